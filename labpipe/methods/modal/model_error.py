"""Modes whose residual is not noise: every mode alone on a line filtered from all FRFs, with an interval that
includes the model error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, student_quantile
from labpipe.errors import FitError
from labpipe.estimation.discrepancy import mixture
from labpipe.estimation.measured import Measured
from labpipe.estimation.mode_model import Curve, Fitted, ModeModel
from labpipe.estimation.model_error import ModelError, StatedRow
from labpipe.methods.modal.likelihood import Refined, pole_functions
from labpipe.methods.modal.whole_covariance import ModalEstimate
from labpipe.records.finding import Parameter

# Half-power widths of a mode's band on either side, its least number of lines, and widths within which
# neighbours share the filter.
REACH, FEWEST, NEAR = 8.0, 60, 16.0
# Residual terms of a filtered line: constant and slope.
TERMS = 2
# A point sees a mode whose frequency it tells to this share of its half-width, and its damping to this share;
# so many points are compared, and disagree below this chance.
SEEN, FEWEST_POINTS, DISAGREE = 0.3, 3, 1e-3


def model_errors(
    measured: Measured, estimate: ModalEstimate, parameters: Sequence[Parameter]
) -> dict[int, ModelError]:
    """The model error of every mode by its number in ascending frequency; a mode that has none in its band is
    left out.

    y_r = W_r y with W = (A^H n A)^-1 A^H n over the FRFs, A (n_frf, n_mode) their residues and n the
    reciprocal of their mean variance: what all FRFs have in common does not average down, what each has for
    itself does. Equation (modal-filter).
    """
    refined = estimate.refined
    order = np.argsort(np.abs(refined.poles))
    values = {parameter.name: parameter.value for parameter in parameters}
    found: dict[int, ModelError] = {}
    for number, mode in enumerate(order, start=1):
        band = _Band.of(measured, estimate, int(mode))
        try:
            base = _ordinary(band.curve(slice(None)), refined.poles[mode])
            mixed = mixture(base)
        except (FitError, np.linalg.LinAlgError):
            continue
        apart = {f"{name}_{number}": interval for name, interval in band.apart().items()}
        found[number] = ModelError(mixed, _rows(base, number, values), apart)
    return found


def with_model_errors(
    parameters: Sequence[Parameter], errors: dict[int, ModelError]
) -> tuple[Parameter, ...]:
    """The parameters of each mode as its model error states them; of a mode without one as they are."""
    by_mode = [errors.get(int(parameter.name.rpartition("_")[2])) for parameter in parameters]
    return tuple(
        parameter if error is None else error.stated([parameter])[0]
        for parameter, error in zip(parameters, by_mode, strict=True)
    )


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
    def of(cls, measured: Measured, estimate: ModalEstimate, mode: int) -> _Band:
        refined = estimate.refined
        pole, shape = complex(refined.poles[mode]), measured.matrix.shape[1:]
        frequency, natural = measured.omega / (2 * np.pi), np.abs(refined.poles) / (2 * np.pi)
        f_r, width = natural[mode], -2 * pole.real / (2 * np.pi)
        near = np.abs(frequency - f_r) <= REACH * width
        if np.count_nonzero(near) < FEWEST:
            near = np.zeros(frequency.size, np.bool_)
            near[np.sort(np.argsort(np.abs(frequency - f_r))[:FEWEST])] = True
        residues = (refined.shapes[:, None, :] * refined.participation.T[None]).reshape(
            -1, refined.poles.size
        )
        data = measured.matrix[near].reshape(-1, residues.shape[0]) - _others(
            refined, mode, 1j * measured.omega[near], residues
        )
        neighbours = np.flatnonzero(
            (np.abs(natural - f_r) <= NEAR * width) & (np.arange(natural.size) != mode)
        )
        columns = residues[:, np.concatenate([[mode], neighbours])]
        std = _noise(measured, estimate)[near]
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

    def apart(self) -> dict[str, tuple[float, float, float]]:
        """Mean and ends of ln f_n and ln zeta over the points, where these disagree beyond noise: what moves
        from point to point loads it.

        mean +- t s sqrt(1 + 1/n), for another point; of points that see the mode. Empty where all agree, or
        too few see it.
        """
        seen = []
        zeta = -self.pole.real / abs(self.pole)
        for output in range(self.data.shape[1]):
            try:
                fit = _ordinary(self.curve(slice(output, output + 1)), self.pole)
                errors = np.sqrt(np.diag(fit.covariance)[:2])
            except (FitError, np.linalg.LinAlgError):
                continue
            if errors[0] < SEEN * zeta and errors[1] < SEEN:
                seen.append((fit.theta[:2], errors))
        if len(seen) < FEWEST_POINTS:
            return {}
        values, errors = (np.array(part) for part in zip(*seen, strict=True))
        found = {}
        for place, name in enumerate(("f_n", "zeta")):
            x, weight = values[:, place], errors[:, place] ** -2.0
            scatter = float(np.sum(weight * (x - np.average(x, weights=weight)) ** 2))
            if chi2_tail(scatter, x.size - 1) < DISAGREE:
                reach = student_quantile(0.975, x.size - 1) * np.std(x, ddof=1) * np.sqrt(1 + 1 / x.size)
                found[name] = (float(np.mean(x)), float(np.mean(x) - reach), float(np.mean(x) + reach))
        return found


def _others(refined: Refined, mode: int, s: ComplexArray, residues: ComplexArray) -> ComplexArray:
    """What all other modes make of the FRFs, (n_line, n_frf) [m/N]."""
    (a, b), _ = pole_functions(s, refined.poles, refined.hysteretic)
    a[:, mode] = b[:, mode] = 0.0
    return np.asarray(a @ residues.T + b @ residues.T.conj())


def _noise(measured: Measured, estimate: ModalEstimate) -> FloatArray:
    """sqrt(E|n|^2) of every FRF on every line, (n_line, n_frf) [m/N]: the measured one, else that of
    neighbouring lines of the residual.
    """
    n_line = measured.omega.size
    if measured.covariance is not None and not estimate.unused:
        variance = np.einsum("lii->li", measured.covariance).real
        if np.all(variance > 0):
            return np.sqrt(measured.shared_noise * variance)
    residual = (measured.matrix - estimate.fitted).reshape(n_line, -1)
    scatter = np.mean(np.abs(np.diff(residual, 2, axis=0)) ** 2, axis=0) / 6
    if not np.all(scatter > 0):
        raise FitError("there is no noise to weigh a model error by")
    return np.broadcast_to(np.sqrt(scatter), residual.shape)


def _ordinary(curve: Curve, pole: complex) -> Fitted:
    model = ModeModel(curve, residual=TERMS)
    start = np.log([abs(pole) / (2 * np.pi), -pole.real / abs(pole)])
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
    for letter, row in (("m", amplitude - unit[0]), ("k", amplitude + unit[0]), ("c", amplitude + unit[1])):
        value = values.get(f"{letter}_{number}", 0.0)
        if value != 0:
            rows[f"{letter}_{number}"] = StatedRow(row, float(np.log(abs(value)) - row @ kept))
    return rows
