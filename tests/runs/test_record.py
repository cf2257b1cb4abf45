"""Records of runs: conversion to JSON and back, messages for damaged fields, and records of older versions."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blocksar.errors import FolderError, InputError, PrfTooLow
from blocksar.places import place
from blocksar.runs import folder
from blocksar.runs.finished import FinishedRun, finished_record
from blocksar.runs.record import FORMAT, RunInput, RunPlan, RunRecord, Written, block_unit
from blocksar.version import __version__

SETTINGS = {"processor": "angular-division", "blocks": 2, "grid": None}
BLOCK = {
    "block": 0, "part": 1, "yaw": [0.5, 0.75], "range": [1e4, 2e4], "memory": 5, "bias": 0.25, "residual_phase": 0.1,
    "quadratic_phase": 0.05, "pslr": -13.3, "width": 1.01, "migration": 0.125, "resolution": 0.5,
    "track_phase": 0.0, "coherence": 0.99, "phase_loss": 0.004, "range_loss": 0.003, "dispersion_loss": 0.002,
    "track_loss": 0.001, "ideal_pslr": -13.2615,
}  # fmt: skip
WRITTEN = {"store": "image.zarr", "variable": "image", "region": [[0, 4], [8, 12]], "checksum": "ab"}
RECEIPTS = [
    {"run": "id", "unit": "columns-0", "stage": "recover", "seconds": 1.5, "written": [WRITTEN], "peak_memory": 7,
     "found": {"n_pulse": 3}, "reused": True},
    {"run": "id", "unit": "block-0.1", "stage": "focus", "seconds": 2.0, "written": [], "origin": [3, 4],
     "steps": {"rcmc-src": 0.5}, "damaged": True},
]  # fmt: skip
RECORD: dict[str, Any] = {
    "format": FORMAT,
    "status": "finished",
    "settings": SETTINGS,
    "input": {"path": "ph.zarr", "fingerprint": "f"},
    "identity": "id",
    "versions": {"blocksar": __version__, "numpy": "2"},
    "workers": 2,
    "threads": 1,
    "memory_limit": 1 << 31,
    "plan": {"blocks": 1, "parts": 2, "memory": 9, "grid": [0.0, 1.0, 0.5, 0.0, 1.0, 0.5], "predicted": [BLOCK]},
    "warnings": ["3 samples are missing"],
    "samples": {"missing": 3, "impossible": 0},
    "doppler_centroid": {"error": -1.5, "coherence": 0.5},
    "receipts": RECEIPTS,
    "timings": {"recover": 1.5, "total": 4.0},
    "peak_memory": 7,
}


def changed(*keys: str | int, value: Any) -> dict[str, Any]:
    """Return the record with one field replaced."""
    record: Any = copy.deepcopy(RECORD)
    entry = record
    for key in keys[:-1]:
        entry = entry[key]
    entry[keys[-1]] = value
    return dict(record)


def write(path: Path, record: Any) -> Path:
    path.mkdir()
    (path / "run.json").write_text(json.dumps(record))
    return path


# JSON


def test_a_record_survives_conversion_to_json_and_back() -> None:
    record = RunRecord.from_json(RECORD)
    assert json.loads(json.dumps(record.as_json())) == RECORD
    assert RunRecord.from_json(json.loads(json.dumps(record.as_json()))) == record
    assert record.plan.predicted[0].name == "0.1" and replace(record.plan.predicted[0], part=None).name == "0"
    assert record.receipts[1].unit == block_unit("0.1")
    assert record.receipts[0].written == (Written("image.zarr", "image", ((0, 4), (8, 12)), "ab"),)
    assert pickle.loads(pickle.dumps(record)) == record


def test_an_unfinished_record_holds_no_results() -> None:
    record = replace(RunRecord.from_json(RECORD), status="unfinished")
    assert set(RECORD) - set(record.as_json()) == {
        "warnings", "samples", "doppler_centroid", "receipts", "timings", "peak_memory",
    }  # fmt: skip


def test_only_the_status_is_required() -> None:
    record = RunRecord.from_json({"status": "finished"})
    assert record.finished and record.version == "" and record.plan == RunPlan() and record.input == RunInput()
    assert RunRecord.from_json({"status": "finished", "plan": None, "receipts": None, "more": 1}) == record


def test_null_is_read_as_nan() -> None:
    block = RunRecord.from_json(changed("plan", "predicted", 0, "pslr", value=None)).plan.predicted[0]
    assert np.isnan(block.pslr)
    centroid = RunRecord.from_json(changed("doppler_centroid", "error", value=None)).doppler_centroid
    assert centroid is not None and np.isnan(centroid.error)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("status",), "done", r"status is 'done', not 'finished' or 'unfinished'"),
        (("format",), "four", r"format is 'four', not a number"),
        (("workers",), 0, r"workers is 0, not at least 1"),
        (("memory_limit",), float("inf"), r"memory_limit is inf, not a number"),
        (("plan", "blocks"), 10**400, r"plan.blocks is 1000.*, not a number"),
        (("plan", "predicted", 0, "yaw"), [1], r"plan.predicted\[0\].yaw\[1\] is missing"),
        (("samples",), {"missing": 1}, r"samples.impossible is missing"),
        (("receipts", 0, "unit"), None, r"receipts\[0\].unit is null, not a text"),
        (
            ("receipts", 0, "written", 0, "store"),
            "../image.zarr",
            r"receipts\[0\].written\[0\].store is '../image.zarr', not a path within the run",
        ),
        (("receipts", 0, "files"), {"/etc": "a"}, r"receipts\[0\].files./etc is '/etc', not a path within the run"),
        (
            ("receipts", 0, "written", 0, "region"),
            [[1, 2, 3]],
            r"receipts\[0\].written\[0\].region\[0\] is \[1, 2, 3\], not a list of 2",
        ),
        (("receipts", 0, "reused"), 1, r"receipts\[0\].reused is 1, not true or false"),
    ],
)
def test_a_damaged_field_is_named_with_its_remedy(
    keys: tuple[str | int, ...], value: Any, message: str, tmp_path: Path
) -> None:
    run = write(tmp_path / "run", changed(*keys, value=value))
    with pytest.raises(
        FolderError, match=rf"run.json is damaged: {message}.*; focus again with --overwrite$"
    ) as caught:
        FinishedRun.open(place(run))
    assert caught.value.replaceable and "\n" not in str(caught.value) and len(str(caught.value)) < 500
    with pytest.raises(FolderError) as caught:
        folder.find_run(place(run), SETTINGS, "f", overwrite=False)
    assert caught.value.replaceable
    assert folder.find_run(place(run), SETTINGS, "f", overwrite=True) is None


@pytest.mark.parametrize("record", [[], 1, None, "text", {}])
def test_json_that_is_not_a_record_is_refused(record: Any, tmp_path: Path) -> None:
    with pytest.raises(FolderError, match=r"is damaged: .*; focus again with --overwrite"):
        finished_record(place(write(tmp_path / "run", record)))


# Formats and versions


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    run = write(tmp_path / "run", changed("format", value=FORMAT + 1))
    for read in (lambda: finished_record(place(run)), lambda: folder.find_run(place(run), {}, "", overwrite=False)):
        with pytest.raises(FolderError, match=rf"has format {FORMAT + 1}.*--overwrite") as caught:
            read()
        assert caught.value.replaceable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": FORMAT - 1}, rf"holds a run with format {FORMAT - 1}, not what"),
        ({"settings": SETTINGS | {"blocks": 3}}, "holds a run with blocks 3, not what"),
        ({"input": {"path": "ph.zarr", "fingerprint": "g"}}, "holds a run with another input, not what"),
        ({"status": "unfinished", "versions": {"blocksar": "0.1.0"}},
         rf"holds an unfinished run of blocksar 0\.1\.0, which {__version__} does not resume; use --overwrite"),
        ({"status": "unfinished", "versions": {}}, "holds an unfinished run of blocksar unknown"),
    ],
)  # fmt: skip
def test_a_run_with_other_settings_or_input_or_version_is_refused(change: Any, message: str, tmp_path: Path) -> None:
    run = write(tmp_path / "run", RECORD | change)
    with pytest.raises(FolderError, match=message) as caught:
        folder.find_run(place(run), SETTINGS, "f", overwrite=False)
    assert caught.value.replaceable


def test_a_finished_run_of_an_older_version_is_kept(tmp_path: Path) -> None:
    run = write(tmp_path / "run", RECORD | {"versions": {"blocksar": "0.1.0"}})
    record = folder.find_run(place(run), SETTINGS, "f", overwrite=False)
    assert record is not None and record.finished and record.version == "0.1.0"
    assert finished_record(place(run)) == record


@pytest.mark.parametrize(
    ("processor", "stages"),
    [
        ("angular-division", ["range-compress", "recover", "focus", "mosaic", ""]),
        ("backprojection", ["range-compress", "inspect", "focus", "backprojection", ""]),
    ],
)
def test_receipts_without_a_stage_get_one_from_their_unit(processor: str, stages: list[str]) -> None:
    units = ["pulses-0", "columns-256", "block-1.0", "chunk-0-2", "tea"]
    old = [{"run": "id", "unit": unit, "seconds": 1.0, "written": []} for unit in units]
    record = RunRecord.from_json(RECORD | {"receipts": old, "settings": {"processor": processor}})
    assert [receipt.stage for receipt in record.receipts] == stages


# Errors


@pytest.mark.parametrize("error", [PrfTooLow("too low\x1b", 1230.0), FolderError("held"), FolderError("other", True)])
def test_errors_can_be_pickled(error: InputError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error) and str(again) == str(error) and vars(again) == vars(error)
