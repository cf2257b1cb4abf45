"""GeoTIFF files in the grid of a map, against the image computed at each of its places."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer
from rio_cogeo import cog_validate
from scipy.optimize import brentq
from small_run import DAYTON, TARGETS, Made, hilly, make

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.kernels.posts import sample_places

SYDNEY = Georeference(latitude=-33.1, longitude=151.2, height=40.0, rotation=200.0)
CENTRE = {
    "DAYTON": (0.0, 0.0),
    "SYDNEY": (9000.0, -4000.0),
}  # 10 km from the origin, heights move places by centimetres


@pytest.fixture(scope="module", params=["SYDNEY", "AXIS"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Made, Georeference, str]:
    """A run on hills, its frame, and a map for it."""
    frame, crs = (SYDNEY, "EPSG:4326") if request.param == "SYDNEY" else (DAYTON, "EPSG:32616")
    centre, folder = CENTRE["DAYTON" if frame is DAYTON else "SYDNEY"], tmp_path_factory.mktemp("run")
    made = make(
        folder, frame=frame, centre=centre, terrain=hilly(centre), formed_on_it=True,
        about_axis=request.param == "AXIS",
    )  # fmt: skip
    return made, frame, crs


def ground_at(frame: Georeference, terrain: Terrain, crs: Any, east: float, north: float) -> NDArray[np.float64]:
    """The place of the ground on the vertical of a map's place, by bisection."""
    longitude, latitude = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(east, north)

    def point(over: float) -> NDArray[np.float64]:
        return frame.from_geodetic(np.array([latitude, longitude, frame.height + over]))

    def above(over: float) -> float:
        at = point(over)
        return float(at[2] - terrain(at[0], at[1]))

    return point(brentq(above, -30.0, 80.0, xtol=1e-9))


@pytest.mark.slow
def test_each_pixel_is_the_image_at_its_own_place_of_the_ground(
    run: tuple[Made, Georeference, str], tmp_path: Path
) -> None:
    made, frame, crs = run
    centre = CENTRE["DAYTON" if frame is DAYTON else "SYDNEY"]
    terrain, out = hilly(centre), tmp_path / "map.tif"
    report = blocksar.export("geotiff", made.folder, out, content="complex", crs=crs)
    assert "orthorectified on the terrain" in report.summary[0]
    assert cog_validate(out, strict=True, quiet=True) == (True, [], [])
    with rasterio.open(out) as file:
        pixels, transform = file.read(1), file.transform
        assert file.crs.to_epsg() == int(crs[5:]) and transform.b == transform.d == 0 and transform.e < 0
        assert float(file.tags()["location_error_m"]) < 1e-4
    random, error, strongest, seen = np.random.default_rng(1), [], [], 0
    places = list(zip(random.integers(0, pixels.shape[0], 60), random.integers(0, pixels.shape[1], 60), strict=True))
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    for target in TARGETS:
        x, y = target.x + centre[0], target.y + centre[1]
        latitude, longitude, _ = frame.to_geodetic(np.array([x, y, float(terrain(np.array(x), np.array(y)))]))
        column, row = ~transform @ to_map.transform(longitude, latitude)
        places.append((int(row), int(column)))
    for row, column in places:
        east, north = transform @ (column + 0.5, row + 0.5)
        point = ground_at(frame, terrain, crs, east, north)
        i, j = (round((at - axis[0]) / (axis[1] - axis[0])) for at, axis in ((point[1], made.y), (point[0], made.x)))
        inside = 0 <= i < made.y.size and 0 <= j < made.x.size and np.isfinite(made.image[i, j])
        assert bool(np.isfinite(pixels[row, column])) == bool(inside)
        around = made.image[max(i - 8, 0) : i + 9, max(j - 8, 0) : j + 9]
        if inside and around.shape == (17, 17) and np.isfinite(around).all():
            error.append(abs(pixels[row, column] - made.exact_value(terrain, point, centre=centre)))
            strongest.append(abs(pixels[row, column]))
            seen += 1
    assert seen > 20 and max(strongest) > 0.9
    # Under a beam, a pixel has a pulse more or less than its neighbour, of about 100.
    assert max(error) < (8e-3 if made.collection.steered else 2e-3)


@pytest.mark.slow
def test_pixels_far_from_the_middle_of_a_part_have_their_own_dwells(tmp_path: Path) -> None:
    """A beam that hardly moves over the ground, and pixels as large as the resolution allows."""
    terrain, crs = hilly((0.0, 0.0)), "EPSG:32616"
    made = make(
        tmp_path, terrain=terrain, formed_on_it=True, about_axis=True, beam=(0.006, 0.004), step=0.82, size=(100, 90),
        hole=False,
    )  # fmt: skip
    blocksar.export("geotiff", made.folder, tmp_path / "map.tif", content="complex", crs=crs)
    with rasterio.open(tmp_path / "map.tif") as file:
        pixels, transform = file.read(1), file.transform
    to_map, error, strongest = Transformer.from_crs("EPSG:4326", crs, always_xy=True), [], []
    for target in TARGETS:
        x, y = target.x, target.y
        latitude, longitude, _ = DAYTON.to_geodetic(np.array([x, y, float(terrain(np.array(x), np.array(y)))]))
        column, row = (int(at) for at in ~transform @ to_map.transform(longitude, latitude))
        for i, j in ((row, column), (row + 1, column), (row, column - 1), (row - 1, column + 1)):
            point = ground_at(DAYTON, terrain, crs, *(transform @ (j + 0.5, i + 0.5)))
            error.append(abs(pixels[i, j] - made.exact_value(terrain, point)))
            strongest.append(abs(pixels[i, j]))
    assert max(strongest) > 0.8 and max(error) < 0.025  # a pulse of 90 more or less


