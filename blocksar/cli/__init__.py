"""The command line: words, numbers and messages for people; everything else is `blocksar.api`."""

from __future__ import annotations

from blocksar.cli.commands import app, main

__all__ = ["app", "main"]
