"""One grid for all: every processor, on every geometry, at block centres, at seams, at the image's edges.

Targets are held to the quality bar, clutter is compared with exact back-projection of the same samples; where they
stand follows from the plan's own blocks. Then what each paper shows, and what its rivals lack.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import pytest
from distributed import Client
from scenes import scene
from test_70_focus import check_targets

import blocksar
from blocksar import stores
from blocksar.api import focusing, measuring
from blocksar.collection.geometry import Geometry
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.method import Chain
from blocksar.graph.cluster import open_client
from blocksar.measurement.coherence import ChipComparison, coherence
from blocksar.planning.plan import Plan
from blocksar.runs.record import RunPlan

MARGIN = 30.0  # m that a place keeps from the image's edge: room for a chip and for the side lobes of a response
SHIPPED = Path(blocksar.__file__).parent / "simulation" / "scenes"


class Ground(NamedTuple):
    """A geometry: a scene without anything in it, the grid of an image of it, and how coarse one of clutter may be."""

    scene: str
    grid: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    coarse: float
    least: float  # coherence
    blocks: Any = "auto"

    def coarser(self, plan: Plan) -> Any:
        (x0, x1), (y0, y1) = (plan.grid.x0, plan.grid.x1), (plan.grid.y0, plan.grid.y1)
        return (x0, x1, self.coarse), (y0, y1, self.coarse)


def emptied(name: str) -> str:
    """A shipped scene without its targets."""
    return (SHIPPED / f"{name}.toml").read_text().split("[matrix]")[0]


GROUNDS = {
    "table1": Ground(scene(steering=(44.75, 55.25), duration=0.4, swath=[29500.0, 30500.0]), None, 4.0, 0.99, 3),
    "scan reversed": Ground(scene(steering=(55.25, 44.75), duration=0.4, swath=[29500.0, 30500.0]), None, 4.0, 0.99, 3),
    "paper_b": Ground(emptied("paper_b"), ((11010.0, 11620.0, 0.25), (-1040.0, 1040.0, 0.25)), 1.0, 0.99),
    "paper_c": Ground(emptied("paper_c"), ((17900.0, 18760.0, 0.4), (-780.0, 780.0, 0.4)), 1.0, 0.99),
}


@pytest.fixture(scope="module")
def client() -> Any:
    with open_client(workers=2, threads=1, memory_limit=3 * 2**30) as connected:
        yield connected


def planned(path: Path, **settings: Any) -> Plan:
    plan = blocksar.plan(path, **settings).result
    assert isinstance(plan, Plan)
    return plan


def places(plan: Plan) -> dict[str, tuple[float, float]]:
    """Some places at the image's edges, on seams and at the centre of its blocks, well within it: name -> (x, y)."""
    geometry, grid = plan.geometry, plan.grid
    predicted = focusing.predicted_blocks(plan)
    known = {name: (x, y) for name, x, y in measuring.reference_places(geometry, RunPlan(predicted=predicted))}
    middle = plan.n_blocks // 2
    wanted = [f"{edge} full dwell, {where} range" for edge in ("first", "last") for where in ("near", "middle", "far")]
    wanted += [f"seam {i}|{i + 1}, middle range" for i in (0, plan.n_blocks - 2)]
    wanted += [f"block {middle} centre, {where} range" for where in ("near", "far")]
    found = {name: known[name] for name in wanted if name in known}
    if not geometry.collection.steered:  # the sector's ends lie outside the box: its own edges instead
        for i, x in enumerate((grid.x0 + 1.2 * MARGIN, grid.x1 - 1.2 * MARGIN)):
            found |= {f"edge {i}{j}": (x, y) for j, y in enumerate((grid.y0 + 1.2 * MARGIN, grid.y1 - 1.2 * MARGIN))}
    kept: dict[str, tuple[float, float]] = {}
    for name, (x, y) in found.items():
        inside = min(x - grid.x0, grid.x1 - x, y - grid.y0, grid.y1 - y) >= MARGIN
        # Side lobes of one target must not reach another.
        if inside and all(np.hypot(x - other[0], y - other[1]) > 2 * MARGIN for other in kept.values()):
            kept[name] = (x, y)
    return kept


def chips(store: Path, run: Path, at: dict[str, tuple[float, float]], *, half: int = 32) -> dict[str, ChipComparison]:
    """The image about some places against exact back-projection of the same samples."""
    history = stores.open_phase_history(store)
    geometry = Geometry(collection=history.collection.centred())
    image = blocksar.open(run).image
    found = {}
    for name, (x, y) in at.items():
        column, row = (
            int(np.argmin(np.abs(axis - value))) for axis, value in ((image.x.values, x), (image.y.values, y))
        )
        chip = image.isel(x=slice(max(column - half, 0), column + half), y=slice(max(row - half, 0), row + half))
        read = measuring.pulse_reader(history)
        exact = form_image(read, geometry, chip.x.values, chip.y.values, threads=2)
        found[name] = coherence(chip.values, exact)
    return found


def with_targets(text: str, at: dict[str, tuple[float, float]]) -> str:
    rows = (f'[[targets]]\nname = "{name}"\nx = {x:.6f}\ny = {y:.6f}\n' for name, (x, y) in at.items())
    return text + "\n" + "\n".join(rows)


def with_clutter(text: str, plan: Plan) -> str:
    """Clutter all over the image: more than its grid would span more Doppler than the PRF of paper B holds."""
    text += "\n[clutter]\nscatterers = 30000\nseed = 3\n"
    if plan.geometry.collection.steered:
        return text
    return text + f"x = [{plan.grid.x0}, {plan.grid.x1}]\ny = [{plan.grid.y0}, {plan.grid.y1}]\n"


def simulated(folder: Path, name: str, text: str) -> Path:
    (folder / f"{name}.toml").write_text(text)
    return Path(blocksar.simulate(folder / f"{name}.toml", folder / f"{name}.zarr"))


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("processor", get_args(Chain))
def test_every_processor_on_every_geometry_at_every_place(
    processor: Any, ground: str, client: Client, tmp_path: Path
) -> None:
    made = GROUNDS[ground]
    (tmp_path / "empty.toml").write_text(made.scene)
    plan = planned(tmp_path / "empty.toml", processor=processor, grid=made.grid, blocks=made.blocks)
    at = places(plan)
    for kind, least in (("centre", 1), ("seam", 1), ("full dwell" if made.grid is None else "edge", 4)):
        assert sum(kind in name for name in at) >= least, (kind, list(at))
    assert plan.within_budget()

    store = simulated(tmp_path, "targets", with_targets(made.scene, at))
    blocksar.focus(store, tmp_path / "sharp", processor=processor, blocks=plan.n_blocks, grid=made.grid, client=client)
    check_targets(blocksar.quality(tmp_path / "sharp").result, len(at))

    store = simulated(tmp_path, "clutter", with_clutter(made.scene, plan))
    grid = made.coarser(plan)
    blocksar.focus(store, tmp_path / "rough", processor=processor, blocks=plan.n_blocks, grid=grid, client=client)
    for name, chip in chips(store, tmp_path / "rough", at).items():
        assert abs(chip.coherence) >= made.least, (name, chip)
        assert chip.gain == pytest.approx(1.0, abs=0.02), (name, chip)
        assert abs(chip.phase) <= 0.02, (name, chip)
