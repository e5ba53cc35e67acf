"""A virtual floating-stator rig: shakers push the stator, probes see it move against the shaft,
accelerometers see it move.

Stator: (Z_s + H) X_s - H X_r = F, shaft: -H X_s + (Z_r + H) X_r = F_r, with H the film, Z_s = -w^2 m_s + j w
C_b + K_b the stator on its hoses and soft supports, Z_r the same of the shaft.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.journal_bearing.bearing import converged_equilibrium
from labpipe.methods.journal_bearing.kind import JournalSettings
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.settings import Settings, StandardDeviations, choice, integer, quantity, section, setting
from labpipe.simulate.linear import TACHO, check_matrices, dynamic_stiffness, pulses
from labpipe.simulate.virtual_rigs import Truth, coefficients_by_name, kind_of_recordings, whole_numbers

KIND = "virtual-floating-rig"
Matrix = tuple[tuple[float, ...], ...]
NONE: Matrix = ((0.0, 0.0), (0.0, 0.0))
RUNS_OF = {
    "alternating": ("x", "y"),
    "hadamard": ("plus", "minus"),
    "zipper": ("zipper",),
    "random": ("random",),
}
FILMS = ("given", "journal")


@dataclass(frozen=True)
class Relaxation(Settings):
    """G j w tau / (1 + j w tau) in either direction: damping that turns into stiffness."""

    stiffness: float = quantity("stiffness G that is added at high frequency", "N/m")
    time: float = quantity("relaxation time tau", "s")

    def __post_init__(self) -> None:
        self.require_positive("time")


@dataclass(frozen=True)
class Pad(Settings):
    """(R_0 + j w R_1) / (1 + 2 zeta j w / w_0 - (w / w_0)^2) in either direction: a pad with inertia, as of a
    tilting-pad bearing.
    """

    stiffness: float = quantity("R_0", "N/m")
    damping: float = quantity("R_1", "N.s/m")
    frequency: float = quantity("natural frequency of the pad, w_0", "Hz")
    damping_ratio: float = quantity("damping ratio of the pad", "1")

    def __post_init__(self) -> None:
        self.require_positive("frequency", "damping_ratio")


@dataclass(frozen=True)
class FilmCondition(Settings):
    """A condition of the test: the film between stator and shaft, H = K + j w C - w^2 M and what is added to
    it.
    """

    speed: float = quantity("shaft speed", "Hz", 0.0)
    load: float = quantity("static load on the bearing, downwards (-y)", "N", 0.0)
    pressure: float = quantity("pressure drop or supply pressure, for the record", "Pa", 0.0)
    film: str = choice("K and C as given here, or of the rig's journal bearing", FILMS, "given")
    stiffness: Matrix = setting("matrix", "K of the film (x, y)", "N/m", NONE)
    damping: Matrix = setting("matrix", "C of the film", "N.s/m", NONE)
    mass: Matrix = setting("matrix", "virtual mass M of the film", "kg", NONE)
    relaxation: Relaxation | None = section("relaxation, added in x and in y", Relaxation, None)
    pad: Pad | None = section("pad with inertia, added in x and in y", Pad, None)

    def __post_init__(self) -> None:
        check_matrices(self, 2, "stiffness", "damping", "mass")
        self.require_not_negative("speed")
        if self.film == "journal" and not (self.speed > 0 and self.load > 0):
            raise SettingError("film", "a journal bearing needs a speed and a load")
        given = {"stiffness", "damping"}.intersection(self.written)
        if self.film == "journal" and given:
            name = max(given)
            raise SettingError(name, f"'{name}' is that of the rig's journal bearing", "leave it out")


@dataclass(frozen=True)
class FloatingNoise(StandardDeviations):
    """Measuring noise of a sample, white up to half the sampling rate."""

    force: float = quantity("load cells", "N", 2.0)
    displacement: float = quantity("relative probes", "m", 2e-7)
    acceleration: float = quantity("accelerometers", "m/s^2", 0.05)
    drive: float = quantity("recorded drives", "V", 1e-4)

    def of(self, quantity: str) -> float:
        return float(getattr(self, "drive" if quantity == "voltage" else quantity))


@dataclass(frozen=True)
class FloatingRig(Settings):
    """A stator on soft supports around a shaft on its own supports, pushed by two shakers. Runs CONDITION-x,
    -y, -plus, -minus, ...
    """

    kind: str = choice("which virtual rig", (KIND,))
    stator_mass: float = quantity("mass of the stator with its housing", "kg")
    conditions: tuple[tuple[str, FilmCondition], ...] = setting(
        "sections", "conditions by name", section=FilmCondition, default=(), needed=True
    )
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual floating stator")
    journal: JournalSettings | None = section(
        "journal bearing between stator and shaft", JournalSettings, None
    )
    baseline_stiffness: Matrix = setting("matrix", "of hoses and soft supports on the stator", "N/m", NONE)
    baseline_damping: Matrix = setting("matrix", "of the same", "N.s/m", NONE)
    shaft_mass: float = quantity("mass that moves with the shaft", "kg", 40.0)
    shaft_stiffness: Matrix = setting(
        "matrix", "of the shaft's own supports", "N/m", ((2.4e8, 0.0), (0.0, 2.4e8))
    )
    shaft_damping: Matrix = setting("matrix", "of the same", "N.s/m", ((2e4, 0.0), (0.0, 2e4)))
    shaft_noise: float = quantity(
        "rms of a random force on the shaft in x and in y, white in the band", "N", 0.0
    )
    unbalance: float = quantity("mass times eccentricity of the shaft", "kg.m", 0.0)
    runout: tuple[float, ...] = setting(
        "values", "amplitudes of 1x, 2x, ... that the probes see of the shaft's surface", "m", ()
    )
    excitation: str = choice("recordings that are made unless they are named", tuple(RUNS_OF), "hadamard")
    force: float = quantity("rms force of one shaker", "N", 2000.0)
    band: tuple[float, float] = setting("band", "excited frequencies", "Hz", (10.0, 100.0))
    spacing: float = quantity("spacing of the excited lines", "Hz", 1.0)
    slope: float = quantity(
        "power of frequency with which the amplitude of the lines goes, -1 for 1/f", "1", 0.0
    )
    periods: int = integer("periods recorded, all of them steady", 8)
    sample_rate: float = quantity("sampling rate", "Hz", 2000.0)
    drives: bool = setting("flag", "the drives of the shakers, u_x and u_y, are recorded too", default=False)
    gain: float = quantity("force of a shaker over its drive", "N/V", 1000.0)
    probe_delay: float = quantity("delay of the relative probes", "s", 0.0)
    noise: FloatingNoise = section("measuring noise", FloatingNoise, FloatingNoise())

    def __post_init__(self) -> None:
        check_matrices(self, 2, "baseline_stiffness", "baseline_damping", "shaft_stiffness", "shaft_damping")
        self.require_positive("stator_mass", "shaft_mass", "force", "spacing")
        self.require_positive("periods", "sample_rate", "gain")
        self.require_not_negative("shaft_noise", "unbalance", "runout")
        if not self.conditions:
            raise SettingError("conditions", "conditions: are missing", "for example conditions: {dry: {}}")
        if self.journal is None and any(condition.film == "journal" for _, condition in self.conditions):
            what = "a condition has the film of a journal bearing, the rig has no `journal`"
            raise SettingError("conditions", what)
        fastest = max(condition.speed for _, condition in self.conditions) * max(len(self.runout), 1)
        if not fastest < self.sample_rate / 2:
            what = f"the shaft turns, or runs out, at {fastest:g} Hz, beyond half the sampling rate"
            raise SettingError("sample_rate", what, f"above {2 * fastest:g} Hz")
        if not self.band[1] < self.sample_rate / 2:
            what = f"band must lie below half the sampling rate, {self.sample_rate / 2:g} Hz"
            raise SettingError("band", what)
        exact = self.sample_rate / self.spacing
        if abs(exact - round(exact)) > 1e-9 * exact:
            what = f"a period of {1 / self.spacing:g} s holds no whole number of samples"
            raise SettingError("spacing", what)

    @property
    def runs(self) -> tuple[str, ...]:
        return tuple(
            f"{name}-{end}" for name, _ in self.conditions for ends in RUNS_OF.values() for end in ends
        )

    @property
    def usual(self) -> tuple[str, ...]:
        """The recordings of every condition under the rig's `excitation`."""
        return tuple(f"{name}-{end}" for name, _ in self.conditions for end in RUNS_OF[self.excitation])

    def condition(self, run: str) -> FilmCondition:
        return dict(self.conditions)[run.rpartition("-")[0]]

    @property
    def n_sample(self) -> int:
        return self.periods * round(self.sample_rate / self.spacing)

    @property
    def lines_in_band(self) -> tuple[IntArray, FloatArray]:
        """Numbers and frequencies [Hz] of the lines of a whole recording within the band, (n_line,) each."""
        frequency = fft.rfftfreq(self.n_sample, 1 / self.sample_rate)
        low, high = self.band[0] * (1 - 1e-9), self.band[1] * (1 + 1e-9)
        inside = np.flatnonzero((frequency >= low) & (frequency <= high) & (frequency > 0))
        return inside, frequency[inside]


