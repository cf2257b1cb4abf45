"""Options of a file of NISAR, and how one is recognised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from blocksar.errors import InputError, quoted
from blocksar.ingestion.kinds import Kind, hdf5
from blocksar.ingestion.strips.options import StripOptions
from blocksar.options import Option

KIND = Kind(
    "an HDF5 file of NISAR", lambda start: hdf5(start) and b"science" in start.data,
    "turn it into a phase history first: `blocksar ingest nisar {path} --out {store}`",
)  # fmt: skip


def _read_frequency(value: Any) -> str | None:
    if value is not None and str(value).upper() not in ("A", "B"):
        raise InputError(f"--frequency is {quoted(value)}; it must be A or B")
    return None if value is None else str(value).upper()


@dataclass(frozen=True, kw_only=True)
class NisarOptions(StripOptions):
    """As `StripOptions`.

    Attributes
    ----------
    frequency : {"A", "B"}, optional
        Band of the two. Default: "A", or the only one.
    """

    frequency: Annotated[
        str | None, Option("Band of the two.", metavar="A|B", default="A, or the only one", read=_read_frequency)
    ] = None
