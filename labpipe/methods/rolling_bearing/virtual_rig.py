"""The virtual ball-bearing rig: a shaft on one preloaded bearing, shaken along x, z and about y; RUNS are
listed by `run_names`.

After R. J. W. Knaapen (1997), chapters 3 and 5: accelerations against shaker forces at four axial preloads,
which are set by a threaded shaft through a long string, and read from the string's frequency or from a strain
strip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rolling_bearing.bearing import rolling_coefficients
from labpipe.methods.rolling_bearing.loads import DOFS, transfer_matrix
from labpipe.methods.rolling_bearing.settings import BallBearingSettings
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.settings import Settings, StandardDeviations, choice, integer, quantity, section, setting
from labpipe.simulate import virtual_rigs
from labpipe.simulate.linear import line_frequencies, sense, steady_state

KIND = "virtual-ball-bearing-rig"
FORCES = ("x", "z", "by")
REPEATED = "z"
CALIBRATION_POINTS = 12


@dataclass(frozen=True)
class TestedBearing(Settings):
    """One bearing on the rig, the preloads at which it is tested, and the shaft's bending stiffness under its
    load.
    """

    name: str = setting("text", "short name, with which the names of the runs begin")
    bearing: BallBearingSettings = section("the bearing, with the shaft on it", BallBearingSettings)
    preloads: tuple[float, ...] = setting("values", "axial preloads", "N")
    bending_stiffness: float = quantity(
        "radial stiffness of the bending shaft; default: rigid", "N/m", np.inf
    )

    def __post_init__(self) -> None:
        self.require_not_negative("preloads")
        if self.bearing.shaft is None:
            raise ConfigError("bearing.shaft: is missing", hint="the rig needs the shaft's mass and inertia")
        for given, name, of in (
            (self.bearing.loads.z is not None, "loads.z", "preloads"),
            (self.bearing.damping_factor > 0, "damping_factor", "its own damping_factor"),
        ):
            if given:
                raise SettingError("bearing", f"bearing.{name}: the rig sets it by {of}", "leave it out")
        self.require_positive("bending_stiffness")
        if len({f"{preload:g}" for preload in self.preloads}) < len(self.preloads):
            raise SettingError("preloads", "'preloads' names one twice", "[427 N, 701 N]")


@dataclass(frozen=True)
class Sampling(Settings):
    """How a shaker test is recorded: in the steady state of a multisine."""

    rate: float = quantity("sampling rate", "Hz", 3200.0)
    spacing: float = quantity("spacing of the multisine's lines", "Hz", 2.0)
    band: tuple[float, float] = setting("band", "frequencies excited", "Hz", (20.0, 1500.0))
    periods: int = integer("periods recorded", 3)
    force: float = quantity("rms force of a shaker", "N", 10.0)

    def __post_init__(self) -> None:
        self.require_positive("rate", "spacing", "periods", "force")


@dataclass(frozen=True)
class RigNoise(StandardDeviations):
    """Standard deviations of measuring noise and of settings."""

    acceleration: float = quantity("accelerometers", "m/s^2", 0.3)
    force: float = quantity("force transducer", "N", 0.1)
    preload: float = quantity("setting of a preload, relative", "1", 0.005)
    string: float = quantity("force read while the string is calibrated", "N", 20.0)
    strip: float = quantity("force read while the strip is calibrated", "N", 20.0)


@dataclass(frozen=True, kw_only=True)
class VirtualBallBearingRig(Settings):
    """Bearings, shaft, sensors, and the deviation from theory: ratio of true to theoretical stiffness."""

    kind: str = choice("which virtual rig", (KIND,))
    deep_groove: TestedBearing = section("first bearing: tested up and down and repeatedly", TestedBearing)
    angular: TestedBearing | None = section("second bearing: tested up", TestedBearing, None)
    name: str = setting("text", "name of the rig", default="Virtual ball-bearing rig")
    stiffness_ratio: float = quantity("true stiffness over the theory's", "1", 1.12)
    damping_factor: float = quantity("beta of the bearings' damping C = beta K", "s", 2e-5)
    hysteresis: float = quantity("stiffness gained on the way down, relative", "1", 0.0)
    arm: float = quantity("distance of tilting shakers and accelerometers from the bearing", "m", 0.1)
    mountings: int = integer("times the preload is set anew for the repeatability test", 5)
    repeats: int = integer("tests after each setting", 3)
    string_factor: float = quantity("a of the string's P = a f^2", "N/Hz^2", 0.009189)
    strip_factor: float = quantity("b of the strip's F = b S + c", "N/V", 2079.0)
    strip_offset: float = quantity("c of the strip's F = b S + c", "N", 0.0092)
    sampling: Sampling = section("how tests are recorded", Sampling, Sampling())
    noise: RigNoise = section("noise and scatter", RigNoise, RigNoise())

    def __post_init__(self) -> None:
        self.require_positive("stiffness_ratio", "arm", "string_factor", "strip_factor")
        self.require_positive("mountings", "repeats")
        self.require_not_negative("damping_factor")
        if self.hysteresis <= -1:
            raise SettingError("hysteresis", "'hysteresis' takes all stiffness away", "above -100 %")
        if self.angular is not None and self.angular.name == self.deep_groove.name:
            raise SettingError("angular", f"both bearings are named '{self.angular.name}'", "rename one")


@dataclass(frozen=True)
class ShakerTest:
    """One run: a bearing at one nominal *preload* [N]; *setting*: name of the setting of the preload, *way*:
    up or down.
    """

    tested: TestedBearing
    preload: float
    setting: str
    way: str
    force: str


def shaker_tests(rig: VirtualBallBearingRig) -> dict[str, ShakerTest]:
    """The runs "6208-427N-up-x", and "6208-701N-m1-r1-z" of mounting 1, repeat 1."""
    first = rig.deep_groove
    ways = [(first, "up"), (first, "down"), *([(rig.angular, "up")] if rig.angular else [])]
    tests: dict[str, ShakerTest] = {}
    for tested, way in ways:
        for preload in tested.preloads:
            start = f"{tested.name}-{preload:g}N-{way}"
            tests |= {f"{start}-{force}": ShakerTest(tested, preload, start, way, force) for force in FORCES}
    preload = first.preloads[min(1, len(first.preloads) - 1)]
    for mounting in range(1, rig.mountings + 1):
        start = f"{first.name}-{preload:g}N-m{mounting}"
        for repeat in range(1, rig.repeats + 1):
            tests[f"{start}-r{repeat}-{REPEATED}"] = ShakerTest(first, preload, start, "up", REPEATED)
    return tests


def run_names(rig: VirtualBallBearingRig) -> tuple[str, ...]:
    """Shaker tests, then the calibrations "string" and "strip"."""
    return (*shaker_tests(rig), "string", "strip")


def simulate_ball_bearing(
    rig: VirtualBallBearingRig, seed: int, runs: Sequence[str] | None = None
) -> tuple[virtual_rigs.SimulatedRun, ...]:
    """The named runs (all unless named); a run's samples depend on rig, seed and its name only."""
    tests = shaker_tests(rig)
    names = virtual_rigs.chosen_runs(rig, runs)
    return tuple(
        _shaken(rig, tests[name], name, seed) if name in tests else _calibration(rig, name, seed)
        for name in names
    )


