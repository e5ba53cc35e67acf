"""Comparison of model structures: the model of a fit against simpler and richer ones on the same lines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError, FitError
from labpipe.identify.constraints import constrained
from labpipe.identify.likelihood import maximum_likelihood
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.proportional import ProportionalModel
from labpipe.identify.rational_fit import RationalFit
from labpipe.identify.settings import ESTIMATE, FitSettings
from labpipe.identify.setup import Setup
from labpipe.identify.statistics import Estimate
from labpipe.identify.weights import has_noise, weight_doubt, whitener
from labpipe.records.finding import Finding
from labpipe.records.identification import Candidate

# Difference in AIC to the best model beyond which a model has practically no support (Burnham and Anderson 2002, sec. 2.6).
NO_SUPPORT = 10.0
# Bound of each descent of a variant: a structure that contradicts the data may have no minimum to reach.
MOST_STEPS = 40


@dataclass(frozen=True)
class _Variant:
    """A model to compare: its name, its settings, and the names of the richer variants that contain it."""

    name: str
    settings: FitSettings
    inside: tuple[str, ...] = ()


def candidates(measured: Measured, setup: Setup, ml_estimate: Estimate | None = None) -> tuple[tuple[Candidate, ...], tuple[str, ...]]:
    """Every variant fitted by ml, in ascending order of AIC = chi-square + 2 parameters, and the names of those that did not converge.

    None for an unknown noise. *ml_estimate*: that of the fit itself, where it is by ml; else this model is fitted again. Every descent is
    bounded. Without `compare` only the alternative to proportional damping: independent damping coefficients.
    p_value: probability of an equal or larger decrease of chi-square to the richest variant that contains this one, if this one is true
    (likelihood ratio, chi-square with as many degrees of freedom as additional parameters). Equation (est-aic).
    """
    if not has_noise(measured):
        return (), ()
    whole = setup.settings.compare
    variants = _variants(setup.settings) if whole else _damping_variants(setup.settings)
    models = {variant.name: _model(replace(setup, settings=variant.settings)) for variant in variants}
    results: dict[str, Candidate | None] = {}
    for name, model in models.items():
        if model is not None:
            estimate = ml_estimate if ml_estimate and name.startswith(THIS) else _estimate(measured, model)
            results[name] = _candidate(name, measured, estimate) if estimate and estimate.converged else None
    if whole:
        results.update(_orders(measured, len(setup.outputs)))
    fitted = {name: candidate for name, candidate in results.items() if candidate is not None}
    inside = {variant.name: [fitted[name] for name in variant.inside if name in fitted] for variant in variants}
    tested = [_tested(candidate, inside.get(name, [])) for name, candidate in fitted.items()]
    return tuple(sorted(tested, key=lambda candidate: candidate.aic)), tuple(name for name in results if name not in fitted)


def comparison_notes(left_out: tuple[str, ...]) -> tuple[str, ...]:
    """A note that names the variants without a minimum."""
    return (f"Compared models left out, their descents found no minimum: {'; '.join(left_out)}.",) if left_out else ()


def comparison_findings(ranking: tuple[Candidate, ...]) -> tuple[Finding, ...]:
    """A warning where another model than the fit's (its name begins with THIS) is much better supported."""
    this_model = next((candidate for candidate in ranking if candidate.name.startswith(THIS)), None)
    if this_model is None or this_model.aic - ranking[0].aic < NO_SUPPORT:
        return ()
    best = ranking[0]
    message = (
        f"another model is better supported by the data: '{best.name}' with {best.parameters} parameters has AIC {best.aic:.4g}, this one "
        f"with {this_model.parameters} parameters {this_model.aic:.4g}"
    )
    return (Finding("other-model", message),)


THIS = "this model"


def _orders(measured: Measured, n_output: int) -> dict[str, Candidate | None]:
    """Rational fits with one mode less than dofs, as many, and one more: a test for modes missing in the model."""
    weights = whitener(measured)
    fits = [RationalFit(measured, weights, modes) for modes in range(max(n_output - 1, 1), n_output + 2)]
    names = [f"{fit.modes} mode{'s' if fit.modes > 1 else ''}, any structure" for fit in fits]
    return {name: _order(name, fit) for name, fit in zip(names, fits, strict=True) if measured.n_equation > fit.n_parameter}


