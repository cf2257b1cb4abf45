"""Readers of formats that state a satellite's strip: what `blocksar ingest` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, cast

from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.readers import Described, Reading
from blocksar.ingestion.strips.options import PartOptions
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable

if TYPE_CHECKING:
    from blocksar.ingestion.strips.strip import Strip


@dataclass(frozen=True, kw_only=True)
class StripReader:
    """See `Reader`.

    Attributes
    ----------
    name : str
        Under which it is registered, and of the package whose module `files` has `begin` (files, options), which gives
        the strip; that is loaded when files are read.
    title : str
        Of what `info` describes.
    """

    name: str
    title: str
    summary: str
    example: str
    source: tuple[str, str]
    kind: Kind
    options: type[PartOptions]
    several: bool = False

    def _begin(self, files: Sequence[Readable], options: PartOptions) -> Strip:
        module = import_module(f"blocksar.ingestion.{self.name}.files")
        return cast("Strip", module.begin(files, options))

    def read(self, sources: Sequence[Location], options: PartOptions) -> Reading:
        return self._begin([readable(each) for each in sources], options).reading(options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        """A strip, by what would be stored of it."""
        options = self.options()
        strip = self._begin(files if self.several else files[:1], options)
        stem = self.name if self.several else files[0].name.partition(".")[0]
        return Described(
            kind=self.title,
            rows=[
                ("title", strip.title),
                ("format", strip.format),
                ("channels", ", ".join(strip.polarizations)),
                ("samples", f"{strip.even.time.size} pulses x {strip.delay.size} samples"),
            ],
            command=["ingest", self.name, given, "--out", f"{stem}.zarr"],
            attributes=strip.attributes(options),
            collection=strip.collection(options)[0],
            notes=strip.remarks(options),
        )
