"""CPHD files as a reader: what `blocksar ingest cphd` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.cphd.choices import Choices
from blocksar.ingestion.cphd.files import KIND
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.readers import Described, Reading
from blocksar.places import Location
from blocksar.places.ranges import Readable


class CphdReader:
    """CPHD 1.0 and 1.1 (NGA.STND.0068)."""

    summary = "Convert a CPHD file to a phase history, in the tangent frame at its scene's reference point."
    example = "collect.cphd --out collect.zarr"
    source = "SOURCE.cphd", "CPHD file, version 1.0 or 1.1; or its URL."
    several = False
    kind: Kind = KIND
    options = Choices

    def read(self, sources: Sequence[Location], options: Choices) -> Reading:
        from blocksar.ingestion.cphd.ingestion import begin

        return begin(sources[0], options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.cphd.ingestion import describe

        return describe(files[0], given)


CPHD = CphdReader()