def true_preload(rig: VirtualBallBearingRig, test: ShakerTest, seed: int) -> float:
    """True preload [N]: one draw for all runs of a setting."""
    return test.preload * (
        1 + rig.noise.preload * float(virtual_rigs.generator(seed, test.setting).standard_normal())
    )


def true_stiffness(rig: VirtualBallBearingRig, test: ShakerTest, preload: float) -> FloatArray:
    """K of the bearing (5, 5): ratio (1 + hysteresis on the way down) times the theory's at the preload [N].
    Equation (sim-ball).
    """
    loads = replace(test.tested.bearing.loads, z=preload)
    (theory,) = rolling_coefficients([replace(test.tested.bearing, loads=loads)])
    factor = rig.stiffness_ratio * (1 + rig.hysteresis if test.way == "down" else 1.0)
    return factor * theory.stiffness


def lever(rig: VirtualBallBearingRig) -> FloatArray:
    """Displacement measured per dof, (5,) [m/m, m/rad]: a tilt is measured as displacement at the arm, its
    moment is a force there.
    """
    return np.array([1.0, 1.0, 1.0, rig.arm, rig.arm])


def _shaken(rig: VirtualBallBearingRig, test: ShakerTest, name: str, seed: int) -> virtual_rigs.SimulatedRun:
    rng, sampling, shaft = virtual_rigs.generator(seed, name), rig.sampling, test.tested.bearing.shaft
    assert shaft is not None
    preload = true_preload(rig, test, seed)
    stiffness = true_stiffness(rig, test, preload)
    force = design_multisine(sampling.band, sampling.spacing, sampling.force)
    omega = line_frequencies(force)
    receptance = transfer_matrix(
        shaft.body, stiffness, omega / (2 * np.pi), rig.damping_factor, test.tested.bending_stiffness
    )
    column = DOFS.index(test.force)
    n_sample = round(sampling.rate / sampling.spacing)
    samples = [force.samples(sampling.rate, sampling.periods)]
    for dof in FORCES:
        row = DOFS.index(dof)
        arms = lever(rig)[row] * lever(rig)[column]
        samples.append(
            steady_state(force, -(omega**2) * arms * receptance[:, row, column], n_sample, sampling.periods)
        )
    noise = [rig.noise.force, *[rig.noise.acceleration] * len(FORCES)]
    recording = sense(name, _channels(test.force), samples, noise, sampling.rate, rng)
    truth = {"preload_set": test.preload, "preload": preload, "ratio": rig.stiffness_ratio}
    truth |= {"stiffness": stiffness.tolist(), "beta": rig.damping_factor}
    return virtual_rigs.SimulatedRun(name, truth, recording)


