"""Reading heights: grids of the scene frame, GeoTIFFs on the Earth with their datums, and the ellipsoid."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from pyproj import CRS, Transformer

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.readers import terrain_earth
from blocksar.readers.heights import Ground, read_frame_grid, terrain_notes
from blocksar.readers.terrain_earth import datum_of, ellipsoid, read_geotiff, refuse_untagged

HERE = Georeference(latitude=47.0, longitude=11.0, height=600.0, rotation=25.0)
X, Y = (-2000.0, 3000.0), (-1000.0, 4000.0)
GRID = Grid(*X, 50.0, *Y, 50.0)


def bumps(x: FloatArray, y: FloatArray) -> FloatArray:
    return 300 * np.sin(x / 900.0) * np.cos(y / 700.0) + 0.05 * x


def frame_file(path: Path, *, order: tuple[str, str] = ("y", "x"), down: bool = False, **attrs: Any) -> Path:
    x, y = np.arange(-5000.0, 6000.0, 100.0), np.arange(-4000.0, 7000.0, 80.0)
    y = y[::-1] if down else y
    height = xr.DataArray(bumps(x, y[:, None]), {"y": y, "x": x}, ("y", "x"), attrs={"units": "m", **attrs})
    dataset = xr.Dataset({"height": height.transpose(*order)})
    if path.suffix == ".zarr":
        dataset.to_zarr(path, zarr_format=3, consolidated=False)
    else:
        dataset.to_netcdf(path, engine="scipy")
    return path


@pytest.mark.parametrize("name", ["dem.zarr", "dem.nc"])
def test_a_grid_of_the_frame_is_read_by_a_window(name: str, tmp_path: Path) -> None:
    terrain = read_frame_grid(frame_file(tmp_path / name), X, Y)
    assert terrain.heights.size < 80 * 80
    x, y = np.linspace(*X, 40), np.linspace(*Y, 30)
    assert np.abs(terrain.on_grid(x, y) - bumps(x, y[:, None])).max() < 1.0  # 300 m at wavelengths of 4 km
    assert terrain.heights == pytest.approx(bumps(terrain.x, terrain.y[:, None]), abs=1e-6)
    other = read_frame_grid(frame_file(tmp_path / f"turned-{name}", order=("x", "y"), down=True), X, Y)
    assert np.abs(other.on_grid(x, y) - terrain.on_grid(x, y)).max() < 1e-9


def test_plain_numbers_are_read_without_xarray_and_encoded_ones_as_what_they_stand_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = frame_file(tmp_path / "plain.zarr")
    encoding = {"height": {"dtype": "int16", "scale_factor": 0.05, "_FillValue": -9999}}
    xr.open_zarr(whole, consolidated=False).to_zarr(
        tmp_path / "encoded.zarr", zarr_format=3, consolidated=False, encoding=encoding
    )
    encoded = read_frame_grid(tmp_path / "encoded.zarr", X, Y)
    monkeypatch.setitem(sys.modules, "xarray", None)  # so that its import fails
    plain = read_frame_grid(whole, X, Y)
    assert plain.heights == pytest.approx(bumps(plain.x, plain.y[:, None]), abs=1e-9)
    assert (plain.row, plain.column) == (encoded.row, encoded.column)
    assert encoded.heights == pytest.approx(plain.heights, abs=0.03)


def geotiff(
    path: Path, crs: str, heights: Any, *, nodata: float | None = None, origin: float = 600.0, **tags: Any
) -> Path:
    """Heights over the ellipsoid, of the frame's place, as a GeoTIFF of the CRS."""
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    corners = HERE.to_geodetic(np.array([[a, b, 0.0] for a in (-6000, 6000) for b in (-6000, 6000)]))
    east, north = to_map.transform(corners[:, 1], corners[:, 0])
    step = (max(east) - min(east)) / 400
    west, top = min(east), max(north)
    transform = rasterio.Affine(step, 0.0, west, 0.0, -step, top)
    rows = int((max(north) - min(north)) / step)
    column, row = np.meshgrid(np.arange(400) + 0.5, np.arange(rows) + 0.5)
    lon, lat = to_map.transform(west + step * column, top - step * row, direction="INVERSE")
    values = heights(np.asarray(lon), np.asarray(lat)).astype(np.float64)
    profile = {"driver": "GTiff", "width": 400, "height": rows, "count": 1, "dtype": "float64", "crs": crs}
    with rasterio.open(path, "w", **profile, transform=transform, nodata=nodata) as file:
        file.write(values, 1)
        if "units" in tags:
            file.units = (tags["units"],)
    return path


