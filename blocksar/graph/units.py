"""Units of work: single tasks, and running those that have no valid receipt."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from distributed import Client, Future, KilledWorker

from blocksar.errors import InputError, ProcessingError
from blocksar.graph.admission import Unit, as_completed
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt

GPU = {"GPU": 1}  # dask's resources of a worker that has one


@dataclass
class Spare:
    """Units of a later stage for places on workers that no unit of a stage takes any more.

    Attributes
    ----------
    after : function
        Those that can begin once a unit of the stage is done, given by its name and its receipt.
    receipts : dict of Receipt
        Of those that were done before the stage ended, by name; the others are left to the later stage.
    """

    after: Callable[[str, Receipt], Sequence[Unit]]
    receipts: dict[str, Receipt] = field(default_factory=dict)


def spans(n: int, size: int) -> list[tuple[int, int]]:
    """Divide 0 .. n into spans (first, end) of `size`; the last may be shorter."""
    return [(first, min(first + size, n)) for first in range(0, n, size)]


def single_task(
    client: Client, run: Run, step: str, unit: str, task: Callable[..., Receipt], *arguments: Any, on: str = "cpu"
) -> Unit:
    """Return a unit of work that is a single task, `task(run, unit, *arguments)`; on a GPU it has one for itself."""
    key = f"{step}-{run.token}-{unit}"
    needed = {"resources": GPU} if on == "gpu" else {}
    return unit, partial(client.submit, task, run, unit, *arguments, key=key, pure=False, **needed)


def run_units(
    client: Client,
    stage: str,
    units: Sequence[Unit],
    run: Run,
    listener: Listener,
    *,
    per_worker: int = 1,
    ahead: bool = False,
    reading_input: Iterable[str] = (),
    spare: Spare | None = None,
) -> list[Receipt]:
    """Run the units that have no valid receipt; return the receipts of all units in order.

    Parameters
    ----------
    per_worker : int
        Units in flight for each worker.
    ahead : bool
        One more for each worker of one thread, to follow at once; for units of one task.
    reading_input : iterable of str
        Units that read the input of the run: their InputErrors are raised as such.
    spare : Spare, optional
        Gets the receipts of its units that were run.

    Returns
    -------
    list of Receipt
        `reused` if the unit was not run again; `damaged` if it was, because its data were damaged.

    Raises
    ------
    ProcessingError
        If a unit or the cluster fails for good; finished units stay.
    InputError
        If a unit finds the input wrong.
    """
    readers = frozenset(reading_input)
    earlier = {unit: receipt for unit, _ in units if (receipt := run.receipt(unit)) is not None}
    receipts: dict[str, Receipt] = {}
    damaged = set()
    # Workers check the data: this process never loads samples.
    checks = [(unit, _submit_check(client, run, receipt)) for unit, receipt in earlier.items()]
    if checks:
        listener.begin(f"check-{stage}")
    for number, (unit, future) in enumerate(as_completed(client, stage, checks, 2, listener), 1):
        if _result(future, stage, unit):
            receipts[unit] = replace(earlier[unit], reused=True)
        else:
            damaged.add(unit)
        listener.update(f"check-{stage}", number, len(checks))
    listener.begin(stage, reused=len(receipts))
    listener.update(stage, len(receipts), len(units))
    waiting = deque(unit for unit in units if unit[0] not in receipts)
    own = {unit for unit, _ in waiting}
    for unit, future in as_completed(client, stage, waiting, per_worker, listener, ahead=ahead):
        signed: Receipt = _result(future, stage, unit, reads_input=unit in readers)
        if spare is not None and unit not in own:
            spare.receipts[unit] = signed
            continue
        receipts[unit] = replace(signed, damaged=unit in damaged)
        listener.update(stage, len(receipts), len(units))
        if spare is None:
            continue
        if len(receipts) < len(units):
            waiting.extend(spare.after(unit, signed))
        else:
            waiting.clear()
    return [receipts[unit] for unit, _ in units]


def _submit_check(client: Client, run: Run, receipt: Receipt) -> Callable[[], Future[Any]]:
    key = f"verify-{run.token}-{receipt.unit}"
    return partial(client.submit, run.intact, receipt, key=key, pure=False)


def _result(future: Future[Any], stage: str, unit: str, *, reads_input: bool = False) -> Any:
    """Return the result of a unit, or raise its error with the stage and the unit."""
    if future.status == "finished":
        return future.result()
    error = future.exception()
    # A defect in the run's own stores is not an error in the user's input.
    if isinstance(error, ProcessingError) or (reads_input and isinstance(error, InputError)):
        raise error
    if isinstance(error, KilledWorker):
        raise ProcessingError(
            f"{stage} of {unit} failed: {error.allowed_failures + 1} workers died of it, perhaps for lack of memory; "
            "give them more with --memory-limit"
        )
    raise ProcessingError(f"{stage} of {unit} failed: {type(error).__name__}: {error}") from error
