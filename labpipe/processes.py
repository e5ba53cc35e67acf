"""Processes of labpipe's own: workers that end with the process that started them, how many a command may
start, and a second thread for arithmetic.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing.connection import wait
from typing import TypeVar

T = TypeVar("T")

# Processes that one piece of work, such as a report, may be shared out to.
SHARED_OUT: ContextVar[int] = ContextVar("processes", default=1)


@contextmanager
def use_processes(processes: int) -> Iterator[None]:
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


def threads() -> int:
    """Threads for the arithmetic of this process: two; one in a worker, and where there is one processor."""
    return 1 if multiprocessing.parent_process() else min(2, os.cpu_count() or 1)


def by_turns(work: Callable[[Sequence[T], int], None], parts: Sequence[T], n_thread: int) -> None:
    """Do *work* on every *n_thread*-th of the *parts* in a thread of its own, by its number from 0.

    Threads end with the work, since other code forks. Results must not depend on the order.
    """
    if n_thread == 1 or len(parts) < n_thread:
        work(parts, 0)
        return
    with ThreadPoolExecutor(n_thread - 1, thread_name_prefix="arithmetic") as pool:
        others = [pool.submit(work, parts[number::n_thread], number) for number in range(1, n_thread)]
        work(parts[::n_thread], 0)
    for other in others:
        other.result()


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
