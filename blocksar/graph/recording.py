"""The cluster's dashboard and its performance report."""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from distributed import Client, performance_report

from blocksar.errors import InputError
from blocksar.graph.cluster import GRACE, REPORT
from blocksar.progress import Listener

# ---------------------------------------------------------------- what can be seen of it


def dashboard(client: Client) -> str | None:
    """Where a cluster's dashboard can be seen, if it has one that shows more than metrics."""
    with suppress(Exception):  # whatever is wrong with a scheduler, others say it better
        return client.dashboard_link if _has_bokeh(client) else None
    return None


def check_recordable(path: Path, client: Client | None) -> None:
    """Whether a performance report can be made of a cluster (None: of our own) and written there.

    Raises
    ------
    InputError
        If not.
    """
    if importlib.util.find_spec("bokeh") is None:
        raise InputError("bokeh is not installed, which --performance-report needs; install blocksar[dashboard]")
    try:
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder")
        tempfile.TemporaryFile(dir=path.parent).close()
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise InputError(f"--performance-report {str(path)!r} cannot be written ({why}); give another file") from None
    if client is not None and not _has_bokeh(client):
        raise InputError("the dask scheduler has no bokeh, which --performance-report needs; install it there")


def _has_bokeh(client: Client) -> bool:
    return bool(client.run_on_scheduler(lambda: importlib.util.find_spec("bokeh") is not None))


@contextmanager
def recorded(client: Client, path: Path | None, report: Listener) -> Iterator[None]:
    """Write dask's performance report of all that is done in the block, however the block ends.

    What stood at `path` is replaced once the report is whole; if there is none to be had, `report` is told why.
    """
    if path is None:
        yield
        return
    made = path.with_name(f".{path.name}.part")
    with client.as_current():
        recorder = performance_report(filename=str(made), mode="inline")  # opens without a network
        recorder.__enter__()
        try:
            yield
        finally:
            # Who interrupts a run does not wait for long.
            patience = REPORT if sys.exc_info()[0] is None or isinstance(sys.exc_info()[1], Exception) else GRACE
            try:
                if client.status != "running":
                    raise OSError("the dask scheduler is gone")
                client.sync(recorder.__aexit__, None, None, None, code="blocksar", callback_timeout=patience)
                os.replace(made, path)
            except Exception as error:
                report.note(f"no performance report at {path}: {' '.join(str(error).split()) or type(error).__name__}")
            finally:
                made.unlink(missing_ok=True)
