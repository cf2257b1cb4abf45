"""Zarr stores: their variables, how to create them, and how to read and write them by region.

`contract` defines the variables of every store, for writing and for checking. Metadata is created once, before any task
(`creation`); each task then writes whole chunks that no other task writes (`regions`), so no locks are needed. A chunk
that was never written reads as NaN (-1 for integers), never as zero: missing is not dark.

`phase_history.zarr` is a public contract, and other programs write such stores; reading one (`phase_history`) therefore
checks everything that the contract fixes and raises an `InputError` for any departure. Chunking, compression, attribute
types and additional variables are free.

Chunks in the layout that `create` uses are plain files, which `chunk_files` reads and writes directly, several times as
fast as zarr. zarr handles all other layouts, and is loaded for those only: it would delay the start of every run.

A store is a folder or a prefix in an object store: every path may be an `s3://` URL or a `Place`.
"""

from __future__ import annotations

from blocksar.stores.channels import POLARIZATIONS, check_channels, look_name, number_of, with_channels, without_unseen
from blocksar.stores.chunk_files import Array, Region
from blocksar.stores.contract import (
    ANTENNAS,
    CALIBRATION_FACTOR,
    COLLECTION,
    COLLECTION_NUMBER,
    CONVENTIONS,
    GATED,
    IMAGE,
    LEVEL,
    NOISE,
    ON_TERRAIN,
    PATCH,
    PHASE_HISTORY,
    RAW_ECHO,
    SCHEMA,
    SPECTRUM,
    TRACK_AND_BEAM,
    TRUTH,
    Variable,
    calibration_of,
)
from blocksar.stores.copying import (
    ORIGINAL,
    copy_files,
    files_to_copy,
    groups_of,
    publish,
    same_files,
    was_being_published,
    write_track,
)
from blocksar.stores.creation import (
    UNFINISHED,
    Group,
    create,
    create_phase_history,
    history_bytes,
    history_line,
    phase_history_group,
    refuse_existing,
    refuse_full,
    write_collection,
)
from blocksar.stores.datasets import CONTENT, DatasetHistory, dataset_of, history_in_memory, history_of
from blocksar.stores.incoming import NUMBERS, enter
from blocksar.stores.phase_history import (
    PhaseHistory,
    collections_in,
    create_collections,
    is_truth,
    open_dataset,
    open_phase_history,
    read_collection,
    write_truth,
)
from blocksar.stores.pieces import Piece, Samples, blocks_of, write_pieces
from blocksar.stores.pyramid import PYRAMID, Pyramid, level_name, level_shapes, levels_of, pyramid_of
from blocksar.stores.records import checksum, checksum_bytes, file_checksum, json_checksum, read_json, write_json
from blocksar.stores.regions import chunk_shape, read_region, share_region, write_region
from blocksar.stores.terrain_store import StoredTerrain, read_terrain, terrain_fingerprint, write_terrain

__all__ = [
    "ANTENNAS",
    "CALIBRATION_FACTOR",
    "COLLECTION",
    "COLLECTION_NUMBER",
    "CONTENT",
    "CONVENTIONS",
    "GATED",
    "IMAGE",
    "LEVEL",
    "NOISE",
    "NUMBERS",
    "ON_TERRAIN",
    "ORIGINAL",
    "PATCH",
    "PHASE_HISTORY",
    "POLARIZATIONS",
    "PYRAMID",
    "RAW_ECHO",
    "SCHEMA",
    "SPECTRUM",
    "TRACK_AND_BEAM",
    "TRUTH",
    "UNFINISHED",
    "Array",
    "DatasetHistory",
    "Group",
    "PhaseHistory",
    "Piece",
    "Pyramid",
    "Region",
    "Samples",
    "StoredTerrain",
    "Variable",
    "blocks_of",
    "calibration_of",
    "check_channels",
    "checksum",
    "checksum_bytes",
    "chunk_shape",
    "collections_in",
    "copy_files",
    "create",
    "create_collections",
    "create_phase_history",
    "dataset_of",
    "enter",
    "file_checksum",
    "files_to_copy",
    "groups_of",
    "history_bytes",
    "history_in_memory",
    "history_line",
    "history_of",
    "is_truth",
    "json_checksum",
    "level_name",
    "level_shapes",
    "levels_of",
    "look_name",
    "number_of",
    "open_dataset",
    "open_phase_history",
    "phase_history_group",
    "publish",
    "pyramid_of",
    "read_collection",
    "read_json",
    "read_region",
    "read_terrain",
    "refuse_existing",
    "refuse_full",
    "same_files",
    "share_region",
    "terrain_fingerprint",
    "was_being_published",
    "with_channels",
    "without_unseen",
    "write_collection",
    "write_json",
    "write_pieces",
    "write_region",
    "write_terrain",
    "write_track",
    "write_truth",
]