AXES = ("x", "y")
MESH_ERROR = 0.01


@lru_cache(maxsize=16)
def _journal(journal: JournalSettings, load: float, speed: float) -> tuple[FloatArray, FloatArray]:
    """K and C of a journal bearing; its y and z are x and y here, and it turns from x to y."""
    state = converged_equilibrium(journal.bearing(), (0.0, -load), 2 * np.pi * speed, MESH_ERROR)
    return state.stiffness, state.damping


def coefficients(rig: FloatingRig, condition: FilmCondition) -> tuple[FloatArray, FloatArray, FloatArray]:
    """K [N/m], C [N s/m] and M [kg] of the film, (2, 2) each, without relaxation and pad."""
    stiffness, damping = np.array(condition.stiffness, float), np.array(condition.damping, float)
    if condition.film == "journal":
        assert rig.journal is not None
        stiffness, damping = _journal(rig.journal, condition.load, condition.speed)
    return stiffness, damping, np.array(condition.mass, float)


def film(rig: FloatingRig, condition: FilmCondition, frequency: FloatArray) -> ComplexArray:
    """H = K + j w C - w^2 M + relaxation + pad at *frequency* (n,) [Hz], (n, 2, 2) [N/m]: force on the stator
    is -H D.

    Equation (sim-film).
    """
    omega = 2 * np.pi * np.asarray(frequency, float)
    jw = 1j * omega[:, None, None]
    stiffness, damping, mass = coefficients(rig, condition)
    dynamic = dynamic_stiffness(mass, stiffness, damping, omega)
    if condition.relaxation is not None:
        relative = jw * condition.relaxation.time
        dynamic = dynamic + condition.relaxation.stiffness * relative / (1 + relative) * np.eye(2)
    if condition.pad is not None:
        pad = condition.pad
        relative = jw / (2 * np.pi * pad.frequency)
        reduced = (pad.stiffness + jw * pad.damping) / (1 + 2 * pad.damping_ratio * relative + relative**2)
        dynamic = dynamic + reduced * np.eye(2)
    return dynamic


