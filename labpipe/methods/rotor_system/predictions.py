"""What follows from the posterior of a rotor, with intervals: Campbell diagram, critical speeds,
amplification, stability; weights in the planes of the unbalances without a trial run, what they leave, and
which run first would pay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.methods.balancing.influence import best_weights, remaining_rms, square_of
from labpipe.methods.rotor.posterior import root_of
from labpipe.methods.rotor.response import GROWTH_TOLERANCE, WhirlModes
from labpipe.methods.rotor.theory import AmplitudeAt, Critical, decrements, follow_modes, peaks
from labpipe.methods.rotor_system import records
from labpipe.methods.rotor_system.build import RUNNING, Built
from labpipe.methods.rotor_system.evidence import RunUpVectors, as_real
from labpipe.methods.rotor_system.model import Curve, Roots, SystemModel, orthonormal
from labpipe.methods.rotor_system.posterior import REFITS, SystemPosterior, normal_draws
from labpipe.methods.rotor_system.settings import RotorSystemSettings
from labpipe.records.finding import NORMAL

# Modes that are followed over the speed.
MOST_MODES = 8
# Draws of the posterior for critical speeds; modes of the basis in which they are computed.
DRAWS, BASIS = 200, 24
# Speeds about a critical one: every .33 % over 15 % to either side; where more than two fifths of the draws
# have no peak there, from half to twice of it.
AROUND, STEP, SCATTERED, WIDE = 0.15, 0.0033, 0.4, 0.7
# Steps in which the onset of instability is looked for, and how often; draws that tell whether it follows its
# slopes, and the distance from these, in standard errors, from which on it does not.
GROWTH, MOST_STEPS, ON_LINE, BENT = 1.25, 30, 20, 0.3
# Draws from which percentiles are steadier than the spread of logarithms, since peaks may split.
ENOUGH = 100
# Draws behind what one more run would leave, and behind the vibration over so many speeds.
VIBRATION_DRAWS, SPEEDS = 60, 61
# Speeds about a peak at which the vibration is drawn as well, in its half half-power widths; amplification
# factor of a peak that has no half-power points.
ACROSS_PEAK, FLAT = np.array([-3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0]), 2.5


def values_at_speed(model: SystemModel, values: FloatArray) -> FloatArray:
    """Values (n_unknown,) [unit of each] as they act on the turning rotor: those of single tests are zero."""
    return np.where(model.acting(RUNNING), values, 0.0)


def campbell(posterior: SystemPosterior, speeds: FloatArray) -> records.Campbell:
    """The Campbell diagram over ascending *speeds* (n_speed,) [Hz] with its standard errors, by first order
    or of refits: f = Im lambda / 2 pi, delta = -2 pi Re lambda / Im lambda.
    """
    model = posterior.model
    each, amounts = [], []
    for speed in 2 * np.pi * speeds:
        solution = model.roots(values_at_speed(model, posterior.values), float(speed), 2 * MOST_MODES)
        modes = _modes(model, float(speed), solution)
        slopes = np.where(model.acting(RUNNING), solution.slopes, 0.0)
        gradients = np.stack([slopes.imag / (2 * np.pi), decrement_slopes(solution.values, slopes)])

        def predict(values: FloatArray, modes: WhirlModes = modes) -> FloatArray:
            """f and delta of each of the *modes* (2, n_mode)."""
            roots = model.roots(values_at_speed(model, values), modes.speed, 2 * MOST_MODES, slopes=False)
            drawn = _modes(model, modes.speed, roots)
            pairs = follow_modes([modes, drawn], [_frequency_and_decrement(of) for of in (modes, drawn)])
            shown = np.full((2, modes.eigenvalues.size), np.nan)
            n = min(MOST_MODES, modes.eigenvalues.size)
            shown[:, :n] = np.array(pairs)[:, 1, :n]
            return shown

        (frequency, decrement), errors = (
            _frequency_and_decrement(modes),
            posterior.error_of(gradients, predict),
        )
        each.append(modes)
        amounts.append((frequency, errors[0], decrement, errors[1], modes.whirl))
    return records.Campbell(np.asarray(speeds), *follow_modes(each, amounts))


def _modes(model: SystemModel, speed: float, roots: Roots) -> WhirlModes:
    shaft = roots.shapes[: model.n_shaft].reshape(-1, 4, roots.values.size)
    return WhirlModes(speed, roots.values, shaft[:, :2].transpose(2, 0, 1))


def _frequency_and_decrement(modes: WhirlModes) -> tuple[FloatArray, FloatArray]:
    return modes.eigenvalues.imag / (2 * np.pi), decrements(modes.eigenvalues)


def least_decrement(posterior: SystemPosterior, operating: float) -> tuple[float, float, FloatArray]:
    """The least logarithmic decrement of the slowest modes at the *operating* speed [Hz], its standard error,
    and its derivatives (n_unknown,) [1 over the unknown's unit]; FitError where nothing oscillates.
    """
    model, spin = posterior.model, 2 * np.pi * operating
    roots = model.roots(values_at_speed(model, posterior.values), spin, MOST_MODES + 1)
    size = np.abs(roots.values)
    if not size.size:
        raise FitError(f"no mode of the rotor oscillates at {60 * operating:.0f} rpm")
    # The same modes wherever the unknowns are: one that is nearly overdamped comes and goes, and a count
    # would take in another one, of any damping, in its place.
    highest = np.sqrt(size[-2] * size[-1]) if size.size > MOST_MODES else np.inf

    def least_of(values: FloatArray) -> FloatArray:
        each = model.eigenvalues(values_at_speed(model, values), spin, 2 * MOST_MODES)
        return np.array(np.min(decrements(each[np.abs(each) < highest]), initial=np.inf))

    slopes = np.where(model.acting(RUNNING), roots.slopes, 0)
    decrement, moved = decrements(roots.values), decrement_slopes(roots.values, slopes)
    mode = int(np.argmin(decrement[:MOST_MODES]))
    return float(decrement[mode]), float(posterior.error_of(moved[mode], least_of)), moved[mode]


def decrement_slopes(root: ComplexArray, slopes: ComplexArray) -> FloatArray:
    """Derivatives (n_mode, n_unknown) of the decrements of eigenvalues (n_mode,) [1/s] by *slopes* of these
    (n_mode, n_unknown).
    """
    moved = 2 * np.pi * slopes.real + decrements(root)[:, None] * slopes.imag
    return -moved / root.imag[:, None]


def onset(posterior: SystemPosterior, lowest: float) -> tuple[float, float] | None:
    """Speed [Hz] at which an eigenvalue's real part becomes positive, from *lowest* [Hz] upwards, and the
    standard error of its logarithm; None where none does within some 800 times that.

    d ln N / d theta = -Re lambda' / (d Re lambda / d ln N). Equation (system-onset). Of refits it is that of
    each; of draws where their own speeds are not on this line, as where another mode is nearly unstable at
    lower speeds, or the growth hardly rises.
    """
    model = posterior.model

    def growth(speed: float, values: FloatArray) -> float:
        eigenvalues = model.eigenvalues(values, 2 * np.pi * speed, 2 * MOST_MODES)
        return float(np.max(eigenvalues.real, initial=-1.0)) - GROWTH_TOLERANCE

    def speed_of(unknowns: FloatArray, accuracy: float = 1e-3) -> float:
        values, low = values_at_speed(model, unknowns), lowest
        for _ in range(MOST_STEPS):
            high = GROWTH * low
            if growth(high, values) > 0:
                break
            low = high
        if low == high or growth(low, values) > 0:
            return low
        return float(scipy.optimize.brentq(growth, low, high, (values,), rtol=accuracy))

    speed, values = speed_of(posterior.values, 1e-9), values_at_speed(model, posterior.values)
    if growth(lowest, values) > 0:
        return lowest, 0.0
    if speed > 0.999 * lowest * GROWTH**MOST_STEPS:
        return None
    roots = model.roots(values, 2 * np.pi * speed, 2 * MOST_MODES)
    mode = int(np.argmax(roots.values.real))
    step = 1e-4
    rise = (growth(speed * (1 + step), values) - growth(speed * (1 - step), values)) / (2 * step)
    slope = np.where(model.acting(RUNNING), roots.slopes[mode].real, 0.0) / rise
    if posterior.refits is None:
        draws = posterior.draws(ON_LINE)
        off = np.log([speed_of(draw) / speed for draw in draws]) + (draws - posterior.values) @ slope
        error = float(posterior.error_of(slope, np.asarray))
        if np.sqrt(np.mean(off**2)) < BENT * error / posterior.widened:
            return speed, error
        posterior = replace(posterior, refits=posterior.draws(REFITS))
    return speed, float(posterior.error_of(slope, lambda drawn: np.log(speed_of(drawn))))


class _Reduced:
    """Unbalance response in a fixed basis of the lowest modes of (K, M), K at a *spin* speed [rad/s], and the
    static shapes of bearing and unbalance dofs.
    """

    def __init__(self, model: SystemModel, values: FloatArray, forced: Sequence[int], spin: float) -> None:
        whole = model.matrices(values, spin)
        n = model.n_dof
        carried = sorted({dof for term in model.terms if term.support for dof in term.dofs} | set(forced))
        # As 1 / w^2, largest first: the mass need not be positive definite. The stiffness of a cross-coupled
        # bearing or of a magnet's pull need not either; their shapes are those on springs of that size.
        stiffness: FloatArray = (whole.stiffness + whole.stiffness.T) / 2
        if linalg.eigvalsh(stiffness, subset_by_index=[0, 0])[0] <= 0:
            stiffness = model.matrices(values, spin, supported=False).stiffness
            stiffness[carried, carried] += np.abs(np.diag(whole.stiffness - stiffness))[carried]
        _, vectors = linalg.eigh(whole.mass, stiffness, subset_by_index=[max(0, n - BASIS), n - 1])
        static = np.linalg.solve(whole.stiffness, np.eye(model.n_dof)[:, carried])
        self.basis = orthonormal(np.column_stack([vectors, static]), 1e-8)
        n_shape = self.basis.shape[1]
        dofs = tuple(range(n_shape))
        terms = tuple(
            replace(term, dofs=dofs, block=self._project(term.block, list(term.dofs))) for term in model.terms
        )
        self.model = SystemModel(model.unknowns, terms, n_shape, 0)

    def _project(self, block: FloatArray | Curve, dofs: list[int]) -> FloatArray | Curve:
        rows = self.basis[dofs]
        if callable(block):
            curve: Curve = block
            return lambda spin, omega, inputs: rows.T @ curve(spin, omega, inputs) @ rows
        return rows.T @ block @ rows

    def amplitudes(
        self, values: FloatArray, speed: FloatArray, forces: ComplexArray, outputs: Sequence[int]
    ) -> FloatArray:
        """|z| (n_speed, n_output) [m] at *speed* (n_speed,) [Hz]; *forces* (n_dof,) [kg m]."""
        omega = 2 * np.pi * speed
        (stiffness,) = self.model.dynamic(values, omega, omega)
        turned = self.basis.T @ forces * omega[:, None] ** 2
        motion = np.linalg.solve(stiffness, turned[:, :, None])[:, :, 0]
        return np.abs(motion @ self.basis[list(outputs)].T)

    def at(self, values: FloatArray, forces: ComplexArray, output: int) -> AmplitudeAt:
        """The same at one *output*, over the speed alone."""
        return lambda speed: self.amplitudes(values, speed, forces, [output])[:, 0]


def unbalance_forces(built: Built, values: FloatArray) -> ComplexArray:
    """u (e_y - j e_z) of all planes, (n_dof,) [kg m]."""
    forces = np.zeros(built.model.n_dof, np.complex128)
    for first, real, imaginary in built.planes.values():
        u = values[real] + 1j * values[imaginary]
        forces[first] += u
        forces[first + 1] += -1j * u
    return forces


def critical_speeds(
    posterior: SystemPosterior,
    built: Built,
    band: tuple[float, float],
    operating: float,
    outputs: Sequence[int],
    n_draw: int,
    seed: int = 1,
) -> list[records.CriticalResult]:
    """Critical speeds in a *band* [Hz] as the unbalance response at *outputs* shows them, with intervals from
    draws in a reduced basis; each once, where its peak is highest.
    """
    model = posterior.model
    values = values_at_speed(model, posterior.values)
    forced = [dof for first, _, _ in built.planes.values() for dof in (first, first + 1)]
    reduced = _Reduced(model, values, forced, 2 * np.pi * float(np.sqrt(band[0] * band[1])))
    coarse = np.geomspace(*band, int(np.log(band[1] / band[0]) / 0.005) + 2)
    forces = unbalance_forces(built, posterior.values)
    amplitude = reduced.amplitudes(values, coarse, forces, outputs)
    all_peaks = [
        peak
        for course, dof in zip(amplitude.T, outputs, strict=True)
        for peak in peaks(coarse, course, dof, reduced.at(values, forces, dof))
    ]
    distinct: list[Critical] = []
    for peak in sorted(all_peaks, key=lambda peak: -peak.amplitude):
        if not any(peak.is_like(other) for other in distinct):
            distinct.append(peak)
    draws = posterior.values + posterior.widened * (posterior.draws(n_draw, seed) - posterior.values)
    speeds = np.log([peak.speed for peak in distinct])
    # A peak of a draw is the same one where it is nearer to it than to any other.
    rooms = [min([*(abs(at - other) / 2 for other in speeds if other != at), AROUND]) for at in speeds]
    pairs = zip(distinct, rooms, strict=True)
    criticals = (_critical(reduced, built, peak, draws, operating, room) for peak, room in pairs)
    return sorted(criticals, key=lambda critical: critical.speed)


def _critical(
    reduced: _Reduced, built: Built, peak: Critical, draws: FloatArray, operating: float, apart: float
) -> records.CriticalResult:
    half = AROUND
    # A flat peak needs more room for its half-power points.
    if peak.low is not None and peak.high is not None:
        half = max(half, 2 * np.log(peak.high / peak.speed), 2 * np.log(peak.speed / peak.low))
    rows = _drawn_peaks(reduced, built, peak, draws, (half, half * STEP / AROUND, apart))
    if np.mean([row is None for row in rows]) > SCATTERED:
        # Speeds that are hardly known: the nearest peak, wherever it is.
        rows = _drawn_peaks(reduced, built, peak, draws, (WIDE, 2 * STEP, WIDE))
    there = [row for row in rows if row is not None]
    whole = [row for row in there if row.amplification is not None]
    factors = np.array([row.amplification for row in whole], dtype=float)
    margins = [row.margin(operating) for row in whole] if operating else []
    required = [margin for margin in margins if margin is not None and margin[1] > 0]
    return records.CriticalResult(
        _place(peak.node),
        peak.speed,
        _interval(peak.speed, np.array([row.speed for row in there])),
        peak.amplification,
        None if peak.amplification is None or factors.size < 2 else _interval(peak.amplification, factors),
        peak.amplitude,
        _interval(peak.amplitude, np.array([row.amplitude for row in there])),
        peak.margin(operating) if operating else None,
        float(np.mean([m is None or m[0] >= m[1] for m in margins])) if required else None,
        1 - len(whole) / len(rows),
    )


def _place(dof: int) -> str:
    return f"{dof // 4 + 1} {'yz'[dof % 4]}"


def _drawn_peaks(
    reduced: _Reduced, built: Built, peak: Critical, draws: FloatArray, looked: tuple[float, float, float]
) -> list[Critical | None]:
    """The nearest peak of every draw; *looked*: ln of the speeds to either side, their step, and how far a
    peak may be off.
    """
    half, step, apart = looked
    grid = peak.speed * np.exp(np.arange(-half, half + step, step))

    def distance(other: Critical) -> float:
        return abs(float(np.log(other.speed / peak.speed)))

    rows: list[Critical | None] = []
    for values in draws:
        amplitude = reduced.at(
            values_at_speed(reduced.model, values), unbalance_forces(built, values), peak.node
        )
        drawn = peaks(grid, amplitude(grid), peak.node, amplitude)
        near = (other for other in drawn if distance(other) < apart)
        rows.append(min(near, key=distance, default=None))
    return rows


def _interval(value: float, draws: FloatArray) -> tuple[float, float]:
    """95 % interval of a positive quantity by its draws: from the spread of their logarithms where they are
    few.
    """
    if draws.size < 2:
        return value, value
    if draws.size < ENOUGH:
        spread = NORMAL * float(np.std(np.log(draws)))
        return value * float(np.exp(-spread)), value * float(np.exp(spread))
    low, high = np.percentile(draws, (2.5, 97.5))
    return float(low), float(high)


def balance(
    settings: RotorSystemSettings,
    built: Built,
    posterior: SystemPosterior,
    criticals: Sequence[records.CriticalResult],
) -> records.BalanceResult | None:
    """Weights in the planes of the unbalances, what they leave, and what one more run would change. Near
    *criticals* the vibration over speed is told at closer speeds.
    """
    runs = [test for test in posterior.tests if isinstance(test, RunUpVectors)]
    if not settings.balance_speeds or not runs:
        return None
    speed = 2 * np.pi * np.array(settings.balance_speeds)
    nothing = np.zeros((speed.size, len(runs[0].outputs)), complex)
    test = replace(runs[0], speed=speed, added=(), measured=nothing, changes={})
    drawn = drawn_influence(built, test, posterior.draws(settings.draws, settings.seed))
    weights = best_weights(square_of(drawn))
    before, left = (remaining_rms(drawn, acting) for acting in (np.zeros_like(weights), weights))
    return records.BalanceResult(
        settings.balance_speeds,
        tuple(
            records.WeightResult(node, float(abs(w)), float(np.angle(w) % (2 * np.pi)))
            for node, w in zip(built.planes, weights, strict=True)
        ),
        float(np.sqrt(np.mean(before**2))),
        float(np.sqrt(np.mean(left**2))),
        interval_of(left, posterior.widened),
        _next_weights(built, posterior, test, weights),
        stated_influence(built, posterior, test),
        _predict_over_speed(settings, built, posterior, test, weights, criticals),
    )


def _predict_over_speed(
    settings: RotorSystemSettings,
    built: Built,
    posterior: SystemPosterior,
    test: RunUpVectors,
    weights: ComplexArray,
    criticals: Sequence[records.CriticalResult],
) -> records.VibrationResult:
    rated, operating = settings.balance_speeds, 0.0 if settings.system is None else settings.system.rig.speed
    even = np.linspace(0.5 * min(rated), max(1.1 * max(rated), operating), SPEEDS)
    # A peak is 1 / amplification of its speed wide.
    near = [c.speed * (1 + ACROSS_PEAK / (2 * (c.amplification or FLAT))) for c in criticals]
    speed = np.unique(np.clip(np.concatenate([even, *near]), even[0], even[-1]))
    wide = replace(test, speed=2 * np.pi * speed)
    drawn = drawn_influence(built, wide, posterior.draws(VIBRATION_DRAWS, settings.seed))
    drawn = drawn.reshape(VIBRATION_DRAWS, speed.size, -1, drawn.shape[-1])
    before, after = (remaining_rms(drawn, acting) for acting in (np.zeros_like(weights), weights))
    low, high = np.percentile(after, (2.5, 97.5), axis=0)
    before, middle = (np.sqrt(np.mean(part**2, axis=0)) for part in (before, after))
    return records.VibrationResult(speed, before, middle, low, posterior.widened * high)


def stated_influence(built: Built, posterior: SystemPosterior, test: RunUpVectors) -> records.InfluenceResult:
    """z_0 = H u and alpha = H at the speeds and probes of a *test*, with the root of their covariance: the
    half differences over one standard deviation to either side along each axis of the posterior, or the
    differences of the refits over the root of their number; it is widened where intervals are.
    """

    def influence(values: FloatArray) -> FloatArray:
        return as_real(drawn_influence(built, test, values[None]).ravel())

    middle, widening = posterior.values, posterior.widened
    if posterior.refits is None:
        axes = root_of(posterior.covariance).T
        root = [widening * (influence(middle + step) - influence(middle - step)) / 2 for step in axes]
    else:
        widening /= np.sqrt(len(posterior.refits))
        root = [widening * (influence(values) - influence(middle)) for values in posterior.refits]
    turned = [f"{speed * 30 / np.pi:.0f} rpm" for speed in test.speed]
    readings = tuple(f"{_place(dof)} {rpm}" for rpm in turned for dof in test.outputs)
    planes = tuple(f"node {node}" for node in built.planes)
    return records.InfluenceResult(planes, readings, influence(middle), np.array(root).T, posterior.widened)


def interval_of(left: FloatArray, widened: float) -> tuple[float, float]:
    """95 % interval of what is left [m], by draws (n_draw,) [m]. What the posterior is *widened* by enlarges
    its upper end; the lower one stays, since what is left grows with the spread.
    """
    low, high = np.percentile(left, (2.5, 97.5))
    return float(low), float(widened * high)


def drawn_influence(built: Built, test: RunUpVectors, draws: FloatArray) -> ComplexArray:
    """z_0 = H u [m] and alpha = H [m/(kg m)], (n_draw, n_reading, n_plane + 1), at the speeds and probes of a
    *test*, of *draws* (n_draw, n_unknown) of the unknowns.
    """
    influences = []
    for values in draws:
        h = test.readings(built.model, values)[2].reshape(-1, len(built.planes))
        u = np.array([values[real] + 1j * values[imaginary] for _, real, imaginary in built.planes.values()])
        influences.append(np.column_stack([h @ u, h]))
    return np.array(influences)


def _next_weights(
    built: Built, posterior: SystemPosterior, test: RunUpVectors, weights: ComplexArray
) -> dict[str, float]:
    """What one more run first, with a weight in one plane or the weights themselves, is expected to leave:
    the posterior narrows, its middle stays.
    """
    trial = float(np.max(np.abs(weights)))
    sets = {f"a weight at node {node}": {node: trial + 0j} for node in built.planes}
    sets["the weights themselves"] = dict(zip(built.planes, weights, strict=True))
    noise = float(np.median(test.noise))
    by_run = {}
    for name, weights_of_run in sets.items():
        added = tuple((built.planes[node][0], amount) for node, amount in weights_of_run.items())
        covariance = posterior.covariance_with(test.plan(test.speed, noise, added))
        drawn = drawn_influence(built, test, normal_draws(posterior.values, covariance, VIBRATION_DRAWS))
        left = remaining_rms(drawn, best_weights(square_of(drawn)))
        by_run[name] = float(np.sqrt(np.mean(left**2)))
    return by_run
