"""Where the jobs of many tests run: one after the other, in processes of this machine, or on a cluster; the results are the same."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from labpipe import __version__
from labpipe.artefacts.code import code_digest
from labpipe.errors import ConfigError, DataError
from labpipe.pipeline.one_test import Done, Job
from labpipe.processes import end_with_parent
from labpipe.records.identification import Failed

Work = Callable[[Job], Done]
Execute = Callable[[Work, Sequence[Job]], Iterator[Done]]

# A job whose process was ended from outside is tried this often before it counts as failed.
ATTEMPTS = 3
CONNECT_SECONDS = 10


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


def on_cluster(address: str) -> Execute:
    """On the workers of a Dask scheduler, e.g. tcp://10.0.0.1:8786; they must see the same files under the same paths."""

    def execute(work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        distributed = _distributed()
        client = _connected(distributed, address)
        try:
            names = {}
            for job in jobs:
                names[client.submit(work, job.absolute(), pure=False, retries=ATTEMPTS - 1)] = job.test.name
            for future in distributed.as_completed(list(names), loop=client.loop):
                error = future.exception()
                if isinstance(error, distributed.scheduler.KilledWorker):
                    yield Done(names[future], failed=Failed(names[future], "every worker that tried it was ended from outside"))
                else:
                    yield future.result()
        finally:
            client.close()

    return execute


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ConfigError("--cluster: needs the package dask.distributed", hint="pip install 'labpipe[cluster]'") from None
    return distributed


def _connected(distributed: Any, address: str) -> Any:
    """A client of the scheduler whose workers have this version of labpipe."""
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False, security=_security(address))
    except (OSError, ValueError, TimeoutError) as error:
        hint = "start one with `dask scheduler` and workers with `dask worker`"
        raise DataError(f"no scheduler answers ({error})", where=address, hint=hint) from None
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        versions = client.run(_version)
    except TimeoutError:
        client.close()
        raise DataError("the scheduler has no workers", where=address, hint=f"start some with `dask worker {address}`") from None
    others = {worker: version for worker, version in versions.items() if version != _version()}
    if others:
        client.close()
        worker, (version, _) = next(iter(others.items()))
        build = "another build of " if version == __version__ else ""
        what = f"worker {worker} has {build}labpipe {version}, this is {__version__}"
        raise DataError(what, where=address, hint="install the same version")
    return client


def _security(address: str) -> Any:
    """The certificates that Dask's own configuration names, for an address tls://...; none for another one."""
    if not address.startswith("tls://"):
        return None
    security: Any = _distributed().Security()
    if not (security.tls_ca_file and security.tls_client_cert):
        hint = "name them in Dask's configuration: distributed.comm.tls.ca-file, .client.cert, .client.key"
        raise ConfigError(f"--cluster {address}: no certificates are configured", hint=hint)
    return security


def _version() -> tuple[str, str]:
    return __version__, code_digest()
