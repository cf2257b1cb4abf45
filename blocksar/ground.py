"""Geometric correction: a focused block, range by Doppler, to calibrated ground pixels.

Where each ground point focuses, with what phase and what gain, is known from traced lines (`GroundMap`).
Over a small tile of pixels each of these is a polynomial of low degree in (x, y), even the carrier's
phase; so a compiled loop does per pixel two Horner schemes, an interpolation and one phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.polynomial import chebyshev

from blocksar import phase
from blocksar.fourier import Axis, run_groups
from blocksar.geometry import Geometry
from blocksar.lines import Focus, RowPhase
from blocksar.parameters import SPEED_OF_LIGHT, ComplexArray, FloatArray

TILE_DEGREE = 5
TILE_PIXELS = 64
TILE_EXTENT = 150.0  # m: over this much, at most, the tile polynomials hold to a millicycle
TILE_GROUP = 16  # tiles done in one go by a thread
YAW_STEPS = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A smooth function of (epoch range, yaw): a tensor Chebyshev series."""

    series: FloatArray
    near: float
    far: float
    low: float
    high: float

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        u = (2 * epoch_range - self.near - self.far) / (self.far - self.near)
        v = (2 * yaw - self.low - self.high) / (self.high - self.low)
        return np.asarray(chebyshev.chebval2d(u, v, self.series))


