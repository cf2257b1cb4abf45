"""The commands about finished runs: `quality`, `report`, `compare` and `view`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import Channel, Everything, Explain, JsonLog, Overwrite, Quiet, Run


def quality(
    context: typer.Context,
    run: Run,
    targets: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="JSON, CSV or GeoJSON file of targets; default: those of the phase history."),
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Also compare image chips with exact back-projection.")
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(metavar="RUN", help="Also compare chips with those of this run, aligned by shift and phase ramp."),
    ] = None,
    found: Annotated[
        int,
        typer.Option(metavar="N", help="Also find and measure the N brightest isolated points, and the noise floor."),
    ] = 0,
    area: Annotated[
        str | None, typer.Option(metavar="x0:x1,y0:y1", help="Also measure the equivalent looks of this part, m.")
    ] = None,
    channel: Channel = None,
    everything: Everything = False,
    explain: Explain = False,
    quiet: Quiet = False,
) -> None:
    """Measure side-lobe ratios, widths, position and calibration of every target.

    Prints the worst cases and the ten worst targets, and writes all to RUN/quality.json.

    Example: [bold]blocksar quality run --reference[/bold]
    """
    from blocksar import api

    report = api.quality(
        run, targets=targets, reference=reference, against=against, found=found, area=area, channel=channel
    )
    show(report, context)
    hint(context, "report", run)


def report(
    context: typer.Context,
    run: Run,
    out: Annotated[
        str | None, typer.Option(metavar="FILE", help="HTML file to write; default: RUN/report.html.")
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write an HTML page about a run, which opens in any browser without a network.

    Shows the image with zoom, block borders and targets; plan and measurements
    side by side; target responses; times; provenance.

    Example: [bold]blocksar report run[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        page = api.report(run, out=out, channel=channel, overwrite=overwrite, progress=progress)
    show(page)
    hint(context, "export", "png", run, "--out", f"{Path(run).name}.png")


def compare(
    context: typer.Context,
    a: Annotated[str, typer.Argument(metavar="A", help="Folder of a finished run, the earlier one.")],
    b: Annotated[str, typer.Argument(metavar="B", help="Folder of another on the same grid.")],
    out: Annotated[str, typer.Option(metavar="FOLDER", help="Folder to write: pair.zarr and pictures.")],
    window: Annotated[
        str, typer.Option(metavar="AxB", help="Pixels along y and x, odd, over which coherence is estimated.")
    ] = "7x7",
    false_alarms: Annotated[
        float, typer.Option(metavar="P", help="Probability that an unchanged pixel is called changed.")
    ] = 0.001,
    crop: Annotated[
        str | None, typer.Option(metavar="x0:x1,y0:y1", help="Compare only this part of the ground, m.")
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Compare two runs on one grid: interferogram, coherence, amplitude ratio and coherent change.

    Writes FOLDER/pair.zarr, which opens with xarray, and pictures of all four.

    Example: [bold]blocksar compare pass-1 pass-2 --out pair[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.compare(
            a, b, out, window=window, false_alarms=false_alarms, crop=crop, channel=channel, overwrite=overwrite,
            progress=progress,
        )  # fmt: skip
    show(report)
    hint(context, "quality", a, "--against", b)


def view(
    context: typer.Context,
    run: Run,
    channel: Channel = None,
    port: Annotated[
        int | None, typer.Option(metavar="N", help="Where to listen on 127.0.0.1.", show_default="one that is free")
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    quiet: Quiet = False,
) -> None:
    """Pan and zoom a run of any size in the browser, by its pyramid if it has one, until Ctrl-C.

    Served by this process, to this machine only.

    Example: [bold]blocksar view run[/bold]
    """
    from blocksar import api

    report = api.view(run, channel=channel, port=port, browser=browser)
    show(report)
    hint(context, "report", run)
    with suppress(KeyboardInterrupt):
        api.wait_until_closed(report.result)
