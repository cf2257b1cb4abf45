"""Where what is imaged begins and ends among the targets that are traced."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray


class ImageEdges(NamedTuple):
    """Where what is imaged begins and ends between places at which targets are traced: (n_range, n_yaw) each.

    Targets next beyond stand for targets at the edge: what those lose is interpolated between them and the next ones.
    """

    held: BoolArray  # the targets inside; where none lies inside, those on either side of it
    before: BoolArray  # those next beyond the beginning
    behind: BoolArray  # those next beyond the end
    share: FloatArray  # of the way to them at which the edge lies, from the ones next to them
    axis: int

    @classmethod
    def between(cls, places: FloatArray, first: FloatArray, last: FloatArray, *, axis: int) -> ImageEdges:
        """Of places (n,) along an axis and, at each place (m,) along the other, the first and the last imaged."""
        at, step = places[:, None], np.diff(places)[:, None]
        held = (at >= first) & (at <= last)
        before, behind, share = np.zeros_like(held), np.zeros_like(held), np.zeros(held.shape)
        before[:-1], behind[1:] = (at[:-1] < first) & (at[1:] >= first), (at[1:] > last) & (at[:-1] <= last)
        share[:-1] = np.where(before[:-1], (at[1:] - first) / step, 0.0)
        share[1:] += np.where(behind[1:], (last - at[:-1]) / step, 0.0)
        held = held if held.any() else before | behind
        return cls(held.T, before.T, behind.T, share.T, axis) if axis else cls(held, before, behind, share, axis)

    def of_dwells(self, full: BoolArray) -> ImageEdges:
        """Those where the targets on either side have full dwell."""
        before, behind = self.before & full, self.behind & full
        along = (before.T, behind.T, full.T) if self.axis else (before, behind, full)
        along[0][:-1] &= along[2][1:]
        along[1][1:] &= along[2][:-1]
        return self._replace(before=before, behind=behind)

    def beside(self, target: tuple[int, ...]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Pairs of targets, beyond an edge and next to it inside, at a target's place along the other axis."""
        row, column = target
        pairs: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        for beyond, step in ((self.before, 1), (self.behind, -1)):
            if self.axis:
                pairs += [((row, at), (row, at + step)) for at in np.flatnonzero(beyond[row]).tolist()]
            else:
                pairs += [((at, column), (at + step, column)) for at in np.flatnonzero(beyond[:, column]).tolist()]
        return pairs

    def at(self, lost: FloatArray) -> FloatArray:
        """Losses (n_range, n_yaw), with those at the edges in place of those beyond."""
        inner = lost.copy()
        into, own, behind = (inner.T, lost.T, self.behind.T) if self.axis else (inner, lost, self.behind)
        into[:-1] = own[1:]
        into[1:] = np.where(behind[1:], own[:-1], into[1:])
        return np.where(self.before | self.behind, inner + self.share * (lost - inner), lost)
