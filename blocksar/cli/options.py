"""The options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated

import typer

from blocksar.api.settings import OVERWRITE
from blocksar.cli.plugged import typer_option, with_options
from blocksar.options import Stated
from blocksar.products.options import COLOUR_MAP, COLOUR_RANGE

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
    """Return the options that stand on the command line, except some, as its words."""
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
