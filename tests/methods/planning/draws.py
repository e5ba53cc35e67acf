"""An estimator of errors in variables written for the planner's tests, and the rigs with their limits."""

from __future__ import annotations

import numpy as np

from labpipe.methods.planning.campaigns import PlannedCampaign, PlannedRig, RigLimits
from labpipe.methods.planning.model import PlannedModel
from labpipe.methods.planning.search import Wanted
from tests.methods.planning.rigs import RIGS

SECONDS = 100.0


def planned_rig(name: str, model: PlannedModel | None = None) -> tuple[PlannedRig, np.ndarray, Wanted]:
    truth, noise, frequency = RIGS[name]()
    model = truth if model is None else model
    spacing = float(frequency[1] - frequency[0])
    force = {"pedestal": 1.0, "rotor": 2.0, "seal": 20e3}[name]
    rig = PlannedRig(
        model, noise, RigLimits(force), np.eye(model.n_dof, dtype=complex), ("x", "y")[: model.n_dof], spacing
    )
    return rig, np.round(frequency / spacing).astype(int), Wanted("minimax", np.ones(len(model.names)))


def estimates(
    truth: PlannedRig, parts: list[tuple[PlannedCampaign, float]], start: np.ndarray, draws: int, seed: int
) -> np.ndarray:
    """Errors in variables by Gauss-Newton with known noise, (draws, n_coefficient): z = [F, X, A], e = F -
    M_s A - D X.

    parts: campaigns with their seconds of data, all fitted together; what they apply moves the rig *truth*.
    """
    model, rng = truth.model, np.random.default_rng(seed)
    n = model.n_dof
    runs = []
    for told, seconds in parts:
        for test, share in zip(told.tests, told.shares, strict=True):
            omega = truth.omega(test)
            force = test.forces @ truth.directions
            moved = np.einsum("lij,lj->li", model.receptance(omega), force)
            # An amplitude from T seconds has the variance 2 S^2 / T.
            size = np.sqrt(2 / (share * seconds)) * np.array(
                [truth.noise.force, truth.noise.displacement, truth.noise.acceleration]
            )
            clean = (force, moved, -(omega[:, None] ** 2) * moved)
            shape = (draws, omega.size, n)
            noisy = []
            for part, deviation in zip(clean, size / np.sqrt(2), strict=True):
                noisy.append(part + deviation * (rng.normal(size=shape) + 1j * rng.normal(size=shape)))
            runs.append(
                (
                    model.elements_at(omega),
                    model.with_values(0 * model.expected).stiffness(omega),
                    noisy,
                    size**2,
                )
            )
    theta = np.tile(start, (draws, 1))
    for _ in range(6):
        theta = theta + _step(model, runs, theta)
    return theta


def _step(model: PlannedModel, runs: list, theta: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step: J = -E_i x^, x^ the displacement less the noise that the residual tells."""
    scales, n = model.scales, model.n_dof
    normal = np.zeros((len(theta), scales.size, scales.size))
    right = np.zeros((len(theta), scales.size))
    for elements, known, (force, moved, accelerated), variance in runs:
        stiffness = np.einsum("dn,lnij->dlij", theta, elements) + known
        residual = force - model.stator_mass * accelerated - np.einsum("dlij,dlj->dli", stiffness, moved)
        plain = variance[0] + model.stator_mass**2 * variance[2]
        covariance = plain * np.eye(n) + variance[1] * stiffness @ stiffness.conj().swapaxes(-1, -2)
        inverse = np.linalg.inv(covariance)
        weighted = np.einsum("dlij,dlj->dli", inverse, residual)
        smooth = moved + variance[1] * np.einsum("dlji,dlj->dli", stiffness.conj(), weighted)
        columns = np.einsum("lnij,dlj->dlin", elements, smooth) * scales
        heavy = np.einsum("dlij,dljn->dlin", inverse, columns)
        normal += np.einsum("dlin,dlim->dnm", columns.conj(), heavy).real
        right += np.einsum("dlin,dli->dn", heavy.conj(), residual).real
    return np.linalg.solve(normal, right[..., None])[..., 0] * scales
