"""The display and the log of a command that runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from blocksar.cli.endings import ending
from blocksar.progress import Progress
from blocksar.version import __version__


@contextmanager
def listening(context: typer.Context) -> Iterator[Progress]:
    """Show the progress of a command; log its settings and how it ends."""
    settings = dict(context.params)
    if isinstance(source := settings.get("source"), list | tuple) and len(source) == 1:
        settings["source"] = source[0]  # programs that read the log know it as a text
    with Progress(quiet=settings["quiet"], log=settings["json_log"]) as progress:
        progress.start(" ".join(context.command_path.split()[1:]), settings, __version__)
        try:
            yield progress
        except BaseException as error:
            progress.end(*ending(error))
            raise
        progress.end(0)
