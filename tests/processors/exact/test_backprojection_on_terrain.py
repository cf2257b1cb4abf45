"""Back-projection and simulation on a terrain, against double loops that take each point's own height."""

from __future__ import annotations

import numpy as np
import pytest
import slow_twins
from axis_beams import axis_collection, with_patterns
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.processors.exact.sums import form_image, form_points
from blocksar.simulation.scatterers import field, phase_history, raw_echo, simulate_pulses


def at_height(collection: Collection, z: float) -> Collection:
    return Collection(**{**collection.as_dict(), "ground_height": z})


def centre(collection: Collection) -> NDArray[np.float64]:
    return Geometry(collection=collection).ground_point(np.array(12_000.0), np.radians(50.0))


def hills(collection: Collection, *, relief: float = 200.0) -> Terrain:
    x, y, _ = centre(collection)
    along = np.linspace(-400, 400, 41)
    heights = relief * np.sin(along / 90.0)[:, None] * np.cos(along / 120.0)
    return Terrain(x0=x - 400, dx=20.0, y0=y - 400, dy=20.0, heights=heights + 150.0)


def noise(collection: Collection) -> ComplexArray:
    shape = collection.n_pulse, 2 * collection.n_range_frequency
    return np.random.default_rng(3).standard_normal(shape, dtype=np.float32).view(np.complex64)


