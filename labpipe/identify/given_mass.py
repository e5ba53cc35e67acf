"""The given mass held against the mass that the data prefer: a wrong one makes stiffness wrong, however good the fit.

Near a resonance the curve knows k / m much better than k and m, so that k follows a wrong mass in proportion and the goodness of fit
hardly changes. The height of the curve under a known force still tells the mass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import amount_text
from labpipe.distributions import f_tail
from labpipe.errors import FitError
from labpipe.identify.corrections import Estimated, corrected
from labpipe.identify.leakage import expected
from labpipe.identify.line_scatter import line_scatter
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel, Term, no_matrices
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import inverse_of
from labpipe.identify.setup import Setup
from labpipe.identify.weights import fit_weights, has_noise, weight_doubt
from labpipe.optimise.levenberg import minimise
from labpipe.records.finding import Finding

CONTRADICTED_P = 0.01
# Share of the chi-square beyond the noise that a free mass explains where the mass is what is wrong.
EXPLAINED = 0.5
MOST_STEPS = 40
# A given mass is taken as known to this share: forces and responses are hardly calibrated better, and a window's resolution at a sharp
# resonance, which no covariance holds, moves a free mass by tenths of a per cent.
TOLERANCE = 0.01


@dataclass(frozen=True)
class _Freed:
    """A model with its mass to be estimated: *names* of the masses, last among its parameters, and their *given* values [kg]."""

    model: DynamicModel
    names: tuple[str, ...]
    given: FloatArray


@dataclass(frozen=True)
class _FreeFit:
    """Output-error fit with free mass: all values, their covariance, and the degrees of freedom behind it."""

    values: FloatArray
    covariance: FloatArray
    dof: float


def mass_findings(measured: Measured, model: DynamicModel, values: FloatArray, setup: Setup) -> list[Finding]:
    """A finding where the data contradict the given mass; *values* (n_parameter,) [parameter units] of the fit with it.

    Whatever the fit's estimator, the mass is freed in an output-error fit from its values, since least squares would be biased by
    noise. No finding where the mass was not given, or the forces' factors are estimated too: the curve knows ratios only then. Nor in
    sliding bands, which are for stiffness that changes with frequency: within a band that looks like another mass. Equation (est-mass).
    """
    freed = _freed(model, setup)
    if freed is None or setup.settings.sliding is not None:
        return []
    fit = _free_fit(measured, freed.model, np.concatenate([values, freed.given]))
    if fit is None:
        return []
    p_value = _p_value(fit, freed.given)
    return [Finding("mass", _message(freed, fit, values, p_value, setup))] if p_value < CONTRADICTED_P else []


def _freed(model: DynamicModel, setup: Setup) -> _Freed | None:
    """The model with a term per mass: a single one for a mass that is one number, else one per dof; None without given mass or force."""
    given, force = model.constant.mass, model.constant.force
    diagonal = np.diag(given)
    if not np.any(diagonal > 0) or not np.any(force):
        return None
    empty = no_matrices(*force.shape)
    if isinstance(setup.settings.mass, float | int):
        parts = {"m": given / diagonal[0]}
    else:
        dofs = [port.dof or port.label for port in setup.outputs]
        units = np.eye(diagonal.size)
        parts = {f"m_{dof}_{dof}": np.outer(units[n], units[n]) for n, dof in enumerate(dofs) if diagonal[n] > 0}
    amounts = np.array([float(np.max(given * part)) for part in parts.values()])
    rest = given - np.tensordot(amounts, np.array(list(parts.values())), 1)
    terms = tuple(Term(name, "kg", replace(empty, mass=part)) for name, part in parts.items())
    free = replace(model, terms=(*model.terms, *terms), constant=replace(model.constant, mass=rest))
    return _Freed(free, tuple(parts), amounts)


def _free_fit(measured: Measured, model: DynamicModel, start: FloatArray) -> _FreeFit | None:
    """The fit from *start* (n_parameter,); None where the data cannot tell the mass.

    Its covariance comes from the measured noise where that explains the residual. Else it comes from the residual's own scatter along the
    lines, and of a measured excess the free mass must explain most: otherwise something else is wrong with the model.
    """
    weighted = has_noise(measured)
    try:
        problem = OutputError(measured, expected(measured, model), fit_weights(measured))
        minimum = minimise(problem, start, most_steps=MOST_STEPS, linearise=problem.linearised)
        if not minimum.converged:
            return None
        linear = problem.linearised(minimum.values)
        inverse, dof = inverse_of(linear), linear.n_equation - minimum.values.size
        if weighted:
            doubt = weight_doubt(measured, dof)
            after, of_noise = linear.chi2, dof * doubt.excess
            if doubt.p_value(after / of_noise, dof) >= CONTRADICTED_P:
                return _FreeFit(minimum.values, doubt.inflation * inverse, dof)
            if after - of_noise > (1 - EXPLAINED) * (problem.chi2(start) - of_noise):
                return None
        scatter = line_scatter(problem.jacobian(minimum.values), problem.residual(minimum.values), measured.omega.size)
    except (FitError, np.linalg.LinAlgError):
        return None
    return _FreeFit(minimum.values, scatter.covariance, float(np.min(scatter.dof)))


def _least_square(whiten: FloatArray, off: FloatArray, limits: FloatArray) -> float:
    """The least |whiten (off - x)|^2 [1] of shifts x (n_mass,) [kg] within +- *limits* [kg]."""
    if off.size == 1:
        return float((whiten[0, 0] * max(abs(off[0]) - limits[0], 0.0)) ** 2)
    from scipy import optimize  # takes a third of a second

    return 2 * float(optimize.lsq_linear(whiten, whiten @ off, (-limits, limits)).cost)


def _p_value(fit: _FreeFit, given: FloatArray) -> float:
    """Chance of masses so far from the *given* ones (n_mass,) if these are right within TOLERANCE: Hotelling's T^2 of all together."""
    n = given.size
    covariance, off, limits = fit.covariance[-n:, -n:], fit.values[-n:] - given, TOLERANCE * given
    if not np.any(covariance):
        # FRFs that the model meets to the last digit.
        return 1.0 if np.all(np.abs(off) <= limits) else 0.0
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    square, rest = _least_square(whiten, off, limits), fit.dof - n + 1
    return f_tail(square * rest / (fit.dof * n), n, rest) if rest > 0 and square > 0 else 1.0


