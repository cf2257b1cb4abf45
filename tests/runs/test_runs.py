"""Runs: they resume after an interruption, refuse wrong input, and never leave a partial result."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from distributed import Client
from quality_bar import coarse_grid
from scenes import one_target, scene, write_store

import blocksar
from blocksar import stores
from blocksar.application import jobs
from blocksar.application.run_stages import any_covered
from blocksar.collection.geometry import Geometry
from blocksar.errors import FolderError, InputError, ProcessingError
from blocksar.graph import units
from blocksar.places import place
from blocksar.planning import stage_memory as memory
from blocksar.processors.chain.steps import step
from blocksar.processors.chain.tasks import blocks as tasks
from blocksar.processors.chain.tasks import stages
from blocksar.runs import folder
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written
from blocksar.simulation.scene import Scene

GRID = ((15900.0, 16300.0, 4.0), (19000.0, 19400.0, 4.0))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return one_target(tmp_path_factory.mktemp("small"))


def checksum(run: Path) -> str:
    return stores.checksum(blocksar.open(run).image.values)


def test_a_finished_run_is_not_computed_again(store: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    blocksar.focus(store, run, blocks=3, grid=GRID, workers=0)
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.is_file()}
    report = blocksar.focus(store, run, blocks=3, grid=GRID, workers=0)
    assert "nothing to do" in report.summary[0]
    assert before == {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match=r"blocks 3.*overwrite=True"):
        blocksar.focus(store, run, blocks=2, grid=GRID, workers=0)
    (run / "report.html").write_text("of the run before")
    blocksar.focus(store, run, blocks=2, grid=GRID, workers=0, overwrite=True)
    assert not (run / "report.html").exists()
    assert json.loads((run / "run.json").read_text())["plan"]["blocks"] == 2


def test_an_interrupted_run_resumes(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    settings: dict[str, Any] = {"blocks": 3, "grid": coarse_grid(store), "client": client}
    blocksar.focus(store, tmp_path / "whole", **settings)
    with monkeypatch.context() as patch:
        patch.setattr(stages, "mosaic", interrupted)
        with pytest.raises(KeyboardInterrupt):
            blocksar.focus(store, tmp_path / "run", **settings)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["status"] == "unfinished"
    done = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "run" / "receipts").iterdir()}
    assert done
    with pytest.raises(InputError, match="not finished"):
        blocksar.quality(tmp_path / "run")
    computed: list[str] = []
    submit = client.submit
    monkeypatch.setattr(client, "submit", lambda f, *a, **k: computed.append(k["key"]) or submit(f, *a, **k))
    report = blocksar.focus(store, tmp_path / "run", **settings)
    made = [key for key in computed if not key.startswith("verify-")]
    assert made and not any(name.removesuffix(".json") in key for key in made for name in done)
    assert "went on from an unfinished run" in report.summary[0]
    assert checksum(tmp_path / "run") == checksum(tmp_path / "whole")
    assert not (tmp_path / "run" / "receipts").exists()


def test_a_failed_task_is_named_in_the_error(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = stages.focus_blocks

    def sabotaged(*args: Any, **keywords: Any) -> Any:
        shutil.rmtree(tmp_path / "run" / "spectrum.zarr")
        return real(*args, **keywords)

    monkeypatch.setattr(stages, "focus_blocks", sabotaged)
    with pytest.raises(ProcessingError, match=r"read-slab\+residual-walk\+keystone of block 1 failed: .*spectrum"):
        blocksar.focus(store, tmp_path / "run", blocks=3, grid=GRID, workers=0)
    assert (tmp_path / "run" / "receipts").exists()


@pytest.mark.slow
def test_samples_that_workers_cannot_read_are_wrong_input(store: Path, client: Client, tmp_path: Path) -> None:
    bad = damaged(store, tmp_path)
    for chunk in (bad / "signal" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(chunk.read_bytes()[:-8])
    with pytest.raises(InputError, match=r"signal .*damaged"):
        blocksar.focus(bad, tmp_path / "run", blocks=1, grid=GRID, client=client)
    assert not (tmp_path / "run").exists()


def test_a_given_scheduler_is_used_and_left_running(store: Path, client: Client, tmp_path: Path) -> None:
    address = client.scheduler.address
    report = blocksar.focus(store, tmp_path / "run", blocks=2, grid=GRID, scheduler=address, threads=1)
    assert report.result["workers"] == len(client.nthreads())
    assert client.submit(lambda: 1).result() == 1
    with pytest.raises(InputError, match="no dask scheduler"):
        blocksar.focus(store, tmp_path / "other", grid=GRID, scheduler="nowhere:1:2")


def test_task_keys_name_step_and_block(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys: list[str] = []
    submit = client.submit
    monkeypatch.setattr(client, "submit", lambda f, *a, **k: keys.append(k["key"]) or submit(f, *a, **k))
    report = blocksar.focus(store, tmp_path / "run", blocks=3, grid=GRID, client=client)
    run = Run(folder=place(tmp_path / "run"), identity=report.result["identity"], threads=1).token
    azimuth = "time-perturbation+azimuth-fft+frequency-perturbation+deramp+doppler-fft"
    names = ["read-slab+residual-walk+keystone", "rcmc-src", azimuth, "geometric-correction"]
    assert [k for k in keys if "block-1" in k] == [f"{stage}-{run}-block-1" for stage in names]
    assert len(set(keys)) == len(keys)
    # The receipt of a block covers all its tasks.
    receipt = next(r for r in report.result["receipts"] if r["unit"] == "block-1")
    assert receipt["seconds"] >= 0.999 * sum(receipt["steps"].values())


def test_a_memory_limit_too_small_for_a_raw_echo_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene.toml").write_text(scene(swath=[29900.0, 30100.0]))
    raw = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "raw.zarr", raw=True)
    history = stores.open_phase_history(raw)
    needed = memory.compression_memory(history.collection, history.raw)
    monkeypatch.setattr(jobs, "compression_memory", lambda *_: 40 * needed)
    with pytest.raises(InputError, match=r"memory limit 2048 MiB a worker is too low: range compression needs about"):
        blocksar.focus(raw, tmp_path / "run", blocks=1, grid=GRID, workers=1, memory_limit=2 * 2**30)
    assert not (tmp_path / "run").exists()  # the cluster that was starting meanwhile has left nothing


def damaged(store: Path, folder: Path, **replace: Any) -> Path:
    """Copy the store with arrays or attributes replaced, or removed where the value is None."""
    copy = folder / "damaged.zarr"
    shutil.copytree(store, copy)
    group = zarr.open_group(str(copy), mode="r+")
    for name, value in replace.items():
        if name in ("carrier_frequency", "beam_width"):
            group.attrs[name] = value
        elif value is None:
            shutil.rmtree(copy / name)
        else:
            group[name][...] = value  # type: ignore[index]
    metadata = json.loads((copy / "zarr.json").read_text())
    metadata.pop("consolidated_metadata", None)
    (copy / "zarr.json").write_text(json.dumps(metadata))
    return copy


@pytest.mark.slow
def test_peak_memory_is_that_of_the_process() -> None:
    """A small process started by a large one does not report its parent's peak."""
    ballast = np.ones(400 * 2**20, np.uint8)
    script = "from blocksar.graph.units import peak_memory; print(peak_memory())"
    child = int(subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout)
    assert units.peak_memory() > ballast.size
    assert child < ballast.size


