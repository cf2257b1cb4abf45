"""A run is finished only if everything that it read and wrote is what it should be."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from scenes import one_target

import blocksar
from blocksar import stores
from blocksar.errors import FolderError, InputError, ProcessingError
from blocksar.processors.chain import processor as chain
from blocksar.processors.chain.tasks import stages
from blocksar.tasks import stages as shared_stages

GRID = ((15900.0, 16300.0, 4.0), (19000.0, 19400.0, 4.0))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return one_target(tmp_path_factory.mktemp("integrity"))


@pytest.fixture
def store(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "phase_history.zarr"))


@pytest.fixture(scope="module")
def right(original: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    run = tmp_path_factory.mktemp("right") / "run"
    report = blocksar.focus(original, run, blocks=2, grid=GRID, workers=0)
    assert report.result["status"] == "finished"
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
    home = stages if hasattr(stages, stage) else shared_stages
    real = getattr(home, stage)

    def sabotaged(*args: Any, **keywords: Any) -> Any:
        act()
        try:
            return real(*args, **keywords)
        finally:
            after()

    monkeypatch.setattr(home, stage, sabotaged)


# ---------------------------------------------------------------- the input


@pytest.mark.slow
def test_a_chunk_that_is_gone_while_it_is_read_ends_the_run(
    store: Path, right: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunk, aside = chunk_of(store / "signal"), tmp_path / "aside"
    with monkeypatch.context() as patch:
        before(patch, "recover", lambda: os.rename(chunk, aside), lambda: os.rename(aside, chunk))
        with pytest.raises(InputError, match=r"changes while it is read: signal/c/\d+/\d+ was gone"):
            blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)
    assert not (tmp_path / "run" / "run.json").exists()
    blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)
    assert checksum(tmp_path / "run") == right


@pytest.mark.parametrize("processor", ["angular-division", "backprojection"])
def test_a_chunk_that_is_written_while_it_is_read_ends_the_run(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processor: Any
) -> None:
    stage = "recover" if processor == "angular-division" else "form_parts"
    before(monkeypatch, stage, lambda: overwrite(chunk_of(store / "signal")), lambda: None)
    with pytest.raises(InputError, match=r"changes while it is read: signal/c/\d+/\d+ was written"):
        blocksar.focus(store, tmp_path / "run", processor=processor, blocks=2, grid=GRID, workers=0)
    assert not (tmp_path / "run" / "run.json").exists()


def test_an_axis_that_is_written_while_it_is_opened_is_refused(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = stores.PhaseHistory.fingerprint

    def changed(history: stores.PhaseHistory) -> str:
        stores.write_region(store, "reference_range", (slice(None),), history.collection.reference_range + 1.0)
        return real(history)

    monkeypatch.setattr(stores.PhaseHistory, "fingerprint", changed)
    with pytest.raises(InputError, match="changes while it is read"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)


# ---------------------------------------------------------------- the run's own stores


@pytest.mark.slow
def test_a_damaged_chunk_of_the_spectrum_is_noticed_and_computed_again(
    store: Path,
    right: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        before(patch, "focus_blocks", lambda: overwrite(chunk_of(run / "spectrum.zarr" / "spectrum")), lambda: None)
        with pytest.raises(ProcessingError, match=r"no longer has the checksum of its receipt.* goes on from there"):
            blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    report = blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    assert checksum(run) == right
    assert any("damaged and computed again" in line for line in report.summary)


@pytest.mark.slow
def test_a_damaged_chunk_of_a_gated_spectrum_is_noticed_and_computed_again(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Range sub-blocks read what range gates have kept for them; only what is damaged is gated again."""
    real = chain.plan_collection
    monkeypatch.setattr(chain, "plan_collection", lambda *args, **how: real(*args, **how | {"parts": 2}))
    run, settings = tmp_path / "run", {"blocks": 2, "grid": GRID, "workers": 0}
    whole = blocksar.focus(store, tmp_path / "whole", **settings)
    assert whole.result["plan"]["parts"] == 2 and "gate" in whole.result["timings"]
    gated = run / "gated" / "spectrum-1.0.zarr" / "spectrum"
    with monkeypatch.context() as patch:
        before(patch, "focus_blocks", lambda: overwrite(chunk_of(gated)), lambda: None)
        with pytest.raises(
            ProcessingError, match=r"spectrum-1\.0\.zarr no longer has the checksum .* goes on from there"
        ):
            blocksar.focus(store, run, **settings)
    report = blocksar.focus(store, run, **settings)
    assert any("damaged and computed again" in line for line in report.summary)
    receipts = [r for r in report.result["receipts"] if r["stage"] == "gate"]
    assert [r.get("damaged", False) for r in receipts].count(True) == 1 < len(receipts)
    assert all(r.get("reused", False) != r.get("damaged", False) for r in receipts)
    assert checksum(run) == checksum(tmp_path / "whole")
    assert not (run / "gated").exists()


