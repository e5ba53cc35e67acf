"""compare: fits and responses of several tests -> one Comparison per question. COMPARISONS by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from labpipe.campaign.bandwise import bandwise, two_tests
from labpipe.campaign.certificate import certificate, resolved
from labpipe.campaign.components import repeatability
from labpipe.campaign.decrements import decrement_certificate
from labpipe.campaign.difference import difference
from labpipe.campaign.loop_sources import directions_left_out
from labpipe.campaign.loop_view import View, checked_view
from labpipe.campaign.observations import Campaign, campaign_of, condition_of, group_of
from labpipe.campaign.per_injection import per_injection
from labpipe.campaign.prediction import MagneticTheory, prediction
from labpipe.campaign.ratio import rayleigh, stiffness_ratio
from labpipe.campaign.reciprocal import reciprocal
from labpipe.campaign.sensitivity import loop_sensitivity
from labpipe.campaign.settings import CompareSettings, TheorySettings
from labpipe.campaign.theory import Matched, Rig, TheoryAt, match, overlay
from labpipe.campaign.trend import trend
from labpipe.errors import ConfigError, LabpipeError
from labpipe.identify.settings import FitSettings
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.comparison import Comparison, Overlay
from labpipe.records.finding import Finding
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.settings import Uncertain
from labpipe.registry import nearest

# The theory at the conditions (value, SI unit) of one comparison.
Theory = Callable[[Sequence[tuple[float, str]]], TheoryAt]


@dataclass(frozen=True)
class _Solved:
    """The theory matched to every observation, and the curves of the first and the last one."""

    matched: list[Matched]
    overlays: tuple[Overlay, ...]


@dataclass(frozen=True)
class Evidence:
    """Inputs of a comparison: fits and responses of the tests, and the settings of the fits.

    *spectra* of tests that have no response. *conditions* of tests without a response (free decays), by their names. *solved*: cache of
    matched theories by fit, term and theory, since several comparisons use the same.
    """

    fits: tuple[Fit, ...]
    responses: tuple[FrequencyResponse, ...]
    fit_settings: tuple[FitSettings, ...]
    solved: dict[tuple[str, str, TheorySettings], _Solved] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    spectra: tuple[ChannelSpectra, ...] = ()

    def campaign(self, settings: CompareSettings) -> Campaign:
        measured = {response.name: response.conditions for response in self.responses}
        return campaign_of(settings, self.fits, {**measured, **self.conditions})

    def response(self, test: str) -> FrequencyResponse:
        """The response of a test; ConfigError where it is missing."""
        response = next((response for response in self.responses if response.name == test), None)
        if response is None:
            raise ConfigError(f"the response of test '{test}' is missing")
        return response

    def settings_of(self, fit: str) -> FitSettings:
        return next(settings for settings in self.fit_settings if settings.name == fit)


def compare(settings: CompareSettings, evidence: Evidence, theory: Theory | MagneticTheory | None = None) -> Comparison:
    """The comparison of the settings; *theory* where they name one. LabpipeError where the tests do not allow it."""
    return COMPARISONS[settings.kind](settings, evidence, theory)


def _matched(campaign: Campaign, evidence: Evidence, theory: Theory) -> _Solved:
    """The matched theory, from the cache; FitError and ConfigError name the test."""
    named = campaign.settings.theory
    assert named is not None
    key = (campaign.settings.fit, campaign.settings.term, named)
    if key not in evidence.solved:
        evidence.solved[key] = _newly_matched(campaign, evidence, theory, named)
    return evidence.solved[key]


def _newly_matched(campaign: Campaign, evidence: Evidence, theory: Theory, named: TheorySettings) -> _Solved:
    rig = Rig(named.shaft or Uncertain(float("inf")), named.arm)
    theories: dict[str, TheoryAt] = {}
    matched, overlays = [], []
    last = len(campaign.observations) - 1
    for number, observation in enumerate(campaign.observations):
        pairs = ((observation.condition, campaign.condition_unit), (observation.second, campaign.second_unit))
        conditions = pairs[: len(campaign.settings.over)]
        key = repr(conditions)
        theories[key] = theories.get(key) or theory(conditions)
        inputs = (observation.fit, evidence.response(observation.fit.test), evidence.settings_of(observation.fit.name), theories[key], rig)
        matched.append(_named(observation.fit.test, *inputs))
        if number in (0, last):
            overlays.append(overlay(*inputs, matched[-1]))
    return _Solved(matched, tuple(overlays))


def _named(test: str, fit: Fit, response: FrequencyResponse, settings: FitSettings, theory: TheoryAt, rig: Rig) -> Matched:
    try:
        return match(fit, response, settings, theory, rig)
    except LabpipeError as error:
        error.what = f"test {test}: {error.what}"
        raise


def _trend(settings: CompareSettings, evidence: Evidence, _: Theory | None) -> Comparison:
    return trend(evidence.campaign(settings))


def _difference(settings: CompareSettings, evidence: Evidence, _: Theory | None) -> Comparison:
    return difference(evidence.campaign(settings))


def _repeatability(settings: CompareSettings, evidence: Evidence, _: Theory | None) -> Comparison:
    return repeatability(evidence.campaign(settings))


def _ratio(settings: CompareSettings, evidence: Evidence, theory: Theory | None) -> Comparison:
    if theory is None or settings.theory is None:
        raise ConfigError("a ratio needs a theory", hint="theory: {bearing: FILE}")
    campaign = evidence.campaign(replace(settings, parameter="k"))
    solved = _matched(campaign, evidence, theory)
    return stiffness_ratio(campaign, solved.matched, solved.overlays, _bending_error(settings))


def _rayleigh(settings: CompareSettings, evidence: Evidence, theory: Theory | None) -> Comparison:
    campaign = evidence.campaign(replace(settings, parameter="c"))
    if theory is None:
        return rayleigh(campaign, None)
    return rayleigh(campaign, _matched(campaign, evidence, theory).matched, _bending_error(settings))


def _bending_error(settings: CompareSettings) -> float:
    """Relative standard error of the shaft's bending stiffness."""
    shaft = None if settings.theory is None else settings.theory.shaft
    return shaft.std_error / shaft.value if shaft else 0.0


