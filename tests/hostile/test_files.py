"""A fixed number of mutated inputs of every kind; `python -m tests.hostile.run` reads them for hours."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from labpipe.cli.main import run_command
from labpipe.project.catalogue import INDEX
from labpipe.project.verification import KINDS
from labpipe.raw_files.table import READERS
from labpipe.raw_files.text_table import plain_suffix
from tests.hostile.scenarios import SCENARIOS, write_scenario
from tests.hostile.seeds import ARTEFACTS, READS, TABLES, write_seeds
from tests.hostile.trials import Tally, trial_of_file, trial_of_yaml

TRIALS, FEWER = 25, 6
YAML_TRIALS = {"pipeline.yaml": 15, "rig.yaml": 15}
SLOW = ("a.h5", "a.xlsx", "a.mf4", "rates.mf4", INDEX, "identification.json")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    write_seeds(folder)
    return folder


def test_every_kind_of_artefact_is_mutated() -> None:
    assert not [kind for kind in KINDS if not any(name.endswith(kind) for name in ARTEFACTS)]


def test_every_reader_of_tables_is_given_mutated_files() -> None:
    """By the function that reads, since some have several endings."""
    tried = {READERS.load(plain_suffix(Path(kind))) for kind in TABLES}
    assert {READERS.load(suffix) for suffix in READERS.names()} == tried


@pytest.mark.parametrize("kind", READS)
@pytest.mark.filterwarnings("ignore")
def test_no_mutated_file_breaks_its_reader(seeds: Path, tmp_path: Path, kind: str) -> None:
    """Nor does a mutated artefact give another number."""
    if kind == INDEX:
        (tmp_path / "identification.json").write_bytes(
            (seeds / "laboratory/out/identification.json").read_bytes()
        )
    (tmp_path / kind).write_bytes((seeds / kind).read_bytes())
    whole = READS[kind](tmp_path / kind)[0]
    assert whole
    tally = Tally(kind)
    for seed in range(FEWER if kind in SLOW else TRIALS):
        trial_of_file(kind, seeds, tmp_path, seed, tally, whole)
    assert not tally.faults
    if kind in ARTEFACTS:
        assert not tally.counts["other numbers"]


# Comparisons with a theory and films at many places take seconds.
DEAR = ("campaign", "run-up", "study", "plan", "virtual journal")
MARKED = [pytest.param(name, marks=pytest.mark.long if name.startswith(DEAR) else ()) for name in SCENARIOS]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Path], None]:
    """Copies a scenario's folder as its command leaves it; scenarios of the same files and command share
    one.
    """
    folders: dict[tuple[object, ...], Path] = {}

    def copy(name: str, to: Path) -> None:
        scenario = SCENARIOS[name]
        key = scenario.command, id(scenario.files)
        if key not in folders:
            folders[key] = tmp_path_factory.mktemp("scenario")
            write_scenario(name, folders[key])
            with contextlib.chdir(folders[key]):
                assert run_command(list(scenario.command)) == 0
        shutil.copytree(folders[key], to, dirs_exist_ok=True)

    return copy


@pytest.mark.parametrize("name", MARKED)
@pytest.mark.filterwarnings("ignore")
def test_no_mutated_yaml_breaks_a_command(
    finished: Callable[[str, Path], None], tmp_path: Path, name: str
) -> None:
    """Nor is the file as it stands refused: its mutations would try nothing."""
    finished(name, tmp_path)
    tally = Tally(name)
    for seed in range(YAML_TRIALS.get(name, 2)):
        trial_of_yaml(name, tmp_path, seed, tally)
    assert not tally.faults
