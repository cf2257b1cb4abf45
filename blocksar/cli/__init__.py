"""The command line: options, tables and messages; `blocksar.api` does the work."""

from __future__ import annotations

from blocksar.garbage import uncollected

with uncollected():
    from blocksar.cli.commands import app, main

__all__ = ["app", "main"]
