"""The simulator against plain double loops, and what it writes against what the scene asks for."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference
import scipy.fft

from blocksar import stores
from blocksar.collection.beam import dwell_at
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.kernels.chirp import chirp_spectrum
from blocksar.simulation.phase_history import noise, simulate
from blocksar.simulation.scatterers import DIRECT_LIMIT, field, phase_history, raw_echo, simulate_pulses
from blocksar.simulation.scene import Scene

SCENE = """
title = "small"
[radar]
carrier = 10e9
bandwidth = 100e6
range_sampling = 120e6
prf = 1500
pulse_width = 2e-6
[track]
position = [100.0, 200.0, 3000.0]
velocity = [150.0, 10.0, -20.0]
acceleration = [2.0, 1.0, -3.0]
jerk = [1.0, 0.0, 5.0]
[time]
pulses = 151
[beam]
start_deg = 40
stop_deg = 60
width_deg = 8
[scene]
swath = [9800.0, 10200.0]
ground_height = 12.0
reference_range = "scene_centre"
"""


def turned(text: str, by: float) -> str:
    """The small scene with its beam turned by some degrees, ahead of the targets."""
    return text.replace("start_deg = 40", f"start_deg = {40 + by}").replace("stop_deg = 60", f"stop_deg = {60 + by}")


def spread(scene: Scene, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scatterers over the lit sector, and a little beyond: no yaw sits on the edge of a beam."""
    random = np.random.default_rng(seed)
    yaw = random.uniform(scene.lit_yaw[0] - 0.02, scene.lit_yaw[1] + 0.02, n)
    x, y = scene.ground_point(random.uniform(9800, 10200, n), yaw)
    return x, y, random.standard_normal(n) + 1j * random.standard_normal(n)


UNSTEERED = SCENE.replace("[beam]\nstart_deg = 40\nstop_deg = 60\nwidth_deg = 8\n", "") + "centre_yaw_deg = 50\n"
BACKWARDS = SCENE.replace("start_deg = 40", "start_deg = 60").replace("stop_deg = 60", "stop_deg = 40", 1)
SCENES = {"plain": SCENE, "across pi": turned(SCENE, 131), "negative": turned(SCENE, -170), "unsteered": UNSTEERED}


