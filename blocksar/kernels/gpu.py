"""The loops of back-projection on a GPU: turns, filters along rows and columns, and sums over pulses at pixels.

They are the formulas of `decimation` and `projection`. A thread sums SIDE x SIDE neighbouring pixels about their middle:
the range of the middle, its phase, and its place in the profile are float64, once for each pulse; with R that range,
e the direction, u the pixel's offset from the middle, and g = 1 / (2 R), the range of a pixel is that of the middle and

    z (1 - q + 2 q^2),  z = e u + g |u|^2,  q = g z,

in float32. `near` tells whether that has enough of the phase; otherwise a thread sums one pixel, which is its middle.

The same source runs in numba's simulator, in which tests without a GPU compare it with the loops of the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import config, cuda

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.beam_weights import place_tables
from blocksar.kernels.decimation import Decimation, padded
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.projection import Sights, halves
from blocksar.kernels.scratch import Scratch

SIMULATED = bool(config.ENABLE_CUDASIM)
UPSAMPLING = 10  # bins of a profile per range cell: the error of the quadratic spline is then -82 dB
SIDE = 2  # pixels along either side that a thread sums
THREADS = (4, 4) if SIMULATED else (8, 16)  # of a block, along columns and rows
ROW_THREADS = 4 if SIMULATED else 128
MOST_CYCLES = 64.0  # from the middle, of which float32 has enough of the phase: 3e-5 rad
FAR = 1e30  # m, no range: the loops know no infinity
NEAR = 0.02  # of the distance, within which a pixel lies from the middle

if SIMULATED:
    xp = np

    def _real(sample: Any) -> Any:
        return np.float64(sample).view(np.complex64).real

    def _imag(sample: Any) -> Any:
        return np.float64(sample).view(np.complex64).imag

else:
    import cupy as xp
    from numba.cuda import libdevice

    @cuda.jit(device=True, inline=True)
    def _real(sample: Any) -> Any:
        return libdevice.int_as_float(libdevice.double2loint(sample))

    @cuda.jit(device=True, inline=True)
    def _imag(sample: Any) -> Any:
        return libdevice.int_as_float(libdevice.double2hiint(sample))


@cuda.jit(fastmath=True)
def _turn(values: Any, first: Any, step: Any, out: Any) -> None:
    """out[r, i] = values[r, i] exp(2j pi (first[r] + step[r] i)), and zero behind the row."""
    i, r = cuda.grid(2)
    if r < out.shape[0] and i < out.shape[1]:
        if i < values.shape[1]:
            turn = first[r] + step[r] * i
            angle = np.float32(turn - math.floor(turn + 0.5)) * np.float32(2 * math.pi)
            cos, sin = math.cos(angle), math.sin(angle)
            a, b = values[r, i].real, values[r, i].imag
            out[r, i] = complex(a * cos - b * sin, a * sin + b * cos)
        else:
            out[r, i] = 0


@cuda.jit(fastmath=True)
def _decimate_rows(values: Any, taps: Any, factor: Any, start: Any, out: Any) -> None:
    """out[r, j] = sum over k of taps[k] values[r, start + j factor + k]."""
    j, r = cuda.grid(2)
    if r < out.shape[0] and j < out.shape[1]:
        begin = start + j * factor
        re, im = np.float32(0), np.float32(0)
        for k in range(max(0, -begin), min(taps.size, values.shape[1] - begin)):
            sample = values[r, begin + k]
            re += taps[k] * sample.real
            im += taps[k] * sample.imag
        out[r, j] = complex(re, im)


@cuda.jit(fastmath=True)
def _add_decimated_columns(values: Any, taps: Any, factor: Any, start: Any, out: Any) -> None:
    """out[k, c] += sum over t of taps[t] values[start + k factor + t, c]."""
    c, k = cuda.grid(2)
    if k < out.shape[0] and c < out.shape[1]:
        begin = start + k * factor
        re, im = np.float32(0), np.float32(0)
        for t in range(max(0, -begin), min(taps.size, values.shape[0] - begin)):
            sample = values[begin + t, c]
            re += taps[t] * sample.real
            im += taps[t] * sample.imag
        out[k, c] += complex(re, im)


@cuda.jit(device=True, inline=True)
def _weight(v: Any, terms: Any, half_frequency: Any) -> Any:
    """sum_k terms_k cos(2 pi k half_frequency v)."""
    total = np.float32(0)
    for k in range(terms.size):
        total += terms[k] * math.cos(np.float32(2 * math.pi * k) * half_frequency * v)
    return total


@cache
def _adder(side: int, weighted: bool, hilly: bool) -> Any:
    """The kernel by which each thread sums `side` pixels along either side."""
    count = side * side

    @cuda.jit(fastmath=True)
    def add(
        image: Any, outside: Any, weight: Any, samples: Any, x: Any, y: Any, height: Any, first: Any, last: Any,
        begin: Any, end: Any, sights: Any, rows: Any, middle: Any, cycles_per_metre: Any, bins_per_metre: Any,
        half_window: Any, places: Any, centre_x: Any, centre_y: Any, centre_z: Any, terms: Any, half_frequency: Any,
    ) -> None:  # fmt: skip
        column, row = cuda.grid(2)
        column *= side
        row *= side
        if row >= image.shape[0] or column >= image.shape[1]:
            return
        # Pixels beyond the image are those at its end, which are then not written.
        ux = cuda.local.array(count, np.float32)
        uy = cuda.local.array(count, np.float32)
        uz = cuda.local.array(count, np.float32)
        re = cuda.local.array(count, np.float32)
        im = cuda.local.array(count, np.float32)
        total = cuda.local.array(count, np.float32)
        lit = cuda.local.array(count, np.int32)
        unlit = cuda.local.array(count, np.int32)
        after_row, after_column = min(row + side, image.shape[0]) - 1, min(column + side, image.shape[1]) - 1
        mx = (x[row, column] + x[after_row, after_column]) / 2
        my = (y[row, column] + y[after_row, after_column]) / 2
        mz = 0.0
        if hilly:
            mz = (height[row, column] + height[after_row, after_column]) / 2
        low, high = end, begin
        for i in range(count):
            r, c = min(row + i // side, after_row), min(column + i % side, after_column)
            ux[i], uy[i], uz[i] = x[r, c] - mx, y[r, c] - my, 0
            if hilly:
                uz[i] = height[r, c] - mz
            lit[i], unlit[i] = max(first[r, c], begin), min(last[r, c], end)
            low, high = min(low, lit[i]), max(high, unlit[i])
            re[i] = im[i] = total[i] = 0
        farthest, half = np.float32(0), np.float32(0.5)
        per_cycle, cycles = np.float32(bins_per_metre), np.float32(cycles_per_metre)
        bins = samples.shape[1]
        for p in range(low, high):
            k = p - begin
            dx, dy, dz = mx - sights[k, 0], my - sights[k, 1], mz - sights[k, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            away = distance - sights[k, 3]
            turns = away * cycles_per_metre
            turn = np.float32(turns - math.floor(turns + 0.5))
            position = away * bins_per_metre + middle
            whole = math.floor(position + 0.5)
            offset, bin_ = np.float32(position - whole), int(whole)
            inverse = np.float32(1) / np.float32(distance)
            ex, ey, ez = np.float32(dx) * inverse, np.float32(dy) * inverse, np.float32(dz) * inverse
            g, far = half * inverse, np.float32(away)
            at = rows[k]
            for i in range(count):
                z = ex * ux[i] + ey * uy[i] + g * (ux[i] * ux[i] + uy[i] * uy[i] + uz[i] * uz[i])
                if hilly:
                    z += ez * uz[i]
                q = g * z
                more = z + z * (q * (q + q - np.float32(1)))
                place = offset + more * per_cycle
                nearest = math.floor(place + half)
                right = place - nearest
                b = min(max(bin_ + int(nearest), 1), bins - 2)
                angle = (turn + more * cycles) * np.float32(2 * math.pi)
                seen = lit[i] <= p and p < unlit[i]
                if seen:
                    farthest = max(farthest, abs(far + more))
                part = np.float32(1) if seen else np.float32(0)
                if weighted:
                    if seen:
                        vx = np.float32(mx - centre_x) + ux[i]
                        vy = np.float32(my - centre_y) + uy[i]
                        v = np.float32(places[k, 0]) + vx * (
                            np.float32(places[k, 1]) + vx * np.float32(places[k, 3]) + vy * np.float32(places[k, 4])
                        )
                        v += vy * (np.float32(places[k, 2]) + vy * np.float32(places[k, 5]))
                        if hilly:
                            vz = np.float32(mz - centre_z) + uz[i]
                            v += vz * (
                                np.float32(places[k, 7]) + vx * np.float32(places[k, 8])
                                + vy * np.float32(places[k, 9]) + vz * np.float32(places[k, 10])
                            )  # fmt: skip
                        part = _weight(v, terms, np.float32(half_frequency))
                        total[i] += part * np.float32(places[k, 6])
                square = right * right
                even, odd = half * square + np.float32(0.125), half * right
                before, here, after = (even - odd) * part, (np.float32(0.75) - square) * part, (even + odd) * part
                s, t, u = samples[at, b - 1], samples[at, b], samples[at, b + 1]
                a = before * _real(s) + here * _real(t) + after * _real(u)
                d = before * _imag(s) + here * _imag(t) + after * _imag(u)
                cos, sin = math.cos(angle), math.sin(angle)
                re[i] += a * cos - d * sin
                im[i] += a * sin + d * cos
        for i in range(count):
            r, c = row + i // side, column + i % side
            if r < image.shape[0] and c < image.shape[1]:
                image[r, c] += complex(re[i], im[i])
                if farthest > half_window:
                    outside[r, c] = True
                if weighted:
                    weight[r, c] += total[i]

    return add


def count() -> int:
    """How many GPUs there are."""
    if SIMULATED:
        return 1
    try:
        return int(xp.cuda.runtime.getDeviceCount())
    except xp.cuda.runtime.CUDARuntimeError:
        return 0


class Gpu:
    """A GPU: the one that this process is given."""

    name = "gpu"
    upsampling = UPSAMPLING

    def put(self, values: Any) -> Any:
        return None if values is None else xp.asarray(values)

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
        self, values: Any, first: FloatArray, step: FloatArray, decimation: Decimation, scratch: Scratch
    ) -> Any:
        n, whole = values.shape[1], decimation.factor == 1
        size, start = decimation.span(n)
        first, step = (xp.asarray(cycles - np.rint(cycles), np.float64) for cycles in (first, step))
        out = scratch.array("turned", (values.shape[0], padded(size)))
        turned = out if whole else scratch.array("turning", values.shape)
        _launch(_turn, turned.shape, values, first, step, turned)
        if not whole:
            taps = _on_gpu(decimation)
            _launch(_decimate_rows, out.shape, turned, taps, decimation.factor, start - decimation.half, out)
        return out

    def add_decimated(self, rows: Any, decimation: Decimation, at: int, out: Any) -> None:
        if decimation.factor == 1:
            low, high = max(0, at), min(rows.shape[0], at + out.shape[0])
            if low < high:
                out[low - at : high - at] += rows[low:high]
            return
        taps = _on_gpu(decimation)
        _launch(_add_decimated_columns, out.shape, rows, taps, decimation.factor, at - decimation.half, out)

    def project(
        self, image: Any, outside: Any, sights: Sights, x: Any, y: Any, first: Any, last: Any, weight: Any, height: Any,
        threads: int = 1,
    ) -> None:  # fmt: skip
        """Sum; under a taper over the beam by parts over which the place in it is a polynomial."""
        n = sights.reference_range.size
        low, high = (np.array([float(f(axis)) for axis in (x, y)]) for f in (np.min, np.max))
        over = None
        if height is not None:
            ends = float(height.min()), float(height.max())
            over = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
        places, precise = place_tables(sights.taper, slice(0, n), low, high, over)
        if image.size > 1 and not precise:
            for part in halves(image.shape):
                of_part = None if height is None else height[part], None if weight is None else weight[part]
                self.project(
                    image[part],
                    outside[part],
                    sights,
                    x[part],
                    y[part],
                    first[part],
                    last[part],
                    of_part[1],
                    of_part[0],
                )
            return
        table = np.column_stack([sights.antenna.T, sights.reference_range])
        weighted, centre = sights.taper is not None, (low + high) / 2
        terms = np.zeros(1, np.float32) if sights.taper is None else sights.taper.series
        side = SIDE if _near(sights, image.shape, x, y, height) else 1
        none = xp.zeros((1, 1))
        _launch(
            _adder(side, weighted, height is not None), tuple(-(-k // side) for k in image.shape),
            image, outside, none.astype(np.float32) if weight is None else weight, sights.values.view(np.float64), x, y,
            none if height is None else height, first, last, sights.start, sights.start + n, xp.asarray(table),
            xp.asarray(sights.rows, np.int32), float(sights.middle), sights.cycles_per_metre, sights.bins_per_metre,
            min(sights.half_window, FAR), xp.asarray(places) if places.size else none, *centre, over[0] if over else 0.0,
            xp.asarray(terms), 0.0 if sights.taper is None else sights.taper.frequency / 2, threads=THREADS,
        )  # fmt: skip


def _near(sights: Sights, shape: tuple[int, ...], x: Any, y: Any, height: Any) -> bool:
    """Whether pixels of a thread are so close together that their ranges follow from their middle's in float32."""
    if min(shape) < SIDE:
        return False
    axes = [x, y] if height is None else [x, y, height]
    squared = sum(np.square(axis[1:, 1:] - axis[:-1, :-1]) + np.square(axis[1:, :-1] - axis[:-1, 1:]) for axis in axes)
    apart = math.sqrt(float(np.max(squared)))  # no less than the longer diagonal
    nearest = float(np.min(np.abs(sights.reference_range))) if math.isinf(sights.half_window) else 0.0
    nearest = max(nearest, float(sights.antenna[2].min()))
    return apart * sights.cycles_per_metre < MOST_CYCLES and apart < NEAR * nearest


@cache
def _on_gpu(decimation: Decimation) -> Any:
    """The taps of a filter."""
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
