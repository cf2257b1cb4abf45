"""The end of a command: exit status, message, and reaction to signals."""

from __future__ import annotations

import errno
import io
import os
import re
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import Any, NoReturn

import typer
from typer.core import TyperGroup

from blocksar.errors import FolderError, InputError, ProcessingError, UnsupportedSystem, quoted
from blocksar.progress import abandon

UsageError: Any = typer.BadParameter.__base__  # typer has no public name for the error of a wrong command line
FAILED, WRONG_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
FILE = "blocksar.options_of_file"  # in a context's `meta`: the path of a file of options, and the command's context
GRACE = 10.0  # s, time for an interrupted command to clean up
PANELS = {  # of the help, with the options of all commands that stand in them; the others stand first
    "Ground": ("terrain", "surface", "vertical", "ground_height", "whole_pulses"),
    "Corrections": ("interference", "autofocus", "control"),
    "Machine": ("workers", "threads", "memory_limit", "scheduler", "wait_workers", "performance_report"),
    "Run": ("overwrite", "discard", "pyramid", "dry_run", "config", "print_config"),
    "Messages": ("everything", "explain", "quiet", "json_log", "version", "help"),
}
_PANEL_OF = {option: panel for panel, options in PANELS.items() for option in options}


class Terminated(SystemExit):
    """SIGTERM was received. Raised in the main thread, so that clusters and unfinished stores are cleaned up."""


def complain(message: str, status: int) -> NoReturn:
    """Print a message on stderr and end the command with an exit status."""
    say(f"blocksar: {message}")
    raise typer.Exit(status)


def say(line: str) -> None:
    """Print a line on stderr; a full disk or a closed pipe there does not change how the command ends."""
    with suppress(OSError):
        typer.echo(line, err=True)


class Commands(TyperGroup):
    """The group of commands, which turns every error into a message and an exit status.

    In the help, options stand in the panels of `PANELS`, and flags have no type: beside --quiet, `<bool>` would ask for
    a value.
    """

    def get_params(self, ctx: Any) -> Any:
        return _for_help(super().get_params(ctx))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            _for_help(command.get_params(ctx))
        return command

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        try:
            return super().make_context(*arguments, **settings)
        except UsageError as error:
            _report_usage(error)

    def invoke(self, ctx: Any) -> Any:  # typer has no public name for the class of this context
        try:
            return super().invoke(ctx)
        except UsageError as error:
            _report_usage(error)
        except InputError as error:
            complain(f"{_file_of(error, ctx)}{error}", WRONG_INPUT)
        except (ProcessingError, UnsupportedSystem, KeyboardInterrupt, Terminated) as error:
            _report(error)
        except RuntimeError as error:
            # Up to Python 3.11 a class whose making is interrupted, while it is imported, wraps what was raised.
            if isinstance(error.__cause__, KeyboardInterrupt | Terminated):
                _report(error.__cause__)
            raise
        except OSError as error:
            # A closed pipe (`blocksar plan ... | head`) is not an error: typer ends quietly.
            if error.errno == errno.EPIPE:
                raise
            _report(error)


def _for_help(parameters: Any) -> Any:
    """Set panels and types of a command's parameters for its help, and return them."""
    for parameter in parameters:
        if getattr(parameter, "rich_help_panel", None) is None:
            parameter.rich_help_panel = _PANEL_OF.get(parameter.name)
        if getattr(parameter, "is_flag", False) and parameter.metavar is None:
            parameter.metavar = ""
    return parameters


def _file_of(error: InputError, context: Any) -> str:
    """Return the file of options to begin a message about one of its values with; empty if there is none.

    A message names the option first, perhaps after the part of the input that it is about, or has the value.
    """
    path, command = context.meta.get(FILE, (None, None))
    if path is None or (isinstance(error, FolderError) and error.replaceable):  # a folder of other settings
        return ""
    message = str(error)
    for name, value in command.params.items():
        source = command.get_parameter_source(name)
        if value is None or source is None or source.name != "DEFAULT_MAP":
            continue
        text = str(value[0] if isinstance(value, list | tuple) and value else value)
        named = re.search(rf"(^|: )(--)?{name.replace('_', '[-_ ]')}\b", message)
        if named or quoted(text) in message or message.startswith((f"{text} ", f"{os.path.abspath(text)} ")):
            return f"{path}: "
    return ""


def _report(error: BaseException) -> NoReturn:
    status, message = ending(error)
    complain(message, status)


def _report_usage(error: Any) -> NoReturn:
    """Report a wrong command line in one sentence, like any other wrong input."""
    message = plain(error.format_message())
    if not message:  # no command was given: typer has printed the help
        raise typer.Exit(WRONG_INPUT)
    for problem in getattr(error.__cause__, "errors", list)():  # pydantic's messages lack the value
        typed = quoted(str(problem["input"]))
        message = message if typed in message else f"{message}, not {typed}"
    command = "blocksar" if error.ctx is None else error.ctx.command_path
    reference = " See" if message.endswith("?") else "; see"
    complain(f"{message[0].lower()}{message[1:]}{reference} {command} --help", WRONG_INPUT)


def plain(message: str) -> str:
    """A message of typer or pydantic in the form of our own, which have no full stop and say "must be"."""
    return message.removesuffix(".").replace("Value error, ", "").replace("Input should be", "must be")


def ending(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the message of a command that ends with an error."""
    match error:
        case InputError() | UnsupportedSystem():
            return WRONG_INPUT, str(error)
        case ProcessingError() | OSError():
            return FAILED, str(error)
        case KeyboardInterrupt():
            return INTERRUPTED, _stop_message(INTERRUPTED)
        case Terminated():
            return TERMINATED, _stop_message(TERMINATED)
        case _:  # a defect: a traceback follows
            return FAILED, f"{type(error).__name__}: {error}"


def open_streams() -> None:
    """Let stdout and stderr take any text: closed ones go nowhere, and characters that an encoding lacks become "?".

    An unfinished table, or a traceback after hours of work, would be worth less.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the caller, as with >&-
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def catch_signals() -> None:
    """Let Ctrl-C raise KeyboardInterrupt and SIGTERM raise Terminated, so that the command cleans up before it ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # A shell starts background processes with Ctrl-C ignored; keep that.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    """Let the command clean up and end; end at once on a second signal, or after GRACE."""
    status = INTERRUPTED if number == signal.SIGINT else TERMINATED
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, lambda *_: _stop_at_once(status))
    deadline = threading.Timer(GRACE, _stop_at_once, (status,))
    deadline.daemon = True
    deadline.start()
    raise KeyboardInterrupt if status == INTERRUPTED else Terminated(TERMINATED)


def _stop_at_once(status: int) -> None:
    """End the process now: its workers end with it, and unfinished files keep their temporary names."""
    abandon(status, _stop_message(status))
    os.write(2, f"blocksar: {_stop_message(status)}\n".encode())
    os._exit(status)


def _stop_message(status: int) -> str:
    reason = "interrupted" if status == INTERRUPTED else "terminated"
    return f"{reason}; what was finished stays: give the same command again to go on"
