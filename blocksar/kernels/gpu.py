"""Back-projection loops on a GPU: phase rotation, filters along rows and columns, and sums over pulses at pixels.

They are the formulas of `decimation` and `projection`. A thread sums SIDE x SIDE pixels about their middle, whose
range, phase, and place in the profile are float64, once for each pulse. With R that range, e the direction, u a
pixel's offset from the middle, and g = 1 / (2 R), the range of the pixel is that of the middle and

    z (1 - q + 2 q^2),  z = e u + g |u|^2,  q = g z,

in float32. `_near` tells whether that has enough of the phase; otherwise a thread sums one pixel, which is its middle.

The same source runs in numba's simulator, in which tests without a GPU compare it with the loops of the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numba.cuda
import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.decimation import Decimation
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.groups import GPU_PART_BYTES
from blocksar.kernels.projection import UPSAMPLING, LitPixels, Sights, Tiles, halves, place_tables
from blocksar.texts import size_text

cuda: Any = numba.cuda
SIMULATED = bool(getattr(numba.config, "ENABLE_CUDASIM", False))
Single, Whole = np.float32, np.int32
SIDE = 2  # pixels along either side that a thread sums
THREADS = (4, 4) if SIMULATED else (8, 16)  # of a block, along columns and rows
ROW_THREADS = 4 if SIMULATED else 128
MOST_CYCLES = 64.0  # from the middle, of which float32 has enough of the phase: 3e-5 rad
FAR = 1e30  # m, no range: the loops know no infinity
TRANSFORMS = 2  # whose work areas are kept
NEAR = 0.02  # of the distance, within which a pixel lies from the middle

numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0  # type: ignore[attr-defined]  # small parts are no fault
xp: Any = np if SIMULATED else import_module("cupy")


def _inlined(function: Callable[..., Any]) -> Any:
    return cuda.jit(function, device=True, inline="always", fastmath=True)


if SIMULATED:

    def _real(sample: Any) -> Any:
        return np.float64(sample).view(np.complex64).real

    def _imag(sample: Any) -> Any:
        return np.float64(sample).view(np.complex64).imag

else:
    libdevice: Any = import_module("numba.cuda.libdevice")

    @_inlined
    def _real(sample: Any) -> Any:
        return libdevice.int_as_float(libdevice.double2loint(sample))

    @_inlined
    def _imag(sample: Any) -> Any:
        return libdevice.int_as_float(libdevice.double2hiint(sample))


@cuda.jit(fastmath=True, cache=True)
def _turn(values: Any, source: Any, first: Any, step: Any, out: Any) -> None:
    """out[r, i] = values[source[r], i] exp(2j pi (first[r] + step[r] i))."""
    i, r = cuda.grid(2)
    if r < out.shape[0] and i < out.shape[1]:
        turn = first[r] + step[r] * i
        angle = np.float32(turn - math.floor(turn + 0.5)) * np.float32(2 * math.pi)
        cos, sin = math.cos(angle), math.sin(angle)
        sample = values[source[r], i]
        a, b = sample.real, sample.imag
        out[r, i] = complex(a * cos - b * sin, a * sin + b * cos)


@cuda.jit(fastmath=True, cache=True)
def _decimate_rows(values: Any, taps: Any, factor: Any, start: Any, target: Any, out: Any, others: Any) -> None:
    """The sum over k of taps[k] values[r, start + j factor + k] becomes out[target[r], j], or others[r, j]."""
    j, r = cuda.grid(2)
    if r < values.shape[0] and j < out.shape[1]:
        begin = start + j * factor
        re, im = np.float32(0), np.float32(0)
        for k in range(max(0, -begin), min(taps.size, values.shape[1] - begin)):
            sample = values[r, begin + k]
            re += taps[k] * sample.real
            im += taps[k] * sample.imag
        if target[r] >= 0:
            out[target[r], j] = complex(re, im)
        else:
            others[r, j] = complex(re, im)


@cuda.jit(fastmath=True, cache=True)
def _add_decimated_columns(values: Any, runs: Any, most: Any, taps: Any, factor: Any, out: Any) -> None:
    """The k-th row of out of a run += sum over t of taps[t] times the row at lead + k factor + t of the run."""
    c, each = cuda.grid(2)
    run, k = each // most, each % most
    if run < runs.shape[0] and c < out.shape[1] and k < runs[run, 4]:
        first, begin = runs[run, 0], runs[run, 3] - taps.size // 2 + k * factor
        re, im = np.float32(0), np.float32(0)
        for t in range(max(0, -begin), min(taps.size, runs[run, 1] - begin)):
            sample = values[first + begin + t, c]
            re += taps[t] * sample.real
            im += taps[t] * sample.imag
        out[runs[run, 2] + k, c] += complex(re, im)


@_inlined
def _weight(places: Any, k: Any, x: Any, y: Any, z: Any, hilly: Any, terms: Any, half_frequency: Any) -> Any:
    """Weight of pulse k at (x, y, z) m from the tile's centre: sum_n terms_n cos(2 pi n half_frequency v)."""
    v = np.float32(places[k, 0]) + y * (np.float32(places[k, 2]) + y * np.float32(places[k, 5]))
    v += x * (np.float32(places[k, 1]) + x * np.float32(places[k, 3]) + y * np.float32(places[k, 4]))
    if hilly:
        along = np.float32(places[k, 7]) + x * np.float32(places[k, 8]) + y * np.float32(places[k, 9])
        v += z * (along + z * np.float32(places[k, 10]))
    total = np.float32(0)
    for n in range(terms.size):
        total += terms[n] * math.cos(np.float32(2 * math.pi * n) * np.float32(half_frequency) * v)
    return total


