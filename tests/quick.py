"""Short answers: on the whole house in under a minute on two cores, and on one folder of tests in under 20 s.

    python -m tests.quick [options of pytest]          the tests that reach the most code for their time
    python -m tests.quick FOLDER [options of pytest]   the tests of a folder but the slow ones
    python -m tests.quick --record                     run all tests, note time and lines of each, choose anew

The choice is tests/quick.txt, one test a line below its file. A line of the package that a second and a third
test reach counts half and a quarter of what it counts for the first: a test that reaches a line need not look
at what it does. The slow ones are tests/slow.txt, one function a line below its file.
"""

from __future__ import annotations

import heapq
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = str(ROOT / "labpipe") + os.sep
SELECTION, SLOW = (Path(__file__).with_name(name) for name in ("quick.txt", "slow.txt"))
# Where the workers of a recording write, and whether only the selection is run; set by the process that
# starts them.
NOTES, SELECTED = "LABPIPE_TEST_NOTES", "LABPIPE_TEST_SELECTION"
# Seconds of the processor for the selection, as noted: the notes cost time too, and two processes share it
# after ten seconds of beginning.
SECONDS = 50.0
# One case of every other test that takes no longer [s] is chosen besides: it looks at what it reaches.
CHEAP = 0.03
# A test is slow beyond so many seconds of the processor, in the mean of its cases; in a large folder sooner.
SLOW_SECONDS = 0.25
LARGE_FOLDERS = {"tests/project/": 0.1}
# A function's lines are noted for its first calls in a test: those in the inner loops of a fit come by the
# hundred thousand.
CALLS = 4
# Another test of a line adds this much of what the last one added; the fourth adds nothing.
AGAIN, READERS = 0.5, 3
# Tests of the house, and not of its code; ratios of speed; a browser.
LEFT_OUT = (
    "tests/benchmarks/",
    "tests/browser/",
    "tests/docs/",
    "tests/packaging/",
    "tests/machine/",
    "tests/draws/",
)


@dataclass(frozen=True)
class Noted:
    """A test with its time [s] and the lines of the package that it reaches."""

    name: str
    seconds: float
    lines: frozenset[str]


def chosen(tests: Iterable[Noted], seconds: float = SECONDS) -> list[str]:
    """The names of the tests that together reach the most in that time: the next one is that which adds most
    for its time. Of every other function the cheapest case, where it is CHEAP.
    """
    tests = list(tests)
    read: Counter[str] = Counter()

    def worth(test: Noted) -> float:
        return sum(AGAIN ** read[line] for line in test.lines if read[line] < READERS) / max(
            test.seconds, 0.01
        )

    # What a test adds only falls while others are taken: a worth that is still the largest when counted anew
    # is the largest of all.
    waiting = [(-worth(test), test.name, test) for test in tests]
    heapq.heapify(waiting)
    taken, left = [], seconds
    while waiting:
        _, name, test = heapq.heappop(waiting)
        now = worth(test)
        if not now or test.seconds > left:
            continue
        if waiting and now < -waiting[0][0]:
            heapq.heappush(waiting, (-now, name, test))
            continue
        taken.append(name)
        left -= test.seconds
        read.update(test.lines)
    functions = {name.partition("[")[0] for name in taken}
    for test in sorted(tests, key=lambda test: test.seconds):
        function = test.name.partition("[")[0]
        if test.seconds <= CHEAP and function not in functions:
            functions.add(function)
            taken.append(test.name)
    return sorted(taken)


def processor() -> float:
    """Seconds of the processor that this process and those it waited for have taken: the same on a busy
    machine.
    """
    return sum(os.times()[:4])


