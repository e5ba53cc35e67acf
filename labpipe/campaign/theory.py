"""Fit against fit: the theory's transfer function, fitted like the measured one, and the factor between the two.

A one-dof fit of a coupled transfer function is not K_ii, and a bending shaft makes radial fits softer still. Therefore the theory's
stiffness matrix is multiplied by a factor and put in series with the shaft, its curve is fitted on the measured lines with the
measured weights, and factor and damping are changed until that fit gives the measured k and c. Neighbouring modes affect both alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.bending_curve import bent_transfer_matrix
from labpipe.bearings.rolling import DOFS
from labpipe.bearings.rolling_shaft import RigidShaft
from labpipe.campaign.common_sources import change_in
from labpipe.errors import ConfigError, FitError
from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.records.comparison import Overlay
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.settings import Uncertain
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import receptance_factor

TILTS = (3, 4)
STEP = 1e-4
TOLERANCE = 1e-8
# Steps smaller than this use the slopes of the previous step.
NEAR = 1e-3
LOOPS = 20
LARGEST_MOVE = 1.0


@dataclass(frozen=True)
class TheoryAt:
    """The theory at one condition: K (5, 5) [N/m, N/rad, N m/rad], K at a condition larger by the share *step*, and the shaft."""

    stiffness: FloatArray
    near: FloatArray
    step: float
    shaft: RigidShaft


@dataclass(frozen=True)
class Rig:
    """How the rig measures the bearing: bending stiffness of the shaft [N/m] (infinite: rigid), arm of tilts [m]."""

    bending: Uncertain
    arm: float | None


@dataclass(frozen=True)
class Matched:
    """The factor on the theory's K at which its curve gives the measured fit: ln ratio and ln beta (2,) [1] with covariance (2, 2).

    *to_sources*: change (2,) [1] of both by one standard uncertainty of each source of the fit's budget.
    *to_bending*, *to_condition* (2,) [1]: change of both per relative change of the shaft's stiffness and of the condition. *theory*:
    (k, c) of the fit of the theory's curve, with the measured damping.
    """

    log: FloatArray
    covariance: FloatArray
    to_bending: FloatArray
    to_condition: FloatArray
    theory: FloatArray
    to_sources: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class _Curve:
    """One term of a measured response on the lines of its fit, and the fit's settings for it alone."""

    response: FrequencyResponse
    settings: FitSettings
    place: tuple[int, int]
    arms: float


def match(fit: Fit, response: FrequencyResponse, settings: FitSettings, theory: TheoryAt, rig: Rig) -> Matched:
    """Solve ln(k, c)(ratio, beta) = ln(k, c) measured by Newton's method with numerical slopes.

    Raises ConfigError for a response whose dofs are not the bearing's, FitError where no ratio gives the measured fit.
    Equation (comp-match).
    """
    curve = _curve(fit, response, settings, rig)
    bending = rig.bending.value

    def fitted(log: FloatArray, stiffness: FloatArray, shaft_stiffness: float) -> FloatArray:
        beta = float(np.exp(log[1]))
        return _log_fit(curve, theory.shaft, float(np.exp(log[0])) * stiffness, beta, shaft_stiffness)

    measured = np.log([_positive(fit, "k"), _positive(fit, "c")])
    start = np.array([0.0, measured[1] - measured[0]])
    log, slopes = _solved(lambda u: fitted(u, theory.stiffness, bending), measured, start)
    inverse = np.linalg.inv(slopes)
    solution = fitted(log, theory.stiffness, bending)
    to_bending = np.zeros(2) if np.isinf(bending) else (fitted(log, theory.stiffness, bending * (1 + STEP)) - solution) / STEP
    to_condition = (fitted(log, theory.near, bending) - solution) / theory.step
    theoretical = np.exp(fitted(np.array([0.0, log[1]]), theory.stiffness, bending))
    covariance = inverse @ log_covariance(fit) @ inverse.T
    to_sources = {source: inverse @ change for source, change in _log_changes(fit).items()}
    return Matched(log, covariance, -inverse @ to_bending, -inverse @ to_condition, theoretical, to_sources)


