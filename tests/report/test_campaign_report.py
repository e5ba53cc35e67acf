"""A campaign of made-up results: trends, control chart and differences say what was put in.

Figures come as files, all or none.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.cli.report import report
from labpipe.document.charts import figure_files
from labpipe.document.render import DOCUMENTS
from labpipe.errors import DataError
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness, Identification
from labpipe.report.campaign import campaign_document, coefficient_series, sliding_overlays
from labpipe.report.document import Figure, Paragraph, Table


def one_result(
    k: float, preload: str, day: str, band: tuple[float, float] = (1.0, 9.0), **others: str
) -> Identification:
    parameter = Parameter(
        "k", k, "N/m", std_error=50.0, t_ratio=k / 50, ci95=(k - 98.0, k + 98.0), significant=True
    )
    gof = Goodness(0.99, 0.99)
    fit = Fit(
        "direct",
        "sdof",
        "ml",
        band_hz=band,
        lines=9,
        equations=18,
        dof=16,
        gof=gof,
        parameters=(parameter,),
        condition_number=1.0,
        correlation=np.ones((1, 1)),
        test="run",
    )
    settings = {"tests": [{"name": "run", "conditions": {"preload": preload, "date": day, **others}}]}
    return Identification(
        (fit,),
        "Campaign",
        pipeline="p.yaml",
        sources=({"path": "a.csv", "sha256": f"{day} {k:g}"},),
        settings=settings,
        version="0.1.0",
    )


def campaign(values: list[float], preloads: list[int] | None = None) -> list[tuple[str, Identification]]:
    preloads = preloads or [400] * len(values)
    days = [f"2026-03-{n + 1:02d}" for n in range(len(values))]
    rows = zip(values, preloads, days, strict=True)
    return [(f"r{n}", one_result(k, f"{preload} N", day)) for n, (k, preload, day) in enumerate(rows)]


def told(results: list[tuple[str, Identification]]) -> str:
    document = campaign_document(results)
    return " ".join(
        block.text
        for section in document.sections
        for block in section.blocks
        if isinstance(block, Paragraph)
    )


def test_bands_of_several_results_are_laid_over_each_other() -> None:
    """Bands of 2 to 4 and 4 to 8 Hz, at their middles; a result with one band has no course."""
    results = []
    for number in range(3):
        ends = ((2.0, 4.0), (4.0, 8.0)) if number < 2 else ((2.0, 4.0),)
        bands = [one_result(1000.0 * (number + 1), "400 N", "2026-03-01", band) for band in ends]
        results.append((f"r{number}", replace(bands[0], fits=tuple(one.fits[0] for one in bands))))
    (figure,) = sliding_overlays(results)
    (panel,) = figure.graphic.panels
    assert [(series.name, series.x.tolist()) for series in panel.series] == [
        ("r0, run", [3.0, 6.0]),
        ("r1, run", [3.0, 6.0]),
    ]
    scale = {"N/m": 1.0, "kN/m": 1e-3}[panel.y.unit]
    np.testing.assert_allclose(panel.series[1].y, 2000 * scale)
    np.testing.assert_allclose(panel.series[1].low, (2000 - 98) * scale)
    np.testing.assert_allclose(panel.series[1].high, (2000 + 98) * scale)
    assert figure.caption == "direct: k over frequency of 2 tests, shaded: 95 % intervals."


def test_fits_of_several_bands_under_one_name_are_said() -> None:
    (name, first), other = campaign([1000.0, 2000.0])
    narrow = (name, replace(first, fits=(replace(first.fits[0], band_hz=(2.0, 4.5)),)))
    assert "several bands have this name: 2-4.5 Hz, 1-9 Hz." in told([narrow, other])
    assert "several bands" not in told([(name, first), other])


def test_a_series_of_which_one_has_no_date_stays_in_its_order() -> None:
    one, other = campaign([1000.0, 2000.0])[::-1]
    undated = ("r9", one_result(3000.0, "400 N", "in March"))
    (series,) = coefficient_series([one, undated, other])
    assert [value.parameter.value for value in series.tests] == [2000.0, 3000.0, 1000.0]


def test_tests_of_one_day_stand_in_the_order_of_their_hours_and_limits_have_their_digits() -> None:
    """By the hour 2, 1, 0 N/m above 10 kN/m: mean moving range 1 N/m, limits 2.394 / 1.128 = 2.12 N/m off,
    beyond which normal tables give 5 % / 3.
    """
    hours = {10000.0: "2026-03-01 15:00", 10002.0: "2026-03-01 09:00", 10001.0: "2026-03-01 12:00"}
    results = [(f"r{k:.0f}", one_result(k, "400 N", when)) for k, when in hours.items()]
    (one,) = coefficient_series(results)
    assert one.values.tolist() == [10.002, 10.001, 10.0] and "date" not in one.over()
    assert "centre 10.00100, limits 9.99888 to 10.00312 kN/m" in told(results)


def test_a_result_copied_to_another_folder_counts_once() -> None:
    results = campaign([1000.0, 2000.0, 4000.0], [400, 500, 700])
    copied = [*results, ("copy", results[1][1])]
    assert [len(of.values) for of in coefficient_series(copied)] == [3]
    left_out = "A recording counts once; left out, since others are of the same: copy, run."
    assert left_out in told(copied) and "counts once" not in told(results)
    with pytest.raises(DataError, match="the results are of the same recordings"):
        campaign_document([results[0], ("copy", results[0][1])])


def test_a_series_is_sorted_by_date_and_knows_its_conditions() -> None:
    (one,) = coefficient_series(list(reversed(campaign([1000.0, 2000.0, 3000.0], [400, 500, 600]))))
    assert [value.label for value in one.tests] == ["r0, run", "r1, run", "r2, run"]
    assert one.over()["preload"][1].tolist() == [400.0, 500.0, 600.0]
    assert one.over()["date"][1].tolist() == [0.0, 1.0, 2.0]


def test_a_steady_rig_is_in_control_and_a_jump_is_named() -> None:
    steady = [10000.0, 10040.0, 9970.0, 10010.0, 10030.0, 9990.0]
    assert "In control" in told(campaign(steady)) and "Trends beyond chance, of 1 looked at: none" in told(
        campaign(steady)
    )
    jumped = told(campaign([*steady, 10600.0]))
    assert (
        "OUT OF CONTROL: 1 of 1 charts" in jumped
        and "outside: r6, run" in jumped
        and "1 of 7 values differ" in jumped
    )


def test_a_stiffness_that_rises_with_preload_is_a_trend_with_its_slope() -> None:
    document = campaign_document(campaign([10000.0, 12000.0, 14000.0, 16000.0], [400, 300, 500, 600]))
    tables = [block for section in document.sections for block in section.blocks if isinstance(block, Table)]
    (trends,) = [table for table in tables if "trends" in table.caption]
    assert {row[1]: row[7] for row in trends.rows}["date"] == "yes"
    day = next(row for row in trends.rows if row[1] == "date")
    # 2000 N/m a day, in kN/m.
    assert float(day[2]) == pytest.approx(2.0, abs=1e-3) and day[3] == "kN/m per d"


def test_two_results_are_one_test_of_their_difference() -> None:
    # 200 N/m apart, z = 200 / (50 sqrt 2) = 2.83: p = 0.0047 uncorrected, for there is one test.
    document = campaign_document(campaign([10000.0, 10200.0]))
    values = [block for section in document.sections for block in section.blocks if isinstance(block, Table)]
    (table,) = [table for table in values if "Values of" in table.caption]
    assert [row[-1] for row in table.rows] == ["0.0047 *", "0.0047 *"]


def test_results_that_share_nothing_are_refused() -> None:
    with pytest.raises(DataError, match="share no coefficient"):
        campaign_document(campaign([1000.0]))


def test_every_format_is_written_from_the_same_document() -> None:
    document = campaign_document(campaign([10000.0, 10040.0, 9970.0]))
    html, markdown, pdf = (DOCUMENTS.load(name)(document) for name in ("html", "md", "pdf"))
    assert (
        b"mean moving range / 1.128" in html
        and b"mean moving range / 1.128" in markdown
        and pdf.startswith(b"%PDF-")
    )


def test_the_numbers_of_every_figure_come_as_csv() -> None:
    document = campaign_document(campaign([10000.0, 10040.0, 9970.0]))
    files = figure_files(document)
    figures = [
        block for section in document.sections for block in section.blocks if isinstance(block, Figure)
    ]
    assert sorted(Path(name).suffix for name in files) == sorted([".svg", ".png", ".csv"] * len(figures))
    text = files[next(name for name in files if name.endswith(".csv"))].decode()
    assert text.startswith("# k of direct over date")
    rows = [row for row in csv.DictReader(io.StringIO(text.partition("\n")[2])) if row["series"] == "tests"]
    assert [(float(row["x"]), float(row["y"])) for row in rows] == [(0.0, 10.0), (1.0, 10.04), (2.0, 9.97)]
    assert [float(row["low"]) for row in rows] == pytest.approx([9.902, 9.942, 9.872]) and rows[0][
        "y axis"
    ] == "k [kN/m]"
    assert files == figure_files(document)


def test_a_unit_that_nobody_knows_is_refused_with_its_file(tmp_path: Path) -> None:
    ((_, result),) = campaign([10000.0])
    path = tmp_path / "identification.json"
    write_identification(path, result)
    edited = json.loads(path.read_text("utf-8").replace('"unit": "N/m"', '"unit": "N/mn"'))
    del edited["digest"]
    path.write_text(json.dumps(edited), "utf-8")
    with pytest.raises(DataError, match=r"or edited \(UnitError: unknown unit 'mn'\)") as caught:
        read_identification(path)
    assert caught.value.where == str(path)


def test_figures_hold_the_tests_the_trend_and_the_limits() -> None:
    document = campaign_document(campaign([10000.0, 10040.0, 9970.0, 10600.0]))
    figures = [
        block for section in document.sections for block in section.blocks if isinstance(block, Figure)
    ]
    trend, chart = (figure.graphic for figure in figures)
    assert [one.name for one in trend.panels[0].series] == ["trend", "tests"]
    assert [one.interval for one in trend.panels[0].series] == ["shaded", "bar"]
    assert [one.kind for one in chart.panels[0].series].count("hline") == 3 and chart.panels[0].x.ticks[
        0
    ] == (1.0, "2026-03-01")


def test_the_command_reads_a_folder_of_results_and_writes_all_or_nothing(tmp_path: Path) -> None:
    for name, result in campaign([10000.0, 10040.0, 9970.0]):
        (tmp_path / "results" / name).mkdir(parents=True)
        write_identification(tmp_path / "results" / name / "identification.json", result)
    page, figures = tmp_path / "c.html", tmp_path / "figures"
    done = CliRunner().invoke(
        report,
        [str(tmp_path / "results"), "-o", str(page), "--figures", str(figures)],
        catch_exceptions=False,
    )
    assert done.exit_code == 0 and page.exists() and len(list(figures.iterdir())) == 6
    # Of an earlier report, which had one figure more; and a drawing of somebody else.
    for path in list(figures.glob("figure-02-*")):
        path.rename(figures / path.name.replace("figure-02", "figure-09"))
    (figures / "figure-08-mine.svg").write_text("<svg/>")
    CliRunner().invoke(
        report,
        [str(tmp_path / "results"), "-o", str(page), "--figures", str(figures)],
        catch_exceptions=False,
    )
    assert len(list(figures.iterdir())) == 7 and not list(figures.glob("figure-09*"))
    (tmp_path / "file").write_text("")
    refused = CliRunner().invoke(
        report,
        [str(tmp_path / "results"), "-o", str(tmp_path / "d.html"), "--figures", str(tmp_path / "file")],
    )
    assert isinstance(refused.exception, DataError) and not (tmp_path / "d.html").exists()


def test_a_bent_coefficient_is_curved_in_verdict_table_and_figure() -> None:
    """1 % above the middle at either end, known to 5e-5: a parabola is drawn, least in the middle."""
    preloads = [100, 200, 300, 400, 500, 600, 700]
    values = [1e6 * (1 + 0.01 * ((p - 400) / 300) ** 2) for p in preloads]
    bent = campaign(values, preloads)
    assert "k of direct over preload: curved, in the middle 1 % below the chord" in told(bent)
    document = campaign_document(bent)
    blocks = [block for section in document.sections for block in section.blocks]
    (trends,) = [block for block in blocks if isinstance(block, Table) and "trends" in block.caption]
    assert {row[1]: row[-1] for row in trends.rows}["preload"] == "curved"
    (figure,) = [b for b in blocks if isinstance(b, Figure) and "over preload" in b.caption]
    line = next(of for of in figure.graphic.panels[0].series if of.name == "trend")
    assert "parabola" in figure.caption
    assert line.x[int(np.argmin(line.y))] == pytest.approx(400, abs=10)


def two_conditions(off: float = 0.0) -> list[tuple[str, Identification]]:
    """k = 10000 + 20 (preload - 450) - 40 (oil - 40) N/m with errors of 50 N/m, of four preloads and two oils
    by turns in their order; one value is off.
    """
    rng, results = np.random.default_rng(1), []
    for n, preload in enumerate(3 * [300, 400, 500, 600]):
        for oil in (30, 50):
            k = 1e4 + 20 * (preload - 450) - 40 * (oil - 40) + 50 * rng.standard_normal()
            k += off * (n == 6 and oil == 50)
            results.append((f"r{n}-{oil}", one_result(k, f"{preload} N", "none", oil=f"{oil} degC")))
    return results


def test_conditions_are_told_apart_and_what_they_do_is_not_out_of_control() -> None:
    """Slopes in closed form, +20 N/m/N and -40 N/m/K: each at the other held. Values that follow them are in
    control, and one that is six errors off what they say is named.
    """
    sound = told(two_conditions())
    assert "In control" in sound and "0 of 24 values differ" in sound
    assert "k of direct over preload; k of direct over oil" in sound
    assert "of one condition, less its trend over preload and oil" in sound
    blocks = [b for section in campaign_document(two_conditions()).sections for b in section.blocks]
    (trends,) = [b for b in blocks if isinstance(b, Table) and "trends" in b.caption]
    for row, expected in zip(trends.rows, (0.02, -0.04), strict=True):
        low, high = (float(end) for end in row[4].replace("−", "-").split(" to "))
        assert low < expected < high and high - low < 0.01 and row[7] == "yes"
    drawn = [b for b in blocks if isinstance(b, Figure) and "trend at the mean" in b.caption]
    assert len(drawn) == 2
    bad = told(two_conditions(off=350.0))
    assert "OUT OF CONTROL" in bad and "outside: r6-50, run" in bad and "1 of 24 values differ" in bad


def test_conditions_that_moved_together_are_not_told_apart() -> None:
    """Preload and oil in one proportion: each alone, with a slope beyond chance, and one taken off."""
    values = [1e4 + 20 * n for n in range(12)]
    results = [
        (f"r{n}", one_result(k, f"{400 + 10 * n} N", "none", oil=f"{30 + n} degC"))
        for n, k in enumerate(values)
    ]
    text = told(results)
    assert "Trends beyond chance, of 2 looked at: k of direct over preload; k of direct over oil" in text
    assert "In control" in text and "less its trend over preload." in text