def motions(
    rig: FloatingRig, condition: FilmCondition, frequency: FloatArray, forces: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """X_s and X_r (n, 2) [m] under *forces* (n, 4) [N] on the stator and on the shaft at *frequency* (n,)
    [Hz]. Equation (sim-floating).
    """
    omega, h = 2 * np.pi * np.asarray(frequency, float), film(rig, condition, frequency)
    stator = dynamic_stiffness(
        rig.stator_mass * np.eye(2), rig.baseline_stiffness, rig.baseline_damping, omega
    )
    shaft = dynamic_stiffness(rig.shaft_mass * np.eye(2), rig.shaft_stiffness, rig.shaft_damping, omega)
    moved = np.linalg.solve(np.block([[stator + h, -h], [-h, shaft + h]]), forces[:, :, None])[:, :, 0]
    return moved[:, :2], moved[:, 2:]


def _run(rig: FloatingRig, name: str, rng: np.random.Generator) -> Recording:
    """f_x, f_y, d_x, d_y, a_x, a_y [SI], the drives u_x, u_y if the rig has them, and the tacho n, still with
    the shaft. Periodic in the whole run and band-limited, so every line is the exact steady state.
    """
    condition = rig.condition(name)
    inside, lines = rig.lines_in_band
    shape = (lines.size, 2)
    draws = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    pushed = SHAKERS[name.rpartition("-")[2]](rig, rng)[inside]
    forces = np.hstack([pushed, draws * rig.shaft_noise / np.sqrt(lines.size)])
    stator, shaft = motions(rig, condition, lines, forces)
    late = np.exp(-2j * np.pi * lines * rig.probe_delay)[:, None]
    amplitudes = np.hstack([pushed, (stator - shaft) * late, -((2 * np.pi * lines[:, None]) ** 2) * stator])
    phase = rng.uniform(0, 2 * np.pi)
    samples = _time_signal(rig, inside, amplitudes) + _synchronous(rig, condition, phase)
    kinds = (("f", "force", "input"), ("d", "displacement", "output"), ("a", "acceleration", "output"))
    channels = [
        Channel(f"{letter}_{axis}", quantity, role, axis, AXIS_ANGLES[axis])
        for letter, quantity, role in kinds
        for axis in AXES
    ]
    if rig.drives:
        samples = np.hstack([samples, _time_signal(rig, inside, pushed / rig.gain)])
        channels += [Channel(f"u_{axis}", "voltage", "reference", axis, AXIS_ANGLES[axis]) for axis in AXES]
    noise = [rig.noise.of(channel.quantity) for channel in channels]
    samples = samples + rng.standard_normal(samples.shape) * noise
    tacho = pulses(_angle(rig, condition.speed) + phase) * (condition.speed > 0)
    return Recording((*channels, TACHO), np.column_stack([samples, tacho]), rig.sample_rate, name)


def _time_signal(rig: FloatingRig, lines: IntArray, amplitudes: ComplexArray) -> FloatArray:
    spectrum = np.zeros((rig.n_sample // 2 + 1, amplitudes.shape[1]), np.complex128)
    spectrum[lines] = amplitudes * (rig.n_sample / 2)
    return fft.irfft(spectrum, rig.n_sample, axis=0)


def _angle(rig: FloatingRig, speed: float) -> FloatArray:
    return 2 * np.pi * speed * np.arange(rig.n_sample) / rig.sample_rate


def _synchronous(rig: FloatingRig, condition: FilmCondition, phase: float) -> FloatArray:
    total = np.zeros((rig.n_sample, 6))
    if condition.speed == 0:
        return total
    angle = _angle(rig, condition.speed) + phase
    if rig.unbalance > 0:
        omega = 2 * np.pi * condition.speed
        force = np.array([[0, 0, 1, -1j]], np.complex128) * rig.unbalance * omega**2
        stator, shaft = motions(rig, condition, np.array([condition.speed]), force)
        late = np.exp(-1j * omega * rig.probe_delay)
        amplitudes = np.concatenate([np.zeros(2), (stator - shaft)[0] * late, -(omega**2) * stator[0]])
        total += (np.exp(1j * angle)[:, None] * amplitudes).real
    late_by = 2 * np.pi * condition.speed * rig.probe_delay
    for order, amplitude in enumerate(rig.runout, 1):
        for column, quarter in ((2, 0.0), (3, np.pi / 2)):
            total[:, column] -= amplitude * np.cos(order * (angle - quarter - late_by))
    return total


def _periodic(rig: FloatingRig, shares: tuple[float, float], zipper: bool = False) -> ComplexArray:
    design = design_multisine(rig.band, rig.spacing, rig.force)
    amplitude = (design.lines * design.spacing) ** rig.slope * np.exp(1j * design.phases)
    both = amplitude[:, None] * np.array(shares)
    if zipper:
        both = both * (np.arange(design.lines.size)[:, None] % 2 == np.arange(2))
    rms = np.sqrt(np.sum(np.abs(both) ** 2, axis=0) / 2)
    spectrum = np.zeros((rig.n_sample // 2 + 1, 2), np.complex128)
    spectrum[design.lines * rig.periods] = both * rig.force / np.where(rms > 0, rms, 1.0)
    return spectrum


def _random(rig: FloatingRig, rng: np.random.Generator) -> ComplexArray:
    inside, lines = rig.lines_in_band
    if not inside.size:
        raise SettingError("band", "no line of a whole recording lies in the band", "widen it")
    draws = rng.standard_normal((inside.size, 2)) + 1j * rng.standard_normal((inside.size, 2))
    draws = draws * (lines**rig.slope)[:, None]
    spectrum = np.zeros((rig.n_sample // 2 + 1, 2), np.complex128)
    spectrum[inside] = draws * rig.force / np.sqrt(np.sum(np.abs(draws) ** 2, axis=0) / 2)
    return spectrum


# End of the name of a run -> amplitudes (n_sample // 2 + 1, 2) of the shakers' forces [N].
SHAKERS: dict[str, Callable[[FloatingRig, np.random.Generator], ComplexArray]] = {
    "x": lambda rig, _rng: _periodic(rig, (1, 0)),
    "y": lambda rig, _rng: _periodic(rig, (0, 1)),
    "plus": lambda rig, _rng: _periodic(rig, (1, 1)),
    "minus": lambda rig, _rng: _periodic(rig, (1, -1)),
    "zipper": lambda rig, _rng: _periodic(rig, (1, 1), zipper=True),
    "random": _random,
}


def truth(rig: FloatingRig) -> dict[str, Any]:
    stator = coefficients_by_name(AXES, k=rig.baseline_stiffness, c=rig.baseline_damping)
    conditions: dict[str, Any] = {}
    for name, condition in rig.conditions:
        entries: dict[str, Any] = {"speed_hz": condition.speed}
        entries |= {"load": condition.load, "pressure": condition.pressure}
        for part in (condition.relaxation, condition.pad):
            entries |= {} if part is None else {type(part).__name__.lower(): vars(part)}
        conditions[name] = entries | _coefficients_by_name(rig, condition)
    return {"stator_mass": rig.stator_mass, "baseline": stator, "conditions": conditions}


def _coefficients_by_name(rig: FloatingRig, condition: FilmCondition) -> Truth:
    stiffness, damping, mass = coefficients(rig, condition)
    return coefficients_by_name(AXES, k=stiffness, c=damping, m=mass)


def _parameters(rig: FloatingRig, runs: Sequence[str]) -> Truth:
    if len(dict.fromkeys(run.rpartition("-")[0] for run in runs)) != 1:
        hint = "for example runs: [seal-plus, seal-minus]"
        raise ConfigError("'runs' of one condition belong to one fit", hint=hint)
    return _coefficients_by_name(rig, rig.condition(runs[0]))


FLOATING_RIG = kind_of_recordings(
    FloatingRig,
    runs=lambda rig: rig.runs,
    usual=lambda rig: rig.usual,
    record=_run,
    logged=whole_numbers,
    truth=truth,
    parameters=_parameters,
)
