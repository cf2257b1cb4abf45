"""The ground that a block owns, and the lines of targets on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY, IMAGE_TAP_ERROR
from blocksar.chunks import IMAGE_PIXELS
from blocksar.collection import range_series
from blocksar.collection.beam import passing_at
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.focusing.dwell_edges import edge_memory
from blocksar.focusing.lines import Line
from blocksar.focusing.recovery import Recovery
from blocksar.focusing.surfaces import GroundRange
from blocksar.planning.dwell_ends import Passing
from blocksar.planning.dwell_weights import DwellWeights, dwell_weights, taper_over_dwells
from blocksar.planning.relief import Relief, stacked
from blocksar.planning.steadiness import scans_evenly
from blocksar.planning.target_lines import Dwells, find_dwells

REFERENCE_ORDER = 8  # of the range series of a block's centre
HALFWAY_FADE = 4  # from which on edges that fade out leave room for a place halfway between them and the middle


@dataclass(frozen=True, kw_only=True, eq=False)
class Sector:
    """The ground that a block owns: yaws [low, high), rad, at epoch ranges [near, far), m.

    With the weighting of its image and the fidelity that it keeps, the error that the interpolation of the focused
    block may have, the `fade`, and the number of the gate's parts over the band. On a terrain the geometry is over the
    smooth part of it, and `relief` has the rest. Where the beam stays on its ground, the geometry is that of a beam
    that lights everything, and `staying` has the beam (`planning.staying`). Where gates follow a steadier beam, it has
    that, `wobbling` the true one, and a taper loses `taper_loss` of coherence (`planning.steadiness`). The grid spans
    the yaws `imaged`.
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
    fade: int = 0
    gate_parts: int = 1
    staying: Geometry | None = None
    wobbling: Geometry | None = None
    taper_loss: float = 0.0
    imaged: tuple[float, float] = (-np.inf, np.inf)

    @property
    def ground_range(self) -> GroundRange:
        """Its epoch ranges along the ground."""
        return ground_range(self.geometry, self.near, self.far)

    @property
    def lighting(self) -> Geometry:
        """The geometry with the beam that gates follow, or that stays."""
        return self.geometry if self.staying is None else self.staying

    @property
    def lit(self) -> Geometry:
        """The geometry with the beam as it is."""
        return self.lighting if self.wobbling is None else self.wobbling

    @property
    def taper(self) -> Taper:
        """The weighting over dwells."""
        return taper_over_dwells(self.lighting.collection, self.weighting)

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
            self.lighting, self.taper, lit, uncut=uncut, epoch_range=epoch_range, yaw=yaw,
            stays=self.staying is not None, moves=moves,
            lit_band=self._lit_band(lit, uncut), fade=self.fade,
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

    def passing(self, epoch_range: FloatArray, yaw: FloatArray) -> Passing:
        """When the beam passes targets: what a weighting over dwells, and edges that fade out, need to know of it."""

        def at(v: float) -> FloatArray:
            return np.asarray(passing_at(self.geometry, yaw, epoch_range, v) - self.geometry.epoch)

        uneven = not scans_evenly(self.geometry.collection)
        if not self.fade:
            return Passing(centre=at(0.0) if uneven and not self.taper.uniform else None)
        edge = 1 - 1 / self.fade
        by_halves = uneven and self.fade >= HALFWAY_FADE  # the place in the beam is not linear in time
        return Passing(at(0.0), (at(-edge), at(edge)), (at(-0.5), at(0.5)) if by_halves else None)

    @property
    def edge_memory(self) -> int:
        """What the edges of dwells add to the peak memory, bytes."""
        summed = self.fade > 0 or self.staying is not None
        return edge_memory(IMAGE_PIXELS, self.lighting.collection) if summed else 0

    @property
    def keeps_rims(self) -> bool:
        """Whether chains have room in time for dwells that the collection cuts, so that no noise wraps into them.

        Under a beam about its axis cut dwells are a large part of an image; otherwise where edges are back-projected.
        """
        collection = self.geometry.collection
        return collection.steered and (collection.has_axis or self.fade > 0)

    @property
    def gates_by_height(self) -> bool:
        """Whether the dwell of a target depends on its height besides its range and Doppler.

        Under a beam about its axis it hardly does: places of equal range and Doppler see the axis at the same angle.
        """
        return self.relief is not None and not self.geometry.collection.has_axis

    def over(self, offset: float) -> Sector:
        """The same sector with the smooth ground raised by an offset, m."""
        assert self.relief is not None
        return replace(self, geometry=self.relief.over(self.geometry, offset))

    def refined(self) -> Sector:
        """The same sector, on a terrain over its finer smooth ground."""
        return self if self.relief is None else replace(self, geometry=self.geometry.over(None, self.relief.fine))

    def with_relief(self, line: Line, trace: Callable[[Sector], Line]) -> Line:
        """Lines of targets on the smooth ground; on a terrain followed by those of the lowest and the highest ones."""
        if self.relief is None:
            return line
        return stacked([line, *(trace(self.over(offset)) for offset in (self.relief.low, self.relief.high))])

    def reference(self) -> FloatArray:
        """Range series of the sector's centre, m/s^n, less the common range that recovery removes."""
        middle = np.array((self.near + self.far) / 2), np.array((self.low + self.high) / 2)
        series = range_series.range_series(self.geometry, *middle, order=REFERENCE_ORDER)
        return np.asarray(series - self.recovery.common.taylor(REFERENCE_ORDER))


def ground_range(geometry: Geometry, near: float, far: float) -> GroundRange:
    """Epoch ranges from near to far, m, along the ground; a mountain may lie nearer than the nadir."""
    height = float(geometry.epoch_position[2] - geometry.collection.ground_height)
    return GroundRange(near=near, far=far, height=min(height, near))
