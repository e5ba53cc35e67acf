"""Workers end with the process that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from labpipe.processes import SHARED_OUT, by_turns, use_processes

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


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
        # One that has ended and that nobody has waited for still has its number.
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_work_is_shared_out_to_as_many_processes_as_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """None asked for: one for each processor, one where their number is not known; outside one."""
    for asked, processors, processes in ((3, 8, 3), (0, 8, 8), (0, None, 1)):
        monkeypatch.setattr(os, "cpu_count", lambda number=processors: number)
        with use_processes(asked):
            assert SHARED_OUT.get() == processes
        assert SHARED_OUT.get() == 1


def test_parts_are_done_once_each_and_what_fails_in_a_thread_is_heard() -> None:
    done: list[int] = []

    def work(parts: Sequence[int], thread: int) -> None:
        done.extend(1 // part for part in parts)

    for n_thread in (1, 2, 3):
        by_turns(work, range(1, 6), n_thread)
    assert sorted(done) == sorted(3 * [1, 0, 0, 0, 0])
    for bad in ([0, 1], [1, 0]):
        with pytest.raises(ZeroDivisionError):
            by_turns(work, bad, 2)
