"""What a CPHD file holds, without its samples."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.ingestion.cphd.files import library, open_file, opened, reading_file
from blocksar.ingestion.cphd.ingestion import prepare
from blocksar.places.ranges import Readable


@dataclass(frozen=True, kw_only=True, eq=False)
class Described:
    """Version, domain and channels (identifier, vectors, samples) of a file, and the collection of its first channel.

    `attributes` are those that the phase history would have.
    """

    version: str
    domain: str
    size: int  # bytes
    channels: list[tuple[str, int, int]]
    collection: Collection
    attributes: dict[str, Any]


def describe(path: Readable) -> Described:
    """Read header, XML and per-vector parameters.

    Raises
    ------
    InputError
        As `ingest`, but a file with several channels is described by its first.
    """
    library()
    with reading_file(path), opened(path) as stream, np.errstate(all="ignore"):
        file = open_file(stream, path, None, any_channel=True)
        prepared = prepare(file)
        nodes = file.root.findall("{*}Data/{*}Channel")
        channels = [
            (node.findtext("{*}Identifier"), int(node.findtext("{*}NumVectors")), int(node.findtext("{*}NumSamples")))
            for node in nodes
        ]
        size = stream.seek(0, os.SEEK_END)
    return Described(
        version=file.version, domain=file.domain, size=size, channels=channels, collection=prepared.collection,
        attributes=prepared.attributes,
    )  # fmt: skip
