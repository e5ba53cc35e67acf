"""Comparisons of control loops with a magnetic-bearing file: prediction, sensitivity, certificate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.bearing import MAGNETIC, MagneticFile
from labpipe.methods.magnetic_bearing.certificate import certificate, resolved
from labpipe.methods.magnetic_bearing.limits import CertificateSettings, decrement_certificate
from labpipe.methods.magnetic_bearing.loop_matrix import per_injection
from labpipe.methods.magnetic_bearing.loop_problem import View, checked_view, directions_left_out
from labpipe.methods.magnetic_bearing.prediction import MagneticTheory, prediction
from labpipe.methods.magnetic_bearing.sensitivity import loop_sensitivity
from labpipe.project.bearing_file import open_bearing
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Finding
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.uncertainty.compare import Evidence
from labpipe.uncertainty.observations import condition_of
from labpipe.uncertainty.settings import CompareSettings, ComparisonKind, TheorySettings


def magnetic_theory(folder: Path, settings: TheorySettings) -> MagneticTheory:
    """The magnetic-bearing file as a function of the condition that sets one of its entries.

    ConfigError for another kind of bearing.
    """
    file = open_bearing(folder / settings.bearing)
    if file.kind_name != MAGNETIC:
        raise ConfigError(
            f"is of the kind {file.kind_name}",
            where=str(file.path),
            hint=f"a loop is predicted for the kind {MAGNETIC}",
        )

    def at(condition: float | None, unit: str) -> MagneticFile:
        return file.settings() if condition is None else file.settings_at(settings.entry, [(condition, unit)])

    return at


def _file_of(settings: CompareSettings, evidence: Evidence) -> MagneticFile | None:
    theory = _theory(settings, evidence)
    return None if theory is None else theory(None, "")


def _theory(settings: CompareSettings, evidence: Evidence) -> MagneticTheory | None:
    """The theory that was given, else the bearing file that the settings name."""
    given: MagneticTheory | None = evidence.theory
    return (
        magnetic_theory(evidence.folder, settings.theory)
        if given is None and settings.theory is not None
        else given
    )


def prediction_of_tests(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """k and c of a loop predicted from its bearing file beside those of every band."""
    theory = _theory(settings, evidence)
    if theory is None:
        raise ConfigError("a prediction needs a theory", hint="theory: {bearing: FILE}")
    return prediction(settings, [checked_view(view) for view in _views(settings, evidence, theory)])


def _views(settings: CompareSettings, evidence: Evidence, theory: MagneticTheory) -> list[View]:
    """All tests of the fit with their bearing file, its entry set to the test's condition where the settings
    name one.
    """
    named, views = evidence.fits_of(settings), []
    for test in dict.fromkeys(fit.test for fit in named):
        response = evidence.response(test)
        at = condition_of(settings.condition, test, response.conditions) if settings.over else (None, "")
        fits = tuple(fit for fit in named if fit.test == test)
        views.append(View(test, response, evidence.settings_of(settings.fit), fits, theory(*at)))
    return views


def sensitivity_of_test(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """The sensitivity of a loop, from an excitation added in it."""
    if len(evidence.responses) != 1:
        hint = "one pipeline per setting of the loop"
        raise ConfigError(f"a sensitivity is that of one test, not of {len(evidence.responses)}", hint=hint)
    response = evidence.responses[0]
    comparison = loop_sensitivity(settings, response, _file_of(settings, evidence))
    return _with_directions_left_out(
        comparison, [port for port in response.outputs if port.label in (settings.before, settings.after)]
    )


def certificate_of_test(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """The certificate of a closed loop, or of the decrements of a fit."""
    if settings.fit:
        return decrement_certificate(settings, [fit for fit in evidence.fits if fit.name == settings.fit])
    certificate_settings = resolved(settings)
    tests: list[FrequencyResponse | ChannelSpectra] = [*evidence.responses, *evidence.spectra]
    names = ", ".join(test.name for test in tests if test.name) or f"{len(tests)} without names"
    if certificate_settings.test:
        tests = [test for test in tests if test.name == certificate_settings.test]
    if len(tests) != 1:
        wanted = (
            f"no test '{certificate_settings.test}'" if certificate_settings.test else "one test is needed"
        )
        raise ConfigError(
            f"a certificate is that of one loop: {wanted} among {names}",
            hint="one comparison per test, certificate: {test: NAME}",
        )
    response = tests[0] if isinstance(tests[0], FrequencyResponse) else per_injection(tests[0])
    comparison = certificate(settings, response, _file_of(settings, evidence))
    outputs = [port for port in response.outputs if port.label in certificate_settings.recorded]
    return _with_directions_left_out(
        comparison, [*outputs, *(() if certificate_settings.before else response.inputs)]
    )


def _with_directions_left_out(comparison: Comparison, ports: Iterable[Port]) -> Comparison:
    """The comparison with a finding on the directions of its *ports* that have an uncertainty: nothing tells
    what they read across.
    """
    names = directions_left_out(ports)
    if not names:
        return comparison
    message = (
        f"uncertainties of the directions of {', '.join(names)} are not propagated: no other channel "
        "tells the motion across"
    )
    return replace(comparison, findings=(*comparison.findings, Finding("number-uncertainty", message)))


PREDICTION = ComparisonKind(
    prediction_of_tests,
    keys=("fit", "parameter", "over", "theory", "estimate"),
    needs=("fit", "theory"),
    loop=True,
)
SENSITIVITY = ComparisonKind(sensitivity_of_test, keys=("before", "after", "theory", "estimate"), loop=True)
CERTIFICATE = ComparisonKind(
    certificate_of_test,
    keys=("fit", "before", "after", "theory", "estimate"),
    loop=True,
    section="certificate",
    settings=CertificateSettings,
)
