"""A satellite's burst, steered over several PRFs of Doppler, on hills that stand on the ellipsoid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from quality_bar import check_targets
from satellite_burst import BEAM, CHIP, PRF, SPEED, Burst

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.constants import MIB
from blocksar.focusing.backprojection import form_chips
from blocksar.measurement.coherence import coherence

DX, DY = 2.0, 6.0  # m
LIMIT = 1536 * MIB  # bytes, of a worker
CHIPS = [(0.375, 0.2625), (0.225, -0.0875), (-0.075, 0.0875), (-0.225, -0.2625)]  # of width and length


def check_clutter(store: Path, image: Any, burst: Burst, chips: list[tuple[float, float]]) -> None:
    """Compare the chips' middles with back-projection on the same terrain, at every third column."""
    history = stores.open_phase_history(store)
    half = CHIP - 50
    parts = [
        image.sel(x=slice(x - half, x + half), y=slice(y - half, y + half)).isel(x=slice(None, None, 3))
        for x, y in chips
    ]
    exact = form_chips(
        lambda pulses: history.read(pulses, slice(None)),
        Geometry(collection=history.collection.centred()).over(burst.terrain),
        [(part.x.values, part.y.values) for part in parts], threads=2,
    )  # fmt: skip
    assert any(np.unique(part.block.values).size > 1 for part in parts)  # a seam
    for part, one in zip(parts, exact, strict=True):
        found = coherence(part.image.values, one)
        assert abs(found.coherence) >= 0.998
        assert found.gain == pytest.approx(1.0, abs=0.01)
        assert abs(found.phase) < 0.01


@pytest.mark.parametrize(
    ("width", "length", "across", "along", "blocks"),
    [
        pytest.param(2.4e3, 3e3, 2, 2, 2, id="small"),
        pytest.param(60e3, 15e3, 7, 5, "auto", id="whole", marks=pytest.mark.slow),
    ],
)
def test_a_burst_is_as_sharp_as_back_projection_on_its_hills(
    width: float, length: float, across: int, along: int, blocks: Any, client: Client, tmp_path: Path
) -> None:
    burst = Burst.over(width, length)
    steering = burst.collection.beam_steering
    assert steering is not None
    wavelength = burst.collection.wavelength
    assert 2 * SPEED / wavelength * (steering[-1] - steering[0] + BEAM) > 1.8 * PRF
    chips = [(0.0, 0.0)] if along == 2 else [(dx * width, dy * length) for dx, dy in CHIPS]  # between targets
    store = burst.write(tmp_path, burst.targets(across, along), chips)
    grid = burst.grid(DX, DY)
    blocksar.focus(
        store, tmp_path / "run", grid=((grid.x0, grid.x1, DX), (grid.y0, grid.y1, DY)), blocks=blocks, client=client,
        terrain=tmp_path / "terrain.zarr", memory_limit=LIMIT,
    )  # fmt: skip
    found = blocksar.quality(tmp_path / "run").result
    assert all(target["full_dwell"] for target in found["targets"])
    check_targets(found, across * along)
    image = blocksar.open(tmp_path / "run")
    assert np.isfinite(image.image.values).all()
    check_clutter(store, image, burst, chips)
