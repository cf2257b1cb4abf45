"""Back-projection against an explicit double loop: exact phase, exact beam, reproducible bits."""

from __future__ import annotations

import platform
import re
import tracemalloc
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection
from numba import njit
from slow_twins import back_projection
from turning_beam import around, collection

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging import profiles
from blocksar.imaging.backprojection import accumulate, pulse_block_size
from blocksar.imaging.profiles import UPSAMPLING, range_profiles, spline_error
from blocksar.kernels import projection
from blocksar.kernels.projection import LitPixels
from blocksar.processors.exact.sums import form_image, form_points, image_memory
from blocksar.simulation.scatterers import simulate_pulses

TURN = 2 * np.pi


def noise(collection: Collection, seed: int = 0) -> ComplexArray:
    shape = (collection.n_pulse, 2 * collection.n_range_frequency)
    signal = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32).view(np.complex64)
    signal.flags.writeable = False
    return signal


def form(collection: Collection, signal: ComplexArray, x: FloatArray, y: FloatArray, **options: Any) -> ComplexArray:
    geometry = Geometry(collection=collection)
    return form_points(lambda pulses: signal[pulses], geometry, x, y, **{"threads": 2, **options})


COLLECTIONS: dict[str, dict[str, Any]] = {
    "Table 1": {},
    "unsteered": {"steered": False, "duration": 0.15, "n_pulse": 61},
    "varying reference range": {"reference": "tracked", "n_frequency": 128},
    "t = 0 off the middle, odd number of pulses": {"middle": 0.4, "n_pulse": 241},
    "600 MHz": {"bandwidth": 600e6, "n_frequency": 768, "n_pulse": 120, "reference": "tracked"},
    "baseband not centred": {"frequency_offset": 40e6},
    "scan reversed, negative yaw": {"yaw": np.deg2rad(-50.0), "steering": np.deg2rad(-26.23), "n_frequency": 768},
    "high ground": {"ground_height": 800.0},
    "from 700 km": {"height": 500e3, "ground": 490e3, "reference": "tracked", "n_frequency": 128},
    "so close that the series does not hold": {
        "height": 400.0,
        "ground": 300.0,
        "steered": False,
        "duration": 0.1,
        "n_pulse": 61,
    },
    "looking across yaw = pi": {"yaw": np.deg2rad(179.5), "reference": "tracked", "n_frequency": 128},
}


def patterned(c: Collection) -> Collection:
    """The same with a pattern over elevation, and over the beam where there is one."""
    down = np.arcsin(c.antenna_position[0, 2] / c.reference_range[0])
    patterns = {"elevation": down + np.array([-0.1, 0.1]), "elevation_pattern": np.array([1.0, 0.4])}
    if c.beam_width is not None:
        offset = np.linspace(-c.beam_width / 2, c.beam_width / 2, 129)
        patterns |= {"beam_offset": offset, "beam_pattern": np.sinc(1.2 * offset / c.beam_width) ** 2}
    return Collection(**{**c.as_dict(), **patterns})


# Collection, patterns, weights along range and azimuth, and by how much points lie apart across, m. A beam about its
# axis that swings lights points seven times.
DOUBLE_LOOP = [
    *((name, False, "uniform", "uniform", 300.0) for name in COLLECTIONS),
    ("Table 1", False, "taylor:4:-35", "taylor:4:-35", 3000.0),
    ("unsteered", False, "uniform", "hann", 3000.0),
    ("scan reversed, negative yaw", False, "kaiser:6", "uniform", 3000.0),
    ("looking across yaw = pi", False, "hamming", "kaiser:2.5", 3000.0),
    ("Table 1", True, "uniform", "uniform", 900.0),
    ("unsteered", True, "taylor:4:-35", "taylor:4:-35", 40.0),
    ("stripmap", True, "taylor:4:-35", "taylor:4:-35", 180.0),
    ("squinted", False, "uniform", "kaiser:4", 180.0),
    ("tops", True, "uniform", "kaiser:4", 180.0),
    ("swinging", True, "uniform", "uniform", 300.0),
    ("swinging", False, "taylor:4:-35", "taylor:4:-35", 300.0),
]