@pytest.mark.slow
def test_detected_pixels_and_layers_follow_the_complex_ones(
    run: tuple[Made, Georeference, str], tmp_path: Path
) -> None:
    made, frame, crs = run
    centre = CENTRE["DAYTON" if frame is DAYTON else "SYDNEY"]
    read, terrain = {}, hilly(centre)
    contents = ("complex", "amplitude", "power", "db", "height", "incidence", "visibility", "gamma")
    for content in contents:
        blocksar.export("geotiff", made.folder, tmp_path / "a.tif", content=content, crs=crs, overwrite=True)  # type: ignore[arg-type]
        with rasterio.open(tmp_path / "a.tif") as file:
            read[content], transform = file.read(1), file.transform
    covered = np.isfinite(read["complex"])
    np.testing.assert_allclose(read["amplitude"], np.abs(read["complex"]), rtol=1e-6)
    np.testing.assert_allclose(read["power"], read["amplitude"] ** 2, rtol=1e-6)
    np.testing.assert_allclose(read["db"], 20 * np.log10(read["amplitude"]), atol=1e-4)
    assert (np.isfinite(read["height"]) == covered).all() and ((read["visibility"] != 255) == covered).all()
    assert np.isfinite(read["incidence"]).mean() > 0.97 * covered.mean()
    for row, column in ((60, 70), (90, 60)):
        point = ground_at(frame, terrain, crs, *(transform @ (column + 0.5, row + 0.5)))
        assert read["height"][row, column] == pytest.approx(point[2], abs=1e-3)
        exact = blocksar.open(made.folder).incidence_angle.interp(x=point[0], y=point[1])
        assert read["incidence"][row, column] == pytest.approx(float(exact), abs=1e-4)


@pytest.mark.slow
def test_looks_are_averaged_before_the_map_is_made(run: tuple[Made, Georeference, str], tmp_path: Path) -> None:
    made, frame, crs = run
    terrain = hilly(CENTRE["DAYTON" if frame is DAYTON else "SYDNEY"])
    blocksar.export("geotiff", made.folder, tmp_path / "a.tif", content="power", looks="4x4", crs=crs)
    with rasterio.open(tmp_path / "a.tif") as file:
        pixels, transform = file.read(1), file.transform
    cells = blocksar.open(made.folder).sar.multilook("4x4")
    seen = 0
    for row in range(4, 30, 5):
        for column in range(4, 36, 6):
            point = ground_at(frame, terrain, crs, *(transform @ (column + 0.5, row + 0.5)))
            expected = float(cells.interp(x=point[0], y=point[1]))
            if np.isfinite(expected):
                assert pixels[row, column] == pytest.approx(expected, rel=2e-3)
                seen += 1
    assert seen > 10


def test_a_map_that_breaks_within_the_image_is_refused(tmp_path: Path) -> None:
    """It would be 96 million columns of nothing."""
    made = make(tmp_path, frame=Georeference(latitude=-17.0, longitude=180.0, height=0.0), size=(60, 50))
    for crs in ("EPSG:4326", "EPSG:3857"):
        with pytest.raises(InputError, match="tears the image apart, as longitudes do at 180 degrees"):
            blocksar.export("geotiff", made.folder, tmp_path / "a.tif", crs=crs)
    blocksar.export("geotiff", made.folder, tmp_path / "a.tif", crs="EPSG:3832")  # about longitude 150


def test_the_width_of_pixels_is_told_in_the_unit_of_the_map(made: Made, tmp_path: Path) -> None:
    report = blocksar.export("geotiff", made.folder, tmp_path / "a.tif", crs="EPSG:3735")  # in feet: it said 1.312 m
    assert ", 1.312 US survey foot wide, " in report.summary[0]


def test_a_map_of_a_single_column_has_its_width(tmp_path: Path) -> None:
    """On the Earth's zero point, where two columns of an image lie on whole multiples of the map's spacing."""
    frame = Georeference(latitude=0.0, longitude=0.0, height=0.0)
    made = make(tmp_path, frame=frame, size=(2, 50), hole=False)
    blocksar.export("geotiff", made.folder, tmp_path / "a.tif", crs="EPSG:4326")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.width == 1 and np.isfinite(file.read(1)).all()
        east = frame.from_geodetic(np.array([0.0, file.transform.a, 0.0]))[0]
        assert east == pytest.approx(0.4, rel=1e-4) and file.transform.c == pytest.approx(-file.transform.a)
    blocksar.export("sicd", made.folder, tmp_path / "a.nitf")  # with corners on equator and meridian


def test_samples_are_interpolated_to_a_thousandth() -> None:
    random = np.random.default_rng(4)
    frequency, phase = random.uniform(-0.36, 0.36, (9, 2)), random.uniform(-3, 3, 9)

    def exact(row: Any, column: Any) -> Any:
        return sum(
            np.exp(2j * np.pi * (f[0] * row + f[1] * column) + 1j * p) for f, p in zip(frequency, phase, strict=True)
        )

    rows, columns = np.meshgrid(np.arange(40), np.arange(50), indexing="ij")
    row, column = random.uniform(8, 31, 300), random.uniform(8, 41, 300)
    found = sample_places(exact(rows, columns).astype(np.complex64), row=row, column=column)
    assert np.abs(found - exact(row, column)).max() < 9 * 2e-3
