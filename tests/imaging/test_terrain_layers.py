"""Incidence angle, visibility and area on hills with shadow and layover, against slow and direct computations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import slow_twins

from blocksar.arrays import FloatArray
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.imaging.terrain_layers import (
    Middles,
    Sight,
    Strip,
    box_about,
    by_owner,
    gamma_factor,
    heights_and_angles,
    heights_on_grid,
    reach,
    visibility,
)

VISIBLE, LAYOVER, SHADOW = 0, 1, 2
GRID = Grid(-1000.0, 1000.0, 4.0, -1000.0, 1000.0, 4.0)
WHOLE = slice(0, GRID.shape[0]), slice(0, GRID.shape[1])
SIGHTS = {
    "broadside": Sight(np.zeros(2), np.zeros(1), np.array([[-3500.0, 100.0, 2500.0]]), np.array([[0.0, 100.0, 0.0]])),
    "squinted": Sight(np.zeros(2), np.zeros(1), np.array([[-3000.0, -1500.0, 2000.0]]), np.array([[20.0, 100.0, 0.0]])),
    "climbing": Sight(np.zeros(2), np.zeros(1), np.array([[3600.0, 800.0, 2900.0]]), np.array([[10.0, 90.0, 3.0]])),
}


def hills() -> Terrain:
    """Two steep hills, a hollow, and ripples; samples every 20 m, beyond the grid on all sides."""
    x, y = np.meshgrid(20.0 * np.arange(-80, 81), 20.0 * np.arange(-80, 81))
    heights = 420 * np.exp(-((x / 230) ** 2) - ((y - 150) / 300) ** 2) + 350 * np.exp(
        -(((x - 500) / 160) ** 2) - ((y + 500) / 160) ** 2
    )
    heights -= 160 * np.exp(-(((x + 600) / 150) ** 2) - ((y + 300) / 150) ** 2)
    return Terrain(x0=-1600.0, dx=20.0, y0=-1600.0, dy=20.0, heights=heights + 10 * np.sin(x / 90) * np.cos(y / 70))


def overlaid(terrain: Terrain, antenna: FloatArray, velocity: FloatArray, x: float, y: float) -> bool:
    """Solve range and Doppler for every height: how often does the curve of those of a point pass the ground?"""
    point = np.array([x, y, float(terrain(np.array(x), np.array(y)))])
    sight = point - antenna
    z = np.arange(terrain.limits[0] - 5, terrain.limits[1] + 5, 0.5)
    along = velocity[:2] / np.linalg.norm(velocity[:2])
    ahead, side = sight[:2] @ along, np.array([-along[1], along[0]])
    side *= np.sign(sight[:2] @ side)  # the antenna looks to one side
    left = sight @ sight - (z - antenna[2]) ** 2 - ahead**2
    places = antenna[:2] + ahead * along + np.sqrt(left)[:, None] * side
    above = z - terrain(places[:, 0], places[:, 1])
    above = above[np.isfinite(above)]
    return int((np.diff(np.sign(above)) != 0).sum()) > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGHTS)
def test_visibility_is_that_of_rays_and_of_range_and_doppler(name: str) -> None:
    terrain, sight = hills(), SIGHTS[name]
    found = visibility(terrain, sight, GRID, WHOLE)
    random = np.random.default_rng(3)
    rows, columns = random.integers(0, GRID.shape[0], 500), random.integers(0, GRID.shape[1], 500)
    wanted = []
    for row, column in zip(rows, columns, strict=True):
        x, y = float(GRID.x[column]), float(GRID.y[row])
        point = np.array([x, y, float(terrain(np.array(x), np.array(y)))])
        if slow_twins.ray_clearance(terrain, sight.position[0], point) < 0:
            wanted.append(SHADOW)
        else:
            wanted.append(LAYOVER if overlaid(terrain, sight.position[0], sight.velocity[0], x, y) else VISIBLE)
    for flag in (VISIBLE, LAYOVER, SHADOW):
        assert (np.array(wanted) == flag).sum() >= 5
    # Only points within a step or two of an edge may differ.
    differ = found[rows, columns] != wanted
    assert differ.mean() <= 0.01
    for row, column in zip(rows[differ], columns[differ], strict=True):
        near = found[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
        assert np.unique(near).size > 1


@pytest.mark.slow
def test_a_window_needs_no_more_of_the_terrain_than_its_reach() -> None:
    terrain = hills()
    for sight in SIGHTS.values():
        whole = visibility(terrain, sight, GRID, WHOLE)
        for window in ((slice(100, 237), slice(200, 330)), (slice(333, 500), slice(0, 71))):
            box = reach(sight, GRID.x[window[1]], GRID.y[window[0]], terrain.limits)
            part = terrain.window(*box)
            assert part.heights.size < terrain.heights.size
            assert (visibility(part, sight, GRID, window) == whole[window]).all()


def test_level_ground_is_visible_and_unknown_ground_is_neither() -> None:
    terrain = Terrain.flat(40.0, (-1600.0, 1600.0), (-1600.0, 1600.0))
    assert (visibility(terrain, SIGHTS["squinted"], GRID, WHOLE) == VISIBLE).all()
    holed = hills()
    holed.heights[60:70, 60:70] = np.nan
    found = visibility(holed, SIGHTS["broadside"], GRID, WHOLE)
    y, x = np.meshgrid(GRID.y, GRID.x, indexing="ij")
    inside = (np.abs(x + 310) < 80) & (np.abs(y + 310) < 80)
    assert (found[inside] == 255).all() and 0 < (found == 255).mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGHTS)
def test_incidence_and_area_are_those_of_small_facets(name: str) -> None:
    """The slant area of a facet is what range and Doppler change by over it, by differences."""
    terrain, sight = hills(), SIGHTS[name]
    part = slice(7, None, 50), slice(3, None, 50)
    y, x = GRID.y[part[0]], GRID.x[part[1]]
    z = terrain.on_grid(x, y)
    angle = heights_and_angles(terrain, sight, GRID, Strip(WHOLE[0], [WHOLE[1]]))[0].angle[part]
    factor = gamma_factor(terrain, sight, x, y)
    antenna, velocity, h = sight.position[0], sight.velocity[0], 0.01

    def facet(px: float, py: float, *, level: float | None) -> tuple[float, float]:
        """cos of the incidence, and slant area over the facet's own."""

        def place(dx: float, dy: float) -> FloatArray:
            ground = float(terrain(np.array(px + dx), np.array(py + dy))) if level is None else level
            return np.array([px + dx, py + dy, ground])

        def seen(point: FloatArray) -> FloatArray:
            """Range, and place along the track at it: the slant plane's axes."""
            sight_line = point - antenna
            speed = np.linalg.norm(velocity)
            distance = np.linalg.norm(sight_line)
            doppler = sight_line @ velocity / speed / distance
            return np.array([distance, -distance * np.arccos(doppler)])  # an angle about the antenna, times range

        a, b = place(h, 0) - place(-h, 0), place(0, h) - place(0, -h)
        normal = np.cross(a, b)
        to_antenna = antenna - place(0, 0)
        cosine = normal @ to_antenna / np.linalg.norm(normal) / np.linalg.norm(to_antenna)
        jacobian = np.stack([seen(place(h, 0)) - seen(place(-h, 0)), seen(place(0, h)) - seen(place(0, -h))])
        # The second axis has range in it, whose part along the first leaves the determinant as it is.
        return float(cosine), abs(float(np.linalg.det(jacobian))) / float(np.linalg.norm(normal))

    for row in range(y.size):
        for column in range(x.size):
            at = float(x[column]), float(y[row])
            cosine, slant = facet(*at, level=None)
            assert angle[row, column] == pytest.approx(np.arccos(cosine), abs=2e-4)
            if np.isfinite(factor[row, column]) and slant > 0.05:
                level_cosine, level_slant = facet(*at, level=float(z[row, column]))
                expected = (slant / cosine) / (level_slant / level_cosine)
                assert factor[row, column] == pytest.approx(expected, rel=5e-3)
    assert np.isfinite(factor).mean() > 0.8