@pytest.mark.parametrize(("name", "patterns", "over_band", "over_dwell", "apart"), DOUBLE_LOOP)
def test_back_projection_equals_the_double_loop(
    name: str, patterns: bool, over_band: str, over_dwell: str, apart: float
) -> None:
    """White noise fills the whole band at every range and therefore shows every interpolation error.

    Some pulses and samples are missing, and some dwells are cut.
    """
    rng = np.random.default_rng(1)
    if name in COLLECTIONS:
        c = collection(**COLLECTIONS[name])
        x, y = around(c, rng.uniform(-60, 60, 60), np.append(rng.uniform(-apart, apart, 50), rng.uniform(-50, 50, 10)))
    else:
        swings = {"beam_steering": 0.03 * np.cos(np.linspace(0, 7 * np.pi, 400))} if name == "swinging" else {}
        c = axis_collection("stripmap" if swings else name, **swings)
        ahead = 9000 * np.tan(0.28) if name == "squinted" else 0.0
        x, y = rng.uniform(8950, 9080, 40), ahead + rng.uniform(-apart, apart, 40)
        assert len(Geometry(collection=c).beam.passes(x, y)[0]) == (7 if swings else 1)
    c, signal = patterned(c) if patterns else c, noise(c).copy()
    signal[rng.random(c.n_pulse) < 0.05] = np.nan
    signal[rng.random(signal.shape) < 0.05] = np.nan
    w = Weighting.parse(range=over_band, azimuth=over_dwell)
    expected = back_projection(c, signal, x, y, in_range=w.range, in_azimuth=w.azimuth)
    image = form(c, signal, x, y, weighting=w, pulse_block=64)
    np.testing.assert_array_equal(np.isnan(image), np.isnan(expected))
    assert np.count_nonzero(~np.isnan(image)) >= 10
    error = np.sqrt(np.nanmean(np.abs(image - expected) ** 2) / np.nanmean(np.abs(expected) ** 2))
    assert error < 5e-4  # the spline's error is -69 dB, 3.5e-4; there are few pixels


@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("name", ["Table 1", "unsteered", "from 700 km"])
def test_a_unit_target_has_amplitude_one(name: str, weighting: str) -> None:
    c, w = collection(**COLLECTIONS[name]), Weighting.parse(weighting)
    sigma = np.array([1.0, 0.5j, -1.0])
    tx, ty = around(c, [3.3, -41.0, 30.0], [-2.1, -20.0, 70.0])
    signal = simulate_pulses(c, tx, ty, sigma)
    alone = form(c, simulate_pulses(c, tx[:1], ty[:1], sigma[:1]), tx[:1], ty[:1], weighting=w)
    assert abs(alone[0] - 1) < 2e-3
    x, y = (t[:, None] + np.random.default_rng(2).uniform(-4, 4, (3, 9)) for t in (tx, ty))
    x[:, 0], y[:, 0] = tx, ty
    image = form(c, signal, x, y, weighting=w)
    expected = back_projection(c, signal, x, y, in_range=w.range, in_azimuth=w.azimuth)
    assert np.abs(image - expected).max() < 1e-3  # of the peak, at every pixel: -60 dB


@pytest.mark.slow
def test_the_place_in_the_beam_is_precise_over_every_tile() -> None:
    """Close by, yaw bends within a tile: the tile is divided until a quadratic polynomial holds."""
    c = collection(height=400.0, ground=300.0, n_frequency=128, n_pulse=120, reference="tracked")
    x, y = around(c, np.linspace(-30, 30, 40)[:, None], np.linspace(-30, 30, 40))
    w = Weighting.parse(azimuth="taylor:4:-35")
    image = form(c, noise(c), x, y, weighting=w)
    alone = np.array([form(c, noise(c), x[i, :1], y[i, :1], weighting=w)[0] for i in range(40)])
    np.testing.assert_allclose(image[:, 0], alone, atol=1e-4 * np.nanmax(np.abs(image)))


