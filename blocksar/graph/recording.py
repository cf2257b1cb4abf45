"""The cluster's dashboard and its performance report."""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from distributed import Client, LocalCluster, performance_report
from distributed.http.routing import RoutingApplication
from distributed.http.utils import RequestHandler

from blocksar.errors import InputError
from blocksar.progress import Listener

REPORT_TIME = 60.0  # s, time for the scheduler to make a performance report
INTERRUPTED_REPORT_TIME = 5.0  # s, the same after an interruption: the user is waiting for the end


def dashboard(client: Client | None) -> str | None:
    """Return the address of a cluster's dashboard; None without bokeh, where it would show metrics only."""
    with suppress(Exception):  # a broken scheduler is reported by the run itself
        return client.dashboard_link if client is not None and _has_bokeh(client) else None
    return None


class Pages(RequestHandler):  # type: ignore[misc, unused-ignore]  # of a library without types
    """Handler of a dashboard that dask builds on the first request, which is then repeated."""

    def get(self) -> None:
        import distributed.dashboard.scheduler as dashboard_pages

        main = self.server.http_application
        main.applications.remove(self.application)
        dashboard_pages.connect(main, self.server.http_server, self.server)
        self.redirect(self.request.uri)


def serve_dashboard(cluster: LocalCluster) -> None:
    """Add a dashboard to a local cluster, built when it is first opened: bokeh is slow to import."""
    if importlib.util.find_spec("bokeh") is not None:
        scheduler: Any = cluster.scheduler
        pages = RoutingApplication([(r"/.*", Pages, {"dask_server": scheduler})])
        scheduler.http_application.add_application(pages)


def check_recordable(path: Path, client: Client | None) -> None:
    """Check that a cluster can make a performance report and that the file can be written. None: a local cluster.

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
def record_performance(client: Client | None, path: Path | None, listener: Listener) -> Iterator[None]:
    """Write dask's performance report of the work in the block, even if it fails; nothing without `path` or cluster.

    A file at `path` is replaced only by a complete report. A report that cannot be made is a note to the listener.
    """
    if path is None or client is None:
        yield
        return
    temporary = path.with_name(f".{path.name}.part")
    with client.as_current():
        recorder = performance_report(filename=str(temporary), mode="inline")  # opens without a network
        recorder.__enter__()
        try:
            yield
        finally:
            interrupted = sys.exc_info()[0] is not None and not isinstance(sys.exc_info()[1], Exception)
            timeout = INTERRUPTED_REPORT_TIME if interrupted else REPORT_TIME
            try:
                if client.status != "running":
                    raise OSError("the dask scheduler is gone")
                client.sync(recorder.__aexit__, None, None, None, code="blocksar", callback_timeout=timeout)
                os.replace(temporary, path)
            except Exception as error:
                cause = " ".join(str(error).split()) or type(error).__name__
                listener.note(f"no performance report at {path}: {cause}")
            finally:
                temporary.unlink(missing_ok=True)
