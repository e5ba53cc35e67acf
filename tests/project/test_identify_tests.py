"""A fit for some tests only, and a fit that builds on an earlier one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.identification_file import read_identification
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

PIPELINE = """tests:
  - {name: soft, frfs: soft.csv}
  - {name: stiff, frfs: stiff.csv}
identify:
  both: {model: sdof}
  one: {model: sdof, test: stiff}
"""


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Two receptances of one mass on 100 and 400 kN/m."""
    lines = np.arange(20.0, 80.0)
    w = 2 * np.pi * lines
    for name, k in (("soft", 1e5), ("stiff", 4e5)):
        h = (1 / (k - w**2 + 20j * w) + 1e-9 * rng.standard_normal(lines.size))[:, None, None]
        ports = (Port("x", "x", "x"),), (Port("f", "f", "x"),)
        write_frf_csv(
            tmp_path / f"{name}.csv",
            FrequencyResponse(lines, h, *ports, covariance=diagonal_covariance(np.full(h.shape, 1e-18))),
        )
    (tmp_path / "p.yaml").write_text(PIPELINE)
    return tmp_path


def test_a_fit_is_made_for_the_tests_it_names(folder: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    ended = labpipe("run", folder / "p.yaml", "-o", folder / "out")
    assert ended.code == 0, ended.err
    fits = read_identification(folder / "out/identification.json").fits
    assert [(fit.name, fit.test) for fit in fits] == [("both", "soft"), ("both", "stiff"), ("one", "stiff")]
    assert fits[2].parameter("k").value == pytest.approx(4e5, rel=1e-2)


def test_a_test_that_is_not_there(folder: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    (folder / "p.yaml").write_text(PIPELINE.replace("test: stiff", "test: stif"))
    ended = labpipe("run", folder / "p.yaml", "-o", folder / "out")
    assert ended.code == 2 and "no test 'stif'" in ended.err and "did you mean 'stiff'" in ended.err
