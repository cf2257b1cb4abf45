"""The image of a part of the grid by hierarchical back-projection: `hierarchy` down to the last parts, and their sums.

The image is the one that `backprojection` defines, with the same lit pulses, weights, gains and missing samples; only
the sums over pulses and range frequencies are formed from decimated data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.backprojection import PixelSums, ReadPulses, pulse_blocks
from blocksar.imaging.profiles import MARGIN, spline_lead
from blocksar.kernels.device import Device, on_device
from blocksar.kernels.groups import Scratch, row_groups, run_groups
from blocksar.kernels.projection import BeamTaper, LitPixels, Sights, Tiles
from blocksar.processors.hierarchy.derivation import Echoes, Frames, Hierarchy, Levels, Part, Parts, part_groups

SAFE = 0.45  # of the unambiguous window: ranges that stay within are interpolated without a test of each
NOTICED = 1e-4  # of a taper's terms: waves of the weights that a filter has to pass
PULSE_BLOCK_BYTES = 16 * 1024**2  # samples that are read at a time
CHECKED = 8  # pixels a side of the parts of which each pixel is tested for the unambiguous window
MOST_WINDOWS = 16  # that are formed from the same echoes
SAMPLED = 16  # places along the side of a window at which it is found which pulses light it
Window = tuple[slice, slice]
Outlined = tuple[Window, list[Parts]]  # with what lights it, pass by pass


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
    # A single window determines its own lit pulses.
    parts = _joined([outline for _, outline in whole]) if len(windows) > 1 else []
    with on_device(device, memory) as opened:
        former = _Former(geometry, levels, weighting, opened)
        tops = [former.gather(read, part, threads) for part in parts]
        yield from former.windows(read, x, y, whole, tops, threads)


def _outline(geometry: Geometry, x: FloatArray, y: FloatArray, window: Window) -> list[Parts]:
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
        outline = seen.whole
        (begin, end), (start, stop) = seen.lit()
        lit, apart = begin < end, 2 + max(_apart(ends, last > first) for ends in (first, last))
        n = geometry.collection.n_pulse
        free = begin == 0 and start == 0, end == n and stop == n  # all of the collection lights it
        begin, end = max(begin - apart, 0), min(end + apart, n)
        start, stop = (0 if free[0] else start + apart), (n if free[1] else stop - apart)
        whole = (start, stop) if start < stop else (end, end)
        some, whole = ((begin, end), whole) if lit else ((0, 0), (0, 0))
        parts.append(replace(outline, some=np.array([some]), whole=np.array([whole])))
    return parts


def _apart(ends: IntArray, lit: BoolArray) -> int:
    """Largest step of dwell ends, in pulses, between neighbouring lit places (n_row, n_column)."""
    steps = [
        np.abs(np.diff(ends, axis=k))[np.delete(lit, 0, axis=k) & np.delete(lit, -1, axis=k)].max(initial=0)
        for k in (0, 1)
    ]
    return int(max(steps))


def _halves(outlines: Sequence[Outlined]) -> list[list[Outlined]]:
    """Divide windows into those on either side of the middle of their bounding box, along its longer side."""
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


def _joined(outlines: Sequence[Sequence[Parts]]) -> list[Parts]:
    """The parts of all windows as one, pass by pass."""
    number = max((len(parts) for parts in outlines), default=0)
    return [Parts.joined([some[k] for some in outlines if k < len(some)]) for k in range(number)]


class _Former:
    """Image former for windows of one collection."""

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

    def gather(self, read: ReadPulses, part: Parts, threads: int) -> Echoes | None:
        """The echoes of a part, of one pass of the beam; None where it has none."""
        return self.hierarchy.gather(part, self._blocks(read, part, threads))

    def _scratch(self) -> Scratch:
        return Scratch(self.device.empty)

    def _blocks(self, read: ReadPulses, part: Parts, threads: int) -> Iterator[tuple[IntArray, ComplexArray]]:
        """Blocks of the pulses that light a part, weighted over band and collection, zero where samples are missing."""
        (begin, end), n = part.some[0].tolist(), self._over_band.size
        pulse = np.arange(self._valid.size)
        for some in pulse_blocks((pulse >= begin) & (pulse < end), max(PULSE_BLOCK_BYTES // (8 * n), 1)):
            samples = read(some)
            values = np.empty(samples.shape, np.complex64)

            def work(rows: slice, some: slice = some, samples: ComplexArray = samples, values: Any = values) -> None:
                self._prepare(samples, values, rows, some.start)

            run_groups(work, row_groups(0, samples.shape[0], n), threads)
            yield np.arange(some.start, some.stop), self.device.put(values)

    def _prepare(self, samples: ComplexArray, values: ComplexArray, rows: slice, start: int) -> None:
        """Write weighted rows, zero where samples are missing, and record the sums of weights of present samples."""
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
        tops: Sequence[Echoes | None], threads: int,
    ) -> Iterator[tuple[Window, ComplexArray]]:  # fmt: skip
        """Form windows; if there are many, halves of them from echoes decimated for each half."""
        if len(outlines) <= MOST_WINDOWS:
            for window, _ in outlines:
                yield window, self.window(read, x[window[1]], y[window[0]], tops, threads)
            return
        for some in _halves(outlines):  # the echoes of one are gone before those of the other are found
            parts = _joined([outline for _, outline in some])
            # Of passes that these lack, as of tops that have no echoes, nothing is left.
            halves = [self._divided(part, top) for part, top in zip(parts, tops, strict=False)]
            yield from self.windows(read, x, y, some, halves, threads)

    def _divided(self, part: Parts, top: Echoes | None) -> Echoes | None:
        """The echoes of a part, out of those of more."""
        lit = part.some[0, 0] < part.some[0, 1]
        return self.hierarchy.divide(top, part, self._scratch()) if top is not None and lit else None

    def window(
        self, read: ReadPulses, x: FloatArray, y: FloatArray, tops: Sequence[Echoes | None], threads: int
    ) -> ComplexArray:
        """Form the image (n_row, n_column) on columns x and rows y, m."""
        geometry = self.geometry
        sums = PixelSums(geometry, *np.meshgrid(x, y), self.weighting, threads)
        image = self.device.put(sums.image)
        for number, (first, last) in enumerate(_whole_passes(sums)):
            part = Part(x=x, y=y, z=sums.z, first=first, last=last)
            sums.outside |= leave_outside(geometry, part)
            levels = part.levels(self.hierarchy.levels.sides)
            known = number < len(tops) and _holds(tops[number], levels[0])
            left = self._divided(levels[0], tops[number]) if known else self.gather(read, levels[0], threads)
            if left is not None:
                self.form(part, levels[1:], left, image, threads)
        sums.image = self.device.take(image)
        sums.note_valid(slice(None), self._valid if sums.over_pulses is None else self._valid * sums.over_pulses)
        if geometry.collection.has_pattern or not sums.over_beam.uniform:
            for pulses in pulse_blocks(sums.lit(), geometry.collection.n_pulse):
                sums.add_gains(pulses)
        return sums.mean()

    def form(self, part: Part, levels: Sequence[Parts], echoes: Echoes, image: ComplexArray, threads: int) -> None:
        """Add the echoes of a part to the image (n_row, n_column), in place: level by level, then by last sums.

        Each pixel takes all rows of its last part from the first that lights it to the last; of the interior's rows,
        which lie between the edges, these are all.
        """
        scratch, last = self._scratch(), part.whole
        for number, last in enumerate(levels):
            echoes = self.hierarchy.divide(echoes, last, scratch, number % 2, threads)
        frames, rows = echoes
        owner = np.zeros(part.shape, np.int64)
        for k, (top, bottom, left, right) in enumerate(last.windows.tolist()):
            owner[top:bottom, left:right] = k
        lit, begin = part.last > part.first, frames.ends[:-1] - frames.some[:, 0]
        end = begin + frames.size - (frames.inside[:, 1] - frames.inside[:, 0])
        first, last_row = (
            np.where(lit, ends + shift[owner], 0) for ends, shift in ((part.first, begin), (part.last, end))
        )
        put, sums = self.device.put, self._sights(frames)
        pixels = LitPixels(*map(put, (*np.meshgrid(part.x, part.y), part.z, first, last_row)))
        beyond, weight = put(np.zeros(part.shape, np.bool_)), put(np.zeros(part.shape, np.float32))
        spans = np.stack([frames.ends[:-1], frames.ends[1:]], axis=1)
        tiles = Tiles(windows=last.windows, low=last.low, high=last.high, rows=spans)
        period = self.hierarchy.levels.bins(frames.columns)

        def work(some: slice) -> None:
            span = slice(int(spans[some.start, 0]), int(spans[some.stop - 1, 1]))
            values = self._profiles(rows[span], period, scratch)
            self.device.project(image, beyond, sums.of(span, values), pixels, weight, given=tiles.some(some))

        run_groups(work, part_groups(spans[:, 1] - spans[:, 0], period, self.device.group_bytes), threads)

    def _sights(self, frames: Frames) -> Sights:
        """How the rows of frames see their parts, without their profiles."""
        collection, path, pulses = self.geometry.collection, self.hierarchy.path, frames.pulses
        period = self.hierarchy.levels.bins(frames.columns)
        window, middle = SPEED_OF_LIGHT / (2 * frames.step), frames.columns // 2
        return Sights(
            start=0,
            values=np.empty((0, 0), np.complex64),
            middle=period // 2 + MARGIN,
            bins_per_metre=period / window,
            cycles_per_metre=2 * (collection.carrier + frames.start + middle * frames.step) / SPEED_OF_LIGHT,
            antenna=path.at(pulses),
            reference_range=path.ranges(pulses, frames.centre[frames.part]),
            half_window=np.inf if frames.reach < SAFE * window else window / 2,
            taper=None if self.taper.uniform else self._beam_taper(pulses),
        )

    def _profiles(self, rows: ComplexArray, period: int, scratch: Scratch) -> ComplexArray:
        """Coefficients (n, period + 2 MARGIN) of splines through the range profiles of rows (n, m).

        As in `range_profiles`: a profile is the mean over all range frequencies, of which the rows hold the sums.
        """
        n, m = rows.shape
        middle = m // 2
        cycles = np.arange(m) - middle
        # The sign moves delay 0 to the middle of the period, which is even.
        lead = (-1.0) ** cycles * spline_lead(cycles, period) * (period / self.geometry.collection.n_range_frequency)
        lead = self.device.put(lead.astype(np.float32))
        out = scratch.array("profiles", (n, period + 2 * MARGIN))
        inner = out[:, MARGIN:-MARGIN]
        inner[:, m - middle : period - middle] = 0
        np.multiply(rows[:, middle:], lead[middle:], out=inner[:, : m - middle])
        np.multiply(rows[:, :middle], lead[:middle], out=inner[:, period - middle :])
        found = self.device.fft_rows(inner, inverse=True)
        if not np.may_share_memory(found, inner):
            inner[:] = found
        out[:, -MARGIN:] = out[:, MARGIN : 2 * MARGIN]
        out[:, :MARGIN] = out[:, -2 * MARGIN : -MARGIN]
        return out

    def _beam_taper(self, rows: IntArray) -> BeamTaper:
        """Weights of rows over the beam; pulses beyond the collection continue the beam at its end."""
        geometry, n = self.geometry, self.geometry.collection.n_pulse
        half = (geometry.collection.beam_width or np.inf) / 2

        def place(x: FloatArray, y: FloatArray, z: FloatArray, some: IntArray) -> FloatArray:
            pulses = rows[some]
            within = np.clip(pulses, 0, n - 1)
            v = geometry.beam.offset(x, y, within, z) / half
            if (within != pulses).any():
                inner = np.clip(within, 1, n - 2)
                v += (v - geometry.beam.offset(x, y, inner, z) / half) * np.abs(pulses - within)
            return v

        return BeamTaper(
            terms=self.taper.series[0], frequency=self.taper.series[1], valid=np.ones(rows.size), place=place
        )


def _whole_passes(sums: PixelSums) -> list[tuple[IntArray, IntArray]]:
    """Combine passes of tiles in `PixelSums` into passes of all pixels of a window."""
    (_, *first_pass), *further = sums.passes
    passes = [(first_pass[0], first_pass[1])]
    for window, first, last in further:
        # The next pass that has no part of this tile yet.
        number = next((k for k, (_, ends) in enumerate(passes) if k and not ends[window].any()), len(passes))
        if number == len(passes):
            passes.append((np.zeros_like(passes[0][0]), np.zeros_like(passes[0][1])))
        passes[number][0][window], passes[number][1][window] = first, last
    return passes


def _holds(echoes: Echoes | None, part: Parts) -> bool:
    """Whether echoes have all pulses that light a part, and in their interior none that does not."""
    (begin, end), (start, stop) = part.some[0].tolist(), part.whole[0].tolist()
    if begin == end:
        return True
    if echoes is None:
        return False
    frames = echoes.frames
    (known, until), (first, last) = frames.some[0].tolist(), frames.inside[0].tolist()
    return known <= begin and end <= until and (first == last or (start <= first and last <= stop))


def leave_outside(geometry: Geometry, part: Part) -> BoolArray:
    """Mark pixels as `mark_outside` does, and remove all pulses of the part from these."""
    outside = np.zeros(part.shape, np.bool_)
    mark_outside(geometry, part, outside)
    if outside.any():
        part.first[outside], part.last[outside] = 0, 0
        part.__dict__.pop("whole")  # as it was found
    return outside


def mark_outside(geometry: Geometry, part: Part, outside: BoolArray) -> None:
    """Set `outside` where a lit pulse sees a pixel of a part outside the unambiguous window, in place."""
    (begin, end), (start, stop) = part.lit()
    if begin == end:
        return
    collection, centre = geometry.collection, part.whole.centre[0]
    half = collection.range_window / 2
    position, reference = collection.antenna_position[begin:end], collection.reference_range[begin:end]
    away = np.abs(np.linalg.norm(position - centre, axis=1) - reference)
    radius = float(np.linalg.norm(part.whole.border[0] - centre, axis=1).max())
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
    """Largest significant frequency of the weights over a steered beam, cycles per dwell."""
    if not geometry.collection.steered or weighting.azimuth.uniform:
        return 0.0
    terms, frequency = weighting.azimuth.series
    noticed = np.flatnonzero(np.abs(terms) > NOTICED * np.abs(terms).max())
    return float(frequency * noticed[-1])
