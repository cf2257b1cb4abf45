"""How long it will go on: stages, their units, and time left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from heapq import heapreplace

from blocksar.progress.listening import Work


def finishing_times(costs: Sequence[float], workers: int) -> list[float]:
    """When units are finished that are started in order, each as soon as a worker is free; ascending.

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
class Stage:
    """A stage's units, when they were finished, and when they ought to be.

    Attributes
    ----------
    costs : sequence of float or None
        Predicted seconds of each unit, in the order in which they are started; None: equal, of unknown length.
    reused : int
        Units that an earlier run has finished: the first ones.
    cold : bool
        Workers are new to it: what their first units take besides (imports, compiled code, cold files) tells nothing.
    begun, heard : float or None
        When the stage began, and when a unit was finished last, s.
    """

    name: str
    costs: Sequence[float] | None = None
    workers: int = 1
    cold: bool = False
    reused: int = 0
    done: int = 0
    total: int = 0
    begun: float | None = None
    heard: float | None = None
    _ends: Sequence[float] = ()
    _even: float | None = None  # predicted seconds of each unit, where all are alike
    _warm: tuple[float, float] | None = None  # when the first units were finished, and ought to be

    @property
    def finished(self) -> bool:
        return self.heard is not None and self.done >= self.total

    @property
    def made(self) -> int:
        """Units that were finished here, not by an earlier run."""
        return max(self.done - self.reused, 0)

    def update(self, done: int, total: int, now: float) -> None:
        if self.heard is None or total != self.total:
            self.total = total
            self._predict()
        if self.heard is None or done != self.done:
            self.heard = now
        self.done = done
        if self.cold and self._warm is None and self.workers <= self.made < self.total - self.reused:
            self._warm = now, self.end(self.made)

    def _predict(self) -> None:
        left = self.total - self.reused
        if self.costs is not None and len(self.costs) == self.total:
            self._even, self._ends = None, finishing_times(self.costs[self.reused :], self.workers)
        else:
            self._even = 1.0 if self.costs is None else sum(self.costs) / max(self.total, 1)
            self._ends = range(left)

    def end(self, count: int) -> float:
        """When so many of the units that are made here ought to be finished, seconds from the beginning."""
        if not count:
            return 0.0
        if self._even is None:
            return self._ends[count - 1]
        workers = 1 if self.costs is None else self.workers
        return self._even * math.ceil(count / workers)

    def seconds(self, now: float) -> float:
        """Since it began, until it was finished."""
        if self.begun is None:
            return 0.0
        return (self.heard if self.finished and self.heard is not None else now) - self.begun

    def rate(self) -> float | None:
        """Units finished here per second."""
        if not self.made or self.begun is None or self.heard is None or self.heard <= self.begun:
            return None
        return self.made / (self.heard - self.begun)

    def measured(self) -> tuple[float, float]:
        """Seconds that units took together, and ought to take; 0 and 0 where that is not known yet."""
        if not self.made or self.heard is None or self.begun is None:
            return 0.0, 0.0
        start, ahead = self._since()
        if self.cold and self._warm is None:  # also once it is finished: it was over before workers were warm
            return 0.0, 0.0
        return self.heard - start, max(self.end(self.made) - ahead, 0.0)

    def _since(self) -> tuple[float, float]:
        """From when on units are counted, and when those before ought to be finished."""
        return self._warm or (self.begun or 0.0, 0.0)

    def left(self, now: float, pace: float | None) -> float | None:
        """Seconds that it will go on, and None where nothing tells.

        Parameters
        ----------
        pace : float or None
            Seconds that a predicted second took other stages; counts until this stage has one of its own.
        """
        if self.finished:
            return 0.0
        if self.costs is None and not self.made:
            return None
        seconds, predicted = self.measured()
        pace = seconds / predicted if predicted else pace
        if pace is None:
            return None
        if self.begun is None or self.heard is None:
            return pace * self._whole()
        start, ahead = self._since()
        waited, following = now - start, self.end(self.made + 1) - ahead
        # The next unit is not finished yet: it takes at least as long as it has taken.
        pace = max(pace, waited / following) if following > 0 else pace
        return max(pace * (self.end(self.total - self.reused) - ahead) - waited, 0.0)

    def _whole(self) -> float:
        return finishing_times(self.costs or (), self.workers)[-1]


@dataclass
class Estimate:
    """All stages of a command, and how long they will go on.

    Predicted work tells the stages' shares and how units fill the workers; time comes from finished units alone. As
    long as there is none of a stage that was announced, there is no estimate. What an earlier run finished counts
    neither as work nor as time.
    """

    clock: Callable[[], float] = time.monotonic
    stages: dict[str, Stage] = field(default_factory=dict)
    begun: float = math.nan

    def __post_init__(self) -> None:
        self.begun = self.clock()

    @property
    def elapsed(self) -> float:
        return self.clock() - self.begun

    def expect(self, work: Work, workers: int) -> None:
        first = next(iter(work), None)
        for name, costs in work.items():
            if costs:
                self.stages[name] = Stage(name, costs=tuple(costs), workers=workers, cold=name == first)
            elif name in self.stages and self.stages[name].begun is None:
                del self.stages[name]

    def begin(self, name: str, reused: int = 0) -> Stage:
        known = self.stages.pop(name, None)
        stage = Stage(name, reused=reused, begun=self.clock())
        if known is not None:
            stage.costs, stage.workers, stage.cold = known.costs, known.workers, known.cold
        # In the order in which they begin, ahead of those that are still to come.
        waiting = {other.name: other for other in self.stages.values() if other.begun is None}
        for other in waiting:
            del self.stages[other]
        self.stages |= {name: stage} | waiting
        return stage

    def update(self, name: str, done: int, total: int) -> Stage:
        stage = self.stages.get(name)
        if stage is None or stage.begun is None or (done < stage.done and stage.finished):
            stage = self.begin(name)
        stage.update(done, total, self.clock())
        return stage

    def left(self) -> float | None:
        """Seconds until all stages are finished; None where there is nothing to go on yet."""
        now, pace = self.clock(), self._pace()
        parts = [stage.left(now, pace) for stage in self.stages.values()]
        known = [part for part in parts if part is not None]
        return sum(known) if known and len(known) == len(parts) else None

    @property
    def current(self) -> Stage | None:
        """The stage that is at work, the last of several."""
        return next((s for s in reversed(self.stages.values()) if s.begun is not None and not s.finished), None)

    @property
    def finished(self) -> bool:
        return bool(self.stages) and all(stage.finished for stage in self.stages.values())

    def _pace(self) -> float | None:
        """Seconds that a predicted second has taken so far."""
        parts = [stage.measured() for stage in self.stages.values() if stage.costs is not None]
        seconds, predicted = (sum(part) for part in zip(*parts, strict=True)) if parts else (0.0, 0.0)
        return seconds / predicted if predicted else None
