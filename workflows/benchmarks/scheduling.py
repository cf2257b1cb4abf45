"""The scheduler's cost of a task: graphs of the shape of a run's, with tasks that do next to nothing."""

from __future__ import annotations

import time

from distributed import Client

from blocksar.graph.units import OnCluster, Unit
from blocksar.places import place
from blocksar.progress import Listener
from blocksar.runs.receipts import Run

CHAIN = 5  # tasks of a block: three stages with the slab's reading, the geometric correction, and one of the mosaic
IN_FLIGHT = 50  # units for each worker: with two workers, as many as 100 workers have


def seconds_a_task(client: Client, n_task: int) -> dict[str, float]:
    """Seconds from the first submission to the last result over the number of tasks, by a run's own admission.

    Each unit is a chain of CHAIN tasks, as a block is. The client sees a bounded number of them at a time, so the cost
    does not grow with their number: the first and the last tenth are reported too.
    """
    units = max(n_task // CHAIN, 10)
    ends = []
    started = time.perf_counter()
    chains = [_chain(number) for number in range(units)]
    for _ in OnCluster(client, Listener()).execute("chains", chains, per_worker=IN_FLIGHT):
        ends.append(time.perf_counter() - started)
    tenth = units // 10
    return {
        "tasks": units * CHAIN,
        "seconds": ends[-1] / units / CHAIN,
        "first_tenth": ends[tenth - 1] / tenth / CHAIN,
        "last_tenth": (ends[-1] - ends[-tenth - 1]) / tenth / CHAIN,
    }


def _chain(number: int) -> Unit:
    run, after = Run(folder=place("."), identity="", threads=1), tuple[Unit, ...]()
    for step in range(CHAIN):
        after = (Unit(f"task-{step}", run, f"chain-{number}", _pass_on, after=after, priority=-number),)
    return after[0]


def _pass_on(_: Run, name: str, *__: str) -> str:
    return name
