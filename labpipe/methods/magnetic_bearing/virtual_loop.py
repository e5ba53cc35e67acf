"""Runs on the virtual magnetic-bearing rig closed by its loop in the time domain: recordings that hold the
loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness
from labpipe.methods.magnetic_bearing.sampled_loop import (
    CONTROL_RATE,
    OUTPUTS,
    Suspended,
    sampled_loop,
    straight,
)
from labpipe.methods.magnetic_bearing.virtual_mechanics import PERIODS, VirtualMagneticRig, negative_stiffness
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.simulate.linear import TACHO, line_frequencies, pulses
from labpipe.simulate.virtual_rigs import SimulatedRun

READING, BEFORE, AFTER, OUTPUT, CURRENT = range(len(OUTPUTS))
HOVER_CORNER = 5.0
# Half length of the logger's filter [s].
MARGIN = 0.05
SETTLING = 3.0
GAINS = {"gain-1.0": 1.0, "gain-1.1": 1.1, "gain-1.2": 1.2}
INJECTION = 0.05  # rms [V]
# Run-up: speeds [Hz], time [s]; mass eccentricity [m] and its angle [rad] at both ends; axial force per
# radial one.
RUN_UP = (20.0, 8000 / 60, 10.0)
UNBALANCE = {"front": (15e-6, 0.0), "rear": (9e-6, 1.2)}
AXIAL_SHARE = 0.15


def suspended(rig: VirtualMagneticRig, loop: ControlLoop | None = None) -> Suspended:
    """Pedestal and rotor on all bearings in one direction.

    The bias field is that of the rig's own loop, whatever gains *loop* has.
    """
    levitation = rig.levitation
    return Suspended(
        loop or levitation.loop,
        negative_stiffness(levitation),
        rig.rotor_mass,
        levitation.bearings,
        rig.pedestal_stiffness,
        rig.pedestal_damping,
    )


def rotor_alone(rig: VirtualMagneticRig) -> Suspended:
    """The share of the levitated rotor that one bearing carries."""
    levitation = rig.levitation
    return Suspended(
        levitation.loop,
        negative_stiffness(levitation),
        (rig.rotor_mass - rig.pedestal_mass) / levitation.bearings,
    )


def radial(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> SimulatedRun:
    """The levitated rotor under one force at 45 deg, 1-250 Hz every 1 Hz, 1 + 5 periods."""
    loop = replace(rig.levitation.loop, proportional=GAINS.get(name, rig.levitation.loop.proportional))
    plant = suspended(rig, loop)
    force = design_multisine((1.0, 250.0), 1.0, rig.radial_force)
    periods, rate = 1 + PERIODS, 2000.0
    closed = sampled_loop(plant)
    length = _length(periods / force.spacing)
    spectrum = np.fft.rfft(force.samples(CONTROL_RATE, 1))
    spectrum[force.lines] /= straight(line_frequencies(force), CONTROL_RATE)
    force_samples = np.resize(
        np.fft.irfft(spectrum, round(CONTROL_RATE / force.spacing)), length + 1
    ) * np.cos(np.pi / 4)
    noise = _probe_noise(rig, rate, (length, 2), rng)
    loop_force = force_samples[:, None] + _hover_force(rig, plant, (length + 1, 2), rng)
    signals = _logged(closed.run(_inputs(loop_force, noise)), rate, round(periods * rate))
    shaker = force.samples(rate, periods) + rng.normal(0.0, rig.noise.force, round(periods * rate))
    channels = [Channel("f", "force", "input", "45 deg", np.pi / 4)]
    columns: list[FloatArray] = [shaker]
    for number, dof in enumerate("xy"):
        channels.append(Channel(dof, "displacement", "output", dof, AXIS_ANGLES[dof]))
        columns.append(signals[:, number, READING])
    # The gain study needs force and motion only.
    for number, dof in enumerate("xy" if name not in GAINS else ""):
        channels += [
            Channel(f"i{dof}", "current", "reference", f"i{dof}"),
            Channel(f"u{dof}", "voltage", "reference", f"u{dof}"),
        ]
        columns += [signals[:, number, CURRENT], signals[:, number, OUTPUT]]
    omega = line_frequencies(force)
    bearing = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    return SimulatedRun(
        name,
        {
            "mass": rig.rotor_mass,
            "pedestal": {"k": rig.pedestal_stiffness, "c": rig.pedestal_damping},
            "proportional": plant.loop.proportional,
            "delay": plant.loop.delay,
            "negative_stiffness_per_bearing": plant.negative_stiffness,
            "frequency_hz": (omega / (2 * np.pi)).tolist(),
            "k_per_bearing": bearing.real.tolist(),
            "c_per_bearing": (bearing.imag / omega).tolist(),
        },
        Recording(tuple(channels), np.column_stack(columns), rate, name),
    )


def injection(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> SimulatedRun:
    """The rotor alone.

    A multisine, 4-1000 Hz every 2 Hz, is added between probe and controller, both sides recorded.
    """
    plant = rotor_alone(rig)
    added = design_multisine((4.0, 1000.0), 2.0, INJECTION)
    periods, rate = 1 + PERIODS, 5000.0
    n_sample = round(periods / added.spacing * rate)
    settling = round(SETTLING * added.spacing) / added.spacing
    length = _length(settling + periods / added.spacing)
    inputs = _inputs(
        _hover_force(rig, plant, (length + 1, 1), rng), _probe_noise(rig, rate, (length, 1), rng)
    )
    inputs[:, 0, 3] = np.resize(added.samples(CONTROL_RATE, 1), length)
    signals = _logged(sampled_loop(plant).run(inputs)[round(settling * CONTROL_RATE) :], rate, n_sample)[:, 0]
    reference = added.samples(rate, periods) + rng.normal(0.0, 1e-4, n_sample)
    channels = [Channel("e", "voltage", "input", "e")]
    channels += [Channel(label, "voltage", "output", label) for label in ("before", "after")]
    samples = np.column_stack([reference, signals[:, BEFORE], signals[:, AFTER]])
    return SimulatedRun(
        name,
        {"mass": plant.mass, "injection_rms": INJECTION},
        Recording(tuple(channels), samples, rate, name),
    )


def run_up(rig: VirtualMagneticRig, name: str, rng: np.random.Generator) -> SimulatedRun:
    """The rotor alone from 1200 to 8000 rpm on both bearings and the passive axial one: x, y at both ends, z,
    tacho.
    """
    low, high, duration = RUN_UP
    rate, length = 2000.0, _length(duration)
    t = np.arange(length + 1) / CONTROL_RATE
    speed = low + (high - low) * t / duration
    angle = 2 * np.pi * (low * t + (high - low) * t**2 / (2 * duration))
    plant = rotor_alone(rig)
    radial_forces = [
        _unbalance_force(plant.mass, speed, angle, *UNBALANCE[end], quarter)
        for end in UNBALANCE
        for quarter in (0.0, np.pi / 2)
    ]
    force = np.column_stack(radial_forces) + _hover_force(rig, plant, (length + 1, 4), rng)
    radial_motion = sampled_loop(plant).run(_inputs(force, _probe_noise(rig, rate, (length, 4), rng)))
    axial = Suspended(plant.loop, 0.0, rig.axial_mass, 0, rig.axial_stiffness, rig.axial_damping)
    axial_force = AXIAL_SHARE * _unbalance_force(rig.axial_mass, speed, angle, *UNBALANCE["front"], 0.0)
    axial_motion = sampled_loop(axial).run(
        _inputs(axial_force[:, None], _probe_noise(rig, rate, (length, 1), rng))
    )
    n_sample = round(duration * rate)
    displacements = _logged(np.concatenate([radial_motion, axial_motion], axis=1), rate, n_sample)[
        :, :, READING
    ]
    tacho = pulses(angle[: length : round(CONTROL_RATE / rate)][:n_sample])
    labels = [*(f"{end}.{dof}" for end in UNBALANCE for dof in "xy"), "z"]
    channels = [Channel(label, "displacement", "output", label) for label in labels]
    channels.append(TACHO)
    truth = {
        "mass": plant.mass,
        "unbalance": {end: {"eccentricity": e, "angle": a} for end, (e, a) in UNBALANCE.items()},
    }
    return SimulatedRun(
        name, truth, Recording(tuple(channels), np.column_stack([displacements, tacho]), rate, name)
    )


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
    """White noise in the loop that has the rig's standard deviation in a recording at *rate* [Hz]."""
    return rng.normal(0.0, rig.noise.displacement * np.sqrt(CONTROL_RATE / rate), shape)


