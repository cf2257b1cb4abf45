"""The commands `plan` and `focus`, which take the same settings.

Options from a TOML file, `--config`: the command line wins over the file, and the file over the defaults.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from inspect import signature, unwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.application.settings import options_taken
from blocksar.cli.endings import FILE, WRONG_INPUT, Commands, UsageError, complain, plain
from blocksar.cli.option_groups import ALTERNATIVES, Everything, Explain, JsonLog, Quiet, given, single_command, taking
from blocksar.cli.printing import hint, listening, show
from blocksar.errors import InputError, quoted
from blocksar.imaging.method import ChainOptions
from blocksar.options import Stated, options_of, read_values
from blocksar.processors import PROCESSORS
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
    """Convert a TOML value to text as on the command line; a flag stays bool, several values become a list."""
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


@taking(options_taken("plan"))
@taking(options_of(ChainOptions), ALTERNATIVES)
def plan(
    context: typer.Context,
    source: Annotated[list[str], typer.Argument(metavar="PH.zarr|SCENE.toml", help="Phase-history stores or scenes.")],
    config: ConfigOption = None,
    everything: Everything = False,
    explain: Explain = False,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Show how a collection would be focused, and the predicted quality of its image.

    Prints blocks, predicted coherence, side lobes, widths and memory, without reading any samples.

    If the collection cannot be focused with these options, prints the reason and exits with status 2.

    Example: [bold]blocksar plan table1 --blocks 3[/bold]
    """
    settings = read_values(options_taken("plan"), options)

    from blocksar import api

    proposal = api.plan(one_or_all(source), **settings)
    show(proposal, context)
    if proposal.refusal is not None:
        complain(proposal.refusal, WRONG_INPUT)
    _hint_after_plan(context, source)


OF_PLAN = ("everything", "explain")  # its options that `focus` has not


def _hint_after_plan(context: typer.Context, sources: list[str]) -> None:
    """Suggest the next command: simulate a scene, or focus phase histories with the same options."""
    from blocksar.application.arguments import is_scene

    for source in sources:
        if is_scene(source):
            hint(context, "simulate", source, "--out", f"{Path(source).stem}.zarr")
            return
    hint(context, "focus", *sources, "--out", "run", *given(context, *OF_PLAN))


@taking(options_taken("focus"))
@taking(options_of(ChainOptions), ALTERNATIVES)
def focus(
    context: typer.Context,
    source: Annotated[
        list[str], typer.Argument(metavar="PH.zarr", help="Phase-history stores; several of one frame: one mosaic.")
    ],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; an unfinished one is resumed.")],
    config: ConfigOption = None,
    print_config: PrintConfig = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **options: Any,
) -> None:
    """Focus a phase history into a calibrated ground image, or several of one frame into one mosaic.

    Give the same command again to resume an interrupted run.

    Example: [bold]blocksar focus table1.zarr --out run --blocks 3[/bold]
    """
    settings = read_values(options_taken("focus"), options)
    if print_config:
        typer.echo(configuration(context))
        return

    from blocksar import api

    with listening(context) as progress:
        report = api.focus(one_or_all(source), out, progress=progress, **settings)
    show(report)
    if settings["dry_run"]:
        hint(context, "focus", *source, "--out", out, *given(context, "out", "dry_run"))
    elif report.measurable:
        hint(context, "quality", out)


class OfProcessors(Commands):
    """The group of all commands; `plan` and `focus` also take processors of other packages and their options."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in ("plan", "focus") and (others := set(PROCESSORS.names()) - set(PROCESSORS.own)):
            self.commands.update({each.__name__: _taking_processors(each, sorted(others)) for each in (plan, focus)})
        return super().resolve_command(ctx, args)


def _taking_processors(command: Callable[..., None], names: Sequence[str]) -> Any:
    """Create a command that also takes processors of other packages: their names, summaries and options."""
    own = {each.name for each in options_taken(command.__name__)}
    known, notes, taken = set(signature(command).parameters), list[str](), unwrap(command)
    for name in names:
        try:
            part = PROCESSORS.get(name)
            stated = options_of(part.options)
            if twice := [each.name for each in stated if each.name in own]:
                notes.append(f"{name} has an option {twice[0]}, which is the command's own; repair or remove it.")
                continue
            more = [each for each in stated if each.name not in known]
            taken = taking(more, f"Options of {name}")(taken)
            known |= {each.name for each in more}
            notes.append(f"{name}: {part.summary}.")
        except InputError as error:
            notes.append(f"{error}.")

    def with_names(stated: Stated) -> Stated:
        option = stated.option
        if option.choices is None:
            return stated
        choices = *option.choices(), *names
        return stated._replace(option=replace(option, help=" ".join([option.help, *notes]), choices=lambda: choices))

    of_all = taking(map(with_names, options_taken(command.__name__)))
    return single_command(command.__name__, of_all(taking(options_of(ChainOptions), ALTERNATIVES)(taken)))


def one_or_all(sources: list[str]) -> str | list[str]:
    """The only source, or all of them."""
    return sources if len(sources) > 1 else sources[0]
