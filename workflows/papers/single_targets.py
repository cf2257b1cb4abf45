"""Single targets through the steps of a chain: traced lines and simulated samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.signal import resample

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.constants import SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.dwells.target_lines import Dwells
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.steps.lines import Line, focus
from blocksar.processors.chain.steps.range_steps import Compression, RangeCompression, ResidualRangeWalk
from blocksar.processors.chain.steps.recovery import recover_columns
from blocksar.processors.chain.steps.step import stages
from blocksar.products.pictures.panels import CURVE_COLOURS, LIMIT, Map, Panel, Trace
from blocksar.simulation.scatterers import simulate_pulses
from papers.bench import THREADS, geometry, plan_scene
from papers.sectors import Place

FINE = 8  # samples of a measured profile per sample of the block
PULSES = 40  # of a dwell, at which a range-compressed peak is measured


def recovered_lines(plan: Plan, places: Sequence[Place]) -> Line:
    """Lines of targets in the recovered signal."""
    yaw = np.array([yaw for _, yaw in places])
    dwells = Dwells(geometry=plan.geometry, yaw=yaw, origin=plan.recovery.origin, walk=plan.recovery.walk)
    return dwells.lines(np.array([r for r, _ in places]))


def trace(line: Line, block: BlockPlan, *, through: type | None = None) -> Line:
    """Trace lines through the steps of a block: all, or up to the last step of a kind."""
    kinds = [isinstance(step, through) for step in block.chain] if through else [True] * len(block.chain)
    last = max((i for i, matches in enumerate(kinds) if matches), default=-1)
    for step in block.chain[: last + 1]:
        line = step.trace(line)
    return line


@cache
def slab(name: str, place: Place, first_bin: int, n_bin: int) -> ComplexArray:
    """Part of the recovered spectrum of one unit target that a block uses: (range frequency, Doppler bin)."""
    plan = plan_scene(name, 1)
    collection = plan.geometry.collection
    point = plan.geometry.ground_point(np.array(place[0]), np.array(place[1]))
    signal = simulate_pulses(collection, point[:1], point[1:2], np.ones(1), threads=THREADS)
    frequency = collection.range_frequency
    spectrum = recover_columns(signal, range_frequency=frequency, recovery=plan.recovery, threads=THREADS)
    return np.ascontiguousarray(spectrum[first_bin : first_bin + n_bin].T)


class Migration(NamedTuple):
    """A target after a step: its line, and the peaks of its range-compressed samples (time in s, range in m)."""

    line: Line
    time: FloatArray
    peak: FloatArray

    @property
    def extent(self) -> float:
        """Extent of the line in range, m."""
        return float(np.ptp(self.line.range))

    @property
    def disagreement(self) -> float:
        """Largest distance of a peak from the line, m."""
        return float(np.abs(self.peak - np.interp(self.time, self.line.time, self.line.range)).max())


def migrations(name: str, plan: Plan, block: BlockPlan, place: Place) -> list[Migration]:
    """One target alone after the unified walk correction, and after every step up to range compression."""
    at = next(i for i, step in enumerate(block.chain) if isinstance(step, Compression))
    walk, compression = block.chain[0], block.chain[at]
    assert isinstance(walk, ResidualRangeWalk) and isinstance(compression, RangeCompression)
    bare = replace(compression, reference=np.zeros_like(compression.reference))
    samples, line = slab(name, place, block.first_bin, block.n_bin), recovered_lines(plan, [place])
    after = [_migration(line, replace(walk, walk=0.0).apply(samples, threads=THREADS), bare)]
    for step in block.chain[:at]:
        samples, line = step.apply(samples, threads=THREADS), step.trace(line)
        after.append(_migration(line, samples, bare))
    return [*after, _migration(compression.trace(line), samples, compression)]


def _migration(line: Line, samples: ComplexArray, compression: RangeCompression) -> Migration:
    """Compress some pulses of samples (range frequency, time) about the line, finely sampled, and find their peaks."""
    line = Line(**{name: np.ravel(getattr(line, name)) for name in Line.__dataclass_fields__})
    time, coarse = compression.axes.time, compression.axes.rows.step
    first, last = np.searchsorted(time.values, [line.time.min(), line.time.max()])
    every = max(int(last - first) // PULSES, 1)
    pulses = Axis(float(time.values[first]), time.step * every, len(range(first, last, every)))
    reach = np.ptp(line.range) / 2 + 4 * coarse
    around = Axis(float(line.range.mean() - reach), coarse / FINE, int(2 * reach / coarse * FINE) + 1)
    some = np.ascontiguousarray(samples[:, first:last:every])
    fine = compression.sampled(replace(compression.axes, time=pulses, rows=around))
    profiles = fine.apply(some, threads=THREADS)
    return Migration(line, pulses.values, _peaks(around, np.abs(profiles) ** 2))


def _peaks(axis: Axis, power: FloatArray) -> FloatArray:
    """Position of the maximum of each column, by a parabola through three samples."""
    top = np.clip(power.argmax(axis=0), 1, axis.size - 2)
    a, b, c = (power[top + k, np.arange(power.shape[1])] for k in (-1, 0, 1))
    return np.asarray(axis.values[top] + axis.step * (a - c) / (2 * (a - 2 * b + c)))


class Cut(NamedTuple):
    """An azimuth response: offsets (Hz) from the focus of its line, complex samples, theoretical width (Hz)."""

    offset: FloatArray
    values: Complex128Array
    width: float


def azimuth_cut(name: str, plan: Plan, block: BlockPlan, place: Place) -> Cut:
    """One target alone through the whole chain: its cut along Doppler at the range of its maximum."""
    samples = slab(name, place, block.first_bin, block.n_bin)
    for stage in stages(block.chain):
        samples = stage.apply(samples, threads=THREADS)
    row = int(np.abs(samples).max(axis=1).argmax())
    doppler = block.ground.doppler
    values = np.asarray(resample(samples[row].astype(np.complex128), 2 * FINE * doppler.size))
    axis = doppler.start + doppler.step / (2 * FINE) * np.arange(values.size)
    line = trace(recovered_lines(plan, [place]), block)
    return Cut(axis - focus(line).doppler[0], values, SINC_WIDTH / float((line.weight * line.stretch).sum()))


def line_panel(title: str, line: Line, names: Sequence[str], *, under: Map | None = None) -> Panel:
    """Time-frequency lines (n_target, n) in s and kHz; over a spectrogram, dashed lines of one colour."""
    names = [*names, *[""] * (line.doppler.shape[0] - len(names))]
    colours = CURVE_COLOURS if under is None else [LIMIT] * len(names)
    traces = [
        Trace(name, time, doppler / 1e3, colour, "-" if under is None else "--")
        for name, time, doppler, colour in zip(names, line.time, line.doppler, colours, strict=False)
    ]
    return Panel(title, "slow time (s)", "Doppler (kHz)", traces, map=under)


def cells(metres: float) -> float:
    """Convert metres to range resolution cells of paper A's scene."""
    return metres * 2 * geometry("table1").collection.bandwidth / SPEED_OF_LIGHT


def rates(line: Line) -> FloatArray:
    """Mean Doppler rate of each line, Hz/s."""
    return np.asarray(np.diff(line.doppler[:, [0, -1]], axis=1) / np.diff(line.time[:, [0, -1]], axis=1))[:, 0]
