"""Damaged runs and damaged files of targets."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bad_input import (
    CHAIN,
    EXACT,
    JSON,
    MANY,
    REPLACED,
    ROUNDING,
    Bench,
    flipped,
    listing,
    one_sentence,
    seeded,
    truncated,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import blocksar
from blocksar.errors import InputError, ProcessingError

# Damaged run records


RECORD_KEYS = [
    "format",
    "status",
    "settings",
    "input",
    "identity",
    "plan",
    "receipts",
    "timings",
    "workers",
    "versions",
]


@pytest.mark.slow
@settings(MANY, max_examples=20)
@given(key=st.sampled_from(RECORD_KEYS), value=JSON, wanted=st.sampled_from(["finished", "unfinished"]))
def test_false_records_of_runs(bench: Bench, key: str, value: Any, wanted: str) -> None:
    """A run with a false record is refused or computed again; it never gives a wrong image or a traceback."""
    run = bench.finished_run(**EXACT)
    record = json.loads((run / "run.json").read_bytes())
    (run / "run.json").write_text(json.dumps({**record, "status": wanted, key: value}))
    resume(bench, run, "records of runs")
    shutil.rmtree(run)


def resume(bench: Bench, run: Path, kind: str) -> None:
    before = listing(run)
    try:
        blocksar.focus(bench.store, run, workers=0, **EXACT)
    except (InputError, ProcessingError) as error:
        one_sentence(error)
        if isinstance(error, InputError):
            assert listing(run) == before, "refused, but the run was changed"
        outcome = "refused"
    else:
        assert bench.difference(run, **EXACT) <= ROUNDING
        outcome = "the clean image"
    bench.tally[kind, outcome] += 1


DAMAGED_RECORDS: dict[str, Callable[[Path], Any]] = {
    "empty": lambda file: file.write_bytes(b""),
    "half": lambda file: file.write_bytes(file.read_bytes()[:200]),
    "not JSON": lambda file: file.write_bytes(b"\xff\xfe\x00"),
    "a list": lambda file: file.write_text("[]"),
    "a number": lambda file: file.write_text("1"),
    "null": lambda file: file.write_text("null"),
    "an empty object": lambda file: file.write_text("{}"),
    "deep": lambda file: file.write_text("[" * 100_000),
    "huge": lambda file: file.write_bytes(file.read_bytes() + b" " * (65 << 20)),
    **{how: REPLACED[how] for how in REPLACED if how not in ("deleted", "empty", "a link to the file")},
}


@pytest.mark.parametrize("how", DAMAGED_RECORDS)
def test_damaged_records_are_refused(how: str, bench: Bench) -> None:
    run = bench.finished_run(**EXACT)
    DAMAGED_RECORDS[how](run / "run.json")
    before = listing(run)
    bench.refused("damaged records", blocksar.focus, bench.store, run, workers=0, **EXACT)
    bench.refused("damaged records", blocksar.quality, run)
    assert listing(run) == before


# Quality


MEASURED = [
    "run.json",
    "collection.zarr/zarr.json",
    "collection.zarr/time/c/0",
    "collection.zarr/antenna_position/zarr.json",
]
MEASURED += [f"image.zarr/{name}" for name in ("zarr.json", "x/zarr.json", "x/c/0", "image/zarr.json", "image/c/0/0")]


@pytest.mark.slow
def test_quality_of_damaged_runs(bench: Bench) -> None:
    """Damaged runs are refused or measured; damaged samples may change the figures, but nothing crashes."""

    def case(name: str, damage: Callable[[Path], Any]) -> None:
        run = bench.finished_run(**CHAIN)
        damage(run / name)
        try:
            blocksar.quality(run)
            outcome = "taken at its word"
        except (InputError, ProcessingError) as error:
            one_sentence(error)
            outcome = "refused"
        bench.tally["quality", outcome] += 1
        shutil.rmtree(run)

    cases: dict[str, Callable[[Path], Any]] = {
        "deleted": REPLACED["deleted"],
        "a pipe": REPLACED["a pipe"],
        "truncated": lambda file: truncated(file, seeded(file.name)),
        "flipped": lambda file: flipped(file, seeded(file.name)),
    }
    bench.all({f"{n} {how}": lambda n=n, d=d: case(n, d) for n in MEASURED for how, d in cases.items()})


@pytest.mark.slow
@settings(MANY, max_examples=25)
@given(value=st.one_of(JSON, st.lists(st.fixed_dictionaries({"name": JSON, "x": JSON, "y": JSON}), max_size=2)))
def test_arbitrary_targets(bench: Bench, value: Any) -> None:
    file = bench.fresh(".json")
    file.write_text(json.dumps(value))
    measure(bench, file)


def measure(bench: Bench, targets: Path) -> None:
    run = bench.run(**CHAIN)
    try:
        blocksar.quality(run, targets=targets)
        outcome = "taken at its word"
    except InputError as error:
        if targets.suffix != ".toml":
            one_sentence(error)
        outcome = "refused"
    bench.tally["targets", outcome] += 1


def test_the_number_and_outcomes_of_cases_are_as_expected(bench: Bench, request: pytest.FixtureRequest) -> None:
    bench.check_tally(request, 105, ("the clean image", "taken at its word", "refused"))
