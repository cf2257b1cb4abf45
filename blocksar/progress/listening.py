"""Listeners: the interface by which the code that does the work reports progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

Callback = Callable[[int, int], None]  # called with the number of finished parts and of all parts
Work = Mapping[str, Sequence[float]]  # predicted seconds of each unit, by stage


class Workers(NamedTuple):
    """The state of the workers, as the scheduler knows it."""

    number: int
    memory: int  # bytes in use by the fullest worker
    limit: int  # bytes, that worker's limit; 0: none


NOBODY = Workers(0, 0, 0)


class Updated(Protocol):
    """Minimal listener of a user: the method `update`."""

    def update(self, stage: str, done: int, total: int) -> None: ...


class Listener:
    """Receives the progress of a command. Subclasses override the methods they need; one thread calls at a time."""

    def expect(self, work: Work, workers: int) -> None:
        """Announce stages in order, with the predicted seconds that each unit takes one of `workers` workers.

        Only the ratios of predicted seconds matter. A stage without units is withdrawn.
        """

    def begin(self, stage: str, reused: int = 0) -> None:
        """Begin a stage, of which an earlier run has finished `reused` units."""

    def update(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` units of a stage are finished."""

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        """Report the names of the units being processed, and the state of the workers."""

    def dashboard(self, address: str) -> None:
        """Report the address of the cluster's dashboard."""

    def note(self, text: str, *, again: bool = False) -> None:
        """Report a sentence for the user; `again`: the command's result will repeat it."""


class UpdateListener(Listener):
    """Passes updates on to an object that has no other method of a listener."""

    def __init__(self, listener: Updated) -> None:
        self.update = listener.update  # type: ignore[method-assign]
