"""Estimates of the time left, against runs whose end is known."""

from __future__ import annotations

from heapq import heappop, heappush

import pytest
from fake_clock import WORK, Clock

from blocksar.progress import Estimate, Work


def carried_out(
    estimate: Estimate,
    work: Work,
    workers: int,
    pace: dict[str, float],
    *,
    cold: float = 0.0,
    reused: dict[str, int] | None = None,
) -> list[tuple[str, int, float, float | None]]:
    """Simulate a run to its end: stage, units done, time and time left told, whenever a unit is finished.

    `cold`: seconds that every worker needs before its first unit. The run takes its units as a cluster does.
    """
    clock = estimate.clock
    assert isinstance(clock, Clock)
    told = []
    ready = [cold] * workers
    for stage, costs in work.items():
        done = (reused or {}).get(stage, 0)
        estimate.begin(stage, done)
        estimate.update(stage, done, len(costs))
        ends: list[float] = []
        free = sorted(clock.now + delay for delay in ready)
        ready = [0.0] * workers
        for cost in costs[done:]:
            end = heappop(free) + pace[stage] * cost
            heappush(free, end)
            ends.append(end)
        for end in sorted(ends):
            clock.now = end
            done += 1
            estimate.update(stage, done, len(costs))
            told.append((stage, done, clock.now, estimate.left()))
    return told


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("cold", [0.0, 7.0])
def test_a_run_at_one_pace_is_known_to_its_end_once_the_workers_are_warm(workers: int, cold: float) -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, workers)
    assert estimate.left() is None
    told = carried_out(estimate, WORK, workers, dict.fromkeys(WORK, 2.5), cold=cold)
    end = told[-1][2]
    assert [left for *_, left in told[:workers]] == [None] * workers
    for _, _, now, left in told[workers:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_a_stage_that_is_slower_than_the_others_is_followed() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 2)
    told = carried_out(estimate, WORK, 2, dict.fromkeys(WORK, 1.0) | {"focus": 3.0})
    end = told[-1][2]
    begun = told[0][2]
    for stage, done, now, left in told:
        if (stage, done) >= ("focus", 2) and stage != "recover":
            assert left is not None
            assert abs(left - (end - now)) < 0.2 * (end - begun), (stage, done)


def test_what_an_earlier_run_finished_is_neither_work_nor_time() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 1)
    told = carried_out(estimate, WORK, 1, dict.fromkeys(WORK, 2.0), reused={"recover": 8, "focus": 4})
    end = told[-1][2]
    assert [stage for stage, *_ in told[:2]] == ["focus", "focus"]  # of six, four were there
    for _, _, now, left in told:
        assert left == pytest.approx(end - now, abs=1e-6)
    recover, focus = estimate.stages["recover"], estimate.stages["focus"]
    assert (recover.rate(), recover.finished) == (None, True)
    assert focus.rate() == pytest.approx(2 / (2.0 * (2.5 + 3.0)))


def test_a_first_stage_that_ends_before_workers_are_warm_is_no_measure() -> None:
    """One unit of recovery, in a small run: its time is that of loading the code."""
    work = WORK | {"recover": [0.1]}
    estimate = Estimate(Clock())
    estimate.expect(work, 1)
    told = carried_out(estimate, work, 1, dict.fromkeys(work, 1.0), cold=2.0)
    end = told[-1][2]
    assert told[0][:1] + told[0][3:] == ("recover", None)
    for _, _, now, left in told[1:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_a_unit_that_is_overdue_makes_time_left_grow() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"focus": [1.0] * 4}, 1)
    estimate.begin("focus")
    estimate.update("focus", 0, 4)
    for done in (1, 2):
        clock.now += 1.0
        estimate.update("focus", done, 4)
    assert estimate.left() == pytest.approx(2.0)
    clock.now += 0.5
    assert estimate.left() == pytest.approx(1.5)
    clock.now += 9.5  # of the third unit, which is late by nine times its length
    left = estimate.left()
    assert left is not None and left > 4.0  # the fourth will take long as well, by all that is known
    clock.now += 10.0
    assert (estimate.left() or 0.0) > left


def test_a_stage_that_nobody_announced_counts_by_itself() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.begin("export")
    assert estimate.left() is None
    clock.now += 6.0
    estimate.update("export", 3, 10)
    assert estimate.left() == pytest.approx(14.0)
    assert estimate.stages["export"].rate() == pytest.approx(0.5)
    estimate.update("export", 10, 10)
    assert estimate.left() == 0.0


def test_other_units_than_announced_share_the_work() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"recover": [1.0] * 4, "mosaic": [1.0, 2.0, 3.0]}, 2)
    for done in (0, 2, 4):
        estimate.update("recover", done, 4)
        clock.now += 2.0 if done < 4 else 0.0
    estimate.update("mosaic", 0, 11)
    assert estimate.left() == pytest.approx(12.0 / 11 * 6)  # by two workers, in six rounds


def test_stages_that_do_not_come_after_all_are_forgotten() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"focus": [1.0], "draw": [1.0]}, 1)
    estimate.expect({"focus": ()}, 1)
    assert list(estimate.stages) == ["draw"]


def test_stages_stand_in_the_order_of_their_beginning() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"recover": [1.0], "focus": [1.0]}, 1)
    for stage in ("start-workers", "recover", "check-focus"):
        estimate.begin(stage)
    assert list(estimate.stages) == ["start-workers", "recover", "check-focus", "focus"]
