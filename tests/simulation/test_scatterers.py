"""The simulator against plain double loops."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import scipy.fft
import slow_twins
from echoes import SCENE, chirp

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import chirp_spectrum
from blocksar.simulation.scatterers import DIRECT_LIMIT, field, phase_history, raw_echo, simulate_pulses
from blocksar.simulation.scene import Scene


def turned(text: str, by: float) -> str:
    """The small scene with only its beam turned, by this many degrees."""
    return text.replace("start_deg = 40", f"start_deg = {40 + by}").replace("stop_deg = 60", f"stop_deg = {60 + by}")


def spread(scene: Scene, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scatterers over the lit sector and slightly beyond; no yaw coincides with a beam edge."""
    random = np.random.default_rng(seed)
    yaw = random.uniform(scene.lit_yaw[0] - 0.02, scene.lit_yaw[1] + 0.02, n)
    x, y = scene.ground_point(random.uniform(9800, 10200, n), yaw)
    return x, y, random.standard_normal(n) + 1j * random.standard_normal(n)


UNSTEERED = SCENE.replace("[beam]\nstart_deg = 40\nstop_deg = 60\nwidth_deg = 8\n", "") + "centre_yaw_deg = 50\n"
BACKWARDS = SCENE.replace("start_deg = 40", "start_deg = 60").replace("stop_deg = 60", "stop_deg = 40", 1)
SCENES = {"plain": SCENE, "across pi": turned(SCENE, 131), "negative": turned(SCENE, -170), "unsteered": UNSTEERED}


