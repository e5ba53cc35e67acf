"""Poles that are one mode: a hammer or a sensor that moves loads the structure, so that every point has a
frequency of its own.

The points are taken to the mean pole of each mode, each through its own fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, modal_assurance
from labpipe.distributions import chi2_tail, student_quantile
from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.leakage import Leakage
from labpipe.estimation.measured import Measured
from labpipe.estimation.repeats import PRIOR_SCALE, repeat_mean
from labpipe.methods.modal.likelihood import FrfLines, Refined, leaking_functions, pole_functions, remaining
from labpipe.methods.modal.poles import Completed, Poles, complete, criterion, kept_modes, refine_with_terms
from labpipe.records.finding import NORMAL, Finding, IntervalParts, Parameter, note

# Half-power widths between neighbouring poles, and in all, up to which they may be one mode.
NEXT, FARTHEST = 2.0, 6.0
# Half-power widths beyond them that are looked at, and the fewest lines and points.
BESIDE, FEWEST_LINES, FEWEST_POINTS = 3.0, 12, 3
# Likeness of two modes at the references within a half-power width that are one line in the list, and factor
# on the damping of a second pole that fits something else.
LIKE, BROADER = 0.9, 10.0
# Share of the largest residue below which a point hardly sees a mode, and that from which it shows where the
# mode lies.
HARDLY, SHOWS = 0.1, 0.3
# Squares over those of noise, as its differences from line to line show it, up to which two poles leave none.
AS_NOISE = 1.3
# Largest |ln| of the damping of a pole over that it starts with, far beyond any that is kept.
MOST_MOVED = 8.0
# Largest |ln| between the frequencies of a mode at two references.
MOST_APART = 0.05
# Modes of one shape that act on references in ways of their own: a pair may do so at few points.
LEAST_ALIKE = 4
# Points disagree on a mode below this chance.
DISAGREE = 1e-3
APART = "the references disagree in frequency"
REMEDY = "Measure all references in one state, or name one of them under `input` or `output`"
PAIR = "a pair, or one mode that moves from point to point: one reference cannot tell"


@dataclass(frozen=True)
class MovedMode:
    """One mode whose points have poles (n_point,) [rad/s] of their own, with residues (n_point, n_reference)
    [unit of the FRF times rad/s]; *also*: frequencies [Hz] of two poles that fit better, which the references
    cannot tell apart; *instead*: the poles [rad/s] that it may stand for, where these fit better and a single
    reference cannot tell whether the mode moves or is a pair.
    """

    poles: ComplexArray
    residues: ComplexArray
    also: tuple[float, ...] = ()
    instead: tuple[complex, ...] = ()

    @property
    def reference(self) -> ComplexArray:
        """Participation (n_reference,) [1] that holds most of the residues."""
        return np.linalg.svd(self.residues, full_matrices=False)[2][0]

    @property
    def pole(self) -> complex:
        """Mean of the points' poles [rad/s], each by the square of its residue."""
        return complex(np.average(self.poles, weights=np.sum(np.abs(self.residues) ** 2, axis=1)))

    @property
    def shifts(self) -> FloatArray:
        """ln f_n and ln zeta of every point over those of the mean, (n_point, 2) [1]; 0 of points that hardly
        see the mode.
        """
        size, damping = np.abs(self.poles / self.pole), self.poles.real / np.abs(self.poles)
        relative = np.abs(damping / (self.pole.real / abs(self.pole)))
        return np.where(self._is_seen[:, None], np.log(np.column_stack([size, relative])), 0.0)

    @property
    def _is_seen(self) -> BoolArray:
        near = np.abs(self.poles - self.pole) < FARTHEST * -2 * self.pole.real
        return (self._share > HARDLY) & near & (self.poles.real < 0)

    @property
    def _share(self) -> FloatArray:
        size = np.linalg.norm(self.residues, axis=1)
        return np.asarray(size / np.max(size))

    def align(self, s: ComplexArray) -> ComplexArray:
        """What takes every point from its own pole to the mean one, (n_line, n_point, n_reference) [unit of
        the FRF]; *s* (n_line,) [rad/s].
        """
        point_poles = np.where(self._is_seen, self.poles, self.pole)
        (a, b), _ = pole_functions(s, np.append(point_poles, self.pole), hysteretic=False)
        change = np.einsum("lp,pr->lpr", a[:, -1:] - a[:, :-1], self.residues)
        return change + np.einsum("lp,pr->lpr", b[:, -1:] - b[:, :-1], self.residues.conj())

    def point_ends(self) -> tuple[tuple[float, float], ...]:
        """Ends of ln f_n and ln zeta of another point, mean +- t s sqrt(1 + 1/n) of those that show it; none
        of fewer than three.
        """
        shown = (self._share > SHOWS) & self._is_seen
        if np.count_nonzero(shown) < FEWEST_POINTS:
            return ()
        poles = self.poles[shown]
        size = np.abs(poles)
        ends = _of_another(np.log(np.column_stack([size / (2 * np.pi), -poles.real / size])))
        return tuple((low, high) for _, low, high in ends)

    def held_by(self, parameter: Parameter) -> Parameter:
        """A frequency or damping of a pole that this mode may stand for, whose interval holds this mode's."""
        ends = self.point_ends()
        if not ends:
            return parameter
        low, high = np.exp(ends[0 if parameter.name.startswith("f_n") else 1])
        return _hold(parameter, float(low), float(high), PAIR)

    @property
    def finding(self) -> Finding:
        """A note that it is one mode, and between which frequencies it lies."""
        frequencies = np.abs(self.poles[self._share > SHOWS]) / (2 * np.pi)
        message = (
            f"the poles around {abs(self.pole) / (2 * np.pi):.6g} Hz are one mode, whose frequency lies "
            f"between {frequencies.min():.6g} and {frequencies.max():.6g} Hz from point to point: what moves "
            "loads the structure. "
        )
        if self.also:
            message += (
                f"Two modes at {self.also[0]:.6g} and {self.also[1]:.6g} Hz would fit better, but look alike "
                "at the references: a close pair, or a mode that jumps. Use more references"
            )
        else:
            message += "`moving_mass` states the structure without it"
        return note("moved-mode", message)


