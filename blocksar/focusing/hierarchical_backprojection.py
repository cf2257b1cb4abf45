"""The image of a part of the grid by hierarchical back-projection: `hierarchy` down to the last parts, and their sums.

The image is the one that `backprojection` defines, with the same lit pulses, weights, gains and missing samples; only
the sums over pulses and range frequencies are formed from decimated data.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.beam import beam_offset
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.backprojection import PixelSums, ReadPulses, lit_pulses, pulse_blocks
from blocksar.focusing.hierarchy import LOOKS, Echoes, Hierarchy, Levels
from blocksar.focusing.parts import Part
from blocksar.focusing.profiles import MARGIN, spline_lead
from blocksar.kernels.beam_weights import BeamTaper
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import row_groups, run_groups
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.projection import Sights, project
from blocksar.kernels.scratch import Scratch

SAFE = 0.45  # of the unambiguous window: ranges that stay within are interpolated without a test of each
NOTICED = 1e-4  # of a taper's terms: waves of the weights that a filter has to pass
PULSE_BLOCK_BYTES = 16 * 1024**2  # samples that are read at a time
CHECKED = 16  # pixels a side of the parts that are tested one by one for the unambiguous window


def form_part(
    read: ReadPulses,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    *,
    levels: Levels,
    threads: int,
    weighting: Weighting = UNIFORM,
) -> ComplexArray:
    """Form the image on columns `x` (n_column,) and rows `y` (n_row,), m, in scene frame.

    Parameters
    ----------
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses, NaN where they are missing. For each
        pass of the beam over the part, slices hold each lit pulse once, in ascending order.
    geometry : Geometry
    levels : Levels
    threads : int
        The result does not depend on it.
    weighting : Weighting

    Returns
    -------
    (n_row, n_column) complex64
        As `backprojection.form_image`.
    """
    mesh_x, mesh_y = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
    sums = PixelSums(geometry, mesh_x, mesh_y, weighting, threads)
    z = np.array(geometry.collection.ground_height) if sums.height is None else sums.height
    z = z if sums.height is None else z + geometry.collection.ground_height
    former = _Former(geometry, levels, sums.over_beam)
    for window, first, last in sums.passes:
        part = Part(x=mesh_x[window][0], y=mesh_y[window][:, 0], z=z[window] if z.ndim else z, first=first, last=last)
        mark_outside(geometry, part, sums.outside[window])
        blocks = _blocks(read, geometry, part, sums, weighting, threads)
        if (echoes := former.hierarchy.gather(part, blocks, Scratch())) is not None:
            former.form(part, echoes, sums.image[window], threads)
    if geometry.collection.has_pattern or not sums.over_beam.uniform:
        for pulses in pulse_blocks(sums.lit(), geometry.collection.n_pulse):
            sums.add_gains(pulses)
    return sums.mean()


def _blocks(
    read: ReadPulses, geometry: Geometry, part: Part, sums: PixelSums, weighting: Weighting, threads: int
) -> Iterator[tuple[IntArray, ComplexArray]]:
    """Blocks of the pulses that light a part, weighted over the band and the collection, zero where missing."""
    n = geometry.collection.n_range_frequency
    weights = weighting.range.samples(n)
    weights /= weights.mean()
    lit = lit_pulses(part.first, part.last, geometry.collection.n_pulse)
    for pulses in pulse_blocks(lit, max(PULSE_BLOCK_BYTES // (8 * n), 1)):
        samples = read(pulses)
        values, valid = np.empty(samples.shape, np.complex64), np.empty(samples.shape[0])
        over = None if sums.over_pulses is None else sums.over_pulses[pulses]
        work = partial(_prepare, samples, values, valid, weights, weighting.range.uniform, over)
        run_groups(work, row_groups(0, samples.shape[0], n), threads)
        sums.note_valid(pulses, valid)
        yield np.arange(pulses.start, pulses.stop), values


def _prepare(
    samples: ComplexArray, values: ComplexArray, valid: FloatArray, weights: FloatArray, uniform: bool,
    over: Float32Array | None, rows: slice,
) -> None:  # fmt: skip
    """Write weighted rows, zero where samples are missing, and the sum of the weights of those that are there."""
    missing = np.isnan(samples[rows])
    np.copyto(values[rows], samples[rows])
    values[rows][missing] = 0
    valid[rows] = weights.size - (missing.sum(axis=1) if uniform else np.where(missing, weights, 0.0).sum(axis=1))
    if not uniform:
        values[rows] *= weights.astype(np.float32)
    if over is not None:
        values[rows] *= over[rows, None]


def mark_outside(geometry: Geometry, part: Part, outside: BoolArray) -> None:
    """Set `outside` where a lit pulse sees a pixel of a part outside the unambiguous window, in place."""
    (begin, end), _ = part.lit()
    if begin == end:
        return
    collection, centre = geometry.collection, part.centre
    half = collection.range_window / 2
    position, reference = collection.antenna_position[begin:end], collection.reference_range[begin:end]
    away = np.abs(np.linalg.norm(position - centre, axis=1) - reference)
    radius = float(np.linalg.norm(part.border - centre, axis=1).max())
    if away.max() + radius <= half:
        return
    if max(part.shape) > CHECKED:
        for window in part.divide(part.side / 2 * (1 + 1e-9)):
            mark_outside(geometry, part.within(window), outside[window])
        return
    z = np.broadcast_to(part.z, part.shape)
    pulses = np.arange(begin, end)
    for row, column in np.ndindex(part.shape):
        point = np.array([part.x[column], part.y[row], z[row, column]])
        lit = (pulses >= part.first[row, column]) & (pulses < part.last[row, column])
        away = np.abs(np.linalg.norm(position - point, axis=1) - reference)
        outside[row, column] |= bool((away[lit] > half).any())


def _waves(taper: Taper) -> float:
    """Largest frequency of a taper that matters, cycles per dwell."""
    terms, frequency = taper.series
    noticed = np.flatnonzero(np.abs(terms) > NOTICED * np.abs(terms).max())
    return float(frequency * noticed[-1])


class _Former:
    """Forms parts from their echoes."""

    def __init__(self, geometry: Geometry, levels: Levels, over_beam: Taper) -> None:
        self.geometry, self.taper = geometry, over_beam
        self.hierarchy = Hierarchy(geometry, levels, waves=0.0 if over_beam.uniform else _waves(over_beam))

    def form(
        self, part: Part, echoes: Echoes, image: ComplexArray, threads: int = 1, level: int = 0,
        scratch: Scratch | None = None,
    ) -> None:  # fmt: skip
        """Add a part to the image (n_row, n_column), in place; its parts side by side in threads."""
        sides = self.hierarchy.levels.sides
        while level < len(sides) and part.side <= sides[level]:
            level += 1
        if level == len(sides):
            self._sum(part, echoes, image, scratch or Scratch())
            return

        own = threading.local()

        def work(window: tuple[slice, slice]) -> None:
            child, memory = part.within(window), scratch or own.__dict__.setdefault("scratch", Scratch())
            left = self.hierarchy.divide(part, echoes, child, memory, level)
            if left is not None:
                self.form(child, left, image[window], level=level + 1, scratch=memory)

        run_groups(work, part.divide(sides[level]), threads)

    def _sum(self, part: Part, echoes: Echoes, image: ComplexArray, scratch: Scratch) -> None:
        """Back-project what is left to the pixels of a last part, each from the pulses that light it.

        Rows are put in the order of time: edges before the interior, the interior, edges after it. Each pixel takes all
        of the interior, which lies between its first and its last row.
        """
        collection, path, frame = self.geometry.collection, self.hierarchy.path, echoes.frame
        before, n = frame.before, frame.size
        rows = np.concatenate([frame.pulses[:before], frame.grid, frame.pulses[before:]])
        values = [echoes.edges[:before], echoes.interior, echoes.edges[before:]]
        begin = int(rows[0]) if before else frame.inside[0]
        first = np.maximum(part.first - begin, 0)
        last = before + n + part.last - frame.inside[1] if n else np.maximum(part.last - begin, 0)
        period = fast_length(self.hierarchy.levels.upsampling * frame.columns)
        window, middle = SPEED_OF_LIGHT / (2 * frame.step), frame.columns // 2
        reach = path.reach(rows[:: max(rows.size // LOOKS, 1)], part)[0]
        antenna = path.at(rows).T
        antenna[2] -= collection.ground_height
        sights = Sights(
            start=0,
            values=_profiles(values, period, collection.n_range_frequency, scratch),
            rows=np.arange(rows.size),
            middle=period // 2 + MARGIN,
            bins_per_metre=period / window,
            cycles_per_metre=2 * (collection.carrier + frame.start + middle * frame.step) / SPEED_OF_LIGHT,
            antenna=np.ascontiguousarray(antenna),
            reference_range=path.ranges(rows, part.centre),
            half_window=np.inf if reach < SAFE * window else window / 2,
            taper=None if self.taper.uniform else self._beam_taper(rows),
        )
        x, y = np.meshgrid(part.x, part.y)
        height = part.z - collection.ground_height if part.z.ndim else None
        beyond, weight = np.zeros(part.shape, np.bool_), np.zeros(part.shape, np.float32)
        project(image, beyond, sights, x, y, first, last, weight, height)

    def _beam_taper(self, rows: IntArray) -> BeamTaper:
        """The weights of rows, whose pulses may lie beyond the collection: there the beam goes on as at its end."""
        geometry, n = self.geometry, self.geometry.collection.n_pulse
        half = (geometry.collection.beam_width or np.inf) / 2

        def place(x: FloatArray, y: FloatArray, some: slice, over: FloatArray | None) -> FloatArray:
            z = geometry.collection.ground_height + (0.0 if over is None else over[:, None])
            pulses = rows[some]
            known = np.clip(pulses, 0, n - 1)
            v = beam_offset(geometry, x[:, None], y[:, None], known, z) / half
            for beyond, end, inner in ((pulses < 0, 0, 1), (pulses >= n, n - 1, n - 2)):
                if beyond.any():
                    at = [beam_offset(geometry, x[:, None], y[:, None], np.array([p]), z) / half for p in (end, inner)]
                    v[:, beyond] = at[0] + (at[0] - at[1]) * np.abs(pulses[beyond] - end)
            return v

        return BeamTaper(
            terms=self.taper.series[0], frequency=self.taper.series[1], valid=np.ones(rows.size), place=place
        )


def _profiles(values: Sequence[ComplexArray], period: int, whole: int, scratch: Scratch) -> ComplexArray:
    """Coefficients (n, period + 2 MARGIN) of splines through the range profiles of rows (k, m), n in all.

    As in `range_profiles`. A profile is the mean over `whole` range frequencies, of which the rows hold the sums.
    """
    n, m = sum(rows.shape[0] for rows in values), values[0].shape[1]
    middle, half = m // 2, period // 2
    lead = (period / whole * spline_lead(np.arange(m) - middle, period)).astype(np.float32)
    group = scratch.array("group", (n, period))
    group[:, m - middle : period - middle] = 0
    first = 0
    for rows in values:
        some = group[first : first + rows.shape[0]]
        np.multiply(rows[:, middle:], lead[middle:], out=some[:, : m - middle])
        np.multiply(rows[:, :middle], lead[:middle], out=some[:, period - middle :])
        first += rows.shape[0]
    group = fft_rows(group, inverse=True)
    out = scratch.array("profiles", (n, period + 2 * MARGIN))
    out[:, MARGIN : MARGIN + half] = group[:, half:]
    out[:, MARGIN + half : -MARGIN] = group[:, :half]
    out[:, -MARGIN:] = out[:, MARGIN : 2 * MARGIN]
    out[:, :MARGIN] = out[:, -2 * MARGIN : -MARGIN]
    return out
