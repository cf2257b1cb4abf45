"""What reflects in a scene: point targets, the scatterers of a random field, and those of a reflectivity map."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.simulation.tables import ClutterTable, ReflectivityTable


class PointTarget(NamedTuple):
    """A named point target: x, y in m in the scene frame, and z; None on the ground plane."""

    name: str
    x: float
    y: float
    reflectivity: complex
    z: float | None = None


class Scatterers(NamedTuple):
    """Many nameless scatterers: x, y (n,) m in the scene frame, reflectivity (n,) complex64."""

    x: FloatArray
    y: FloatArray
    reflectivity: NDArray[np.complex64]


def draw_field(
    table: ClutterTable,
    ranges: tuple[float, float],
    yaws: tuple[float, float],
    ground_point: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> Scatterers:
    """Draw a random field: uniform over the table's box, or over the ground between slant ranges (m) and yaws (rad).

    `ground_point` returns x, y (m) at slant ranges (m) and yaws (rad).
    """
    random = np.random.default_rng(table.seed)
    u, v = random.random((2, table.scatterers))
    if table.x is not None and table.y is not None:
        x = table.x[0] + u * (table.x[1] - table.x[0])
        y = table.y[0] + v * (table.y[1] - table.y[0])
    else:
        # Ground area grows with the square of the distance, and that with the square of the slant range.
        squared = ranges[0] ** 2 + u * (ranges[1] ** 2 - ranges[0] ** 2)
        x, y = ground_point(np.sqrt(squared), yaws[0] + v * (yaws[1] - yaws[0]))
    parts = random.standard_normal((2, table.scatterers)) * np.sqrt(table.power / 2)
    return Scatterers(x, y, (parts[0] + 1j * parts[1]).astype(np.complex64))


def read_map(table: ReflectivityTable) -> Scatterers:
    """Read a reflectivity map: a scatterer for each pixel that is not zero."""
    pixels = np.load(table.file, allow_pickle=False)
    row, column = np.nonzero(pixels)
    values = pixels[row, column].astype(np.complex64)
    if table.seed is not None:
        # One phase for each pixel of the map, empty ones included: editing a pixel leaves the others unchanged.
        phase = np.random.default_rng(table.seed).random(pixels.shape)[row, column]
        values = values * np.exp(2j * np.pi * phase).astype(np.complex64)
    x, y = table.x0 + table.dx * column.astype(np.float64), table.y0 + table.dy * row.astype(np.float64)
    return Scatterers(x, y, values)