def test_missing_pulses_and_samples_do_not_change_the_mean() -> None:
    c = collection()
    rng = np.random.default_rng(3)
    tx, ty = around(c, [0.0], [0.0])
    signal = simulate_pulses(c, tx, ty, np.ones(1))
    first, last = (int(bound[0]) for bound in Geometry(collection=c).beam.longest_pass(tx, ty))
    signal[rng.choice(np.arange(first, last), 20, replace=False)] = np.nan
    signal[rng.random(signal.shape) < 0.05] = np.nan
    signal[first + 3, ::2] = complex(1.0, np.nan)
    signal.flags.writeable = False
    x, y = tx + rng.uniform(-4, 4, 20), ty + rng.uniform(-4, 4, 20)
    image, expected = form(c, signal, x, y), back_projection(c, signal, x, y)
    assert np.abs(image - expected).max() < 1e-3
    assert abs(form(c, signal, tx, ty)[0] - 1) < 2e-3


def test_pixels_without_a_valid_lit_pulse_are_nan() -> None:
    c = collection()
    signal = noise(c).copy()
    x, y = around(c, np.zeros(2), [0.0, 12e3])  # the second is far outside the scan
    assert np.isnan(form(c, signal, x, y)).tolist() == [False, True]
    signal[:] = np.nan
    assert np.isnan(form(c, signal, x, y)).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_the_window_ends_where_ranges_become_ambiguous(side: int) -> None:
    """Up to the window's edge, where the spline wraps round the end, the image is exact; beyond, it is NaN."""
    c = collection(reference="tracked", n_frequency=96, n_pulse=60)
    half = c.range_window / 2
    x, y = around(c, side * np.linspace(0.9, 1.4, 2001) * half, np.zeros(2001))
    geometry, signal = Geometry(collection=c), noise(c)
    first, last = geometry.beam.longest_pass(x, y)
    away = np.linalg.norm(np.stack([x, y, 0 * x], -1)[:, None] - c.antenna_position, axis=-1) - c.reference_range
    lit = (np.arange(c.n_pulse) >= first[:, None]) & (np.arange(c.n_pulse) < last[:, None])
    farthest = np.where(lit, np.abs(away), 0).max(axis=1)
    image = form(c, signal, x, y)
    np.testing.assert_array_equal(np.isnan(image), farthest > half)
    edge = np.flatnonzero(farthest <= half)[-3:]
    assert 0.99 < farthest[edge[-1]] / half <= 1
    expected = back_projection(c, signal, x[edge], y[edge])
    assert np.abs(image[edge] - expected).max() < 2e-3 * np.abs(expected).max()


def test_phase_is_exact_at_900_km() -> None:
    """A single frequency needs no interpolation: this tests the phase alone, of 6e7 cycles."""
    c = collection(height=600e3, ground=670e3, carrier=35e9, reference="tracked", n_pulse=100)
    middle = c.n_range_frequency // 2
    signal = np.zeros((c.n_pulse, c.n_range_frequency), np.complex64)
    signal[:, middle] = np.exp(1j * np.random.default_rng(4).uniform(0, TURN, c.n_pulse))
    x, y = around(c, np.linspace(-100, 100, 30), np.linspace(-100, 100, 30))
    image = form(c, signal, x, y) * np.float32(c.n_range_frequency)
    expected = back_projection(c, signal, x, y) * c.n_range_frequency
    assert np.abs(image - expected).max() < 1e-6


