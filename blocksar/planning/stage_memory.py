"""Predicted peak memory of a worker in stages before any processor's, and of tracks."""

from __future__ import annotations

from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import MIB
from blocksar.imaging.compression import COMPRESSED_ROWS, GAPPED_ROWS, RawCompression
from blocksar.imaging.interference import GROUP
from blocksar.planning.memory import PROCESS_MEMORY

PROFILES = 3 * 2  # bytes of range profiles and their copies, for each of the samples, which are zero-padded twofold
TRACK_MEMORY = 48 * MIB  # forms of splines, and what is read and written
CHIP_COPIES = 8  # of the chips of all points while the track's error is estimated


def compression_memory(collection: Collection, raw: RawEcho | None) -> int:
    """Peak memory of a worker that range-compresses a raw echo, bytes; 0 without one."""
    if raw is None:
        return 0
    echo, band = raw.fast_time.size, collection.n_range_frequency
    length = RawCompression.of_echo(raw, collection).length
    pulses = 8 * TILE[0] * (2 * echo + 2 * band)  # as arrays, and as chunks read and written
    return PROCESS_MEMORY + pulses + COMPRESSED_ROWS * (8 * length + 5 * 16 * band) + GAPPED_ROWS * 64 * length


def interference_memory(collection: Collection) -> int:
    """Peak memory of a worker that cuts interference from samples, bytes."""
    columns = collection.n_range_frequency
    # The samples as an array and as chunks read and written; a group in double precision, and its projected-out part.
    return PROCESS_MEMORY + 8 * 3 * TILE[0] * columns + 16 * 6 * 2 * GROUP * columns


def track_memory(collection: Collection, n_pulse: int, chips: int) -> int:
    """Peak memory of a worker that takes chips from `n_pulse` pulses, or estimates from all chips, of so many bytes."""
    samples = 8 * n_pulse * collection.n_range_frequency
    # As an array, and as chunks read.
    return PROCESS_MEMORY + TRACK_MEMORY + max((2 + PROFILES) * samples, CHIP_COPIES * chips)
