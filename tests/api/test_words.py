"""Python takes what the command line takes, and says the same of wrong input, in its own words."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from arrays import arrays
from distributed import Client
from typer.testing import CliRunner

import blocksar
from blocksar.api.arguments import (
    check_one_frame,
    control_points,
    history_of,
    is_scene,
)
from blocksar.api.jobs import records_of
from blocksar.api.parsing import blocks_of, grid_of, memory_of
from blocksar.cli import commands
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, in_python
from blocksar.ingestion.readers import stated_times
from blocksar.measurement.targets import Target
from blocksar.products.pictures.quicklook import checked_colour_map, checked_size


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


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("grid", "-60:60"),
        ("grid", "a:b:c,0:1:1"),
        ("grid", "5:5:1,0:1:1"),
        ("grid", "0:1:-1,0:1:1"),
        ("grid", "0:inf:1,0:1:1"),
        ("memory_limit", "lots"),
        ("memory_limit", "1e30T"),
        ("blocks", "many"),
        ("blocks", "0"),
        ("weighting", "taylor"),
    ],
)
def test_both_say_the_same(setting: str, value: str, store: Path) -> None:
    option = f"--{setting.replace('_', '-')}={value}"
    ended = CliRunner().invoke(commands.app, ["plan", str(store), option])
    assert ended.exit_code == 2
    with pytest.raises(InputError) as caught:
        blocksar.plan(store, **{setting: value})  # type: ignore[arg-type]
    said = " ".join(ended.stderr.removeprefix("blocksar: ").split())
    assert str(caught.value) == in_python(said)
    assert "--" not in str(caught.value)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a grid of three numbers": ({"grid": (-60, 60, 0.5)}, r"^grid \(-60, 60, 0.5\) is not two axes of three numbers;"),
    "a grid of points": ({"grid": ([0, 1, 2, 3], [0, 1, 2])}, r"^grid has \[0, 1, 2, 3\] for x, which is not"),
    "an empty grid": ({"grid": ((5, 5, 1), (0, 1, 1))}, r"^grid is empty: x runs from 5 to 5 m; give an end above"),
    "half a block": ({"blocks": 2.5}, r"^blocks 2\.5 is neither 'auto' nor a whole number"),
    "half a byte": ({"memory_limit": 0.5}, r'^memory_limit is 0\.5; give a whole number of bytes, or a text'),
    "no memory": ({"memory_limit": 0}, r"^memory_limit is 0 bytes; give what a worker may use, such as 2147483648"),
    "a list of memory": ({"memory_limit": [1]}, r"^memory_limit is \[1\]; give"),
    "a fidelity in words": ({"fidelity": "high"}, r"^fidelity is 'high'; give a number below 1, such as 0\.999$"),
    "a fidelity above 1": ({"fidelity": 1.5}, r"^fidelity = 1\.5: ask for a coherence from 0\.5 to below 1, such as"),
    "workers in words": ({"workers": "2"}, r"^workers is '2'; give a whole number of at least 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_values_of_the_wrong_kind_are_refused(case: str, dataset: xr.Dataset, tmp_path: Path) -> None:
    settings, message = WRONG[case]
    for call in (blocksar.plan, lambda source, **kw: blocksar.focus(source, tmp_path / "run", **kw)):
        with pytest.raises(InputError, match=message):
            call(dataset, **settings)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda source: blocksar.check(source, threads="two"), "^threads is 'two'; give a whole number"),
        (lambda source: blocksar.preview(source, threads=1.5), "^threads is 1.5; give a whole number"),
        (
            lambda _: blocksar.simulate("table1", "none.cphd", cphd=True, origin=(1, 2)),  # type: ignore[arg-type]
            r"^origin is \(1, 2\): give",
        ),
        (lambda _: blocksar.ingest("gotcha", None, "none.zarr"), "^source is None; give the path"),  # type: ignore[arg-type]
        (lambda _: checked_colour_map(3), "^colour map 3 is none that matplotlib knows; did you mean"),
        (lambda _: checked_size("large"), "^size = 'large': give 200 to"),
        (lambda _: stated_times(3, None), "^--collection-start '3' is not a date"),
        (lambda _: stated_times(None, 1e300), "^--time-zero is 1e.300 s; give the seconds"),
        (lambda _: stated_times(None, "noon"), "^--time-zero is 'noon' s; give the seconds"),
    ],
)
def test_other_values_of_the_wrong_kind_are_refused(
    call: Callable[[xr.Dataset], Any], message: str, dataset: xr.Dataset
) -> None:
    with pytest.raises(InputError, match=message):
        call(dataset)


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


@pytest.mark.parametrize("command", ["focus", "autofocus"])
def test_a_client_that_is_none_is_refused(command: str, store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^client is a str; give a distributed.Client, or the address"):
        getattr(blocksar, command)(store, tmp_path / "out", grid="-10:10:1,-10:10:1", client="tcp://127.0.0.1:8786")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["focus", "autofocus"])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"client": "C", "workers": 0}, r"^workers 0 is given together with a client, whose workers"),
        ({"scheduler": "tcp://a:1", "workers": 0}, r"^workers 0 is given together with scheduler, .*; leave one out$"),
        ({"scheduler": "tcp://a:1", "client": "C"}, r"^scheduler 'tcp://a:1' is given together with a client; leave"),
    ],
)
def test_one_cluster_is_used(command: str, given: dict[str, Any], message: str, store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        getattr(blocksar, command)(store, tmp_path / "out", grid="-10:10:1,-10:10:1", **given)
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


def test_an_error_speaks_of_parameters(dataset: xr.Dataset, tmp_path: Path) -> None:
    small: dict[str, Any] = {"grid": "-10:10:1,-10:10:1", "workers": 0}
    blocksar.focus(dataset, tmp_path / "run", **small)
    with pytest.raises(InputError, match=r"use overwrite=True to replace it, or another out$"):
        blocksar.focus(dataset, tmp_path / "run", blocks=1, **small)
    with pytest.raises(InputError, match=r"so give grid x0:x1:dx,y0:y1:dy for the ground to image, such as grid='"):
        blocksar.plan(blocksar.collection(**arrays(steered=False)))


def test_a_report_speaks_of_parameters(dataset: xr.Dataset) -> None:
    report = blocksar.plan(dataset, blocks=1, fidelity=0.9999999)
    assert any("--blocks" in line for line in report.summary)
    assert "--" not in str(report) and "--" not in report._repr_html_()


def test_functions_keep_their_names_and_signatures() -> None:
    from blocksar import api

    assert blocksar.focus.__doc__ == api.focus.__doc__ and blocksar.focus.__name__ == "focus"
    assert blocksar.focus is blocksar.focus
