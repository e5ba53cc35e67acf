"""Parameters of refined modes as people read them, and the model error of every mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, modal_assurance
from labpipe.errors import FitError
from labpipe.estimation.discrepancy import FEWEST_WIDTHS, Mixture, Settled, mixture, settle
from labpipe.estimation.leakage import Leakage
from labpipe.estimation.measured import Measured
from labpipe.estimation.mode_model import Curve, Fitted, ModeModel
from labpipe.estimation.model_error import ModelError, StatedRow, thin
from labpipe.estimation.statistics import correlation, derive, widen
from labpipe.methods.modal.likelihood import Refined, ResidualTerms, leaking_functions, pseudo_inverse
from labpipe.methods.modal.moved import FEWEST_POINTS, MovedMode, mean_of_points, unloaded_values
from labpipe.methods.modal.whole_covariance import ModalEstimate
from labpipe.records.finding import Finding, Parameter
from labpipe.records.fit_details import Modes, StabilisationDiagram
from labpipe.records.response import Port


def shape_record(
    refined: Refined,
    terms: ResidualTerms,
    points: Sequence[Port],
    references: Sequence[Port],
    forces_move: bool,
    diagram: StabilisationDiagram | None,
    returns: FloatArray,
    driving: Sequence[DrivingPoint],
) -> Modes:
    """The record of the modes in ascending frequency, every shape 1 at its largest point; *returns* (n_mode,)
    [1] in the order of *refined*.
    """
    order = ascending(refined)
    strongest = strongest_points(refined, driving)
    poles, raw, participation = refined.poles[order], refined.shapes[:, order], refined.participation[order]
    scale = raw[np.argmax(np.abs(raw), axis=0), np.arange(len(order))]
    shapes = raw / scale
    of_pole = [function for _, _, function in _pole_functions(refined)]
    rows = [[function(np.array([pole.real, pole.imag])) for function in of_pole] for pole in poles]
    frequency, damping = np.array(rows).T
    return Modes(
        frequency,
        # A loss factor is twice the damping ratio of the same peak.
        damping / 2 if refined.hysteretic else damping,
        shapes=shapes,
        shape_std_errors=shape_errors(refined)[:, order],
        participation=participation,
        scale=scale,
        points=tuple(port.label for port in points),
        references=tuple(port.label for port in references),
        dofs=tuple(port.dof for port in points),
        forces_move=forces_move,
        mac=modal_assurance(shapes.T, shapes.T),
        collinearity=phase_collinearity(shapes),
        lower=terms.lower,
        upper=terms.upper,
        diagram=diagram,
        returns=returns[order],
        driving_points=tuple(place.dof for place in strongest),
        modal_a=np.array(
            [shapes[d.output, n] / (scale[n] * participation[n, d.input]) for n, d in enumerate(strongest)]
        )
        if strongest
        else None,
    )


def shape_errors(refined: Refined) -> FloatArray:
    """Standard errors (n_output, n_mode) [1] of the complex shapes over their largest point, whose error all
    points have; that of poles and participation is common to all outputs, the rest is each one's own.
    """
    by_poles = refined.crossed @ pseudo_inverse(refined.covariance)
    by_output = refined.shape_covariance - by_poles @ refined.crossed.swapaxes(1, 2)
    alone = np.einsum("omm->om", by_output)
    alone = alone[:, 0::2] + alone[:, 1::2]
    common = by_poles[:, 0::2] + 1j * by_poles[:, 1::2]
    largest, modes = np.argmax(np.abs(refined.shapes), axis=0), np.arange(refined.poles.size)
    scale = refined.shapes[largest, modes]
    ratio = refined.shapes / scale
    slopes = common - ratio[:, :, None] * common[largest, modes]
    variance = alone + np.abs(ratio) ** 2 * alone[largest, modes]
    variance += np.sum((slopes @ refined.covariance) * slopes.conj(), axis=-1).real
    variance[largest, modes] = 0.0
    return np.sqrt(np.maximum(variance, 0.0)) / np.abs(scale)


def phase_collinearity(shapes: ComplexArray) -> FloatArray:
    """Modal phase collinearity (n_mode,) [1] of *shapes* (n_point, n_mode): 1 where all points move in one
    phase, 0 for no phase at all.

    ((S_xx - S_yy)^2 + 4 S_xy^2) / (S_xx + S_yy)^2 of real and imaginary part (Juang and Pappa 1985). Equation
    (modal-collinearity).
    """
    xx, yy = np.sum(shapes.real**2, axis=0), np.sum(shapes.imag**2, axis=0)
    xy = np.sum(shapes.real * shapes.imag, axis=0)
    return ((xx - yy) ** 2 + 4 * xy**2) / (xx + yy) ** 2


Function = Callable[[FloatArray], float]
# Of the pole x_0 + j x_1; with a loss factor its square is -w_n^2 (1 + j eta).
VISCOUS: tuple[tuple[str, str, Function], ...] = (
    ("f_n", "Hz", lambda x: float(np.hypot(x[0], x[1]) / (2 * np.pi))),
    ("zeta", "1", lambda x: float(-x[0] / np.hypot(x[0], x[1]))),
)
HYSTERETIC: tuple[tuple[str, str, Function], ...] = (
    ("f_n", "Hz", lambda x: float(np.sqrt(x[1] ** 2 - x[0] ** 2) / (2 * np.pi))),
    ("eta", "1", lambda x: float(-2 * x[0] * x[1] / (x[1] ** 2 - x[0] ** 2))),
)
STEP = 1e-6


@dataclass(frozen=True)
class DrivingPoint:
    """An output and an input at the same place: their numbers in the FRF matrix, and its dof."""

    output: int
    input: int
    dof: str


def modal_parameters(
    refined: Refined, dof: int, mass: float | None, driving: Sequence[DrivingPoint], inflation: float | None
) -> tuple[Parameter, ...]:
    """f_n, zeta (eta) of every mode, ascending; then k, c with the given *mass* [kg], else m, k, c of the
    modes at a driving point.

    k = m w_n^2, c = 2 zeta w_n m. At the driving point of its largest residue the modal mass is that with the
    shape 1 there: the residue is R = 1 / (2 j w_d m) for a real mode, m = Re(1 / (2 j w_d R)) for any.
    Hysteretic modes have eta in place of zeta, no c, and m = Re(1 / (2 lambda R)). Equation
    (modal-loss-factor). *inflation*: factor on the standard errors where the residual exceeds the noise.
    Equation (modal-frequency).
    """
    weigh = _driving_point_function(refined.hysteretic) if mass is None else (lambda _: mass)
    functions: list[tuple[str, str, Function]] = []
    if (mass is not None or driving) and refined.hysteretic:
        functions = [("k", "N/m", lambda x: weigh(x) * float(x[1] ** 2 - x[0] ** 2))]
    elif mass is not None or driving:
        functions = [
            ("k", "N/m", lambda x: weigh(x) * float(x[0] ** 2 + x[1] ** 2)),
            ("c", "N.s/m", lambda x: -2 * weigh(x) * float(x[0])),
        ]
    if mass is None and driving:
        functions.insert(0, ("m", "kg", weigh))
    strongest = strongest_points(refined, driving)
    ordered = list(enumerate(ascending(refined), start=1))
    parameters = [
        replace(_value(refined, mode, None, n, function, dof), derived=False)
        for n, mode in ordered
        for function in _pole_functions(refined)
    ]
    for n, mode in ordered:
        place = strongest[n - 1] if strongest else None
        parameters += [_value(refined, mode, place, n, function, dof) for function in functions]
    if not refined.converged:
        return tuple(replace(parameter, std_error=None, ci95=None) for parameter in parameters)
    return tuple(widen(parameter, inflation) if inflation else parameter for parameter in parameters)


def strongest_points(refined: Refined, driving: Sequence[DrivingPoint]) -> tuple[DrivingPoint, ...]:
    """For every mode, ascending, the driving point with its largest residue; none without driving points."""
    if not driving:
        return ()
    sizes = [np.abs(refined.shapes[of.output] * refined.participation[:, of.input]) for of in driving]
    return tuple(driving[n] for n in np.argmax(sizes, axis=0)[ascending(refined)])


def frequency_correlation(refined: Refined) -> FloatArray:
    """Correlation (2 n_mode, 2 n_mode) [1] of f_n_1, zeta_1, f_n_2, zeta_2 ..."""
    slopes = np.zeros((2 * refined.poles.size, refined.covariance.shape[0]))
    for row, mode in enumerate(ascending(refined)):
        values, _ = _pole_and_residue(refined, mode, None)
        for number, (_, _, function) in enumerate(_pole_functions(refined)):
            slopes[2 * row + number, 2 * mode : 2 * mode + 2] = _gradient(function, values)
    return correlation(slopes @ refined.covariance @ slopes.T)


def _value(
    refined: Refined,
    mode: int,
    driving: DrivingPoint | None,
    number: int,
    named: tuple[str, str, Function],
    dof: int,
) -> Parameter:
    name, unit, function = named
    values, covariance = _pole_and_residue(refined, mode, driving)
    gradient = _gradient(function, values)
    variance = max(float(gradient @ covariance @ gradient), 0.0)
    return derive(f"{name}_{number}", unit, function(values), float(np.sqrt(variance)), dof)


def _driving_point_function(hysteretic: bool) -> Function:
    """Modal mass [kg] of pole x_0 + j x_1, residue (x_2 + j x_3)(x_4 + j x_5)."""

    def mass(x: FloatArray) -> float:
        residue = (x[2] + 1j * x[3]) * (x[4] + 1j * x[5])
        return float((1 / (2 * ((x[0] if hysteretic else 0.0) + 1j * x[1]) * residue)).real)

    return mass


def _pole_functions(refined: Refined) -> tuple[tuple[str, str, Function], ...]:
    return HYSTERETIC if refined.hysteretic else VISCOUS


def _pole_and_residue(
    refined: Refined, mode: int, driving: DrivingPoint | None
) -> tuple[FloatArray, FloatArray]:
    """Re, Im of the pole, and of shape and participation at the driving point, (2,) or (6,)."""
    pole = refined.poles[mode]
    at = [2 * mode, 2 * mode + 1]
    if driving is None:
        return np.array([pole.real, pole.imag]), refined.covariance[np.ix_(at, at)]
    psi, factor = refined.shapes[driving.output, mode], refined.participation[mode, driving.input]
    values = np.array([pole.real, pole.imag, psi.real, psi.imag, factor.real, factor.imag])
    crossed, n = refined.crossed[driving.output], len(refined.covariance)
    of_shape = refined.shape_covariance[driving.output]
    whole = np.block([[refined.covariance, crossed.T], [crossed, of_shape]])
    place = refined.place(mode, driving.input)
    places = [*at, *(n + number for number in at), *([] if place is None else [place, place + 1])]
    covariance = np.zeros((6, 6))
    covariance[: len(places), : len(places)] = whole[np.ix_(places, places)]
    return values, covariance


def _gradient(function: Function, x: FloatArray) -> FloatArray:
    steps = STEP * np.repeat(np.hypot(x[0::2], x[1::2]), 2)
    changes = np.diag(steps)
    return np.array([function(x + change) - function(x - change) for change in changes]) / (2 * steps)


def ascending(refined: Refined) -> list[int]:
    return [int(mode) for mode in np.argsort(np.abs(refined.poles))]


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
# A point sees a mode whose frequency it tells to this share of its half-width, and its damping to this share.
SEEN = 0.3
FEW = "too few lines around the mode to tell a model error"


def model_errors(
    measured: Measured,
    wide: Measured,
    estimate: ModalEstimate,
    parameters: Sequence[Parameter],
    misfit: bool,
    moved: Sequence[MovedMode],
    *,
    moving: bool,
    driving: Sequence[DrivingPoint],
) -> dict[int, ModelError]:
    """The model error of every mode by its number in ascending frequency; a mode that has none in its band is
    left out. *wide*: the same FRFs beyond the band. Without *misfit* of the whole only modes that fill the
    band, where residual terms of the FRFs may stand for a part of them, and whose own line shows one, or,
    where the noise is not known, does not survive other bands.
    *moved*: modes whose points are *measured* at the mean pole; *moving*: a mass is known to move from point
    to point, without which f_n and zeta are stated.

    y_r = W_r y with W = (A^H n A)^-1 A^H n over the FRFs, A (n_frf, n_mode) their residues and n the
    reciprocal of their mean variance: what all FRFs have in common does not average down, what each has for
    itself does. Equation (modal-filter).
    """
    refined = estimate.refined
    values = {parameter.name: parameter.value for parameter in parameters}
    every = misfit or moving or bool(moved)
    width = measured.omega[-1] - measured.omega[0]
    errors_by_mode: dict[int, ModelError] = {}
    for number, mode in enumerate(ascending(refined), start=1):
        if not every and width >= 2 * REACH * -2 * refined.poles[mode].real:
            continue
        try:
            scatter = _scatter(measured, estimate, _lines_near(measured, complex(refined.poles[mode])))
            band, base, mixed = _judge(measured, wide, estimate, mode, scatter)
        except (FitError, np.linalg.LinAlgError):
            continue
        if mixed.sound < 0.5 or scatter is not None:
            mixed = settle(mixed, _elsewhere(wide, estimate, mode, band, scatter))
        place = driving[number - 1] if driving else None
        amplitude = (0.0, 0.0) if place is None else band.log_amplitude(place, base.theta[:2])
        rows = _rows(base, number, values, amplitude)
        if not every and (mixed.sound > SOUND_SHARE if scatter is None else _survives(mixed)):
            continue
        seen, shifted, of_points = band.points()
        for mode_moved in moved:
            if np.argmin(np.abs(refined.poles - mode_moved.pole)) == mode:
                shifted = shifted + mode_moved.shifts[seen]
        points = seen, shifted, of_points
        unmoved = unloaded_values(*points, refined.shapes[:, mode]) if moving else {}
        apart = _find_apart(unmoved or mean_of_points(*points), number, values)
        errors_by_mode[number] = ModelError(mixed, rows, apart, unloaded=bool(unmoved))
    return errors_by_mode


def _find_apart(
    differing: Mapping[str, tuple[float, float, float]], number: int, values: Mapping[str, float]
) -> dict[str, tuple[float, float, float]]:
    """Mean and ends of ln f_n and ln zeta, of eta = 2 zeta, and under a given mass of k ~ f_n^2 and c, which
    hardly has another error than zeta.
    """
    found = {f"{name}_{number}": ends for name, ends in differing.items()}
    for name, of, power in (("eta", "zeta", 1), ("k", "f_n", 2), ("c", "zeta", 1)):
        value = values.get(f"{name}_{number}", 0.0)
        if differing and value > 0 and (name == "eta" or f"m_{number}" not in values):
            base = value / 2 if name == "eta" else values[f"{of}_{number}"]
            offset = float(np.log(value) - power * np.log(base))
            mean, low, high = differing[of]
            found[f"{name}_{number}"] = (power * mean + offset, power * low + offset, power * high + offset)
    return found


def _judge(
    measured: Measured, wide: Measured, estimate: ModalEstimate, mode: int, scatter: FloatArray | None
) -> tuple[_Band, Fitted, Mixture]:
    """Of the lines next to the mode where its band shows a stronger one."""
    pole = complex(estimate.refined.poles[mode])
    f_r, half = abs(pole) / (2 * np.pi), HALF_JUDGED * -2 * pole.real / (2 * np.pi)
    edges = _widen(measured, pole)
    for of in (edges, (f_r - half, f_r + half)):
        try:
            band = _Band.of(measured if edges is None else wide, estimate, mode, scatter, of)
            base = _ordinary(band.curve(slice(None)), pole)
            return band, base, mixture(base)
        except FitError:
            continue
    raise FitError("the lines of the mode show another one")


def _survives(mixed: Mixture) -> bool:
    others = mixed.others if isinstance(mixed, Settled) else ()
    return all(of.sound >= 0.5 for of in (mixed, *others))


def _elsewhere(
    wide: Measured, estimate: ModalEstimate, mode: int, near: _Band, scatter: FloatArray | None
) -> tuple[Mixture, ...]:
    pole, rows = estimate.refined.poles[mode], []
    low, high = float(near.frequency[0]), float(near.frequency[-1])
    f_r, width = abs(pole) / (2 * np.pi), -2 * pole.real / (2 * np.pi)
    bands = [(factor, TERMS) for factor in OTHER_BANDS]
    for factor, terms in [*bands, *((1.0, terms) for terms in OTHER_TERMS)]:
        half = factor * (high - low) / 2
        edges = ((low + high) / 2 - half, (low + high) / 2 + half)
        if 2 * half < LEAST_WIDTHS * width or min(f_r - edges[0], edges[1] - f_r) < INSIDE * width:
            continue
        try:
            band = near if factor == 1.0 else _Band.of(wide, estimate, mode, scatter, edges)
            rows.append(mixture(_ordinary(band.curve(slice(None)), pole, terms)))
        except (FitError, np.linalg.LinAlgError):
            continue
    return tuple(rows)


def with_model_errors(
    parameters: Sequence[Parameter],
    errors: dict[int, ModelError],
    estimate: ModalEstimate,
    lines: FloatArray,
    instead: Sequence[MovedMode],
) -> tuple[Parameter, ...]:
    """The parameters of each mode as its model error states them.

    A mode whose band is too narrow for one, on *lines* (n_line,) [Hz], counts all lines of its half-power
    width as one where the noise is that of the residual. An unstable one has no interval. Intervals of poles
    hold those of the modes that may stand *instead* of them.
    """
    poles = estimate.refined.poles[ascending(estimate.refined)]
    stated: list[Parameter] = []
    for parameter in parameters:
        number = int(parameter.name.rpartition("_")[2])
        pole = poles[number - 1]
        if pole.real >= 0:
            stated.append(parameter.without_interval)
        elif number in errors:
            stated += errors[number].state([parameter])
        elif estimate.chi2_reduced is None:
            alike = -2 * pole.real / (2 * np.pi) / float(np.median(np.diff(lines)))
            stated.append(replace(widen(parameter, float(np.sqrt(max(alike, 1.0)))), reason=FEW))
        else:
            stated.append(parameter)
    for mode in instead:
        numbers = {int(np.argmin(np.abs(poles - pole))) + 1 for pole in mode.instead}
        names = [name for number in numbers for name in (f"f_n_{number}", f"zeta_{number}")]
        stated = [mode.held_by(parameter) if parameter.name in names else parameter for parameter in stated]
    return tuple(stated)


@dataclass(frozen=True)
class _Band:
    """A mode's lines without what the other modes make of them: frequency (n_line,) [Hz], frf and std
    (n_line, n_output, n_input) [m/N], *columns* (n_output, n_input, n): residues of the mode and of its
    neighbours, the mode first. *leakage* of random data, which beside one mode looks like one that moves.
    """

    pole: complex
    frequency: FloatArray
    frf: ComplexArray
    std: FloatArray
    columns: ComplexArray
    leakage: Leakage | None = None

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
        near = _lines_near(measured, pole)
        if edges is not None:
            near = (frequency >= edges[0]) & (frequency <= edges[1])
        residues = refined.shapes[:, None, :] * refined.participation.T
        flat = residues.reshape(-1, refined.poles.size)
        leakage = measured.leakage and measured.leakage.choose(near)
        (a, b), _ = leaking_functions(measured.omega[near], refined.poles, leakage, refined.hysteretic)
        a[:, mode] = b[:, mode] = 0.0
        others = (a @ flat.T + b @ flat.T.conj()).reshape(-1, *shape)
        power = scatter
        if power is None:
            assert measured.variance is not None
            power = measured.shared_noise * measured.variance[near]
        std = np.broadcast_to(np.sqrt(power).reshape(-1, *shape), measured.matrix[near].shape)
        is_near = (np.abs(natural - f_r) <= NEAR * width) & (np.arange(natural.size) != mode)
        columns = residues[:, :, [mode, *np.flatnonzero(is_near)]]
        return cls(pole, frequency[near], measured.matrix[near] - others, std, columns, leakage)

    def curve(self, outputs: slice) -> Curve:
        frf, std = (part[:, outputs].reshape(self.frequency.size, -1) for part in (self.frf, self.std))
        # As many modes as these FRFs can tell apart.
        columns = self.columns[outputs].reshape(frf.shape[1], -1)[:, : max(frf.shape[1] // 2, 1)]
        weight = 1 / np.sqrt(np.mean(std**2, axis=0))
        filters = np.linalg.pinv(columns * weight[:, None])[0] * weight
        curve = Curve(self.frequency, frf @ filters, np.sqrt((std**2) @ np.abs(filters) ** 2))
        if self.leakage is None:
            return curve
        return replace(curve, smear=self.leakage.weights, omega=self.leakage.grid[0])

    def log_amplitude(self, place: DrivingPoint, q: FloatArray) -> tuple[float, float]:
        """ln of the residue of the FRF at a driving point over that of *columns*, with the pole at *q* = (ln
        f_n, ln zeta), and its standard error by noise [1].
        """
        residue = self.columns[place.output, place.input, 0]
        values, std = (part[:, place.output, place.input] / residue for part in (self.frf, self.std))
        curve = replace(self.curve(slice(None)), values=values, std=np.abs(std))
        model = ModeModel(curve, residual=TERMS)
        theta = model.start(q)
        rows = curve.weight(model.at(theta)[1][q.size :])
        along = np.zeros(len(rows))
        along[:2] = theta[q.size : q.size + 2] / np.sum(theta[q.size : q.size + 2] ** 2)
        error = float(np.sqrt(along @ np.linalg.inv(rows @ rows.T) @ along))
        return float(np.log(np.hypot(*theta[q.size : q.size + 2]))), error

    def points(self) -> tuple[list[int], FloatArray, FloatArray]:
        """Points that see the mode, (ln f_n, ln zeta) of each (n, 2) and their errors by noise (n, 2) [1]."""
        seen, values, errors = [], [], []
        zeta = -self.pole.real / abs(self.pole)
        for output in range(self.frf.shape[1]):
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


def _lines_near(measured: Measured, pole: complex) -> BoolArray:
    frequency = measured.omega / (2 * np.pi)
    away = np.abs(frequency - abs(pole) / (2 * np.pi))
    near = away <= REACH * -2 * pole.real / (2 * np.pi)
    if np.count_nonzero(near) < FEWEST:
        near = np.zeros(frequency.size, np.bool_)
        near[np.argsort(away)[:FEWEST]] = True
    return near


def _widen(measured: Measured, pole: complex) -> tuple[float, float] | None:
    f_r, width = abs(pole) / (2 * np.pi), -2 * pole.real / (2 * np.pi)
    low, high = (float(end) / (2 * np.pi) for end in measured.omega[[0, -1]])
    if high - low >= FEWEST_WIDTHS * width:
        return None
    return min(low, f_r - HALF_JUDGED * width), max(high, f_r + HALF_JUDGED * width)


def _scatter(measured: Measured, estimate: ModalEstimate, near: BoolArray) -> FloatArray | None:
    """E|n|^2 of every FRF (n_frf,) [m^2/N^2] by the residual of the lines *near*; None where measured."""
    if measured.variance is not None and not estimate.unused and np.all(measured.variance > 0):
        return None
    residual = (measured.matrix - estimate.fitted)[near].reshape(np.count_nonzero(near), -1)
    scatter = measured.shared_noise * measured.scatter(residual)
    if not np.all(scatter > 0):
        raise FitError("there is no noise to weigh a model error by")
    return scatter


def _ordinary(curve: Curve, pole: complex, terms: int = TERMS) -> Fitted:
    model = ModeModel(curve, residual=terms)
    start = np.log([abs(pole) / (2 * np.pi), -pole.real / abs(pole)])
    model = replace(model, curve=thin(curve, model, start))
    fit = model.fit(model.start(start))
    if abs(np.exp(fit.theta[0]) / np.exp(start[0]) - 1) > REACH * np.exp(start[1]):
        raise FitError("the filtered line shows another mode")
    return fit


def _rows(
    base: Fitted, number: int, values: dict[str, float], at_driving_point: tuple[float, float] = (0.0, 0.0)
) -> dict[str, StatedRow]:
    """f_n and zeta of the filtered line.

    M ~ 1 / (w R), k ~ w / R, c ~ zeta / R follow its frequency, damping and amplitude, which at the driving
    point is that of one FRF: *at_driving_point*, ln of R over that of the modes of the whole band, and its
    standard error; under a given mass k ~ w^2, c ~ zeta w.
    """
    kept = base.theta[base.model.kept]
    unit = np.eye(kept.size)
    amplitude = -(kept[2] * unit[2] + kept[3] * unit[3]) / float(kept[2] ** 2 + kept[3] ** 2)
    rows = {f"f_n_{number}": StatedRow(unit[0]), f"zeta_{number}": StatedRow(unit[1])}
    if (factor := values.get(f"eta_{number}", 0.0)) > 0:
        # A loss factor is twice the damping ratio of the same peak.
        rows[f"eta_{number}"] = StatedRow(unit[1], float(np.log(factor) - kept[1]))
    alone = f"m_{number}" in values
    of_mass, logs = np.zeros(kept.size), {}
    if alone:
        of_mass, log_w = amplitude - unit[0], float(kept[0] + np.log(2 * np.pi))
        mass = np.log(abs(values[f"m_{number}"]) * values[f"f_n_{number}"]) - kept[0] - at_driving_point[0]
        logs = {"m": mass, "k": mass + 2 * log_w, "c": mass + np.log(2) + kept[1] + log_w}
    for letter, row in (("m", of_mass), ("k", of_mass + 2 * unit[0]), ("c", of_mass + unit[0] + unit[1])):
        value = values.get(f"{letter}_{number}", 0.0)
        if value != 0:
            at_base = logs[letter] if alone else float(np.log(abs(value)))
            offset = float(at_base - row @ kept)
            rows[f"{letter}_{number}"] = StatedRow(row, offset, alone=at_driving_point[1] if alone else None)
    return rows


def loaded_findings(n_mode: int, errors: Mapping[int, ModelError]) -> tuple[Finding, ...]:
    """A warning for every mode whose frequency without the moving mass was asked for and cannot be told."""
    loaded = [str(n) for n in range(1, n_mode + 1) if n not in errors or not errors[n].unloaded]
    if not loaded:
        return ()
    message = (
        f"f_n and zeta of mode {', '.join(loaded)} are those with the moving mass: {FEWEST_POINTS} points or "
        "fewer show the mode by itself. Measure more points where it moves"
    )
    return (Finding("moved-mode", message),)
