"""Back-projection of two antennas: half the way there and back against the definition, summed in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.weighting import Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.imaging.recorded_pulses import distances_at
from blocksar.measurement.figures import ideal_response
from blocksar.planning.ambiguity import worst_ambiguity
from blocksar.processors.exact.sums import form_points

N, CARRIER = 160, 10e9
TIME: FloatArray = (np.arange(N) - N / 2) / 400.0
BAND: FloatArray = (np.arange(96) - 48) * 1e6


def flown(distance: float, bearing: float, height: float, speed: float) -> FloatArray:
    """A straight track across the line of sight, whose middle lies at a bearing from the scene, degrees."""
    u = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))])
    ground = -distance * u + np.outer(speed * TIME, [-u[1], u[0]])
    return np.column_stack([ground, np.full(N, height)])


PAIRS: dict[str, dict[str, Any]] = {
    "40 degrees between": {"t": flown(8000.0, -20.0, 5000.0, 150.0), "r": flown(7000.0, 20.0, 4000.0, 120.0)},
    "a receiver that stands still": {"t": flown(9000.0, -15.0, 6000.0, 200.0), "r": flown(600.0, 30.0, 80.0, 0.0)},
    "forward scatter": {"t": flown(9000.0, 0.0, 6000.0, 200.0), "r": flown(5000.0, 120.0, 3000.0, 150.0)},
}


def pair(name: str, **fields: Any) -> Collection:
    t, r = PAIRS[name]["t"], PAIRS[name]["r"]
    return Collection(
        carrier=CARRIER, time=TIME, range_frequency=BAND, antenna_position=t, transmitter_position=t,
        receiver_position=r, reference_range=(np.linalg.norm(t, axis=1) + np.linalg.norm(r, axis=1)) / 2,
        beam_azimuth=np.full(N, np.nan), **fields,
    )  # fmt: skip


def half_way(c: Collection, x: float, y: float) -> FloatArray:
    assert c.transmitter_position is not None and c.receiver_position is not None
    point = np.array([x, y, c.ground_height])
    ways = [np.linalg.norm(point - antenna, axis=1) for antenna in (c.transmitter_position, c.receiver_position)]
    return np.asarray((ways[0] + ways[1]) / 2)


def echoes(c: Collection, x: float, y: float) -> np.ndarray:
    away = half_way(c, x, y) - c.reference_range
    return np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(away, c.carrier + c.range_frequency)).astype(np.complex64)


def double_sum(c: Collection, signal: np.ndarray, x: FloatArray, y: FloatArray) -> np.ndarray:
    total = np.zeros(x.shape, complex)
    for k, place in enumerate(zip(x, y, strict=True)):
        away = half_way(c, *place) - c.reference_range
        turned = np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(away, c.carrier + c.range_frequency))
        total[k] = np.nanmean(signal * turned)
    return total


def form(c: Collection, signal: np.ndarray, x: FloatArray, y: FloatArray, **options: Any) -> np.ndarray:
    return form_points(lambda p: signal[p], Geometry(collection=c), x, y, threads=2, **options)


@pytest.mark.parametrize("name", PAIRS)
def test_back_projection_equals_the_double_sum(name: str) -> None:
    c, rng = pair(name), np.random.default_rng(0)
    signal = rng.standard_normal((N, 2 * BAND.size), dtype=np.float32).view(np.complex64)
    signal[3], signal[5, 7:11] = np.nan, np.nan
    x, y = rng.uniform(-25, 25, (2, 50))
    expected, image = double_sum(c, signal, x, y), form(c, signal, x, y)
    assert np.sqrt(np.mean(np.abs(image - expected) ** 2) / np.mean(np.abs(expected) ** 2)) < 5e-4  # the spline's
    at = np.array([7.0]), np.array([-11.0])
    assert abs(form(c, echoes(c, 7.0, -11.0), *at)[0] - 1) < 1e-3
    assert abs(form(c, echoes(c, 7.0, -11.0), *at, weighting=Weighting.parse("taylor:4:-35"))[0] - 1) < 1e-3


def test_two_antennas_at_one_place_are_one_antenna() -> None:
    both = pair("40 degrees between")
    c = Collection(**{**both.as_dict(), "receiver_position": both.transmitter_position})
    one = Collection(**{**c.as_dict(), "transmitter_position": None, "receiver_position": None})
    x, y = np.random.default_rng(1).uniform(-25, 25, (2, 64))
    signal = echoes(c, 5.0, 5.0)
    np.testing.assert_allclose(form(c, signal, x, y), form(one, signal, x, y), atol=2e-5)


def test_ground_beyond_the_window_of_half_ways_is_left_out() -> None:
    c = pair("40 degrees between")
    x = np.linspace(-300.0, 300.0, 61)
    away = np.array([np.abs(half_way(c, at, 0.0) - c.reference_range).max() for at in x])
    image = form(c, echoes(c, 0.0, 0.0), x, np.zeros(61))
    np.testing.assert_array_equal(np.isnan(image), away > c.range_window / 2)


@pytest.mark.parametrize("name", ["40 degrees between", "a receiver that stands still"])
def test_resolution_and_response_follow_the_gradient_of_the_half_way(name: str) -> None:
    c = pair(name).centred()
    geometry, rng = Geometry(collection=c), np.random.default_rng(2)
    at = np.array([0.0]), np.array([0.0])
    width, _ = ground_resolution(geometry, float(geometry.epoch_range(*at)[0]), float(geometry.yaw(*at)[0]))
    step = 1e-3
    slope = np.hypot(*[
        (half_way(c, step * i, step * j) - half_way(c, -step * i, -step * j))[N // 2] / (2 * step)
        for i, j in ((1, 0), (0, 1))
    ])  # fmt: skip
    assert width == pytest.approx(0.8859 * SPEED_OF_LIGHT / 2 / c.bandwidth / slope, rel=1e-3)
    x, y = rng.uniform(-6, 6, (2, 50))
    found = ideal_response(geometry, (0.0, 0.0), x, y)
    assert np.abs(found - double_sum(c, echoes(c, 0.0, 0.0), x, y)).max() < 6e-3
    time = c.time[[20, 90]]
    x, y, z = (np.full((2, 1), value) for value in (3.0, 4.0, 0.0))
    expected = half_way(c, 3.0, 4.0)[[20, 90]]
    np.testing.assert_allclose(distances_at(geometry, x, y, z, time[:, None])[:, 0], expected, atol=1e-6)


def test_the_strongest_ghost_is_that_of_an_image() -> None:
    """Every eighth pulse only: Doppler folds."""
    whole = pair("a receiver that stands still")
    by_pulse = ("time", "reference_range", "transmitter_position", "receiver_position", "beam_azimuth")
    c = Collection(**{**whole.as_dict(), **{name: getattr(whole, name)[::8] for name in by_pulse}})
    geometry = Geometry(collection=c)
    found = worst_ambiguity(geometry, Grid(-60.0, 60.0, 1.0, -60.0, 60.0, 1.0))
    assert found is not None and found.amplitude > 0.05
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-4, 4, 0.2), np.arange(-4, 4, 0.1)))
    image = form(c, echoes(c, *found.source), found.ghost[0] + x, found.ghost[1] + y)
    assert np.nanmax(np.abs(image)) == pytest.approx(found.amplitude, rel=0.15)


def test_a_mimo_frame_at_three_metres() -> None:
    """Twelve pairs of 3 x 4 elements, one after the other; at 3 m their virtual positions would not do."""
    t = np.array([[0.0, -0.5, 1.2], [0.0, 0.0, 1.2], [0.0, 0.5, 1.2]])
    r = np.column_stack([np.zeros(4), np.linspace(-0.1, 0.1, 4), np.full(4, 1.0)])
    pairs = np.array([(i, j) for i in range(3) for j in range(4)])
    c = Collection(
        carrier=9e9, time=np.arange(12) * 1e-3, range_frequency=BAND * 20, antenna_position=t[pairs[:, 0]],
        transmitter_position=t[pairs[:, 0]], receiver_position=r[pairs[:, 1]], reference_range=np.full(12, 3.0),
        beam_azimuth=np.full(12, np.nan),
    )  # fmt: skip
    signal, rng = echoes(c, 2.8, 0.3), np.random.default_rng(3)
    x, y = np.append(2.8 + rng.uniform(-0.2, 0.2, 20), 2.8), np.append(0.3 + rng.uniform(-0.2, 0.2, 20), 0.3)
    image = form(c, signal, x, y)
    assert abs(image[-1] - 1) < 1e-3
    assert np.abs(image - double_sum(c, signal, x, y)).max() < 1e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"receiver_position": None}, "transmitter_position is given without receiver_position"),
        ({"receiver_position": np.zeros((3, 3))}, r"receiver_position has shape \(3, 3\)"),
        ({"receiver_position": np.tile([0.0, 0.0, -5.0], (N, 1))}, "receiver_position falls to z = -5 m"),
        ({"beam_azimuth": np.zeros(N), "beam_width": 0.1}, "beam_azimuth is given with transmitter_position"),
    ],
)
def test_what_is_no_pair_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Collection(**{**pair("40 degrees between").as_dict(), **change})
