"""Scatter between repeats as sources: closed forms of their sums, and what they do to comparisons of
tests.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.estimation.budget import with_repeat_sources
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.work import Work, run_fits
from labpipe.records.identification import Fit
from labpipe.records.uncertain import RepeatSource
from labpipe.uncertainty.amounts import parameter_changes
from tests.estimation.test_budget import GAIN_X, a_response

REMOUNTING = RepeatSource("remounting", "k", 0.01, "mounting", 4.0)
DRIFT = RepeatSource("drift", "k", 0.005)


def fitted(uncertainties=()) -> Fit:
    (fit,) = identify(
        a_response(np.random.default_rng(3), output=uncertainties, force=()),
        FitSettings("sdof", name="peak", mass=0.79),
    )
    return fit


@pytest.mark.parametrize("uncertainties", [(), (GAIN_X,)])
def test_sources_add_in_squares_and_share_their_degrees_of_freedom(uncertainties) -> None:
    """u_c^2 = u_noise^2 + u_gain^2 + (1 % k)^2 + (0.5 % k)^2.

    Welch and Satterthwaite with 4 degrees behind the largest.
    """
    before = fitted(uncertainties)
    fit = with_repeat_sources(before, [REMOUNTING, DRIFT], "a", {"mounting": 3}, 0.95)
    k, was = fit.parameter("k"), before.parameter("k")
    known = was.systematic or 0.0
    assert k.systematic == pytest.approx(np.sqrt(known**2 + (0.01 * k.value) ** 2 + (0.005 * k.value) ** 2))
    assert k.combined == pytest.approx(np.hypot(was.std_error, k.systematic))
    dof = k.combined**4 / ((0.01 * k.value) ** 4 / 4 + was.std_error**4 / before.dof)
    (column,) = [n for n, name in enumerate(fit.budget.names) if name == "k"]
    assert fit.budget.dof[column] == pytest.approx(dof)
    assert k.ci95[1] - k.value == pytest.approx(k.expanded, rel=1e-6)
    assert [part.source for part in k.budget][:2] == ["remounting (mounting 3)", "drift (a)"]
    # The parts of the interval are those of the interval that is stated.
    assert (k.interval.systematic, k.interval.noise) == (k.systematic, was.std_error)
    c = fit.parameter("c")
    assert (c.systematic or 0.0) == pytest.approx(before.parameter("c").systematic or 0.0)


def test_tests_of_one_mounting_err_together() -> None:
    """The ratio of two coefficients of one mounting does not carry its error.

    That of two mountings has both.
    """
    fits = [
        with_repeat_sources(fitted(), [REMOUNTING], name, {"mounting": m}, 0.95)
        for name, m in (("a", 1), ("b", 1), ("c", 2))
    ]
    changes = parameter_changes(fits, "k")
    relative = changes / fits[0].parameter("k").value
    np.testing.assert_allclose(relative, [[0.01, 0.01, 0.0], [0.0, 0.0, 0.01]], rtol=1e-9)


def test_a_missing_condition_is_named() -> None:
    with pytest.raises(
        ConfigError, match="remounting goes by the condition 'mounting', which test a does not have"
    ):
        with_repeat_sources(fitted(), [REMOUNTING], "a", {}, 0.95)


PIPELINE = """
rig: rig.yaml
recordings: r.csv
frf: {excitation: random, block: 1 s}
identify: {peak: {model: sdof}}
uncertainty:
  repeatability:
"""
RIG = (
    "name: r\nsample_rate: 1 kHz\nchannels:\n  f: {quantity: force, unit: N, dof: x}\n  x: {quantity: "
    "displacement, unit: um, dof: x}\n"
)


def loaded(folder: Path, entry: str) -> tuple[RepeatSource, ...]:
    (folder / "rig.yaml").write_text(RIG)
    (folder / "r.csv").write_text("f,x\n1,2\n3,4\n")
    (folder / "p.yaml").write_text(PIPELINE + entry + "\n")
    (fit,) = load_pipeline(folder / "p.yaml").fits
    return fit.between


def test_a_size_and_a_repeatability_test_are_read(tmp_path: Path) -> None:
    assert loaded(tmp_path, '    remounting: {parameter: k, size: "2 % (k=2, dof=4)", per: mounting}') == (
        REMOUNTING,
    )
    amounts = [{"name": "mean", "value": 200.0}, {"name": "between", "value": 3.0}]
    points = [{"group": str(n // 2)} for n in range(6)]
    comparison = {
        "name": "stiffness",
        "kind": "repeatability",
        "subject": "k, fit axial",
        "amounts": amounts,
        "points": points,
    }
    (tmp_path / "repeat.json").write_text(json.dumps({"comparisons": [comparison]}))
    found = loaded(tmp_path, "    day: {file: repeat.json, comparison: stiffness, per: date}")
    assert found == (RepeatSource("day", "k", 0.015, "date", 2.0),)


def test_a_parameter_that_no_fit_has_is_named(tmp_path: Path) -> None:
    """Its scatter went into no interval."""
    loaded(tmp_path, "    d: {parameter: kk, size: 5 %}")
    pipeline = load_pipeline(tmp_path / "p.yaml")
    work = Work(pipeline, (), OutputFolder(tmp_path, tmp_path), test_fits={"peak": [fitted()]})
    with pytest.raises(ConfigError, match=r"repeatability.d: no fit has a parameter 'kk'; did you mean 'k'"):
        run_fits(pipeline.fits, work)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "    d: {parameter: k, size: 3 N/m}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d.size: '3 N/m' is not relative",
        ),
        (
            "    d: {parameter: k}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d: 'parameter' and 'size' are needed",
        ),
        (
            "    d: {file: rig.yaml, comparison: k}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d.file: 'rig.yaml' is not a readable",
        ),
        (
            "    d: {file: none.json, comparison: k}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d.file: .*none.json",
        ),
        (
            "    d: {file: rig.yaml}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d.*'file' and 'comparison' go together",
        ),
        (
            "    d: {file: rig.yaml, comparison: k, size: 1 %}",
            r"p.yaml:8:\d+: uncertainty.repeatability.d.*says which parameter scatters",
        ),
    ],
)
def test_faults_have_their_place(tmp_path: Path, entry: str, message: str) -> None:
    with pytest.raises(ConfigErrors, match=message):
        loaded(tmp_path, entry)
