"""zarr and xarray: what every store holds, and how to create, read and write one region of it.

`schema` is the one statement of every store's variables; writing and checking both go by it. Metadata is
created once, before any task (`creation`); after that each task writes whole chunks that nobody else writes
(`regions`), so there are no locks. A chunk that was never written reads as NaN (-1 for integers), never as zero:
"not there" is not "dark".

`phase_history.zarr` is a public contract, and other programs write it: reading it (`phase_history`) trusts nothing.
Chunking, compression, attribute types and extra variables are theirs to choose; what the contract fixes is checked, and
every disagreement is one `InputError`.

zarr reads and writes whatever it understands. Chunks laid out as `create` lays them out are plain files, which
`chunk_files` reads and writes itself, several times as fast.

A store lies in a folder or below a prefix of an object store: every path may be an `s3://` URL or a `Place`.
"""

from __future__ import annotations

from blocksar.stores.chunk_files import Array, Region
from blocksar.stores.creation import UNFINISHED, create
from blocksar.stores.phase_history import (
    PhaseHistory,
    create_phase_history,
    history_line,
    open_dataset,
    open_phase_history,
    read_collection,
    write_collection,
)
from blocksar.stores.records import checksum, checksum_bytes, json_checksum, read_json, write_json
from blocksar.stores.regions import chunk_shape, read_region, share_region, write_region
from blocksar.stores.schema import (
    COLLECTION,
    CONVENTIONS,
    IMAGE,
    PATCH,
    PHASE_HISTORY,
    RAW_ECHO,
    SPECTRUM,
    TRACK_AND_BEAM,
    Variable,
)

__all__ = [
    "COLLECTION",
    "CONVENTIONS",
    "IMAGE",
    "PATCH",
    "PHASE_HISTORY",
    "RAW_ECHO",
    "SPECTRUM",
    "TRACK_AND_BEAM",
    "UNFINISHED",
    "Array",
    "PhaseHistory",
    "Region",
    "Variable",
    "checksum",
    "checksum_bytes",
    "chunk_shape",
    "create",
    "create_phase_history",
    "history_line",
    "json_checksum",
    "open_dataset",
    "open_phase_history",
    "read_collection",
    "read_json",
    "read_region",
    "share_region",
    "write_collection",
    "write_json",
    "write_region",
]
