"""The dask cluster: a local one that starts and ends with a run, or a running one.

The local cluster listens on loopback only and keeps its temporary files in the run folder. It ends within seconds,
however the run ends: its workers are killed rather than waited for. They are forked from one process that has done all
imports (`multiprocessing`'s fork server), so that they start, and start again, at once.
"""

from __future__ import annotations

import ast
import logging
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import forkserver, resource_tracker
from multiprocessing.process import ORIGINAL_DIR  # type: ignore[attr-defined]
from multiprocessing.util import get_temp_dir
from pathlib import Path
from typing import Any

import dask
import distributed.utils
from distributed import Client, LocalCluster, get_worker

from blocksar.budget import WAIT_WORKERS
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.compiling import TASKS, By, compile_missing, kernels_cached
from blocksar.graph.machine import machine, why_no_workers
from blocksar.graph.recording import serve_dashboard
from blocksar.graph.units import GPU, NO_WORKER, ThisProcess, await_workers, waiting_for_workers, workers_of
from blocksar.progress import Listener
from blocksar.version import __version__

WORKER_TTL = 60.0  # s without a message from a worker of the local cluster before it counts as lost
HUNG = 8.0  # s after which a worker that has been given up, but lives, is killed
CONNECT = 20.0  # s for a running scheduler to answer
ANSWER = 5.0  # s for the scheduler of the active client to answer: in a forked process it never does
PRE_SPAWN = "distributed.nanny.pre-spawn-environ"
# `start_fork_server` says what the fork server imports. Otherwise dask would import pandas here to say so.
distributed.utils._forkserver_preload_set = True
SETTINGS = {"distributed.admin.low-level-log-length": 10}  # dask would keep the last 1000 messages to workers
LONGEST_FOLDER, SHORT_FOLDER = 70, "/tmp"  # characters that leave room for the name of a socket
WORKER_MODULE = "blocksar.processors.worker"


class OwnCluster(LocalCluster):
    """A local cluster of this process. `size` stays constant while workers are restarted."""

    def __init__(self, workers: int, memory: int, **options: Any) -> None:
        super().__init__(n_workers=0, memory_limit=memory, **options)  # type: ignore[no-untyped-call]
        self.size = workers, memory  # bytes of each


def cluster_size(
    client: Client, *, workers: int | None = None, memory_limit: int | None = None, listener: Listener | None = None
) -> tuple[int, int]:
    """Return the number of workers of a cluster, and the smallest of their memory limits, bytes.

    At most so many `workers` and so much memory, where they are given. Without any worker, wait for the first; see
    `units.waiting_for_workers`.

    Raises
    ------
    InputError
        If there is no worker in time, or one does not have the same version of blocksar.
    """
    if (own := _own_cluster(client)) is not None:
        number, memory = own.size
    else:
        found = await_workers(client, listener or Listener())
        _check_versions(client)
        number, memory = len(found), min(int(w["memory_limit"]) or machine()[1] for w in found.values())
    return min(number, workers or number), min(memory, memory_limit or memory)


def workers_with_gpu(client: Client) -> int:
    """Count the workers of a cluster that have a GPU among dask's resources.

    Raises
    ------
    InputError
        If none has.
    """
    if found := sum("GPU" in worker.get("resources", {}) for worker in workers_of(client).values()):
        return found
    raise InputError(
        "device gpu: no worker of the cluster has a GPU; start one for each by CUDA_VISIBLE_DEVICES=N dask worker "
        "SCHEDULER --resources GPU=1, or leave --device out"
    )


def active_client(*, gpu: bool) -> tuple[Client | None, list[str]]:
    """Return dask's active client if it can do the work, and a note on it; in a task of a worker, none.

    A task that waits for others would keep its worker from them.

    Parameters
    ----------
    gpu : bool
        Whether its workers need a GPU.
    """
    with suppress(ValueError):
        get_worker()
        return None, []
    try:
        client = Client.current()
    except ValueError:
        return None, []
    if (lacking := _why_unusable(client, gpu=gpu)) is not None:
        return None, [f"note: dask's active client is not used: {lacking}"]
    where = client.scheduler_info()["address"]
    return client, [f"note: work goes to dask's active client ({where}); give workers for a cluster of its own"]


