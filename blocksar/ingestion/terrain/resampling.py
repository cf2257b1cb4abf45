"""Heights that are given on the Earth, as z on a grid of the scene frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.terrain import MARGIN, Terrain
from blocksar.errors import InputError
from blocksar.ingestion.terrain.frame_grid import MOST_HEIGHTS

HIGHER = 3000.0  # m: relief about an area that is looked for, above its own highest place
MOST_AROUND = 1 << 24  # heights of the terrain about an area: of a finer one, less far away

Box = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m
Limits = tuple[float, float]  # lowest and highest height, m


def read_around(
    terrain: Terrain, own: Box, needed: Callable[[Limits], Box], read: Callable[[Box], Terrain]
) -> Terrain | None:
    """The terrain as far as anything on it hides or overlies places of an area; None if `terrain` is all of that.

    Parameters
    ----------
    terrain : Terrain
        What is known of it, over the area.
    own : Box
        The area.
    needed : callable
        The box on which what is seen of the area depends, for a terrain between two heights.
    read : callable
        The terrain over a box, or what there is of it.
    """
    terrain = terrain.thinned()
    low, high = terrain.limits
    around = read(_within(needed((low, high + HIGHER)), own, terrain))
    for _ in range(2):  # with heights as they are there
        around = around.window(*needed(around.limits))
    extents = (terrain.x[0], terrain.x[-1]), (terrain.y[0], terrain.y[-1])
    beyond = (around.x[0], around.x[-1]), (around.y[0], around.y[-1])
    covered = all(a[0] <= b[0] and b[1] <= a[1] for a, b in zip(extents, beyond, strict=True))
    return None if covered else around


def _within(box: Box, own: Box, terrain: Terrain) -> Box:
    """A box, drawn back towards the area's until it has no more heights than are taken."""
    share = 1.0
    while True:
        drawn = [
            (inner[0] + share * (outer[0] - inner[0]), inner[1] + share * (outer[1] - inner[1]))
            for outer, inner in zip(box, own, strict=True)
        ]
        count = [(side[1] - side[0]) / step for side, step in zip(drawn, (terrain.dx, terrain.dy), strict=True)]
        if share < 0.01 or count[0] * count[1] <= max(MOST_AROUND, terrain.heights.size):
            return drawn[0], drawn[1]
        share *= 0.8


STEPS = 4  # of the iteration for z: each leaves the square of the angle between z and the vertical
STRIP = 1 << 18  # heights that are computed at a time
REFINED = 2  # samples to one of the file's, along each axis: cubic convolution between them adds a hundredth
MOST_REFINED = 1 << 24  # heights: of more, only one to one of the file's
NODE_SPACING = 1000.0  # m, at most, of places at which maps of the Earth are computed; cubic in between
LEAST_NODES = 9  # along each axis
LEVELS = 3  # heights at which they are computed; a parabola in between
ROOM = 100.0  # m, by which these heights reach beyond those of the file
BENT = 1.0  # posts, by which a map may bend between three nodes; one that breaks is computed at every place

# Of a frame's x, y (n,) and z, m: row and column in the file, and the height over the file's datum, m, each (n,).
ToFile = Callable[[FloatArray, FloatArray, float], tuple[FloatArray, FloatArray, FloatArray]]
Maps = list[list[FloatArray]]  # of row, column and height: constant, rate and bend over z


def lattice(side: tuple[float, float], step: float) -> tuple[float, int]:
    """Start, m, and count of multiples of a step that reach MARGIN steps beyond a side of a box."""
    start = float(np.floor(side[0] / step - MARGIN) * step)
    return start, int(np.ceil((side[1] - start) / step)) + MARGIN + 1


