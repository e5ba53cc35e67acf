"""Processes and threads of labpipe's own: workers that end with the process that started them, and a second
thread."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import wait
from typing import TypeVar

Part = TypeVar("Part")


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


def in_threads(work: Callable[[Sequence[Part]], None], parts: Sequence[Part]) -> None:
    """Do *work* on all *parts*, half of them on a second thread where there is a processor for it; errors of
    either are raised.

    For work that numpy, scipy.fft or BLAS does, which let other threads run, and whose parts do not meet. A
    worker has one thread: other workers have the other processors.
    """
    if len(parts) < 2 or os.cpu_count() == 1 or multiprocessing.parent_process() is not None:
        work(parts)
        return
    with ThreadPoolExecutor(1, thread_name_prefix="second") as second:
        rest = second.submit(work, parts[1::2])
        work(parts[::2])
        rest.result()
