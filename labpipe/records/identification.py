"""The result of an identification: parameters that travel with their doubt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import number
from labpipe.records.budget import Budget
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.dataset_index import DatasetIndex
from labpipe.records.dynamic_stiffness import DynamicStiffness
from labpipe.records.finding import Finding
from labpipe.records.modes import Modes
from labpipe.records.parameter import Parameter as Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.records.ring_down import RingDown
from labpipe.records.robust import RobustPlant
from labpipe.records.text import fit_html, fit_line, fit_text, identification_line
from labpipe.records.views import VIEWS

# The model of a line through points, of a calibration.
STRAIGHT_LINE = "straight-line"


@dataclass(frozen=True)
class Goodness:
    """R^2, adjusted R^2 ("G.o.F"), and the chi-square test where the FRF has a covariance."""

    r2: float
    r2_adjusted: float
    chi2_reduced: float | None = None
    chi2_p: float | None = None


@dataclass(frozen=True)
class Candidate:
    """A candidate model on the same lines: number of estimated *parameters*, chi-square of its residual, information criteria.

    aic = chi-square + 2 parameters, less is better; p_value: chance of so large an improvement by the richest model if this one,
    which it contains, is right (None for the richest one, and where it does not contain this one). bic = chi-square + parameters * ln(real
    equations) and chi2_p, the chance of so large a chi-square, where candidates are chosen by them.
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
    """Measured and fitted FRF on the fit's lines: (n_line,) [Hz] and (n_line, n_output, n_input) in the measured form.

    before: the model as it was before the fit, where a model was tuned.
    dense_frequency (n,) [Hz], dense (n, n_output, n_input): the model also between the lines, so close that it can be drawn as a curve;
    None where it was not computed.
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
        """Frequency (n_dense,) [Hz] and the model as a curve: dense between the lines where that was computed, else on the lines."""
        if self.dense_frequency is None or self.dense is None:
            return self.frequency, self.fitted
        return self.dense_frequency, self.dense


@dataclass(frozen=True)
class Region:
    """Joint confidence region of two parameters: its closed *outline* (n_point, 2) [SI units]; *level* e.g. 0.95."""

    names: tuple[str, str]
    outline: FloatArray
    level: float


@dataclass(frozen=True, repr=False)
class Fit:
    """One fit of one model in one band. lines: frequency lines used; equations: real equations; dof: equations minus estimated parameters.

    correlation (n, n) [-]: of the estimated (not derived) parameters, in their order. term: dof of the fitted diagonal term, where one
    fit has several.
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
    region: Region | None = None
    modes: Modes | None = None
    ring_down: RingDown | None = None
    budget: Budget | None = None
    dynamic_stiffness: DynamicStiffness | None = None
    robust: RobustPlant | None = None

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
    def centre_hz(self) -> float:
        return (self.band_hz[0] + self.band_hz[1]) / 2

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name; KeyError with the known names otherwise."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter '{name}'; known: {', '.join(p.name for p in self.parameters)}")


def of_points(model: str) -> bool:
    """Whether a fit of that model is a line through points, of which no noise is known and which are no spectrum."""
    return model == STRAIGHT_LINE


@dataclass(frozen=True)
class RuleOutcome:
    """One rule of ``accept`` or ``expect`` (*section*), the value [SI], whether it passed; *shown*: the value in the rule's own unit."""

    section: str
    rule: str
    value: float | str | None
    passed: bool
    shown: str = ""

    @property
    def found(self) -> str:
        """The value as people read it, in the unit of the rule."""
        if self.shown:
            return self.shown
        return "nothing" if self.value is None else self.value if isinstance(self.value, str) else number(self.value)


@dataclass(frozen=True)
class Failed:
    """A test or comparison that could not be evaluated, and why, while others were."""

    name: str
    message: str


@dataclass(frozen=True, repr=False)
class Identification:
    """All fits of a pipeline with their measured responses and spectra, source files and settings.

    *inputs*: digests of the responses that the fits were made from, *code*: of the program that made them,
    *digest*: of the file that the result was read from, empty for one without. *sections*: the records of the
    pipeline's other sections by their key (compare, study, run_ups, ...). *dataset*: of so many tests that their fits
    and responses stand in files of their own, what they are as a whole; then *inputs* are the dataset's parts.
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
    def measured_tests(self) -> list[tuple[str, dict[str, Any]]]:
        """Name and conditions of every test that was measured: as a response, as spectra, or as free decays that were fitted."""
        if self.responses or self.spectra:
            return [
                *((response.name, response.conditions) for response in self.responses),
                *((spectrum.name, spectrum.conditions) for spectrum in self.spectra),
            ]
        decayed = {fit.test for fit in self.fits if fit.ring_down is not None}
        return [(name, dict(conditions)) for name, conditions in self.test_conditions.items() if name in decayed]

    @property
    def test_conditions(self) -> dict[str, dict[str, str]]:
        """The conditions of every test by its name, as people wrote them: as listed, and as its response had them."""
        listed = {test["name"]: dict(test["conditions"]) for test in self.settings.get("tests", [])}
        spectra = {spectrum.name: dict(spectrum.conditions) for spectrum in self.spectra}
        return {**listed, **{response.name: dict(response.conditions) for response in self.responses}, **spectra}
