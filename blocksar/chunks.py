"""Chunk sizes: the chunks of stores, and the amounts that a task reads or writes at a time."""

from __future__ import annotations

import math

from blocksar.constants import MIB

SAMPLE = 8  # bytes of a sample or pixel, complex64
MOSAIC_CHUNKS = 4  # output chunks merged by a task: a single one takes no longer than the scheduler's reply
LAYER_CHUNKS = 16  # output chunks whose layers are added by a task
BACKPROJECTION_CHUNK = 512  # pixels on a side that are back-projected in one pass over the pulses
DOPPLER_GROUP = 512  # Doppler bins gated in range at a time, and in a chunk of the result; at most
COLUMN_CHUNK = 256  # range frequencies in a chunk of the spectrum; fewer if there are many Doppler bins
CHUNK_SAMPLES = DOPPLER_GROUP * COLUMN_CHUNK  # samples in a chunk of the spectrum
SPECTRUM_BYTES = 64 * MIB  # bytes of the spectrum written at a time
GATE_BYTES = 128 * MIB  # bytes of the spectrum that one task gates in range, at most
SIGNAL_BYTES = 96 * MIB  # bytes of the phase history read at a time
SIGNAL_COLUMNS = 512  # columns of the phase history read at a time, at most
IMAGE_CHUNK = 512  # pixels on a side of an image's chunk: 2 MiB
COPY_BYTES = 256 * MIB  # bytes of files that one task copies, about
TILED_CHUNKS = 32  # output chunks whose tiles are found at once: 1 MiB of polynomials
STRIP_CHUNKS = 8  # adjacent output chunks whose heights and layers are computed at once
READS_AT_ONCE = 2  # patches that a task reads while it merges those before
WRITES_AT_ONCE = 2  # chunks that a task of one thread writes while it computes the next
WRITES_PER_THREAD = 2 / 3  # and of several threads, for each: writing takes up to so much of the time of computing
IMAGE_PIXELS = IMAGE_CHUNK**2
PYRAMID_LEVELS = 3  # the last of those that many tasks make: one makes the few that remain
PYRAMID_FROM = 4096  # pixels along a side, beyond which an image has a pyramid by default
TILE = (512, 1024)  # pulses by columns in a chunk of a phase history: 4 MiB, efficient to read along both axes


def stored_bytes(shape: tuple[int, ...], chunks: tuple[int, ...] = TILE) -> int:
    """Bytes of an array of complex64 samples in chunks, which are stored whole also where they stand out of it.

    Examples
    --------
    >>> stored_bytes((1200, 451)) // 8, 3 * 512 * 451
    (692736, 692736)
    """
    sides = [(n, max(min(n, chunk), 1)) for n, chunk in zip(shape, chunks, strict=True)]
    return SAMPLE * math.prod(-(-n // side) * side for n, side in sides)
