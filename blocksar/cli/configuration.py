"""Options from a TOML file, `--config`: the command line wins over the file, and the file over the defaults."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.cli.endings import FILE, UsageError, plain
from blocksar.errors import InputError, quoted
from blocksar.version import __version__

CONFIGURED = "focus"  # the command whose options a file holds
NOT_CONFIGURED = ("config", "print_config", "dry_run", "help")
MOST_BYTES = 1 << 20  # of a file


def read_configuration(context: typer.Context, path: str | None) -> str | None:
    """Make the options of a file the defaults of a command; a callback of `--config`.

    A file has the options of `focus`, by their names with or without dashes. `plan` takes those that it has too.

    Raises
    ------
    InputError
        If the file cannot be read or is not TOML, a key is unknown, or a value is wrong.
    """
    if path is None:
        return None
    known = _options(_configured_command(context))
    own = _options(context.command)
    defaults: dict[str, Any] = {}
    given: dict[str, str] = {}  # keys by name: dashes may be underscores
    for key, value in _read(path).items():
        name = key.replace("-", "_")
        if name not in known:
            raise InputError(f"{path}: {quoted(key)} is no option of {CONFIGURED}; {_nearest(name, known)}")
        if name in given:
            raise InputError(f"{path}: {given[name]} and {key} are one option; give one of them")
        given[name] = key
        words = _as_typed(value, known[name], f"{path}: {key}")
        try:
            known[name].process_value(context, words)
        except UsageError as error:
            raise InputError(f"{path}: {key} = {_shown(value)}: {_problem(error)}") from None
        if name in own:
            defaults[name] = words
    context.default_map = defaults
    context.meta[FILE] = path, context
    return path


def _configured_command(context: Any) -> Any:
    """The command `focus`, as the group of all commands knows it."""
    group = context.find_root().command
    return getattr(group, "commands", {}).get(CONFIGURED, context.command)


def _options(command: Any) -> dict[str, Any]:
    """Arguments and options of a command that a file may give, by name."""
    return {parameter.name: parameter for parameter in command.params if parameter.name not in NOT_CONFIGURED}


def _read(path: str) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            data = file.read(MOST_BYTES)
        return tomllib.loads(data.decode("utf-8"))
    except OSError as error:
        raise InputError(f"--config {path} cannot be read ({error.strerror or error}); check the path") from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"--config {path} is not TOML: {error}; correct that line") from None


def _nearest(name: str, known: dict[str, Any]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    names = ", ".join(option.replace("_", "-") for option in known)
    return f"did you mean {close[0].replace('_', '-')}?" if close else f"known are {names}"


def _as_typed(value: Any, parameter: Any, place: str) -> Any:
    """A value of TOML as the command line gives it: text, except for a flag, and a list where several are taken."""
    if getattr(parameter, "is_flag", False):
        if not isinstance(value, bool):
            raise InputError(f"{place} = {_shown(value)} is neither true nor false; write one of them")
        return value
    if isinstance(value, list) and parameter.nargs == -1 and value:
        return [_as_text(item, place) for item in value]
    return [_as_text(value, place)] if parameter.nargs == -1 else _as_text(value, place)


def _as_text(value: Any, place: str) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise InputError(f"{place} = {_shown(value)} is neither text nor a number; write it as on the command line")
    return str(value)


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else quoted(value if isinstance(value, str) else str(value))


def _problem(error: Any) -> str:
    """Say what is wrong with a value, without the name of the option."""
    message = plain(str(error.message))
    return message[:1].lower() + message[1:]


def configuration(context: typer.Context) -> str:
    """Return the options of a command as they take effect, in TOML that `--config` reads back."""
    return "\n".join([
        f"# Options of blocksar {context.info_name}, version {__version__}; `--config FILE.toml` reads them.",
        *_lines(context),
    ])  # fmt: skip


def _lines(context: typer.Context) -> Iterator[str]:
    for name, parameter in _options(context.command).items():
        value, key = context.params[name], name.replace("_", "-")
        remark = f"  # {' '.join(str(parameter.help).split())}" if parameter.help else ""
        if value is None:
            yield f"# {key} ={remark}"
        elif isinstance(value, str | Path | list | tuple):
            yield f"{key} = {json.dumps([*map(str, value)] if isinstance(value, list | tuple) else str(value))}{remark}"
        else:
            yield f"{key} = {str(value).lower()}{remark}"


ConfigOption = Annotated[
    str | None,
    typer.Option(
        "--config",
        metavar="FILE.toml",
        callback=read_configuration,
        is_eager=True,
        help="Take options from a file; those on the command line win.",
    ),
]
PrintConfig = Annotated[
    bool, typer.Option("--print-config", help="Print all options as they take effect, as a file for --config.")
]
