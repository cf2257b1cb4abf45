"""What gets its final name is on the disk by then: a loss of power leaves nothing that only looks complete."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from arrays import arrays
from scenes import scene

import blocksar
from blocksar import stores
from blocksar.errors import ProcessingError
from blocksar.places import place
from blocksar.places.local import LocalPlace


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The order in which file systems and files are flushed, and things get their names."""
    told: list[str] = []

    def telling(words: Callable[..., str], call: Callable[..., object]) -> Callable[..., object]:
        def told_of(*arguments: object, **options: object) -> object:
            told.append(words(*arguments))
            return call(*arguments, **options)

        return told_of

    monkeypatch.setattr(LocalPlace, "settle", telling(lambda _: "flush", LocalPlace.settle))
    monkeypatch.setattr(os, "fsync", telling(lambda _: "flush", os.fsync))
    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, telling(lambda _, target: Path(target).name, getattr(os, name)))
    return told


@pytest.mark.slow
def test_stores_are_flushed_before_they_get_their_names(tmp_path: Path, events: list[str]) -> None:
    dataset, text = blocksar.collection(**arrays()), tmp_path / "scene.toml"
    text.write_text(scene())
    for name, make in {
        "simulated.zarr": lambda out: blocksar.simulate(text, out),
        "a.cphd": lambda out: blocksar.simulate(text, out, cphd=True),
        "ingested.zarr": lambda out: blocksar.ingest("cphd", tmp_path / "a.cphd", out),
        "written.zarr": lambda out: blocksar.write(dataset, out),
    }.items():
        make(tmp_path / name)
        assert events[events.index(name) - 1] == "flush", name


def test_stores_that_are_filled_later_are_flushed_by_their_run(tmp_path: Path, events: list[str]) -> None:
    axes = {"doppler": np.arange(4.0), "range_frequency": np.arange(4.0)}
    stores.create(
        tmp_path / "spectrum.zarr", stores.SPECTRUM, sizes={}, coords=axes, variables={"lit": np.zeros(4)}, attrs={},
        chunks={},
    )  # fmt: skip
    assert events == ["spectrum.zarr"]
    stores.publish(place(tmp_path / "spectrum.zarr"), place(tmp_path / "published.zarr"), overwrite=False)
    assert events[1] == "flush" and events[-1] == "published.zarr"


def test_a_store_that_cannot_be_flushed_does_not_come_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: LocalPlace) -> None:
        raise OSError(5, "Input/output error")

    dataset = blocksar.collection(**arrays())
    monkeypatch.setattr(LocalPlace, "settle", fail)
    with pytest.raises(ProcessingError, match=r"a\.zarr cannot be written \(Input/output error\); see to the disk"):
        blocksar.write(dataset, tmp_path / "a.zarr")
    assert not os.listdir(tmp_path)
