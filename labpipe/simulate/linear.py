"""Linear virtual rigs: masses on springs and dampers under a force or on a table that shakes, with sensors
and their noise.

Motions are exact: H times the spectrum of the force line by line, of a force that is periodic in the run, or
of one from rest that is followed until what comes round has died out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.raw_files.excitation import Multisine, Sweep
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.settings import Settings, StandardDeviations, choice, quantity, section, setting, text
from labpipe.simulate import virtual_rigs

# A free decay is followed until this share of it is left.
DIED_OUT = 1e-12


def dynamic_stiffness(
    mass: ArrayLike, stiffness: ArrayLike, damping: ArrayLike, omega: FloatArray
) -> ComplexArray:
    """Z = K + j w C - w^2 M at *omega* (n_line,) [rad/s]: of numbers (n_line,), of matrices (n_line, n_dof,
    n_dof) [N/m]. Equation (sim-one-dof).
    """
    k, c, m = (np.asarray(part, float) for part in (stiffness, damping, mass))
    w = np.reshape(omega, (-1, *[1] * k.ndim))
    return k + 1j * w * c - w**2 * m


def receptance(
    mass: ArrayLike, stiffness: ArrayLike, damping: ArrayLike, frequency: FloatArray
) -> ComplexArray:
    """H = (K + j w C - w^2 M)^-1 at *frequency* (n_line,) [Hz], of the shape of `dynamic_stiffness` [m/N].
    ConfigError where Z has no inverse. Equation (sim-mdof).
    """
    z = dynamic_stiffness(mass, stiffness, damping, 2 * np.pi * frequency)
    try:
        return 1 / z if z.ndim == 1 else np.linalg.inv(z)
    except np.linalg.LinAlgError:
        hint = "as of a free body at 0 Hz, or without damping at a natural frequency"
        raise ConfigError("the response is infinite at a frequency line", hint=hint) from None


def white_noise(
    band: tuple[float, float], rms: float, n_sample: int, sample_rate: float, rng: np.random.Generator
) -> FloatArray:
    """Normal white noise in *band* [Hz] without its mean, periodic in its (n_sample,) samples, of this *rms*;
    ConfigError for a band between two lines.
    """
    spectrum = fft.rfft(rng.standard_normal(n_sample))
    frequency = fft.rfftfreq(n_sample, 1 / sample_rate)
    outside = (frequency < band[0]) | (frequency > band[1]) | (frequency == 0)
    if np.all(outside):
        what = f"no line of a run of {n_sample / sample_rate:g} s lies in {band[0]:g}-{band[1]:g} Hz"
        raise ConfigError(what, hint="widen the band, or make the run longer")
    spectrum[outside] = 0.0
    white = fft.irfft(spectrum, n_sample)
    return white * (rms / np.std(white))


def lines_of(n_sample: int, sample_rate: float, settling: float = 0.0) -> tuple[int, FloatArray]:
    """Samples, and frequencies (n_line,) [Hz], of the DFT of a run that is periodic, or that has *settling*
    [s] after it.
    """
    length = fft.next_fast_len(n_sample + int(settling * sample_rate), real=True) if settling else n_sample
    return length, fft.rfftfreq(length, 1 / sample_rate)


def response(transfer: ComplexArray, force: FloatArray, length: int) -> FloatArray:
    """DFT^-1 [H DFT F], (n_sample,): the response to *force* (n_sample,) [N], *transfer* (n_line,) [unit per
    N] on the lines of `lines_of`. Equation (sim-sweep).
    """
    return fft.irfft(fft.rfft(force, length) * transfer, length)[: force.size]


def line_frequencies(force: Multisine) -> FloatArray:
    """Angular frequencies of the excited lines [rad/s], (n_line,)."""
    return 2 * np.pi * force.spacing * force.lines


def line_amplitude(force: Multisine) -> float:
    """Amplitude of each line of a flat multisine, rms sqrt(2 / n_line) [N]. Equation (sim-line-amplitude)."""
    return float(force.rms * np.sqrt(2 / force.lines.size))


def steady_state(force: Multisine, transfer: ComplexArray, n_sample: int, periods: int) -> FloatArray:
    """Response (n_sample periods,) [unit of the response] to the multisine, exact line by line: X_k = H(w_k)
    F_k. *transfer* (n_line,) [unit of the response per N], *n_sample* of a period. Equation (sim-steady).
    """
    spectrum = np.zeros(n_sample // 2 + 1, np.complex128)
    spectrum[force.lines] = transfer * line_amplitude(force) * np.exp(1j * force.phases) * (n_sample / 2)
    return np.tile(fft.irfft(spectrum, n_sample), periods)


def free_decay(
    displacement: FloatArray, sample_rate: float, frequency: float, damping_ratio: float
) -> FloatArray:
    """The transient that makes the motion start at rest: -x(0) e^{-zeta w t} cos(w t), (n_sample,) [m].
    Equation (sim-transient).
    """
    t = np.arange(displacement.size) / sample_rate
    omega = 2 * np.pi * frequency
    return -displacement[0] * np.exp(-damping_ratio * omega * t) * np.cos(omega * t)


def sense(
    name: str,
    channels: Sequence[Channel],
    clean: Sequence[FloatArray],
    noise: Sequence[float],
    rate: float,
    rng: np.random.Generator,
) -> Recording:
    """What sensors with independent white *noise* [SI] record of the *clean* signals, (n_sample,) each, at
    *rate* [Hz].
    """
    samples = np.column_stack(clean)
    return Recording(tuple(channels), samples + rng.standard_normal(samples.shape) * noise, rate, name)


# Tacho of a shaft: a pulse [V] over this share of every turn.
PULSE, PULSE_SHARE = 5.0, 0.3
TACHO = Channel("n", "tacho", "reference", "n")


def pulses(angle: FloatArray) -> FloatArray:
    """What a TACHO records at *angle* (n_sample,) [rad] of the shaft, (n_sample,) [V]."""
    return np.where(angle / (2 * np.pi) % 1.0 < PULSE_SHARE, PULSE, 0.0)


class OneMass(Settings):
    """A mass on a spring and a damper, excited in a band."""

    mass: float
    stiffness: float
    damping: float
    band: tuple[float, float]
    duration: float
    sample_rate: float

    def check(self, *positive: str) -> None:
        """ConfigError for one of the numbers that is not positive, and for a band that the length of a run or
        the sampling rate does not hold.
        """
        self.require_positive("mass", "stiffness", "damping", "duration", "sample_rate", *positive)
        lowest, highest = 1 / self.duration, self.sample_rate / 2
        if not lowest <= self.band[0] < self.band[1] < highest:
            what = f"band must lie between {lowest:g} Hz, a period in a run, and {highest:g} Hz"
            raise SettingError("band", what)

    @property
    def truth(self) -> dict[str, float]:
        """k, c, mass, f_n and zeta [SI, Hz]."""
        return virtual_rigs.one_mass_truth(self.mass, self.stiffness, self.damping)

    def receptance(self, frequency: FloatArray) -> ComplexArray:
        """H at *frequency* (n,) [Hz], (n,) [m/N]."""
        return receptance(self.mass, self.stiffness, self.damping, frequency)

    def from_rest(self, n_sample: int) -> tuple[int, FloatArray]:
        """`lines_of` a run, (n_line,) [Hz], that is followed until only DIED_OUT is left of what was moving.
        For -2 m / c ln DIED_OUT.
        """
        return lines_of(n_sample, self.sample_rate, float(-np.log(DIED_OUT) * 2 * self.mass / self.damping))


@dataclass(frozen=True)
class BaseNoise(StandardDeviations):
    """Measuring noise, white up to half the sampling rate."""

    base: float = quantity("accelerometer on the table", "m/s^2", 0.005)
    acceleration: float = quantity("accelerometer on the mass", "m/s^2", 0.1)
    displacement: float = quantity("probe between table and mass", "m", 1e-6)


@dataclass(frozen=True)
class BaseRig(OneMass):
    """m x'' = -k (x - b) - c (x' - b'), b the table's motion: white noise in two runs, a logarithmic sweep
    from rest in the third.
    """

    kind: str = choice("which virtual rig", ("virtual-base-rig",))
    mass: float = quantity("mass that moves", "kg")
    stiffness: float = quantity("stiffness between table and mass", "N/m")
    damping: float = quantity("damping between table and mass", "N.s/m")
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual mass on a shaking table")
    acceleration: float = quantity("rms acceleration of the table", "m/s^2", 5.0)
    band: tuple[float, float] = setting("band", "band in which the table shakes", "Hz", (10.0, 100.0))
    sample_rate: float = quantity("sampling rate", "Hz", 512.0)
    duration: float = quantity("length of a run", "s", 32.0)
    pause: float = quantity("pause after the sweep, part of its run", "s", 4.0)
    noise: BaseNoise = section("measuring noise", BaseNoise, BaseNoise())

    def __post_init__(self) -> None:
        self.check("acceleration")
        if not 0 <= self.pause < self.duration:
            raise SettingError("pause", "pause must lie between 0 and the length of a run")


@dataclass(frozen=True)
class SweepRig(OneMass):
    """m y'' + c y' + k y = f from rest; f a sweep with constant amplitude, then a pause."""

    kind: str = choice("which virtual rig", ("virtual-sweep-rig",))
    mass: float = quantity("mass that moves", "kg")
    stiffness: float = quantity("stiffness of its support", "N/m")
    damping: float = quantity("damping of its support", "N.s/m")
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual mass under swept sines")
    band: tuple[float, float] = setting("band", "band that is swept", "Hz", (20.0, 80.0))
    force: float = quantity("rms force while a sweep runs", "N", 5.0)
    duration: float = quantity("length of the linear sweep; the others take half as long", "s", 24.0)
    pause: float = quantity("pause after every sweep", "s", 3.0)
    noise: float = quantity("standard deviation of the probe's noise", "m", 1e-6)
    force_noise: float = quantity("standard deviation of the force transducer's noise", "N", 0.02)
    sample_rate: float = quantity("sampling rate", "Hz", 512.0)

    def __post_init__(self) -> None:
        self.check("force")
        self.require_not_negative("pause", "noise", "force_noise")


