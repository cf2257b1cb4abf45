"""Datasets returned by `blocksar.open`, and their xarray accessor."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import rasterio.warp
import xarray as xr
import zarr
from small_run import DAYTON, TARGETS, Made, make

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, ProcessingError
from blocksar.places.local import LocalPlace
from blocksar.products import geotiff
from blocksar.products.pixels import Pixels

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray


def test_db_equals_the_power_of_the_pixels(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        power = opened.sar.db()
        assert power.attrs["units"] == "dB"
        np.testing.assert_allclose(power.values, 20 * np.log10(np.abs(made.image)), rtol=0, atol=1e-4)


def test_without_known_noise_there_is_none(tmp_path: Path) -> None:
    plain, known = (make(tmp_path / str(power), size=(60, 50), noise_power=power).folder for power in (None, 0.5))
    with blocksar.open(plain) as opened:
        assert set(opened.data_vars) == {"image", "block"}
        with pytest.raises(InputError, match="has no noise_equivalent: the noise of the samples was not known"):
            opened.sar.noise_db()
    assert "noise" not in blocksar.quality(plain, targets=[]).result
    assert blocksar.quality(known, targets=[]).result["noise"]["area"] > 0
    with blocksar.open(known) as opened:
        assert opened.sar.noise_db().attrs["grid_mapping"] == "spatial_ref"


def test_crop_selects_by_ground_coordinates_and_is_lazy(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    with blocksar.open(made.folder) as opened:
        part = opened.sar.crop(x=(-4.1, 5.0), y=(None, 2.0))
        assert not part["image"].variable._in_memory
        inside = (made.x >= -4.1) & (made.x <= 5.0)
        np.testing.assert_array_equal(part.x, made.x[inside])
        np.testing.assert_array_equal(part["image"], made.image[made.y <= 2.0][:, inside])
        for wrong, said in (({"x": (3.0, 1.0)}, "lower end first"), ({"y": (1e3, None)}, "holds no pixel")):
            with pytest.raises(InputError, match=said):
                opened.sar.crop(**wrong)


@pytest.mark.parametrize("azimuth", [None, 37.0, 90.0])
def test_a_cut_agrees_with_back_projection(azimuth: float | None, made: Made) -> None:
    """Compare with exact back-projection at the points of the line."""
    target = TARGETS[0]
    with blocksar.open(made.folder) as opened:
        cut = opened.sar.cut(target.x, target.y, azimuth=azimuth, length=8.0, samples=41)
    signal = np.zeros((made.collection.n_pulse, made.collection.n_range_frequency), np.complex128)
    frequency = made.collection.carrier + made.collection.range_frequency
    for other in TARGETS:
        distance = np.linalg.norm([other.x, other.y, 0.0] - made.collection.antenna_position, axis=1)
        signal += np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, frequency))
    for i in range(0, 41, 5):
        turn = np.radians(azimuth or 0.0)
        point = [target.x + cut.distance.values[i] * np.cos(turn), target.y + cut.distance.values[i] * np.sin(turn), 0]
        distance = np.linalg.norm(point - made.collection.antenna_position, axis=1)
        exact = np.abs((signal * np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, frequency))).mean())
        assert 10 ** (cut.values[i] / 20) == pytest.approx(exact, abs=3e-3)
    assert cut.values[20] == pytest.approx(0.0, abs=0.1)  # includes the side lobes of the other targets


def test_a_cut_outside_the_image_is_refused(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        with pytest.raises(InputError, match="lies outside the image"):
            opened.sar.cut(500.0, 0.0)
        with pytest.raises(InputError, match="is no line"):
            opened.sar.cut(0.0, 0.0, length=0.0)
        assert np.isnan(opened.sar.cut(made.x[0], 0.0, length=30.0).values[0])


def test_descending_axes_give_the_same_results(made: Made) -> None:
    from matplotlib.figure import Figure

    with blocksar.open(made.folder) as opened:
        turned = opened.isel(y=slice(None, None, -1), x=slice(None, None, -1))
        part, whole = (ds.sar.crop(x=(-4.1, 5.0), y=(None, 2.0)) for ds in (turned, opened))
        assert not part["image"].variable._in_memory
        np.testing.assert_array_equal(part["image"].values[::-1, ::-1], whole["image"])
        assert turned.sar.cut(0.3, -0.2).equals(opened.sar.cut(0.3, -0.2))
        axes = [ds.sar.plot(Figure().add_subplot()) for ds in (turned, opened)]
        assert axes[0].get_ylim() == axes[1].get_ylim()
        np.testing.assert_array_equal(axes[0].images[0].get_array(), axes[1].images[0].get_array())
        for of in ("plot", "cut"):
            with pytest.raises(InputError, match="x of the image is not evenly spaced"):
                getattr(opened.isel(x=[0, 1, 5]).sar, of)(*((-31.0, 0.0) if of == "cut" else ()))


@pytest.mark.parametrize("span", [3.0, (1.0, 2.0, 3.0), ("west", 3.0)])
def test_a_span_that_is_not_two_numbers_is_refused(span: Any, made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=r"give two ends in m, the lower first"):
        opened.sar.crop(x=span)
    with (
        blocksar.open(made.folder / "collection.zarr") as collection,
        pytest.raises(InputError, match="no coordinate x"),
    ):
        collection.sar.crop(x=(0.0, 1.0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"length": np.inf}, {"azimuth": np.nan}, {"azimuth": np.inf}, {"x": "a"}, {"y": None}, {"azimuth": "east"},
        {"length": [1, 2]}, {"samples": "many"}, {"samples": 10.5}, {"samples": 10**12},
    ],
)  # fmt: skip
def test_a_cut_with_wrong_parameters_is_refused(wrong: Any, made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=rf"is no line|{next(iter(wrong))} is"):
        opened.sar.cut(**{"x": 0.0, "y": 0.0, **wrong})


@pytest.mark.filterwarnings("error")
def test_db_of_a_chunked_image_is_lazy_and_raises_no_warning(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        power = opened.chunk(y=64).sar.db()
        assert power.chunks
        assert power.dtype == np.float32
        np.testing.assert_array_equal(power.values, opened.sar.db().values)


def test_derived_datasets_can_be_saved(tmp_path: Path) -> None:
    """netCDF has no complex numbers and only numeric or text attributes; CF forbids a fill value for coordinates."""
    told = {"settings": {"processor": "auto"}, "checked": True, "predicted": [{"block": 0}], "warnings": []}
    run = make(tmp_path / "run", size=(40, 30))
    zarr.open_group(run.folder / "image.zarr").attrs.update(told)
    with blocksar.open(run.folder) as opened:
        assert {name: json.loads(opened.attrs[name]) for name in told} == told
        assert "processor" in dict(opened.sar._facts()) and blocksar.info(opened).result["kind"] == "image"
        xr.merge([opened]).drop_vars("image").to_netcdf(tmp_path / "merged.nc")
        opened.to_netcdf(tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc") as again:
        assert {name: json.loads(again.attrs[name]) for name in told} == told
        assert again.rio.crs == opened.rio.crs
        assert "_FillValue" not in again["x"].encoding
        np.testing.assert_array_equal(again["image_real"] + 1j * again["image_imag"], run.image)
        assert again["image_imag"].attrs["grid_mapping"] == "spatial_ref" and again["image_imag"].units == "1"
    opened.sar.crop(x=(0.0, 3.0)).to_zarr(tmp_path / "a.zarr", consolidated=False)
    with blocksar.open(tmp_path / "a.zarr") as again:
        assert again.sar.plot().texts[-1].get_text() == "N"
        assert again["image"].shape == (30, 8)
    matplotlib.pyplot.close("all")


def test_plot_draws_into_given_axes(made: Made) -> None:
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    with blocksar.open(made.folder) as opened:
        assert opened.sar.plot(ax=axes) is axes
        with pytest.raises(InputError, match="ax is 'a', but must be matplotlib Axes"):
            opened.sar.plot(ax="a")
        assert opened.sar.crop(x=(0.0, 10.0)).sar.plot().get_xlim() == pytest.approx((-0.2, 10.2), abs=0.4)
    assert axes.get_title() == "small scene, é"
    assert axes.images[0].get_clim()[1] > axes.images[0].get_clim()[0] + 20
    matplotlib.pyplot.close("all")


def test_rioxarray_reads_the_grid_mapping(made: Made, unplaced: Made) -> None:
    with blocksar.open(made.folder) as opened:
        assert opened["image"].rio.crs is not None
        assert opened.x.attrs["standard_name"] == "projection_x_coordinate"
        target = TARGETS[1]
        latitude, longitude, _ = DAYTON.to_geodetic(np.array([target.x, target.y, 0.0]))
        (east,), (north,) = rasterio.warp.transform("EPSG:4326", opened.rio.crs, [longitude], [latitude])
        assert (east, north) == pytest.approx((target.x, target.y), abs=0.01)
        # Derived arrays keep the grid mapping.
        assert opened.sar.db().rio.crs == opened.rio.crs
        assert opened.sar.db().attrs["grid_mapping"] == "spatial_ref"
    with blocksar.open(unplaced.folder) as opened:
        assert "spatial_ref" not in opened.coords


def test_a_rotated_frame_has_no_grid_mapping(tmp_path: Path) -> None:
    run = make(tmp_path, size=(40, 40), frame=Georeference(latitude=1.0, longitude=2.0, height=3.0, rotation=10.0))
    with blocksar.open(run.folder) as opened:
        assert "spatial_ref" not in opened.coords


def test_the_default_projection_is_kept_where_it_is_accurate(made: Made) -> None:
    assert geotiff.place_pixels(Pixels(made.source, "amplitude"), DAYTON).offset.tolist() == [0.0, 0.0]


def test_a_part_holds_no_attribute_of_the_whole_stores_layout(tmp_path: Path) -> None:
    run = make(tmp_path / "run", size=(40, 30))
    layout = {"zarr_conventions": [], "multiscales": {}, "spatial:transform": [1.0], "proj:wkt2": "x"}
    zarr.open_group(run.folder / "image.zarr").attrs.update(layout)
    with blocksar.open(run.folder) as opened:
        for part in (opened.sar.crop(x=(0.0, 3.0)), opened.isel(x=slice(4, 9)), opened):
            assert not set(layout) & set(part.attrs)
            assert part.rio.transform().c == pytest.approx(float(part.x[0] - (part.x[1] - part.x[0]) / 2))


def test_arrays_trees_and_merged_datasets_go_to_netcdf(tmp_path: Path) -> None:
    run = make(tmp_path / "run", size=(40, 30))
    with blocksar.open(run.folder) as opened:
        xr.testing.assert_equal(opened.image.sar.crop(x=(0.0, 3.0)), opened.sar.crop(x=(0.0, 3.0)).image)
        xr.testing.assert_equal(opened.image.sar.db(), opened.sar.db())
        with pytest.raises(InputError, match=r"not the complex image; give ds\.image"):
            opened.sar.db().sar.db()
        merged = xr.merge([opened], combine_attrs="override").assign_attrs(weight=np.int64(3), ends=np.arange(2))
        made = {"array": opened.image, "merged": merged, "tree": xr.DataTree.from_dict({"/": opened, "/part": opened})}
        for name, each in made.items():
            flat = each.sar.netcdf()
            groups = [flat] if isinstance(flat, xr.Dataset) else [node.to_dataset() for node in flat.subtree]
            groups[-1].to_netcdf(tmp_path / f"{name}.nc")
            with xr.open_dataset(tmp_path / f"{name}.nc") as again:
                np.testing.assert_array_equal(again["image_real"] + 1j * again["image_imag"], run.image)


def test_figures_of_a_run_that_cannot_be_written_to_are_reported(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(number: int) -> None:
        def write(self: LocalPlace, data: bytes) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(LocalPlace, "write_bytes", write)

    refuse(errno.EROFS)
    report = blocksar.quality(made.folder, area="-5:5,-5:5")
    assert report.result and report.summary[-1].endswith("quality.json cannot be written (Read-only file system)")
    refuse(errno.ENOSPC)  # which makes room for the file
    with pytest.raises(ProcessingError, match=r"quality\.json cannot be written \(No space left on device\)"):
        blocksar.quality(made.folder)
