"""Interference in collections: images are those without it, whatever forms them; without any, no bit changes."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from scenes import scene

import blocksar
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene

TARGET = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\namplitude = 3.0\n'
CLUTTER = (
    "[clutter]\nscatterers = 1000\nseed = 3\nrange = [29850.0, 30150.0]\nyaw_deg = [49.2, 50.8]\npower = 0.0005\n"
    "[noise]\npower = 1.0\nseed = 5\n"
)
NOISE = "[noise]\npower = 1.0\nseed = 5\n"
POWER = 11.0  # of the samples of target, clutter and noise, about
AREA: dict[str, Any] = {
    "bandwidth": 100e6, "range_sampling": 120e6, "steering": (49.2, 50.8), "duration": 0.14,
    "swath": [29850.0, 30150.0],
}  # fmt: skip
TONE, BAND, PULSED = (101.4, 40.0), (150, 4, 40.0), (30.3, 30.0)  # frequency and dB over the samples; 1 MHz: four


def interfered(store: Path, out: Path, *, tones: bool = True) -> Path:
    """Copy a phase history with a band of 1 MHz, and with two tones, one of them in a quarter of the pulses."""
    shutil.copytree(store, out)
    signal = zarr.open_group(str(out), mode="r+")["signal"]
    samples, rng = np.asarray(signal[:]), np.random.default_rng(7)
    p, f = samples.shape
    noise = (rng.standard_normal((p, 4)) + 1j * rng.standard_normal((p, 4))) / np.sqrt(2)
    added = np.zeros((p, f), complex)
    added[:, BAND[0] : BAND[0] + BAND[1]] = noise * np.sqrt(f / 4 * POWER) * 10 ** (BAND[2] / 20)
    for (at, db), share in ((TONE, 1.0), (PULSED, 0.25)):
        course = np.exp(2j * np.pi * rng.uniform(size=(p, 1))) * (rng.uniform(size=(p, 1)) < share) / np.sqrt(share)
        added += tones * course * np.sinc(np.arange(f) - at) * np.sqrt(f * POWER) * 10 ** (db / 20)
    signal[:] = (samples + added).astype(np.complex64)
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """A folder with phase histories, and the target."""
    folder = tmp_path_factory.mktemp("interference")
    for name, more in (("scene", TARGET + CLUTTER), ("noise", NOISE)):
        (folder / f"{name}.toml").write_text(scene(**AREA, more=more))
        store = Path(blocksar.simulate(folder / f"{name}.toml", folder / f"{name}.zarr"))
        interfered(store, folder / f"{name}-all.zarr")
        interfered(store, folder / f"{name}-band.zarr", tones=False)
    return folder, Scene.read(folder / "scene.toml").point_targets()[0]


def image_of(made: tuple[Path, Any], name: str, out: Path, side: float = 30.0, **options: Any) -> tuple[Any, Any]:
    folder, target = made
    grid = ((target.x - side, target.x + side, 0.5), (target.y - side, target.y + side, 0.5))
    report = blocksar.focus(folder / f"{name}.zarr", out, grid=grid, workers=0, progress=False, **options)
    with blocksar.open(out) as dataset:
        return dataset.image.values, report


def side_lobes(run: Path) -> Any:
    response = blocksar.quality(run).result["targets"][0]
    return np.array([response["range_pslr"], response["azimuth_pslr"]])


@pytest.mark.slow
def test_images_are_those_without_interference(made: tuple[Path, Any], tmp_path: Path) -> None:
    """Amplitude within 2 %, side lobes within 1 dB, noise within 0.5 dB."""
    without, _ = image_of(made, "scene", tmp_path / "without")
    noise, _ = image_of(made, "noise", tmp_path / "noise", 12.0)
    for method, kind in (("eigen", "all"), ("notch", "band")):
        image, report = image_of(made, f"scene-{kind}", tmp_path / f"{method}", interference=method)
        peak = np.unravel_index(np.abs(without).argmax(), without.shape)
        assert abs(image[peak] / without[peak] - 1) < 0.02
        assert np.abs(side_lobes(tmp_path / method) - side_lobes(tmp_path / "without")).max() < 1
        (line,) = [line for line in report.summary if "interference" in line]
        assert f"({method}): {3 if kind == 'all' else 1} line" in line and "in 9 of 9 groups of pulses" in line
    other, _ = image_of(made, "noise-all", tmp_path / "noise-all", 12.0, interference="eigen")
    assert abs(10 * np.log10(np.mean(np.abs(other) ** 2) / np.mean(np.abs(noise) ** 2))) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("raw", [False, True])
def test_a_clean_collection_keeps_every_bit(made: tuple[Path, Any], raw: bool, tmp_path: Path) -> None:
    folder, name = made[0], "scene"
    if raw:
        name = "echo"
        if not (folder / "echo.zarr").exists():
            blocksar.simulate(folder / "scene.toml", folder / "echo.zarr", raw=True)
    without, _ = image_of(made, name, tmp_path / "without", side=10.0)
    method = "eigen" if raw else "notch"
    image, report = image_of(made, name, tmp_path / method, side=10.0, interference=method)
    np.testing.assert_array_equal(image.view(np.int32), without.view(np.int32))
    assert f"note: interference ({method}): none stands out, and nothing is cut" in report.summary


@pytest.mark.slow
def test_a_tone_in_a_raw_echo(made: tuple[Path, Any], tmp_path: Path) -> None:
    """Its receive window stays where it is while the reference range moves."""
    folder, _ = made
    blocksar.simulate(folder / "scene.toml", folder / "tone.zarr", raw=True)
    without, _ = image_of(made, "tone", tmp_path / "without", side=10.0)
    group = zarr.open_group(str(folder / "tone.zarr"), mode="r+")
    echo = group[next(name for name in group.array_keys() if group[name].ndim == 2)]
    samples, rng = np.asarray(echo[:]), np.random.default_rng(8)
    time = np.asarray(group["fast_time"][:])
    course = np.exp(2j * np.pi * rng.uniform(size=(samples.shape[0], 1)))
    level = np.sqrt(np.mean(np.abs(samples) ** 2)) * 10 ** (30 / 20)
    echo[:] = (samples + level * course * np.exp(2j * np.pi * 13.37e6 * time)).astype(np.complex64)
    image, report = image_of(made, "tone", tmp_path / "eigen", side=10.0, interference="eigen")
    peak = np.unravel_index(np.abs(without).argmax(), without.shape)
    assert abs(image[peak] / without[peak] - 1) < 0.02
    assert any("(eigen): 1 line at 150" in line or "(eigen): 1 line at 149" in line for line in report.summary)


@pytest.mark.slow
def test_a_run_goes_on_with_the_same_bits_and_processors_agree(made: tuple[Path, Any], tmp_path: Path) -> None:
    """The samples are cut before any of them."""

    class Stop:
        def update(self, stage: str, done: int, total: int) -> None:
            if stage == "interference" and done == 2:
                raise KeyboardInterrupt

    folder, target = made
    grid = ((target.x - 6, target.x + 6, 0.5), (target.y - 6, target.y + 6, 0.5))
    options: dict[str, Any] = {"grid": grid, "workers": 0, "interference": "eigen", "processor": "angular-division"}
    source = folder / "scene-all.zarr"
    with pytest.raises(KeyboardInterrupt):
        blocksar.focus(source, tmp_path / "run", progress=Stop(), **options)
    with pytest.raises(InputError, match="interference"):
        blocksar.focus(source, tmp_path / "run", progress=False, **(options | {"interference": None}))
    report = blocksar.focus(source, tmp_path / "run", progress=False, **options)
    assert any("2 of 3 groups of pulses" in line for line in report.summary)
    assert report.result["settings"]["interference"] == "eigen"
    blocksar.focus(source, tmp_path / "again", progress=False, **options)
    blocksar.focus(source, tmp_path / "exact", progress=False, **options | {"processor": "backprojection"})
    one, other, exact = (blocksar.open(tmp_path / name).image.values for name in ("run", "again", "exact"))
    np.testing.assert_array_equal(one.view(np.int32), other.view(np.int32))
    assert abs(np.vdot(one, exact)) / np.linalg.norm(one) / np.linalg.norm(exact) > 0.998


def test_a_plan_says_what_it_cannot_know(made: tuple[Path, Any]) -> None:
    folder, target = made
    grid = ((target.x - 6, target.x + 6, 0.5), (target.y - 6, target.y + 6, 0.5))
    report = blocksar.plan(folder / "scene.zarr", grid=grid, interference="notch", workers=0)
    assert any("interference (notch)" in line and "a plan reads no samples" in line for line in report.summary)
