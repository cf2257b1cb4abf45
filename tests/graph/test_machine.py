"""The machine as this package sees it is the machine as dask sees it; what workers need of it."""

from __future__ import annotations

import multiprocessing

import pytest
from dask.system import cpu_count
from distributed.system import memory_limit

from blocksar.errors import InputError
from blocksar.graph import cluster
from blocksar.graph import machine as module
from blocksar.graph.machine import machine, resources


def test_cores_and_memory_are_those_that_dask_finds() -> None:
    assert machine() == (cpu_count(), memory_limit())


@pytest.mark.parametrize(
    ("workers", "threads", "filled_in"),
    [(None, None, (4, 4)), (None, 8, (2, 8)), (None, 32, (1, 32)), (8, None, (8, 2)), (0, None, (1, 16))],
)
def test_what_is_left_open_fills_the_cores(
    workers: int | None, threads: int | None, filled_in: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "machine", lambda: (16, 1 << 34))
    assert resources(workers, threads, None) == (*filled_in, (1 << 34) // filled_in[0])


def test_without_shared_locks_workers_are_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a run would wait two minutes for them."""

    def fail() -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(multiprocessing.get_context("forkserver"), "Lock", fail)
    with (
        pytest.raises(InputError, match=r"\(Permission denied\), which takes a /dev/shm that is writable"),
        cluster.open_client(),
    ):
        pass
