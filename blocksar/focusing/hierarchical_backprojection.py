"""The image of a part of the grid by hierarchical back-projection: `hierarchy` down to the last parts, and their sums.

The image is the one that `backprojection` defines, with the same lit pulses, weights, gains and missing samples; only
the sums over pulses and range frequencies are formed from decimated data.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.backprojection import PixelSums, ReadPulses, pulse_blocks
from blocksar.focusing.hierarchy import Echoes, Hierarchy, Levels, Part
from blocksar.focusing.profiles import MARGIN, spline_lead
from blocksar.kernels.device import CPU, Device, on_device
from blocksar.kernels.fourier import fast_length
from blocksar.kernels.groups import Scratch, row_groups, run_groups
from blocksar.kernels.projection import BeamTaper, LitPixels, Sights

SAFE = 0.45  # of the unambiguous window: ranges that stay within are interpolated without a test of each
NOTICED = 1e-4  # of a taper's terms: waves of the weights that a filter has to pass
PULSE_BLOCK_BYTES = 16 * 1024**2  # samples that are read at a time
CHECKED = 8  # pixels a side of the parts of which each pixel is tested for the unambiguous window
MOST_WINDOWS = 16  # that are formed from the same echoes
SAMPLED = 16  # places along the side of a window at which it is found which pulses light it
Window = tuple[slice, slice]
Outlined = tuple[Window, list[Part]]  # with what lights it, pass by pass


def form_windows(
    read: ReadPulses,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    windows: Sequence[Window],
    *,
    levels: Levels,
    threads: int,
    weighting: Weighting = UNIFORM,
    device: str = "cpu",
    memory: int = 0,
) -> Iterator[tuple[Window, ComplexArray]]:
    """Form windows of the image, one after the other, from one reading of the samples.

    Parameters
    ----------
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses, NaN where they are missing.
    geometry : Geometry
    x, y : (n_column,), (n_row,) float
        Columns and rows of the grid, m, scene frame.
    windows : sequence of (slice, slice)
        Rows and columns of each, together a compact part of the grid.
    levels : Levels
    threads : int
        The result does not depend on it.
    weighting : Weighting
    device : "cpu" or "gpu"
    memory : int
        Of a GPU that may be taken, bytes; 0: all.

    Yields
    ------
    window : (slice, slice)
    image : (n_row, n_column) complex64
        Of each window, in an order that depends on the windows only, as `backprojection.form_image` defines it.
    """
    whole = [(window, _outline(geometry, x, y, window)) for window in windows]
    # A single window knows itself which pulses light it.
    parts = _joined([outline for _, outline in whole]) if len(windows) > 1 else []
    with on_device(device, memory) as opened:
        former = _Former(geometry, levels, weighting, opened)
        tops = [former.gather(read, part, threads) for part in parts]
        yield from former.windows(read, x, y, whole, tops, threads)


def _outline(geometry: Geometry, x: FloatArray, y: FloatArray, window: Window) -> list[Part]:
    """Passes that light a window, from a few places of it.

    Between these, pulses may begin and end earlier and later by as much as from one to the next: so many are taken for
    edges besides. What that misses after all is noticed by `_Former.window`.
    """
    rows, columns = (np.unique(np.linspace(part.start, part.stop - 1, SAMPLED).astype(int)) for part in window)
    mesh_x, mesh_y = np.meshgrid(x[columns], y[rows])
    z, _ = geometry.known_height(mesh_x, mesh_y)
    parts = []
    for first, last in zip(*geometry.beam.passes(mesh_x, mesh_y), strict=True):
        seen = Part(x=x[columns], y=y[rows], z=z, first=first, last=last)
        leave_outside(geometry, seen)
        (begin, end), (start, stop) = seen.lit()
        lit, apart = begin < end, 2 + max(_apart(ends, last > first) for ends in (first, last))
        n = geometry.collection.n_pulse
        free = begin == 0 and start == 0, end == n and stop == n  # all of the collection lights it
        begin, end = max(begin - apart, 0), min(end + apart, n)
        start, stop = (0 if free[0] else start + apart), (n if free[1] else stop - apart)
        # Two places that say as much: where no pulse lights all of the window, none lights both.
        ends = [(begin, end), (start, stop)] if start < stop else [(begin, begin + 1), (end - 1, end)]
        ends = ends if lit else [(0, 0)]
        places = np.array(ends).T
        parts.append(Part(x=x[columns], y=y[rows], z=z.ravel(), first=places[0], last=places[1]))
    return parts


def _apart(ends: IntArray, lit: BoolArray) -> int:
    """Largest step from one lit place (n_row, n_column) to the next, of the pulses at which dwells begin or end."""
    steps = [
        np.abs(np.diff(ends, axis=k))[np.delete(lit, 0, axis=k) & np.delete(lit, -1, axis=k)].max(initial=0)
        for k in (0, 1)
    ]
    return int(max(steps))


def _halves(outlines: Sequence[Outlined]) -> list[list[Outlined]]:
    """Windows on either side of the middle of the box around them, along its longer side."""
    ends = [
        (min(window[axis].start for window, _ in outlines), max(window[axis].stop for window, _ in outlines))
        for axis in (0, 1)
    ]
    axis = int(ends[1][1] - ends[1][0] > ends[0][1] - ends[0][0])
    middle = sum(ends[axis]) / 2
    sides = [
        [each for each in outlines if (each[0][axis].start + each[0][axis].stop > 2 * middle) == far]
        for far in (False, True)
    ]
    return [side for side in sides if side]


def _joined(outlines: Sequence[Sequence[Part]]) -> list[Part]:
    """The parts of all windows as one, pass by pass."""
    joined = []
    for number in range(max((len(parts) for parts in outlines), default=0)):
        parts = [some[number] for some in outlines if number < len(some)]
        every = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "y", "z", "first", "last")
        }
        ends = {name: np.array([every[name].min(), every[name].max()]) for name in ("x", "y", "z")}
        whole = len(parts) == len(outlines)  # else a window has no such pass
        light = {name: every[name] if whole else np.append(every[name], 0) for name in ("first", "last")}
        joined.append(Part(**ends, **light))
    return joined


class _Former:
    """Forms windows of an image of one collection."""

    def __init__(self, geometry: Geometry, levels: Levels, weighting: Weighting, device: Device) -> None:
        self.geometry, self.weighting, collection = geometry, weighting, geometry.collection
        self.taper = weighting.azimuth if collection.steered else FLAT
        self.device = device
        self.hierarchy = Hierarchy(geometry, levels, waves=dwell_waves(geometry, weighting), device=device)
        n = collection.n_range_frequency
        self._over_band = weighting.range.samples(n)
        self._over_band /= self._over_band.mean()
        self._over_pulses = None if collection.steered else weighting.azimuth.samples(collection.n_pulse)
        self._valid: FloatArray = np.zeros(collection.n_pulse)

    def gather(self, read: ReadPulses, part: Part, threads: int) -> tuple[Part, Echoes | None]:
        """A part, and its echoes, of one pass of the beam; None where it has none."""
        return part, self.hierarchy.gather(part, self._blocks(read, part, threads), self._scratch())

    def _scratch(self) -> Scratch:
        return Scratch(self.device.empty)

    def _blocks(self, read: ReadPulses, part: Part, threads: int) -> Iterator[tuple[IntArray, ComplexArray]]:
        """Blocks of the pulses that light a part, weighted over band and collection, zero where samples are missing."""
        (begin, end), _ = part.lit()
        n = self._over_band.size
        pulse = np.arange(self._valid.size)
        for some in pulse_blocks((pulse >= begin) & (pulse < end), max(PULSE_BLOCK_BYTES // (8 * n), 1)):
            samples = read(some)
            values = np.empty(samples.shape, np.complex64)

            def work(rows: slice, some: slice = some, samples: ComplexArray = samples, values: Any = values) -> None:
                self._prepare(samples, values, rows, some.start)

            run_groups(work, row_groups(0, samples.shape[0], n), threads)
            yield np.arange(some.start, some.stop), self.device.put(values)

    def _prepare(self, samples: ComplexArray, values: ComplexArray, rows: slice, start: int) -> None:
        """Write weighted rows, zero where samples are missing; note the sum of the weights of those that are there."""
        missing = np.isnan(samples[rows])
        np.copyto(values[rows], samples[rows])
        values[rows][missing] = 0
        pulses = slice(rows.start + start, rows.stop + start)
        lost = missing.sum(axis=1) if self.weighting.range.uniform else (missing * self._over_band).sum(axis=1)
        self._valid[pulses] = self._over_band.size - lost
        if not self.weighting.range.uniform:
            values[rows] *= self._over_band.astype(np.float32)
        if self._over_pulses is not None and not self.weighting.azimuth.uniform:
            values[rows] *= self._over_pulses[pulses, None].astype(np.float32)

    def windows(
        self, read: ReadPulses, x: FloatArray, y: FloatArray, outlines: Sequence[Outlined],
        tops: Sequence[tuple[Part, Echoes | None]], threads: int,
    ) -> Iterator[tuple[Window, ComplexArray]]:  # fmt: skip
        """Form windows; many of them from the echoes of halves of them, which are decimated first."""
        if len(outlines) <= MOST_WINDOWS:
            for window, _ in outlines:
                yield window, self.window(read, x[window[1]], y[window[0]], tops, threads)
            return
        for some in _halves(outlines):  # the echoes of one are gone before those of the other are found
            yield from self.windows(read, x, y, some, self._divided(some, tops), threads)

    def _divided(
        self, outlines: Sequence[Outlined], tops: Sequence[tuple[Part, Echoes | None]]
    ) -> list[tuple[Part, Echoes | None]]:
        """Some of the windows as parts, pass by pass, with their echoes out of those of all."""
        parts = _joined([outline for _, outline in outlines])
        # Of passes that these lack, as of tops that have no echoes, nothing is left.
        return [
            (part, None if echoes is None else self.hierarchy.divide(top, echoes, part, self._scratch(), -1))
            for part, (top, echoes) in zip(parts, tops, strict=False)
        ]

    def window(
        self, read: ReadPulses, x: FloatArray, y: FloatArray, tops: Sequence[tuple[Part, Echoes | None]], threads: int
    ) -> ComplexArray:
        """The image (n_row, n_column) on columns x and rows y, m."""
        geometry = self.geometry
        sums = PixelSums(geometry, *np.meshgrid(x, y), self.weighting, threads)
        image = self.device.put(sums.image)
        for number, (first, last) in enumerate(_whole_passes(sums)):
            part = Part(x=x, y=y, z=sums.z, first=first, last=last)
            sums.outside |= leave_outside(geometry, part)
            top, echoes = tops[number] if number < len(tops) else (part, None)
            if _holds(echoes, part):
                left = None if echoes is None else self.hierarchy.divide(top, echoes, part, self._scratch(), -1)
            else:
                left = self.gather(read, part, threads)[1]
            if left is not None:
                self.form(part, left, image, threads)
        sums.image = self.device.take(image)
        sums.note_valid(slice(None), self._valid if sums.over_pulses is None else self._valid * sums.over_pulses)
        if geometry.collection.has_pattern or not sums.over_beam.uniform:
            for pulses in pulse_blocks(sums.lit(), geometry.collection.n_pulse):
                sums.add_gains(pulses)
        return sums.mean()

    def form(
        self, part: Part, echoes: Echoes, image: ComplexArray, threads: int = 1, level: int = 0,
        scratch: Scratch | None = None,
    ) -> None:  # fmt: skip
        """Add a part to the image (n_row, n_column), in place; its parts side by side in threads."""
        sides = self.hierarchy.levels.sides
        while level < len(sides) and part.side <= sides[level]:
            level += 1
        if level == len(sides):
            self._sum(part, echoes, image, scratch or self._scratch())
            return
        own = threading.local()

        def work(window: Window) -> None:
            child, memory = part.within(window), scratch or own.__dict__.setdefault("scratch", self._scratch())
            left = self.hierarchy.divide(part, echoes, child, memory, level)
            if left is not None:
                self.form(child, left, image[window], level=level + 1, scratch=memory)

        run_groups(work, part.divide(sides[level]), threads if self.device is CPU else 1)

    def _sum(self, part: Part, echoes: Echoes, image: ComplexArray, scratch: Scratch) -> None:
        """Back-project what is left to the pixels of a last part, each from the pulses that light it.

        Rows are put in the order of time: edges before the interior, the interior, edges after it. Each pixel takes all
        of the interior, which lies between its first and its last row.
        """
        collection, path, frame = self.geometry.collection, self.hierarchy.path, echoes.frame
        before, n = frame.before, frame.size
        rows = np.concatenate([frame.pulses[:before], frame.grid, frame.pulses[before:]])
        values = [echoes.edges[:before], echoes.interior, echoes.edges[before:]]
        begin, lit = int(rows[0]) if before else frame.inside[0], part.last > part.first
        first = np.where(lit, np.maximum(part.first - begin, 0), 0)
        last = np.where(lit, part.last + (before + n - frame.inside[1] if n else -begin), 0)
        put, period = self.device.put, fast_length(self.hierarchy.levels.upsampling * frame.columns)
        window, middle = SPEED_OF_LIGHT / (2 * frame.step), frame.columns // 2
        sights = Sights(
            start=0,
            values=self._profiles(values, period, scratch),
            middle=period // 2 + MARGIN,
            bins_per_metre=period / window,
            cycles_per_metre=2 * (collection.carrier + frame.start + middle * frame.step) / SPEED_OF_LIGHT,
            antenna=path.at(rows).T,
            reference_range=path.ranges(rows, part.centre),
            half_window=np.inf if frame.reach < SAFE * window else window / 2,
            taper=None if self.taper.uniform else self._beam_taper(rows),
        )
        x, y = np.meshgrid(part.x, part.y)
        beyond, weight = put(np.zeros(part.shape, np.bool_)), put(np.zeros(part.shape, np.float32))
        self.device.project(image, beyond, sights, LitPixels(*map(put, (x, y, part.z, first, last))), weight)

    def _profiles(self, values: Sequence[ComplexArray], period: int, scratch: Scratch) -> ComplexArray:
        """Coefficients (n, period + 2 MARGIN) of splines through the range profiles of rows (k, m), n in all.

        As in `range_profiles`: a profile is the mean over all range frequencies, of which the rows hold the sums.
        """
        n, m = sum(rows.shape[0] for rows in values), values[0].shape[1]
        middle, half = m // 2, period // 2
        level = period / self.geometry.collection.n_range_frequency
        lead = self.device.put((level * spline_lead(np.arange(m) - middle, period)).astype(np.float32))
        group = scratch.array("group", (n, period))
        group[:, m - middle : period - middle] = 0
        first = 0
        for rows in values:
            some = group[first : first + rows.shape[0]]
            np.multiply(rows[:, middle:], lead[middle:], out=some[:, : m - middle])
            np.multiply(rows[:, :middle], lead[:middle], out=some[:, period - middle :])
            first += rows.shape[0]
        group = self.device.fft_rows(group, inverse=True)
        out = scratch.array("profiles", (n, period + 2 * MARGIN))
        out[:, MARGIN : MARGIN + half] = group[:, half:]
        out[:, MARGIN + half : -MARGIN] = group[:, :half]
        out[:, -MARGIN:] = out[:, MARGIN : 2 * MARGIN]
        out[:, :MARGIN] = out[:, -2 * MARGIN : -MARGIN]
        return out

    def _beam_taper(self, rows: IntArray) -> BeamTaper:
        """The weights of rows, whose pulses may lie beyond the collection: there the beam goes on as at its end."""
        geometry, n = self.geometry, self.geometry.collection.n_pulse
        half = (geometry.collection.beam_width or np.inf) / 2

        def place(x: FloatArray, y: FloatArray, z: FloatArray, some: slice) -> FloatArray:
            x, y, z, pulses = x[:, None], y[:, None], z[:, None], rows[some]
            v = geometry.beam.offset(x, y, np.clip(pulses, 0, n - 1), z) / half
            for beyond, end, inner in ((pulses < 0, 0, 1), (pulses >= n, n - 1, n - 2)):
                if beyond.any():
                    at = [geometry.beam.offset(x, y, np.array([p]), z) / half for p in (end, inner)]
                    v[:, beyond] = at[0] + (at[0] - at[1]) * np.abs(pulses[beyond] - end)
            return v

        return BeamTaper(
            terms=self.taper.series[0], frequency=self.taper.series[1], valid=np.ones(rows.size), place=place
        )


def _whole_passes(sums: PixelSums) -> list[tuple[IntArray, IntArray]]:
    """Passes of all pixels of a window: those of `PixelSums`, of which all but the first are of some tiles only."""
    (_, *first_pass), *further = sums.passes
    passes = [(first_pass[0], first_pass[1])]
    for window, first, last in further:
        # The next pass that this tile has not.
        number = next((k for k, (_, ends) in enumerate(passes) if k and not ends[window].any()), len(passes))
        if number == len(passes):
            passes.append((np.zeros_like(passes[0][0]), np.zeros_like(passes[0][1])))
        passes[number][0][window], passes[number][1][window] = first, last
    return passes


def _holds(echoes: Echoes | None, part: Part) -> bool:
    """Whether echoes have all pulses that light a part, and in their interior none that does not."""
    (begin, end), (start, stop) = part.lit()
    if begin == end:
        return True
    if echoes is None:
        return False
    frame = echoes.frame
    known = [*frame.pulses[[0, -1]].tolist()] if frame.pulses.size else []
    if frame.size:
        known += [frame.inside[0], frame.inside[1] - 1]
        if not (start <= frame.inside[0] and frame.inside[1] <= stop):
            return False
    return min(known, default=end) <= begin and end - 1 <= max(known, default=begin - 1)


def leave_outside(geometry: Geometry, part: Part) -> BoolArray:
    """Where `mark_outside` sets it; no pulse of the part lights these pixels any more."""
    outside = np.zeros(part.shape, np.bool_)
    mark_outside(geometry, part, outside)
    part.first[outside], part.last[outside] = 0, 0
    return outside


def mark_outside(geometry: Geometry, part: Part, outside: BoolArray) -> None:
    """Set `outside` where a lit pulse sees a pixel of a part outside the unambiguous window, in place."""
    (begin, end), (start, stop) = part.lit()
    if begin == end:
        return
    collection, centre = geometry.collection, part.centre
    half = collection.range_window / 2
    position, reference = collection.antenna_position[begin:end], collection.reference_range[begin:end]
    away = np.abs(np.linalg.norm(position - centre, axis=1) - reference)
    radius = float(np.linalg.norm(part.border - centre, axis=1).max())
    if away.max() + radius <= half:
        return
    if away[start - begin : stop - begin].max(initial=0) - radius > half:
        outside[:] = True
    elif max(part.shape) > CHECKED:
        for window in part.divide(part.side / 2 * (1 + 1e-9)):
            mark_outside(geometry, part.within(window), outside[window])
    else:
        x, y = np.meshgrid(part.x, part.y)
        ground = np.stack([x, y, part.z], axis=-1)
        ranges = np.sqrt(sum(np.square(ground[..., k, None] - position[:, k]) for k in range(3)))
        pulses = np.arange(begin, end)
        lit = (pulses >= part.first[..., None]) & (pulses < part.last[..., None])
        outside |= (lit & (np.abs(ranges - reference) > half)).any(axis=-1)


def dwell_waves(geometry: Geometry, weighting: Weighting) -> float:
    """Largest frequency of the weights over a steered beam that matters, cycles per dwell."""
    if not geometry.collection.steered or weighting.azimuth.uniform:
        return 0.0
    terms, frequency = weighting.azimuth.series
    noticed = np.flatnonzero(np.abs(terms) > NOTICED * np.abs(terms).max())
    return float(frequency * noticed[-1])
