"""The pyramid of an image: mean powers, by whole chunks, with the metadata that browsers of zarr read."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401
import xarray as xr
import zarr
from passes import fly, focus, points

import blocksar
from blocksar.collection.grid import Grid
from blocksar.places import place
from blocksar.planning.disk import has_pyramid, with_pyramid
from blocksar.runs.record import RunRecord
from blocksar.tasks import pyramid_levels

AFFINE = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray
GRID = ((-70.0, 60.05, 0.05), (-40.0, 40.25, 0.15))  # 2601 x 535 pixels: partly outside the swath, and odd levels
FRAME = {"kind": "ENU", "latitude": 39.8, "longitude": -84.1, "height": 250.0}


@pytest.fixture(scope="module")
def history() -> Any:
    return fly(points((-20.0, 5.0, 0.0), (12.0, -8.0, 0.0)), georeference=FRAME)


@pytest.fixture(scope="module")
def run(history: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return focus(history, tmp_path_factory.mktemp("run") / "run", grid=GRID, pyramid=True)


def half(power: Any) -> Any:
    """Means of the covered of 2 x 2 cells; NaN where there are none."""
    padded = np.pad(power, [(0, n % 2) for n in power.shape], constant_values=np.nan)
    cells = np.stack([padded[y::2, x::2] for y in range(2) for x in range(2)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about means of nothing
        return np.nanmean(cells, axis=0)


def test_levels_are_means_of_the_covered_power(run: Path) -> None:
    image = blocksar.open(run).image.values
    power = np.abs(image.astype(np.complex128)) ** 2
    assert 0.02 < np.isnan(power).mean() < 0.9
    tree = xr.open_datatree(run / "image.zarr" / "pyramid", engine="zarr")
    assert list(tree.children) == ["1", "2", "3"]
    for level, shape in enumerate([(268, 1301), (134, 651), (67, 326)], 1):
        power = half(power)
        stored = tree[f"{level}/power"]
        assert stored.shape == shape
        np.testing.assert_allclose(stored.values, power, rtol=1e-5)
        assert np.isnan(stored.values).sum() == np.isnan(power).sum()
        own = np.arange(GRID[0][0], GRID[0][1], GRID[0][2])[: 2**level].mean()
        assert float(stored.x[0]) == pytest.approx(own)


@pytest.mark.slow
def test_the_image_opens_as_without_a_pyramid(run: Path, history: Any, tmp_path: Path) -> None:
    plain = focus(history, tmp_path / "plain", grid=GRID)
    assert not (plain / "image.zarr" / "pyramid").exists()
    with_one, without = (xr.open_zarr(each / "image.zarr") for each in (run, plain))
    xr.testing.assert_equal(with_one, without)
    more = {"zarr_conventions", "multiscales", "spatial:dimensions", "proj:wkt2"}
    assert set(with_one.attrs) - set(without.attrs) == more
    bytes_of = {
        name: sum(f.stat().st_size for f in (run / "image.zarr" / name).rglob("*") if f.is_file())
        for name in ("image", "pyramid")
    }
    assert bytes_of["pyramid"] < bytes_of["image"] / 3


def test_metadata_follow_the_conventions(run: Path) -> None:
    group = zarr.open_group(run / "image.zarr", mode="r")
    names = [each["name"] for each in group.attrs["zarr_conventions"]]
    assert names == ["multiscales", "spatial", "proj"]
    assert group.attrs["proj:wkt2"].startswith("PROJCRS[")
    layout = group.attrs["multiscales"]["layout"]
    assert [each["asset"] for each in layout] == ["image", *(f"pyramid/{k}/power" for k in (1, 2, 3))]
    assert [each.get("derived_from") for each in layout] == [None, *(each["asset"] for each in layout[:-1])]
    for each in layout:
        array = group[each["asset"]]
        assert list(array.shape) == each["spatial:shape"]
        a, _, left, _, e, low = each["spatial:transform"]
        parent = group[each["asset"].rpartition("/")[0]] if "/" in each["asset"] else group
        assert left + a / 2 == pytest.approx(float(parent["x"][0])) and low + e / 2 == pytest.approx(
            float(parent["y"][0])
        )
    inner = group["pyramid"].attrs["multiscales"]["layout"]
    assert [each["asset"] for each in inner] == ["1", "2", "3"] and inner[1]["derived_from"] == "1"
    assert all(each.get("transform", {}).get("scale", [2.0, 2.0]) == [2.0, 2.0] for each in (*layout, *inner))


@AFFINE
def test_levels_have_a_grid_mapping_for_programs_without_the_conventions(run: Path) -> None:
    group = zarr.open_group(run / "image.zarr" / "pyramid", mode="r")
    for level in (1, 2, 3):
        power = xr.open_zarr(run / "image.zarr", group=f"pyramid/{level}", decode_coords="all").power
        assert power.rio.crs == rasterio.CRS.from_wkt(group.attrs["proj:wkt2"])
        assert power.rio.transform().almost_equals(rasterio.Affine(*group[f"{level}"].attrs["spatial:transform"]), 1e-9)
        # GDAL refuses others, though zstd has negative ones.
        assert 0 <= group[f"{level}/power"].metadata.codecs[-1].level <= 22


@AFFINE
def test_levels_open_in_gdal(run: Path) -> None:
    gdal = tuple(map(int, rasterio.__gdal_version__.split(".")[:2]))
    with rasterio.Env() as environment:
        if gdal < (3, 11) or "Zarr" not in environment.drivers():
            pytest.skip(f"GDAL {rasterio.__gdal_version__} does not read zarr 3")
    image = run / "image.zarr"
    for level in (1, 2, 3):
        with rasterio.open(f'ZARR:"{image}":/pyramid/{level}/power') as file:
            own = xr.open_zarr(image, group=f"pyramid/{level}", decode_coords="all").power
            np.testing.assert_array_equal(file.read(1), own.values)
            assert file.crs == own.rio.crs and file.transform.almost_equals(own.rio.transform(), 1e-9)
            assert np.isnan(file.nodata)


@pytest.mark.slow
def test_an_interrupted_pyramid_is_resumed_to_the_same_bytes(
    run: Path, history: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, calls = pyramid_levels.write, []

    def failing(*arguments: Any, **more: Any) -> Any:
        calls.append(arguments[2])
        if len(calls) == 2:
            raise OSError(5, "Input/output error")
        return written(*arguments, **more)

    monkeypatch.setattr(pyramid_levels, "PYRAMID_LEVELS", 2)  # so that one task makes the last level
    monkeypatch.setattr(pyramid_levels, "write", failing)
    with pytest.raises(blocksar.ProcessingError, match="pyramid"):
        focus(history, tmp_path / "run", grid=GRID, pyramid=True)
    monkeypatch.setattr(pyramid_levels, "write", written)
    focus(history, tmp_path / "run", grid=GRID)  # what it began with stays
    files = [each for each in (run / "image.zarr" / "pyramid").rglob("*") if each.is_file()]
    assert files
    for each in files:
        assert (tmp_path / "run" / each.relative_to(run)).read_bytes() == each.read_bytes()


def test_a_pyramid_counts_as_part_of_the_run(run: Path, history: Any, tmp_path: Path) -> None:
    record = RunRecord.read(place(run))
    units = [receipt.unit for receipt in record.receipts if receipt.stage.startswith("pyramid")]
    assert units == ["pyramid-0-0"]
    assert any(part.variable == "pyramid/1/power" for receipt in record.receipts for part in receipt.written)
    assert record.timings["pyramid"] > 0
    damaged = tmp_path / "run"
    shutil.copytree(run, damaged)
    (damaged / "image.zarr" / "pyramid" / "2" / "power" / "c" / "0" / "0").unlink()
    with pytest.raises(blocksar.InputError, match="pyramid/2/power/c/0/0"):
        focus(history, damaged, grid=GRID, pyramid=True)


def test_large_images_have_a_pyramid_and_its_room_is_predicted() -> None:
    small, large = Grid(0, 4096, 1, 0, 10, 1), Grid(0, 4097, 1, 0, 10, 1)
    assert [has_pyramid(small), has_pyramid(large), has_pyramid(small, True), has_pyramid(large, False)] == [
        False, True, True, False,
    ]  # fmt: skip
    assert with_pyramid({"image": 8}, large, None)["pyramid"] == round(4 * 40970 / 3)
    assert "pyramid" not in with_pyramid({"image": 8, "pyramid": 9}, large, False)
