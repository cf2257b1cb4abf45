"""What a terrain does to the pixels of an image: local incidence angle, visibility, and the area of a pixel.

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

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell_at, lit_yaw, turned_near
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.kernels.occlusion import STEPS, block_extremes, find_visibility

NODES = 257  # yaws between which the antenna's place at the middle of dwells is interpolated
PLACES_PER_SAMPLE = 4  # of the terrain, along each axis, at which visibility is found; pixels take the nearest
ROWS = 64  # of pixels whose angles are computed at a time
EDGE_NODES = 9  # a side of a window, for which the reach of shadow and layover is found
Box = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m


@dataclass(frozen=True, eq=False)
class Sight:
    """The antenna at the middle of the dwells of ground points, over their yaw.

    Attributes
    ----------
    nadir : (2,) float
        Origin of the yaw, m.
    yaw : (n,) float
        rad, ascending.
    position, velocity : (n, 3) float
        m, m/s.
    """

    nadir: FloatArray
    yaw: FloatArray
    position: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, geometry: Geometry) -> Sight:
        """The antenna of a collection whose beam is described by its yaw, or that is not steered."""
        collection = geometry.collection
        middle = sum(aperture(collection)) / 2
        if not collection.steered:
            yaw, time = np.zeros(1), np.array([middle])
        else:
            yaw = np.linspace(*lit_yaw(collection), NODES)
            first, last = dwell_at(geometry, yaw, np.zeros(1))
            time = np.where(np.isfinite(first) & np.isfinite(last), (first + last) / 2, middle)
            time = np.clip(time, *aperture(collection))
        return cls(geometry.nadir, yaw, geometry.track.position(time), geometry.track.velocity(time))

    def antenna(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Positions (..., 3), m, at the middle of the dwells of points x, y (...), m."""
        return self._at(self.position, x, y)

    def across(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Horizontal unit vectors (..., 2) across the track at the middle of the dwells of points x, y (...), m."""
        velocity = self._at(self.velocity, x, y)
        normal = np.stack([-velocity[..., 1], velocity[..., 0]], axis=-1)
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(float).tiny)

    def velocity_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Velocities (..., 3), m/s, at the middle of the dwells of points x, y (...), m."""
        return self._at(self.velocity, x, y)

    def _at(self, values: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        if self.yaw.size == 1:
            return np.broadcast_to(values[0], (*np.shape(x), 3))
        yaw = turned_near(np.arctan2(y - self.nadir[1], x - self.nadir[0]), float(self.yaw[0] + self.yaw[-1]) / 2)
        return np.stack([np.interp(yaw, self.yaw, column) for column in values.T], axis=-1)


def incidence_angle(terrain: Terrain, sight: Sight, x: FloatArray, y: FloatArray, z: FloatArray) -> NDArray[np.float32]:
    """Local incidence angles (n_y, n_x), rad, at columns x (n_x,) and rows y (n_y,) with heights z (n_y, n_x), m."""
    angle = np.empty(z.shape, np.float32)
    for first in range(0, y.size, ROWS):
        rows = slice(first, first + ROWS)
        along_x, along_y = terrain.slopes_on_grid(x, y[rows])
        ux, uy, uz = _sight(sight, x, y[rows], z[rows])
        cosine = uz - ux * along_x - uy * along_y
        cosine /= np.sqrt((1 + along_x**2 + along_y**2) * (ux * ux + uy * uy + uz * uz))
        angle[rows] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle


def gamma_factor(terrain: Terrain, sight: Sight, x: FloatArray, y: FloatArray) -> NDArray[np.float32]:
    """Factor of the power (n_y, n_x) that removes what slopes do; NaN where a surface faces away or stands on edge."""
    factor = np.empty((y.size, x.size), np.float32)
    for first in range(0, y.size, ROWS):
        rows = slice(first, first + ROWS)
        along_x, along_y = terrain.slopes_on_grid(x, y[rows])
        ux, uy, uz = _sight(sight, x, y[rows], terrain.on_grid(x, y[rows]))
        vx, vy, vz = np.moveaxis(sight.velocity_at(*np.meshgrid(x, y[rows])), -1, 0)
        across_x, across_y, across_z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx  # u x v
        # Only ratios to those of a level surface count, so that no normal needs to have unit length.
        incidence = 1 - (ux * along_x + uy * along_y) / uz
        with np.errstate(invalid="ignore", divide="ignore"):
            slant = 1 - (across_x * along_x + across_y * along_y) / across_z
            factor[rows] = np.where((slant > 0) & (incidence > 0), slant / incidence, np.nan)
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
    px, py = np.meshgrid(np.linspace(x[0], x[-1], EDGE_NODES), np.linspace(y[0], y[-1], EDGE_NODES))
    antenna, across, relief = sight.antenna(px, py), sight.across(px, py), limits[1] - limits[0]
    gap = np.stack([antenna[..., 0] - px, antenna[..., 1] - py], axis=-1)
    away, above = np.linalg.norm(gap, axis=-1), np.maximum(antenna[..., 2] - limits[1], 1.0)
    shadow = np.minimum(relief * away / above, away)
    side = (gap * across).sum(axis=-1)
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
    rows, at_row = _places(grid.y, window[0], terrain.dy)
    columns, at_column = _places(grid.x, window[1], terrain.dx)
    x, y = (part.ravel() for part in np.meshgrid(grid.x[columns], grid.y[rows]))
    antenna = sight.antenna(x, y) - np.stack([x, y, np.zeros(x.size)], axis=-1)
    heights = np.ascontiguousarray(terrain.heights, np.float64)
    found = np.empty(x.size, np.uint8)
    find_visibility(
        heights, *block_extremes(heights), np.array([terrain.dx, terrain.dy]),
        (x - terrain.x0) / terrain.dx - terrain.column, (y - terrain.y0) / terrain.dy - terrain.row,
        antenna, np.ascontiguousarray(sight.across(x, y)), min(terrain.dx, terrain.dy) / STEPS, found,
    )  # fmt: skip
    return found.reshape(rows.size, columns.size)[at_row][:, at_column]


def by_owner(
    sights: Mapping[int, Sight], owner: NDArray[np.int16], values: Callable[[Sight], NDArray[Any]], missing: float
) -> NDArray[Any]:
    """Values of pixels, each as seen from the block that `owner` says it comes from; `missing` where not covered."""
    present = {int(block): sights[int(block)] for block in np.unique(owner) if block >= 0}
    layer: NDArray[Any] | None = None
    for sight in {id(sight): sight for sight in present.values()}.values():
        found = values(sight)
        layer = np.full(owner.shape, missing, found.dtype) if layer is None else layer
        np.copyto(layer, found, where=np.isin(owner, [block for block, of in present.items() if of is sight]))
    return np.full(owner.shape, missing) if layer is None else layer


def _sight(sight: Sight, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Components of the vectors from pixels to the antenna, m, each (n_y, n_x)."""
    antenna = sight.antenna(*np.meshgrid(x, y))
    return antenna[..., 0] - x, antenna[..., 1] - y[:, None], antenna[..., 2] - z


def _places(axis: FloatArray, part: slice, step: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices along an axis at which visibility is found, and for every pixel of a part of it which of them counts."""
    spacing = float(axis[-1] - axis[0]) / max(axis.size - 1, 1)
    stride = max(int(step / PLACES_PER_SAMPLE / spacing), 1) if spacing > 0 else 1
    cell = np.arange(part.start, part.stop) // stride
    first = int(cell[0])
    return np.minimum(np.arange(first, int(cell[-1]) + 1) * stride + stride // 2, axis.size - 1), cell - first
