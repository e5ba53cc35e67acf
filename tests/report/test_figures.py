"""The figures of fits and responses hold the numbers of the records, in the units people read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, FittedCurve, Goodness, Identification
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.report.chart import Drawing, Panel, Series
from labpipe.report.document import Table
from labpipe.report.figures import (
    VIEWS,
    correlation_figure,
    fitted_curve_figure,
    form_unit,
    line_figure,
    matrix_figure,
    project,
    response_figure,
    sliding_figures,
)
from labpipe.report.fits import fit_sections

FREQUENCY = np.array([10.0, 20.0, 30.0])
MATRIX = np.array([1.0, 2j, -4.0])[:, None, None] * 1e-6
K = Parameter("k", 45200.0, "N/m", std_error=31.0, ci95=(45137.0, 45263.0))
C = Parameter("c", 3.7, "N.s/m", std_error=0.1, ci95=(3.5, 3.9))
FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(10.0, 30.0),
    lines=3,
    equations=6,
    dof=4,
    gof=Goodness(0.99, 0.98, 1.1, 0.4),
    parameters=(K, C),
    condition_number=2.0,
    correlation=np.array([[1.0, -0.4], [-0.4, 1.0]]),
)
CURVE = FittedCurve(
    FREQUENCY,
    MATRIX,
    2 * MATRIX,
    variance=np.full(MATRIX.shape, 1e-14),
    outputs=("y",),
    inputs=("f",),
    form="receptance",
)
RESPONSE = FrequencyResponse(FREQUENCY, MATRIX, (Port("y", "y", "y"),), (Port("f", "f", "y"),), name="run 1")


def named(panel: Panel) -> dict[str, Series]:
    return {series.name: series for series in panel.series}


def test_amplitude_and_phase_are_those_of_measurement_and_fit() -> None:
    amplitude, phase, _ = fitted_curve_figure(FIT, CURVE).graphic.panels
    assert (
        amplitude.y.label == "receptance [um/N]"
        and amplitude.y.logarithmic
        and phase.y.label == "phase [deg]"
    )
    np.testing.assert_allclose(named(amplitude)["y/f measured"].y, [1.0, 2.0, 4.0])
    np.testing.assert_allclose(named(amplitude)["y/f fitted"].y, [2.0, 4.0, 8.0])
    np.testing.assert_allclose(named(phase)["y/f measured"].y, [0.0, 90.0, 180.0])


def test_the_residual_is_relative_to_the_fit_with_its_band_where_the_noise_has_a_variance() -> None:
    figure = fitted_curve_figure(FIT, CURVE)
    (residual,) = figure.graphic.panels[2].series
    np.testing.assert_allclose(residual.y, 50.0)
    # sqrt(ln 20) x 1e-7 m/N against 2, 4 and 8 um/N, in per cent.
    np.testing.assert_allclose(residual.high, 100 * np.sqrt(np.log(20)) * 0.1 / np.array([2.0, 4.0, 8.0]))
    assert residual.interval == "shaded" and not residual.low.any() and "shaded: 95 %" in figure.caption
    bare = fitted_curve_figure(FIT, replace(CURVE, variance=None))
    assert bare.graphic.panels[2].series[0].low is None and "shaded" not in bare.caption


def test_an_element_that_the_model_takes_for_zero_has_no_relative_residual() -> None:
    two = np.concatenate([MATRIX, MATRIX], axis=2)
    fitted = two * [2.0, 0.0]
    curve = replace(CURVE, measured=two, fitted=fitted, variance=None, inputs=("f", "g"))
    panels = fitted_curve_figure(FIT, curve).graphic.panels
    assert list(named(panels[0])) == ["y/f measured", "y/f fitted", "y/g measured", "y/g fitted"]
    assert list(named(panels[2])) == ["y/f measured"]


def test_the_fit_is_drawn_where_it_was_computed_between_the_lines() -> None:
    between = np.linspace(10.0, 30.0, 5)
    dense = replace(CURVE, dense_frequency=between, dense=np.full((5, 1, 1), 3e-6 + 0j))
    series = named(fitted_curve_figure(FIT, dense).graphic.panels[0])
    assert series["y/f fitted"].x.tolist() == between.tolist() and series["y/f fitted"].y == pytest.approx(
        [3.0] * 5
    )
    assert series["y/f measured"].x.tolist() == FREQUENCY.tolist()


def test_correlations_stand_in_cells_with_their_names() -> None:
    figure = correlation_figure(FIT)
    (panel,) = figure.graphic.panels
    (cells,) = panel.series
    assert cells.texts == (("1.00", "-0.40"), ("-0.40", "1.00")) and cells.y[0, 1] == -0.4
    assert [name for _, name in panel.x.ticks] == ["k", "c"]


def test_sliding_coefficients_over_the_centres_with_their_intervals() -> None:
    fits = [replace(FIT, band_hz=(low, low + 15.0)) for low in (10.0, 13.0)]
    fits[1] = replace(fits[1], gof=Goodness(0.9, 0.89), parameters=(replace(K, ci95=None), C))
    stiffness, damping, goodness = sliding_figures(fits)
    (k,) = stiffness.graphic.panels[0].series
    assert (
        k.x.tolist() == [17.5, 20.5]
        and k.y == pytest.approx([45.2, 45.2])
        and stiffness.graphic.panels[0].y.label == "k [kN/m]"
    )
    assert k.low[0] == pytest.approx(45.137) and np.isnan(k.low[1]) and "2 bands" in stiffness.caption
    assert damping.graphic.panels[0].y.label == "c [N s/m]"
    adjusted, chi2 = (panel.series[0] for panel in goodness.graphic.panels)
    assert adjusted.y.tolist() == [0.98, 0.89] and chi2.y[0] == 1.1 and np.isnan(chi2.y[1])


def test_loss_factors_and_masses_of_bands_stand_in_figure_and_table() -> None:
    eta, mass = replace(C, name="eta", unit="1", value=0.01), replace(C, name="m", unit="kg", value=0.9)
    bands = [replace(FIT, band_hz=(low, low + 15.0), parameters=(K, eta, mass)) for low in (10.0, 13.0)]
    _, loss, weight, _ = sliding_figures(bands)
    assert loss.graphic.panels[0].y.label == "eta" and loss.graphic.panels[0].series[0].y.tolist() == [
        0.01,
        0.01,
    ]
    assert weight.graphic.panels[0].y.label == "m [kg]" and "mass over frequency" in weight.caption
    (section,) = fit_sections(Identification(tuple(bands)))
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert table.header[3:6] == ("k [kN/m]", "eta", "m [kg]")


def test_a_response_is_shown_with_the_best_statement_of_its_quality() -> None:
    coherent = response_figure(replace(RESPONSE, coherence=np.full(MATRIX.shape, 0.9)))
    amplitude, quality = coherent.graphic.panels
    np.testing.assert_allclose(amplitude.series[0].y, [1.0, 2.0, 4.0])
    assert (
        amplitude.series[0].name == "y/f"
        and (quality.y.low, quality.y.high) == (0.0, 1.02)
        and quality.series[0].y.tolist() == [0.9] * 3
    )
    periodic = response_figure(replace(RESPONSE, snr=np.array([[100.0, 0.0]] * 3), snr_channels=("f", "y")))
    assert (
        named(periodic.graphic.panels[1])["y"].y.tolist() == [1e-3] * 3
        and "signal-to-noise" in periodic.caption
    )
    covered = response_figure(replace(RESPONSE, covariance=diagonal_covariance(np.full(MATRIX.shape, 1e-14))))
    np.testing.assert_allclose(covered.graphic.panels[1].series[0].y, [0.1, 0.05, 0.025])
    plain = response_figure(RESPONSE)
    assert len(plain.graphic.panels) == 1 and "its uncertainty is not known" in plain.caption


def test_slopes_of_a_calibration_stand_by_name_from_zero() -> None:
    lines = [
        replace(
            FIT,
            name="gain",
            test=test,
            model="straight-line",
            parameters=(Parameter("slope", value, "N/A", std_error=0.1, ci95=ends),),
        )
        for test, value, ends in (("up", 2.0, (1.8, 2.2)), ("down", 3.0, None))
    ]
    (panel,) = line_figure(lines).graphic.panels
    (slopes,) = panel.series
    assert (
        [name for _, name in panel.x.ticks] == ["up", "down"]
        and panel.y.label == "slope [N/A]"
        and panel.y.low == 0.0
    )
    assert (
        slopes.y.tolist() == [2.0, 3.0]
        and slopes.low.tolist() == [1.8, 3.0]
        and slopes.high.tolist() == [2.2, 3.0]
    )


def test_units_of_forms() -> None:
    assert form_unit("displacement per current") == ("um/A", pytest.approx(1e6))
    assert form_unit("receptance") == ("um/N", pytest.approx(1e6)) and form_unit("voltage ratio") == (
        "SI",
        1.0,
    )


def test_of_very_many_elements_largest_median_and_least_have_a_curve() -> None:
    """25 elements of 1 to 25 um/N."""
    matrix = np.tile(1e-6 * np.arange(1.0, 26.0).reshape(25, 1), (3, 1, 1)).astype(complex)
    outputs = tuple(Port(f"p{n}", f"p{n}", f"p{n}") for n in range(25))
    amplitude = response_figure(replace(RESPONSE, matrix=matrix, outputs=outputs)).graphic.panels[0]
    curves = {name: series.y[0] for name, series in named(amplitude).items()}
    assert curves == pytest.approx({"largest of 25": 25.0, "median of 25": 13.0, "least of 25": 1.0})


def test_a_mode_shape_turns_where_its_points_move_farthest(drawings: dict[str, Drawing]) -> None:
    """Of all phases of exp(j p) m that with the largest square sum, tried one by one; the structure is 1 in
    size about its middle and the largest motion .15 of that.
    """
    sketch = drawings["mode-shapes"].subject
    assert sketch.titles == ("1: 20 Hz, 1 %", "2: 30 Hz, 2 %")
    np.testing.assert_allclose(np.ptp(sketch.positions, axis=0), 1)
    np.testing.assert_allclose(sketch.positions.max(axis=0), -sketch.positions.min(axis=0))
    # Point 1 by 1 in x and point 3 by half of it in z.
    np.testing.assert_allclose(sketch.motion[0], 0.15 * np.array([[1, 0, 0], [0, 0, 0], [0, 0, 0.5]]))
    np.testing.assert_allclose(np.abs(sketch.motion[1]).max(), 0.15)
    turned = replace(sketch, motion=sketch.motion * np.exp(0.7j) + [[0, 0.02j, 0]])
    there, back = turned.extremes(0)
    np.testing.assert_allclose((there + back) / 2, sketch.positions)
    phases = np.exp(1j * np.linspace(0, np.pi, 1801))[:, None, None]
    sums = np.sum((turned.motion[0] * phases).real ** 2, axis=(1, 2))
    assert np.sum((there - sketch.positions) ** 2) == pytest.approx(sums.max(), rel=1e-5)


def test_views_of_a_structure_are_turned_and_not_stretched() -> None:
    """Right-handed: across, up and towards the eye, which is at azimuth a and elevation e in the direction
    (sin a cos e, -cos a cos e, sin e).
    """
    for _, azimuth, elevation in VIEWS:
        across, up = project(np.eye(3), azimuth, elevation).T
        level = np.cos(elevation)
        eye = [np.sin(azimuth) * level, -np.cos(azimuth) * level, np.sin(elevation)]
        np.testing.assert_allclose(np.cross(across, up), eye, atol=1e-12)
        np.testing.assert_allclose([across @ across, up @ up, across @ up], [1, 1, 0], atol=1e-12)
    front, top = (project(np.array([[1.0, 2.0, 3.0]]), *view[1:])[0] for view in VIEWS[1:])
    assert front == pytest.approx([1, 3]) and top == pytest.approx([1, 2])


@pytest.mark.parametrize("along", [1, 2], ids=["outputs", "inputs"])
def test_elements_of_one_row_or_column_stand_in_rows_of_three(along: int) -> None:
    """Five responses to one force, or one to a hammer at five points: none is a fifth of a page wide."""
    names = tuple("abcde")
    shape = {"outputs": names} if along == 1 else {"inputs": names}
    many = replace(
        CURVE, measured=np.repeat(MATRIX, 5, along), fitted=np.repeat(MATRIX, 5, along), variance=None
    )
    figure = matrix_figure(FIT, replace(many, **shape))
    assert (figure.graphic.rows, figure.graphic.columns) == (2, 3)
    assert "(dots) and fitted" in figure.caption


def test_a_coefficient_that_bands_lack_has_gaps_there() -> None:
    """With `eliminate: true` the first band has dropped c and the second k."""
    bands = (replace(FIT, parameters=(K,)), replace(FIT, parameters=(C,), band_hz=(20.0, 40.0)))
    stiffness, damping = (named(figure.graphic.panels[0]) for figure in sliding_figures(bands)[:2])
    np.testing.assert_array_equal(stiffness["k"].y, [45.2, np.nan])
    np.testing.assert_array_equal(damping["c"].y, [np.nan, 3.7])
    assert stiffness["k"].low is not None and damping["c"].low is not None
    np.testing.assert_array_equal([stiffness["k"].low, damping["c"].low], [[45.137, np.nan], [np.nan, 3.5]])
    (section,) = fit_sections(Identification(bands))
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert [row[3:5] for row in table.rows] == [
        ("45.200 ± 0.031", "eliminated"),
        ("eliminated", "3.70 ± 0.10"),
    ]