# Measured is the acceleration of the mass, or its displacement relative to the table.
BASE_RUNS = ("absolute", "relative", "sweep")


def relative_transmissibility(rig: BaseRig, frequency: FloatArray) -> ComplexArray:
    """w^2 m / Z [1] at *frequency* (n,) [Hz], (n,): motion relative to the table over the table's; the
    absolute one is 1 more. Equation (sim-base).
    """
    w = 2 * np.pi * frequency
    return w**2 * rig.mass / dynamic_stiffness(rig.mass, rig.stiffness, rig.damping, w)


def _base_run(rig: BaseRig, name: str, rng: np.random.Generator) -> Recording:
    """Acceleration *base* of the table and *mass* [m/s^2], or *gap* between them [m]: -m H of the
    acceleration, at 0 Hz too.
    """
    n_sample, level = round(rig.duration * rig.sample_rate), rig.noise
    if name == "sweep":
        sweep = Sweep(rig.band, rig.duration - rig.pause, rig.acceleration, "logarithmic", "up", rig.pause)
        base = sweep.samples(rig.sample_rate, 1)
        length, lines = rig.from_rest(base.size)
    else:
        base = white_noise(rig.band, rig.acceleration, n_sample, rig.sample_rate, rng)
        length, lines = lines_of(base.size, rig.sample_rate)
    table = Channel("base", "acceleration", "input", "z")
    if name == "relative":
        moved = response(-rig.mass * rig.receptance(lines), base, length)
        measured, noise = Channel("gap", "displacement", "output", "z"), level.displacement
    else:
        moved = response(1 + relative_transmissibility(rig, lines), base, length)
        measured, noise = Channel("mass", "acceleration", "output", "z"), level.acceleration
    return sense(name, [table, measured], [base, moved], [level.base, noise], rig.sample_rate, rng)


