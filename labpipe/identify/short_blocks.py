"""leakage: blocks of random data too short for the damping that a fit found, and the length that would do."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.estimators import Estimator
from labpipe.identify.measured import Measured
from labpipe.identify.model import Matrices
from labpipe.identify.modes import modes
from labpipe.records.finding import Finding
from labpipe.spectra.joint import is_joint

# Lines in the half-power width of a mode below which its damping is biased by more than its standard error; below which the expected
# leakage, though part of the model (ml of an H1), decides on it.
ENOUGH_LINES, FEWEST_LINES = 10.0, 1.5
# Lines in the half-power width times degree of local polynomials below which their bias counts against the standard error: 16 lines for
# degree 2 and 8 for degree 4 leave 95 % of the intervals right, half as many 88 % and 70 %.
LINES_BY_DEGREE = 30.0
# Bias of the damping by one line in the half-power width, and its fall with their number n: 14 % at 1, 4 % at 2, 0.5 % at 8 (Hann).
BIAS, FALL = 14.0, 1.6


def leakage_findings(measured: Measured, whole: Matrices, estimator: Estimator) -> list[Finding]:
    """A warning where the block times the half-power width 2 zeta f_n [lines] of the most lightly damped mode in the band is small.

    *whole*: K, C and M of the fitted model. Nothing for data that are not random, or a model without modes in the band.
    """
    blocks = measured.blocks
    narrowest = None if blocks is None else _narrowest(measured, whole)
    # In a closed loop the force rings as the response does: what leaks are the poles of the loop, not those of the fitted model.
    if blocks is None or narrowest is None or is_joint(blocks):
        return []
    frequency, width = narrowest
    lines, modelled = blocks.length * width, estimator.models_leakage and measured.leakage is not None
    enough = LINES_BY_DEGREE / blocks.degree if blocks.degree else FEWEST_LINES if modelled else ENOUGH_LINES
    if lines >= enough:
        return []
    needed = f"blocks of at least {_rounded_up(enough / width):g} s"
    which = f"the mode at {frequency:.4g} Hz is {width:.2g} Hz wide (half power), {lines:.2g} lines of blocks of {blocks.length:.3g} s"
    if blocks.degree:
        return [
            Finding(
                "leakage",
                f"{which}: local polynomials of degree {blocks.degree} do not follow its peak; use {needed}, or a higher `degree`",
            )
        ]
    if modelled:
        return [Finding("leakage", f"{which}: its damping comes from the window's leakage more than from the measurement; use {needed}")]
    bias = f"its damping comes out up to {BIAS * lines**-FALL:.1g} % too large, which no standard error shows"
    other = "" if measured.leakage is None else ", or the estimator ml, which takes the leakage into the model"
    return [Finding("leakage", f"{which}: {bias}; use {needed}{other}")]


def _narrowest(measured: Measured, whole: Matrices) -> tuple[float, float] | None:
    """(frequency, half-power width) [Hz] of the most lightly damped mode in the band, None without one."""
    if np.linalg.matrix_rank(whole.mass) < whole.mass.shape[0]:
        return None
    modal = modes(Matrices(whole.stiffness[None], whole.damping[None], whole.mass[None], whole.force[None]))
    if modal is None:
        return None
    frequency: FloatArray = modal.frequency[0]
    width = 2 * modal.damping[0] * frequency
    band = measured.omega[[0, -1]] / (2 * np.pi)
    inside = (frequency >= band[0]) & (frequency <= band[1]) & (width > 0)
    if not np.any(inside):
        return None
    chosen = int(np.argmin(np.where(inside, width, np.inf)))
    return float(frequency[chosen]), float(width[chosen])


def _rounded_up(length: float) -> float:
    """The length [s] with two digits, not below it."""
    digit = 10.0 ** (np.floor(np.log10(length)) - 1)
    return float(np.ceil(length / digit * (1 - 1e-9)) * digit)
