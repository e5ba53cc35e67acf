"""A virtual rotor with all its tests: shaken on strings and in its bearings, run up.

Its truth is drawn from what the rotor file declares, the small errors that are everywhere too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rotor_system.build import Built, RotorSystem, Sensors, SmallErrors, build
from labpipe.methods.rotor_system.evidence import RunUpVectors, run_up_whitener
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import Settings, choice, integer, quantity, setting, text
from labpipe.simulate.virtual_rigs import LoggedTable, kind_of_recordings, whole_numbers

KIND = "virtual-rotor-rig"
# The rotor on strings; shaken at rest in y, and in z; run up.
FREE, SHAKEN, RUN_UP = "free", ("shaken-y", "shaken-z"), "run-up"
RUNS = (FREE, *SHAKEN, RUN_UP)
# Shares of a turn in which the tacho's pulse is high, and in which it rises, through half its height [V] at
# the mark.
PULSE, RISE, HIGH = 0.2, 0.08, 5.0


@dataclass(frozen=True)
class RotorTestRig(Settings):
    """A rotor file's rotor, its tests and their noise; *system*: contents of `rotor`."""

    kind: str = choice("which virtual rig", (KIND,))
    rotor: str = setting("file", "rotor file with uncertainties", file_kind="rotor-system", into="system")
    force: int = integer("node at which the rotor is shaken")
    accelerations: tuple[float, ...] = setting("values", "nodes of the accelerometers, y and z", "1")
    probes: tuple[float, ...] = setting("values", "nodes of the probes, y and z", "1")
    speeds: tuple[float, float] = setting("band", "of the run-up", "Hz")
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual rotor with all its tests")
    truth: int = integer("seed of the truth, drawn from what is declared; 0: as declared in the middle", 1)
    amplitude: float = quantity("force on a line", "N", 1.0)
    band: tuple[float, float] = setting("band", "lines of the forces", "Hz", (10.0, 300.0))
    spacing: float = quantity("distance of the lines, one over the period", "Hz", 1.0)
    periods: int = integer("periods recorded", 6)
    duration: float = quantity("of the run-up", "s", 40.0)
    acceleration_noise: float = quantity("standard deviation", "m/s^2", 0.3)
    force_noise: float = quantity("standard deviation", "N", 0.02)
    probe_noise: float = quantity("standard deviation", "m", 1e-6)
    gain: float = quantity("standard deviation of the probes' gains", "1", 0.0)
    sample_rate: float = quantity("sampling rate", "Hz", 2000.0)
    system: RotorSystem | None = None

    def __post_init__(self) -> None:
        self.require_positive("amplitude", "spacing", "duration", "sample_rate")
        self.require_not_negative("acceleration_noise", "force_noise", "probe_noise", "gain")
        n = self.sample_rate / self.spacing
        if abs(n - round(n)) > 1e-6 * n:
            raise SettingError("spacing", f"a period of {n:.6g} samples is not a whole number of them")
        if self.periods < 2:
            raise SettingError("periods", "at least two periods are needed")
        if not self.lines.size or self.lines[0] < 1:
            raise SettingError("band", f"no line every {self.spacing:g} Hz, or one at 0 Hz, lies in the band")
        if self.band[1] >= self.sample_rate / 2 or self.speeds[1] >= self.sample_rate / 4:
            raise SettingError("sample_rate", "the sampling rate is too low for band and speeds")
        last = np.inf if self.system is None else self.system.rig.rotor.n_node
        places = {"force": [self.force], "accelerations": self.accelerations, "probes": self.probes}
        for name, nodes in places.items():
            if len(set(nodes)) < len(nodes) or any(node % 1 or not 1 <= node <= last for node in nodes):
                raise SettingError(name, f"'{name}': whole numbers of nodes, from 1 to {last:g}, each once")

    @property
    def lines(self) -> FloatArray:
        """Numbers (n_line,) [1] of the excited lines."""
        low, high = self.band
        return np.arange(np.ceil(low / self.spacing - 1e-9), np.floor(high / self.spacing + 1e-9) + 1)


@dataclass(frozen=True)
class World:
    """A rig with its true *values* (n_unknown,) [unit of each]."""

    rig: RotorTestRig
    system: RotorSystem
    built: Built
    values: FloatArray

    def dofs(self, names: Sequence[float]) -> list[int]:
        return [dof for node in names for dof in self.system.rig.rotor.dofs(int(node))]


def world_of(rig: RotorTestRig) -> World:
    """The rig with values drawn from what its rotor file declares."""
    assert rig.system is not None
    labels = tuple(f"{int(node)} {axis}" for node in rig.probes for axis in ("x", "y"))
    built = build(rig.system, SmallErrors(), {RUN_UP: Sensors(labels, rig.gain, True, True)})
    model = built.model
    drawn = np.random.default_rng(rig.truth).standard_normal(len(model.unknowns)) if rig.truth else 0.0
    return World(rig, rig.system, built, model.means + model.errors * drawn)


