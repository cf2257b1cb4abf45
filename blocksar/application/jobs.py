"""A run before it starts: the request of a user, its settings, its plan, and the first state of its record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from importlib import metadata
from typing import Any

from blocksar import stores
from blocksar.application.arguments import (
    One,
    OnGround,
    Source,
    check_one_frame,
    control_points,
    history_of,
    on_ground,
    sources_of,
)
from blocksar.application.ground import PLANE, check_ground, ground_settings, read_ground, read_surroundings
from blocksar.application.pulses import imaging_parts, pulses_of
from blocksar.application.settings import Settings
from blocksar.application.track_places import TrackPlace, joint_fingerprint
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.region import joint_grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError, PrfTooLow, ProcessingError, Unfocusable, changes_while_read
from blocksar.graph.machine import Resources
from blocksar.imaging.compression import RawCompression
from blocksar.imaging.interference import check_band
from blocksar.imaging.noise import NoiseMap
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.planning import effort
from blocksar.planning.memory import checked_memory
from blocksar.planning.stage_memory import compression_memory, interference_memory
from blocksar.processors import HIERARCHY, PROCESSORS, device_for, options_for
from blocksar.processors.base import ImagePlan, Problem, check_taken, plan_image
from blocksar.progress import Work
from blocksar.readers.heights import Ground
from blocksar.runs import folder as run_folder
from blocksar.runs import stored_plan
from blocksar.runs.record import FORMAT, UNFINISHED, RunInput, RunPlan, RunRecord, RunSegment
from blocksar.tasks.segments import Segment
from blocksar.version import __version__

FOLDED = f"; hierarchical back-projection takes any PRF, and tells what folds: --processor {HIERARCHY}"
ANY = f"; hierarchical back-projection has no such limit: --processor {HIERARCHY}"


@contextmanager
def naming_hierarchy() -> Iterator[None]:
    """Add to errors about images that no chain can form that hierarchical back-projection can."""
    try:
        yield
    except Unfocusable as error:
        raise InputError(f"{error}{FOLDED if isinstance(error, PrfTooLow) else ANY}") from error


@dataclass(frozen=True, kw_only=True)
class Request:
    """Phase histories to be focused into a folder, and how.

    Attributes
    ----------
    histories : tuple of PhaseHistory
        Of one frame, if there are several.
    asked : Settings
        As the user gave them.
    weighting : Weighting
        Tapers over band and dwell.
    grid : Grid or None
        None to cover the lit sector.
    fingerprints : tuple of str
        Of the phase histories.
    ground : Ground
        What the user says of the ground.
    terrain : Terrain or None
        The ground itself, under the grid; None for the plane.
    surroundings : Terrain or None
        The ground as far as it hides or overlies places of the grid; None if that is under it.
    track : TrackPlace or None
        Where the track is corrected first; None: it is taken as it is.
    control : sequence of Target
        Points that anchor it.
    """

    histories: tuple[stores.PhaseHistory, ...]
    folder: Place
    asked: Settings
    weighting: Weighting
    grid: Grid | None
    fingerprints: tuple[str, ...]
    ground: Ground = PLANE
    terrain: Terrain | None = None
    surroundings: Terrain | None = None
    track: TrackPlace | None = None
    control: Sequence[Target] = ()

    @classmethod
    def open(cls, source: Source, folder: Place, settings: Settings, *, track: TrackPlace | None = None) -> Request:
        """Open the phase histories; nothing is written.

        With autofocus their track is corrected, in the place `track`, by default in the folder.

        Raises
        ------
        InputError
            If there is none, its georeference is wrong, several do not share a frame, or one and the folder lie in each
            other; if the grid is missing or lies outside the swath; the ground cannot be read; or a setting is wrong.
        """
        options_for(settings.processor, settings.options)  # which refuses wrong ones
        grid, asked, whole_pulses = settings.points, settings.ground, settings.whole_pulses
        height, autofocus = settings.ground_height, settings.autofocus
        control = control_points(settings.control, source, height, used=autofocus)
        sources = sources_of(source)
        over = partial(on_ground, height=height, terrain=asked.terrain)
        opened = [_open(each, over, folder, i if len(sources) > 1 else None) for i, each in enumerate(sources)]
        histories = tuple(history for history, _ in opened)
        check_one_frame(histories)
        ground = asked.under(histories[0].attrs)
        for history in histories:
            if not isinstance(history, stores.DatasetHistory):
                run_folder.refuse_overlap(place(history.path), folder)
        histories = imaging_parts(histories, grid, whole_pulses=whole_pulses)
        centred = [history.collection.centred() for history in histories]
        check_taken(PROCESSORS.get(settings.processor), centred)
        if grid is None or ground.plane:  # the ranges of a terrain are not those of the plane
            check_ground(centred, grid, any_grid=PROCESSORS.get(settings.processor).universal)
        terrain, around = None, None
        if not ground.plane:
            under = grid or joint_grid([Geometry(collection=collection) for collection in centred])
            read = [
                read_ground(ground, each, under, history.attrs)
                for each, history in zip(centred, histories, strict=True)
            ]
            terrain = read[0]
            if terrain is not None:
                around = read_surroundings(ground, terrain, centred, under, Georeference.among(histories[0].attrs))
            histories = imaging_parts(histories, grid, terrain, whole_pulses=whole_pulses)
        fingerprints = tuple(fingerprint for _, fingerprint in opened)
        if autofocus and track is None:
            track = TrackPlace.of(folder / run_folder.TRACK, histories, fingerprints)
        return cls(
            histories=histories, folder=folder, asked=settings, weighting=settings.tapers, grid=grid,
            fingerprints=fingerprints, ground=ground, terrain=terrain,
            surroundings=around, track=track, control=control,
        )  # fmt: skip

    def asking(self, **changes: Any) -> Request:
        """Return a copy with other settings; only settings that need no file to be read again may change."""
        return replace(self, asked=replace(self.asked, **changes))

    @property
    def processor(self) -> str:
        """Name of the processor."""
        return self.asked.processor

    @cached_property
    def device(self) -> str:
        """Device of back-projection, "cpu" or "gpu"."""
        return device_for(self.asked.processor, self.asked.device)

    @cached_property
    def options(self) -> Any:
        """Options of the processor; see `processors.options_for`."""
        return options_for(self.asked.processor, self.asked.options)

    @property
    def history(self) -> stores.PhaseHistory:
        """The first phase history: its attributes are the image's."""
        return self.histories[0]

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the phase history, or of all of them."""
        return joint_fingerprint(self.fingerprints)

    @property
    def settings(self) -> dict[str, Any]:
        """The settings, as run.json holds them."""
        return {
            "processor": self.processor,
            **{field.name: getattr(self.options, field.name) for field in fields(self.options)},
            **({} if self.device == "cpu" else {"device": self.device}),
            "blocks": self.asked.blocks,
            "fidelity": self.asked.fidelity,
            "weighting_range": self.weighting.range.text,
            "weighting_azimuth": self.weighting.azimuth.text,
            "grid": None if self.grid is None else list(grid_numbers(self.grid)),
            **ground_settings(self.ground, self.terrain, self.surroundings),
            # Runs without these settings, such as those of earlier versions, do not record them.
            **({} if self.asked.interference is None else {"interference": self.asked.interference}),
            **({} if self.history.ground_height is None else {"ground_height": self.history.ground_height}),
            **(self.track.settings(self.fingerprint) if self.track is not None else {}),
            **({"control": records_of(self.control)} if self.control else {}),
            **({} if (pulses := pulses_of(self.histories)) is None else {"pulses": pulses}),
        }

    def identity(self, plan: RunPlan) -> str:
        """Hash everything that the results depend on."""
        divided = plan.blocks, plan.parts, plan.checksum
        text = repr((FORMAT, sorted(self.settings.items(), key=str), self.fingerprint, divided))
        return stores.checksum_bytes(text.encode("utf-8", "surrogateescape"))

    def find_run(self) -> RunRecord | None:
        """Return the record of the run to be resumed, or of a finished one; see `folder.find_run`.

        Raises
        ------
        FolderError
            As it does, and if an unfinished run's plan is not the one that it began with.
        """
        record = run_folder.find_run(self.folder, self.settings, self.fingerprint, overwrite=self.asked.overwrite)
        if record is None or record.finished:
            return record
        if record.identity != self.identity(record.plan):
            raise stored_plan.damaged(self.folder)
        return record


def _open(source: One, over: OnGround, folder: Place, number: int | None) -> tuple[stores.PhaseHistory, str]:
    """Open a phase history in the state that it has now, over its ground, with its fingerprint.

    One in memory gets the place in the run folder where its samples will be written; `number` is that of several.
    """
    [history] = over([history_of(source).pinned()])
    fingerprint = history.fingerprint()
    if isinstance(history, stores.DatasetHistory):
        if (opened := getattr(source, "encoding", {}).get("source")) is not None:
            run_folder.refuse_overlap(place(opened), folder)  # it may still be read
        own = folder / run_folder.INPUT
        return replace(history, path=own if number is None else own / f"{number}.zarr"), fingerprint
    if not history.opened_again().same(history):
        raise changes_while_read(history.path)
    return history, fingerprint


@dataclass(frozen=True, kw_only=True)
class Job:
    """A request with its plan.

    Attributes
    ----------
    segments : tuple of Segment
        The collection; or collections that cover some of the grid, or parts of them along time.
    packed : bytes
        The plan as it is kept in the run folder.
    memory : int
        Predicted peak memory of a worker, bytes.
    """

    request: Request
    plan: ImagePlan
    machine: Resources
    segments: tuple[Segment, ...]
    packed: bytes
    memory: int

    @property
    def history(self) -> stores.PhaseHistory:
        """The first phase history: its attributes are the image's."""
        return self.request.history

    @property
    def grid(self) -> Grid:
        return self.plan.grid

    @classmethod
    def of(cls, request: Request, earlier: RunRecord | None, machine: Resources) -> Job:
        """Plan a run; a resumed one has the plan that it began with.

        Raises
        ------
        InputError
            If there is no such plan, or it needs more memory than there is.
        FolderError
            If the plan that a run began with is damaged.
        """
        compression = max(_preparation_memory(history, request.asked, machine) for history in request.histories)
        if earlier is None:
            plan = _plan(request, machine)
            packed = stored_plan.pack(plan)
        else:
            PROCESSORS.get(earlier.processor)  # loads what its plan is made of, also where `auto` has chosen it
            plan, packed = stored_plan.read(request.folder, earlier.plan.checksum, ImagePlan)  # type: ignore[type-abstract]
            checked_memory("the plan of the unfinished run", plan.memory(machine.threads), machine.memory_limit)
        several, collections = len(plan.pieces) > 1 or len(request.histories) > 1, len(request.histories)
        segments = tuple(
            Segment(
                number=number if several else None,
                collection=piece.collection if collections > 1 else None,
                source=request.histories[piece.collection],
                pulses=piece.pulses,
                geometry=piece.geometry,
                plan=piece.plan,
                interference=request.asked.interference,
            )
            for number, piece in enumerate(plan.pieces)
        )
        return cls(
            request=request, plan=plan, machine=machine, segments=segments, packed=packed,
            memory=max(compression, plan.memory(machine.threads)),
        )  # fmt: skip

    def left_out(self) -> list[str]:
        """A sentence on collections that cover nothing of the grid, if there are any."""
        used = {segment.collection or 0 for segment in self.segments}
        paths = [str(history.path) for number, history in enumerate(self.request.histories) if number not in used]
        return [f"{', '.join(paths)} {'covers' if len(paths) == 1 else 'cover'} nothing of the grid"] if paths else []

    def with_stored_input(self) -> Job:
        """Copy of the job with its samples in a store: those in memory are written into the run folder, once.

        Tasks read their input by chunks, and a run that is resumed reads the same.

        Raises
        ------
        ProcessingError
            If they cannot be written.
        """
        if not any(isinstance(history, stores.DatasetHistory) for history in self.request.histories):
            return self
        try:
            histories = tuple(
                replace(history.stored(history.path).pinned(), collection=history.collection)
                if isinstance(history, stores.DatasetHistory) else history
                for history in self.request.histories
            )  # fmt: skip
        except InputError as error:  # about the run's own store, not about the input
            raise ProcessingError(str(error)) from error
        segments = tuple(replace(segment, source=histories[segment.collection or 0]) for segment in self.segments)
        return replace(self, request=replace(self.request, histories=histories), segments=segments)

    def noises(self, lit: Sequence[FloatArray]) -> list[NoiseMap | None]:
        """Return the noise map of each segment of the image; None unless the noise of all samples is known.

        `lit` has the valid fraction of each pulse of each segment.
        """
        maps = [self._noise(segment, valid) for segment, valid in zip(self.segments, lit, strict=True)]
        return [None] * len(maps) if None in maps else maps

    def _noise(self, segment: Segment, lit: FloatArray) -> NoiseMap | None:
        raw, collection = segment.source.raw, segment.source.collection
        if not collection.noise_power:
            return None
        spectrum = 1.0 if raw is None else RawCompression.of_echo(raw, collection).noise_spectrum
        return NoiseMap.of(segment.geometry.over(None), self.request.weighting, lit, spectrum)

    def predict_effort(self) -> Work:
        """Predict the relative cost of the stages."""
        histories = {segment.collection: segment.source for segment in self.segments}
        echoes = {
            number: 0
            if history.raw is None
            else RawCompression.of_echo(history.raw, history.collection).length * history.collection.n_pulse
            for number, history in histories.items()
        }
        if self.request.asked.interference is not None:
            echoes = {number: echoes[number] or math.prod(history.shape) for number, history in histories.items()}
        work = dict(self.plan.work())
        last = {"finish": work.pop("finish", ())}
        preparing = effort.of_preparation(
            ((history.collection.n_pulse, echoes[number]) for number, history in histories.items()),
            raw=any(history.raw is not None for history in histories.values()),
        )
        return {**preparing, **work, **effort.of_pyramid(self.grid, self.request.asked.pyramid), **last}

    def _run_segments(self) -> tuple[RunSegment, ...]:
        """Return the segments as the record of the run lists them; empty if there is only one."""
        if self.segments[0].number is None:
            return ()
        indices = [segment.collection or 0 for segment in self.segments]
        return tuple(
            RunSegment(
                collection=index,
                path=str(self.request.histories[index].path),
                fingerprint=self.request.fingerprints[index],
                pulses=segment.pulses,
                blocks=None if segment.plan is None else segment.plan.n_blocks,
                parts=None if segment.plan is None else segment.plan.parts,
                first_block=piece.first_block,
            )
            for index, segment, piece in zip(indices, self.segments, self.plan.pieces, strict=True)
        )

    def record(self) -> RunRecord:
        """Return the record of the run at its start."""
        plans = [piece.plan for piece in self.plan.pieces if piece.plan is not None]
        plan = RunPlan(
            blocks=sum(plan.n_blocks for plan in plans) or None,
            parts=max((plan.parts for plan in plans), default=None),
            memory=self.memory,
            grid=grid_numbers(self.grid),
            predicted=(predicted := self.plan.blocks()),
            coherence=self.plan.coherence if not predicted and self.plan.coherence < 1 else None,
            processor="" if self.plan.processor == self.request.processor else self.plan.processor,
            checksum=stores.checksum_bytes(self.packed),
        )
        return RunRecord(
            status=UNFINISHED,
            format=FORMAT,
            settings=self.request.settings,
            input=RunInput(str(self.request.history.path), self.request.fingerprint),
            segments=self._run_segments(),
            versions=_versions(),
            **self.machine._asdict(),
            plan=plan,
            identity=self.request.identity(plan),
        )