def _why_unusable(client: Client, *, gpu: bool) -> str | None:
    if client.asynchronous:
        return "it is asynchronous"
    try:
        client.sync(client.scheduler.identity, callback_timeout=ANSWER)  # type: ignore[union-attr]
    except Exception:  # of the connection, the loop, or the scheduler
        return "its scheduler does not answer"
    try:
        _check_versions(client)
        if gpu:
            workers_with_gpu(client)
    except InputError as error:
        return str(error)
    return None


def _own_cluster(client: Client) -> OwnCluster | None:
    cluster = getattr(client, "cluster", None)
    return cluster if isinstance(cluster, OwnCluster) else None


def worker_environment(threads: int) -> dict[str, str]:
    """Environment variables that a worker's libraries read when they are loaded."""
    return {
        "NUMBA_NUM_THREADS": str(threads),
        # Each thread of a worker runs loops of its own.
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        # Blocks are returned to the system at once; malloc keeps groups of rows and chunks, which stay in the cache.
        "MALLOC_MMAP_THRESHOLD_": str(24 * 2**20),
        "MALLOC_TRIM_THRESHOLD_": str(64 * 2**20),
    }


def start_fork_server(threads: int) -> None:
    """Start the process that workers are forked from, if it is not running yet.

    A terminal sends Ctrl-C to all processes of a command, and the main process ends the others: they inherit that it is
    blocked.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload([WORKER_MODULE])
    resource_tracker.ensure_running()  # otherwise the next line starts it, and that unblocks SIGINT
    wanted = worker_environment(threads)
    own = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _short_sockets():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in own.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _short_sockets() -> Iterator[None]:
    """Place the sockets of `multiprocessing` in /tmp if the temporary folder's path is too long for them.

    A socket's path has at most 107 characters. `get_temp_dir` makes the folder once for the life of this process.
    """
    usual = tempfile.tempdir
    if len(tempfile.gettempdir()) > LONGEST_FOLDER and os.access(SHORT_FOLDER, os.W_OK):
        tempfile.tempdir = SHORT_FOLDER
    try:
        get_temp_dir()
        yield
    finally:
        tempfile.tempdir = usual


def prepare_workers(threads: int, listener: Listener, loops: Sequence[str] = TASKS) -> None:
    """Compile these loops if need be, and let the process that workers are forked from import in the background.

    Raises
    ------
    InputError
        If the caller is a script that its workers would run again, or can start none.
    """
    _refuse_unguarded_script()
    if (reason := why_no_workers()) is not None:
        raise InputError(f"no workers can start: {reason}; leave --workers out, or give 0: this process does the work")
    if not kernels_cached(loops):
        _compile_once(listener, loops)
    start_fork_server(threads)


def open_here(listener: Listener, loops: Sequence[str] = TASKS) -> ThisProcess:
    """Return what runs the tasks of a run in this process, after these loops are compiled by others."""
    _compile_once(listener, loops, by="others")
    return ThisProcess(listener)


def _compile_once(listener: Listener, loops: Sequence[str], by: By = "all") -> None:
    """Compile these loops, unless numba's cache has them.

    Compilation takes more memory than a worker may use: the process that workers are forked from finds them compiled.
    """
    listener.update("compile", 0, 1)
    compile_missing(loops, by, listener)
    listener.update("compile", 1, 1)


@contextmanager
def open_client(
    *,
    scheduler: str | None = None,
    client: Client | None = None,
    workers: int = 1,
    threads: int = 1,
    memory_limit: int | None = None,
    scratch: str | None = None,
    wait_workers: float = WAIT_WORKERS,
    listener: Listener | None = None,
) -> Iterator[Client]:
    """Open a client: `client` itself, one of the scheduler at an address, or one of a new local cluster.

    Parameters
    ----------
    scheduler : str, optional
        Address of a running scheduler.
    client : Client, optional
        Client of a running cluster; it is not closed.
    workers, threads : int
        Processes of a local cluster, and threads in each.
    memory_limit : int, optional
        Memory of each local worker, bytes. Default: its share of the machine's memory.
    scratch : str, optional
        Folder for temporary files of local workers. Default: a temporary folder.
    wait_workers : float
        Time to wait in the block for a worker of a running cluster that has none, s; see `waiting_for_workers`.
    listener : Listener, optional
        Receives the progress of the start of a local cluster.

    Raises
    ------
    InputError
        If `client` is none or asynchronous, or the scheduler does not answer.
    ProcessingError
        If the workers of a local cluster do not start.
    """
    if client is not None:
        if not isinstance(client, Client):
            raise InputError(
                f"client is a {type(client).__name__}; give a distributed.Client, or the address of a scheduler as "
                "scheduler"
            )
        if client.asynchronous:
            raise InputError(
                "client is asynchronous, and nothing here awaits it; give a distributed.Client without "
                "asynchronous=True, or the address of a scheduler as scheduler"
            )
        with waiting_for_workers(wait_workers if _own_cluster(client) is None else None):
            yield client
        return
    if scheduler is None:
        with Starting(workers, threads, memory_limit, scratch=scratch, listener=listener or Listener()) as starting:
            yield starting.client()
        return
    with (
        dask.config.set(SETTINGS),
        _silence_dask(),
        _connect(scheduler) as connected,
        waiting_for_workers(wait_workers),
    ):
        yield connected


class Starting:
    """A local cluster that starts in the background. It ends with the block of its context.

    Parameters
    ----------
    workers, threads, memory_limit, scratch, listener
        As in `open_client`.
    loops : sequence of str
        Loops that tasks run, which are compiled first if need be.

    Raises
    ------
    InputError
        If the caller is a script that its workers would run again, or can start none.
    """

    def __init__(
        self,
        workers: int,
        threads: int,
        memory_limit: int | None,
        *,
        scratch: str | None,
        listener: Listener,
        loops: Sequence[str] = TASKS,
    ) -> None:
        self._workers, self._listener, self._loops = workers, listener, loops
        prepare_workers(threads, listener, loops)
        self._stack, self._pool = ExitStack(), ThreadPoolExecutor(1)
        # Signals are received by the main thread: none interrupts the start.
        self._opened = self._pool.submit(self._open, workers, threads, memory_limit, scratch)

    def _open(self, workers: int, threads: int, memory_limit: int | None, scratch: str | None) -> Client:
        enter = self._stack.enter_context
        enter(dask.config.set(SETTINGS))
        enter(_silence_dask())
        enter(_hiding_missing_script())
        if scratch is None:
            scratch = enter(tempfile.TemporaryDirectory(prefix="blocksar-", ignore_cleanup_errors=True))
        return enter(_local_cluster(workers, threads, memory_limit, scratch))

    def client(self) -> Client:
        """Wait for the workers; return the client of the cluster.

        Raises
        ------
        ProcessingError
            If the workers do not start.
        """
        _compile_once(self._listener, self._loops)
        self._listener.update("start-workers", 0, self._workers)
        client = self._stack.enter_context(self._opened.result())
        self._listener.update("start-workers", self._workers, self._workers)
        return client

    def __enter__(self) -> Starting:
        return self

    def __exit__(self, *error: Any) -> None:
        """Wait until the cluster has started, and end it; a second call does nothing."""
        self._pool.shutdown()
        self._stack.__exit__(*error)


@contextmanager
def _silence_dask() -> Iterator[None]:
    """Silence dask's loggers; errors are reported once, at the end."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _connect(scheduler: str) -> Client:
    try:
        return Client(scheduler, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"no dask scheduler answers at {scheduler} ({cause}); check --scheduler") from None