def test_compiled_heights_and_angles_are_those_of_the_terrain() -> None:
    terrain, sight = hills(), SIGHTS["squinted"]
    terrain.heights[60, 70] = np.nan
    # Partly outside, and across the unknown sample.
    grid = Grid(-1700.0, 300.0, 15.0, -1700.0, -100.0, 23.0)
    z = heights_on_grid(terrain, grid.x, grid.y)
    np.testing.assert_array_equal(z, terrain.on_grid(grid.x, grid.y))
    assert 0.01 < np.isnan(z).mean() < 0.5
    for rows in (slice(0, grid.y.size), slice(40, 41)):
        strip = Strip(rows, [slice(0, 40), slice(40, grid.x.size)])
        layers = heights_and_angles(terrain, sight, grid, strip)
        height, rounded, found = (np.concatenate(parts, axis=1) for parts in zip(*layers, strict=True))
        np.testing.assert_array_equal(height, z[rows])
        np.testing.assert_array_equal(rounded, z[rows].astype(np.float32))
        along_x, along_y = terrain.slopes_on_grid(grid.x, grid.y[rows])
        normal = np.stack([-along_x, -along_y, np.ones_like(along_x)])
        ray = sight.position[0][:, None, None] - np.stack([*np.meshgrid(grid.x, grid.y[rows]), z[rows]])
        length = np.linalg.norm(normal, axis=0) * np.linalg.norm(ray, axis=0)
        assert found == pytest.approx(np.arccos((normal * ray).sum(axis=0) / length), abs=1e-6, nan_ok=True)


def _steered() -> Sight:
    """An antenna whose place depends on the yaw of the point."""
    turn = np.linspace(0.3, 1.3, 9)
    position = np.stack([-6000.0 + 900 * turn**2, -3000.0 + 2000 * turn, 4000.0 - 300 * turn], axis=1)
    return Sight(np.array([-6000.0, -2000.0]), turn - 0.8, position, np.gradient(position, axis=0))


