"""A run is finished only if everything that it read and wrote is what it should be."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from scenes import scene

import blocksar
from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.graph import stages

GRID = ((15900.0, 16300.0, 4.0), (19000.0, 19400.0, 4.0))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("integrity")
    more = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n'
    (folder / "scene.toml").write_text(scene(swath=[29700.0, 30300.0], more=more))
    return blocksar.simulate(folder / "scene.toml", folder / "phase_history.zarr")


@pytest.fixture
def store(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "phase_history.zarr"))


@pytest.fixture(scope="module")
def right(original: Path, client: Client, tmp_path_factory: pytest.TempPathFactory) -> str:
    run = tmp_path_factory.mktemp("right") / "run"
    blocksar.focus(original, run, blocks=2, grid=GRID, client=client)
    return checksum(run)


def checksum(run: Path) -> str:
    return stores.checksum(blocksar.open(run).image.values)


def chunk_of(variable: Path) -> Path:
    """A chunk in the middle of the samples."""
    files = sorted(file for file in (variable / "c").rglob("*") if file.is_file())
    return files[len(files) // 2]


def overwrite(file: Path) -> None:
    with file.open("r+b") as stream:
        stream.seek(file.stat().st_size // 2)
        stream.write(bytes(4000))


def before(monkeypatch: pytest.MonkeyPatch, stage: str, act: Callable[[], None], after: Callable[[], None]) -> None:
    """Act before a stage, and after it."""
    real = getattr(stages, stage)

    def sabotaged(*args: Any) -> Any:
        act()
        try:
            return real(*args)
        finally:
            after()

    monkeypatch.setattr(stages, stage, sabotaged)


# ---------------------------------------------------------------- the input


def test_a_chunk_that_is_gone_while_it_is_read_ends_the_run(
    store: Path, right: str, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunk, aside = chunk_of(store / "signal"), tmp_path / "aside"
    with monkeypatch.context() as patch:
        before(patch, "recover", lambda: os.rename(chunk, aside), lambda: os.rename(aside, chunk))
        with pytest.raises(InputError, match=r"changes while it is read: signal/c/\d+/\d+ was gone"):
            blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, client=client)
    assert not (tmp_path / "run" / "run.json").exists()
    blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, client=client)
    assert checksum(tmp_path / "run") == right


@pytest.mark.parametrize("processor", ["angular-division", "backprojection"])
def test_a_chunk_that_is_written_while_it_is_read_ends_the_run(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processor: Any
) -> None:
    stage = "recover" if processor == "angular-division" else "back_project"
    before(monkeypatch, stage, lambda: overwrite(chunk_of(store / "signal")), lambda: None)
    with pytest.raises(InputError, match=r"changes while it is read: signal/c/\d+/\d+ was written"):
        blocksar.focus(store, tmp_path / "run", processor=processor, blocks=2, grid=GRID, client=client)
    assert not (tmp_path / "run" / "run.json").exists()


def test_an_axis_that_is_written_while_it_is_opened_is_refused(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = stores.PhaseHistory.fingerprint

    def changed(history: stores.PhaseHistory) -> str:
        stores.write_region(store, "reference_range", (slice(None),), history.collection.reference_range + 1.0)
        return real(history)

    monkeypatch.setattr(stores.PhaseHistory, "fingerprint", changed)
    with pytest.raises(InputError, match="changes while it is read"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, client=client)


# ---------------------------------------------------------------- the run's own stores


@pytest.mark.parametrize("damage", [os.unlink, overwrite])
def test_a_damaged_chunk_of_the_spectrum_is_noticed_and_computed_again(
    store: Path,
    right: str,
    client: Client,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    damage: Callable[[Path], None],
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        before(patch, "focus_blocks", lambda: damage(chunk_of(run / "spectrum.zarr" / "spectrum")), lambda: None)
        with pytest.raises(ProcessingError, match=r"no longer has the checksum of its receipt.* goes on from there"):
            blocksar.focus(store, run, blocks=2, grid=GRID, client=client)
    report = blocksar.focus(store, run, blocks=2, grid=GRID, client=client)
    assert checksum(run) == right
    assert any("damaged and computed again" in line for line in report.summary)


def test_a_chunk_of_a_patch_that_is_lost_is_noticed(
    store: Path, right: str, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        before(patch, "mosaic", lambda: os.unlink(chunk_of(run / "patches" / "0" / "image")), lambda: None)
        with pytest.raises(ProcessingError, match="no longer has the checksum of its receipt"):
            blocksar.focus(store, run, blocks=2, grid=GRID, client=client)
    blocksar.focus(store, run, blocks=2, grid=GRID, client=client)
    assert checksum(run) == right
