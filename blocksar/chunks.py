"""How samples are divided: chunks of stores, and what a task reads or writes at a time."""

from __future__ import annotations

from blocksar.constants import MIB

MOSAIC_CHUNKS = 4  # output chunks merged by a task: one takes no longer than the scheduler's answer
BACKPROJECTION_CHUNK = 256  # pixels a side of a back-projection task
DOPPLER_GROUP = 512  # Doppler bins of a slab that are read at a time
COLUMN_CHUNK = 256  # range frequencies of a chunk of the spectrum, fewer where Doppler bins are many
CHUNK_SAMPLES = DOPPLER_GROUP * COLUMN_CHUNK  # of a chunk of the spectrum
SPECTRUM_BYTES = 64 * MIB  # of the spectrum written at a time
SIGNAL_BYTES = 96 * MIB  # of the phase history read at a time
SIGNAL_COLUMNS = 512  # at most
IMAGE_CHUNK = 1024  # pixels a side of an image's chunk
IMAGE_PIXELS = IMAGE_CHUNK**2
TILE = (512, 1024)  # pulses by columns of a phase history: 4 MiB, whole in either direction of reading
