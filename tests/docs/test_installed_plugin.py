"""The worked plug-in as it is installed: one module and one line for each addition, and every command that
then knows it.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import runpy
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import labpipe
from labpipe import registry

ROOT = Path(__file__).parents[2]
PLUGIN = ROOT / "docs/plugin"
EXAMPLE = "docs/plugin/example"
# Group of the entry points -> the module that is the addition.
ADDED = {
    "labpipe.reader": "r16_table",
    "labpipe.estimator": "robust",
    "labpipe.bearing": "squeeze_film",
    "labpipe.virtual_rig": "sdof_rig",
    "labpipe.run_up_method": "common_factor",
    "labpipe.section": "separation",
}


def load_console():
    """docs/console.py, which is not a module of a package.

    It makes the scratch folder and runs commands with the plug-in.
    """
    spec = importlib.util.spec_from_file_location("docs_console_of_plugin", ROOT / "docs/console.py")
    assert spec is not None and spec.loader is not None
    sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[spec.name])
    return sys.modules[spec.name]


console = load_console()


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    console.scratch(folder)
    return folder


@pytest.fixture
def of_own_process(project: Path, monkeypatch: pytest.MonkeyPatch):
    """Run a command in a process that begins with the plug-in installed; its exit code must be as stated."""
    monkeypatch.chdir(project)

    def run(*words: str, code: int = 0) -> str:
        ended, printed = console.run(console.Command(words, plugin=True))
        assert ended == code, printed
        return str(printed)

    return run


@contextmanager
def with_plugin(project: Path) -> Iterator[None]:
    """The tables of labpipe in this process, looked up anew with the plug-in: a process takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(project / "docs/plugin/src"))
        registry._groups_of_others.cache_clear()
        yield
    registry._groups_of_others.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "labpipe_example"]:
        del sys.modules[name]


@pytest.fixture
def installed(project: Path, monkeypatch: pytest.MonkeyPatch, labpipe):
    """Run a labpipe command here with the plug-in; its exit code must be as stated."""
    monkeypatch.chdir(project)

    def run(*words: str, code: int = 0) -> str:
        ended = labpipe(*words)
        assert ended.code == code, ended
        return str(ended.out + ended.err)

    with with_plugin(project):
        yield run


