"""Which fits of which tests a comparison looks at, and what it says when they are not there."""

from __future__ import annotations

from dataclasses import replace

import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.records.finding import Finding
from labpipe.uncertainty.observations import campaign_of
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.uncertainty.conftest import a_fit

OVER = CompareSettings(kind="trend", fit="axial", over="preload", name="series")
CONDITIONS = {"b": {"preload": "0.7 kN"}, "a": {"preload": "427 N"}}


def test_tests_come_in_rising_condition_in_si() -> None:
    fits = [a_fit("b", {"k": (2e7, 1e4)}), a_fit("a", {"k": (1e7, 1e4)})]
    campaign = campaign_of(OVER, fits, CONDITIONS)
    assert [each.fit.test for each in campaign.observations] == ["a", "b"]
    assert campaign.condition.tolist() == [427.0, 700.0]
    assert (campaign.condition_unit, campaign.unit) == ("N", "N/m")
    points = campaign.points()
    assert [(point.test, point.condition, point.value) for point in points] == [
        ("a", 427.0, 1e7),
        ("b", 700.0, 2e7),
    ]
    assert points[0].ci95 == (1e7 - 2e4, 1e7 + 2e4)


def test_a_pure_number_is_a_condition_and_fractions_come_in_parts_of_one() -> None:
    fits = [a_fit("a", {"k": (1.0, 0.1)}), a_fit("b", {"k": (2.0, 0.1)})]
    campaign = campaign_of(OVER, fits, {"a": {"preload": 3}, "b": {"preload": "50 %"}})
    assert campaign.condition.tolist() == [0.5, 3.0]
    assert campaign.condition_unit == "1"


def test_a_term_is_chosen_among_peaks() -> None:
    fits = [
        a_fit(test, {"k": (value, 1.0)}, term=term)
        for test, term, value in (("a", "x", 1.0), ("a", "z", 2.0), ("b", "x", 3.0))
    ]
    settings = CompareSettings(kind="trend", fit="axial", term="x", over="preload")
    assert campaign_of(settings, fits, CONDITIONS).value.tolist() == [1.0, 3.0]
    with pytest.raises(ConfigError, match="has no term 'y'"):
        campaign_of(CompareSettings(kind="trend", fit="axial", term="y", over="preload"), fits, CONDITIONS)
    with pytest.raises(ConfigError, match="several results in test 'a'"):
        campaign_of(OVER, fits, CONDITIONS)


@pytest.mark.parametrize(
    ("conditions", "what"),
    [
        ({"a": {}, "b": {}}, "test 'a' has no condition 'preload'"),
        ({"a": {"preload": "up"}, "b": {"preload": "1 N"}}, "of test 'a': 'up' is not an amount"),
        ({"a": {"preload": "3 Nn"}, "b": {"preload": "1 N"}}, "unknown unit 'Nn'"),
        ({"a": {"preload": "3 N.m^4"}, "b": {"preload": "1 N"}}, "unusual dimension"),
        ({"a": {"preload": "3 m"}, "b": {"preload": "1 N"}}, "has the units N, m"),
    ],
)
def test_conditions_that_do_not_serve_are_named(conditions, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        campaign_of(OVER, [a_fit("a", {"k": (1.0, 0.1)}), a_fit("b", {"k": (1.0, 0.1)})], conditions)


def test_missing_fits_parameters_and_errors_are_named() -> None:
    fits = [a_fit("a", {"k": (1.0, 0.1)}), a_fit("b", {"k": (1.0, 0.1)})]
    with pytest.raises(ConfigError, match="no fit 'axail' to compare") as caught:
        campaign_of(CompareSettings(kind="trend", fit="axail", over="preload"), fits, CONDITIONS)
    assert "axial" in caught.value.hint
    with pytest.raises(ConfigError, match="fit 'axial' has no 'c'"):
        campaign_of(
            CompareSettings(kind="trend", fit="axial", parameter="c", over="preload"), fits, CONDITIONS
        )
    with pytest.raises(FitError, match=r"has 1 test\(s\)"):
        campaign_of(OVER, fits[:1], CONDITIONS)
    negative = campaign_of(OVER, [a_fit("a", {"k": (-1.0, 0.1)}), fits[1]], CONDITIONS)
    with pytest.raises(FitError, match="only positive values"):
        assert negative.relative is None
    turned = replace(negative.observations[0].fit, findings=(Finding("unphysical", "a sign is wrong"),))
    with pytest.raises(FitError, match="is -1") as caught:
        assert replace(negative.observations[0], fit=turned).relative is None
    assert caught.value.hint == "only positive values have a ratio; a sign is wrong"


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"kind": "trend", "over": "preload"}, "'fit' is missing"),
        ({"kind": "trend", "fit": "axial"}, "'over' is missing"),
        (
            {"kind": "difference", "fit": "axial", "group": "way", "groups": ("up",)},
            "two groups are compared, not up",
        ),
        ({"kind": "repeatability", "fit": "axial"}, "'group' is missing"),
        ({"kind": "ratio", "fit": "axial", "over": "preload"}, "'theory' is missing"),
        ({"kind": "trend", "fit": "axial", "over": "preload", "level": 1.0}, "level must lie"),
        (
            {"kind": "trend", "fit": "axial", "over": "preload", "setting_error": -0.1},
            "setting_error must not",
        ),
    ],
)
def test_settings_say_what_they_lack(given, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        CompareSettings(**given)


def test_a_theory_s_arm_and_shaft_must_be_above_zero() -> None:
    with pytest.raises(ConfigError, match="arm must be positive"):
        TheorySettings("b.yaml", arm=0.0)