def _hover_force(
    rig: VirtualMagneticRig, plant: Suspended, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """A slow force that makes the rotor wander by the stated rms: white noise through a first-order low
    pass.
    """
    wander = slow_noise(shape, CONTROL_RATE, rng)
    static = (
        plant.stiffness
        + plant.bearings * dynamic_stiffness(plant.loop, plant.negative_stiffness, np.zeros(1))[0].real
    )
    return static * rig.noise.hover * wander / np.sqrt(np.mean(wander**2))


def slow_noise(shape: tuple[int, ...], rate: float, rng: np.random.Generator) -> FloatArray:
    """White noise at *rate* [Hz] through a first-order low pass, (n_sample, ...): how a levitated rotor
    wanders.
    """
    # Loading scipy.signal takes longer than most runs.
    from scipy import signal

    b, a = signal.butter(1, HOVER_CORNER, fs=rate)
    return np.asarray(signal.lfilter(b, a, rng.normal(0.0, 1.0, shape), axis=0))


def _logged(outputs: FloatArray, rate: float, n_sample: int) -> FloatArray:
    # Loading scipy.signal takes longer than most runs.
    from scipy import signal

    return signal.resample_poly(outputs, 1, round(CONTROL_RATE / rate), axis=0)[:n_sample]


LOOP_RUNS: dict[str, Callable[[VirtualMagneticRig, str, np.random.Generator], SimulatedRun]] = {
    "loop-0rpm": radial,
    **dict.fromkeys(GAINS, radial),
    "loop-injection": injection,
    "run-up": run_up,
}
