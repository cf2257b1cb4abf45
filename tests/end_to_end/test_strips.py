"""Strips of many dwells, cut into segments along time: one mosaic without a seam."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from strips import DISTANCE, TIME_ZERO, strip_collection, write_strip

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.measurement.coherence import coherence
from blocksar.processors.base import PlannedSegment
from blocksar.processors.chain import processor as chain
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.planning.strip_segments import Planner, number_blocks, owned_by, plan_segments
from blocksar.processors.chain.tasks import stages
from blocksar.processors.exact.sums import form_image

SPANS = ((0, 3400), (2600, 6000))
GRID = Grid(DISTANCE - 30, DISTANCE + 30, 0.8, -45.0, 45.0, 0.45)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_strip(tmp_path_factory.mktemp("strip"), strip_collection(3.0), GRID)


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two segments, whatever one epoch would serve."""

    def forced(plan: Planner, collections: Sequence[Collection], *, grid: Grid, cut: bool) -> Any:
        whole = collections[0]
        plans = [
            plan(whole.segment(*span), grid=grid, blocks=4, parts=1, owned=owned_by(whole, SPANS, k))
            for k, span in enumerate(SPANS)
        ]
        return number_blocks(
            [
                PlannedSegment(collection=0, pulses=span, geometry=each.geometry, plan=each)
                for span, each in zip(SPANS, plans, strict=True)
            ]
        )

    monkeypatch.setattr(chain, "plan_segments", forced)


def against_back_projection(run: Path, store: Path, rows: slice) -> tuple[float, float]:
    """Coherence with back-projection of all pulses at full dwells, and the largest phase between neighbouring parts."""
    image = blocksar.open(run).image[rows]
    history = stores.open_phase_history(store)
    geometry = Geometry(collection=history.collection.centred())
    x, y = image.x.values, image.y.values
    exact = form_image(lambda pulses: history.read(pulses, slice(None)), geometry, x, y, threads=1)
    full = geometry.beam.has_full_dwell(*np.meshgrid(x, y))
    found = np.where(full, image.values, np.nan)
    parts = [coherence(found[i : i + 16], exact[i : i + 16]) for i in range(0, len(y) - 15, 16)]
    assert all(0.98 < part.gain < 1.02 for part in parts)
    return abs(coherence(found, exact).coherence), float(np.ptp([part.phase for part in parts]))


@pytest.mark.slow
def test_segments_of_a_resumed_run_have_no_seam(
    store: Path, cut: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        blocksar.focus(store, run, grid=GRID, workers=0, processor="angular-division")
    report = blocksar.focus(store, run, grid=GRID, workers=0, processor="angular-division")
    assert "went on from an unfinished run" in report.summary[0]
    image = blocksar.open(run)
    assert "collection" not in image
    assert np.isfinite(image.image.values.real).all()
    block = image.block.values
    assert (block[:80] < 4).all() and (block[-80:] >= 4).all()  # the seam lies in the middle of the strip
    measured, jump = against_back_projection(run, store, slice(None))
    assert measured > 0.999 and jump < 0.02
    record = json.loads((run / "run.json").read_text())
    assert [tuple(segment["pulses"]) for segment in record["segments"]] == list(SPANS)
    time = stores.open_phase_history(store).collection.time
    for number, (first, last) in enumerate(SPANS):  # each counts its time from its own middle
        collection, attrs = stores.read_collection(run / "segments" / str(number) / "collection.zarr")
        since = attrs["source"]["time_zero"] - TIME_ZERO
        np.testing.assert_allclose(since + collection.time, time[first:last], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_long_strip_is_cut_by_plan() -> None:
    """80 dwells, which one epoch does not serve at all."""
    collection = strip_collection(12.0, curve=0.0)
    grid = Grid(DISTANCE - 30, DISTANCE + 30, 0.8, -1185.0, 1185.0, 0.45)
    assert plan_collection(collection, grid=grid, blocks=8).refusal is not None

    segments = plan_segments(partial(plan_collection, fidelity=0.997), [collection], grid=grid)
    assert len(segments) > 1
    assert all(segment.plan.refusal is None and segment.plan.coherence > 0.996 for segment in segments)
