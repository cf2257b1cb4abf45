"""Chunks of one value share a file; what is read is the same as if each had its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blocksar import stores
from blocksar.places import place
from blocksar.planning.tiling import Window
from blocksar.runs.receipts import Run
from blocksar.tasks.layers import AlikeChunks

SHAPE, CHUNK = (10, 11), 4  # the last row and column of chunks are cut


def _window(row: int, column: int) -> Window:
    spans = zip((row, column), SHAPE, strict=True)
    y, x = (slice(CHUNK * k, min(CHUNK * (k + 1), n)) for k, n in spans)
    return y, x


@pytest.fixture
def run(tmp_path: Path) -> Run:
    y, x = (np.arange(n, dtype=np.float64) for n in SHAPE)
    stores.create(
        tmp_path / "image.zarr", stores.IMAGE, sizes={}, coords={"x": x, "y": y}, attrs={},
        chunks={"y": CHUNK, "x": CHUNK},
    )  # fmt: skip
    (tmp_path / "run.json").write_text('{"identity": "0"}')
    return Run(folder=place(tmp_path), identity="0", threads=1)


def _no_links(patch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any) -> None:
        raise OSError("no hard links here")

    patch.setattr(os, "link", refused)


@pytest.mark.parametrize("prepare", [lambda _: None, _no_links])
def test_chunks_of_one_value_share_a_file_and_are_what_was_given(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prepare: Callable[[pytest.MonkeyPatch], None]
) -> None:
    prepare(monkeypatch)
    whole = np.full(SHAPE, 3, np.int16)
    whole[:, 8:] = 4
    whole[5, 2] = -1
    alike = AlikeChunks(run)
    cells = [(i, j) for i in range(3) for j in range(3)]
    for _ in range(2):  # the second time as in a task that is retried
        with ThreadPoolExecutor(3) as pool:
            written = list(pool.map(lambda cell: alike.write("block", _window(*cell), whole[_window(*cell)]), cells))
    np.testing.assert_array_equal(stores.read_region(run.image, "block", (slice(None), slice(None))), whole)
    assert all(part.intact(run.folder) for part in written)
    assert [part.region for part in written] == [tuple((w.start, w.stop) for w in _window(*cell)) for cell in cells]

    def file(row: int, column: int) -> Path:
        return tmp_path / "image.zarr" / "block" / "c" / str(row) / str(column)

    linked = prepare is not _no_links
    assert os.path.samefile(file(0, 0), file(0, 1)) == linked  # both 3
    assert os.path.samefile(file(0, 2), file(1, 2)) == linked  # both 4
    assert not os.path.samefile(file(0, 0), file(1, 0))  # a pixel differs
    assert not os.path.samefile(file(0, 1), file(2, 1))  # cut by the end of the image


def test_one_number_stands_for_a_chunk_of_it(run: Run) -> None:
    alike = AlikeChunks(run)
    parts = [alike.write("block", _window(2, k), np.int16(k // 2)) for k in range(3)]
    assert stores.read_region(run.image, "block", (slice(8, 10), slice(None))).tolist() == [[0] * 8 + [1] * 3] * 2
    assert parts[0].checksum == parts[1].checksum == stores.checksum(np.zeros((2, 4), np.int16))
