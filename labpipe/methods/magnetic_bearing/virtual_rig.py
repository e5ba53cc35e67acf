"""Runs on the virtual magnetic-bearing rig: recordings and tables with their truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing import virtual_mechanics as mechanics
from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.methods.magnetic_bearing.sampled_loop import (
    CONTROL_RATE,
    OUTPUTS,
    Suspended,
    sampled_loop,
    straight,
)
from labpipe.methods.magnetic_bearing.virtual_mechanics import (
    PERIODS,
    Timing,
    VirtualMagneticRig,
    negative_stiffness,
)
from labpipe.raw_files.excitation import Multisine, design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.registry import nearest
from labpipe.simulate import linear, virtual_rigs
from labpipe.simulate.linear import TACHO, line_frequencies, pulses

READING, BEFORE, AFTER, OUTPUT, CURRENT = range(len(OUTPUTS))
HOVER_CORNER = 5.0
# Direction of the force on the levitated rotor.
DIAGONAL = "45 deg"
# Half length of the logger's filter [s].
MARGIN = 0.05
SETTLING = 3.0
GAINS = {"gain-1.0": 1.0, "gain-1.1": 1.1, "gain-1.2": 1.2}
INJECTION = 0.05  # rms [V]
# Run-up: speeds [Hz], time [s]; eccentricity [m] and angle [rad] at both ends; axial force per radial one.
RUN_UP = (20.0, 8000 / 60, 10.0)
UNBALANCE = {"front": (15e-6, 0.0), "rear": (9e-6, 1.2)}
AXIAL_SHARE = 0.15


def rotor_alone(rig: VirtualMagneticRig) -> Suspended:
    """The share of the levitated rotor that one bearing carries."""
    levitation = rig.levitation
    mass = (rig.rotor_mass - rig.pedestal_mass) / levitation.bearings
    return Suspended(levitation.loop, negative_stiffness(levitation), mass)


def radial_in_loop(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """The levitated rotor under one force at 45 deg, 1-250 Hz every 1 Hz, 1 + 5 periods."""
    levitation, pedestal = rig.levitation, (rig.pedestal_stiffness, rig.pedestal_damping)
    loop = replace(levitation.loop, proportional=GAINS.get(name, levitation.loop.proportional))
    # The bias field is that of the rig's own loop, whatever the gain.
    pull = negative_stiffness(levitation)
    plant = Suspended(loop, pull, rig.rotor_mass, levitation.bearings, *pedestal)
    force = design_multisine((1.0, 250.0), 1.0, rig.radial_force)
    periods, rate = 1 + PERIODS, 2000.0
    closed = sampled_loop(plant)
    length = _length(periods / force.spacing)
    spectrum = np.fft.rfft(force.samples(CONTROL_RATE, 1))
    spectrum[force.lines] /= straight(line_frequencies(force), CONTROL_RATE)
    period = np.fft.irfft(spectrum, round(CONTROL_RATE / force.spacing))
    force_samples = np.resize(period, length + 1) * np.cos(np.pi / 4)
    noise = _probe_noise(rig, rate, (length, 2), rng)
    loop_force = force_samples[:, None] + _hover_force(rig, plant, (length + 1, 2), rng)
    signals = _log(closed.run(_inputs(loop_force, noise)), rate, round(periods * rate))
    shaker = _noisy(force.samples(rate, periods), rig.noise.force, rng)
    channels = _channels(DIAGONAL, "xy")
    columns: list[FloatArray] = [shaker, *signals[:, :2, READING].T]
    # The gain study needs force and motion only.
    for number, dof in enumerate("xy" if name not in GAINS else ""):
        for name_of, quantity in ((f"i{dof}", "current"), (f"u{dof}", "voltage")):
            channels.append(Channel(name_of, quantity, "reference", name_of))
        columns += [signals[:, number, CURRENT], signals[:, number, OUTPUT]]
    omega = line_frequencies(force)
    bearing = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    truth = {
        "mass": rig.rotor_mass,
        "pedestal": {"k": rig.pedestal_stiffness, "c": rig.pedestal_damping},
        "proportional": plant.loop.proportional,
        "delay": plant.loop.delay,
        "negative_stiffness_per_bearing": plant.negative_stiffness,
        **_values_per_bearing(omega, bearing),
    }
    return _run(name, truth, channels, columns, rate)


def _values_per_bearing(omega: FloatArray, bearing: ComplexArray) -> dict[str, list[float]]:
    return {
        "frequency_hz": (omega / (2 * np.pi)).tolist(),
        "k_per_bearing": bearing.real.tolist(),
        "c_per_bearing": (bearing.imag / omega).tolist(),
    }


def injection(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """The rotor alone; a multisine, 4-1000 Hz every 2 Hz, between probe and controller, both recorded."""
    plant = rotor_alone(rig)
    added = design_multisine((4.0, 1000.0), 2.0, INJECTION)
    periods, rate = 1 + PERIODS, 5000.0
    n_sample = round(periods / added.spacing * rate)
    settling = round(SETTLING * added.spacing) / added.spacing
    length = _length(settling + periods / added.spacing)
    hover = _hover_force(rig, plant, (length + 1, 1), rng)
    inputs = _inputs(hover, _probe_noise(rig, rate, (length, 1), rng))
    inputs[:, 0, 3] = np.resize(added.samples(CONTROL_RATE, 1), length)
    signals = _log(sampled_loop(plant).run(inputs)[round(settling * CONTROL_RATE) :], rate, n_sample)[:, 0]
    reference = _noisy(added.samples(rate, periods), 1e-4, rng)
    channels = [Channel("e", "voltage", "input", "e")]
    channels += [Channel(label, "voltage", "output", label) for label in ("before", "after")]
    samples = [reference, signals[:, BEFORE], signals[:, AFTER]]
    return _run(name, {"mass": plant.mass, "injection_rms": INJECTION}, channels, samples, rate)


def run_up(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """The rotor alone from 1200 to 8000 rpm, passive in the axial direction: x, y at both ends, z, tacho."""
    low, high, duration = RUN_UP
    rate, length = 2000.0, _length(duration)
    t = np.arange(length + 1) / CONTROL_RATE
    speed = low + (high - low) * t / duration
    angle = 2 * np.pi * (low * t + (high - low) * t**2 / (2 * duration))
    plant, quarters = rotor_alone(rig), (0.0, np.pi / 2)
    radial_forces = [
        _unbalance_force(plant.mass, speed, angle, *of_end, quarter)
        for of_end in UNBALANCE.values()
        for quarter in quarters
    ]
    force = np.column_stack(radial_forces) + _hover_force(rig, plant, (length + 1, 4), rng)
    radial_motion = sampled_loop(plant).run(_inputs(force, _probe_noise(rig, rate, (length, 4), rng)))
    axial = Suspended(plant.loop, 0.0, rig.axial_mass, 0, rig.axial_stiffness, rig.axial_damping)
    axial_force = AXIAL_SHARE * _unbalance_force(rig.axial_mass, speed, angle, *UNBALANCE["front"], 0.0)
    noise = _probe_noise(rig, rate, (length, 1), rng)
    axial_motion = sampled_loop(axial).run(_inputs(axial_force[:, None], noise))
    n_sample = round(duration * rate)
    displacements = _log(np.concatenate([radial_motion, axial_motion], axis=1), rate, n_sample)[:, :, READING]
    tacho = pulses(angle[: length : round(CONTROL_RATE / rate)][:n_sample])
    labels = [*(f"{end}.{dof}" for end in UNBALANCE for dof in "xy"), "z"]
    channels = [*(Channel(label, "displacement", "output", label) for label in labels), TACHO]
    truth = {
        "mass": plant.mass,
        "unbalance": {end: {"eccentricity": e, "angle": a} for end, (e, a) in UNBALANCE.items()},
    }
    return _run(name, truth, channels, [displacements, tacho], rate)


def _unbalance_force(
    mass: float, speed: FloatArray, angle: FloatArray, eccentricity: float, place: float, quarter: float
) -> FloatArray:
    """m e (2 pi n)^2 cos(theta + place - quarter) [N]."""
    return mass * eccentricity * (2 * np.pi * speed) ** 2 * np.cos(angle + place - quarter)


def _length(seconds: float) -> int:
    return round((seconds + MARGIN) * CONTROL_RATE)


def _inputs(force: FloatArray, noise: FloatArray) -> FloatArray:
    """(n_sample, n_direction, 4) of the force (n_sample + 1, n_direction) and the probe's noise."""
    return np.stack([force[:-1], force[1:], noise, np.zeros_like(noise)], axis=2)


