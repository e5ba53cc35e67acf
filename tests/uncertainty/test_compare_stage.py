"""Comparisons in a pipeline: read with every fault at its place, judged by rules, written, read again,
reported, shown.
"""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from labpipe.artefacts.identification_file import read_identification
from labpipe.cli.main import run_command
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.methods.rolling_bearing.ratio import theory_of
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.schema import pipeline_schema
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.report.build import build
from labpipe.report.comparison import comparison_blocks
from labpipe.report.document import Figure, Table
from labpipe.uncertainty.settings import TheorySettings

ROOT = Path(__file__).parents[2]
BEARING = ROOT / "configs/bearings/nsk-6208.yaml"
PRELOADS = (427.0, 701.0, 1422.0)


def axial_response(stiffness: float, rng) -> FrequencyResponse:
    """Accelerance of 2.45 kg on the stiffness with c = 20 us k, 300-900 Hz, noise 0.2 %."""
    frequency = np.arange(300.0, 900.0, 4.0)
    w = 2 * np.pi * frequency
    h = -(w**2) / (stiffness * (1 + 20e-6j * w) - 2.45 * w**2)
    noise = 0.002 * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) / np.sqrt(2)
    variance = np.full((w.size, 1, 1), 0.002**2)
    ports = (Port("z", "z", "z"),), (Port("z", "z", "z"),)
    return FrequencyResponse(
        frequency,
        (h + noise)[:, None, None],
        *ports,
        form="accelerance",
        covariance=diagonal_covariance(variance),
    )


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The series, for a test of its own."""
    return written_series(tmp_path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The series run once with its report: the folder, not to be written to, and what was printed."""
    folder = written_series(tmp_path_factory.mktemp("series"))
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert run_command(["run", str(folder / "pipeline.yaml"), "-o", str(folder / "out")]) == 0
    return folder, printed.getvalue()