@_inlined
def _sample(samples: Any, row: Any, bin_: Any, right: Any) -> Any:
    """Quadratic spline at `right` bins from a bin: real and imaginary part."""
    half, square = np.float32(0.5), right * right
    even, odd = half * square + np.float32(0.125), half * right
    before, here, after = even - odd, np.float32(0.75) - square, even + odd
    s, t, u = samples[row, bin_ - 1], samples[row, bin_], samples[row, bin_ + 1]
    return (
        before * _real(s) + here * _real(t) + after * _real(u),
        before * _imag(s) + here * _imag(t) + after * _imag(u),
    )


@_inlined
def _see(sights: Any, k: Any, x: Any, y: Any, z: Any, scales: Any) -> Any:
    """View of pulse k on the middle (x, y, z) of a thread's pixels.

    Range over the reference range, m; its phase, in cycles about a whole number; its bin, and how far it lies from
    there; the direction; and 1 / (2 R).
    """
    dx, dy, dz = x - sights[k, 0], y - sights[k, 1], z - sights[k, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    away = distance - sights[k, 3]
    turns, position = away * scales[1], away * scales[2] + scales[0]
    turn, whole = turns - math.floor(turns + 0.5), math.floor(position + 0.5)
    inverse = np.float32(1) / np.float32(distance)
    return (
        np.float32(away), np.float32(turn), int(whole), np.float32(position - whole), np.float32(dx) * inverse,
        np.float32(dy) * inverse, np.float32(dz) * inverse, np.float32(0.5) * inverse,
    )  # fmt: skip


@cache
def _adder(side: int, weighted: bool, hilly: bool) -> Any:
    """Make the kernel in which each thread sums `side` x `side` pixels.

    Of its `sights`, a row for each pulse: the antenna, the reference range, and the centre of the places, m. Of its
    `scales`: the bin of the reference range, cycles and bins per metre, the largest unambiguous range, half of the
    frequency of weights over the beam, and the height of level ground, m.
    """
    count = side * side

    @cuda.jit(fastmath=True, cache=True)
    def add(
        image: Any, outside: Any, weight: Any, samples: Any, x: Any, y: Any, z: Any, first: Any, last: Any,
        begin: Any, end: Any, sights: Any, scales: Any, places: Any, terms: Any,
    ) -> None:  # fmt: skip
        column, row = cuda.grid(2)
        column, row = column * side, row * side
        if row >= image.shape[0] or column >= image.shape[1]:
            return
        ux, uy, uz = cuda.local.array(count, Single), cuda.local.array(count, Single), cuda.local.array(count, Single)
        re, im, far = cuda.local.array(count, Single), cuda.local.array(count, Single), cuda.local.array(count, Single)
        total, lit = cuda.local.array(count, Single), cuda.local.array(count, Whole)
        unlit = cuda.local.array(count, Whole)
        # Pixels beyond the image are those at its end, and are not written.
        bottom, right = min(row + side, image.shape[0]) - 1, min(column + side, image.shape[1]) - 1
        mx, my = (x[row, column] + x[bottom, right]) / 2, (y[row, column] + y[bottom, right]) / 2
        mz = (z[row, column] + z[bottom, right]) / 2 if hilly else scales[5]
        low, high = end, begin
        for i in range(count):
            r, c = min(row + i // side, bottom), min(column + i % side, right)
            ux[i], uy[i], uz[i] = x[r, c] - mx, y[r, c] - my, (z[r, c] - mz if hilly else 0.0)
            lit[i], unlit[i] = max(first[r, c], begin), min(last[r, c], end)
            low, high = min(low, lit[i]), max(high, unlit[i])
            re[i], im[i], total[i], far[i] = 0, 0, 0, 0
        half, one, cycles, bins = np.float32(0.5), np.float32(1), np.float32(scales[1]), np.float32(scales[2])
        for p in range(low, high):
            k = p - begin
            away, turn, whole, offset, ex, ey, ez, g = _see(sights, k, mx, my, mz, scales)
            cx, cy, cz = np.float32(mx - sights[k, 4]), np.float32(my - sights[k, 5]), np.float32(mz - sights[k, 6])
            for i in range(count):
                w = ex * ux[i] + ey * uy[i] + ez * uz[i] + g * (ux[i] * ux[i] + uy[i] * uy[i] + uz[i] * uz[i])
                q = g * w
                more = w + w * (q * (q + q - one))
                place = offset + more * bins
                nearest = math.floor(place + half)
                bin_ = min(max(whole + int(nearest), 1), samples.shape[1] - 2)
                a, b = _sample(samples, k, bin_, place - nearest)
                if lit[i] <= p < unlit[i]:
                    far[i] = max(far[i], abs(away + more))
                    if weighted:
                        part = _weight(places, k, cx + ux[i], cy + uy[i], cz + uz[i], hilly, terms, scales[4])
                        total[i] += part * np.float32(places[k, 6])
                        a, b = a * part, b * part
                    angle = (turn + more * cycles) * np.float32(2 * math.pi)
                    cos, sin = math.cos(angle), math.sin(angle)
                    re[i] += a * cos - b * sin
                    im[i] += a * sin + b * cos
        for i in range(count):
            r, c = row + i // side, column + i % side
            if r < image.shape[0] and c < image.shape[1]:
                image[r, c] += complex(re[i], im[i])
                if far[i] > scales[3]:
                    outside[r, c] = True
                if weighted:
                    weight[r, c] += total[i]

    return add


def missing() -> str | None:
    """Explain why there is no GPU; None if there is one."""
    if SIMULATED:
        return None
    try:
        return None if xp.cuda.runtime.getDeviceCount() else "no GPU is found"
    except xp.cuda.runtime.CUDARuntimeError as error:
        return f"no GPU is found ({' '.join(str(error).split())})"


class Gpu:
    """The GPU given to this process."""

    name = "gpu"
    upsampling = UPSAMPLING["gpu"]
    group_bytes = GPU_PART_BYTES

    def limit(self, memory: int) -> None:
        if SIMULATED:
            return
        pool = xp.get_default_memory_pool()
        xp.fft.config.get_plan_cache().set_size(TRANSFORMS)  # each keeps its work area
        pool.set_limit(size=memory)
        free = xp.cuda.runtime.memGetInfo()[0] + pool.total_bytes()
        if free < memory:
            raise MemoryError(f"{size_text(memory)} are needed, {size_text(free)} are free")

    def put(self, values: Any) -> Any:
        return None if values is None else xp.array(values)

    def take(self, values: Any) -> Any:
        return values if SIMULATED or values is None else xp.asnumpy(values)

    def empty(self, shape: Any, dtype: Any) -> Any:
        return xp.empty(shape, dtype)

    def fft_rows(self, group: Any, *, inverse: bool) -> Any:
        if SIMULATED:
            return fft_rows(group, inverse=inverse)
        return (xp.fft.ifft if inverse else xp.fft.fft)(group, axis=1)

    def run(self, work: Callable[[slice], None], rows: int, length: int, threads: int) -> None:
        work(slice(0, rows))

    def turn_and_decimate(
        self, values: Any, source: IntArray, first: FloatArray, step: FloatArray, decimation: Decimation,
        target: IntArray, out: Any, others: Any,
    ) -> None:  # fmt: skip
        turned = xp.empty((source.size, values.shape[1]), np.complex64)
        first, step = (xp.asarray(cycles - np.rint(cycles), np.float64) for cycles in (first, step))
        _launch(_turn, turned.shape, values, xp.asarray(source), first, step, turned)
        start = decimation.span(values.shape[1])[1] - decimation.half
        into = xp.asarray(target), out, others
        _launch(
            _decimate_rows, (source.size, out.shape[1]), turned, _on_gpu(decimation), decimation.factor, start, *into
        )

    def add_decimated(self, rows: Any, runs: IntArray, decimation: Decimation, out: Any) -> None:
        most = int(runs[:, 4].max())
        shape = runs.shape[0] * most, out.shape[1]
        factor = decimation.factor
        _launch(_add_decimated_columns, shape, rows, xp.asarray(runs), most, _on_gpu(decimation), factor, out)

    def project(
        self, image: Any, outside: Any, sights: Sights, pixels: LitPixels, weight: Any, threads: int = 1,
        given: Tiles | None = None,
    ) -> None:  # fmt: skip
        """Sum; under a taper over the beam by parts over which the place in it is a polynomial."""
        (x, y, z, first, last), n, weighted = pixels, sights.reference_range.size, sights.taper is not None
        low, high = self.take(xp.stack([f(axis) for f in (xp.min, xp.max) for axis in (x, y, z)])).reshape(2, 3)
        hilly = bool(high[2] > low[2])
        tiles = given or Tiles(
            windows=np.array([[0, image.shape[0], 0, image.shape[1]]]), low=low[None], high=high[None],
            rows=np.array([[sights.start, sights.start + n]]),
        )  # fmt: skip
        rows = tiles.rows - sights.start
        # Each pulse is seen from one tile: all of the image, or the part whose row it is.
        tile = np.repeat(np.arange(rows.shape[0]), rows[:, 1] - rows[:, 0])
        places, precise = place_tables(sights.taper, np.arange(n), tile, tiles.low, tiles.high)
        if image.size > 1 and not precise.all():
            for window, (begin, end) in zip(tiles.slices(), rows.tolist(), strict=True):
                some = sights.of(slice(begin, end), sights.values[begin:end])
                for part in halves(window) if rows.shape[0] == 1 else [window]:
                    over = None if weight is None else weight[part]
                    self.project(image[part], outside[part], some, pixels.of(part), over)
            return
        none, centre = xp.zeros((1, 1)), ((tiles.low + tiles.high) / 2)[tile]
        table = np.column_stack([sights.antenna, sights.reference_range, centre])
        terms, frequency = (
            (sights.taper.terms.astype(np.float32), sights.taper.frequency) if sights.taper else (np.zeros(1), 0.0)
        )
        of_pulses = sights.middle, sights.cycles_per_metre, sights.bins_per_metre, min(sights.half_window, FAR)
        scales = np.array([*of_pulses, frequency / 2, (low[2] + high[2]) / 2])
        side = SIDE if _near(sights, [x, y, z] if hilly else [x, y], high[2]) else 1
        _launch(
            _adder(side, weighted, hilly), (-(-image.shape[0] // side), -(-image.shape[1] // side)), image, outside,
            weight if weighted else none, sights.values.view(np.float64), x, y, z if hilly else none, first, last,
            sights.start, sights.start + n, xp.asarray(table), xp.asarray(scales),
            xp.asarray(places) if weighted else none, xp.asarray(terms, np.float32), threads=THREADS,
        )  # fmt: skip


def _near(sights: Sights, axes: Sequence[Any], top: float) -> bool:
    """Tell whether a thread's pixels are close enough to derive their ranges from their middle's in float32.

    They lie at coordinates (n_row, n_column) along axes, m, and no higher than `top`.
    """
    if min(axes[0].shape) < SIDE:
        return False
    squared = sum(np.square(axis[1:, 1:] - axis[:-1, :-1]) + np.square(axis[1:, :-1] - axis[:-1, 1:]) for axis in axes)
    apart = math.sqrt(float(np.max(squared)))  # no less than the longer diagonal
    nearest = float(np.min(np.abs(sights.reference_range))) if math.isinf(sights.half_window) else 0.0
    nearest = max(nearest, float(sights.antenna[:, 2].min() - top))
    return apart * sights.cycles_per_metre < MOST_CYCLES and apart < NEAR * nearest


@cache
def _on_gpu(decimation: Decimation) -> Any:
    """Copy a filter's taps to the GPU."""
    return xp.array(decimation.taps)


def _launch(kernel: Any, shape: tuple[int, ...], *arguments: Any, threads: tuple[int, int] = (ROW_THREADS, 1)) -> None:
    """Run a kernel over rows and columns (n_row, n_column)."""
    if min(shape) < 1:
        return
    blocks = -(-shape[1] // threads[0]), -(-shape[0] // threads[1])
    if not SIMULATED:
        kernel[blocks, threads](*arguments)
        return
    # The simulator takes whole arrays only.
    given = [np.ascontiguousarray(each) if isinstance(each, np.ndarray) else each for each in arguments]
    kernel[blocks, threads](*given)
    for argument, each in zip(arguments, given, strict=True):
        if argument is not each:
            argument[...] = each
