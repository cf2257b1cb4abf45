"""Tracks on which the antenna stands still, turns back, scans a raster or repeats: named, with remedies that work."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from near_range import TARGETS, near_range

import blocksar
from blocksar.collection.collection import Collection
from blocksar.collection.track_shape import find_flaw
from blocksar.errors import InputError
from blocksar.stores import history_in_memory

N = 500
INDEX = np.arange(N)
ALONG = (INDEX - N // 2) * 0.01  # m
GRID = "-1.0:0.8:0.05,-0.8:0.8:0.02"


def collection(y: Any, *, x: Any = -10.0, z: Any = 3.0, every: int = 1) -> Collection:
    """A track through y, x and z (n,), m; `every`: as many pulses for each of these."""
    track = np.stack(np.broadcast_arrays(x, y, z), axis=1)
    if every > 1:
        fine = np.arange(len(track) * every) / every
        track = np.stack([np.interp(fine, np.arange(len(track)), axis) for axis in track.T], axis=1)
    n = len(track)
    return Collection(
        carrier=4.3e9, time=(np.arange(n) - n // 2) / 20 / every, range_frequency=(np.arange(64) - 32) * 5e6,
        reference_range=np.full(n, 10.0), antenna_position=track, beam_azimuth=np.full(n, np.nan),
    )  # fmt: skip


def through(*places: tuple[int, float]) -> Any:
    return np.interp(INDEX, *zip(*places, strict=True))


NOISE = np.random.default_rng(1).normal(size=N)
TURN = 2 * np.pi * INDEX / N
LANES = np.concatenate([np.linspace(-3, 3, 100)[:: (-1) ** k] for k in range(5)])
USUAL = {
    "even": ALONG,
    "positions with noise of a step": ALONG + 0.01 * NOISE,
    "uneven speed": ALONG + 0.02 * np.sin(INDEX / 15),
    "speed down to a quarter": ALONG + 0.3 * np.sin(INDEX / 40),
    "a few pulses in one place": through((0, -2), (200, -0.5), (203, -0.5), (499, 2)),
    "a circle": 5 * np.sin(TURN),
}
FLAWS = {
    "hovers first": (np.maximum(ALONG, ALONG[100]), r"stands still at pulses 0 \.\. 100 \(t = -12.5 \.\. -7.5 s\): .*"
                     r"dataset.isel\(pulse=slice\(101, 500\)\)"),
    "hovers last": (np.minimum(ALONG, ALONG[400]), r"at pulses 400 \.\. 499 .*isel\(pulse=slice\(0, 400\)\)"),
    "hovers at both ends": (np.clip(ALONG, ALONG[50], ALONG[450]), r"0 \.\. 50 .* 450 \.\. 499 .*slice\(51, 450\)"),
    "hovers inside": (through((0, -2), (200, -0.5), (260, -0.5), (499, 2)), r"200 \.\. 260 .*even times"),
    "hovers with noise": (np.maximum(ALONG, ALONG[100]) + 0.0005 * NOISE, r"stands still at pulses 0 \.\. 100"),
    "turns back": (through((0, -1), (250, 1), (499, -1)), r"turns back at pulse 250 \(t = 0 s\): .* each way"),
    "turns back twice": (through((0, -1), (160, 1), (320, -1), (499, 1)), r"at pulse 160 .* and at pulse 320"),
    "repeats": (ALONG[INDEX // 10 * 10], r"moves on at 49 of 500 pulses only, by 0.1 m each time; interpolate"),
    "flies lanes": (LANES, r"a raster of 5 rows of some 100 pulses, not one track"),
}  # fmt: skip


@pytest.mark.parametrize("name", USUAL)
def test_usual_tracks_have_no_flaw(name: str) -> None:
    x = 5 * np.cos(TURN) if name == "a circle" else -10.0
    assert find_flaw(collection(USUAL[name], x=x)) is None


@pytest.mark.parametrize("name", FLAWS)
def test_a_flaw_is_named_with_pulses_times_and_remedy(name: str) -> None:
    y, said = FLAWS[name]
    flaw = find_flaw(collection(y, x=-10.0 - 0.5 * (INDEX // 100) if name == "flies lanes" else -10.0))
    assert flaw is not None and re.search(said, str(flaw))


def test_very_many_pulses_are_told_by_some_of_them() -> None:
    flaw = find_flaw(collection(np.maximum(ALONG, ALONG[100]), every=40))
    assert flaw is not None
    last = int(flaw.fact.split("pulses 0 .. ")[1].split()[0])
    assert abs(last - 4000) < 100  # a window is 1 / 64 of 20 000


@pytest.mark.parametrize("serpentine", [False, True])
@pytest.mark.parametrize("columns", [32, 120])
def test_rasters_have_a_sentence_of_their_own(columns: int, serpentine: bool) -> None:
    """Rows of 120 columns fly back by more than 50 steps, which two passes joined into one collection do as well."""
    y, z = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(2.5, 3.5, 6))
    y[1::2] = y[1::2, ::-1] if serpentine else y[1::2]
    flaw = find_flaw(collection(y.ravel(), z=z.ravel()))
    assert flaw is not None and flaw.ways == 6
    assert f"a raster of 6 rows of some {columns} pulses, not one track" in flaw.fact
    assert "each" not in flaw.fact and "one row as a collection" in flaw.remedy


def test_two_passes_are_still_refused() -> None:
    with pytest.raises(InputError, match=r"moves 8\.99 m from pulse 249 to 250"):
        collection(np.concatenate([ALONG[:250], ALONG[:250] - 6.5]))


def amplitudes(folder: Path) -> list[float]:
    image = blocksar.open(folder)["image"]
    return [abs(complex(image.sel(x=x, y=y, method="nearest"))) for x, y, _ in TARGETS]


def scan(rows: int = 8, columns: int = 40) -> Any:
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, columns), np.linspace(1.0, 1.4, rows))
    return np.stack([np.full(y.size, -7.9), y.ravel(), z.ravel()], axis=1)


@pytest.mark.checked
def test_back_projection_forms_what_chains_refuse(tmp_path: Path) -> None:
    """A raster: the refusal ends with the processor that does it; what it then forms is the truth."""
    dataset = blocksar.collection(**near_range(track=scan()))
    settings: dict[str, Any] = {"grid": GRID, "workers": 0}
    with pytest.raises(InputError) as caught:
        blocksar.focus(dataset, tmp_path / "run", **settings, processor="angular-division")
    assert "a raster of 8 rows" in str(caught.value)
    assert "hierarchical back-projection has no such limit: processor hierarchical-backprojection" in str(caught.value)
    assert not (tmp_path / "run" / "image.zarr").exists()
    report = blocksar.focus(dataset, tmp_path / "exact", **settings, processor="backprojection")
    assert any("a raster of 8 rows" in note for note in report.result["warnings"])
    assert not any("it seems" in note or "the track is off" in note for note in report.result["warnings"])
    assert amplitudes(tmp_path / "exact") == pytest.approx([1.0] * len(TARGETS), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("inside", [pytest.param(False, marks=pytest.mark.slow), True])
def test_standing_pulses_left_out_as_the_note_says(inside: bool, tmp_path: Path) -> None:
    n = 360
    stands = (120, 180) if inside else (0, 60)
    index = np.arange(n)
    moved = np.where(index < stands[0], index, np.maximum(index - stands[1], 0) + stands[0])
    track = np.stack([np.full(n, -7.9), (moved - moved[-1] / 2) / 300, np.full(n, 1.2)], axis=1)
    dataset = blocksar.collection(**near_range(track=track))
    flaw = find_flaw(history_in_memory(dataset).collection)
    assert flaw is not None and f"stands still at pulses {stands[0]} .. {stands[1]} " in flaw.fact
    keep = np.r_[0 : stands[0], stands[1] + 1 : n]
    cut = dataset.isel(pulse=keep)
    if inside:
        cut = cut.assign_coords(time=("pulse", (np.arange(keep.size) - keep.size // 2) / 100.0, {"units": "s"}))
    report = blocksar.focus(cut, tmp_path / "run", grid=GRID, workers=0)
    assert not any("stands still" in line for line in report.result["warnings"])
    assert amplitudes(tmp_path / "run") == pytest.approx([1.0] * len(TARGETS), abs=0.02)
