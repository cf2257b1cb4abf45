"""Targets of a block as its chain leaves them: what their quality is predicted from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.focusing.lines import Focus, Line
from blocksar.planning.dwell_ends import Moments, dwell_ends
from blocksar.planning.dwell_weights import DwellWeights


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedTargets:
    """Targets at epoch ranges (n_range,) and yaws (n_yaw,), traced through a whole chain.

    Attributes
    ----------
    geometry : Geometry
        Its ground is the one on which they lie.
    epoch_range, yaw : (n_range,), (n_yaw,) float
        m and rad.
    line : Line
        (n_range, n_yaw, n), after all steps.
    spots : Focus
        (n_range, n_yaw), where and how the lines focus.
    weights : DwellWeights
        At the nodes of the lines.
    uncut : pair of (n_yaw,) or (n_range, n_yaw) float
        Slow time at which the dwells would begin and end if the collection did not cut them, s from the epoch.
    rate : (n_range, n_yaw, n) float
        The lines' Doppler rate before the steps in Doppler, Hz/s.
    scaled_about : float or None
        Time, s from the epoch, about which a keystone scales time with range frequency; None without one.
    moves : (n_range, n_yaw, n) float or None
        From `dwell_ends.band_moves`, s; None with a keystone.
    """

    geometry: Geometry
    epoch_range: FloatArray
    yaw: FloatArray
    line: Line
    spots: Focus
    weights: DwellWeights
    uncut: Moments
    rate: FloatArray
    scaled_about: float | None
    moves: FloatArray | None

    @cached_property
    def lit(self) -> Moments:
        """Slow times at which the targets are first and last lit, (n_yaw,) or (n_range, n_yaw) s."""
        return dwell_at(self.geometry, self.yaw, self.epoch_range[:, None])

    @cached_property
    def cut(self) -> BoolArray:
        """Whether an end of the collection cuts the begin and the end of dwells, (n_yaw, 2) or (n_range, n_yaw, 2)."""
        collection = self.geometry.collection
        return np.asarray(np.abs(np.stack(self.lit, axis=-1) - collection.time[[0, -1]]) < collection.pulse_interval)

    @cached_property
    def ends(self) -> Moments:
        """Times at which the dwells begin and end after all steps, (n_range, n_yaw) s."""
        return dwell_ends(self.line)

    def moved(self, end: int) -> FloatArray:
        """Time by which relative range frequency moves the begin (0) or the end (-1) of dwells, s."""
        if self.moves is not None:
            return self.moves[..., end]
        if self.scaled_about is None:
            return np.zeros(self.yaw.shape)
        return np.asarray(self.lit[end] - self.geometry.epoch - self.scaled_about)
