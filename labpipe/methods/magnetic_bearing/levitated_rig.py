"""A virtual levitated rotor in the time domain: an unstable plant held by a sampled controller."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import SettingError
from labpipe.methods.magnetic_bearing.levitated_loop import (
    AXES,
    BETWEEN,
    MULTISINE,
    RANDOM,
    REST,
    SHAKER,
    LevitatedRig,
    bearing_stiffness,
    levitated_loop,
    mechanics,
)
from labpipe.methods.magnetic_bearing.sampled_loop import straight
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.simulate.linear import TACHO, pulses
from labpipe.simulate.virtual_rigs import Truth, kind_of_recordings, whole_numbers

# Left out before a recording [s]; of it, and after the recording, so much for the logger's filter [s].
SETTLING, MARGIN = 2.0, 0.05
# Currents are small: stored in whole uA.
FINE_CURRENT = ("uA", 1e6)


def _run(rig: LevitatedRig, name: str, rng: np.random.Generator) -> Recording:
    injection, n_axis = rig.injection, len(rig.labels)
    if name.startswith(MULTISINE):
        n_sample = injection.periods * round(rig.sample_rate / injection.spacing)
    else:
        n_sample = round(injection.duration * rig.sample_rate)
    length = n_sample * rig.decimation + round((SETTLING + MARGIN) * rig.control.rate)
    angle = 2 * np.pi * rig.speed * np.arange(length + 1) / rig.control.rate
    added = _injection(rig, name, length, rng)
    push: FloatArray = np.zeros((length + 1, n_axis))
    if name == SHAKER:
        push = _random(rig, rig.shaker, (length + 1, n_axis), rng, straight_lines=True)
    sensor_noise = rng.normal(0.0, np.sqrt(rig.decimation) * rig.noise.displacement, added.shape)
    seen = sensor_noise + _runout(rig, angle[:-1])
    output, motion, current = levitated_loop(rig).signals(_inputs(rig, angle, push, seen, added, rng))
    fine = _log(rig, np.hstack([current, motion]), BETWEEN, n_sample)
    coarse: list[FloatArray] = [seen]
    if rig.output_recorded:
        coarse.append(output)
    if name != REST:
        coarse.append(push[:-1] if name == SHAKER else added)
    plain = _log(rig, np.hstack(coarse), 1, n_sample)
    samples = np.hstack([fine, plain[:, n_axis:]])
    samples[:, n_axis : 2 * n_axis] += plain[:, :n_axis]
    channels = _channels(rig, name)
    noise = np.array([_measuring_noise(rig, channel) for channel in channels])
    samples = samples + rng.standard_normal(samples.shape) * noise
    if rig.force_recorded:
        samples[:, :n_axis] *= rig.force_per_current
    if rig.speed > 0:
        channels.append(TACHO)
        steady = angle[round(SETTLING * rig.control.rate) :: rig.decimation]
        samples = np.column_stack([samples, pulses(steady[:n_sample])])
    return Recording(tuple(channels), samples, rig.sample_rate, name)


def _inputs(
    rig: LevitatedRig,
    angle: FloatArray,
    push: FloatArray,
    seen: FloatArray,
    added: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """What drives the loop (n_sample, n_input) [N, m, m, A]; noise at the density of the recording."""
    of, loudness = mechanics(rig), np.sqrt(rig.decimation)
    directions = np.column_stack([np.cos(angle), np.sin(angle)])[:, : len(AXES[rig.axes])]
    whirling = rig.unbalance * (2 * np.pi * rig.speed) ** 2 * directions
    disturbing = rng.normal(0.0, loudness * rig.noise.disturbance, push.shape)
    forces = (push + disturbing) @ of.at_bearings + whirling @ of.at_unbalance
    nothing = np.zeros_like(added)
    at_input, at_output = (added, nothing) if rig.injection.place == "input" else (nothing, added)
    return np.hstack([forces[:-1], forces[1:], seen, at_input, at_output])


def _injection(rig: LevitatedRig, name: str, length: int, rng: np.random.Generator) -> FloatArray:
    n_axis, injection = len(rig.labels), rig.injection
    added = np.zeros((length, n_axis))
    level = injection.rms * (injection.per_ampere if injection.place == "input" else 1.0)
    kind, _, label = name.partition("-")
    if kind == MULTISINE:
        period = design_multisine(injection.band, injection.spacing, level).samples(rig.control.rate, 1)
        added[:, rig.labels.index(label)] = np.resize(period, length)
    elif kind == RANDOM:
        axes = [rig.labels.index(label)] if label else list(range(n_axis))
        added[:, axes] = _random(rig, level, (length, len(axes)), rng, straight_lines=False)
    return added


def _random(
    rig: LevitatedRig, rms: float, shape: tuple[int, int], rng: np.random.Generator, *, straight_lines: bool
) -> FloatArray:
    """White in the injection's band; *straight_lines*: what is straight between samples is."""
    frequency = scipy.fft.rfftfreq(shape[0], 1 / rig.control.rate)
    inside = (frequency >= rig.injection.band[0]) & (frequency <= rig.injection.band[1])
    if not inside.any():
        raise SettingError("injection", "no line of a whole recording lies in its band", "widen it")
    spectrum = np.zeros((frequency.size, shape[1]), np.complex128)
    draws = rng.standard_normal((int(np.sum(inside)), shape[1], 2)) @ np.array([1.0, 1j])
    spectrum[inside] = draws * rms * shape[0] / np.sqrt(4 * draws.shape[0])
    if straight_lines:
        spectrum /= straight(2 * np.pi * frequency, rig.control.rate)[:, None]
    return scipy.fft.irfft(spectrum, shape[0], axis=0)


