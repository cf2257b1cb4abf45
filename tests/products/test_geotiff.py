"""GeoTIFF files of a small run, read back by rasterio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio.warp
from rio_cogeo import cog_validate
from small_run import DAYTON, TARGETS, make

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.measurement.targets import Target

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray


@pytest.mark.parametrize("content", ["amplitude", "complex"])
def test_geotiff_is_a_valid_cog_with_the_pixels_of_the_image(content: Any, tmp_path: Path) -> None:
    run = make(tmp_path, size=(700, 600), step=0.15)
    out = tmp_path / "image.tif"
    blocksar.export("geotiff", run.folder, out, content=content)
    assert cog_validate(out, strict=True, quiet=True) == (True, [], [])
    with rasterio.open(out) as file:
        pixels = file.read(1)[::-1]
        assert file.overviews(1) == [2]
        assert np.isnan(file.nodata)
    wanted = np.abs(run.image) if content == "amplitude" else run.image
    assert pixels.dtype == wanted.dtype
    np.testing.assert_array_equal(pixels, wanted)


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
