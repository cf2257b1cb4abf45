"""PALSAR's raw echoes as a reader: ALOS PALSAR level 1.0 (CEOS)."""

from __future__ import annotations

from blocksar.ingestion.kinds import Kind, ceos
from blocksar.ingestion.strips.options import StripOptions
from blocksar.ingestion.strips.reader import StripReader

PALSAR = StripReader(
    name="palsar",
    title="PALSAR raw echo",
    summary="Convert raw echoes of ALOS PALSAR (CEOS level 1.0) to a phase history on the ellipsoid.",
    example="ALPSRP267211110-L1.0 --out palsar.zarr",
    source=("FOLDER", "Folder of one scene, or its files: leader (LED) and images (IMG)."),
    several=True,
    kind=Kind(
        "a CEOS file of raw echoes", lambda start: ceos(start, b"\x32\x0a"),
        "if it is of PALSAR, turn its folder into a phase history first: `blocksar ingest palsar {path} --out {store}`",
    ),
    options=StripOptions,
)  # fmt: skip