def _runout(rig: LevitatedRig, angle: FloatArray) -> FloatArray:
    quarters = np.resize(np.array([0.0, np.pi / 2])[: len(AXES[rig.axes])], len(rig.labels))
    seen = np.zeros((angle.size, quarters.size))
    for order, amplitude in enumerate(rig.runout, 1):
        seen += amplitude * np.cos(order * (angle[:, None] - quarters))
    return seen


def _log(rig: LevitatedRig, signals: FloatArray, per_step: int, n_sample: int) -> FloatArray:
    """Signals known *per_step* times in a step, stored by one filter without delay."""
    before = round(MARGIN * rig.sample_rate)
    steps = rig.decimation * per_step
    steady = signals[round(SETTLING * rig.control.rate) * per_step - before * steps :]
    filtered = steady if steps == 1 else scipy.signal.resample_poly(steady, 1, steps, axis=0)
    return np.array(filtered[before : before + n_sample])


def _channels(rig: LevitatedRig, name: str) -> list[Channel]:
    quantity, letter = ("force", "f") if rig.force_recorded else ("current", "i")
    added = "current" if rig.injection.place == "output" else "displacement"
    kinds = [
        (f"{letter}_", quantity, "reference" if name == SHAKER else "input"),
        ("", "displacement", "output"),
    ]
    if rig.output_recorded:
        kinds.append(("u_", "current", "reference"))
    if name == SHAKER:
        kinds.append(("s_", "force", "input"))
    elif name != REST:
        kinds.append(("r_", added, "reference"))
    return [
        Channel(f"{prefix}{label}", what, role, label, AXIS_ANGLES.get(label[-1]))
        for prefix, what, role in kinds
        for label in rig.labels
    ]


def _measuring_noise(rig: LevitatedRig, channel: Channel) -> float:
    """Standard deviation that the logger adds [A, N, A or m]; sensor noise is in the loop already."""
    own = {"r_": rig.noise.reference, "s_": rig.noise.force, "u_": 0.0}
    return own.get(channel.name[:2], 0.0 if channel.role == "output" else rig.noise.current)


def truth(rig: LevitatedRig) -> dict[str, Any]:
    of = mechanics(rig)
    poles = levitated_loop(rig).poles
    slowest = poles[np.argsort(-poles.real)]
    matrices = {
        "mass_matrix": of.mass,
        "damping_matrix": of.damping,
        "rotor_stiffness": of.stiffness,
        "at_bearings": of.at_bearings,
        "at_sensors": of.at_sensors,
        "bearing_stiffness": bearing_stiffness(rig),
    }
    return {
        "mass": rig.mass,
        "k_i": rig.force_per_current,
        "k_s": -rig.negative_stiffness,
        "negative_stiffness": rig.negative_stiffness,
        "axes": list(rig.labels),
        **{name: matrix.tolist() for name, matrix in matrices.items()},
        "poles": [[float(pole.real), float(pole.imag)] for pole in slowest if pole.imag >= 0],
    }


def _parameters(rig: LevitatedRig, _runs: Sequence[str]) -> Truth:
    values = {"k_i": rig.force_per_current, "k_s": -rig.negative_stiffness, "m": rig.mass}
    if rig.rotor is None:
        values |= {"k": -rig.negative_stiffness, "c": rig.damping}
    glue = "" if rig.rotor is None else "_"
    for (row, column), stiffness in np.ndenumerate(bearing_stiffness(rig)):
        x, y, direct = rig.labels[row], rig.labels[column], float(row == column)
        k_i, k_s, c = direct * rig.force_per_current, float(stiffness), direct * rig.damping
        values |= {f"k_i_{x}{glue}{y}": k_i, f"k_s_{x}{glue}{y}": k_s, f"c_{x}{glue}{y}": c}
        if rig.rotor is None:
            values |= {f"k_{x}_{y}": k_s, f"c_{x}_{y}": c}
    return values


LEVITATED_RIG = kind_of_recordings(
    LevitatedRig,
    runs=lambda rig: rig.runs,
    usual=lambda rig: rig.usual,
    record=_run,
    logged=lambda run: whole_numbers(run, {"current": FINE_CURRENT}),
    truth=truth,
    parameters=_parameters,
)