@pytest.mark.slow
@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("near", [False, True])
def test_pixels_at_their_heights_equal_the_double_loop(
    small_collection: Collection, weighting: str, near: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    c, signal = small_collection, noise(small_collection)
    if near:  # square roots in place of the series
        monkeypatch.setattr("blocksar.kernels.projection.SERIES_ERROR", 0.0)
    geometry = Geometry(collection=c).over(hills(c))
    random = np.random.default_rng(1)
    x, y = (centre(c)[axis] + random.uniform(-60, 60, 40) for axis in (0, 1))
    assert geometry.terrain is not None
    z = geometry.terrain(x, y)
    assert np.ptp(z) > 50
    tapers = Weighting.parse(weighting)
    image = form_points(lambda pulses: signal[pulses], geometry, x, y, threads=1, weighting=tapers)
    given = {"in_range": tapers.range, "in_azimuth": tapers.azimuth}
    expected = np.array(
        [
            slow_twins.back_projection(at_height(c, float(h)), signal, np.array([a]), np.array([b]), **given)[0]
            for a, b, h in zip(x, y, z, strict=True)
        ]
    )
    np.testing.assert_array_equal(np.isnan(image), np.isnan(expected))
    assert np.isfinite(image).sum() > 20
    error = np.sqrt(np.nanmean(np.abs(image - expected) ** 2) / np.nanmean(np.abs(expected) ** 2))
    assert error < 5e-4  # the spline's, as on the plane


@pytest.mark.slow
@pytest.mark.parametrize(("weighting", "patterns"), [("uniform", False), ("taylor:4:-35", True)])
def test_beams_about_their_axis_light_pixels_at_their_heights(weighting: str, patterns: bool) -> None:
    """Heights of 400 m move the dwells of a beam at 14 degrees by a third of their length."""
    c = axis_collection("squinted")
    c, signal = with_patterns(c) if patterns else c, noise(c)
    random = np.random.default_rng(2)
    x, y = 9000 + random.uniform(-80, 80, 24), 2515 + random.uniform(-80, 80, 24)
    along = np.linspace(-100, 100, 26)
    heights = 200 + 200 * np.sin(along / 30)[:, None] * np.cos(along / 40)
    terrain = Terrain(x0=8900.0, dx=8.0, y0=2415.0, dy=8.0, heights=heights)
    geometry, z, tapers = Geometry(collection=c).over(terrain), terrain(x, y), Weighting.parse(weighting)
    levels = [(at_height(c, float(h)), np.array([a]), np.array([b])) for a, b, h in zip(x, y, z, strict=True)]
    lit = np.array([[slow_twins.lit(of, p, float(a[0]), float(b[0])) for p in range(400)] for of, a, b in levels])
    np.testing.assert_array_equal(geometry.beam.is_lit(x, y), lit)
    first, last = geometry.beam.longest_pass(x, y)
    np.testing.assert_array_equal(last - first, lit.sum(axis=1))
    plane_first, plane_last = Geometry(collection=c).beam.longest_pass(x, y)
    assert np.ptp(first - plane_first) > 20 < np.ptp(last - plane_last)
    image = form_points(lambda pulses: signal[pulses], geometry, x, y, threads=1, weighting=tapers)
    given = {"in_range": tapers.range, "in_azimuth": tapers.azimuth}
    expected = np.array([slow_twins.back_projection(of, signal, a, b, **given)[0] for of, a, b in levels])
    assert np.isfinite(expected).sum() > 15
    np.testing.assert_array_equal(np.isnan(image), np.isnan(expected))
    error = np.sqrt(np.nanmean(np.abs(image - expected) ** 2) / np.nanmean(np.abs(expected) ** 2))
    assert error < 5e-4


def test_a_level_terrain_is_the_plane_and_unknown_heights_are_not_covered(small_collection: Collection) -> None:
    c, signal = small_collection, noise(small_collection)
    x, y = (centre(c)[axis] + np.arange(-40.0, 40.0, 4.0) for axis in (0, 1))
    box = (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1]))
    plane = form_image(lambda pulses: signal[pulses], Geometry(collection=c), x, y, threads=1)
    level = Terrain.flat(0.0, *box)
    same = form_image(lambda pulses: signal[pulses], Geometry(collection=c).over(level), x, y, threads=1)
    scale = np.sqrt(np.nanmean(np.abs(plane) ** 2))
    assert np.nanmax(np.abs(same - plane)) < 1e-5 * scale
    heights = np.zeros((41, 41))
    heights[:, :20] = np.nan
    holed = Terrain(x0=x[0] - 4, dx=4.0, y0=y[0] - 4, dy=4.0, heights=heights)
    image = form_image(lambda pulses: signal[pulses], Geometry(collection=c).over(holed), x, y, threads=1)
    np.testing.assert_array_equal(np.isnan(image), np.isnan(plane) | ~np.isfinite(holed.on_grid(x, y)))


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 600])  # direct sums, and the non-uniform transform
def test_echoes_come_from_the_scatterers_heights(small_collection: Collection, n: int) -> None:
    c, random = small_collection, np.random.default_rng(4)
    x, y = (centre(c)[axis] + random.uniform(-150, 150, n) for axis in (0, 1))
    z, sigma = hills(c)(x, y), random.standard_normal(n) + 1j * random.standard_normal(n)
    pulses = slice(120, 124)
    made = phase_history(field(c, x, y, sigma, z), pulses=pulses)
    expected = sum(
        slow_twins.phase_history(at_height(c, float(h)), [(a, b, s)], range(120, 124))
        for a, b, h, s in zip(x, y, z, sigma, strict=True)
    )
    assert np.abs(made - expected).max() < 1e-4 * np.sqrt(n)
    flat = simulate_pulses(c, x, y, sigma, pulses=pulses)
    assert np.abs(made - flat).max() > 1.0
    level = phase_history(field(c, x, y, sigma, np.zeros(n)), pulses=pulses)
    assert np.abs(level - flat).max() < 1e-5 * np.sqrt(n)


def test_raw_echoes_come_from_the_scatterers_heights(small_collection: Collection) -> None:
    c = small_collection
    x, y, z = centre(c)[0] + np.array([0.0, 30.0]), centre(c)[1] + np.array([0.0, -20.0]), np.array([180.0, -90.0])
    fast_time = (2 * 12_000.0) / 299_792_458.0 + np.arange(-400, 400) / 60e6
    chirp = {"fast_time": fast_time, "chirp_rate": 50e6 / 4e-6, "pulse_width": 4e-6}
    made = raw_echo(field(c, x, y, np.ones(2), z), **chirp, pulses=slice(126, 129))
    expected = sum(
        slow_twins.raw_echo(at_height(c, float(h)), [(a, b, 1.0)], **chirp, pulses=range(126, 129))
        for a, b, h in zip(x, y, z, strict=True)
    )
    assert np.abs(made).max() > 0.9
    assert np.abs(made - expected).max() < 1e-5
