"""Options that several commands share, options from models, and groups with a command for each plug-in."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any, Literal, get_args

import typer
from rich.markup import escape

from blocksar.application.settings import OVERWRITE
from blocksar.cli.endings import Commands
from blocksar.errors import InputError
from blocksar.options import Option, Stated
from blocksar.products.shared_options import COLOUR_MAP, COLOUR_RANGE


class Plugged(Commands):
    """A group with a command for each part of a registry, created on demand."""

    def __init__(self, *, commands: Any = None, **settings: Any) -> None:
        super().__init__(commands=_Made(commands or {}, self), **settings)  # type: ignore[arg-type]

    @classmethod
    @abstractmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the parts, in the order of the help."""

    @classmethod
    @abstractmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        """Return the function of a part's command."""


class _Made(Mapping[str, Any]):
    """Commands of a group by name: its own, and those of parts, each created when it is first looked up."""

    def __init__(self, own: Mapping[str, Any], group: Plugged) -> None:
        self._own, self._group, self._made = own, group, dict[str, Any]()

    def __iter__(self) -> Iterator[str]:
        return iter((*self._own, *self._group.names()))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> Any:
        if name in self._own:
            return self._own[name]
        if name not in self._made:
            if name not in self._group.names():
                raise KeyError(name)
            self._made[name] = self._command(name)
        return self._made[name]

    def _command(self, name: str) -> Any:
        """Create the command of a part; if the part is broken, a command that prints the reason."""
        try:
            return single_command(name, self._group.command_of(name))
        except InputError as error:
            refusal = error
        except Exception as error:  # its options are none for a command line
            refusal = InputError(
                f"{name} has no command ({type(error).__name__}: {error}); repair or remove the package that adds it"
            )
        return single_command(name, _refusing(refusal), ignore_unknown_options=True, allow_extra_args=True)


def single_command(name: str, function: Callable[..., None], **settings: bool) -> Any:
    """Create a command from a function."""
    settings_of_all = {"help_option_names": ["-h", "--help"]}
    single = typer.Typer(rich_markup_mode="rich", context_settings=settings_of_all | settings, add_completion=False)
    single.command(name)(function)
    return typer.main.get_command(single)


def _refusing(error: InputError) -> Callable[..., None]:
    def refuse() -> None:
        raise error

    refuse.__doc__ = escape(f"{str(error)[0].upper()}{str(error)[1:]}.")
    return refuse


def with_options(
    command: Callable[..., None], options: Iterable[Stated], doc: str | None = None, *, panel: str | None = None
) -> Callable[..., None]:
    """Let a command take options as keyword arguments, behind its own up to the first with a default.

    What has a function that reads it is taken as text, except for numbers. `panel` is where its help shows them.
    """
    plain = signature(command, eval_str=True)
    own = [parameter for parameter in plain.parameters.values() if parameter.kind != Parameter.VAR_KEYWORD]
    needed = [parameter for parameter in own if parameter.default is Parameter.empty]
    others = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in own if each.default is not Parameter.empty]
    shown = [_parameter(each, panel) for each in options]

    @wraps(command)
    def taking_options(*arguments: Any, **settings: Any) -> None:
        command(*arguments, **settings)

    taking_options.__signature__ = plain.replace(parameters=[*needed, *shown, *others])  # type: ignore[attr-defined]
    taking_options.__doc__ = doc or command.__doc__
    return taking_options


def typer_option(option: Option, default: object = None, panel: str | None = None) -> Any:
    """Convert an option of a model to one of the command line; `panel` is where its help shows it."""
    shown = option.default if option.default is not None else default is not None
    return typer.Option(
        *option.flags, metavar=option.metavar, help=option.help, min=option.least, show_default=shown,
        rich_help_panel=panel,
    )  # fmt: skip


def _parameter(stated: Stated, panel: str | None) -> Parameter:
    option, kind = stated.option, stated.type
    if option.choices is not None:
        kind = Literal[tuple(option.choices())]
    elif option.read is not None and kind not in (int, float):
        kind = str | None
    if stated.default is False and not option.flags:  # such flags have no negative form
        option = replace(option, flags=(f"--{stated.name.replace('_', '-')}",))
    if panel is not None and option.metavar is None:
        option = replace(option, metavar=", ".join(map(str, get_args(kind))) or None)  # which few columns can fold
    default = stated.default if option.default is None else None
    annotation = Annotated[kind, typer_option(option, default, panel)]  # type: ignore[valid-type]
    return Parameter(stated.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


Command = Callable[..., None]

ALTERNATIVES = "Alternative methods, for comparison"  # title of a panel in the help
Channel = Annotated[str | None, typer.Option(metavar="NAME", help="Of several channels.", show_default="the first")]
ColourMap = Annotated[str | None, typer_option(COLOUR_MAP)]
ColourRange = Annotated[str | None, typer_option(COLOUR_RANGE)]
Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
StoreOut = Annotated[str, typer.Option(metavar="STORE", help="Phase-history store to write.")]
OwnThreads = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Number of threads; default: by the machine's cores.")
]
Overwrite = Annotated[bool, typer_option(OVERWRITE)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress, and no next command.")]
Everything = Annotated[bool, typer.Option("--all", help="Show all rows and columns of the tables.")]
Explain = Annotated[bool, typer.Option("--explain", help="Say what the columns mean.")]
JsonLog = Annotated[
    str | None, typer.Option(metavar="FILE", help="Append progress as JSON lines to a file, also with --quiet.")
]


def taking(options: Iterable[Stated], panel: str | None = None) -> Callable[[Command], Command]:
    """Decorate a command to take options as keyword arguments; `panel` is where its help shows them."""
    return lambda command: with_options(command, options, panel=panel)


def given(context: typer.Context, *without: str) -> list[str]:
    """Return the options that stand on the command line, except some, as words."""
    words: list[str] = []
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        option = max(parameter.opts, key=len)
        if parameter.name in without or source is None or source.name != "COMMANDLINE" or not option.startswith("-"):
            continue
        value = context.params[parameter.name or ""]
        if isinstance(value, bool):
            words.append(option if value else parameter.secondary_opts[0])
        else:
            words += [option, str(value)]
    return words
