"""The command line: options, tables and messages; `blocksar.api` does the work."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from blocksar.garbage import uncollected

if TYPE_CHECKING:
    from blocksar.cli.commands import app

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback of imports; `catch_signals` is next
    _check_environment()
    with uncollected():
        from blocksar.cli import commands
    commands.main()


def _check_environment() -> None:
    """End with a sentence where numba would refuse to be imported."""
    threads = os.environ.get("NUMBA_NUM_THREADS", "")
    with suppress(ValueError):  # numba takes no notice of other texts
        if int(threads) < 1:
            print(
                f"blocksar: NUMBA_NUM_THREADS = {threads} in the environment must be at least 1; unset it, or give the "
                "number of cores",
                file=sys.stderr,
            )
            raise SystemExit(2)


def __getattr__(name: str) -> Any:
    if name == "app":
        from blocksar.cli.commands import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
