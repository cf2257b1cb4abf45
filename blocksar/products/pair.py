"""Two finished runs on one grid: the check of that, and their joint products, by chunks of the images."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.axes import response_axes
from blocksar.measurement.interferometry import (
    Baseline,
    Windowed,
    changed,
    coherence_of_median,
    independent_pixels,
    mean_estimate,
    over_window,
    sides_at,
    threshold,
    vertical_wavenumber,
)
from blocksar.measurement.multilooking import multilook, power_of
from blocksar.measurement.side_lobes import REACH, side_lobe_power
from blocksar.places.place import Place
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.runs.folder import find_input
from blocksar.stores import Variable
from blocksar.stores.contract import X, Y
from blocksar.version import __version__

SAME = 1e-3  # of a pixel, that the grids may lie apart
NODES = 32  # pixels between the points at which the vertical wavenumber is computed
SAME_HEIGHT = 0.01  # m, that their grounds may
HEIGHTS = 129  # points along either axis at which these are compared
SAMPLED = 64  # chunks, evenly over the image, from which the scene's coherence is estimated
BINS = 2000  # of the histogram of coherences
CLEAR = 0.7  # coherence that noise and side lobes leave of the pixels whose median tells that of the scene

PAIR = {
    "interferogram": Variable(
        ("y", "x"), "complex64", "1", "mean of a conj(b) over the window; NaN where one is not covered", compressed=True
    ),
    "coherence": Variable(("y", "x"), "float32", "1", "estimated coherence over the window", compressed=True),
    "amplitude_ratio": Variable(
        ("y", "x"), "float32", "1", "root of the mean power of b over that of a, over the window", compressed=True
    ),
    "vertical_wavenumber": Variable(
        ("y", "x"), "float32", "rad m-1", "phase of the interferogram for a metre of height over the imaged ground",
        compressed=True,
    ),
    "change": Variable(
        ("y", "x"), "uint8", "1", "coherent change from a to b; 255 where one is not covered", compressed=True,
        flags=("unchanged", "changed", "not_judged"),
    ),
    "x": X,
    "y": Y,
}  # fmt: skip
PIXEL_BYTES = 8 + 3 * 4 + 1  # of a pixel of a pair, at most


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two runs whose pixels show the same ground.

    Attributes
    ----------
    a, b : FinishedRun
        The earlier image, and the later one, as is said: neither is changed.
    window : (int, int)
        Pixels along y and x, odd, over which coherence is estimated.
    false_alarms : float
        Probability that an unchanged pixel is called changed.
    """

    a: FinishedRun
    b: FinishedRun
    window: tuple[int, int]
    false_alarms: float

    def __post_init__(self) -> None:
        check_same_ground(self.a, self.b)
        for name, n, side in zip("yx", (self.a.y.size, self.a.x.size), self.window, strict=True):
            if side > n:
                raise InputError(
                    f"window of {side} pixels along {name} is larger than the image of {n}; give a smaller window"
                )

    @cached_property
    def middle(self) -> tuple[float, float]:
        """Point in the middle of the image, m."""
        return float(self.a.x[self.a.x.size // 2]), float(self.a.y[self.a.y.size // 2])

    @cached_property
    def baseline(self) -> Baseline:
        """Baseline in the middle of the image."""
        a, b = (run.geometry_at(*self.middle) for run in (self.a, self.b))
        return Baseline.at(a, b, *self.middle, self.a.weighting)

    @cached_property
    def looks(self) -> float:
        """Number of independent pixels in the window, in the middle of the image."""
        sides = sides_at(self.a.geometry_at(*self.middle), *self.middle)
        return max(independent_pixels(self.window, self.a.spacing[::-1], sides, self.a.weighting), 1.0)

    @property
    def chance(self) -> float:
        """Mean estimated coherence of incoherent images."""
        return float(mean_estimate(0.0, self.looks))

    def windows(self) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of the chunks of the image, row by row."""
        sides = self.chunk
        for y in range(0, self.a.y.size, sides[0]):
            for x in range(0, self.a.x.size, sides[1]):
                yield slice(y, min(y + sides[0], self.a.y.size)), slice(x, min(x + sides[1], self.a.x.size))

    @cached_property
    def chunk(self) -> tuple[int, int]:
        """Sides of a chunk of the image, and of what is written."""
        rows, columns = stores.chunk_shape(self.a.image, "image")[-2:]
        return rows, columns

    def over_window(self, rows: slice, columns: slice) -> Windowed:
        """Average the pair over the window about the pixels of a part of the image."""
        (top, own_rows), (left, own_columns) = (
            _widened(part, n, side // 2)
            for part, n, side in zip((rows, columns), (self.a.y.size, self.a.x.size), self.window, strict=True)
        )
        means = over_window(self.a.read(top, left), self.b.read(top, left), self.window)
        own = own_rows, own_columns
        return Windowed(means.inner[own], means.power_a[own], means.power_b[own])

    def left_for_ground(self, means: Windowed, rows: slice, columns: slice) -> FloatArray:
        """Coherence that noise and bright places' side lobes leave if the ground has not changed.

        Each image has the power s of the ground, the same in both, and n of noise, where that is known, and of the side
        lobes (`measurement.side_lobes`) that turn otherwise from pass to pass: s / sqrt((s + n_a) (s + n_b)), with the
        mean of both for s. So a place that is bright in one image alone is still judged.
        """
        parts = [_unwanted(run, self.window, rows, columns) for run in (self.a, self.b)]
        ground = sum(p - n for n, p in zip(parts, (means.power_a, means.power_b), strict=True)) / 2
        ground = np.maximum(ground, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(ground / np.sqrt((ground + parts[0]) * (ground + parts[1])))

    def wavenumbers(self, rows: slice, columns: slice) -> FloatArray:
        """Vertical wavenumbers of an image part, rad/m; in mosaics by the segments that pixels come from."""
        owners = [_segments(run, rows, columns) for run in (self.a, self.b)]
        y, x = self.a.y[rows], self.a.x[columns]
        if all(owner is None for owner in owners):
            return _between(self.a, self.b, (0, 0), y, x)
        numbers = np.stack([np.zeros((y.size, x.size), np.int64) if owner is None else owner for owner in owners])
        found = np.full((y.size, x.size), np.nan)
        for pair in np.unique(numbers.reshape(2, -1), axis=1).T.tolist():
            if min(pair) >= 0:
                own = (numbers == np.array(pair)[:, None, None]).all(axis=0)
                found[own] = _between(self.a, self.b, (pair[0], pair[1]), y, x)[own]
        return found


def _widened(part: slice, n: int, by: int) -> tuple[slice, slice]:
    """Extend part of an axis of n pixels at both ends, and locate the part in the result."""
    first, last = max(part.start - by, 0), min(part.stop + by, n)
    return slice(first, last), slice(part.start - first, part.stop - first)


def _unwanted(run: FinishedRun, window: tuple[int, int], rows: slice, columns: slice) -> FloatArray:
    """Mean power of noise, if known, and of bright places' side lobes, in a window about pixels of a part."""
    x, y = float(run.x[columns].mean()), float(run.y[rows].mean())
    power = np.zeros((rows.stop - rows.start, columns.stop - columns.start))
    if (run.image / "noise_equivalent" / "zarr.json").exists():
        power += run.read_layer("noise_equivalent", rows, columns)
    axes = response_axes(run.geometry_at(x, y), x, y, run.weighting)
    if axes is not None:
        (top, own_rows), (left, own_columns) = (
            _widened(part, n, REACH) for part, n in zip((rows, columns), (run.y.size, run.x.size), strict=True)
        )
        # Side lobes hardly change within half a window, over whose whole the mean is taken.
        cell = max(window[0] // 2, 1), max(window[1] // 2, 1)
        pixels = run.read(top, left)
        beyond = [(0, -n % side) for n, side in zip(pixels.shape, cell, strict=True)]  # as what is not covered, 0
        coarse = multilook(np.pad(np.nan_to_num(power_of(pixels)), beyond), cell).astype(np.float64)
        lobes = side_lobe_power(coarse, axes, (run.spacing[0] * cell[1], run.spacing[1] * cell[0]), REACH // max(cell))
        lobes = lobes.repeat(cell[0], axis=0).repeat(cell[1], axis=1)[: top.stop - top.start, : left.stop - left.start]
        power += np.maximum(uniform_filter(lobes, window, mode="nearest")[own_rows, own_columns], 0.0)
    return power


def _segments(run: FinishedRun, rows: slice, columns: slice) -> NDArray[np.int64] | None:
    """Segment number of each pixel, -1 where not covered; None if the run has only one."""
    if not run.segments:
        return None
    blocks = run.read_block(rows, columns)
    found = np.full(blocks.shape, -1, np.int64)
    for block in np.unique(blocks[blocks >= 0]).tolist():
        found[blocks == block] = run.segment_of(block)
    return found


def _between(a: FinishedRun, b: FinishedRun, numbers: tuple[int, int], y: FloatArray, x: FloatArray) -> FloatArray:
    """Vertical wavenumber of two segments at pixels, interpolated between nodes."""
    first, second = (run.segments[n] if run.segments else run.geometry for run, n in zip((a, b), numbers, strict=True))
    nodes = [np.linspace(axis[0], axis[-1], max(-(-axis.size // NODES), 1) + 1) for axis in (y, x)]
    values = vertical_wavenumber(first, second, *reversed(np.meshgrid(*nodes, indexing="ij")))
    shares = [(axis - node[0]) / max(node[1] - node[0], 1e-300) for axis, node in zip((y, x), nodes, strict=True)]
    cells = [np.clip(share.astype(int), 0, node.size - 2) for share, node in zip(shares, nodes, strict=True)]
    (top, left), (down, right) = cells, (share - cell for share, cell in zip(shares, cells, strict=True))
    upper, lower = (values[row][:, left] * (1 - right) + values[row][:, left + 1] * right for row in (top, top + 1))
    return np.asarray(upper * (1 - down[:, None]) + lower * down[:, None])


class Made(NamedTuple):
    """Result of writing a pair: its store and figures.

    Attributes
    ----------
    median, scene : float
        Median of the estimated coherence where noise and side lobes leave at least CLEAR, and the coherence that it
        stands for.
    limit : float
        Below which a pixel without noise is changed; NaN if the scene is not coherent enough to tell.
    covered, judged, changed : int
        Pixels that both images cover, and of these those that are judged, and changed.
    """

    median: float
    scene: float
    limit: float
    covered: int
    judged: int
    changed: int


def write_pair(pair: Pair, out: Place, *, overwrite: bool, progress: Callback) -> Made:
    """Create the store of a pair, one chunk at a time.

    Raises
    ------
    InputError
        If `out` exists, or the images have no covered pixel in common.
    ProcessingError
        If it cannot be written.
    """
    parts = list(pair.windows())
    median = _median(pair, parts[:: -(-len(parts) // SAMPLED)])
    scene = expected = float(coherence_of_median(median, pair.looks))
    chance = float(threshold(0.0, pair.looks, 0.5))
    limit = float(threshold(scene, pair.looks, pair.false_alarms))
    if limit <= chance:
        limit = expected = float("nan")
    flags = np.zeros(256, np.int64)

    def fill(place: Place) -> None:
        for number, window in enumerate(parts, 1):
            means = pair.over_window(*window)
            estimate = means.coherence
            left = pair.left_for_ground(means, *window)
            flag = changed(estimate, threshold(expected * left, pair.looks, pair.false_alarms), chance)
            values = {
                "interferogram": means.inner, "coherence": estimate, "amplitude_ratio": means.amplitude_ratio,
                "vertical_wavenumber": np.where(np.isfinite(estimate), pair.wavenumbers(*window), np.nan),
                "change": flag,
            }  # fmt: skip
            for name, each in values.items():
                stores.write_region(place, name, window, each.astype(PAIR[name].dtype))
            flags[:] += np.bincount(flag.ravel(), minlength=256)
            progress(number, len(parts))

    stores.create(
        out, PAIR, sizes={}, coords={"x": pair.a.x, "y": pair.a.y}, attrs=_attributes(pair, scene, limit),
        chunks={"y": pair.chunk[0], "x": pair.chunk[1]}, fill=fill, overwrite=overwrite,
    )  # fmt: skip
    return Made(median, scene, limit, int(flags[:255].sum()), int(flags[:2].sum()), int(flags[1]))


def _median(pair: Pair, parts: Sequence[tuple[slice, slice]]) -> float:
    """Estimate the median coherence over parts of the image where noise and side lobes leave enough of it.

    Raises
    ------
    InputError
        If no pixel is covered by both.
    """
    counts = np.zeros((2, BINS), np.int64)
    for window in parts:
        means = pair.over_window(*window)
        estimate = means.coherence
        clear = pair.left_for_ground(means, *window) >= CLEAR
        for number, some in enumerate((np.isfinite(estimate), np.isfinite(estimate) & clear)):
            counts[number] += np.bincount((estimate[some] * (BINS - 1)).astype(np.int64), minlength=BINS)
    if not counts.any():
        raise InputError(f"{pair.a.folder} and {pair.b.folder} cover no pixel in common; give runs of the same ground")
    chosen = counts[1] if counts[1].any() else counts[0]
    return float((np.searchsorted(np.cumsum(chosen), chosen.sum() / 2) + 0.5) / BINS)


def _attributes(pair: Pair, scene: float, limit: float) -> dict[str, Any]:
    a, b, baseline = pair.a, pair.b, pair.baseline
    attrs = {
        "title": f"{a.title} and {b.title}",
        "Conventions": stores.CONVENTIONS,
        "history": stores.history_line(f"compared by blocksar {__version__}", None),
        "a": str(a.folder),
        "b": str(b.folder),
        "carrier_frequency": a.collection.carrier,
        "ground_height": a.ground_height,
        "window": list(pair.window),
        "independent_pixels": pair.looks,
        "coherence_of_chance": pair.chance,
        "coherence_of_scene": scene,
        "change_below": limit,
        "false_alarms": pair.false_alarms,
        "perpendicular_baseline": baseline.perpendicular,
        "displacement_of_a_radian": displacement(pair),
    }
    return attrs | {name: a.attrs[name] for name in ("georeference",) if name in a.attrs}


def displacement(pair: Pair) -> float:
    """Motion, m, away from the antenna after image a that changes the phase by a radian: lambda / (4 pi)."""
    return SPEED_OF_LIGHT / (4 * np.pi * pair.b.collection.carrier)


def check_same_ground(a: FinishedRun, b: FinishedRun) -> None:
    """Check that the pixels of two images show the same ground.

    Raises
    ------
    InputError
        If their frames, grids or grounds differ, with the command that makes them equal.
    """
    frames = [run.georeference for run in (a, b)], [run.attrs.get("frame") for run in (a, b)]
    for first, other in frames:
        if None not in (first, other) and first != other:
            raise InputError(
                f"{a.folder} and {b.folder} are in different frames ({first} and {other}); write both phase histories "
                "in one frame, with the same georeference, and focus them on one grid"
            )
    for name in "xy":
        axis, other = getattr(a, name), getattr(b, name)
        step = float(axis[-1] - axis[0]) / (axis.size - 1)
        if axis.shape != other.shape or np.abs(axis - other).max() > SAME * step:
            texts = (f"{each[0]:g} to {each[-1]:g} m in {each.size} pixels" for each in (axis, other))
            raise InputError(
                f"the grids differ: {name} runs from {next(texts)} in {a.folder}, and from {next(texts)} in "
                f"{b.folder}; {_remedy(a, b)}"
            )
    apart = _heights_apart(a, b)
    if not apart <= SAME_HEIGHT:
        raise InputError(
            f"the ground of {a.folder} and {b.folder} lies up to {apart:.3g} m apart, which would turn the phase; "
            f"{_remedy(a, b)}"
        )


def _heights_apart(a: FinishedRun, b: FinishedRun) -> float:
    """Largest difference, m, between the heights that two images assume, at points all over their grid."""
    axes = [np.linspace(axis[0], axis[-1], HEIGHTS) for axis in (a.x, a.y)]
    first, second = (np.asarray(run.geometry.height(*np.meshgrid(*axes))) for run in (a, b))
    return float(np.nanmax(np.abs(first - second), initial=0.0))


def _remedy(a: FinishedRun, b: FinishedRun) -> str:
    """Compose the command that focuses the second input on the first's grid."""
    spans = []
    for axis in (a.x, a.y):
        step = float(axis[-1] - axis[0]) / (axis.size - 1)
        spans.append(f"{float(axis[0]):.15g}:{float(axis[-1]) + step / 2:.15g}:{step:.15g}")
    settings = a.record.settings
    inputs = [str(find_input(b.folder, path)) for path in b.record.inputs] or [b.record.input.path]
    words = ["blocksar", "focus", *inputs, "--out", f"{b.folder}-on-the-grid-of-{a.folder.name}"]
    words += ["--grid", ",".join(spans)]
    for name in ("terrain", "surface", "vertical"):
        if settings.get(name) not in (None, "plane"):
            words += [f"--{name}", str(settings[name])]
    if a.geometry.terrain is None and a.ground_height != b.ground_height:
        words += ["--ground-height", f"{a.ground_height:.15g}"]
    for name in ("weighting_range", "weighting_azimuth"):
        if settings.get(name, "uniform") != "uniform":
            words += [f"--{name.replace('_', '-')}", str(settings[name])]
    return f"give the second the grid and ground of the first: `{shlex.join(words)}`"
