"""Where the jobs of many tests run: one after the other, or in processes of this machine; the results are the same."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from labpipe.pipeline.one_test import Done, Job
from labpipe.processes import end_with_parent
from labpipe.records.identification import Failed

Work = Callable[[Job], Done]
Execute = Callable[[Work, Sequence[Job]], Iterator[Done]]

# A job whose process was ended from outside is tried this often before it counts as failed.
ATTEMPTS = 3


def serially(work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
    """One after the other in this process."""
    return map(work, jobs)


def in_processes(count: int) -> Execute:
    """In *count* processes of this machine; jobs of a killed process are repeated."""

    def execute(work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        open_jobs = {job.test.name: job for job in jobs}
        for _ in range(ATTEMPTS - 1):
            for done in _pooled(work, tuple(open_jobs.values()), count):
                del open_jobs[done.test]
                yield done
        # The pool does not report which job ended its process: every open job runs in a separate process.
        for job in tuple(open_jobs.values()):
            for done in _pooled(work, (job,), 1):
                del open_jobs[done.test]
                yield done
        for name in open_jobs:
            yield Done(name, failed=Failed(name, "its process was killed, perhaps for lack of memory; use fewer processes"))

    return execute


def _pooled(work: Work, jobs: Sequence[Job], count: int) -> Iterator[Done]:
    """Outcomes of the jobs that finish before a process is killed."""
    others = multiprocessing.active_children()
    # Fresh interpreters: forking a process that has threads is not safe.
    if not jobs:
        return
    pool = ProcessPoolExecutor(min(count, len(jobs)), mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        for future in as_completed([pool.submit(work, job) for job in jobs]):
            if not isinstance(future.exception(), BrokenProcessPool):
                yield future.result()
    except BaseException:
        # Their unfinished files are in the run's scratch folder, which is removed at the end.
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Workers ignore SIGINT; the parent terminates them, or they end with it."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
