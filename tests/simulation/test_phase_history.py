"""Simulated stores: targets, clutter, noise and gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import slow_twins
from echoes import SCENE, chirp

from blocksar import stores
from blocksar.errors import InputError
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import noise, simulate


def test_noise_has_its_power_and_does_not_depend_on_the_cut_into_pulses() -> None:
    whole = noise((400, 500), first_pulse=0, power=0.25, seed=9)
    parts = [noise((100, 500), first_pulse=first, power=0.25, seed=9) for first in range(0, 400, 100)]
    assert np.array_equal(whole, np.concatenate(parts))
    # 200000 samples: the mean power varies by 1 / sqrt(200000) = 0.0022 of itself; five times that.
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
    expected += slow_twins.phase_history(collection, [target[1:4] for target in targets])
    # Sums of complex64 numbers with a modulus up to about 100.
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
    targets = [target[1:4] for target in scene.point_targets()]
    expected = slow_twins.raw_echo(collection, targets, **chirp(scene), pulses=range(60, 75))
    lost = np.isnan(echo).all(axis=1)
    assert np.flatnonzero(lost).tolist() == [10, 11, 12]
    assert np.abs(echo - expected)[~lost].max() < 1e-5


def test_existing_stores_are_kept_unless_overwrite_is_set_and_failures_leave_nothing(tmp_path: Path) -> None:
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
