"""Predicted peak memory of a worker that forms parts of an image, and of its GPU."""

from __future__ import annotations

from blocksar.collection.collection import Collection
from blocksar.kernels.groups import ROOM
from blocksar.planning.memory import GPU_PROCESS_MEMORY, PROCESS_MEMORY
from blocksar.processors.hierarchy.parts import PULSE_BLOCK_BYTES

PIXEL_BYTES = 72  # of a pixel of the hierarchy's window while it is formed
GPU_PIXEL_BYTES = 64  # of it on a GPU


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
