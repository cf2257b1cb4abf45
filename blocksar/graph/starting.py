"""The start of a command that needs workers: their imports begin before those of the command.

The process that the workers of a local cluster are forked from: `multiprocessing`'s fork server.

It imports what workers need, and loads the compiled loops, while the main process is busy with its own imports and with
the plan. This module imports nothing of dask, so that a command can start it first.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.util import get_temp_dir

from blocksar.graph.compiling import kernels_cached
from blocksar.graph.machine import resources

LONGEST_FOLDER, SHORT_FOLDER = 70, "/tmp"  # characters that leave room for the name of a socket
WORKER_MODULE = "blocksar.graph.worker"


def worker_environment(threads: int) -> dict[str, str]:
    """Variables that libraries of a worker read when they are loaded."""
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
    """Start the process that workers are forked from, if it does not run yet.

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
    """Let the sockets of `multiprocessing` lie in /tmp where the temporary folder's path is too long for them.

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


# With one of these no workers are started here, or the command line alone does not say how many threads they have.
OTHERWISE = ("-h", "--help", "--scheduler", "--dry-run", "--print-config", "--config")


def start_at_once(words: Sequence[str]) -> None:
    """Start the process that workers are forked from, if the words after a command say that it will probably need it.

    They are looked at before anything is imported that could read them. In doubt nothing is started: the command does
    that once it has read them.
    """
    if None in (sys.stdin, sys.stdout, sys.stderr):  # pipes would take the numbers of closed streams
        return
    out, workers, threads = (_value_of(words, name) for name in ("--out", "--workers", "--threads"))
    if any(word.split("=")[0] in OTHERWISE for word in words) or not any(os.path.exists(word) for word in words):
        return
    if out is not None and _is_number(workers, least=0) and _is_number(threads, least=1):
        start_early(
            (),
            out,
            workers=None if workers is None else int(workers),
            threads=None if threads is None else int(threads),
        )


def _value_of(words: Sequence[str], name: str) -> str | None:
    """The value of an option: the word after its name, or the rest of its own; the last one if there are several."""
    found = None
    for word, following in zip(words, [*words[1:], None], strict=True):
        if word == name:
            found = following
        elif word.startswith(f"{name}="):
            found = word.removeprefix(f"{name}=")
    return found


def _is_number(text: str | None, *, least: int) -> bool:
    return text is None or (text.isdecimal() and int(text) >= least)


def start_early(sources: Sequence[str], out: str, *, workers: int | None, threads: int | None) -> None:
    """Start the process that workers are forked from, if `focus` with these arguments will probably need it.

    It will not if one of the sources does not exist, or if the run folder may hold a finished run; nor before loops
    are compiled.
    """
    there = all(os.path.exists(source) for source in sources)
    if workers != 0 and there and not os.path.exists(out) and kernels_cached():
        start_fork_server(resources(workers, threads, None).threads)