def _preparation_memory(history: stores.PhaseHistory, asked: Settings, machine: Resources) -> int:
    """Return the peak memory, bytes, of a worker that compresses a raw echo or cuts interference; 0 without either.

    Raises
    ------
    InputError
        If the limit does not hold it, or the samples have too few range frequencies.
    """
    collection = history.collection
    memory = compression_memory(collection, history.raw)
    checked_memory("range compression", memory, machine.memory_limit)
    if asked.interference is None:
        return memory
    check_band(collection.n_range_frequency)
    return checked_memory("interference", memory + interference_memory(collection), machine.memory_limit)


def _plan(request: Request, machine: Resources) -> ImagePlan:
    """Plan the image of a request.

    Raises
    ------
    InputError
        If its processor cannot form it.
    """
    collections = [history.collection.centred() for history in request.histories]
    problem = Problem(
        collections=collections, grid=request.grid, terrain=request.terrain, blocks=request.asked.blocks,
        fidelity=request.asked.fidelity, weighting=request.weighting, options=request.options, machine=machine,
        device=request.device,
    )  # fmt: skip
    with naming_hierarchy():
        plan = plan_image(PROCESSORS.get(request.processor), problem)
        if plan.refusal is not None:
            raise Unfocusable(plan.refusal)
    return plan


def records_of(control: Sequence[Target]) -> list[list[str | float]]:
    """Control points as settings hold them: name, x, y, real and imaginary part of the reflectivity, z if given."""
    return [
        [t.name, t.x, t.y, t.reflectivity.real, t.reflectivity.imag, *([] if t.z is None else [t.z])] for t in control
    ]


def grid_numbers(grid: Grid) -> tuple[float, float, float, float, float, float]:
    """Return a grid as run.json holds it."""
    return grid.x0, grid.x1, grid.dx, grid.y0, grid.y1, grid.dy


@lru_cache(maxsize=1)
def _versions() -> Mapping[str, str]:
    names = ("numpy", "scipy", "numba", "dask", "zarr", "xarray")
    return {"blocksar": __version__} | {name: metadata.version(name) for name in names}
