"""Predicted against measured bands of a loop: shares, ratios, unknowns, unstable settings."""

from __future__ import annotations

import functools
import json
from dataclasses import replace

import numpy as np
import pytest

from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.comparisons import prediction
from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.methods.magnetic_bearing.loop_problem import View, predicted_fits, with_unknowns
from labpipe.records.comparison import Comparison
from labpipe.report.comparison import comparison_blocks
from labpipe.report.document import Figure, Paragraph, Table
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.methods.magnetic_bearing.loop_cases import SETTINGS, bearing, measured

# Fits of loops that take a second each.
pytestmark = pytest.mark.long

ASKED = CompareSettings(
    kind="prediction", fit="sliding", theory=TheorySettings("hmb.yaml", "loop.proportional"), name="loop"
)
GEOMETRY = bearing("hmb-geometry")


@functools.cache
def recorded(truth: MagneticFile = GEOMETRY) -> View:
    """The bands of one noise, for all that look at them."""
    return measured(truth, np.random.default_rng(20240917), fits=True)


def predicted(file: MagneticFile, truth: MagneticFile = GEOMETRY, **settings) -> Comparison:
    return prediction(replace(ASKED, **settings), [replace(recorded(truth), file=file)])


@functools.cache
def of_another_loop() -> Comparison:
    return predicted(with_unknowns(GEOMETRY, {"proportional": 1.1}))


def test_the_right_loop_lies_in_the_bands() -> None:
    found = predicted(GEOMETRY)
    assert found.verdict == "as predicted" and found.verdict in found.statement
    assert found.amount("share_k").value >= 0.9 and found.amount("share_c").value >= 0.9
    assert found.amount("bands").value == 16 and len(found.bands) == 32
    assert found.amount("chi2_p").value > 1e-3
    band = next(band for band in found.bands if band.parameter == "k" and band.holds)
    assert band.ratio == pytest.approx(band.value / band.other)
    assert band.ratio_ci95 is not None and band.ratio_ci95[0] <= 1 <= band.ratio_ci95[1]
    # Courses beside the bands: k + j w c of the file itself.
    stiffness, damping = found.curves
    omega, plant = 2 * np.pi * np.array(stiffness.frequency), GEOMETRY.suspension()
    whole = np.array(stiffness.theory) + 1j * omega * np.array(damping.theory)
    np.testing.assert_allclose(whole, dynamic_stiffness(plant.loop, plant.negative_stiffness, omega))


def test_another_loop_does_not() -> None:
    found = of_another_loop()
    assert found.verdict == "not as predicted" and found.amount("share_k").value < 0.9
    assert found.amount("chi2_p").value < 1e-6


def test_the_prediction_is_the_same_fit_of_the_theory_and_not_its_value_at_the_centre(
    rng: np.random.Generator,
) -> None:
    """Without noise both fits are one, which the values at the centres are not where k(f) bends: 3 % in the
    lowest band.
    """
    view = measured(GEOMETRY, rng, noise=1e-6, fits=True)
    stiffness = np.array(
        [[fit.parameter("k").value for fit in fits] for fits in (view.fits, predicted_fits(view, GEOMETRY))]
    )
    # What is left is the support, drawn within 100 N/m for both bearings.
    np.testing.assert_allclose(stiffness[0], stiffness[1], atol=200)
    plant, centre = GEOMETRY.suspension(), 2 * np.pi * np.array([view.fits[0].centre_hz])
    assert (
        abs(stiffness[1, 0] / dynamic_stiffness(plant.loop, plant.negative_stiffness, centre)[0].real - 1)
        > 0.03
    )


def test_unknowns_are_fitted_and_the_bands_judged_again() -> None:
    wrong = with_unknowns(GEOMETRY, {"gap": 0.47e-3})
    found = predicted(wrong, estimate=("gap", "delay"))
    gap = found.amount("gap")
    assert gap.ci95 is not None and gap.ci95[0] <= 0.45e-3 <= gap.ci95[1] < 0.47e-3
    assert found.amount("share_k").value < found.amount("share_k_fitted").value
    assert found.correlations[0][:2] == ("delay", "gap")
    assert all(
        len(curve.matched) == len(curve.theory) == len(curve.frequency) > 200 for curve in found.curves
    )