def _check_versions(client: Client) -> None:
    """Check that all workers have this version of blocksar: tasks are sent by name."""
    try:
        versions = client.run(_version)
    except Exception as error:
        where = client.scheduler_info()["address"]
        raise InputError(
            f"the workers of {where} cannot run blocksar ({' '.join(str(error).split())}); "
            f"install blocksar {__version__} there"
        ) from error
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(f"the worker {worker} has blocksar {version}, but here is {__version__}; install the same")


def _version() -> str:
    return __version__


@contextmanager
def _local_cluster(workers: int, threads: int, memory_limit: int | None, scratch: str) -> Iterator[Client]:
    """Start a local cluster and open its client, which is not the current one; both end with the block.

    Raises
    ------
    ProcessingError
        If the workers do not start.
    """
    memory = memory_limit or machine()[1] // workers
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_local_settings(threads, scratch)))
        cluster: LocalCluster = OwnCluster(
            workers,
            memory,
            threads_per_worker=1,
            resources=GPU,  # of which a unit of work that needs one has it for itself
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # any free port, loopback only; needs bokeh to show more than metrics
            scheduler_kwargs={"dashboard": False},  # `serve_dashboard` makes one on demand
            silence_logs=logging.CRITICAL,
        )
        stack.enter_context(cluster)
        serve_dashboard(cluster)
        cluster.scale(workers)
        client = Client(cluster, set_as_default=False)
        stack.callback(client.close)
        try:
            client.wait_for_workers(workers, timeout=NO_WORKER)
        except TimeoutError:
            raise ProcessingError(
                f"the workers did not start within {NO_WORKER:.0f} s, in which each imports blocksar and connects to "
                "this process by 127.0.0.1; the same command resumes: give fewer --workers if the machine is busy, or "
                "--workers 0 to do without"
            ) from None
        stack.enter_context(_replacing_hung_workers(cluster))
        try:
            yield client
        except BaseException:
            # Closing the cluster would wait for tasks whose results are no longer needed.
            _kill_workers(cluster)
            raise


