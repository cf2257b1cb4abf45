"""Known targets to phase history or raw echo, with exact ranges: no series anywhere.

Point targets are summed directly. Random fields and maps of up to millions of scatterers go through a non-uniform
Fourier transform: in one pulse, the signal over range frequency is the Fourier transform of reflectivity over range,
and range is not on a grid. Ranges and phases are float64 throughout, samples complex64.

Every pulse is computed by itself, in blocks whose size is fixed: the samples do not depend on the number of threads,
nor on how the pulses are cut into chunks.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import finufft
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft  # not fourier.py: this inverse transform leads to fast time, on its own grid

from blocksar import stores
from blocksar.geometry import Geometry
from blocksar.parameters import SPEED_OF_LIGHT, Collection, ComplexArray, FloatArray, InputError
from blocksar.phase import cosine, sine
from blocksar.places import LocalPlace, Location, Place, place
from blocksar.recovery import chirp_spectrum
from blocksar.scene import Scene

NUFFT_ACCURACY = 1e-7  # relative to the norm of the lit reflectivity: below the rounding of complex64
DIRECT_LIMIT = 400  # scatterers from which the non-uniform transform is the faster one
BLOCK = 16  # pulses that one thread takes at a time
MAX_NAMED_TARGETS = 2000  # more are not listed in the store's attributes
TURN = 2 * np.pi

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Field:
    """Scatterers of one collection, sorted by yaw, so that the lit ones are a slice.

    Attributes
    ----------
    collection : Collection
    x, y : (n,) float
        m, scene frame, on the ground plane.
    yaw : (n,) float
        Ascending, in [-pi, pi], rad.
    reflectivity : (n,) complex128
    """

    collection: Collection
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    reflectivity: NDArray[np.complex128]

    def lit_slices(self, pulse: int) -> list[tuple[int, int]]:
        """Slices that hold all scatterers lit at a pulse, and perhaps one on either side that is not.

        Two where the beam looks across yaw = +-pi.
        """
        width = self.collection.beam_width
        if width is None:
            return [(0, self.yaw.size)]
        half = width / 2 * (1 + 1e-12) + 1e-12
        azimuth = wrapped(self.collection.beam_azimuth[pulse])
        found = []
        for beam in (azimuth - TURN, azimuth, azimuth + TURN):
            first, last = np.searchsorted(self.yaw, [beam - half, beam + half])
            if last > first:
                found.append((int(first), int(last)))
        return found


def field(collection: Collection, x: FloatArray, y: FloatArray, reflectivity: NDArray[Any]) -> Field:
    """Scatterers of any shape, ready for `phase_history` and `raw_echo`.

    Raises
    ------
    ValueError
        If x, y and reflectivity differ in size, or are not finite.
    """
    x = np.atleast_1d(np.asarray(x, dtype=np.float64)).ravel()
    y = np.atleast_1d(np.asarray(y, dtype=np.float64)).ravel()
    sigma = np.atleast_1d(np.asarray(reflectivity, dtype=np.complex128)).ravel()
    if not x.size == y.size == sigma.size:
        raise ValueError(f"{x.size=}, {y.size=} and {sigma.size=} must agree")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(sigma).all()):
        raise ValueError("x, y and reflectivity must be finite")
    yaw = np.asarray(Geometry(collection=collection).yaw(x, y), dtype=np.float64)
    order = np.argsort(yaw, kind="stable")
    return Field(collection=collection, x=x[order], y=y[order], yaw=yaw[order], reflectivity=sigma[order])


def simulate_pulses(
    collection: Collection,
    x: FloatArray,
    y: FloatArray,
    reflectivity: NDArray[Any],
    *,
    pulses: slice = slice(None),
    threads: int = 1,
) -> ComplexArray:
    """Range-frequency samples of scatterers on the ground plane, exact ranges.

    signal[p, f] = sum over lit scatterers of sigma exp(-4j pi (fc + f) / c (R(t_p) - reference_range[p]))

    Parameters
    ----------
    collection : Collection
        Its ground_height is the scatterers' height.
    x, y : (n,) float
        m, scene frame.
    reflectivity : (n,) complex
    pulses : slice
        Of the collection's pulses, step 1.
    threads : int
        The result does not depend on it.

    Returns
    -------
    (n_pulses, n_range_frequency) complex64
    """
    return phase_history(field(collection, x, y, reflectivity), pulses=pulses, threads=threads)


def phase_history(scatterers: Field, *, pulses: slice, threads: int = 1) -> ComplexArray:
    """As `simulate_pulses`, of scatterers that are prepared once for many calls.

    Few are summed directly (error below 1e-7 each), many by a non-uniform Fourier transform (error below 1e-6 of
    the root sum square of the lit reflectivity).
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
    """Chirped echo over fast time.

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
        True: p is evaluated at every sample of every scatterer. False, for many scatterers: the samples are built
        from the chirp's spectrum within half the sampling rate, on the Fourier grid of the fast-time samples. That
        is what a receiver with an ideal anti-alias filter records; it differs from the exact samples by the chirp's
        spectral tails, chiefly at the two ends of the pulse.

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


def noise(shape: tuple[int, int], *, first_pulse: int, power: float, seed: int) -> ComplexArray:
    """Circular Gaussian noise, E|n|^2 = power: (n_pulse, n) complex64.

    The generator is keyed by (seed, pulse), so a pulse's noise is the same however the pulses are cut.
    """
    out = np.empty(shape, np.complex64)
    scale = np.float32(np.sqrt(power / 2))
    for row in range(shape[0]):
        random = np.random.Generator(np.random.Philox(key=np.array([seed, first_pulse + row], dtype=np.uint64)))
        out[row] = (random.standard_normal(2 * shape[1], dtype=np.float32) * scale).view(np.complex64)
    return out


# -- blocks of pulses ---------------------------------------------------------------------------------------


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi]."""
    return float(angle - TURN * np.rint(angle / TURN))