@pytest.mark.slow
def test_a_chunk_of_a_patch_that_is_lost_is_noticed(
    store: Path, right: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        before(patch, "mosaic", lambda: os.unlink(chunk_of(run / "patches" / "0" / "image")), lambda: None)
        with pytest.raises(ProcessingError, match="no longer has the checksum of its receipt"):
            blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    assert checksum(run) == right


# ---------------------------------------------------------------- the run folder


@pytest.fixture(scope="module")
def interrupted(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the original that was interrupted before its mosaic."""

    def interrupt(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    run = tmp_path_factory.mktemp("interrupted") / "run"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupt)
        blocksar.focus(original, run, blocks=2, grid=GRID, workers=0)
    return run


@pytest.fixture
def unfinished(interrupted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(interrupted, tmp_path / "run"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


@pytest.mark.parametrize("plan", [{"blocks": None}, {"blocks": 2.5}, {"blocks": 3}, {"parts": 10**9}, {"parts": "two"}])
def test_a_plan_that_was_altered_is_refused(plan: dict[str, Any], original: Path, unfinished: Path) -> None:
    record = json.loads((unfinished / "run.json").read_text())
    (unfinished / "run.json").write_text(json.dumps(record | {"plan": record["plan"] | plan}))
    before = contents(unfinished)
    with pytest.raises(InputError, match=r"run\.json.*overwrite=True"):
        blocksar.focus(original, unfinished, blocks=2, grid=GRID, workers=0)
    assert contents(unfinished) == before


def test_a_run_without_its_record_can_be_begun_again(original: Path, right: str, unfinished: Path) -> None:
    (unfinished / "run.json").unlink()
    with pytest.raises(InputError, match=r"unfinished run without its run\.json; use overwrite=True"):
        blocksar.focus(original, unfinished, blocks=2, grid=GRID, workers=0)
    blocksar.focus(original, unfinished, blocks=2, grid=GRID, workers=0, overwrite=True)
    assert checksum(unfinished) == right


ALTERED: list[dict[str, Any]] = [
    {"files": {"/dev/zero": "00"}},
    {"files": {"../phase_history.zarr/zarr.json": "00"}},
    {"files": [1]},
    {"written": 7},
    {"written": [{"store": "/dev", "variable": "zero", "region": [[0, 1]], "checksum": "00"}]},
    {"written": [{"store": "spectrum.zarr", "variable": "spectrum", "region": [[0, 1e300]], "checksum": 1}]},
    {"origin": "here"},
    {"found": [None]},
]


@pytest.mark.slow
def test_receipts_that_were_altered_do_not_count(original: Path, right: str, unfinished: Path) -> None:
    """Even with seals that fit; each receipt of the run is altered in another way."""
    receipts = sorted((unfinished / "receipts").iterdir())
    assert len(receipts) >= len(ALTERED)
    for number, path in enumerate(receipts):
        change = ALTERED[number % len(ALTERED)]
        value = {name: item for name, item in json.loads(path.read_text()).items() if name != "seal"} | change
        path.write_text(json.dumps(value | {"seal": stores.json_checksum(value)}))
    blocksar.focus(original, unfinished, blocks=2, grid=GRID, workers=0)
    assert checksum(unfinished) == right


@pytest.mark.parametrize("name", ["run.lock", "patches", "receipts", "run.json", "autofocus"])
def test_symbolic_links_are_not_written_through(name: str, store: Path, tmp_path: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    run.mkdir()
    elsewhere.mkdir()
    (run / name).symlink_to(elsewhere / "file" if name == "run.lock" else elsewhere)
    with pytest.raises(InputError, match="is a symbolic link"):
        blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    assert list(elsewhere.iterdir()) == []


@pytest.mark.slow
def test_an_overwriting_that_cannot_move_the_old_run_leaves_it_whole(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a folder of another user."""
    run = tmp_path / "run"
    blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    before, rename = contents(run), os.rename

    def refusing(source: Any, target: Any) -> None:
        if os.path.basename(source) == "patches" and ".replaced" in str(target):
            raise PermissionError(13, "Permission denied")
        rename(source, target)

    monkeypatch.setattr(os, "rename", refusing)
    with pytest.raises(InputError, match=r"patches cannot be moved \(Permission denied\)"):
        blocksar.focus(store, run, blocks=1, grid=GRID, workers=0, overwrite=True)
    assert contents(run) == before
    assert "nothing to do" in blocksar.focus(store, run, blocks=2, grid=GRID, workers=0).summary[0]


def test_a_foreign_scratch_is_in_nobodys_way(original: Path, right: str, unfinished: Path) -> None:
    """With a local cluster, whose temporary files lie there."""
    (unfinished / "scratch").write_text("a file")
    blocksar.focus(original, unfinished, blocks=2, grid=GRID, workers=1)
    assert checksum(unfinished) == right


# ---------------------------------------------------------------- unusual input


@pytest.mark.slow
def test_a_finished_image_that_is_changed_afterwards_is_not_taken_for_the_run_s(original: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"blocks": 2, "grid": GRID, "workers": 0}
    blocksar.focus(original, tmp_path / "run", **settings)
    for file in (tmp_path / "run" / "image.zarr").rglob("*"):  # as a copy of the folder may have them
        os.utime(file, ns=(time.time_ns() + 10**9,) * 2)
    assert "nothing to do" in blocksar.focus(original, tmp_path / "run", **settings).summary[0]
    for variable in ("image", "block"):
        chunk = chunk_of(tmp_path / "run" / "image.zarr" / variable)
        kept = chunk.read_bytes()
        os.unlink(chunk)  # which may share storage with others
        chunk.write_bytes(kept[:-8] + bytes([kept[-8] ^ 1]) + kept[-7:])
        os.utime(chunk, ns=(time.time_ns() + 10**9,) * 2)
        with pytest.raises(FolderError, match=rf"its image has 1 file that changed since \(first: {variable}/c/"):
            blocksar.focus(original, tmp_path / "run", **settings)
        chunk.write_bytes(kept)
    assert "nothing to do" in blocksar.focus(original, tmp_path / "run", **settings).summary[0]


@pytest.mark.parametrize(
    ("processor", "shape"), [("angular-division", (1, 1)), ("angular-division", (1, 40)), ("backprojection", (1, 1))]
)
def test_a_row_or_a_pixel_is_an_image(shape: tuple[int, int], processor: Any, store: Path, tmp_path: Path) -> None:
    grid = ((15900.0, 15900.0 + 4 * shape[1], 4.0), (19000.0, 19000.0 + 4 * shape[0], 4.0))
    blocksar.focus(store, tmp_path / "run", processor=processor, blocks=1, grid=grid, workers=0)
    assert blocksar.open(tmp_path / "run").image.shape == shape


def rewrite(store: Path, name: str, values: Any) -> None:
    shutil.rmtree(store / name)
    zarr.create_array(store / name, data=values, chunks=values.shape, dimension_names=(DIMENSIONS[name],))


DIMENSIONS = {"time": "pulse", "range_frequency": "range_frequency"}


@pytest.mark.parametrize(("name", "scale"), [("time", 1e-30), ("time", 1e300), ("range_frequency", 1e-300)])
@pytest.mark.filterwarnings("error")
def test_axes_of_impossible_scale_are_refused(name: str, scale: float, store: Path, tmp_path: Path) -> None:
    values = stores.read_region(store, name, (slice(None),)) * scale
    values = np.arange(values.size) * scale if not np.isfinite(values).all() else values
    rewrite(store, name, values)
    with pytest.raises(InputError, match=name):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)


def test_a_coordinate_that_expands_is_refused_before_it_is_read(store: Path, tmp_path: Path) -> None:
    shutil.rmtree(store / "time")
    huge = zarr.create_array(
        store / "time", shape=(400_000_000,), chunks=(400_000_000,), dtype="float64", dimension_names=("pulse",)
    )
    assert huge.nbytes > 3e9
    (store / "time" / "c").mkdir()
    (store / "time" / "c" / "0").write_bytes(b"whatever it is")
    with pytest.raises(InputError, match=r"time claims the shape \(400000000,\)"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)
    small = zarr.create_array(
        store / "time", shape=(100,), chunks=(400_000_000,), dtype="float64", dimension_names=("pulse",), overwrite=True
    )
    assert small.nbytes == 800
    with pytest.raises(InputError, match="time has chunks of"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, workers=0)


def test_old_metadata_beside_the_new_says_nothing(store: Path, tmp_path: Path) -> None:
    (store / ".zgroup").write_text('{"zarr_format": 2}')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stores.open_phase_history(store)


@pytest.mark.parametrize("endpoint", ["http//no", "http://[::1", "http://me:secret@host:9000"])
def test_a_malformed_endpoint_is_refused_and_not_repeated(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(InputError, match="AWS_ENDPOINT_URL") as refused:
        stores.open_phase_history("s3://bucket/ph.zarr")
    assert "secret" not in str(refused.value)


def test_a_script_without_the_guard_is_told_at_once(store: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    call = f"blocksar.focus({str(store)!r}, {str(tmp_path / 'run')!r}, blocks=1, grid={GRID!r}, workers=1)\n"
    script.write_text(f"import blocksar\ndef main():\n    {call}\nmain()\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and not (tmp_path / "run").exists()
    last = done.stderr.strip().splitlines()[-1]
    assert "script.py, line 5: workers import this script" in last and "__main__" in last and last.endswith("workers=0")
