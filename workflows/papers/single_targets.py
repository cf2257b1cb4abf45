"""Single targets through single steps: traced lines beside measured samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.signal import resample

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.constants import SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.focusing.lines import Line, focus
from blocksar.focusing.range_steps import Compression, RangeCompression, ResidualRangeWalk
from blocksar.focusing.recovery import recover_columns
from blocksar.focusing.step import stages
from blocksar.kernels.fourier import Axis
from blocksar.measurement.response import Complex128Array
from blocksar.planning.block import BlockPlan
from blocksar.planning.plan import Plan
from blocksar.planning.target_lines import recovered_line
from blocksar.products.pictures.figures import CURVE_COLOURS, LIMIT
from blocksar.products.pictures.panels import Map, Panel, Trace
from blocksar.simulation.scatterers import simulate_pulses
from papers.bench import THREADS, geometry, plan
from papers.printed import SWATH

Place = tuple[float, float]  # of a target: epoch range (m) and yaw (rad)
YAWS = 61  # of a curve
FINE = 8  # samples of a measured profile for one of the block's
PULSES = 40  # of a dwell, at which a range-compressed peak is looked for


# ---------------------------------------------------------------- single targets: traced lines, and samples


def lines(made: Plan, places: Sequence[Place]) -> Line:
    """Of some targets, in the recovered signal."""
    return recovered_line(
        made.geometry,
        epoch_range=np.array([r for r, _ in places]),
        yaw=np.array([yaw for _, yaw in places]),
        origin=made.recovery.origin,
        walk=made.recovery.walk,
    )


def traced(line: Line, block: BlockPlan, *, through: type | None = None) -> Line:
    """After the steps of a block, all or up to the last of a kind."""
    kinds = [isinstance(step, through) for step in block.chain] if through else [True] * len(block.chain)
    last = max((i for i, wanted in enumerate(kinds) if wanted), default=-1)
    for step in block.chain[: last + 1]:
        line = step.trace(line)
    return line


@cache
def slab(name: str, place: Place, first_bin: int, n_bin: int) -> ComplexArray:
    """A block's part of the recovered spectrum of one unit target: (range frequency, Doppler bin)."""
    made = plan(name, 1)
    collection = made.geometry.collection
    point = made.geometry.ground_point(np.array(place[0]), np.array(place[1]))
    signal = simulate_pulses(collection, point[:1], point[1:2], np.ones(1), threads=THREADS)
    frequency = collection.range_frequency
    spectrum = recover_columns(signal, range_frequency=frequency, recovery=made.recovery, threads=THREADS)
    return np.ascontiguousarray(spectrum[first_bin : first_bin + n_bin].T)


class Migration(NamedTuple):
    """A target after a step: its line, and where its range-compressed samples peak (time in s, range in m)."""

    line: Line
    time: FloatArray
    peak: FloatArray

    @property
    def extent(self) -> float:
        """Of the line in range, m."""
        return float(np.ptp(self.line.range))

    @property
    def disagreement(self) -> float:
        """Largest distance of a peak from the line, m."""
        return float(np.abs(self.peak - np.interp(self.time, self.line.time, self.line.range)).max())


def migrations(name: str, made: Plan, block: BlockPlan, place: Place) -> list[Migration]:
    """One target alone: after the unified walk correction, and after every step up to range compression."""
    at = next(i for i, step in enumerate(block.chain) if isinstance(step, Compression))
    walk, compression = block.chain[0], block.chain[at]
    assert isinstance(walk, ResidualRangeWalk) and isinstance(compression, RangeCompression)
    bare = replace(compression, reference=np.zeros_like(compression.reference))
    samples, line = slab(name, place, block.first_bin, block.n_bin), lines(made, [place])
    found = [_migration(line, replace(walk, walk=0.0).apply(samples, threads=THREADS), bare)]
    for step in block.chain[:at]:
        samples, line = step.apply(samples, threads=THREADS), step.trace(line)
        found.append(_migration(line, samples, bare))
    return [*found, _migration(compression.trace(line), samples, compression)]


