"""What a result says of itself: findings, and parameters with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace

NOTE, WARNING = "note", "warning"


# Standard uncertainties of a 95 % interval of the normal distribution.
NORMAL = 1.959963984540054
# Standard uncertainties below zero from which a sign counts as certain: by chance in 0.1 % of cases.
CERTAIN = 3.0


@dataclass(frozen=True)
class Finding:
    """*code* for programs (clipped, gap, collinear, ...), *message* for people. Findings travel downstream
    with the results.

    *level*: a warning limits how far a number can be trusted; a note only says what was done (lines masked, a
    hit left out). *line_hz*: the one line [Hz] it speaks of; not stored.
    """

    code: str
    message: str
    level: str = WARNING
    line_hz: float | None = field(default=None, compare=False, metadata={"entry": False})

    def __post_init__(self) -> None:
        if self.level not in (NOTE, WARNING):
            raise ValueError(f"a finding is a note or a warning, not '{self.level}'")


def note(code: str, message: str) -> Finding:
    """A finding that only informs."""
    return Finding(code, message, NOTE)


def of_level(level: str, findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings of one level, in their order."""
    return tuple(finding for finding in findings if finding.level == level)


# An estimated or derived parameter that travels with its uncertainty.


def parameter_by_name(entries: Sequence[Parameter], name: str, word: str) -> Parameter:
    """The parameter of that name; KeyError with the known names, *word* for what they are, otherwise."""
    for entry in entries:
        if entry.name == name:
            return entry
    raise KeyError(f"no {word} '{name}'; known: {', '.join(entry.name for entry in entries)}")


@dataclass(frozen=True)
class Contribution:
    """Part of a source in the uncertainty of a parameter: *contribution* as a standard uncertainty, *share*
    of the variance [1].
    """

    source: str
    contribution: float
    share: float


@dataclass(frozen=True)
class IntervalParts:
    """What the interval of a parameter holds, as standard uncertainties [unit of the parameter]: noise of the
    record, model error, scatter between repeats, and given numbers.
    """

    noise: float
    discrepancy: float = 0.0
    repeats: float = 0.0
    systematic: float = 0.0


@dataclass(frozen=True)
class Discrepancy:
    """What explains a residual that is not noise: *shares* [1] of the evidence by cause, and where a second
    mode would lie [Hz].
    """

    shares: Mapping[str, float]
    second_mode_hz: float | None = None


@dataclass(frozen=True)
class Repeats:
    """The repeats that a value is the mean of: *n* recorded, *used* in the mean, their *values* and *spread*
    (tau) [unit of the value].

    *covariate*: what they follow, where they do, and the value of it *at* which the mean is stated [SI].
    groups: number of groups, such as days, that are the repeats, each of several values; 0 where none are.
    """

    n: int
    used: int
    spread: float
    values: tuple[float, ...]
    covariate: str = ""
    at: float | None = None
    groups: int = 0


@dataclass(frozen=True)
class Parameter:
    """One estimated or derived parameter in SI units.

    *std_error*, *t_ratio*, *ci95* are None where none can be given (at a bound, not determined).
    *significant*: |t| exceeds the two-sided 95 % Student quantile. *vif*: variance inflation factor.
    *derived*: computed from the others (f_n, zeta, ...). *std_error* is what noise alone leaves;
    *std_error_inflated*: with what else the residual shows, where it is not noise, and with the uncertainty
    of given numbers. *ci95*, *t_ratio* and *significant* are by the latter then. *systematic*: the part of it
    that stems from given numbers, where that is known by itself; then there are the *combined* standard
    uncertainty, the *expanded* one, which is it times *coverage_factor*, and the *budget* of all sources,
    noise among them, the largest first. *repeats*: those that the value is the mean of. *interval*: the parts
    of the interval that is stated, and the *reason* in words where it is wider than noise and given numbers
    make it, with the *discrepancy* behind it; *fitted*: what the model alone gives, where the value is the
    mean over model errors.
    """

    name: str
    value: float
    unit: str
    _: KW_ONLY
    std_error: float | None = None
    t_ratio: float | None = None
    ci95: tuple[float, float] | None = None
    significant: bool | None = None
    vif: float | None = None
    derived: bool = False
    at_bound: bool = False
    std_error_inflated: float | None = None
    systematic: float | None = None
    combined: float | None = None
    expanded: float | None = None
    coverage_factor: float | None = None
    budget: tuple[Contribution, ...] = ()
    interval: IntervalParts | None = None
    reason: str = ""
    repeats: Repeats | None = None
    discrepancy: Discrepancy | None = None
    fitted: float | None = None

    @property
    def as_fitted(self) -> Parameter:
        """The parameter as the model alone gives it, by noise and given numbers: for what is compared with
        the same model on other data.
        """
        if self.fitted is None or self.std_error is None:
            return self
        error = math.hypot(self.std_error, self.systematic or 0.0)
        reach = NORMAL * error
        interval = None if self.ci95 is None else (self.fitted - reach, self.fitted + reach)
        return replace(
            self,
            value=self.fitted,
            fitted=None,
            ci95=interval,
            std_error_inflated=error if self.systematic else None,
        )

    @property
    def without_interval(self) -> Parameter:
        """The value alone."""
        bare = replace(self, std_error=None, std_error_inflated=None, t_ratio=None, ci95=None)
        return replace(bare, significant=None, interval=None)

    @property
    def measured_ci95(self) -> tuple[float, float] | None:
        """The 95 % interval by noise, repeats and given numbers, for what is compared with a value of the
        same model on the same lines.

        What the model lacks, and the residual shows, it lacks on both sides.
        """
        if self.fitted is not None:
            return self.as_fitted.ci95
        if self.ci95 is None or not self.full_error or self.std_error is None:
            return self.ci95
        between = 0.0 if self.interval is None else self.interval.repeats
        share = math.hypot(self.std_error, self.systematic or 0.0, between) / self.full_error
        return self.value + share * (self.ci95[0] - self.value), self.value + share * (
            self.ci95[1] - self.value
        )

    @property
    def is_negative(self) -> bool:
        """Whether the value lies below zero by more than CERTAIN of its combined standard uncertainties."""
        error = self.full_error if self.combined is None else self.combined
        return error is not None and self.value < -CERTAIN * error

    @property
    def full_error(self) -> float | None:
        """The standard error that goes with the interval: the inflated one, where there is one."""
        return self.std_error if self.std_error_inflated is None else self.std_error_inflated
