"""Description of a satellite's raw echo by `info`."""

from __future__ import annotations

from blocksar.ingestion.readers import Described
from blocksar.ingestion.strips.options import StripOptions
from blocksar.ingestion.strips.strip import Strip


def describe(strip: Strip, kind: str, command: list[str], name: str) -> Described:
    """A strip, by what would be stored of it; `command` without its --out, `name` that of the file."""
    options = StripOptions()
    collection, _ = strip.collection(options)
    return Described(
        kind=kind,
        rows=[
            ("title", strip.title),
            ("format", strip.format),
            ("channels", ", ".join(strip.polarizations)),
            ("samples", f"{strip.even.time.size} pulses x {strip.delay.size} samples"),
        ],
        command=[*command, "--out", f"{name.partition('.')[0]}.zarr"],
        attributes=strip.attributes(options),
        collection=collection,
        notes=strip.remarks(options),
    )
