"""Raw echoes of satellites, from files of the formats' layout: targets lie where they are on the Earth."""

from __future__ import annotations

from pathlib import Path

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
    values = np.array([complex(*each["value"]) for each in found])
    assert len(found) == 10 and all(each["covered"] for each in found)
    for each in found:
        # 16 mm of it for PALSAR: times in milliseconds, of which no fraction fits at 1700 Hz but steps of 3 us.
        assert np.hypot(each["error_x"], each["error_y"]) < 0.05, each
        for axis in ("range", "azimuth"):
            assert each[f"{axis}_pslr"] == pytest.approx(each[f"{axis}_pslr_theory"], abs=0.1), each
            assert each[f"{axis}_irw"] == pytest.approx(each[f"{axis}_irw_theory"], rel=0.005), each
    mean = values.mean()
    assert np.abs(np.abs(values) / abs(mean) - 1).max() < 0.01
    assert np.abs(np.angle(values / mean)).max() < 0.03
    assert abs(mean) == pytest.approx(1.0 if name == "nisar" else GAIN, rel=0.01)
