"""The command line: options, tables and messages; `blocksar.api` does the work."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from blocksar.errors import UnsupportedSystem
from blocksar.garbage import uncollected

if TYPE_CHECKING:
    from blocksar.cli.commands import app

__all__ = ["app", "main"]
OF_WORKERS = ("focus", "autofocus")  # the commands that may start workers


def main() -> None:
    """Run the command line: the entry point of `blocksar`. What workers import is imported beside what it needs."""
    if sys.argv[1:2] and sys.argv[1] in OF_WORKERS:
        with suppress(UnsupportedSystem):  # the command says so
            from blocksar.graph.starting import start_at_once

            start_at_once(sys.argv[2:])
    with uncollected():
        from blocksar.cli import commands
    commands.main()


def __getattr__(name: str) -> Any:
    if name == "app":
        from blocksar.cli.commands import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
