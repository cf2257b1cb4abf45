"""Which ground a collection sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid, folds, ground_spectrum
from blocksar.collection.region import WINDOW_GUARD, default_grid, plan_region, share_outside
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError

GRID = Grid(7e3, 7.1e3, 1.0, 8e3, 8.1e3, 1.0)


def passing(small_collection: Collection) -> Collection:
    """An unsteered pass of 4 km, in a range window of 375 m about one range."""
    time = np.arange(-1000, 1000) / 100
    track = np.stack([200 * time, 0 * time, 5000 + 0 * time], axis=1)
    return replace(
        small_collection, time=time, antenna_position=track, beam_azimuth=np.full(2000, np.nan), beam_width=None,
        reference_range=np.full(2000, 11_700.0),
    )  # fmt: skip


def test_ranges_that_leave_the_window_while_they_are_lit_are_told_from_ranges_outside_it(
    small_collection: Collection,
) -> None:
    collection = passing(small_collection)
    with pytest.raises(InputError, match=r"shorter than the \d+ m by which ranges change .* re-reference the samples"):
        plan_region(Geometry(collection=collection), GRID)
    centre = np.array([7.05e3, 8.05e3, 0.0])
    following = np.linalg.norm(collection.antenna_position - centre, axis=1)
    region = plan_region(Geometry(collection=replace(collection, reference_range=following)), GRID)
    assert (region.far > region.near).all()
    with pytest.raises(InputError, match="no range stays in"):
        plan_region(Geometry(collection=replace(collection, reference_range=following + 500)), GRID)


@pytest.mark.parametrize("n", [1, 100])
def test_pixels_on_one_ray_have_a_region(small_collection: Collection, n: int) -> None:
    """They span no yaw; seams lie between yaws."""
    collection, grid = passing(small_collection), Grid(0.0, 1.0, 1.0, 8e3, 8e3 + n, 1.0)
    following = np.linalg.norm(collection.antenna_position - np.array([0.0, 8.05e3, 0.0]), axis=1)
    geometry = Geometry(collection=replace(collection, reference_range=following))
    region = plan_region(geometry, grid)
    assert region.yaw[0] < np.pi / 2 - 0.5 / 8e3 and np.pi / 2 + 0.5 / 8e3 < region.yaw[-1] < np.pi / 2 + 2 / 8e3


@pytest.mark.slow
def test_pixels_whose_ranges_leave_the_window_are_counted(small_collection: Collection) -> None:
    """Against the ranges of every pixel to every tenth antenna position."""
    collection, grid = passing(small_collection), Grid(6.8e3, 7.4e3, 5.0, 7.9e3, 8.4e3, 5.0)
    centre = np.array([7.05e3, 8.05e3, 0.0])
    following = np.linalg.norm(collection.antenna_position - centre, axis=1)
    collection = replace(collection, reference_range=following)
    geometry = Geometry(collection=collection)
    x, y = np.meshgrid(grid.x, grid.y)
    points = np.stack([x, y, np.zeros(x.shape)], axis=-1).reshape(-1, 1, 3)
    away = np.linalg.norm(points - collection.antenna_position[::10], axis=-1) - following[::10]
    half = collection.range_window / 2 - WINDOW_GUARD * SPEED_OF_LIGHT / (2 * collection.bandwidth)
    outside = float((np.abs(away).max(axis=1) > half).mean())
    assert 0.2 < outside < 0.8
    assert share_outside([(geometry, plan_region(geometry, grid))], grid) == pytest.approx(outside, abs=0.01)
    assert share_outside([(geometry, plan_region(geometry, GRID))], GRID) == 0


def test_under_a_beam_about_its_axis_lit_pixels_outside_the_window_are_counted() -> None:
    """Those that it does not light are not outside."""
    collection = axis_collection()
    geometry, grid = Geometry(collection=collection), Grid(8.7e3, 9.3e3, 2.0, -200.0, 200.0, 2.0)
    mesh_x, mesh_y = np.meshgrid(grid.x, grid.y)
    first, last = geometry.beam.dwell(mesh_x, mesh_y)
    points = np.stack([mesh_x, mesh_y, np.full(mesh_x.shape, collection.ground_height)], axis=-1)
    half = collection.range_window / 2 - WINDOW_GUARD * SPEED_OF_LIGHT / (2 * collection.bandwidth)
    away = [geometry.range_history(points, np.clip(at, *collection.time[[0, -1]]))[0] for at in (first, last)]
    reference = [np.interp(at, collection.time, collection.reference_range) for at in (first, last)]
    outside = np.abs(np.subtract(away, reference)).max(axis=0) > half
    wanted = float((outside & (last > first)).mean())
    assert 0.1 < wanted < 0.5
    assert share_outside([(geometry, plan_region(geometry, grid))], grid) == pytest.approx(wanted, abs=0.01)


def test_the_region_of_steep_incidence_ends_at_the_line_of_flight() -> None:
    """Near the nadir a beam lights ground on both sides of the track; the default grid lies on one of them."""
    collection = axis_collection(reference_range=np.full(400, 4060.0), beam_width=0.06, side_of_track="right")
    geometry = Geometry(collection=collection)
    region = plan_region(geometry, None)
    assert -np.pi / 2 < region.yaw[0] and region.yaw[-1] < np.pi / 2  # the track leads along +y
    assert default_grid(geometry, region).x0 > 0


@pytest.mark.slow
def test_a_spectrum_folds_where_two_of_its_images_overlap() -> None:
    """Against points of the plane: some lie in two parallelograms of the lattice, or none does."""
    rng = np.random.default_rng(0)
    shifts = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), axis=-1).reshape(-1, 1, 2)
    found = []
    for _ in range(30):
        sides, steps = rng.normal(size=(2, 2)), rng.uniform(0.1, 1.0, 2)
        points = (rng.uniform(size=(600, 2)) + shifts) / steps
        inside = (np.abs(points @ np.linalg.inv(sides)) < 0.5).all(axis=-1).sum(axis=0)
        found.append(folds((sides[0], sides[1]), *steps))
        assert found[-1] == (inside.max() > 1)
    assert 3 < sum(found) < 27


def test_a_grid_that_suits_each_axis_is_not_said_to_undersample() -> None:
    """1.4 m in range, where 0.5 m are needed in azimuth alone, were called too coarse."""
    collection = axis_collection()  # 0.9 m in azimuth, 4.3 m in range
    by_band, by_dwell = ground_spectrum(Geometry(collection=collection), float(np.hypot(9000, 4000)), 0.0)
    coarse, fine = 0.9 / np.hypot(*by_band), 0.9 / np.hypot(*by_dwell)
    assert coarse > 1.5 * fine
    assert not folds((by_band, by_dwell), coarse, fine) and folds((by_band, by_dwell), coarse, coarse)
