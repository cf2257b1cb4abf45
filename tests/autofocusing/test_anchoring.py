"""Control points anchor what the samples alone do not tell."""

from __future__ import annotations

import numpy as np
import pytest
import wrong_tracks

from blocksar.autofocusing import anchoring
from blocksar.autofocusing.anchoring import Control, anchor
from blocksar.autofocusing.chips import take_chips
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.track_correction import Correction
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene

PLACES = np.array([[-40.0, -50.0], [45.0, 10.0], [0.0, 55.0], [30.0, -45.0], [-50.0, 20.0], [55.0, 50.0]])
PHASES = np.array([0.3, -1.0, 2.0, 0.0, 1.0, -2.0])
GRID = Grid(*wrong_tracks.GRID[0], *wrong_tracks.GRID[1])


def anchored(
    offset: list[float],
    velocity: list[float],
    count: int = 4,
    said: np.ndarray | None = None,
    phases: np.ndarray = PHASES,
    neighbours: np.ndarray | None = None,
) -> tuple[Work, Result, np.ndarray]:
    """A track that is wrong by a constant and a line, corrected by control points; the true positions.

    The first `count` of six points are said to lie at `said` (6, 3), m, and to have `phases` (6,), rad. There may be
    `neighbours` (n, 2), m, ten times as bright.
    """
    places = np.column_stack([PLACES, np.zeros(6)]) if said is None else said
    true = Scene.parse(wrong_tracks.SCENE).collection()
    others = np.zeros((0, 2)) if neighbours is None else neighbours
    at = np.concatenate([PLACES, others])
    amplitudes = np.concatenate([np.exp(1j * PHASES), np.full(len(others), 10.0)])
    signal = simulate_pulses(true, at[:, 0], at[:, 1], amplitudes)
    wrong = true.antenna_position + np.array(offset) + true.time[:, None] * np.array(velocity)
    work = begin(Geometry(collection=Collection(**{**true.as_dict(), "antenna_position": wrong}).centred()), GRID)
    control = Control(
        names=tuple("ABCDEF"[:count]),
        x=places[:count, 0],
        y=places[:count, 1],
        z=places[:count, 2],
        phase=phases[:count],
    )
    nothing, points = Correction.none(work), control.points(work)
    parts = [take_chips(signal[pulses], work, points, nothing.displacement, pulses) for pulses in work.blocks]
    time = work.sample_times
    empty = np.zeros((0, 1, 1))
    result = Result(
        antenna_position=wrong, time=time, track_error=np.zeros((time.size, 3)), uncertainty=np.zeros((time.size, 3)),
        x=np.zeros(0), y=np.zeros(0), chips_before=empty, chips_after=empty,
        figures={"points": 30, "predicted_error": 0.01},
    )  # fmt: skip
    return work, anchor(work, result, control, parts, nothing), true.antenna_position


@pytest.mark.parametrize(
    ("offset", "velocity"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.06, 0.0, 0.05], [0.0, 0.03, 0.0]),
        ([-0.2, 0.1, 0.3], [0.02, -0.05, 0.01]),
    ],
)
def test_range_and_phase_of_places_are_those_of_the_true_track(offset: list[float], velocity: list[float]) -> None:
    work, result, true = anchored(offset, velocity)
    assert result.figures["points"] == 30 and result.figures["control"]["points"] == 4
    assert result.figures["control"]["phase_left"] < 0.1
    taken = np.stack([np.interp(work.geometry.collection.time, result.time, axis) for axis in result.track_error.T], 1)
    inside = slice(20, -20)  # beyond the first and last sample of the chips, np.interp is constant
    moved = work.geometry.collection.antenna_position - result.antenna_position
    assert taken[inside] == pytest.approx(moved[inside], abs=1e-4)
    for x, y in [*PLACES, [10.0, 10.0]]:  # also where there is no control point
        ranges = [np.linalg.norm([x, y, 0.0] - track, axis=1) for track in (result.antenna_position, true)]
        left = work.wavenumber * (ranges[0] - ranges[1])
        turns = 2 * np.pi * np.round(left.mean() / (2 * np.pi))
        assert abs(turns) <= 2 * 2 * np.pi  # from the range of the points: within 3 cm
        assert np.abs(left - turns).max() < 0.35


def test_a_point_at_a_wrong_place_is_left_out() -> None:
    said = np.column_stack([PLACES, np.zeros(6)])
    said[2, :2] += 0.5, -0.7
    _, result, true = anchored([0.06, 0.0, 0.05], [0.0, 0.03, 0.0], said=said)
    assert result.figures["control"]["left_out"] == ["C"] and result.figures["control"]["points"] == 3
    assert np.abs(result.antenna_position - true).max() < 0.1


