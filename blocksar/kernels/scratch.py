"""Memory that arrays of one thread use again: the system clears every page of new memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray

ROOM = 1.25  # times what is asked for: later arrays are often a little larger


class Scratch:
    """Named arrays, each of which takes the memory of the one before of its name."""

    def __init__(self, empty: Callable[..., Any] = np.empty) -> None:
        self._empty = empty  # of a device
        self._kept: dict[Hashable, ComplexArray] = {}

    def array(self, name: Hashable, shape: tuple[int, ...]) -> ComplexArray:
        """An array of complex64, not cleared; one of this name that was taken before is lost."""
        size = math.prod(shape)
        kept = self._kept.get(name)
        if kept is None or kept.size < size:
            kept = self._kept[name] = self._empty(int(ROOM * size), np.complex64)
        return kept[:size].reshape(shape)
