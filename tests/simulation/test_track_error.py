"""Errors of the track: in the samples, not in the store, and kept beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import slow_twins
from echoes import SCENE, chirp

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import truth_place

TARGET = '[[targets]]\nname = "one"\nrange = 9950.0\nyaw_deg = 47.0\n'
ERROR = """
[track.error]
offset = [0.02, 0.0, 0.01]
velocity = [0.1, -0.2, 0.0]
drift = [0.1, 0.05, -0.08]
velocity_random_walk = [0.01, 0.01, 0.02]
position_random_walk = [0.003, 0.0, 0.002]
seed = 3
[[track.error.oscillation]]
amplitude = [0.03, 0.0, 0.03]
frequency = 15.0
phase_deg = [0.0, 0.0, 90.0]
[[track.error.vibration]]
rms = [0.002, 0.001, 0.002]
band = [100.0, 200.0]
"""


def errors(table: str, pulses: int = 4001) -> np.ndarray:
    """The error (n, 3) that a table gives over 4001 pulses of 1 ms."""
    track = Scene.parse(SCENE + "[track.error]\n" + table).track
    assert track.error is not None
    return track.error.positions((np.arange(pulses) - pulses // 2) / 1e3)


def opened(path: object) -> tuple[Collection, np.ndarray, dict[str, object]]:
    store = stores.open_phase_history(str(path))
    return store.collection, store.read(slice(None), slice(None)), store.attrs


def truth_of(path: object) -> np.ndarray:
    with blocksar.stores.open_dataset(truth_place(str(path))) as truth:
        return np.array(truth["antenna_position"])


def moved(collection: Collection, positions: np.ndarray) -> Collection:
    return Collection(**{**collection.as_dict(), "antenna_position": positions})


def test_samples_follow_the_track_as_flown_and_the_store_the_track_as_known(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE + TARGET + ERROR)
    scene = Scene.read(tmp_path / "scene.toml")
    without = Scene.parse(SCENE + TARGET).collection()
    collection, signal, attrs = opened(blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr"))
    for name, value in without.as_dict().items():  # reference_range too: it would tell of the true track
        assert np.array_equal(getattr(collection, name), value, equal_nan=isinstance(value, np.ndarray)), name
    assert set(attrs) == {"Conventions", "title", "history", "scene", "noise", "seed", "targets"}
    assert attrs["seed"] == {}
    truth = truth_of(tmp_path / "ph.zarr")
    assert scene.track.error is not None
    assert np.array_equal(truth, without.antenna_position + scene.track.error.positions(without.time))
    targets = [target[1:4] for target in scene.point_targets()]
    # complex64
    assert np.abs(signal - slow_twins.phase_history(moved(without, truth), targets)).max() < 1e-5
    assert np.abs(signal - slow_twins.phase_history(without, targets)).max() > 1


@pytest.mark.slow
def test_raw_echoes_and_cphd_files_have_it_too(tmp_path: Path) -> None:
    scene = Scene.parse(SCENE + TARGET + ERROR)
    targets = [target[1:4] for target in scene.point_targets()]
    raw = stores.open_phase_history(blocksar.simulate(scene, tmp_path / "raw.zarr", raw=True))
    truth = truth_of(tmp_path / "raw.zarr")
    flown = moved(scene.collection(raw=True), truth)
    expected = slow_twins.raw_echo(flown, targets, **chirp(scene), pulses=range(10, 14))
    assert np.abs(raw.read(slice(10, 14), slice(None)) - expected).max() < 1e-5
    assert np.array_equal(raw.collection.antenna_position, scene.collection().antenna_position)
    blocksar.simulate(scene, tmp_path / "file.cphd", cphd=True)
    # The frame of the ingested store begins at the scene centre.
    inside = truth_of(tmp_path / "file.cphd") + scene.centre
    assert inside == pytest.approx(truth, abs=1e-8)
    blocksar.ingest("cphd", tmp_path / "file.cphd", tmp_path / "ph.zarr")
    collection, signal, _ = opened(tmp_path / "ph.zarr")
    assert collection.antenna_position + scene.centre == pytest.approx(scene.collection().antenna_position, abs=1e-6)
    places = [(x - scene.centre[0], y - scene.centre[1], sigma) for x, y, sigma in targets]
    expected = slow_twins.phase_history(moved(collection, inside - scene.centre), places)
    lit = np.isfinite(signal).all(axis=1) & (np.abs(expected).max(axis=1) > 0)
    # Positions pass through Earth-centred coordinates, whose rounding of 1e-9 m is 1e-6 rad.
    assert np.abs(signal - expected)[lit].max() < 1e-4


def test_parts_of_the_error_are_what_they_say() -> None:
    assert np.array_equal(errors("offset = [1.0, 2.0, 3.0]"), np.tile([1.0, 2.0, 3.0], (4001, 1)))
    assert errors("velocity = [0.5, 0.0, -1.0]")[[0, 2000, -1]] == pytest.approx(
        np.array([[-1, 0, 2], [0, 0, 0], [1, 0, -2]])
    )
    assert errors("drift = [0.1, 0.2, 0.0]")[[0, 2000, 3000, -1], 1] == pytest.approx([0.2, 0.0, 0.05, 0.2])
    wave = errors("[[track.error.oscillation]]\namplitude = [0.0, 0.03, 0.0]\nfrequency = 5.0")
    assert wave[2050] == pytest.approx([0, 0.03, 0])
    noise = errors("seed = 1\n[[track.error.vibration]]\nrms = [0.0, 2e-3, 1e-3]\nband = [40.0, 60.0]")
    # 64 waves with random phases that are not quite orthogonal over 4 s.
    assert noise.std(axis=0) == pytest.approx([0, 2e-3, 1e-3], rel=0.2)
    power = np.abs(np.fft.rfft(noise[:, 1] * np.hanning(4001))) ** 2
    assert power[150:250].sum() > 0.999 * power.sum()  # bins of 0.25 Hz
    for name, order in (("velocity_random_walk", 2), ("position_random_walk", 1)):
        walk = errors(f"seed = 1\n{name} = [0.01, 0.01, 0.0]")
        time = np.arange(4001)
        assert np.abs(np.polyfit(time, walk, 1)).max() < 1e-12
        assert np.sqrt(np.mean(walk**2, axis=0)) == pytest.approx([0.01, 0.01, 0])
        steps = np.diff(walk[:, 0], n=order)
        assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 0.08  # white: five times 1 / sqrt(4000)


def test_parts_are_added_and_do_not_change_each_other() -> None:
    walk = "position_random_walk = [0.01, 0.0, 0.0]\n"
    other = "velocity_random_walk = [0.0, 0.02, 0.0]\n"
    both = errors("seed = 7\n" + walk + other)
    assert np.array_equal(both, errors("seed = 7\n" + walk) + errors("seed = 7\n" + other))
    assert not np.array_equal(both, errors("seed = 8\n" + walk + other))


def test_the_truth_of_a_replaced_store_is_replaced_or_removed(tmp_path: Path) -> None:
    out, plain = tmp_path / "ph.zarr", Scene.parse(SCENE + TARGET)
    blocksar.simulate(Scene.parse(SCENE + TARGET + ERROR), out)
    first = truth_of(out)
    blocksar.simulate(Scene.parse(SCENE + TARGET + ERROR.replace("seed = 3", "seed = 4")), out, overwrite=True)
    assert not np.array_equal(first, truth_of(out))
    blocksar.simulate(plain, out, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["ph.zarr"]
    blocksar.simulate(plain, tmp_path / "ph.truth.zarr")  # somebody's own, under that name
    blocksar.simulate(plain, out, overwrite=True)
    assert (tmp_path / "ph.truth.zarr" / "signal").exists()


def test_an_error_beyond_the_range_window_is_refused(tmp_path: Path) -> None:
    scene = Scene.parse(SCENE + TARGET + "[track.error]\noffset = [300.0, 0.0, 400.0]\n")
    with pytest.raises(InputError, match=r"track\.error reaches 500 m: must stay below .* m, or echoes leave"):
        blocksar.simulate(scene, tmp_path / "ph.zarr")
    assert not list(tmp_path.iterdir())