@pytest.fixture(params=[0, 10**9], ids=["transform", "direct"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Either way of summing, whatever the number of scatterers."""
    monkeypatch.setattr(sys.modules["blocksar.simulation.scatterers"], "DIRECT_LIMIT", request.param)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("name", SCENES)
def test_samples_are_those_of_the_double_loop(name: str) -> None:
    scene = Scene.parse(SCENES[name])
    collection = scene.collection()
    x, y, sigma = spread(scene, 150, seed=3)
    pulses = [0, 1, 15, 16, 75, 149, 150]
    expected = reference.phase_history(collection, zip(x, y, sigma, strict=True), pulses)
    found = simulate_pulses(collection, x, y, sigma)
    assert found.dtype == np.complex64
    assert found.shape == (151, collection.n_range_frequency)
    # complex64 rounds to 6e-8 of a sample; the transform errs by 1e-6 of the root sum square of what is lit.
    assert np.abs(found[pulses] - expected).max() < 1e-6 * np.linalg.norm(sigma)
    assert np.linalg.norm(expected) > 1


@pytest.mark.usefixtures("way")
def test_a_target_is_lit_at_exactly_the_pulses_of_its_dwell() -> None:
    for text in (SCENE, BACKWARDS, turned(SCENE, 131)):
        scene = Scene.parse(text)
        collection = scene.collection()
        yaw = scene.centre_yaw + 0.0123
        x, y = scene.ground_point(10e3, yaw)
        lit = np.abs(simulate_pulses(collection, x, y, np.ones(1))).max(axis=1) > 0.5
        assert lit.tolist() == [reference.lit(collection, pulse, float(x), float(y)) for pulse in range(151)]
        first, last = dwell_at(Geometry(collection=collection), np.array(yaw))
        # The dwell ends on the edge of the beam; a pulse is lit if it lies inside.
        assert lit.sum() == pytest.approx(float(last - first) * collection.prf, abs=1)
        assert 0 < lit.sum() < 151


def test_ranges_are_exact_at_table_1() -> None:
    scene = Scene.read("table1")
    collection = scene.collection()
    targets = [(t.x, t.y, t.reflectivity) for t in scene.point_targets()]
    x, y, sigma = map(np.array, zip(*targets, strict=True))
    pulses = slice(2100, 2103)
    found = simulate_pulses(collection, x, y, sigma, pulses=pulses)
    expected = reference.phase_history(collection, targets, range(2100, 2103))
    # Rounding of complex64 at a modulus of some 20.
    assert np.abs(found - expected).max() < 2e-6


@pytest.mark.usefixtures("way")
def test_samples_do_not_depend_on_threads_or_chunks() -> None:
    scene = Scene.parse(SCENE)
    collection = scene.collection()
    x, y, sigma = spread(scene, 3000, seed=1)
    whole = simulate_pulses(collection, x, y, sigma, threads=1)
    assert np.array_equal(whole, simulate_pulses(collection, x, y, sigma, threads=3))
    cut = [simulate_pulses(collection, x, y, sigma, pulses=slice(i, i + 37), threads=2) for i in range(0, 151, 37)]
    assert np.array_equal(whole, np.concatenate(cut))


def test_nothing_lit_is_zero_and_wrong_arrays_are_refused() -> None:
    collection = Scene.parse(SCENE).collection()
    many = np.full(DIRECT_LIMIT + 1, -9000.0)
    assert not simulate_pulses(collection, many, many, many).any()
    assert not simulate_pulses(collection, many[:3], many[:3], many[:3]).any()
    with pytest.raises(ValueError, match=r"x\.size=3, y\.size=2"):
        simulate_pulses(collection, np.ones(3), np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        simulate_pulses(collection, np.full(1, np.nan), np.ones(1), np.ones(1))


def chirp(scene: Scene) -> dict[str, Any]:
    width = scene.radar.pulse_width
    assert width is not None
    return {"fast_time": scene.fast_time, "chirp_rate": scene.radar.bandwidth / width, "pulse_width": width}


def test_raw_echo_is_that_of_the_double_loop() -> None:
    scene = Scene.parse(SCENE)
    collection = scene.collection(raw=True)
    x, y, sigma = spread(scene, 40, seed=2)
    found = raw_echo(field(collection, x, y, sigma), **chirp(scene), pulses=slice(70, 73), threads=2)
    expected = reference.raw_echo(collection, zip(x, y, sigma, strict=True), **chirp(scene), pulses=range(70, 73))
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def compressed(echo: np.ndarray, scene: Scene, collection: Collection, pulses: slice) -> np.ndarray:
    """Range-frequency samples of a raw echo: its spectrum over the chirp's, moved to the reference range."""
    axes, n = chirp(scene), echo.shape[1]
    tau, f = axes.pop("fast_time"), collection.range_frequency
    index = np.rint(f / collection.range_frequency_step).astype(int) % n
    spectrum = scipy.fft.fft(echo.astype(complex), axis=1)[:, index] / scene.radar.range_sampling
    delay = 2 * collection.reference_range[pulses, None] / SPEED_OF_LIGHT - tau[0]
    return spectrum * np.exp(2j * np.pi * f * delay) / chirp_spectrum(f, **axes)


@pytest.mark.parametrize("exact", [True, False])
def test_compressed_raw_echo_is_the_phase_history(exact: bool) -> None:
    scene, pulses = Scene.parse(SCENE), slice(70, 73)
    collection = scene.collection(raw=True)
    scatterers = field(collection, *spread(scene, 60, seed=4))
    expected = phase_history(scatterers, pulses=pulses)
    echo = raw_echo(scatterers, **chirp(scene), pulses=pulses, exact=exact)
    error = np.linalg.norm(compressed(echo, scene, collection, pulses) - expected) / np.linalg.norm(expected)
    # Without an anti-alias filter the sampled chirp folds its spectral tails into the band: the energy beyond
    # half the sampling rate F, some 2 / (pi^2 (F - B / 2) T) = 1 % of it here.
    assert error < (0.15 if exact else 3e-6)


def test_filtered_echo_differs_from_the_exact_one_by_the_tails_only() -> None:
    scene, pulses = Scene.parse(SCENE), slice(70, 73)
    collection = scene.collection(raw=True)
    scatterers = field(collection, *spread(scene, 60, seed=4))
    exact = raw_echo(scatterers, **chirp(scene), pulses=pulses)
    filtered = raw_echo(scatterers, **chirp(scene), pulses=pulses, exact=False)
    assert np.linalg.norm(filtered - exact) < 0.15 * np.linalg.norm(exact)


def test_chirp_spectrum_is_its_fourier_integral() -> None:
    rate, width = 5e13, 2e-6
    f = np.array([-70e6, -50e6, -1e6, 0.0, 30e6, 50e6])
    tau = (np.arange(400_000) + 0.5) / 400_000 * width - width / 2
    integral = np.exp(1j * np.pi * rate * tau**2) @ np.exp(-2j * np.pi * tau[:, None] * f) * width / tau.size
    assert chirp_spectrum(f, chirp_rate=rate, pulse_width=width) == pytest.approx(integral, abs=1e-6 * width)


def test_noise_has_its_power_and_is_the_same_however_the_pulses_are_cut() -> None:
    whole = noise((400, 500), first_pulse=0, power=0.25, seed=9)
    parts = [noise((100, 500), first_pulse=first, power=0.25, seed=9) for first in range(0, 400, 100)]
    assert np.array_equal(whole, np.concatenate(parts))
    # 200000 samples: the mean power strays by 1 / sqrt(200000) = 0.0022 of itself; five times that.
    assert np.mean(np.abs(whole) ** 2) == pytest.approx(0.25, rel=0.011)
    assert abs(np.mean(whole**2)) < 0.011 * 0.25
    assert abs(np.vdot(whole[:-1], whole[1:])) / whole[1:].size < 0.011 * 0.25
    assert not np.array_equal(whole, noise((400, 500), first_pulse=0, power=0.25, seed=10))


TARGETS = """
[[targets]]
name = "one"
ground_range_offset = 30.0
cross_range_offset = -40.0
amplitude = 2.0
phase_deg = 30.0
[[targets]]
name = "two"
range = 9900.0
yaw_deg = 45.0
"""
CLUTTER = "[clutter]\nscatterers = 2000\nseed = 4\n"
NOISE = "[noise]\npower = 0.5\nseed = 8\n"
DROPPED = "[dropped]\npulses = [5]\nranges = [[70, 72]]\n"


def test_store_holds_targets_clutter_noise_and_gaps(tmp_path: Path) -> None:
    scene = Scene.parse(SCENE + TARGETS + CLUTTER + NOISE + DROPPED, name="small")
    seen: list[tuple[int, int]] = []
    path = simulate(scene, tmp_path / "ph.zarr", threads=2, progress=lambda *done: seen.append(done))
    assert seen[-1] == (151, 151)
    store = stores.open_phase_history(path)
    collection = scene.collection()
    for name, value in collection.as_dict().items():
        assert np.array_equal(getattr(store.collection, name), value, equal_nan=isinstance(value, np.ndarray)), name
    signal = store.read(slice(0, 151), slice(0, collection.n_range_frequency))
    lost = np.isnan(signal).all(axis=1)
    assert np.flatnonzero(lost).tolist() == [5, 70, 71, 72]
    assert np.isfinite(signal[~lost]).all()
    expected = simulate_pulses(collection, *scene.scatterers())
    expected += noise(signal.shape, first_pulse=0, power=0.5, seed=8)
    targets = scene.point_targets()
    expected += reference.phase_history(collection, [target[1:] for target in targets])
    # Sums of complex64 numbers of modulus up to some 100.
    assert np.abs(signal - expected)[~lost].max() < 1e-4
    assert store.attrs["scene"] == "small"
    assert store.attrs["noise"] == 0.5
    assert store.attrs["seed"] == {"clutter": 4, "noise": 8}
    assert [target["name"] for target in store.attrs["targets"]] == ["one", "two"]
    assert complex(*store.attrs["targets"][0]["reflectivity"]) == pytest.approx(2 * np.exp(1j * np.pi / 6))
    assert [path.name for path in tmp_path.iterdir()] == ["ph.zarr"]


def test_raw_store_holds_the_chirped_echo(tmp_path: Path) -> None:
    scene = Scene.parse(SCENE + TARGETS + DROPPED)
    store = stores.open_phase_history(simulate(scene, tmp_path / "raw.zarr", raw=True))
    assert store.raw is not None
    assert store.raw.fast_time == pytest.approx(scene.fast_time, abs=1e-15)
    assert (store.raw.chirp_rate, store.raw.pulse_width) == (pytest.approx(5e13), 2e-6)
    collection = scene.collection(raw=True)
    assert store.collection.range_frequency == pytest.approx(collection.range_frequency, abs=1e-3)
    echo = store.read(slice(60, 75), slice(0, scene.fast_time.size))
    targets = [target[1:] for target in scene.point_targets()]
    expected = reference.raw_echo(collection, targets, **chirp(scene), pulses=range(60, 75))
    lost = np.isnan(echo).all(axis=1)
    assert np.flatnonzero(lost).tolist() == [10, 11, 12]
    assert np.abs(echo - expected)[~lost].max() < 1e-5


def test_existing_stores_stay_unless_asked_and_failures_leave_nothing(tmp_path: Path) -> None:
    scene, path = Scene.parse(SCENE + TARGETS), tmp_path / "ph.zarr"
    simulate(scene, path)
    with pytest.raises(InputError, match="exists"):
        simulate(scene, path)
    simulate(scene, path, overwrite=True)
    other = tmp_path / "precious"
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="not overwritten"):
        simulate(scene, other, overwrite=True)
    assert (other / "thesis.txt").exists()

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(scene, tmp_path / "half.zarr", progress=stop)
    with pytest.raises(InputError, match="threads = 0"):
        simulate(scene, tmp_path / "half.zarr", threads=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ph.zarr", "precious"]