def _migration(line: Line, samples: ComplexArray, compression: RangeCompression) -> Migration:
    """Compress some pulses of samples (range frequency, time) about the line, finely, and look for their peaks."""
    line = Line(**{name: np.ravel(getattr(line, name)) for name in Line.__dataclass_fields__})
    time, coarse = compression.time, compression.rows.step
    first, last = np.searchsorted(time.values, [line.time.min(), line.time.max()])
    every = max(int(last - first) // PULSES, 1)
    pulses = Axis(float(time.values[first]), time.step * every, len(range(first, last, every)))
    reach = np.ptp(line.range) / 2 + 4 * coarse
    around = Axis(float(line.range.mean() - reach), coarse / FINE, int(2 * reach / coarse * FINE) + 1)
    some = np.ascontiguousarray(samples[:, first:last:every])
    profiles = replace(compression, time=pulses, rows=around).apply(some, threads=THREADS)
    return Migration(line, pulses.values, _peaks(around, np.abs(profiles) ** 2))


def _peaks(axis: Axis, power: FloatArray) -> FloatArray:
    """Where each column is strongest, by a parabola through three samples."""
    top = np.clip(power.argmax(axis=0), 1, axis.size - 2)
    a, b, c = (power[top + k, np.arange(power.shape[1])] for k in (-1, 0, 1))
    return np.asarray(axis.values[top] + axis.step * (a - c) / (2 * (a - 2 * b + c)))


class Cut(NamedTuple):
    """An azimuth response: offsets (Hz) from where its line focuses, complex samples, theoretical width (Hz)."""

    offset: FloatArray
    values: Complex128Array
    width: float


def azimuth_cut(name: str, made: Plan, block: BlockPlan, place: Place) -> Cut:
    """One target alone, through the whole chain: its cut along Doppler at its strongest range."""
    samples = slab(name, place, block.first_bin, block.n_bin)
    for stage in stages(block.chain):
        samples = stage.apply(samples, threads=THREADS)
    row = int(np.abs(samples).max(axis=1).argmax())
    doppler = block.ground.doppler
    values = np.asarray(resample(samples[row].astype(np.complex128), 2 * FINE * doppler.size))
    axis = doppler.start + doppler.step / (2 * FINE) * np.arange(values.size)
    line = traced(lines(made, [place]), block)
    return Cut(axis - focus(line).doppler[0], values, SINC_WIDTH / float((line.weight * line.stretch).sum()))


class Sector(NamedTuple):
    """Yaws, rad: the whole steering interval, or a block of it."""

    low: float
    high: float

    @property
    def centre(self) -> float:
        return (self.low + self.high) / 2


def line_panel(title: str, line: Line, names: Sequence[str], *, under: Map | None = None) -> Panel:
    """Time-frequency lines (n_target, n), s and kHz; over a spectrogram all have one colour, and the first a name."""
    names = [*names, *[""] * (line.doppler.shape[0] - len(names))]
    colours = CURVE_COLOURS if under is None else [LIMIT] * len(names)
    traces = [
        Trace(name, time, doppler / 1e3, colour, "-" if under is None else "--")
        for name, time, doppler, colour in zip(names, line.time, line.doppler, colours, strict=False)
    ]
    return Panel(title, "slow time (s)", "Doppler (kHz)", traces, map=under)


# ---------------------------------------------------------------- paper A: range migration


def same_range(block: BlockPlan) -> dict[str, Place]:
    """T_A, T_B, T_C: targets of one range at a block's first yaw of full dwell, its last, and halfway."""
    full = full_dwell()
    first, last = max(block.low, full.low), min(block.high, full.high)
    yaws = (first, (first + last) / 2, last)
    return {f"T_{letter}": (SWATH["middle"], yaw) for letter, yaw in zip("ABC", yaws, strict=True)}


def cells(metres: float) -> float:
    """Range resolution cells of paper A's scene."""
    return metres * 2 * geometry("table1").collection.bandwidth / SPEED_OF_LIGHT


# ---------------------------------------------------------------- paper A: azimuth focusing


def rates(line: Line) -> FloatArray:
    """Mean Doppler rate of each line, Hz/s."""
    return np.asarray(np.diff(line.doppler[:, [0, -1]], axis=1) / np.diff(line.time[:, [0, -1]], axis=1))[:, 0]


def full_dwell() -> Sector:
    """First and last yaw that are lit for a full dwell."""
    collection = geometry("table1").collection
    half = (collection.beam_width or 0.0) / 2
    return Sector(float(collection.beam_azimuth.min()) + half, float(collection.beam_azimuth.max()) - half)
