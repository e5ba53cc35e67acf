"""Motion that has not died away when the first of the averaged periods begins: from the differences of
neighbouring periods.

A rig that starts from rest answers with its steady motion less a free one, which decays by exp(-zeta w_n T)
from one period T to the next. The squares of the differences of neighbouring periods then fall exponentially
to the level that noise leaves, whereas a drift leaves them as they are. Looked at in groups of lines: free
motion stands on a few of them, beside a resonance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy import special

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel
from labpipe.spectra.channels import columns_of

# Groups of lines, the least lines of one, and the differences from which on something can be told.
GROUPS, GROUP_LINES, FEWEST = 16, 4, 4
# Chance of a finding on a sound record, and degrees of freedom that the expected scatter counts for beside
# what is seen.
CHANCE, EXPECTED_DOF = 1e-4, 4.0
# Logarithm by which squares that fall evenly must do so in all: less is slow noise.
LEAST_FALL = 3.0
# Free motion below this share of the signal's power is of no account.
NEGLIGIBLE = 1e-10
# What is left in the mean of all periods, in power, over that of its noise, once enough periods are skipped.
SETTLED = 0.01


class Differences:
    """Squares of the differences of neighbouring periods by groups of lines and channels, fed period by
    period.
    """

    def __init__(self, n_line: int) -> None:
        """*n_line* lines of a spectrum."""
        self._starts = np.unique(
            np.linspace(0, n_line, max(min(GROUPS, n_line // GROUP_LINES), 1), endpoint=False).astype(int)
        )
        self._sizes = np.diff(np.append(self._starts, n_line))
        self._before: ComplexArray | None = None
        self._signal: FloatArray = np.zeros(0)
        self._squares: list[FloatArray] = []

    def add(self, amplitude: ComplexArray) -> None:
        """Add the spectrum (n_line, n_channel) [unit of the channel] of the next period."""
        if self._before is None:
            self._signal = self._by_group(amplitude)
        else:
            self._squares.append(self._by_group(amplitude - self._before))
        self._before = amplitude

    def _by_group(self, amplitude: ComplexArray) -> FloatArray:
        return np.asarray(np.add.reduceat(np.abs(amplitude) ** 2, self._starts, axis=0))

    def further(self, columns: Sequence[int]) -> dict[int, tuple[int, float]]:
        """Of the channels *columns* that have not settled: how many more periods to skip, and the decay of
        the motion per period [1].

        By logarithms of the squares, against Student's t at a chance of 1e-4 in all: the first one over the
        later half, where motion dies away within the record, and their slope, where it does not. Equation
        (spec-settling).
        """
        if len(self._squares) < FEWEST or not columns:
            return {}
        squares = np.array(self._squares)[:, :, columns]
        tiny = np.maximum(NEGLIGIBLE * self._signal[:, columns], np.finfo(float).tiny)
        logs = np.log(np.maximum(squares, tiny))
        unsettled: dict[int, tuple[int, float]] = {}
        for group, number in zip(*np.nonzero(self._falling(logs) & (squares[0] > tiny)), strict=True):
            course = np.exp(logs[:, group, number])
            half = len(course) - len(course) // 2
            level = float(np.exp(logs[half:, group, number].mean()))
            above = np.maximum(course[:half] - level, 0.0)
            # The sum of a geometric series without its first term, over all of it.
            decay = float(np.clip(above[1:].sum() / above.sum(), 1e-6, 0.99))
            noise = float(course.min()) / self._sizes[group]
            more = int(np.ceil(np.log(above[0] / (noise * SETTLED) * len(course)) / -np.log(decay)))
            unsettled[columns[number]] = max(
                unsettled.get(columns[number], (0, 0.0)), (max(more, 1), float(np.sqrt(decay)))
            )
        return unsettled

    def _falling(self, logs: FloatArray) -> BoolArray:
        """Whether the first of *logs* (n_difference, n_group, n_channel) [1] is far above the later ones, or
        all fall evenly.
        """
        n, half = len(logs), len(logs) - len(logs) // 2
        scatter = EXPECTED_DOF / self._sizes[:, None]
        late = logs[half:]
        dof = n - half - 1 + EXPECTED_DOF
        spread = (np.sum((late - late.mean(axis=0)) ** 2, axis=0) + scatter) / dof
        first = (logs[0] - late.mean(axis=0)) / np.sqrt(spread * (1 + 1 / len(late))) > -special.stdtrit(
            dof, CHANCE / logs[0].size
        )
        time = np.arange(n) - (n - 1) / 2
        slope = np.tensordot(time, logs, 1) / np.sum(time**2)
        rest = logs - logs.mean(axis=0) - time[:, None, None] * slope
        dof = n - 2 + EXPECTED_DOF
        spread = (np.sum(rest**2, axis=0) + scatter) / dof
        even = -slope * np.sqrt(np.sum(time**2) / spread) > -special.stdtrit(dof, CHANCE / logs[0].size)
        falls = first | (even & (-slope * n > LEAST_FALL))
        return np.asarray(falls & np.all(logs[0] > logs[1:half], axis=0))


def is_unsettled(findings: Iterable[Finding]) -> bool:
    """Whether motion had not died away, so that the scatter of the periods is not noise."""
    return any(finding.code == "not-settled" for finding in findings)


def settling_finding(
    differences: Differences, channels: Sequence[Channel], name: str, skip: int
) -> tuple[Finding, ...]:
    """A warning where the responses of the recording *name* have not settled after *skip* periods."""
    further = differences.further(columns_of(channels, "output"))
    if not further:
        return ()
    more, decay = max(further.values())
    names = ", ".join(channels[number].name for number in further)
    what = (
        f"recording '{name}': the motion of {names} has not died away after `skip: {skip}`: the first "
        f"periods approach the rest of them exponentially, by a factor of {decay:.2g} per period. Damping "
        f"above all is off by more than its errors: `skip: {skip + more}`, or let the force run that much "
        "longer before the record begins"
    )
    return (Finding("not-settled", what),)
