"""CRSD files as a reader: what `blocksar ingest crsd` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.crsd.options import KIND, CrsdOptions
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.readers import Described, Reading
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable


class CrsdReader:
    """CRSD 1.0 (NGA.STND.0080)."""

    summary = "Convert a CRSD file, of echoes that are not compressed, to a phase history."
    example = "collect.crsd --out collect.zarr"
    source = "SOURCE.crsd", "CRSD file, version 1.0."
    several = False
    kind: Kind = KIND
    options = CrsdOptions

    def read(self, sources: Sequence[Location], options: CrsdOptions) -> Reading:
        from blocksar.ingestion.crsd.files import begin

        return begin(readable(sources[0]), options).reading(options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.crsd.files import begin
        from blocksar.ingestion.strips.describing import describe

        return describe(begin(files[0], CrsdOptions()), "CRSD file", ["ingest", "crsd", given], files[0].name)


CRSD = CrsdReader()
