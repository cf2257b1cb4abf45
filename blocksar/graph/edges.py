"""Edges of dwells in a run: read from the samples to complete the chunks of patches (`focusing.dwell_edges`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.focusing.dwell_edges import KeptProfiles, add_edges, edge_profiles, take_unlit
from blocksar.focusing.ground_map import GroundMap
from blocksar.graph.spectrum import Window
from blocksar.inspection.samples import Inspection, mask_outliers
from blocksar.planning.steadiness import Gated
from blocksar.planning.tiling import image_chunk


@dataclass(frozen=True, eq=False)
class Edges:
    """What the edges of dwells are summed from.

    Attributes
    ----------
    source : PhaseHistory
        Whose samples the run recovers.
    inspection : Inspection
        Of all of it.
    weighting : Weighting
    fade : int
        From the plan; without effect where the beam stays.
    gated : Gated
        The beam that dwell gates follow.
    """

    source: stores.PhaseHistory
    inspection: Inspection
    weighting: Weighting
    fade: int
    gated: Gated

    def profiles(self, ground: GroundMap, *, threads: int) -> KeptProfiles:
        """Range profiles for the chunks of one patch."""

        def read(pulses: slice) -> ComplexArray:
            return read_valid(self.source, self.inspection, pulses)

        return edge_profiles(read, ground.geometry.collection, self.weighting, fade=self.fade, threads=threads)

    def add(
        self,
        pixels: ComplexArray,
        kept: KeptProfiles,
        ground: GroundMap,
        window: Window,
        grid: Grid,
        *,
        height: FloatArray | None,
        threads: int,
    ) -> None:
        """Add the edges to a chunk of a patch, or take out what is not lit where the beam stays, in place.

        `height` (n_y, n_x) has its pixels' z, m, on a terrain.
        """
        x, y = grid.x[window[1]], grid.y[window[0]]
        if ground.stays:
            take_unlit(
                pixels, kept, ground.geometry, x=x, y=y, total=ground.lit_at, valid=self.inspection.lit,
                weighting=self.weighting, height=height, threads=threads,
            )  # fmt: skip
            return
        known = None
        if height is not None:
            known = np.where(np.isfinite(height), height, ground.geometry.collection.ground_height)
        add_edges(
            pixels, kept, self.gated.over(ground.geometry), x=x, y=y, lit=ground.lit_at(*np.meshgrid(x, y), known),
            valid=self.inspection.lit, fade=self.fade, weighting=self.weighting, height=height, threads=threads,
            wobbling=ground.geometry if self.gated.wobbles else None,
        )  # fmt: skip


def by_yaw(cells: list[tuple[int, int]], ground: GroundMap, grid: Grid) -> list[tuple[int, int]]:
    """Chunks of an image in the order of the yaws of their middles: neighbours in it need the same pulses."""
    side = image_chunk(grid)
    rows, columns = ((np.array(cells).reshape(-1, 2)[:, axis] + 0.5) * side[axis] for axis in (0, 1))
    yaw = ground.relative_yaw(grid.x[0] + columns * grid.dx, grid.y[0] + rows * grid.dy)
    return [cells[k] for k in np.argsort(yaw, kind="stable")]


def read_valid(source: stores.PhaseHistory, inspection: Inspection, pulses: slice) -> ComplexArray:
    """All columns of pulses; outliers are missing."""
    signal = source.read(pulses, slice(None))
    mask_outliers(signal, inspection, pulses=pulses)
    return signal
