"""The machine that this process runs on."""

from __future__ import annotations

from dask.system import CPU_COUNT
from distributed.system import MEMORY_LIMIT


def machine() -> tuple[int, int]:
    """Return the number of cores and the bytes of memory that this process may use, within its control group."""
    return int(CPU_COUNT), int(MEMORY_LIMIT)
