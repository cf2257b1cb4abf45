"""The commands below `ingest`: measured data to phase histories, one for each reader."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from blocksar.cli.display import hint, listening, show
from blocksar.cli.options import JsonLog, Overwrite, Quiet, StoreOut
from blocksar.cli.plugged import Plugged, with_options
from blocksar.options import options_of

CollectionStart = Annotated[
    str | None,
    typer.Option(metavar="UTC", help="When the collection began, such as 2008-08-19T14:03:21.5Z, for products."),
]
TimeZero = Annotated[
    float | None, typer.Option(metavar="S", help="Seconds from --collection-start to slow time 0, for products.")
]


class Readers(Plugged):
    """The readers; files that stand for the name of one are ingested by what knows them."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        from blocksar.ingestion.readers import READERS

        return READERS.names()

    @classmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        from blocksar.ingestion.readers import READERS

        reader = READERS.get(name)
        metavar, text = reader.source
        kind: Any = list[str] if reader.several else str

        def ingest_files(
            context: typer.Context,
            source: str,
            out: StoreOut,
            collection_start: CollectionStart = None,
            time_zero: TimeZero = None,
            overwrite: Overwrite = False,
            quiet: Quiet = False,
            json_log: JsonLog = None,
            **options: Any,
        ) -> None:
            from blocksar import api

            with listening(context) as progress:
                report = api.ingest(
                    name, source, out, collection_start=collection_start, time_zero=time_zero, overwrite=overwrite,
                    progress=progress, **options,
                )  # fmt: skip
            show(report)
            hint(context, "info", out)

        ingest_files.__annotations__["source"] = Annotated[kind, typer.Argument(metavar=metavar, help=text)]
        doc = f"{reader.summary}\n\nExample: [bold]blocksar ingest {name} {reader.example}[/bold]"
        return with_options(ingest_files, options_of(reader.options), doc)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        from blocksar.api.sources import reader_of

        named = not args or args[0].startswith("-") or args[0] in self.names()
        if not (named or ctx.resilient_parsing):  # which completes words
            name = reader_of(args[0])
            return name, self.get_command(ctx, name), args
        return super().resolve_command(ctx, args)


ingest = typer.Typer(
    name="ingest",
    cls=Readers,
    help="Convert measured data to a phase history. Without the name of a command, the file's first bytes tell it.\n\n"
    "Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]",
    no_args_is_help=True,
)
