"""The response of a rotor as a function of wear and of what is tuned: viscosity, clearance, ..."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.estimation.measured import Measured, matrix_errors, measured_part
from labpipe.estimation.model import labels
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import fit_weights, has_noise, weight_uncertainty, whiten_values
from labpipe.methods.journal_bearing.curve import TableRange
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import ReducedRotor, reduced_rotor
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.shaft import Rotor
from labpipe.methods.wear import tables
from labpipe.methods.wear.settings import ANGLE, DEPTH, REACH, Gaussian, WearSettings
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import MatrixError
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import FORWARD_BACKWARD, FROM_DIRECTIONAL, directions
from labpipe.spectra.damping import half_power
from labpipe.spectra.matrices import without_rounding

# Relative step of the difference by the shaft's damping, in which the response is smooth.
BETA_STEP = 1e-3
# Margin of the tables beyond the bounds, for rounding.
TABLE_MARGIN = 1.001
SCALES = {DEPTH: 1e-6, ANGLE: float(np.deg2rad(1.0))}


@dataclass(frozen=True, kw_only=True)
class WornModel:
    """A rig's response on *frequency* [Hz] by the parameters *names*, all scaled: value [SI] = scale (n,) *
    parameter; low, high (n,): their bounds; prior: of the nuisance parameters among them [SI units].
    """

    rig: RotorRig
    bearings: tuple[tables.TabledBearing, ...]
    frequency: tuple[float, ...]
    directional: bool
    names: tuple[str, ...]
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    prior: Gaussian
    mesh: FilmMesh

    @property
    def film_mesh(self) -> FilmMesh:
        """The mesh of the films that refine a minimum; around the journal it follows the film's front and the
        edges of wear.
        """
        return FilmMesh(4 * self.mesh.around, 2 * self.mesh.across)

    def refine(self, parameters: FloatArray, with_slopes: bool = True) -> WornModel:
        """The model with the films' own coefficients, and slopes, at scaled parameters (n,) [1]."""
        values, mesh = self.values(parameters), self.film_mesh
        return replace(
            self, bearings=tuple(bearing.refine(values, mesh, with_slopes) for bearing in self.bearings)
        )

    def with_mesh_error(self, parameters: FloatArray) -> tuple[WornModel, ...]:
        """For every oil film, refined before, the model with the error of its mesh at parameters (n,) [1]."""
        values = self.values(parameters)
        models = []
        for number, bearing in enumerate(self.bearings):
            if bearing.place.is_film:
                bearings = list(self.bearings)
                bearings[number] = bearing.shift(bearing.mesh_error(values, self.film_mesh))
                models.append(replace(self, bearings=tuple(bearings)))
        return tuple(models)

    def values(self, parameters: FloatArray) -> dict[str, float]:
        """Values by name [SI units] of scaled parameters (n,)."""
        return dict(zip(self.names, (self.scale * parameters).tolist(), strict=True))

    def response(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """H (n_line, 2, 2) [m/N] and its derivatives by the scaled parameters, (n, n_line, 2, 2)."""
        values = self.values(parameters)
        supports = [bearing.support(values, self.names) for bearing in self.bearings]
        scale = self.scale[self.names.index("beta")] if "beta" in self.names else 0.0
        response, slopes = rotor_response(self.rig, self._rotor, supports, values, self.names, scale)
        slopes = slopes * self.scale[:, None, None, None]
        if self.directional:
            return tables.forward_backward(response), tables.forward_backward(slopes)
        return response, slopes

    def _rotor(self, beta: float) -> ReducedRotor:
        places = {bearing.place.node for bearing in self.bearings}
        nodes = tuple(sorted(places | {self.rig.force, self.rig.response}))
        rotor = replace(self.rig.rotor, beta=beta)
        return _reduced_rotor(rotor, nodes, self.frequency, self.rig.omega)


def rotor_response(
    rig: RotorRig,
    rotor: Callable[[float], ReducedRotor],
    supports: list[tables.VaryingSupport],
    values: Mapping[str, float],
    names: Sequence[str],
    scale: float,
) -> tuple[ComplexArray, ComplexArray]:
    """H (n_line, 2, 2) [m/N] at the *rig*'s response and its derivatives by *names*, (n, n_line, 2, 2), of
    the *rotor* by its damping beta [s] on *supports*; by beta over a step of BETA_STEP of its *scale* [s].
    """
    beta, ends_of_path = values.get("beta", rig.rotor.beta), (rig.response, rig.force)
    response, slopes = tables.response_with_slopes(rotor(beta), supports, *ends_of_path)
    if "beta" in names:
        step = BETA_STEP * scale
        moved = [rotor(beta + move).on(of.support for of in supports) for move in (step, -step)]
        ends = [standing.response(*ends_of_path) for standing in moved]
        slopes[names.index("beta")] = (ends[0] - ends[1]) / (2 * step)
    return response, slopes


@lru_cache(maxsize=8)
def _reduced_rotor(
    rotor: Rotor, nodes: tuple[int, ...], frequency: tuple[float, ...], speed: float
) -> ReducedRotor:
    return reduced_rotor(rotor, nodes, np.array(frequency), speed)


def worn_model(settings: WearSettings, frequency: FloatArray) -> WornModel:
    """The model of a fit on its lines *frequency* (n_line,) [Hz]. FitError without a rotor, ConfigError for
    settings that it does not fit.
    """
    if settings.rig is None:
        raise FitError("no rotor was read for this fit", hint="name it with wear.rotor")
    prior = settings.nuisance_prior
    centre = {**settings.fixed_values, **dict(zip(prior.names, prior.mean, strict=True))}
    rig = _centre(settings.rig, centre)
    worn = "" if settings.healthy else rig.place(settings.bearing).name
    ranges, box = _reach(settings, prior, rig)
    loads, mesh = rig.static_loads(), settings.mesh
    bearings = tuple(
        tables.tabulate(place, loads[place.name], rig.omega, place.name == worn, ranges, mesh)
        for place in rig.bearings
    )
    nuisances = tuple(name for name in prior.names if name not in SCALES)
    names = (*(() if settings.healthy else (DEPTH, ANGLE)), *nuisances)
    spread = dict(zip(prior.names, prior.std.tolist(), strict=True))
    scale = np.array([SCALES.get(name) or spread[name] for name in names])
    low, high = (np.array([box[name][end] for name in names]) / scale for end in (0, 1))
    return WornModel(
        rig=rig,
        bearings=bearings,
        frequency=tuple(np.asarray(frequency, float).tolist()),
        directional=settings.response == "dFRF",
        names=names,
        scale=scale,
        low=low,
        high=high,
        prior=prior,
        mesh=mesh,
    )


def _centre(rig: RotorRig, centre: dict[str, float]) -> RotorRig:
    """The rig at the prior means, around which the tables are made."""
    film_values = {name: value for name, value in centre.items() if name not in ("beta", *SCALES)}
    rig = rig.with_bearings((), **film_values) if film_values else rig
    return replace(rig, rotor=replace(rig.rotor, beta=centre["beta"])) if "beta" in centre else rig


def _reach(
    settings: WearSettings, prior: Gaussian, rig: RotorRig
) -> tuple[TableRange, dict[str, tuple[float, float]]]:
    box = {DEPTH: (0.0, settings.depth_limit), ANGLE: (-settings.angle_limit, settings.angle_limit)}
    for name, mean, std in zip(prior.names, prior.mean, prior.std, strict=True):
        low, high = box.get(name, (-np.inf, np.inf))
        box[name] = (max(low, mean - REACH * float(std)), min(high, mean + REACH * float(std)))
    if "cavitation_pressure" in box:
        box["cavitation_pressure"] = (box["cavitation_pressure"][0], min(box["cavitation_pressure"][1], 0.0))
    viscosity, clearance = (_factor(prior, box, name) for name in ("viscosity", "clearance"))
    # A pressure that is given, not estimated, needs its axis in the table as well.
    films = [place.film("wear") for place in rig.bearings if place.is_film]
    lowest = min(
        [box.get("cavitation_pressure", (0.0,))[0], *(1.25 * film.cavitation_pressure for film in films)]
    )
    limits = settings.depth_limit, settings.angle_limit
    return tables.table_range(*limits, viscosity, clearance, cavitation_pressure=lowest), box


def _factor(prior: Gaussian, box: dict[str, tuple[float, float]], name: str) -> float:
    if name not in box:
        return 1.0
    mean = prior.mean[prior.names.index(name)]
    return TABLE_MARGIN * max(box[name][1] / mean, mean / box[name][0])


# Terms of the matrix in row-major order: yy yz zy zz, or ff fb bf bb.
PLACES = {"full": (0, 1, 2, 3), "direct": (0, 3), "cross": (1, 2)}
NAMES = {"FRF": ("y", "z"), "dFRF": FORWARD_BACKWARD}
# Step of the central differences by a direction [rad].
SMALL_ANGLE = 1e-5


@dataclass(frozen=True)
class WornReceptance:
    """The receptance *measured* (n_line, 2, 2) [m/N] on the fit's *lines*, a mask (n_frequency,), in its
    frame; *places* of the terms used; *errors*: what sources of systematic error do to it.
    """

    measured: Measured
    places: tuple[int, ...]
    names: tuple[str, str]
    lines: BoolArray
    errors: tuple[MatrixError, ...] = ()

    @property
    def frequency(self) -> FloatArray:
        """(n_line,) [Hz]."""
        return self.measured.omega / (2 * np.pi)

    def terms(self, matrix: ComplexArray) -> ComplexArray:
        """Terms used, (..., n_line, n_term, 1) [m/N], of matrices (..., n_line, 2, 2) [m/N]."""
        flat = matrix.reshape(*matrix.shape[:-2], 4)
        return flat[..., list(self.places)][..., None]

    @property
    def chosen(self) -> Measured:
        """The measured terms as one column, with their covariance."""
        measured, index = self.measured, list(self.places)
        covariance = None if measured.covariance is None else measured.covariance[:, index][:, :, index]
        return replace(measured, matrix=self.terms(measured.matrix), covariance=covariance)


def worn_receptance(response: FrequencyResponse, settings: FitSettings, wear: WearSettings) -> WornReceptance:
    """Lines, frame and terms of a fit; ConfigError where the response has none such, FitError for no line."""
    left, right = _turn(response, wear.response)
    lines = _lines(response, settings.band, wear)
    measured = measured_part(response, [0, 1], [0, 1], lines)
    turn = np.kron(left, right.T)
    covariance = measured.covariance
    if covariance is not None:
        covariance = without_rounding(turn @ covariance @ turn.conj().T)
    turned = replace(measured, matrix=left @ measured.matrix @ right, covariance=covariance, errors=())
    errors = [replace(error, change=left @ error.change @ right) for error in matrix_errors(measured)]
    errors += _direction_errors(response, wear.response, measured.matrix)
    return WornReceptance(turned, PLACES[wear.terms], NAMES[wear.response], lines, tuple(errors))


def _direction_errors(response: FrequencyResponse, frame: str, matrix: ComplexArray) -> list[MatrixError]:
    errors = []
    for side in ("outputs", "inputs"):
        ports = getattr(response, side)
        for number, port in enumerate(ports):
            for calibration in port.uncertainties:
                if calibration.effect == "direction" and port.angle is not None:
                    ends = []
                    for step in (SMALL_ANGLE, -SMALL_ANGLE):
                        turned = replace(port, angle=port.angle + step)
                        moved: Any = (*ports[:number], turned, *ports[number + 1 :])
                        left, right = _turn(replace(response, **{side: moved}), frame)
                        ends.append(left @ matrix @ right)
                    slope = (ends[0] - ends[1]) / (2 * SMALL_ANGLE)
                    angle = calibration.uncertainty
                    errors.append(MatrixError(angle, angle.std_error * slope))
    return errors


def _turn(response: FrequencyResponse, frame: str) -> tuple[ComplexArray, ComplexArray]:
    """L and R of L H R, from the response's own frame to the fit's."""
    if len(response.outputs) != 2 or len(response.inputs) != 2:
        ports = f"responses {labels(response.outputs)}, forces {labels(response.inputs)}"
        what = f"worn-bearing takes two responses and two forces, found {ports}"
        raise ConfigError(what, hint="excite in y, then in z")
    # (responses) = P (y, z): P of the sensors' directions, or A^-1 of forward and backward.
    directional = _is_directional(response.outputs)
    sensing = np.linalg.inv(FROM_DIRECTIONAL) if directional else _rows_in_yz(response.outputs, "responses")
    left = np.linalg.inv(sensing)
    right = np.linalg.inv(
        FROM_DIRECTIONAL if _is_directional(response.inputs) else _rows_in_yz(response.inputs, "forces").T
    )
    if frame == "dFRF":
        return np.linalg.inv(FROM_DIRECTIONAL) @ left, right @ FROM_DIRECTIONAL
    return left, right


def _is_directional(ports: tuple[Port, ...]) -> bool:
    return tuple(port.label for port in ports) == FORWARD_BACKWARD


def _rows_in_yz(ports: tuple[Port, ...], role: str) -> ComplexArray:
    """Rows (along y, along z) of dofs y and z, else by angle, from horizontal (0) to up (90 deg)."""
    dofs = tuple(port.dof for port in ports)
    if set(dofs) == {"y", "z"}:
        return np.array([[dof == "y", dof == "z"] for dof in dofs], np.complex128)
    try:
        return directions(ports, role).astype(np.complex128)
    except DataError as error:
        hint = "give dof: y (horizontal) and dof: z (up), or angles from horizontal"
        raise ConfigError(error.what, hint=hint) from None


def _lines(response: FrequencyResponse, band: tuple[float, float] | None, wear: WearSettings) -> BoolArray:
    inside = lines_in(response.frequency, band)
    if wear.lines:
        away = np.where(inside, np.abs(response.frequency - np.array(wear.lines)[:, None]), np.inf)
        spacing = float(np.median(np.diff(response.frequency))) if response.frequency.size > 1 else 0.0
        chosen = np.zeros(response.frequency.shape, bool)
        for line, distances in zip(wear.lines, away, strict=True):
            place = int(np.argmin(distances))
            if distances[place] > 0.51 * spacing:
                what = f"there is no line near {line:g} Hz; the nearest is {response.frequency[place]:g} Hz"
                raise ConfigError(what, hint="is it masked or out of the band?")
            chosen[place] = True
        return chosen
    if wear.half_power:
        size = np.sqrt(np.sum(np.abs(response.matrix) ** 2, axis=(1, 2)))
        peaks = [half_power(response.frequency, size + 0j, around) for around in wear.half_power]
        inside &= np.any([lines_in(response.frequency, (peak.low, peak.high)) for peak in peaks], axis=0)
    if not np.any(inside):
        raise FitError("no frequency line is left", hint="widen the band")
    return inside


# From (modelled terms, their slopes) to (residual, its slopes), both as real columns.
Compared = Callable[[ComplexArray, ComplexArray], tuple[FloatArray, FloatArray]]


@dataclass
class WornMisfit:
    """Residual (n_equation,) [1] and its Jacobian at scaled parameters, the prior's rows last: what
    `compared` gives over its standard deviation *size*, which is 1 where the noise of the FRF is known.
    """

    model: WornModel
    receptance: WornReceptance
    _: KW_ONLY
    compared: Compared
    weighted: bool
    size: float = 1.0
    excess: float = 1.0
    evaluations: int = 0
    _last: tuple[bytes, FloatArray, FloatArray] | None = field(default=None, repr=False)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Weighted residual (n_equation,) [1] at scaled parameters (n,)."""
        return self._at(parameters)[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual by the scaled parameters, (n_equation, n) [1]."""
        return self._at(parameters)[1]

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] at scaled parameters (n,)."""
        residual = self.residual(parameters)
        return float(residual @ residual)

    @property
    def n_prior(self) -> int:
        return len(self.model.prior.names)

    def resize(self, size: float) -> WornMisfit:
        """The misfit in units of another standard deviation."""
        return replace(self, size=size, _last=None)

    def _at(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = np.asarray(parameters, float).tobytes()
        if self._last is None or self._last[0] != key:
            self.evaluations += 1
            response, slopes = self.model.response(parameters)
            residual, jacobian = self.compared(self.receptance.terms(response), self.receptance.terms(slopes))
            rows, mean = _prior_rows(self.model)
            joined = np.concatenate([residual / self.size, rows @ parameters - mean])
            self._last = (key, joined, np.concatenate([jacobian / self.size, rows]))
        return self._last[1], self._last[2]


def _prior_rows(model: WornModel) -> tuple[FloatArray, FloatArray]:
    """R and r of the prior's rows R p - r, of unit variance."""
    prior = model.prior
    if not prior.names:
        return np.zeros((0, len(model.names))), np.zeros(0)
    root = np.linalg.inv(np.linalg.cholesky(np.array(prior.covariance)))
    rows = np.zeros((len(prior.names), len(model.names)))
    first = len(model.names) - len(prior.names)
    rows[:, first:] = root * model.scale[first:]
    return rows, root @ np.array(prior.mean)


