"""Mode shapes with their doubt, their likeness and their phase."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.modal.likelihood import Refined
from labpipe.modal.residual_terms import ResidualTerms
from labpipe.modal.stabilisation import damping_ratio, similarity
from labpipe.records.modes import Modes, StabilisationDiagram
from labpipe.records.response import Port


def shape_record(
    refined: Refined,
    terms: ResidualTerms,
    points: Sequence[Port],
    references: Sequence[Port],
    forces_move: bool,
    diagram: StabilisationDiagram | None,
) -> Modes:
    """The record of the modes in ascending frequency, every shape 1 at its largest point."""
    order = np.argsort(np.abs(refined.poles))
    poles, raw, participation = refined.poles[order], refined.shapes[:, order], refined.participation[order]
    scale = raw[np.argmax(np.abs(raw), axis=0), np.arange(order.size)]
    shapes = raw / scale
    variance = np.einsum("omm->om", refined.shape_covariance)
    std = np.sqrt(variance[:, 0::2] + variance[:, 1::2])[:, order]
    return Modes(
        np.abs(poles) / (2 * np.pi),
        damping_ratio(poles),
        shapes=shapes,
        shape_std_errors=std / np.abs(scale),
        participation=participation,
        scale=scale,
        points=tuple(port.label for port in points),
        references=tuple(port.label for port in references),
        dofs=tuple(port.dof for port in points),
        forces_move=forces_move,
        mac=similarity(shapes.T, shapes.T),
        collinearity=phase_collinearity(shapes),
        lower=terms.lower,
        upper=terms.upper,
        diagram=diagram,
    )


def phase_collinearity(shapes: ComplexArray) -> FloatArray:
    """Modal phase collinearity (n_mode,) [1] of *shapes* (n_point, n_mode): 1 where all points move in one phase, 0 for no phase at all.

    ((S_xx - S_yy)^2 + 4 S_xy^2) / (S_xx + S_yy)^2 of real and imaginary part (Juang and Pappa 1985). Equation (modal-collinearity).
    """
    xx, yy = np.sum(shapes.real**2, axis=0), np.sum(shapes.imag**2, axis=0)
    xy = np.sum(shapes.real * shapes.imag, axis=0)
    return np.asarray(((xx - yy) ** 2 + 4 * xy**2) / (xx + yy) ** 2)
