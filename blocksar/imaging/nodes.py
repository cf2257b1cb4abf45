"""Nodes: pixels of an axis at which what is smooth over the ground is computed, linear in between."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray, IntArray

NODE_PIXELS = 16  # between nodes, at most


def nodes_of(n: int, step: int = NODE_PIXELS) -> IntArray:
    """Indices of every `step`-th of n pixels, and of the last one."""
    return np.unique(np.append(np.arange(0, n, step), n - 1))


def over_pixels(values: FloatArray, rows: IntArray, columns: IntArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Values (n_row, n_column) at nodes of the axes y (n_y,) and x (n_x,), even or not, at all pixels: (n_y, n_x)."""
    return _between(_between(values, y, rows).T, x, columns).T


def _between(values: FloatArray, axis: FloatArray, nodes: IntArray) -> FloatArray:
    """Values (n_node, m) at nodes of an axis (n,), linear in between: (n, m)."""
    if nodes.size == 1:
        return values
    first = np.clip(np.searchsorted(nodes, np.arange(axis.size), side="right") - 1, 0, nodes.size - 2)
    start, end = axis[nodes[first]], axis[nodes[first + 1]]
    part = ((axis - start) / (end - start))[:, None]
    return np.asarray(values[first] * (1 - part) + values[first + 1] * part)