def complex_misfit(model: WornModel, measured: WornReceptance) -> WornMisfit:
    """e^H C^-1 e over the lines, e the complex residual of all terms and C its covariance (equal weights
    where no noise is known), scaled back by what few averages inflate it. Equation (wear-complex).
    """
    chosen = measured.chosen
    weighted = has_noise(chosen)
    weights = fit_weights(chosen)
    size = excess = 1.0
    if weighted:
        uncertainty = weight_uncertainty(measured.measured, max(chosen.n_equation - len(model.names), 1))
        size = float(np.sqrt(uncertainty.inflation))
        excess = uncertainty.excess / uncertainty.inflation

    def compare(response: ComplexArray, slopes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        return whiten_values(weights, response - chosen.matrix), whiten_values(weights, slopes).T

    return WornMisfit(model, measured, compared=compare, weighted=weighted, size=size, excess=excess)


def log_misfit(model: WornModel, measured: WornReceptance) -> WornMisfit:
    """log10(|H_model| / |H_measured|) of every line and term (Mendes et al. 2017). Equation (wear-log)."""
    matrix = measured.chosen.matrix
    if silent := measured.frequency[np.any(matrix == 0, axis=(1, 2))].tolist():
        what = f"a term at {silent[0]:g} Hz is zero, which has no logarithm"
        raise FitError(what, hint="choose other `lines` or `terms`, or `objective: complex`")

    def compare(response: ComplexArray, slopes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        residual = np.log10(np.abs(response) / np.abs(matrix)).reshape(-1)
        return residual, ((slopes / response).real / np.log(10)).reshape(slopes.shape[0], -1).T

    return WornMisfit(model, measured, compared=compare, weighted=False)


MISFITS: dict[str, Callable[[WornModel, WornReceptance], WornMisfit]] = {
    "complex": complex_misfit,
    "log": log_misfit,
}
