"""PALSAR's raw echoes as a reader: what `blocksar ingest palsar` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.kinds import Kind, ceos
from blocksar.ingestion.readers import Described, Reading
from blocksar.ingestion.strips.options import StripOptions
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable


class PalsarReader:
    """ALOS PALSAR level 1.0 (CEOS)."""

    summary = "Convert raw echoes of ALOS PALSAR (CEOS level 1.0) to a phase history on the ellipsoid."
    example = "ALPSRP267211110-L1.0 --out palsar.zarr"
    source = "FOLDER", "Folder of one scene, or its files: leader (LED) and images (IMG)."
    several = True
    kind = Kind(
        "a CEOS file of raw echoes", lambda start: ceos(start, b"\x32\x0a"),
        "if it is of PALSAR, turn its folder into a phase history first: `blocksar ingest palsar {path} --out {store}`",
    )  # fmt: skip
    options = StripOptions

    def read(self, sources: Sequence[Location], options: StripOptions) -> Reading:
        from blocksar.ingestion.palsar.files import begin

        return begin([readable(each) for each in sources], options).reading(options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.palsar.files import begin
        from blocksar.ingestion.strips.describing import describe

        command = ["ingest", "palsar", given]
        return describe(begin(files, StripOptions()), "PALSAR raw echo", command, "palsar")


PALSAR = PalsarReader()
