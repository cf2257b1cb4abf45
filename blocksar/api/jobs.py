"""A run before it starts: the request of a user, its settings, its plan, and the first state of its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import metadata
from typing import Any, Literal

from blocksar import stores
from blocksar.api.arguments import (
    One,
    OnGround,
    Source,
    check_one_frame,
    control_points,
    history_of,
    on_ground,
    sources_of,
)
from blocksar.api.exact_way import naming_exact
from blocksar.api.fingerprints import joint_fingerprint
from blocksar.api.ground import PLANE, check_ground, geometry_over, ground_settings, read_ground
from blocksar.api.partial_pulses import imaging_parts, pulses_of
from blocksar.api.settings import Settings
from blocksar.api.surroundings import read_surroundings
from blocksar.api.track_places import TrackPlace
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.errors import FolderError, InputError, ProcessingError, Unfocusable, changes_while_read
from blocksar.focusing.method import Method
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.range_compression import RawCompression
from blocksar.graph.machine import Resources
from blocksar.graph.segments import Segment
from blocksar.ingestion.terrain.reading import Ground
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.planning import effort
from blocksar.planning.memory import checked_back_projection_memory, checked_memory, compression_memory
from blocksar.planning.plan import Plan
from blocksar.planning.planner import planner_of
from blocksar.planning.segments import Divided, joint_grid, plan_segments
from blocksar.progress import Work
from blocksar.runs import folder as run_folder
from blocksar.runs.record import FORMAT, UNFINISHED, PredictedBlock, RunPlan, RunRecord
from blocksar.runs.sources import RunInput, RunSegment
from blocksar.version import __version__


@dataclass(frozen=True, kw_only=True)
class Request:
    """Phase histories to be focused into a folder, and how.

    Attributes
    ----------
    histories : tuple of PhaseHistory
        Of one frame, if there are several.
    method : Method or None
        None for back-projection.
    blocks : int or "auto"
        Number of angular blocks.
    fidelity : float
        Coherence that "auto" keeps.
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
    whole_pulses : bool
        Of raw echoes, whether only ground with whole pulses is imaged.
    overwrite : bool
        Whether to replace a run of other settings or another input.
    discard : bool
        Whether to remove spectra and patches once nothing reads them.
    track : TrackPlace or None
        Where the track is corrected first; None: it is taken as it is.
    control : sequence of Target
        Points that anchor it.
    """

    histories: tuple[stores.PhaseHistory, ...]
    folder: Place
    method: Method | None
    blocks: int | Literal["auto"]
    fidelity: float
    weighting: Weighting
    grid: Grid | None
    fingerprints: tuple[str, ...]
    overwrite: bool
    whole_pulses: bool = False
    discard: bool = False
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
        method, grid, ground, whole_pulses = settings.method, settings.points, settings.ground, settings.whole_pulses
        height, autofocus, weighting = settings.ground_height, settings.autofocus, settings.tapers
        control = control_points(settings.control, source, height, used=autofocus)
        sources = sources_of(source)
        over = partial(on_ground, height=height, terrain=ground.terrain)
        opened = [_open(each, over, folder, i if len(sources) > 1 else None) for i, each in enumerate(sources)]
        histories = tuple(history for history, _ in opened)
        check_one_frame(histories)
        for history in histories:
            if not isinstance(history, stores.DatasetHistory):
                run_folder.refuse_overlap(place(history.path), folder)
        histories = imaging_parts(histories, grid, whole_pulses=whole_pulses)
        centred = [history.collection.centred() for history in histories]
        check_ground(centred, grid, any_grid=method is None or not ground.plane)
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
            histories=histories, folder=folder, method=method, blocks=settings.blocks, fidelity=settings.fidelity,
            weighting=weighting, grid=grid, fingerprints=fingerprints, overwrite=settings.overwrite,
            whole_pulses=whole_pulses, discard=settings.discard, ground=ground, terrain=terrain, surroundings=around,
            track=track, control=control,
        )  # fmt: skip

    @property
    def history(self) -> stores.PhaseHistory:
        """The first phase history: its attributes are the image's."""
        return self.histories[0]

    @property
    def fingerprint(self) -> str:
        """That of the phase history, or of all of them."""
        return joint_fingerprint(self.fingerprints)

    @property
    def settings(self) -> dict[str, Any]:
        """The settings, as run.json holds them."""
        exact = Method().as_settings() | {"processor": "backprojection"}
        return {
            **(exact if self.method is None else self.method.as_settings()),
            "blocks": self.blocks,
            "fidelity": self.fidelity,
            "weighting_range": self.weighting.range.text,
            "weighting_azimuth": self.weighting.azimuth.text,
            "grid": None if self.grid is None else list(grid_numbers(self.grid)),
            **ground_settings(self.ground, self.terrain, self.surroundings),
            # Not in runs without them, also those of earlier versions.
            **({} if self.history.ground_height is None else {"ground_height": self.history.ground_height}),
            **(self.track.settings(self.fingerprint) if self.track is not None else {}),
            **({"control": records_of(self.control)} if self.control else {}),
            **({} if (pulses := pulses_of(self.histories)) is None else {"pulses": pulses}),
        }

    def identity(self, division: Division) -> str:
        """Hash everything that the results depend on."""
        text = repr((FORMAT, sorted(self.settings.items(), key=str), self.fingerprint, division))
        return stores.checksum_bytes(text.encode("utf-8", "surrogateescape"))

    def find_run(self) -> RunRecord | None:
        """Return the record of the run to be resumed, or of a finished one; see `folder.find_run`.

        Raises
        ------
        FolderError
            As it does, and if an unfinished run's division is not the one that it began with.
        """
        record = run_folder.find_run(self.folder, self.settings, self.fingerprint, overwrite=self.overwrite)
        if record is None or record.finished:
            return record
        if record.identity != self.identity(division_of(record, exact=self.method is None)):
            raise FolderError(
                f"{self.folder} is damaged: its run.json does not have the plan that the run began with; use "
                "--overwrite to begin it again",
                replaceable=True,
            )
        return record


