"""The dask cluster: ours, begun and ended with a run, or a given one; and how much of it is asked at a time.

Ours listens on loopback only, keeps its temporary files in the run's folder, and is gone within seconds whatever ends
the run: nobody waits for tasks whose results are of no use any more.
"""

from __future__ import annotations

import logging
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path

import dask
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.system import MEMORY_LIMIT

from blocksar.errors import InputError, ProcessingError
from blocksar.focusing import correction
from blocksar.focusing.correction import compile_kernels
from blocksar.graph.admission import NO_WORKER
from blocksar.progress import Listener
from blocksar.version import __version__

WORKER_TTL = 60.0  # seconds: a worker of ours that has not been heard of for so long is lost
CONNECT = 20.0  # seconds for a given scheduler to answer
SETTINGS = {"distributed.admin.low-level-log-length": 10}  # else what was sent to workers is kept, 1000 times
REPORT = 60.0  # seconds for a performance report to be made
GRACE = 5.0  # likewise, where a run was interrupted


def machine() -> tuple[int, int]:
    """Cores and bytes of memory that this process may use, control groups respected."""
    return int(CPU_COUNT), int(MEMORY_LIMIT)


def cluster_size(client: Client) -> tuple[int, int]:
    """Workers of a cluster, and the smallest memory limit among them, bytes.

    Raises
    ------
    InputError
        If it has no worker.
    """
    with suppress(TimeoutError):
        client.wait_for_workers(1, timeout=CONNECT)  # the only one may just be starting again
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        raise InputError("the dask scheduler has no worker; start some")
    return len(workers), min(int(w["memory_limit"]) or machine()[1] for w in workers.values())


@contextmanager
def open_client(
    *,
    scheduler: str | None = None,
    client: Client | None = None,
    workers: int = 1,
    threads: int = 1,
    memory_limit: int | None = None,
    scratch: str | None = None,
    report: Listener | None = None,
) -> Iterator[Client]:
    """The client given, a client of the scheduler given, or of a cluster of our own on loopback that ends with it.

    `scratch` is a folder for the workers' temporary files, of our own cluster; by default one that goes with it.
    `report` is told how far the start of our own has come.

    Raises
    ------
    InputError
        If no scheduler answers, or its workers do not have the same blocksar.
    """
    if client is not None:
        yield client
        return
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(SETTINGS))
        stack.enter_context(_silent())
        if scheduler is not None:
            connected = stack.enter_context(_connected(scheduler))
            _check_versions(connected, scheduler)
            yield connected
            return
        if scratch is None:
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="blocksar-", ignore_cleanup_errors=True))
        yield stack.enter_context(_own(workers, threads, memory_limit, scratch, report or Listener()))


def _connected(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout=CONNECT)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"no dask scheduler answers at {scheduler} ({cause}); check --scheduler") from None


@contextmanager
def _silent() -> Iterator[None]:
    """Not a word of dask's: what a run ends with says it in one sentence."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _check_versions(client: Client, scheduler: str) -> None:
    """Tasks travel by name: what is behind the names must be the same here and there."""
    try:
        found = client.run(_version)
    except Exception as error:
        raise InputError(
            f"the workers of {scheduler} cannot run blocksar ({' '.join(str(error).split())}); "
            f"install blocksar {__version__} there"
        ) from error
    for worker, version in found.items():
        if version != __version__:
            raise InputError(f"the worker {worker} has blocksar {version}, but here is {__version__}; install the same")


def _version() -> str:
    return __version__


@contextmanager
def _own(workers: int, threads: int, memory_limit: int | None, scratch: str, report: Listener) -> Iterator[Client]:
    report.update("compile", 0, 1)
    # Compiling takes a worker more memory than a block may: done here, once, the workers load from the cache.
    compile_kernels()
    report.update("compile", 1, 1)
    report.update("start-workers", 0, workers)
    settings = {
        # The plan keeps to the limit; spilling would only hide that it did not.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": 0.9,
        "distributed.worker.memory.terminate": 0.98,
        "distributed.scheduler.work-stealing": False,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.scheduler.worker-ttl": WORKER_TTL,
        # So long after a loss, a worker that is just starting again would be given up for good.
        "distributed.deploy.lost-worker-timeout": "1h",
        "temporary-directory": scratch,
        "distributed.nanny.pre-spawn-environ.NUMBA_NUM_THREADS": threads,
        # Blocks go back to the system at once; groups of rows and chunks stay in malloc's keeping, and in the cache.
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 24 * 2**20,
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 64 * 2**20,
    }
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        with _signals_later():  # an interrupted start leaves a cluster that nobody can close
            cluster = LocalCluster(
                n_workers=0,
                threads_per_worker=1,
                processes=True,
                memory_limit=memory_limit or "auto",
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",  # any free port, loopback only; needs bokeh to show more than metrics
                silence_logs=logging.CRITICAL,
            )
            stack.enter_context(cluster)
            cluster.sync(_deaf_to_interrupts)
            cluster.scale(workers)
            client = stack.enter_context(Client(cluster))
        try:
            client.wait_for_workers(workers, timeout=NO_WORKER)
        except TimeoutError:
            raise ProcessingError(
                f"{workers} workers did not start within {NO_WORKER:.0f} s; in a script, call focus below "
                '`if __name__ == "__main__":`, as workers import the script again'
            ) from None
        report.update("start-workers", workers, workers)
        try:
            yield client
        except BaseException:
            # Else closing waits for tasks whose results are of no use any more.
            _kill_workers(cluster)
            raise


def compiled() -> bool:
    """Whether compiled kernels are in numba's cache, as far as a look at its folder tells."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    name = f"{Path(correction.__file__).stem}.*.nbi"
    found = Path(folder).rglob(name) if folder else Path(correction.__file__).parent.glob(f"__pycache__/{name}")
    return next(found, None) is not None


async def _deaf_to_interrupts() -> None:
    """Ctrl-C in a terminal goes to all processes of a command: workers, which inherit this, leave it to the first."""
    resource_tracker.ensure_running()  # else the first process that is started starts it, which undoes this
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextmanager
def _signals_later() -> Iterator[None]:
    """Keep Ctrl-C and SIGTERM until the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # others do not get any
        yield
        return
    came: list[int] = []
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    caught = {each: handler for each, handler in before.items() if callable(handler)}
    for each in caught:
        signal.signal(each, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for each, handler in caught.items():
            signal.signal(each, handler)
    if came:
        signal.raise_signal(came[0])


def _kill_workers(cluster: LocalCluster) -> None:
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
