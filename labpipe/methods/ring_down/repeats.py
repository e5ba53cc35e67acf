"""The modes of several decays as repeats: each decay is fitted alone, and the values are their means with the
part between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.repeats import (
    PRIOR_SCALE,
    Kept,
    RepeatMean,
    follows,
    groups_of,
    groups_text,
    kept_repeats,
    mean_of_groups,
    repeat_mean,
)
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import restate, student_limit
from labpipe.methods.ring_down.likelihood import Decayed, Piece, most_likely, noise_chance
from labpipe.records.finding import Finding, IntervalParts, Parameter, Repeats, note
from labpipe.records.spectra import FreeDecays

# Powers of f and zeta in the quantities of a mode.
POWERS = {"f_n": (1, 0), "zeta": (0, 1), "log_decrement": (0, 1), "k": (2, 0), "c": (1, 1)}


def quantity_name(quantity: str, mode: int, n_mode: int) -> str:
    """The name of a quantity of a mode, from 0; of a single mode k and c have no number."""
    return quantity if n_mode == 1 and quantity in ("k", "c") else f"{quantity}_{mode + 1}"


def powers_of(name: str, zeta: float) -> tuple[float, float]:
    """Slopes of the logarithm of a quantity over ln f and ln zeta: those of POWERS, but that of the
    logarithmic decrement 2 pi zeta / sqrt(1 - zeta^2) is 1 / (1 - zeta^2).
    """
    of_f, of_zeta = POWERS[name]
    return of_f, of_zeta / (1 - zeta**2) if name == "log_decrement" else of_zeta


@dataclass(frozen=True)
class RepeatedDecays:
    """Decays that were fitted alone: their *numbers*, *fits* of one decay each, and those that could not be,
    in words. *kept*: which of the fits are used; *means*: of ln f and ln zeta of every mode; *at*: the
    amplitude (n_mode,) [unit] at which the values hold where they follow it, nan elsewhere, in the *outputs*
    (n_mode,) that stand out of their noise most; the *groups*, if any, that are the repeats.
    """

    total: int
    numbers: tuple[int, ...]
    fits: tuple[Decayed, ...]
    failed: tuple[Finding, ...]
    kept: Kept
    means: tuple[tuple[RepeatMean, RepeatMean], ...]
    at: FloatArray
    outputs: IntArray
    groups: tuple[str, ...] = ()

    @property
    def places(self) -> IntArray:
        """Numbers (n_used,) of the decays that are used."""
        return np.array(self.numbers)[self.kept.used]

    @property
    def joined(self) -> Decayed:
        """The used decays as one fit in which each has its own poles; those of the fit are of the means."""
        used = [fit for fit, is_used in zip(self.fits, self.kept.used, strict=True) if is_used]
        f, zeta = (np.exp([pair[which].value for pair in self.means]) for which in (0, 1))
        poles = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - np.minimum(zeta, 1.0) ** 2))
        return Decayed(
            poles,
            np.sum([fit.covariance for fit in used], axis=0) / len(used) ** 2,
            np.concatenate([fit.variance for fit in used]),
            sum(fit.dof for fit in used),
            tuple(fit.pieces[0] for fit in used),
            True,
            max(fit.steps for fit in used),
            np.array([fit.poles for fit in used]),
        )


def repeated_decays(
    decays: FreeDecays, columns: Sequence[int], pieces: Sequence[Piece], settings: FitSettings, n_mode: int
) -> RepeatedDecays | None:
    """Every decay fitted alone in the band of the *settings*, and the means over decays, or over groups of
    recordings. None where fewer than two can be, or one mode does not decay in most of them.
    """
    fits: dict[int, Decayed] = {}
    failed = []
    for number, (decay, piece) in enumerate(zip(decays.decays, pieces, strict=True)):
        try:
            fitted = most_likely([decay], columns, [piece], decays.sample_rate, settings.band, n_mode)
            if not fitted.converged:
                raise FitError("its fit does not converge")
            if np.any(fitted.poles.real >= 0):
                raise FitError("it does not decay")
            if np.any(noise_chance([piece], fitted) > MISMATCH_P):
                raise FitError("a mode of it is noise")
            fits[number] = fitted
        except FitError as error:
            where = f"decay {number + 1} of {len(pieces)} ('{decay.recording}', {decay.start:.3f} s)"
            failed.append(note("repeat-left-out", f"{where} is left out: {error.what}"))
    if len(fits) < max(2, len(pieces) / 2):
        return None
    numbers, of_decays = tuple(fits), tuple(fits.values())
    logs, variances = (
        np.array(parts) for parts in zip(*(_logarithms(fit) for fit in of_decays), strict=True)
    )
    recordings = [decays.decays[number].recording for number in numbers]
    groups = groups_of(settings.repeat_groups, recordings) if settings.repeat_groups else ()
    kept = kept_repeats(logs, variances, groups=groups)
    used = kept.used
    groups = tuple(group for group, is_used in zip(groups, used, strict=False) if is_used)
    sizes = np.array([np.abs(fit.pieces[0].amplitudes) for fit in of_decays])[used]
    noise = np.array([fit.variance for fit in of_decays])[used]
    outputs = np.argmax(np.mean(sizes**2 / noise, axis=0), axis=1)
    means, at = [], np.full(n_mode, np.nan)
    for mode in range(n_mode):
        of_mode = [mode, n_mode + mode]
        size = sizes[:, mode, outputs[mode]]
        pair, at[mode] = _means(logs[used][:, of_mode], variances[used][:, of_mode], size, groups)
        means.append(pair)
    left_out = (*failed, *_outliers(decays, numbers, kept, logs, n_mode))
    total, named = len(pieces), settings.repeat_groups
    return RepeatedDecays(total, numbers, of_decays, left_out, kept, tuple(means), at, outputs, named)


def _logarithms(fitted: Decayed) -> tuple[FloatArray, FloatArray]:
    """ln f and ln zeta of all modes, (2 n_mode,), and their variances by the noise alone."""
    sizes = np.abs(fitted.poles)
    zeta = -fitted.poles.real / sizes
    variances = []
    for number, (pole, size) in enumerate(zip(fitted.poles, sizes, strict=True)):
        block = fitted.covariance[2 * number : 2 * number + 2, 2 * number : 2 * number + 2]
        of_f = np.array([pole.real, pole.imag]) / size**2
        of_zeta = np.array([1 / pole.real, 0.0]) - of_f
        variances.append([gradient @ block @ gradient for gradient in (of_f, of_zeta)])
    return np.concatenate([np.log(sizes / (2 * np.pi)), np.log(zeta)]), np.array(variances).T.ravel()


def _means(
    logs: FloatArray, variances: FloatArray, sizes: FloatArray, groups: Sequence[str]
) -> tuple[tuple[RepeatMean, RepeatMean], float]:
    scales = (PRIOR_SCALE * float(np.exp(np.median(logs[:, 1]))), PRIOR_SCALE)
    both = list(zip(logs.T, variances.T, scales, strict=True))
    if len(set(groups)) > 1:
        frequency, damping = (mean_of_groups(x, variance, groups, scale) for x, variance, scale in both)
        return (frequency, damping), np.nan
    middle = float(np.median(sizes))
    covariate = (sizes - middle) / middle
    is_course = any(follows(x, variance, covariate) for x, variance, _ in both)
    chosen = covariate if is_course else None
    frequency, damping = (repeat_mean(x, variance, scale, chosen) for x, variance, scale in both)
    return (frequency, damping), middle if is_course else np.nan


def _outliers(
    decays: FreeDecays, numbers: Sequence[int], kept: Kept, logs: FloatArray, n_mode: int
) -> list[Finding]:
    if kept.two_populations:
        message = (
            "more than a quarter of the decays, or the first or last ones, lie apart: two populations, and "
            "the mean is of both. Name the groups (repeat_groups)"
        )
        return [Finding("two-populations", message)]
    findings = []
    for place in np.flatnonzero(~kept.used).tolist():
        decay = decays.decays[numbers[place]]
        modes = np.exp(logs[place].reshape(2, n_mode)).T
        values = ", ".join(f"{frequency:.6g} Hz and {ratio:.3g}" for frequency, ratio in modes)
        where = f"decay {numbers[place] + 1} ('{decay.recording}', {decay.start:.3f} s)"
        what = f"{where} is left out: its frequency and damping ratio, {values}, stand out"
        findings.append(note("repeat-left-out", what))
    return findings


def drift_findings(repeated: RepeatedDecays) -> list[Finding]:
    """A note where neighbours in time are alike."""
    pairs = enumerate(repeated.means, start=1)
    modes = [str(number) for number, (f_n, zeta) in pairs if f_n.ordered or zeta.ordered]
    if not modes:
        return []
    message = (
        f"mode {', '.join(modes)}: the values of neighbouring decays are alike, so they drift or come in "
        "steps (temperature, mounting). The interval allows for it; record them in groups, or what changes"
    )
    return [note("repeats-in-order", message)]


def with_repeats(
    parameters: Sequence[Parameter], repeated: RepeatedDecays, dof: int, mass: float | None
) -> tuple[Parameter, ...]:
    """The parameters of the modes as means of the decays, each with its 95 % interval, its repeats and their
    spread. ln f and ln zeta have a mean and an interval; ln delta = ln zeta / (1 - zeta^2) + ..., ln k = 2 ln
    f + ..., ln c = ln f + ln zeta + ... follow. The standard error stays that of noise alone. *dof* of the
    fit, *mass* [kg] of k and c. Equation (repeats-mean).
    """
    entries: dict[str, Parameter] = {}
    n_mode = len(repeated.means)
    by_name = {parameter.name: parameter for parameter in parameters}
    logs = np.array([_logarithms(fit)[0] for fit in repeated.fits])
    noise = np.array([_logarithms(fit)[1] for fit in repeated.fits])[repeated.kept.used]
    for mode, pair in enumerate(repeated.means):
        of_mode = [mode, n_mode + mode]
        means = np.array([mean.value for mean in pair])
        f, zeta = np.exp(means).tolist()
        stated = {"f_n": f, "zeta": zeta, "log_decrement": 2 * np.pi * zeta / float(np.sqrt(1 - zeta**2))}
        if mass is not None:
            stated |= {"k": mass * (2 * np.pi * f) ** 2, "c": 4 * np.pi * mass * f * zeta}
        errors = np.sqrt([mean.weights**2 @ noise[:, of] for of, mean in zip(of_mode, pair, strict=True)])
        for quantity, value in stated.items():
            name = quantity_name(quantity, mode, n_mode)
            powers = np.array(powers_of(quantity, zeta))
            values = value * np.exp((logs[:, of_mode] - means) @ powers)
            law = (powers, value, repeated.at[mode])
            entries[name] = _parameter(by_name[name], pair, law, values, errors, repeated, dof)
    return tuple(entries.get(parameter.name, parameter) for parameter in parameters)


def _parameter(
    parameter: Parameter,
    pair: tuple[RepeatMean, RepeatMean],
    law: tuple[FloatArray, float, float],
    values: FloatArray,
    errors: FloatArray,
    repeated: RepeatedDecays,
    dof: int,
) -> Parameter:
    """A quantity by two means, with its interval by both; *law*: powers (p, q) of f^p zeta^q, the value, and
    the amplitude it holds at or nan; *values* (n_decay,) of the single decays, *errors* (2,) of the means'
    logarithms.
    """
    powers, value, at = law
    reach = float(np.hypot(*(powers * [mean.half_width for mean in pair])))
    error = value * float(np.hypot(*(powers * errors)))
    used = tuple(bool(is_used) for is_used in repeated.kept.used)
    limit, spread = student_limit(dof), value * float(np.hypot(*(powers * [mean.spread for mean in pair])))
    interval = (value * float(np.exp(-reach)), value * float(np.exp(reach)))
    half = value * reach
    for end in (0, -1):
        # A first or last decay that is left out may be of another state.
        if not used[end] and not repeated.groups:
            other = float(values[end])
            interval = (min(interval[0], other - limit * spread), max(interval[1], other + limit * spread))
            half = max(half, (interval[1] - interval[0]) / 2)
    follows = bool(np.isfinite(at))
    full = half / limit
    repeats = Repeats(
        n=repeated.total,
        used=sum(used),
        spread=spread,
        values=tuple(values[repeated.kept.used].tolist()),
        covariate="amplitude" if follows else "",
        at=float(at) if follows else None,
        groups=len(repeated.groups),
    )
    parts = IntervalParts(error, repeats=float(np.sqrt(max(full**2 - error**2, 0.0))))
    return restate(parameter, value, full, interval, std_error=error, interval=parts, repeats=repeats)


def repeat_notes(repeated: RepeatedDecays, units: Sequence[str]) -> tuple[str, ...]:
    """How many decays the values are the mean of, and what they scatter by."""
    used = int(np.count_nonzero(repeated.kept.used))
    over = f"{used} decays" if used == repeated.total else f"{used} of {repeated.total} decays"
    over += groups_text(repeated.groups)
    notes = []
    for mode, (frequency, damping) in enumerate(repeated.means):
        text = (
            f"decay: f_n_{mode + 1} and zeta_{mode + 1} are means over {over}, each fitted alone; from "
            f"decay to decay they scatter by {100 * frequency.spread:.2g} % and {100 * damping.spread:.2g} % "
            "beyond their noise. An error that all decays share is not in this interval."
        )
        if np.isfinite(repeated.at[mode]):
            text += (
                f" They follow the amplitude, and are stated at {repeated.at[mode]:.3g} {units[mode]}, "
                "the middle one of the decays."
            )
        notes.append(text)
    return tuple(notes)
