"""view: a page on this machine that pans and zooms a run."""

from __future__ import annotations

import webbrowser
from typing import Any

from blocksar.application.reports import Report
from blocksar.application.target_files import targets_of
from blocksar.errors import InputError, quoted
from blocksar.places import Location, place
from blocksar.products.viewer import Viewer, ViewerTiles
from blocksar.runs.finished import FinishedRun, folder_of, member_line

PORTS = (1024, 65535)


def view(run: Location, *, channel: str | None = None, port: int | None = None, browser: bool = True) -> Report:
    """Show a finished run of any size in a page that pans and zooms, served by this process to this machine only.

    The page reads the run's pyramid, if it has one, and else the pixels of what it shows. It has block borders, targets
    and the value under the pointer.

    Parameters
    ----------
    run : path
        Folder of a finished run.
    channel : str, optional
        Of a run of several channels or looks. Default: the first.
    port : int, optional
        Where to listen on 127.0.0.1. Default: one that is free.
    browser : bool
        Open the page in the browser. Default: True.

    Returns
    -------
    Report
        `result` is the server: its `url`, `wait()` and `close()`. It serves until it is closed, or the process ends.

    Raises
    ------
    InputError
        If the run is not finished, has no such channel, or the port cannot be used.
    """
    number: Any = port
    if port is not None and (
        isinstance(number, bool) or not isinstance(number, int) or not PORTS[0] <= number <= PORTS[1]
    ):
        raise InputError(f"port is {quoted(port)}; give a whole number from {PORTS[0]} to {PORTS[1]}, or leave it out")
    folder = place(run)
    source = FinishedRun.open(folder_of(folder, channel))
    viewer = Viewer(ViewerTiles(source), targets_of(None, source.attrs), port or 0)
    if browser:
        webbrowser.open(viewer.url)
    lines = [
        *member_line(folder, channel),
        f"{folder} is shown at {viewer.url} until Ctrl-C, or in Python until `result.close()`",
    ]
    return Report(summary=lines, result=viewer)
