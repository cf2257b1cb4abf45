"""The order in which chunks of a patch are completed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.grid import Grid
from blocksar.graph.edges import by_yaw


def test_chunks_are_ordered_by_yaw_and_may_be_none() -> None:
    """A block at the rim of an image may have no pixel of it."""

    def relative_yaw(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.arctan2(y, x)

    ground: Any = SimpleNamespace(relative_yaw=relative_yaw)
    grid = Grid(1000.0, 3000.0, 1.0, -1000.0, 1000.0, 1.0)
    assert by_yaw([], ground, grid) == []
    assert by_yaw([(2, 0), (0, 0), (1, 0)], ground, grid) == [(0, 0), (1, 0), (2, 0)]
