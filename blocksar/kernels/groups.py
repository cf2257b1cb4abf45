"""Groups of rows that fit into a core's cache, and a thread pool for them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from blocksar.arrays import ComplexArray

ROOM = 1.25  # times the requested size: later arrays are often a little larger


class Scratch(threading.local):
    """Named arrays of a thread, each of which takes the memory of the one before of its name."""

    def __init__(self, empty: Callable[..., Any] = np.empty) -> None:
        self._empty = empty  # of a device
        self._kept: dict[Hashable, ComplexArray] = {}

    def array(self, name: Hashable, shape: tuple[int, ...]) -> ComplexArray:
        """Return an array of complex64, not cleared; the previous one of this name is overwritten."""
        size = math.prod(shape)
        memory = self._kept.get(name)
        if memory is None or memory.size < size:
            memory = self._kept[name] = self._empty(int(ROOM * size), np.complex64)
        return memory[:size].reshape(shape)


GROUP_BYTES = 768 * 1024  # of the rows in a group, to stay within a core's second-level cache
PART_BYTES = 3 * 1024**2  # of the samples of parts of an image that are worked on at a time
GPU_PART_BYTES = 128 * 1024**2  # of these on a GPU
GROUP_ROWS = 4  # group sizes are multiples of this: the FFT library transforms so many rows at once
Part = TypeVar("Part")  # one unit of work for a thread: a slice or a tile


def row_groups(first: int, last: int, length: int, *, columns: bool = False) -> list[slice]:
    """Divide rows first .. last - 1 of `length` complex64 samples into groups of about GROUP_BYTES.

    If the rows are an array's columns, a group holds whole cache lines of them.
    """
    multiple = 2 * GROUP_ROWS if columns else GROUP_ROWS
    rows = max(GROUP_BYTES // (8 * length) // multiple, 1) * multiple
    return [slice(i, min(i + rows, last)) for i in range(first, last, rows)]


def run_groups(work: Callable[[Part], None], groups: Iterable[Part], threads: int) -> None:
    """Call `work` for every group on several threads: Python's, since numba's own threads are not re-entrant."""
    if threads == 1:
        for group in groups:
            work(group)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, groups):
            pass