def fit_surface(values: FloatArray, *, epoch_range: FloatArray, yaw: FloatArray, degree: tuple[int, int]) -> Surface:
    """Least-squares tensor series through values (n_range, n_yaw) on a grid that spans the domain."""
    near, far, low, high = epoch_range[0], epoch_range[-1], yaw[0], yaw[-1]
    u = (2 * epoch_range - near - far) / (far - near)
    v = (2 * yaw - low - high) / (high - low)
    in_range = chebyshev.chebfit(u, values, min(degree[0], u.size - 1))
    series = chebyshev.chebfit(v, in_range.T, min(degree[1], v.size - 1)).T
    return Surface(series=np.asarray(series), near=float(near), far=float(far), low=float(low), high=float(high))


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundMap:
    """Where a block's image holds each ground point, and its complex value there for a unit target.

    Attributes
    ----------
    geometry : Geometry
    low, high : float
        Yaw interval that this block owns, [low, high), rad.
    near, far : float
        Epoch ranges that it owns, [near, far), m.
    origin : float
        Range origin, m.
    rows, doppler : Axis
        Of the focused block.
    range_offset : Surface
        Apparent range of the focus less (epoch range - origin), m.
    doppler_focus : Surface
        Hz.
    phase : Surface
        Of the focus, cycles, less the carrier's -2 fc / c (epoch range - origin).
    gain : Surface
    time : Surface
        Middle of the dwell after all steps, s: the carrier of a target's response along Doppler.
    common : RowPhase or None
        Phase that the image has been given along Doppler, the same in all rows.
    yaw_axis : (n,) float
        Uniform yaws from low to high, rad, for the two limits and the number of lit pulses.
    near_limit, far_limit : (n,) float
        Epoch ranges that the range window holds at each yaw, m.
    lit : (n,) float
        Lit valid pulses at each yaw.
    scale : float
        n_range_frequency / period of the range transform.
    """

    geometry: Geometry
    low: float
    high: float
    near: float
    far: float
    origin: float
    rows: Axis
    doppler: Axis
    range_offset: Surface
    doppler_focus: Surface
    phase: Surface
    gain: Surface
    time: Surface
    common: RowPhase | None
    yaw_axis: FloatArray
    near_limit: FloatArray
    far_limit: FloatArray
    lit: FloatArray
    scale: float
    range_taps: tuple[int, float]
    doppler_taps: tuple[int, float]

    @property
    def middle_yaw(self) -> float:
        return (self.low + self.high) / 2

    def relative_yaw(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Yaw less the block's middle, wrapped to +-pi."""
        turn = self.geometry.yaw(x, y) - self.middle_yaw
        return turn - 2 * np.pi * np.rint(turn / (2 * np.pi))

    def doppler_slope(self) -> FloatArray:
        """Doppler of the focus per yaw, Hz/rad, over the block's ranges and yaws (9, 33)."""
        rng = np.linspace(self.near, self.far, 9)
        yaw = np.linspace(self.low, self.high, 33)
        rng_, yaw_ = np.meshgrid(rng, yaw, indexing="ij")
        return np.gradient(self.doppler_focus(rng_, yaw_), yaw, axis=1)

    def locate(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        """Row and Doppler index, phase (cycles), gain, relative yaw and dwell time (cycles a Doppler sample)."""
        geometry = self.geometry
        epoch_range = geometry.epoch_range(x, y)
        turn = self.relative_yaw(x, y)
        yaw = self.middle_yaw + turn
        offset = epoch_range - self.origin
        rng = offset + self.range_offset(epoch_range, yaw)
        doppler = self.doppler_focus(epoch_range, yaw)
        carrier = -2 * geometry.collection.carrier / SPEED_OF_LIGHT * offset
        cycles, time = carrier + self.phase(epoch_range, yaw), self.time(epoch_range, yaw)
        if self.common is not None:
            given, rate, _ = self.common.evaluate(rng, doppler[..., None])
            cycles, time = cycles + given[..., 0], time - rate[..., 0]
        return (
            self.rows.position(rng),
            self.doppler.position(doppler),
            cycles,
            self.gain(epoch_range, yaw),
            turn,
            time * self.doppler.step,
        )


def surfaces(
    focus: Focus, *, epoch_range: FloatArray, yaw: FloatArray, origin: float, carrier: float, degree: tuple[int, int]
) -> tuple[Surface, Surface, Surface, Surface, Surface]:
    """Range offset, Doppler, phase, gain and time over (epoch range, yaw) from traced and focused lines."""
    offset = (epoch_range - origin)[:, None]
    carrier_cycles = -2 * carrier / SPEED_OF_LIGHT * offset
    grid = {"epoch_range": epoch_range, "yaw": yaw, "degree": degree}
    return (
        fit_surface(focus.range - offset, **grid),  # type: ignore[arg-type]
        fit_surface(focus.doppler, **grid),  # type: ignore[arg-type]
        fit_surface(focus.phase - carrier_cycles, **grid),  # type: ignore[arg-type]
        fit_surface(focus.gain, **grid),  # type: ignore[arg-type]
        fit_surface(focus.time, **grid),  # type: ignore[arg-type]
    )


def correct(block: ComplexArray, ground: GroundMap, *, x: FloatArray, y: FloatArray, threads: int = 1) -> ComplexArray:
    """Resample a focused block to ground pixels; NaN where this block owns none.

    Parameters
    ----------
    block : (rows.size, doppler.size) complex64
        Focused.
    x : (n_x,) float
        m, uniform.
    y : (n_y,) float
        m, uniform.

    Returns
    -------
    (n_y, n_x) complex64
        Calibrated: a unit target reads 1 + 0j at its place.
    """
    step = max(abs(x[1] - x[0]) if x.size > 1 else 0.0, abs(y[1] - y[0]) if y.size > 1 else 0.0, 1e-6)
    # Tiles overlap the block's edges; a surface must not be asked for far beyond the domain that it was fitted on.
    narrow = ground.geometry.ground_point(
        np.array(max(ground.near, float(ground.near_limit.min()))), np.array(ground.middle_yaw)
    )
    across = (ground.high - ground.low) * float(np.hypot(*(narrow[:2] - ground.geometry.nadir)))
    reach = min(TILE_EXTENT, across / 8, (ground.far - ground.near) / 8)
    tile = int(np.clip(reach / step, 1, TILE_PIXELS))
    out = np.full((y.size, x.size), np.nan + 1j * np.nan, np.complex64)
    tiles = _tiles(ground, x, y, tile)
    if tiles.shape[0] == 0:
        return out
    coefficients = _tile_polynomials(ground, x, y, tiles, tile)
    range_table = phase.interpolation_taps(ground.range_taps[0], occupancy=ground.range_taps[1])
    doppler_table = phase.interpolation_taps(ground.doppler_taps[0], occupancy=ground.doppler_taps[1])
    px, py, pz = ground.geometry.epoch_position
    nx, ny = ground.geometry.nadir
    height2 = float((pz - ground.geometry.collection.ground_height) ** 2)
    # Ownership is decided by the side of the two seam rays that a pixel is on: the neighbouring block
    # computes the same products with the same numbers, so every pixel has exactly one owner.
    edges = np.array([np.cos(ground.low), np.sin(ground.low), np.cos(ground.high), np.sin(ground.high)])
    lit = 1.0 / np.maximum(ground.lit, 1e-9) / ground.scale
    lit[ground.lit <= 0] = np.nan
    yaw_start = float(ground.yaw_axis[0] - ground.middle_yaw)
    yaw_step = float(ground.yaw_axis[1] - ground.yaw_axis[0])
    frame = np.array([nx, ny, px, py, height2, ground.near, ground.far])
    # Copies: what has travelled to a worker is read-only, for which the loop would be compiled once more.
    x, y, near_limit, far_limit = (np.array(values) for values in (x, y, ground.near_limit, ground.far_limit))

    def resample(some: slice) -> None:
        _resample(
            block.view(np.float32), out, tiles[some], coefficients[some], x, y, tile, range_table, doppler_table,
            edges, frame, yaw_start, yaw_step, near_limit, far_limit, lit,
        )  # fmt: skip

    # Python threads over groups of tiles, not numba's own: a dask worker may run several tasks in one process.
    run_groups(resample, [slice(i, i + TILE_GROUP) for i in range(0, tiles.shape[0], TILE_GROUP)], threads)
    return out


def _tiles(ground: GroundMap, x: FloatArray, y: FloatArray, tile: int) -> FloatArray:
    """First row and column of the tiles that the block may own pixels of, (n, 2) int64."""
    corners = np.stack(
        np.meshgrid(np.arange(0, y.size, tile), np.arange(0, x.size, tile), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    last_y = np.minimum(corners[:, 0] + tile, y.size) - 1
    last_x = np.minimum(corners[:, 1] + tile, x.size) - 1
    cy, cx = (y[corners[:, 0]] + y[last_y]) / 2, (x[corners[:, 1]] + x[last_x]) / 2
    radius = np.hypot(y[last_y] - y[corners[:, 0]], x[last_x] - x[corners[:, 1]]) / 2 + 1e-6
    rng = ground.geometry.epoch_range(cx, cy)
    turn = ground.relative_yaw(cx, cy)
    distance = np.hypot(cx - ground.geometry.nadir[0], cy - ground.geometry.nadir[1])
    half = (ground.high - ground.low) / 2
    slack = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1.0))
    near = max(ground.near, float(ground.near_limit.min()))
    far = min(ground.far, float(ground.far_limit.max()))
    keep = (np.abs(turn) <= half + slack) & (rng >= near - radius) & (rng <= far + radius)
    return np.ascontiguousarray(corners[keep])


def _tile_polynomials(ground: GroundMap, x: FloatArray, y: FloatArray, tiles: FloatArray, tile: int) -> FloatArray:
    """(n_tile, 6, degree + 1, degree + 1) power coefficients in tile coordinates (y, x) in [-1, 1]."""
    n = TILE_DEGREE + 1
    nodes = np.cos(np.pi * (np.arange(n) + 0.5) / n)[::-1]
    dx = x[1] - x[0] if x.size > 1 else 1.0
    dy = y[1] - y[0] if y.size > 1 else 1.0
    half = (tile - 1) / 2
    px = x[0] + dx * (tiles[:, 1, None, None] + half * (1 + nodes[None, None, :]))
    py = y[0] + dy * (tiles[:, 0, None, None] + half * (1 + nodes[None, :, None]))
    px, py = np.broadcast_arrays(px, py)
    to_power = np.linalg.inv(np.vander(nodes, n, increasing=True))
    values = np.stack(ground.locate(px, py), axis=1)
    return np.ascontiguousarray(np.einsum("ai,tqij,bj->tqab", to_power, values, to_power))


@njit(cache=True, nogil=True)
def _left(ray_x: float, ray_y: float, x: float, y: float) -> bool:
    """Whether a point is on a ray or to its left.

    Two products are compared, not their difference with zero: the compiler fuses a difference into a
    multiply-add, which rounds one way for one neighbour of a seam and another way for the other.
    """
    return ray_x * y >= ray_y * x


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _resample(  # type: ignore[no-untyped-def]
    floats, out, tiles, coefficients, x, y, tile, range_table, doppler_table, edges, frame,
    yaw_start, yaw_step, near_limit, far_limit, lit,
):  # fmt: skip
    n_row, n_doppler = floats.shape[0], floats.shape[1] // 2
    n_phase = range_table.shape[0] - 1
    rt, dt = range_table.shape[1], doppler_table.shape[1]
    nx, ny, px, py, height2, near, far = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5], frame[6]
    half = max((tile - 1) / 2, 0.5)
    degree = coefficients.shape[2] - 1
    along = np.empty((6, degree + 1))
    wr = np.empty(rt, np.float32)
    line = np.empty(2 * dt, np.float32)
    for t in range(tiles.shape[0]):
        i0, j0 = tiles[t, 0], tiles[t, 1]
        for i in range(i0, min(i0 + tile, out.shape[0])):
            v = (i - i0) / half - 1.0
            for q in range(6):
                for b in range(degree + 1):
                    total = 0.0
                    for a in range(degree, -1, -1):
                        total = total * v + coefficients[t, q, a, b]
                    along[q, b] = total
            yy = y[i]
            for j in range(j0, min(j0 + tile, out.shape[1])):
                xx = x[j]
                rx, ry = xx - nx, yy - ny
                if not _left(edges[0], edges[1], rx, ry) or _left(edges[2], edges[3], rx, ry):
                    continue
                epoch_range = np.sqrt((xx - px) ** 2 + (yy - py) ** 2 + height2)
                if epoch_range < near or epoch_range >= far:
                    continue
                u = (j - j0) / half - 1.0
                row, doppler, cycles, gain, turn, middle = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for b in range(degree, -1, -1):
                    row = row * u + along[0, b]
                    doppler = doppler * u + along[1, b]
                    cycles = cycles * u + along[2, b]
                    gain = gain * u + along[3, b]
                    turn = turn * u + along[4, b]
                    middle = middle * u + along[5, b]
                place = (turn - yaw_start) / yaw_step
                k = min(max(int(place), 0), lit.size - 2)
                part = min(max(place - k, 0.0), 1.0)
                if epoch_range < near_limit[k] + part * (near_limit[k + 1] - near_limit[k]):
                    continue
                if epoch_range > far_limit[k] + part * (far_limit[k + 1] - far_limit[k]):
                    continue
                weight = lit[k] if part < 0.5 else lit[k + 1]
                if np.isnan(weight):
                    continue
                r0, d0 = int(np.floor(row)), int(np.floor(doppler))
                first_row, first_doppler = r0 - (rt // 2 - 1), d0 - (dt // 2 - 1)
                if first_row < 0 or first_row + rt > n_row or first_doppler < 0 or first_doppler + dt > n_doppler:
                    continue
                a, b_ = (row - r0) * n_phase, (doppler - d0) * n_phase
                ia, ib = min(int(a), n_phase - 1), min(int(b_), n_phase - 1)
                da, db = np.float32(a - ia), np.float32(b_ - ib)
                for m in range(rt):
                    wr[m] = range_table[ia, m] + da * (range_table[ia + 1, m] - range_table[ia, m])
                for m in range(2 * dt):
                    line[m] = np.float32(0.0)
                for p in range(rt):
                    w = wr[p]
                    for m in range(2 * dt):
                        line[m] += w * floats[first_row + p, 2 * first_doppler + m]
                # Along Doppler the response rides on the carrier of its dwell time: out, sample by sample.
                re, im = np.float32(0.0), np.float32(0.0)
                for m in range(dt):
                    weight_m = doppler_table[ib, m] + db * (doppler_table[ib + 1, m] - doppler_table[ib, m])
                    turned = middle * (first_doppler + m - doppler)
                    carrier = np.float32(turned - np.rint(turned))
                    c, s = phase.cosine(carrier), phase.sine(carrier)
                    re += weight_m * (line[2 * m] * c - line[2 * m + 1] * s)
                    im += weight_m * (line[2 * m] * s + line[2 * m + 1] * c)
                phi = np.float32(-(cycles - np.rint(cycles)))
                c, s = phase.cosine(phi), phase.sine(phi)
                amplitude = np.float32(weight / gain)
                out[i, j] = complex(amplitude * (re * c - im * s), amplitude * (re * s + im * c))


def compile_kernels() -> None:
    """Compile this module's loop, or load it from numba's cache, by running it on no tiles."""
    table = phase.interpolation_taps(4, occupancy=0.5)
    line, tiles = np.zeros(2), np.zeros((0, 2), np.int64)
    _resample(
        np.zeros((1, 2), np.float32), np.zeros((1, 1), np.complex64), tiles, np.zeros((0, 6, 2, 2)), line, line, 1,
        table, table, np.zeros(4), np.zeros(7), 0.0, 1.0, line, line, line,
    )  # fmt: skip
