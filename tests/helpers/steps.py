"""Helpers for the tests of the processing steps: small collections, explicit Fourier sums, measured lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scenes import TABLE1

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.method import DEFAULT, Method
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.dwells.target_lines import Dwells, Sector
from blocksar.processors.chain.planning.block import BlockPlan, plan_block
from blocksar.processors.chain.planning.spectrum_recovery import plan_recovery
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.recovery import Recovery, recover_columns
from blocksar.processors.chain.steps.step import Sampling
from blocksar.simulation.scatterers import simulate_pulses

Complex128Array = NDArray[np.complex128]


def collection(
    *,
    yaw_deg: float = 50.0,
    steering_deg: float | None = 26.23,
    beam_deg: float = 4.25,
    velocity: Sequence[float] = TABLE1["velocity"],
    acceleration: Sequence[float] = TABLE1["acceleration"],
    jerk: Sequence[float] = (0.0, 0.0, 0.0),
    wobble: Sequence[float] = (0.0, 0.0, 0.0),
    carrier: float = TABLE1["carrier"],
    bandwidth: float = TABLE1["bandwidth"],
    n_frequency: int = 80,
    n_pulse: int = 2400,
    prf: float = TABLE1["prf"],
    middle: float = 0.0,
    centre_range: float = 30e3,
    reference: str = "scene_centre",
) -> Collection:
    """A small version of Table 1: 0.3 s, and a range window of 240 m that follows the scene's centre."""
    time = middle + (np.arange(n_pulse) - n_pulse // 2) / prf
    t = time[:, None]
    position = [0.0, 0.0, 16500.0] + np.array(velocity) * t + np.array(acceleration) * t**2 / 2
    position = position + np.array(jerk) * t**3 / 6
    if any(wobble):  # m, oscillations of 3 to 7 Hz along the axes
        position = position + np.array(wobble) * np.sin(2 * np.pi * np.array([3.0, 5.0, 7.0]) * t + [0.3, 1.0, 2.0])
    yaw = np.radians(yaw_deg)
    across = np.sqrt(centre_range**2 - 16500.0**2)
    centre = np.array([across * np.cos(yaw), across * np.sin(yaw), 0.0])
    distance = np.linalg.norm(centre - position, axis=1)
    steered = steering_deg is not None
    return Collection(
        carrier=carrier,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * bandwidth / n_frequency,
        reference_range=distance if reference == "scene_centre" else np.full(n_pulse, centre_range),
        antenna_position=position,
        beam_azimuth=yaw + np.radians(steering_deg) * (time - middle) if steered else np.full(n_pulse, np.nan),
        beam_width=np.radians(beam_deg) if steered else None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """A collection with the complete plan of one of its blocks."""

    collection: Collection
    geometry: Geometry
    region: Region
    recovery: Recovery
    plan: BlockPlan


def planned(
    collection: Collection,
    *,
    blocks: int = 3,
    index: int | None = None,
    method: Method = DEFAULT,
    patch: float = 200.0,
) -> Planned:
    """Plan one of `blocks` equal blocks; an unsteered collection images `patch` metres about its centre."""
    geometry = Geometry(collection=collection)
    grid = None
    if not collection.steered:
        at = geometry.ground_point(np.array(30e3), np.radians(50.0))
        grid = Grid(at[0] - patch / 2, at[0] + patch / 2, 1.0, at[1] - patch / 2, at[1] + patch / 2, 1.0)
    region = plan_region(geometry, grid)
    recovery = plan_recovery(geometry, region)
    edges = np.linspace(region.yaw[0], region.yaw[-1], blocks + 1)
    index = blocks // 2 if index is None else index
    low, high = float(edges[index]), float(edges[index + 1])
    near, far = region.limits(low, high)
    sector = Sector(geometry=geometry, recovery=recovery, region=region, low=low, high=high, near=near, far=far)
    plan = plan_block(sector, method, index=index)
    return Planned(collection=collection, geometry=geometry, region=region, recovery=recovery, plan=plan)


def target_at(geometry: Geometry, epoch_range: float, yaw: float) -> FloatArray:
    """Ground point (3,), m."""
    return geometry.ground_point(np.array(epoch_range), np.array(yaw))


def taper(geometry: Geometry, yaw: float, time: FloatArray) -> FloatArray:
    """A smooth illumination, sin^2 over the dwell: no abrupt ends, so the line shows no ringing.

    time (n,) s, absolute.
    """
    first, last = geometry.beam.dwell_at(np.array(yaw), np.zeros(1))
    along = (time - first) / (last - first)
    return np.where((along > 0) & (along < 1), np.sin(np.pi * np.clip(along, 0, 1)) ** 2, 0.0)


def signal_of(case: Planned, epoch_range: float, yaw: float, *, tapered: bool) -> ComplexArray:
    """Samples (n_pulse, n_range_frequency) of one unit target."""
    point = target_at(case.geometry, epoch_range, yaw)
    signal = simulate_pulses(case.collection, point[:1], point[1:2], np.array([1.0 + 0j]))
    if tapered:
        signal = signal * taper(case.geometry, yaw, case.collection.time)[:, None].astype(np.float32)
    signal.flags.writeable = False
    return signal


def slab_of(case: Planned, signal: ComplexArray) -> ComplexArray:
    """The block's part of the recovered spectrum."""
    spectrum = recover_columns(signal, range_frequency=case.collection.range_frequency, recovery=case.recovery).T
    slab = spectrum[:, case.plan.first_bin : case.plan.first_bin + case.plan.n_bin].copy()
    slab.flags.writeable = False
    return slab


def line_of(case: Planned, epoch_range: float, yaw: float) -> Line:
    """(n,) line of one target in the recovered signal."""
    dwells = Dwells(
        geometry=case.geometry,
        yaw=np.array(yaw),
        origin=case.recovery.origin,
        walk=case.recovery.walk,
        common=case.recovery.common,
    )
    return dwells.lines(np.array(epoch_range))


def after_each_step(case: Planned, slab: ComplexArray, line: Line) -> Iterator[tuple[Any, ComplexArray, Line]]:
    """Yield (step, samples, line) after every step of the block's chain."""
    for step in case.plan.chain:
        slab = step.apply(slab, threads=1)
        slab.flags.writeable = False
        line = step.trace(line)
        yield step, slab, line


# Explicit sums


def explicit_transform(x: NDArray[Any], source: Axis, target: Axis, *, inverse: bool, period: int) -> Complex128Array:
    """The sums of `blocksar.kernels.fourier`, term by term along the last axis."""
    sign = 1.0 if inverse else -1.0
    cycles = np.multiply.outer(source.values, target.values)
    kernel = np.exp(sign * 2j * np.pi * (cycles - np.rint(cycles)))
    return x.astype(np.complex128) @ kernel / (period if inverse else 1)


def compress_range(values: ComplexArray, frequency: FloatArray, rng: FloatArray) -> Complex128Array:
    """sum over range frequency of S(f, t_i) exp(4j pi f r / c) / n, (n_r, n_t): range compression at any ranges.

    values (n_frequency, n_t); rng (n_r, n_t) m.
    """
    out = np.empty(rng.shape, np.complex128)
    for k, (column, at) in enumerate(zip(values.T, rng.T, strict=True)):
        kernel = np.exp(4j * np.pi / SPEED_OF_LIGHT * np.multiply.outer(at, frequency))
        out[:, k] = kernel @ column.astype(np.complex128) / frequency.size
    return out


def rows_to_frequency(values: ComplexArray, rows: Axis, period: int) -> tuple[Complex128Array, FloatArray]:
    """Transform range rows (n_row, n_t) back to range frequency, (period, n_t); also return those frequencies, Hz.

    Rows outside the slab count as zero. The band is not truncated: phases that differ from row to row widen it.
    """
    frequency = (np.arange(period) - period // 2) * SPEED_OF_LIGHT / (2 * rows.step * period)
    kernel = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.multiply.outer(frequency, rows.values))
    return kernel @ values.astype(np.complex128), frequency


# Measured lines


class Measured(NamedTuple):
    """A line measured from samples, at the times of the traced line."""

    phase: FloatArray  # cycles, minus the traced phase, wrapped to +-1/2
    doppler: FloatArray  # Hz, minus the traced Doppler
    range: FloatArray  # m, minus the traced range
    amplitude: FloatArray  # of the compressed samples


def measure_line(values: Complex128Array, line: Line, *, time: Axis, frequency: FloatArray, cell: float) -> Measured:
    """Measure S(f, t), (n_frequency, time.size), at the traced position of the target.

    Phase and Doppler: value and slope of the phase of the range-compressed signal, at the traced range, around the
    sample nearest to each traced time. Range: position of the peak of a compressed column's envelope.
    """
    near = np.rint(time.position(line.time)).astype(int)
    index = near + np.arange(-2, 3)[:, None]
    assert index.min() >= 0 and index.max() < time.size
    offset = time.values[index] - line.time
    # Extrapolate the traced line over these few samples with its own rate.
    wanted = line.phase + line.doppler * offset + line.rate * offset**2 / 2
    at = line.range + np.gradient(line.range, line.time, edge_order=2) * offset
    samples = np.stack([compress_range(values[:, i], frequency, r[None])[0] for i, r in zip(index, at, strict=True)])
    turned = samples * np.exp(-2j * np.pi * (wanted - np.rint(wanted)))
    step = np.angle(turned[1:] * turned[:-1].conj()).mean(axis=0)
    around = np.linspace(-0.5, 0.5, 11) * cell
    power = np.abs(compress_range(values[:, near], frequency, at[2] + around[:, None])) ** 2
    return Measured(
        phase=np.angle(turned[2]) / (2 * np.pi),
        doppler=step / (2 * np.pi * time.step),
        range=np.array([peak(column, around) for column in power.T]),
        amplitude=np.abs(turned[2]),
    )


def peak(power: FloatArray, around: FloatArray) -> float:
    """Return the position of the maximum of a smooth peak, by a polynomial of order 6 through it."""
    fit = np.polynomial.Polynomial.fit(around, power / power.max(), 6)
    fine = np.linspace(around[0], around[-1], 4001)
    return float(fine[np.argmax(fit(fine))])


# Sampling


def sampling(**axes: Any) -> Sampling:
    """Return a sampling for a test of one step: the axes given, and placeholders for the others."""
    unused = Axis(0.0, 1.0, 1)
    whole: dict[str, Any] = dict.fromkeys(Sampling.__dataclass_fields__, unused)
    return Sampling(**whole | {"time_occupancy": 0.5, "doppler_occupancy": 0.5, "gate": None, "summed": None} | axes)
