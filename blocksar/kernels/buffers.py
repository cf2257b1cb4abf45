"""Large arrays whose memory is kept and used again by the next ones of this process.

The system clears every page of new memory, which takes a tenth of the time of a run, and more on a virtual machine that
has returned the memory to its host. Kept and used memory together never exceed the most that has been in use at once,
and what is kept is given back once nothing was allocated for a while: a worker may outlive the run.

Each array has a piece of address space of its own, a power of two: the system backs only pages that were written, so an
array of another size takes the pages of the one before.
"""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from collections import deque
from contextlib import suppress

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.constants import MIB

SMALLEST = 4 * MIB  # bytes of an array that is worth it
IDLE = 20.0  # s without use after which memory is given back
GRAIN = MIB // 16  # bytes, of which arrays take a multiple


class Block:
    """Address space of an array, and how much of it the system may back, bytes from its beginning."""

    def __init__(self, size: int) -> None:
        try:
            self.memory = map_pages(1 << (size - 1).bit_length())
        except OSError:  # a system that lends no more than it has
            self.memory = map_pages(size)
        self.written = 0

    def cut(self, size: int) -> None:
        """Give back what lies beyond `size`, a multiple of GRAIN."""
        if size < self.written:
            with suppress(AttributeError, OSError):
                self.memory.madvise(mmap.MADV_DONTNEED, size, self.written - size)
            self.written = size


class Memory:
    """Memory of arrays, used or kept; safe for several threads."""

    def __init__(self, idle: float = IDLE) -> None:
        self._idle, self._last_use, self._watch = idle, time.monotonic(), False
        self._lock = threading.Lock()
        self._gone: deque[Block] = deque()  # of arrays that are gone: one may go while its thread holds the lock
        self._free: list[Block] = []
        self._used = self._most_used = 0

    def empty(self, shape: tuple[int, ...]) -> ComplexArray:
        """Return an array of complex64, not initialised; its memory is kept once it and all views are gone."""
        n = int(np.prod(shape))
        if 8 * n < SMALLEST:
            return np.empty(shape, np.complex64)
        size = -(-8 * n // GRAIN) * GRAIN
        with self._lock:
            self._take_back()
            fitting = [block for block in self._free if len(block.memory) >= size]
            if fitting:
                block = min(fitting, key=lambda block: (max(size - block.written, 0), block.written))
                self._free.remove(block)
            else:
                block = Block(size)
            block.cut(size)
            block.written = size
            self._used += size
            self._most_used = max(self._most_used, self._used)
            self._shrink(self._most_used)
            self._last_use = time.monotonic()
            if not self._watch:
                self._watch_for(self._idle)
        # All views refer to `whole`, directly or not: it dies with the last of them.
        whole = np.frombuffer(block.memory, np.complex64, n)
        weakref.finalize(whole, self._gone.append, block).atexit = False
        return whole.reshape(shape)

    def release(self) -> None:
        """Give back what is kept."""
        with self._lock:
            self._take_back()
            self._most_used = self._used
            self._shrink(self._used)

    @property
    def used(self) -> int:
        """Bytes of the arrays that are alive."""
        with self._lock:
            self._take_back()
            return self._used

    @property
    def kept(self) -> int:
        """Bytes that no array has, but the system may back."""
        with self._lock:
            self._take_back()
            return sum(block.written for block in self._free)

    def _take_back(self) -> None:
        """Keep the memory of the arrays that are gone."""
        while self._gone:
            self._free.append(self._gone.popleft())
            self._used -= self._free[-1].written
        self._shrink(self._most_used)

    def _shrink(self, total: int) -> None:
        """Give back what is kept, of small blocks first, until kept and used memory is at most `total` bytes."""
        excess = self._used + sum(block.written for block in self._free) - total
        for block in sorted(self._free, key=lambda block: block.written):
            if excess > 0:
                excess -= block.written
                block.cut(max(-(excess // GRAIN) * GRAIN, 0))
        self._free = [block for block in self._free if block.written]

    def _watch_for(self, seconds: float) -> None:
        """See after some seconds whether the memory is idle."""
        timer = threading.Timer(seconds, self._expire)
        timer.daemon = self._watch = True
        timer.start()

    def _expire(self) -> None:
        if (left := self._last_use + self._idle - time.monotonic()) <= 0:
            self.release()
        with self._lock:
            self._watch = False
            if self._used or self._free:
                self._watch_for(max(left, self._idle / 10))


def map_pages(size: int) -> mmap.mmap:
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(AttributeError, OSError):  # in pages of 2 MiB, where the system has them
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


empty = Memory().empty
