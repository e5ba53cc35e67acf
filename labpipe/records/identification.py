"""The result of an identification: parameters that travel with their uncertainty, and their lists."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, TypeVar

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import number
from labpipe.records.finding import WARNING, Discrepancy, Finding, Parameter, of_level, parameter_by_name
from labpipe.records.fit_details import FitDetail
from labpipe.records.response import FrequencyResponse
from labpipe.records.sections import section
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.text import VIEWS, fit_html, fit_line, fit_text, identification_line
from labpipe.records.uncertain import Budget

Detail = TypeVar("Detail", bound=FitDetail)

# What the results of many tests say as a whole, while their numbers stand in a dataset.


@dataclass(frozen=True)
class CountedFinding:
    """A kind of finding: in how many tests it was made, and the first one with its origin."""

    finding: Finding
    origin: str
    tests: int

    @property
    def message(self) -> str:
        """The finding as one sentence of all tests."""
        more = f" ({self.tests} tests in all; this is the first)" if self.tests > 1 else ""
        return f"{self.finding.code}: {self.origin}{more}: {self.finding.message}"


@dataclass(frozen=True, kw_only=True)
class DatasetIndex:
    """Tests with a result and *failed* ones without, those whose rules do not all hold, *rows* of the
    dataset, fits by their name.
    """

    tests: int = 0
    failed: int = 0
    not_accepted: int = 0
    rows: int = 0
    fits: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[CountedFinding, ...] = ()

    def of_level(self, level: str = WARNING) -> tuple[CountedFinding, ...]:
        """The kinds of findings of a level."""
        return tuple(counted for counted in self.findings if counted.finding.level == level)

    def with_more(self, other: DatasetIndex) -> DatasetIndex:
        """Of these tests and of further ones."""
        counted: dict[tuple[str, str], CountedFinding] = {}
        for finding in (*self.findings, *other.findings):
            key = finding.finding.level, finding.finding.code
            before = counted.get(key)
            counted[key] = (
                finding
                if before is None
                else CountedFinding(before.finding, before.origin, before.tests + finding.tests)
            )
        return DatasetIndex(
            tests=self.tests + other.tests,
            failed=self.failed + other.failed,
            not_accepted=self.not_accepted + other.not_accepted,
            rows=self.rows + other.rows,
            fits={
                name: self.fits.get(name, 0) + other.fits.get(name, 0)
                for name in dict.fromkeys((*self.fits, *other.fits))
            },
            findings=tuple(counted[key] for key in sorted(counted)),
        )


# In the rig of a dataset: how many other rig files its earlier tests were made with.
RIGS_BEFORE = "rigs_before"
# The models of a line and of a plane through points, of a calibration.
STRAIGHT_LINE, PLANE = "straight-line", "plane"


@dataclass(frozen=True)
class Goodness:
    """R^2, adjusted R^2 ("G.o.F"), and the chi-square test where the FRF has a covariance."""

    r2: float
    r2_adjusted: float
    chi2_reduced: float | None = None
    chi2_p: float | None = None


@dataclass(frozen=True)
class Candidate:
    """A candidate model on the same lines: number of estimated *parameters*, chi-square of its residual,
    information criteria.

    aic = chi-square + 2 parameters, less is better; p_value: chance of so large an improvement by the richest
    model if this one, which it contains, is right (None for the richest one, and where it does not contain
    this one). bic = chi-square + parameters * ln(real equations) and chi2_p, the chance of so large a
    chi-square, where candidates are chosen by them.
    """

    name: str
    parameters: int
    chi2: float
    dof: int
    aic: float
    p_value: float | None = None
    bic: float | None = None
    chi2_p: float | None = None


@dataclass(frozen=True)
class FittedCurve:
    """Measured and fitted FRF on the fit's lines: (n_line,) [Hz] and (n_line, n_output, n_input) in the
    measured form.

    before: the model as it was before the fit, where a model was tuned. dense_frequency (n,) [Hz], dense (n,
    n_output, n_input): the model also between the lines, so close that it can be drawn as a curve; None where
    it was not computed.
    """

    frequency: FloatArray
    measured: ComplexArray
    fitted: ComplexArray
    _: KW_ONLY
    variance: FloatArray | None
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    form: str
    before: ComplexArray | None = None
    dense_frequency: FloatArray | None = None
    dense: ComplexArray | None = None

    @property
    def drawn(self) -> tuple[FloatArray, ComplexArray]:
        """Frequency (n_dense,) [Hz] and the model as a curve: dense between the lines where that was
        computed, else on the lines.
        """
        if self.dense_frequency is None or self.dense is None:
            return self.frequency, self.fitted
        return self.dense_frequency, self.dense


@dataclass(frozen=True)
class Unstated:
    """A *source* of error that no residual shows and nobody stated, so that it counts as zero, and its
    *effect* in words.
    """

    source: str
    effect: str


@dataclass(frozen=True, repr=False)
class Fit:
    """One fit of one model in one band. lines: frequency lines used; equations: real equations; dof:
    equations minus estimated parameters; noise_dof: those of the noise, where it alone gives the errors since
    as many equations as parameters leave no residual.

    correlation (n, n) [-]: of the estimated (not derived) parameters, in their order. term: dof of the fitted
    diagonal term, where one fit has several. not_stated: what counts as zero in the intervals. details: what
    its model shows beside the parameters, at most one of a class.
    """

    name: str
    model: str
    estimator: str
    _: KW_ONLY
    band_hz: tuple[float, float]
    lines: int
    equations: int
    dof: int
    gof: Goodness
    parameters: tuple[Parameter, ...]
    condition_number: float = field(metadata={"null": math.inf})
    correlation: FloatArray
    converged: bool = True
    iterations: int = 0
    findings: tuple[Finding, ...] = ()
    test: str = ""
    notes: tuple[str, ...] = ()
    curve: FittedCurve | None = None
    candidates: tuple[Candidate, ...] = ()
    term: str = ""
    budget: Budget | None = None
    discrepancy: Discrepancy | None = None
    not_stated: tuple[Unstated, ...] = ()
    details: tuple[FitDetail, ...] = field(default=(), metadata={"entry": False})
    noise_dof: int | None = None

    def __repr__(self) -> str:
        return fit_line(self)

    def __str__(self) -> str:
        return fit_text(self)

    def _repr_html_(self) -> str:
        return fit_html(self)

    def to_frame(self) -> Any:
        """The parameters as a pandas data frame, one row each [SI units]."""
        return VIEWS["frame"](self)

    @property
    def error_dof(self) -> int:
        """Degrees of freedom behind the standard errors, one at least."""
        return max(self.noise_dof or self.dof, 1)

    @property
    def goodness_text(self) -> str:
        """How well the fit follows the data, in words: "G.o.F 0.9998", or that it must."""
        return f"G.o.F {self.gof.r2_adjusted:.4f}" if self.noise_dof is None else "exactly determined"

    @property
    def as_fitted(self) -> Fit:
        """The fit with the values of its model alone: what the model lacks, it lacks in another test of the
        same structure as well.
        """
        noise = {p.name: p.std_error for p in self.parameters if p.fitted is not None and p.std_error}
        return replace(
            self,
            parameters=tuple(parameter.as_fitted for parameter in self.parameters),
            budget=self.budget.with_random(noise) if self.budget is not None and noise else self.budget,
        )

    def detail(self, kind: type[Detail]) -> Detail | None:
        """The detail of that class; None where the fit has none."""
        return next((detail for detail in self.details if isinstance(detail, kind)), None)

    @property
    def estimated(self) -> tuple[Parameter, ...]:
        """The parameters of the fit itself, without those that follow from them."""
        return tuple(parameter for parameter in self.parameters if not parameter.derived)

    @property
    def centre_hz(self) -> float:
        return (self.band_hz[0] + self.band_hz[1]) / 2

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name; KeyError with the known names otherwise."""
        return parameter_by_name(self.parameters, name, "parameter")