def _in_blocks(
    work: Callable[[range, ComplexArray], None], pulses: slice, collection: Collection, n: int, threads: int
) -> ComplexArray:
    """Let `work` fill (len(block), n) rows for every block of pulses, by threads; compiled code drops the GIL."""
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
    """Yaw of the beam centre and half its width, rad; infinite half width where the beam is not steered."""
    if collection.beam_width is None:
        return 0.0, np.inf
    return float(collection.beam_azimuth[pulse]), collection.beam_width / 2


@njit(inline="always")
def _lit(yaw: float, beam: float, half_width: float) -> bool:
    away = yaw - beam
    return abs(away - TURN * np.rint(away / TURN)) <= half_width


# -- few scatterers: direct sums ----------------------------------------------------------------------------


def _direct(scatterers: Field, block: range, out: ComplexArray) -> None:
    collection = scatterers.collection
    n = collection.n_range_frequency
    stride = int(np.ceil(np.sqrt(n)))
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        _direct_pulse(
            scatterers.x,
            scatterers.y,
            scatterers.yaw,
            scatterers.reflectivity,
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


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _direct_pulse(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
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
    """out[k] = sum sigma exp(-2j pi (cycles_first + k cycles_step) (R - reference)).

    With k = a stride + b the exponential is a product of one in a and one in b: 2 sqrt(n) sines and cosines instead
    of n, all of them of float64 phases, and a plain outer product.
    """
    n = out.size
    rows = (n + stride - 1) // stride
    total_real, total_imag = np.zeros((rows, stride)), np.zeros((rows, stride))
    fine_real, fine_imag = np.empty(stride), np.empty(stride)
    for i in range(x.size):
        if not _lit(yaw[i], beam, half_width):
            continue
        dx, dy, dz = x[i] - antenna[0], y[i] - antenna[1], height - antenna[2]
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


def _direct_echo(
    scatterers: Field, block: range, start: float, interval: float, half: float, chirp_rate: float, out: ComplexArray
) -> None:
    collection = scatterers.collection
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        _direct_echo_pulse(
            scatterers.x,
            scatterers.y,
            scatterers.yaw,
            scatterers.reflectivity,
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


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _direct_echo_pulse(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
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
    n = out.size
    total = np.zeros(n, np.complex128)
    for i in range(x.size):
        if not _lit(yaw[i], beam, half_width):
            continue
        dx, dy, dz = x[i] - antenna[0], y[i] - antenna[1], height - antenna[2]
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


# -- many scatterers: non-uniform transform -----------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Grid:
    """Frequencies middle + (k - n // 2) step, Hz, of ranges counted from envelope_range (n_pulse,), m."""

    n: int
    middle: float
    step: float
    envelope_range: FloatArray


def _transform(scatterers: Field, grid: _Grid, block: range, out: NDArray[Any]) -> None:
    """out[row, k] = sum sigma exp(-4j pi / c [fc (R - reference_range) + f_k (R - envelope_range)])."""
    collection = scatterers.collection
    # The fine grid of one transform fits in the cache: sorting the scatterers by range would cost more than it saves.
    plan = finufft.Plan(1, (grid.n,), eps=NUFFT_ACCURACY, isign=-1, dtype="complex128", nthreads=1, spread_sort=0)
    nodes, strengths = np.empty(scatterers.yaw.size), np.empty(scatterers.yaw.size, np.complex128)
    for row, pulse in enumerate(block):
        beam, half_width = _beam(collection, pulse)
        n = 0
        for first, last in scatterers.lit_slices(pulse):
            _nodes_and_strengths(
                scatterers.x[first:last],
                scatterers.y[first:last],
                scatterers.yaw[first:last],
                scatterers.reflectivity[first:last],
                collection.antenna_position[pulse],
                collection.ground_height,
                beam,
                half_width,
                collection.reference_range[pulse],
                grid.envelope_range[pulse],
                2 * collection.carrier / SPEED_OF_LIGHT,
                2 * grid.middle / SPEED_OF_LIGHT,
                2 * grid.step / SPEED_OF_LIGHT,
                nodes[n : n + last - first],
                strengths[n : n + last - first],
            )
            n += last - first
        if n == 0:
            out[row] = 0
            continue
        plan.setpts(nodes[:n])
        out[row] = plan.execute(strengths[:n])


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _nodes_and_strengths(
    x: FloatArray,
    y: FloatArray,
    yaw: FloatArray,
    reflectivity: NDArray[np.complex128],
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
    ax, ay, dz = antenna[0], antenna[1], height - antenna[2]
    for i in range(x.size):
        dx, dy = x[i] - ax, y[i] - ay
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        away = distance - envelope
        turns = step_cycles * away
        nodes[i] = TURN * (turns - np.rint(turns))
        cycles = -(carrier_cycles * (distance - reference) + middle_cycles * away)
        part = np.float32(cycles - np.rint(cycles))
        lit = 1.0 if _lit(yaw[i], beam, half_width) else 0.0
        cos, sin = lit * cosine(part), lit * sine(part)
        sigma = reflectivity[i]
        strengths[i] = complex(sigma.real * cos - sigma.imag * sin, sigma.real * sin + sigma.imag * cos)


# -- scene to store -----------------------------------------------------------------------------------------


def simulate(
    scene: Scene | str | os.PathLike[str],
    out: Location,
    *,
    raw: bool = False,
    threads: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path | Place:
    """Simulate a scene into a phase-history store, chunk of pulses by chunk: the whole is never in memory.

    Parameters
    ----------
    scene : Scene, or path of a scene file, or name of a shipped scene
    out : path, URL or Place
        Of the store to make.
    raw : bool
        Store the chirped echo over fast time instead of range-frequency samples.
    threads : int
        The samples do not depend on it.
    overwrite : bool
        Replace a store that is there.
    progress : callable (done, total)
        Told after each chunk, in pulses.

    Returns
    -------
    Path
        Of the store; a Place where that is no path.

    Raises
    ------
    InputError
        If the scene is wrong, or `out` exists and overwrite is False.
    """
    if threads < 1:
        raise InputError(f"threads = {threads}: must be at least 1")
    scene = scene if isinstance(scene, Scene) else Scene.read(os.fspath(scene))
    where = place(out)
    collection = scene.collection(raw=raw)
    echo = _echo_axes(scene) if raw else None
    n = collection.n_range_frequency if echo is None else echo.fast_time.size
    sample = sampler(scene, collection, echo=echo, threads=threads)
    rows = stores.TILE[0]

    def write(store: Place) -> None:
        for first in range(0, collection.n_pulse, rows):
            pulses = slice(first, min(first + rows, collection.n_pulse))
            samples = sample(pulses)
            stores.write_region(store, "echo" if raw else "signal", (pulses, slice(0, n)), samples)
            if progress is not None:
                progress(pulses.stop, collection.n_pulse)

    # Rows that are not yet written read as lost pulses: the store gets its name when it is complete.
    stores.create_phase_history(where, collection, raw=echo, attrs=_attributes(scene), overwrite=overwrite, fill=write)
    return where.path if isinstance(where, LocalPlace) else where


def sampler(
    scene: Scene, collection: Collection, *, echo: stores.RawEcho | None = None, threads: int = 1
) -> Callable[[slice], ComplexArray]:
    """A function of a slice of pulses: their samples as stored, noise and lost pulses included.

    `collection` is the scene's own, or one that differs from it in frequencies and reference range.
    """
    n = collection.n_range_frequency if echo is None else echo.fast_time.size
    parts, lost = _reflecting(scene, collection), scene.dropped_pulses()

    def sample(pulses: slice) -> ComplexArray:
        samples = _samples(parts, echo, n, pulses, threads)
        _disturb(samples, scene, lost, pulses)
        return samples

    return sample


def _echo_axes(scene: Scene) -> stores.RawEcho:
    fast_time, pulse_width = scene.fast_time, scene.radar.pulse_width
    assert pulse_width is not None  # fast_time has refused that
    return stores.RawEcho(
        fast_time=fast_time,
        chirp_rate=scene.radar.bandwidth / pulse_width,
        pulse_width=pulse_width,
        sampling_rate=scene.radar.range_sampling,
    )


def _reflecting(scene: Scene, collection: Collection) -> list[tuple[Field, bool]]:
    """What reflects, and whether its raw echo is evaluated exactly: point targets, and field and map."""
    points, many = scene.point_targets(), scene.scatterers()
    parts = []
    if points:
        _, x, y, sigma = zip(*points, strict=True)
        parts.append((field(collection, np.array(x), np.array(y), np.array(sigma)), True))
    if many.x.size:
        parts.append((field(collection, many.x, many.y, many.reflectivity), False))
    return parts


def _samples(
    parts: list[tuple[Field, bool]], echo: stores.RawEcho | None, n: int, pulses: slice, threads: int
) -> ComplexArray:
    """The sum over what reflects, (n_pulses, n) complex64."""
    total = np.zeros((pulses.stop - pulses.start, n), np.complex64)
    for scatterers, exact in parts:
        if echo is None:
            total += phase_history(scatterers, pulses=pulses, threads=threads)
        else:
            total += raw_echo(
                scatterers,
                fast_time=echo.fast_time,
                chirp_rate=echo.chirp_rate,
                pulse_width=echo.pulse_width,
                pulses=pulses,
                threads=threads,
                exact=exact,
            )
    return total


def _disturb(samples: ComplexArray, scene: Scene, lost: NDArray[np.int64], pulses: slice) -> None:
    """Add noise to samples that nobody else has seen yet, and make rows of lost pulses NaN."""
    if scene.noise is not None and scene.noise.power > 0:
        samples += noise(samples.shape, first_pulse=pulses.start, power=scene.noise.power, seed=scene.noise.seed)
    samples[lost[(lost >= pulses.start) & (lost < pulses.stop)] - pulses.start] = complex(np.nan, np.nan)


def _attributes(scene: Scene) -> dict[str, Any]:
    """What the store tells about its scene: name, targets (where there are few), noise and seeds."""
    attrs: dict[str, Any] = {"scene": scene.name, "noise": scene.noise.power if scene.noise else 0.0}
    tables = (scene.clutter, scene.reflectivity, scene.noise, scene.dropped)
    named = zip(("clutter", "reflectivity", "noise", "dropped"), tables, strict=True)
    attrs["seed"] = {name: table.seed for name, table in named if table is not None and table.seed is not None}
    targets = scene.point_targets()
    if len(targets) <= MAX_NAMED_TARGETS:
        attrs["targets"] = [
            {"name": name, "x": x, "y": y, "reflectivity": [sigma.real, sigma.imag]} for name, x, y, sigma in targets
        ]
    return attrs
