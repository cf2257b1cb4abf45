"""Runs of several channels or looks: each is a run of its own, one after the other, and their images lie in one store.

RUN/channels/NAME is the run of a channel, as it would be alone: one geometry gives all of them one plan, and so pixels
at the same places to the last bit. RUN/looks/NAME is that of a look, a part of each target's dwell (`collection.
sublooks`). RUN/image.zarr has their images, and the noise and pyramids of these, as (channel, y, x) or (look, y, x), in
files that are shared with the members' own images where the file system has links. RUN/run.json is the record of the
whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.application.arguments import OnGround, Source, history_of, sources_of
from blocksar.application.ground import image_grid
from blocksar.application.looks import divide_dwells, name_rows, one_source
from blocksar.application.rehearsing import NOTHING_DONE
from blocksar.application.run_stages import without_samples
from blocksar.application.settings import Settings
from blocksar.application.shown import RunReport, is_measurable
from blocksar.application.track_places import TrackPlace, fingerprint_of_members, joint_fingerprint
from blocksar.chunks import TILE
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.errors import FolderError, InputError, NoRoom
from blocksar.graph import cluster
from blocksar.graph.machine import resources
from blocksar.places.place import Place
from blocksar.planning.memory import PROCESS_MEMORY, checked_memory
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.runs import folder as run_folder
from blocksar.runs.record import FINISHED, FORMAT, RECORD, UNFINISHED, Receipt, RunInput, RunRecord, Written
from blocksar.version import __version__

if TYPE_CHECKING:
    from distributed import Client

Focus = Callable[..., RunReport]
OWN = ("image", "noise_equivalent")  # of each channel or look
# Attributes of a member's image that differ between members, and those of its pyramid: the whole has its own.
NOT_SHARED = ("warnings", "run", "channel", "look", "multiscales", "zarr_conventions")
SAME = ("block", "collection", *stores.ON_TERRAIN)  # those of the first


@dataclass(frozen=True)
class Members:
    """Inputs of each channel or look, by name, with the dimension ("channel" or "look") and the phase history."""

    dimension: str
    histories: dict[str, list[stores.PhaseHistory]]
    whole: tuple[stores.PhaseHistory, ...]
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.histories)

    def folder(self, run: Place, name: str) -> Place:
        return run_folder.member(run, name, self.dimension)

    def input(self) -> RunInput:
        """Return the input as the record of the whole run names it from the start; empty if it is in memory."""
        if any(isinstance(each, stores.DatasetHistory) for some in self.histories.values() for each in some):
            return RunInput()
        return RunInput(self.path, fingerprint_of_members(self.histories.values()))

    def unfinished(self) -> RunRecord:
        """The record of the whole as long as it is not finished."""
        return RunRecord(
            status=UNFINISHED, format=FORMAT, channels=self.names, dimension=self.dimension, input=self.input(),
            versions={"blocksar": __version__},
        )  # fmt: skip

    @property
    def path(self) -> str:
        """Path of the first phase history."""
        return str(next(iter(self.histories.values()))[0].path)


def members_of(source: Source, looks: int | None, grid: Grid | None, on_ground: OnGround) -> Members | None:
    """Return the channels of a source, or the looks that were requested; None if there is only one image.

    Raises
    ------
    InputError
        If several phase histories do not have the same channels, or looks cannot be formed.
    """
    if looks is not None:
        return _looks_of(source, looks, grid, on_ground)
    sources = sources_of(source)
    if any(isinstance(each, stores.PhaseHistory) for each in sources):
        return None
    histories = on_ground([history_of(each) for each in sources])
    first = histories[0]
    for other in histories:
        if other.channels != first.channels:
            have = (", ".join(history.channels) or "none" for history in (first, other))
            raise InputError(
                f"{first.label} and {other.label} do not have the same channels ({' and '.join(have)}); "
                "focus each alone"
            )
    if not first.channels:
        return None
    of = {name: [each.of_channel(name) for each in histories] for name in first.channels}
    return Members("channel", of, tuple(histories))


def _looks_of(source: Source, count: int, grid: Grid | None, on_ground: OnGround) -> Members:
    [history] = on_ground([history_of(one_source(source, count))])
    if isinstance(history, stores.DatasetHistory):
        raise InputError(f"looks = {count}: looks are formed of a phase history in a store; write it (blocksar.write)")
    looks = divide_dwells(history.collection.centred(), count, grid)
    named = {name: [history.of_look(number, looks.count, looks.sign)] for number, name in enumerate(looks.names)}
    return Members("look", named, (history,), looks.notes)


def focus_members(
    focus: Focus, members: Members, folder: Place, settings: Settings, progress: Progress | None, client: Client | None
) -> RunReport:
    """Focus all channels or looks; an unfinished run of these is resumed where possible, even with `overwrite`.

    Parameters
    ----------
    focus : callable
        Focuses one of them: focus(source, folder, settings, progress=, client=, track=, following=number).
    folder : Place
        Of the whole.
    settings : Settings
    progress, client
        As for `blocksar.focus`.

    Raises
    ------
    InputError, ProcessingError
        As `focus` does.
    """
    if settings.overwrite and run_folder.is_begun(folder, members.unfinished()):
        try:
            return _focus_members(focus, members, folder, replace(settings, overwrite=False), progress, client)
        except FolderError as error:  # one of them has other settings, or is damaged
            if not error.replaceable:
                raise
    return _focus_members(focus, members, folder, settings, progress, client)


def _focus_members(
    focus: Focus, members: Members, folder: Place, settings: Settings, progress: Progress | None, client: Client | None
) -> RunReport:
    names, kinds = members.names, f"{members.dimension}s"
    if settings.performance_report is not None:
        raise InputError(f"performance_report covers one run, but each of the {kinds} is one; leave it out")
    shared = settings
    if members.dimension == "look":  # their beams differ, but not the ground that they show
        grid = image_grid(members.whole[0].collection.centred(), settings.points)
        shared = replace(settings, grid=grid, whole_pulses=settings.whole_pulses or settings.grid is None)

    track = TrackPlace.of(folder / run_folder.TRACK, members.whole) if settings.autofocus else None

    def focus_one(name: str) -> RunReport:
        try:
            left = names[names.index(name) + 1 :]
            following = sum(not _is_finished(members.folder(folder, other)) for other in left)
            return focus(
                members.histories[name], members.folder(folder, name), shared, progress=progress, client=client,
                track=track, following=following,
            )  # fmt: skip
        except FolderError:  # names the folder
            raise
        except InputError as error:
            raise InputError(f"{members.dimension} {name}: {error}") from error

    _refuse_empty(members)
    there = folder.exists()
    fresh = not (there and RECORD in folder.names())
    earlier = _earlier(folder, members.dimension, overwrite=settings.overwrite)
    if settings.dry_run:
        return _rehearse(members, focus_one)
    with ExitStack() as stack:
        if fresh:
            stack.enter_context(_nothing_left(folder, there=there))
        stack.enter_context(run_folder.claim(folder))
        stack.enter_context(run_folder.resumable())
        if track is not None:
            stack.enter_context(track.removed_if_wrong())
        input_read = stack.enter_context(run_folder.begin(folder, resumed=not settings.overwrite))
        if earlier is None:
            members.unfinished().write(folder)
            shared, client = stack.enter_context(_own_workers(folder, shared, progress, client))
        before = [name for name in names if earlier is None and _is_finished(members.folder(folder, name))]
        reports = {name: focus_one(name) for name in names}
        input_read()
        folders = {name: members.folder(folder, name) for name in names}
        records = {name: RunRecord.read(path) for name, path in folders.items()}
        if earlier is not None and earlier.identity == _identity(records):
            run_folder.check_unchanged(folder, earlier)
            if not run_folder.is_tidy(folder):
                run_folder.tidy(folder)
            done = f"{folder} is finished already with these settings and this input: nothing to do"
            return RunReport(summary=[done], result=earlier.as_json(), folder=folder, measurable=is_measurable(earlier))
        for name in before:  # whose image becomes a part of the whole one without being read
            run_folder.check_unchanged(folders[name], records[name], every=True)
        record = _join(folder, members.dimension, members.path, folders, records)
        run_folder.finish(folder, record)
    lines = [f"{name}: {line}" for name, report in reports.items() for line in report.summary]
    whole = f"{folder / 'image.zarr'} has the images of {len(names)} {kinds} ({', '.join(names)})"
    summary = [*lines, *members.notes, whole]
    return RunReport(summary=summary, result=record.as_json(), folder=folder, measurable=is_measurable(record))


def _rehearse(members: Members, focus_one: Callable[[str], RunReport]) -> RunReport:
    """Report what `focus` would do: for every look, or for the first channel, whose plan holds for all."""
    names, kinds = members.names, f"{members.dimension}s"
    if members.dimension == "channel":
        first = focus_one(names[0])
        return replace(first, summary=[f"{len(names)} {kinds} ({', '.join(names)}), each as follows", *first.summary])
    found = {name: focus_one(name) for name in names}
    lines = [f"{name}: {line}" for name, report in found.items() for line in report.summary if line != NOTHING_DONE]
    some = any(NOTHING_DONE in report.summary for report in found.values())
    return RunReport(
        tables=[name_rows(name, table) for name, report in found.items() for table in report.tables],
        details=[name_rows(name, table) for name, report in found.items() for table in report.details],
        summary=[
            *members.notes,
            f"{len(names)} {kinds} ({', '.join(names)}), one after the other",
            *lines,
            *([NOTHING_DONE] if some else []),
        ],
        result=tuple(chain.from_iterable(map(_plans_of, found.values()))) or None,
    )


def _plans_of(report: RunReport) -> tuple[Any, ...]:
    """Return the plans of a rehearsed run; none for back-projection, or if nothing is left to do."""
    if report.result is None:
        return ()
    return report.result if isinstance(report.result, tuple) else (report.result,)


@contextmanager
def _own_workers(
    folder: Place, settings: Settings, progress: Progress | None, client: Client | None
) -> Iterator[tuple[Settings, Client | None]]:
    """Start a local cluster for all members, if they are to have one: it, and the settings with which it is used."""
    if client is not None or settings.scheduler is not None or settings.workers == 0:
        yield settings, client
        return
    machine = resources(settings.workers, settings.threads, settings.memory_limit)
    checked_memory("a worker without samples", PROCESS_MEMORY, machine.memory_limit)  # or dask kills it for ever
    scratch, listener = run_folder.scratch(folder), as_listener(progress)
    try:
        with cluster.open_client(**machine._asdict(), scratch=scratch, listener=listener) as own:
            yield replace(settings, workers=None, threads=machine.threads, memory_limit=None), own
    finally:
        (folder / run_folder.SCRATCH).remove()


def _refuse_empty(members: Members) -> None:
    """Raise an InputError if a member has no valid sample, before others are focused and an earlier run is replaced."""
    for name, histories in members.histories.items():
        for history in histories:
            n_pulse, n_column = history.shape
            zeros = False
            for at in range(0, n_pulse, TILE[0]):
                part = history.read(slice(at, min(at + TILE[0], n_pulse)), slice(0, n_column))
                finite = np.isfinite(part)
                if (finite & (part != 0)).any():
                    break
                zeros |= bool(finite.any())
            else:
                raise InputError(f"{members.dimension} {name}: {without_samples(history, zeros=zeros)}")


@contextmanager
def _nothing_left(folder: Place, *, there: bool) -> Iterator[None]:
    """Remove the files of a new run if its input proves wrong, and the folder if the run created it."""
    try:
        yield
    except InputError as error:
        if isinstance(error, FolderError) and not isinstance(error, NoRoom):  # the folder may belong to another run
            raise
        if folder.exists():
            with run_folder.claim(folder):
                run_folder.clear(folder)
            if not there and not folder.names():
                folder.remove()
        raise


def _earlier(folder: Place, dimension: str, *, overwrite: bool) -> RunRecord | None:
    """Return the record of a finished run of channels or looks that stays; None if there is none.

    Raises
    ------
    FolderError
        If the folder holds something else, or a run without these.
    """
    names = folder.names() if folder.exists() else []
    run_folder.refuse_links(folder)
    if RECORD not in names:
        known = set(run_folder.OWN) - {run_folder.SCRATCH}
        if foreign := [name for name in run_folder.foreign_names(folder, names) if name not in known]:
            raise FolderError(f"{folder} exists and holds no run of blocksar (but {foreign[0]}); choose another --out")
        return None
    if overwrite:
        return None
    record = RunRecord.read(folder)
    if record.channels and record.dimension == dimension:
        return record if record.finished else None
    raise FolderError(
        f"{folder} holds a run without {dimension}s; use --overwrite to replace it, or another --out",
        replaceable=True,
    )


def _is_finished(folder: Place) -> bool:
    """Whether a folder holds the record of a finished run."""
    with suppress(InputError):
        return RunRecord.read(folder).finished
    return False


def _identity(records: Mapping[str, RunRecord]) -> str:
    """Hash everything that the channels' images depend on."""
    return stores.checksum_bytes(repr([(name, record.identity) for name, record in records.items()]).encode())


