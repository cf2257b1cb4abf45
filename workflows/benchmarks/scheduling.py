"""The scheduler's cost of a task: graphs of the shape of a run's, with tasks that do next to nothing."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from distributed import Client, Future

from blocksar.graph.units import Unit, as_completed
from blocksar.progress import Listener

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
    chains: list[Unit] = [(f"chain-{number}", partial(_submit, client, number)) for number in range(units)]
    for _, _ in as_completed(client, "chains", chains, IN_FLIGHT, Listener()):
        ends.append(time.perf_counter() - started)
    tenth = units // 10
    return {
        "tasks": units * CHAIN,
        "seconds": ends[-1] / units / CHAIN,
        "first_tenth": ends[tenth - 1] / tenth / CHAIN,
        "last_tenth": (ends[-1] - ends[-tenth - 1]) / tenth / CHAIN,
    }


def _submit(client: Client, number: int) -> Future[Any]:
    node = client.submit(str, key=f"task-0-{number}", pure=False, priority=-number)
    for step in range(1, CHAIN):
        node = client.submit(str, node, key=f"task-{step}-{number}", pure=False, priority=-number)
    return node
