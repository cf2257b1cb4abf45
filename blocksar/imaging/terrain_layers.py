"""Layers of a terrain for the pixels of an image: local incidence angle, visibility, and the area of a pixel.

All are seen from the antenna at the middle of a point's dwell, with u the unit vector from the point to it, v the
antenna's velocity then, and n the upward normal of the terrain, which is interpolated as everywhere.

Local incidence angle: the angle between n and u. Above pi / 2 a surface faces away from the antenna.

Shadow: a place of the terrain that lies on the horizontal line from the point to below the antenna, nearer to the
antenna, is seen at a higher angle of elevation, so that the ray from the antenna to the point passes below it.

Layover: another place of the terrain has the same range and the same Doppler, so that both fall upon one sample. Places
of equal range and Doppler have equal (q - a) . v, with a the antenna: they lie in the plane through the point across
the track (whose climb is neglected). Along the terrain in that plane, range grows with the distance from the track,
unless something nearer to the track is not nearer in range, or something farther is not farther: exactly then the range
of the point occurs twice. The antenna sees one side of its track. A place counts also where it lies in shadow itself. A
point in shadow is not called layover, as it has no echo.

Area: a sample of the area A of the slant plane, spanned by u and v, holds the echo of A / cos psi of a surface, psi
between n and the slant plane's normal (Ulander, IEEE Trans. GRS 34(5), 1996): sigma0 = beta0 cos psi, and gamma0 =
sigma0 / cos theta with the local incidence theta. `gamma_factor` is cos psi / cos theta over that of a level surface at
the same point: times the image's power it removes what slopes do, and leaves level ground as it is. Broadside and with
slopes along range only, it is tan theta / tan theta0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.beam import aperture, lit_yaw, turned_near
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Taps, Terrain
from blocksar.kernels.occlusion import VISIBLE, HeightGrid, find_visibility, steepest_slope
from blocksar.kernels.terrain_rows import SeenGround, TerrainTaps, find_surface, sum_taps

NODES = 257  # yaws, or times, between which the antenna's place at the middle of dwells is interpolated
NODE_PIXELS = 32  # between which the antenna's place is linear
BOX_NODES = 65  # places along each side of a box between which these times are, under a beam about its axis
PLACES_PER_SAMPLE = 4  # of the terrain, along each axis, at which visibility is found; pixels take the nearest
ROWS = 64  # of pixels whose angles are computed at a time
EDGE_NODES = 9  # a side of a window, for which the reach of shadow and layover is found
Box = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m


def box_of(x: FloatArray, y: FloatArray) -> Box:
    """The box of an image's columns and rows, m."""
    return (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1]))


