"""All commands of the command line."""

from __future__ import annotations

from typing import Any

import typer

from blocksar.cli import commands


def every_command() -> dict[tuple[str, ...], Any]:
    """The commands of typer by their words; of groups those below them."""
    found: dict[tuple[str, ...], Any] = {}
    for name, command in typer.main.get_command(commands.app).commands.items():  # type: ignore[attr-defined]
        below = getattr(command, "commands", None)
        found |= {(name, sub): entry for sub, entry in below.items()} if below else {(name,): command}
    return found
