"""A recovered spectrum stays in the page cache where it takes little of the memory; it reads the same either way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from blocksar import stores
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.processors.chain.tasks import spectrum as subject
from blocksar.processors.chain.tasks.spectrum import SpectrumChunks, stays_cached
from blocksar.runs.record import Written

SHAPE, CHUNK = (700, 90), (256, 64)


@pytest.mark.parametrize(("memory", "cached"), [(8 * 8 * 700 * 90, True), (8 * 8 * 700 * 90 - 8, False)])
def test_a_spectrum_of_an_eighth_of_the_memory_stays_cached(
    memory: int, cached: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subject, "machine", lambda: (2, memory))
    assert stays_cached(SHAPE) is cached


@pytest.fixture
def written(tmp_path: Path) -> tuple[Place, np.ndarray]:
    """A spectrum of random samples, and the samples."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal((*SHAPE, 2), np.float32).view(np.complex64)[..., 0]
    stores.create(
        tmp_path / "spectrum.zarr", stores.SPECTRUM, sizes={}, attrs={"title": "t"},
        coords={"doppler": np.arange(SHAPE[0], dtype=float), "range_frequency": np.arange(SHAPE[1], dtype=float)},
        variables={"lit": np.ones(3)}, chunks=dict(zip(("doppler", "range_frequency"), CHUNK, strict=True)),
    )  # fmt: skip
    return place(tmp_path / "spectrum.zarr"), values


@pytest.mark.parametrize("wrote", [False, True])
@pytest.mark.parametrize("reads", [False, True])
def test_a_spectrum_reads_as_it_was_written(
    wrote: bool, reads: bool, written: tuple[Place, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the page cache or without, also if the reader's machine decides otherwise than the writer's."""
    store, values = written
    parts = []
    for rows in (slice(0, 256), slice(256, 512), slice(512, 700)):
        for columns in (slice(0, 64), slice(64, 90)):
            stores.write_region(store, "spectrum", (rows, columns), values[rows, columns], cached=wrote)
            span = ((rows.start, rows.stop), (columns.start, columns.stop))
            parts.append(Written("spectrum.zarr", "spectrum", span, stores.checksum(values[rows, columns])))
    monkeypatch.setattr(subject, "stays_cached", lambda shape: reads)
    chunks = SpectrumChunks.of(store, parts, shape=SHAPE, chunk=CHUNK, recovered=True)
    np.testing.assert_array_equal(chunks.read((slice(100, 650), slice(0, 90))), values[100:650])