def _refuse_unguarded_script() -> None:
    """Refuse a call from a script's top level: workers import the script and would call it again.

    Raises
    ------
    InputError
        If it is, without `if __name__ == "__main__":`.
    """
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
    main = sys.modules["__main__"]
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    if frame.f_globals is not vars(main) or file is None or (spec is not None and spec.name.endswith("__main__")):
        return  # a thread, an interactive session, or a package: none is imported by workers
    try:
        statements = ast.parse(Path(file).read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return
    for statement in statements:
        if statement.lineno <= frame.f_lineno <= (statement.end_lineno or statement.lineno):
            test = statement.test if isinstance(statement, ast.If) else ast.Pass()
            names = {node.id for node in ast.walk(test) if isinstance(node, ast.Name)}
            if not names & {"__name__", "current_process", "parent_process"}:
                raise InputError(
                    f"{file}, line {frame.f_lineno}: workers import this script, and would call focus again; call it "
                    'below `if __name__ == "__main__":`, or focus in this process with workers=0'
                )


@contextmanager
def _hiding_missing_script() -> Iterator[None]:
    """Hide a `__main__` file that does not exist, such as <stdin>, from workers, which would try to run it."""
    main = vars(sys.modules["__main__"])
    file = main.get("__file__")
    if file is None or os.path.exists(os.path.join(ORIGINAL_DIR or "", file)):
        yield
        return
    main["__file__"] = None
    try:
        yield
    finally:
        main["__file__"] = file


@contextmanager
def _replacing_hung_workers(cluster: LocalCluster) -> Iterator[None]:
    """Kill workers that hang and that the scheduler has dropped, so that their nannies restart them."""
    ended = threading.Event()

    def watch() -> None:
        since: dict[int, float] = {}
        while (scheduler := cluster.scheduler) is not None and not ended.wait(HUNG / 4):
            known = set(scheduler.workers)
            lost = {
                nanny.pid
                for nanny in list(cluster.workers.values())
                if nanny.pid is not None and nanny.worker_address is not None and nanny.worker_address not in known
            }
            since = {pid: since.get(pid, time.monotonic()) for pid in lost}
            for pid, first in since.items():
                if time.monotonic() - first > HUNG:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=watch, name="hung-workers", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _local_settings(threads: int, scratch: str) -> dict[str, Any]:
    return {
        # The plan keeps within the memory limit; spilling would only hide an error in it.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": 0.9,
        "distributed.worker.memory.terminate": 0.98,
        "distributed.scheduler.work-stealing": False,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.scheduler.worker-ttl": WORKER_TTL,
        # A lost worker is given up for good after this time, even while it restarts.
        "distributed.deploy.lost-worker-timeout": "1h",
        # Sampled stacks of tasks, a clock of the event loop and figures of the machine, 50 to 100 times a second in
        # every process: a twentieth of all processor time. Receipts say what tasks take.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
        "temporary-directory": scratch,
        "distributed.worker.multiprocessing-method": "forkserver",
        # Workers would inherit the environment of the time at which the process that they are forked from began.
        "distributed.nanny.environ": dict(os.environ),
        PRE_SPAWN: worker_environment(threads),
    }


def _kill_workers(cluster: LocalCluster) -> None:
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
