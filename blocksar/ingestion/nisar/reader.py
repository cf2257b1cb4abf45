"""NISAR's raw echoes as a reader: what `blocksar ingest nisar` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.nisar.options import KIND, NisarOptions
from blocksar.ingestion.readers import Described, Reading
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable


class NisarReader:
    """NISAR level 0B RRSD (HDF5)."""

    summary = "Convert raw echoes of NISAR (level 0B RRSD, HDF5) to a phase history on the ellipsoid."
    example = "NISAR_L0_RRSD.h5 --out strip.zarr"
    source = "SOURCE.h5", "File of level 0B."
    several = False
    kind: Kind = KIND
    options = NisarOptions

    def read(self, sources: Sequence[Location], options: NisarOptions) -> Reading:
        from blocksar.ingestion.nisar.files import begin

        return begin(readable(sources[0]), options).reading(options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.nisar.files import begin
        from blocksar.ingestion.strips.describing import describe

        return describe(begin(files[0], NisarOptions()), "NISAR raw echo", ["ingest", "nisar", given], files[0].name)


NISAR = NisarReader()
