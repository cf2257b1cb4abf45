"""The project's quality bar, and the references that end-to-end tests compare images with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.focusing.backprojection import form_chips
from blocksar.measurement.coherence import ChipComparison, coherence
from blocksar.planning.plan import Plan

MARGIN = 30.0  # m from the image's edge: room for a chip and for the side lobes of a response
SHIPPED = Path(blocksar.__file__).parent / "simulation" / "scenes"


def check_targets(found: dict[str, Any], expected: int) -> None:
    """Check that every full-dwell target meets the quality bar."""
    full = [t for t in found["targets"] if t["full_dwell"]]
    assert len(full) >= expected
    for target in full:
        assert target["covered"], target
        for axis in ("range", "azimuth"):
            assert target[f"{axis}_pslr"] == pytest.approx(-13.26, abs=0.2), target
            assert target[f"{axis}_irw"] == pytest.approx(target[f"{axis}_irw_theory"], rel=0.01), target
        assert abs(target["error_x"]) <= 0.05, target
        assert abs(target["error_y"]) <= 0.05, target
        value = complex(*target["value"])
        assert abs(value) == pytest.approx(1.0, abs=0.02), target
        assert abs(np.angle(value)) <= 0.05, target


def emptied(name: str) -> str:
    """Return a shipped scene without its targets."""
    return (SHIPPED / f"{name}.toml").read_text().split("[matrix]")[0]


def planned(path: Path, **settings: Any) -> Plan:
    plan = blocksar.plan(path, **settings).result
    assert isinstance(plan, Plan)
    return plan


def coarse_grid(store: Path, step: float = 4.0) -> Any:
    """Return a grid for comparing complex values: it need not sample the image adequately."""
    grid = planned(store, blocks=3).grid
    return ((grid.x0, grid.x1, step), (grid.y0, grid.y1, step))


def telling_places(plan: Plan) -> dict[str, tuple[float, float]]:
    """Return ground points at block centres, seams and ends of full dwell, at three ranges each: name -> (x, y)."""
    beam = plan.geometry.collection
    low, high = plan.blocks[0].low, plan.blocks[-1].high
    if beam.beam_width is not None:
        low = max(low, float(beam.beam_azimuth.min() + beam.beam_width / 2))
        high = min(high, float(beam.beam_azimuth.max() - beam.beam_width / 2))
    yaws = {f"block {b.index} centre": float(np.clip((b.low + b.high) / 2, low, high)) for b in plan.blocks}
    yaws |= {f"seam {b.index}|{b.index + 1}": b.high for b in plan.blocks[:-1]}
    yaws |= {"first full dwell": low + 0.01 * (high - low), "last full dwell": high - 0.01 * (high - low)}
    near, far = max(b.ground.near for b in plan.blocks), min(b.ground.far for b in plan.blocks)
    found = {}
    for name, yaw in yaws.items():
        low, high = (float(limit) for limit in plan.region.at(np.array(yaw)))
        for where, share in (("near", 0.1), ("middle", 0.5), ("far", 0.9)):
            rng = max(near, low) + share * (min(far, high) - max(near, low))
            x, y, _ = plan.geometry.ground_point(np.array(rng), np.array(yaw))
            found[f"{name}, {where} range"] = (float(x), float(y))
    return found


def places(plan: Plan) -> dict[str, tuple[float, float]]:
    """Return some points at the image's edges, on seams and at a block centre, inside the margin: name -> (x, y)."""
    geometry, grid = plan.geometry, plan.grid
    known = telling_places(plan)
    middle = plan.n_blocks // 2
    wanted = [f"{edge} full dwell, {where} range" for edge in ("first", "last") for where in ("near", "middle", "far")]
    wanted += [f"seam {i}|{i + 1}, middle range" for i in (0, plan.n_blocks - 2)]
    wanted += [f"block {middle} centre, {where} range" for where in ("near", "far")]
    found = {name: known[name] for name in wanted if name in known}
    if not geometry.collection.steered:  # the sector's ends lie outside the grid: use the grid's edges
        for i, x in enumerate((grid.x0 + 1.2 * MARGIN, grid.x1 - 1.2 * MARGIN)):
            found |= {f"edge {i}{j}": (x, y) for j, y in enumerate((grid.y0 + 1.2 * MARGIN, grid.y1 - 1.2 * MARGIN))}
    kept: dict[str, tuple[float, float]] = {}
    for name, (x, y) in found.items():
        inside = min(x - grid.x0, grid.x1 - x, y - grid.y0, grid.y1 - y) >= MARGIN
        # Keep the side lobes of one target away from the others.
        if inside and all(np.hypot(x - other[0], y - other[1]) > 2 * MARGIN for other in kept.values()):
            kept[name] = (x, y)
    return kept


def chips(store: Path, run: Path, at: dict[str, tuple[float, float]], *, half: int = 32) -> dict[str, ChipComparison]:
    """Compare the image about some places with exact back-projection of the same samples."""
    history = stores.open_phase_history(store)
    geometry = Geometry(collection=history.collection.centred())
    image = blocksar.open(run).image
    parts = {}
    for name, (x, y) in at.items():
        column, row = (
            int(np.argmin(np.abs(axis - value))) for axis, value in ((image.x.values, x), (image.y.values, y))
        )
        parts[name] = image.isel(x=slice(max(column - half, 0), column + half), y=slice(max(row - half, 0), row + half))
    exact = form_chips(
        lambda pulses: history.read(pulses, slice(None)),
        geometry,
        [(chip.x.values, chip.y.values) for chip in parts.values()],
        threads=2,
    )
    return {name: coherence(chip.values, one) for (name, chip), one in zip(parts.items(), exact, strict=True)}


def with_targets(text: str, at: dict[str, tuple[float, float]]) -> str:
    rows = (f'[[targets]]\nname = "{name}"\nx = {x:.6f}\ny = {y:.6f}\n' for name, (x, y) in at.items())
    return text + "\n" + "\n".join(rows)


def with_clutter(text: str, plan: Plan) -> str:
    """Add clutter over the image: beyond the grid it would occupy more Doppler bandwidth than the PRF of paper B."""
    text += "\n[clutter]\nscatterers = 8000\nseed = 3\n"
    if plan.geometry.collection.steered:
        return text
    return text + f"x = [{plan.grid.x0}, {plan.grid.x1}]\ny = [{plan.grid.y0}, {plan.grid.y1}]\n"


def simulated(folder: Path, name: str, text: str) -> Path:
    (folder / f"{name}.toml").write_text(text)
    return Path(blocksar.simulate(folder / f"{name}.toml", folder / f"{name}.zarr"))
