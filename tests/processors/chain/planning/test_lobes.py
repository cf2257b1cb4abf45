"""Side lobes that a plan predicts under a weighting, beside the exact back-projection of one target."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from axis_beams import axis_collection
from exact_scenes import exact_scene, lit
from summed_response import summed_response

import blocksar
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.measurement.axes import response_axes
from blocksar.measurement.targets import Target
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.planning.prediction import LOBES, SAMPLES, side_lobe, side_lobe_as_in
from blocksar.processors.chain.processor import plan_lines

TAYLOR = "taylor:4:-35"
RADAR = """
[radar]
carrier = {carrier}
bandwidth = {bandwidth}
range_sampling = {sampling}
prf = {prf}
[track]
position = [0.0, 0.0, 2500.0]
velocity = [0.0, {speed}, 0.0]
"""
TARGET = """
[[targets]]
name = "P"
x = {x}
y = {y}
"""
# The beam steps on by some tenths of a percent of a dwell from one resolution cell to the next; a band of 23 %.
SCENES = {
    "yaw": (
        RADAR.format(carrier=9.6e9, bandwidth=40e6, sampling=50e6, prf=4800.0, speed=180.0)
        + "[time]\nduration = 1.0\n[beam]\nstart_deg = 6.0\nstop_deg = -6.0\ndwell = 0.4\n[scene]\n"
        + 'swath = [7400.0, 7800.0]\ncentre_yaw_deg = 0.0\nreference_range = "scene_centre"\n',
        "7000:7300:3,-60:60:2",
        (7150.0, 0.0),
    ),
    "wide band": (
        RADAR.format(carrier=435e6, bandwidth=100e6, sampling=120e6, prf=100.0, speed=80.0)
        + "[time]\nduration = 6.0\n[scene]\nswath = [3400.0, 3800.0]\ncentre_yaw_deg = 0.0\n"
        + 'reference_range = "scene_centre"\n',
        "2500:2600:1,-50:50:2",
        (2550.0, 0.0),
    ),
}
CUT = (
    RADAR.format(carrier=400e6, bandwidth=40e6, sampling=50e6, prf=60.0, speed=70.0)
    + '[time]\nduration = 6.0\n[beam]\nmode = "stripmap"\nwidth_deg = 12.0\nsquint_deg = 10.0\n[scene]\n'
    + 'swath = [3000.0, 3500.0]\ncentre_yaw_deg = 10.0\nreference_range = "scene_centre"\n'
)


def scene(folder: Path, text: str, at: tuple[float, float]) -> Path:
    path = folder / "scene.toml"
    path.write_text(text + TARGET.format(x=at[0], y=at[1]))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_ideal_side_lobes_are_those_of_back_projection(tmp_path: Path, name: str) -> None:
    """The beam moves on from pixel to pixel, and over a wide band echoes leave the range cell of a pixel beside.

    With many pulses in a dwell: it begins and ends at whole ones.
    """
    text, grid, at = SCENES[name]
    plan = blocksar.plan(scene(tmp_path, text, at), grid=grid, blocks=1, weighting=TAYLOR).result
    geometry, weighting = plan.geometry, Weighting.parse(TAYLOR)
    axes = response_axes(geometry, *at, weighting)
    assert axes is not None
    widths = np.linspace(-LOBES, LOBES, SAMPLES) / weighting.azimuth.ideal.width * axes.azimuth_width
    dx, dy = axes.ground_offset(np.zeros(SAMPLES), widths)
    exact = side_lobe(np.abs(summed_response(geometry, Target("P", *at), at[0] + dx, at[1] + dy, weighting)))
    assert abs(exact - weighting.azimuth.ideal.pslr) > 0.15
    predicted = plan.blocks[0].prediction
    assert predicted.ideal_pslr == pytest.approx(exact, abs=0.05)
    assert predicted.pslr == pytest.approx(exact, abs=0.3)


def test_a_shoulder_counts_in_both_of_two_responses_or_in_none() -> None:
    u = np.linspace(-LOBES, LOBES, SAMPLES)
    plain = np.abs(np.sinc(u)) + 0.1 * np.exp(-((u - 0.8) ** 2) / 0.02)
    minimum = plain.copy()
    minimum[(u > 0.6) & (u < 0.62)] = 0.0
    assert abs(side_lobe(minimum) - side_lobe(plain)) > 3
    assert side_lobe_as_in(plain, minimum) == pytest.approx(side_lobe(plain), abs=0.01)
    assert side_lobe_as_in(minimum, plain) == pytest.approx(side_lobe(minimum), abs=0.01)


@pytest.mark.slow
def test_a_plan_says_where_all_dwells_are_cut(tmp_path: Path) -> None:
    grid = "1950:2150:5,300:500:8"
    path = scene(tmp_path, CUT, (2050.0, 400.0))
    report = blocksar.plan(path, grid=grid, blocks=1, weighting=TAYLOR)
    side = report.result.blocks[0].prediction.ideal_pslr
    assert side > -30
    assert any(f"no full dwell: the weighting of cut dwells is cut as well, with side lobes of up to {side:.2f} dB" in
               line for line in report.summary)  # fmt: skip
    assert not any("no full dwell" in line for line in blocksar.plan(path, grid=grid, blocks=1).summary)


def test_a_plan_says_on_which_share_of_the_grid_its_prediction_holds() -> None:
    collection = exact_scene(5).collection
    plan = plan_collection(collection, blocks=1)
    x, y = plan.grid.x[::12], plan.grid.y[::12]
    places = [np.array([east, north, 0.0]) for north in y for east in x]
    uncut = [seen.any() and not (seen[0] or seen[-1]) for seen in (lit(collection, each) for each in places)]
    said = next(line for line in plan_lines(plan) if "targets with full dwell" in line)
    assert float(said.rpartition("(")[2].partition(" %")[0]) == pytest.approx(100 * np.mean(uncut), abs=2)


def test_targets_that_a_beam_never_reaches_have_no_weights_that_move() -> None:
    """A beam that turns back before it reaches them lights them for 0 s, and numpy warned of a division by that."""
    steering = 0.006 * np.cos(np.linspace(0, 2 * np.pi, 400))
    plan = plan_collection(
        axis_collection(beam_steering=steering), grid=Grid(8900.0, 9300.0, 4.0, -100.0, 100.0, 2.0), blocks=1,
        weighting=Weighting.parse(TAYLOR),
    )  # fmt: skip
    assert all(np.isfinite(block.prediction).all() for block in plan.blocks)
