"""GeoTIFF files of a small run, read back by rasterio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio.warp
from rio_cogeo import cog_validate
from small_run import DAYTON, TARGETS, make, ridge

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.measurement.targets import Target

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray


@pytest.mark.parametrize("content", ["amplitude", "complex"])
def test_geotiff_is_a_valid_cog_with_the_pixels_of_the_image(content: Any, tmp_path: Path) -> None:
    run = make(tmp_path, size=(700, 100), step=0.15)
    out = tmp_path / "image.tif"
    blocksar.export("geotiff", run.folder, out, content=content)
    assert cog_validate(out, strict=True, quiet=True) == (True, [], [])
    with rasterio.open(out) as file:
        pixels = file.read(1)[::-1]
        assert file.overviews(1) == [2]
        assert np.isnan(file.nodata)
    wanted = np.abs(run.image) if content == "amplitude" else run.image
    assert pixels.dtype == wanted.dtype
    rounding = 4e-7 if content == "amplitude" else 0  # of roots and powers, float32
    np.testing.assert_allclose(pixels, wanted, rtol=rounding, atol=0)


@pytest.mark.slow
def test_overviews_are_means_of_the_power_that_is_covered(tmp_path: Path) -> None:
    """Each pixel of each level, against a loop over the pixels of the image that it stands for."""
    run = make(tmp_path, size=(1031, 61), step=0.1)
    power = np.abs(run.image[::-1].astype(np.complex128)) ** 2  # north up; with a hole, and rows without coverage
    ways: dict[str, Any] = {
        "power": lambda mean: mean,
        "amplitude": np.sqrt,
        "db": lambda mean: 10 * np.log10(mean),
        "uint8": lambda mean: np.clip(np.rint((10 * np.log10(mean) + 40) / (40 / 254) + 1), 1, 255),
    }
    files = {}
    for name in (*ways, "complex"):
        options = {"scale": "uint8", "range": "-40:0"} if name == "uint8" else {"content": name}
        blocksar.export("geotiff", run.folder, tmp_path / f"{name}.tif", **options)
        assert cog_validate(tmp_path / f"{name}.tif", strict=True, quiet=True) == (True, [], [])
        files[name] = tmp_path / f"{name}.tif"
    for level, factor in enumerate((2, 4)):
        shape = -(-61 // factor), -(-1031 // factor)
        mean = np.full(shape, np.nan)
        for i, j in np.ndindex(shape):
            cell = power[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
            if np.isfinite(cell).any():
                mean[i, j] = np.nanmean(cell)
        assert np.isnan(mean).any() and (np.isnan(mean) == np.isnan(power[::factor, ::factor])).mean() < 1
        for name, way in ways.items():
            with rasterio.open(files[name]) as file, rasterio.open(files[name], overview_level=level) as overview:
                assert file.overviews(1) == [2, 4] and overview.shape == shape
                found, nodata = overview.read(1), file.nodata
            wanted = np.where(np.isnan(mean), nodata, way(mean))
            np.testing.assert_allclose(found, wanted, rtol=2e-6, atol=1e-5 if name == "db" else 0)
        with rasterio.open(files["complex"], overview_level=level) as overview:
            np.testing.assert_array_equal(overview.read(1), run.image[::-1][::factor, ::factor])


@pytest.mark.slow
def test_overviews_of_a_map_and_of_a_terrain_are_those_of_its_pixels(tmp_path: Path) -> None:
    run = make(tmp_path, size=(530, 71), step=0.15, terrain=ridge())
    for content, options in (("power", {"crs": "EPSG:32616"}), ("height", {}), ("visibility", {}), ("gamma", {})):
        out = tmp_path / f"{content}.tif"
        blocksar.export("geotiff", run.folder, out, content=content, **options)
        with rasterio.open(out) as file, rasterio.open(out, overview_level=0) as overview:
            pixels, found, nodata = file.read(1), overview.read(1), file.nodata
        if content == "visibility":
            assert nodata == 255
            np.testing.assert_array_equal(found, pixels[::2, ::2])
            continue
        padded = np.pad(pixels.astype(float), [(0, n % 2) for n in pixels.shape], constant_values=np.nan)
        cells = padded.reshape(padded.shape[0] // 2, 2, -1, 2)
        count = np.isfinite(cells).sum(axis=(1, 3))
        with np.errstate(invalid="ignore"):
            np.testing.assert_allclose(found, np.nansum(cells, axis=(1, 3)) / count, rtol=2e-6)
        assert np.isnan(nodata) and (count == 0).any() and (count == 4).any()


def test_whole_numbers_of_a_map_with_looks_are_nothing_beyond_the_image(tmp_path: Path) -> None:
    run = make(tmp_path)
    options = {"scale": "uint8", "range": "-40:0", "looks": "2x2", "crs": "EPSG:32616"}
    blocksar.export("geotiff", run.folder, tmp_path / "map.tif", **options)
    with rasterio.open(tmp_path / "map.tif") as file:
        pixels = file.read(1)
    assert (pixels[0] == 0).any() and (pixels[:, 0] == 0).any() and (pixels > 0).mean() > 0.5


@pytest.mark.parametrize(
    ("frame", "centre"),
    [
        (DAYTON, (0.0, 0.0)),
        (DAYTON, (24000.0, -18000.0)),  # the projection about the origin has an error of a third of a pixel here
        (Georeference(latitude=-33.1, longitude=151.2, height=40.0, rotation=200.0), (0.0, 0.0)),
        (Georeference(latitude=78.2, longitude=179.9995, height=-5.0), (300.0, 50.0)),
    ],
)
def test_geotiff_places_targets_at_their_latitude_and_longitude(
    frame: Georeference, centre: tuple[float, float], tmp_path: Path
) -> None:
    run = make(tmp_path, frame=frame, centre=centre)
    blocksar.export("geotiff", run.folder, tmp_path / "image.tif")
    with rasterio.open(tmp_path / "image.tif") as file:
        for named in TARGETS:
            target = Target(named.name, named.x + centre[0], named.y + centre[1])
            latitude, longitude, _ = frame.to_geodetic(np.array([target.x, target.y, 0.0]))
            (east,), (north,) = rasterio.warp.transform("EPSG:4326", file.crs, [longitude], [latitude])
            column, row = ~file.transform @ (east, north)
            peak = run.peak(target)
            assert column - 0.5 == pytest.approx(peak[1], abs=0.1)
            assert row - 0.5 == pytest.approx(run.y.size - 1 - peak[0], abs=0.1)
        assert float(file.tags()["location_error_m"]) < 0.04
        assert (file.transform.b == 0) == ((frame == DAYTON and centre == (0.0, 0.0)) or frame.latitude > 70)


@pytest.mark.slow
@pytest.mark.parametrize("content", ["amplitude", "db"])
def test_looks_are_means_over_whole_cells_at_their_places(content: Any, tmp_path: Path) -> None:
    run = make(tmp_path, size=(153, 131))
    blocksar.export("geotiff", run.folder, tmp_path / "image.tif", content=content, looks="4x3")
    power = np.abs(run.image[:128, :153]).astype(float) ** 2
    mean = power.reshape(32, 4, 51, 3).mean(axis=(1, 3))
    assert np.isnan(mean).any() and not np.isnan(mean).all()
    wanted = {"amplitude": np.sqrt(mean), "db": 10 * np.log10(mean)}[content]
    with rasterio.open(tmp_path / "image.tif") as file:
        np.testing.assert_allclose(file.read(1)[::-1], wanted, rtol=2e-6, atol=1e-5)
        assert file.tags()["looks"] == "4 x 3 pixels (y x x)"
        west, north = file.transform @ (0.5, 0.5)  # the middle of the first pixel
    assert west == pytest.approx(run.x[:3].mean(), abs=0.01)
    assert north == pytest.approx(run.y[124:128].mean(), abs=0.01)
    with blocksar.open(run.folder) as dataset:
        cells = dataset.sar.multilook((4, 3))
        lazy = dataset.chunk({"y": 40, "x": 50}).sar.multilook("4x3")
        np.testing.assert_allclose(cells.values, mean, rtol=2e-6)
        np.testing.assert_allclose(lazy.values, mean, rtol=2e-6)
        assert cells.y.values[-1] == pytest.approx(run.y[124:128].mean())


@pytest.mark.parametrize(("scale", "most"), [("uint8", 255), ("uint16", 65535)])
def test_whole_numbers_stand_for_decibels(scale: Any, most: int, tmp_path: Path) -> None:
    run = make(tmp_path)
    blocksar.export("geotiff", run.folder, tmp_path / "image.tif", scale=scale, range="-40:0", crop="-20:20,-20:10")
    columns, rows = np.abs(run.x) <= 20, (run.y >= -20) & (run.y <= 10)
    with np.errstate(divide="ignore"):
        wanted = 20 * np.log10(np.abs(run.image[rows][:, columns]))
    with rasterio.open(tmp_path / "image.tif") as file:
        pixels = file.read(1)[::-1]
        assert pixels.dtype == scale and file.nodata == 0
        stands_for = pixels * file.scales[0] + file.offsets[0]
    assert (pixels == 0).tolist() == np.isnan(wanted).tolist()
    inside = np.isfinite(wanted) & (wanted > -40) & (wanted < 0)
    np.testing.assert_allclose(stands_for[inside], wanted[inside], atol=0.51 * 40 / (most - 1))
    assert (pixels[wanted < -41] == 1).all() and inside.sum() > 1000


@pytest.mark.slow
def test_layers_of_a_terrain_are_those_of_the_image_where_it_is_covered(tmp_path: Path) -> None:
    run = make(tmp_path / "run", terrain=ridge())
    image, covered = blocksar.open(run.folder), np.isfinite(run.image)
    read = {}
    for content in ("height", "incidence", "visibility", "gamma", "power"):
        out = tmp_path / f"{content}.tif"
        blocksar.export("geotiff", run.folder, out, content=content)  # type: ignore[arg-type]
        assert cog_validate(out, strict=True, quiet=True) == (True, [], [])
        with rasterio.open(out) as file:
            read[content] = file.read(1)[::-1]
            assert (file.units[0], file.nodata == 255) == (
                {"height": "m", "incidence": "rad"}.get(content), content == "visibility"
            )  # fmt: skip
    for content, name in (("height", "height"), ("incidence", "incidence_angle")):
        np.testing.assert_array_equal(read[content], np.where(covered, image[name].values, np.nan))
    flags = read["visibility"]
    np.testing.assert_array_equal(flags, np.where(covered, image.visibility.values, 255))
    assert flags.dtype == np.uint8 and all((flags == flag).sum() > 50 for flag in (0, 1, 2, 255))
    # At the very edge of layover the slope, which is smoother than what visibility is found on, may stand on edge.
    assert not np.isfinite(read["gamma"])[flags != 0].any()
    assert np.isfinite(read["gamma"])[flags == 0].mean() > 0.97
    factor = read["gamma"] / read["power"]
    # Broadside, nearly: the ratio of the tangents of local and level incidence, where the slope is along range.
    geometry = run.source.geometry
    antenna = geometry.collection.antenna_position.mean(axis=0)
    x, y = np.meshgrid(run.x, run.y)
    level = np.arctan2(np.hypot(x - antenna[0], y - antenna[1]), antenna[2] - read["height"])
    expected = np.tan(read["incidence"]) / np.tan(level)
    some = np.isfinite(factor) & (read["incidence"] > 0.4)
    assert 0.1 < factor[some].min() < 0.7 and factor[some].max() > 1.3
    assert np.median(np.abs(factor[some] / expected[some] - 1)) < 0.05


def test_layers_of_a_terrain_are_refused_where_there_are_none(tmp_path: Path) -> None:
    run = make(tmp_path / "run")
    with pytest.raises(InputError, match="lies on the plane and has no visibility; focus again with terrain"):
        blocksar.export("geotiff", run.folder, tmp_path / "a.tif", content="gamma")
    hilly = make(tmp_path / "hilly", terrain=ridge())
    with pytest.raises(InputError, match="content = 'height' has no looks"):
        blocksar.export("geotiff", hilly.folder, tmp_path / "a.tif", content="height", looks=(2, 2))
    assert not (tmp_path / "a.tif").exists()
