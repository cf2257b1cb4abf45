"""Windows at the ends of whole dwells that a keystone spreads over a wide band."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import blocksar
from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import RowPolynomial
from blocksar.kernels import fourier
from blocksar.planning.end_windows import end_lift

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
GRID = "8000:8660:3,5700:6400:3"


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


def test_a_wide_band_leaves_width_and_level_of_targets_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    store, run = tmp_path / "scene.zarr", tmp_path / "run"
    blocksar.simulate(tmp_path / "scene.toml", store)
    assert blocksar.plan(store, grid=GRID, weighting="taylor:4:-35").result.fade == 0
    blocksar.focus(store, run, grid=GRID, weighting="taylor:4:-35", workers=0, progress=False)
    (found,) = blocksar.quality(run).result["targets"]
    # Without raised windows 1.0047 and 0.9976.
    assert found["azimuth_irw"] == pytest.approx(found["azimuth_irw_theory"], rel=0.0015)
    assert abs(complex(*found["value"])) == pytest.approx(1, abs=0.0015)


def test_edges_are_summed_where_windows_would_change_the_side_lobes(tmp_path: Path) -> None:
    """Those of `hamming` are lower, and further out, where raised windows serve less."""
    (tmp_path / "scene.toml").write_text(SCENE)
    plan = blocksar.plan(tmp_path / "scene.toml", grid=GRID, weighting="hamming").result
    assert plan.fade > 0
    prediction = plan.blocks[0].prediction
    assert prediction.pslr == pytest.approx(prediction.ideal_pslr, abs=0.1)
    assert prediction.ideal_pslr == pytest.approx(Taper.parse("hamming").ideal.pslr, abs=0.05)
