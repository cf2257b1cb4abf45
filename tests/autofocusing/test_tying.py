"""Tracks of collections that overlap are tied by points that both see."""

from __future__ import annotations

import numpy as np
import pytest
import wrong_tracks

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.autofocusing.chips import ChipPart, take_chips
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.track_correction import Correction
from blocksar.autofocusing.tying import Places, control_of, find_places, places_seen, shared_points, tie, tie_in_turn
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene

PLACES = np.array([[-40.0, -50.0], [45.0, 10.0], [0.0, 55.0], [30.0, -45.0], [-50.0, 20.0], [55.0, 50.0]])
GRID = Grid(*wrong_tracks.GRID[0], *wrong_tracks.GRID[1])
TRUE = Scene.parse(wrong_tracks.SCENE).collection()


def work_with(wrong: FloatArray | float) -> Work:
    """A collection whose track is wrong by (n_pulse, 3), m."""
    stated = Collection(**{**TRUE.as_dict(), "antenna_position": TRUE.antenna_position + wrong})
    return begin(Geometry(collection=stated.centred()), GRID)


def points_at(work: Work, places: FloatArray) -> Points:
    n = np.full(len(places), work.geometry.collection.n_pulse)
    return Points(x=places[:, 0].copy(), y=places[:, 1].copy(), z=np.zeros(len(places)), first=0 * n, last=n)


def parts_of(work: Work, signal: ComplexArray, points: Points) -> list[ChipPart]:
    nothing = Correction.none(work).displacement
    return [take_chips(signal[pulses], work, points, nothing, pulses) for pulses in work.blocks]


@pytest.fixture(scope="module")
def signal() -> ComplexArray:
    return simulate_pulses(TRUE, PLACES[:, 0], PLACES[:, 1], np.exp(1j * np.arange(6)))


def found(work: Work, signal: ComplexArray, points: Points) -> FloatArray:
    places = find_places(work, points, parts_of(work, signal, points), Correction.none(work))
    return np.stack([places.x, places.y], axis=1)


def test_responses_lie_where_they_are_seen_and_each_once(signal: ComplexArray) -> None:
    """The points are known to a cell or two; two of them are beside the same response."""
    work = work_with(0.0)
    near = np.concatenate([PLACES + np.array([1.2, -0.4]), PLACES[:1] + np.array([-1.0, 0.3])])
    assert found(work, signal, points_at(work, near)) == pytest.approx(PLACES, abs=0.1)


def test_another_track_is_moved_so_that_they_are_seen_there(signal: ComplexArray) -> None:
    line = np.array([0.1, -0.05, 0.02]) + TRUE.time[:, None] * np.array([0.06, 0.2, 0.03])
    other = work_with(line)
    apart = found(other, signal, points_at(other, PLACES)) - PLACES
    assert np.hypot(*apart.T).max() > 1
    tied = tied_to(other, signal, PLACES)
    assert tied.figures["tied"]["points"] >= 5 and tied.figures["tied"]["range_left"] < 0.05
    moved = work_with(tied.antenna_position - TRUE.antenna_position)
    assert found(moved, signal, points_at(moved, PLACES)) == pytest.approx(PLACES, abs=0.1)


def test_places_that_do_not_agree_move_nothing(signal: ComplexArray) -> None:
    work = work_with(0.0)
    off = np.random.default_rng(1).uniform(-4, 4, PLACES.shape)
    for places in (PLACES + off, PLACES[:3]):  # or too few
        tied = tied_to(work, signal, places)
        assert tied.figures["tied"] == {"points": 0}
        assert np.array_equal(tied.antenna_position, TRUE.antenna_position)


