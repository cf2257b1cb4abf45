"""The workers of a call: of a running cluster, of a local one, or the calling process."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from blocksar.errors import InputError, quoted
from blocksar.graph.machine import why_no_workers

if TYPE_CHECKING:
    from distributed import Client


class Workforce(NamedTuple):
    """A running cluster by client or address, or the number of workers of a local one; and notes on the choice."""

    client: Client | None
    scheduler: str | None
    workers: int | None
    notes: list[str]


def choose_workforce(
    *, client: Client | None, scheduler: Any, workers: int | None, wait_workers: Any, device: str = "cpu"
) -> Workforce:
    """Choose who does the work.

    It is what is asked for; by default dask's active client, workers of a local cluster, or, where none can start, the
    calling process. A client may be given as `scheduler`, too.

    Raises
    ------
    InputError
        If two running clusters are asked for, or one and none at all; or if the time to wait is none.
    """
    if "distributed" in sys.modules:  # whoever has a client has loaded it
        from distributed import Client

        if client is None and isinstance(scheduler, Client):
            client, scheduler = scheduler, None
    _check(client=client, scheduler=scheduler, workers=workers, wait_workers=wait_workers)
    if client is not None or scheduler is not None or workers is not None:
        return Workforce(client, scheduler, workers, [])
    client, notes = active_client(device)
    if client is None and (reason := why_no_workers()) is not None:
        return Workforce(
            None, None, 0, [*notes, f"note: this process does the work: no workers can start, since {reason}"]
        )
    return Workforce(client, None, None, notes)


def active_client(device: str) -> tuple[Client | None, list[str]]:
    """Return dask's active client if it can do the work, and a note on it. Loads dask only where there is one."""
    if "distributed" not in sys.modules:
        return None, []
    from blocksar.graph import cluster

    if device == "auto":
        from blocksar.kernels.device import has_gpu  # with the loops, which take long to load

        device = "gpu" if has_gpu() else "cpu"
    return cluster.active_client(gpu=device == "gpu")


def size_of(client: Client, workers: int | None, memory_limit: int | None) -> tuple[int | None, int | None]:
    """Return the number of workers of a client and the least of their memory limits, bytes; if none, as given."""
    from blocksar.graph import cluster, units

    if not units.workers_of(client):
        return workers, memory_limit
    return cluster.cluster_size(client, workers=workers, memory_limit=memory_limit)


def _check(*, client: object, scheduler: str | None, workers: int | None, wait_workers: Any) -> None:
    """Check that at most one cluster is given, and that the time to wait for workers fits it.

    Raises
    ------
    InputError
        If two running ones are, or one and none at all; or if the time to wait is none.
    """
    if isinstance(wait_workers, bool) or not isinstance(wait_workers, int | float | np.number) or not wait_workers >= 0:
        raise InputError(f"--wait-workers {quoted(wait_workers)} is no time; give seconds, or 0 to wait for no worker")
    if client is not None and scheduler is not None:
        raise InputError(f"--scheduler {quoted(scheduler)} is given together with a client; leave one out")
    if workers == 0 and (client is not None or scheduler is not None):
        cluster = "a client" if client is not None else "--scheduler"
        raise InputError(f"--workers 0 is given together with {cluster}, whose workers do the work; leave one out")