@pytest.mark.parametrize("range_km", [30, 700, 900])
def test_the_series_and_the_square_root_agree(range_km: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of which the series holds, formed also by the square root: both are exact.

    In small groups, whose pixels are seen from the middle in float32, to -86 dB.
    """
    place: dict[int, dict[str, Any]] = {30: {}, 700: {"height": 500e3, "ground": 490e3}}
    c = collection(**place.get(range_km, {"height": 600e3, "ground": 670e3, "carrier": 35e9}), reference="tracked")
    x, y = around(c, np.linspace(-30, 30, 70)[:, None], np.linspace(-30, 30, 70))
    used: list[float] = []
    tables = projection.pulse_tables

    def watched(*args: Any, **options: Any) -> tuple[FloatArray, FloatArray]:
        series, roots = tables(*args, **options)
        used.append(float(series[0].mean()))
        return series, roots

    monkeypatch.setattr(projection, "pulse_tables", watched)
    from_middles = form(c, noise(c), x, y)
    monkeypatch.setattr(projection, "MOST_CYCLES", 0.0)
    series = form(c, noise(c), x, y)
    assert set(used) == {1.0}
    used.clear()
    monkeypatch.setattr(projection, "SERIES_ERROR", 0.0)
    images = [form(c, noise(c), x, y, threads=n) for n in (1, 2, 5)]
    assert set(used) == {0.0}
    assert images[0].tobytes() == images[1].tobytes() == images[2].tobytes()
    assert np.abs(series - images[0]).max() < 2e-6 * np.abs(series).max()
    assert 0 < np.abs(from_middles - series).max() < 5e-5 * np.abs(series).max()


def test_a_profile_too_long_to_address_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    c = collection(n_frequency=64)
    monkeypatch.setattr(profiles, "FIXED_RANGE", 128.0)
    with pytest.raises(ValueError, match="64 range frequencies make 384 bins; at most 256"):
        range_profiles(noise(c)[:1], collection=c, pulses=slice(0, 1), threads=1)


def test_the_interpolation_error_is_below_60_db() -> None:
    """One pulse, many ranges: the measured error agrees with that of the spline's frequency response."""
    c = collection(reference="tracked", n_frequency=500)
    geometry, p = Geometry(collection=c), c.n_pulse // 2
    x, y = around(c, np.linspace(-500, 500, 2000)[None], np.zeros((1, 2000)))
    signal = noise(c)[p : p + 1]
    formed = range_profiles(signal, collection=c, pulses=slice(p, p + 1), threads=1)
    image, outside = np.zeros(x.shape, np.complex64), np.zeros(x.shape, np.bool_)
    pixels = LitPixels(x, y, 0 * x, np.full(x.shape, p), np.full(x.shape, p + 1))
    accumulate(image, outside, formed, geometry=geometry, pixels=pixels, threads=1)
    distance = np.linalg.norm(np.stack([x, y, 0 * x], -1)[0] - c.antenna_position[p], axis=1) - c.reference_range[p]
    steering = np.exp(4j * np.pi / SPEED_OF_LIGHT * np.multiply.outer(distance, c.carrier + c.range_frequency))
    expected = steering @ signal[0].astype(np.complex128) / c.n_range_frequency
    error = np.sqrt(np.mean(np.abs(image[0] - expected) ** 2) / np.mean(np.abs(expected) ** 2))
    predicted = spline_error(upsampling=UPSAMPLING)
    assert predicted < 1e-3
    assert 0.8 * predicted < error < 1.2 * predicted
    carried = np.exp(4j * np.pi / SPEED_OF_LIGHT * (c.carrier + c.range_frequency[c.n_range_frequency // 2]) * distance)
    few = formed.at(np.zeros(1, np.int64), distance[None])[0] * carried
    assert np.abs(few - image[0]).max() < 1e-4 * np.abs(expected).max()


def test_the_number_of_threads_changes_no_bit() -> None:
    c = collection(n_frequency=256, reference="tracked")
    x, y = around(c, 0.0, 0.0)
    columns, rows = x + np.arange(-75, 75) * 1.5, y + np.arange(-70, 71) * 1.5
    signal, geometry = noise(c), Geometry(collection=c)
    images = [form_image(lambda p: signal[p], geometry, columns, rows, threads=n) for n in (1, 2, 5)]
    assert images[0].shape == (141, 150)
    assert images[0].tobytes() == images[1].tobytes() == images[2].tobytes()
    small = form_image(lambda p: signal[p], geometry, columns, rows, threads=2, pulse_block=13)
    assert np.nanmax(np.abs(small - images[0])) < 1e-6 * np.nanmax(np.abs(images[0]))  # float32 sums in another order


def test_form_image_lays_columns_along_x() -> None:
    c = collection(reference="tracked", n_frequency=128)
    tx, ty = around(c, 6.0, 10.0)
    signal = simulate_pulses(c, np.atleast_1d(tx), np.atleast_1d(ty), np.ones(1))
    columns, rows = tx + np.arange(-3, 9) * 2.0, ty + np.arange(-5, 4) * 2.0
    image = form_image(lambda p: signal[p], Geometry(collection=c), columns, rows, threads=1)
    assert np.unravel_index(np.abs(image).argmax(), image.shape) == (5, 3)
    mesh = form(c, signal, *np.meshgrid(columns, rows))
    assert image.tobytes() == mesh.tobytes()


@pytest.mark.parametrize("shape", [(), (0,), (3, 0), (5,), (2, 3, 2)])
def test_points_of_any_shape(shape: tuple[int, ...]) -> None:
    c = collection(reference="tracked", n_frequency=64)
    rng = np.random.default_rng(6)
    x, y = around(c, rng.uniform(-9, 9, shape), rng.uniform(-9, 9, shape))
    image = form(c, noise(c), x, y)
    assert image.shape == shape and not np.isnan(image).any()
    flat = form(c, noise(c), x.ravel(), y.ravel())
    assert image.tobytes() == flat.tobytes()


def test_only_lit_pulses_are_read_each_once_and_in_order() -> None:
    c = collection(n_frequency=64, n_pulse=480, reference="tracked")
    geometry = Geometry(collection=c)
    # Two chips whose dwells do not overlap: no pixel needs the pulses between them.
    x, y = around(c, np.zeros(2), [-1800.0, 1800.0])
    first, last = geometry.beam.longest_pass(x, y)
    assert 0 < last[0] < first[1]
    asked: list[slice] = []

    def read(pulses: slice) -> ComplexArray:
        asked.append(pulses)
        return noise(c)[pulses]

    form_points(read, geometry, x, y, threads=1, pulse_block=20)
    read_pulses = np.concatenate([np.arange(s.start, s.stop) for s in asked])
    assert max(s.stop - s.start for s in asked) <= 20
    lit = np.concatenate([np.arange(*interval) for interval in zip(first, last, strict=True)])
    np.testing.assert_array_equal(read_pulses, lit)


@pytest.mark.slow
def test_memory_stays_within_the_stated_bound() -> None:
    c = collection(n_frequency=400, n_pulse=1200, reference="tracked")
    signal, geometry = noise(c), Geometry(collection=c)
    x, y = around(c, 0.0, 0.0)
    columns, rows = x + np.arange(600) * 0.2, y + np.arange(500) * 0.2

    def image() -> ComplexArray:
        return form_image(lambda p: signal[p].copy(), geometry, columns, rows, threads=2)

    form_points(lambda p: signal[p], geometry, np.array(x), np.array(y), threads=2)  # compiles
    tracemalloc.start()
    image()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    bound = image_memory(columns.size * rows.size, c, threads=2)
    assert 0.5 * bound < peak < bound
    assert image_memory(0, c) < 4 * 8 * pulse_block_size(c) * 6 * c.n_range_frequency


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in {"x86_64", "AMD64"}, reason="reads x86 assembly")
def test_the_inner_loop_is_vectorised() -> None:
    """Compile afresh, since the cache does not keep the assembly: its square roots are packed, and it calls nothing."""
    c = collection(n_frequency=64, reference="tracked")
    form(c, noise(c), *around(c, np.zeros((2, 2)), np.zeros((2, 2))))
    kernel = projection.add_pulses.dispatcher
    fresh = njit(nogil=True, fastmath=kernel.targetoptions["fastmath"])(kernel.py_func)
    fresh.compile(kernel.signatures[0])
    (assembly,) = fresh.inspect_asm().values()
    assert re.search(r"sqrtpd", assembly)
    assert not re.search(r"sqrtsd", assembly)
