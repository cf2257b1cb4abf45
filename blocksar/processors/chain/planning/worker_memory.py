"""Predicted peak memory of a worker that focuses blocks, or gates their ranges."""

from __future__ import annotations

from blocksar.chunks import COLUMN_CHUNK, IMAGE_PIXELS, SPECTRUM_BYTES, WRITES_AT_ONCE, WRITES_PER_THREAD
from blocksar.constants import MIB
from blocksar.kernels.fourier import Axis
from blocksar.kernels.groups import GROUP_BYTES
from blocksar.planning.memory import PROCESS_MEMORY
from blocksar.processors.chain.steps.range_gate import RangeGate

# On a terrain: heights, angles and layers of two strips of chunks, samples of the terrain that are kept, and bent taps.
RELIEF_MEMORY = 72 * MIB


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