@pytest.fixture(params=[0, 10**9], ids=["transform", "direct"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the two ways of summing, whatever the number of scatterers."""
    monkeypatch.setattr(sys.modules["blocksar.simulation.scatterers"], "DIRECT_LIMIT", request.param)


@pytest.mark.slow
@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("name", SCENES)
def test_samples_equal_those_of_the_double_loop(name: str) -> None:
    scene = Scene.parse(SCENES[name])
    collection = scene.collection()
    x, y, sigma = spread(scene, 150, seed=3)
    pulses = [0, 1, 15, 16, 75, 149, 150]
    expected = slow_twins.phase_history(collection, zip(x, y, sigma, strict=True), pulses)
    found = simulate_pulses(collection, x, y, sigma)
    assert found.dtype == np.complex64
    assert found.shape == (151, collection.n_range_frequency)
    # complex64 rounds to 6e-8 of a sample; the transform errs by 1e-6 of the root sum of squares of the lit scatterers.
    assert np.abs(found[pulses] - expected).max() < 1e-6 * np.linalg.norm(sigma)
    assert np.linalg.norm(expected) > 1


@pytest.mark.usefixtures("way")
def test_a_target_is_lit_by_exactly_the_pulses_of_its_dwell() -> None:
    for text in (SCENE, BACKWARDS, turned(SCENE, 131)):
        scene = Scene.parse(text)
        collection = scene.collection()
        yaw = scene.centre_yaw + 0.0123
        x, y = scene.ground_point(10e3, yaw)
        lit = np.abs(simulate_pulses(collection, x, y, np.ones(1))).max(axis=1) > 0.5
        assert lit.tolist() == [slow_twins.lit(collection, pulse, float(x), float(y)) for pulse in range(151)]
        first, last = Geometry(collection=collection).beam.dwell_at(np.array(yaw), np.zeros(1))
        # The dwell ends at the edge of the beam; a pulse is lit if it lies inside.
        assert lit.sum() == pytest.approx(float(last - first) * collection.prf, abs=1)
        assert 0 < lit.sum() < 151


def test_ranges_are_exact_at_table_1() -> None:
    scene = Scene.read("table1")
    collection = scene.collection()
    targets = [(t.x, t.y, t.reflectivity) for t in scene.point_targets()]
    x, y, sigma = map(np.array, zip(*targets, strict=True))
    pulses = slice(2100, 2103)
    found = simulate_pulses(collection, x, y, sigma, pulses=pulses)
    expected = slow_twins.phase_history(collection, targets, range(2100, 2103))
    # Rounding of complex64 at a modulus of about 20.
    assert np.abs(found - expected).max() < 2e-6


@pytest.mark.slow
@pytest.mark.usefixtures("way")
def test_samples_do_not_depend_on_threads_or_chunks() -> None:
    scene = Scene.parse(SCENE)
    collection = scene.collection()
    x, y, sigma = spread(scene, 3000, seed=1)
    whole = simulate_pulses(collection, x, y, sigma, threads=1)
    assert np.array_equal(whole, simulate_pulses(collection, x, y, sigma, threads=3))
    cut = [simulate_pulses(collection, x, y, sigma, pulses=slice(i, i + 37), threads=2) for i in range(0, 151, 37)]
    assert np.array_equal(whole, np.concatenate(cut))


def test_unlit_samples_are_zero_and_wrong_arrays_are_refused() -> None:
    collection = Scene.parse(SCENE).collection()
    many = np.full(DIRECT_LIMIT + 1, -9000.0)
    assert not simulate_pulses(collection, many, many, many).any()
    assert not simulate_pulses(collection, many[:3], many[:3], many[:3]).any()
    with pytest.raises(ValueError, match=r"x\.size=3, y\.size=2"):
        simulate_pulses(collection, np.ones(3), np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        simulate_pulses(collection, np.full(1, np.nan), np.ones(1), np.ones(1))


def test_raw_echo_equals_that_of_the_double_loop() -> None:
    scene = Scene.parse(SCENE)
    collection = scene.collection(raw=True)
    x, y, sigma = spread(scene, 40, seed=2)
    found = raw_echo(field(collection, x, y, sigma), **chirp(scene), pulses=slice(70, 73), threads=2)
    expected = slow_twins.raw_echo(collection, zip(x, y, sigma, strict=True), **chirp(scene), pulses=range(70, 73))
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def compressed(echo: np.ndarray, scene: Scene, collection: Collection, pulses: slice) -> np.ndarray:
    """Range-frequency samples of a raw echo: its spectrum divided by the chirp's, moved to the reference range."""
    axes, n = chirp(scene), echo.shape[1]
    tau, f = axes.pop("fast_time"), collection.range_frequency
    index = np.rint(f / collection.range_frequency_step).astype(int) % n
    spectrum = scipy.fft.fft(echo.astype(complex), axis=1)[:, index] / scene.radar.range_sampling
    delay = 2 * collection.reference_range[pulses, None] / SPEED_OF_LIGHT - tau[0]
    return spectrum * np.exp(2j * np.pi * f * delay) / chirp_spectrum(f, **axes)


@pytest.mark.parametrize("exact", [True, False])
def test_the_compressed_raw_echo_equals_the_phase_history(exact: bool) -> None:
    scene, pulses = Scene.parse(SCENE), slice(70, 73)
    collection = scene.collection(raw=True)
    scatterers = field(collection, *spread(scene, 60, seed=4))
    expected = phase_history(scatterers, pulses=pulses)
    echo = raw_echo(scatterers, **chirp(scene), pulses=pulses, exact=exact)
    error = np.linalg.norm(compressed(echo, scene, collection, pulses) - expected) / np.linalg.norm(expected)
    # Without an anti-alias filter the spectral tails of the sampled chirp fold into the band: the energy beyond
    # half the sampling rate F, about 2 / (pi^2 (F - B / 2) T) = 1 % of it here.
    assert error < (0.15 if exact else 3e-6)


def test_the_filtered_echo_differs_from_the_exact_one_only_by_the_tails() -> None:
    scene, pulses = Scene.parse(SCENE), slice(70, 73)
    collection = scene.collection(raw=True)
    scatterers = field(collection, *spread(scene, 60, seed=4))
    exact = raw_echo(scatterers, **chirp(scene), pulses=pulses)
    filtered = raw_echo(scatterers, **chirp(scene), pulses=pulses, exact=False)
    assert np.linalg.norm(filtered - exact) < 0.15 * np.linalg.norm(exact)
