"""Files of a made-up format: a line that names it, a line of JSON, positions of the antenna, and samples."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.options import Option
from blocksar.places import readable
from blocksar.readers.kinds import Kind, begins
from blocksar.readers.reading import reading
from blocksar.readers.registry import Described, Piece, ReaderOptions, Reading

MAGIC = b"MADEUP 1\n"
AT_ONCE = 256  # pulses


@dataclass(frozen=True, kw_only=True)
class MadeUpOptions(ReaderOptions):
    gain: Annotated[float, Option("Factor of the samples.")] = 1.0


def header(where: Any) -> tuple[dict[str, Any], Collection, int]:
    """The line of JSON, the collection, and where the samples begin."""
    with reading(where, damaged="damaged", remedy="get it again"), where.open() as file:
        if file.readline() != MAGIC:
            raise InputError("it is no MADEUP file; give one")
        told = json.loads(file.readline())
        n, columns = told["pulses"], told["columns"]
        position = np.frombuffer(file.read(24 * n), "<f8").reshape(n, 3)
        begin = file.tell()
        collection = Collection(
            carrier=told["carrier"], time=(np.arange(n) - n // 2) / told["prf"], antenna_position=position,
            range_frequency=(np.arange(columns) - columns // 2) * told["step"],
            reference_range=np.full(n, told["reference_range"]), beam_azimuth=np.full(n, np.nan),
            title=told["title"],
        )  # fmt: skip
    return told, collection, begin


class MadeUp:
    summary = "Convert a MADEUP file to a phase history."
    example = "flight.madeup --out flight.zarr"
    source = "SOURCE.madeup", "MADEUP file."
    several = False
    kind = Kind("a MADEUP file", begins(MAGIC), "turn it into a phase history first: `blocksar ingest {path}`")
    options = MadeUpOptions

    def read(self, sources: Sequence[Any], options: MadeUpOptions) -> Reading:
        where = readable(sources[0])
        told, collection, begin = header(where)
        n, columns = collection.n_pulse, collection.n_range_frequency

        def pieces() -> Iterator[Piece]:
            with reading(where, damaged="damaged", remedy="get it again"), where.open() as file:
                file.seek(begin)
                for first in range(0, n, AT_ONCE):
                    pulses = slice(first, min(first + AT_ONCE, n))
                    rows = pulses.stop - first
                    samples = np.frombuffer(file.read(8 * rows * columns), "<c8").reshape(rows, columns)
                    yield Piece(0, pulses, options.gain * samples)

        return Reading(
            collection=collection, pieces=pieces, attributes={"source": {"format": "MADEUP", "by": told["by"]}},
            messages=lambda: [f"{n} pulses of {columns} samples, by {told['by']}"],
        )  # fmt: skip

    def describe(self, files: Sequence[Any], given: str) -> Described:
        told, collection, _ = header(files[0])
        rows = [("title", collection.title), ("by", told["by"])]
        command = ["ingest", "madeup", given, "--out", "flight.zarr"]
        return Described(kind="MADEUP file", rows=rows, command=command, collection=collection)


MADEUP = MadeUp()
