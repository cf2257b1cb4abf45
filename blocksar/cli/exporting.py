"""The commands below `export`, one for each product: the image of a run in standard formats."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from blocksar.cli.display import hint, listening, show
from blocksar.cli.options import Channel, JsonLog, Overwrite, Quiet, Run
from blocksar.cli.plugged import Plugged, with_options
from blocksar.options import options_of
from blocksar.products.registry import PRODUCTS


class Products(Plugged):
    """A command for each product."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        return PRODUCTS.names()

    @classmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        product = PRODUCTS.get(name)

        def export_product(
            context: typer.Context,
            run: Run,
            out: str | None = None,
            channel: Channel = None,
            overwrite: Overwrite = False,
            quiet: Quiet = False,
            json_log: JsonLog = None,
            **options: Any,
        ) -> None:
            from blocksar import api

            if out is None:
                out = f"{run.rstrip('/').rpartition('/')[2]}{product.endings[0]}"
            with listening(context) as progress:
                report = api.export(name, run, out, channel=channel, overwrite=overwrite, progress=progress, **options)
            show(report)
            hint(context, "report", run)

        file = typer.Option(
            metavar="FILE",
            help=f"File to write, {' or '.join(product.endings)}; default: the run's name with that, here.",
        )
        export_product.__annotations__["out"] = Annotated[str | None, file]
        example = f"Example: [bold]blocksar export {name} run --out image{product.endings[0]}[/bold]"
        return with_options(export_product, options_of(product.options), f"{product.summary}\n\n{example}")


export = typer.Typer(
    name="export",
    cls=Products,
    help="Export the image of a run to a standard file format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)
