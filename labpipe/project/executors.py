"""Where the jobs of many tests run: one after the other, in processes of this machine, or on a Dask cluster.
Tests go out in batches, a bounded number at a time: a scheduler spends about a millisecond on a task, however
short that is, and keeps each until its outcome is taken.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.header import code_digest
from labpipe.errors import ConfigError, DataError
from labpipe.processes import end_with_parent
from labpipe.project.marked_yaml import load_marked
from labpipe.project.one_test import Done, Job
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
            for done in _pool(work, tuple(open_jobs.values()), count):
                del open_jobs[done.test]
                yield done
        # The pool does not report which job ended its process: every open job runs in a separate process.
        for job in tuple(open_jobs.values()):
            for done in _pool(work, (job,), 1):
                del open_jobs[done.test]
                yield done
        for name in open_jobs:
            why = "its process was killed, perhaps for lack of memory; use fewer processes"
            yield Done(name, failed=Failed(name, why))

    return execute


def _pool(work: Work, jobs: Sequence[Job], count: int) -> Iterator[Done]:
    others = multiprocessing.active_children()
    # Fresh interpreters: forking a process that has threads is not safe.
    if not jobs:
        return
    pool = ProcessPoolExecutor(
        min(count, len(jobs)), mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker
    )
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


CONNECT_SECONDS = 10
LOST = "Timed out trying to connect"
# Batch systems start workers when there is room for them.
START_SECONDS = 3600
# Between two looks at whether there still are some.
LOOK_SECONDS = 20
LOCAL = "local"
# Tests in a batch, so that each worker has several batches; batches that a scheduler has at a time.
MOST_IN_BATCH, BATCHES_PER_WORKER, MOST_BATCHES = 50, 4, 400
FILE_KEYS = ("class", "arguments", "adapt", "scale")


def on_cluster(address: str) -> Execute:
    """On the workers of a Dask scheduler, e.g. tcp://10.0.0.1:8786; "local": processes of this machine;
    FILE.yaml: a cluster to start. They must see the same files under the same paths.
    """

    def execute(work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        distributed = _distribute()
        # Loaded with the cluster's package, and by no run without it.
        from asyncio import CancelledError

        try:
            with _client(distributed, address) as client:
                yield from _run_in_batches(distributed, client, work, [job.absolute() for job in jobs])
        except (distributed.CancelledError, CancelledError, OSError) as error:
            # Dask's own errors of a connection; those of files have a number.
            of_connection = isinstance(error, distributed.comm.core.CommClosedError) or LOST in str(error)
            if isinstance(error, OSError) and not of_connection:
                raise
            hint = "what is finished is kept; the same command goes on from there when a scheduler runs"
            raise DataError("the scheduler was lost", address, hint) from None

    return execute


def _run_in_batches(distributed: Any, client: Any, work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
    """Outcomes as they come. Tests of a batch whose workers were all ended are tried alone."""
    size = batch_size(len(jobs), len(client.nthreads()))
    waiting = [jobs[start : start + size] for start in range(0, len(jobs), size)][::-1]
    batches: dict[Any, Sequence[Job]] = {}

    def wait_for_end(seconds: float) -> Any:
        with client.as_current():
            return distributed.wait(list(batches), timeout=seconds, return_when="FIRST_COMPLETED").done

    while waiting or batches:
        while waiting and len(batches) < MOST_BATCHES:
            batch = waiting.pop()
            batches[client.submit(work_on, work, batch, pure=False, retries=ATTEMPTS - 1)] = batch
        for future in patiently(client, wait_for_end):
            # A worker that is ended now takes its outcome with it, which is then worked out again.
            error = patiently(client, future.exception)
            batch = batches.pop(future)
            if not isinstance(error, distributed.scheduler.KilledWorker):
                yield from patiently(client, future.result)
            elif len(batch) > 1:
                waiting.extend([job] for job in batch)
            else:
                name = batch[0].test.name
                yield Done(name, failed=Failed(name, "every worker that tried it was ended from outside"))
            future.release()


def patiently(client: Any, ask: Callable[[float], Any]) -> Any:
    """What is asked for again and again as long as there are workers; DataError after an hour without any."""
    since = time.monotonic()
    while True:
        try:
            return ask(LOOK_SECONDS)
        except TimeoutError:
            if client.nthreads():
                since = time.monotonic()
            elif time.monotonic() - since > START_SECONDS:
                hint = "what is finished is kept; the same command goes on from there when there are some"
                raise DataError("the scheduler has no workers any more", hint=hint) from None


def batch_size(n_job: int, n_worker: int) -> int:
    """Tests in a batch: one while there are few, more when each worker has several batches all the same."""
    return max(1, min(MOST_IN_BATCH, n_job // (BATCHES_PER_WORKER * max(n_worker, 1))))


def work_on(work: Work, batch: Sequence[Job]) -> list[Done]:
    """The outcomes of a batch, on a worker."""
    return [work(job) for job in batch]


def _distribute() -> Any:
    try:
        import distributed
    except ImportError:
        hint = "pip install 'labpipe[cluster]'"
        raise ConfigError("--cluster: needs the package dask.distributed", hint=hint) from None
    # What goes wrong with a scheduler is said once, by this module.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


@contextmanager
def _client(distributed: Any, address: str) -> Iterator[Any]:
    patience = CONNECT_SECONDS
    with ExitStack() as started:
        if address == LOCAL:
            cluster = distributed.LocalCluster(
                host="127.0.0.1", dashboard_address="127.0.0.1:0", threads_per_worker=1, silence_logs=50
            )
            scheduler = started.enter_context(cluster).scheduler_address
        elif Path(address).suffix.lower() in (".yaml", ".yml"):
            scheduler = started.enter_context(_describe(Path(address))).scheduler_address
            patience = START_SECONDS
        else:
            scheduler = address
        client = _connect(distributed, scheduler, patience)
        started.callback(client.close)
        yield client


def _describe(path: Path) -> Any:
    """The cluster of a file: `class: dask_jobqueue.SLURMCluster`, its `arguments:`, `adapt:` or `scale:`."""
    entries = load_marked(path).plain()
    class_path = entries.get("class") if isinstance(entries, dict) else None
    if not isinstance(class_path, str) or "." not in class_path:
        hint = "begin with class: dask_jobqueue.SLURMCluster"
        raise ConfigError("is not the description of a cluster", path, hint)
    unknown = [key for key in entries if key not in FILE_KEYS]
    if unknown:
        raise ConfigError(f"unknown entry '{unknown[0]}'", path, f"known: {', '.join(FILE_KEYS)}")
    module, _, name = class_path.rpartition(".")
    try:
        make = getattr(import_module(module), name)
    except (ImportError, AttributeError):
        hint = f"pip install {module.split('.')[0]}"
        raise ConfigError(f"class: {class_path} is not installed", path, hint) from None
    try:
        cluster = make(**(entries.get("arguments") or {}))
        if "adapt" in entries:
            # The version of labpipe is asked of a first worker before there is work that would start one.
            cluster.adapt(**{"minimum": 1, **(entries["adapt"] or {})})
        if "scale" in entries:
            cluster.scale(int(entries["scale"]))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{class_path} does not take this ({error})", path) from None
    return cluster


def _connect(distributed: Any, address: str, patience: float) -> Any:
    try:
        how = {"timeout": CONNECT_SECONDS, "set_as_default": False, "security": security_of(address)}
        client = distributed.Client(address, **how)
    except (OSError, ValueError, TimeoutError) as error:
        hint = "start one with `dask scheduler` and workers with `dask worker`"
        raise DataError(f"no scheduler answers ({error})", address, hint) from None
    try:
        client.wait_for_workers(1, timeout=patience)
        versions = client.run(_version)
    except TimeoutError:
        client.close()
        hint = f"start some with `dask worker {address}`"
        raise DataError("the scheduler has no workers", address, hint) from None
    others = {worker: version for worker, version in versions.items() if version != _version()}
    if others:
        client.close()
        worker, (version, _) = next(iter(others.items()))
        build = "another build of " if version == __version__ else ""
        what = f"worker {worker} has {build}labpipe {version}, this is {__version__}"
        raise DataError(what, address, "install the same version")
    return client


def security_of(address: str) -> Any:
    """Dask's certificates for a tls:// *address*, None for another; ConfigError where none are named."""
    if not address.startswith("tls://"):
        return None
    security: Any = _distribute().Security()
    if not (security.tls_ca_file and security.tls_client_cert):
        hint = "name them in Dask's configuration: distributed.comm.tls.ca-file, .client.cert, .client.key"
        raise ConfigError(f"--cluster {address}: no certificates are configured", hint=hint)
    return security


def _version() -> tuple[str, str]:
    return __version__, code_digest()