def resample(posts: FloatArray, to_file: ToFile, step: float, box: Box, *, refine: bool) -> Terrain:
    """A file's heights on a grid over a box and MARGIN steps beyond; z is such that each point has its own height.

    A height is known where the four posts about its place are (`kernels.posts`).

    Parameters
    ----------
    posts : (n_row, n_column) float
        m over the file's datum; NaN where unknown.
    to_file : callable
    step : float
        Spacing of the posts, m.
    box : ((float, float), (float, float))
        x and y, from .. to, m.
    refine : bool
        Whether to take REFINED heights to a post along each axis, if these are not too many.
    """
    from blocksar.kernels.posts import continued, heights_between  # loads numba, which only GeoTIFF needs

    (x0, n_x), (y0, n_y) = (lattice(side, step) for side in box)
    if n_x * n_y > MOST_HEIGHTS:
        raise InputError(f"terrain: {n_y} x {n_x} heights within the image are too many; give a coarser file")
    times = REFINED if refine and n_x * n_y * REFINED**2 <= MOST_REFINED else 1
    step = step / times
    x, y = (np.asarray(start + step * np.arange(times * (n - 1) + 1)) for start, n in ((x0, n_x), (y0, n_y)))
    known = posts[np.isfinite(posts)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    drop = float(to_file(np.array([sum(box[0]) / 2]), np.array([sum(box[1]) / 2]), 0.0)[2][0])
    levels = np.linspace(low - drop - ROOM, high - drop + ROOM, LEVELS)
    maps, filled, z = _mapper(to_file, x, y, levels), continued(posts), np.empty((y.size, x.size))

    def between(row: FloatArray, column: FloatArray) -> FloatArray:
        return heights_between(posts, filled, row=row.ravel(), column=column.ravel()).reshape(row.shape)

    for first in range(0, y.size, max(STRIP // x.size, 1)):
        rows = slice(first, first + max(STRIP // x.size, 1))
        z[rows] = _solve(between, maps(y[rows]), levels)
    return Terrain(x0=x0, dx=step, y0=y0, dy=step, heights=z, refined=times)


def _solve(between: Callable[[FloatArray, FloatArray], FloatArray], maps: Maps, levels: FloatArray) -> FloatArray:
    """z (n_y, n_x) with the file's heights at the places that it is mapped to; NaN where there are none."""
    z = np.full(maps[0][0].shape, levels[1])
    for _ in range(STEPS):
        known = np.where(np.isfinite(z), z, levels[1])
        at = (known - levels[1]) / (levels[2] - levels[1])
        row, column, height = (constant + at * (rate + at * bend) for constant, rate, bend in maps)
        z = known + between(row, column) - height
    return z


def _mapper(to_file: ToFile, x: FloatArray, y: FloatArray, levels: FloatArray) -> Callable[[FloatArray], Maps]:
    """A function of some of the rows y (n_y,), m, that gives what `to_file` does there."""

    def exact(x: FloatArray, y: FloatArray) -> list[list[FloatArray]]:
        mesh = np.meshgrid(x, y)
        values = [to_file(mesh[0].ravel(), mesh[1].ravel(), level) for level in levels.tolist()]
        return [[each[k].reshape(mesh[0].shape) for each in values] for k in range(3)]

    nodes = [_nodes(axis) for axis in (x, y)]
    found = exact(*nodes)
    bends = [np.abs(np.diff(each, 2, axis)).max() for axis in (0, 1) for of in found[:2] for each in of]
    if not max(bends) < BENT:  # where longitudes jump, say; NaN too
        return lambda rows: [_parabola(values) for values in exact(x, rows)]
    (x0, dx), (y0, dy) = ((float(axis[0]), float(axis[1] - axis[0])) for axis in nodes)
    smooth = [[Terrain(x0=x0, dx=dx, y0=y0, dy=dy, heights=each) for each in of] for of in found]
    return lambda rows: [_parabola([each.on_grid(x, rows) for each in of]) for of in smooth]


def _nodes(axis: FloatArray) -> FloatArray:
    """Uniform places about an axis, which reach beyond it, so that rounding leaves none outside."""
    count = max(int(np.ceil((axis[-1] - axis[0]) / NODE_SPACING)) + 1, LEAST_NODES)
    room = 0.01 * (axis[-1] - axis[0]) / count
    return np.linspace(axis[0] - room, axis[-1] + room, count)


def _parabola(values: list[FloatArray]) -> list[FloatArray]:
    """Constant, rate and bend of the parabola that has three values at -1, 0 and 1."""
    low, middle, high = values
    return [middle, (high - low) / 2, (high + low) / 2 - middle]
