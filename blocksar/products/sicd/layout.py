"""Layout of the file: how its rows and columns lie in the scene, and which of its pixels are valid."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.products.sicd.aperture import centre_time
from blocksar.runs.finished import Coverage, FinishedRun

MAX_VERTICES = 100  # of ValidData
FIT_POINTS = 41  # a side, where polynomials over the image are fitted
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # in x and y, that rows of the file may run in


class Layout(NamedTuple):
    """Position of the file's rows and columns in the scene.

    Attributes
    ----------
    row, column : (2,) float
        Unit vectors in x and y along which the row and the column index grow.
    first : (3,) float
        Scene point of row 0, column 0, m.
    spacing : tuple of float
        Distance between rows and between columns, m.
    shape : tuple of int
        Number of rows and of columns.
    """

    row: FloatArray
    column: FloatArray
    first: FloatArray
    spacing: tuple[float, float]
    shape: tuple[int, int]

    @property
    def row_axis(self) -> int:
        """Axis of the image's array along which the file's row index grows: 0 is y, 1 is x."""
        return 1 if self.row[0] else 0

    def point(self, row: FloatArray, column: FloatArray) -> FloatArray:
        """Scene points (..., 3), m, of fractional rows and columns (...)."""
        offset = np.multiply.outer(row * self.spacing[0], self.row) + np.multiply.outer(
            column * self.spacing[1], self.column
        )
        return self.first + np.concatenate([offset, np.zeros((*offset.shape[:-1], 1))], axis=-1)

    def reorder(self, values: ComplexArray) -> ComplexArray:
        """Return a part (y, x) of the image in the order of the file."""
        values = values.T if self.row_axis == 1 else values
        return values[:: int(self.row.sum()), :: int(self.column.sum())]


class Axes(Protocol):
    """Where pixels lie, m."""

    @property
    def x(self) -> FloatArray: ...
    @property
    def y(self) -> FloatArray: ...
    @property
    def spacing(self) -> tuple[float, float]: ...


def lay_out(source: FinishedRun, pixels: Axes | None = None) -> Layout:
    """Lay rows along the axis that points most directly away from the radar at the middle of the image.

    The pixels are those of the image, or cells of them.
    """
    grid = source if pixels is None else pixels
    middle = np.array([source.x.mean(), source.y.mean(), source.ground_height])
    sight = middle - source.geometry.track.position(np.array(centre_time(source.geometry, middle)))
    row = np.array(max(DIRECTIONS, key=lambda direction: float(np.dot(direction, sight[:2]))), np.float64)
    column = np.array([-row[1], row[0]])  # about z, a quarter turn
    towards = row + column
    x, y = grid.x[0 if towards[0] > 0 else -1], grid.y[0 if towards[1] > 0 else -1]
    dx, dy = grid.spacing
    along_x = row[0] != 0
    return Layout(
        row=row,
        column=column,
        first=np.array([x, y, source.ground_height]),
        spacing=(dx, dy) if along_x else (dy, dx),
        shape=(grid.x.size, grid.y.size) if along_x else (grid.y.size, grid.x.size),
    )


def valid_data(coverage: Coverage, layout: Layout) -> Any:
    """Vertices (n, 2), row and column, of a polygon around the covered pixels, as SICD orders them.

    The polygon joins the first and last covered row of every column. A sector seen along the line of sight has one run
    of covered rows in every column, so the polygon matches it to a pixel or two; for other shapes it also holds the
    gaps between runs. Clockwise with rows to the right and columns up, starting at the first column of the first row.
    """
    from shapely import Polygon
    from shapely.geometry.polygon import orient

    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    border = np.concatenate([
        np.stack([first[columns], columns], axis=1), np.stack([last[columns], columns], axis=1)[::-1]
    ])  # fmt: skip
    vertices = _box(border, layout.shape)
    outline = Polygon(border) if columns.size > 1 else Polygon(vertices)
    if not outline.is_valid:  # parts that are one pixel wide make it touch itself
        hull = outline.convex_hull
        outline = hull if hull.area > 0 else Polygon(vertices)
    for tolerance in (0.0, *2.0 ** np.arange(-1, 12)):
        rounded = np.rint(outline.simplify(tolerance).exterior.coords[:-1])
        if 3 <= len(rounded) <= MAX_VERTICES and (polygon := Polygon(rounded)).is_valid and polygon.area > 0:
            vertices = np.array(orient(polygon, -1.0).exterior.coords[:-1])
            break
    start = np.lexsort((vertices[:, 1], vertices[:, 0]))[0]
    return np.roll(vertices, -start, axis=0).astype(int)


def _box(points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Corners (4, 2), clockwise, of the box around pixels (n, 2), at least one pixel wide and within the image."""
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.minimum(np.maximum(high, low + 1), np.array(shape) - 1)
    low = np.minimum(low, high - 1)
    return np.array([low, [low[0], high[1]], high, [high[0], low[1]]])


def central_pixel(vertices: Any) -> Any:
    """Row and column of a pixel inside the polygon: its centroid if that lies inside."""
    from shapely import Polygon

    outline = Polygon(vertices)
    inside = outline.centroid if outline.contains(outline.centroid) else outline.representative_point()
    return np.rint([inside.x, inside.y]).astype(int)


def sample_pixels(coverage: Coverage, layout: Layout) -> FloatArray:
    """Row and column of covered pixels (n, 2) spread over the image, for fitting polynomials."""
    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    columns = columns[np.unique(np.linspace(0, columns.size - 1, FIT_POINTS).astype(int))]
    share = np.linspace(0, 1, FIT_POINTS)
    rows = first[columns] + np.multiply.outer(share, last[columns] - first[columns])
    return np.stack([rows.ravel(), np.broadcast_to(columns, rows.shape).ravel()], axis=1)


def _spans(coverage: Coverage, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """First and last covered row of every column of the file; first > last where no row is covered."""
    if layout.row_axis == 1:
        first, last, n = coverage.row_first, coverage.row_last, layout.shape[0]
    else:
        first, last, n = coverage.column_first, coverage.column_last, layout.shape[0]
    if layout.row.sum() < 0:
        first, last = n - 1 - last, n - 1 - first
    order = slice(None, None, int(layout.column.sum()))
    return first[order].astype(np.float64), last[order].astype(np.float64)
