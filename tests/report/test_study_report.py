"""What the report says of a study, of candidates and of a large FRF matrix.

The figures' numbers are those of the records.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.project.study import study_blocks, study_sections
from labpipe.records.comparison import StudiedParameter, Study, StudyCase, StudyThreshold
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import (
    Candidate,
    Fit,
    FittedCurve,
    Goodness,
    Identification,
    listed_parameters,
)
from labpipe.report.document import Figure, Paragraph, Table
from labpipe.report.figures import matrix_figure, matrix_figures
from labpipe.report.fits import candidate_blocks
from labpipe.report.wording import entangled_text, interval_text, parameter_row, threshold_text

K = StudiedParameter("k_1_1", "N/m", truth=2.0, mean=2.1, rmse=0.2, bound=0.16, std_error=0.19, coverage=0.94)
CASE = StudyCase(
    fit="ml",
    estimator="ml",
    noise=0.011,
    lines=25,
    repeats=500,
    failed=3,
    mean_error=0.00297,
    median_error=0.00259,
    error_variance=3.4e-6,
    success=(0.998,),
    rmse_over_bound=0.975,
    coverage=0.957,
    parameters=(K,),
)
FIT = Fit(
    "three",
    "mdof",
    "ml",
    band_hz=(0.0, 1.0),
    lines=3,
    equations=9,
    dof=8,
    gof=Goodness(0.9, 0.89, 4.0, 1e-9),
    parameters=(),
    condition_number=2.0,
    correlation=np.eye(1),
)


def study(**change: object) -> Study:
    cases = (CASE, replace(CASE, noise=0.043, mean_error=0.0466, failed=0))
    return replace(Study("rig", 1, (0.1,), 0.95, cases, (StudyThreshold("ml", 0.1, 0.0538, 200),)), **change)


def test_the_table_of_cases_has_every_figure() -> None:
    table = next(block for block in study_blocks(study()) if isinstance(block, Table))
    assert table.rows[0] == (
        "ml",
        "1.1 %",
        "25",
        "0.00297",
        "3.4e-06",
        "0.00259",
        "3 of 500",
        "99.8 %",
        "0.975",
        "95.7 %",
    )
    assert table.rows[1][:4] == ("ml", "4.3 %", "25", "0.0466")


def test_printed_errors_stand_beside() -> None:
    table = next(
        block
        for block in study_blocks(study(printed=(("ml", (0.0031, 0.0483)),)))
        if isinstance(block, Table)
    )
    assert table.header[-1] == "printed mean error" and [row[-1] for row in table.rows] == [
        "0.0031",
        "0.0483",
    ]


def test_parameters_at_the_highest_noise_with_bias_and_bound() -> None:
    tables = [block for block in study_blocks(study()) if isinstance(block, Table)]
    detail = next(table for table in tables if "4.3 % noise" in table.caption)
    assert detail.rows == (("k_1_1", "2 N/m", "2.1", "0.1", "0.2", "0.16", "0.19", "94 %"),)
    means = next(table for table in tables if "mean of the estimates" in table.caption)
    assert means.rows[0] == ("truth", "2") and means.rows[1] == ("1.1 %", "2.1")


def test_curves_over_the_noise_are_the_cases() -> None:
    figure = next(block for block in study_blocks(study()) if isinstance(block, Figure))
    coverage, asked = figure.graphic.panels[2].series
    assert (
        coverage.x == pytest.approx([1.1, 4.3])
        and coverage.y == pytest.approx([95.7, 95.7])
        and asked.y == [95.0]
    )
    alone = study_blocks(study(cases=(CASE,)))
    assert not any(isinstance(block, Figure) for block in alone)


def test_a_case_without_results_is_shown_as_such() -> None:
    nothing = replace(
        CASE, failed=500, mean_error=float("nan"), coverage=None, rmse_over_bound=None, parameters=()
    )
    (section,) = study_sections((study(cases=(nothing,)),), Identification(()))
    (table,) = (block for block in section.blocks if isinstance(block, Table))
    assert table.rows[0][6] == "500 of 500" and table.header[-2:] == ("no result", "success")


def test_cases_are_listed_with_noise_and_lines() -> None:
    """As lists of results and data frames show them; what a case has not is left out."""
    cases = (CASE, replace(CASE, noise=0.043, coverage=None, mean_error=float("nan")))
    listed = list(listed_parameters(Identification((), sections={"study": (study(cases=cases),)})))
    assert [(one.test, one.parameter.name, one.parameter.value) for one in listed] == [
        ("1.1 %, 25 lines", "mean_error", 0.00297),
        ("1.1 %, 25 lines", "success", 0.998),
        ("1.1 %, 25 lines", "rmse_over_bound", 0.975),
        ("1.1 %, 25 lines", "coverage", 0.957),
        ("4.3 %, 25 lines", "success", 0.998),
        ("4.3 %, 25 lines", "rmse_over_bound", 0.975),
    ]
    assert {(one.fit, one.model, one.estimator, one.parameter.unit) for one in listed} == {
        ("study.ml", "study", "ml", "1")
    }


def test_thresholds_as_sentences() -> None:
    found = threshold_text(StudyThreshold("iv", 0.1, 0.0227, 200), 0.95)
    assert found == "iv: within 10 % of the truth in 95 % of the repeats up to a noise of 2.27 %"
    assert "no such noise level" in threshold_text(StudyThreshold("iv", 0.1, None, 200), 0.95)


def test_candidates_best_first() -> None:
    found = (
        Candidate("mdof, symmetric", 12, 430.0, 438, 454.0, 0.31),
        Candidate("this model: mdof, general", 18, 424.0, 432, 460.0),
    )
    table, explained = candidate_blocks(replace(FIT, candidates=found))
    assert isinstance(table, Table) and isinstance(explained, Paragraph)
    assert table.rows[0] == ("mdof, symmetric", "12", "430.0", "438", "0.0", "0.31")
    assert table.rows[1][4:] == ("6.0", "")
    assert candidate_blocks(FIT) == ()


def test_candidates_by_bic_have_their_own_chi_square() -> None:
    found = (
        Candidate("free", 3, 440.0, 400, 446.0, bic=458.0, chi2_p=0.081),
        Candidate("clamped", 2, 900.0, 401, 904.0, bic=912.04, chi2_p=1e-40),
    )
    table, explained = candidate_blocks(replace(FIT, candidates=found))
    assert table.rows == (("free", "3", "1.1", "0.081", "0.0"), ("clamped", "2", "2.244", "1e-40", "454.0"))
    assert "BIC = chi² + parameters ln(equations)" in explained.text


def test_enlarged_standard_errors_are_said() -> None:
    parameter = Parameter("c", 3.7, "N.s/m", std_error=0.02, std_error_inflated=0.04)
    text = interval_text(replace(FIT, parameters=(parameter,)))
    assert "wider than those of noise alone: c 2 times." in text
    # Noise .02 and model .03 beside .12 of given numbers, which the residual does not show.
    given = replace(
        parameter, std_error_inflated=float(np.sqrt(0.02**2 + 0.03**2 + 0.12**2)), systematic=0.12
    )
    assert "wider than those of noise alone: c 1.8 times." in interval_text(replace(FIT, parameters=(given,)))
    assert interval_text(FIT) == ""


def test_missing_intervals_and_entangled_parameters_are_said_in_words() -> None:
    k, c = (Parameter(name, 1.0, "N/m", vif=vif) for name, vif in (("k", 150.0), ("c", 2.0)))
    refused = replace(FIT, parameters=(k, c), findings=(Finding("model-mismatch", "a mode too few"),))
    assert "no standard errors and intervals are given" in interval_text(refused)
    vif, close = entangled_text(
        replace(FIT, parameters=(k, c), correlation=np.array([[1.0, -0.998], [-0.998, 1.0]]))
    )
    assert "k (150 times)" in vif and "c (" not in vif
    assert "k and c (-0.9980)" in close
    assert entangled_text(replace(FIT, parameters=(c,), correlation=np.eye(1))) == []


def test_every_element_of_a_large_matrix_has_its_panel() -> None:
    frequency = np.array([1.0, 2.0, 3.0])
    matrix = np.arange(1, 28).reshape(3, 3, 3) * 1e-6 * (1 + 1j)
    curve = FittedCurve(
        frequency,
        matrix,
        1.1 * matrix,
        variance=np.full(matrix.shape, 1e-14),
        outputs=("1", "2", "3"),
        inputs=("a", "b", "c"),
        form="receptance",
    )
    figure = matrix_figure(replace(FIT, curve=curve), curve)
    panels = figure.graphic.panels
    assert [panel.title for panel in panels] == [f"{o}/{i}" for o in "123" for i in "abc"]
    measured, fitted = panels[5].series
    np.testing.assert_allclose(measured.y, np.abs(matrix[:, 1, 2]) * 1e6)
    np.testing.assert_allclose(fitted.y, 1.1 * np.abs(matrix[:, 1, 2]) * 1e6)


def test_of_very_many_elements_the_mean_and_the_worst_are_shown() -> None:
    """30 elements; the residual of number n is n per cent of it."""
    frequency = np.array([1.0, 2.0, 3.0])
    matrix = np.full((3, 10, 3), 2e-6 + 0j)
    fitted = matrix * (1 + 0.01 * np.arange(30).reshape(10, 3))
    curve = FittedCurve(
        frequency,
        matrix,
        fitted,
        variance=None,
        outputs=tuple("0123456789"),
        inputs=("a", "b", "c"),
        form="receptance",
    )
    mean, worst = matrix_figures(replace(FIT, curve=curve), curve)
    measured, _, residual = mean.graphic.panels[0].series
    np.testing.assert_allclose(measured.y, 2.0)
    np.testing.assert_allclose(residual.y, 2.0 * np.sqrt(np.mean((0.01 * np.arange(30)) ** 2)))
    assert [panel.title for panel in worst.graphic.panels] == [
        f"{n // 3}/{'abc'[n % 3]}" for n in range(29, 17, -1)
    ]
    assert "the 12 of 30 elements" in worst.caption and "residual 29 to 18 %" in worst.caption


def test_soft_springs_stay_in_newtons_per_metre() -> None:
    soft = Parameter("k", 2.0, "N/m", std_error=0.02, ci95=(1.96, 2.04))
    assert parameter_row(soft, 10)[1:4] == ("2.000", "N/m", "0.020")
    assert parameter_row(replace(soft, value=2000.0), 10)[1:3] == ("2.000000", "kN/m")
