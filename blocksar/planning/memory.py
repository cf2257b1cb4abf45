"""Predicted peak memory of a worker by stage."""

from __future__ import annotations

import math

from blocksar.chunks import (
    BACKPROJECTION_CHUNK,
    COLUMN_CHUNK,
    IMAGE_PIXELS,
    SPECTRUM_BYTES,
    TILE,
    WRITES_AT_ONCE,
    WRITES_PER_THREAD,
)
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.imaging.backprojection import gpu_memory, image_memory
from blocksar.imaging.interference import GROUP
from blocksar.kernels.fourier import Axis
from blocksar.kernels.groups import GROUP_BYTES, ROOM
from blocksar.planning.tiling import image_chunk, inspection_width
from blocksar.processors.chain.steps.range_gate import COMPRESSED_ROWS, GAPPED_ROWS, RangeGate, RawCompression
from blocksar.processors.hierarchy.parts import PULSE_BLOCK_BYTES

MEMORY_SHARE = 0.8  # fraction of a worker's limit that a plan may fill
PROCESS_MEMORY = 288 * MIB  # a worker's interpreter and libraries, without samples
GPU_PROCESS_MEMORY = 768 * MIB  # more with the libraries of a GPU
PROFILES = 3 * 2  # bytes of range profiles and their copies, for each of the samples, which are zero-padded twofold
# On a terrain: heights, angles and layers of two strips of chunks, samples of the terrain that are kept, and bent taps.
RELIEF_MEMORY = 72 * MIB
TRACK_MEMORY = 48 * MIB  # forms of splines, and what is read and written
PIXEL_BYTES = 72  # of a pixel of the hierarchy's window while it is formed
GPU_PIXEL_BYTES = 64  # of it on a GPU
CHIP_COPIES = 8  # of the chips of all points while the track's error is estimated


def checked_back_projection_memory(
    collection: Collection, grid: Grid, threads: int, memory_limit: int, chunks: tuple[int, int] | None = None
) -> int:
    """Peak memory of a worker that back-projects, bytes, if its limit holds it.

    Raises
    ------
    InputError
        If the limit is too low.
    """
    memory = back_projection_memory(collection, grid, threads=threads, chunks=chunks)
    return checked_memory("back-projection", memory, memory_limit)


def checked_memory(what: str, memory: int, memory_limit: int) -> int:
    """Return `memory`, bytes, if a worker's limit allows it; `what` names the need in the error.

    Raises
    ------
    InputError
        If the limit is too low.
    """
    if memory > MEMORY_SHARE * memory_limit:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {what} needs about "
            f"{math.ceil(memory / MEMORY_SHARE / MIB)} MiB; raise --memory-limit, or take fewer workers"
        )
    return memory


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


def back_projection_memory(
    collection: Collection, grid: Grid, *, threads: int, chunks: tuple[int, int] | None = None
) -> int:
    """Peak memory of a worker that inspects and back-projects, bytes; on a GPU to `chunks` at a time."""
    pixels = math.prod(image_chunk(grid))
    part = min(pixels, BACKPROJECTION_CHUNK**2)
    if chunks is not None:
        part = pixels = _box(grid, chunks)
    inspecting = 2 * 8 * inspection_width(collection) * collection.n_pulse  # as an array, and as chunks read
    forming = 3 * 8 * pixels + image_memory(part, collection, threads=threads)  # image, covered part, bytes to write
    return PROCESS_MEMORY + max(inspecting, forming) + (0 if chunks is None else GPU_PROCESS_MEMORY)


def gpu_back_projection_memory(collection: Collection, grid: Grid, chunks: tuple[int, int]) -> int:
    """Peak memory of a GPU that back-projects to `chunks` at a time, bytes."""
    return gpu_memory(_box(grid, chunks), collection)


def _box(grid: Grid, chunks: tuple[int, int]) -> int:
    """Pixels of a box of chunks."""
    return math.prod(min(n, k * side) for n, k, side in zip(grid.shape, chunks, image_chunk(grid), strict=True))


def block_memory(
    *,
    frequency: Axis,
    n_bin: int,
    n_column: int,
    n_row: int,
    n_image: int,
    length: int,
    n_short: int = 0,
) -> int:
    """Peak memory of a worker that focuses a block, bytes: the largest input and output of its stages.

    Stages work in place, except on rows of `n_short` samples that become longer, and on an image wider in Doppler than
    the signal is long. `n_bin` counts the Doppler bins of whole chunks.
    """
    buffer = max(frequency.size, n_row) * n_column
    loaded = n_bin * COLUMN_CHUNK
    held = [3 * loaded + buffer]  # one part in use, the next one being read, and the chunks of that
    if n_short:
        held.append(buffer + max(frequency.size, n_row) * n_short)
    if n_image > n_column:
        held.append(buffer + n_row * n_image)
    return PROCESS_MEMORY + 8 * max(*held, buffer + 2 * (WRITES_AT_ONCE + 1) * IMAGE_PIXELS) + group_memory(length)


def gating_memory(gate: RangeGate, *, n_bin: int, n_group: int) -> int:
    """Peak memory of a worker that gates `n_bin` Doppler bins in range, `n_group` at a time, bytes."""
    read = n_bin * gate.full.size
    read += min(read, SPECTRUM_BYTES // 8)  # and the chunks of a part
    delays = n_group * gate.to_delay.period
    # Groups being written or waiting for it; the one being computed, alone and in whole chunks; copies of chunks.
    gated = (WRITES_AT_ONCE + 4) * n_group * gate.range_frequency.size
    return PROCESS_MEMORY + 8 * (read + delays + gated) + group_memory(gate.to_delay.period)


def group_memory(length: int) -> int:
    """Memory of a thread that transforms rows of `length` samples by groups, bytes."""
    return 4 * max(GROUP_BYTES, 8 * 8 * length)


def thread_memory(length: int) -> int:
    """Memory of each further thread of a worker, bytes: groups of rows, and chunks of the image.

    The threads of one stage do not give back what those of another take: each has a heap of its own.
    """
    return group_memory(length) + round(2 * 8 * IMAGE_PIXELS * (1 + WRITES_PER_THREAD))  # computed and written


def hierarchical_memory(collection: Collection, samples: int, chunk: tuple[int, int], *, on_gpu: bool) -> int:
    """Peak memory of a worker with one thread that keeps `samples`, bytes; with a GPU, those are kept there."""
    block = max(PULSE_BLOCK_BYTES, 8 * collection.n_range_frequency)
    path = 2 * 3 * 3 * 8 * 3 * collection.n_pulse
    own = GPU_PROCESS_MEMORY if on_gpu else 8 * int(ROOM * samples)
    return PROCESS_MEMORY + 4 * block + own + PIXEL_BYTES * chunk[0] * chunk[1] + path


def hierarchical_gpu_memory(collection: Collection, samples: int, chunk: tuple[int, int]) -> int:
    """Peak memory of a GPU, bytes: its samples, a block being read and filtered, and a window."""
    block = max(PULSE_BLOCK_BYTES, 8 * collection.n_range_frequency)
    return 8 * int(ROOM * samples) + 4 * block + GPU_PIXEL_BYTES * chunk[0] * chunk[1]