def true_values(rig: RotorTestRig) -> dict[str, float]:
    """The unknowns by name: logarithms of factors, and amounts in their units."""
    world = world_of(rig)
    names = (unknown.name for unknown in world.built.model.unknowns)
    return dict(zip(names, world.values.tolist(), strict=True))


def _shaken(world: World, name: str, rng: np.random.Generator) -> Recording:
    """Random-phase multisine at one node in y or z; free on strings, or in the bearings."""
    rig, model, lines = world.rig, world.built.model, world.rig.lines
    if name != FREE and any(place.is_film for place in world.system.rig.bearings):
        what = f"the rotor rests in run '{name}', where no oil film carries it"
        raise ConfigError(what, hint=f"--run {FREE}")
    n = round(rig.sample_rate / rig.spacing)
    force = rig.amplitude * np.exp(2j * np.pi * rng.random(lines.size))
    outputs = world.dofs(rig.accelerations)
    driven = world.system.rig.rotor.dofs(rig.force)[name == SHAKEN[1]]
    values = np.where(model.acting(name), world.values, 0.0)
    omega = 2 * np.pi * lines * rig.spacing
    column = np.eye(model.n_dof)[:, [driven]]
    motion, _, _ = model.response(values, np.zeros(lines.size), omega, column, outputs, name != FREE)
    acceleration = -(omega[:, None] ** 2) * motion[:, :, 0] * force[:, None]
    whole = np.zeros((n // 2 + 1, 1 + len(outputs)), np.complex128)
    whole[lines.astype(int)] = np.column_stack([force, acceleration]) * n / 2
    samples = np.tile(np.fft.irfft(whole, n, axis=0), (rig.periods, 1))
    noise = [rig.force_noise, *[rig.acceleration_noise] * len(outputs)]
    dof = f"{rig.force}{'z' if name == SHAKEN[1] else 'y'}"
    places = [f"{int(node)}{axis}" for node in rig.accelerations for axis in "yz"]
    channels = [Channel("f", "force", "input", dof)]
    channels += [Channel(f"a{place}", "acceleration", "output", place) for place in places]
    samples = samples + rng.standard_normal(samples.shape) * noise
    return Recording(tuple(channels), samples, rig.sample_rate, name)


def _run_up(world: World, name: str, rng: np.random.Generator) -> Recording:
    """y(t) = Re(z(Omega(t)) exp(j phi(t))), a pulse of the tacho at every whole turn."""
    rig, built, outputs = world.rig, world.built, world.dofs(world.rig.probes)
    if not built.planes:
        raise ConfigError("nothing excites the run-up", hint="unbalances of the rotor file, or other runs")
    low, high = (2 * np.pi * end for end in rig.speeds)
    time = np.arange(round(rig.duration * rig.sample_rate)) / rig.sample_rate
    rate = (high - low) / rig.duration
    turned = low * time + rate * time**2 / 2
    speed = low + rate * time
    grid = np.linspace(low, high, 200)
    test = RunUpVectors(
        RUN_UP,
        grid,
        tuple(outputs),
        np.zeros((grid.size, len(outputs)), complex),
        run_up_whitener(np.ones((len(outputs), 1)), 0.0),
        planes=tuple(built.planes.values()),
        gains=built.gains[RUN_UP],
        phases=built.phases[RUN_UP],
    )
    vectors, _, _ = test.readings(built.model, world.values)
    motion = (scipy.interpolate.CubicSpline(grid, vectors)(speed) * np.exp(1j * turned)[:, None]).real
    motion = motion + rig.probe_noise * rng.standard_normal(motion.shape)
    share = (turned / (2 * np.pi) + 0.5) % 1 - 0.5
    tacho = HIGH * np.clip(0.5 + np.minimum(share, PULSE - share) / RISE, 0.0, 1.0)
    channels = [Channel("n", "tacho", "reference", "n")]
    channels += [
        Channel(f"p{int(node)}{axis}", "displacement", "output", f"node {int(node)}.{axis}")
        for node in rig.probes
        for axis in "xy"
    ]
    return Recording(tuple(channels), np.column_stack([tacho, motion]), rig.sample_rate, name)


def record(rig: RotorTestRig, name: str, rng: np.random.Generator) -> Recording:
    """A run of the rig: a shaken one is in its steady state, a run-up is quasi-steady."""
    return (_run_up if name == RUN_UP else _shaken)(world_of(rig), name, rng)


def _log_table(run: Recording) -> LoggedTable:
    # As loggers of 16 bits store them: in steps of 50 nm and 10 mm/s^2.
    steps = {"displacement": 50, "acceleration": 10}
    by_channel = {channel.name: steps.get(channel.quantity, 1) for channel in run.channels}
    return whole_numbers(run, {"tacho": ("mV", 1e3)}, by_channel)


ROTOR_RIG = kind_of_recordings(
    RotorTestRig,
    runs=lambda _rig: RUNS,
    record=record,
    logged=_log_table,
    truth=true_values,
    noisy=lambda rig, level: replace(
        rig,
        acceleration_noise=level * rig.acceleration_noise,
        force_noise=level * rig.force_noise,
        probe_noise=level * rig.probe_noise,
    ),
)
