"""Python takes what the command line takes, and says the same of wrong input, in its own words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from arrays import arrays
from distributed import Client

import blocksar
from blocksar.application.arguments import check_one_frame, control_points, history_of, is_scene
from blocksar.application.jobs import records_of
from blocksar.application.parsing import blocks_of, grid_of, memory_of
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.measurement.targets import Target


@pytest.fixture(scope="module")
def dataset() -> xr.Dataset:
    return blocksar.collection(**arrays())


@pytest.fixture(scope="module")
def store(dataset: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(str(blocksar.write(dataset, tmp_path_factory.mktemp("store") / "ph.zarr")))


def test_texts_stand_for_values() -> None:
    assert grid_of("-60:60:0.5,1e3:2e3:1") == Grid(-60, 60, 0.5, 1000, 2000, 1)
    assert grid_of(((-60, 60, 0.5), [1e3, 2e3, 1])) == Grid(-60, 60, 0.5, 1000, 2000, 1)  # type: ignore[arg-type]
    assert memory_of("2GiB") == memory_of(2**31) == memory_of(float(2**31)) == 2**31
    assert blocks_of("3") == blocks_of(3) == 3 and blocks_of("auto") == "auto"


def test_an_address_is_no_scene() -> None:
    assert is_scene("table1") and is_scene("own.toml") and not is_scene("s3://bucket/ph.zarr") and not is_scene("none")


def test_control_points_of_another_height_are_others() -> None:
    low, high, ground = (records_of([Target("P", 1.0, 2.0, 1.0, z)]) for z in (5.0, 50.0, None))
    assert low != high != ground and len(ground[0]) == 5  # as runs of earlier versions have it


def test_control_points_may_lie_on_the_earth(tmp_path: Path) -> None:
    frame = {"kind": "ENU", "latitude": 39.78, "longitude": -84.1, "height": 300.0}
    feature = {"type": "Feature", "id": "P", "geometry": {"type": "Point", "coordinates": [-84.1, 39.78, 312.0]}}
    (tmp_path / "points.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    placed = blocksar.collection(**arrays(), georeference=frame)
    (point,) = control_points(tmp_path / "points.geojson", placed)
    assert point.name == "P" and point[1:3] == pytest.approx((0, 0), abs=1e-6) and point.z == pytest.approx(12.0)
    with pytest.raises(InputError, match="there is no georeference"):
        control_points(tmp_path / "points.geojson", blocksar.collection(**arrays()))


class Asynchronous(Client):
    """As `Client(asynchronous=True)` is to others, without a cluster."""

    asynchronous = True

    def __init__(self) -> None:
        pass

    def __del__(self) -> None:
        pass


def test_a_client_that_is_asynchronous_is_refused(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^client is asynchronous"):
        blocksar.focus(store, tmp_path / "out", grid="-10:10:1,-10:10:1", client=Asynchronous())
    assert not list(tmp_path.iterdir())


def test_georeferences_are_the_same_however_they_are_written() -> None:
    frame = {"kind": "ENU", "latitude": 45.0, "longitude": 9.5, "height": 100.0}

    def check(other: dict[str, Any]) -> None:
        check_one_frame(
            [history_of(blocksar.collection(**arrays()).assign_attrs(georeference=g)) for g in (frame, other)]
        )

    check({**frame, "latitude": 45, "rotation_deg": 0.0})
    check(Georeference.from_attribute(frame).as_attribute())
    with pytest.raises(
        InputError, match=r"^the dataset and the dataset have different georeferences .*height=100.*105"
    ):
        check({**frame, "height": 105.0})


def test_a_report_speaks_of_parameters(dataset: xr.Dataset) -> None:
    report = blocksar.plan(dataset, blocks=1, fidelity=0.9999999)
    assert any("--blocks" in line for line in report.summary)
    assert "--" not in str(report) and "--" not in report._repr_html_()


def test_functions_keep_their_names_and_signatures() -> None:
    from blocksar import api

    assert blocksar.focus.__doc__ == api.focus.__doc__ and blocksar.focus.__name__ == "focus"
    assert blocksar.focus is blocksar.focus