def _probe_noise(
    rig: VirtualMagneticRig, rate: float, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    return rng.normal(0.0, rig.noise.displacement * np.sqrt(CONTROL_RATE / rate), shape)


def _hover_force(
    rig: VirtualMagneticRig, plant: Suspended, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """A slow force that makes the rotor wander by the stated rms."""
    wander = slow_noise(shape, CONTROL_RATE, rng)
    bearing = dynamic_stiffness(plant.loop, plant.negative_stiffness, np.zeros(1))[0].real
    static = plant.stiffness + plant.bearings * bearing
    return static * rig.noise.hover * wander / np.sqrt(np.mean(wander**2))


def slow_noise(shape: tuple[int, ...], rate: float, rng: np.random.Generator) -> FloatArray:
    """White noise at *rate* [Hz] through a first-order low pass, (n_sample, ...): how the rotor wanders."""
    b, a = scipy.signal.butter(1, HOVER_CORNER, fs=rate)
    return scipy.signal.lfilter(b, a, rng.normal(0.0, 1.0, shape), axis=0)


def _log(outputs: FloatArray, rate: float, n_sample: int) -> FloatArray:
    return scipy.signal.resample_poly(outputs, 1, round(CONTROL_RATE / rate), axis=0)[:n_sample]


# A run of a rig by its name.
MakeRun = Callable[[VirtualMagneticRig, str, np.random.Generator], virtual_rigs.SimulatedRun]
LOOP_RUNS: dict[str, MakeRun] = {
    "loop-0rpm": radial_in_loop,
    **dict.fromkeys(GAINS, radial_in_loop),
    "loop-injection": injection,
    "run-up": run_up,
}


# Forces [N rms] by which pedestal and rotor stay within 40 um.
PEDESTAL_FORCE, AXIAL_FORCE = 0.3, 0.3


@dataclass(frozen=True)
class OneDofRun:
    """Mass [kg] on spring [N/m] and damper [N.s/m] along *dof*, under a multisine."""

    force: Multisine
    timing: Timing
    dof: str
    mass: float
    stiffness: float
    damping: float

    @property
    def truth(self) -> dict[str, float]:
        return virtual_rigs.one_mass_truth(self.mass, self.stiffness, self.damping)


def pedestal(rig: VirtualMagneticRig) -> OneDofRun:
    """The pedestal alone: 1-100 Hz every 0.5 Hz."""
    force, timing = design_multisine((1.0, 100.0), 0.5, PEDESTAL_FORCE), Timing(1000.0, 0.5, 3)
    support = rig.pedestal_stiffness, rig.pedestal_damping
    return OneDofRun(force, timing, "y", rig.pedestal_mass, *support)


def axial(rig: VirtualMagneticRig) -> OneDofRun:
    """The axial direction: 1-50 Hz every 0.5 Hz."""
    force, timing = design_multisine((1.0, 50.0), 0.5, AXIAL_FORCE), Timing(500.0, 0.5, 1)
    return OneDofRun(force, timing, "z", rig.axial_mass, rig.axial_stiffness, rig.axial_damping)


ONE_DOF: dict[str, Callable[[VirtualMagneticRig], OneDofRun]] = {"pedestal": pedestal, "axial": axial}


def expected_std_error(rig: VirtualMagneticRig, name: str, band: tuple[float, float]) -> dict[str, float]:
    """Cramer-Rao standard errors of k [N/m] and c [N.s/m] from the lines of run *name* within *band* [Hz],
    mass known. With both channels noisy, the residual Y - H F of a line has the variance s_y^2 + |H|^2 s_f^2,
    where s^2 = 4 sigma^2 / n over n averaged samples is the variance of a complex amplitude. Information: 2
    sum Re(dH^* dH^T) |F|^2 / variance, with dH/dk = -H^2, dH/dc = -j w H^2. Holds while the noise of a line's
    force is small beside the force. ConfigError for a run that is not of one degree of freedom, a band
    without lines, or a rig without noise. Equation (sim-bound).
    """
    if name not in ONE_DOF:
        raise ConfigError(f"run '{name}' has no single k and c", hint=nearest(name, ONE_DOF))
    run = ONE_DOF[name](rig)
    frequency = run.force.spacing * run.force.lines
    omega = 2 * np.pi * frequency[(frequency >= band[0] - 1e-9) & (frequency <= band[1] + 1e-9)]
    if not omega.size:
        raise ConfigError(f"no line of run '{name}' lies in {band[0]:g}-{band[1]:g} Hz")
    if rig.noise.displacement == 0 and rig.noise.force == 0:
        raise ConfigError("a rig without noise has no standard errors")
    receptance = 1 / linear.dynamic_stiffness(run.mass, run.stiffness, run.damping, omega)
    line_variance = 4 / (PERIODS * run.timing.n_sample)
    variance = line_variance * (rig.noise.displacement**2 + np.abs(receptance) ** 2 * rig.noise.force**2)
    amplitude = linear.line_amplitude(run.force)
    slopes = np.array([-(receptance**2), -1j * omega * receptance**2]) * amplitude / np.sqrt(variance)
    std_error = np.sqrt(np.diag(np.linalg.inv(2 * (slopes.conj() @ slopes.T).real)))
    return {"k": float(std_error[0]), "c": float(std_error[1])}


# What the logger writes of a channel: (unit, recorded value per SI value). y is the probe's voltage.
RECORDED = {"f": ("N", 1.0), "x": ("um", 1e6), "y": ("V", 8e3), "z": ("um", 1e6)}
TEXT_RUNS = ("pedestal", "axial")
ECCENTRICITIES = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
GAIN_CORNER = 0.4
STATIC_BEND = 300e-6


def simulate(
    rig: VirtualMagneticRig, seed: int, runs: Sequence[str] | None = None
) -> tuple[virtual_rigs.SimulatedRun, ...]:
    """The named runs, by default all; the same rig and seed give the same samples of each."""
    by_name, names = {**RUNS, **_loop_runs(rig)}, virtual_rigs.chosen_runs(rig, runs)
    return tuple(by_name[name](rig, name, virtual_rigs.generator(seed, name)) for name in names)


def run_names(rig: VirtualMagneticRig) -> tuple[str, ...]:
    """All of RUNS, and of a rig under its control loop LOOP_RUNS, which close it in the time domain."""
    return tuple({**RUNS, **_loop_runs(rig)})


def _loop_runs(rig: VirtualMagneticRig) -> dict[str, MakeRun]:
    """Blocks have no proportional gain to be varied."""
    if rig.levitation.law != "control-loop":
        return {}
    fixed = GAINS if rig.levitation.loop.controller else {}
    return {name: run for name, run in LOOP_RUNS.items() if name not in fixed}


def _noisy(clean: FloatArray, std: float, rng: np.random.Generator) -> FloatArray:
    return clean + rng.normal(0.0, std, clean.shape)


def _run(
    name: str, truth: dict[str, Any], channels: Sequence[Channel], samples: Sequence[FloatArray], rate: float
) -> virtual_rigs.SimulatedRun:
    recording = Recording(tuple(channels), np.column_stack(samples), rate, name)
    return virtual_rigs.SimulatedRun(name, truth, recording)


def _channels(force: str, moved: str) -> list[Channel]:
    """A force in a direction (dof) and the displacements of some axes."""
    angle = np.pi / 4 if force == DIAGONAL else AXIS_ANGLES.get(force)
    of_motion = [Channel(dof, "displacement", "output", dof, AXIS_ANGLES.get(dof)) for dof in moved]
    return [Channel("f", "force", "input", force, angle), *of_motion]


def single(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """One force and one displacement that starts at rest: the runs of ONE_DOF."""
    run = ONE_DOF[name](rig)
    timing = run.timing
    omega = line_frequencies(run.force)
    receptance = 1 / linear.dynamic_stiffness(run.mass, run.stiffness, run.damping, omega)
    steady = linear.steady_state(run.force, receptance, timing.n_sample, timing.periods)
    clean = steady + linear.free_decay(steady, timing.sample_rate, run.truth["f_n"], run.truth["zeta"])
    samples = [
        _noisy(run.force.samples(timing.sample_rate, timing.periods), rig.noise.force, rng),
        _noisy(clean, rig.noise.displacement, rng),
    ]
    return _run(name, run.truth, _channels(run.dof, run.dof), samples, timing.sample_rate)


def radial(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """The levitated rotor under one force at 45 deg: x and y move alike, since the rig is symmetric."""
    rotating = name.endswith("rpm") and not name.endswith("-0rpm")
    force = design_multisine((1.0, 250.0), 1.0, rig.radial_force)
    omega = line_frequencies(force)
    receptance = np.cos(np.pi / 4) / mechanics.levitated_stiffness(rig, omega)
    timing = Timing(2000.0, 1.0, 1)
    clean = linear.steady_state(force, receptance, timing.n_sample, timing.periods)
    clean = clean + linear.free_decay(clean, timing.sample_rate, 70.0, 0.2)
    samples = [_noisy(force.samples(timing.sample_rate, timing.periods), rig.noise.force, rng)]
    for quarter in (0.0, np.pi / 2):
        wander = slow_noise((timing.n_sample * (timing.periods + 1),), timing.sample_rate, rng)
        wander = wander[timing.n_sample :]
        displacement = clean + rig.noise.hover * wander / np.sqrt(np.mean(wander**2))
        if rotating:
            t = np.arange(timing.n_sample * timing.periods) / timing.sample_rate
            angle = 2 * np.pi * rig.speed * t - quarter
            orders = ((1, 1.0), (2, 0.25), (4, 0.12))
            displacement += rig.unbalance * sum(share * np.cos(order * angle) for order, share in orders)
        samples.append(_noisy(displacement, rig.noise.displacement, rng))
    bearing = mechanics.levitation_stiffness(rig.levitation, omega) / rig.levitation.bearings
    truth: dict[str, Any] = {
        "mass": rig.rotor_mass,
        "speed_hz": rig.speed if rotating else 0.0,
        "forcing_angle": np.pi / 4,
        "pedestal": {"k": rig.pedestal_stiffness, "c": rig.pedestal_damping},
        **_values_per_bearing(omega, bearing),
    }
    if rig.levitation.law == "control-loop":
        truth["negative_stiffness_per_bearing"] = mechanics.negative_stiffness(rig.levitation)
    return _run(name, truth, _channels(DIAGONAL, "xy"), samples, timing.sample_rate)


def two_directions(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """A cross-coupled support under a force along x (or y): both runs show all eight coefficients."""
    dof = name[-1]
    column = "xy".index(dof)
    force = design_multisine((1.0, 250.0), 1.0, rig.radial_force)
    omega = line_frequencies(force)
    stiffness, damping = mechanics.COUPLED_STIFFNESS, mechanics.COUPLED_DAMPING
    dynamic = linear.dynamic_stiffness(rig.rotor_mass * np.eye(2), stiffness, damping, omega)
    receptance = np.linalg.inv(dynamic)[:, :, column]
    timing = Timing(2000.0, 1.0, 1)
    samples = [_noisy(force.samples(timing.sample_rate, timing.periods), rig.noise.force, rng)]
    for row in range(2):
        clean = linear.steady_state(force, receptance[:, row], timing.n_sample, timing.periods)
        samples.append(_noisy(clean, rig.noise.displacement, rng))
    support = virtual_rigs.coefficients_by_name("xy", k=stiffness, c=damping)
    truth = {"mass": rig.rotor_mass, **support}
    return _run(name, truth, _channels(dof, "xy"), samples, timing.sample_rate)


def actuator_gain(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """Force over voltage at seven levels and eccentricities. The gain falls as 1 / (1 + (e / 0.4)^4)."""
    levels = np.linspace(0.08, 0.56, 7)
    gains = [rig.actuator_gain / (1 + (e / GAIN_CORNER) ** 4) for e in ECCENTRICITIES]
    eccentricity = np.repeat(ECCENTRICITIES, levels.size)
    voltage = np.tile(levels, len(ECCENTRICITIES))
    force = _noisy(np.repeat(gains, levels.size) * voltage, rig.noise.force, rng)
    table = {"eccentricity [%]": 100 * eccentricity, "voltage [V]": voltage, "force [N]": force}
    within = [e for e, gain in zip(ECCENTRICITIES, gains, strict=True) if abs(gain / gains[0] - 1) <= 0.2]
    truth = {"eccentricity": list(ECCENTRICITIES), "gain": gains, "linear_range_20_percent": max(within)}
    return virtual_rigs.SimulatedRun(name, truth, table=table)


def static(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> virtual_rigs.SimulatedRun:
    """Static magnet force over displacement, k_0 x (1 - (x / 300 um)^2): straight within 2.3 % to 45 um."""
    displacement = np.arange(0, 91, 3) * 1e-6
    k_0 = rig.levitation.static
    force = _noisy(k_0 * displacement * (1 - (displacement / STATIC_BEND) ** 2), 2e-4, rng)
    table = {"displacement [um]": displacement * 1e6, "force [N]": force}
    return virtual_rigs.SimulatedRun(name, {"k_0": k_0}, table=table)


RUNS: dict[str, MakeRun] = {
    "pedestal": single,
    "radial-0rpm": radial,
    "radial-8000rpm": radial,
    "two-directions-x": two_directions,
    "two-directions-y": two_directions,
    "axial": single,
    "actuator-gain": actuator_gain,
    "static": static,
}


def log_table(recording: Recording) -> virtual_rigs.LoggedTable:
    """A run as the logger stores it: short runs as text, runs under the control loop as whole numbers."""
    if recording.name in LOOP_RUNS:
        return virtual_rigs.whole_numbers(recording)
    columns = {}
    for number, channel in enumerate(recording.channels):
        unit, per_si = RECORDED[channel.name]
        title = "force" if channel.name == "f" else channel.name
        columns[f"{title} [{unit}]"] = recording.samples[:, number] * per_si
    if recording.name in TEXT_RUNS:
        time = np.arange(recording.n_sample) / recording.sample_rate
        return virtual_rigs.LoggedTable({"t [s]": time, **columns}, text=True)
    return virtual_rigs.LoggedTable({title: column.astype(np.float32) for title, column in columns.items()})


def _parameters(rig: VirtualMagneticRig, runs: Sequence[str]) -> virtual_rigs.Truth:
    (first,) = simulate(rig, 0, runs[:1])
    return {name: float(number) for name, number in first.truth.items() if isinstance(number, (int, float))}


MAGNETIC_RIG = virtual_rigs.kind_of_tests(
    VirtualMagneticRig,
    runs=run_names,
    usual=lambda rig: tuple(_loop_runs(rig) or RUNS),
    tests=simulate,
    logged=log_table,
    parameters=_parameters,
    std_errors=lambda rig, runs, band: expected_std_error(rig, runs[0], band) if runs[0] in ONE_DOF else {},
)