def _join(
    folder: Place, dimension: str, source: str, members: Mapping[str, Place], records: Mapping[str, RunRecord]
) -> RunRecord:
    """Assemble the image of all channels from their own images, and write the record of the whole."""
    started = time.perf_counter()
    first, image = next(iter(members.values())), folder / "image.zarr"
    x, y = (stores.read_region(first / "image.zarr", name, (slice(None),)) for name in ("x", "y"))
    own = [name for name in OWN if all((path / "image.zarr" / name).exists() for path in members.values())]
    same = [name for name in SAME if (first / "image.zarr" / name).exists()]
    schema = stores.with_channels({
        name: {**stores.IMAGE, **stores.COLLECTION_NUMBER, **stores.NOISE, **stores.ON_TERRAIN}[name]
        for name in (*own, *same, "x", "y")
    }, *own, dimension=dimension)  # fmt: skip
    side = stores.chunk_shape(first / "image.zarr", "image")
    attrs = _attributes(first)
    pyramid, levels = stores.Pyramid({}, {}), len(stores.level_shapes((y.size, x.size)))
    if levels and all(stores.levels_of(path / "image.zarr") == levels for path in members.values()):
        frame = Georeference.among(attrs)
        projection = None if frame is None else frame.map_projection(attrs["ground_height"])
        pyramid = stores.pyramid_of(x, y, projection, members=tuple(members), dimension=dimension)
        own += map(stores.level_name, range(1, levels + 1))
    written: dict[str, list[Written]] = {name: [] for name in members}

    def fill(made: Place) -> None:
        for number, (name, path) in enumerate(members.items()):
            for variable in (*own, *(same if number == 0 else ())):
                lead = (slice(number, number + 1),) if variable in own else ()
                for part in _parts(records[name], variable):
                    written[name].append(share_chunk(path / "image.zarr", made, part, lead))

    stores.create(
        image, schema, sizes={}, coords={"x": x, "y": y, dimension: np.asarray(list(members), "T")},
        attrs=attrs | pyramid.attrs, chunks={dimension: 1, "y": side[0], "x": side[1]}, overwrite=True, fill=fill,
        groups=pyramid.groups,
    )  # fmt: skip
    identity = _identity(records)
    base = next(iter(records.values()))
    receipts = tuple(
        Receipt(unit=f"join-{name}", stage="join", run=identity, written=tuple(parts))
        for name, parts in written.items()
    )
    stages = {stage: sum(r.timings.get(stage, 0.0) for r in records.values()) for stage in base.timings}
    return replace(
        base, status=FINISHED, channels=tuple(members), dimension=dimension, identity=identity, receipts=receipts,
        input=RunInput(source, joint_fingerprint([r.input.fingerprint for r in records.values()])),
        warnings=tuple(f"{name}: {line}" for name, record in records.items() for line in record.warnings),
        timings={**stages, "join": time.perf_counter() - started},
        peak_memory=max(record.peak_memory or 0 for record in records.values()),
    )  # fmt: skip


def _parts(record: RunRecord, variable: str) -> Iterator[Written]:
    """Iterate over the chunks that a run wrote of one variable of its image."""
    for receipt in record.receipts:
        yield from (part for part in receipt.written if part.store == "image.zarr" and part.variable == variable)


def share_chunk(source: Place, image: Place, part: Written, lead: tuple[slice, ...]) -> Written:
    """Put chunks of a channel's image into that of all channels: linked, or copied where that is impossible."""
    region = tuple(slice(*span) for span in part.region)
    target = (*lead, *region)
    if not stores.share_region(image, part.variable, target, source=source, source_region=region):
        values = stores.read_region(source, part.variable, region)
        stores.write_region(image, part.variable, target, values[None] if lead else values)
    return replace(part, region=(*((s.start, s.stop) for s in lead), *part.region))


def _attributes(member: Place) -> dict[str, Any]:
    """Attributes of a channel's image that hold for all channels."""
    attrs = stores.open_dataset(member / "image.zarr").attrs
    return {name: value for name, value in attrs.items() if name not in NOT_SHARED and ":" not in name}
