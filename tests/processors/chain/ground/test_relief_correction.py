"""Geometric correction on a terrain: taps that take a bend out, and a level terrain that is the plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.kernels.interpolation import bent_errors, bent_taps, interpolation_error, interpolation_taps
from blocksar.processors.chain.ground.correction import correct
from blocksar.processors.chain.ground.ground_map import GroundMap, straighten
from blocksar.processors.chain.ground.relief_correction import (
    DEGREE,
    QUANTITIES,
    bend_scale,
    bent_taps_of,
    locate_on_relief,
    tile_polynomials,
)
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.steps.lines import Line
from blocksar.simulation.scene import Scene

N_TAP, OCCUPANCY, PHASES = 14, 0.62, 8


@pytest.mark.parametrize("bend", [-0.2, 0.0, 0.1, 0.3])  # cycles
def test_bent_taps_interpolate_and_take_the_bend_out(bend: float) -> None:
    real, imag = bent_taps(N_TAP, np.array([bend]), occupancy=OCCUPANCY, n_phase=PHASES)
    assert real.shape == imag.shape == (1, PHASES + 1, N_TAP)
    k = np.arange(N_TAP) - (N_TAP // 2 - 1)
    f = np.linspace(-OCCUPANCY / 2, OCCUPANCY / 2, 101)
    wanted = np.exp(-2j * np.pi * bend * (2 * f / OCCUPANCY) ** 2)
    for p in range(PHASES + 1):
        taps = real[0, p] + 1j * imag[0, p]
        response = (taps * np.exp(-2j * np.pi * f[:, None] * (k - p / PHASES))).sum(axis=1)
        assert np.sqrt(np.mean(np.abs(response - wanted) ** 2)) < 5e-3
    if bend == 0:
        straight = interpolation_taps(N_TAP, occupancy=OCCUPANCY, n_phase=PHASES)
        assert np.abs(real[0] - straight).max() < 1e-5
        assert np.abs(imag).max() < 1e-6


def test_errors_of_bent_taps_are_those_over_the_band() -> None:
    bends = np.array([0.0, 0.1, 0.3])
    errors = bent_errors(8, bends, occupancy=OCCUPANCY)
    assert errors[0] == pytest.approx(interpolation_error(8, OCCUPANCY), rel=1e-2)
    real, imag = bent_taps(8, bends, occupancy=OCCUPANCY, n_phase=2)
    f = np.linspace(-OCCUPANCY / 2, OCCUPANCY / 2, 1001)
    for bend, taps, error in zip(bends, real[:, 1] + 1j * imag[:, 1], errors, strict=True):
        response = sum(tap * np.exp(-2j * np.pi * f * (k - 3.5)) for k, tap in enumerate(taps))
        wanted = np.exp(-2j * np.pi * bend * (2 * f / OCCUPANCY) ** 2)
        assert error == pytest.approx(np.sqrt(np.mean(np.abs(response - wanted) ** 2)), rel=0.1)
    assert (np.diff(errors) > 0).all()


def test_the_bend_of_a_line_is_its_quadratic_phase() -> None:
    time = np.linspace(-0.08, 0.08, 33) + np.array([[0.3], [-0.2]])
    offset, bend = time - time.mean(axis=1, keepdims=True), np.array([[4.0], [-9.0]])
    flat = np.ones_like(time)
    line = Line(
        time=time, doppler=100 + 2 * bend * offset, rate=2 * bend * flat, phase=0.25 + 100 * time + bend * offset**2,
        range=0 * flat, stretch=flat, weight=flat,
    )  # fmt: skip
    straight, found, spots = straighten(line, lambda spots: spots.time)
    assert found == pytest.approx(bend[:, 0], rel=1e-9)
    assert spots.doppler == pytest.approx(100.0, abs=1e-9)
    assert spots.residual.max() < 1e-9
    assert spots.gain == pytest.approx(1.0)
    assert straight.doppler == pytest.approx(100.0)


SCENE = """
[radar]
carrier = 15e9
bandwidth = 50e6
range_sampling = 60e6
prf = 8e3
[track]
position = [0.0, 0.0, 16500.0]
velocity = [-40.0, 1300.0, -600.0]
acceleration = [-15.0, -30.0, -35.0]
[time]
duration = 0.6
[beam]
start_deg = 42.13
stop_deg = 57.87
dwell = 0.162
[scene]
swath = [29800.0, 30200.0]
"""


@pytest.mark.slow
def test_on_a_level_terrain_pixels_are_those_of_the_plane() -> None:
    """The same focused block, white noise, through both corrections, on a plane at 120 m."""
    text = SCENE + "ground_height = 120.0\n"
    collection = Scene.parse(text).collection().centred()
    grid = Grid(16050.0, 16150.0, 1.0, 19150.0, 19240.0, 1.0)
    box = (grid.x0 - 10, grid.x1 + 10), (grid.y0 - 10, grid.y1 + 10)
    plane = plan_collection(collection, blocks=3, grid=grid).blocks[0].ground
    raised = plan_collection(collection, blocks=3, grid=grid, terrain=Terrain.flat(120.0, *box)).blocks[0].ground
    # The gate is fitted with other degrees: the plane's axes and common phase, so that one block serves both.
    raised = replace(
        raised, rows=plane.rows, doppler=plane.doppler, common=plane.common, doppler_taps=plane.doppler_taps
    )
    shape = plane.rows.size, 2 * plane.doppler.size
    block = np.random.default_rng(5).standard_normal(shape, dtype=np.float32).view(np.complex64)
    expected = correct(block, plane, x=grid.x, y=grid.y)
    z = np.full(grid.shape, 120.0)
    z[10, 20] = np.nan
    found = correct(block, raised, x=grid.x, y=grid.y, z=z)
    assert np.isnan(found[10, 20])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected) | np.isnan(z))
    error = np.nanmean(np.abs(found - expected) ** 2) / np.nanmean(np.abs(expected) ** 2)
    assert error < 1e-3  # white noise lies beyond the band too, where the taps of the two are free to differ
    again = correct(block, raised, x=grid.x, y=grid.y, z=z, threads=2)
    np.testing.assert_array_equal(again, found)


def on_hills(swath: list[float]) -> tuple[GroundMap, Terrain, FloatArray, FloatArray]:
    """A block on slopes of 30 degrees, its terrain, and the x and y of some of its pixels."""
    text = SCENE.replace("[29800.0, 30200.0]", str(swath))
    collection = Scene.parse(text).collection().centred()
    x, y = 16050.0 + np.arange(128), 19150.0 + np.arange(128)
    along = np.arange(15000.0, 20200.0, 25.0)
    heights = 150 * np.sin(along / 260)[:, None] * np.sin(along / 260 + 1)
    terrain = Terrain(x0=15000.0, dx=25.0, y0=15000.0, dy=25.0, heights=heights)
    grid = Grid(x[0] - 400, x[-1] + 400, 1.0, y[0] - 400, y[-1] + 400, 1.0)
    return plan_collection(collection, blocks=3, grid=grid, terrain=terrain).blocks[0].ground, terrain, x, y


@pytest.mark.slow
def test_slight_bends_take_fewer_taps() -> None:
    """Noise in the band of these pixels' responses, by 8 taps where they suffice, and by 14 or more."""
    ground, terrain, x, y = on_hills([29800.0, 30200.0])
    z, occupancy, most = terrain.on_grid(x, y), 0.55, 0.3
    assert ground.relief is not None
    few = replace(ground, doppler_taps=(8, occupancy))
    few = replace(few, relief=replace(ground.relief, most_bend=most / bend_scale(few)))
    taps, many = bent_taps_of(few, few.relief)[0], replace(few, doppler_taps=(14, occupancy))
    assert taps.width == (16, 8) and 1 < taps.n_bend[1] < taps.n_bend[0] / 2
    *_, middle, bend = locate_on_relief(few, few.relief, *np.meshgrid(x, y), z)
    assert (np.abs(bend) < taps.n_bend[1] / taps.n_bend[0] * most).all()
    n = ground.doppler.size
    band = np.abs((np.arange(n) / n - middle.mean() + 0.5) % 1 - 0.5) < 0.45 * occupancy
    noise = np.random.default_rng(7).standard_normal((ground.rows.size, 2 * n)).view(np.complex128) * band
    block = np.fft.ifft(noise, axis=1).astype(np.complex64)
    found, exact = (correct(block, each, x=x, y=y, z=z) for each in (few, many))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
    assert 0 < np.nanmean(np.abs(found - exact) ** 2) < 1e-6 * np.nanmean(np.abs(exact) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("swath", [[29800.0, 30200.0], [28000.0, 32000.0]])
def test_polynomials_of_a_tile_are_what_they_stand_for(swath: list[float]) -> None:
    """To 1e-4 of a row, a Doppler sample and a cycle, on slopes of 30 degrees."""
    ground, terrain, x, y = on_hills(swath)
    z = terrain.on_grid(x, y)
    tile = np.array([128]), np.zeros((1, 3), np.int64), np.zeros(1, np.int64)
    coefficients, spans = tile_polynomials(ground, ground.relief, [(x, y)], [z], *tile)
    rows, columns = np.random.default_rng(2).integers(0, 128, (2, 300))
    u, v, w = columns / 63.5 - 1, rows / 63.5 - 1, (z[rows, columns] - spans[0, 0]) / spans[0, 1]
    assert np.abs(w).max() <= 1 + 1e-12
    assert np.ptp(z) > 60
    powers = coefficients.reshape(DEGREE + 1, 3, QUANTITIES, DEGREE + 1)  # of v, w, quantity, u
    found = np.einsum(
        "bhqa,nb,nh,na->qn", powers, *(np.vander(t, n, increasing=True) for t, n in ((v, 4), (w, 3), (u, 4)))
    )
    exact = np.stack(locate_on_relief(ground, ground.relief, x[columns], y[rows], z[rows, columns]))
    error = np.abs(found - exact).max(axis=1)
    assert (error[:3] < 1e-4).all() and (error[3:] < 1e-6).all()
    # A single column extends nowhere.
    alone, _ = tile_polynomials(ground, ground.relief, [(x[:1], y)], [z[:, :1]], *tile)
    assert np.abs(alone.reshape(powers.shape)[..., 1:]).max() < 1e-6


def test_ranges_on_a_terrain_are_those_of_its_points(small_collection: object) -> None:
    geometry = Geometry(collection=small_collection)  # type: ignore[arg-type]
    x, y = np.array([7000.0, 7100.0]), np.array([8000.0, 8200.0])
    ground = Terrain.flat(250.0, (6900.0, 7200.0), (7900.0, 8300.0))
    points = geometry.over(ground).on_ground(x, y)
    assert points[:, 2] == pytest.approx(250.0)
    distance = np.linalg.norm(points - geometry.epoch_position, axis=1)
    assert geometry.over(ground).epoch_range(x, y) == pytest.approx(distance)
    assert geometry.epoch_range(x, y, 250.0) == pytest.approx(distance)
    assert geometry.epoch_range(x, y) != pytest.approx(distance, rel=1e-5)