@dataclass(frozen=True, eq=False)
class Middles:
    """Slow time at the middle of dwells under a beam about its axis, at places of a box; linear in between.

    Attributes
    ----------
    x, y, z : (n,) float
        m, ascending and uniform.
    time : (n_z, n_y, n_x) float
        s
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    time: FloatArray

    @classmethod
    def over(cls, geometry: Geometry, box: Box, levels: tuple[float, float]) -> Middles:
        """Find the middles of dwells over a box, between two heights, m."""
        x, y = (np.linspace(low, max(high, low + 1.0), BOX_NODES) for low, high in box)
        z = np.array([levels[0], max(levels[1], levels[0] + 1.0)])
        start, end = aperture(geometry.collection)
        times = []
        for height in z.tolist():
            first, last = geometry.beam.dwell(*np.meshgrid(x, y), z=height, uncut=True)
            middle = (np.maximum(first, start) + np.minimum(last, end)) / 2
            times.append(np.clip(np.nan_to_num(middle, nan=(start + end) / 2), start, end))
        return cls(x, y, z, np.stack(times))

    def at(self, x: FloatArray, y: FloatArray, z: FloatArray | None) -> FloatArray:
        """Times of points (...), s; without z, m, and where that is NaN, at the middle height."""
        height = np.full_like(x, self.z.mean()) if z is None else np.where(np.isnan(z), self.z.mean(), z)
        (i, u), (j, v), (_, w) = (_between(axis, at) for axis, at in ((self.x, x), (self.y, y), (self.z, height)))
        low, high = (
            (t[j, i] * (1 - u) + t[j, i + 1] * u) * (1 - v) + (t[j + 1, i] * (1 - u) + t[j + 1, i + 1] * u) * v
            for t in self.time
        )
        return np.asarray(low * (1 - w) + high * w)


@dataclass(frozen=True, eq=False)
class Sight:
    """Antenna at the middle of the dwells of ground points, tabulated over yaw, or over slow time with `middles`.

    Attributes
    ----------
    nadir : (2,) float
        Origin of the yaw, m.
    along : (n,) float
        Yaws, rad, or with `middles` slow times, s; ascending.
    position, velocity : (n, 3) float
        m, m/s.
    middles : Middles or None
        Under a beam about its axis, whose dwells depend on range and height.
    """

    nadir: FloatArray
    along: FloatArray
    position: FloatArray
    velocity: FloatArray
    middles: Middles | None = None

    @classmethod
    def of(cls, geometry: Geometry, box: Box, levels: tuple[float, float]) -> Sight:
        """Tabulate the antenna of a collection for points in a box between two heights, m."""
        collection = geometry.collection
        middle, middles = sum(aperture(collection)) / 2, None
        if not collection.steered:
            yaw, time = np.zeros(1), np.array([middle])
        elif collection.has_axis:
            yaw = time = np.linspace(*aperture(collection), NODES)
            middles = Middles.over(geometry, box, levels)
        else:
            yaw = np.linspace(*lit_yaw(collection), NODES)
            first, last = geometry.beam.dwell_at(yaw, np.zeros(1))
            time = np.where(np.isfinite(first) & np.isfinite(last), (first + last) / 2, middle)
            time = np.clip(time, *aperture(collection))
        return cls(geometry.nadir, yaw, geometry.track.position(time), geometry.track.velocity(time), middles)

    def antenna(self, x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> FloatArray:
        """Positions (..., 3), m, at the middle of the dwells of points x, y, z (...), m; without z at a mean height."""
        return self._at(self.position, self._middle(x, y, z))

    def antenna_and_across(
        self, x: FloatArray, y: FloatArray, z: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Antenna positions, and horizontal unit vectors (..., 2) across the track at the same times."""
        middle = self._middle(x, y, z)
        velocity = self._at(self.velocity, middle)
        normal = np.stack([-velocity[..., 1], velocity[..., 0]], axis=-1)
        length = np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(float).tiny)
        return self._at(self.position, middle), normal / length

    def velocity_at(self, x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> FloatArray:
        """Velocities (..., 3), m/s, at the middle of the dwells of these points."""
        return self._at(self.velocity, self._middle(x, y, z))

    def _middle(self, x: FloatArray, y: FloatArray, z: FloatArray | None) -> FloatArray:
        """Coordinate in `along` of the middles of the points' dwells."""
        if self.along.size == 1:
            return np.broadcast_to(self.along[0], np.shape(x))
        if self.middles is not None:
            return self.middles.at(x, y, z)
        middle = float(self.along[0] + self.along[-1]) / 2
        return turned_near(np.arctan2(y - self.nadir[1], x - self.nadir[0]), middle)

    def _at(self, values: FloatArray, middle: FloatArray) -> FloatArray:
        if self.along.size == 1:
            return np.broadcast_to(values[0], (*middle.shape, 3))
        return np.stack([np.interp(middle, self.along, column) for column in values.T], axis=-1)


def heights_on_grid(terrain: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights as `Terrain.on_grid` gives them, to the bit, by a compiled loop."""
    in_x, in_y = terrain.taps_of(x, y)
    z = np.empty((y.size, x.size))
    sum_taps(_sums(terrain, in_x, in_y), z)
    z[~in_y[2]] = np.nan
    z[:, ~in_x[2]] = np.nan
    return z


class Strip(NamedTuple):
    """Windows of an image beside each other: their rows, and the columns of each, ascending and without gaps."""

    rows: slice
    columns: Sequence[slice]

    @property
    def whole(self) -> tuple[slice, slice]:
        """Bounding window of the strip."""
        return self.rows, slice(self.columns[0].start, self.columns[-1].stop)


def box_about(grid: Grid, window: tuple[slice, slice]) -> Box:
    """Box of a window of an image, m, extended to the nodes between which the antenna is interpolated."""
    nodes_x, nodes_y = (_positions(*axis) for axis in _axes(grid, window))
    return box_of(nodes_x, nodes_y)


def heights_and_angles(terrain: Terrain, sight: Sight, grid: Grid, strip: Strip) -> list[SeenGround]:
    """Heights, bit-identical to `heights_on_grid`, and incidence angles of the windows of a strip.

    It does not depend on which windows are asked for at once. The terrain is at least that of `box_about`.
    """
    x, y = grid.x[strip.whole[1]], grid.y[strip.rows]
    in_x, in_y = terrain.taps_of(x, y)
    up_x, up_y = terrain.rates_of(x, y, (in_x, in_y))
    heights, columns, along_x, rows, along_y = _sums(terrain, in_x, in_y)
    rate_x, rate_y = np.array(up_x[1]) / terrain.dx, np.array(up_y[1]) / terrain.dy
    at_x, at_y = (_positions(*axis) for axis in _axes(grid, strip.whole))
    antenna = sight.antenna(*np.meshgrid(at_x, at_y), None if sight.middles is None else terrain.on_grid(at_x, at_y))
    antenna = _between_nodes(antenna.transpose(2, 0, 1), strip.whole[1])
    (before, part), inside = _to_nodes(strip.rows), in_x[2].all() and in_y[2].all()
    found = []
    for window in strip.columns:
        own = slice(window.start - strip.columns[0].start, window.stop - strip.columns[0].start)
        shape = y.size, x[own].size
        surface = SeenGround(np.empty(shape), np.empty(shape, np.float32), np.empty(shape, np.float32))
        find_surface(
            TerrainTaps.of(heights, columns[own], along_x[:, own], rows, along_y),
            np.ascontiguousarray(rate_x[:, own]), rate_y, x[own], y, np.ascontiguousarray(antenna[..., own]), before,
            part, surface,
        )  # fmt: skip
        if not inside:
            for layer in surface:
                layer[~in_y[2]] = layer[:, ~in_x[2][own]] = np.nan
        found.append(surface)
    return found


class SlopeFactors(NamedTuple):
    """Effects of slopes on the echo of pixels (n_y, n_x), against level ground.

    Attributes
    ----------
    area : float
        Area of the point response on level ground at the same point over that on the surface; 1 on level ground.
    incidence : float
        Local incidence angle, rad.
    gamma : float
        `gamma_factor`.

    All are NaN where a surface faces away or stands on edge.
    """

    area: FloatArray
    incidence: FloatArray
    gamma: FloatArray


def slope_factors(terrain: Terrain, sight: Sight, x: FloatArray, y: FloatArray) -> SlopeFactors:
    """Find the factors at pixels of columns x (n_x,) and rows y (n_y,), m.

    With p the normal of the slant plane and m = (-dz/dx, -dz/dy, 1), a response covers p_z / p . m times the x and y
    that it does on level ground, and |m| times that of the surface: `area` is p . m / (p_z |m|).
    """
    along_x, along_y = terrain.slopes_on_grid(x, y)
    z = terrain.on_grid(x, y)
    ux, uy, uz = _sight(sight, x, y, z)
    vx, vy, vz = np.moveaxis(sight.velocity_at(*np.meshgrid(x, y), z), -1, 0)
    across_x, across_y, across_z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx  # u x v
    # Ratios to those of a level surface, so that no normal needs to have unit length.
    incidence = 1 - (ux * along_x + uy * along_y) / uz
    with np.errstate(invalid="ignore", divide="ignore"):
        slant = 1 - (across_x * along_x + across_y * along_y) / across_z
        seen = (slant > 0) & (incidence > 0)
        steepness = np.sqrt(1 + along_x**2 + along_y**2)
        angle = np.arccos(uz * incidence / (np.sqrt(ux**2 + uy**2 + uz**2) * steepness))
        found = slant / steepness, angle, slant / incidence
    return SlopeFactors(*(np.where(seen, factor, np.nan) for factor in found))


def level_incidence(sight: Sight, x: FloatArray, y: FloatArray, height: float) -> FloatArray:
    """Incidence angle (n_y, n_x), rad, of a plane at a height, m."""
    ux, uy, uz = _sight(sight, x, y, np.full((y.size, x.size), height))
    return np.asarray(np.arctan2(np.sqrt(ux**2 + uy**2), uz))


def gamma_factor(terrain: Terrain, sight: Sight, x: FloatArray, y: FloatArray) -> NDArray[np.float32]:
    """Factor (n_y, n_x) that removes the effect of slopes on power; NaN for surfaces that face away or are edge-on."""
    factor = np.empty((y.size, x.size), np.float32)
    for first in range(0, y.size, ROWS):
        rows = slice(first, first + ROWS)
        factor[rows] = slope_factors(terrain, sight, x, y[rows]).gamma
    return factor


def reach(sight: Sight, x: FloatArray, y: FloatArray, limits: tuple[float, float]) -> Box:
    """The box of the terrain on which the visibility of a window of the image depends, m.

    Parameters
    ----------
    x, y : (n,) float
        Columns and rows of the window, m.
    limits : (float, float)
        Lowest and highest height of the whole terrain, m.
    """
    px, py, antenna, across, gap, side, away = _outlook(sight, box_of(x, y))
    relief, above = limits[1] - limits[0], np.maximum(antenna[..., 2] - limits[1], 1.0)
    shadow = np.minimum(relief * away / above, away)
    flat, top = np.abs(side), np.maximum(antenna[..., 2] - limits[0], 1.0)
    # The circle of a range about the antenna, by heights that differ by all of the relief.
    nearer = flat - np.sqrt(np.maximum(flat**2 - 2 * above * relief - relief**2, 0.0))
    farther = np.sqrt(flat**2 + 2 * top * relief) - flat
    ends = [(px, py)]
    for way, direction in (
        (shadow, gap / np.maximum(away, 1.0)[..., None]),
        (nearer, across * np.sign(side)[..., None]),
        (-farther, across * np.sign(side)[..., None]),
    ):
        ends.append((px + way * direction[..., 0], py + way * direction[..., 1]))
    all_x, all_y = (np.concatenate([np.ravel(end[axis]) for end in ends]) for axis in (0, 1))
    return (float(all_x.min()), float(all_x.max())), (float(all_y.min()), float(all_y.max()))


class _Outlook(NamedTuple):
    """View from places (...), m, to the antenna, with the horizontal unit vector across its track.

    The horizontal way `gap` to the antenna is `side` across the track, and `away` long, m.
    """

    x: FloatArray
    y: FloatArray
    antenna: FloatArray
    across: FloatArray
    gap: FloatArray
    side: FloatArray
    away: FloatArray


def _look(sight: Sight, x: FloatArray, y: FloatArray, z: FloatArray | None) -> _Outlook:
    antenna, across = sight.antenna_and_across(x, y, z)
    gap = np.stack([antenna[..., 0] - x, antenna[..., 1] - y], axis=-1)
    return _Outlook(x, y, antenna, across, gap, (gap * across).sum(axis=-1), np.linalg.norm(gap, axis=-1))


@lru_cache(maxsize=4)
def _outlook(sight: Sight, box: Box) -> _Outlook:
    """View from a few places of a box, at a mean height; cached for `reach` and visibility."""
    (x0, x1), (y0, y1) = box
    return _look(sight, *np.meshgrid(np.linspace(x0, x1, EDGE_NODES), np.linspace(y0, y1, EDGE_NODES)), None)


def visibility(terrain: Terrain, sight: Sight, grid: Grid, window: tuple[slice, slice]) -> NDArray[np.uint8]:
    """Visibility of a window of an image: 0 visible, 1 layover, 2 shadow, 255 where the terrain has no height.

    It is found at places that depend on the grid and the terrain's step, and not on the window; every pixel takes the
    nearest one's. Where the terrain ends, nothing hides and nothing overlies.

    Parameters
    ----------
    terrain : Terrain
        At least that of `reach`.
    window : (slice, slice)
        Rows and columns of the grid.
    """
    terrain, x, y = terrain.thinned(), grid.x[window[1]], grid.y[window[0]]
    if _is_open(terrain, sight, x, y):
        return np.full((y.size, x.size), VISIBLE, np.uint8)
    rows, at_row = _places(grid.y, window[0], terrain.dy)
    columns, at_column = _places(grid.x, window[1], terrain.dx)
    x, y = (part.ravel() for part in np.meshgrid(grid.x[columns], grid.y[rows]))
    z = None if sight.middles is None else terrain(x, y)
    antenna, across = sight.antenna_and_across(x, y, z)
    antenna = antenna - np.stack([x, y, np.zeros(x.size)], axis=-1)
    found = np.empty(x.size, np.uint8)
    find_visibility(
        HeightGrid.of(terrain.heights, terrain.dx, terrain.dy), (x - terrain.x0) / terrain.dx - terrain.column,
        (y - terrain.y0) / terrain.dy - terrain.row, antenna, np.ascontiguousarray(across), found,
    )  # fmt: skip
    return found.reshape(rows.size, columns.size)[:, at_column][at_row]


def _is_open(terrain: Terrain, sight: Sight, x: FloatArray, y: FloatArray) -> bool:
    """Tell whether the terrain is nowhere steep enough for shadow or layover (`kernels.occlusion`).

    The slopes of curves are taken at a few places of the window, with room for what they change in between.
    """
    heights = np.ascontiguousarray(terrain.heights, np.float64)
    inside = terrain.x[0] <= x[0] and x[-1] <= terrain.x[-1] and terrain.y[0] <= y[0] and y[-1] <= terrain.y[-1]
    slope = float(steepest_slope(heights, terrain.dx, terrain.dy))
    if not inside or not np.isfinite(slope):
        return False
    outlook = _outlook(sight, box_of(x, y))
    if sight.middles is not None:
        outlook = _look(sight, outlook.x, outlook.y, terrain(outlook.x, outlook.y))
    antenna, side, away = outlook.antenna, np.abs(outlook.side), outlook.away
    least, most = antenna[..., 2] - terrain.limits[1], antenna[..., 2] - terrain.limits[0]
    if least.min() <= 0:
        return False
    ray, near = least / away, np.sqrt(np.maximum(side**2 + least**2 - most**2, 0.0)) / most  # less steep than far
    return all(slope < 0.99 * (part.min() - np.ptp(part) / 2) for part in (ray, near))


def _sums(terrain: Terrain, in_x: Taps, in_y: Taps) -> TerrainTaps:
    """Weighted rows of samples for the taps of columns and rows."""
    (columns, along_x, _), (rows, along_y, _) = in_x, in_y
    first, last = int(rows.min()), int(rows.max()) + 4
    return TerrainTaps.of(
        np.array(terrain.heights[first:last]), columns, np.array(along_x), rows - first, np.array(along_y)
    )


def by_owner(
    sights: Mapping[int, Sight], owner: NDArray[np.int16] | int, values: Callable[[Sight], NDArray[Any]], missing: float
) -> NDArray[Any]:
    """Evaluate pixels for the block that owns each; `missing` where not covered.

    `owner` may be the one block that all pixels come from.
    """
    if isinstance(owner, int):
        return values(sights[owner])
    layer: NDArray[Any] | None = None
    different = {id(sight): sight for sight in sights.values()}
    for sight in different.values():
        own = owner >= 0
        if len(different) > 1:
            own &= np.isin(owner, [block for block, of in sights.items() if of is sight])
        if own.any():
            found = values(sight)
            if own.all():
                return found
            layer = np.full(owner.shape, missing, found.dtype) if layer is None else layer
            np.copyto(layer, found, where=own)
    return np.full(owner.shape, missing) if layer is None else layer


def _between(axis: FloatArray, at: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Index of the sample of a uniform axis before each value (...), and the fraction of the step beyond it."""
    place = np.clip(np.nan_to_num((at - axis[0]) / (axis[1] - axis[0])), 0.0, axis.size - 1.0)
    before = np.minimum(place.astype(np.intp), axis.size - 2)
    return before, place - before


def _sight(sight: Sight, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Components of the vectors from pixels to the antenna, m, each (n_y, n_x).

    The antenna's place is linear between every NODE_PIXELS-th row and column: over those its way is next to straight.
    """
    (rows, to_row), (columns, to_column) = _nodes(y.size), _nodes(x.size)
    antenna = sight.antenna(*np.meshgrid(x[columns], y[rows]), z[np.ix_(rows, columns)])
    px, py, pz = (_expand(_expand(part, to_column, 1), to_row, 0) for part in np.moveaxis(antenna, -1, 0))
    return px - x, py - y[:, None], pz - z


def _axes(grid: Grid, window: tuple[slice, slice]) -> tuple[tuple[float, float, slice], tuple[float, float, slice]]:
    """First place and step, m, and the window's part, of the x and the y of an image."""
    return (grid.x0, grid.dx, window[1]), (grid.y0, grid.dy, window[0])


def _positions(start: float, step: float, part: slice) -> FloatArray:
    """Every NODE_PIXELS-th place of an axis about a part of it, m; the last may lie behind the axis."""
    first, last = part.start // NODE_PIXELS, (part.stop - 1) // NODE_PIXELS + 1
    return np.asarray(start + step * (NODE_PIXELS * np.arange(first, last + 1)))


def _to_nodes(part: slice) -> tuple[IntArray, FloatArray]:
    """Index in `_positions` before each index of a part of an axis, and the fraction of the step beyond it."""
    index = np.arange(part.start, part.stop)
    return index // NODE_PIXELS - part.start // NODE_PIXELS, index % NODE_PIXELS / NODE_PIXELS


def _between_nodes(values: FloatArray, part: slice) -> FloatArray:
    """Values (..., n) at the places of `_positions`, at every index of the part of the axis: linear in between."""
    low, way = values[..., :-1, None], np.arange(NODE_PIXELS) / NODE_PIXELS
    cells = low + way * (values[..., 1:, None] - low)
    first = part.start % NODE_PIXELS
    return np.asarray(cells.reshape(*values.shape[:-1], -1)[..., first : first + part.stop - part.start])


def _nodes(n: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Every NODE_PIXELS-th of n pixels and the last; and the place (n,) of each pixel between them."""
    nodes = np.unique(np.append(np.arange(0, n, NODE_PIXELS), n - 1))
    return nodes, np.interp(np.arange(n), nodes, np.arange(nodes.size))


def _expand(values: FloatArray, place: FloatArray, axis: int) -> FloatArray:
    """Values at places between those along an axis."""
    before = np.minimum(place.astype(np.intp), max(values.shape[axis] - 2, 0))
    part = (place - before)[:, None] if axis == 0 else place - before
    low = np.take(values, before, axis)
    after = np.minimum(before + 1, values.shape[axis] - 1)
    return np.ascontiguousarray(low + part * (np.take(values, after, axis) - low))


def _places(axis: FloatArray, part: slice, step: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices along an axis at which visibility is computed, and for every pixel the one that it takes."""
    spacing = float(axis[-1] - axis[0]) / max(axis.size - 1, 1)
    stride = max(int(step / PLACES_PER_SAMPLE / spacing), 1) if spacing > 0 else 1
    cell = np.arange(part.start, part.stop) // stride
    first = int(cell[0])
    return np.minimum(np.arange(first, int(cell[-1]) + 1) * stride + stride // 2, axis.size - 1), cell - first