def _hold(parameter: Parameter, low: float, high: float, reason: str) -> Parameter:
    if parameter.ci95 is None or parameter.std_error is None:
        return parameter
    held = (min(parameter.ci95[0], low), max(parameter.ci95[1], high))
    if held == parameter.ci95:
        return parameter
    full = max((held[1] - held[0]) / (2 * NORMAL), parameter.std_error)
    parts = IntervalParts(parameter.std_error, float(np.sqrt(full**2 - parameter.std_error**2)))
    return replace(parameter, std_error_inflated=full, ci95=held, interval=parts, reason=reason)


@dataclass(frozen=True)
class MovedReferences:
    """References at which a mode has the frequency e^shift times that of their mean: *shifts*, their standard
    *errors* [1] and *poles* [rad/s] (n_reference, n_mode), *residues* (n_reference, n_point, n_mode) [unit of
    the FRF times rad/s], 0 of modes that a reference does not show.
    """

    shifts: FloatArray
    errors: FloatArray
    poles: ComplexArray
    residues: ComplexArray
    hysteretic: bool

    def align(self, omega: FloatArray, leakage: Leakage | None) -> ComplexArray:
        """What takes every reference to the frequencies of their mean, (n_line, n_point, n_reference) [unit
        of the FRF], at *omega* (n_line,) [rad/s] with the *leakage* of random data.
        """
        changes = []
        for shift, poles, residues in zip(self.shifts, self.poles, self.residues, strict=True):
            both = np.concatenate([poles * np.exp(-shift), poles])
            (a, b), _ = leaking_functions(omega, both, leakage, self.hysteretic)
            a, b = (of[:, : poles.size] - of[:, poles.size :] for of in (a, b))
            changes.append(a @ residues.T + b @ residues.T.conj())
        return np.stack(changes, axis=-1)

    @property
    def is_common(self) -> bool:
        """Whether all modes of a reference have one shift."""
        return bool(np.all(self.shifts == self.shifts[:, :1]))

    def hold(self, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Frequencies, and stiffnesses ~ f^2, whose intervals hold those of all references."""
        natural, restated = np.abs(self.poles[0]) * np.exp(-self.shifts[0]) / (2 * np.pi), []
        values = {parameter.name: parameter.value for parameter in parameters}
        for parameter in parameters:
            name, _, number = parameter.name.rpartition("_")
            power, value = {"f_n": 1, "k": 2}.get(name, 0), parameter.value
            if parameter.ci95 is not None and power:
                mode = np.argmin(np.abs(natural - values[f"f_n_{number}"]))
                ends = value * np.exp(power * self.shifts[:, mode])
                errors = NORMAL * value * power * self.errors[:, mode]
                low, high = (np.hypot(end - value, errors) for end in parameter.ci95)
                parameter = _hold(parameter, float(np.min(ends - low)), float(np.max(ends + high)), APART)
            restated.append(parameter)
        return tuple(restated)

    def finding(self, names: Sequence[str]) -> Finding:
        """A warning by how much the references, called *names*, disagree."""
        worst = int(np.argmax(np.ptp(self.shifts, axis=0)))
        shifts = self.shifts[:, worst]
        lowest, highest = names[int(np.argmin(shifts))], names[int(np.argmax(shifts))]
        share, f_n = 100 * np.expm1(np.ptp(shifts)), np.abs(self.poles[0, worst]) / (2 * np.pi)
        where = f"{share:.2g} %: all modes of {lowest} lie below those of {highest}"
        if not self.is_common:
            where = f"up to {share:.2g} %: the mode at {f_n:.4g} Hz of {lowest} lies below that of {highest}"
        message = (
            f"the references disagree in frequency by {where}. The structure changed between their "
            "recordings (temperature, supports, a shaker or sensors that load it). Each mode is fitted once, "
            f"at the mean, and intervals of f_n and k hold all references. {REMEDY}"
        )
        return Finding("moved-mode", message)


# What is taken to its mean.
Moved = tuple[MovedMode | MovedReferences, ...]


def align_references(
    done: Completed, names: Sequence[str], find_modes: Callable[[FrfLines], Poles]
) -> tuple[Completed, tuple[MovedReferences, ...], tuple[Finding, ...]]:
    """The modes of the FRFs at the mean frequencies of their references, called *names*, how these differ,
    and a warning; as they are where a residual of modes that differ in shape is noise.

    Every reference is fitted by itself, from the modes that *find_modes* finds; those of one shape are one
    mode. ln f_n over the mean of the references, weighted over the modes by its noise, differs from 0 by
    Student's t of the scatter between modes, or that of single modes beyond noise. Equation
    (modal-references).
    """
    refined, lines, at_means = done.refined, done.terms.lines, []
    if len(names) < 2 or (done.p_noise >= MISMATCH_P and not _alike(refined)):
        return done, (), ()
    for apart in _references_apart(lines, find_modes):
        change = apart.align(lines.omega, lines.leakage) * (lines.s**lines.power)[:, None, None]
        at_mean = replace(lines, matrix=lines.matrix + change)
        participation = np.linalg.svd(apart.residues.transpose(2, 1, 0), full_matrices=False)[2][:, 0]
        start = np.exp(np.mean(np.log(apart.poles) - apart.shifts, axis=0))
        again, terms, _ = kept_modes(*refine_with_terms(at_mean, start, participation))
        aligned = complete(again, terms, adding=True)
        # A pair is no single pole at any reference.
        worse = criterion(aligned.refined, aligned.terms) > criterion(refined, done.terms)
        # Factors of their own follow any misfit, of points that move as well.
        sound = apart.is_common or aligned.p_noise >= MISMATCH_P
        if sound and not worse and not _alike(aligned.refined):
            at_means.append((aligned, apart))
    if at_means:
        aligned, apart = max(at_means, key=lambda at_mean: at_mean[0].p_noise >= MISMATCH_P)
        return aligned, (apart,), (apart.finding(names),)
    alike = np.sort(np.abs(refined.poles[_alike(refined)])) / (2 * np.pi)
    message = (
        f"the modes at {', '.join(f'{f_n:.5g}' for f_n in alike)} Hz are fewer: several have one shape, yet "
        "act on the references in ways of their own, as where the structure changed between the recordings "
        f"of these. {REMEDY}"
    )
    return done, (), (Finding("moved-mode", message),) if alike.size >= LEAST_ALIKE else ()


def _alike(refined: Refined) -> list[int]:
    """Numbers of modes near one of the same shape that acts on the references in another way."""
    other = modal_assurance(refined.participation, refined.participation) < LIKE
    near = _distances(refined.poles, refined.shapes, refined.poles, refined.shapes) < MOST_APART
    return np.flatnonzero(np.any(other & near, axis=1)).tolist()


def _distances(
    poles: ComplexArray, shapes: ComplexArray, others: ComplexArray, their_shapes: ComplexArray
) -> FloatArray:
    """|ln| between the frequencies of modes (n_mode, n_other) [1] of one shape, 1 of others."""
    apart = np.abs(np.log(np.abs(poles[:, None] / others)))
    return np.where(modal_assurance(shapes.T, their_shapes.T) > LIKE, np.minimum(apart, 1.0), 1.0)


def _references_apart(lines: FrfLines, find_modes: Callable[[FrfLines], Poles]) -> list[MovedReferences]:
    """How references of *lines* differ: alike in all modes, and each mode by itself, beyond chance."""
    alone = []
    for reference in range(lines.matrix.shape[2]):
        frfs = replace(lines, matrix=lines.matrix[:, :, [reference]])
        try:
            start = find_modes(frfs)
            modes, terms, _ = kept_modes(*refine_with_terms(frfs, start.values, start.participation))
        except FitError:
            return []
        alone.append(complete(modes, terms, adding=True).refined)
    mode_poles, mode_shapes = alone[0].poles[:0], alone[0].shapes[:, :0]
    table = len(alone), sum(fit.poles.size for fit in alone)
    poles, weights = np.zeros(table, np.complex128), np.zeros(table)
    residues = np.zeros((table[0], len(mode_shapes), table[1]), np.complex128)
    for reference, fit in enumerate(alone):
        apart = _distances(fit.poles, fit.shapes, mode_poles, mode_shapes)
        rows, columns = scipy.optimize.linear_sum_assignment(apart)
        number, is_near = np.full(fit.poles.size, -1), apart[rows, columns] < MOST_APART
        number[rows[is_near]] = columns[is_near]
        is_new = number < 0
        number[is_new] = mode_poles.size + np.arange(np.count_nonzero(is_new))
        mode_poles = np.append(mode_poles, fit.poles[is_new])
        mode_shapes = np.hstack([mode_shapes, fit.shapes[:, is_new]])
        by_noise = lines.shared * np.diag(fit.covariance)[1 : 2 * fit.poles.size : 2]
        poles[reference, number], weights[reference, number] = fit.poles, np.abs(fit.poles) ** 2 / by_noise
        residues[reference][:, number] = fit.shapes * fit.participation.T
    n_mode = mode_poles.size
    poles, weights, residues = poles[:, :n_mode], weights[:, :n_mode], residues[..., :n_mode]
    n_shown, total = np.count_nonzero(poles, axis=0), np.sum(weights, axis=0)
    poles = np.where(poles == 0, np.sum(poles, axis=0) / n_shown, poles)
    logs = np.log(np.abs(poles))
    each = np.where(weights > 0, logs - np.sum(weights * logs, axis=0) / total, 0.0)
    shifts = [] if (common := _common_shifts(logs, weights)) is None else [common]
    if chi2_tail(float(np.sum(weights * each**2)), int(np.sum(n_shown - 1))) < DISAGREE:
        shifts.append((each, np.sqrt((1 - weights / total) / np.where(weights > 0, weights, np.inf))))
    return [MovedReferences(*of, poles, residues, lines.hysteretic) for of in shifts]


def _common_shifts(logs: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Shifts and their standard errors (n_reference, n_mode) [1], alike in all modes; None where they are
    chance. *logs*: ln of the frequencies, *weights* 1 over their variances, of that shape.
    """
    # A mode counts as its worst reference tells it.
    weight, away = np.min(weights, axis=0), logs - np.mean(logs, axis=0)
    if (n_mode := int(np.count_nonzero(weight))) < FEWEST_POINTS:
        return None
    shifts = np.average(away, axis=1, weights=weight)[:, None]
    scatter = np.average((away - shifts) ** 2, axis=1, weights=weight)[:, None] / (n_mode - 1)
    error = np.sqrt(np.maximum(scatter, 1 / np.sum(weight)))
    if np.max(np.abs(shifts) / error) < student_quantile(1 - DISAGREE / 2, n_mode - 1):
        return None
    return np.broadcast_to(shifts, logs.shape), np.broadcast_to(error, logs.shape)


def alignment(omega: FloatArray, leakage: Leakage | None, moved: Moved) -> ComplexArray | float:
    """What takes all points and references to the mean poles of *moved* modes, (n_line, n_point, n_reference)
    [unit of the FRF], at *omega* (n_line,) [rad/s] with the *leakage* of random data; 0 without any.
    """
    changes = [
        mode.align(omega, leakage) if isinstance(mode, MovedReferences) else mode.align(1j * omega)
        for mode in moved
        if isinstance(mode, MovedReferences) or not mode.instead
    ]
    return sum(changes, start=0.0)


def align_measured(measured: Measured, moved: Moved) -> Measured:
    """The FRFs with every point and reference at the mean poles of the *moved* modes."""
    return replace(measured, matrix=measured.matrix + alignment(measured.omega, measured.leakage, moved))


def add_moved_modes(
    done: Completed, *, moving: bool
) -> tuple[Completed, tuple[MovedMode, ...], tuple[Finding, ...]]:
    """The modes of the FRFs with every point moved to the mean pole of its mode, how these moved, and notes
    on poles that are one; as they are where none does. Modes that may stand *instead* of several poles come
    with how these moved, but nothing is moved by them.

    Poles nearer than two half-power widths are fitted as one pole per point, and as two common ones. One mode
    where BIC = sum over the FRFs of 2 n ln(residual) + p ln(2 n n_frf) is for it, where a pole of the two
    leaves the others or is broad, or where both are alike at the references and nearer than a half-power
    width. What moves one mode moves all; *moving*: it is known that something does. Equation (modal-moved).
    """
    refined, lines = done.refined, done.terms.lines
    if lines.hysteretic or lines.matrix.shape[1] < FEWEST_POINTS or np.any(refined.poles.real >= 0):
        return done, (), ()
    judged = [pair for chain in _chains(refined) for pair in _move(done, chain, moving)]
    merging = [(chain, mode) for chain, mode in judged if not mode.instead]
    undecided = tuple(mode for _, mode in judged if mode.instead)
    if not merging and not (moving and done.p_noise < MISMATCH_P):
        return done, undecided, ()
    findings = tuple(mode.finding for _, mode in merging)
    merged = {number for chain, _ in merging for number in chain}
    for number in set(range(refined.poles.size)) - merged:
        s, frfs = _fit_alone(done, [number])
        if s.size >= FEWEST_LINES:
            merging.append(([number], _fit_by_points(s, frfs, refined.poles[[number]])[0]))
            merged.add(number)
    moved = tuple(mode for _, mode in merging)
    rest = np.setdiff1d(np.arange(refined.poles.size), list(merged))
    poles = np.concatenate([refined.poles[rest], [mode.pole for mode in moved]])
    participation = np.vstack([refined.participation[rest], [mode.reference for mode in moved]])
    change = alignment(lines.omega, None, moved) * (lines.s**lines.power)[:, None, None]
    lines = replace(lines, matrix=lines.matrix + change)
    again, terms = refine_with_terms(lines, poles, participation)
    frequency = np.abs(again.poles)
    if not again.converged or frequency.min() < lines.omega[0] or frequency.max() > lines.omega[-1]:
        return done, undecided, ()
    return replace(done, refined=again, terms=terms), (*moved, *undecided), findings


def _chains(refined: Refined) -> list[list[int]]:
    order = np.argsort(refined.poles.imag).tolist()
    # Half-power width over frequency, 2 zeta.
    relative = float(np.median(-2 * refined.poles.real / np.abs(refined.poles)))
    chains = [[order[0]]]
    for number in order[1:]:
        width = relative * refined.poles.imag[number]
        first, last = refined.poles.imag[[chains[-1][0], chains[-1][-1]]]
        at = refined.poles.imag[number]
        if at - last < NEXT * width and at - first < FARTHEST * width:
            chains[-1].append(number)
        else:
            chains.append([number])
    return chains


def _move(done: Completed, chain: list[int], moving: bool) -> list[tuple[list[int], MovedMode]]:
    if len(chain) < 2:
        return []
    s, frfs = _fit_alone(done, chain)
    if s.size < FEWEST_LINES:
        return []
    mode = _fit_one_mode(s, frfs, done.refined.poles[chain], moving)
    if mode is not None and not mode.instead:
        return [(chain, mode)]
    middle = len(chain) // 2
    return [
        *([] if mode is None else [(chain, mode)]),
        *_move(done, chain[:middle], moving),
        *_move(done, chain[middle:], moving),
    ]


def _fit_alone(done: Completed, chain: list[int]) -> tuple[ComplexArray, ComplexArray]:
    """Lines s (n_line,) [rad/s] around the *chain*, and their receptance without other modes, conjugate poles
    and, where the fit of all leaves noise, residual terms: these reach across a broad mode, but hold parts of
    peaks that it does not follow.
    """
    refined, lines = done.refined, done.terms.lines
    poles = refined.poles[chain]
    reach = BESIDE * float(np.median(-2 * poles.real))
    near, first, last = np.delete(refined.poles.imag, chain), poles.imag.min(), poles.imag.max()
    # Cut halfway to the neighbours.
    low = max(first - reach, (near[near < first].max(initial=-np.inf) + first) / 2)
    high = min(last + reach, (near[near > last].min(initial=np.inf) + last) / 2)
    chosen = (lines.omega >= low) & (lines.omega <= high)
    s = lines.s[chosen]
    residues = np.einsum("om,mi->moi", refined.shapes, refined.participation)
    (a, b), _ = pole_functions(s, refined.poles, hysteretic=False)
    factor = (s**lines.power)[:, None, None]
    if done.p_noise >= MISMATCH_P:
        left = remaining(done.terms, refined)[chosen] / (factor * lines.weight[chosen, None, None])
    else:
        left = (
            lines.matrix[chosen] / factor - np.tensordot(a, residues, 1) - np.tensordot(b, residues.conj(), 1)
        )
    return s, left + np.tensordot(a[:, chain], residues[chain], 1)


def _solve(s: ComplexArray, frfs: ComplexArray, poles: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Residues (n_pole, n) and what poles with a constant and a slope leave of *frfs* (n_line, n)."""
    x = np.linspace(-1, 1, s.size)
    columns = np.column_stack([1 / (s[:, None] - poles), np.ones_like(x), x])
    amounts = np.linalg.lstsq(columns, frfs, rcond=None)[0]
    return amounts[: poles.size], frfs - columns @ amounts


def _squares(left: ComplexArray) -> FloatArray:
    return np.maximum(np.sum(np.abs(left) ** 2, axis=0), np.finfo(float).tiny)


def _excess(left: ComplexArray) -> float:
    """Squares of what is *left* (n_line, n) over those of noise, by its differences from line to line: of a
    peak a few lines wide the differences of neighbours are no noise.
    """
    noise = np.sum(np.abs(np.diff(left, 2, axis=0)) ** 2, axis=0) / 6
    return float(np.mean(_squares(left) / noise) * (1 - 2 / len(left)))


def _best(s: ComplexArray, frfs: ComplexArray, start: ComplexArray) -> ComplexArray:
    """The poles (n_pole,) [rad/s] common to *frfs* (n_line, n) of least 2 n_line mean ln(squares)."""
    unit = float(np.median(-start.real))

    def poles(moves: FloatArray) -> ComplexArray:
        decay, frequency = moves.reshape(2, -1)
        return start.real * np.exp(decay) + 1j * (start.imag + unit * frequency)

    def cost(moves: FloatArray) -> tuple[float, FloatArray]:
        """With its slopes: what is left is orthogonal to the columns, so amounts need not move with poles."""
        now = poles(moves)
        amounts, left = _solve(s, frfs, now)
        squares = _squares(left)
        turned = np.einsum("lp,ln,pn,n->p", (s[:, None] - now) ** -2, left.conj(), amounts, 1 / squares)
        slopes = -2 * np.concatenate([(turned * now.real).real, (1j * unit * turned).real])
        scale = 2 * s.size / frfs.shape[1]
        return scale * float(np.sum(np.log(squares))), scale * slopes

    # A first step too long would leave no number.
    bounds = [(-MOST_MOVED, MOST_MOVED)] * start.size + [(None, None)] * start.size
    best = scipy.optimize.minimize(cost, np.zeros(2 * start.size), jac=True, method="L-BFGS-B", bounds=bounds)
    return poles(best.x)


def _fit_by_points(s: ComplexArray, frfs: ComplexArray, chain: ComplexArray) -> tuple[MovedMode, FloatArray]:
    start = np.array([np.mean(chain.real) + 1j * np.mean(chain.imag)])
    point_poles = [_best(s, frfs[:, point], start) for point in range(frfs.shape[1])]
    solved = [_solve(s, frfs[:, point], pole) for point, pole in enumerate(point_poles)]
    mode = MovedMode(np.array(point_poles)[:, 0], np.array([amounts[0] for amounts, _ in solved]))
    return mode, np.array([_squares(left) for _, left in solved])


def _squares_in_proportion(s: ComplexArray, frfs: ComplexArray, mode: MovedMode) -> FloatArray:
    """Squares (n_point, n_reference) of what the poles of all points leave with residues in proportion to the
    *mode's* participation.
    """
    squares, participation = [], mode.reference
    for point, pole in enumerate(mode.poles):
        _, left = _solve(s, np.column_stack([1 / (s - pole), frfs[:, point]]), np.empty(0, np.complex128))
        along = left[:, 0].conj() @ left[:, 1:] / np.sum(np.abs(left[:, 0]) ** 2)
        residues = (along @ participation.conj()) * participation
        squares.append(_squares(left[:, 1:] - np.outer(left[:, 0], residues)))
    return np.array(squares)


def _fit_one_mode(s: ComplexArray, frfs: ComplexArray, chain: ComplexArray, moving: bool) -> MovedMode | None:
    """The chain as one mode with a pole per point, *instead* of two where one reference cannot tell, or None
    where it is two.
    """
    n_line, n_point, n_reference = frfs.shape
    moved, squares = _fit_by_points(s, frfs, chain)
    flat, n_entry = frfs.reshape(n_line, -1), n_point * n_reference
    # What moves acts on the references in one proportion at all points, but for what a known mass turns modes
    # into each other; modes on one place do not; one reference is in proportion, but for rounding.
    apart = 2 * n_line * float(np.sum(np.log(_squares_in_proportion(s, frfs, moved)) - np.log(squares)))
    limit = np.log(2 * n_line * n_entry) * 2 * (n_point - 1) * (n_reference - 1)
    if n_reference > 1 and not moving and apart > limit:
        return None

    def compare(poles: ComplexArray) -> tuple[float, ComplexArray, ComplexArray]:
        """BIC of one mode less that of common *poles*, their residues, and what they leave."""
        amounts, left = _solve(s, flat, poles)
        difference = 2 * n_line * (np.sum(np.log(squares)) - np.sum(np.log(_squares(left))))
        more = 2 * (1 - poles.size) * n_entry + 2 * (n_point - poles.size)
        return float(difference + np.log(2 * n_line * n_entry) * more), amounts, left

    if chain.size > 2:
        # Three modes and more in a cluster: no two poles are these.
        difference, _, left = compare(_best(s, flat, chain))
        if difference >= 0 and _excess(left) < AS_NOISE:
            return None
    pair = _best(s, flat, chain[np.argsort(chain.imag)[[0, -1]]])
    difference, amounts, left = compare(pair)
    width = -2 * moved.pole.real
    out = (pair.imag < chain.imag.min() - width) | (pair.imag > chain.imag.max() + width)
    if difference < 0 or np.any(out | (-2 * pair.real > BROADER * width)):
        return moved
    if _excess(left) < AS_NOISE:
        # Two poles that are the same at all points leave noise: that is a pair.
        return None
    if n_reference == 1:
        return replace(moved, instead=tuple(chain.tolist()))
    a, b = amounts.reshape(2, n_point, n_reference)
    sizes = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    like = float(np.sum(np.abs(np.sum(a.conj() * b, axis=1))) / np.sum(sizes))
    if like > LIKE and abs(pair.imag[0] - pair.imag[1]) < width:
        return replace(moved, also=tuple(float(f) for f in np.sort(np.abs(pair)) / (2 * np.pi)))
    return None


def mean_of_points(
    seen: list[int], values: FloatArray, errors: FloatArray
) -> dict[str, tuple[float, float, float]]:
    """Mean and ends of ln f_n and ln zeta over the points, where these disagree in one of them beyond noise:
    what moves from point to point loads it, and smears the damping of all points together.

    mean +- t s sqrt(1 + 1/n), for another point; of the points *seen*, *values* (n, 2) with *errors* (n, 2)
    [1] by noise.
    """
    n = len(seen)
    if n < FEWEST_POINTS:
        return {}
    weights = errors**-2.0
    scatter = np.sum(weights * (values - np.average(values, axis=0, weights=weights)) ** 2, axis=0)
    if chi2_tail(float(np.max(scatter)), n - 1) >= DISAGREE:
        return {}
    return dict(zip(("f_n", "zeta"), _of_another(values), strict=True))


def _of_another(values: FloatArray) -> list[tuple[float, float, float]]:
    """mean, mean -+ t s sqrt(1 + 1/n) of the columns of *values* (n, n_column) [1]."""
    n, mean = len(values), np.mean(values, axis=0)
    reach = student_quantile(0.975, n - 1) * np.std(values, axis=0, ddof=1) * np.sqrt(1 + 1 / n)
    return list(zip(mean.tolist(), (mean - reach).tolist(), (mean + reach).tolist(), strict=True))


def unloaded_values(
    seen: list[int], values: FloatArray, errors: FloatArray, shape: ComplexArray
) -> dict[str, tuple[float, float, float]]:
    """Mean and ends of ln f_n and ln zeta where the mode does not move, phi^2 = 0: a mass there changes
    nothing.

    The points *seen* are repeats, *values* (n, 2) with *errors* (n, 2) [1], and phi^2 of the *shape*
    (n_point,) [1] their covariate. Empty where too few see the mode. Equation (modal-unloaded).
    """
    square = np.abs(shape[seen]) ** 2 / np.max(np.abs(shape) ** 2)
    if len(seen) <= FEWEST_POINTS:
        return {}
    scales = (PRIOR_SCALE * float(np.exp(np.median(values[:, 1]))), PRIOR_SCALE)
    pieces = {}
    for place, name in enumerate(("f_n", "zeta")):
        mean = repeat_mean(values[:, place], errors[:, place] ** 2, scales[place], square)
        pieces[name] = (mean.value, mean.value - mean.half_width, mean.value + mean.half_width)
    return pieces
