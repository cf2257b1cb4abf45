"""Echoes of scatterers: by direct summation, or by a non-uniform Fourier transform if there are many."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import finufft
import numpy as np
from numba import njit, types
from numpy.typing import NDArray
from scipy import fft  # not kernels.fourier: this inverse transform leads to fast time, on its own grid

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.beam import EDGE, beam_at, in_beam, wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.kernels.fourier import chirp_spectrum
from blocksar.kernels.lanes import cosine, sine
from blocksar.kernels.loops import COMPILED, REAL_ROW, Loop, loop
from blocksar.simulation.scene_ground import Shadow, cast_shadow

_FIELD = (
    *(REAL_ROW, REAL_ROW, REAL_ROW, types.Array(types.complex128, 1, "C", readonly=True)),
    types.none,
    types.Array(types.float64, 1, "A", readonly=True),
)  # types of a field's x, y, yaw, reflectivity and z, and of the antenna's position
_RAISED = (*_FIELD[:4], REAL_ROW, _FIELD[5])  # of a field with heights


def compiled(function: Callable[..., None], *arguments: Any) -> tuple[Loop, Loop]:
    """Compile a loop over scatterers twice: for those on the ground plane, and for those with heights."""
    plain, raised = (loop(*field, *arguments, **COMPILED) for field in (_FIELD, _RAISED))
    return plain(function), raised(function)


class Scatterers(NamedTuple):
    """Places (n,), m, yaw, rad, and reflectivity of scatterers; heights z, or None on the ground plane."""

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    reflectivity: NDArray[np.complex128]
    z: FloatArray | None = None

    def at(self, which: slice | BoolArray | IntArray) -> Scatterers:
        """Select some scatterers."""
        return Scatterers(*(None if column is None else column[which] for column in self))  # type: ignore[arg-type]


NUFFT_ACCURACY = 1e-7  # relative to the norm of the lit reflectivity: below the rounding error of complex64
DIRECT_LIMIT = 400  # scatterers beyond which the non-uniform transform is faster
BLOCK = 16  # pulses that a thread computes at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Field:
    """Scatterers of one collection, sorted by yaw, so that the lit ones are a slice.

    Attributes
    ----------
    collection : Collection
    x, y : (n,) float
        m, scene frame.
    yaw : (n,) float
        Ascending, in [-pi, pi], rad.
    reflectivity : (n,) complex128
    z : (n,) float or None
        m; None: on the ground plane.
    shadow : Shadow or None
        The pulses that the terrain keeps from them.
    """

    collection: Collection
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    reflectivity: NDArray[np.complex128]
    z: FloatArray | None = None
    shadow: Shadow | None = None

    @cached_property
    def geometry(self) -> Geometry:
        return Geometry(collection=self.collection)

    def part(self, pulse: int, first: int, last: int) -> Scatterers:
        """Scatterers of a slice that a pulse lights; their reflectivity includes the antenna's pattern.

        Under a beam that is described by its yaw, all of the slice but those in shadow: the loops ask the rule.
        """
        of = Scatterers(self.x, self.y, self.yaw, self.reflectivity, self.z).at(slice(first, last))
        if self.shadow is not None:
            of = of.at(~self.shadow.at(pulse, first, last))
        if self.collection.has_axis:
            of = of.at(self.geometry.beam.is_lit(of.x, of.y, slice(pulse, pulse + 1), of.z)[:, 0])
        if self.collection.has_pattern:
            of = of._replace(reflectivity=of.reflectivity * self.geometry.beam.gain(of.x, of.y, pulse, of.z))
        return of

    def lit_slices(self, pulse: int) -> list[tuple[int, int]]:
        """Return slices that contain all scatterers lit at a pulse, and at most one unlit on either side.

        All scatterers under a beam that is not described by its yaw. There are two slices if the beam extends across
        yaw = +-pi.
        """
        if not self.geometry.beam.by_yaw:
            return [(0, self.yaw.size)]
        azimuth, half = _beam(self.collection, pulse)
        azimuth, half = wrapped(azimuth), half + EDGE
        slices = []
        for beam in (azimuth - TURN, azimuth, azimuth + TURN):
            first, last = np.searchsorted(self.yaw, [beam - half, beam + half])
            if last > first:
                slices.append((int(first), int(last)))
        return slices


def field(
    collection: Collection, x: FloatArray, y: FloatArray, reflectivity: NDArray[Any], z: FloatArray | None = None,
    *, terrain: Terrain | None = None, threads: int = 1,
) -> Field:  # fmt: skip
    """Prepare scatterers, on the ground plane without z, for `phase_history` and `raw_echo`; arrays of any shape.

    Those with z do not echo where the terrain hides them.

    Raises
    ------
    ValueError
        If x, y, z and reflectivity differ in size, or are not finite.
    """
    x = np.atleast_1d(np.asarray(x, dtype=np.float64)).ravel()
    y = np.atleast_1d(np.asarray(y, dtype=np.float64)).ravel()
    sigma = np.atleast_1d(np.asarray(reflectivity, dtype=np.complex128)).ravel()
    if not x.size == y.size == sigma.size:
        raise ValueError(f"{x.size=}, {y.size=} and {sigma.size=} must agree")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(sigma).all()):
        raise ValueError("x, y and reflectivity must be finite")
    if z is not None:
        z = np.atleast_1d(np.asarray(z, dtype=np.float64)).ravel()
        if z.size != x.size or not np.isfinite(z).all():
            raise ValueError(f"z must be {x.size} finite heights, got {z.size}")
    yaw = np.asarray(Geometry(collection=collection).yaw(x, y), dtype=np.float64)
    order = np.argsort(yaw, kind="stable")
    x, y, yaw, sigma, z = Scatterers(x, y, yaw, sigma, z).at(order)
    shadow = None if terrain is None or z is None else cast_shadow(collection, terrain, x, y, z, threads=threads)
    return Field(collection=collection, x=x, y=y, yaw=yaw, reflectivity=sigma, z=z, shadow=shadow)


def simulate_pulses(
    collection: Collection,
    x: FloatArray,
    y: FloatArray,
    reflectivity: NDArray[Any],
    *,
    pulses: slice = slice(None),
    threads: int = 1,
) -> ComplexArray:
    """Simulate range-frequency samples of scatterers on the ground plane, with exact ranges.

    signal[p, f] = sum over lit scatterers of sigma exp(-4j pi (fc + f) / c (R(t_p) - reference_range[p]))

    Parameters
    ----------
    collection : Collection
        Its ground_height is the scatterers' height.
    x, y : (n,) float
        m, scene frame.
    reflectivity : (n,) complex
    pulses : slice
        Pulses of the collection, with step 1.
    threads : int
        Number of threads; the result does not depend on it.

    Returns
    -------
    (n_pulses, n_range_frequency) complex64
    """
    return phase_history(field(collection, x, y, reflectivity), pulses=pulses, threads=threads)


def phase_history(scatterers: Field, *, pulses: slice, threads: int = 1) -> ComplexArray:
    """Simulate as `simulate_pulses` does, for scatterers that are prepared once for many calls.

    Few scatterers are summed directly (error below 1e-7 each), many by a non-uniform Fourier transform (error below
    1e-6 of the root sum square of the lit reflectivity).
    """
    collection = scatterers.collection
    if scatterers.yaw.size > DIRECT_LIMIT:
        n = collection.n_range_frequency
        grid = _Grid(
            n=n,
            middle=float(collection.range_frequency[n // 2]),
            step=collection.range_frequency_step,
            envelope_range=collection.reference_range,
        )
        return _in_blocks(lambda block, out: _transform(scatterers, grid, block, out), pulses, collection, n, threads)
    return _in_blocks(
        lambda block, out: _direct(scatterers, block, out), pulses, collection, collection.n_range_frequency, threads
    )


def raw_echo(
    scatterers: Field,
    *,
    fast_time: FloatArray,
    chirp_rate: float,
    pulse_width: float,
    pulses: slice,
    threads: int = 1,
    exact: bool = True,
) -> ComplexArray:
    """Simulate the chirped echo over fast time.

    echo[p, tau] = sum over lit scatterers of sigma p(tau - 2R/c) exp(-4j pi fc / c (R - reference_range[p])),
    p(tau) = exp(j pi chirp_rate tau^2) for |tau| <= pulse_width / 2.

    Parameters
    ----------
    scatterers : Field
    fast_time : (n_fast_time,) float
        Two-way delay, s; uniform.
    chirp_rate : float
        Hz/s.
    pulse_width : float
        s.
    pulses : slice
    threads : int
    exact : bool
        True: p is evaluated at every sample of every scatterer. False, for many scatterers: the samples are computed
        from the chirp's spectrum within half the sampling rate, on the Fourier grid of the fast-time samples. A
        receiver with an ideal anti-alias filter records the same; the difference from the exact samples is the
        chirp's spectral tails, chiefly at the two ends of the pulse.

    Returns
    -------
    (n_pulses, n_fast_time) complex64
    """
    collection, n = scatterers.collection, fast_time.size
    interval = (fast_time[-1] - fast_time[0]) / (n - 1)
    if exact:
        start, half = float(fast_time[0]), pulse_width / 2
        return _in_blocks(
            lambda block, out: _direct_echo(scatterers, block, start, interval, half, chirp_rate, out),
            pulses,
            collection,
            n,
            threads,
        )
    envelope = np.full(collection.n_pulse, fast_time[0] * SPEED_OF_LIGHT / 2)
    grid = _Grid(n=n, middle=0.0, step=1 / (n * interval), envelope_range=envelope)
    frequency = np.asarray((np.arange(n) - n // 2) * grid.step, dtype=np.float64)
    spectrum = chirp_spectrum(frequency, chirp_rate=chirp_rate, pulse_width=pulse_width)
    spectrum = fft.ifftshift(spectrum / interval)

    def work(block: range, out: NDArray[Any]) -> None:
        values = np.empty(out.shape, np.complex128)
        _transform(scatterers, grid, block, values)
        out[:] = fft.ifft(fft.ifftshift(values, axes=1) * spectrum, axis=1, workers=1, overwrite_x=True)

    return _in_blocks(work, pulses, collection, n, threads)


# -- blocks of pulses ---------------------------------------------------------------------------------------


def _in_blocks(
    work: Callable[[range, ComplexArray], None], pulses: slice, collection: Collection, n: int, threads: int
) -> ComplexArray:
    """Fill (len(block), n) rows by `work` for every block of pulses, in threads; compiled code releases the GIL."""
    first, stop, step = pulses.indices(collection.n_pulse)
    if step != 1:
        raise ValueError(f"{pulses=}: the step must be 1")
    out = np.empty((max(stop - first, 0), n), np.complex64)
    blocks = [range(start, min(start + BLOCK, stop)) for start in range(first, stop, BLOCK)]
    jobs = [(block, out[block.start - first : block.stop - first]) for block in blocks]
    if threads == 1:
        for job in jobs:
            work(*job)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda job: work(*job), jobs))
    return out


def _beam(collection: Collection, pulse: int) -> tuple[float, float]:
    """Yaw of the beam centre and half its width, rad; infinite half width where the beam is not described by it."""
    if collection.has_axis:
        return 0.0, np.inf
    azimuth, half_width = beam_at(collection, slice(pulse, pulse + 1))
    return float(azimuth[0]), half_width


_in_beam = njit(inline="always")(in_beam)


def _direct(scatterers: Field, block: range, out: ComplexArray) -> None:
    """Sum the range-frequency samples of few scatterers directly."""
    collection = scatterers.collection
    n = collection.n_range_frequency
    stride = int(np.ceil(np.sqrt(n)))
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        (_PULSE if scatterers.z is None else _RAISED_PULSE)(
            *scatterers.part(pulse, 0, scatterers.yaw.size),
            collection.antenna_position[pulse],
            collection.ground_height,
            beam,
            half_width,
            collection.reference_range[pulse],
            2 * (collection.carrier + collection.range_frequency[0]) / SPEED_OF_LIGHT,
            2 * collection.range_frequency_step / SPEED_OF_LIGHT,
            stride,
            out[row],
        )


def _sum_pulse(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
    z: FloatArray | None,
    antenna: FloatArray,
    height: float,
    beam: float,
    half_width: float,
    reference: float,
    cycles_first: float,
    cycles_step: float,
    stride: int,
    out: ComplexArray,
) -> None:
    """Sum echoes of a pulse: out[k] = sum sigma exp(-2j pi (cycles_first + k cycles_step) (R - reference)).

    With k = a stride + b, the exponential is a factor in a times a factor in b: 2 sqrt(n) sines and cosines of float64
    phases instead of n, and an outer product.
    """
    n = out.size
    rows = (n + stride - 1) // stride
    total_real, total_imag = np.zeros((rows, stride)), np.zeros((rows, stride))
    fine_real, fine_imag = np.empty(stride), np.empty(stride)
    for i in range(x.size):
        if not _in_beam(yaw[i], beam, half_width):
            continue
        dx, dy, dz = x[i] - antenna[0], y[i] - antenna[1], height - antenna[2]
        if z is not None:
            dz = z[i] - antenna[2]
        away = np.sqrt(dx * dx + dy * dy + dz * dz) - reference
        for b in range(stride):
            phase = -TURN * (cycles_step * b * away)
            fine_real[b], fine_imag[b] = np.cos(phase), np.sin(phase)
        for a in range(rows):
            cycles = (cycles_first + cycles_step * (a * stride)) * away
            phase = -TURN * (cycles - np.rint(cycles))
            coarse = reflectivity[i] * complex(np.cos(phase), np.sin(phase))
            cr, ci = coarse.real, coarse.imag
            for b in range(stride):
                total_real[a, b] += cr * fine_real[b] - ci * fine_imag[b]
                total_imag[a, b] += cr * fine_imag[b] + ci * fine_real[b]
    for k in range(n):
        a, b = k // stride, k % stride
        out[k] = complex(np.float32(total_real[a, b]), np.float32(total_imag[a, b]))


_PULSE, _RAISED_PULSE = compiled(_sum_pulse, *[types.float64] * 6, types.int64, types.complex64[::1])


def _direct_echo(
    scatterers: Field, block: range, start: float, interval: float, half: float, chirp_rate: float, out: ComplexArray
) -> None:
    """Sum the raw echoes of few scatterers directly."""
    collection = scatterers.collection
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        (_ECHO if scatterers.z is None else _RAISED_ECHO)(
            *scatterers.part(pulse, 0, scatterers.yaw.size),
            collection.antenna_position[pulse],
            collection.ground_height,
            beam,
            half_width,
            collection.reference_range[pulse],
            2 * collection.carrier / SPEED_OF_LIGHT,
            start,
            interval,
            half,
            chirp_rate,
            out[row],
        )


def _sum_echo(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
    z: FloatArray | None,
    antenna: FloatArray,
    height: float,
    beam: float,
    half_width: float,
    reference: float,
    cycles_per_metre: float,
    start: float,
    interval: float,
    half: float,
    chirp_rate: float,
    out: ComplexArray,
) -> None:
    """out[k] = sum sigma exp(2j pi (chirp_rate / 2 tau_k^2 - cycles_per_metre (R - reference))), within the pulse."""
    n = out.size
    total = np.zeros(n, np.complex128)
    for i in range(x.size):
        if not _in_beam(yaw[i], beam, half_width):
            continue
        dx, dy, dz = x[i] - antenna[0], y[i] - antenna[1], height - antenna[2]
        if z is not None:
            dz = z[i] - antenna[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        delay = 2 * distance / SPEED_OF_LIGHT - start
        carrier_cycles = -cycles_per_metre * (distance - reference)
        first = max(int(np.ceil((delay - half) / interval)), 0)
        last = min(int(np.floor((delay + half) / interval)), n - 1)
        for k in range(first, last + 1):
            tau = k * interval - delay
            cycles = carrier_cycles + chirp_rate / 2 * tau * tau
            phase = TURN * (cycles - np.rint(cycles))
            total[k] += reflectivity[i] * complex(np.cos(phase), np.sin(phase))
    for k in range(n):
        out[k] = complex(np.float32(total[k].real), np.float32(total[k].imag))


_ECHO, _RAISED_ECHO = compiled(_sum_echo, *[types.float64] * 9, types.complex64[::1])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Grid:
    """Frequencies middle + (k - n // 2) step, Hz, of a transform whose ranges start at envelope_range (n_pulse,), m."""

    n: int
    middle: float
    step: float
    envelope_range: FloatArray


def _transform(scatterers: Field, grid: _Grid, block: range, out: NDArray[Any]) -> None:
    """Transform: out[row, k] = sum sigma exp(-4j pi / c [fc (R - reference_range) + f_k (R - envelope_range)])."""
    collection = scatterers.collection
    # The fine grid of one transform fits into the cache, so that sorting the scatterers by range would not pay.
    plan = finufft.Plan(1, (grid.n,), eps=NUFFT_ACCURACY, isign=-1, dtype="complex128", nthreads=1, spread_sort=0)
    nodes, strengths = np.empty(scatterers.yaw.size), np.empty(scatterers.yaw.size, np.complex128)
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        n = 0
        for first, last in scatterers.lit_slices(pulse):
            part = scatterers.part(pulse, first, last)
            (_NODES if scatterers.z is None else _RAISED_NODES)(
                *part,
                collection.antenna_position[pulse],
                collection.ground_height,
                beam,
                half_width,
                collection.reference_range[pulse],
                grid.envelope_range[pulse],
                2 * collection.carrier / SPEED_OF_LIGHT,
                2 * grid.middle / SPEED_OF_LIGHT,
                2 * grid.step / SPEED_OF_LIGHT,
                nodes[n : n + part.x.size],
                strengths[n : n + part.x.size],
            )
            n += part.x.size
        if n == 0:
            out[row] = 0
            continue
        plan.setpts(nodes[:n])
        out[row] = plan.execute(strengths[:n])


def _find_nodes(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
    z: FloatArray | None,
    antenna: FloatArray,
    height: float,
    beam: float,
    half_width: float,
    reference: float,
    envelope: float,
    carrier_cycles: float,
    middle_cycles: float,
    step_cycles: float,
    nodes: FloatArray,
    strengths: NDArray[np.complex128],
) -> None:
    """Compute nodes and strengths of one pulse's transform; scatterers that are not lit have strength 0."""
    ax, ay, dz = antenna[0], antenna[1], height - antenna[2]
    for i in range(x.size):
        dx, dy = x[i] - ax, y[i] - ay
        if z is not None:
            dz = z[i] - antenna[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        away = distance - envelope
        turns = step_cycles * away
        nodes[i] = TURN * (turns - np.rint(turns))
        cycles = -(carrier_cycles * (distance - reference) + middle_cycles * away)
        part = np.float32(cycles - np.rint(cycles))
        lit = 1.0 if _in_beam(yaw[i], beam, half_width) else 0.0
        cos, sin = lit * cosine(part), lit * sine(part)
        sigma = reflectivity[i]
        strengths[i] = complex(sigma.real * cos - sigma.imag * sin, sigma.real * sin + sigma.imag * cos)


_NODES, _RAISED_NODES = compiled(_find_nodes, *[types.float64] * 8, types.float64[::1], types.complex128[::1])