def _message(freed: _Freed, fit: _FreeFit, values: FloatArray, p_value: float, setup: Setup) -> str:
    n, model = len(freed.names), freed.model
    free = corrected(Estimated(model.names, model.units, fit.values, fit.covariance), setup.settings)
    before = corrected(Estimated(model.names[:-n], model.units[:-n], values, np.zeros((values.size, values.size))), setup.settings)
    masses = ", ".join(
        f"{name} = {_amount(given, 'kg')} was given, free it comes out as {_amount(free.value(name), 'kg', free.std_error(name))}"
        for name, given in zip(freed.names, freed.given, strict=True)
    )
    stiffness = [name for name, unit in zip(before.names, before.units, strict=True) if unit == "N/m"]
    changed = max(stiffness, key=lambda name: abs(free.value(name) - before.value(name)), default=None)
    becomes = ""
    if changed is not None:
        error = free.std_error(changed)
        becomes = f" {changed} is then {_amount(free.value(changed), 'N/m', error)} instead of {_amount(before.value(changed), 'N/m')}."
    return (
        f"the data contradict the given mass by more than {100 * TOLERANCE:g} % (p = {p_value:.2g}): {masses}.{becomes} Either the mass "
        "or the calibration is wrong, or stiffness changes with frequency in the band. Weigh what moves, calibrate, fit with "
        "`mass: estimate`, or narrow the band"
    )


def _amount(value: float, si_unit: str, std_error: float | None = None) -> str:
    """Value, with its standard error where there is one, in the unit in which people read it."""
    return amount_text(value, std_error, si_unit, "+-")