def tied_to(work: Work, signal: ComplexArray, at: FloatArray) -> Result:
    places = Places(x=at[:, 0].copy(), y=at[:, 1].copy(), z=np.zeros(len(at)))
    parts = parts_of(work, signal, control_of(places).points(work))
    time, empty = work.sample_times, np.zeros((0, 1, 1))
    nothing = np.zeros((time.size, 3))
    result = Result(
        antenna_position=work.geometry.collection.antenna_position, time=time, track_error=nothing, uncertainty=nothing,
        x=np.zeros(0), y=np.zeros(0), chips_before=empty, chips_after=empty,
        figures={"points": 30, "predicted_error": 0.01},
    )  # fmt: skip
    return tie(work, result, places, parts, Correction.none(work))


def test_points_that_both_see_are_shared() -> None:
    work = work_with(0.0)
    half = Collection(**{**TRUE.segment(0, 300).as_dict()})
    other = begin(Geometry(collection=half.centred()), GRID)
    one = points_at(work, PLACES)
    shared = shared_points(work, other, [one, points_at(other, PLACES[:2] + 1)])
    assert shared.x.tolist() == [*PLACES[:, 0], *(PLACES[:2, 0] + 1)]  # all are lit all the time
    assert (shared.last == TRUE.n_pulse).all()
    assert shared_points(other, work, [one]).last.max() == 300


def test_what_lies_outside_a_range_window_is_not_shared() -> None:
    """A chip would hold other ranges there."""
    work, window = work_with(0.0), TRUE.range_window
    moved = Collection(**{**TRUE.as_dict(), "reference_range": TRUE.reference_range + window / 2})
    other = begin(Geometry(collection=moved.centred()), GRID)
    assert shared_points(work, other, [points_at(work, PLACES)]).x.tolist() == [x for x, _ in PLACES if x > 10]
    places = Places(x=PLACES[:, 0].copy(), y=PLACES[:, 1].copy(), z=np.zeros(len(PLACES)))
    assert places_seen(other, places).x.tolist() == [x for x, _ in PLACES if x > 10]
    assert places_seen(work, places).x.size == len(PLACES)


def test_places_beside_the_terrain_are_left_out(signal: ComplexArray) -> None:
    terrain = Terrain(x0=-46.0, dx=1.0, y0=-49.0, dy=1.0, heights=np.zeros((120, 120)))
    work = begin(over_terrain(TRUE.centred(), terrain), GRID)
    near = points_at(work, PLACES + np.array([1.2, -0.4]))
    inside = (PLACES > -46).all(axis=1)
    assert 0 < inside.sum() < len(PLACES)
    assert found(work, signal, near) == pytest.approx(PLACES[inside], abs=0.1)


@pytest.mark.parametrize(
    ("shared", "refused", "tried", "apart"),
    [
        ({(0, 1): 9, (0, 2): 0, (1, 2): 9}, [], [(0, 1), (1, 2)], []),
        ({(0, 1): 0, (0, 2): 5, (1, 2): 9}, [], [(0, 2), (2, 1)], []),
        ({(0, 1): 0, (0, 2): 0, (1, 2): 9}, [], [(1, 2)], [1]),  # the others agree with each other
        ({(0, 1): 3, (0, 2): 9, (1, 2): 0}, [], [(0, 2)], [1]),  # too few
        ({(0, 1): 9, (0, 2): 5, (1, 2): 6}, [(1, 2)], [(0, 1), (1, 2), (0, 2)], []),
        ({(0, 1): 9, (0, 2): 5, (1, 2): 6}, [(0, 1)], [(0, 1), (0, 2), (2, 1)], []),
        ({(0, 1): 9, (0, 2): 5, (1, 2): 6}, [(0, 1), (0, 2)], [(0, 1), (0, 2), (1, 2)], [1]),
    ],
)
def test_collections_are_tied_in_turn(
    shared: dict[tuple[int, int], int], refused: list[tuple[int, int]], tried: list[tuple[int, int]], apart: list[int]
) -> None:
    calls: list[tuple[int, int]] = []

    def attempt(one: int, other: int) -> bool:
        calls.append((one, other))
        return (one, other) not in refused

    assert tie_in_turn(3, shared, attempt) == apart
    assert calls == tried
