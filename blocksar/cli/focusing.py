"""The commands `plan` and `focus`, which take the same settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import signature, unwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.api.settings import options_taken
from blocksar.cli.configuration import ConfigOption, PrintConfig, configuration
from blocksar.cli.display import hint, listening, show
from blocksar.cli.endings import WRONG_INPUT, Commands, complain
from blocksar.cli.options import ALTERNATIVES, Everything, Explain, JsonLog, Quiet, given, taking
from blocksar.cli.plugged import single_command
from blocksar.errors import InputError
from blocksar.focusing.method import ChainOptions
from blocksar.options import Stated, options_of, read_values
from blocksar.processors import PROCESSORS


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
    """Simulate a scene, or focus phase histories with the same options."""
    from blocksar.api.arguments import is_scene

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

    if settings["scheduler"] is None and not settings["dry_run"]:
        from blocksar.graph.starting import start_early

        start_early(source, out, workers=settings["workers"], threads=settings["threads"])

    with listening(context) as progress:
        report = api.focus(one_or_all(source), out, progress=progress, **settings)
    show(report)
    if settings["dry_run"]:
        hint(context, "focus", *source, "--out", out, *given(context, "out", "dry_run"))
    elif report.measurable:
        hint(context, "quality", out)


class OfProcessors(Commands):
    """All commands. When `plan` or `focus` is called, it takes the processors of other packages and their options."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in ("plan", "focus") and (others := set(PROCESSORS.names()) - set(PROCESSORS.own)):
            self.commands.update({each.__name__: _taking_processors(each, sorted(others)) for each in (plan, focus)})
        return super().resolve_command(ctx, args)


def _taking_processors(command: Callable[..., None], names: Sequence[str]) -> Any:
    """A command with processors of other packages besides: their names, summaries and options."""
    own = {each.name for each in options_taken(command.__name__)}
    known, said, taken = set(signature(command).parameters), list[str](), unwrap(command)
    for name in names:
        try:
            part = PROCESSORS.get(name)
            stated = options_of(part.options)
            if twice := [each.name for each in stated if each.name in own]:
                said.append(f"{name} has an option {twice[0]}, which is the command's own; repair or remove it.")
                continue
            more = [each for each in stated if each.name not in known]
            taken = taking(more, f"Options of {name}")(taken)
            known |= {each.name for each in more}
            said.append(f"{name}: {part.summary}.")
        except InputError as error:
            said.append(f"{error}.")

    def with_names(stated: Stated) -> Stated:
        option = stated.option
        if option.choices is None:
            return stated
        choices = *option.choices(), *names
        return stated._replace(option=replace(option, help=" ".join([option.help, *said]), choices=lambda: choices))

    of_all = taking(map(with_names, options_taken(command.__name__)))
    return single_command(command.__name__, of_all(taking(options_of(ChainOptions), ALTERNATIVES)(taken)))


def one_or_all(sources: list[str]) -> str | list[str]:
    """The only source, or all of them."""
    return sources if len(sources) > 1 else sources[0]
