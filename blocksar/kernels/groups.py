"""Groups of rows that fit a core's cache, run by several threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

GROUP_BYTES = 768 * 1024  # rows worked on at a time: within a core's second-level cache
GROUP_ROWS = 4  # and a multiple of so many, which the FFT library transforms at once
Part = TypeVar("Part")  # a slice, a tile: what a thread does in one go


def row_groups(first: int, last: int, length: int, *, columns: bool = False) -> list[slice]:
    """Rows of `length` samples in groups of about GROUP_BYTES, whole cache lines of an array's columns if they are."""
    multiple = 2 * GROUP_ROWS if columns else GROUP_ROWS
    rows = max(GROUP_BYTES // (8 * length) // multiple, 1) * multiple
    return [slice(i, min(i + rows, last)) for i in range(first, last, rows)]


def run_groups(work: Callable[[Part], None], groups: Iterable[Part], threads: int) -> None:
    """Do `work` for every group, on as many threads: Python's, not numba's, which may not be entered twice."""
    if threads == 1:
        for group in groups:
            work(group)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, groups):
            pass
