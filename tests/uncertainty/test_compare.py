"""The table of comparisons: every kind answers, every verdict is one of the documented ones, the same theory
is matched once.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.methods.rolling_bearing.ratio import TheoryAt
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Finding
from labpipe.records.identification import Identification, listed_parameters
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Uncertain
from labpipe.report.comparison import EXPLAINED, FIGURES, OVER_FREQUENCY
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import COMPARISONS, CompareSettings, TheorySettings
from tests.uncertainty.test_theory import BENDING, PEAKS, SHAFT, K, measured

VERDICTS = {
    "trend": {"rising", "falling", "no trend", "curved"},
    "difference": {"different", "no difference"},
    "quotient": {"different", "no difference"},
    "repeatability": {"settings differ", "settings alike"},
    "ratio": {"stiffer than theory", "softer than theory", "as theory"},
    "rayleigh": {"proportional", "not proportional"},
    "reciprocity": {"reciprocal", "not reciprocal"},
}
THEORY = TheorySettings("bearing.yaml", shaft=Uncertain(BENDING, 0.01 * BENDING), arm=0.1)
SERIES = {"fit": "peaks", "term": "z", "over": "preload", "name": "series"}


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    """Three preloads up and down: the 6208 at 427 N with its matrix growing as the preload, ratio 1.12."""
    rng = np.random.default_rng(20240917)
    responses, fits = [], []
    for way in ("up", "down"):
        for preload in (427.0, 500.0, 600.0):
            name = f"{preload:g} {way}"
            made = measured(1.12 * preload / 427, BENDING, rng)
            responses.append(
                dataclasses.replace(made, name=name, conditions={"preload": f"{preload:g} N", "way": way})
            )
            fits.extend(dataclasses.replace(fit, test=name) for fit in identify(made, PEAKS))
    return Evidence(tuple(fits), tuple(responses), (PEAKS,))


def theory(calls: list[float]) -> Callable[[Sequence[tuple[float, str]]], TheoryAt]:
    def at(conditions: Sequence[tuple[float, str]]) -> TheoryAt:
        ((condition, unit),) = conditions
        assert unit == "N"
        calls.append(condition)
        return TheoryAt(K * condition / 427, K * condition / 427 * 1.001, 1e-3, SHAFT)

    return at


@pytest.fixture(scope="module")
def every_kind(evidence: Evidence) -> dict[str, Comparison]:
    own = {
        "trend": CompareSettings(kind="trend", law="power", **SERIES),
        "difference": CompareSettings(kind="difference", group="way", groups=("up", "down"), **SERIES),
        "quotient": CompareSettings(kind="quotient", group="way", groups=("up", "down"), **SERIES),
        "repeatability": CompareSettings(kind="repeatability", group="preload", **SERIES),
        "ratio": CompareSettings(kind="ratio", theory=THEORY, **SERIES),
        "rayleigh": CompareSettings(kind="rayleigh", **SERIES),
        "reciprocity": CompareSettings(kind="reciprocity", name="symmetry"),
    }
    return {
        kind: compare(settings, evidence, theory([]) if settings.theory else None)
        for kind, settings in own.items()
    }


@pytest.mark.long
def test_every_kind_answers_with_a_documented_verdict_and_survives_its_file(every_kind) -> None:
    # Those over frequency are looked at in test_prediction, test_bandwise and test_sensitivity.
    assert set(every_kind) == set(VERDICTS) == {*FIGURES, "reciprocity"}
    assert set(COMPARISONS) == set(EXPLAINED) == {*every_kind, *OVER_FREQUENCY}
    page = (Path(__file__).parents[2] / "docs/pages/comparisons.md").read_text()
    for kind, comparison in every_kind.items():
        assert comparison.kind == kind
        assert comparison.verdict in VERDICTS[kind]
        assert comparison.verdict in comparison.statement or kind == "ratio"
        entry = json.loads(json.dumps(entry_of(comparison)))
        assert record_of(entry, Comparison) == comparison
        for verdict in VERDICTS[kind]:
            assert verdict in page


def test_the_numbers_are_those_of_the_making(every_kind) -> None:
    """K grows as the preload, so the exponent of z is 1; the ratio is 1.12; beta 20 us.

    Both ways are alike.
    """
    within = {
        "trend": ("exponent", 1.0),
        "ratio": ("ratio", 1.12),
        "rayleigh": ("beta", 20e-6),
        "difference": ("difference", 0.0),
    }
    within["quotient"] = ("quotient", 1.0)
    for kind, (name, truth) in within.items():
        amount = every_kind[kind].amount(name)
        assert abs(amount.value - truth) < 4 * amount.std_error, kind
    assert every_kind["trend"].verdict == "rising"
    assert every_kind["ratio"].verdict == "stiffer than theory"
    assert every_kind["ratio"].amount("beta").std_error is None
    # Lists of results have them under the names of their comparisons.
    warned = dataclasses.replace(every_kind["trend"], findings=(Finding("collinear", "x"),))
    comparisons = (warned, every_kind["ratio"])
    listed = list(listed_parameters(Identification((), sections={"compare": comparisons})))
    assert [(one.fit, one.model, one.parameter, one.warnings) for one in listed] == [
        (
            one.name,
            one.kind,
            amount,
            ("collinear",)
            if one is warned
            else tuple(dict.fromkeys(f.code for f in one.findings if f.level == "warning")),
        )
        for one in comparisons
        for amount in one.amounts
    ]


@pytest.mark.long
def test_a_theory_is_asked_once_per_condition_and_matched_once_per_term(evidence) -> None:
    calls: list[float] = []
    radial = {**SERIES, "term": "x"}
    first = compare(CompareSettings(kind="ratio", theory=THEORY, **radial), evidence, theory(calls))
    assert sorted(calls) == [427.0, 500.0, 600.0]
    second = compare(CompareSettings(kind="rayleigh", theory=THEORY, **radial), evidence, theory(calls))
    assert len(calls) == 3
    assert first.amount("ratio").value == pytest.approx(1.12, rel=0.01)
    assert second.amount("beta").value == pytest.approx(20e-6, rel=0.01)
    compare(
        CompareSettings(kind="ratio", theory=dataclasses.replace(THEORY, shaft=None), **radial),
        evidence,
        theory(calls),
    )
    assert len(calls) == 6


def test_the_bending_shaft_makes_radial_damping_fall_though_the_bearing_s_grows(evidence) -> None:
    """The measured c over the preload falls, the bearing's damping is beta K: the theory sees through it, c /
    k does not.
    """
    radial = {**SERIES, "term": "x"}
    assert (
        compare(CompareSettings(kind="trend", parameter="c", law="power", **radial), evidence).verdict
        == "falling"
    )
    assert compare(CompareSettings(kind="rayleigh", **radial), evidence).verdict == "not proportional"
    assert (
        compare(CompareSettings(kind="rayleigh", theory=THEORY, **radial), evidence, theory([])).verdict
        == "proportional"
    )


def test_overlays_are_the_first_and_the_last_condition(evidence) -> None:
    found = compare(CompareSettings(kind="ratio", theory=THEORY, **SERIES), evidence, theory([]))
    assert [overlay.test.split()[0] for overlay in found.overlays] == ["427", "600"]
    for overlay in found.overlays:
        measured_peak, matched_peak, theory_peak = (
            max(curve) for curve in (overlay.measured, overlay.matched, overlay.theory)
        )
        assert matched_peak == pytest.approx(measured_peak, rel=0.02)
        assert theory_peak < 1.1 * matched_peak


def test_errors_name_the_test_and_what_is_missing(evidence) -> None:
    settings = CompareSettings(
        kind="ratio", theory=dataclasses.replace(THEORY, arm=None), **{**SERIES, "term": "by"}
    )
    with pytest.raises(ConfigError, match="test 427 up: the tilt by is compared without an arm"):
        compare(settings, evidence, theory([]))
    with pytest.raises(ConfigError, match=r"bearing\.yaml: no such file"):
        compare(CompareSettings(kind="ratio", theory=THEORY, **SERIES), evidence, None)
    with pytest.raises(ConfigError, match="response of test '427 up' is missing"):
        dataclasses.replace(evidence, responses=evidence.responses[1:]).response("427 up")


def test_fits_that_were_corrected_are_not_compared_with_a_theory(evidence) -> None:
    for change, said in (
        ({"share": 2}, "corrected for support or share"),
        ({"damping": "hysteretic"}, "has hysteretic damping; the theory's is viscous"),
    ):
        fit_settings = (dataclasses.replace(PEAKS, **change),)
        other = dataclasses.replace(evidence, fit_settings=fit_settings, solved={})
        with pytest.raises(ConfigError, match=said):
            compare(CompareSettings(kind="ratio", theory=THEORY, **SERIES), other, theory([]))


def test_a_fit_without_noise_gives_the_ratio_itself() -> None:
    quiet: list[FrequencyResponse] = []
    fits = []
    axial = dataclasses.replace(PEAKS, peaks=PEAKS.peaks[1:2])
    for preload in (427.0, 500.0):
        made = dataclasses.replace(
            measured(1.12 * preload / 427, BENDING), covariance=None, name=f"{preload:g}"
        )
        quiet.append(dataclasses.replace(made, conditions={"preload": f"{preload:g} N"}))
        fits.extend(dataclasses.replace(fit, test=made.name) for fit in identify(made, axial))
    evidence = Evidence(tuple(fits), tuple(quiet), (axial,))
    found = compare(CompareSettings(kind="ratio", theory=THEORY, **SERIES), evidence, theory([]))
    # The residual of an exact model is rounding: the ratio is exact, its interval next to nothing.
    assert found.amount("ratio").value == pytest.approx(1.12, rel=1e-6)


def test_one_test_is_no_campaign(evidence) -> None:
    assert evidence.settings_of("peaks") is PEAKS
    with pytest.raises(ConfigError, match="the settings of fit 'decays' are missing"):
        evidence.settings_of("decays")
    with pytest.raises(FitError, match="at least two are needed"):
        Evidence(evidence.fits[:3], evidence.responses, (PEAKS,)).campaign(
            CompareSettings(kind="trend", **SERIES)
        )


PAIR = {"kind": "difference", "fit": "a", "groups": ("up", "down")}
OF_LOOP = {"kind": "prediction", "fit": "a", "over": ("gain",)}


@pytest.mark.parametrize(
    ("entries", "message", "hint"),
    [
        ({"kind": "trend", "fit": "a"}, "'over' is missing", "a comparison of kind trend needs it"),
        ({**PAIR, "groups": ("up",)}, "two groups are compared, not up", "[up, down]"),
        ({**PAIR, "groups": ("up", "up")}, "two groups are compared, not up, up", "[up, down]"),
        ({**PAIR, "over": ("a", "b", "c")}, "goes over 2 condition(s), not 3", "two: trend, difference"),
        ({**PAIR, "over": ("a", "a")}, "'over' names 'a' twice", ""),
        ({**PAIR, "tolerance": 1.0}, "at least 0 and below 100 %", ""),
        ({**PAIR, "tolerance": -0.1}, "at least 0 and below 100 %", ""),
        ({**PAIR, "level": 1.0}, "between 0 and 100 %", ""),
        ({**PAIR, "level": 0.0}, "between 0 and 100 %", ""),
        ({**PAIR, "setting_error": -0.1}, "must not be negative", ""),
        ({**PAIR, "theory": {}}, "'theory' is not for the kind difference", "ratio, rayleigh, prediction"),
        ({"kind": "sensitivity", "estimate": ("gap",)}, "no loop whose unknowns", "theory: {bearing: FILE}"),
        ({**OF_LOOP, "theory": {}, "estimate": ("gap", "gap")}, "names an unknown twice", "gap"),
        ({**OF_LOOP, "theory": {}}, "'theory.entry' is missing", "entry: loop.proportional"),
        ({**OF_LOOP, "theory": {"shaft": Uncertain(1e3)}}, "'theory.shaft' is not for the kind pred", "out"),
        (
            {**OF_LOOP, "theory": {"entry": ("a", "b")}},
            "names 2 entries for 1 conditions",
            "[speed, loads.z]",
        ),
        (
            {**OF_LOOP, "theory": {"entry": ("loop.gap",)}, "estimate": ("gap",)},
            "'loop.gap' is set by 'gain', so it is not estimated",
            "leave one of them out",
        ),
        (
            {"kind": "rayleigh", "fit": "a", "over": ("x",), "theory": {"arm": 0.0}},
            "arm must be positive",
            "",
        ),
        ({**PAIR, "theory": {"shaft": Uncertain(0.0)}}, "shaft must be positive", ""),
        (
            {"kind": "trend", "fit": "a", "over": ("x",), "kind_settings": 1},
            "not those of the kind trend",
            "out",
        ),
    ],
)
def test_settings_that_contradict_themselves_are_refused(entries, message: str, hint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        theory = {"theory": TheorySettings("b.yaml", **entries["theory"])} if "theory" in entries else {}
        CompareSettings(**{**entries, **theory})
    assert message in refused.value.what and hint in refused.value.hint


def test_settings_at_their_limits_are_taken() -> None:
    assert (
        CompareSettings(**PAIR, over=("a", "b"), tolerance=0.0, level=0.999, setting_error=0.0).second == "b"
    )
    theory = TheorySettings("b.yaml", entry=("loop.gap",))
    settings = CompareSettings(**OF_LOOP, theory=theory, estimate=("delay",))
    assert (settings.condition, settings.second) == ("gain", "")
    assert CompareSettings(kind="certificate").kind_settings is not None
