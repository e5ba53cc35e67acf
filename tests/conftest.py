"""What the tests share: the repository's folders, and the command line run in this process."""

from __future__ import annotations

import atexit
import gc
import os
import sys

# Small matrices all the way: threads of the linear algebra would only compete with each other, and blur the
# ratios of the benchmarks.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

# Tests start many processes, each of which would compile labpipe anew where Python is asked to keep no
# compiled modules; and the assertions of every file of tests would be rewritten by each of pytest's own.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What tests write need not outlast a cut of power. As with fsync, what is not an open file is an error.
os.fsync = os.fstat  # type: ignore[assignment]

# Half a million objects that modules and collected tests are, and nothing of it garbage.
gc.disable()

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from labpipe.cli.main import run_command
from tests.agreement import held

ROOT = Path(__file__).parent.parent

# The same examples on every machine, no folder that two workers write to, and no limit of time on a machine
# that is busy.
hypothesis.settings.register_profile(
    "pinned", derandomize=True, database=None, deadline=None, max_examples=50
)
hypothesis.settings.load_profile("pinned")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Command = Callable[..., Ended]


@pytest.fixture
def command_line(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a labpipe command in this process; an unexpected exception fails the test with its traceback, and
    so does a result whose numbers contradict each other.
    """

    def run(*arguments: object) -> Ended:
        capsys.readouterr()
        code = run_command([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        if arguments[0] == "run" and "-o" in arguments and code in (0, 1):
            held(Path(str(arguments[arguments.index("-o") + 1])))
        return Ended(code, captured.out, captured.err)

    return run


@pytest.fixture
def labpipe(command_line: Command) -> Command:
    """A labpipe command as people type it."""
    return command_line


@pytest.fixture
def labpipe_without_report(command_line: Command) -> Command:
    """`labpipe run` without a report unless the test asks for one.

    Modules where hardly a test looks at a report take it for their own `labpipe`.
    """

    def run(*arguments: object) -> Ended:
        silent = ("--set", "report.formats=[]") if arguments[0] == "run" else ()
        return command_line(*arguments[:1], *silent, *arguments[1:])

    return run


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files without a long test, two in three, are not read where these alone are asked for."""
    if config.option.markexpr != "long" or collection_path.suffix != ".py":
        return None
    return "mark.long" not in collection_path.read_text(encoding="utf-8") or None


def pytest_collection_finish() -> None:
    """Thousands of collected tests are nothing that every later search for garbage need look at again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Libraries look at their objects once more when the interpreter ends: not sooner, since pytest collects
    garbage five times before.
    """
    atexit.register(gc.unfreeze)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Ratios of speed mean nothing while other tests run beside them."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    alone = pytest.mark.skip(reason="ratios of speed are measured alone: pytest -n 0 tests/benchmarks")
    for item in items:
        if "benchmarks" in item.path.parts:
            item.add_marker(alone)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures that commands write beside their numbers are empty: drawing takes the most time."""
    monkeypatch.setattr("labpipe.document.charts.svg_text", lambda canvas: "<svg/>")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers with a pinned seed."""
    return np.random.default_rng(20240917)


@pytest.fixture
def root() -> Path:
    return ROOT
