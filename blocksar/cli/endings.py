"""How a command ends: one sentence, an exit status, and signals in good order."""

from __future__ import annotations

import errno
import os
import signal
import threading
from types import FrameType
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

from blocksar.cli.parsing import quoted
from blocksar.errors import InputError, ProcessingError
from blocksar.progress import abandon

UsageError: Any = typer.BadParameter.__base__  # typer gives the class of a wrong command line no public name
FAILED, WRONG_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
GRACE = 10.0  # seconds that an interrupted command has to end in good order


class Terminated(SystemExit):
    """SIGTERM came. Raised in the main thread, so that clusters and half-made stores are cleaned up."""


def complain(message: str, status: int) -> NoReturn:
    """End the command with one message on stderr."""
    typer.echo(f"blocksar: {message}", err=True)
    raise typer.Exit(status)


class Commands(TyperGroup):
    """The group of commands, and the one place where an error becomes a message and an exit status."""

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        try:
            return super().make_context(*arguments, **settings)
        except UsageError as error:
            _complain_of_usage(error)

    def invoke(self, ctx: Any) -> Any:  # typer gives the class of this context no public name
        try:
            return super().invoke(ctx)
        except UsageError as error:
            _complain_of_usage(error)
        except (InputError, ProcessingError, KeyboardInterrupt, Terminated) as error:
            _complain_of(error)
        except OSError as error:
            # A reader that has seen enough (`blocksar plan ... | head`) is nobody's error: typer ends quietly.
            if error.errno == errno.EPIPE:
                raise
            _complain_of(error)


def _complain_of(error: BaseException) -> NoReturn:
    status, message = ending(error)
    complain(message, status)


def _complain_of_usage(error: Any) -> NoReturn:
    """A wrong command line, in one sentence like any other input."""
    message = error.format_message().removesuffix(".").replace("Value error, ", "")
    if not message:  # a group of commands alone, without one of them: typer has printed its help
        raise typer.Exit(WRONG_INPUT)
    for problem in getattr(error.__cause__, "errors", list)():  # pydantic's, whose text does not say the value
        typed = quoted(str(problem["input"]))
        message = message if typed in message else f"{message}, not {typed}"
    command = "blocksar" if error.ctx is None else error.ctx.command_path
    ending = " See" if message.endswith("?") else "; see"
    complain(f"{message[0].lower()}{message[1:]}{ending} {command} --help", WRONG_INPUT)


def ending(error: BaseException) -> tuple[int, str]:
    """The exit status of a command that ends with this, and what a person is told."""
    match error:
        case InputError():
            return WRONG_INPUT, str(error)
        case ProcessingError() | OSError():
            return FAILED, str(error)
        case KeyboardInterrupt():
            return INTERRUPTED, _stopped(INTERRUPTED)
        case Terminated():
            return TERMINATED, _stopped(TERMINATED)
        case _:  # ours: a traceback follows
            return FAILED, f"{type(error).__name__}: {error}"


def catch_signals() -> None:
    """Let Ctrl-C raise KeyboardInterrupt and SIGTERM raise Terminated, and see to it that the process then ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # A shell starts what runs in the background with Ctrl-C ignored: so it stays.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    """End in good order; at once if asked again, or if that order takes longer than GRACE."""
    status = INTERRUPTED if number == signal.SIGINT else TERMINATED
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: _stop_at_once(status))
    late = threading.Timer(GRACE, _stop_at_once, (status,))
    late.daemon = True
    late.start()
    raise KeyboardInterrupt if status == INTERRUPTED else Terminated(TERMINATED)


def _stop_at_once(status: int) -> None:
    """Workers end with the process that started them; what is half-written has a name that nobody takes for whole."""
    abandon(status, _stopped(status))
    os.write(2, f"blocksar: {_stopped(status)}\n".encode())
    os._exit(status)


def _stopped(status: int) -> str:
    how = "interrupted" if status == INTERRUPTED else "terminated"
    return f"{how}; what was finished stays: give the same command again to go on"