def written_series(tmp_path: Path) -> Path:
    """A pipeline over FRF tables made of the bearing file's own K_zz times 1.1, at three preloads, up and
    down.

    The preloads are exact; a stated setting error makes the interval wider than needed
    (test_campaign_coverage.py draws the coverage).
    """
    theory = theory_of(tmp_path, TheorySettings(str(BEARING)))
    rng = np.random.default_rng(20240917)
    tests = []
    for way in ("up", "down"):
        for preload in PRELOADS:
            name = f"{preload:g}-{way}"
            write_frf_csv(
                tmp_path / f"{name}.csv", axial_response(1.1 * theory([(preload, "N")]).stiffness[2, 2], rng)
            )
            tests.append(
                {"name": name, "frfs": f"{name}.csv", "conditions": {"preload": f"{preload:g} N", "way": way}}
            )
    fit = {"model": "sdof", "input": "z", "output": "z", "band": "300-900 Hz"}
    series = {"fit": "axial", "over": "preload"}
    plan = {
        "title": "Axial series",
        "tests": tests,
        "identify": {"axial": fit},
        "compare": {
            "ratio": {
                "kind": "ratio",
                **series,
                "setting_error": "0.1 %",
                "theory": {"bearing": str(BEARING)},
            },
            "damping": {"kind": "rayleigh", **series},
            "trend": {"kind": "trend", "law": "power", **series},
            "ways": {"kind": "difference", **series, "group": "way", "groups": ["up", "down"]},
            "repeats": {"kind": "repeatability", "fit": "axial", "group": "preload"},
        },
        "expect": {
            "ratio.ratio.covers": 1.1,
            "ratio.ratio": ["1.1 +- 1 %", ">= 1.09"],
            "ratio.verdict": "stiffer than theory",
            "ratio.count": 6,
            "damping.beta": "20 us +- 2 %",
            "damping.verdict": "proportional",
            "ways.difference.std_error": "<= 0.5 %",
            "ways.p_value": ">= 0.001",
            "repeats.between.covers": "15 MN/m",
        },
    }
    (tmp_path / "pipeline.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
    return tmp_path


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


def ruled(project: Path, address: str, bound) -> Path:
    """The pipeline with one comparison and a rule on it."""
    name = address.partition(".")[0]
    return edited(
        project, lambda plan: plan.update(compare={name: plan["compare"][name]}, expect={address: bound})
    )


def edited(project: Path, change) -> Path:
    plan = yaml.safe_load((project / "pipeline.yaml").read_text())
    change(plan)
    (project / "pipeline.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
    return project / "pipeline.yaml"


def test_a_pipeline_of_comparisons_runs_is_judged_and_read_again(finished, labpipe) -> None:
    project, printed = finished
    assert "ratio: k, fit axial: measured / theory 1.09" in printed
    assert "expect: ratio.ratio.covers 1.1: passed" in printed
    found = read_identification(project / "out/identification.json")
    assert [comparison.name for comparison in found.sections["compare"]] == [
        "ratio",
        "damping",
        "trend",
        "ways",
        "repeats",
    ]
    entry = json.loads((project / "out/identification.json").read_text())
    assert entry["comparisons"][0]["amounts"][0]["name"] == "ratio"
    assert entry["settings"]["compare"][0]["kind"] == "ratio"
    assert any(source["path"].endswith("nsk-6208.yaml") for source in entry["sources"])
    assert len(found.sections["compare"][0].overlays) == 2
    # What is up to date is not computed again, and what is read again is written the same.
    before = (project / "out/identification.json").read_bytes()
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "out").code == 0
    assert (project / "out/identification.json").read_bytes() == before


@pytest.mark.long
def test_another_bearing_file_makes_the_result_stale(project, labpipe) -> None:
    own = project / "bearing.yaml"
    own.write_text(BEARING.read_text())
    path = edited(project, lambda plan: plan["compare"]["ratio"]["theory"].update(bearing="bearing.yaml"))
    assert labpipe("run", path, "-o", project / "out").code == 0
    own.write_text(BEARING.read_text().replace("1.10e10", "1.00e10"))
    ended = labpipe("run", path, "-o", project / "out")
    assert ended.code == 1
    assert "ratio.ratio.covers 1.1: FAILED" in ended.out


def test_the_report_says_it_in_words_numbers_and_pictures(finished) -> None:
    project, _ = finished
    found = read_identification(project / "out/identification.json")
    headings = [section.heading for section in build(found).sections]
    compared = [
        heading.removeprefix("Comparison: ") for heading in headings if heading.startswith("Comparison: ")
    ]
    assert compared == ["ratio", "damping", "trend", "ways", "repeats"]
    # What the tests say together comes before the single fits.
    assert headings.index("Comparison: repeats") < min(
        n for n, heading in enumerate(headings) if heading.startswith("Result: ")
    )
    for comparison in found.sections["compare"]:
        blocks = comparison_blocks(comparison, found.responses)
        assert comparison.statement in [getattr(block, "text", "") for block in blocks]
        tables = [block for block in blocks if isinstance(block, Table)]
        assert len(tables[-1].rows) == len(comparison.points) == 6
        assert all(len(row) == len(table.header) for table in tables for row in table.rows)
        drawn = [block for block in blocks if isinstance(block, Figure)]
        assert len(drawn) == (2 if comparison.kind == "ratio" else 1)
        assert all(comparison.name in figure.caption for figure in drawn)
    html = (project / "out/report.html").read_text()
    assert "measured / theory 1.09" in html
    assert "One-way random effects" in html


def test_reciprocity_is_drawn_pair_by_pair(labpipe, tmp_path) -> None:
    assert labpipe("run", ROOT / "pipelines/reciprocity.yaml", "-o", tmp_path, "-q").code == 0
    found = read_identification(tmp_path / "identification.json")
    (comparison,) = found.sections["compare"]
    drawn = [block for block in comparison_blocks(comparison, found.responses) if isinstance(block, Figure)]
    assert len(drawn) == 3
    assert "x/by and by/x" in drawn[0].caption
    groups = {point.group for point in comparison.points if point.value < 0.7}
    assert groups == {"x-by"}  # the bearing couples x with the tilt about y and nothing with z


FAULTS = [
    (
        lambda plan: plan["compare"].update(axial={"kind": "reciprocity"}),
        "compare.axial: a fit or calibration has this name already",
    ),
    (
        lambda plan: plan["compare"]["trend"].update(fit="axail"),
        "compare.trend.fit: there is no fit 'axail'; did you mean 'axial'?",
    ),
    (
        lambda plan: plan["compare"]["ratio"]["theory"].update(bearing="no.yaml"),
        "compare.ratio.theory.bearing: no such file 'no.yaml'",
    ),
    (
        lambda plan: plan["compare"]["trend"].update(kind="tend"),
        "compare.trend.kind: unknown choice 'tend'; did you mean 'trend'?",
    ),
    (lambda plan: plan["compare"]["trend"].pop("over"), "compare.trend: 'over' is missing"),
    (
        lambda plan: plan["compare"]["ratio"].update(setting_error="1 N"),
        "compare.ratio.setting_error: 'N' has the wrong dimension",
    ),
    (lambda plan: plan["expect"].update({"rato.ratio": 1}), "expect.rato.ratio: there is no fit 'rato'"),
]


@pytest.mark.parametrize(("change", "what"), FAULTS)
def test_faults_are_named_at_their_place(project, change, what: str) -> None:
    path = edited(project, change)
    with pytest.raises(ConfigErrors) as caught:
        load_pipeline(path)
    lines = [line for line in str(caught.value).splitlines() if what in line]
    assert len(lines) == 1, str(caught.value)
    assert lines[0].startswith(f"{path}:")


RULES = [
    ("damping.bta", 1, "the comparison has no 'bta'; did you mean 'beta'?"),
    ("damping.beta.covers", "1 N", "'N' has the wrong dimension"),
    ("damping.beta", ">= 1 kg", "'kg' has the wrong dimension"),
]


@pytest.mark.parametrize(("address", "bound", "what"), RULES)
def test_rules_that_do_not_fit_the_comparison_are_named(
    project, labpipe, address: str, bound, what: str
) -> None:
    ended = labpipe("run", ruled(project, address, bound), "-o", project / "out")
    assert ended.code == 2
    assert f"expect.{address}" in ended.err
    assert what in ended.err


def test_a_rule_on_an_interval_that_is_not_there_fails(project, labpipe) -> None:
    ended = labpipe("run", ruled(project, "ways.p_value.covers", 0.5), "-o", project / "out")
    assert ended.code == 1
    assert "found no interval" in ended.out


def test_a_recording_under_two_tests_counts_once(project: Path, labpipe) -> None:
    """Before, six tests of one recording had a sixth of its variance, and no trend for sure."""
    (project / "701-up.csv").write_bytes((project / "427-up.csv").read_bytes())
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    what = "the tests '427-up' and '701-up' are of the same recordings; a recording counts once; leave one"
    assert ended.code == 2 and f"compare.ratio: {what}" in ended.err
    assert not (project / "out/identification.json").exists()


def test_a_comparison_that_cannot_be_made_is_named(project, labpipe) -> None:
    path = edited(project, lambda plan: plan["tests"][0]["conditions"].pop("preload"))
    ended = labpipe("run", path, "-o", project / "out")
    assert ended.code == 2
    assert "compare.ratio: test '427-up' has no condition 'preload'" in ended.err
    # Each test is whole by itself and kept; what needed all of them is not there.
    assert not (project / "out/identification.json").exists()


def test_the_theory_is_the_bearing_file_at_the_condition() -> None:
    """NSK 6208 at 427 N and 1721 N, printed K_zz .1654e8 and .4616e8 (Knaapen 1997, appendix A), to half a
    printed digit.
    """
    theory = theory_of(BEARING.parent, TheorySettings(BEARING.name))
    for preload, printed in ((427.0, 0.1654e8), (1721.0, 0.4616e8)):
        at = theory([(preload, "N")])
        assert at.stiffness[2, 2] == pytest.approx(printed, abs=5e3)
        slope = np.log(at.near[2, 2] / at.stiffness[2, 2]) / np.log1p(at.step)
        assert 0.5 < slope < 0.9
    assert theory([(427.0, "N")]).shaft.mass == 2.45


def test_the_theory_knows_the_uncertain_numbers_of_its_bearing_file(tmp_path: Path) -> None:
    """K and shaft with each number one standard uncertainty off are those of a file that states it so; the
    load that the condition sets is none of them.
    """
    plain, uncertain = tmp_path / "plain.yaml", tmp_path / "uncertain.yaml"
    text = BEARING.read_text("utf-8").replace("z: 427 N", "z: 427 N +- 5 %")
    text = text.replace("1.10e10", "1.10e10 N/m^1.5 +- 2 % (source=Hertz)")
    uncertain.write_text(text.replace("2.45 kg", "2.45 kg +- 0.05 kg"))
    plain.write_text(BEARING.read_text("utf-8").replace("1.10e10", "1.122e10").replace("2.45 kg", "2.5 kg"))
    other = theory_of(tmp_path, TheorySettings(plain.name))([(1000.0, "N")])
    stated = theory_of(tmp_path, TheorySettings(uncertain.name))([(1000.0, "N")]).ends
    (mass, (_, heavier), (_, lighter)), (hertz, (high, _), _) = stated
    assert (hertz, mass) == ("Hertz", "shaft.mass")
    np.testing.assert_allclose(high, other.stiffness, rtol=1e-9, atol=1e-3)
    assert (heavier.mass, lighter.mass) == (other.shaft.mass, pytest.approx(2.4))


def test_a_bearing_file_without_a_shaft_is_no_theory(tmp_path: Path) -> None:
    text = "\n".join(line for line in BEARING.read_text().splitlines() if not line.startswith("shaft"))
    (tmp_path / "bare.yaml").write_text(text)
    theory = theory_of(tmp_path, TheorySettings("bare.yaml"))
    with pytest.raises(ConfigError, match="has no shaft on a bearing of five dofs"):
        theory([(427.0, "N")])
    with pytest.raises(ConfigError, match="wrong dimension"):
        theory([(427.0, "m")])


def test_the_schema_knows_comparisons() -> None:
    properties = pipeline_schema()["properties"]["compare"]["additionalProperties"]["properties"]
    kinds = {
        "trend",
        "difference",
        "quotient",
        "repeatability",
        "ratio",
        "rayleigh",
        "reciprocity",
        "prediction",
        "bands",
        "sensitivity",
        "certificate",
    }
    assert set(properties["kind"]["enum"]) == kinds
    assert "bearing" in properties["theory"]["properties"]


def test_a_string_s_force_goes_as_its_frequency_squared(labpipe, tmp_path: Path) -> None:
    """P = a f^2 exactly: the slope is a, in N/Hz^2; the same points give no straight line over f."""
    frequency = np.linspace(100, 400, 9)
    rows = "\n".join(f"{f!r},{0.009189 * f**2!r}" for f in frequency.tolist())
    (tmp_path / "string.csv").write_text(f"frequency [Hz],force [N]\n{rows}\n")
    entry = {"table": "string.csv", "x": "frequency [Hz]", "y": "force [N]", "through_origin": True}
    plan = {
        "calibrate": {"string": {**entry, "x_power": 2}},
        "expect": {"string.slope": "0.009189 N/Hz^2 +- 1e-9 N/Hz^2"},
    }
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(plan))
    assert labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out").code == 0
    plan["calibrate"]["string"]["x_power"] = 0
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(plan))
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2
    assert "p.yaml:6:5: calibrate.string.x_power: x_power must be positive" in ended.err


