"""Chains beside exact back-projection of the same samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import blocksar
from blocksar.measurement.coherence import ChipComparison, coherence


def beside_exact(folder: Path, scene: str, grid: Any, processor: Any, **settings: Any) -> ChipComparison:
    """Simulate a scene, given as text, in a folder; the chain's image of it compared with exact back-projection."""
    (folder / "scene.toml").write_text(scene)
    store = blocksar.simulate(folder / "scene.toml", folder / "history.zarr", progress=False)
    images = []
    for name, given in ((processor, settings), ("backprojection", {})):
        blocksar.focus(store, folder / name, grid=grid, processor=name, workers=0, progress=False, **given)
        images.append(blocksar.open(folder / name).image.values)
    return coherence(*images)
