"""Beams about the antenna's own axis, against an explicit double loop; patterns; what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axis_beams import MODES, axis_collection, boom, spotlight, with_patterns
from slow_twins import gain, lit, offset

from blocksar.arrays import FloatArray
from blocksar.collection.beam import (
    aperture,
)
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.region import default_grid, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Taper
from blocksar.errors import InputError

EACH = pytest.mark.parametrize("mode", MODES)


def points(collection: Collection, *, n: int = 60) -> tuple[FloatArray, FloatArray]:
    """x, y (m) in and about what is lit at some time; some far from it."""
    rng = np.random.default_rng(5)
    assert collection.beam_steering is not None
    x = rng.uniform(8300, 9700, n)
    ahead = np.hypot(x, 4000) * np.tan(rng.choice(collection.beam_steering, n) + rng.uniform(-0.01, 0.01, n))
    y = collection.antenna_position[rng.integers(collection.n_pulse, size=n), 1] + ahead
    y[::10] += 4000
    return x, y


def slow_mask(collection: Collection, x: FloatArray, y: FloatArray) -> Any:
    return np.array([[lit(collection, p, *at) for p in range(collection.n_pulse)] for at in zip(x, y, strict=True)])


@pytest.mark.parametrize("mode", [*MODES, "spotlight"])
def test_lit_pulses_are_those_of_the_double_loop(mode: str) -> None:
    collection = spotlight() if mode == "spotlight" else axis_collection(mode)
    geometry = Geometry(collection=collection)
    x, y = points(collection)
    expected = slow_mask(collection, x, y)
    assert expected.any() and not expected.any(axis=1).all()
    np.testing.assert_array_equal(geometry.beam.is_lit(x, y), expected)
    np.testing.assert_array_equal(geometry.beam.is_lit(x, y, slice(50, 70)), expected[:, 50:70])
    first, last = geometry.beam.longest_pass(x.reshape(6, 10), y.reshape(6, 10))
    pulse = np.arange(collection.n_pulse)
    np.testing.assert_array_equal((pulse >= first.reshape(-1, 1)) & (pulse < last.reshape(-1, 1)), expected)
    assert (last.ravel()[~expected.any(axis=1)] == 0).all()


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(("kind", "side"), [("circle", "right"), ("circle", "left"), ("arc", "right"), ("arc", "left")])
def test_an_antenna_that_turns_round_lights_one_side(kind: str, side: str, backwards: bool) -> None:
    collection, towards = boom(kind, side, backwards=backwards)
    beam = Geometry(collection=collection).beam
    x, y = (np.random.default_rng(axis).uniform(-30, 30, 50) for axis in (1, 2))
    x[0] = np.nan
    sight = np.stack([x, y, 0 * x], axis=1)[:, None] - collection.antenna_position
    sine = (sight * collection.beam_axis).sum(axis=2) / np.linalg.norm(sight, axis=2)
    expected = (np.abs(np.arcsin(sine)) <= np.pi / 6) & ((sight[..., :2] * towards).sum(axis=2) >= 0)
    np.testing.assert_array_equal(expected[3, 7], lit(collection, 7, x[3], y[3]))
    np.testing.assert_array_equal(beam.is_lit(x, y), expected)
    first, last = beam.passes(x, y)
    pulse = np.arange(collection.n_pulse)
    np.testing.assert_array_equal(((pulse >= first[..., None]) & (pulse < last[..., None])).sum(axis=0), expected)
    begin, end = beam.dwell(x[1:], y[1:])
    single = np.count_nonzero(last > first, axis=0)[1:] == 1
    assert single.any()
    length, count = ((end - begin) * collection.prf)[single], expected[1:].sum(axis=1)[single]
    assert np.abs(length - count).max() < 1
    np.testing.assert_array_equal((end > begin), expected[1:].any(axis=1))


def test_a_side_is_asked_only_of_antennas_that_move_along_their_axis() -> None:
    """An antenna at the nose, with its axis across the track, looks ahead: no side of its axis is left or right."""
    collection = axis_collection(beam_axis=np.tile([1.0, 0.0, 0.0], (400, 1)), beam_steering=np.zeros(400))
    x, y = np.array([-3.0, 3.0]), np.full(2, 9000.0)
    assert Geometry(collection=replace(collection, side_of_track="left")).beam.is_lit(x, y).all()


@EACH
def test_a_dwell_covers_its_lit_pulses(mode: str) -> None:
    collection = axis_collection(mode)
    geometry = Geometry(collection=collection)
    x, y = points(collection)
    mask = slow_mask(collection, x, y)
    count = mask.sum(axis=1)
    start, end = geometry.beam.dwell(x, y)
    begin, stop = aperture(collection)
    some = count > 0
    assert (start[some] >= begin).all() and (end[some] <= stop).all()
    assert np.abs((end - start) * collection.prf - count)[some].max() <= 1
    assert ((end - start)[~some] * collection.prf < 1).all()
    assert geometry.beam.most_lit_pulses(x, y) in (count.max(), count.max() + 1)
    # Times of the beam's edges are those of a finer track, on which they fall between other pulses.
    inside = some & ~mask[:, 0] & ~mask[:, -1]
    fine = np.linspace(collection.time[0], collection.time[-1], 40 * collection.n_pulse)
    for i in np.flatnonzero(inside)[:5]:
        offsets = np.interp(fine, collection.time, _offsets(collection, x[i], y[i]))
        lit_time = fine[np.abs(offsets) <= (collection.beam_width or 0) / 2]
        np.testing.assert_allclose([start[i], end[i]], [lit_time[0], lit_time[-1]], atol=1.1 * (fine[1] - fine[0]))


def _offsets(collection: Collection, x: float, y: float) -> FloatArray:
    sight = np.array([x, y, 0.0]) - collection.antenna_position
    sine = (sight * collection.beam_axis).sum(axis=1) / np.linalg.norm(sight, axis=1)
    return np.asarray(np.arcsin(sine) - collection.beam_steering)


@EACH
def test_a_full_dwell_is_cut_by_neither_end(mode: str) -> None:
    collection = axis_collection(mode)
    geometry = Geometry(collection=collection)
    x, y = points(collection, n=200)
    mask = geometry.beam.is_lit(x, y)
    whole = mask.any(axis=1) & ~mask[:, 0] & ~mask[:, -1]
    full = geometry.beam.has_full_dwell(x, y)
    assert whole.any() and not whole.all()
    assert full[whole].all() and not full[~mask.any(axis=1)].any()
    assert (full & ~whole).sum() <= 4  # within a pulse of the ends
    assert Geometry(collection=spotlight()).beam.has_full_dwell(9000.0, 0.0)  # lit all the time


def test_dwells_depend_on_range_and_go_on_beyond_the_collection() -> None:
    geometry = Geometry(collection=axis_collection())
    ranges = np.array([9400.0, 9850.0, 10300.0])[:, None]
    yaw = np.linspace(-0.03, 0.03, 41)
    first, last = geometry.beam.dwell_at(yaw, ranges)
    assert first.shape == (3, 41)
    x, y = geometry.ground_axes(ranges, yaw)
    np.testing.assert_array_equal(geometry.beam.dwell(x, y), (first, last))
    begin, end = geometry.beam.dwell_at(yaw, ranges, uncut=True)
    cut = (first <= aperture(geometry.collection)[0]) | (last >= aperture(geometry.collection)[1])
    np.testing.assert_array_equal(begin[~cut], first[~cut])
    length = (end - begin)[1, 20]
    assert (length > 0.5) and np.abs((end - begin) / length - ranges / ranges[1]).max() < 0.08  # as range, in a strip
    np.testing.assert_allclose(np.diff(begin, 2, axis=1), 0, atol=0.01)  # no steps where the cut begins


def test_the_beam_s_centre_is_in_the_middle_of_the_beam() -> None:
    for mode in MODES:
        collection = axis_collection(mode)
        geometry = Geometry(collection=collection)
        at = float(collection.reference_range[0])
        side = 0.27 if mode == "squinted" else 0.0
        yaw = geometry.beam.centre_yaw(collection.time, at, side - 0.25, side + 0.25)
        x, y = geometry.ground_axes(np.array(at), yaw)
        p = np.arange(40, 360)  # where what the beam passes from now on is yet lit to the end
        off = [_offsets(collection, x[k], y[k])[k] for k in p]
        assert np.abs(off).max() < 0.1 * (collection.beam_width or 0)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [0.7, 1.0, 3.5])
def test_a_beam_may_pass_points_several_times(turns: float) -> None:
    """All their lit pulses are in the passes, the longest pass is the interval, and none of them has its full dwell."""
    n = 400
    collection = axis_collection(beam_steering=0.03 * np.cos(np.linspace(0, 2 * np.pi * turns, n)))
    geometry = Geometry(collection=collection)
    x, y = np.full((3, 20), 9000.0) + np.arange(3)[:, None] * 90, np.tile(np.linspace(-420, 420, 20), (3, 1))
    expected = slow_mask(collection, x.ravel(), y.ravel()).reshape(3, 20, n)
    first, last = geometry.beam.passes(x, y)
    number, pulse = np.count_nonzero(last > first, axis=0), np.arange(n)
    assert number.max() == len(first) == {0.7: 2, 1.0: 2, 3.5: 7}[turns] and number.min() == 0
    inside = (pulse >= first[..., None]) & (pulse < last[..., None])
    np.testing.assert_array_equal(inside.sum(axis=0), expected)
    assert (first[1:] >= last[:-1]).all() and (last[:, number == 0] == 0).all()
    begin, end = geometry.beam.longest_pass(x, y)
    np.testing.assert_array_equal(end - begin, (last - first).max(axis=0))
    assert not geometry.beam.has_full_dwell(x, y)[number > 1].any()


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("patterns", [False, True])
def test_sums_over_lit_pulses_are_those_of_the_double_loop(patterns: bool, text: str) -> None:
    collection = with_patterns(axis_collection()) if patterns else axis_collection()
    geometry = Geometry(collection=collection)
    valid = np.ones(collection.n_pulse)
    valid[100:130] = 0.0
    ranges, yaw = np.array([9500.0, 9900.0, 10200.0]), np.linspace(-0.025, 0.025, 11)
    taper, half = Taper.parse(text), (collection.beam_width or 0.0) / 2
    total = geometry.beam.lit_total(ranges, yaw, valid, taper)
    x, y = geometry.ground_axes(ranges[:, None], yaw)
    for place in np.ndindex(total.shape):
        at = float(x[place]), float(y[place])
        expected = sum(
            valid[p] * gain(collection, p, *at) * float(taper(np.array(offset(collection, p, *at) / half)))
            for p in range(400)
            if lit(collection, p, *at)
        )
        assert total[place] == pytest.approx(expected, abs=1.2)
    assert total.max() > 100 and (total == 0).any()


def test_the_pattern_is_that_of_the_double_loop() -> None:
    axis = with_patterns(axis_collection("tops"))
    azimuth = {"beam_axis": None, "beam_steering": None, "beam_azimuth": np.linspace(-0.02, 0.02, 400)}
    for collection in (axis, Collection(**{**axis.as_dict(), **azimuth})):
        x, y = np.linspace(8800, 9200, 7), np.linspace(-100, 100, 7)
        found = Geometry(collection=collection).beam.gain(x[:, None], y[:, None], slice(0, 400, 50))
        expected = [[gain(collection, p, *at) for p in range(0, 400, 50)] for at in zip(x, y, strict=True)]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
        assert np.ptp(found) > 0.1


@pytest.mark.slow
def test_the_region_is_what_the_beam_lights() -> None:
    for mode in MODES:
        collection = axis_collection(mode)
        geometry = Geometry(collection=collection)
        y0 = 2300.0 if mode == "squinted" else 0.0
        region = plan_region(geometry, Grid(8900.0, 9100.0, 2.0, y0 - 60.0, y0 + 60.0, 2.0))
        x, y = points(collection, n=400)
        rng, yaw = geometry.epoch_range(x, y), geometry.yaw(x, y)
        near, far = region.at(yaw)
        held = np.abs(rng - collection.reference_range[0]) < 0.35 * collection.range_window
        inside = (yaw > region.yaw[0]) & (yaw < region.yaw[-1]) & (rng >= near) & (rng <= far)
        some = geometry.beam.is_lit(x, y).any(axis=1)
        assert inside[some & held].all(), mode
        assert inside[~some].mean() < 0.3
    with pytest.raises(
        InputError, match=r"the beam \(beam_axis, .*lights none of its yaws; its middle lies .* move th"
    ):
        plan_region(geometry, Grid(8900.0, 9100.0, 2.0, 5000.0, 5100.0, 2.0))


@pytest.mark.parametrize(("mode", "side"), [*((mode, "right") for mode in [*MODES, "spotlight"]), ("tops", "left")])
def test_the_default_grid_is_the_ground_with_full_dwell(mode: str, side: str) -> None:
    collection = spotlight() if mode == "spotlight" else axis_collection(mode)
    geometry = Geometry(collection=replace(collection, side_of_track=side))
    grid = default_grid(geometry, plan_region(geometry, None))
    at, ahead = (9000.0 if side == "right" else -9000.0), (2450.0 if mode == "squinted" else 0.0)
    assert grid.x[0] < at < grid.x[-1] and grid.x[0] * grid.x[-1] > 0
    x, y = np.meshgrid(at + np.linspace(-150, 150, 31), np.linspace(-160, 160, 129) + ahead)
    full = geometry.beam.has_full_dwell(x, y)
    room = 0.02 * (grid.y[-1] - grid.y[0]) + 2.5 + 2 * grid.dy
    assert full.any() and (y[full] > grid.y[0] - room).all() and (y[full] < grid.y[-1] + room).all()
    if mode != "squinted":  # whose footprint is a slanting strip in its bounding box
        mesh = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], 41), np.linspace(grid.y[0], grid.y[-1], 41))
        assert geometry.beam.has_full_dwell(*mesh).mean() > 0.7
        geometry.beam.longest_pass(*mesh)  # none is lit twice
    place = float(geometry.epoch_range(at, y[full].mean())), float(geometry.yaw(at, y[full].mean()))
    across, along = ground_resolution(geometry, *place)
    assert 0.3 < grid.dx / across < 0.75
    assert 0.3 < grid.dy / (min(across, along) if mode == "squinted" else along) < 0.75


def test_the_side_of_the_track_has_to_be_known() -> None:
    collection = axis_collection()
    with pytest.raises(InputError, match=r"grid is missing: .*both sides of the track.*attribute side_of_track"):
        plan_region(Geometry(collection=collection), None)
    geometry = Geometry(collection=replace(collection, side_of_track="left"))
    with pytest.raises(InputError, match=r"lies right of the flight, but side_of_track is 'left': correct one of"):
        plan_region(geometry, Grid(8900.0, 9100.0, 2.0, -60.0, 60.0, 2.0))
    moved = {"antenna_position": collection.antenna_position - [9000.0, 0.0, 0.0]}  # the origin is the scene's centre
    geometry = Geometry(collection=Collection(**{**collection.as_dict(), **moved}))
    grid = default_grid(geometry, plan_region(geometry, None))
    assert grid.x[0] < 0 < grid.x[-1] and grid.x[0] > -1000


N = 400
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "both kinds": ({"beam_azimuth": np.linspace(0, 0.1, N)}, "beam_azimuth and beam_axis are both given"),
    "no steering": ({"beam_steering": None}, "beam_axis is given without beam_steering"),
    "no axis": ({"beam_axis": None}, "beam_steering is given without beam_axis"),
    "no unit vector": ({"beam_axis": np.tile([0.0, 1.01, 0.0], (N, 1))}, r"length of 1\.01 .* must be a unit vector"),
    "axis is NaN": ({"beam_axis": np.full((N, 3), np.nan)}, "beam_axis is not finite at 400 of 400 pulses"),
    "steering is NaN": ({"beam_steering": np.append(np.zeros(N - 1), np.nan)}, r"first: pulse 399"),
    "axis of another shape": ({"beam_axis": np.ones((N, 2))}, r"beam_axis has shape \(400, 2\)"),
    "steering of another shape": ({"beam_steering": np.zeros(3)}, r"beam_steering has shape \(3,\)"),
    "no width": ({"beam_width": None}, "beam_width must lie between 0 and pi rad where beam_axis"),
    "width in degrees": ({"beam_width": 12.0}, "it looks like degrees"),
    "steered along the axis": ({"beam_steering": np.full(N, 1.6)}, r"beam_steering is 1\.6 rad .* below pi / 2"),
    "steering jumps": ({"beam_steering": np.repeat([0.0, 0.1], N // 2)}, "jumps by 0.1 rad at pulse 200"),
    "axis jumps": (
        {"beam_axis": np.repeat([[0, 1.0, 0], [0, -1.0, 0]], N // 2, axis=0)}, "beam_axis jumps by 2 rad at pulse 200"
    ),
    "pattern without angles": ({"beam_pattern": np.ones(3)}, "beam_pattern is given without beam_offset"),
    "absurd pattern": (
        {"elevation": np.array([0.1, 1.2]), "elevation_pattern": np.full(2, 1e-300)}, "is 1e-300 at most, which no"
    ),
    "angles without pattern": ({"elevation": np.ones(3)}, "elevation is given without elevation_pattern"),
    "narrow pattern": (
        {"beam_offset": np.array([-0.001, 0.001]), "beam_pattern": np.ones(2)},
        r"beam_pattern covers beam_offset = -0\.001 .* give it for all of that",
    ),
    "elevation elsewhere": (
        {"elevation": np.array([1.0, 1.2]), "elevation_pattern": np.ones(2)}, "ground at reference_range needs 0.41"
    ),
    "pattern descends": (
        {"beam_offset": np.array([0.1, -0.1]), "beam_pattern": np.ones(2)}, "beam_offset does not ascend at index 1"
    ),
    "pattern is negative": (
        {"beam_offset": np.array([-0.1, 0.1]), "beam_pattern": np.array([1, -1.0])}, "an amplitude: at least 0"
    ),
    "pattern is NaN": (
        {"beam_offset": np.array([-0.1, 0.1]), "beam_pattern": np.array([1, np.nan])}, "not finite at 1 of 2 values"
    ),
    "pattern of another length": (
        {"beam_offset": np.array([-0.1, 0.1]), "beam_pattern": np.ones(3)}, r"shape \(3,\) and beam_offset has \(2,\)"
    ),
    "noise": ({"noise_power": -1.0}, "noise_power must be 0 or between 1e-30 and 1e"),
    "loud noise": ({"noise_power": 1e300}, "noise_power must be 0 or between 1e-30 and 1e"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_wrong_beams_are_refused(case: str) -> None:
    changes, message = BAD[case]
    with pytest.raises(InputError, match=message) as caught:
        axis_collection(**changes)
    assert "\n" not in str(caught.value)


def test_a_pattern_needs_a_beam() -> None:
    unsteered = {"beam_axis": None, "beam_steering": None, "beam_width": None}
    down = math.asin(4000 / math.hypot(9000, 4000))
    assert axis_collection(
        **unsteered, elevation=np.array([down - 0.1, down + 0.1]), elevation_pattern=np.ones(2)
    ).has_pattern


def test_points_without_a_height_are_lit_by_no_pulse() -> None:
    """A grid may reach beyond its terrain."""
    collection = axis_collection()
    x, y = np.meshgrid(np.linspace(8900, 9100, 5), np.linspace(-50, 50, 5))
    terrain = Terrain.flat(0.0, (8990.0, 9110.0), (-100.0, 100.0))
    assert over_terrain(collection, terrain).beam.most_lit_pulses(x, y) > 50
    assert over_terrain(collection, terrain).beam.most_lit_pulses(x - 900, y) == 0


def test_a_terrain_above_the_antenna_is_named() -> None:
    """The message named ground_height, which was 0."""
    collection = axis_collection()
    terrain = Terrain.flat(5000.0, (8500.0, 9500.0), (-500.0, 500.0))
    with pytest.raises(InputError, match=r"^the terrain lies at z = 5000 m on average, and the antenna falls to"):
        over_terrain(collection, terrain)
