"""The documentation: every command of every page runs and prints what is shown, its YAML and Python are
valid.

Runs whose report no page shows are made without one, the study of minutes with few repeats; commands marked
`parse` in the page (a cluster's address, half a minute of work that tests/cli runs) are compared with the
options of their command only.
"""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

DOCS = Path(__file__).parents[2] / "docs"
sys.path.insert(0, str(DOCS))
PAGES = sorted((DOCS / "pages").rglob("*.md"))
# Commands for a shell, and where they are run.
SHELL = {
    "python -m tests.hostile.run --seconds 600": "tests/hostile, with a fixed number of trials",
    "python -m tests.machine.kills --count 100 --processes 2": "tests/machine, with one kill",
    "python -m tests.machine.kills --count 100 --cluster --worker": "tests/machine, with one kill",
    "python -m tests.mutants.run --count 200": "takes hours",
    "python -m tests.benchmarks.fleet --recordings 2000 --results 20000 --cluster 1000 4000 16000": "takes "
    "half an hour",
    "python -m tests.validation": "tests/validation",
    "python -m tests.validation.record_measured --data FOLDER": "tests/validation, where the raw files are",
    "moto_server -H 127.0.0.1 -p 5055": "tests/project/test_object_storage.py, on a free port",
    "dask scheduler": "tests/project/test_many_tests.py, on loopback",
    "dask worker tcp://10.0.0.1:8786 --nthreads 1": "tests/project/test_many_tests.py, on loopback",
    "pip install ./docs/plugin": "the plug-in's entry points are written here as pip writes them",
    "python3 -m venv .venv": "the README's first command, by .ci/run",
    ".venv/bin/pip install .": "the README's first command, by .ci/run",
    "pipx install .": "tests/packaging/test_distribution.py, by pip into an environment of its own",
    "uv tool install .": "as pipx",
    "source .venv/bin/activate": "the README's first command, by .ci/run",
    "labpipe check -j 0 pipelines/*.yaml": ".ci/run",
}


def module(name: str) -> ModuleType:
    """A module of docs, which is not a package."""
    return importlib.import_module(name)


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


console = module("console")
WITH_COMMANDS = [page for page in PAGES if list(console.commands(page.read_text(encoding="utf-8")))]


