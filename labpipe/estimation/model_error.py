"""What a fit of one FRF states where its residual is not noise: values and intervals with model error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.estimation.derived import is_corrected
from labpipe.estimation.discrepancy import Mixture, mixture
from labpipe.estimation.linear_models import stiffness_and_damping
from labpipe.estimation.measured import Measured
from labpipe.estimation.mode_model import MOVED, SECOND, Curve, ModeModel
from labpipe.estimation.model import DynamicModel, FittedModel
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import restate
from labpipe.estimation.transfer_mode import DrivingMode, TransferMode
from labpipe.records.finding import NORMAL, Discrepancy, IntervalParts, Parameter

# Lines beyond which neighbours are averaged, to so many half-power widths on either side of the resonance.
MOST_LINES, REACH = 400, 8.0
# Lines in a half-power width that averaging leaves.
LINES_IN_WIDTH = 8
FEWEST_NEAR = 60
# Types of discrepancy in words.
WORDS = {
    "a": "other modes",
    "m": "gain curve",
    "z": "stiffness law or drift",
    "n": "noise larger than measured",
}
SECOND_MODE, MOVED_FREQUENCY, NOISE = "second mode", "moved frequency", "noise"
APART = "not the same from point to point: what moves loads the structure"
UNLOADED = "without the mass that moves: from its course over the square of the shape"
# Share from which a cause is named beside the first one.
NAMED = 0.25
# Logarithm of a factor between its ends from which an interval tells nothing.
WIDEST = float(np.log(1e6))


@dataclass(frozen=True)
class StatedRow:
    """A parameter as a combination (n_kept,) [parameter units] of what the mixture keeps, plus an offset.
    *log*: of its logarithm. *alone*: standard error by noise [1] of its logarithm where it is read off one
    FRF of those that the mixture is of; it has at least that, and the error that the fit states.
    """

    row: FloatArray
    offset: float = 0.0
    log: bool = True
    alone: float | None = None


@dataclass(frozen=True)
class ModelError:
    """The mixture of a fit, and its parameters by name as rows of it; apart: mean and ends of the logarithm
    of a mode's parameters that differ from point to point, in the interval as well; *unloaded*: they are
    those without what moves, and count alone.
    """

    mixture: Mixture
    rows: dict[str, StatedRow]
    apart: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    unloaded: bool = False

    @property
    def discrepancy(self) -> Discrepancy:
        """What explains the residual, by shares of the evidence."""
        shares = shares_by_cause(self.mixture.shares)
        return Discrepancy(shares, self.mixture.second if SECOND_MODE in shares else None)

    @property
    def reason(self) -> str:
        """The causes that the evidence names, in words."""
        return reason_of(self.discrepancy.shares, self._wording)

    @property
    def likely(self) -> str:
        """The reason of the mode as a whole: points that disagree come before any other."""
        return self.reason if not self.apart else UNLOADED if self.unloaded else APART

    def _wording(self, cause: str) -> str:
        if cause == SECOND_MODE and self.mixture.second is not None:
            return f"second mode at {self.mixture.second:.5g} Hz"
        if cause == MOVED_FREQUENCY and self.mixture.motion is not None:
            return f"frequency moved by {100 * self.mixture.motion:.2g} %"
        return cause

    def growth_of(self, name: str) -> float:
        """By how much the interval of a parameter exceeds that of noise [1]."""
        row = self.rows[name].row
        _, low, high = self.mixture.stated_interval(row)
        return float((high - low) / (2 * NORMAL * np.sqrt(row @ self.mixture.noise @ row)))

    def state(self, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """The parameters with means and intervals of the mixture, and std_error of noise; those that it does
        not tell keep their value, without an interval.
        """
        return tuple(self._statement(parameter) for parameter in parameters)

    def _statement(self, parameter: Parameter) -> Parameter:
        row = self.rows.get(parameter.name)
        if row is None and not parameter.std_error:
            return parameter
        if row is None:
            return replace(parameter, ci95=None, significant=None, t_ratio=None)
        centre, low, high = (end + row.offset for end in self.mixture.stated_interval(row.row))
        reason, apart = self.reason, self.apart.get(parameter.name)
        if apart is not None:
            # The interval holds either, but for a stated mass.
            first = self.unloaded or apart[2] - apart[1] > high - low
            centre, reason = (apart[0], self.likely) if first else (centre, reason)
            low, high = apart[1:] if self.unloaded else (min(low, apart[1]), max(high, apart[2]))
        if row.log and not high - low < WIDEST:
            return replace(parameter, ci95=None, significant=None, t_ratio=None)
        noise = float(np.sqrt(row.row @ self.mixture.noise @ row.row))
        if row.log:
            # The sign of the fit: coefficients of a sensor of the wrong sign are negative together.
            sign = -1.0 if parameter.value < 0 else 1.0
            centre, low, high = (sign * float(np.exp(end)) for end in (centre, low, high))
            low, high, noise = min(low, high), max(low, high), noise * abs(centre)
        if row.alone is not None and parameter.std_error is not None and parameter.full_error is not None:
            of_frf = row.alone * abs(centre)
            half = NORMAL * np.sqrt(max(parameter.full_error**2 - noise**2, of_frf**2 - noise**2, 0.0))
            down, up = np.hypot([centre - low, high - centre], half).tolist()
            low, high = centre - down, centre + up
            noise = max(noise, parameter.std_error, of_frf)
        full = max((high - low) / (2 * NORMAL), noise)
        why = {"reason": reason, "discrepancy": self.discrepancy}
        return with_model_error(parameter, centre, full, (low, high), noise, **why)


def with_model_error(
    parameter: Parameter, value: float, error: float, ci95: tuple[float, float], noise: float, **why: Any
) -> Parameter:
    """The parameter with a *value*, an *error* and a *ci95* of model error and *noise* [all its unit], of
    which the latter is std_error, and *why*: its reason and discrepancy.
    """
    parts = IntervalParts(noise, float(np.sqrt(max(error**2 - noise**2, 0.0))))
    fitted = parameter.value
    return restate(parameter, value, error, ci95, std_error=noise, interval=parts, fitted=fitted, **why)


def shares_by_cause(shares: Mapping[str, float]) -> dict[str, float]:
    """Shares of the evidence by cause, the largest first, of those by member and type."""
    causes: dict[str, float] = {}
    for name, share in shares.items():
        cause = _cause(name)
        causes[cause] = causes.get(cause, 0.0) + share
    ordered = sorted(causes.items(), key=lambda pair: -pair[1])
    return {name: round(share, 6) for name, share in ordered if share >= 1e-6}


def reason_of(shares: Mapping[str, float], worded: Callable[[str], str] = str) -> str:
    """The first cause of the evidence in words, and others of a share above NAMED."""
    causes = {name: share for name, share in shares.items() if name != NOISE}
    named = [name for number, (name, share) in enumerate(causes.items()) if not number or share > NAMED]
    return " or ".join(worded(name) for name in named)


def _cause(share: str) -> str:
    if share == "none":
        return NOISE
    if share.startswith(SECOND):
        return SECOND_MODE
    if share[0] in MOVED:
        return MOVED_FREQUENCY
    return WORDS[share.lstrip("+")[0]]


def model_error(
    measured: Measured, model: FittedModel, values: FloatArray, settings: FitSettings
) -> ModelError | None:
    """The model error of a fit of one FRF by one mode at *values* (n_parameter,) [parameter units]; None for
    another kind, a band too narrow for its width, and random data whose leakage the fit models. Unknown noise
    is the scatter of the residual's second differences.
    """
    if measured.matrix.shape[1:] != (1, 1) or settings.sliding is not None:
        return None
    # What blocks of hits cut off is small beside an error of the model.
    if measured.leakage is not None and not measured.leakage.kernel.blocks.after_hit:
        return None
    built = None if is_corrected(settings) else _mode_of(model, values)
    if built is None:
        return None
    h = measured.matrix[:, 0, 0]
    if measured.covariance is not None and np.all(measured.covariance[:, 0, 0].real > 0):
        # Of what is common to neighbouring lines, as a course is.
        std = np.sqrt(measured.shared_noise * measured.covariance[:, 0, 0].real)
    else:
        residual = measured.form_size * (h - model.receptance(values, measured.omega)[:, 0, 0])
        std = np.sqrt(measured.shared_noise * measured.scatter(residual)) / measured.form_size
    if not np.all(std > 0):
        return None
    curve = Curve(measured.omega / (2 * np.pi), h / built.force, std / abs(built.force))
    try:
        placed = replace(built.mode, curve=thin(curve, built.mode, built.start))
        return ModelError(mixture(placed.fit(placed.start(built.start))), built.rows)
    except (FitError, np.linalg.LinAlgError):
        return None


@dataclass(frozen=True)
class _Built:
    mode: ModeModel
    start: FloatArray
    rows: dict[str, StatedRow]
    force: float = 1.0


# Replaced by that of the measurement.
_NO_CURVE = Curve(np.arange(2.0), np.zeros(2, np.complex128), np.ones(2))


def _mode_of(model: FittedModel, values: FloatArray) -> _Built | None:
    """The mode that a model is; None of several coefficients, a law of damping, signs without a resonance."""
    by_name = dict(zip(model.names, map(float, values), strict=True))
    if isinstance(model, DrivingMode):
        # k, c and m beside a constant.
        mode, numbers = ModeModel(_NO_CURVE, coefficients=True), np.array([by_name[name] for name in "kcm"])
        rows = _coefficient_rows(mode, "k", "c")
        return _Built(mode, np.log(numbers), rows) if np.all(numbers > 0) else None
    if isinstance(model, TransferMode):
        return _transfer(by_name) if by_name["f_n"] > 0 and by_name["zeta"] > 0 else None
    if not isinstance(model, DynamicModel) or any(term.aliases for term in model.terms):
        return None
    stiffness, damping = stiffness_and_damping(by_name)
    constant, of_mass = model.constant, ["m"] if "m" in by_name else []
    if set(by_name) != {stiffness, damping, *of_mass}:
        return None
    if np.any(constant.stiffness) or np.any(constant.damping) or not np.any(constant.force):
        return None
    sign = float(np.sign(by_name[stiffness]))
    mass = None if of_mass else sign * float(constant.mass[0, 0])
    numbers = sign * np.array([by_name[name] for name in (stiffness, damping, *of_mass)])
    if np.any(numbers <= 0) or (mass is not None and mass <= 0):
        return None
    mode = ModeModel(_NO_CURVE, coefficients=True, residual=0, mass=mass)
    rows = _coefficient_rows(mode, stiffness, damping)
    return _Built(mode, np.log(numbers), rows, sign * float(constant.force[0, 0]))


def _coefficient_rows(mode: ModeModel, stiffness: str, damping: str) -> dict[str, StatedRow]:
    unit = np.eye(mode.n_interest)
    rows = {stiffness: StatedRow(unit[0]), damping: StatedRow(unit[1])}
    if mode.mass is None:
        rows |= {"m": StatedRow(unit[2]), "modal_constant": StatedRow(-unit[2])}
    resonance = zip(("f_n", "zeta"), mode.to_resonance, mode.offset, strict=True)
    return rows | {name: StatedRow(row, offset) for name, row, offset in resonance}


def _transfer(by_name: dict[str, float]) -> _Built:
    """Of R / (s - lambda) + conj.: A + j B = 2 j w_d R."""
    w_d = 2 * np.pi * by_name["f_n"] * float(np.sqrt(max(1 - by_name["zeta"] ** 2, 0.0)))
    unit = np.eye(6)
    rows = {
        "f_n": StatedRow(unit[0]),
        "zeta": StatedRow(unit[1]),
        "modal_constant": StatedRow(-2 * w_d * unit[3], log=False),
        "modal_constant_quadrature": StatedRow(2 * w_d * unit[2], log=False),
        "residual_re": StatedRow(unit[4], log=False),
        "residual_im": StatedRow(unit[5], log=False),
    }
    return _Built(ModeModel(_NO_CURVE), np.log([by_name["f_n"], by_name["zeta"]]), rows)


def thin(curve: Curve, mode: ModeModel, start: FloatArray) -> Curve:
    """About MOST_LINES lines of a *curve* at most: those around the *mode* as at *start* (n,) [1], then means
    of neighbours that leave its peak as it is.
    """
    if curve.frequency.size <= MOST_LINES:
        return curve
    f_n, zeta = mode.frequency_and_damping(start)
    near = np.abs(curve.frequency - f_n) <= REACH * 2 * zeta * f_n
    if np.count_nonzero(near) >= FEWEST_NEAR:
        curve = curve.choose(near)
    spacing = float(np.median(np.diff(curve.frequency)))
    together = min(curve.frequency.size // MOST_LINES + 1, int(2 * zeta * f_n / (LINES_IN_WIDTH * spacing)))
    return curve if together < 2 else curve.average(together)
