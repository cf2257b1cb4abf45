"""What is told, and who listens."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

Callback = Callable[[int, int], None]  # called with the parts done and the parts in all
Work = Mapping[str, Sequence[float]]  # of stages to come: predicted seconds of each unit


class Workers(NamedTuple):
    """What a scheduler knows of its workers."""

    number: int
    memory: int  # bytes, of the one that holds most now
    limit: int  # bytes, of that one; 0: none


NOBODY = Workers(0, 0, 0)


class Updated(Protocol):
    """The least that can be told how far a command has come."""

    def update(self, stage: str, done: int, total: int) -> None: ...


class Listener:
    """Told how far a command has come: a subclass overrides what it wants to hear. From one thread at a time."""

    def expect(self, work: Work, workers: int) -> None:
        """What stages are to come, in order, and the seconds that their units take one of so many workers.

        Only the ratios between predicted seconds matter. A stage without units will not come after all.
        """

    def begin(self, stage: str, reused: int = 0) -> None:
        """A stage begins; so many of its units were taken up from an earlier run."""

    def update(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` units of a stage are finished."""

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        """The units at work now, and those who work."""

    def dashboard(self, address: str) -> None:
        """Where a dashboard of the cluster can be seen."""

    def note(self, text: str, *, again: bool = False) -> None:
        """What a person should know, in a sentence; `again`: it is said once more with the result."""


class _UpdatedOnly(Listener):
    def __init__(self, progress: Updated) -> None:
        self.update = progress.update  # type: ignore[method-assign]


def listener(progress: Updated | None) -> Listener:
    """Whatever was given as `progress`, as a listener."""
    if progress is None:
        return Listener()
    return progress if isinstance(progress, Listener) else _UpdatedOnly(progress)
