"""What is built from the checkout and installed elsewhere: the wheel, the source distribution, and the
command that they bring.

Built by the hooks of PEP 517 in a copy of the checkout, without a network; the environment that the wheel is
installed in takes numpy and the others from that of the tests.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from labpipe import __version__
from tests.packaging.test_dockerfile import BUILD, copied

pytestmark = pytest.mark.long
ROOT = Path(__file__).parents[2]
# What a checkout holds beside what is committed, and what no build looks at.
ASIDE = (
    ".git",
    ".venv*",
    "*.egg-info",
    "build",
    "out",
    "__pycache__",
    ".*_cache",
    ".hypothesis",
    "docs",
    "tests",
)


def hook(name: str, source: Path, target: Path) -> Path:
    """What a hook of the build backend makes of a folder with sources."""
    target.mkdir()
    code = f"from setuptools import build_meta; print(build_meta.{name}({str(target)!r}))"
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=source, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return target / ended.stdout.strip().splitlines()[-1]


def files(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(
        ROOT, tmp_path_factory.mktemp("source") / "labpipe", ignore=shutil.ignore_patterns(*ASIDE)
    )


@pytest.fixture(scope="module")
def sdist(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hook("build_sdist", checkout, tmp_path_factory.mktemp("sdist") / "dist")


@pytest.fixture(scope="module")
def wheel(checkout: Path, sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built after the source distribution, which must not find what this build leaves."""
    return hook("build_wheel", checkout, tmp_path_factory.mktemp("wheel") / "dist")


def test_the_wheel_holds_every_module_and_every_example(wheel: Path) -> None:
    held = set(files(wheel))
    package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "labpipe").rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert package <= held
    (data,) = {name.split("/")[0] for name in held if ".data/" in name}
    examples = {
        f"{data}/data/share/labpipe/{path.relative_to(ROOT).as_posix()}"
        for folder in ("pipelines", "configs", "sample_data")
        for path in (ROOT / folder).rglob("*")
        if path.is_file()
    }
    info = {name for name in held if ".dist-info/" in name}
    # And nothing else: no tests, no pages, no rubbish.
    assert held == package | examples | info


def test_the_source_distribution_builds_the_same_wheel(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    again = files(hook("build_wheel", source, tmp_path / "dist"))
    assert again == files(wheel)
    assert (source / "README.md").is_file() and (source / "pyproject.toml").is_file()


def test_what_the_dockerfile_copies_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    for name in copied(BUILD):
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, tmp_path / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (tmp_path / "source").mkdir(exist_ok=True)
            shutil.copy(path, tmp_path / "source")
    assert files(hook("build_wheel", tmp_path / "source", tmp_path / "dist")) == files(wheel)


def test_the_wheel_runs_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    """As `pipx install` does: an environment of its own.

    Then the version, an example, and its first pipeline.
    """
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin/python"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "--quiet",
        "--disable-pip-version-check",
        "install",
        "--no-compile",
        "--no-deps",
        "--no-index",
    ]
    subprocess.run([*pip, wheel], check=True)
    # After the wheel: pip must not take the labpipe of the tests for an earlier one.
    (site,) = environment.glob("lib/python3*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    # Compiled modules of the libraries are not compiled again where they are kept apart.
    kept = "PYTHONPYCACHEPREFIX"
    variables = {
        name: value for name, value in os.environ.items() if name == kept or not name.startswith("PYTHON")
    }

    def labpipe(*arguments: str) -> str:
        command = [environment / "bin/labpipe", *arguments]
        ended = subprocess.run(
            command, cwd=tmp_path, env=variables, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    # Of a wheel no commit is known; a labpipe of the checkout would name one.
    assert labpipe("--version") == f"labpipe, version {__version__}\n"
    assert "pedestal.yaml" in labpipe("init", "bench", "--example", "hmb")
    printed = labpipe("run", "bench/pipelines/pedestal.yaml", "-o", "out")
    assert "passed" in printed and "FAILED" not in printed
    assert (tmp_path / "out/report.html").stat().st_size > 20_000
    assert "all is well" in labpipe("doctor")
