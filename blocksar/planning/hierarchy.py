"""How hierarchical back-projection divides an image, and what that costs: levels, error, time and memory.

The error of an image is that of its filters and of the last interpolation. A filter of attenuation A errs in its pass
band and leaves of what it stops 10^(-A / 10) of the power at most. Over the pass band it errs by half of that on
average, and what is stopped is far below: an image whose samples have passed n filters has an error power of

    n / 2 10^(-A / 10) + spline_error(upsampling)^2

of all that its data hold. Half of what the fidelity allows is given to each term. The coherence of an image with an
error power e, which is not coherent with it, is (1 + e)^(-1/2).

What levels there are, and how large the last parts, is chosen by the predicted time: the filters of each level, and the
sums over what is left, are counted with the frames of `focusing.hierarchy`, which plan what samples follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from blocksar.collection.beam import lit_passes
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.focusing.hierarchy import Filters, Frame, Hierarchy, Levels
from blocksar.focusing.parts import Part
from blocksar.focusing.profiles import spline_error
from blocksar.kernels.fourier import fast_length

EDGE = 0.38  # e of the filters: higher ones have long tails, lower ones leave more samples
RATIOS = (2.0, 3.0, 4.0, 6.0)  # of the sides of a level and the next
LAST_SIDES = (24, 32, 48, 64, 96, 128, 192)  # pixels
UPSAMPLINGS = range(2, 25)
NODES = 3  # along a part's side, at which it is found what lights it
UNITS_PER_WORKER = 4  # parts of the image for each worker at least, so that they end together
MOST_UNITS = 4096
# Seconds of one thread where `graph.machine.pace` is 1.
TURN = 0.5e-9  # per sample whose phase is turned
TAP = 0.028e-9  # per sample and tap, along range
ROW_TAP = 0.028e-9  # and along pulses
PART = 0.5e-3  # per part, besides
PROFILE = 1.1e-9  # per bin of a range profile
UPDATE = 1.9e-9  # per pixel and pulse
PIXEL = 120e-9  # per pixel: which pulses light it, weights, normalisation and writing
READ = 0.7e-9  # per sample read
PIXEL_BYTES = 72  # of a window's pixel while it is formed


def planned_error(levels: Levels, *, stages: int) -> float:
    """Error power of an image over its own, after `stages` filters along either axis."""
    filters = stages * 10 ** (-levels.attenuation / 10)  # two axes, half of the largest error each
    return filters + spline_error(upsampling=levels.upsampling) ** 2


def coherence_of(error: float) -> float:
    """Coherence of an image with one from which it differs by an error power."""
    return (1 + error) ** -0.5


def levels_for(fidelity: float, sides: tuple[float, ...], *, stages: int) -> Levels:
    """Levels whose error power is 1 - fidelity at most."""
    allowed = (1 - fidelity) / 2
    attenuation = 10 * math.log10(stages / allowed)
    upsampling = next((n for n in UPSAMPLINGS if spline_error(upsampling=n) ** 2 <= allowed), UPSAMPLINGS[-1])
    return Levels(sides=sides, attenuation=attenuation, edge=EDGE, upsampling=upsampling)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cost:
    """What it takes to form a unit: a part of the image that one task forms from one reading of the samples.

    Attributes
    ----------
    seconds : float
        Of one thread, where the pace is 1.
    samples : int
        That are kept at once, at all levels together.
    """

    seconds: float
    samples: int


class Ladders:
    """Finds what a unit costs that is divided along a ladder of sides, at one place of the image.

    Parameters
    ----------
    hierarchy : Hierarchy
    geometry : Geometry
    grid : Grid
    """

    def __init__(self, hierarchy: Hierarchy, geometry: Geometry, grid: Grid) -> None:
        self.hierarchy, self.geometry, self.grid = hierarchy, geometry, grid

    def part(self, place: tuple[float, float], side: tuple[float, float]) -> Part:
        """A part of a size (m along x and y) about a place, as its border sees the beam."""
        x, y = (centre + size / 2 * np.linspace(-1, 1, NODES) for centre, size in zip(place, side, strict=True))
        mesh = np.meshgrid(x, y)
        first, last = lit_passes(self.geometry, *mesh)
        longest = int((last - first).sum(axis=(1, 2)).argmax())
        z = np.nan_to_num(np.asarray(self.geometry.height(*mesh)), nan=self.geometry.collection.ground_height)
        return Part(x=x, y=y, z=z, first=first[longest], last=last[longest])

    def cost(self, place: tuple[float, float], sides: Sequence[tuple[float, float]]) -> Cost | None:
        """What the first of some parts costs, each of which is divided into the next; None where nothing lights it."""
        parts = [self.part(place, side) for side in sides]
        entered = self.hierarchy.enter(parts[0])
        if entered is None:
            return None
        (begin, end), _ = parts[0].lit()
        n_frequency = self.geometry.collection.n_range_frequency
        seconds, samples = READ * (end - begin) * n_frequency, 0
        filters, frame = entered
        seconds += _filtering(filters, frame, end - begin, 0, n_frequency, parts[0])
        samples += _samples(frame)
        count = 1.0
        for above, below in zip(sides, sides[1:], strict=False):
            part = parts[sides.index(below)]
            descended = self.hierarchy.descend(frame, part)
            if descended is None:
                return None
            count *= above[0] * above[1] / (below[0] * below[1])
            filters, left = descended
            edges = len(range(*filters.kept.indices(frame.pulses.size)))
            seconds += count * (PART + _filtering(filters, left, edges, frame.size, frame.columns, part))
            frame = left
            samples += _samples(frame)
        return Cost(seconds=seconds + count * self._last(frame, parts[-1], sides[-1]), samples=samples)

    def _last(self, frame: Frame, part: Part, side: tuple[float, float]) -> float:
        """Seconds to back-project a last part from what is left."""
        pixels = max(side[0] / self.grid.dx, 1) * max(side[1] / self.grid.dy, 1)
        rows = frame.size + frame.pulses.size
        lit = float((part.last - part.first).mean())
        each = frame.size + lit - (frame.inside[1] - frame.inside[0]) if frame.size else lit
        bins = fast_length(self.hierarchy.levels.upsampling * frame.columns)
        return PART + PROFILE * rows * bins + pixels * (UPDATE * max(each, 1) + PIXEL)


def _samples(frame: Frame) -> int:
    return (frame.size + frame.pulses.size) * frame.columns


def _filtering(filters: Filters, left: Frame, edges: int, interior: int, columns: int, part: Part) -> float:
    """Seconds to turn and filter rows of `columns` samples, so many edges and of the interior, to a frame."""
    across = 2 * filters.across.half if filters.across.factor > 1 else 0
    rows = edges + interior
    seconds = rows * (TURN * columns + TAP * left.columns * across)
    taps = 0.0
    if interior:
        taps += interior * (2 * filters.further.half + 1) / filters.further.factor
    if left.size:
        taps += max(edges - left.pulses.size, 0) * (2 * filters.single.half + 1) / filters.single.factor
    return seconds + ROW_TAP * taps * left.columns
