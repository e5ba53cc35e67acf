"""Run-ups in the report: both differences of the source's tables, uncertainty beside every method, figures
with the numbers they show.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.document import render
from labpipe.methods.run_ups.figures import (
    best_method,
    bode_figure,
    cascade_figure,
    coefficient_figure,
    convergence_figure,
    orbit_figure,
    orbit_places,
    polar_figure,
    speeds_figure,
    spread_figure,
    surface_figures,
)
from labpipe.methods.run_ups.records import (
    Cascade,
    Convergence,
    LeftOut,
    MeasuredRun,
    MetamodelResult,
    Motion,
    RankRow,
    RunPrediction,
    RunUpMethod,
    RunUpResult,
    StartSpread,
    Surface,
    UncertainAmount,
)
from labpipe.methods.run_ups.report import (
    both_differences,
    coefficient_table,
    parameter_table,
    rpm_text,
    run_up_sections,
    speed_blocks,
    uncertainty_blocks,
)
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Identification
from labpipe.report.build import build
from labpipe.report.chart import Drawing
from labpipe.report.document import Figure, Paragraph, Table

RPM = np.pi / 30
SPEED = tuple(float(one) for one in np.arange(800.0, 2001.0, 200.0) * RPM)


def motions(scale: float, measured: bool) -> tuple[Motion, ...]:
    """Two planes, two directions.

    Amplitudes 1, 2, 3, 4 um times *scale*, a phase that falls by 30 deg from speed to speed.
    """
    turn = np.exp(-1j * np.radians(30.0) * np.arange(len(SPEED)))
    found = []
    for number, (plane, direction) in enumerate((p, d) for p in ("disc 1", "disc 2") for d in ("x", "y")):
        value = 1e-6 * (number + 1) * scale * turn * (1j if direction == "y" else 1)
        errors = (tuple(0.01 * np.abs(value)), (0.02,) * len(SPEED)) if measured else ((), ())
        found.append(Motion(plane, direction, tuple(value.real), tuple(value.imag), *errors))
    return tuple(found)


def run(name: str, load: float, role: str = "trained") -> MeasuredRun:
    printed = ((1317 / 60, 1450 / 60, 1317 / 60), (2838.37 / 60, 2475 / 60, 2955 / 60))
    return MeasuredRun(
        name,
        load,
        role,
        excitation="disc 1: 50 g mm at 0 deg",
        speed=SPEED,
        motions=motions(1.0, True),
        critical_speed=UncertainAmount(1400 * RPM, 1.0 * RPM),
        threshold=UncertainAmount(2800 * RPM, 5 * RPM),
        printed_critical_speed=printed[0],
        printed_threshold=printed[1],
    )


def told(name: str, factor: float, error: float | None, notes: tuple[str, ...] = ()) -> RunPrediction:
    eight = tuple(tuple(1e5 * factor * (n + 1) / (1 if n < 4 else 100) for n in range(8)) for _ in SPEED)
    errors = tuple(tuple(0.02 * abs(one) for one in row) for row in eight) if error else ()
    speeds = UncertainAmount(1400 * RPM * factor, error), UncertainAmount(2800 * RPM * factor, error)
    return RunPrediction(
        name,
        *speeds,
        speed=SPEED,
        motions=motions(factor, False),
        coefficient_speed=SPEED,
        coefficients=eight,
        std_errors=errors,
        notes=notes,
    )


OUTSIDE = "16.9 N lies outside the loads of the fit (3.66 to 10.3 N)"
RUNS = (run("load-1", 3.66), run("held-out", 16.9, "held-out"))
START = RunUpMethod(
    "start",
    "original (start)",
    "not fitted",
    predictions=tuple(told(one.name, 1.03, None) for one in RUNS),
    unknowns=0,
)
AMPLITUDES = RunUpMethod(
    "amplitudes",
    "(a) amplitudes, pattern search",
    "not determined",
    predictions=(
        told("load-1", 0.99, None),
        RunPrediction("held-out", None, None, notes=("at the fitted loads only",)),
    ),
    rank=2,
    condition=120.0,
    share_at_bound=0.25,
    n_datum=14,
    n_effective=14,
    convergence=(
        Convergence(
            "3.66 N, 1400 rpm",
            (1e-12, 1e-14, 1e-15),
            (0.25, 0.25, 0.125),
            (1.0, 16.0, 16.0),
            True,
            (1.1,) * 8,
        ),
    ),
    spreads=(
        StartSpread("3.66 N, 1400 rpm", tuple((0.7 + 0.03 * n,) * 8 for n in range(20)), (0.001,) * 20),
    ),
)
JOINT = RunUpMethod(
    "joint",
    "(c) joint physical fit",
    "not rejected",
    predictions=(told("load-1", 1.0001, 0.3 * RPM), told("held-out", 0.99, 0.8 * RPM, (OUTSIDE,))),
    unknowns=12,
    rank=11,
    condition=50.0,
    share_at_bound=0.0,
    chi2_per_datum=1.09,
    chi2_p=0.04,
    n_datum=836,
    n_effective=11.0,
    free=("viscosity +1.00, clearance +0.50",),
    parameters=(
        Parameter("viscosity", 0.8, "1", std_error=0.05, t_ratio=None, ci95=(0.7, 0.9)),
        Parameter("clearance", 1.5, "1", at_bound=True),
    ),
)
SURFACE = Surface(
    (3.0, 6.0, 9.0), (50.0, 100.0), tuple(((1e5, 2e5), (1e5, 3e5), (1e5, 4e5)) for _ in range(8))
)
MODEL = MetamodelResult(
    "response-surface",
    "second-order response surface",
    SURFACE,
    (LeftOut(3.66, (0.1,) * 8, True),),
    (told("load-1", 1.0, None), RunPrediction("held-out", None, None, notes=("carried on",))),
    ("104 points.",),
)
RANKS = (
    RankRow("amplitudes at the planes", 2, 100.0, "one number per plane is seen", ("k_xx +1.00",)),
    RankRow(
        "the same, with a second unbalance run",
        4,
        7.0,
        "one vector",
        (),
        "a second unbalance run adds no rank",
    ),
)
RESULT = RunUpResult(
    "Two-disc rotor",
    "disc 2",
    "journal bearing",
    runs=RUNS,
    methods=(START, AMPLITUDES, JOINT),
    metamodels=(MODEL,),
    metamodels_of="(c) joint physical fit",
    ranks=RANKS,
    rank_load=5.0,
    rank_speed=1400 * RPM,
    measured_rank=RankRow("load-1", 4, 7.0, "one vector", ("k_yx +1.00, c_yx -0.90",)),
    source="Falah and Khorshid, tables 2 and 3",
    findings=(Finding("collinear", "(a): the data see 2 of 8 coefficients"),),
)


@pytest.mark.parametrize(
    ("predicted", "measured", "rule"),
    [
        (1450, 1317, 9.17),
        (1510, 1371, 9.21),
        (1570, 1312, 16.43),
        (1650, 1355, 17.88),
        (1700, 1420, 16.47),
        (2475, 2838.37, 12.80),
        (2955, 2838.37, 3.95),
    ],
)
def test_the_sources_rule_gives_its_printed_percentages(
    predicted: float, measured: float, rule: float
) -> None:
    """Falah and Khorshid, tables 2 and 3: 9.150, 9.205, 16.43, 17.86, 16.47, 12.8, 3.95 %.

    They round the first, second and fourth down.
    """
    own = 100 * (predicted - measured) / measured
    assert both_differences(predicted, measured) == f"{own:+.2f} % ({rule:.2f} %)"


def text_of(table: Table) -> list[tuple[str, ...]]:
    return [tuple(cell.replace("\N{NO-BREAK SPACE}", " ") for cell in row) for row in table.rows]


def test_all_methods_stand_beside_the_measurement() -> None:
    blocks = speed_blocks(RESULT)
    critical = next(block for block in blocks if isinstance(block, Table))
    assert critical.header == ("run", "measured", "original", "(a) amplitudes", "(c) joint")
    first, held = text_of(critical)
    assert first == (
        "load-1, 3.66 N",
        "1400.0 ± 1.0 rpm",
        "1442.0: +3.00 % (2.91 %)",
        "1386.0: -1.00 % (1.00 %)",
        "1400.14 ± 0.30: +0.01 % (0.01 %)",
    )
    assert held[3] == "none" and held[4] == "1386.00 ± 0.80*: -1.00 % (1.00 %)"
    printed = [
        block
        for block in blocks
        if isinstance(block, Table) and "for reference, measured on another rig" in block.caption
    ]
    assert [text_of(table)[0][1:] for table in printed] == [
        ("1317", "1450: +10.10 % (9.17 %)", "1317: +0.00 % (0.00 %)"),
        ("2838.37", "2475: -12.80 % (12.80 %)", "2955: +4.11 % (3.95 %)"),
    ]
    # A second run under the same load and one under a shaker: neither has a threshold of its own, the latter
    # no critical speed.
    nothing = RunPrediction("shaken", None, UncertainAmount(2800 * RPM))
    more = (
        replace(RUNS[0], name="again", threshold=None),
        replace(RUNS[0], name="shaken", critical_speed=None, threshold=None),
    )
    methods = (replace(START, predictions=(*START.predictions, told("again", 1.0, None), nothing)),)
    tables = [
        block
        for block in speed_blocks(replace(RESULT, runs=(*RUNS, *more), methods=methods))
        if isinstance(block, Table)
    ]
    assert [row[0].split(",")[0] for row in text_of(tables[0])] == ["load-1", "held-out", "again"]
    assert [row[0].split(",")[0] for row in text_of(tables[2])] == ["load-1", "held-out"]
    bare = replace(
        RESULT,
        runs=tuple(replace(one, printed_critical_speed=(), printed_threshold=()) for one in RUNS),
        metamodels=(),
    )
    assert sum(isinstance(block, Table) for block in speed_blocks(bare)) == 2


def test_a_speed_is_rounded_to_its_error() -> None:
    assert rpm_text(None) == "none" and rpm_text(UncertainAmount(100.0)) == "954.9"
    assert (
        rpm_text(UncertainAmount(4040 * RPM, 101 * RPM)) == "4040 ± 100"
        and rpm_text(UncertainAmount(1516.6 * RPM, 1.04 * RPM)) == "1516.6 ± 1.0"
    )


def test_uncertainty_is_told_for_every_method() -> None:
    blocks = uncertainty_blocks(RESULT)
    table, *_ = (block for block in blocks if isinstance(block, Table))
    assert text_of(table)[0][:5] == ("(a) amplitudes", "not determined", "2 of 8", "120", "25 %")
    assert table.rows[0][5:] == ("14", "14", "no redundant datum")
    assert text_of(table)[1][2] == "11 of 12" and table.rows[1][7] == "1.09 (p = 0.04)"
    words = " ".join(block.text for block in blocks if isinstance(block, Paragraph))
    assert (
        "viscosity +1.00, clearance +0.50" in words
        and "second unbalance run adds no rank" in words
        and "shaker" in words
    )


def test_coefficients_carry_their_deviation_or_their_bound() -> None:
    table = coefficient_table(JOINT, RUNS[0])
    assert table is not None and table.rows[0][:2] == ("800", "100.0 ± 2.0") and len(table.rows) == 7
    bound = told("load-1", 1.0, 0.1)
    bound = replace(bound, std_errors=((float("nan"), *bound.std_errors[0][1:]), *bound.std_errors[1:]))
    at_bound = coefficient_table(replace(JOINT, predictions=(bound,)), RUNS[0])
    assert at_bound is not None and at_bound.rows[0][1] == "100 at bound"
    assert coefficient_table(AMPLITUDES, RUNS[1]) is None


def named(figure: Figure) -> dict[str, object]:
    drawn = figure.graphic
    return {one.name: one for panel in drawn.panels for one in panel.series}


def test_a_value_without_an_interval_is_not_at_its_bound() -> None:
    """A rejected fit states values alone."""
    free, bound = Parameter("clearance", 0.9, "1"), Parameter("viscosity", 4.0, "1", at_bound=True)
    table = parameter_table(replace(JOINT, parameters=(free, bound)))
    assert [row[3:] for row in table.rows] == [("none", "none"), ("none", "at bound")]


def test_bode_shows_measured_points_and_every_method() -> None:
    drawn = bode_figure(RESULT, RUNS[0]).graphic
    assert len(drawn.panels) == 8
    amplitude, phase = drawn.panels[0], drawn.panels[2]
    assert amplitude.y.label == "x amplitude [um]" and phase.y.label == "x phase [deg]"
    series = {one.name: one for one in amplitude.series}
    np.testing.assert_allclose(series["measured"].y, 1.0)
    np.testing.assert_allclose(series["measured"].high - series["measured"].y, 0.0196, rtol=1e-3)
    np.testing.assert_allclose(series["(c) joint physical fit"].y, 1.0001)
    turned = {one.name: one for one in phase.series}
    np.testing.assert_allclose(turned["measured"].y, -30.0 * np.arange(7), atol=1e-9)
    np.testing.assert_allclose(turned["original (start)"].y, -30.0 * np.arange(7), atol=1e-9)


def test_polar_and_orbits_are_those_of_the_phasors() -> None:
    polar = polar_figure(RESULT, best_method(RESULT)).graphic
    assert [panel.title for panel in polar.panels] == ["disc 1, x", "disc 1, y", "disc 2, x", "disc 2, y"]
    assert orbit_places(RUNS[0]) == [1, 3, 4, 6]
    orbits = orbit_figure(RESULT, JOINT).graphic
    assert len(orbits.panels) == 8
    first = {one.name: one for one in orbits.panels[0].series}["disc 1 measured"]
    # x = cos(t - 30 deg), y = 2 cos(t + 60 deg) = -2 sin(t - 30 deg): half axes 1 and 2 um.
    np.testing.assert_allclose(first.x**2 + (first.y / 2) ** 2, 1.0)


def test_speeds_over_load_have_bars_where_there_is_an_error() -> None:
    series = named(speeds_figure(RESULT))
    assert {"measured", "original (start)", "(a) amplitudes", "(c) joint physical fit"} <= set(series)
    threshold = speeds_figure(RESULT).graphic.panels[1]
    joint = next(one for one in threshold.series if one.name == "(c) joint physical fit")
    np.testing.assert_allclose(joint.y, [2800.28, 2772.0])
    np.testing.assert_allclose(joint.high - joint.low, 2 * 1.959964 * np.array([0.3, 0.8]), rtol=1e-6)


def test_coefficients_over_speed_have_bands() -> None:
    drawn = coefficient_figure(RESULT, RUNS[0]).graphic
    assert [panel.y.label for panel in drawn.panels][:3] == ["k_xx [kN/m]", "c_xx [N s/m]", "k_xy [kN/m]"]
    joint = next(one for one in drawn.panels[0].series if one.name == "(c) joint physical fit")
    np.testing.assert_allclose(joint.y, 100.01)
    np.testing.assert_allclose(joint.high - joint.y, 0.0392 * 100.01, rtol=1e-3)


def test_searches_are_shown_with_what_they_do_not_say() -> None:
    (search,), (spread,) = AMPLITUDES.convergence, AMPLITUDES.spreads
    figure = convergence_figure(AMPLITUDES, search)
    assert "33 evaluations, ended by the limit on evaluations" in figure.caption
    assert (
        figure.graphic.panels[0].series[0].y == pytest.approx([1.0, 0.01, 0.001])
        and figure.graphic.panels[0].y.logarithmic
    )
    drawn = spread_figure(AMPLITUDES, spread)
    assert "the coefficients are not determined" in drawn.caption and "0.57 (median)" in drawn.caption
    alike = replace(spread, factors=((1.0,) * 8,) * 20)
    assert "agree within 0.00" in spread_figure(AMPLITUDES, alike).caption


def test_surfaces_stand_as_drawings_with_a_text() -> None:
    stiffness, damping = surface_figures(MODEL)
    assert isinstance(stiffness.graphic, Drawing) and stiffness.graphic.subject.titles[1] == "k_xy [kN/m]"
    np.testing.assert_allclose(stiffness.graphic.subject.values[0], [[100, 200], [100, 300], [100, 400]])
    assert (
        "stiffness" in stiffness.caption
        and "3.66 to 3.66 N extrapolated" in damping.caption
        and "damping" in damping.alternative
    )


def test_a_cascade_raises_every_spectrum_by_its_speed() -> None:
    cascade = Cascade(
        "disc 1.x",
        (10.0, 20.0, 30.0),
        (0.0, 10.0, 20.0, 30.0),
        ((0, 2e-6, 0, 0), (0, 0, 4e-6, 0), (0, 0, 0, 1e-6)),
    )
    figure = cascade_figure(RUNS[0], cascade)
    drawn = figure.graphic
    spectra = [one for one in drawn.panels[0].series if one.x.size == 4]
    assert len(spectra) == 3 and "4 um" in figure.caption
    # The largest line stands three steps of speed high: 600 rpm each.
    assert spectra[1].y.max() == pytest.approx(1200 + 1800) and spectra[0].y.max() == pytest.approx(600 + 900)
    still = cascade_figure(RUNS[0], replace(cascade, amplitude=((0.0,) * 4,) * 3)).graphic
    assert {float(one.y.max()) for one in still.panels[0].series if one.x.size == 4} == {
        600.0,
        1200.0,
        1800.0,
    }


def test_the_best_method_follows_chi_square() -> None:
    process = replace(JOINT, name="process", title="(d)")
    both = replace(RESULT, methods=(START, JOINT, process))
    chosen = best_method(both)
    assert chosen is not None and chosen.name == "joint"
    rejected = replace(both, methods=(START, replace(JOINT, verdict="rejected"), process))
    chosen = best_method(rejected)
    assert chosen is not None and chosen.name == "process"
    assert best_method(replace(RESULT, methods=(START,))) is None


@pytest.mark.long
def test_the_whole_report_reads_and_warns() -> None:
    settings = {"run_ups": {"rotor": "falah.yaml"}}
    identification = Identification(
        (), "Run-ups", version="0.1.0", sections={"run_ups": RESULT}, settings=settings
    )
    document = build(identification)
    headings = [section.heading for section in document.sections]
    assert headings[:4] == ["Verdict", "Warnings", "Run-ups: Two-disc rotor", "Critical speed and threshold"]
    assert ("rig", "Two-disc rotor") in document.cover
    cautions = [
        block
        for block in document.sections[3].blocks
        if isinstance(block, Paragraph) and block.kind == "warning"
    ]
    assert len(cautions) == 1 and OUTSIDE in cautions[0].text
    text = render.markdown_report(identification).decode()
    assert "collinear: run-ups" in text and "no rig file was named" not in text and "falah.yaml" in text
    page = render.html_report(identification).decode()
    assert page.count("<figure") == sum(
        isinstance(block, Figure)
        for section in run_up_sections(RESULT, Identification(()))
        for block in section.blocks
    )
