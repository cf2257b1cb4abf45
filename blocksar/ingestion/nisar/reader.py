"""NISAR's raw echoes as a reader: level 0B RRSD (HDF5)."""

from __future__ import annotations

from blocksar.ingestion.nisar.options import KIND, NisarOptions
from blocksar.ingestion.strips.reader import StripReader

NISAR = StripReader(
    name="nisar",
    title="NISAR raw echo",
    summary="Convert raw echoes of NISAR (level 0B RRSD, HDF5) to a phase history on the ellipsoid.",
    example="NISAR_L0_RRSD.h5 --out strip.zarr",
    source=("SOURCE.h5", "File of level 0B."),
    kind=KIND,
    options=NisarOptions,
)