def test_points_keep_their_parts_through_the_file(finished) -> None:
    project, _ = finished
    found = read_identification(project / "out/identification.json")
    again = replace(found.sections["compare"][0], line=((1.0, 2.0),))
    assert again.points[0].ratio_ci95 == found.sections["compare"][0].points[0].ratio_ci95
    assert isinstance(again.points[0].ci95, tuple)
    point = found.sections["compare"][0].points[0]
    assert point.ratio == pytest.approx(point.value / point.theory, rel=1e-6)


def test_a_theory_at_two_conditions_sets_two_entries(tmp_path: Path) -> None:
    """A load in x beside that in z: without it K is that of one condition, with it another.

    An entry that there is not is named.
    """
    text = BEARING.read_text("utf-8")
    (tmp_path / "b.yaml").write_text(text)
    both = theory_of(tmp_path, TheorySettings("b.yaml", entry=("loads.z", "temperature_rise")))
    with pytest.raises(ConfigError, match="unknown key"):
        both([(427.0, "N"), (20.0, "K")])
    moment = theory_of(tmp_path, TheorySettings("b.yaml", entry=("loads.z", "loads.x")))
    plain = theory_of(tmp_path, TheorySettings("b.yaml"))
    loaded = moment([(427.0, "N"), (20.0, "N")]).stiffness
    assert not np.allclose(loaded, plain([(427.0, "N")]).stiffness)
    np.testing.assert_allclose(
        moment([(427.0, "N"), (0.0, "N")]).stiffness, plain([(427.0, "N")]).stiffness, rtol=1e-9
    )
