"""A satellite's burst, steered over several PRFs of Doppler, on hills that stand on the ellipsoid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from satellite_burst import BEAM, CHIP, PRF, SPEED, Burst

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.constants import MIB
from blocksar.measurement.coherence import coherence
from blocksar.processors.exact.sums import form_chips

pytestmark = pytest.mark.slow

DX, DY = 2.0, 6.0  # m
LIMIT = 1536 * MIB  # bytes, of a worker


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


def check_targets(targets: list[dict[str, Any]], expected: int) -> None:
    """Check the quality bar. Side lobes may be lower: on slopes, where cuts are oblique, as in back-projection."""
    assert sum(target["full_dwell"] and target["covered"] for target in targets) == expected
    for target in targets:
        assert np.hypot(target["error_x"], target["error_y"]) <= 0.1, target
        for axis in ("range", "azimuth"):
            assert -13.66 <= target[f"{axis}_pslr"] <= -13.06, target
            assert target[f"{axis}_irw"] == pytest.approx(target[f"{axis}_irw_theory"], rel=0.01), target
        value = complex(*target["value"])
        assert abs(value) == pytest.approx(1.0, abs=0.02), target
        assert abs(np.angle(value)) <= 0.05, target


def test_a_burst_is_as_sharp_as_back_projection_on_its_hills(tmp_path: Path) -> None:
    width, length, across, along, blocks = 2.4e3, 3e3, 2, 2, 2
    burst = Burst.over(width, length)
    steering = burst.collection.beam_steering
    assert steering is not None
    wavelength = burst.collection.wavelength
    assert 2 * SPEED / wavelength * (steering[-1] - steering[0] + BEAM) > 1.8 * PRF
    chips = [(0.0, 0.0)]  # between targets
    store = burst.write(tmp_path, burst.targets(across, along), chips)
    grid = burst.grid(DX, DY)
    report = blocksar.focus(
        store, tmp_path / "run", grid=((grid.x0, grid.x1, DX), (grid.y0, grid.y1, DY)), blocks=blocks, workers=0,
        terrain=tmp_path / "terrain.zarr", memory_limit=LIMIT,
    )  # fmt: skip
    assert report.result["peak_memory"] <= LIMIT
    found = blocksar.quality(tmp_path / "run").result
    check_targets(found["targets"], across * along)
    image = blocksar.open(tmp_path / "run")
    assert np.isfinite(image.image.values).all()
    check_clutter(store, image, burst, chips)