def _order(name: str, fit: RationalFit) -> Candidate | None:
    raw, dof = fit.lowest_chi2(), fit.measured.n_equation - fit.n_parameter
    if raw is None:
        return None
    chi2 = raw / weight_doubt(fit.measured, dof).inflation
    return Candidate(name, fit.n_parameter, chi2, dof, chi2 + 2 * fit.n_parameter)


def _variants(settings: FitSettings) -> list[_Variant]:
    """Plausible alternatives: with and without cross terms, mass, symmetry, proportional damping."""
    plain = replace(settings, estimator="ml", weight="none", eliminate=False, sliding=None, bands=())
    return [_Variant(f"{THIS}: {_described(plain)}", plain, tuple(v.name for v in _richer(plain))), *_richer(plain), *_simpler(plain)]


def _damping_variants(settings: FitSettings) -> list[_Variant]:
    plain = replace(settings, weight="none", sliding=None)
    viscous = replace(plain, damping="viscous")
    return [_Variant(f"{THIS}: {_described(plain)}", plain, (_described(viscous),)), _Variant(_described(viscous), viscous)]


def _richer(settings: FitSettings) -> list[_Variant]:
    kind, changes = settings.kind, list[dict[str, Any]]()
    if kind.richer:
        changes.append({"model": kind.richer})
    if settings.symmetric:
        changes.append({"symmetric": False})
    if settings.damping == "proportional":
        changes.append({"damping": "viscous"})
    if kind.frees_mass and settings.mass != ESTIMATE:
        changes.append({"mass": ESTIMATE, "scale_mass": False})
    return [_Variant(_described(other), other) for other in _changed(settings, changes)]


def _simpler(settings: FitSettings) -> list[_Variant]:
    this = f"{THIS}: {_described(settings)}"
    kind, changes = settings.kind, list[dict[str, Any]]()
    if kind.simpler:
        changes.append({"model": kind.simpler})
    if "symmetric" in kind.keys and not settings.symmetric:
        changes.append({"symmetric": True})
    if "damping" in kind.keys and settings.damping == "viscous":
        changes.append({"damping": "proportional"})
    if "lumped_mass" in kind.keys and settings.mass == ESTIMATE and not settings.lumped_mass:
        changes.append({"lumped_mass": True})
    return [_Variant(_described(other), other, (this,)) for other in _changed(settings, changes)]


def _changed(settings: FitSettings, changes: Sequence[dict[str, Any]]) -> Iterator[FitSettings]:
    """The settings with each of the changes, where another model or key takes all of the others."""
    for change in changes:
        with contextlib.suppress(ConfigError):
            yield replace(settings, **change)


def _described(settings: FitSettings) -> str:
    parts = [settings.model]
    if "symmetric" in settings.kind.keys:
        parts.append("symmetric" if settings.symmetric else "general")
    if settings.damping == "proportional":
        parts.append("proportional damping")
    if settings.mass == ESTIMATE:
        parts.append("lumped mass estimated" if settings.lumped_mass else "mass estimated")
    return ", ".join(parts)


def _model(setup: Setup) -> DynamicModel | ProportionalModel | None:
    """The model of a variant; None where it does not suit these ports."""
    try:
        return constrained(setup.settings.kind.model(setup), setup.settings)
    except ConfigError:
        return None


def _estimate(measured: Measured, model: DynamicModel | ProportionalModel) -> Estimate | None:
    try:
        return maximum_likelihood(measured, model, most_steps=MOST_STEPS)
    except FitError:
        return None


def _candidate(name: str, measured: Measured, estimate: Estimate) -> Candidate:
    """Name, parameters, chi-square and AIC of an estimate by ml."""
    assert estimate.squares is not None
    doubt = weight_doubt(measured, estimate.dof)
    # Differences between models follow the covariance of parameters (lost efficiency), not the expectation of the residual.
    chi2 = estimate.squares / doubt.inflation
    n_parameter = estimate.values.size
    return Candidate(name, n_parameter, chi2, estimate.dof, chi2 + 2 * n_parameter)


def _tested(candidate: Candidate, richer: list[Candidate]) -> Candidate:
    if not richer:
        return candidate
    richest = max(richer, key=lambda other: other.parameters)
    gained, added = candidate.chi2 - richest.chi2, richest.parameters - candidate.parameters
    return replace(candidate, p_value=chi2_tail(gained, added)) if added > 0 else candidate
