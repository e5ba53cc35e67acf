"""Where a baseline comes from: the fit of an earlier test, or given numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.forms import BANDS, FORMS, StiffnessModel, banded
from labpipe.dynamic_stiffness.given import Baseline
from labpipe.dynamic_stiffness.settings import DynamicStiffnessSettings
from labpipe.errors import ConfigError
from labpipe.identify.diagnostics import MISMATCH_P
from labpipe.identify.settings import FitSettings
from labpipe.records.dynamic_stiffness import DynamicStiffness, GivenDoubt
from labpipe.records.identification import Fit, Goodness
from labpipe.records.uncertain import Uncertain
from labpipe.registry import nearest

NONE = Uncertain(0.0)


def with_baseline(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    """Settings with the result of the earlier fit (or of the only one of the test) that `baseline` names; ConfigError if there is none."""
    stiffness_settings: DynamicStiffnessSettings = settings.model_settings
    if not stiffness_settings.baseline:
        return settings
    usable = [fit for fit in fits if fit.dynamic_stiffness is not None]
    baselines = [fit for fit in usable if fit.name == stiffness_settings.baseline] or [
        fit for fit in usable if fit.test == stiffness_settings.baseline
    ]
    if not baselines:
        hint = nearest(stiffness_settings.baseline, [fit.name for fit in usable])
        raise ConfigError(
            f"baseline: no earlier fit '{stiffness_settings.baseline}' of model dynamic-stiffness",
            hint=f"fits are made in their order; {hint}",
        )
    if len(baselines) > 1:
        tests = ", ".join(fit.test for fit in baselines)
        raise ConfigError(
            f"baseline: '{stiffness_settings.baseline}' has {len(baselines)} results ({tests})",
            hint="say `test:` in the fit of the baseline",
        )
    return replace(settings, model_settings=replace(stiffness_settings, known=baseline_of(baselines[0])))


def baseline_of(fit: Fit) -> Baseline:
    """The fitted stiffness of another fit as a baseline: its noise and its given numbers become doubts of this one.

    A residual beyond the noise counts as noise here as in the intervals of that fit.
    """
    shown = fit.dynamic_stiffness
    if shown is None or not fit.converged:
        raise ConfigError(f"the fit '{fit.name}' is no baseline: it did not converge")
    label = f"noise of {fit.name}" + (f", test {fit.test}" if fit.test else "")
    values, vectors = np.linalg.eigh(shown.noise / np.outer(_scale(shown), _scale(shown)))
    changes = _excess(fit.gof) * (vectors * np.sqrt(np.maximum(values, 0.0))).T * _scale(shown)
    return Baseline(fitted_model(shown), shown.values, (GivenDoubt(label, changes), *shown.doubts), fit.name, fit.test)


def _excess(gof: Goodness) -> float:
    """The factor of a residual that is larger than noise, else 1."""
    beyond = gof.chi2_reduced is not None and gof.chi2_p is not None and gof.chi2_p < MISMATCH_P
    return float(np.sqrt(gof.chi2_reduced)) if beyond and gof.chi2_reduced is not None else 1.0


def _scale(shown: DynamicStiffness) -> FloatArray:
    errors = np.sqrt(np.diag(shown.noise))
    return np.where(errors > 0, errors, 1.0)


def fitted_model(shown: DynamicStiffness) -> StiffnessModel:
    """The model of a fitted dynamic stiffness."""
    form = banded(np.array(shown.bands)) if shown.form == BANDS else FORMS[shown.form]
    return StiffnessModel(form, shown.symmetry)


def given_baseline(own: DynamicStiffnessSettings) -> Baseline | None:
    """The baseline of given numbers, the same in x and y; else that of an earlier fit; None without any."""
    if own.baseline_stiffness is None and own.baseline_damping is None:
        return own.known
    stiffness, damping = own.baseline_stiffness or NONE, own.baseline_damping or NONE
    pairs = (("stiffness of the baseline", stiffness, "N/m"), ("damping of the baseline", damping, "N.s/m"))
    doubts = tuple(
        GivenDoubt(
            number.source or f"{name}, {number.value:g} {unit} +- {number.std_error:g} {unit}",
            number.std_error * np.eye(2)[place][None],
            std_error=number.std_error,
            unit=unit,
        )
        for place, (name, number, unit) in enumerate(pairs)
        if number.std_error > 0
    )
    return Baseline(StiffnessModel(FORMS["kc"], "isotropic"), np.array([stiffness.value, damping.value]), doubts, "given numbers")