class Recorder:
    """A plug-in of pytest that notes the time and the lines of every test that passes."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / f"{os.environ.get('PYTEST_XDIST_WORKER', 'alone')}.jsonl"
        self.failed = False
        self.calls: dict[int, int] = {}
        self.lines: set[tuple[str, int]] = set()

    def _call(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        code = frame.f_code
        calls = self.calls.get(id(code), 0 if code.co_filename.startswith(PACKAGE) else CALLS)
        self.calls[id(code)] = calls + 1
        return self._line if calls < CALLS else None

    def _line(self, frame: FrameType, event: str, _argument: Any) -> Any:
        if event == "line":
            self.lines.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        self.failed, self.calls, self.lines = False, {}, set()
        began = processor()
        sys.settrace(self._call)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            if not self.failed:
                lines = sorted(f"{name.removeprefix(PACKAGE)}:{line}" for name, line in self.lines)
                note = {"name": item.nodeid, "seconds": processor() - began, "lines": lines}
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(note) + "\n")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed = self.failed or not report.passed


def pytest_configure(config: pytest.Config) -> None:
    """As a plug-in of a recording: in the processes that run tests, not in the one that shares them out."""
    if NOTES in os.environ and (
        "PYTEST_XDIST_WORKER" in os.environ or not config.getoption("numprocesses", None)
    ):
        config.pluginmanager.register(Recorder(Path(os.environ[NOTES])))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """As a plug-in of a run of the selection: a name that no test has any more ends nothing."""
    if SELECTED in os.environ:
        names = set(selected())
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in names])
        items[:] = [item for item in items if item.nodeid in names]


def recorded(arguments: Sequence[str]) -> dict[str, Noted]:
    """Tests by their names, as a run of pytest with these arguments notes them."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.quick", *arguments]
        subprocess.run(command, check=False, env={**os.environ, NOTES: folder})
        notes = [
            json.loads(line)
            for path in sorted(Path(folder).glob("*.jsonl"))
            for line in path.read_text("utf-8").splitlines()
        ]
    return {note["name"]: Noted(note["name"], note["seconds"], frozenset(note["lines"])) for note in notes}


def record() -> None:
    """Write the selection. Shared fixtures make a test slower without its neighbours: the selection is
    measured itself, and made again.
    """
    tests = recorded([f"--ignore={ROOT / folder}" for folder in LEFT_OUT])
    names = chosen(tests.values())
    for _ in range(2):
        alone = recorded(names)
        tests |= {
            name: Noted(name, max(one.seconds, tests[name].seconds), one.lines) for name, one in alone.items()
        }
        names = chosen(tests.values())
    write_names(SELECTION, names)
    write_names(SLOW, slow(tests.values()))


def slow(tests: Iterable[Noted]) -> list[str]:
    """Functions whose cases take more than SLOW_SECONDS in the mean, or what is said of their folder."""

    def limit(name: str) -> float:
        return next((s for folder, s in LARGE_FOLDERS.items() if name.startswith(folder)), SLOW_SECONDS)

    seconds: dict[str, list[float]] = {}
    for test in tests:
        seconds.setdefault(test.name.partition("[")[0], []).append(test.seconds)
    return sorted(name for name, taken in seconds.items() if sum(taken) > limit(name) * len(taken))


def write_names(path: Path, names: Iterable[str]) -> None:
    """Names of tests below those of their files."""
    lines: list[str] = []
    for file, of_file in itertools.groupby(sorted(names), lambda name: name.partition("::")[0]):
        lines += [file, *(" " + name.partition("::")[2] for name in of_file)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_names(path: Path) -> Iterator[str]:
    """The whole names that `write_names` wrote."""
    file = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith(" "):
            yield f"{file}::{line[1:]}"
        else:
            file = line


def selected() -> list[str]:
    """The recorded names."""
    return list(read_names(SELECTION))


def without_slow() -> list[str]:
    """Options of pytest that leave out the slow tests."""
    return [f"--deselect={name}" for name in read_names(SLOW)]


def main() -> int:
    os.chdir(ROOT)
    if "--record" in sys.argv:
        record()
        return 0
    if any(Path(argument).is_dir() for argument in sys.argv[1:]):
        return int(pytest.main([*sys.argv[1:], *without_slow()]))
    os.environ[SELECTED] = "1"
    files = sorted({name.partition("::")[0] for name in selected()})
    return int(pytest.main([*sys.argv[1:], "-p", "tests.quick", *filter(os.path.exists, files)]))


if __name__ == "__main__":
    sys.exit(main())
