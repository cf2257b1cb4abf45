"""Estimates of the time left, compared with simulated runs whose end is known."""

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
    """Simulate a run: stage, units done, time and estimated time left, after each unit.

    `cold`: start-up time of each worker before its first unit, s. Units are scheduled as on a cluster.
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
def test_the_estimate_is_exact_at_constant_pace_once_the_workers_are_warm(workers: int, cold: float) -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, workers)
    assert estimate.left() is None
    told = carried_out(estimate, WORK, workers, dict.fromkeys(WORK, 2.5), cold=cold)
    end = told[-1][2]
    assert [left for *_, left in told[:workers]] == [None] * workers
    for _, _, now, left in told[workers:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_the_estimate_adapts_to_a_slower_stage() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 2)
    told = carried_out(estimate, WORK, 2, dict.fromkeys(WORK, 1.0) | {"focus": 3.0})
    end = told[-1][2]
    begun = told[0][2]
    for stage, done, now, left in told:
        if (stage, done) >= ("focus", 2) and stage != "recover":
            assert left is not None
            assert abs(left - (end - now)) < 0.2 * (end - begun), (stage, done)


def test_reused_units_count_neither_as_work_nor_as_time() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 1)
    told = carried_out(estimate, WORK, 1, dict.fromkeys(WORK, 2.0), reused={"recover": 8, "focus": 4})
    end = told[-1][2]
    assert [stage for stage, *_ in told[:2]] == ["focus", "focus"]  # four of its six units are reused
    for _, _, now, left in told:
        assert left == pytest.approx(end - now, abs=1e-6)
    recover, focus = estimate.stages["recover"], estimate.stages["focus"]
    assert (recover.rate(), recover.finished) == (None, True)
    assert focus.rate() == pytest.approx(2 / (2.0 * (2.5 + 3.0)))


def test_a_stage_that_ends_before_the_workers_are_warm_is_not_used_for_the_estimate() -> None:
    """In a small run with one unit of recovery, the unit's time is mostly that of loading the code."""
    work = WORK | {"recover": [0.1]}
    estimate = Estimate(Clock())
    estimate.expect(work, 1)
    told = carried_out(estimate, work, 1, dict.fromkeys(work, 1.0), cold=2.0)
    end = told[-1][2]
    assert told[0][:1] + told[0][3:] == ("recover", None)
    for _, _, now, left in told[1:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_an_overdue_unit_increases_the_time_left() -> None:
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
    clock.now += 9.5  # the third unit is overdue by nine times its length
    left = estimate.left()
    assert left is not None and left > 4.0  # the fourth unit must be expected to take long as well
    clock.now += 10.0
    assert (estimate.left() or 0.0) > left


def test_an_unannounced_stage_is_estimated_from_its_own_units() -> None:
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


def test_the_announced_work_is_divided_among_a_different_number_of_units() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"recover": [1.0] * 4, "mosaic": [1.0, 2.0, 3.0]}, 2)
    for done in (0, 2, 4):
        estimate.update("recover", done, 4)
        clock.now += 2.0 if done < 4 else 0.0
    estimate.update("mosaic", 0, 11)
    assert estimate.left() == pytest.approx(12.0 / 11 * 6)  # two workers, six rounds


def test_little_work_does_not_tell_the_pace_of_much() -> None:
    """A small run: starting its tasks takes all of the time, and then the end was foretold in half a minute."""
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"recover": [0.001] * 4, "focus": [0.01], "finish": [0.8]}, 1)
    for stage, count in (("recover", 4), ("focus", 1)):
        for done in range(count + 1):
            estimate.update(stage, done, count)
            clock.now += 0.1
    left = estimate.left()
    assert left is not None and left < 1.5


def test_cancelled_stages_are_removed() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"focus": [1.0], "draw": [1.0]}, 1)
    estimate.expect({"focus": ()}, 1)
    assert list(estimate.stages) == ["draw"]


def test_stages_are_listed_in_the_order_in_which_they_begin() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"recover": [1.0], "focus": [1.0]}, 1)
    for stage in ("start-workers", "recover", "check-focus"):
        estimate.begin(stage)
    assert list(estimate.stages) == ["start-workers", "recover", "check-focus", "focus"]