def _channels(force: str) -> tuple[Channel, ...]:
    outputs = [Channel(dof, "acceleration", "output", dof, AXIS_ANGLES.get(dof)) for dof in FORCES]
    return (Channel("f", "force", "input", force, AXIS_ANGLES.get(force)), *outputs)


def _calibration(rig: VirtualBallBearingRig, name: str, seed: int) -> virtual_rigs.SimulatedRun:
    rng = virtual_rigs.generator(seed, name)
    force = np.linspace(150.0, 1800.0, CALIBRATION_POINTS)
    title, read, noise = "frequency [Hz]", np.sqrt(force / rig.string_factor), rig.noise.string
    truth = {"a": rig.string_factor}
    if name == "strip":
        title, read, noise = "strip [V]", (force - rig.strip_offset) / rig.strip_factor, rig.noise.strip
        truth = {"b": rig.strip_factor, "c": rig.strip_offset}
    table = {title: read, "force [N]": force + rng.normal(0.0, noise, force.size)}
    return virtual_rigs.SimulatedRun(name, truth, table=table)


def _parameters(rig: VirtualBallBearingRig, runs: Sequence[str]) -> virtual_rigs.Truth:
    """k and k_row_column of the dofs that are shaken [N/m], as measured at the arm, at the preload that was
    to be set; k of a single run. ConfigError for runs of several bearings or preloads, and for calibrations.
    """
    tests = [test for name, test in shaker_tests(rig).items() if name in runs]
    if len({(test.tested.name, test.preload, test.way) for test in tests}) != 1 or len(tests) != len(runs):
        raise ConfigError(
            "'runs' of one bearing, preload and way give one FRF matrix",
            hint="for example runs: [6208-427N-up-z]",
        )
    stiffness = true_stiffness(rig, tests[0], tests[0].preload) / np.outer(lever(rig), lever(rig))
    places = [DOFS.index(dof) for dof in FORCES]
    terms = {
        f"k_{DOFS[row]}_{DOFS[column]}": float(stiffness[row, column]) for row in places for column in places
    }
    if len(tests) == 1:
        terms["k"] = terms[f"k_{tests[0].force}_{tests[0].force}"]
        terms["c"] = rig.damping_factor * terms["k"]
    return terms


def _set_level(rig: VirtualBallBearingRig, level: float) -> VirtualBallBearingRig:
    noise = rig.noise
    return replace(
        rig, noise=replace(noise, acceleration=level * noise.acceleration, force=level * noise.force)
    )


BALL_BEARING_RIG = virtual_rigs.kind_of_tests(
    VirtualBallBearingRig,
    runs=run_names,
    tests=simulate_ball_bearing,
    logged=virtual_rigs.force_and_accelerations,
    parameters=_parameters,
    noisy=_set_level,
)
