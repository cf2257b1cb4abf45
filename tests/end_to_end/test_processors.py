"""Every processor on every geometry, at block centres, at seams and at the edges of the image.

Targets must meet the quality bar, and clutter is compared with exact back-projection of the same samples. Their
positions follow from the blocks of the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest
from quality_bar import check_targets, chips, emptied, places, planned, simulated, with_clutter, with_targets
from scenes import PAPERS, scene

import blocksar
from blocksar.focusing.method import Chain
from blocksar.planning.plan import Plan

pytestmark = pytest.mark.slow


class Ground(NamedTuple):
    """A geometry: an empty scene, the grid of its image, and the pixel spacing in m for images of clutter."""

    scene: str
    grid: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    coarse: float
    least: float  # least coherence
    blocks: Any = "auto"

    def coarser(self, plan: Plan) -> Any:
        (x0, x1), (y0, y1) = (plan.grid.x0, plan.grid.x1), (plan.grid.y0, plan.grid.y1)
        return (x0, x1, self.coarse), (y0, y1, self.coarse)


# Of papers B and C the whole of the azimuth and half of the range: test_papers.py has the papers' own scenes in full.
GROUNDS = {
    "table1": Ground(scene(steering=(44.75, 55.25), duration=0.4, swath=[29700.0, 30300.0]), None, 4.0, 0.995, 3),
    "scan reversed": Ground(
        scene(steering=(55.25, 44.75), duration=0.4, swath=[29500.0, 30500.0]), None, 4.0, 0.995, 3
    ),
    "paper_b": Ground(emptied("paper_b"), ((11150.0, 11480.0, 0.25), (-1040.0, 1040.0, 0.25)), 1.0, 0.995),
    "paper_c": Ground(emptied("paper_c"), ((18100.0, 18560.0, 0.4), (-780.0, 780.0, 0.4)), 1.0, 0.995),
}


# test_table1.py tests these at full size, and test_papers.py with the targets of the papers.
ELSEWHERE = {("table1", "angular-division"), *((name, processor) for name, (processor, _) in PAPERS.items())}
SLOWEST = {("paper_b", "high-order-phase"), ("paper_c", "angular-division"), ("paper_c", "keystone-resampling")}
SLOWEST |= {
    ("table1", "keystone-resampling"),
    ("scan reversed", "angular-division"),
    ("scan reversed", "keystone-resampling"),
    ("scan reversed", "high-order-phase"),
    ("paper_b", "angular-division"),
}
CASES = [
    pytest.param(ground, processor, marks=pytest.mark.slow if (ground, processor) in SLOWEST else ())
    for ground in GROUNDS
    for processor in get_args(Chain)
    if (ground, processor) not in ELSEWHERE
]


@pytest.fixture(scope="module")
def clutter(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Phase history of clutter by name and scene, each simulated once."""
    folder = tmp_path_factory.mktemp("clutter")
    return cache(partial(simulated, folder))


@pytest.mark.parametrize(("ground", "processor"), CASES)
def test_every_processor_meets_the_quality_bar_on_every_geometry(
    ground: str, processor: Any, clutter: Callable[[str, str], Path], tmp_path: Path
) -> None:
    made = GROUNDS[ground]
    (tmp_path / "empty.toml").write_text(made.scene)
    plan = planned(tmp_path / "empty.toml", processor=processor, grid=made.grid, blocks=made.blocks)
    at = places(plan)
    for kind, least in (("centre", 1), ("seam", 1), ("full dwell" if made.grid is None else "edge", 4)):
        assert sum(kind in name for name in at) >= least, (kind, list(at))
    assert plan.faithful or processor != "angular-division"  # the others need more blocks

    store = simulated(tmp_path, "targets", with_targets(made.scene, at))
    blocksar.focus(store, tmp_path / "sharp", processor=processor, blocks=plan.n_blocks, grid=made.grid, workers=0)
    check_targets(blocksar.quality(tmp_path / "sharp").result, len(at))

    store = clutter(ground, with_clutter(made.scene, plan))
    grid = made.coarser(plan)
    blocksar.focus(store, tmp_path / "rough", processor=processor, blocks=plan.n_blocks, grid=grid, workers=0)
    for name, chip in chips(store, tmp_path / "rough", at).items():
        assert abs(chip.coherence) >= made.least, (name, chip)
        assert chip.gain == pytest.approx(1.0, abs=0.02), (name, chip)
        assert abs(chip.phase) <= 0.02, (name, chip)
