"""What a magnet's fit says besides its numbers: findings, notes, and the response that its figure draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import number
from labpipe.magnet.estimate import MagnetEstimate, noise_of
from labpipe.magnet.likelihood import unweighted
from labpipe.magnet.rotor import Levitation
from labpipe.records.finding import Finding, note
from labpipe.records.identification import FittedCurve
from labpipe.records.settings import Doubts

# Loss of the standard errors to few degrees of freedom beyond which it is said.
LOSS = 1.1
# Condition number of the currents of all runs beyond which a line does not tell X per I.
ONE_DIRECTION = 1e3


def remedy(_group: Sequence[str]) -> str:
    """What separates parameters that the lines cannot tell apart."""
    return (
        "the rotor moves and is driven in one way only: excite the axes one after the other or by independent signals, widen the band so "
        "that K_s and w^2 M differ in their course, or estimate fewer terms, `coupling: direct`"
    )


def mismatch_findings(best: MagnetEstimate, factor: float) -> tuple[Finding, ...]:
    """A warning where the residual is larger than noise by *factor*."""
    if factor == 1.0:
        return ()
    message = (
        f"the residual is {factor:.3g} times what the measured noise explains (chi-square per degree of freedom {best.reduced:.3g}, "
        f"p = {best.p_value:.2g}): the rotor is no rigid mass in the band (bending, a moving housing), another force acts, the mass is "
        f"wrong, or the magnet is not linear at this amplitude. Standard errors are {factor:.3g} times those of noise alone. Narrow the "
        "band; where the current was sampled without a filter behind a held output, give `hold`"
    )
    return (Finding("model-mismatch", message),)


def noise_findings(rotor: Levitation) -> tuple[Finding, ...]:
    """A note where few periods or blocks widen the intervals."""
    noise = noise_of(rotor)
    loss = float(np.sqrt(noise.inflation / noise.shared * (noise.dof - noise.equations) / noise.dof)) if np.isfinite(noise.dof) else 1.0
    if loss < LOSS:
        return ()
    message = (
        f"the covariance of the channels has {noise.dof:.3g} degrees of freedom: standard errors are {loss:.3g} times those with a "
        "known one. Average more periods, or let neighbouring lines share their noise"
    )
    return (note("few-averages", message),)


def fit_notes(rotor: Levitation, best: MagnetEstimate, doubts: Doubts) -> tuple[str, ...]:
    """Sign and size of what was estimated, its use as a force, and what least squares without regard to noise would give."""
    n = rotor.n_axis
    size = 1e6 * np.sqrt(np.mean(np.sum(np.abs(rotor.axes[..., n:]) ** 2, axis=0) / 2))
    notes = [
        "magnet: M x'' = K_i i - K_s x. K_s is a stiffness: negative where the bias field pulls the rotor away from the centre (the "
        f"`negative_stiffness` of a bearing file is -k_s). It holds for motions of this size: r.m.s. {size:.3g} um."
    ]
    if n == 1:
        values = dict(zip(best.model.names, best.values, strict=True))
        errors = dict(zip(best.model.names, np.sqrt(np.diag(best.covariance)), strict=True))
        current, motion = (rotor.spectra.channels[int(np.flatnonzero(row)[0])].name for row in rotor.to_axes)
        terms = ", ".join(
            f"{name}: {sign * values[kind]:.6g} {unit} +- {errors[kind]:.2g} {unit}"
            for name, kind, sign, unit in ((current, "k_i", 1, "N/A"), (motion, "k_s", -1, "N/m"))
        )
        notes.append(f"magnet: force from current and displacement as a channel of the rig file: {{sum: {{{terms}}}, quantity: force}}.")
    plain = zip(best.model.names, unweighted(rotor, best.model), best.model.units, strict=True)
    listed = ", ".join(f"{name} {number(float(value))} {unit}" for name, value, unit in plain if not name.startswith("c"))
    notes.append(f"magnet: least squares that takes currents and displacements for free of noise gives {listed}; it is not to be used.")
    if "mass" not in dict(doubts):
        notes.append("magnet: the mass counts as exact, and all results are in proportion to it: give its doubt (4 kg +- 5 g).")
    return tuple(notes)


def drawn(rotor: Levitation, best: MagnetEstimate) -> FittedCurve | None:
    """Displacement per current, X I^-1 of the runs, against the model; none where a line has too few runs."""
    axes, n = rotor.axes, rotor.n_axis
    currents, motions = (part.swapaxes(-1, -2) for part in (axes[..., :n], axes[..., n:]))
    if axes.shape[1] < n or np.any(np.linalg.cond(currents) > ONE_DIRECTION):
        return None
    inverse = np.linalg.pinv(currents)
    measured = motions @ inverse
    rows = best.model.rows(best.values, rotor.omega)
    fitted = -np.linalg.solve(rows[:, :, n:], rows[:, :, :n])
    channels = [rotor.spectra.channels[int(np.flatnonzero(row)[0])] for row in rotor.to_axes]
    return FittedCurve(
        rotor.omega / (2 * np.pi),
        measured,
        fitted,
        variance=_variance(rotor, measured, inverse),
        outputs=tuple(channel.dof for channel in channels[n:]),
        inputs=tuple(channel.name for channel in channels[:n]),
        form="displacement per current",
    )


def _variance(rotor: Levitation, measured: ComplexArray, inverse: ComplexArray) -> FloatArray:
    """E|d(X I^-1)|^2 (n_line, n, n) [(m/A)^2]: [-G, 1] C_z [-G, 1]^H of every run times what that run is in I^-1."""
    n = rotor.n_axis
    covariance = rotor.to_axes @ rotor.covariance @ rotor.to_axes.T
    rows = np.concatenate([-measured, np.broadcast_to(np.eye(n), measured.shape)], axis=2)
    noise = np.einsum("lkc,lrcd,lkd->lrk", rows, covariance, rows.conj()).real
    return np.asarray(np.einsum("lrk,lrm->lkm", noise, np.abs(inverse) ** 2))