# Pages whose commands take a second and more: films, run-ups, a loop's theory, plans, whole projects.
SLOW = {"bearing", "journal-bearing", "unbalance", "control-loop", "compare", "virtual-rig", "run-up-method"}
SLOW |= {"section", "budget", "plan", "many", "campaign", "closed-loop", "ball-bearing", "magnetic-bearing"}
SLOW |= {
    "reader",
    "estimator",
    "modal",
    "rotor",
    "rotor-system",
    "white-noise",
    "index",
    "sweep",
    "frf-table",
    "local",
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.long] * (page.stem in SLOW), id=page.stem)
        for page in WITH_COMMANDS
    ],
)
def test_the_commands_of_a_page_run_as_shown(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console.scratch(tmp_path)
    monkeypatch.chdir(tmp_path)
    for command in console.commands(page.read_text(encoding="utf-8")):
        code, printed = console.run(console.without_report(command))
        assert code == command.code, (command.words, printed)
        assert not console.differs(command.shown, printed), (command.words, printed)


def test_most_pages_hold_commands() -> None:
    without = {
        "statistics",
        "advice",
        "notebook",
        "fleet",
        "versions",
        "reading-a-report",
        "pipelines",
        "models",
        "comparisons",
        "recordings",
        "design",
        "glossary",
        "gallery",
        "speed",
    }
    # The manuals of theory and of validation explain; they need no commands.
    guides = {page for page in PAGES if page.parent.name not in ("theory", "validation")}
    assert {page.stem for page in guides} - {page.stem for page in WITH_COMMANDS} == without


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_shell_commands_are_known(page: Path) -> None:
    for block in blocks(page.read_text(encoding="utf-8"), "sh"):
        for line in block.strip().splitlines():
            assert line in SHELL, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_yaml_shown_has_the_keys_that_are_read(page: Path, tmp_path: Path) -> None:
    """Keys of a pipeline.

    A block with channels is a whole rig file, one with elements a rotor file, one with a plan or planes a
    plan or balance file: read.
    """
    from labpipe.methods.balancing.balance_file import load_balance
    from labpipe.methods.planning.plan_file import load_plan
    from labpipe.methods.rotor_system.system_file import load_system
    from labpipe.project.pipeline_file import section_names
    from labpipe.project.rig_file import load_rig

    for block in blocks(page.read_text(encoding="utf-8"), "yaml"):
        if "channels" in yaml.safe_load(block):
            (tmp_path / "rig.yaml").write_text(block, encoding="utf-8")
            assert load_rig(tmp_path / "rig.yaml").all_channels
        elif "planes" in yaml.safe_load(block):
            # The result that a model is read from is not there.
            tree = {key: value for key, value in yaml.safe_load(block).items() if key != "model"}
            (tmp_path / "balance.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
            assert load_balance(tmp_path / "balance.yaml").runs
        elif "elements" in yaml.safe_load(block):
            (tmp_path / "rotor.yaml").write_text(block, encoding="utf-8")
            assert load_system(tmp_path / "rotor.yaml").rig.bearings
        elif "plan" in yaml.safe_load(block):
            if not (tmp_path / "configs").exists():
                (tmp_path / "configs").symlink_to(DOCS.parent / "configs")
            (tmp_path / "plan.yaml").write_text(block, encoding="utf-8")
            assert load_plan(tmp_path / "plan.yaml").settings.model
        else:
            assert set(yaml.safe_load(block)) <= set(section_names()), block


def test_the_notebook_page_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(DOCS.parent)
    names: dict[str, object] = {}
    for code in blocks((DOCS / "pages/how-to/notebook.md").read_text(encoding="utf-8"), "python"):
        exec(code, names)
    k = "k = 134.50 kN/m, 95 %: 134.48 to 134.52"
    assert capsys.readouterr().out == f"{k}\nno difference\n60-70 Hz: {k}\n62-68 Hz: {k}\n"
    assert names["modes"].model_settings.order == (1, 8)
    assert bytes(names["html"]).startswith(b"<!DOCTYPE html>")


def test_every_code_of_a_finding_is_explained() -> None:
    reference = module("reference")
    assert reference.codes() == set(reference.explained())


def test_the_reference_names_every_key_and_command() -> None:
    from labpipe.bearings.kinds import BEARINGS
    from labpipe.cli.main import COMMANDS
    from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS

    pages = module("reference").reference_pages()
    assert all(f"## {name}\n" in pages["commands"] for name in COMMANDS)
    assert "| `k` |" not in pages["rig"] and "| `sensitivity` |" in pages["rig"]
    for page, kinds in {"bearing": BEARINGS, "virtual": VIRTUAL_RIGS}.items():
        for name in kinds:
            assert f"## {name}\n" in pages[page]
            assert all(f"| `{key}` |" in pages[page] for key in keys(kinds[name].settings)), name
    assert all(f"### {name}\n" in pages["rotor"] for name in BEARINGS)


def test_the_reference_names_every_section_with_its_keys_and_those_of_models() -> None:
    from labpipe.estimation.settings import MODELS, model_kind
    from labpipe.records.sections import sections

    page = module("reference").reference_pages()["pipeline"]
    for name, section in sections():
        own = page.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        assert section.words in own
        assert all(f"| `{key}` |" in own for key in keys(section.settings)), name
    for kind in map(model_kind, MODELS):
        assert kind.settings is None or f"`{kind.section}:` of a fit" in page


def keys(owner: type) -> set[str]:
    """The names of a dataclass's settings, those of nested sections too."""
    from labpipe.records.settings import settings_of

    nested = [
        keys(setting.section) for setting, _ in settings_of(owner).values() if setting.section is not None
    ]
    return set(settings_of(owner)).union(*nested)


def test_the_reference_has_words_for_every_form_of_a_setting() -> None:
    from labpipe.records.settings import CONVERTERS

    reference = module("reference")
    # A choice lists its choices.
    assert set(reference.KINDS) == set(CONVERTERS) - {"choice"}
    assert set(reference.BELOW) == {
        kind for kind, words in reference.KINDS.items() if words.endswith("below")
    }
