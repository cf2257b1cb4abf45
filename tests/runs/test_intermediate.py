"""Removing the intermediate stores of a finished run."""

from __future__ import annotations

from pathlib import Path

import small_run

import blocksar
from blocksar.places import place
from blocksar.runs import folder as run_folder


def test_an_image_outlives_the_spectrum_and_the_patches(tmp_path: Path) -> None:
    run = small_run.make(tmp_path / "run")
    for name in run_folder.INTERMEDIATE:
        (run.folder / name / "part").mkdir(parents=True)
    before = {path.name for path in run.folder.iterdir()}
    run_folder.discard_intermediate(place(run.folder))
    assert before - {path.name for path in run.folder.iterdir()} == set(run_folder.INTERMEDIATE)
    assert set(run_folder.INTERMEDIATE) <= set(run_folder.OWN)
    assert len(blocksar.quality(run.folder).result["targets"]) == 4
