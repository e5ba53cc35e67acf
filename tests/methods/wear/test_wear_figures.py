"""The figures of worn-bearing fits show what the fit says, and travel through its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.methods.wear.report import region_figure
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import Region
from labpipe.records.identification import Fit, FittedCurve, Goodness, Identification
from labpipe.report.build import build
from labpipe.report.document import Figure
from labpipe.report.figures import tuning_figure
from labpipe.report.fits import blocks_of_details, fit_figures

TURN = np.linspace(0, 2 * np.pi, 12, endpoint=False)
OUTLINE = np.column_stack([22e-6 + 0.3e-6 * np.cos(TURN), np.deg2rad(11 + 0.5 * np.sin(TURN))])
REGION = Region(("wear_depth", "wear_angle"), OUTLINE, 0.95)
FREQUENCY = np.linspace(20.0, 90.0, 8)


def curve(before: bool) -> FittedCurve:
    """Four terms, the fit 10 % and the model before it 40 % above the measured response."""
    measured = np.multiply.outer(
        1e-6 * (1 + 0.5j) * (1 + FREQUENCY / 50), np.array([[1.0, 0.2], [-0.2, 0.8]])
    )
    own = 1.4 * measured if before else None
    return FittedCurve(
        FREQUENCY,
        measured,
        1.1 * measured,
        variance=None,
        outputs=("y", "z"),
        inputs=("y", "z"),
        form="receptance",
        before=own,
    )


def fit(region: Region | None = None, before: bool = False) -> Fit:
    depth = Parameter("wear_depth", 22e-6, "m", std_error=0.12e-6, ci95=(21.76e-6, 22.24e-6))
    angle = Parameter(
        "wear_angle",
        float(np.deg2rad(11)),
        "rad",
        std_error=0.0035,
        ci95=(float(np.deg2rad(10.6)), float(np.deg2rad(11.4))),
    )
    return Fit(
        "wear",
        "worn-bearing",
        "ml",
        band_hz=(20.0, 90.0),
        lines=8,
        equations=64,
        dof=62,
        gof=Goodness(0.99, 0.99),
        parameters=(depth, angle),
        condition_number=3.0,
        correlation=np.eye(2),
        curve=curve(before),
        details=() if region is None else (region,),
    )


def through_file(found: Fit, folder: Path) -> Fit:
    path = folder / "identification.json"
    write_identification(path, Identification((found,), version="1"))
    return read_identification(path).fits[0]


def test_region_is_drawn_closed_in_the_units_people_read() -> None:
    (panel,) = region_figure(fit(REGION), REGION).graphic.panels
    shade, edge = (series for series in panel.series if series.name == "95 % joint region")
    assert (shade.kind, edge.kind) == ("area", "line")
    np.testing.assert_allclose(edge.x, [*(OUTLINE[:, 0] * 1e6), OUTLINE[0, 0] * 1e6])
    np.testing.assert_allclose(edge.y[:-1], np.rad2deg(OUTLINE[:, 1]))
    estimate = panel.series[-1]
    assert estimate.name == "estimate" and (estimate.x[0], estimate.y[0]) == pytest.approx((22.0, 11.0))
    assert panel.x.label == "wear_depth [um]" and panel.y.label == "wear_angle [deg]"


def test_intervals_of_each_parameter_alone_are_drawn_beside_the_region() -> None:
    (panel,) = region_figure(fit(REGION), REGION).graphic.panels
    assert [series.x[0] for series in panel.series if series.kind == "vline"] == pytest.approx([21.76, 22.24])
    assert [series.y[0] for series in panel.series if series.kind == "hline"] == pytest.approx([10.6, 11.4])


def test_a_parameter_without_interval_leaves_its_lines_out() -> None:
    found = fit(REGION)
    found = replace(found, parameters=(replace(found.parameters[0], ci95=None), found.parameters[1]))
    (panel,) = region_figure(found, REGION).graphic.panels
    assert [series.kind for series in panel.series if series.line == "--"] == ["hline", "hline"]


def test_tuning_shows_measured_before_and_after_in_one_panel_per_term() -> None:
    found = curve(True)
    panels = tuning_figure(fit(), found).graphic.panels
    assert [panel.y.title.split()[0] for panel in panels] == ["y/y", "y/z", "z/y", "z/z"]
    for panel, size in zip(panels, (1.0, 0.2, 0.2, 0.8), strict=True):
        drawn = {series.name: series.y for series in panel.series}
        expected = size * np.abs(1 + 0.5j) * (1 + FREQUENCY / 50)
        ratio = drawn["measured"] / expected
        np.testing.assert_allclose(ratio, ratio[0])
        np.testing.assert_allclose(drawn["before tuning"] / drawn["measured"], 1.4)
        np.testing.assert_allclose(drawn["after tuning"] / drawn["measured"], 1.1)


@pytest.mark.parametrize(
    ("region", "before", "count"), [(None, False, 0), (REGION, False, 1), (None, True, 1), (REGION, True, 2)]
)
def test_a_fit_has_the_figures_it_has_something_for(region: Region | None, before: bool, count: int) -> None:
    regions = list(blocks_of_details(fit(region, before)))
    tunings = len(fit_figures(fit(region, before))) - len(fit_figures(fit(region, False)))
    assert len(regions) + tunings == count


def test_region_and_model_before_tuning_travel_through_the_file(tmp_path: Path) -> None:
    again = through_file(fit(REGION, before=True), tmp_path)
    assert (
        again.detail(Region) is not None
        and again.detail(Region).names == REGION.names
        and again.detail(Region).level == REGION.level
    )
    np.testing.assert_array_equal(again.detail(Region).outline, OUTLINE)
    assert again.curve is not None and again.curve.before is not None
    np.testing.assert_array_equal(again.curve.before, curve(True).before)


def test_a_file_without_them_says_nothing_of_them(tmp_path: Path) -> None:
    again = through_file(fit(), tmp_path)
    assert again.detail(Region) is None and again.curve is not None and again.curve.before is None
    text = (tmp_path / "identification.json").read_text(encoding="utf-8")
    assert '"region": null' in text and '"before": null' in text


def test_the_report_holds_both_figures() -> None:
    document = build(Identification((fit(REGION, before=True),), version="1"))
    captions = [
        block.caption
        for section in document.sections
        for block in section.blocks
        if isinstance(block, Figure)
    ]
    assert sum("joint 95 % confidence region" in caption for caption in captions) == 1
    assert sum("before and after its tuning" in caption for caption in captions) == 1