def test_unknowns_that_cannot_be_told_apart_are_said() -> None:
    file = replace(bearing("hmb-magnetic"), static_stiffness=None, negative_stiffness=33106.0)
    found = predicted(file, estimate=("gain", "force_per_current"))
    assert [finding.code for finding in found.findings if finding.code == "collinear"]
    assert found.amount("gain").ci95 is None and "cannot be told apart" in found.statement
    assert "share_k_fitted" not in [amount.name for amount in found.amounts]


def test_an_unstable_setting_is_said() -> None:
    """The printed sign of the lag: pedestal and rotor stand, the bearing file's rotor alone does not."""
    printed = replace(bearing("hmb-magnetic"), loop=replace(bearing("hmb-magnetic").loop, lag=0.25))
    found = predicted(printed, truth=printed)
    assert found.verdict == "unstable" and "unstable" in found.statement
    assert found.amount("unstable_poles").value == 2
    assert "unstable-loop" in [finding.code for finding in found.findings]
    assert "sensitivity_peak" not in [amount.name for amount in found.amounts]
    # The bands hold it all the same, since the loop of the recording is this one.
    assert found.amount("share_k").value >= 0.9


def test_tests_under_several_gains_are_predicted_each_by_its_own(rng: np.random.Generator) -> None:
    asked: list[float | None] = []

    def theory(condition: float | None, unit: str) -> MagneticFile:
        asked.append(condition)
        return GEOMETRY if condition is None else with_unknowns(GEOMETRY, {"proportional": condition})

    responses, fits = [], []
    for gain in (1.0, 1.2):
        name = f"gain {gain}"
        view = measured(theory(gain, "1"), rng, fits=True)
        responses.append(replace(view.response, name=name, conditions={"gain": str(gain)}))
        fits.extend(replace(fit, test=name) for fit in view.fits)
    asked.clear()
    evidence = Evidence(tuple(fits), tuple(responses), (SETTINGS,))
    found = compare(replace(ASKED, over="gain"), evidence, theory)
    assert asked == [1.0, 1.2] and found.verdict == "as predicted"
    assert {band.test for band in found.bands} == {"gain 1.0", "gain 1.2"}
    plain = compare(ASKED, evidence, theory)
    assert asked[2:] == [None, None] and plain.verdict == "not as predicted"
    with pytest.raises(ConfigError, match="no fit 'slidin'"):
        compare(replace(ASKED, fit="slidin"), evidence, theory)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parameter": "k_yy"}, "no 'k_yy'"),
        ({"parameter": "m"}, "no 'm'"),
        ({"estimate": ("gab",)}, "'gab' is not an unknown"),
    ],
)
def test_what_cannot_be_predicted_is_said(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        predicted(GEOMETRY, **settings)


def test_a_prediction_survives_its_file_and_is_reported() -> None:
    found = predicted(with_unknowns(GEOMETRY, {"gap": 0.46e-3}), estimate=("gap", "delay"))
    # Budgets hold arrays, which their entries compare.
    assert entry_of(record_of(json.loads(json.dumps(entry_of(found))), Comparison)) == entry_of(found)
    blocks = comparison_blocks(found, ())
    figure, _of_shares = (block for block in blocks if isinstance(block, Figure))
    above, middle, below = figure.graphic.panels
    assert (
        above.y.label == "k [kN/m]"
        and middle.y.label == "c [N s/m]"
        and "measured / predicted" in below.y.label
    )
    assert above.series[0].y[0] == pytest.approx(found.bands[0].value / 1e3)
    assert [series.name for series in above.series] == [
        "measured",
        "predicted",
        "loop",
        "with the fitted unknowns",
    ]
    tables = [block for block in blocks if isinstance(block, Table)]
    gap = next(row for row in tables[0].rows if row[0] == "gap")
    delay = next(row for row in tables[0].rows if row[0] == "delay")
    assert gap[2] == "um" and delay[2] == "us"
    assert ("unknown", "and", "correlation") in [table.header for table in tables]
    # The rest of the support's uncertainty that the response does not take away.
    assert any(row[0].startswith("stiffness of the support") for row in tables[-1].rows)
    assert any(isinstance(block, Paragraph) and block.text.startswith("sensitivity:") for block in blocks)


def test_bands_that_miss_are_marked() -> None:
    found = of_another_loop()
    table = next(
        block
        for block in comparison_blocks(found, ())
        if isinstance(block, Table) and block.header[0] == "band [Hz]"
    )
    marked = [row[1].endswith("*") for row in table.rows]
    assert marked == [not band.holds for band in found.bands if band.parameter == "k"]