def test_a_block_from_another_worker_gives_the_same_result(store: Path, tmp_path: Path) -> None:
    """Arrays received from another worker are read-only, although a stage works in place."""
    block = blocksar.plan(store, blocks=3).result.blocks[1]
    stage = step.stages(block.chain)[1]
    rng = np.random.default_rng(2)
    shape = (max(stage.program.source.size, stage.program.target.size), stage.program.n_row)
    samples = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    fixed = samples.copy()
    fixed.flags.writeable = False
    run = Run(folder=place(tmp_path), identity="x", threads=1)
    here = tasks.run_stage(run, "", tasks.BlockSamples(samples, {}), block, stage)
    there = tasks.run_stage(run, "", tasks.BlockSamples(fixed, {}), block, stage)
    assert here.values is samples
    np.testing.assert_array_equal(here.values, there.values)


@pytest.mark.slow
def test_a_task_of_a_replaced_run_writes_nothing(store: Path, tmp_path: Path) -> None:
    """A given cluster may still run tasks of a dead process while --overwrite has started another run."""
    run = tmp_path / "run"
    blocksar.focus(store, run, blocks=3, grid=GRID, workers=0)
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.is_file()}
    orphan = Run(folder=place(run), identity="0" * 32, threads=1)
    values = np.zeros((64, 64), np.complex64)
    with pytest.raises(ProcessingError, match="taken by another run"):
        write(orphan, orphan.image, "image", (slice(0, 64), slice(0, 64)), values)
    assert before == {p: p.stat().st_mtime_ns for p in run.rglob("*") if p.is_file()}


