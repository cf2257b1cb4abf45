"""The machine as this package sees it is the machine as dask sees it."""

from __future__ import annotations

from dask.system import cpu_count
from distributed.system import memory_limit

from blocksar.graph.machine import machine


def test_cores_and_memory_are_those_that_dask_finds() -> None:
    assert machine() == (cpu_count(), memory_limit())
