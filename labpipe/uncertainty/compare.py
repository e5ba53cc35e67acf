"""compare: fits and responses of several tests -> one Comparison per question.

Kinds by the table COMPARISONS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.settings import FitSettings
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import nearest
from labpipe.spectra.quality import reciprocity
from labpipe.uncertainty.amounts import chance
from labpipe.uncertainty.bandwise import bandwise, two_tests
from labpipe.uncertainty.observations import Campaign, campaign_of, group_of
from labpipe.uncertainty.settings import CompareSettings, ComparisonKind, comparison_kind
from labpipe.uncertainty.trend import difference, quotient, trend
from labpipe.uncertainty.weighted import repeatability

# Reciprocity of every test: H_ij = H_ji within the standard errors.

# Relative rms difference beyond which both are noise: the dofs are not coupled.
UNCOUPLED = 0.7


def reciprocal(settings: CompareSettings, responses: Sequence[FrequencyResponse]) -> Comparison:
    """Every pair of dofs in every test with its p-value; the verdict takes the smallest one times their
    number (Bonferroni).

    The largest relative difference is that of coupled pairs. DataError without a response that can be tested.
    Equation (comp-reciprocity).
    """
    points = [
        ComparedPoint(
            response.name, pair.difference, group=f"{pair.first}-{pair.second}", p_value=pair.p_value
        )
        for response in responses
        for pair in reciprocity(response)
    ]
    if not points:
        raise DataError("there is no response whose reciprocity can be tested")
    least = min(point.p_value for point in points if point.p_value is not None)
    p_value = min(1.0, least * len(points))
    coupled = [point.value for point in points if point.value < UNCOUPLED]
    largest = max(coupled) if coupled else float("nan")
    verdict = "not reciprocal" if p_value < settings.level else "reciprocal"
    coupled_text = (
        f"coupled pairs differ by at most {100 * largest:.2g} % rms"
        if coupled
        else "no pair is coupled above the noise"
    )
    count = f"{len(points)} pair(s) of dofs in {len(responses)} test(s), {len(coupled)} of them coupled"
    return Comparison(
        name=settings.name,
        kind="reciprocity",
        subject="|H_ij - H_ji| / |H|",
        unit="1",
        points=tuple(points),
        amounts=(chance("p_value", p_value), Parameter("difference", largest, "1", derived=True)),
        verdict=verdict,
        statement=f"{count}; {coupled_text}: {verdict} (p = {p_value:.2g}, corrected for the number of "
        "pairs).",
    )


# compare: fits and responses of several tests -> one Comparison per question; kinds by the table COMPARISONS.


@dataclass(frozen=True)
class Evidence:
    """Inputs of a comparison: fits and responses of the tests, and the settings of the fits.

    *spectra* of tests that have no response. *conditions* of tests without a response (free decays), by their
    names. *folder*: where the files lie that settings name; *theory*: in place of that of the file, by the
    kind of comparison. *solved*: cache of theories matched to a fit, since several comparisons use the same.
    """

    fits: tuple[Fit, ...]
    responses: tuple[FrequencyResponse, ...]
    fit_settings: tuple[FitSettings, ...]
    solved: dict[Any, Any] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    spectra: tuple[ChannelSpectra, ...] = ()
    folder: Path = Path()
    theory: Any = None

    def fits_of(self, settings: CompareSettings) -> list[Fit]:
        """The fits that the settings name; ConfigError where there is none."""
        named = [fit for fit in self.fits if fit.name == settings.fit]
        if not named:
            raise ConfigError(
                f"no fit '{settings.fit}' to compare",
                hint=nearest(settings.fit, {fit.name for fit in self.fits}),
            )
        return named

    def campaign(self, settings: CompareSettings, parameter: str = "") -> Campaign:
        """The observations of the settings; *parameter*: in place of theirs."""
        measured = {response.name: response.conditions for response in self.responses}
        return campaign_of(settings, self.fits, {**measured, **self.conditions}, parameter)

    def response(self, test: str) -> FrequencyResponse:
        """The response of a test; ConfigError where it is missing."""
        response = next((response for response in self.responses if response.name == test), None)
        if response is None:
            raise ConfigError(f"the response of test '{test}' is missing")
        return response

    def settings_of(self, fit: str) -> FitSettings:
        return next(settings for settings in self.fit_settings if settings.name == fit)


def compare(settings: CompareSettings, evidence: Evidence, theory: Any = None) -> Comparison:
    """The comparison of the settings; *theory*: in place of their bearing file.

    LabpipeError where the tests do not allow it.
    """
    evidence = replace(evidence, fits=tuple(fit.as_fitted for fit in evidence.fits))
    return comparison_kind(settings.kind).compare(
        settings, evidence if theory is None else replace(evidence, theory=theory)
    )


def _bands(settings: CompareSettings, evidence: Evidence) -> Comparison:
    named = evidence.fits_of(settings)
    tests = dict.fromkeys(fit.test for fit in named)
    groups = [(test, group_of(settings, test, evidence.response(test).conditions)) for test in tests]
    return bandwise(settings, two_tests(settings, named, groups))


# Keys of comparisons of one parameter of the fit of every test.
OF_TESTS = ("fit", "term", "over", "group")
TREND = ComparisonKind(
    lambda settings, evidence: trend(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "law", "setting_error", "level"),
    needs=("fit", "over"),
    conditions=2,
)
# Groups of tests that share a condition, or, without `group`, two tests by their names.
DIFFERENCE = ComparisonKind(
    lambda settings, evidence: difference(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "groups", "tolerance", "setting_error", "level"),
    needs=("fit", "groups"),
    conditions=2,
)
QUOTIENT = replace(DIFFERENCE, compare=lambda settings, evidence: quotient(evidence.campaign(settings)))
REPEATABILITY = ComparisonKind(
    lambda settings, evidence: repeatability(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "level"),
    needs=("fit", "group"),
)
RECIPROCITY = ComparisonKind(
    lambda settings, evidence: reciprocal(settings, evidence.responses), keys=("level",)
)
BANDS = ComparisonKind(
    _bands, keys=("fit", "parameter", "group", "groups", "level"), needs=("fit", "group", "groups")
)
