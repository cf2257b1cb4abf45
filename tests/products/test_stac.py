"""STAC items, held to the specification by pystac, and to what the run and its files are."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
import rasterio
import shapely.geometry
import xarray as xr
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.sar import SarExtension
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from small_run import DAYTON, Made, hilly, make
from stac_schemas import schemas

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError

DATED = {"source": {"collection_start": "2026-05-04T10:00:00Z", "time_zero": 2.0}, "collector": "UAV-7"}


def checked(path: Path) -> pystac.Item:
    """The item, after pystac has validated it with its extensions; nothing is fetched."""
    validator = JsonSchemaSTACValidator()
    validator.schema_cache |= schemas()
    item = pystac.Item.from_file(str(path))
    used = item.validate(validator)
    assert len(used) == 1 + len(item.stac_extensions) >= 4
    return item


def test_an_item_says_where_when_and_how(tmp_path: Path) -> None:
    run = make(tmp_path / "run", more={**DATED, "polarization": {"transmit": "H", "receive": "V"}})
    report = blocksar.export("stac", run.folder, tmp_path / "item.json")
    assert report.summary == [
        "item of 2 assets, with the extensions sar, projection, processing, xarray-assets",
        f"wrote {tmp_path / 'item.json'}",
    ]
    item = checked(tmp_path / "item.json")
    time = run.collection.time
    start = datetime.fromisoformat("2026-05-04T10:00:02+00:00").timestamp()
    spans = [item.common_metadata.start_datetime, item.datetime, item.common_metadata.end_datetime]
    wanted = [start + time[0], start + time[[0, -1]].mean(), start + time[-1]]
    np.testing.assert_allclose([each.timestamp() for each in spans if each], wanted, rtol=0, atol=2e-6)
    sar = SarExtension.ext(item)
    assert (sar.frequency_band, sar.polarizations, sar.instrument_mode) == ("X", ["HV"], "SPOTLIGHT")
    assert sar.center_frequency == pytest.approx(9.6, abs=0.01) and sar.observation_direction == "right"
    assert item.properties["platform"] == "UAV-7" and item.properties["sar:bandwidth"] == pytest.approx(0.144)
    assert sar.pixel_spacing_range == sar.pixel_spacing_azimuth == pytest.approx(0.4)
    ground = 0.886 * SPEED_OF_LIGHT / (2 * 144e6) * np.hypot(6000, 4000) / 6000  # of an unweighted band, level
    assert sar.resolution_range == pytest.approx(ground, rel=0.05)
    # The outline holds the covered pixels, and not much else; it is counter-clockwise.
    outline = shapely.geometry.shape(item.geometry)
    assert outline.exterior.is_ccw and list(outline.bounds) == item.bbox
    grid = np.stack([*np.meshgrid(run.x, run.y), np.zeros(run.image.shape)], axis=-1)
    latitude, longitude, _ = np.moveaxis(DAYTON.to_geodetic(grid), -1, 0)
    inside = shapely.contains_xy(outline.buffer(1e-9), longitude, latitude)
    covered = np.isfinite(run.image)
    assert inside[covered].all() and inside.sum() < 1.01 * covered.sum()


@pytest.mark.slow
def test_assets_are_where_the_item_says_with_their_own_grids(tmp_path: Path) -> None:
    run = make(tmp_path / "run", terrain=hilly((0.0, 0.0)), formed_on_it=True)
    blocksar.export("geotiff", run.folder, tmp_path / "a.tif", looks="2x2")
    blocksar.export("geotiff", run.folder, tmp_path / "sub" / "map.tif", crs="EPSG:32616", content="complex")
    blocksar.export("png", run.folder, tmp_path / "a.png")
    files = [str(tmp_path / name) for name in ("a.tif", "sub/map.tif", "a.png")]
    blocksar.export("stac", run.folder, tmp_path / "items" / "item.json", assets=",".join(files))
    item = checked(tmp_path / "items" / "item.json")
    assert list(item.assets) == ["image", "run", "a.tif", "map.tif", "a.png"]
    for name, asset in item.assets.items():
        assert (tmp_path / "items" / asset.href).resolve().exists(), name
    assert item.assets["a.png"].media_type == "image/png" and item.assets["a.png"].roles == ["overview"]
    with rasterio.open(tmp_path / "sub" / "map.tif") as file:
        told = ProjectionExtension.ext(item.assets["map.tif"])
        assert told.code == "EPSG:32616" and told.shape == list(file.shape)
        assert told.transform == list(file.transform)[:6] and told.bbox == pytest.approx(list(file.bounds))
    image = ProjectionExtension.ext(item.assets["image"])
    assert image.code is None and image.shape == list(run.image.shape)
    with rasterio.open(tmp_path / "a.tif") as file:  # that of the image, but for looks and the order of rows
        assert rasterio.CRS.from_wkt(image.wkt2) == file.crs
        assert image.bbox == pytest.approx(list(file.bounds), abs=0.4)
    assert image.transform is not None and image.transform[4] > 0
    assert item.assets["image"].extra_fields["data_type"] == "cfloat32"
    settings = item.assets["image"].extra_fields["xarray:open_kwargs"]
    assert "image" in xr.open_dataset(item.assets["image"].get_absolute_href(), **settings)


@pytest.mark.slow
def test_an_item_across_the_antimeridian_is_cut_there(tmp_path: Path) -> None:
    frame = Georeference(latitude=-16.0, longitude=179.99999, height=99e3)
    run = make(tmp_path / "run", frame=frame, look=2.6)
    blocksar.export("stac", run.folder, tmp_path / "item.json")
    item = checked(tmp_path / "item.json")
    outline = shapely.geometry.shape(item.geometry)
    assert outline.geom_type == "MultiPolygon" and len(outline.geoms) == 2
    west, _, east, _ = item.bbox or [0] * 4
    assert 179.9 < west < 180 and -180 < east < -179.9
    assert sorted(round(part.bounds[0]) for part in outline.geoms) == [-180, 180]
    assert item.properties["sat:orbit_state"] == "descending"  # so high up


@pytest.mark.slow
@pytest.mark.parametrize("latitude", [90.0, -89.9999])
def test_an_outline_about_a_pole_reaches_it(latitude: float, tmp_path: Path) -> None:
    frame = Georeference(latitude=latitude, longitude=20.0, height=10.0)
    run = make(tmp_path / "run", frame=frame)
    blocksar.export("stac", run.folder, tmp_path / "item.json")
    item = checked(tmp_path / "item.json")
    west, south, east, north = item.bbox or [0] * 4
    assert (west, east) == (-180, 180) and (north == 90 if latitude > 0 else south == -90)
    assert shapely.geometry.shape(item.geometry).contains(shapely.Point(10.0, np.sign(latitude) * 89.99999))
    with pytest.raises(blocksar.InputError, match=r"polar stereographic there is EPSG:504[12], or EPSG:3[40][13][31]"):
        blocksar.export("geotiff", run.folder, tmp_path / "image.tif", crs="EPSG:32633")
    with pytest.raises(blocksar.InputError, match=r"polar stereographic there is"):
        blocksar.export("geotiff", run.folder, tmp_path / "image.tif", crs="EPSG:4326")
    for crs in ("EPSG:5041", "EPSG:3413") if latitude > 0 else ("EPSG:5042", "EPSG:3031"):
        blocksar.export("geotiff", run.folder, tmp_path / f"{crs[5:]}.tif", crs=crs)
    blocksar.export("geotiff", run.folder, tmp_path / "own.tif")


@pytest.mark.slow
def test_channels_have_their_polarizations_together_or_alone(polarised: Path, tmp_path: Path) -> None:
    blocksar.export("stac", polarised, tmp_path / "all.json")
    whole = checked(tmp_path / "all.json")
    assert SarExtension.ext(whole).polarizations == ["HH", "HV", "VV"]
    report = blocksar.export("stac", polarised, tmp_path / "one.json", channel="HV")
    assert report.summary[0] == "channel HV of HH, HV, VV"
    one = checked(tmp_path / "one.json")
    assert SarExtension.ext(one).polarizations == ["HV"]
    assert (tmp_path / one.assets["image"].href).resolve() == (polarised / "channels/HV/image.zarr").resolve()


@pytest.mark.slow
def test_the_validator_finds_what_is_wrong(tmp_path: Path, made: Made) -> None:
    blocksar.export("stac", made.folder, tmp_path / "item.json")
    item = json.loads((tmp_path / "item.json").read_text(encoding="utf-8"))
    wrongs: list[dict[str, Any]] = [
        {"sar:frequency_band": "X-band"}, {"sar:resolution": 1.0}, {"processing:software": "blocksar"}, {"datetime": 7},
    ]  # fmt: skip
    for wrong in wrongs:
        (tmp_path / "wrong.json").write_text(json.dumps({**item, "properties": {**item["properties"], **wrong}}))
        with pytest.raises((pystac.STACValidationError, TypeError)):
            checked(tmp_path / "wrong.json")


@pytest.mark.slow
def test_an_asset_of_another_run_is_refused(made: Made, tmp_path: Path) -> None:
    other = make(tmp_path / "other", size=(60, 50))
    record = json.loads((other.folder / "run.json").read_text())
    (other.folder / "run.json").write_text(json.dumps({**record, "identity": "f" * 16}))
    blocksar.export("geotiff", other.folder, tmp_path / "other.tif")
    with pytest.raises(InputError, match="is of another run; export this one's"):
        blocksar.export("stac", made.folder, tmp_path / "no.json", assets=tmp_path / "other.tif")
    assert not (tmp_path / "no.json").exists()
