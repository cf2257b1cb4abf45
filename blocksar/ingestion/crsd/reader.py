"""CRSD files as a reader: CRSD 1.0 (NGA.STND.0080)."""

from __future__ import annotations

from blocksar.ingestion.crsd.options import KIND, CrsdOptions
from blocksar.ingestion.strips.reader import StripReader

CRSD = StripReader(
    name="crsd",
    title="CRSD file",
    summary="Convert a CRSD file, of echoes that are not compressed, to a phase history.",
    example="collect.crsd --out collect.zarr",
    source=("SOURCE.crsd", "CRSD file, version 1.0."),
    kind=KIND,
    options=CrsdOptions,
)
