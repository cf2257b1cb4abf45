"""Ends of dwells: windows over a wide band, looks, weights near zero, and ranges without a full dwell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from axis_beams import axis_collection

import blocksar
from blocksar.collection.beam import lit_pulses
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.sublooks import narrowed
from blocksar.collection.weighting import Taper, Weighting
from blocksar.kernels import fourier
from blocksar.processors.chain.dwells.dwell_ends import smear_loss
from blocksar.processors.chain.dwells.target_lines import Dwells
from blocksar.processors.chain.planning.gating import end_lift
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.steps.dwell_gate import DwellGate
from blocksar.processors.chain.steps.lines import RowPolynomial, focus

# A band of 3 %.
SCENE = """
[radar]
carrier = 1.3e9
bandwidth = 40e6
range_sampling = 50e6
prf = 400.0
[track]
position = [0.0, 0.0, 6000.0]
velocity = [60.0, 250.0, 30.0]
acceleration = [2.0, -3.0, 4.0]
[time]
pulses = 900
[beam]
start_deg = 42.0
stop_deg = 30.0
width_deg = 6.0
[scene]
swath = [11900.0, 12100.0]
reference_range = "constant"
[[targets]]
name = "P"
x = 8332.0
y = 6053.0
"""
ONE = np.ones(900)  # all pulses are valid
GRID = "8000:8660:3,5700:6400:3"


@pytest.mark.slow
@pytest.mark.parametrize("weighting", ["uniform", "hamming"])
def test_raised_windows_give_back_what_targets_lose_at_ends_that_move_over_the_band(weighting: str) -> None:
    """Summed over each range frequency's own part of the dwell, and over the band."""
    band, spread, blur = Taper.parse(weighting), 0.02, 0.0202
    none = RowPolynomial(series=np.zeros((1, 1)), near=-1.0, far=1.0, centre=0.0, scale=1.0)
    time = fourier.centred(0.0, 1e-4, 20000)
    places = np.linspace(-1, 1, 801)
    shares = band(places) / band(places).sum()

    def lost(lift: float) -> float:
        gate = DwellGate(
            begin=none, end=none, common=none, begin_slope=none, end_slope=none, blur=blur, lift=lift, length=1.0,
            time=time,
        )  # fmt: skip
        lacking = 1 - gate.window(1e-9, "begin").real
        inner = time.values < 0
        summed = [lacking[inner & (time.values > at)].sum() for at in -0.5 + spread * places]
        return float((shares * summed).sum() * time.step)

    lift = end_lift(blur, spread, band)
    assert lost(0.0) == pytest.approx(2 * blur * lift, rel=0.05) and lost(0.0) > blur / 4
    assert abs(lost(lift)) < 0.01 * lost(0.0)
    assert end_lift(blur, 0.0, band) == 0.0


@pytest.mark.slow
def test_a_wide_band_leaves_width_and_level_of_targets_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    store, run = tmp_path / "scene.zarr", tmp_path / "run"
    blocksar.simulate(tmp_path / "scene.toml", store)
    blocksar.focus(store, run, grid=GRID, weighting="taylor:4:-35", workers=0, progress=False)
    (found,) = blocksar.quality(run).result["targets"]
    # Without raised windows 1.0047 and 0.9976.
    assert found["azimuth_irw"] == pytest.approx(found["azimuth_irw_theory"], rel=0.0015)
    assert abs(complex(*found["value"])) == pytest.approx(1, abs=0.0015)


def test_looks_lose_at_their_ends_by_what_the_whole_beam_lights() -> None:
    """The samples of a look hold its echoes on both sides of the ends; a real beam of that width has none beyond."""
    collection = axis_collection("tops", n_pulse=800, beam_width=0.03)
    look = narrowed(collection, 1, 3, 1.0)
    assert look.lit_widths == pytest.approx(3)
    grid = Grid(8970.0, 9030.0, 1.0, -20.0, 20.0, 1.0)
    of_look, of_beam = (
        plan_collection(each, blocks=1, grid=grid, fidelity=0.9, weighting=Weighting.parse("taylor:4:-35"))
        for each in (look, replace(look, lit_width=None))
    )
    losses = [plan.blocks[0].prediction.dispersion_loss for plan in (of_look, of_beam)]
    assert losses[0] > 1.5 * losses[1]


@pytest.mark.slow
def test_weights_near_zero_divide_nothing(tmp_path: Path) -> None:
    """Under hann a pixel of a small part of a dwell came to 1e8, since its weights add up to nothing."""
    (tmp_path / "scene.toml").write_text(SCENE)
    for weighting, covered in (("hann", 0.11), ("taylor:4:-35", 0.03)):
        asked = {"grid": GRID, "weighting": weighting, "processor": "angular-division"}
        plan = blocksar.plan(tmp_path / "scene.toml", **asked).result
        grounds = [block.ground for block in plan.blocks]
        weight, lit = (np.concatenate(each) for each in zip(*((g.weight[0], g.lit) for g in grounds), strict=True))
        share = np.concatenate([lit_pulses(plan.geometry.collection, g.yaw_axis, ONE) for g in grounds])
        dark = np.isnan(weight)
        assert dark.any() and not dark[share > covered * share.max()].any()
        assert lit[~dark].min() > 0.005 * lit.max()


def test_a_rough_fit_without_a_full_dwell_is_judged_by_what_there_is() -> None:
    """At three of a block's ranges none may be: it ended in a traceback on gentle terrain."""
    collection = axis_collection()
    geometry, yaw = Geometry(collection=collection), np.linspace(-0.01, 0.01, 5)
    line = Dwells(geometry=geometry, yaw=yaw, origin=9800.0, walk=0.0).lines(np.array([[9800.0], [9850.0]]))
    none = np.zeros((2, 5), np.bool_)
    assert np.isfinite(smear_loss(line, focus(line), line.rate, geometry, none))
