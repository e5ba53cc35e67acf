"""What stands first in a report: the verdict, every warning in full, notes up to a number.

And the parts that a report is made of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.records.finding import NOTE, WARNING, Finding, Parameter
from labpipe.records.identification import Failed, Fit, Goodness, Identification, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port
from labpipe.report.build import MOST_NOTES, PARTS, build, provenance_sections, verdict_sections
from labpipe.report.cover import result_blocks
from labpipe.report.document import Figure, Paragraph, Section, Table
from labpipe.report.fits import fit_sections
from labpipe.report.measurement import measurement_sections

K = Parameter("k", 45200.0, "N/m", std_error=31.0, t_ratio=1458.0, ci95=(45137.0, 45263.0), significant=True)
FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(65.0, 80.0),
    lines=15,
    equations=30,
    dof=28,
    gof=Goodness(0.99, 0.98, 1.02, 0.4),
    parameters=(K,),
    condition_number=12.3,
    correlation=np.ones((1, 1)),
    test="427N",
)
HOLDS = RuleOutcome("accept", "direct.gof >= 0.95", 0.98, True)
FAILS = RuleOutcome("expect", "direct.k 1 kN/m", None, False)
RESULT = Identification((FIT,), "Report", pipeline="p.yaml", outcomes=(HOLDS,), version="0.1.0")
RESPONSE = FrequencyResponse(
    np.array([1.0, 2.0]), np.ones((2, 1, 1)) + 0j, (Port("y", "y", "y"),), (Port("f", "f", "y"),), name="427N"
)


def words(sections: tuple[Section, ...]) -> dict[str, list[tuple[str, str]]]:
    """heading -> (text, tone) of its paragraphs."""
    return {
        section.heading: [
            (block.text, block.kind) for block in section.blocks if isinstance(block, Paragraph)
        ]
        for section in sections
    }


def test_rules_that_hold_for_a_part_of_the_tests_accept_nothing() -> None:
    """As `Identification.accepted` and exit code 2 say."""
    part = replace(RESULT, failed=(Failed("701N", "no such channel"),))
    first, second = words(verdict_sections(part))["Verdict"][:2]
    assert not part.accepted and first[0].startswith("INCOMPLETE")
    said = "NOT DECIDED: the one rule holds for what could be evaluated. No warnings."
    assert second == (said, "warning")


def test_an_accepted_result_says_so_with_its_rules() -> None:
    sections = verdict_sections(RESULT)
    assert words(sections)["Verdict"] == [("ACCEPTED: the one rule holds. No warnings.", "passed")]
    results, rules = (block for block in sections[0].blocks if isinstance(block, Table))
    assert results.rows == (("stiffness k", "45.200 ± 0.063 kN/m", "± 0.14 %"),)
    assert rules.rows == (("accept", "direct.gof >= 0.95", "0.98", "holds"),)
    assert [section.heading for section in sections] == ["Verdict", "Warnings"] and words(sections)[
        "Warnings"
    ][0][1] == "passed"


def test_a_box_is_green_only_when_the_rules_were_checked() -> None:
    """No noise, no test of the residual, no rule: each is named, and neither box is green."""
    blind = replace(FIT, gof=Goodness(0.99, 0.98))
    (lead, *_), (clean,) = words(verdict_sections(replace(RESULT, fits=(blind,)))).values()
    unchecked = "Not checked: chi-square, since the noise is not known (direct, test 427N)."
    assert lead[0].endswith(unchecked) and clean[0].endswith(unchecked) and lead[1] == clean[1] == "note"
    bare = words(verdict_sections(replace(RESULT, outcomes=())))["Warnings"]
    assert "Not checked: no accept or expect rule was given" in bare[0][0] and bare[0][1] == "note"
    unjudged = replace(blind, findings=(Finding("not-judged", "few lines", WARNING),))
    assert (
        "whether the residual is noise (direct, test 427N)"
        in words(verdict_sections(replace(RESULT, fits=(unjudged,))))["Verdict"][0][0]
    )


def test_a_failed_rule_and_no_rules_at_all() -> None:
    failed = verdict_sections(replace(RESULT, outcomes=(HOLDS, FAILS)))
    assert words(failed)["Verdict"][0] == ("NOT ACCEPTED: 1 of 2 rules fail. No warnings.", "failed")
    table = failed[0].blocks[-1]
    assert isinstance(table, Table) and table.rows[1] == ("expect", "direct.k 1 kN/m", "nothing", "FAILS")
    assert words(verdict_sections(replace(RESULT, outcomes=())))["Verdict"][0][1] == "note"


def test_what_could_not_be_evaluated_stands_before_all() -> None:
    verdict = verdict_sections(replace(RESULT, failed=(Failed("701N", "no such file"),)))[0]
    assert isinstance(verdict.blocks[0], Paragraph) and verdict.blocks[0].text.startswith(
        "INCOMPLETE: 1 test(s)"
    )
    assert isinstance(verdict.blocks[1], Table) and verdict.blocks[1].rows == (("701N", "no such file"),)


def test_each_kind_of_warning_stands_once_with_its_first_message() -> None:
    bands = tuple(
        replace(FIT, test=name, findings=(Finding("collinear", f"k and c in {name}", WARNING),))
        for name in ("a", "b")
    )
    measured = replace(RESPONSE, findings=(Finding("gap", "3 samples are missing", WARNING),))
    told = words(verdict_sections(replace(RESULT, fits=bands, responses=(measured,))))
    assert told["Warnings"] == [
        ("gap: 427N: 3 samples are missing", "warning"),
        ("collinear: direct, test a (2 times in all; this is the first): k and c in a", "warning"),
    ]
    assert told["Verdict"][1] == (
        "Read the warnings before using: direct, test a (collinear); direct, test b (collinear).",
        "warning",
    )


def test_any_band_of_a_sliding_fit_that_must_not_be_used_is_named() -> None:
    bad = replace(FIT, findings=(Finding("collinear", "k and c", WARNING),))
    told = words(verdict_sections(replace(RESULT, fits=(bad, FIT))))
    assert told["Verdict"][1][0] == "Read the warnings before using: direct, test 427N (collinear)."


def test_many_notes_of_a_kind_are_counted() -> None:
    findings = tuple(Finding("masked", f"line {n}", NOTE) for n in range(MOST_NOTES + 3))
    told = words(verdict_sections(replace(RESULT, fits=(replace(FIT, findings=findings),))))
    ((text, kind),) = told["Notes"]
    assert (
        kind == "note"
        and text.endswith(f"line 0 ({MOST_NOTES + 3} such notes in all; this is the first).")
        and "line 1" not in text
    )


def test_long_notes_of_a_kind_are_counted() -> None:
    findings = tuple(Finding("shaft-moves", f"{'word ' * 60}{n}", NOTE) for n in range(5))
    ((text, _),) = words(verdict_sections(replace(RESULT, fits=(replace(FIT, findings=findings),))))["Notes"]
    assert text.endswith("0 (5 such notes in all; this is the first).")


def test_few_notes_of_a_kind_are_listed_in_full() -> None:
    findings = tuple(Finding("masked", f"line {n}", NOTE) for n in range(MOST_NOTES))
    told = words(verdict_sections(replace(RESULT, fits=(replace(FIT, findings=findings),))))
    ((text, _),) = told["Notes"]
    assert all(f"line {n}" in text for n in range(MOST_NOTES)) and "such notes" not in text


def test_every_part_gives_sections_and_the_report_is_their_sum() -> None:
    full = replace(RESULT, responses=(RESPONSE,))
    sections = [section for part in PARTS for section in part(full)]
    assert [section.heading for section in sections] == [section.heading for section in build(full).sections]
    assert [section.heading for section in build(full).sections] == [
        "Verdict", "Warnings", "Result: direct, test 427N", "Measurement", "Rig and conditions", "Provenance",
    ]  # fmt: skip


def test_nothing_gives_no_sections_but_verdict_and_provenance() -> None:
    headings = [section.heading for section in build(Identification(())).sections]
    assert headings == ["Verdict", "Warnings", "Rig and conditions", "Provenance"]


def test_a_fit_is_described_with_its_parameters() -> None:
    (section,) = fit_sections(RESULT)
    text, table = section.blocks[:2]
    assert (
        isinstance(text, Paragraph)
        and ("band 65–80 Hz: 15 frequency lines, 30 real equations, 28 degrees of freedom") in text.text
    )
    assert isinstance(table, Table) and table.rows[0][:3] == ("k", "45.200", "kN/m")
    (unsettled,) = fit_sections(replace(RESULT, fits=(replace(FIT, converged=False),)))
    assert isinstance(unsettled.blocks[0], Paragraph) and "NOT converged" in unsettled.blocks[0].text


def test_bands_of_a_sliding_fit_share_a_section_with_a_row_each() -> None:
    fits = tuple(replace(FIT, band_hz=(low, low + 15.0)) for low in (60.0, 63.0, 66.0))
    (section,) = fit_sections(replace(RESULT, fits=fits))
    (table,) = (block for block in section.blocks if isinstance(block, Table))
    assert [row[:3] for row in table.rows] == [
        (f"{low}–{low + 15} Hz", f"{low + 7.5:g}", "0.9800") for low in (60, 63, 66)
    ]
    assert sum(isinstance(block, Figure) for block in section.blocks) == 2


def test_lines_of_a_calibration_share_a_section() -> None:
    slope = Parameter("slope", 2.0, "N/A", std_error=0.1, t_ratio=20.0, ci95=(1.8, 2.2), significant=True)
    lines = tuple(
        replace(FIT, name="gain", model="straight-line", test=test, parameters=(slope,), notes=("up to 3 A",))
        for test in ("a", "b")
    )
    (section,) = fit_sections(replace(RESULT, fits=lines))
    tables = [block for block in section.blocks if isinstance(block, Table)]
    assert section.heading == "Result: gain" and [row[0] for row in tables[0].rows] == ["a", "b"]
    assert tables[1].rows[0] == ("a", "0.99000", "15", "up to 3 A")


def test_measurements_say_their_size_and_averages() -> None:
    (section,) = measurement_sections(replace(RESULT, responses=(replace(RESPONSE, averages=12.5),)))
    assert words((section,))["Measurement"][0][0] == (
        "427N: receptance, 1 x 1 (responses x forces), 2 lines, 12.5 effective averages."
    )
    assert measurement_sections(RESULT) == ()


def test_provenance_repeats_channels_conditions_sources_and_settings() -> None:
    channel = {"name": "y", "quantity": "displacement", "role": "output", "dof": "y"}
    rig = {
        "name": "Bench",
        "description": "On rubber.",
        "mass": 0.92,
        "channels": [{"channel": channel, "column": "x [um]", "unit": "um", "scale": 1e-6}],
    }
    sources = ({"path": "a.csv", "sha256": "ab" * 32},)
    measured = (replace(RESPONSE, conditions={"preload": "427 N"}),)
    result = replace(
        RESULT, rig=rig, sources=sources, responses=measured, settings={"frf": {"period": 1.0}, "report": {}}
    )
    rig_section, provenance = provenance_sections(result)
    channels, conditions = (block for block in rig_section.blocks if isinstance(block, Table))
    assert words((rig_section,))["Rig and conditions"][0][0] == "Bench. On rubber. Moving mass 0.92 kg."
    assert channels.rows == (("y", "x [um]", "displacement", "output", "y", "um", "1e-06"),)
    assert conditions.rows == (("427N", "preload", "427 N"),)
    table, stated = (block for block in provenance.blocks if isinstance(block, Table))
    assert table.rows == (("a.csv", "ab" * 32),) and stated.rows == (("frf.period", "1.0"),)
    assert "labpipe run p.yaml" in words((provenance,))["Provenance"][0][0]


def test_acceptance_by_goodness_of_fit_alone_says_so() -> None:
    unknown = replace(FIT, findings=(Finding("no-covariance", "the FRF has no covariance"),))
    outcomes = (RuleOutcome("accept", "direct.gof >= 0.95", 0.98, True),)
    for fit, said in ((unknown, True), (FIT, False)):
        verdict = verdict_sections(Identification(fits=(fit,), outcomes=outcomes))[0]
        texts = [block.text for block in verdict.blocks if isinstance(block, Paragraph)]
        assert texts[0].startswith("ACCEPTED")
        assert any("G.o.F alone" in text and "direct" in text for text in texts) is said


def test_the_first_page_says_each_number_as_it_is_written_by_hand() -> None:
    """Even intervals as ±, others by their ends, a wide one with its reason, none with why."""
    skew = replace(K, name="c", unit="N.s/m", value=10.0, ci95=(9.0, 13.0), reason="other modes")
    held = replace(K, name="zeta", unit="1", value=0.0, ci95=None, std_error=None, at_bound=True)
    fits = (replace(FIT, parameters=(K, skew, held)), replace(FIT, name="other"))
    tables = [b for b in verdict_sections(replace(RESULT, fits=fits))[0].blocks if isinstance(b, Table)]
    assert tables[0].header == (
        "result of",
        "coefficient",
        "value with its 95 % interval",
        "relative",
        "why it is so wide",
    )
    assert [row[:3] for row in tables[0].rows] == [
        ("direct, test 427N", "stiffness k", "45.200 ± 0.063 kN/m"),
        ("", "damping c", "10.0 (9.0 to 13.0) N s/m"),
        ("", "damping ratio zeta", "0 (at the end of its range)"),
        ("other, test 427N", "stiffness k", "45.200 ± 0.063 kN/m"),
    ]
    without = replace(FIT, parameters=(replace(K, ci95=None),))
    for found, why in (((), "no interval"), ((Finding("gap", "x"),), "no interval, see the warnings")):
        (shown,) = result_blocks(replace(RESULT, fits=(replace(without, findings=found),)))
        assert isinstance(shown, Table) and shown.rows[0][1] == f"45.2 kN/m ({why})"
    # A probability has no interval, and is not zero where its sums only round to it.
    for value, text in ((0.0, "< 1e-15"), (0.0123, "0.0123")):
        worn = replace(FIT, parameters=(Parameter("healthy_probability", value, "1", derived=True),))
        (shown,) = result_blocks(replace(RESULT, fits=(worn,)))
        assert isinstance(shown, Table) and shown.rows[0][1] == text
    assert tables[0].rows[1][4] == "other modes"


def test_a_word_belongs_to_a_name_and_its_unit() -> None:
    """A force per current is not a stiffness, a damping ratio over the amplitude no damping ratio."""
    names = (("k_i", "N/A"), ("k_1_2", "N/m"), ("zeta_slope_1", "1/m"), ("zeta_rest_1", "1"))
    fit = replace(FIT, parameters=tuple(replace(K, name=name, unit=unit) for name, unit in names))
    (table,) = (b for b in result_blocks(replace(RESULT, fits=(fit,))) if isinstance(b, Table))
    assert [row[0] for row in table.rows] == [
        "k_i",
        "stiffness k_1_2",
        "zeta_slope_1",
        "damping ratio zeta_rest_1",
    ]


def test_a_test_of_no_name_is_no_hint() -> None:
    unnamed = replace(RESULT, fits=(replace(FIT, test=""),))
    with pytest.raises(ConfigError, match="no test 'x'; its only test has no name"):
        build(unnamed, "x")


def test_settings_are_those_that_the_file_states() -> None:
    settings = {
        "frf": {"period": 1.0, "window": "hann", "skip": 3},
        "identify": [{"name": "a", "share": 1, "mass": 2.0}],
    }
    stated = provenance_sections(replace(RESULT, settings=settings))[1].blocks[-1]
    assert isinstance(stated, Table)
    assert stated.rows == (("frf.period", "1.0"), ("frf.skip", "3"), ("identify.a.mass", "2.0"))
