"""Comparisons of control loops with a magnetic-bearing file: prediction, sensitivity, certificate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing import loop_problem
from labpipe.methods.magnetic_bearing.bearing import MAGNETIC, MagneticFile, stability_findings, verdict
from labpipe.methods.magnetic_bearing.certificate import certificate, resolve
from labpipe.methods.magnetic_bearing.limits import VERDICTS, LoopCertificateSettings, decrement_certificate
from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.methods.magnetic_bearing.loop_fit import (
    LoopFit,
    fit_statement,
    goodness,
    identifiability_findings,
    loop_fit,
)
from labpipe.methods.magnetic_bearing.sensitivity import curve_of, loop_sensitivity, response_per_injection
from labpipe.project.bearing_file import open_bearing
from labpipe.records.comparison import ComparedBand, Comparison, QuantityCurve
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import nearest
from labpipe.uncertainty.compare import Evidence
from labpipe.uncertainty.observations import condition_of
from labpipe.uncertainty.settings import CompareSettings, ComparisonKind, TheorySettings

# Least share of bands that hold the prediction: 95 % are expected, and neighbouring bands share lines.
ENOUGH = 0.9
LETTERS = ("k", "c")

MagneticTheory = Callable[[float | None, str], MagneticFile]


def prediction(settings: CompareSettings, views: Sequence[loop_problem.View]) -> Comparison:
    """k and c of every band with the same fit of the predicted response, the share of bands that hold it, and
    fitted unknowns.

    Raises ConfigError for unknown parameters or unknowns, FitError for responses without noise estimate.
    """
    names = _names(settings, views[0].fits[0])
    bands = [band for view in views for band in _bands(view, view.file, names)]
    fitted = loop_fit([view.observation for view in views], settings.estimate)
    changed = [loop_problem.with_unknowns(view.file, fitted.values()) for view in views if fitted.usable]
    after = [band for view, file in zip(views, changed, strict=False) for band in _bands(view, file, names)]
    assumptions = note("assumptions", views[0].file.assumptions())
    stability = _stability(views)
    word = "as predicted" if min(_share(bands, name) for name in names) >= ENOUGH else "not as predicted"
    if stability[0].value:
        word = "unstable"
    amounts = [
        Parameter(f"share_{letter}{fitted}", _share(of, name), "1", derived=True)
        for of, fitted in ((bands, ""), (after, "_fitted"))
        if of
        for letter, name in zip(LETTERS, names, strict=True)
    ]
    return Comparison(
        name=settings.name,
        kind="prediction",
        subject=f"{names[0]} and {names[1]}, fit {settings.fit}",
        unit="N/m",
        points=(),
        amounts=(
            *amounts,
            Parameter("bands", float(len(bands) // 2), "1", derived=True),
            *stability,
            *goodness(fitted),
            *fitted.parameters,
        ),
        verdict=word,
        statement=_statement(bands, after, names, fitted, word, views),
        condition=settings.condition,
        bands=tuple(bands),
        curves=tuple(
            curve for n, view in enumerate(views) for curve in _curves(view, changed[n] if changed else None)
        ),
        correlations=fitted.correlations,
        findings=(*_unstable(views), *identifiability_findings(fitted), assumptions),
        budgets=() if fitted.budget is None else (fitted.budget,),
    )


def _names(settings: CompareSettings, fit: Fit) -> tuple[str, str]:
    names = [parameter.name for parameter in fit.parameters if parameter.unit in ("N/m", "N.s/m")]
    stiffness = settings.parameter
    if stiffness == "k" and "k" not in names:
        stiffness = next((name for name in names if name.startswith("k")), stiffness)
    pair = (stiffness, "c" + stiffness[1:])
    missing = next((name for name in pair if name not in names), None)
    if missing is not None or not stiffness.startswith("k"):
        what = f"fit '{fit.name}' has no '{missing or stiffness}' as stiffness and damping"
        raise ConfigError(what, hint=nearest(stiffness, names))
    return pair


def _bands(view: loop_problem.View, file: MagneticFile, names: tuple[str, str]) -> list[ComparedBand]:
    predicted = loop_problem.predicted_fits(view, file)
    return [
        _band(view.test, fit, theory, name)
        for fit, theory in zip(view.fits, predicted, strict=True)
        for name in names
    ]


def _band(test: str, fit: Fit, theory: Fit, name: str) -> ComparedBand:
    measured, predicted = fit.parameter(name).as_fitted, theory.parameter(name).value
    # A fit without convergence holds no prediction. What the model lacks it lacks on both sides.
    low, high = measured.measured_ci95 or (float("nan"), float("nan"))
    ends = sorted((low / predicted, high / predicted))
    return ComparedBand(
        test,
        name,
        measured.unit,
        band_hz=fit.band_hz,
        value=measured.value,
        ci95=(low, high),
        other=predicted,
        ratio=measured.value / predicted,
        ratio_ci95=(ends[0], ends[1]),
    )


def _share(bands: Sequence[ComparedBand], name: str) -> float:
    return float(np.mean([band.holds for band in bands if band.parameter == name]))


def _stability(views: Sequence[loop_problem.View]) -> list[Parameter]:
    verdicts = [verdict(view.file.suspension()) for view in views]
    peaks = [stability.peak.value for stability in verdicts if not stability.unstable]
    most = float(max(stability.unstable for stability in verdicts))
    amounts = {"unstable_poles": most} | ({"sensitivity_peak": max(peaks)} if peaks else {})
    return [Parameter(name, value, "1", derived=True) for name, value in amounts.items()]


def _unstable(views: Sequence[loop_problem.View]) -> list[Finding]:
    findings = []
    for view in views:
        plant = view.file.suspension()
        of_test = f"test {view.test}: " if view.test else ""
        prefix = f"{of_test}prediction for the {plant.mass:g} kg of the bearing file: "
        for finding in stability_findings(verdict(plant)):
            findings.append(replace(finding, message=prefix + finding.message))
    return findings


def _statement(
    bands: Sequence[ComparedBand],
    after: Sequence[ComparedBand],
    names: tuple[str, str],
    fitted: LoopFit,
    word: str,
    views: Sequence[loop_problem.View],
) -> str:
    held = {name: [band.holds for band in bands if band.parameter == name] for name in names}
    shares = " and ".join(f"{name} in {sum(holds)} of {len(holds)}" for name, holds in held.items())
    sentences = [f"The 95 % interval of the bands holds the predicted {shares} bands: {word}."]
    if word == "unstable":
        growing = (view.test for view in views if verdict(view.file.suspension()).unstable)
        tests = ", ".join(test or "the test" for test in growing)
        what = f"The loop as stated is unstable on the mass of the bearing file ({tests})"
        sentences.append(f"{what}, whatever the bands show.")
    sentences.append(fit_statement(fitted))
    if after:
        shares_after = " and ".join(f"{name} in {100 * _share(after, name):.0f} %" for name in names)
        sentences.append(f"With the fitted values the bands hold {shares_after}.")
    return " ".join(sentences)


def _curves(view: loop_problem.View, changed: MagneticFile | None) -> Iterator[QuantityCurve]:
    """k and c over frequency of the bearing file, and of it with the fitted unknowns."""
    omega = view.measured.omega
    courses = {}
    for name, file in (("theory", view.file), ("matched", changed)):
        if file is not None:
            plant = file.suspension()
            courses[name] = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    for letter, unit in zip(LETTERS, ("N/m", "N.s/m"), strict=True):
        parts = {name: h.real if letter == "k" else h.imag / omega for name, h in courses.items()}
        yield curve_of(view.test, letter, unit, frequency=omega / (2 * np.pi), **parts)


def magnetic_theory(folder: Path, settings: TheorySettings) -> MagneticTheory:
    """The bearing file over the condition that sets an entry. ConfigError for another kind of bearing."""
    file = open_bearing(folder / settings.bearing)
    if file.kind_name != MAGNETIC:
        hint = f"a loop is predicted for the kind {MAGNETIC}"
        raise ConfigError(f"is of the kind {file.kind_name}", file.path, hint)

    def at(condition: float | None, unit: str) -> MagneticFile:
        return file.settings() if condition is None else file.settings_at(settings.entry, [(condition, unit)])

    return at


def _file_of(settings: CompareSettings, evidence: Evidence) -> MagneticFile | None:
    theory = _theory(settings, evidence)
    return None if theory is None else theory(None, "")


def _theory(settings: CompareSettings, evidence: Evidence) -> MagneticTheory | None:
    if evidence.theory is None and settings.theory is not None:
        return magnetic_theory(evidence.folder, settings.theory)
    given: MagneticTheory | None = evidence.theory
    return given


def prediction_of_tests(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """k and c of a loop predicted from its bearing file beside those of every band."""
    theory = _theory(settings, evidence)
    # A comparison of this kind needs one.
    assert theory is not None
    named, of_fit, views = evidence.fits_of(settings), evidence.settings_of(settings.fit), []
    for test in dict.fromkeys(fit.test for fit in named):
        response = evidence.response(test)
        at = condition_of(settings.condition, test, response.conditions) if settings.over else (None, "")
        fits = tuple(fit for fit in named if fit.test == test)
        view = loop_problem.View(test, response, of_fit, fits, theory(*at))
        views.append(loop_problem.checked_view(view))
    return prediction(settings, views)


def sensitivity_of_test(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """The sensitivity of a loop, from an excitation added in it."""
    if len(evidence.responses) != 1:
        hint = "one pipeline per setting of the loop"
        raise ConfigError(f"a sensitivity is that of one test, not of {len(evidence.responses)}", hint=hint)
    response = evidence.responses[0]
    comparison = loop_sensitivity(settings, response, _file_of(settings, evidence))
    sides = [port for port in response.outputs if port.label in (settings.before, settings.after)]
    return _with_directions_left_out(comparison, sides)


def certificate_of_test(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """The certificate of a closed loop, or of the decrements of a fit."""
    if settings.fit:
        return decrement_certificate(settings, [fit for fit in evidence.fits if fit.name == settings.fit])
    chosen = resolve(settings)
    tests: list[FrequencyResponse | ChannelSpectra] = [*evidence.responses, *evidence.spectra]
    names = ", ".join(test.name for test in tests if test.name) or f"{len(tests)} without names"
    if chosen.test:
        tests = [test for test in tests if test.name == chosen.test]
    if len(tests) != 1:
        wanted = f"no test '{chosen.test}'" if chosen.test else "one test is needed"
        hint = "one comparison per test, certificate: {test: NAME}"
        raise ConfigError(f"a certificate is that of one loop: {wanted} among {names}", hint=hint)
    response = tests[0] if isinstance(tests[0], FrequencyResponse) else response_per_injection(tests[0])
    comparison = certificate(settings, response, _file_of(settings, evidence))
    outputs = [port for port in response.outputs if port.label in chosen.recorded]
    return _with_directions_left_out(comparison, [*outputs, *(() if chosen.before else response.inputs)])


def _with_directions_left_out(comparison: Comparison, ports: Iterable[Port]) -> Comparison:
    """With a finding on *ports* of uncertain direction: nothing tells what they read across."""
    names = (port.label for port in ports if any(c.effect == "direction" for c in port.uncertainties))
    labels = ", ".join(dict.fromkeys(names))
    if not labels:
        return comparison
    what = f"uncertainties of the directions of {labels} are not propagated"
    finding = Finding("number-uncertainty", f"{what}: no other channel measures the motion across")
    return replace(comparison, findings=(*comparison.findings, finding))


PREDICTION = ComparisonKind(
    prediction_of_tests,
    keys=("fit", "parameter", "over", "theory", "estimate"),
    needs=("fit", "theory"),
    verdicts=("as predicted", "not as predicted", "unstable"),
    loop=True,
)
SENSITIVITY = ComparisonKind(
    sensitivity_of_test,
    keys=("before", "after", "theory", "estimate"),
    verdicts=tuple(f"zone {zone}" for zone in "ABCD"),
    loop=True,
)
CERTIFICATE = ComparisonKind(
    certificate_of_test,
    keys=("fit", "before", "after", "theory", "estimate"),
    verdicts=VERDICTS,
    loop=True,
    section="certificate",
    settings=LoopCertificateSettings,
)
