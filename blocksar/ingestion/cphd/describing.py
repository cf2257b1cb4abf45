"""Description of a CPHD file, without its samples."""

from __future__ import annotations

import os

import numpy as np

from blocksar.ingestion.cphd.choices import Choices
from blocksar.ingestion.cphd.files import library, open_file, opened, reading_file
from blocksar.ingestion.cphd.ingestion import prepare
from blocksar.ingestion.readers import Described
from blocksar.places.place import size_text
from blocksar.places.ranges import Readable


def describe(path: Readable, given: str) -> Described:
    """Read header, XML and per-vector parameters; a file with several channels is described by its first.

    Raises
    ------
    InputError
        As `CphdReader.read`.
    """
    library()
    with reading_file(path), opened(path) as stream, np.errstate(all="ignore"):
        file = open_file(stream, path, None, any_channel=True)
        prepared = prepare(file, Choices())
        sign = prepared.sign(None, Choices())
        nodes = file.root.findall("{*}Data/{*}Channel")
        channels = [
            (node.findtext("{*}Identifier"), int(node.findtext("{*}NumVectors")), int(node.findtext("{*}NumSamples")))
            for node in nodes
        ]
        size = stream.seek(0, os.SEEK_END)
    first, several = channels[0][0], len(channels) > 1
    chosen = ["--channel", first] if several else []
    return Described(
        kind="CPHD file",
        rows=[
            ("title", prepared.collection.title),
            ("format", f"CPHD {file.version}, {file.domain} domain, {size_text(size)}"),
            ("channels", ", ".join(f"{name} ({n} vectors x {m} samples)" for name, n, m in channels)),
        ],
        command=["ingest", "cphd", given, *chosen, "--out", f"{path.name.partition('.')[0]}.zarr"],
        attributes=prepared.attributes,
        collection=prepared.collection,
        notes=[
            *([sign] if sign else []), *prepared.notes,
            *([f"what follows the channels is that of {first}"] if several else []),
        ],
    )  # fmt: skip
