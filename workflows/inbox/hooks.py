"""The command that is called for every result."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from typing import Self

from blocksar.errors import InputError
from inbox.records import Event

HOOK_SECONDS = 60.0  # after which a hook is killed


@dataclass(frozen=True)
class Hook:
    """A command that receives events; an empty one receives none."""

    command: list[str]

    @classmethod
    def parse(cls, text: str | None) -> Self:
        """Split a command line as a shell would.

        Raises
        ------
        InputError
            If it cannot be split, or the command does not exist.
        """
        if text is None:
            return cls([])
        try:
            command = shlex.split(text)
        except ValueError as error:
            raise InputError(f"--notify {text!r} is not a valid command line ({error}); check its quotes") from None
        if not command or shutil.which(command[0]) is None:
            raise InputError(f"--notify {text!r} names no executable command; give its path")
        return cls(command)

    def send(self, event: Event) -> str | None:
        """Run the command with the event as JSON on its standard input; the error, or None."""
        if not self.command:
            return None
        try:
            process = subprocess.run(self.command, input=json.dumps(event).encode(), timeout=HOOK_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"the hook failed: {error}"
        return f"the hook exited with status {process.returncode}" if process.returncode else None
