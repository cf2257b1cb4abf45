"""The one transform pair, its axes and its sign: nobody else touches an FFT.

    forward:  X(f_k) = sum_n x(t_n) exp(-2j pi f_k t_n)
    inverse:  x(t_n) = 1/N sum_k X(f_k) exp(+2j pi f_k t_n)

Both axes are uniform and may start anywhere; with step_f = 1 / (N step_t) each sum is one FFT between two
vectors of phase factors. There is no fftshift: an axis says where it starts.

Rows are transformed in fixed groups that fit the cache, one FFT thread a group. Fixed, because the
library's SIMD path depends on how many rows it is given: a grouping by the number of threads would change
the last bit of an image with it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft

from blocksar.parameters import ComplexArray, FloatArray

GROUP_BYTES = 512 * 1024  # rows transformed at a time: within a core's second-level cache

RowWork = Callable[[ComplexArray, slice], None]  # changes a group of rows in place, given which rows they are


@dataclass(frozen=True)
class Axis:
    """A uniform axis: start + step * index."""

    start: float
    step: float
    size: int

    @property
    def values(self) -> FloatArray:
        return np.asarray(self.start + self.step * np.arange(self.size), dtype=np.float64)

    @property
    def extent(self) -> float:
        return self.step * self.size

    @property
    def centre(self) -> float:
        return self.start + self.step * (self.size // 2)

    def position(self, value: FloatArray) -> FloatArray:
        """Index, with its fraction, of a value."""
        return (value - self.start) / self.step

    def part(self, first: int, size: int) -> Axis:
        return Axis(self.start + first * self.step, self.step, size)


def centred(centre: float, step: float, size: int) -> Axis:
    """An axis whose middle sample (index size // 2) is `centre`."""
    return Axis(centre - step * (size // 2), step, size)


def dual(axis: Axis, *, size: int, centre: float) -> Axis:
    """The other side of a transform of `size` samples of this step, about `centre`."""
    return centred(centre, 1.0 / (size * axis.step), size)


def fast_length(minimum: float) -> int:
    """The smallest even length of at least `minimum` that transforms fast."""
    return 2 * int(scipy.fft.next_fast_len(int(np.ceil(max(minimum, 2.0) / 2))))


def unit_phasor(cycles: FloatArray) -> ComplexArray:
    """exp(2j pi cycles), the whole cycles taken out in float64."""
    return np.exp(2j * np.pi * (cycles - np.rint(cycles))).astype(np.complex64)


def transform(
    x: ComplexArray,
    source: Axis,
    target: Axis,
    *,
    inverse: bool,
    threads: int = 1,
    before: RowWork | None = None,
    after: RowWork | None = None,
) -> ComplexArray:
    """Transform the rows of `x` from one axis to another; `source` is zero-padded to the target's size.

    Parameters
    ----------
    x : (n_row, source.size) complex64
        Not changed.
    source, target : Axis
        target.size >= source.size and target.step * source.step * target.size = 1.
    inverse : bool
        Sign and scale of the pair above.
    before, after : callable
        Work on a group of rows while it is in the cache, on the source samples and on the result.

    Returns
    -------
    (n_row, target.size) complex64
    """
    if x.ndim != 2 or x.shape[1] != source.size:
        raise ValueError(f"{x.shape=} but {source.size=}")
    if target.size < source.size or abs(source.step * target.step * target.size - 1) > 1e-9:
        raise ValueError(f"axes are no transform pair: {source=} {target=} {target.size=}")
    lead, trail = phasors(source, target, inverse=inverse, period=target.size)
    out = np.empty((x.shape[0], target.size), np.complex64)

    def work(rows: slice) -> None:
        group = np.zeros((rows.stop - rows.start, target.size), np.complex64)
        head = group[:, : source.size]
        if before is None:
            np.multiply(x[rows], lead, out=head)
        else:
            work_rows = x[rows].copy()
            before(work_rows, rows)
            np.multiply(work_rows, lead, out=head)
        group = fft_rows(group, inverse=inverse)
        np.multiply(group[:, : target.size], trail, out=out[rows])
        if after is not None:
            after(out[rows], rows)

    run_groups(work, row_groups(x.shape[0], target.size), threads)
    return out


def to_doppler(x: ComplexArray, time: Axis, doppler: Axis, *, threads: int = 1) -> ComplexArray:
    """Slow time to Doppler along the last axis."""
    return transform(x, time, doppler, inverse=False, threads=threads)


def to_time(x: ComplexArray, doppler: Axis, time: Axis, *, threads: int = 1) -> ComplexArray:
    """Doppler to slow time along the last axis."""
    return transform(x, doppler, time, inverse=True, threads=threads)


@lru_cache(maxsize=32)
def phasors(source: Axis, target: Axis, *, inverse: bool, period: int) -> tuple[ComplexArray, ComplexArray]:
    """Factors before and after an FFT of `period` points that make it the sum of this module's heading; read-only."""
    sign = 1.0 if inverse else -1.0
    before = unit_phasor(sign * target.start * source.values)
    after = unit_phasor(sign * (target.values - target.start) * source.start)
    if inverse:
        after = (after / np.float32(period)).astype(np.complex64)
    before.flags.writeable = after.flags.writeable = False
    return before, after


def row_groups(n_row: int, n_column: int) -> list[slice]:
    """Groups of rows of about GROUP_BYTES; they depend on the shape alone."""
    rows = max(1, GROUP_BYTES // (8 * n_column))
    return [slice(first, min(first + rows, n_row)) for first in range(0, n_row, rows)]


def run_groups(work: Callable[[slice], None], groups: list[slice], threads: int) -> None:
    """Do `work` for every group, on as many threads."""
    if threads == 1:
        for group in groups:
            work(group)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, groups):
            pass


def fft_rows(group: ComplexArray, *, inverse: bool) -> ComplexArray:
    """The bare library call: unnormalised both ways, one thread, the input is scratch."""
    if inverse:
        return np.asarray(scipy.fft.ifft(group, axis=1, norm="forward", overwrite_x=True))
    return np.asarray(scipy.fft.fft(group, axis=1, overwrite_x=True))


def transform_columns(
    x: ComplexArray,
    source: Axis,
    target: Axis,
    period: int,
    *,
    inverse: bool,
    threads: int = 1,
    before: RowWork | None = None,
) -> ComplexArray:
    """The same along the first axis, zero-padded to `period` and cut to the target's samples.

    Parameters
    ----------
    x : (source.size, n_column) complex64
    target : Axis
        At most `period` samples of the result, from target.start on.
    before : callable
        Works in place on a group of gathered columns (source.size, a few), given which they are.

    Returns
    -------
    (target.size, n_column) complex64
    """
    if x.shape[0] != source.size or target.size > period:
        raise ValueError(f"{x.shape=} but {source.size=}, {target.size=}, {period=}")
    lead, trail = phasors(source, target, inverse=inverse, period=period)
    out = np.empty((target.size, x.shape[1]), np.complex64)
    lead_column, trail_column = lead[:, None], trail[:, None]

    def work(columns: slice) -> None:
        # Columns are gathered a few cache lines wide, transformed as rows, and scattered back: a transform
        # along the first axis of a big array would miss the cache at every sample.
        group = np.zeros((columns.stop - columns.start, period), np.complex64)
        gathered = x[:, columns] * lead_column
        if before is not None:
            before(gathered, columns)
        group[:, : source.size] = gathered.T
        group = fft_rows(group, inverse=inverse)
        np.multiply(group[:, : target.size].T, trail_column, out=out[:, columns])

    groups = [slice(first, min(first + 32, x.shape[1])) for first in range(0, x.shape[1], 32)]
    run_groups(work, groups, threads)
    return out
