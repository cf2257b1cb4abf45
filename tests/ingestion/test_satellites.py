"""Raw echoes of satellites, from files of the formats' layout: targets lie where they are on the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_satellites import GAIN, Radar, write_nisar, write_palsar

import blocksar
from blocksar import stores
from blocksar.collection.georeference import Georeference

RADARS = {"nisar": Radar(side=-1), "palsar": Radar()}


@pytest.fixture(scope="module", params=list(RADARS))
def image(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Radar, Path]:
    """A run over the targets, and what it is of."""
    folder, name = tmp_path_factory.mktemp("satellite"), request.param
    radar, source = RADARS[name], folder / "source"
    write_nisar(source, radar) if name == "nisar" else write_palsar(source, radar)
    blocksar.ingest(None, source, folder / "ph.zarr", progress=False)
    blocksar.focus(folder / "ph.zarr", folder / "run", grid="-900:1000:2.5,-900:900:2.5", workers=0, progress=False)
    return name, radar, folder / "run"


def test_targets_on_the_ellipsoid_lie_at_their_places(image: tuple[str, Radar, Path]) -> None:
    name, radar, run = image
    frame = Georeference.among(stores.open_phase_history(run.parent / "ph.zarr").attrs)
    assert frame is not None
    targets = [
        {"name": f"T{i}", "x": x, "y": y, "z": z} for i, (x, y, z) in enumerate(frame.from_ecef(radar.targets).tolist())
    ]
    found = blocksar.quality(run, targets=targets).result["targets"]
    for each in found: print(each)
