"""Commands below `export` and `ingest`: one for each part of a registry, with the options of its model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from inspect import Parameter, signature
from typing import Annotated, Any

import typer

from blocksar.cli.endings import Commands
from blocksar.options import Stated, options_of


class Plugged(Commands):
    """A group with a command for each part of a registry, made when it is asked for."""

    @classmethod
    @abstractmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the parts, in the order of the help."""

    @classmethod
    @abstractmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        """The function of a part's command."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *self.names()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in self.names() and cmd_name not in self.commands:
            single = typer.Typer(rich_markup_mode="rich", context_settings={"help_option_names": ["-h", "--help"]})
            single.command(cmd_name)(self.command_of(cmd_name))
            self.commands[cmd_name] = typer.main.get_command(single)
        return super().get_command(ctx, cmd_name)


def with_options(command: Callable[..., None], model: type, doc: str) -> Callable[..., None]:
    """Let a command take the options of a model as keyword arguments, behind its own up to the first with a default.

    What has a function that reads it is taken as text.
    """
    plain = signature(command, eval_str=True)
    own = [parameter for parameter in plain.parameters.values() if parameter.kind != Parameter.VAR_KEYWORD]
    needed = [parameter for parameter in own if parameter.default is Parameter.empty]
    others = [parameter for parameter in own if parameter.default is not Parameter.empty]
    options = [_parameter(each) for each in options_of(model)]
    command.__signature__ = plain.replace(parameters=[*needed, *options, *others])  # type: ignore[attr-defined]
    command.__doc__ = doc
    return command


def _parameter(stated: Stated) -> Parameter:
    option = stated.option
    shown: Any = option.default if option.default is not None else stated.default is not None
    kind = stated.type if option.read is None else str | None
    return Parameter(
        stated.name,
        Parameter.KEYWORD_ONLY,
        default=stated.default,
        annotation=Annotated[kind, typer.Option(metavar=option.metavar, help=option.help, show_default=shown)],
    )
