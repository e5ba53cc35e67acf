"""A virtual floating-stator rig: shakers push the stator, probes see it move against the shaft, accelerometers see it move.

Stator: (Z_s + H) X_s - H X_r = F, shaft: -H X_s + (Z_r + H) X_r = F_r, with H the film, Z_s = -w^2 m_s + j w C_b + K_b the stator on its
hoses and soft supports, Z_r the same of the shaft. Measured are F, D = X_s - X_r less the runout of the shaft's surface, and A = -w^2 X_s,
so that F - m_s A - (K_b + j w C_b) X_s = H D, whatever the shaft does.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.bearings.journal import converged_equilibrium
from labpipe.bearings.journal_kind import JournalSettings
from labpipe.errors import ConfigError
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.signals.excitation import Multisine, design_multisine
from labpipe.simulate.floating_settings import Condition, FloatingRig
from labpipe.simulate.logged import whole_numbers
from labpipe.simulate.virtual_rigs import Simulation, Truth, VirtualRigKind

AXES = ("x", "y")
MESH_ERROR = 0.01
PULSE, PULSE_SHARE = 5.0, 0.3


@lru_cache(maxsize=16)
def _journal(journal: JournalSettings, load: float, speed: float) -> tuple[FloatArray, FloatArray]:
    """K and C of a journal bearing; its y and z are x and y here, and it turns from x to y."""
    state = converged_equilibrium(journal.bearing(), (0.0, -load), 2 * np.pi * speed, MESH_ERROR)
    return state.stiffness, state.damping


def coefficients(rig: FloatingRig, condition: Condition) -> tuple[FloatArray, FloatArray, FloatArray]:
    """K [N/m], C [N s/m] and M [kg] of the film, (2, 2) each, without relaxation and pad."""
    stiffness, damping = np.array(condition.stiffness, float), np.array(condition.damping, float)
    if condition.film == "journal":
        assert rig.journal is not None
        stiffness, damping = _journal(rig.journal, condition.load, condition.speed)
    return stiffness, damping, np.array(condition.mass, float)


def film(rig: FloatingRig, condition: Condition, frequency: FloatArray) -> ComplexArray:
    """H = K + j w C - w^2 M + relaxation + pad at *frequency* (n,) [Hz], (n, 2, 2) [N/m]: force on the stator is -H D.

    Equation (sim-film).
    """
    jw = 2j * np.pi * np.asarray(frequency, float)[:, None, None]
    stiffness, damping, mass = coefficients(rig, condition)
    dynamic = stiffness + jw * damping + jw**2 * mass
    if condition.relaxation is not None:
        relative = jw * condition.relaxation.time
        dynamic = dynamic + condition.relaxation.stiffness * relative / (1 + relative) * np.eye(2)
    if condition.pad is not None:
        pad = condition.pad
        relative = jw / (2 * np.pi * pad.frequency)
        dynamic = dynamic + (pad.stiffness + jw * pad.damping) / (1 + 2 * pad.damping_ratio * relative + relative**2) * np.eye(2)
    return np.asarray(dynamic)


def motions(rig: FloatingRig, condition: Condition, frequency: FloatArray, forces: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """X_s and X_r (n, 2) [m] under *forces* (n, 4) [N] on the stator and on the shaft at *frequency* (n,) [Hz]. Equation (sim-floating)."""
    jw = 2j * np.pi * np.asarray(frequency, float)[:, None, None]
    h = film(rig, condition, frequency)
    stator = np.array(rig.baseline_stiffness) + jw * np.array(rig.baseline_damping) + jw**2 * rig.stator_mass * np.eye(2)
    shaft = np.array(rig.shaft_stiffness) + jw * np.array(rig.shaft_damping) + jw**2 * rig.shaft_mass * np.eye(2)
    system = np.concatenate([np.concatenate([stator + h, -h], axis=2), np.concatenate([-h, shaft + h], axis=2)], axis=1)
    moved = np.linalg.solve(system, forces[:, :, None])[:, :, 0]
    return moved[:, :2], moved[:, 2:]


def floating_runs(rig: FloatingRig, seed: int, names: Sequence[str]) -> tuple[Recording, ...]:
    """The named runs: f_x, f_y, d_x, d_y, a_x, a_y [SI], the drives u_x, u_y if the rig has them, and the tacho n, still with the shaft.

    Periodic in the whole run and band-limited, so every line is the exact steady state; noise is independent from run to run.
    """
    return tuple(_run(rig, name, np.random.default_rng([seed, zlib.crc32(name.encode())])) for name in names)


def _run(rig: FloatingRig, name: str, rng: np.random.Generator) -> Recording:
    condition = rig.condition(name)
    frequency = fft.rfftfreq(rig.n_sample, 1 / rig.sample_rate)
    inside = np.flatnonzero((frequency >= rig.band[0] * (1 - 1e-9)) & (frequency <= rig.band[1] * (1 + 1e-9)) & (frequency > 0))
    lines = frequency[inside]
    forces = np.concatenate([SHAKERS[name.rpartition("-")[2]](rig, rng)[inside], _white(rig.shaft_noise, (lines.size, 2), rng)], axis=1)
    stator, shaft = motions(rig, condition, lines, forces)
    late = np.exp(-2j * np.pi * lines * rig.probe_delay)[:, None]
    amplitudes = np.concatenate([forces[:, :2], (stator - shaft) * late, -((2 * np.pi * lines[:, None]) ** 2) * stator], axis=1)
    phase = rng.uniform(0, 2 * np.pi)
    samples = _in_time(rig, inside, amplitudes) + _synchronous(rig, condition, phase)
    channels = _channels()
    if rig.drives:
        samples = np.concatenate([samples, _in_time(rig, inside, np.asarray(forces[:, :2] / rig.gain))], axis=1)
        channels += [Channel(f"u_{axis}", "voltage", "reference", axis, AXIS_ANGLES[axis]) for axis in AXES]
    samples = samples + rng.standard_normal(samples.shape) * [rig.noise.of(channel.quantity) for channel in channels]
    turned = (_angle(rig, condition.speed) + phase) / (2 * np.pi) % 1.0
    pulses = np.where((turned < PULSE_SHARE) & (condition.speed > 0), PULSE, 0.0)
    samples = np.column_stack([samples, pulses])
    channels.append(Channel("n", "tacho", "reference", "n"))
    return Recording(tuple(channels), samples, rig.sample_rate, name)


def _channels() -> list[Channel]:
    kinds = (("f", "force", "input"), ("d", "displacement", "output"), ("a", "acceleration", "output"))
    return [Channel(f"{letter}_{axis}", quantity, role, axis, AXIS_ANGLES[axis]) for letter, quantity, role in kinds for axis in AXES]


def _in_time(rig: FloatingRig, lines: IntArray, amplitudes: ComplexArray) -> FloatArray:
    """(n_sample, n) of amplitudes (n_line, n), 0 to peak, at lines of the whole run."""
    spectrum = np.zeros((rig.n_sample // 2 + 1, amplitudes.shape[1]), np.complex128)
    spectrum[lines] = amplitudes * (rig.n_sample / 2)
    return np.asarray(fft.irfft(spectrum, rig.n_sample, axis=0))


def _white(rms: float, shape: tuple[int, int], rng: np.random.Generator) -> ComplexArray:
    """Amplitudes (n_line, n) of white noise with this rms in all lines together."""
    draws = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return np.asarray(draws * rms / np.sqrt(shape[0]))


def _angle(rig: FloatingRig, speed: float) -> FloatArray:
    return np.asarray(2 * np.pi * speed * np.arange(rig.n_sample) / rig.sample_rate)


def _synchronous(rig: FloatingRig, condition: Condition, phase: float) -> FloatArray:
    """What the six channels see of the turning shaft: motion under the unbalance, and runout, (n_sample, 6)."""
    total = np.zeros((rig.n_sample, 6))
    if condition.speed == 0:
        return total
    angle = _angle(rig, condition.speed) + phase
    if rig.unbalance > 0:
        omega = 2 * np.pi * condition.speed
        force: ComplexArray = np.array([[0, 0, 1, -1j]], np.complex128) * rig.unbalance * omega**2
        stator, shaft = motions(rig, condition, np.array([condition.speed]), force)
        late = np.exp(-1j * omega * rig.probe_delay)
        amplitudes = np.concatenate([np.zeros(2), (stator - shaft)[0] * late, -(omega**2) * stator[0]])
        total += (np.exp(1j * angle)[:, None] * amplitudes).real
    for order, amplitude in enumerate(rig.runout, 1):
        for column, quarter in ((2, 0.0), (3, np.pi / 2)):
            total[:, column] -= amplitude * np.cos(order * (angle - quarter - 2 * np.pi * condition.speed * rig.probe_delay))
    return total


def _multisine(rig: FloatingRig) -> Multisine:
    return design_multisine(rig.band, rig.spacing, rig.force)


def _periodic(rig: FloatingRig, shares: tuple[float, float], zipper: bool = False) -> ComplexArray:
    """Amplitudes (n_sample // 2 + 1, 2) [N]: the multisine times *shares* in x and y, or its lines to x and y in turn."""
    design = _multisine(rig)
    size = (design.lines * design.spacing) ** rig.slope
    amplitude = size * np.exp(1j * design.phases)
    both = amplitude[:, None] * np.array(shares)
    if zipper:
        both = both * (np.arange(design.lines.size)[:, None] % 2 == np.arange(2))
    rms = np.sqrt(np.sum(np.abs(both) ** 2, axis=0) / 2)
    spectrum = np.zeros((rig.n_sample // 2 + 1, 2), np.complex128)
    spectrum[design.lines * rig.periods] = both * rig.force / np.where(rms > 0, rms, 1.0)
    return spectrum


def _random(rig: FloatingRig, rng: np.random.Generator) -> ComplexArray:
    """Independent random forces in x and y over all lines of the run in the band."""
    frequency = fft.rfftfreq(rig.n_sample, 1 / rig.sample_rate)
    inside = np.flatnonzero((frequency >= rig.band[0] * (1 - 1e-9)) & (frequency <= rig.band[1] * (1 + 1e-9)) & (frequency > 0))
    draws = rng.standard_normal((inside.size, 2)) + 1j * rng.standard_normal((inside.size, 2))
    draws = draws * (frequency[inside] ** rig.slope)[:, None]
    spectrum = np.zeros((frequency.size, 2), np.complex128)
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
    """Masses and baseline of the stator, and per condition k_xx ... m_yy, relaxation and pad [SI, Hz]."""
    stator = {**named("k", np.array(rig.baseline_stiffness)), **named("c", np.array(rig.baseline_damping))}
    conditions: dict[str, Any] = {}
    for name, condition in rig.conditions:
        entries: dict[str, Any] = {"speed_hz": condition.speed, "load": condition.load, "pressure": condition.pressure}
        for part in (condition.relaxation, condition.pad):
            entries |= {} if part is None else {type(part).__name__.lower(): vars(part)}
        conditions[name] = entries | _coefficients_by_name(rig, condition)
    return {"stator_mass": rig.stator_mass, "baseline": stator, "conditions": conditions}


def named(letter: str, matrix: FloatArray) -> Truth:
    """Entries of a matrix (2, 2) [any unit] by name: k_xx, k_xy, k_yx, k_yy."""
    return {f"{letter}_{AXES[row]}{AXES[column]}": float(matrix[row, column]) for row in range(2) for column in range(2)}


def _coefficients_by_name(rig: FloatingRig, condition: Condition) -> Truth:
    letters = zip("kcm", coefficients(rig, condition), strict=True)
    return {name: value for letter, matrix in letters for name, value in named(letter, matrix).items()}


def _simulate(rig: FloatingRig, seed: int, runs: Sequence[str]) -> Simulation:
    """One file per run, in whole mN, nm, mm/s^2 and mV."""
    return Simulation({run.name: whole_numbers(run) for run in floating_runs(rig, seed, runs)}, {"truth": truth(rig)})


def _parameters(rig: FloatingRig, runs: Sequence[str]) -> Truth:
    """Coefficients of the condition of the runs; ConfigError where they are of several."""
    conditions = dict.fromkeys(run.rpartition("-")[0] for run in runs)
    if len(conditions) != 1:
        raise ConfigError("'runs' of one condition belong to one fit", hint="for example runs: [seal-plus, seal-minus]")
    return _coefficients_by_name(rig, rig.condition(runs[0]))


def _at_level(rig: FloatingRig, level: float) -> FloatingRig:
    noise = rig.noise
    scaled = {name: level * getattr(noise, name) for name in ("force", "displacement", "acceleration", "drive")}
    return replace(rig, noise=replace(noise, **scaled))


FLOATING_RIG = VirtualRigKind(
    settings=FloatingRig,
    runs=lambda rig: rig.runs,
    usual=lambda rig: rig.usual,
    simulate=_simulate,
    parameters=_parameters,
    noisy=_at_level,
    recordings=floating_runs,
)
