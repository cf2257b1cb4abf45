"""The units of work that add the layers of a terrain to chunks of an image that one block covers.

The blocks of a full round add theirs themselves, chunk by chunk, while the disk waits for their pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from distributed import Client

from blocksar import stores
from blocksar.chunks import LAYER_CHUNKS
from blocksar.graph.admission import Unit
from blocksar.graph.layers import sights_of
from blocksar.graph.segments import Segment
from blocksar.graph.tasks import add_layers
from blocksar.graph.units import single_task, spans
from blocksar.planning.tiling import image_chunk
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, Written, block_unit


class LayerUnits:
    """Units for the chunks that blocks have written to the image; none on the plane.

    Attributes
    ----------
    sights : dict of Sight
        The antenna as pixels see it, by number of the segment; empty on the plane.
    """

    def __init__(self, client: Client, segments: Sequence[Segment], run: Run) -> None:
        self._client, self._run, self._grid = client, run, segments[0].planned.grid
        on_terrain = segments[0].planned.geometry.terrain is not None
        seen = [(segment.number or 0, segment.planned.geometry) for segment in segments if on_terrain]
        self.sights = sights_of(run, self._grid, seen)
        self._blocks = {
            block_unit(block.name): (block.index, segment.number or 0)
            for segment in segments
            for block in segment.planned.blocks
        }

    def after(self, unit: str, receipt: Receipt) -> list[Unit]:
        """The units that can begin once a block is done, given by its unit and its receipt."""
        if not self.sights:
            return []
        (index, segment), side, image = self._blocks[unit], image_chunk(self._grid), self._run.name_of(self._run.image)
        added = {part.region for part in receipt.written if part.store == image and part.variable in stores.ON_TERRAIN}
        cells = [
            ((part.region[0][0] // side[0], part.region[1][0] // side[1]), index if _is_all(part, index) else None)
            for part in receipt.written
            if part.store == image and part.variable == "block" and part.region not in added
        ]
        units = []
        for first, end in spans(len(cells), LAYER_CHUNKS):
            name, sights = "layers-{}-{}".format(*cells[first][0]), {index: self.sights[segment]}
            task = add_layers, dict(cells[first:end]), self._grid, sights
            units.append(single_task(self._client, self._run, "layers", name, *task))
        return units


def _is_all(owners: Written, block: int) -> bool:
    """Whether all pixels of a chunk come from a block, as the checksum of its owners tells."""
    return owners.checksum == _checksum_of_all(tuple(end - first for first, end in owners.region), block)


@lru_cache(maxsize=64)
def _checksum_of_all(shape: tuple[int, ...], block: int) -> str:
    return stores.checksum(np.full(shape, block, np.int16))