# What of a plan the results depend on: numbers of blocks, and of parts of each; None for back-projection. Of several
# segments, one entry for each.
Division = tuple[Any, ...] | None


def division_of(record: RunRecord, *, exact: bool) -> Division:
    """The division that a run began with."""
    if record.segments:
        return tuple((s.collection, s.pulses, s.blocks, s.parts) for s in record.segments)
    return None if exact else (record.plan.blocks, record.plan.parts)


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
    first_blocks : tuple of int
        Number of the first block of each.
    memory : int
        Predicted peak memory of a worker, bytes.
    """

    request: Request
    grid: Grid
    machine: Resources
    segments: tuple[Segment, ...]
    first_blocks: tuple[int, ...]
    memory: int

    @property
    def history(self) -> stores.PhaseHistory:
        """The first phase history: its attributes are the image's."""
        return self.request.history

    @property
    def exact(self) -> bool:
        """Whether the image is formed by back-projection."""
        return self.request.method is None

    @property
    def plans(self) -> list[Plan]:
        """The plans of the segments; none for back-projection."""
        return [segment.plan for segment in self.segments if segment.plan is not None]

    @classmethod
    def of(cls, request: Request, earlier: RunRecord | None, machine: Resources) -> Job:
        """Plan a run; a resumed one keeps its division into blocks.

        Raises
        ------
        InputError
            If there is no such plan, or it needs more memory than there is.
        """
        compression = max(
            checked_memory(
                "range compression", compression_memory(history.collection, history.raw), machine.memory_limit
            )
            for history in request.histories
        )
        collections = [history.collection.centred() for history in request.histories]
        if request.method is None:
            return cls._of_backprojection(request, collections, machine, compression)

        plan = planner_of(
            request.method, blocks=request.blocks, fidelity=request.fidelity, weighting=request.weighting,
            terrain=request.terrain, workers=machine.workers, memory_limit=machine.memory_limit,
        )  # fmt: skip
        grid = request.grid
        if request.terrain is not None:  # the grid that its heights were read for
            grid = grid or joint_grid([Geometry(collection=collection) for collection in collections])
        with naming_exact(collections, grid, machine):
            planned = plan_segments(plan, collections, grid=grid, cut=request.blocks == "auto", like=_divided(earlier))
            if (refusal := next(filter(None, (each.plan.refusal for each in planned)), None)) is not None:
                raise Unfocusable(refusal)
        several = len(planned) > 1 or len(collections) > 1
        segments = tuple(
            Segment(
                number=number if several else None,
                collection=each.collection if len(collections) > 1 else None,
                source=request.histories[each.collection],
                pulses=each.pulses,
                geometry=each.plan.geometry,
                plan=each.plan,
            )
            for number, each in enumerate(planned)
        )
        return cls(
            request=request, grid=planned[0].plan.grid, machine=machine, segments=segments,
            first_blocks=tuple(each.first_block for each in planned),
            memory=max(compression, *(each.plan.memory_of(machine.threads) for each in planned)),
        )  # fmt: skip

    @classmethod
    def _of_backprojection(
        cls, request: Request, collections: list[Collection], machine: Resources, compression: int
    ) -> Job:
        grid = request.grid or joint_grid([Geometry(collection=collection) for collection in collections])
        geometries = [geometry_over(collection, request.terrain) for collection in collections]
        several = len(geometries) > 1
        segments = tuple(
            Segment(
                number=number if several else None, collection=number if several else None,
                source=request.histories[number], geometry=geometry, plan=None,
            )
            for number, geometry in enumerate(geometries)
        )  # fmt: skip
        needed = [
            checked_back_projection_memory(collection, grid, machine.threads, machine.memory_limit)
            for collection in collections
        ]
        return cls(
            request=request, grid=grid, machine=machine, segments=segments, first_blocks=tuple(range(len(segments))),
            memory=max(compression, *needed),
        )  # fmt: skip

    def left_out(self) -> list[str]:
        """A sentence on collections that cover nothing of the grid, if there are any."""
        used = {segment.collection or 0 for segment in self.segments}
        paths = [str(history.path) for number, history in enumerate(self.request.histories) if number not in used]
        return [f"{', '.join(paths)} {'covers' if len(paths) == 1 else 'cover'} nothing of the grid"] if paths else []

    def with_stored_input(self) -> Job:
        """The same job with its samples in a store: those in memory are written into the run folder, once.

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
        """The noise of the image in each segment; None unless that of the samples is known in all of them.

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
        works = []
        for segment in self.segments:
            echo = echoes.pop(segment.collection, 0)  # of several segments, with the first
            if segment.plan is None:
                works.append(effort.of_backprojection(segment.geometry, self.grid, echo_samples=echo))
            else:
                works.append(effort.of_plan(segment.plan, echo_samples=echo, workers=self.machine.workers))
        return effort.together(works)

    def _run_segments(self) -> tuple[RunSegment, ...]:
        """The segments for the record; none in a run of one."""
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
                first_block=first,
            )
            for index, segment, first in zip(indices, self.segments, self.first_blocks, strict=True)
        )

    def record(self) -> RunRecord:
        """Return the record of the run at its start."""
        request, plans = self.request, self.plans
        record = RunRecord(
            status=UNFINISHED,
            format=FORMAT,
            settings=request.settings,
            input=RunInput(str(request.history.path), request.fingerprint),
            segments=self._run_segments(),
            versions=_versions(),
            **self.machine._asdict(),
            plan=RunPlan(
                blocks=sum(plan.n_blocks for plan in plans) or None,
                parts=max((plan.parts for plan in plans), default=None),
                memory=self.memory,
                grid=grid_numbers(self.grid),
                predicted=tuple(block for plan in plans for block in predicted_blocks(plan)),
            ),
        )
        return replace(record, identity=request.identity(division_of(record, exact=self.exact)))