def _reciprocity(settings: CompareSettings, evidence: Evidence, _: Theory | None) -> Comparison:
    return reciprocal(settings, evidence.responses)


def _prediction(settings: CompareSettings, evidence: Evidence, theory: MagneticTheory | None) -> Comparison:
    if theory is None:
        raise ConfigError("a prediction needs a theory", hint="theory: {bearing: FILE}")
    return prediction(settings, [checked_view(view) for view in _views(settings, evidence, theory)])


def _views(settings: CompareSettings, evidence: Evidence, theory: MagneticTheory) -> list[View]:
    """All tests of the fit with their bearing file, its entry set to the test's condition where the settings name one."""
    named = [fit for fit in evidence.fits if fit.name == settings.fit]
    if not named:
        raise ConfigError(f"no fit '{settings.fit}' to compare", hint=nearest(settings.fit, {fit.name for fit in evidence.fits}))
    views = []
    for test in dict.fromkeys(fit.test for fit in named):
        response = evidence.response(test)
        at = condition_of(settings.condition, test, response.conditions) if settings.over else (None, "")
        fits = tuple(fit for fit in named if fit.test == test)
        views.append(View(test, response, evidence.settings_of(settings.fit), fits, theory(*at)))
    return views


def _bands(settings: CompareSettings, evidence: Evidence, _: Theory | None) -> Comparison:
    named = [fit for fit in evidence.fits if fit.name == settings.fit]
    if not named:
        raise ConfigError(f"no fit '{settings.fit}' to compare", hint=nearest(settings.fit, {fit.name for fit in evidence.fits}))
    tests = dict.fromkeys(fit.test for fit in named)
    groups = [(test, group_of(settings, test, evidence.response(test).conditions)) for test in tests]
    return bandwise(settings, two_tests(settings, named, groups))


def _sensitivity(settings: CompareSettings, evidence: Evidence, theory: MagneticTheory | None) -> Comparison:
    if len(evidence.responses) != 1:
        hint = "one pipeline per setting of the loop"
        raise ConfigError(f"a sensitivity is that of one test, not of {len(evidence.responses)}", hint=hint)
    response = evidence.responses[0]
    comparison = loop_sensitivity(settings, response, None if theory is None else theory(None, ""))
    return _with_directions_left_out(comparison, [port for port in response.outputs if port.label in (settings.before, settings.after)])


def _certificate(settings: CompareSettings, evidence: Evidence, theory: MagneticTheory | None) -> Comparison:
    if settings.fit:
        return decrement_certificate(settings, [fit for fit in evidence.fits if fit.name == settings.fit])
    tests = [*evidence.responses, *evidence.spectra]
    if len(tests) != 1:
        raise ConfigError(f"a certificate is that of one test, not of {len(tests)}", hint="one pipeline per setting of the loop")
    response = evidence.responses[0] if evidence.responses else per_injection(evidence.spectra[0])
    comparison = certificate(settings, response, None if theory is None else theory(None, ""))
    certificate_settings = resolved(settings)
    outputs = [port for port in response.outputs if port.label in certificate_settings.recorded]
    return _with_directions_left_out(comparison, [*outputs, *(() if certificate_settings.before else response.inputs)])


def _with_directions_left_out(comparison: Comparison, ports: Iterable[Port]) -> Comparison:
    """The comparison with a finding on the directions of its *ports* that have a doubt: nothing tells what they read across."""
    names = directions_left_out(ports)
    if not names:
        return comparison
    message = f"doubts of the directions of {', '.join(names)} are not propagated: no other channel tells the motion across"
    return replace(comparison, findings=(*comparison.findings, Finding("number-doubt", message)))


# The theory is a rolling bearing's or, for the kinds of a control loop, a magnetic bearing's.
COMPARISONS: Mapping[str, Callable[[CompareSettings, Evidence, Any], Comparison]] = {
    "trend": _trend,
    "difference": _difference,
    "repeatability": _repeatability,
    "ratio": _ratio,
    "rayleigh": _rayleigh,
    "reciprocity": _reciprocity,
    "prediction": _prediction,
    "bands": _bands,
    "sensitivity": _sensitivity,
    "certificate": _certificate,
}
