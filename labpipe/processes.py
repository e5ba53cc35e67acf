"""Processes of labpipe's own: workers that end with the process that started them, and how many a command may
start.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing.connection import wait

# Processes that one piece of work, such as a report, may be shared out to.
SHARED_OUT: ContextVar[int] = ContextVar("processes", default=1)


@contextmanager
def shared_out(processes: int) -> Iterator[None]:
    """Let work inside be shared out to so many *processes*; 0: as many as there are processors."""
    token = SHARED_OUT.set(processes or os.cpu_count() or 1)
    try:
        yield
    finally:
        SHARED_OUT.reset(token)


@contextmanager
def pool_of(processes: int) -> Iterator[ProcessPoolExecutor | None]:
    """So many worker processes; None for one, whose work is done here."""
    if processes == 1:
        yield None
        return
    # Fresh interpreters: forking a process that has threads is not safe.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=spawn, initializer=end_with_parent) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def end_with_parent() -> None:
    """Let this worker end when its parent does, also when that is killed: a worker waits for its next job for
    ever otherwise.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(
            target=_outlive_nobody, args=(parent.sentinel,), daemon=True, name="parent-watch"
        ).start()


def _outlive_nobody(sentinel: int) -> None:
    wait([sentinel])
    # Unfinished files are in staging folders, which the next run removes.
    os._exit(1)
