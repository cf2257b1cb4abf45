"""Intervals of yaw of paper A's scene, and targets placed in them."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from blocksar.collection.beam import full_dwell_yaw
from blocksar.processors.chain.planning.block import BlockPlan
from papers.bench import SWATH, geometry, scene

Place = tuple[float, float]  # of a target: epoch range (m) and yaw (rad)
YAWS = 61  # of a curve


class Sector(NamedTuple):
    """Yaws, rad: the whole steering interval, or a block of it."""

    low: float
    high: float

    @property
    def centre(self) -> float:
        return (self.low + self.high) / 2


def sectors(count: int) -> list[Sector]:
    """The steering interval of paper A's Table 1, divided evenly."""
    beam = scene("table1").beam
    assert beam is not None and beam.start_deg is not None and beam.stop_deg is not None
    edges = np.radians(np.linspace(beam.start_deg, beam.stop_deg, count + 1)).tolist()
    return [Sector(*edge) for edge in pairwise(edges)]


def full_dwell() -> Sector:
    """First and last yaw that are lit for a full dwell."""
    return Sector(*full_dwell_yaw(geometry("table1").collection))


def same_range(block: BlockPlan) -> dict[str, Place]:
    """T_A, T_B, T_C: targets of one range at a block's first yaw of full dwell, halfway, and at its last."""
    full = full_dwell()
    first, last = max(block.low, full.low), min(block.high, full.high)
    yaws = (first, (first + last) / 2, last)
    return {f"T_{letter}": (SWATH["middle"], yaw) for letter, yaw in zip("ABC", yaws, strict=True)}
