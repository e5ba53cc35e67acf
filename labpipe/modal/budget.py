"""What systematic errors of sensors and of a given mass do to modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.budget import Source
from labpipe.identify.matrix_errors import changes_by, matrix_errors
from labpipe.identify.measured import Measured
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import solve_scaled
from labpipe.identify.weights import equal_weights, has_noise, whitener
from labpipe.modal.likelihood import Refined
from labpipe.modal.residual_terms import ResidualTerms
from labpipe.modal.whole_covariance import MOST_ENTRIES, ModalReceptance
from labpipe.records.identification import Parameter


def modal_sources(
    measured: Measured,
    terms: ResidualTerms,
    refined: Refined,
    parameters: Callable[[Refined], tuple[Parameter, ...]],
    *,
    real: bool = False,
) -> list[Source]:
    """Changes of the *parameters* of refined modes by every source in the FRFs' sensors and sums, (n_parameter,) [parameter units] each.

    Directions count where two points or more of known direction tell the motion in their plane, likewise two forces.

    One step of Gauss-Newton of the output-error fit from its estimate, p - (J^T J)^-1 J^T W dH; no fit is repeated. None where the
    Jacobian is too large to be held in memory.
    """
    errors = matrix_errors(measured, directions=True)
    model = ModalReceptance.of(terms, refined, measured, real=real)
    if not errors or model.n_parameter * measured.n_equation > MOST_ENTRIES:
        return []
    values = model.joined(refined, measured)
    problem = OutputError(measured, model, _weights(measured))
    jacobian = problem.jacobian(values)
    step = solve_scaled(jacobian, problem.residual(values))[1] @ jacobian.T

    def changed(change: ComplexArray) -> FloatArray:
        poles, participation, shapes, _ = model.split(values - step @ problem.whitened(change))
        again = replace(refined, poles=poles, participation=participation, shapes=shapes)
        return np.array([parameter.value for parameter in parameters(again)])

    return changes_by(errors, changed)


def _weights(measured: Measured) -> ComplexArray:
    """Those of the fit; equal ones where the covariance is not known or cannot be used."""
    if not has_noise(measured):
        return equal_weights(measured)
    try:
        return whitener(measured)
    except FitError:
        return equal_weights(measured)
