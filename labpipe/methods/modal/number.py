"""How many modes and residual terms the data ask for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.modal.likelihood import Lines, Refined, ResidualTerms, refine, remaining
from labpipe.methods.modal.poles import similarity

LAGS = 8
# Lines whose residuals tell the noise of the one in their middle.
AROUND = 31


@dataclass(frozen=True)
class LineNoise:
    """The noise along the lines: correlation (n,) [1] with the next lines that a window gives it, and 1 + 2
    sum of their squares.
    """

    correlation: tuple[complex, ...] = ()

    @property
    def shared_power(self) -> float:
        return 1.0 + 2 * sum(abs(value) ** 2 for value in self.correlation)


def whiteness(residual: ComplexArray, noise: LineNoise) -> float:
    """Probability [1] of so much likeness of neighbouring lines in noise: the least p-value of the elements,
    times their number.

    residual (n_line, n_output, n_input): r_d = sum e_k+d conj(e_k) / sum |e|^2 of circular white noise has
    the variance 1 / n_line, so that 2 n_line sum |r_d|^2 over d = 1 ... 8 is chi-square with 16 degrees of
    freedom (portmanteau test of Box and Pierce 1970, complex form). Equation (modal-whiteness).
    """
    n_line = residual.shape[0]
    flat = _even(residual.reshape(n_line, -1))
    power = np.sum(np.abs(flat) ** 2, axis=0)
    lags = range(1, min(LAGS, n_line - 1) + 1)
    expected = [*noise.correlation, *([0.0] * LAGS)]
    likeness = [np.sum(flat[d:] * flat[:-d].conj(), axis=0) / power - expected[d - 1] for d in lags]
    statistic = 2 * n_line / noise.shared_power * np.sum(np.abs(likeness) ** 2, axis=0)
    least = chi2_tail(float(np.max(statistic)), 2 * len(lags))
    return min(1.0, least * statistic.size)


def _even(flat: ComplexArray) -> ComplexArray:
    """Residuals (n_line, n) relative to the root mean square of the AROUND lines about each."""
    kernel = np.ones(min(AROUND, flat.shape[0]))
    counts = np.convolve(np.ones(flat.shape[0]), kernel, mode="same")
    around = (
        np.stack([np.convolve(column, kernel, mode="same") for column in (np.abs(flat) ** 2).T], axis=1)
        / counts[:, None]
    )
    return np.asarray(flat / np.sqrt(np.maximum(around, np.finfo(float).tiny)))


def loudest_line(residual: ComplexArray, noise: FloatArray, width: int) -> int:
    """The line around which the residual (n_line, n_output, n_input) [unit of the FRF] is largest over
    *width* lines.

    It is taken relative to its noise (n_output, n_input) [square of the FRF's unit].
    """
    scaled = (residual / np.sqrt(noise)).reshape(residual.shape[0], -1)
    kernel = np.ones(max(width, 1))
    summed = np.stack([np.convolve(column, kernel, mode="same") for column in scaled.T])
    return int(np.argmax(np.sum(np.abs(summed) ** 2, axis=0)))


# Number of residual terms by the information criterion, grown one term at a time from the refined modes.

MOST_LOWER, MOST_UPPER = 3, 8
# Steps of a trial: the modes move little by one term more.
TRIAL_STEPS = 1


def refine_with_terms(
    lines: Lines, poles: ComplexArray, participation: ComplexArray
) -> tuple[Refined, ResidualTerms]:
    """The refined modes and the residual terms of least AIC = 2 n_line sum ln(residual) + 2 parameters.

    *poles* (n_mode,) [rad/s], *participation* (n_mode, n_input) [1].
    """
    terms = ResidualTerms(lines, 1, 1)
    best = refine(lines, terms, poles, participation, TRIAL_STEPS)
    while True:
        trials = [
            (refine(lines, more, best.poles, best.participation, TRIAL_STEPS), more)
            for more in _larger(terms)
            if more.count + 2 * poles.size < lines.omega.size
        ]
        if not trials:
            break
        refined, more = min(trials, key=lambda trial: criterion(lines, *trial))
        if criterion(lines, refined, more) >= criterion(lines, best, terms):
            break
        best, terms = refined, more
    return refine(lines, terms, best.poles, best.participation), terms


def criterion(lines: Lines, refined: Refined, terms: ResidualTerms) -> float:
    """AIC [1]: a term has a complex factor in every FRF; a mode a pole, a shape, and a participation of which
    one entry is given.

    Equation (modal-aic).
    """
    _, n_output, n_input = lines.matrix.shape
    n_complex = lines.n_element * terms.count + refined.poles.size * (n_output + n_input)
    return refined.information + 4 * n_complex


def _larger(terms: ResidualTerms) -> list[ResidualTerms]:
    sizes = [(terms.lower + 1, terms.upper), (terms.lower, terms.upper + 1)]
    return [
        ResidualTerms(terms.lines, lower, upper)
        for lower, upper in sizes
        if lower <= MOST_LOWER and upper <= MOST_UPPER
    ]


MOST_ADDED = 4
# Least decrease of AIC that a mode is added for (Burnham and Anderson 2002, sec. 2.6).
SUPPORT = 10.0
# Least decay rate as part of the distance of the lines: a sharper peak is the noise of one line.
SHARPEST = 0.01
# Largest half-power width as part of the band: a broader mode is what the residual terms are, a smooth curve.
BROADEST = 0.5
# Two poles of like participation closer than this part of their decay rate are one pole that differs from
# point to point.
DISTINCT, ALIKE = 0.25, 0.9
# Probability by noise alone below which a mode counts as seen.
SEEN_P = 1e-3


@dataclass(frozen=True)
class Completed:
    """Refined modes with the terms of their residual, the probability of that residual as noise, and the
    number of modes added.
    """

    refined: Refined
    terms: ResidualTerms
    p_noise: float
    added: int = 0


def kept_modes(
    lines: Lines, refined: Refined, terms: ResidualTerms
) -> tuple[Refined, ResidualTerms, tuple[str, ...]]:
    """The modes inside the band, not as broad as it, that stand out of the noise, refined again without the
    others; notes name these.

    FitError where none stays.
    """
    frequency = np.abs(refined.poles)
    inside, narrow, seen = _inside(lines, refined), _narrow(lines, refined), _seen(lines, refined)
    keep = inside & narrow & seen
    if np.all(keep):
        return refined, terms, ()
    notes = []
    for chosen, why in (
        (~inside, "left the band in the refinement"),
        (inside & ~narrow, "is as broad as the band, which no mode can be told by"),
        (inside & narrow & ~seen, "does not stand out of the noise"),
    ):
        if np.any(chosen):
            notes.append(
                "modal: the pole at "
                f"{', '.join(f'{value / (2 * np.pi):.4g}' for value in frequency[chosen])} Hz {why}."
            )
    if not np.any(keep):
        raise FitError(
            f"no mode stays in the refinement: {' '.join(notes)}",
            hint="widen the band to where the response peaks",
        )
    again, more = refine_with_terms(lines, refined.poles[keep], refined.participation[keep])
    again, more, further = kept_modes(lines, again, more)
    return again, more, (*notes, *further)


def _inside(lines: Lines, refined: Refined) -> BoolArray:
    """The modes inside the band, (n_mode,)."""
    frequency = np.abs(refined.poles)
    return (frequency >= lines.omega[0]) & (frequency <= lines.omega[-1])


def _narrow(lines: Lines, refined: Refined) -> BoolArray:
    """The modes narrower than the band, (n_mode,): half-power width -2 Re lambda."""
    return -2 * refined.poles.real < BROADEST * (lines.omega[-1] - lines.omega[0])


def _seen(lines: Lines, refined: Refined) -> BoolArray:
    """The modes that noise does not explain, (n_mode,)."""
    spacing = float(np.mean(np.diff(lines.omega)))
    return (shape_p(refined) < SEEN_P) & (-refined.poles.real > SHARPEST * spacing)


def shape_p(refined: Refined) -> FloatArray:
    """Probability (n_mode,) [1] of so large a shape by noise alone: chi-square of its points, of 2 degrees of
    freedom each.

    Equation (modal-seen).
    """
    probabilities = []
    for mode in range(refined.poles.size):
        block = slice(2 * mode, 2 * mode + 2)
        psi = np.stack([refined.shapes[:, mode].real, refined.shapes[:, mode].imag], axis=-1)
        inverse = np.linalg.pinv(refined.shape_covariance[:, block, block])
        probabilities.append(chi2_tail(float(np.einsum("oi,oij,oj->", psi, inverse, psi)), 2 * psi.shape[0]))
    return np.array(probabilities)


def completed(
    lines: Lines, refined: Refined, terms: ResidualTerms, noise: LineNoise, *, adding: bool
) -> Completed:
    """The modes and, where *adding*, those that the residual asks for, one at a time, as long as AIC supports
    them.

    They are kept only if the residual then is noise.
    """
    first = done = Completed(refined, terms, whiteness(remaining(lines, terms, refined), noise))
    while adding and done.p_noise < MISMATCH_P and done.added < MOST_ADDED:
        more = _with_one_more(lines, done, noise)
        if more is None:
            break
        done = more
    return done if done.p_noise >= MISMATCH_P else first


def with_real_modes(lines: Lines, done: Completed, noise: LineNoise) -> Completed:
    """The same modes with real shapes and participation, and the probability of the residual that they leave
    as noise.
    """
    refined = refine(lines, done.terms, done.refined.poles, done.refined.participation, real=True)
    return replace(done, refined=refined, p_noise=whiteness(remaining(lines, done.terms, refined), noise))


def _with_one_more(lines: Lines, done: Completed, noise: LineNoise) -> Completed | None:
    """With a mode where the residual is loudest."""
    refined = done.refined
    residual = remaining(lines, done.terms, refined)
    spacing = float(np.mean(np.diff(lines.omega)))
    decay = float(np.median(-refined.poles.real))
    line = loudest_line(residual, refined.noise, round(2 * decay / spacing))
    near = int(np.argmin(np.abs(refined.poles.imag - lines.omega[line])))
    pole = refined.poles.real[near] + 1j * lines.omega[line]
    if abs(pole - refined.poles[near]) < decay / 2:
        # On top of a mode: the two begin on either side of the place.
        pole += 1j * decay
    width = max(3, round(2 * decay / spacing))
    part = residual[max(0, line - width) : line + width + 1] / np.sqrt(refined.noise)
    participation = np.asarray(np.linalg.svd(part.reshape(-1, residual.shape[2]), full_matrices=False)[2][0])
    poles = np.append(refined.poles, pole)
    again, terms = refine_with_terms(lines, poles, np.vstack([refined.participation, participation]))
    sound = (
        again.converged
        and _distinct(again)
        and np.all(_inside(lines, again) & _narrow(lines, again) & _seen(lines, again))
    )
    if not sound or criterion(lines, again, terms) > criterion(lines, refined, done.terms) - SUPPORT:
        return None
    return Completed(again, terms, whiteness(remaining(lines, terms, again), noise), done.added + 1)


def _distinct(refined: Refined) -> bool:
    """Whether no two modes are one: R / (s - lambda - d_o) with d_o of the points looks like two poles close
    to lambda.
    """
    apart = np.abs(refined.poles[:, None] - refined.poles) / np.abs(refined.poles.real)
    is_same = (apart < DISTINCT) & (similarity(refined.participation, refined.participation) > ALIKE)
    return bool(np.count_nonzero(is_same) == refined.poles.size)
