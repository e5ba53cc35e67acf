"""Processes of labpipe's own: workers that end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.connection import wait


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