# Law, direction and number of the sweeps of a run.
SWEEP_RUNS = {"linear": ("linear", "up", 1), "logarithmic": ("logarithmic", "up-down", 4)}
# The logger begins this long before the first sweep [s].
PRETRIGGER = 0.5


def _sweep_run(rig: SweepRig, name: str, rng: np.random.Generator) -> Recording:
    law, direction, count = SWEEP_RUNS[name]
    sweep = Sweep(rig.band, rig.duration / (1 if count == 1 else 2), rig.force, law, direction, rig.pause)
    before = np.zeros(round(PRETRIGGER * rig.sample_rate))
    force = np.concatenate([before, sweep.samples(rig.sample_rate, count)])
    length, lines = rig.from_rest(force.size)
    moved = response(rig.receptance(lines), force, length)
    channels = [Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y")]
    return sense(name, channels, [force, moved], [rig.force_noise, rig.noise], rig.sample_rate, rng)


def check_matrices(rig: Any, n: int, *names: str) -> None:
    """ConfigError for the first of the entries that is not a matrix (n, n)."""
    for name in names:
        if np.shape(getattr(rig, name)) != (n, n):
            raise SettingError(name, f"{name} is not a {n} x {n} matrix")


SHAKEN_RUNS = {"along-x": "x", "along-y": "y"}


@dataclass(frozen=True)
class SensorNoise(StandardDeviations):
    """Measuring noise, white up to half the sampling rate."""

    displacement: float = quantity("displacement sensors", "m", 5e-6)
    force: float = quantity("force transducer", "N", 0.05)


@dataclass(frozen=True)
class WhiteNoiseRig(Settings):
    """m q'' + C q' + K q = f of the rotor's centre (x, y), with an unbalance that turns from x to y. Force,
    sampling and blocks are those of Mendes et al.; bending near 82 Hz as on their rig, unbalance as on
    Machado's.
    """

    kind: str = choice("which virtual rig", ("virtual-white-noise-rig",))
    stiffness: tuple[tuple[float, ...], ...] = setting("matrix", "stiffness matrix K (x, y)", "N/m")
    damping: tuple[tuple[float, ...], ...] = setting("matrix", "damping matrix C (x, y)", "N.s/m")
    mass: float = quantity("mass that moves with the rotor", "kg")
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual rotor under white noise")
    force: float = quantity("rms force of the shaker", "N", 30.0)
    bandwidth: float = quantity("the force is white up to here", "Hz", 400.0)
    sample_rate: float = quantity("sampling rate", "Hz", 1024.0)
    blocks: int = setting("integer", "blocks recorded one after the other", default=100)
    block: float = quantity("length of one block", "s", 5.0)
    speed: float = quantity("shaft speed", "Hz", 50.0)
    unbalance: float = quantity("mass times eccentricity", "kg.m", 5.5e-5)
    noise: SensorNoise = section("measuring noise", SensorNoise, SensorNoise())

    def __post_init__(self) -> None:
        check_matrices(self, 2, "stiffness", "damping")
        self.require_positive("mass", "force", "bandwidth", "sample_rate", "blocks", "block")
        self.require_not_negative("unbalance")
        if self.n_sample < 2:
            raise SettingError("block", f"a block holds less than a sample at {self.sample_rate:g} Hz")
        system = np.block(
            [[np.zeros((2, 2)), self.mass * np.eye(2)], [-np.array(self.stiffness), -np.array(self.damping)]]
        )
        if np.max(np.linalg.eigvals(system / self.mass).real) > 0:
            raise SettingError("stiffness", "the rotor is unstable with this stiffness and damping")
        for name in ("speed", "bandwidth"):
            if not 0 <= getattr(self, name) < self.sample_rate / 2:
                what = f"{name} must lie below half the sampling rate, {self.sample_rate / 2:g} Hz"
                raise SettingError(name, what)

    @property
    def n_sample(self) -> int:
        return self.blocks * round(self.block * self.sample_rate)

    def receptance(self, frequency: FloatArray) -> ComplexArray:
        """H at *frequency* (n,) [Hz], (n, 2, 2) [m/N]."""
        return receptance(self.mass * np.eye(2), self.stiffness, self.damping, frequency)

    @property
    def truth(self) -> dict[str, float]:
        """k_xx ... c_yy, mass, speed and unbalance [SI, Hz], by name."""
        coefficients = virtual_rigs.coefficients_by_name("xy", k=self.stiffness, c=self.damping)
        return {"mass": self.mass, **coefficients, "speed_hz": self.speed, "unbalance": self.unbalance}


def _shaken_run(rig: WhiteNoiseRig, name: str, rng: np.random.Generator) -> Recording:
    axis = SHAKEN_RUNS[name]
    force = white_noise((0.0, rig.bandwidth), rig.force, rig.n_sample, rig.sample_rate, rng)
    at_lines = rig.receptance(fft.rfftfreq(rig.n_sample, 1 / rig.sample_rate))[:, :, "xy".index(axis)]
    turning = rig.receptance(np.array([rig.speed]))[0], rig.unbalance, 2 * np.pi * rig.speed
    outputs = [Channel(dof, "displacement", "output", dof, AXIS_ANGLES[dof]) for dof in "xy"]
    channels = [Channel("f", "force", "input", axis, AXIS_ANGLES[axis]), *outputs]
    return shaken_rotor(rig, name, channels, fft.rfft(force), at_lines, turning, rng)


def shaken_rotor(
    rig: Any,
    name: str,
    channels: Sequence[Channel],
    spectrum: ComplexArray,
    at_lines: ComplexArray,
    turning: tuple[ComplexArray, float, float],
    rng: np.random.Generator,
) -> Recording:
    """A force and the displacements on two axes, with unbalance and noise; of *rig* its n_sample, sample_rate
    and noise.

    The force, *spectrum* (n_line,) [N], is periodic in the whole run and band-limited, so x = H f line by
    line is the exact steady state, without aliasing; *at_lines* (n_line, 2) [m/N]. *turning*: H (2, 2) at the
    shaft speed, unbalance u [kg m] and speed W [rad/s], from the first axis to the second: u W^2 (cos, sin)(W
    t + phase).
    """
    h, unbalance, omega = turning
    angle = omega * np.arange(rig.n_sample) / rig.sample_rate + rng.uniform(0, 2 * np.pi)
    synchronous = (np.exp(1j * angle)[:, None] * (h @ (unbalance * omega**2 * np.array([1, -1j])))).real
    motion = fft.irfft(spectrum[:, None] * at_lines, rig.n_sample, axis=0) + synchronous
    noise = [rig.noise.force, *[rig.noise.displacement] * 2]
    return sense(name, channels, [fft.irfft(spectrum, rig.n_sample), *motion.T], noise, rig.sample_rate, rng)


@dataclass(frozen=True)
class Lines(Settings):
    """Equally spaced frequency lines."""

    first: float = quantity("lowest frequency", "Hz")
    last: float = quantity("highest frequency", "Hz")
    count: int = setting("integer", "number of lines")


@dataclass(frozen=True)
class VirtualMdofRig(Settings):
    """M q'' + C q' + K q = f on dofs 1, 2, ..., a force and a response on each."""

    kind: str = choice("which virtual rig", ("virtual-mdof-rig",))
    stiffness: tuple[tuple[float, ...], ...] = setting("matrix", "stiffness matrix K", "N/m")
    damping: tuple[tuple[float, ...], ...] = setting("matrix", "damping matrix C", "N.s/m")
    mass: tuple[float, ...] | tuple[tuple[float, ...], ...] = setting(
        "mass", "masses, or the mass matrix M", "kg"
    )
    lines: Lines = section("frequency lines of the FRF", Lines)
    noise: float = quantity(
        "standard deviation on the real and on the imaginary part, as a share of the largest |H|", "1"
    )
    name: str = text("name of the rig", "Virtual rig of masses, springs and dampers")

    def __post_init__(self) -> None:
        n = len(self.stiffness)
        check_matrices(self, n, "stiffness", "damping")
        # A list of masses, or of rows; both, or rows of other lengths, have no shape.
        shapes = {np.shape(row) for row in self.mass} if isinstance(self.mass, tuple) else set()
        if shapes not in ({()}, {(n,)}) or len(self.mass) != n:
            raise ConfigError(f"mass does not fit {n} dofs", hint="a list of masses, or a matrix")
        self.require_not_negative("noise")
        if self.lines.count < 2 or not 0 <= self.lines.first < self.lines.last:
            raise ConfigError("lines: two or more from `first` up to `last` are needed")

    @property
    def frequency(self) -> FloatArray:
        """(n_line,) [Hz]."""
        return np.linspace(self.lines.first, self.lines.last, self.lines.count)

    @property
    def mass_matrix(self) -> FloatArray:
        """M (n_dof, n_dof) [kg]."""
        mass = np.array(self.mass, float)
        return np.diag(mass) if mass.ndim == 1 else mass

    @property
    def receptance(self) -> ComplexArray:
        """H on the rig's lines, (n_line, n_dof, n_dof) [m/N]."""
        return receptance(self.mass_matrix, self.stiffness, self.damping, self.frequency)

    @property
    def truth(self) -> dict[str, float]:
        """k_i_j [N/m], c_i_j [N.s/m] and m_i_j [kg] by name."""
        labels = [str(number + 1) for number in range(len(self.stiffness))]
        return virtual_rigs.coefficients_by_name(
            labels, "_", k=self.stiffness, c=self.damping, m=self.mass_matrix
        )


def noisy_response(rig: VirtualMdofRig, rng: np.random.Generator | None) -> FrequencyResponse:
    """The FRF with circular white noise of known variance; without noise for no *rng*, its variance stated
    all the same. Equation (sim-mdof-noise).
    """
    matrix = rig.receptance
    std = rig.noise * float(np.max(np.abs(matrix)))
    ports = tuple(Port(dof, dof, dof) for dof in map(str, range(1, matrix.shape[1] + 1)))
    covariance = diagonal_covariance(np.full(matrix.shape, 2 * std**2)) if std > 0 else None
    if rng is not None:
        matrix = matrix + std * (rng.standard_normal(matrix.shape) + 1j * rng.standard_normal(matrix.shape))
    return FrequencyResponse(rig.frequency, matrix, ports, ports, covariance=covariance, name=rig.name)


BASE_RIG = virtual_rigs.kind_of_recordings(
    BaseRig,
    runs=lambda _rig: BASE_RUNS,
    record=_base_run,
    logged=lambda run: virtual_rigs.whole_numbers(run, steps={"base": 1, "mass": 10, "gap": 100}),
)
SWEEP_RIG = virtual_rigs.kind_of_recordings(
    SweepRig,
    runs=lambda _rig: tuple(SWEEP_RUNS),
    record=_sweep_run,
    logged=lambda run: virtual_rigs.whole_numbers(run, steps={"f": 10, "y": 100}),
    noisy=lambda rig, level: replace(rig, noise=level * rig.noise, force_noise=level * rig.force_noise),
)
WHITE_NOISE_RIG = virtual_rigs.kind_of_recordings(
    WhiteNoiseRig,
    runs=lambda _rig: tuple(SHAKEN_RUNS),
    record=_shaken_run,
    logged=virtual_rigs.force_and_displacements,
)
MDOF_RIG = virtual_rigs.VirtualRigKind(
    settings=VirtualMdofRig,
    runs=lambda _rig: (),
    simulate=lambda rig, seed, _runs: virtual_rigs.Simulation(
        {"frf": noisy_response(rig, np.random.default_rng(seed))}, {"truth": rig.truth}
    ),
    parameters=lambda rig, _runs: rig.truth,
    noisy=lambda rig, level: replace(rig, noise=level),
    response=lambda rig, seeds: noisy_response(
        rig, None if seeds is None else np.random.default_rng(tuple(seeds))
    ),
    with_lines=lambda rig, count: replace(rig, lines=replace(rig.lines, count=count)),
)
