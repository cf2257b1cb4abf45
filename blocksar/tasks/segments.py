"""Segments of a run: its collection, several collections, or parts of one along time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import expand
from blocksar.collection.geometry import Geometry
from blocksar.runs.receipts import Run

if TYPE_CHECKING:
    from blocksar.imaging.method import Cutting


@dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """A segment of a run: samples and plan.

    Attributes
    ----------
    number : int or None
        None in a run of one segment.
    collection : int or None
        Number of the collection that it is of; None in a run of one collection.
    source : PhaseHistory
        That of its whole collection.
    pulses : (first, last) or None
        Its pulses among those of the collection; None for all.
    geometry : Geometry
        That of the plan.
    plan : object or None
        What its processor has planned of it, if it plans each by itself, as chains do.
    interference : str or None
        How it is cut from the samples.
    """

    number: int | None = None
    collection: int | None = None
    source: stores.PhaseHistory
    pulses: tuple[int, int] | None = None
    geometry: Geometry
    plan: Any = None
    interference: Cutting | None = None

    def of(self, run: Run) -> Run:
        """The run as seen by the tasks of this segment."""
        return replace(run, collection=self.collection, segment=self.number)

    @cached_property
    def history(self) -> stores.PhaseHistory:
        """Phase history of the segment's pulses."""
        return self.source if self.pulses is None else self.source.segment(*self.pulses)


class Merged:
    """Segment of each pixel of an image part, chosen by the largest margin as segments are added.

    Attributes
    ----------
    taken : (n_y, n_x) int16
        The segment that each pixel comes from; -1 where none covers it.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.taken = np.full(shape, -1, np.int16)
        self._margin: FloatArray | None = None
        self._shape = shape

    def choose(self, number: int, covered: BoolArray, margins: FloatArray) -> BoolArray:
        """Add a segment by its `margins_over` the part; return the covered pixels (n_y, n_x) that it takes."""
        margin = expand(margins, self._shape)
        if self._margin is None:
            better = covered
            self._margin = np.where(covered, margin, -np.inf)
        else:
            better = covered & ((self.taken < 0) | (margin > self._margin))
            np.copyto(self._margin, margin, where=better)
        np.copyto(self.taken, np.int16(number), where=better)
        return better


Margins = Mapping[int, FloatArray]  # `margins_over` a part of the image, by number of the segment


def by_collection(segments: Sequence[Segment]) -> dict[int | None, list[Segment]]:
    """Group segments by collection, in order."""
    groups: dict[int | None, list[Segment]] = {}
    for segment in segments:
        groups.setdefault(segment.collection, []).append(segment)
    return groups