def test_places_that_are_all_shifted_move_the_track_by_as_much_and_keep_the_focus() -> None:
    shift = np.array([2.0, 2.0, 0.0])
    work, result, true = anchored(
        [0.06, 0.0, 0.05], [0.0, 0.0, 0.0], said=np.column_stack([PLACES, np.zeros(6)]) + shift
    )
    moved = np.linalg.norm(result.antenna_position - work.geometry.collection.antenna_position, axis=1).max()
    assert moved == pytest.approx(result.figures["control"]["moved"], abs=0.01) and 1.5 < moved < 3.0
    for x, y in PLACES:  # seen from the track, the shifted places are where the true ones are
        ranges = [
            np.linalg.norm([x + dx, y + dy, 0.0] - track, axis=1)
            for track, (dx, dy) in ((result.antenna_position, shift[:2]), (true, (0.0, 0.0)))
        ]
        left = work.wavenumber * (ranges[0] - ranges[1])
        assert np.std(left) < 0.2
    assert result.figures["predicted_error"] < 0.05


def test_bright_neighbours_are_not_taken_for_the_points() -> None:
    neighbours = PLACES + np.array([[0.0, 6.0], [1.0, -9.0], [0.5, -7.0], [-1.0, 8.0], [0.0, 7.0], [0.5, -8.0]])
    alone, among = (anchored([0.06, 0.0, 0.05], [0.0, 0.03, 0.0], neighbours=n) for n in (None, neighbours))
    assert among[1].figures["control"]["left_out"] == []
    assert np.abs(among[1].antenna_position - alone[1].antenna_position).max() < 0.05
    assert np.abs(among[1].antenna_position - among[2]).max() < 0.1


def test_what_the_points_leave_is_in_the_predicted_error() -> None:
    _, result, _ = anchored([0.06, 0.0, 0.05], [0.0, 0.0, 0.0])
    left = result.figures["control"]["bend_left"]
    assert 0 < left < 0.02
    assert result.figures["predicted_error"] == pytest.approx(np.hypot(0.01, left))


@pytest.mark.parametrize(
    "off",
    [
        [[0, 0, 20.0]] * 4,  # metres: out of their chips
        [[0.4, 0, 0], [0, 0.5, 0], [-0.4, 0, 0], [0, 0, 1]],
        [[30.0, 0, 0], [0, 20.0, 0], [0, 0, 0], [0, 0, 0]],
    ],
)
def test_points_that_are_not_at_their_places_are_refused(off: list[list[float]]) -> None:
    places = np.column_stack([PLACES, np.zeros(6)])
    places[:4] += np.array(off)
    message = (
        r"control: [234] of 4 points \([A-D, ]+\) are not seen where .* 1 may be left out .*; correct their x, y, z"
    )
    with pytest.raises(InputError, match=message):
        anchored([0.06, 0.0, 0.05], [0.0, 0.0, 0.0], said=places)


def test_reflectivities_that_do_not_agree_are_refused() -> None:
    wrong = PHASES + np.array([-0.1, 2.3, 2.6, -0.9, 0.4, -1.1])
    message = (
        r"control: the 6 points \(A, B, C, D, \.\.\.\) do not agree: .* phases .* 2 times are believed; .* reflect"
    )
    with pytest.raises(InputError, match=message):
        anchored([0.06, 0.0, 0.05], [0.0, 0.0, 0.0], count=6, phases=wrong)


def test_a_track_that_would_move_too_far_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(anchoring, "MOST_MOVED", 1.0)
    places = np.column_stack([PLACES, np.zeros(6)]) + np.array([2.0, 0.0, 0.0])
    with pytest.raises(
        InputError, match=r"control: .* the track would have to move by [1-3]\.\d+ m, and 1 m are believed"
    ):
        anchored([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], said=places)


def test_one_point_anchors_its_own_line_of_sight() -> None:
    work, result, true = anchored([0.06, 0.0, 0.05], [0.0, 0.0, 0.0], count=1)
    ranges = [np.linalg.norm([*PLACES[0], 0.0] - track, axis=1) for track in (result.antenna_position, true)]
    left = work.wavenumber * (ranges[0] - ranges[1])
    assert np.abs(left - 2 * np.pi * np.round(left.mean() / (2 * np.pi))).max() < 0.2


def test_a_point_that_is_not_there_is_named() -> None:
    true = Scene.parse(wrong_tracks.SCENE).collection()
    work = begin(Geometry(collection=true.centred()), GRID)
    noise = np.random.default_rng(1).standard_normal((true.n_pulse, 2 * true.n_range_frequency)).view(np.complex128)
    control = Control(names=("A",), x=np.zeros(1), y=np.zeros(1), z=np.zeros(1), phase=np.zeros(1))
    nothing, points = Correction.none(work), control.points(work)
    signal = noise.astype(np.complex64)
    parts = [take_chips(signal[pulses], work, points, nothing.displacement, pulses) for pulses in work.blocks]
    zero = np.zeros((work.sample_times.size, 3))
    result = Result(
        antenna_position=true.antenna_position, time=work.sample_times, track_error=zero, uncertainty=zero,
        x=np.zeros(0), y=np.zeros(0), chips_before=zero, chips_after=zero, figures={"predicted_error": 0.01},
    )  # fmt: skip
    with pytest.raises(InputError, match="control point A is not seen"):
        anchor(work, result, control, parts, nothing)
