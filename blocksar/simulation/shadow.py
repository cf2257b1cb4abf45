"""Shadow: pulses that do not reach scatterers, since the terrain lies between them and the antenna.

A scatterer is hidden from a pulse if the ray from it to the antenna's place at that pulse passes below the terrain,
which is bilinear between its samples here, as in the layer `visibility` of images. Rays are followed for some pulses of
each dwell only, so close to each other that in between a ray moves over the terrain by less than half a sample; where a
scatterer is hidden from one of them and not from the next, the pulse at which that changes is found by bisection. So
each pulse is right, but for a scatterer that appears and disappears again within such an interval.

The terrain hides where it is known: a scene asks for it as far towards the antenna as `reach_of_shadow` says.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import TURN
from blocksar.ingestion.terrain.resampling import Box
from blocksar.kernels.occlusion import STEPS, block_extremes, find_shadow

RAYS = 1 << 18  # that are followed at a time
ROOM = 1.0  # dwells on either side of one that are looked at, as the dwell of a raised point may lie beside the plane's

Rays = Callable[[IntArray, IntArray], BoolArray]  # of scatterers and pulses: whether they are hidden


@dataclass(frozen=True, eq=False)
class Shadow:
    """The pulses that do not reach the scatterers of a field.

    Attributes
    ----------
    hidden : (n,) bool
        From the first pulses of each dwell.
    index, pulse : (m,) int
        Scatterers, ascending, and the pulses from which on they are not what they were before.
    """

    hidden: BoolArray
    index: IntArray
    pulse: IntArray

    def at(self, pulse: int, first: int, last: int) -> BoolArray:
        """Find which of the scatterers first <= i < last a pulse does not reach, (last - first,)."""
        a, b = np.searchsorted(self.index, [first, last])
        changed = self.index[a:b][self.pulse[a:b] <= pulse] - first
        return self.hidden[first:last] ^ (np.bincount(changed, minlength=last - first) % 2 == 1)


def cast_shadow(
    collection: Collection, terrain: Terrain, x: FloatArray, y: FloatArray, z: FloatArray, *, threads: int = 1
) -> Shadow | None:
    """Find the pulses that do not reach scatterers (n,) at x, y, z, m; None if all of a dwell's reach all of them.

    Parameters
    ----------
    collection : Collection
        With the antenna's places as they really were.
    terrain : Terrain
    threads : int
        Number of threads; the result does not depend on it.
    """
    terrain = terrain.thinned()
    rays = _rays(collection, terrain, x, y, z)
    first, last = _tested(collection, x, y)
    nodes = int((last - first).max()) // _pulses_between(collection, terrain) + 2
    size = max(RAYS // nodes, 1)
    groups = [np.arange(start, min(start + size, x.size)) for start in range(0, x.size, size)]
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(lambda group: _changes(rays, group, first[group], last[group], nodes), groups))
    hidden, index, pulse = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Shadow(hidden, index, pulse) if hidden.any() or index.size else None


def reach_of_shadow(
    track: FloatArray, x: tuple[float, float], y: tuple[float, float], limits: tuple[float, float]
) -> Box:
    """The box of the terrain that rays from a box of the ground to the antenna pass below its highest place, m.

    Parameters
    ----------
    track : (n, 3) float
        Places of the antenna, m.
    x, y : (float, float)
        The box of the ground, from .. to, m.
    limits : (float, float)
        Lowest and highest height of the whole terrain, m.
    """
    above = np.maximum(track[:, 2] - limits[0], 1.0)
    share = np.minimum((limits[1] - limits[0]) / above, 1.0)[:, None]  # of the way to below the antenna
    ends = [at + share * (track[:, axis, None] - at) for axis, at in ((0, np.array(x)), (1, np.array(y)))]
    low, high = ([float(pick(end)) for end in ends] for pick in (np.min, np.max))
    return (min(x[0], low[0]), max(x[1], high[0])), (min(y[0], low[1]), max(y[1], high[1]))


def _rays(collection: Collection, terrain: Terrain, x: FloatArray, y: FloatArray, z: FloatArray) -> Rays:
    """Return a function of scatterers (k,) and pulses (k,) that follows their rays."""
    heights = np.ascontiguousarray(terrain.heights, np.float64)
    low, high = block_extremes(heights)
    spacing, step = np.array([terrain.dx, terrain.dy]), min(terrain.dx, terrain.dy) / STEPS
    columns, rows = (x - terrain.x0) / terrain.dx - terrain.column, (y - terrain.y0) / terrain.dy - terrain.row

    def hidden(which: IntArray, pulses: IntArray) -> BoolArray:
        sight = collection.antenna_position[pulses] - np.stack([x[which], y[which], np.zeros(which.size)], axis=1)
        found = np.empty(which.size, np.bool_)
        find_shadow(heights, low, high, spacing, columns[which], rows[which], z[which], sight, step, found)
        return found

    return hidden


def _pulses_between(collection: Collection, terrain: Terrain) -> int:
    """Pulses during which a ray moves over the terrain by less than half a sample.

    At the horizontal distance s from its point, of d to the antenna, a ray moves by s / d of what the antenna does. It
    is above all of the terrain from s = relief d / height on, with the antenna's height over the highest point.
    """
    track = collection.antenna_position
    above, relief = float(track[:, 2].min()) - terrain.limits[1], terrain.limits[1] - terrain.limits[0]
    moved = float(np.sqrt((np.diff(track, axis=0) ** 2).sum(axis=1)).max()) * relief
    most = min(terrain.dx, terrain.dy) / STEPS * max(above, 0.0)
    return int(max(most / moved, 1.0)) if most < collection.n_pulse * moved else collection.n_pulse


def _tested(collection: Collection, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last pulse at which each scatterer may be lit: those of its dwell, with room."""
    end = collection.n_pulse - 1
    width, beam = collection.beam_width, collection.beam_azimuth
    round_about = not collection.has_axis and width is not None and abs(beam[-1] - beam[0]) + width >= TURN
    if width is None or round_about:
        return np.zeros(x.size, np.int64), np.full(x.size, end)
    firsts, lasts = Geometry(collection=collection).beam.passes(x, y)
    first, last = firsts[0], lasts[-1]
    room = np.ceil(ROOM * (last - first)).astype(np.int64)
    return np.clip(first - room, 0, end), np.clip(last + room, 0, end)


def _changes(
    rays: Rays, group: IntArray, first: IntArray, last: IntArray, nodes: int
) -> tuple[BoolArray, IntArray, IntArray]:
    """`hidden`, `index` and `pulse` of a group of scatterers, see `Shadow`, from so many pulses of each at first."""
    pulses = np.rint(first[:, None] + (last - first)[:, None] * np.linspace(0, 1, nodes)).astype(np.int64)
    hidden = rays(np.repeat(group, nodes), pulses.ravel()).reshape(pulses.shape)
    row, column = np.nonzero(hidden[:, 1:] != hidden[:, :-1])
    before, after, start = pulses[row, column], pulses[row, column + 1], hidden[row, column]
    while (open_ := np.flatnonzero(after - before > 1)).size:
        middle = (before[open_] + after[open_]) // 2
        same = rays(group[row[open_]], middle) == start[open_]
        before[open_[same]], after[open_[~same]] = middle[same], middle[~same]
    return hidden[:, 0], group[row], after
