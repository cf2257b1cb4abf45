"""Commands below `export` and `ingest`: one for each part of a registry, with the options of its model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from inspect import Parameter, signature
from typing import Annotated, Any

import typer
from rich.markup import escape

from blocksar.cli.endings import Commands
from blocksar.errors import InputError
from blocksar.options import Option, Stated, options_of


class Plugged(Commands):
    """A group with a command for each part of a registry, made when it is asked for."""

    def __init__(self, *, commands: Any = None, **settings: Any) -> None:
        super().__init__(commands=_Made(commands or {}, self), **settings)  # type: ignore[arg-type]

    @classmethod
    @abstractmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the parts, in the order of the help."""

    @classmethod
    @abstractmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        """The function of a part's command."""


class _Made(Mapping[str, Any]):
    """The commands of a group by name: its own, then those of parts, each made once, when it is first looked up."""

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
        """The command of a part; of one that cannot have any, one that says so, as its help does."""
        try:
            return command_of(name, self._group.command_of(name))
        except InputError as error:
            refusal = error
        except Exception as error:  # its options are none for a command line
            refusal = InputError(
                f"{name} has no command ({type(error).__name__}: {error}); repair or remove the package that adds it"
            )
        return command_of(name, _refusing(refusal), ignore_unknown_options=True, allow_extra_args=True)


def command_of(name: str, function: Callable[..., None], **settings: bool) -> Any:
    settings_of_all = {"help_option_names": ["-h", "--help"]}
    single = typer.Typer(rich_markup_mode="rich", context_settings=settings_of_all | settings, add_completion=False)
    single.command(name)(function)
    return typer.main.get_command(single)


def _refusing(error: InputError) -> Callable[..., None]:
    def refuse() -> None:
        raise error

    refuse.__doc__ = escape(f"{str(error)[0].upper()}{str(error)[1:]}.")
    return refuse


def with_options(command: Callable[..., None], model: type, doc: str) -> Callable[..., None]:
    """Let a command take the options of a model as keyword arguments, behind its own up to the first with a default.

    What has a function that reads it is taken as text.
    """
    plain = signature(command, eval_str=True)
    own = [parameter for parameter in plain.parameters.values() if parameter.kind != Parameter.VAR_KEYWORD]
    needed = [parameter for parameter in own if parameter.default is Parameter.empty]
    others = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in own if each.default is not Parameter.empty]
    options = [parameter_of(each) for each in options_of(model)]
    command.__signature__ = plain.replace(parameters=[*needed, *options, *others])  # type: ignore[attr-defined]
    command.__doc__ = doc
    return command


def typer_option(option: Option, default: object = None, panel: str | None = None) -> Any:
    """An option as the command line has it; `panel` is where its help shows it."""
    shown = option.default if option.default is not None else default is not None
    return typer.Option(
        *option.flags, metavar=option.metavar, help=option.help, show_default=shown, rich_help_panel=panel
    )


def parameter_of(stated: Stated, panel: str | None = None) -> Parameter:
    """An option as a parameter of a command's function; `panel` is where its help shows it."""
    kind = stated.type if stated.option.read is None else str | None
    default = stated.default if stated.option.default is None else None
    annotation = Annotated[kind, typer_option(stated.option, default, panel)]  # type: ignore[valid-type]
    return Parameter(stated.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
