"""Modes whose residual is not noise: every mode alone on a line filtered from all FRFs, with an interval that
includes the model error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, student_quantile
from labpipe.errors import FitError
from labpipe.estimation.derived import without_intervals
from labpipe.estimation.discrepancy import FEWEST_WIDTHS, Mixture, mixture, settled
from labpipe.estimation.measured import Measured
from labpipe.estimation.mode_model import Curve, Fitted, ModeModel
from labpipe.estimation.model_error import ModelError, StatedRow, thinned
from labpipe.estimation.repeats import PRIOR_SCALE, repeat_mean
from labpipe.estimation.statistics import widened
from labpipe.methods.modal.likelihood import pole_functions
from labpipe.methods.modal.moved import MovedMode
from labpipe.methods.modal.whole_covariance import ModalEstimate
from labpipe.records.finding import Parameter

# Half-power widths of a mode's band on either side, its least number of lines, and widths within which
# neighbours share the filter.
REACH, FEWEST, NEAR = 8.0, 60, 16.0
# Residual terms of a filtered line, constant and slope, and other numbers of them that the mode must survive.
TERMS, OTHER_TERMS = 2, (1, 3)
# Widths of other bands about the same middle that it must survive; each so many half-power widths wide, with
# the mode so many inside.
OTHER_BANDS, LEAST_WIDTHS, INSIDE = (0.8, 1.25), 2.5, 0.5
# Half of the half-power widths to which a band is widened that is too narrow to judge its mode.
HALF_JUDGED = 2.0
# Share of the evidence for a sound model below which a residual of unknown noise shows a model error.
SOUND_SHARE = 0.05
# A point sees a mode whose frequency it tells to this share of its half-width, and its damping to this share;
# so many points are compared, and disagree below this chance.
SEEN, FEWEST_POINTS, DISAGREE = 0.3, 3, 1e-3
FEW = "too few lines around the mode to tell a model error"


def model_errors(
    measured: Measured,
    wide: Measured,
    estimate: ModalEstimate,
    parameters: Sequence[Parameter],
    misfit: bool,
    moved: Sequence[MovedMode] = (),
    *,
    moving: bool = False,
) -> dict[int, ModelError]:
    """The model error of every mode by its number in ascending frequency; a mode that has none in its band is
    left out. *wide*: the same FRFs beyond the band. Without *misfit* of the whole only modes that fill the
    band, where residual terms of the FRFs may stand for a part of them, and whose own line shows one.
    *moved*: modes whose points are *measured* at the mean pole; *moving*: a mass is known to move from point
    to point, without which f_n and zeta are stated.

    y_r = W_r y with W = (A^H n A)^-1 A^H n over the FRFs, A (n_frf, n_mode) their residues and n the
    reciprocal of their mean variance: what all FRFs have in common does not average down, what each has for
    itself does. Equation (modal-filter).
    """
    refined = estimate.refined
    order = np.argsort(np.abs(refined.poles))
    values = {parameter.name: parameter.value for parameter in parameters}
    errors_by_mode: dict[int, ModelError] = {}
    for number, mode in enumerate(order, start=1):
        if not (misfit or moving or moved) and not bool(
            measured.omega[-1] - measured.omega[0] < 2 * REACH * -2 * refined.poles[mode].real
        ):
            continue
        try:
            pole = complex(refined.poles[mode])
            scatter = _scatter(measured, estimate, _near(measured, pole))
            edges = _widened(measured, pole)
            band = _Band.of(measured if edges is None else wide, estimate, int(mode), scatter, edges)
            base = _ordinary(band.curve(slice(None)), pole)
            mixed = mixture(base)
        except (FitError, np.linalg.LinAlgError):
            continue
        if mixed.sound > SOUND_SHARE and not (misfit or moving or moved):
            continue
        if mixed.sound < 0.5:
            mixed = settled(mixed, _elsewhere(wide, estimate, int(mode), band, scatter))
        seen, shifted, of_points = band.points()
        for mode_moved in moved:
            if np.argmin(np.abs(refined.poles - mode_moved.pole)) == mode:
                shifted = shifted + mode_moved.shifts[seen]
        points = seen, shifted, of_points
        unmoved = unloaded(*points, refined.shapes[:, mode]) if moving else {}
        apart = {f"{name}_{number}": interval for name, interval in (unmoved or _apart(*points)).items()}
        errors_by_mode[number] = ModelError(mixed, _rows(base, number, values), apart, unloaded=bool(unmoved))
    return errors_by_mode


def _elsewhere(
    wide: Measured, estimate: ModalEstimate, mode: int, near: _Band, scatter: FloatArray | None
) -> tuple[Mixture, ...]:
    """The same mode in narrower and wider bands, and with fewer and more residual terms."""
    pole, rows = estimate.refined.poles[mode], []
    low, high = float(near.frequency[0]), float(near.frequency[-1])
    f_r, width = abs(pole) / (2 * np.pi), -2 * pole.real / (2 * np.pi)
    tried: list[tuple[float, int]] = [(factor, TERMS) for factor in OTHER_BANDS]
    for factor, terms in [*tried, *((1.0, terms) for terms in OTHER_TERMS)]:
        half = factor * (high - low) / 2
        edges = ((low + high) / 2 - half, (low + high) / 2 + half)
        far = 2 * half < LEAST_WIDTHS * width or min(f_r - edges[0], edges[1] - f_r) < INSIDE * width
        if far:
            continue
        try:
            band = near if factor == 1.0 else _Band.of(wide, estimate, mode, scatter, edges)
            rows.append(mixture(_ordinary(band.curve(slice(None)), pole, terms)))
        except (FitError, np.linalg.LinAlgError):
            continue
    return tuple(rows)


def with_model_errors(
    parameters: Sequence[Parameter], errors: dict[int, ModelError], estimate: ModalEstimate, lines: FloatArray
) -> tuple[Parameter, ...]:
    """The parameters of each mode as its model error states them.

    A mode whose band is too narrow for one, on *lines* (n_line,) [Hz], counts all lines of its half-power
    width as one where the noise is that of the residual. An unstable one has no interval.
    """
    poles = estimate.refined.poles[np.argsort(np.abs(estimate.refined.poles))]
    stated: list[Parameter] = []
    for parameter in parameters:
        number = int(parameter.name.rpartition("_")[2])
        pole = poles[number - 1]
        if pole.real >= 0:
            stated += without_intervals([parameter])
        elif number in errors:
            stated += errors[number].stated([parameter])
        elif estimate.chi2_reduced is None:
            alike = -2 * pole.real / (2 * np.pi) / float(np.mean(np.diff(lines)))
            stated.append(replace(widened(parameter, float(np.sqrt(max(alike, 1.0)))), reason=FEW))
        else:
            stated.append(parameter)
    return tuple(stated)


@dataclass(frozen=True)
class _Band:
    """A mode's lines without what the other modes make of them: frequency (n_line,) [Hz], data and std
    (n_line, n_output, n_input) [m/N], *columns* (n_output, n_input, n): residues of the mode and of its
    neighbours, the mode first.
    """

    pole: complex
    frequency: FloatArray
    data: ComplexArray
    std: FloatArray
    columns: ComplexArray

    @classmethod
    def of(
        cls,
        measured: Measured,
        estimate: ModalEstimate,
        mode: int,
        scatter: FloatArray | None,
        edges: tuple[float, float] | None = None,
    ) -> _Band:
        """The band of a mode, or that between *edges* [Hz]; *scatter* as of _scatter."""
        refined = estimate.refined
        pole, shape = complex(refined.poles[mode]), measured.matrix.shape[1:]
        frequency, natural = measured.omega / (2 * np.pi), np.abs(refined.poles) / (2 * np.pi)
        f_r, width = natural[mode], -2 * pole.real / (2 * np.pi)
        near = _near(measured, pole)
        if edges is not None:
            near = (frequency >= edges[0]) & (frequency <= edges[1])
        residues = (refined.shapes[:, None, :] * refined.participation.T[None]).reshape(
            -1, refined.poles.size
        )
        (a, b), _ = pole_functions((1j * measured.omega[near]), refined.poles, refined.hysteretic)
        a[:, mode] = b[:, mode] = 0.0
        data = measured.matrix[near].reshape(-1, residues.shape[0]) - np.asarray(
            a @ residues.T + b @ residues.T.conj()
        )
        neighbours = np.flatnonzero(
            (np.abs(natural - f_r) <= NEAR * width) & (np.arange(natural.size) != mode)
        )
        columns = residues[:, np.concatenate([[mode], neighbours])]
        std = _noise(measured, scatter)[near]
        return cls(
            pole,
            frequency[near],
            data.reshape(-1, *shape),
            std.reshape(-1, *shape),
            columns.reshape(*shape, -1),
        )

    def curve(self, outputs: slice) -> Curve:
        """The line of the mode, of unit amplitude, from some of the outputs, and the noise on it."""
        data, std = (part[:, outputs].reshape(self.frequency.size, -1) for part in (self.data, self.std))
        # As many modes as these FRFs can tell apart.
        columns = self.columns[outputs].reshape(data.shape[1], -1)[:, : max(data.shape[1] // 2, 1)]
        weight = 1 / np.sqrt(np.mean(std**2, axis=0))
        filters = np.linalg.pinv(columns * weight[:, None])[0] * weight
        return Curve(self.frequency, data @ filters, np.sqrt((std**2) @ np.abs(filters) ** 2))

    def points(self) -> tuple[list[int], FloatArray, FloatArray]:
        """Points that see the mode, (ln f_n, ln zeta) of each (n, 2) and their errors by noise (n, 2) [1]."""
        seen, values, errors = [], [], []
        zeta = -self.pole.real / abs(self.pole)
        for output in range(self.data.shape[1]):
            try:
                fit = _ordinary(self.curve(slice(output, output + 1)), self.pole)
                error = np.sqrt(np.diag(fit.covariance)[:2])
            except (FitError, np.linalg.LinAlgError):
                continue
            if error[0] < SEEN * zeta and error[1] < SEEN:
                seen.append(output)
                values.append(fit.theta[:2])
                errors.append(error)
        return seen, np.array(values).reshape(-1, 2), np.array(errors).reshape(-1, 2)


def _apart(seen: list[int], values: FloatArray, errors: FloatArray) -> dict[str, tuple[float, float, float]]:
    """Mean and ends of ln f_n and ln zeta over the points, where these disagree beyond noise: what moves from
    point to point loads it.

    mean +- t s sqrt(1 + 1/n), for another point; of points that see the mode.
    """
    if len(seen) < FEWEST_POINTS:
        return {}
    pieces = {}
    for place, name in enumerate(("f_n", "zeta")):
        x, weight = values[:, place], errors[:, place] ** -2.0
        scatter = float(np.sum(weight * (x - np.average(x, weights=weight)) ** 2))
        if chi2_tail(scatter, x.size - 1) < DISAGREE:
            reach = student_quantile(0.975, x.size - 1) * np.std(x, ddof=1) * np.sqrt(1 + 1 / x.size)
            pieces[name] = (float(np.mean(x)), float(np.mean(x) - reach), float(np.mean(x) + reach))
    return pieces


def unloaded(
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


def _near(measured: Measured, pole: complex) -> BoolArray:
    """The lines (n_line,) of a mode: REACH half-power widths to either side, FEWEST of them at least."""
    frequency = measured.omega / (2 * np.pi)
    away = np.abs(frequency - abs(pole) / (2 * np.pi))
    near = away <= REACH * -2 * pole.real / (2 * np.pi)
    if np.count_nonzero(near) < FEWEST:
        near = np.zeros(frequency.size, np.bool_)
        near[np.argsort(away)[:FEWEST]] = True
    return np.asarray(near)


def _widened(measured: Measured, pole: complex) -> tuple[float, float] | None:
    """Edges [Hz] of the band in which a mode can be judged whose own one is too narrow for that, or None."""
    f_r, width = abs(pole) / (2 * np.pi), -2 * pole.real / (2 * np.pi)
    low, high = (float(end) / (2 * np.pi) for end in measured.omega[[0, -1]])
    if high - low >= FEWEST_WIDTHS * width:
        return None
    return min(low, f_r - HALF_JUDGED * width), max(high, f_r + HALF_JUDGED * width)


def _scatter(measured: Measured, estimate: ModalEstimate, near: BoolArray) -> FloatArray | None:
    """E|n|^2 of every FRF (n_frf,) [m^2/N^2] between neighbours of the lines *near* (n_line,) [-].

    It is that of the residual.
    """
    if measured.variance is not None and not estimate.unused and np.all(measured.variance > 0):
        return None
    residual = (measured.matrix - estimate.fitted)[near].reshape(np.count_nonzero(near), -1)
    scatter = np.mean(np.abs(np.diff(residual, 2, axis=0)) ** 2, axis=0) / 6
    if not np.all(scatter > 0):
        raise FitError("there is no noise to weigh a model error by")
    return np.asarray(scatter)


def _noise(measured: Measured, scatter: FloatArray | None) -> FloatArray:
    """sqrt(E|n|^2) of every FRF on every line, (n_line, n_frf) [m/N]: of a *scatter* alike on all, else the
    measured one.
    """
    if scatter is not None:
        return np.broadcast_to(np.sqrt(scatter), (measured.omega.size, scatter.size))
    assert measured.variance is not None
    return np.sqrt(measured.shared_noise * measured.variance)


def _ordinary(curve: Curve, pole: complex, terms: int = TERMS) -> Fitted:
    model = ModeModel(curve, residual=terms)
    start = np.log([abs(pole) / (2 * np.pi), -pole.real / abs(pole)])
    model = replace(model, curve=thinned(curve, model, start))
    fit = model.fitted(model.started(start))
    if abs(np.exp(fit.theta[0]) / np.exp(start[0]) - 1) > REACH * np.exp(start[1]):
        raise FitError("the filtered line shows another mode")
    return fit


def _rows(base: Fitted, number: int, values: dict[str, float]) -> dict[str, StatedRow]:
    """f_n and zeta of the filtered line.

    M ~ 1 / (w R), k ~ w / R, c ~ zeta / R follow its frequency, damping and amplitude.
    """
    kept = base.theta[base.model.kept]
    unit = np.eye(kept.size)
    amplitude = -(kept[2] * unit[2] + kept[3] * unit[3]) / float(kept[2] ** 2 + kept[3] ** 2)
    rows = {f"f_n_{number}": StatedRow(unit[0]), f"zeta_{number}": StatedRow(unit[1])}
    if (factor := values.get(f"eta_{number}", 0.0)) > 0:
        # A loss factor is twice the damping ratio of the same peak.
        rows[f"eta_{number}"] = StatedRow(unit[1], float(np.log(factor) - kept[1]))
    for letter, row in (("m", amplitude - unit[0]), ("k", amplitude + unit[0]), ("c", amplitude + unit[1])):
        value = values.get(f"{letter}_{number}", 0.0)
        if value != 0:
            rows[f"{letter}_{number}"] = StatedRow(row, float(np.log(abs(value)) - row @ kept))
    return rows
