"""Commands that form images: processors of other packages, and their options, join the own ones when they are asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from inspect import Parameter, signature, unwrap
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from blocksar.cli.endings import without_types
from blocksar.cli.plugged import command_of, parameter_of
from blocksar.errors import InputError
from blocksar.options import Option, Stated, options_of
from blocksar.processors import AUTO, PROCESSORS


class ImagingCommand(TyperCommand):
    """A command with --processor; what is installed is not looked up before it is parsed, or its help is shown."""

    _complete = False

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        self.complete()
        return super().make_context(*arguments, **settings)

    def complete(self) -> None:
        """Add the names, summaries and options of the processors that other packages add, once."""
        if self._complete or len(PROCESSORS.names()) == len(PROCESSORS.own):
            return
        self._complete = True
        function = unwrap(self.callback or (lambda: None))
        plain = signature(function, eval_str=True)
        parameters, said = dict(plain.parameters), []
        panels: dict[str | None, str | None] = {
            each.name: getattr(each, "rich_help_panel", None) for each in self.params
        }
        for name in PROCESSORS.names()[len(PROCESSORS.own) :]:
            try:
                parameters |= {each.name: each for each in _options(name, panels)}
                said.append(f"{name}: {PROCESSORS.get(name).summary}.")
            except InputError as error:
                said.append(f"{error}.")
        chosen = parameters["processor"]
        names = (*PROCESSORS.names(), AUTO) if self.name == "plan" else PROCESSORS.names()
        help_text = " ".join([chosen.annotation.__metadata__[0].help, *said])
        kind = Annotated[Literal[names], typer.Option(metavar="NAME", help=help_text)]  # type: ignore[valid-type]
        parameters["processor"] = chosen.replace(annotation=kind)

        def extended(**given: Any) -> None:
            function(**given)

        extended.__signature__ = plain.replace(parameters=[*parameters.values()])  # type: ignore[attr-defined]
        made = command_of(self.name or "", extended)
        self.params, self.callback = without_types(made.params), made.callback


def _options(name: str, panels: dict[str | None, str | None]) -> Iterator[Parameter]:
    """Those options of an installed processor that no other processor has; `panels` are of the options that are known.

    Raises
    ------
    InputError
        If the processor cannot be loaded, or its options are none for a command.
    """
    part = PROCESSORS.get(name)
    for each in options_of(part.options):
        if each.name not in panels:
            panels[each.name] = f"Options of {name}"
            yield parameter_of(_asked(each), panels[each.name])
        elif panels[each.name] is None:
            raise InputError(f"{name} has an option {each.name}, which is the command's own; repair or remove it")


def _asked(stated: Stated) -> Stated:
    """An option that is None unless it is given, and shows its default."""
    shown = stated.option.default
    option: Option = replace(stated.option, default=str(stated.default) if shown is None else shown)
    return Stated(stated.name, stated.type | None, None, option)
