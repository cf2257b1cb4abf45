"""Estimate of the time left, from stages and their units."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from heapq import heapreplace

from blocksar.progress.listening import Work


def clock_time(seconds: float) -> str:
    """Format a time as m:ss or h:mm:ss.

    Examples
    --------
    >>> clock_time(7.9), clock_time(3725)
    ('0:07', '1:02:05')
    """
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def rate_text(rate: float | None) -> str:
    """Format a rate, in units per second, minute or hour: the shortest in which a unit is finished.

    Examples
    --------
    >>> rate_text(2.51), rate_text(0.2), rate_text(0.001)
    ('2.5/s', '12/min', '3.6/h')
    """
    if rate is None:
        return ""
    seconds, unit = next(((s, unit) for s, unit in ((1, "s"), (60, "min")) if rate * s >= 1), (3600, "h"))
    return f"{rate * seconds:.2g}/{unit}" if rate * seconds < 10 else f"{rate * seconds:.0f}/{unit}"


LEAST_WORK = 0.5  # s predicted, from which units tell the pace of other stages


def finishing_times(costs: Sequence[float], workers: int) -> list[float]:
    """Return when units finish, ascending, if they start in order, each as soon as a worker is free.

    Examples
    --------
    >>> finishing_times([2, 3, 2], 2)
    [2.0, 3.0, 4.0]
    """
    free = [0.0] * max(min(workers, len(costs)), 1)
    ends = []
    for cost in costs:
        end = free[0] + cost
        heapreplace(free, end)
        ends.append(end)
    return sorted(ends)


@dataclass
class TimedStage:
    """A stage: its units, when they were finished, and when they were predicted to be.

    Attributes
    ----------
    costs : sequence of float or None
        Predicted seconds of each unit, in starting order; None: equal units of unknown duration.
    reused : int
        Number of units, the first ones, that an earlier run has finished.
    cold : bool
        The workers are new: their first units are ignored, as these include imports, compilation and cold files.
    begun, last_finished : float or None
        When the stage began, and when a unit was last finished, s.
    """

    name: str
    costs: Sequence[float] | None = None
    workers: int = 1
    cold: bool = False
    reused: int = 0
    done: int = 0
    total: int = 0
    begun: float | None = None
    last_finished: float | None = None
    _ends: Sequence[float] = ()
    _even: float | None = None  # predicted seconds of each unit, if all are equal
    _warm: tuple[float, float] | None = None  # when the first units were finished, and their predicted time

    @property
    def finished(self) -> bool:
        return self.last_finished is not None and self.done >= self.total

    @property
    def finished_here(self) -> int:
        """Number of units that this run, not an earlier one, has finished."""
        return max(self.done - self.reused, 0)

    def update(self, done: int, total: int, now: float) -> None:
        """Record that `done` of `total` units are finished."""
        if self.last_finished is None or total != self.total:
            self.total = total
            self._predict()
        if self.last_finished is None or done != self.done:
            self.last_finished = now
        self.done = done
        if self.cold and self._warm is None and self.workers <= self.finished_here < self.total - self.reused:
            self._warm = now, self.predicted_end(self.finished_here)

    def _predict(self) -> None:
        """Predict when each of the units that are left will be finished."""
        left = self.total - self.reused
        if self.costs is not None and len(self.costs) == self.total:
            self._even, self._ends = None, finishing_times(self.costs[self.reused :], self.workers)
        else:
            self._even = 1.0 if self.costs is None else sum(self.costs) / max(self.total, 1)
            self._ends = range(left)

    def predicted_end(self, count: int) -> float:
        """Return when `count` units of this run are predicted to be finished, in seconds from the beginning."""
        if not count:
            return 0.0
        if self._even is None:
            return self._ends[count - 1]
        workers = 1 if self.costs is None else self.workers
        return self._even * math.ceil(count / workers)

    def seconds(self, now: float) -> float:
        """Return the seconds since the stage began, or that it took."""
        if self.begun is None:
            return 0.0
        end = self.last_finished if self.finished and self.last_finished is not None else now
        return end - self.begun

    def rate(self) -> float | None:
        """Return the units per second of this run; None if that is not known yet."""
        if (
            not self.finished_here
            or self.begun is None
            or self.last_finished is None
            or self.last_finished <= self.begun
        ):
            return None
        return self.finished_here / (self.last_finished - self.begun)

    def measured(self) -> tuple[float, float]:
        """Return the seconds that units took together, and their prediction; 0 and 0 if that is not known yet."""
        if not self.finished_here or self.last_finished is None or self.begun is None:
            return 0.0, 0.0
        start, predicted_before = self._baseline()
        if self.cold and self._warm is None:  # also when finished: it ended before the workers were warm
            return 0.0, 0.0
        return self.last_finished - start, max(self.predicted_end(self.finished_here) - predicted_before, 0.0)

    def _baseline(self) -> tuple[float, float]:
        """Return the time from which units are counted, and the predicted time of the units before it."""
        return self._warm or (self.begun or 0.0, 0.0)

    def left(self, now: float, pace: float | None) -> float | None:
        """Return the estimated seconds left; None if there is no basis for an estimate.

        Parameters
        ----------
        pace : float or None
            Actual seconds per predicted second in other stages; used until this stage has its own.
        """
        if self.finished:
            return 0.0
        if self.costs is None and not self.finished_here:
            return None
        seconds, predicted = self.measured()
        pace = seconds / predicted if predicted else pace
        if pace is None:
            return None
        if self.begun is None or self.last_finished is None:
            return pace * self._predicted_total()
        start, predicted_before = self._baseline()
        elapsed, following = now - start, self.predicted_end(self.finished_here + 1) - predicted_before
        # The next unit is not finished yet, so it takes at least as long as has elapsed.
        pace = max(pace, elapsed / following) if following > 0 else pace
        return max(pace * (self.predicted_end(self.total - self.reused) - predicted_before) - elapsed, 0.0)

    def _predicted_total(self) -> float:
        return finishing_times(self.costs or (), self.workers)[-1]


@dataclass
class Estimate:
    """All stages of a command, and the time left.

    Predictions give the stages' relative work and how units fill the workers; the time scale comes from finished units
    alone. There is no estimate before the first unit of an announced stage is finished. Units that an earlier run
    finished count neither as work nor as time.
    """

    clock: Callable[[], float] = time.monotonic
    stages: dict[str, TimedStage] = field(default_factory=dict)
    begun: float = math.nan

    def __post_init__(self) -> None:
        self.begun = self.clock()

    @property
    def elapsed(self) -> float:
        return self.clock() - self.begun

    def expect(self, work: Work, workers: int) -> None:
        """Announce stages; see `Listener.expect`."""
        first = next(iter(work), None)
        for name, costs in work.items():
            if costs:
                self.stages[name] = TimedStage(name, costs=tuple(costs), workers=workers, cold=name == first)
            elif name in self.stages and self.stages[name].begun is None:
                del self.stages[name]

    def begin(self, name: str, reused: int = 0) -> TimedStage:
        """Begin a stage, announced or not."""
        announced = self.stages.pop(name, None)
        stage = TimedStage(name, reused=reused, begun=self.clock())
        if announced is not None:
            stage.costs, stage.workers, stage.cold = announced.costs, announced.workers, announced.cold
        # Stages are kept in the order in which they begin, before those that have not begun.
        waiting = {other.name: other for other in self.stages.values() if other.begun is None}
        for other in waiting:
            del self.stages[other]
        self.stages |= {name: stage} | waiting
        return stage

    def update(self, name: str, done: int, total: int) -> TimedStage:
        """Record finished units; this begins the stage if needed."""
        stage = self.stages.get(name)
        if stage is None or stage.begun is None or (done < stage.done and stage.finished):
            stage = self.begin(name)
        stage.update(done, total, self.clock())
        return stage

    def left(self) -> float | None:
        """Return the estimated seconds until all stages are finished; None if there is no basis for an estimate yet."""
        now, pace = self.clock(), self._pace()
        parts = [stage.left(now, pace) for stage in self.stages.values()]
        known = [part for part in parts if part is not None]
        return sum(known) if known and len(known) == len(parts) else None

    @property
    def current(self) -> TimedStage | None:
        """The stage in progress; the last if there are several."""
        return next((s for s in reversed(self.stages.values()) if s.begun is not None and not s.finished), None)

    @property
    def finished(self) -> bool:
        return bool(self.stages) and all(stage.finished for stage in self.stages.values())

    def _pace(self) -> float | None:
        """Return the actual seconds per predicted second so far.

        Little work takes mostly what is not predicted, such as the start of its tasks: what it lacks of LEAST_WORK is
        taken at the predicted pace.
        """
        parts = [stage.measured() for stage in self.stages.values() if stage.costs is not None]
        seconds, predicted = (sum(part) for part in zip(*parts, strict=True)) if parts else (0.0, 0.0)
        unknown = max(LEAST_WORK - predicted, 0.0)
        return (seconds + unknown) / (predicted + unknown) if predicted else None
