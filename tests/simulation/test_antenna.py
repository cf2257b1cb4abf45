"""Beams of scenes about the antenna's own axis, and patterns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import slow_twins
from axis_beams import axis_collection, axis_scene, with_patterns
from scipy.signal.windows import taylor

from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.simulation.antenna import named_pattern
from blocksar.simulation.scatterers import DIRECT_LIMIT, field, raw_echo, simulate_pulses
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import sampler

TRACK = {"velocity": [4.0, 200.0, -2.0], "acceleration": [0.5, 0.5, 0.0], "time": "pulses = 401"}
TARGET = '[[targets]]\nname = "P"\nx = 9000.0\ny = 0.0\n'


def scene(beam: str, *, yaw: float = 0.0) -> Scene:
    return Scene.parse(axis_scene(beam, yaw=yaw, more=TARGET, **TRACK))


def beam_of(text: str, **options: Any) -> Collection:
    return scene(text, **options).collection()


def test_the_axis_lies_along_the_velocity_or_as_given() -> None:
    collection = beam_of('mode = "stripmap"\nwidth_deg = 1.0')
    assert collection.beam_axis is not None and collection.beam_steering is not None
    velocity = np.array([4.0, 200.0, -2.0]) + collection.time[:, None] * [0.5, 0.5, 0.0]
    np.testing.assert_allclose(
        collection.beam_axis, velocity / np.linalg.norm(velocity, axis=1, keepdims=True), atol=1e-5
    )
    assert not collection.beam_steering.any()
    given = beam_of('mode = "stripmap"\nwidth_deg = 1.0\naxis_yaw_deg = 90.0\naxis_pitch_deg = 2.0')
    pitch = np.deg2rad(2)
    np.testing.assert_allclose(given.beam_axis, np.tile([0, np.cos(pitch), np.sin(pitch)], (401, 1)), atol=1e-15)


def test_steering_follows_squint_and_rate_or_a_point() -> None:
    squinted = beam_of('mode = "stripmap"\nwidth_deg = 1.0\nsquint_deg = 10.0', yaw=11.0)
    np.testing.assert_allclose(squinted.beam_steering, np.deg2rad(10.0))
    for mode, rate in (("tops", 4.0), ("sliding-spotlight", -0.3)):
        turning = beam_of(f'mode = "{mode}"\nwidth_deg = 1.0\nsquint_deg = 1.0\nrate_deg = {rate}')
        np.testing.assert_allclose(turning.beam_steering, np.deg2rad(1.0 + rate * turning.time))
    of_scene = scene('mode = "spotlight"\nwidth_deg = 1.0')
    point = "point = [25000.0, 10.0, -4000.0]"
    for text, target in (
        ('mode = "spotlight"\nwidth_deg = 1.0', of_scene.centre),
        (f'mode = "sliding-spotlight"\nwidth_deg = 1.0\n{point}', np.array([25000.0, 10.0, -4000.0])),
    ):
        collection = beam_of(text)
        sight = target - collection.antenna_position
        sine = np.sin(collection.beam_steering) - (sight * collection.beam_axis).sum(axis=1) / np.linalg.norm(
            sight, axis=1
        )
        np.testing.assert_allclose(sine, 0, atol=1e-12)


@pytest.mark.parametrize("name", ["sinc2", "gaussian", "taylor"])
def test_named_patterns_lose_half_of_the_power_one_way_at_the_edges(name: str) -> None:
    offset, amplitude = named_pattern(name, 0.02)
    np.testing.assert_allclose(offset[[0, -1]], [-0.01, 0.01])
    np.testing.assert_allclose(amplitude[[0, offset.size // 2, -1]], [0.5, 1.0, 0.5], rtol=1e-9)
    np.testing.assert_allclose(amplitude, amplitude[::-1], rtol=1e-12)
    assert (np.diff(amplitude[: offset.size // 2]) > 0).all()


@pytest.mark.slow
def test_the_taylor_pattern_is_that_of_scipy_s_window() -> None:
    window = taylor(4096, nbar=4, sll=35, norm=False)
    v = (np.arange(4096) - 2047.5) / 4096
    u = np.linspace(-0.9, 0.9, 2001)
    one_way = np.cos(2 * np.pi * u[:, None] * v) @ window / window.sum()
    edge = np.interp(-np.sqrt(0.5), -one_way[1000:], u[1000:])
    offset, amplitude = named_pattern("taylor", 2.0)
    np.testing.assert_allclose(amplitude, np.interp(offset * edge, u, one_way) ** 2, atol=1e-5)


def test_patterns_of_a_scene() -> None:
    text = 'mode = "stripmap"\nwidth_deg = 1.0\npattern = "taylor"\nelevation_pattern = "gaussian"\n'
    collection = beam_of(text + "elevation_width_deg = 4.0")
    assert collection.beam_offset is not None and collection.elevation is not None
    np.testing.assert_allclose(np.rad2deg(collection.beam_offset[[0, -1]]), [-0.5, 0.5])
    centre = np.rad2deg(np.arcsin(4000 / 9850))
    np.testing.assert_allclose(np.rad2deg(collection.elevation[[0, 128, -1]]), [centre - 2, centre, centre + 2])
    sampled = beam_of(
        "start_deg = -2.0\nstop_deg = 2.0\nwidth_deg = 1.0\npattern = [[-0.6, 0.2], [0.0, 1.0], [0.6, 0.2]]\n"
        "elevation_pattern = [[20.0, 1.0], [30.0, 0.5]]"
    )
    np.testing.assert_allclose(sampled.beam_pattern, [0.2, 1.0, 0.2])
    np.testing.assert_allclose(np.rad2deg(sampled.elevation), [20, 30])


def test_a_beam_that_misses_the_swath_is_refused() -> None:
    with pytest.raises(InputError, match=r"beam\.mode: the beam lights none of the swath"):
        beam_of('mode = "stripmap"\nwidth_deg = 1.0\naxis_yaw_deg = 0.0')


def test_noise_power_is_that_of_the_scene() -> None:
    text = axis_scene('mode = "stripmap"\nwidth_deg = 1.0', more="[noise]\npower = 0.5\nseed = 1\n", **TRACK)
    assert Scene.parse(text).collection().noise_power == 0.5
    assert Scene.parse(text).collection(raw=True).noise_power == 0.5  # of a sample of the echo
    assert beam_of('mode = "stripmap"\nwidth_deg = 1.0').noise_power is None


@pytest.mark.parametrize("mode", ["stripmap", "tops"])
@pytest.mark.parametrize("many", [False, True])
def test_samples_are_those_of_the_double_loop(mode: str, many: bool) -> None:
    collection = with_patterns(axis_collection(mode))
    rng = np.random.default_rng(2)
    n = DIRECT_LIMIT + 20 if many else 6
    x, y = rng.uniform(8950, 9050, n), rng.uniform(-150, 150, n)
    sigma = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    pulses = range(100, 300, 40)
    expected = slow_twins.phase_history(collection, list(zip(x, y, sigma, strict=True)), pulses)
    found = [simulate_pulses(collection, x, y, sigma, pulses=slice(p, p + 1))[0] for p in pulses]
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_raw_echo_is_that_of_the_double_loop() -> None:
    collection = with_patterns(axis_collection())
    targets = [(9000.0, 10.0, 1.0 + 0j), (9020.0, -130.0, 1j)]
    x, y, sigma = (np.array(values) for values in zip(*targets, strict=True))
    delay = 2 * collection.reference_range[0] / 299_792_458.0
    axes: dict[str, Any] = {
        "fast_time": delay + (np.arange(200) - 100) / 60e6, "chirp_rate": 4e13, "pulse_width": 1e-6,
    }  # fmt: skip
    found = raw_echo(field(collection, x, y, sigma), **axes, pulses=slice(190, 192))
    expected = slow_twins.raw_echo(collection, targets, **axes, pulses=range(190, 192))
    expected *= np.array([[slow_twins.gain(collection, p, 9000.0, 10.0)] for p in (190, 191)])
    lit = [slow_twins.lit(collection, 190, *target[:2]) for target in targets]
    assert lit == [True, False]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_range_window_holds_what_the_beam_lights() -> None:
    of = scene('mode = "tops"\nwidth_deg = 1.0\nrate_deg = 4.0')
    collection = of.collection()
    signal = sampler(of, collection)(slice(0, 401))
    lit = [slow_twins.lit(collection, p, 9000.0, 0.0) for p in range(401)]
    np.testing.assert_array_equal(np.abs(signal).max(axis=1) > 0.5, lit)
    assert 20 < sum(lit) < 380
    far = np.hypot(np.hypot(9200, 400), 4000) - collection.reference_range[0]
    assert collection.range_window / 2 > abs(far) * 0.5