TARGET = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n'
FAR = '[[targets]]\nname = "Q"\nrange = 30100.0\nyaw_deg = 51.0\namplitude = 0.5\n'


def changed(store: Path, folder: Path, variable: str, change: Any) -> Path:
    """Copy the store and apply a function to its samples."""
    shutil.copytree(store, folder / "changed.zarr")
    samples = zarr.open_array(str(folder / "changed.zarr" / variable), mode="r+")
    samples[...] = change(np.array(samples[...]))
    return folder / "changed.zarr"


def lose(signal: Any) -> Any:
    signal[1000:1010] = np.nan
    signal[:, 100:103] = np.inf
    signal[2000, 7] = 1e30
    return signal


@pytest.mark.parametrize("processor", ["angular-division", "backprojection"])
def test_missing_and_impossible_samples_count_as_not_lit_and_are_reported(
    processor: Any, store: Path, tmp_path: Path
) -> None:
    point = ground(30000.0, 50.0)
    grid = tuple((at - 12.0, at + 12.0, 1.0) for at in point)
    bad = changed(store, tmp_path, "signal", lose)
    settings: dict[str, Any] = {"blocks": 3, "grid": grid, "workers": 0, "processor": processor}
    report = blocksar.focus(bad, tmp_path / "run", **settings)
    n = stores.open_phase_history(bad).collection.n_range_frequency
    whole, more = 10, 3 * (3200 - 10)
    assert report.summary[:2] == [
        f"note: {whole} of 3200 pulses are missing, {more} more samples are not numbers: counted as not lit",
        "note: 1 sample stands 100-fold above its neighbours: counted as not lit",
    ]
    assert report.result["samples"] == {"missing": whole * n + more, "impossible": 1}
    image = blocksar.open(tmp_path / "run")
    assert json.loads(image.attrs["warnings"]) == [line.removeprefix("note: ") for line in report.summary[:2]]
    blocksar.focus(store, tmp_path / "clean", **settings)
    np.testing.assert_allclose(image.image.values, blocksar.open(tmp_path / "clean").image.values, atol=0.02)
    assert np.abs(image.image.values).max() == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_a_track_that_does_not_match_the_samples_is_reported(tmp_path: Path) -> None:
    store = write_store(tmp_path, swath=[29700.0, 30300.0], more=TARGET)
    collection = stores.open_phase_history(store).collection
    wrong = collection.antenna_position + collection.time[:, None] * np.array([0.0, 60.0, 0.0])
    bad = damaged(store, tmp_path, antenna_position=wrong)
    report = blocksar.focus(bad, tmp_path / "run", blocks=3, grid=GRID, workers=0)
    assert any("measured Doppler centroid" in line and "Hz" in line for line in report.summary)
    report = blocksar.focus(store, tmp_path / "right", blocks=3, grid=GRID, workers=0)
    assert not report.result["warnings"]


@pytest.mark.slow
def test_a_saturated_echo_with_a_gap_is_reported(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scene(swath=[29900.0, 30100.0], more=TARGET + FAR))
    raw = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "raw.zarr", raw=True)

    def clip(echo: Any) -> Any:
        echo[500, 30:40] = np.nan
        level = 0.9 * np.float32(max(np.nanmax(echo.real), np.nanmax(echo.imag)))
        return np.clip(echo.real, -level, level) + 1j * np.clip(echo.imag, -level, level)

    report = blocksar.focus(changed(raw, tmp_path, "echo", clip), tmp_path / "run", blocks=3, grid=GRID, workers=0)
    said = " ".join(report.result["warnings"])
    assert "gaps in 1 pulse: these are divided" in said and "saturated" in said


def ground(rng: float, yaw_deg: float) -> tuple[float, float]:
    geometry = Geometry(collection=Scene.read("table1").collection().centred())
    point = geometry.ground_point(np.array(rng), np.array(np.radians(yaw_deg)))
    return float(point[0]), float(point[1])


def test_a_changed_receipt_is_not_accepted(tmp_path: Path) -> None:
    run = Run(folder=place(tmp_path), identity="x", threads=1)
    steps = {"b": 1.5, "a": np.float64(2)}
    signed = run.sign(Receipt(unit="block-1", stage="focus", origin=(17, 4), found={"x": np.nan}, steps=steps), 0.0)
    assert run.receipt("block-1") == replace(signed, found={"x": None})
    file = tmp_path / "receipts" / "block-1.json"
    file.write_text(file.read_text().replace("17", "16"))
    assert run.receipt("block-1") is None


