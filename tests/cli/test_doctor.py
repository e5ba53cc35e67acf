"""What an installation says of itself, and completion on the Tab key."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest


def test_a_sound_installation_is_well(labpipe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    ended = labpipe("doctor")
    assert ended.code == 0 and ended.out.endswith("all is well\n")
    assert re.search(rf"^numpy +{re.escape(importlib.metadata.version('numpy'))}$", ended.out, re.M)
    assert "OMP_NUM_THREADS=3" in ended.out


def test_a_missing_package_is_named_and_is_a_fault(labpipe, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.import_module

    def without(missing: str) -> None:
        def importing(name: str, package: str | None = None) -> object:
            if name == missing:
                raise ImportError(f"No module named '{name}'")
            return found(name, package)

        monkeypatch.setattr("importlib.import_module", importing)

    without("pyarrow")
    # The command itself is imported before anything is taken away.
    from labpipe.cli.help import doctor

    assert doctor.callback is not None and doctor.callback() == 2
    without("distributed")
    assert doctor.callback() == 0


def test_a_command_that_misses_a_package_names_it(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """As an uninstalled pypdf where a report is drawn: no fault of labpipe, exit code 2."""
    from labpipe.cli import main

    def missing(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("No module named 'pypdf.generic'", name="pypdf.generic")

    monkeypatch.setattr(main.group, "main", missing)
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 2
    assert "error: the package pypdf is not installed" in capsys.readouterr().err


def test_an_optional_package_says_what_is_missing_without_it(
    labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    ended = labpipe("doctor")
    assert ended.code == 0 and "--cluster: pip install 'labpipe[cluster]'" in ended.out


def test_labpipe_without_an_installation_says_so(labpipe, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(name: str) -> list[str]:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", unknown)
    ended = labpipe("doctor")
    assert ended.code == 2 and "pip install ." in ended.out and "1 fault(s) to correct" in ended.out


def test_every_module_of_the_dependencies_can_be_imported_by_its_name(root: Path) -> None:
    from labpipe.cli.help import MODULES

    for text in tomllib.loads((root / "pyproject.toml").read_text())["project"]["dependencies"]:
        name = re.match(r"[\w.-]+", text)[0]
        importlib.import_module(MODULES.get(name, name))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_printed_for_every_shell(labpipe, shell: str) -> None:
    ended = labpipe("completion", shell)
    assert ended.code == 0 and f"_LABPIPE_COMPLETE={shell}_complete" in ended.out


def test_the_tab_key_offers_commands_and_options() -> None:
    words, offered = "labpipe run --clus", "--cluster"
    environment = {
        **os.environ,
        "_LABPIPE_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(words.count(" ")),
    }
    script = "import sys; sys.argv[0] = 'labpipe'; from labpipe.cli.main import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    assert f"plain,{offered}" in ended.stdout.splitlines()


def test_an_unknown_shell_is_refused(labpipe) -> None:
    ended = labpipe("completion", "tcsh")
    assert ended.code == 2 and "tcsh" in ended.err


def test_a_package_that_fails_in_its_own_way_is_named(labpipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one built for another numpy does."""
    from labpipe.cli.help import doctor

    def importing(name: str) -> object:
        raise ValueError("numpy.dtype size changed")

    monkeypatch.setattr("importlib.import_module", importing)
    assert doctor.callback is not None and doctor.callback() == 2


def test_doctor_looks_at_the_packages_of_every_extra(root: Path) -> None:
    """But for those of the tests and pages, and what another extra holds."""
    from labpipe.cli.help import OPTIONAL

    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    texts = [text for extra in extras.keys() - {"docs", "test", "networks"} for text in extras[extra]]
    assert {re.match(r"[\w.-]+", text)[0] for text in texts} == set(OPTIONAL)
