"""A raw echo of a satellite's squinted strip, quantised to four bits, beside its twin in range frequency."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from axis_beams import axis_scene
from quality_bar import check_targets

import blocksar
from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.constants import SPEED_OF_LIGHT

RANGE, HEIGHT, SPEED = 800e3, 514e3, 7500.0  # m, m, m/s
SQUINT, PRF = 1.5, 3600.0  # degrees, Hz
NOISE = 4.0  # power of a sample of the echo, in which targets are 3 to 7 dB weaker
STEP = 0.5  # of a quantiser of 16 levels over the standard deviation: hardly a sample is beyond its range
ALONG = RANGE * math.sin(math.radians(SQUINT))
X, Y = math.sqrt(RANGE**2 - HEIGHT**2 - ALONG**2), ALONG
GRID = ((X - 200, X + 200, 2.5), (Y - 150, Y + 150, 1.0))
TARGETS = [(-95.0, -70.0), (10.0, 5.0), (88.0, 81.0)]  # m from X, Y


def text(more: str = "") -> str:
    """A curved orbit about a flat ground, and an antenna of 5 m."""
    targets = "".join(f'[[targets]]\nname = "P{i}"\nx = {X + x}\ny = {Y + y}\n' for i, (x, y) in enumerate(TARGETS))
    return axis_scene(
        f'mode = "stripmap"\nwidth_deg = 0.355\nsquint_deg = {SQUINT}',
        yaw=math.degrees(math.atan2(Y, X)), prf=PRF, height=HEIGHT, velocity=[0.0, SPEED, 0.0],
        acceleration=[0.0, 0.0, -8.2], time="duration = 0.95", swath=[RANGE - 300, RANGE + 300], bandwidth=30e6,
        range_sampling=36e6, pulse_width=5e-6, more=targets + more,
    )  # fmt: skip


def quantised(echo: ComplexArray) -> ComplexArray:
    """The echo with 16 levels of each of its parts, halves of a step off zero."""
    parts = echo.view(np.float32)
    step = STEP * parts.std()
    return (np.clip(np.floor(parts / step), -8, 7) * step + step / 2).astype(np.float32).view(np.complex64)


def quantised_copy(store: Path, out: Path) -> Path:
    """The raw store with four bits of each part, and what this adds to the noise."""
    history = stores.open_phase_history(store)
    assert history.raw is not None and history.collection.noise_power == NOISE
    echo = history.read(slice(None), slice(None))
    coarse = quantised(echo)
    error = float(np.mean(np.abs(coarse - echo) ** 2))
    assert np.unique(coarse.view(np.float32)).size == 16
    assert error == pytest.approx(STEP**2 / 12 * float(np.mean(np.abs(echo) ** 2)), rel=0.05)
    collection = Collection(**{**history.collection.as_dict(), "noise_power": NOISE + error})
    whole = tuple(slice(0, n) for n in coarse.shape)
    stores.create_phase_history(
        out, collection, raw=history.raw, attrs=history.attrs,
        fill=lambda place: stores.write_region(place, "echo", whole, coarse),
    )  # fmt: skip
    return out


@pytest.mark.slow
def test_a_quantised_raw_echo_gives_the_image_of_its_twin_and_the_noise_it_says(tmp_path: Path) -> None:
    wavelength = SPEED_OF_LIGHT / 9.6e9
    assert 2 * SPEED * math.sin(math.radians(SQUINT)) / wavelength > 3 * PRF  # the Doppler centroid
    images = {}
    for name, more in (("twin", ""), ("raw", f"\n[noise]\npower = {NOISE}\nseed = 4\n")):
        (tmp_path / "scene.toml").write_text(text(more))
        store = Path(blocksar.simulate(tmp_path / "scene.toml", tmp_path / f"{name}.zarr", raw=name == "raw"))
        if name == "raw":
            store = quantised_copy(store, tmp_path / "quantised.zarr")
        blocksar.focus(store, tmp_path / name, grid=GRID, workers=0)
        check_targets(blocksar.quality(tmp_path / name).result, len(TARGETS))
        images[name] = blocksar.open(tmp_path / name)
    noise = images["raw"].noise_equivalent.values
    difference = np.abs(images["raw"].image.values - images["twin"].image.values) ** 2
    assert "noise_equivalent" not in images["twin"]
    # Thermal noise and errors of quantisation, over some 8000 resolution cells.
    assert np.mean(difference / noise) == pytest.approx(1.0, abs=0.05)