@pytest.fixture
def run_up_table(installed, project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run-up that the example's script writes; its page runs it as it is shown."""
    path = project / EXAMPLE / "damper.csv"
    if not path.exists():
        monkeypatch.setattr(sys, "argv", ["make_run_up.py", str(path)])
        runpy.run_path(f"{EXAMPLE}/make_run_up.py", run_name="__main__")
    return path


def entry_points() -> dict[str, dict[str, str]]:
    return tomllib.loads((PLUGIN / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]


def imported(path: Path) -> set[str]:
    """The modules that a module imports; "." for one of its own package by a relative name."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return plain | {
        "." if node.level else str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)
    }


def test_each_addition_is_one_module_and_one_line() -> None:
    groups = entry_points()
    assert {
        group: [target.partition(":")[0] for target in lines.values()] for group, lines in groups.items()
    } == {group: [f"labpipe_example.{module}"] for group, module in ADDED.items()}
    modules = {
        path.stem: path for path in (PLUGIN / "src/labpipe_example").glob("*.py") if path.stem != "__init__"
    }
    assert set(modules) == set(ADDED.values())
    assert not [
        name
        for path in modules.values()
        for name in imported(path)
        if name.startswith((".", "labpipe_example"))
    ]


def test_labpipe_itself_names_nothing_of_the_plugin() -> None:
    names = [
        name for lines in entry_points().values() for name in lines if name not in ("robust", "separation")
    ]
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "labpipe").rglob("*.py"))
    assert not [name for name in (*names, "labpipe_example", '"separation"') if name in source]


def test_every_addition_has_a_page_with_its_line() -> None:
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs/pages/extend").glob("*.md"))
    lines = (PLUGIN / "pyproject.toml").read_text(encoding="utf-8")
    for group, module in ADDED.items():
        head = f'[project.entry-points."{group}"]\n'
        line = lines.partition(head)[2].partition("\n")[0]
        assert f"{head}{line}\n```" in pages, group
        assert f"{{{{ source plugin/src/labpipe_example/{module}.py }}}}" in pages


def test_a_bearing_from_its_file_and_on_a_rotor(installed, project: Path) -> None:
    """By hand at 30 % and 100 Hz: c = 24.43 kN s/m (page). On the rotor, 50 Hz: pi mu R (L / c)^3 / (2 (1 -
    e^2)^1.5), and k.
    """
    assert "2.443e+04" in installed("bearing", f"{EXAMPLE}/damper.yaml")
    damper = labpipe.rotor(project / EXAMPLE / "damped-rotor.yaml").supports()[0]
    film = 0.01 * 0.025 * (0.01 / 1e-4) ** 3
    assert damper.damping[1, 1] == pytest.approx(np.pi * film / 2 / (1 - 0.16) ** 1.5, rel=1e-6)
    assert damper.stiffness[0, 0] == pytest.approx(
        2 * film * 2 * np.pi * 50 * 0.4 / (1 - 0.16) ** 2, rel=1e-6
    )
    wrong = installed(
        "run", f"{EXAMPLE}/damped-unbalance.yaml", "-o", "out/no", "--set", "unbalance.bearing=front", code=2
    )
    assert "needs an oil film, bearing 'front' is a squeeze-film-damper" in wrong


def test_the_rotor_with_the_damper_is_run_and_drawn(installed, project: Path) -> None:
    installed(
        "run", f"{EXAMPLE}/damped-unbalance.yaml", "-o", "out/rotor", "--set", "report.formats=[html,md]"
    )
    cases = {
        case["name"]: case
        for case in json.loads((project / "out/rotor/identification.json").read_text())["unbalance"]["cases"]
    }
    assert max(cases["worn"]["backward"]) > 3 * max(cases["healthy"]["backward"])
    assert "Drawing of the rotor" in (project / "out/rotor/report.html").read_text(encoding="utf-8")


def test_an_entry_that_follows_from_the_rotor_is_refused(installed, project: Path) -> None:
    text = (project / EXAMPLE / "damped-rotor.yaml").read_text(encoding="utf-8")
    (project / EXAMPLE / "stated.yaml").write_text(
        text.replace("eccentricity: 40 %", "frequency: 50 Hz"), encoding="utf-8"
    )
    printed = installed(
        "run",
        f"{EXAMPLE}/damped-unbalance.yaml",
        "-o",
        "out/no",
        "--set",
        "unbalance.rotor=stated.yaml",
        code=2,
    )
    assert "bearings.1.frequency: follows from the rotor" in printed


@pytest.mark.long
def test_simulate_and_study_know_the_virtual_rig(installed, project: Path) -> None:
    installed("simulate", f"{EXAMPLE}/virtual-sdof.yaml", "-o", "out/rig")
    assert json.loads((project / "out/rig/truth.json").read_text())["truth"]["k"] == 134.5e3
    assert (project / "out/rig/multisine.csv").read_text().startswith('"t [s]","force [N]","y [um]"')
    assert "no run 'sine'; did you mean 'multisine'?" in installed(
        "simulate", f"{EXAMPLE}/virtual-sdof.yaml", "-o", "out/no", "--run", "sine", code=2
    )
    installed(
        "study", f"{EXAMPLE}/sdof-study.yaml", "-o", "out/study", "-j", "1", "--set", "study.repeats=100"
    )
    (study,) = json.loads((project / "out/study/identification.json").read_text())["studies"]
    by_noise = {case["noise"]: {one["name"]: one for one in case["parameters"]} for case in study["cases"]}
    assert by_noise[0.5]["k"]["truth"] == 134.5e3
    # The noise is four times as large, and with it the scatter; 100 repeats know either to 7 %.
    assert by_noise[2.0]["k"]["rmse"] / by_noise[0.5]["k"]["rmse"] == pytest.approx(4.0, rel=0.15)
    # 95 % of 100 intervals, within four standard deviations of a binomial.
    assert all(case["k"]["coverage"] > 0.86 for case in by_noise.values())


def test_the_method_finds_the_factor_that_the_run_up_was_made_with(
    installed, project: Path, run_up_table: Path
) -> None:
    installed("run", f"{EXAMPLE}/damped-run-up.yaml", "-o", "out/factor", "--set", "report.formats=[html,md]")
    result = json.loads((project / "out/factor/identification.json").read_text())["run_ups"]
    (method,) = [method for method in result["methods"] if method["name"] == "common-factor"]
    (factor,) = method["parameters"]
    assert abs(factor["value"] - 1.2) < 4 * factor["std_error"] < 0.02
    for name in ("report.html", "report.md"):
        assert "common factor" in (project / "out/factor" / name).read_text(encoding="utf-8")
    assert "run_ups.common-factor  factor" in installed("list", "out/factor", "-p", "factor")


@pytest.mark.long
def test_metamodels_are_made_of_the_method(of_own_process, project: Path, run_up_table: Path) -> None:
    """Three loads under one damper: the surface over load and speed is that of 1.2 times the file's
    coefficients.
    """
    table = run_up_table.read_text(encoding="utf-8")
    for load in (20, 60):
        (project / EXAMPLE / f"damper-{load}.csv").write_text(
            table.replace("# load: 40 N", f"# load: {load} N"), encoding="utf-8"
        )
    runs = "[{file: damper.csv}, {file: damper-20.csv}, {file: damper-60.csv}]"
    options = (
        "methods=[common-factor]",
        f"runs={runs}",
        "metamodels=[response-surface]",
        "metamodels_of=common-factor",
    )
    changed = [word for option in options for word in ("--set", f"run_ups.{option}")]
    of_own_process(
        "labpipe",
        "run",
        f"{EXAMPLE}/damped-run-up.yaml",
        "-o",
        "out/surface",
        *changed,
        "--set",
        "report.formats=[]",
    )
    (model,) = json.loads((project / "out/surface/identification.json").read_text())["run_ups"]["metamodels"]
    film = 0.01 * 0.025 * (0.006 / 1e-4) ** 3
    np.testing.assert_allclose(model["surface"]["values"][4], 1.2 * np.pi * film / 2 / 0.91**1.5, rtol=0.02)


def test_the_section_is_run_reported_listed_and_read_again(installed, project: Path) -> None:
    first = installed(
        "run", f"{EXAMPLE}/margins.yaml", "-o", "out/margins", "--set", "report.formats=[html,md]"
    )
    assert "separation.pedestal.f_n.2x >= 16 %: passed (found 17.9129 %)" in first
    margins = json.loads((project / "out/margins/identification.json").read_text())["separation"]["margins"]
    # By hand: 65.6697 Hz against 50 and 80 Hz.
    assert [margin["margin"] for margin in margins] == pytest.approx(
        [65.6697 / 50 - 1, 1 - 65.6697 / 80], abs=1e-5
    )
    for name in ("report.html", "report.md"):
        text = (project / "out/margins" / name).read_text(encoding="utf-8")
        assert "Separation margins" in text and "All separation margins are kept." in text
    listed = installed("list", "out/margins", "-p", "margin_2x")
    assert "separation.pedestal" in listed and "0.179129" in listed
    before = (project / "out/margins/identification.json").stat().st_mtime_ns
    installed("run", f"{EXAMPLE}/margins.yaml", "-o", "out/margins", "--set", "report.formats=[html,md]")
    assert (project / "out/margins/identification.json").stat().st_mtime_ns == before


def test_rules_on_the_section_decide_on_the_exit_code(installed) -> None:
    def run(expect: str, code: int, *more: str) -> str:
        words = ("-o", "out/rules", "--set", f"expect={{{expect}}}", "--set", "report.formats=[]", *more)
        return installed("run", f"{EXAMPLE}/margins.yaml", *words, code=code)

    assert "FAILED (found 17.9129 %)" in run('separation.least: ">= 20 %"', 1)
    assert "separation.kept false: FAILED (found true)" in run("separation.kept: false", 1)
    assert "no such margin; did you mean 'pedestal.f_n.2x'?" in run(
        'separation.pedestal.f_n.3x: ">= 20 %"', 2
    )
    missed = run("separation.kept: false", 0, "--set", "separation.speeds=60-70 Hz")
    assert "warning separation: pedestal.f_n.1x: 0.0 % where 16.0 % are required." in missed
    assert "no fit gives a natural frequency" in run("", 2, "--set", "identify={}")


def test_the_schema_knows_the_additions(of_own_process) -> None:
    """In a process of its own: choices of settings are looked up once."""
    schema = json.loads(of_own_process("labpipe", "schema", "pipeline"))["properties"]
    assert set(schema["separation"]["properties"]) == {"speeds", "orders"} and schema["separation"][
        "required"
    ] == ["speeds"]
    assert "common-factor" in schema["run_ups"]["properties"]["metamodels_of"]["enum"]
    assert "robust" in schema["identify"]["additionalProperties"]["properties"]["estimator"]["enum"]


def test_faults_of_the_section_have_their_place(installed) -> None:
    wrong = installed("run", f"{EXAMPLE}/margins.yaml", "-o", "out/no", "--set", "separation.order=2", code=2)
    assert "separation.order: unknown key; did you mean 'orders'?" in wrong
    impossible = installed(
        "run", f"{EXAMPLE}/margins.yaml", "-o", "out/no", "--set", "separation.speeds=0-50 Hz", code=2
    )
    assert f"{EXAMPLE}/margins.yaml:7:1: separation: 'speeds' must rise from above zero" in impossible


def test_without_the_plugin_its_section_is_unknown_and_its_result_still_reads(
    project: Path, monkeypatch: pytest.MonkeyPatch, labpipe
) -> None:
    monkeypatch.chdir(project)
    with with_plugin(project):
        left = labpipe("run", f"{EXAMPLE}/margins.yaml", "-o", "out/left", "--set", "report.formats=[]")
    assert left.code == 0
    refused = labpipe("run", f"{EXAMPLE}/margins.yaml", "-o", "out/no")
    assert refused.code == 2 and "separation: unknown key" in refused.err
    assert "pedestal" in labpipe("list", "out/left", "-p", "k").out
