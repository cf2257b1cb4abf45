"""What a CPHD file holds, without its samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.ingestion.cphd.files import library, open_file, reading_file
from blocksar.ingestion.cphd.ingestion import Choices, prepare
from blocksar.places.local import LocalPlace


@dataclass(frozen=True, kw_only=True, eq=False)
class Described:
    """Version, domain and channels (identifier, vectors, samples) of a file, and the collection of its first channel.

    `attributes` are those that the phase history would have, `notes` what is unusual about delays and places.
    """

    version: str
    domain: str
    channels: list[tuple[str, int, int]]
    collection: Collection
    attributes: dict[str, Any]
    notes: list[str]


def describe(path: LocalPlace) -> Described:
    """Read header, XML and per-vector parameters.

    Raises
    ------
    InputError
        As `ingest`, but a file with several channels is described by its first.
    """
    library()
    with reading_file(path), open(path.path, "rb") as stream, np.errstate(all="ignore"):
        file = open_file(stream, path.path, None, any_channel=True)
        prepared = prepare(file, Choices())
        nodes = file.root.findall("{*}Data/{*}Channel")
        channels = [
            (node.findtext("{*}Identifier"), int(node.findtext("{*}NumVectors")), int(node.findtext("{*}NumSamples")))
            for node in nodes
        ]
    return Described(
        version=file.version, domain=file.domain, channels=channels, collection=prepared.collection,
        attributes=prepared.attributes, notes=prepared.notes,
    )  # fmt: skip
