"""Removing the intermediate stores of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import small_run
from arrays import arrays

import blocksar
from blocksar.errors import ProcessingError
from blocksar.places import place
from blocksar.processors.chain.tasks import stages
from blocksar.runs import folder as run_folder


def test_an_image_outlives_the_spectrum_and_the_patches(tmp_path: Path) -> None:
    run = small_run.make(tmp_path / "run")
    for name in (*run_folder.INTERMEDIATE, "segments/1/spectrum.zarr"):
        (run.folder / name / "part").mkdir(parents=True)
    before = {path.name for path in run.folder.iterdir()}
    run_folder.discard_intermediate(place(run.folder))
    assert before - {path.name for path in run.folder.iterdir()} == set(run_folder.INTERMEDIATE)
    assert not list((run.folder / "segments" / "1").iterdir())
    assert set(run_folder.INTERMEDIATE) <= set(run_folder.OWN)
    assert len(blocksar.quality(run.folder).result["targets"]) == 4


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def image(folder: Path) -> bytes:
    return bytes(blocksar.open(folder)["image"].values.tobytes())


@pytest.mark.slow
def test_a_run_that_discards_them_makes_the_same_image_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {"grid": "-30:30:1,-30:30:1", "blocks": 2, "workers": 0}
    blocksar.write(blocksar.collection(**arrays()), tmp_path / "ph.zarr")
    source = tmp_path / "ph.zarr"
    kept, discarded = tmp_path / "kept", tmp_path / "discarded"
    blocksar.focus(source, kept, **settings)

    merge = stages.mosaic

    def fail(*_: Any) -> Any:
        raise ProcessingError("the power fails")

    monkeypatch.setattr(stages, "mosaic", fail)
    with pytest.raises(ProcessingError):
        blocksar.focus(source, discarded, **settings, discard=True)
    assert not list(discarded.rglob("spectrum.zarr")) and "patches" in names(discarded)
    monkeypatch.setattr(stages, "mosaic", merge)
    resumed = blocksar.focus(source, discarded, **settings, discard=True)
    assert resumed.summary[0].startswith("went on") and "damaged" not in resumed.summary[0]
    assert not {"spectrum.zarr", "patches"} & {path.name for path in discarded.rglob("*")}
    assert image(discarded) == image(kept)
    # A finished run does not lose its image, and one that kept them may lose them later.
    blocksar.focus(source, kept, **settings, discard=True)
    assert not {"spectrum.zarr", "patches"} & {path.name for path in kept.rglob("*")} and image(kept) == image(
        discarded
    )