def plane_of(lon: FloatArray, lat: FloatArray) -> FloatArray:
    """Heights over the ellipsoid of some smooth ground on the Earth."""
    return 700.0 + 2e4 * (lat - 47.0) - 1e4 * (lon - 11.0) + 100 * np.sin((lon - 11.0) * 300)


@pytest.mark.slow
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32632", "EPSG:3035"])
def test_points_on_a_geotiff_s_ground_lie_at_its_heights(crs: str, tmp_path: Path) -> None:
    terrain = read_geotiff(geotiff(tmp_path / "dem.tif", crs, plane_of), "ellipsoid", HERE, X, Y)
    x, y = np.meshgrid(np.linspace(*X, 30), np.linspace(*Y, 30))
    lat, lon, height = np.moveaxis(HERE.to_geodetic(np.stack([x, y, terrain(x, y)], axis=-1)), -1, 0)
    assert height == pytest.approx(plane_of(lon, lat), abs=2e-3)  # waves of 1.6 km at 30 m, again every 15 m
    assert np.ptp(terrain(x, y)) > 300
    assert terrain.refined == 2
    # As dense as the file, for what it hides: the same posts.
    coarse = read_geotiff(tmp_path / "dem.tif", "ellipsoid", HERE, X, Y, refine=False)
    assert coarse.refined == 1
    np.testing.assert_allclose(coarse.heights, terrain.thinned().heights, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_map_that_breaks_is_followed_place_by_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one does where longitudes jump; elsewhere it is smooth, and cubic between nodes."""
    path = geotiff(tmp_path / "dem.tif", "EPSG:3035", plane_of)
    smooth = read_geotiff(path, "ellipsoid", HERE, X, Y)
    monkeypatch.setattr(terrain_earth, "BENT", 0.0)
    exact = read_geotiff(path, "ellipsoid", HERE, X, Y)
    np.testing.assert_allclose(smooth.heights, exact.heights, rtol=0, atol=1e-6)


def test_a_hole_of_a_geotiff_takes_posts_beside_it_only(tmp_path: Path) -> None:
    """A sample is unknown if one of the four pixels about it is; a height, if one of its 4 x 4 samples is."""
    path = geotiff(tmp_path / "dem.tif", "EPSG:32632", plane_of, nodata=-1.0)
    with rasterio.open(path, "r+") as file:
        values = file.read(1)
        values[190:196, 190:196] = values[230, 170] = -1.0
        file.write(values, 1)
        transform = file.transform
    terrain = read_geotiff(path, "ellipsoid", HERE, X, Y)
    x, y = np.meshgrid(terrain.x, terrain.y)
    lat, lon, _ = np.moveaxis(HERE.to_geodetic(np.stack([x, y, np.full(x.shape, 300.0)], axis=-1)), -1, 0)
    column, row = ~transform @ Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(lon, lat)
    i, j = (np.floor(at - 0.5).astype(int) for at in (row, column))
    unknown = (values[i, j] == -1) | (values[i + 1, j] == -1) | (values[i, j + 1] == -1) | (values[i + 1, j + 1] == -1)
    assert unknown.sum() > 200
    assert (np.isnan(terrain.heights) != unknown).sum() <= 2  # heights move places by millimetres
    at = np.arange(X[0], X[1], 5.0), np.arange(Y[0], Y[1], 5.0)
    lost = float(np.isnan(terrain.on_grid(*at)).sum()) * 25 / (transform.a * -transform.e)
    assert 37 < lost < 37 + 70  # pixels: 81 and 16 at most, along the file's own axes


@pytest.mark.slow
def test_heights_over_a_geoid_need_its_grid(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "dem.tif", "EPSG:4326", lambda lon, lat: plane_of(lon, lat) - 48.0)
    with pytest.raises(InputError, match="does not say what its heights are measured from"):
        read_geotiff(path, None, HERE, X, Y)
    with pytest.raises(InputError, match=r"PROJ has no grid us_nga_egm08_25\.tif.*--vertical egm2008:FILE"):
        read_geotiff(path, "egm2008", HERE, X, Y)
    geoid = tmp_path / "geoid.tif"
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(geoid, "w", **profile, transform=rasterio.Affine(0.1, 0.0, 9.0, 0.0, -0.1, 49.0)) as file:
        file.write(np.full((40, 40), 48.0, np.float32), 1)
    raised = read_geotiff(path, f"egm2008:{geoid}", HERE, X, Y)
    direct = read_geotiff(geotiff(tmp_path / "other.tif", "EPSG:4326", plane_of), "ellipsoid", HERE, X, Y)
    assert raised.heights == pytest.approx(direct.heights, abs=1e-3)


def test_a_stated_datum_is_taken_and_must_agree(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "dem.tif", "EPSG:4326+3855", plane_of)
    with pytest.raises(InputError, match="PROJ has no grid"):
        read_geotiff(path, None, HERE, X, Y)
    with pytest.raises(InputError, match="heights over egm2008, but vertical is 'ellipsoid'"):
        read_geotiff(path, "ellipsoid", HERE, X, Y)


@pytest.mark.parametrize(
    ("scene", "west"), [(-179.99, 179.9), (180.0, 179.9), (180.0, -180.1), (-120.0, 239.9), (240.0, -120.1)]
)
def test_longitudes_may_be_counted_otherwise_than_by_the_scene(scene: float, west: float, tmp_path: Path) -> None:
    """Beyond 180 degrees, from 0 to 360, or a whole turn off."""
    lon, lat = west + 0.001 * (np.arange(200) + 0.5), -16.9 - 0.001 * (np.arange(200) + 0.5)
    heights = 100 + 200 * (lon - west) - 300 * (lat[:, None] + 17)
    profile = {"driver": "GTiff", "width": 200, "height": 200, "count": 1, "dtype": "float64", "crs": "EPSG:4326"}
    with rasterio.open(
        tmp_path / "dem.tif", "w", **profile, transform=rasterio.Affine(0.001, 0, west, 0, -0.001, -16.9)
    ) as file:
        file.write(heights, 1)
    frame = Georeference(latitude=-17.0, longitude=scene, height=0.0)
    terrain = read_geotiff(tmp_path / "dem.tif", "ellipsoid", frame, (-600.0, 600.0), (-600.0, 600.0))
    x, y = np.meshgrid(np.linspace(-600, 600, 9), np.linspace(-600, 600, 9))
    latitude, longitude, height = np.moveaxis(frame.to_geodetic(np.stack([x, y, terrain(x, y)], axis=-1)), -1, 0)
    east = (longitude - west) % 360
    assert height == pytest.approx(100 + 200 * east - 300 * (latitude + 17), abs=1e-3)


@pytest.mark.parametrize(
    ("vertical", "said"),
    [
        (
            '"EGM96 height",VERT_DATUM["EGM96 geoid",2005],UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]',
            "foot",
        ),
        ('"EGM96 depth",VERT_DATUM["EGM96 geoid",2005],UNIT["metre",1],AXIS["Depth",DOWN]', "metre, downwards"),
    ],
)
def test_a_datum_in_other_units_or_downwards_is_refused(vertical: str, said: str) -> None:
    """A VRT keeps what its CRS says, and its band has no unit then: feet were taken for metres."""
    crs = CRS(f'COMPD_CS["both",{CRS("EPSG:4326").to_wkt("WKT1_GDAL")},VERT_CS[{vertical}]]')
    with pytest.raises(InputError, match=rf"dem.vrt has heights in .*{said}.*; convert them to m, upwards"):
        datum_of(crs, "egm96", "dem.vrt")


def test_the_ellipsoid_falls_away_from_the_plane() -> None:
    box = (-30e3, 30e3), (-7e3, 7e3)
    ground = ellipsoid(HERE, 40.0, *box)
    x, y = np.meshgrid(np.linspace(*box[0], 41), np.linspace(*box[1], 21))
    height = HERE.to_geodetic(np.stack([x, y, ground(x, y)], axis=-1))[..., 2]
    assert height == pytest.approx(640.0, abs=1e-4)
    assert ground(np.array(0.0), np.array(0.0)) == pytest.approx(40.0, abs=1e-4)
    assert -80 < ground(np.array(30e3), np.array(0.0)) - 40.0 < -65


@pytest.mark.slow
def test_what_is_no_terrain_is_refused_with_figures(tmp_path: Path) -> None:
    path = frame_file(tmp_path / "dem.nc")
    with pytest.raises(InputError, match=r"lies elsewhere: it spans x -5000 .. 5900 m.*image x 90000"):
        read_frame_grid(path, (90e3, 91e3), Y)
    (tmp_path / "text.nc").write_text("no heights")
    with pytest.raises(InputError, match=r"is no netCDF file that an installed library reads .* give zarr or netCDF"):
        read_frame_grid(tmp_path / "text.nc", X, Y)
    with pytest.raises(InputError, match="does not exist"):
        read_frame_grid(tmp_path / "absent.nc", X, Y)
    with pytest.raises(InputError, match="heights in fathom"):
        read_geotiff(geotiff(tmp_path / "f.tif", "EPSG:4326", plane_of, units="fathom"), "ellipsoid", HERE, X, Y)
    with pytest.raises(InputError, match=r"is in NAD27, whose datum PROJ cannot tie to WGS 84 at longitude"):
        read_geotiff(geotiff(tmp_path / "n.tif", "EPSG:4267", plane_of), "ellipsoid", HERE, X, Y)
    far = Georeference(latitude=-20.0, longitude=100.0, height=0.0)
    with pytest.raises(InputError, match=r"lies elsewhere|does not reach"):
        read_geotiff(geotiff(tmp_path / "u.tif", "EPSG:32632", plane_of), "ellipsoid", far, X, Y)
    with pytest.raises(InputError, match=r"spans longitude .* and the image longitude 9.9.* degrees; give one"):
        near = Georeference(latitude=47.0, longitude=10.0, height=0.0)
        read_geotiff(geotiff(tmp_path / "g.tif", "EPSG:4326", plane_of), "ellipsoid", near, X, Y)


def test_a_surface_on_the_earth_needs_a_georeference_and_gaps_are_told(tmp_path: Path) -> None:
    assert Ground().read(None, 0.0, GRID) is None
    path = frame_file(tmp_path / "dem.nc")
    whole = Ground(terrain=path).read(None, 0.0, GRID)
    assert whole is not None and terrain_notes(whole, GRID) == []
    beyond = Grid(4000.0, 8000.0, 50.0, *Y, 50.0)
    half = Ground(terrain=path).read(None, 0.0, beyond)
    assert half is not None
    assert "no height at 51" in terrain_notes(half, beyond)[0]
    empty = Terrain(x0=-3e3, dx=100.0, y0=-2e3, dy=100.0, heights=np.full((80, 80), np.nan))
    assert "100 %" in terrain_notes(empty, GRID)[0]


@pytest.mark.parametrize(("value", "said"), [(-9999.0, "-9999"), (-32768.0, "-32768"), (1e30, r"1e\+30")])
def test_a_number_that_stands_for_no_data_untagged_is_refused(value: float, said: str, tmp_path: Path) -> None:
    """A cubic through it would spread it: heights of -9878 to +730 m were taken for the ground."""
    heights = np.full((20, 20), value)
    heights[5:, 5:] = 3.0
    with pytest.raises(InputError, match=rf"t.zarr has a height of {said} m \(175 of the kind\).*: tag the number"):
        refuse_untagged(heights, place(tmp_path / "t.zarr"))
    refuse_untagged(np.where(heights == value, np.nan, heights), place(tmp_path / "t.zarr"))


def test_a_collection_has_a_ground_of_its_own_unless_the_user_names_one(tmp_path: Path) -> None:
    attrs = {"surface": "ellipsoid"}
    ground = Ground().under(attrs)
    heights = ground.read(Georeference(latitude=10.0, longitude=20.0, height=0.0), 0.0, GRID)
    assert not ground.plane and heights is not None and heights.limits[0] < 0
    assert Ground(surface="plane").under(attrs).plane and Ground(terrain="dem.nc").under(attrs).surface is None
    assert Ground().under({}).plane
    with pytest.raises(InputError, match="surface = 'sphere' is unknown; give plane or ellipsoid"):
        Ground().under({"surface": "sphere"})
