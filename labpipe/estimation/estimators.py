"""Estimators of models linear in their parameters, with the properties that code asks for.

Every estimator is looked at when a pipeline is read, so what fits is imported by the first fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from labpipe.arrays import FloatArray

if TYPE_CHECKING:
    from labpipe.estimation.budget import Case
    from labpipe.estimation.derived import BandModel
    from labpipe.estimation.measured import Measured
    from labpipe.estimation.statistics import Estimate

# From a model and data with other numbers to parameters (n_parameter,) [parameter units].
Step = Callable[["BandModel", "Measured"], FloatArray]


@dataclass(frozen=True)
class Estimator:
    """fit: from a measured FRF, a model and the key `weight` to an Estimate; and what is true of the
    estimator.

    refuses: keys of a fit that it has no use for. linear: it needs a model linear in its parameters; else one
    with `receptance` and `jacobian` will do. one_frf: it needs a model of one FRF. likelihood: its estimate
    is the minimum of the output error, weighted by the noise. models_leakage: it compares random data with
    what leakage makes of the model. unbiased: a right model leaves nothing but noise. phase: it uses the
    phase. step: one more step from the estimate of a case, on which the budget rests; None: that of ml where
    the estimate is that of ml, else the fit is repeated.

    The defaults are those of an output error of its own weights.
    """

    fit: Callable[[Any, Any, str], Estimate]
    refuses: tuple[str, ...] = ("weight",)
    linear: bool = False
    one_frf: bool = False
    likelihood: bool = False
    models_leakage: bool = True
    unbiased: bool = True
    phase: bool = True
    step: Callable[[Case], Step] | None = None


def _regression() -> Any:
    from labpipe.estimation import regression

    return regression


def _budget() -> Any:
    from labpipe.estimation import budget

    return budget


def _maximum_likelihood(measured: Measured, model: Any, weight: str) -> Estimate:
    from labpipe.estimation.likelihood import maximum_likelihood

    return maximum_likelihood(measured, model, weight)


def _amplitudes(measured: Measured, model: Any, weight: str) -> Estimate:
    from labpipe.estimation.amplitude import amplitude_fit

    return amplitude_fit(measured, model, weight)


LS = Estimator(
    lambda *of: _regression().least_squares(*of),
    refuses=("damping",),
    linear=True,
    models_leakage=False,
    unbiased=False,
    step=lambda case: _budget().least_squares_step(case),
)
IV = replace(
    LS,
    fit=lambda *of: _regression().instrumental_variables(*of),
    step=lambda case: _budget().instrumental_step(case),
)
ML = Estimator(_maximum_likelihood, likelihood=True, step=lambda case: _budget().likelihood_step(case))
# Without a phase, and of few equations: the fit is repeated.
AMPLITUDE = Estimator(
    _amplitudes, refuses=("damping",), linear=True, one_frf=True, models_leakage=False, phase=False
)
