"""How fast a resonance is swept: against the rule of ISO 7626-2, and against what the record resolves."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.spectra.peaks import HalfPower, half_power
from labpipe.spectra.sweeps import FoundSweep

# Lines in the half-power width that show a resonance at all; those that tell its leakage from its response. With half as many, the
# damping of a record cut in full motion was off by up to half its standard error (tests/oracles/test_sweep_coverage.py has 8 and 16).
FEWEST_LINES, LEAKING_LINES = 4.0, 8.0


def largest_rate(frequency: float, damping_ratio: float) -> float:
    """Sweep rate [Hz/s] up to which a resonance at *frequency* [Hz] reaches its steady amplitude: 216 f_n^2 zeta^2 Hz/min.

    ISO 7626-2 for a linear sweep, as in Ewins, Modal Testing, sec. 3.7; its 310 f_n zeta^2 octaves/min of a logarithmic sweep are the
    same rate at f_n. In half-power widths b = 2 zeta f_n it is 0.9 b per 1 / b. Equation (frf-sweep-rate).
    """
    return 216.0 / 60 * frequency**2 * damping_ratio**2


def rate_findings(
    frequency: FloatArray, matrix: ComplexArray, sweeps: Sequence[FoundSweep], rate: float, n_sample: int, *, leaking: bool
) -> tuple[Finding, ...]:
    """The highest resonance of each FRF that is swept faster than ISO 7626-2 allows: the one that is most so.

    A note where the record holds all that rings, for then the transforms give the FRF whatever the rate; a warning where the lines are
    too coarse for the resonance, or, when *leaking*, for the leakage that was taken out. frequency (n_line,) [Hz],
    matrix (n_line, n_output, n_input) [any unit]; *rate* of sampling [Hz]; *n_sample* of a block.
    """
    peaks = _peaks(frequency, matrix)
    if not peaks:
        return ()
    excess = [max(sweep.rate_at(p.frequency / rate) * rate**2 for sweep in sweeps) / _allowed(p) for p in peaks]
    worst = int(np.argmax(excess))
    peak, times = peaks[worst], excess[worst]
    if times <= 1:
        return ()
    width = peak.high - peak.low
    lines, enough = width * n_sample / rate, LEAKING_LINES if leaking else FEWEST_LINES
    message = (
        f"the resonance at {peak.frequency:.4g} Hz, {width:.3g} Hz wide (half power), is swept at {times * _allowed(peak):.3g} Hz/s, "
        f"{times:.3g} times the rate of ISO 7626-2 ({_allowed(peak):.3g} Hz/s): it does not reach its steady amplitude"
    )
    if lines >= enough:
        why = "since the ringing that the record lacks is estimated" if leaking else "since the record holds all that rings"
        return (note("sweep-rate", f"{message}; the FRF does not suffer, {why}"),)
    needed = f"{lines:.2g} lines in its width are too few, {enough:.3g} would do: sweep slower, or record until the response is at rest"
    return (Finding("sweep-rate", f"{message}; {needed}"),)


def _allowed(peak: HalfPower) -> float:
    return largest_rate(peak.frequency, peak.damping_ratio)


def _peaks(frequency: FloatArray, matrix: ComplexArray) -> list[HalfPower]:
    """The highest peak of every FRF that has one with its half-power points in the band."""
    peaks = []
    for row, column in itertools.product(range(matrix.shape[1]), range(matrix.shape[2])):
        try:
            peaks.append(half_power(frequency, matrix[:, row, column], (float(frequency[0]), float(frequency[-1]))))
        except (DataError, np.linalg.LinAlgError):
            continue
    return [peak for peak in peaks if peak.damping_ratio > 0]
