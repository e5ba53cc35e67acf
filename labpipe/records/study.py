"""The result of a Monte Carlo study: errors of every fit over many repeats, with their statistical
scatter.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass


@dataclass(frozen=True)
class StudiedParameter:
    """One parameter over the repeats that gave a result.

    *bound*: Cramer-Rao standard deviation of an unbiased estimate, None where it is not known. *std_error*:
    mean of what the fits stated, None where they stated none. *coverage*: share of 95 % intervals that hold
    the truth.
    """

    name: str
    unit: str
    _: KW_ONLY
    truth: float
    mean: float
    rmse: float
    bound: float | None
    std_error: float | None
    coverage: float | None

    @property
    def bias(self) -> float:
        return self.mean - self.truth


@dataclass(frozen=True, kw_only=True)
class StudyCase:
    """One fit at one noise level with one number of lines.

    *failed*: repeats without a result (no convergence, or refused). mean_error, median_error, error_variance:
    of the sum of squared parameter errors of all repeats that ended with numbers, a coefficient of a
    symmetric matrix counted at both its places; *success*: share of all repeats that ended in a result whose
    relative deviation is below each of the study's limits. rmse_over_bound: root mean square over the
    parameters of rmse / bound. *coverage*: mean over the parameters.
    """

    fit: str
    estimator: str
    noise: float
    lines: int
    repeats: int
    failed: int
    mean_error: float
    median_error: float
    error_variance: float
    success: tuple[float, ...]
    rmse_over_bound: float | None
    coverage: float | None
    parameters: tuple[StudiedParameter, ...]


@dataclass(frozen=True)
class StudyThreshold:
    """The noise level at which a fit's success rate falls under the study's share.

    None when it did not within the range searched.
    """

    fit: str
    limit: float
    noise: float | None
    repeats: int


@dataclass(frozen=True)
class Study:
    """All cases of a study. *limits*: relative deviations that count as success; *share*: the required
    success rate. *printed*: mean errors published elsewhere, by fit, one for each noise level.
    """

    rig: str
    seed: int
    limits: tuple[float, ...]
    share: float
    cases: tuple[StudyCase, ...]
    thresholds: tuple[StudyThreshold, ...] = ()
    printed: tuple[tuple[str, tuple[float, ...]], ...] = ()


Studies = tuple[Study, ...]
