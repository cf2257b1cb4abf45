"""Options of a CRSD file, and how one is recognised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from blocksar.ingestion.kinds import Kind, begins
from blocksar.ingestion.strips.options import PartOptions
from blocksar.options import Option

KIND = Kind(
    "a CRSD file", begins(b"CRSDsar/", b"CRSDrcv/", b"CRSDtx/", b"CRSD/"),
    "turn it into a phase history first: `blocksar ingest crsd {path} --out {store}`",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CrsdOptions(PartOptions):
    """As `PartOptions`.

    Attributes
    ----------
    channel : str, optional
        Identifier of the channel. Needed if several have the polarisation.
    """

    channel: Annotated[
        str | None, Option("Channel to read, if the file has several of a polarisation.", metavar="NAME")
    ] = None
