"""Large arrays whose memory is kept and used again by the next ones of this process.

The system clears every page of new memory, which takes a tenth of the time of a run, and more on a virtual machine that
has returned the memory to its host. Kept memory never raises the peak: it is given back as soon as kept and used
memory together would exceed the most that has been in use at once, and once nothing was allocated for a while: a worker
may outlive the run.
"""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from contextlib import suppress

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.constants import MIB

SMALLEST = 4 * MIB  # bytes of an array that is worth it
IDLE = 20.0  # s without use after which memory is given back
FIT = 1.25  # a kept memory serves if it is at most so many times as large as needed


class Memory:
    """Memory of arrays, used or kept; safe for several threads.

    Attributes
    ----------
    used : int
        Bytes of the arrays that are alive.
    """

    def __init__(self, idle: float = IDLE) -> None:
        self._idle, self._last_use, self._watch = idle, time.monotonic(), False
        self._lock = threading.RLock()  # an array may be freed, and kept, while another is allocated
        self._kept: list[mmap.mmap] = []
        self.used = self._most_used = 0

    def empty(self, shape: tuple[int, ...]) -> ComplexArray:
        """Return an array of complex64, not initialised; its memory is kept once it and all views are gone."""
        size = 8 * int(np.prod(shape))
        if size < SMALLEST:
            return np.empty(shape, np.complex64)
        memory = self._take(size)
        # All views refer to `whole`, directly or not: it dies with the last of them.
        whole = np.frombuffer(memory, np.complex64)
        weakref.finalize(whole, self._keep, memory).atexit = False
        return whole[: size // 8].reshape(shape)

    def release(self) -> None:
        """Give back what is kept."""
        with self._lock:
            self._kept.clear()
            self._most_used = self.used

    @property
    def kept(self) -> int:
        """Bytes."""
        return sum(map(len, self._kept))

    def _take(self, size: int) -> mmap.mmap:
        with self._lock:
            fitting = [memory for memory in self._kept if size <= len(memory) <= FIT * size]
            chosen = min(fitting, key=len, default=None)
            if chosen is None:
                self._most_used = max(self._most_used, self.used + size)
                self._shrink(self._most_used - size)
                chosen = _new(size)
            else:
                self._kept.remove(chosen)
            self._last_use = time.monotonic()
            self.used += len(chosen)
            self._most_used = max(self._most_used, self.used)
            return chosen

    def _keep(self, memory: mmap.mmap) -> None:
        with self._lock:
            self.used -= len(memory)
            self._kept.append(memory)
            self._shrink(self._most_used)
            self._last_use = time.monotonic()
            if self._kept and not self._watch:
                self._watch_for(self._idle)

    def _watch_for(self, seconds: float) -> None:
        """See after some seconds whether the memory is idle."""
        timer = threading.Timer(seconds, self._expire)
        timer.daemon = self._watch = True
        timer.start()

    def _expire(self) -> None:
        with self._lock:
            self._watch = False
            left = self._last_use + self._idle - time.monotonic()
            if left > 0:
                self._watch_for(left)
            else:
                self.release()

    def _shrink(self, total: int) -> None:
        """Give back the largest kept memories until kept and used memory together is at most `total` bytes."""
        self._kept.sort(key=len)
        while self._kept and self.used + self.kept > total:
            self._kept.pop()


def _new(size: int) -> mmap.mmap:
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(AttributeError, OSError):  # in pages of 2 MiB, where the system has them
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


empty = Memory().empty
