"""Memory of a worker: what its process takes, and whether its limit holds a plan."""

from __future__ import annotations

import math

from blocksar.constants import MIB
from blocksar.errors import InputError

MEMORY_SHARE = 0.8  # fraction of a worker's limit that a plan may fill
PROCESS_MEMORY = 288 * MIB  # a worker's interpreter and libraries, without samples
GPU_PROCESS_MEMORY = 768 * MIB  # more with the libraries of a GPU


def checked_memory(what: str, memory: int, memory_limit: int) -> int:
    """Return `memory`, bytes, if a worker's limit allows it; `what` names the need in the error.

    Raises
    ------
    InputError
        If the limit is too low.
    """
    if memory > MEMORY_SHARE * memory_limit:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {what} needs about "
            f"{math.ceil(memory / MEMORY_SHARE / MIB)} MiB; raise --memory-limit, or take fewer workers"
        )
    return memory