def _divided(earlier: RunRecord | None) -> tuple[Divided, ...] | None:
    """How an earlier process divided what is to be resumed."""
    if earlier is None:
        return None
    if earlier.segments:
        return tuple(Divided(s.collection, s.pulses, s.blocks or 1, s.parts or 1) for s in earlier.segments)
    if earlier.plan.blocks is None:
        return None
    return (Divided(0, None, earlier.plan.blocks, earlier.plan.parts or 1),)


def records_of(control: Sequence[Target]) -> list[list[str | float]]:
    """Control points as settings hold them: name, x, y, real and imaginary part of the reflectivity, z if given."""
    return [
        [t.name, t.x, t.y, t.reflectivity.real, t.reflectivity.imag, *([] if t.z is None else [t.z])] for t in control
    ]


def predicted_blocks(plan: Plan) -> tuple[PredictedBlock, ...]:
    """Return what the plan predicts of each block."""
    return tuple(
        PredictedBlock(
            block=block.index,
            part=block.part,
            yaw=(block.low, block.high),
            range=(block.ground.near, block.ground.far),
            memory=block.memory,
            bias=block.choice.candidate.bias,
            **block.prediction._asdict(),
        )
        for block in plan.blocks
    )


def grid_numbers(grid: Grid) -> tuple[float, ...]:
    """Return a grid as run.json holds it."""
    return grid.x0, grid.x1, grid.dx, grid.y0, grid.y1, grid.dy


@lru_cache(maxsize=1)
def _versions() -> Mapping[str, str]:
    names = ("numpy", "scipy", "numba", "dask", "zarr", "xarray")
    return {"blocksar": __version__} | {name: metadata.version(name) for name in names}
