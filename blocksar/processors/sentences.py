"""Sentences on plans of any processor: its workers, and the time that it takes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.graph.machine import Resources, machine, pace
from blocksar.planning import effort
from blocksar.progress import Work
from blocksar.texts import count, time_text

PLANNING_TOLD = 1.0  # s to plan, which are counted in the time of a run
DISK_RATE = 200e6  # bytes/s of a typical disk, by which the time of large runs is stated
PAGE_CACHE = 0.5  # of the machine's memory, which writes fill before they wait for the disk
LOOKED_AT = 64  # points along a side of a grid at which lit pulses are counted


def time_line(work: Work, assumed: Resources, stored: int, planning: float = 0.0) -> str:
    """State how long a run would take on this machine, by stage; the only measured part of a plan.

    `stored` is what it writes, bytes, for which the disk may need longer where the page cache cannot take them;
    `planning` what the plan took, s, which a run makes again: told where it is long.
    """
    seconds = stage_seconds(work, assumed, planning)
    large = stored > PAGE_CACHE * machine()[1]
    disk = f"the disk is slow ({time_text(stored / DISK_RATE)} to write at {DISK_RATE / 1e6:.0f} MB/s)"
    return (
        f"a run takes about {time_text(sum(seconds.values()))} on this machine {workforce(assumed)} "
        f"({_shares(seconds)}), more where others use it, {disk if large else 'the disk is slow'}, or loops are not "
        "compiled"
    )


def stage_seconds(work: Work, assumed: Resources, planning: float = 0.0) -> dict[str, float]:
    """Seconds of a run by stage, as in `time_line`."""
    workers = min(assumed.workers, machine()[0])  # more than there are cores gain nothing
    seconds = effort.seconds_of(work, workers=workers, threads=assumed.threads, pace=pace())
    if not assumed.workers:
        del seconds["start"]
    return {"plan": planning, **seconds} if planning >= PLANNING_TOLD else seconds


def workforce(assumed: Resources) -> str:
    """Name the workers of a run."""
    return f"with {count(assumed.workers, 'worker')}" if assumed.workers else "in one process"


def _shares(seconds: Mapping[str, float]) -> str:
    """Format parts of a time, rounded in the unit in which `time_text` writes their sum, so that they add up.

    Examples
    --------
    >>> _shares({"start": 1.9, "recover": 0.6, "focus": 0.7, "mosaic": 0.1})
    'start 2 s, focus 1 s'
    """
    total = sum(seconds.values())
    step, unit = (1, "s") if total < 100 else (60, "min") if total < 6000 else (360, "h")
    parts = {name: int(value / step) for name, value in seconds.items()}
    left = max(round(total / step), 1) - sum(parts.values())
    for name in sorted(seconds, key=lambda each: parts[each] - seconds[each] / step)[:left]:  # most cut off first
        parts[name] += 1
    shares = {name: f"{count / 10:.1f}" if unit == "h" else str(count) for name, count in parts.items() if count}
    return ", ".join(f"{name} {text} {unit}" for name, text in shares.items())


def lit_pulses(geometry: Geometry, grid: Grid) -> int:
    """The largest number of pulses that light any point of a grid."""
    return geometry.beam.most_lit_pulses(
        *np.meshgrid(*(axis[:: max(axis.size // LOOKED_AT, 1)] for axis in (grid.x, grid.y)))
    )
