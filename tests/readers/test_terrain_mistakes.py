"""Files of heights that mean something else: in feet, zero where unknown, with holes, exchanged axes or no CRS.

Each is taken as it is and said to be doubtful, or refused; what the sentence says to do makes the image right.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner
from rasterio.rio.main import main_group

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.readers.heights import Ground, terrain_notes

HERE = Georeference(latitude=36.0, longitude=-84.0, height=250.0)
STEP, N = 1 / 3600, 61
ABOVE = 30.0  # m of the ground over the frame's plane
GRID = Grid(-50.0, 50.0, 2.0, -50.0, 50.0, 2.0)
FLAT = np.full((N, N), HERE.height + ABOVE)
WEST, NORTH = HERE.longitude - (N // 2 + 0.5) * STEP, HERE.latitude + (N // 2 + 0.5) * STEP


def from_origin(west: float, north: float) -> Affine:
    return Affine(STEP, 0.0, west, 0.0, -STEP, north)


def dem(path: Path, heights: Any, *, crs: Any = "EPSG:4326", transform: Affine | None = None, **profile: Any) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=N, height=N, count=1, dtype="float32", crs=crs,
        transform=transform or from_origin(WEST, NORTH), **profile,
    ) as file:  # fmt: skip
        file.write(np.asarray(heights, np.float32), 1)
    return path


def notes_on(path: Path) -> list[str]:
    terrain = Ground(terrain=path, vertical="ellipsoid").read(HERE, 0.0, GRID)
    assert terrain is not None
    return terrain_notes(terrain, GRID)


def height_on(path: Path) -> Any:
    terrain = Ground(terrain=path, vertical="ellipsoid").read(HERE, 0.0, GRID)
    assert terrain is not None
    return terrain.on_grid(GRID.x, GRID.y)


def follow(note: str) -> None:
    """Run the command that a sentence names."""
    command = re.search(r"`(rio [^`]*)`", note)
    assert command is not None
    program, *words = shlex.split(command[1])
    assert program == "rio"
    CliRunner().invoke(main_group, words, catch_exceptions=False)


def holed(value: float, half: int = 2) -> Any:
    heights = FLAT.copy()
    heights[N // 2 - half : N // 2 + half + 1, N // 2 - half : N // 2 + half + 1] = value
    return heights


def test_metres_on_the_ground_need_no_word(tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif", FLAT)
    assert notes_on(path) == []
    np.testing.assert_allclose(height_on(path), ABOVE, atol=1e-3)  # the ellipsoid bends by 0.2 mm over 50 m


def test_feet_are_suspected_and_taken_once_they_are_tagged(tmp_path: Path) -> None:
    [note] = notes_on(path := dem(tmp_path / "dem.tif", FLAT / 0.3048))
    assert "lies 669 m above the scene's plane, but 30 m above it if its heights are feet" in note
    follow(note)
    assert notes_on(path) == []
    np.testing.assert_allclose(height_on(path), ABOVE, atol=1e-3)


def test_feet_of_another_country_are_its_own(tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif", FLAT * 3937 / 1200)
    with rasterio.open(path, "r+") as file:
        file.units = ["US survey foot"]
    np.testing.assert_allclose(height_on(path), ABOVE, atol=1e-3)


@pytest.mark.parametrize("height", [0.0, 40.0, 1200.0])
def test_heights_in_metres_are_not_taken_for_feet(height: float, tmp_path: Path) -> None:
    """A frame on the ground, on the ellipsoid below it, or far below a mountain."""
    assert notes_on(dem(tmp_path / "dem.tif", FLAT + height)) == []
    below = Georeference(latitude=36.0, longitude=-84.0, height=0.0)
    terrain = Ground(terrain=tmp_path / "dem.tif", vertical="ellipsoid").read(below, 0.0, GRID)
    assert terrain is not None and terrain.remarks == ()


def test_zeros_beside_land_are_suspected_and_left_out_once_they_are_tagged(tmp_path: Path) -> None:
    sea = FLAT.copy()
    sea[:, N // 2 + 1 :] = 0
    [note] = notes_on(path := dem(tmp_path / "dem.tif", sea))
    assert "is exactly 0 m at 4" in note and "beside heights of 280 m" in note
    follow(note)
    [note] = notes_on(path)
    assert "has no height at" in note
    heights = height_on(path)
    np.testing.assert_allclose(heights[np.isfinite(heights)], ABOVE, atol=1e-3)


def test_a_coast_is_no_mistake(tmp_path: Path) -> None:
    sea = np.maximum(np.linspace(-100, 100, N), 0)[None] * np.ones((N, 1))
    terrain = Ground(terrain=dem(tmp_path / "dem.tif", sea), vertical="ellipsoid").read(
        Georeference(latitude=36.0, longitude=-84.0, height=0.0), 0.0, GRID
    )
    assert terrain is not None and terrain.remarks == ()


def test_zeros_everywhere_are_suspected_where_the_scene_is_higher(tmp_path: Path) -> None:
    [note] = notes_on(dem(tmp_path / "dem.tif", 0 * FLAT))
    assert "is exactly 0 m all over the grid, 250 m below the scene's plane" in note
    at_sea = Georeference(latitude=36.0, longitude=-84.0, height=0.0)
    terrain = Ground(terrain=tmp_path / "dem.tif", vertical="ellipsoid").read(at_sea, 0.0, GRID)
    assert terrain is not None and terrain.remarks == ()


@pytest.mark.parametrize(("value", "profile"), [(-32767.0, {"nodata": -32767.0}), (np.nan, {})])
def test_a_hole_under_the_grid_is_said_to_be_one(value: float, profile: dict[str, float], tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif", holed(value), **profile)
    with pytest.raises(
        InputError, match=r"has no height under the grid, .*; fill the hole \(rasterio.fill.fillnodata\)"
    ):
        notes_on(path)
    from rasterio.fill import fillnodata

    with rasterio.open(path, "r+") as file:
        file.write(fillnodata(file.read(1), file.read_masks(1) * np.isfinite(file.read(1))), 1)
    assert notes_on(path) == []
    np.testing.assert_allclose(height_on(path), ABOVE, atol=1e-3)


def test_a_hole_whose_number_is_not_tagged_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has a height of -32767 m \(25 of the kind\).*tag the number"):
        notes_on(dem(tmp_path / "dem.tif", holed(-32767.0)))


def test_exchanged_longitudes_and_latitudes_are_said_to_be(tmp_path: Path) -> None:
    south, east = HERE.latitude - (N // 2 + 0.5) * STEP, HERE.longitude + (N // 2 + 0.5) * STEP
    exchanged = dem(tmp_path / "dem.tif", FLAT, transform=from_origin(south, east))
    with pytest.raises(InputError, match=r"lies elsewhere: .*; its longitudes and latitudes are exchanged, it seems"):
        notes_on(exchanged)
    abroad = dem(tmp_path / "abroad.tif", FLAT, transform=from_origin(10.0, 52.0))
    with pytest.raises(InputError, match=r"lies elsewhere: it spans longitude 10 .*; give one that covers it"):
        notes_on(abroad)


def test_a_missing_reference_system_can_be_stated(tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif", FLAT, crs=None)
    with pytest.raises(InputError, match="has no coordinate reference system; state it") as error:
        notes_on(path)
    follow(str(error.value).replace(", if it is in degrees of WGS 84", ""))
    np.testing.assert_allclose(height_on(path), ABOVE, atol=1e-3)


@pytest.mark.slow
def test_a_grid_that_a_terrain_lifts_out_of_the_swath_is_not_told_to_move_only(tmp_path: Path) -> None:
    """An antenna 9 km above and 12 km west of the scene, with a range window of 384 m about its origin."""
    time = (np.arange(256) - 128) / 300.0
    antenna = np.stack([np.full(256, -12000.0), 150 * time, np.full(256, 9000.0)], axis=1)
    history = blocksar.collection(
        time=time, antenna_position=antenna, reference_range=np.linalg.norm(antenna, axis=1), carrier_frequency=9.65e9,
        range_frequency=np.arange(-128, 128) * 390625.0, signal=np.ones((256, 256), np.complex64),
        georeference=HERE.as_attribute(),
    )  # fmt: skip
    path = dem(tmp_path / "dem.tif", FLAT / 0.3048)
    with pytest.raises(InputError) as error:
        blocksar.plan(history, grid=GRID, terrain=path, vertical="ellipsoid")
    said = str(error.value)
    assert "the terrain lies at z = 668.6" in said and "the middle of what was recorded at 0.0 m there" in said
    assert "correct its heights (unit, datum), or move the grid; " in said and "if its heights are feet" in said
    follow(said)
    assert blocksar.plan(history, grid=GRID, terrain=path, vertical="ellipsoid").refusal is None