@pytest.mark.slow
def test_receipts_of_a_run_killed_at_its_very_end_are_removed(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, settings = tmp_path / "run", {"blocks": 3, "grid": GRID, "workers": 0}
    blocksar.focus(store, run, **settings)  # type: ignore[arg-type]
    for first_looks in (0, 1):  # 1: another process finishes the run while this one waits for the folder
        (run / "receipts").mkdir()
        real, looks = folder.find_run, iter([None] * first_looks)
        monkeypatch.setattr(folder, "find_run", lambda *a, r=real, i=looks, **k: next(i, r(*a, **k)))
        assert "nothing to do" in blocksar.focus(store, run, **settings).summary[0]  # type: ignore[arg-type]
        assert not (run / "receipts").exists()
        monkeypatch.undo()


@pytest.mark.parametrize("left", [[], ["dask-scratch-space"]])
def test_a_run_that_was_killed_while_it_was_planned_begins_again(tmp_path: Path, left: list[str]) -> None:
    """Its workers, which start meanwhile, left their folder; what else lies in one of that name is foreign."""
    run, file = tmp_path / "run", tmp_path / "file"
    for path in (run / "scratch", file, *(run / "scratch" / name / "worker-1" for name in left)):
        path.mkdir(parents=True)
    (run / "run.lock").write_text("")
    assert folder.find_run(place(run), {}, "", overwrite=False) is None
    (run / "scratch" / "kept").write_text("")
    (file / "scratch").write_text("")
    for foreign in (run, file):
        with pytest.raises(FolderError, match=r"holds no run of blocksar \(but scratch\)"):
            folder.find_run(place(foreign), {}, "", overwrite=False)


class Killed(BaseException):
    """Ends a process where it is, as far as what it leaves on the disk is concerned."""


@pytest.mark.slow
def test_an_overwrite_that_was_killed_while_it_moved_the_earlier_run_can_be_given_again(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {"coefficients": "closed-form", "grid": GRID, "workers": 0}
    run, rename, done = tmp_path / "run", os.rename, []

    def rename_some(source: str, target: str) -> None:
        if ".replaced" in str(target):
            if len(done) == 3:
                raise Killed
            done.append(source)
        rename(source, target)

    blocksar.focus(store, run, blocks=1, **settings)
    monkeypatch.setattr(os, "rename", rename_some)
    with pytest.raises(Killed):
        blocksar.focus(store, run, blocks=2, overwrite=True, **settings)
    monkeypatch.setattr(os, "rename", rename)
    blocksar.focus(store, run, blocks=2, overwrite=True, **settings)
    assert blocksar.info(run).result["facts"]["state"].startswith("finished")
    assert not (run / ".replaced").exists()


@pytest.mark.slow
def test_an_overwrite_that_was_interrupted_keeps_the_earlier_run_until_the_input_is_read_and_goes_on(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Given again, it repeats nothing that is done; if the input is then wrong, the earlier run is there again."""

    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    def wrong(*_: Any, **__: Any) -> Any:
        raise InputError("wrong")

    run = tmp_path / "run"
    settings: dict[str, Any] = {"coefficients": "closed-form", "grid": GRID, "workers": 0}
    again: dict[str, Any] = settings | {"blocks": 2, "overwrite": True}
    blocksar.focus(store, run, blocks=1, **settings)
    before = checksum(run)
    for ending, error in ((interrupted, KeyboardInterrupt), (wrong, InputError)):
        with monkeypatch.context() as patch, pytest.raises(error):
            patch.setattr(stages, "recover", ending)
            blocksar.focus(store, run, **again)
    assert checksum(run) == before
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        blocksar.focus(store, run, **again)
    assert not (run / ".replaced").exists()
    assert "would go on" in " ".join(blocksar.focus(store, run, dry_run=True, **again).summary)
    assert "2 of 2 blocks" in blocksar.focus(store, run, **again).summary[0]


def test_an_image_without_a_covered_pixel_is_told_apart() -> None:
    """All of its chunks are the fill value, and none is written; patches are another store."""
    patch, pixels, block = (
        Receipt(unit="u", stage="focus", written=(Written(store, name, ((0, 4), (0, 4)), ""),))
        for store, name in (("patches/0.zarr", "image"), ("image.zarr", "image"), ("image.zarr", "block"))
    )
    assert any_covered([patch, pixels, block], "image.zarr")
    assert not any_covered([patch, block], "image.zarr")