def of_points(model: str) -> bool:
    """Whether a fit of that model is a line or a plane through points, of which no noise is known and which
    are no spectrum.
    """
    return model in (STRAIGHT_LINE, PLANE)


@dataclass(frozen=True, kw_only=True)
class RuleDecision:
    """How was decided on limits: the *outcome* (pass, conditional-pass, conditional-fail, fail), the
    *probability* [1] that the value lies within the limits by its combined standard *uncertainty*, and the
    *specific_risk* [1] of this decision: of a false acceptance where it passes, of a false rejection else.

    low, high: the limits, accept_low, accept_high: the values that pass, all [unit], None where that side is
    open or nothing passes. global_false_acceptance, global_false_rejection: shares [1] of all that the stated
    process makes. together: so many limits that are judged at once; least: the probability is the least that
    any correlation leaves.
    """

    outcome: str
    probability: float
    specific_risk: float
    uncertainty: float | None = None
    unit: str = ""
    low: float | None = None
    high: float | None = None
    accept_low: float | None = None
    accept_high: float | None = None
    global_false_acceptance: float | None = None
    global_false_rejection: float | None = None
    together: int = 1
    least: bool = False


@dataclass(frozen=True)
class RuleOutcome:
    """One rule of ``accept`` or ``expect`` (*section*), the value [SI], whether it passed; *shown*: the value
    in the rule's own unit; *decision*: of a rule with limits, how was decided.
    """

    section: str
    rule: str
    value: float | str | None
    passed: bool
    shown: str = ""
    decision: RuleDecision | None = None

    @property
    def found(self) -> str:
        """The value as people read it, in the unit of the rule."""
        if self.shown:
            return self.shown
        if self.value is None:
            return "nothing"
        return self.value if isinstance(self.value, str) else number(self.value)


