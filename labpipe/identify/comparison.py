"""Comparison of model structures: the model of a fit against simpler and richer ones on the same lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError, FitError
from labpipe.identify.constraints import constrained
from labpipe.identify.likelihood import maximum_likelihood
from labpipe.identify.measured import Measured
from labpipe.identify.order import MOST_STEPS, modal_chi2
from labpipe.identify.settings import ESTIMATE, MODELS, FitSettings
from labpipe.identify.setup import Setup
from labpipe.identify.weights import has_noise, weight_doubt, whitener
from labpipe.records.finding import Finding
from labpipe.records.identification import Candidate

# Difference in AIC to the best model beyond which a model has practically no support (Burnham and Anderson 2002, sec. 2.6).
NO_SUPPORT = 10.0


@dataclass(frozen=True)
class _Variant:
    """A model to compare: its name, its settings, and the names of the richer variants that contain it."""

    name: str
    settings: FitSettings
    inside: tuple[str, ...] = ()


def candidates(measured: Measured, setup: Setup) -> tuple[Candidate, ...]:
    """Every variant fitted by ml, in ascending order of AIC = chi-square + 2 parameters; none for an unknown noise.

    A variant without a minimum in MOST_STEPS of each start is left out. Without `compare` only the alternative to proportional damping:
    independent damping coefficients.
    p_value: probability of an equal or larger decrease of chi-square to the richest variant that contains this one, if this one is true
    (likelihood ratio, chi-square with as many degrees of freedom as additional parameters).
    """
    if not has_noise(measured):
        return ()
    whole = setup.settings.compare
    variants = _variants(setup.settings) if whole else _damping_variants(setup.settings)
    results = {variant.name: _fitted(measured, replace(setup, settings=variant.settings), variant.name) for variant in variants}
    fitted = {name: candidate for name, candidate in results.items() if candidate is not None}
    if whole:
        fitted.update(_orders(measured, setup))
    inside = {variant.name: [fitted[name] for name in variant.inside if name in fitted] for variant in variants}
    tested = [_tested(candidate, inside.get(name, [])) for name, candidate in fitted.items()]
    return tuple(sorted(tested, key=lambda candidate: candidate.aic))


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


def _orders(measured: Measured, setup: Setup) -> dict[str, Candidate]:
    """Rational fits with one mode less than dofs, as many, and one more: a test for modes missing in the model."""
    n_output = len(setup.outputs)
    orders = {}
    for modes in range(max(n_output - 1, 1), n_output + 2):
        fitted = modal_chi2(measured, whitener(measured), modes)
        if fitted is not None:
            raw, n_parameter = fitted
            name = f"{modes} mode{'s' if modes > 1 else ''}, any structure"
            dof = measured.n_equation - n_parameter
            chi2 = raw / weight_doubt(measured, dof).inflation
            orders[name] = Candidate(name, n_parameter, chi2, dof, chi2 + 2 * n_parameter)
    return orders


def _variants(settings: FitSettings) -> list[_Variant]:
    """Plausible alternatives: with and without cross terms, mass, symmetry, proportional damping."""
    plain = replace(settings, estimator="ml", weight="none", eliminate=False, sliding=None, bands=())
    return [_Variant(f"{THIS}: {_described(plain)}", plain, tuple(v.name for v in _richer(plain))), *_richer(plain), *_simpler(plain)]


def _damping_variants(settings: FitSettings) -> list[_Variant]:
    plain = replace(settings, weight="none", sliding=None)
    viscous = replace(plain, damping="viscous")
    return [_Variant(f"{THIS}: {_described(plain)}", plain, (_described(viscous),)), _Variant(_described(viscous), viscous)]


def _richer(settings: FitSettings) -> list[_Variant]:
    settings_of_variants = []
    if settings.model == "rotor-2dof-direct":
        settings_of_variants.append(replace(settings, model="rotor-2dof"))
    if settings.model == "mdof" and settings.symmetric:
        settings_of_variants.append(replace(settings, symmetric=False))
    if settings.damping == "proportional":
        settings_of_variants.append(replace(settings, damping="viscous"))
    if settings.model in ("sdof", "mdof") and settings.mass != ESTIMATE:
        settings_of_variants.append(replace(settings, mass=ESTIMATE, scale_mass=False))
    return [_Variant(_described(other), other) for other in settings_of_variants]


def _simpler(settings: FitSettings) -> list[_Variant]:
    this = f"{THIS}: {_described(settings)}"
    settings_of_variants = []
    if settings.model == "rotor-2dof":
        settings_of_variants.append(replace(settings, model="rotor-2dof-direct"))
    if settings.model == "mdof" and not settings.symmetric:
        settings_of_variants.append(replace(settings, symmetric=True))
    if settings.model in ("mdof", "rotor-2dof") and settings.damping == "viscous":
        settings_of_variants.append(replace(settings, damping="proportional"))
    if settings.model == "mdof" and settings.mass == ESTIMATE and not settings.lumped_mass:
        settings_of_variants.append(replace(settings, lumped_mass=True))
    return [_Variant(_described(other), other, (this,)) for other in settings_of_variants]


def _described(settings: FitSettings) -> str:
    parts = [settings.model]
    if settings.model == "mdof":
        parts.append("symmetric" if settings.symmetric else "general")
    if settings.damping == "proportional":
        parts.append("proportional damping")
    if settings.mass == ESTIMATE:
        parts.append("lumped mass estimated" if settings.lumped_mass else "mass estimated")
    return ", ".join(parts)


def _fitted(measured: Measured, setup: Setup, name: str) -> Candidate | None:
    """The variant's fit; None where it does not suit these ports, or does not converge."""
    try:
        model = constrained(MODELS[setup.settings.model](setup), setup.settings)
        estimate = maximum_likelihood(measured, model, most_steps=MOST_STEPS)
        doubt = weight_doubt(measured, estimate.dof)
    except (ConfigError, FitError):
        return None
    reduced = estimate.gof.chi2_reduced
    if not estimate.converged or reduced is None:
        return None
    # Differences between models follow the covariance of parameters (lost efficiency), not the expectation of the residual.
    chi2 = reduced * estimate.dof * doubt.excess / doubt.inflation
    return Candidate(name, len(model.names), chi2, estimate.dof, chi2 + 2 * len(model.names))


def _tested(candidate: Candidate, richer: list[Candidate]) -> Candidate:
    if not richer:
        return candidate
    richest = max(richer, key=lambda other: other.parameters)
    gained, added = candidate.chi2 - richest.chi2, richest.parameters - candidate.parameters
    return replace(candidate, p_value=chi2_tail(gained, added)) if added > 0 else candidate
