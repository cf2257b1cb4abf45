"""Sentinel-1 level 0 as a reader: what `blocksar ingest sentinel1` and `info` ask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.readers import Described, Reading
from blocksar.ingestion.sentinel1.options import Sentinel1Options
from blocksar.ingestion.sentinel1.packets import KIND
from blocksar.places import Location
from blocksar.places.ranges import Readable


class Sentinel1Reader:
    """Stripmap, wave and TOPS bursts of Sentinel-1."""

    summary = (
        "Convert Sentinel-1 level 0 (packets) to phase histories.\n\n"
        "Several bursts become a store of as many phase histories in one frame, which focus makes one mosaic of."
    )
    example = "S1A_IW_RAW__0SDV_....SAFE --swath IW1 --out iw1.zarr"
    source = "SOURCE.dat|FOLDER.SAFE...", "Files of packets of one data take, or the SAFE folder that they lie in."
    several = True
    kind: Kind = KIND
    options = Sentinel1Options

    def read(self, sources: Sequence[Location], options: Sentinel1Options) -> Mapping[str, Reading]:
        from blocksar.ingestion.sentinel1.ingestion import begin

        return begin(sources, options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.sentinel1.describing import describe

        return describe(files, given)


SENTINEL1 = Sentinel1Reader()
