"""Workers end with the process that started them; work is shared with a second thread."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from labpipe.processes import in_threads

PARENT = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from labpipe.processes import end_with_parent

if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"), initializer=end_with_parent)
    print(pool.submit(os.getpid).result(), flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process is killed by a signal")
def test_a_worker_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(PARENT)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    end = time.monotonic() + 10
    while time.monotonic() < end and _alive(worker):
        time.sleep(0.02)
    assert not _alive(worker)


@pytest.mark.parametrize("processors", [1, 2])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_every_part_is_done_once_and_half_by_the_second_thread_where_there_is_a_processor_for_it(
    monkeypatch: pytest.MonkeyPatch, processors: int, count: int
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    done: dict[int, list[int]] = {}
    in_threads(lambda parts: done.setdefault(threading.get_ident(), []).extend(parts), range(count))
    assert sorted(part for parts in done.values() for part in parts) == list(range(count))
    here = done[threading.get_ident()]
    assert here == list(range(0, count, 2) if processors == 2 and count > 1 else range(count))


@pytest.mark.parametrize("bad", [0, 1])
def test_an_error_of_either_thread_is_raised(monkeypatch: pytest.MonkeyPatch, bad: int) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda parts: operator.floordiv(1, min(abs(part - bad) for part in parts)), range(4))


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
        # One that has ended and that nobody has waited for still has its number.
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
