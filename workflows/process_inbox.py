"""Process an inbox: focus every collection in it exactly once, oldest first.

    python workflows/process_inbox.py INBOX OUTBOX --workers 2 --notify "notify-operators --channel radar"

The script makes one sweep and ends; cron or a systemd timer starts it again, as often as required. A sweep lists the
complete collections of INBOX and focuses them one after the other on one cluster. A collection `NAME.zarr` is complete
when its group has a zarr.json: write it under another name and rename it when all of it is there.

A file or folder FILE of measured data that `blocksar ingest FILE` knows is ingested, with that command's defaults, and
is then the collection FILE.zarr. Nothing says when such a file is complete: a sweep waits with one that the sweep
before has not seen as it is. If it needs options, ingest it into INBOX/NAME.zarr instead. INBOX is only read. What else
lies in it is ignored; log and status say why.

Several collections of one acquisition, such as bursts, become one mosaic. List them beside them in a manifest
NAME.acquisition.json, {"collections": ["NAME_b0.zarr", ...]}: the acquisition is complete when all of them are. Or give
a pattern of their names: with --group '(.+)_b[0-9]+', collections whose names have the same first group are focused
together, and again when one more of them arrives.

OUTBOX belongs to the workflow:

    runs/NAME/                   the run; if the collection changes, the next run is NAME.2, and so on
    done/NAME.zarr.json          record of a finished collection: fingerprint, run
    quarantine/NAME.zarr.json    record of a collection that cannot be focused: fingerprint, reason
    ingested/FILE.zarr           phase history of measured data; may be removed when it is done
    ingested/FILE.zarr.json      fingerprint that a sweep has seen
    status.json                  results of the sweep, and its progress while it runs
    log.jsonl                    log of all sweeps, one event per line
    lock, scratch/               present while a sweep runs

The folders runs/, done/, quarantine/ and ingested/ alone decide what is to be done; the clock is not used. An
interrupted run is resumed. A quarantined collection is tried again when its bytes or the options change, or its record
is removed. A finished one is focused again when its bytes change, or its record and its run are removed.

    exit status   meaning
    0             all collections are done
    1             a failure that may pass: no room, no cluster, a hook that failed
    2             an option or a path is wrong: nothing was done
    3             a collection was quarantined, all others are done; reported once, by a later sweep if need be
    75            another sweep holds this outbox: nothing was done
    130, 143      interrupted, terminated: the next sweep continues

The hook (--notify) is run without a shell for every collection that is done, quarantined or failed, and reads the
event as JSON from its standard input. If it does not exit with 0, the next sweep sends the event again: every result
is delivered at least once.

The script needs the folder `inbox` beside it.
"""

from __future__ import annotations

import re
import sys
from typing import Annotated, Any, NoReturn

import typer

from blocksar.application.settings import Settings as FocusSettings
from blocksar.cli import endings, option_groups
from blocksar.errors import InputError, ProcessingError
from blocksar.imaging.method import ChainOptions
from blocksar.options import options_of, read_values
from blocksar.places import place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Held
from inbox.arrivals import list_inbox
from inbox.cluster import Cluster
from inbox.hooks import Hook
from inbox.journal import Journal
from inbox.outbox import Outbox
from inbox.records import Settings
from inbox.statuses import BUSY, FAILED, USAGE
from inbox.sweeping import Sweep

OPTIONS = options_of(FocusSettings, "processor", "blocks", "grid", "workers", "threads", "memory_limit", "wait_workers")


@option_groups.taking(OPTIONS)
@option_groups.taking(options_of(ChainOptions, "coefficients"), option_groups.ALTERNATIVES)
def main(
    inbox: Annotated[
        str, typer.Argument(metavar="INBOX", help="Folder of phase-history stores and measured data; only read.")
    ],
    outbox: Annotated[str, typer.Argument(metavar="OUTBOX", help="Folder of runs, records, status and log.")],
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A running dask scheduler; default: a cluster of its own.")
    ] = None,
    notify: Annotated[
        str | None, typer.Option(metavar="COMMAND", help="Run for each result, with the event as JSON on stdin.")
    ] = None,
    group: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN", help="Regular expression: names with the same first group are one acquisition."
        ),
    ] = None,
    quiet: option_groups.Quiet = False,
    **given: Any,
) -> None:
    """Focus every collection of an inbox exactly once, oldest first, and end; a timer starts the next sweep.

    Example: [bold]python workflows/process_inbox.py inbox outbox --workers 2 --notify notify-operators[/bold]
    """
    endings.catch_signals()
    try:
        settings = read_values(OPTIONS, {each.name: each.default for each in OPTIONS} | given)
        if settings["grid"] is not None:
            settings["grid"] = [list(axis) for axis in settings["grid"]]  # as JSON holds it
        status = sweep(
            inbox, outbox, settings, Hook.parse(notify), scheduler=scheduler, group=parse_group(group), quiet=quiet
        )
    except InputError as error:
        _end(str(error), USAGE)
    except Held as owner:
        _end(f"{outbox} is being swept by {owner}; nothing was done", BUSY)
    except (OSError, ProcessingError) as error:
        _end(str(error), FAILED)
    except KeyboardInterrupt:
        _end("interrupted; the next sweep continues from here", endings.INTERRUPTED)
    except endings.Terminated:
        _end("terminated; the next sweep continues from here", endings.TERMINATED)
    raise typer.Exit(status)


def sweep(
    inbox: str,
    outbox: str,
    settings: Settings,
    hook: Hook,
    *,
    scheduler: str | None = None,
    group: re.Pattern[str] | None = None,
    quiet: bool = False,
) -> int:
    """Lock the outbox, sweep the inbox once, and return the exit status.

    Raises
    ------
    Held
        If another sweep holds the outbox.
    InputError
        If the inbox cannot be listed, or the outbox cannot be written.
    """
    if not isinstance(folder := place(outbox), LocalPlace):
        raise InputError(f"OUTBOX {folder} is not a local folder; give one: lock and log need it")
    source, target = place(inbox), Outbox(folder.path)
    list_inbox(source, target.ingested, group)  # before anything is written
    if isinstance(source, LocalPlace):
        target.check_apart(source.path)
    target.prepare()
    with target.lock(), Cluster(settings, scheduler, target.scratch) as cluster:
        return Sweep(source, target, settings, cluster, hook, Journal(target, quiet=quiet), group).run()


def parse_group(pattern: str | None) -> re.Pattern[str] | None:
    """The pattern of names of one acquisition.

    Raises
    ------
    InputError
        If it is no regular expression.
    """
    try:
        return None if pattern is None else re.compile(pattern)
    except re.error as error:
        raise InputError(
            f"--group {pattern!r} is no regular expression ({error}); give one such as '(.+)_b[0-9]+'"
        ) from None


def _end(message: str, status: int) -> NoReturn:
    print(f"inbox: {message}", file=sys.stderr)
    raise typer.Exit(status)


if __name__ == "__main__":
    typer.run(main)