@dataclass(frozen=True)
class Failed:
    """A test, fit or comparison that could not be evaluated, and why, while others were."""

    name: str
    message: str


@dataclass(frozen=True, repr=False)
class Identification:
    """All fits of a pipeline with their measured responses and spectra, source files and settings.

    *inputs*: digests of the responses that the fits were made from, *code*: of the program that made them,
    *digest*: of the file that the result was read from, empty for one without. *sections*: the records of the
    pipeline's other sections by their key (compare, study, run_ups, ...). *dataset*: of so many tests that
    their fits and responses stand in files of their own, what they are as a whole; then *inputs* are the
    dataset's parts.
    """

    fits: tuple[Fit, ...]
    title: str = ""
    _: KW_ONLY
    pipeline: str = ""
    sources: tuple[dict[str, str], ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    rig: dict[str, Any] = field(default_factory=dict)
    responses: tuple[FrequencyResponse, ...] = ()
    spectra: tuple[ChannelSpectra, ...] = ()
    outcomes: tuple[RuleOutcome, ...] = ()
    version: str = ""
    failed: tuple[Failed, ...] = ()
    inputs: tuple[dict[str, str], ...] = ()
    code: str = ""
    digest: str = field(default="", compare=False)
    sections: Mapping[str, Any] = field(default_factory=dict)
    dataset: DatasetIndex | None = None

    def __repr__(self) -> str:
        return identification_line(self)

    def __str__(self) -> str:
        return "\n\n".join([identification_line(self), *(fit_text(fit) for fit in self.fits)])

    def to_frame(self) -> Any:
        """The parameters of all fits and sections as a pandas data frame, one row each [SI units]."""
        return VIEWS["frame"](self)

    @property
    def accepted(self) -> bool:
        """True if every test was evaluated and every rule passed (true without rules)."""
        return not self.failed and all(outcome.passed for outcome in self.outcomes)

    @property
    def verdict(self) -> str:
        """Outcome of the rules in a word."""
        if self.failed:
            return "incomplete"
        if not self.outcomes:
            return "no rules"
        return "accepted" if self.accepted else "not accepted"

    @property
    def digests(self) -> frozenset[str]:
        """SHA-256 of the files behind the result."""
        return frozenset(source["sha256"] for source in self.sources)

    @property
    def measured_tests(self) -> list[tuple[str, dict[str, Any]]]:
        """Name and conditions of every test that was measured: as a response, as spectra, or as free decays
        that were fitted.
        """
        if self.responses or self.spectra:
            return [
                *((response.name, response.conditions) for response in self.responses),
                *((spectrum.name, spectrum.conditions) for spectrum in self.spectra),
            ]
        decayed = {fit.test for fit in self.fits if any(detail.in_time for detail in fit.details)}
        return [
            (name, dict(conditions)) for name, conditions in self.test_conditions.items() if name in decayed
        ]

    @property
    def test_conditions(self) -> dict[str, dict[str, str]]:
        """The conditions of every test by its name, as people wrote them: as listed, and as its response had
        them.
        """
        listed = {test["name"]: dict(test["conditions"]) for test in self.settings.get("tests", [])}
        spectra = {spectrum.name: dict(spectrum.conditions) for spectrum in self.spectra}
        return {
            **listed,
            **{response.name: dict(response.conditions) for response in self.responses},
            **spectra,
        }


# Parameters of results as lists, trends and campaigns read them: those of all fits and of every other
# section.


@dataclass(frozen=True, kw_only=True)
class ListedParameter:
    """A parameter as lists of results show it: *fit* is whose it is (a fit, "run_ups.joint"), of which
    *test*, *term* and band [Hz].

    changes: of the parameter by one standard uncertainty of every systematic source, by its name; dofs:
    degrees of freedom behind those sources that are not known; *random*: standard error without them.
    """

    fit: str
    parameter: Parameter
    test: str = ""
    term: str = ""
    model: str = ""
    estimator: str = ""
    band_hz: tuple[float, float] = (0.0, 0.0)
    warnings: tuple[str, ...] = ()
    random: float | None = None
    changes: Mapping[str, float] = field(default_factory=dict)
    dofs: Mapping[str, float] = field(default_factory=dict)

    @property
    def random_error(self) -> float | None:
        """Standard error without what given numbers add, which is common to all tests that share them."""
        return self.parameter.full_error if self.random is None else self.random

    @property
    def title(self) -> str:
        """The fit, with its term."""
        return f"{self.fit} of {self.term}" if self.term else self.fit


def listed_parameters(identification: Identification) -> Iterator[ListedParameter]:
    """The parameters of all fits, then those of every other section."""
    for fit in identification.fits:
        yield from of_fit(fit)
    for name, record in identification.sections.items():
        yield from section(name).parameters(record)


def of_fit(fit: Fit) -> Iterator[ListedParameter]:
    codes = tuple(warning_codes(fit))
    for parameter in fit.parameters:
        yield ListedParameter(
            fit=fit.name,
            parameter=parameter,
            test=fit.test,
            term=fit.term,
            model=fit.model,
            estimator=fit.estimator,
            band_hz=fit.band_hz,
            warnings=codes,
            random=random_part(fit, parameter),
            changes=changes_of(fit, parameter),
            dofs=dofs_of(fit),
        )


def random_part(fit: Fit, parameter: Parameter) -> float | None:
    """Standard error of a parameter [its unit] without what given numbers add.

    None where it has no systematic part by itself.
    """
    if fit.budget is None or parameter.name not in fit.budget.names or parameter.systematic is None:
        return None
    return float(fit.budget.random[fit.budget.names.index(parameter.name)])


def changes_of(fit: Fit, parameter: Parameter) -> dict[str, float]:
    """Change of a parameter [its unit] by one standard uncertainty of every source of the fit's budget."""
    if fit.budget is None or parameter.name not in fit.budget.names:
        return {}
    return {
        source.source: fit.budget.change_by(source.source, parameter.name) for source in fit.budget.sources
    }


def dofs_of(fit: Fit) -> dict[str, float]:
    """Degrees of freedom [1] behind every source of the fit's budget that is not known."""
    sources = () if fit.budget is None else fit.budget.sources
    return {source.source: source.dof for source in sources if source.dof}


def warning_codes(fit: Fit) -> list[str]:
    """The codes of a fit's warnings, each once."""
    return list(dict.fromkeys(finding.code for finding in of_level(WARNING, fit.findings)))
