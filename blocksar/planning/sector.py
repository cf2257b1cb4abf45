"""The ground that a block owns, and the lines of targets on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY, IMAGE_TAP_ERROR
from blocksar.collection import range_series
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.focusing.lines import Line
from blocksar.focusing.recovery import Recovery
from blocksar.focusing.surfaces import GroundRange
from blocksar.planning.dwell_weights import DwellWeights, dwell_weights, taper_over_dwells
from blocksar.planning.relief import Relief, stacked
from blocksar.planning.steadiness import scans_evenly
from blocksar.planning.target_lines import Dwells, find_dwells

REFERENCE_ORDER = 8  # of the range series of a block's centre


@dataclass(frozen=True, kw_only=True, eq=False)
class Sector:
    """The ground that a block owns: yaws [low, high), rad, at epoch ranges [near, far), m.

    With the weighting of its image and the fidelity that it keeps, and the error that the interpolation of the focused
    block may have. On a terrain the geometry is over the smooth part of it, and `relief` has the rest. Where gates
    follow a smoothed beam, this loses `beam_loss` of coherence (`planning.steadiness`). The grid spans the yaws
    `imaged`.
    """

    geometry: Geometry
    recovery: Recovery
    region: Region
    low: float
    high: float
    near: float
    far: float
    weighting: Weighting = UNIFORM
    fidelity: float = FIDELITY
    tap_error: float = IMAGE_TAP_ERROR
    relief: Relief | None = None
    beam_loss: float = 0.0
    imaged: tuple[float, float] = (-np.inf, np.inf)

    @property
    def ground_range(self) -> GroundRange:
        """Its epoch ranges along the ground."""
        return ground_range(self.geometry, self.near, self.far)

    @property
    def taper(self) -> Taper:
        """The weighting over dwells."""
        return taper_over_dwells(self.geometry.collection, self.weighting)

    def weights(
        self,
        lit: Line,
        *,
        uncut: tuple[FloatArray, FloatArray],
        epoch_range: FloatArray,
        yaw: FloatArray,
        moves: FloatArray | None,
    ) -> DwellWeights:
        """Weights of targets over their dwells: see `dwell_weights`."""
        return dwell_weights(
            self.geometry, self.taper, lit, uncut=uncut, epoch_range=epoch_range, yaw=yaw, moves=moves,
            lit_band=self._lit_band(lit, uncut),
        )  # fmt: skip

    def _lit_band(self, lit: Line, uncut: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Band of Doppler that is lit at a time at targets (...), Hz.

        After derotation the beam keeps its Doppler, and a target passes through all of it in its dwell.
        """
        recovery = self.recovery
        passed = lit.doppler[..., [0, -1]] - recovery.derotation_rate(lit.time[..., [0, -1]])
        over = lit.time[..., -1] - lit.time[..., 0]
        dwell = np.maximum(uncut[1] - uncut[0], recovery.pulses.step)
        band = np.abs(passed[..., 1] - passed[..., 0]) * dwell / np.maximum(over, 1e-12)
        return np.clip(band, 1 / dwell, 1 / recovery.pulses.step)

    def dwells(self, yaw: FloatArray, *, coarsely: bool = False, like: Line | None = None) -> Dwells:
        """Dwells of targets at yaws (...), rad, for lines in the recovered signal, with as many nodes as `like` has."""
        recovery = self.recovery
        return find_dwells(
            self.geometry, yaw=yaw, origin=recovery.origin, walk=recovery.walk, common=recovery.common,
            coarsely=coarsely, as_many=None if like is None else like.time.shape[-1],
        )  # fmt: skip

    def passing(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray | None:
        """When the beam's centre passes targets, s from the epoch, where a taper asks; None: amid their dwells."""
        if self.taper.uniform or scans_evenly(self.geometry.collection):
            return None
        return np.asarray(self.geometry.beam.passing_at(yaw, epoch_range, 0.0) - self.geometry.epoch)

    @property
    def keeps_rims(self) -> bool:
        """Whether chains have room in time for dwells that the collection cuts, so that no noise wraps into them.

        Under a beam about its axis cut dwells are a large part of an image.
        """
        return self.geometry.beam.by_range

    @property
    def gates_by_height(self) -> bool:
        """Whether the dwell of a target depends on its height besides its range and Doppler.

        Under a beam about its axis it hardly does: places of equal range and Doppler see the axis at the same angle.
        """
        return self.relief is not None and not self.geometry.beam.by_range

    def refined(self) -> Sector:
        """Copy of the sector, on a terrain over its finer smooth ground."""
        return self if self.relief is None else replace(self, geometry=self.geometry.over(None, self.relief.fine))

    def with_relief(self, line: Line, trace: Callable[[Sector], Line]) -> Line:
        """Lines of targets on the smooth ground; on a terrain followed by those of the lowest and the highest ones."""
        if self.relief is None:
            return line
        ends = (self.relief.over(self.geometry, offset) for offset in (self.relief.low, self.relief.high))
        return stacked([line, *(trace(replace(self, geometry=ground)) for ground in ends)])

    def reference(self) -> FloatArray:
        """Range series of the sector's centre, m/s^n, less the common range that recovery removes."""
        middle = np.array((self.near + self.far) / 2), np.array((self.low + self.high) / 2)
        series = range_series.range_series(self.geometry, *middle, order=REFERENCE_ORDER)
        return np.asarray(series - self.recovery.common.taylor(REFERENCE_ORDER))


def ground_range(geometry: Geometry, near: float, far: float) -> GroundRange:
    """Epoch ranges from near to far, m, along the ground; a mountain may lie nearer than the nadir."""
    height = float(geometry.epoch_position[2] - geometry.collection.ground_height)
    return GroundRange(near=near, far=far, height=min(height, near))