def _solved(function: Callable[[FloatArray], FloatArray], target: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The root of function(u) = target and the slopes (2, 2) near it; FitError where there is none within reach."""
    u, slopes, size = start, np.eye(2), np.inf
    for _ in range(LOOPS):
        here = function(u)
        if size > NEAR:
            slopes = np.column_stack([(function(u + STEP * unit) - here) / STEP for unit in np.eye(2)])
        move = np.linalg.solve(slopes, target - here)
        u = u + np.clip(move, -LARGEST_MOVE, LARGEST_MOVE)
        size = float(np.max(np.abs(move)))
        if size < TOLERANCE:
            return u, slopes
    hint = "check bearing, condition, arm and the shaft's bending stiffness"
    raise FitError("no multiple of the theory's stiffness gives the measured fit", hint=hint)


def _positive(fit: Fit, name: str) -> float:
    value = fit.parameter(name).value
    if not value > 0:
        whose = f"of test {fit.test}" if fit.test else "of the theory's own curve"
        hint = "" if fit.test else "its resonance lies outside the band of the fit"
        raise FitError(f"{name} {whose} is {value:g}, impossible for the bearing of the theory", hint=hint)
    return value


def _log_changes(fit: Fit) -> dict[str, FloatArray]:
    """Change of ln k and ln c, (2,) [1], by one standard uncertainty of every source of a fit's budget."""
    if fit.budget is None:
        return {}
    names = ("k", "c")
    return {
        source.source: np.array([change_in(fit, source.source, name) / fit.parameter(name).value for name in names])
        for source in fit.budget.sources
    }


def log_covariance(fit: Fit) -> FloatArray:
    """Covariance of ln k and ln c, (2, 2) [1], from the fit's standard errors and correlation; FitError without standard errors."""
    names = [parameter.name for parameter in fit.parameters if not parameter.derived]
    places = [names.index("k"), names.index("c")]
    chosen = [fit.parameters[place] for place in places]
    if any(parameter.std_error is None for parameter in chosen):
        raise FitError(f"k or c of test {fit.test} has no standard error")
    relative = np.array([parameter.std_error / parameter.value for parameter in chosen])  # type: ignore[operator]
    return fit.correlation[np.ix_(places, places)] * np.outer(relative, relative)


def overlay(fit: Fit, response: FrequencyResponse, settings: FitSettings, theory: TheoryAt, rig: Rig, matched: Matched) -> Overlay:
    """|H| of the fitted term on all lines of the response: measured, theory with the measured damping, theory times the ratio."""
    curve = _curve(fit, response, settings, rig, whole=True)
    beta = float(np.exp(matched.log[1]))
    curves = [
        _theory_curve(curve, theory.shaft, factor * theory.stiffness, beta, rig.bending.value)
        for factor in (1.0, float(np.exp(matched.log[0])))
    ]
    sizes = (tuple(np.abs(values).tolist()) for values in (curve.response.matrix[:, 0, 0], *curves))
    return Overlay(fit.test, response.form, tuple(curve.response.frequency.tolist()), *sizes)


def _theory_curve(curve: _Curve, shaft: RigidShaft, stiffness: FloatArray, beta: float, bending: float) -> ComplexArray:
    """The measured term of the theory's transfer matrix, (n_frequency,)."""
    frequency = curve.response.frequency
    receptance = bent_transfer_matrix(shaft, stiffness, frequency, beta, bending)[:, *curve.place] * curve.arms
    return receptance * receptance_factor(curve.response.form, frequency)


def _log_fit(curve: _Curve, shaft: RigidShaft, stiffness: FloatArray, beta: float, bending: float) -> FloatArray:
    """ln(k, c) of the fit on the theory's curve."""
    matrix = _theory_curve(curve, shaft, stiffness, beta, bending)[:, None, None]
    (fit,) = identify(replace(curve.response, matrix=matrix), curve.settings, judging=False)
    return np.log([_positive(fit, "k"), _positive(fit, "c")])


def _curve(fit: Fit, response: FrequencyResponse, settings: FitSettings, rig: Rig, whole: bool = False) -> _Curve:
    """The part of the response that belongs to *fit*; *whole*: its term on all lines."""
    if not settings.kind.one_frf or fit.curve is None:
        raise ConfigError(f"fit '{fit.name}' is not of the model sdof", hint="only one-dof fits are compared with those of the theory")
    if settings.subtract is not None or settings.share != 1:
        raise ConfigError(f"fit '{fit.name}' is corrected for support or share", hint="compare the fit of the whole with the theory")
    row = [port.label for port in response.outputs].index(fit.curve.outputs[0])
    column = [port.label for port in response.inputs].index(fit.curve.inputs[0])
    lines = np.ones(response.n_frequency, bool) if whole else lines_in(response.frequency, fit.band_hz)
    element = row * len(response.inputs) + column
    covariance = None if response.covariance is None else response.covariance[lines][:, element, None][:, :, element, None]
    part = FrequencyResponse(
        response.frequency[lines],
        response.matrix[lines][:, row, None][:, :, column, None],
        # Fits of the theory's curve give values alone: no doubt of a sensor need be propagated in each of them.
        (replace(response.outputs[row], doubts=()),),
        (replace(response.inputs[column], doubts=()),),
        form=response.form,
        covariance=covariance,
        averages=response.averages,
        covariance_dof=response.covariance_dof,
    )
    places = (_place(response.outputs[row]), _place(response.inputs[column]))
    alone = replace(settings, peaks=(), bands=(fit.band_hz,), band=None, sliding=None, input=(), output=(), bootstrap=0, compare=False)
    return _Curve(part, alone, places, _arm(rig, places[0]) * _arm(rig, places[1]))


def _place(port: Port) -> int:
    name = next((name for name in (port.dof, port.label) if name in DOFS), None)
    if name is None:
        raise ConfigError(f"'{port.label}' is no dof of the bearing's theory", hint=f"give its dof in the rig file: {', '.join(DOFS)}")
    return DOFS.index(name)


def _arm(rig: Rig, place: int) -> float:
    """Displacement measured per dof; ConfigError for a tilt without an arm."""
    if place not in TILTS:
        return 1.0
    if rig.arm is None:
        raise ConfigError(f"the tilt {DOFS[place]} is compared without an arm", hint="theory: {arm: 100 mm}, the place of the shaker")
    return rig.arm
