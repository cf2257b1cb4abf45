"""The machine that this process runs on, as dask sees it, without importing dask, which takes longer than a plan."""

from __future__ import annotations

import math
import multiprocessing
import os
from contextlib import suppress
from functools import lru_cache
from multiprocessing import forkserver
from numbers import Integral
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from blocksar.errors import InputError
from blocksar.places.posix import resource

GROUPS = Path("/sys/fs/cgroup")
CPU_QUOTAS = ("cpuacct,cpu", "cpu,cpuacct")  # folders of control groups of version 1
MEMORY_LIMITS = (
    *("memory/memory.limit_in_bytes", "memory/memory.soft_limit_in_bytes"),  # of version 1
    *("memory.max", "memory.high", "memory.low"),  # of version 2
)


@lru_cache(maxsize=1)
def machine() -> tuple[int, int]:
    """Return the number of cores and the bytes of memory that this process may use, within its control group."""
    return _cores(), _memory()


PACE_SAMPLES, PACE_TRIALS = 1 << 16, 16
PACE_SECONDS = 1.9e-3  # that a trial takes on the machine of the constants in `planning.effort`


@lru_cache(maxsize=1)
def pace() -> float:
    """Measure the pace of this machine: its seconds for a second of work on the machine of `planning.effort`.

    A few phases are multiplied, as focusing does; the median of some trials, since cores that are shared with others,
    or change their clock, are at their best only at times.
    """
    import numpy as np  # slow to import, and cores are counted before anything else

    phase = np.linspace(0.0, 1e3, PACE_SAMPLES)
    samples = np.ones(PACE_SAMPLES, np.complex64)
    seconds = []
    for _ in range(PACE_TRIALS):
        begun = perf_counter()
        samples * np.exp(1j * phase).astype(np.complex64)
        seconds.append(perf_counter() - begun)
    return float(np.median(seconds)) / PACE_SECONDS


class Resources(NamedTuple):
    """Resources of a cluster: processes, threads in each, and memory of each in bytes."""

    workers: int
    threads: int
    memory_limit: int


def resources(workers: int | None, threads: int | None, memory_limit: int | None) -> Resources:
    """Fill in defaults: at most 4 workers, with no more threads in all than cores; workers share the memory equally.

    Without workers (0) the calling process does their work: it counts as one.

    Raises
    ------
    InputError
        If a number is too low.
    """
    cores, memory = machine()
    for name, value, least in (("workers", workers, 0), ("threads", threads, 1)):
        if value is not None and not isinstance(value, Integral):
            raise InputError(f"{name} is {value!r}; give a whole number of at least {least}")
        if value is not None and value < least:
            raise InputError(f"{name} must be at least {least}, got {value}")
    workers = min(max(cores // (threads or 1), 1), 4) if workers is None else max(workers, 1)
    threads = threads or max(cores // workers, 1)
    return Resources(workers, threads, memory_limit or memory // workers)


def why_no_workers() -> str | None:
    """Explain why this process can start no workers; None if it can.

    `multiprocessing` lets no daemon have children, and tells each child the working folder; a worker that cannot share
    locks fails before it can say so. The server that workers are forked from is the child of one process.
    """
    if multiprocessing.current_process().daemon:
        return "this process is a daemon, as workers of a multiprocessing.Pool, of Celery and of dask are"
    server = getattr(getattr(forkserver, "_forkserver", None), "_forkserver_pid", None)
    try:
        if server is not None:
            os.waitid(os.P_PID, server, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return "this process was forked from one that had workers, where it can be spawned instead"
    try:
        os.getcwd()
    except OSError:
        return "the working folder was deleted"
    try:
        multiprocessing.get_context("forkserver").Lock()
    except OSError as error:
        return f"processes cannot share locks ({error.strerror or error}), which takes a /dev/shm that is writable"
    return None


def _cores() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _cpu_quota()
    return cores if quota is None else min(cores, max(math.ceil(quota), 1))


def _cpu_quota() -> float | None:
    """Cores that the control group may use; None without a limit."""
    for folder in CPU_QUOTAS:
        with suppress(OSError, ValueError, ZeroDivisionError):
            quota, period = (int((GROUPS / folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
            return quota / period if quota > 0 else None
    with suppress(OSError, ValueError, ZeroDivisionError):
        group = Path("/proc/self/cgroup").read_text(encoding="ascii").strip().split(":")[-1]
        quota, period = map(int, (GROUPS / group.strip("/") / "cpu.max").read_text().split())  # "max": no number
        return quota / period
    return None


def _memory() -> int:
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), resource.getrlimit(resource.RLIMIT_RSS)[1]]
    for name in MEMORY_LIMITS:
        with suppress(OSError, ValueError):
            limits.append(int((GROUPS / name).read_text()))
    return min(limit for limit in limits if limit > 0)
