"""Chunks of the image with one value throughout: the first of its kind is written, the others share its file."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.graph.spectrum import Window
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Written


class AlikeChunks:
    """Writes a task's chunks of the image, for its threads at once.

    Most chunks of layers of small whole numbers have one value. To compress it, and to make a file, takes as long as a
    tenth of the correction of the chunk's pixels.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._lock = run, threading.Lock()
        self._first: dict[tuple[str, tuple[int, ...], str], Written] = {}

    def write(self, variable: str, window: Window, values: NDArray[Any] | np.generic) -> Written:
        """Write a chunk of a variable: its values, or the one value of all of them, in the variable's dtype."""
        shape = tuple(part.stop - part.start for part in window)
        chunk = np.broadcast_to(values, shape)
        one = chunk.flat[0]
        if values.ndim and (chunk.flat[-1] != one or (chunk != one).any()):
            return self._write(variable, window, chunk)
        kind = variable, shape, one.tobytes().hex()
        with self._lock:
            if kind not in self._first:
                self._first[kind] = self._write(variable, window, chunk)
                return self._first[kind]
        first, image = self._first[kind], self._run.image
        source = tuple(slice(*span) for span in first.region)
        if stores.share_region(image, variable, window, source=image, source_region=source):
            return replace(first, region=tuple((part.start, part.stop) for part in window))
        return self._write(variable, window, chunk)

    def _write(self, variable: str, window: Window, chunk: NDArray[Any]) -> Written:
        return write(self._run, self._run.image, variable, window, np.ascontiguousarray(chunk))