def _staying() -> Sight:
    """One whose place depends on the height, too."""
    middles = Middles(
        np.linspace(-1500.0, 1500.0, 7), np.linspace(-1500.0, 1500.0, 5), np.array([-100.0, 200.0]),
        np.random.default_rng(3).uniform(0, 1, (2, 5, 7)),
    )  # fmt: skip
    return replace(_steered(), along=np.linspace(0, 1, 9), middles=middles)


@pytest.mark.parametrize("sight", [_steered(), _staying()])
def test_layers_do_not_depend_on_what_is_found_at_once(sight: Sight) -> None:
    """To the bit: blocks, and the tasks after them, divide an image differently."""
    terrain, grid = hills(), Grid(-1403.0, 1209.0, 11.3, -1350.0, 1120.0, 13.1)
    columns = [slice(64 * k, min(64 * (k + 1), grid.x.size)) for k in range(4)]
    rows = slice(64, min(192, grid.y.size))
    whole = Strip(slice(0, grid.y.size), [slice(0, grid.x.size)])
    height, _, angle = heights_and_angles(terrain, sight, grid, whole)[0]
    assert np.isfinite(angle).all()
    for strip in (Strip(rows, columns), Strip(rows, columns[1:2]), Strip(rows, columns[2:])):
        part = terrain.window(*box_about(grid, strip.whole))
        for window, found in zip(strip.columns, heights_and_angles(part, sight, grid, strip), strict=True):
            np.testing.assert_array_equal(found.height, height[rows, window])
            np.testing.assert_array_equal(found.angle, angle[rows, window])


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, 1.5, 2.4])  # rad
def test_angles_of_level_ground_are_those_to_the_antenna(angle: float) -> None:
    antenna = 1e4 * np.array([-np.sin(angle), 0.0, np.cos(angle)])  # below the ground beyond pi / 2
    sight = Sight(np.zeros(2), np.zeros(1), antenna[None], np.array([[0.0, 100.0, 0.0]]))
    grid = Grid(0.0, 0.5, 1.0, 0.0, 0.5, 1.0)
    found = heights_and_angles(
        Terrain.flat(0.0, (-9.0, 9.0), (-9.0, 9.0)), sight, grid, Strip(slice(0, 1), [slice(0, 1)])
    )
    assert found[0].angle[0, 0] == pytest.approx(angle, abs=3e-7)


def test_a_march_passes_no_place_that_crosses_its_curve() -> None:
    """An unknown sample far away forbids long steps: the terrain beyond could be of any slope."""
    coarse, window = Grid(-1000.0, 1000.0, 16.0, -1000.0, 1000.0, 16.0), (slice(0, 126), slice(0, 126))
    for steep in (0.3, 1.0, 1.8):
        terrain = replace(hills(), heights=steep * hills().heights)
        for sight in SIGHTS.values():
            found = visibility(terrain, sight, coarse, window)
            terrain.heights[0, 0] = np.nan
            np.testing.assert_array_equal(visibility(terrain, sight, coarse, window), found)
            terrain.heights[0, 0] = terrain.heights[0, 1]


def test_slopes_along_range_broadside_change_power_by_the_ratio_of_tangents() -> None:
    x, _ = np.meshgrid(20.0 * np.arange(-60, 61), 20.0 * np.arange(-60, 61))
    terrain = Terrain(x0=-1200.0, dx=20.0, y0=-1200.0, dy=20.0, heights=0.2 * x)
    at = np.array([0.0, 100.0]), np.array([100.0])
    z = terrain.on_grid(*at)
    sight = SIGHTS["broadside"]
    grid = Grid(0.0, 150.0, 100.0, 100.0, 150.0, 100.0)
    angle = heights_and_angles(terrain, sight, grid, Strip(slice(0, 1), [slice(0, 2)]))[0].angle
    level = np.arctan2(np.abs(at[0] - sight.position[0, 0]), sight.position[0, 2] - z)
    assert angle == pytest.approx(level - np.arctan(0.2), abs=1e-6)
    assert gamma_factor(terrain, sight, *at) == pytest.approx(np.tan(angle) / np.tan(level), rel=1e-6)


def test_pixels_are_seen_from_the_block_that_they_come_from() -> None:
    one, other = SIGHTS["broadside"], SIGHTS["climbing"]
    owner = np.array([[0, 1], [2, -1]], np.int16)
    values = {id(one): np.array([[1.0, 2], [3, 4]]), id(other): np.array([[5.0, 6], [7, 8]])}
    layer = by_owner({0: one, 1: other, 2: other}, owner, lambda sight: values[id(sight)], np.nan)
    np.testing.assert_array_equal(layer, [[1.0, 6.0], [7.0, np.nan]])
    np.testing.assert_array_equal(
        by_owner({0: one, 1: other}, 1, lambda sight: values[id(sight)], np.nan), [[5, 6], [7, 8]]
    )
    empty = by_owner({0: one}, np.full((2, 2), -1, np.int16), lambda sight: values[id(sight)], 255)
    assert (empty == 255).all()
