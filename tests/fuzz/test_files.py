"""A fixed number of mutated inputs of every kind; `python -m tests.fuzz.run` reads them for hours."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.catalogue.index import INDEX
from tests.fuzz.seeds import ARTEFACTS, READS, write_seeds
from tests.fuzz.trials import Tally, trial_of_file, trial_of_yaml
from tests.unit.pipeline.laboratory import ALONE, laboratory

TRIALS, FEWER = 60, 12
SLOW = ("a.h5", "a.xlsx", INDEX, "identification.json")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    write_seeds(folder)
    return folder


@pytest.mark.parametrize("kind", READS)
@pytest.mark.filterwarnings("ignore")
def test_no_mutated_file_breaks_its_reader(seeds: Path, tmp_path: Path, kind: str) -> None:
    """Nor does a mutated artefact give another number."""
    if kind == INDEX:
        (tmp_path / "identification.json").write_bytes((seeds / "laboratory/out/identification.json").read_bytes())
    (tmp_path / kind).write_bytes((seeds / kind).read_bytes())
    whole = READS[kind](tmp_path / kind)[0]
    assert whole
    tally = Tally(kind)
    for seed in range(FEWER if kind in SLOW else TRIALS):
        trial_of_file(kind, seeds, tmp_path, seed, tally, whole)
    assert not tally.faults
    if kind in ARTEFACTS:
        assert not tally.counts["other numbers"]


@pytest.mark.parametrize("name", ["pipeline.yaml", "rig.yaml"])
@pytest.mark.filterwarnings("ignore")
def test_no_mutated_yaml_breaks_a_run(tmp_path: Path, name: str) -> None:
    laboratory(tmp_path, ALONE)
    tally = Tally(name)
    for seed in range(60):
        trial_of_yaml(name, tmp_path, seed, tally)
    assert not tally.faults and tally.counts["refused"]
