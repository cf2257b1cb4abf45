"""The estimate of a track's error, as `autofocus` and `focus` make it: its identity, its folder, its figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.application.ground import PLANE, ground_settings
from blocksar.application.jobs import Request, grid_numbers, records_of
from blocksar.application.track_places import TrackPlace, channels_of_track, joint_fingerprint
from blocksar.autofocusing.anchoring import Control
from blocksar.autofocusing.estimation import LEAST_LOOPS
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.work import begin
from blocksar.chunks import stored_bytes
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.errors import FolderError, InputError, ProcessingError, changes_while_read
from blocksar.graph import cluster, compiling
from blocksar.graph.machine import Resources
from blocksar.graph.units import Executor, OnCluster
from blocksar.imaging.method import Cutting
from blocksar.measurement.targets import Target
from blocksar.places.place import Place
from blocksar.planning.memory import checked_memory
from blocksar.planning.stage_memory import compression_memory, interference_memory, track_memory
from blocksar.progress import Listener
from blocksar.readers.heights import Ground
from blocksar.runs import folder as run_folder
from blocksar.runs.receipts import Run
from blocksar.runs.record import RECORD, Receipt
from blocksar.runs.track import ATTRIBUTE, SHOWN, TrackCorrection, levels
from blocksar.tasks.track_stages import Estimated, estimate_track, tie_tracks
from blocksar.texts import count, size_text
from blocksar.version import __version__

FORMAT = 4  # of the folder of an estimate


@dataclass(frozen=True, kw_only=True)
class TrackEstimate:
    """A phase history whose track is to be corrected, and how.

    Attributes
    ----------
    channels : tuple of PhaseHistory
        Its channels, pinned, as `TrackPlace.channels` has them.
    folder : Place
        For receipts and what they vouch for.
    fingerprint : str
        Of all of them.
    grid : Grid or None
        Ground in which points are looked for; None: the lit sector.
    control : sequence of Target
        Points at known places, which anchor the track.
    ground : Ground
        What the user says of the ground.
    terrain : Terrain or None
        The ground itself, on which points stand; None for the plane.
    interference : str or None
        How it is cut from the samples first.
    """

    channels: tuple[stores.PhaseHistory, ...]
    folder: Place
    fingerprint: str
    grid: Grid | None
    control: Sequence[Target] = ()
    ground: Ground = PLANE
    terrain: Terrain | None = None
    interference: Cutting | None = None

    @property
    def history(self) -> stores.PhaseHistory:
        """The first channel: all have its collection."""
        return self.channels[0]

    @property
    def settings(self) -> dict[str, Any]:
        grid = None if self.grid is None else list(grid_numbers(self.grid))
        uneven = {} if self.terrain is None else ground_settings(self.ground, self.terrain, None)
        cut = {} if self.interference is None else {"interference": self.interference}
        return {"grid": grid, "control": records_of(self.control) or None, **uneven, **cut}

    @property
    def geometry(self) -> Geometry:
        return over_terrain(self.history.collection.centred(), self.terrain)

    @property
    def identity(self) -> str:
        """Hash of everything that the corrected track depends on."""
        text = repr((FORMAT, __version__, sorted(self.settings.items()), self.fingerprint))
        return stores.checksum_bytes(text.encode("utf-8", "surrogateescape"))

    @property
    def key(self) -> tuple[str, str]:
        """Return a key that distinguishes estimates by folder and identity, also of equal collections."""
        return str(self.folder), self.identity

    def run(self, threads: int) -> Run:
        return Run(folder=self.folder, identity=self.identity, threads=threads)

    def checked_memory(self, machine: Resources) -> int:
        """Predicted peak memory of a worker, bytes.

        Raises
        ------
        InputError
            If the limit does not hold it, or the collection cannot serve.
        """
        collection, raw = self.history.collection, self.history.raw
        work = begin(self.geometry, self.grid)
        pulses = max(block.stop - block.start for block in (*work.blocks, *work.apertures))
        needed = max(
            track_memory(collection, pulses, work.chip_bytes(len(self.control))), compression_memory(collection, raw)
        ) + (0 if self.interference is None else interference_memory(collection))
        return checked_memory("autofocus", needed, machine.memory_limit)

    def room(self, store: int = 0) -> int:
        """Return the bytes that must be free for an estimate in its folder, besides the files there.

        They are for samples that are written or compressed first, for the chips of the loops that are always made, and
        for the bytes of a corrected `store`.
        """
        pulses, columns = self.history.shape
        written = stored_bytes((pulses, columns)) if isinstance(self.history, stores.DatasetHistory) else 0
        raw, compressed = self.history.raw, stored_bytes((pulses, self.history.collection.n_range_frequency))
        chips = LEAST_LOOPS * begin(self.geometry, self.grid).chip_bytes(len(self.control))
        first = written + (0 if raw is None and self.interference is None else compressed * len(self.channels))
        return max(first + chips + store - self.folder.taken(), 0)

    @contextmanager
    def opened(self, machine: Resources, executor: Executor | None, listener: Listener) -> Iterator[Executor]:
        """Yield an executor: the one given, or a new local cluster with its temporary files in the folder."""
        if executor is not None:
            yield executor
            return
        compiling.compile_missing(compiling.TRACKS)
        scratch = run_folder.scratch(self.folder)
        with cluster.open_client(**machine._asdict(), scratch=scratch, listener=listener) as own:
            yield OnCluster(own, listener)

    def carry_out(self, executor: Executor, machine: Resources, *, local: bool) -> Estimated:
        """Estimate the track in the folder, or go on with an estimate there.

        With a `local` cluster of its own, a task that runs alone has the threads of all workers.

        Raises
        ------
        InputError
            If the samples do not tell of the track's error.
        """
        self._begin()
        control = self._control() if self.control else None
        run, threads = self.run(machine.threads), machine.threads * (machine.workers if local else 1)
        return estimate_track(
            executor, self.stored(), run, self.grid, control, threads, self.terrain, self.interference
        )

    def _control(self) -> Control:
        """The control points; those without a height of their own stand on the ground."""
        x, y = (np.array([getattr(point, axis) for point in self.control]) for axis in "xy")
        z = np.array([np.nan if point.z is None else point.z for point in self.control])
        z = np.where(np.isnan(z), self.geometry.height(x, y), z)
        for point, height in zip(self.control, z, strict=True):
            if np.isnan(height):
                raise InputError(f"control point {point.name} has no z, and the terrain has no height there; give one")
        phase = np.angle([point.reflectivity for point in self.control])
        return Control(names=tuple(point.name for point in self.control), x=x, y=y, z=z, phase=phase)

    def stored(self) -> tuple[stores.PhaseHistory, ...]:
        """The channels in a store: samples in memory are written into the folder, once.

        Raises
        ------
        ProcessingError
            If they cannot be written.
        """
        if not isinstance(self.history, stores.DatasetHistory):
            return self.channels
        try:
            return channels_of_track(self.history.stored(self.folder / run_folder.INPUT))
        except InputError as error:  # about the own store, not about the input
            raise ProcessingError(str(error)) from error

    def check_unchanged(self) -> None:
        """Check that a store has not changed since the track was estimated from it.

        Raises
        ------
        InputError
            If it is not.
        """
        if isinstance(self.history, stores.DatasetHistory):
            return
        if joint_fingerprint([channel.opened_again().fingerprint() for channel in self.channels]) != self.fingerprint:
            raise changes_while_read(self.history.path)

    def _begin(self) -> None:
        """Clear the folder of other estimates' files, and record this one."""
        record = None
        with suppress(InputError):  # there is none, or it is damaged
            record = stores.read_json(self.folder / RECORD)
        if isinstance(record, Mapping) and record.get("identity") == self.identity:
            return
        run_folder.clear_estimate(self.folder)
        stores.write_json(self.folder / RECORD, {"identity": self.identity, "settings": self.settings})

    def attribute(self, result: Result) -> dict[str, Any]:
        """Return the attribute `autofocus` that describes the correction."""
        shown = np.unique(np.linspace(0, result.time.size - 1, SHOWN).round().astype(int))
        before, after = levels(result.chips_before, result.chips_after)
        correction = TrackCorrection(
            figures=result.figures, identity=self.identity, settings=self.settings, time=result.time[shown],
            error=result.track_error[shown], uncertainty=result.uncertainty[shown], before=before, after=after,
            places=np.stack([result.x, result.y], axis=1),
        )  # fmt: skip
        return correction.as_json()

    def corrected(self, history: stores.PhaseHistory, result: Result) -> Collection:
        """The collection of a channel, or of a look at it, with the corrected track."""
        whole = self.history if history.look is not None else history
        band = {name: getattr(history.collection, name) for name in ("range_frequency", "recorded")}
        moved = Collection(**{**whole.collection.as_dict(), **band, "antenna_position": result.antenna_position})
        if history.look is None or history.look == self.history.look:
            return moved
        return replace(whole, collection=moved).of_look(*history.look).collection

    def summary(self, receipts: Sequence[Receipt], attribute: Mapping[str, Any], memory: int) -> list[str]:
        """Sentences on the correction, on resumed work and on memory; `memory` is the planned peak, bytes."""
        reused = sum(receipt.reused for receipt in receipts)
        resumed = [f"went on from an unfinished estimate: {reused} of {count(len(receipts), 'unit')} used again"]
        peak = max((receipt.peak_memory or 0 for receipt in receipts), default=0)
        return [
            *TrackCorrection.of(attribute, str(self.history.path)).sentences(),
            *(resumed if reused else []),
            f"peak memory of a worker {size_text(peak)}, planned {size_text(memory)}",
        ]


@contextmanager
def track_corrected(
    request: Request, machine: Resources, executor: Executor | None, listener: Listener
) -> Iterator[tuple[Request, list[str], Executor | None]]:
    """Correct the track of a run's input, in the request's `TrackPlace`; yield the request, sentences and an executor.

    The executor is the local cluster which the correction started, if it needed one: the run goes on with it. The
    folder stays until the run is finished, for runs that are resumed; an InputError removes it.

    Raises
    ------
    InputError
        If the samples do not tell of the track's error.
    ProcessingError
        If processing fails.
    """
    local, place = executor is None, request.track
    assert place is not None
    with ExitStack() as stack:
        stack.enter_context(place.removed_if_wrong())
        run_folder.refuse_foreign(place.folder)
        estimates, sentences = estimates_of(request, place), []
        if not all(estimate.key in place.results for estimate in estimates):
            memory = 0
            for estimate in estimates:
                with _named(estimate if len(estimates) > 1 else None):
                    memory = max(memory, estimate.checked_memory(machine))
            with run_folder.resumable():
                executor = stack.enter_context(estimates[0].opened(machine, executor, listener))
                found = []
                for estimate in estimates:
                    with _named(estimate if len(estimates) > 1 else None):
                        found.append(estimate.carry_out(executor, machine, local=local))
                if len(found) > 1 and not request.control:
                    labels = [str(history.path) for history in request.histories]
                    found = tie_tracks(found, labels)
            for estimate, one in zip(estimates, found, strict=True):
                place.results[estimate.key] = one.result
                lines = estimate.summary(one.receipts, estimate.attribute(one.result), memory)
                sentences += lines if len(found) == 1 else [f"{estimate.history.path}: {line}" for line in lines]
        histories = []
        for history, estimate in zip(request.histories, estimates, strict=True):
            result = place.results[estimate.key]
            attrs = {**history.attrs, ATTRIBUTE: estimate.attribute(result)}
            histories.append(replace(history, collection=estimate.corrected(history, result), attrs=attrs))
        yield replace(request, histories=tuple(histories)), sentences, executor


@contextmanager
def _named(estimate: TrackEstimate | None) -> Iterator[None]:
    """Add to an InputError in the block which of several collections it concerns."""
    try:
        yield
    except FolderError:
        raise
    except InputError as error:
        if estimate is None:
            raise
        raise InputError(f"{estimate.history.path}: {error}") from error


def estimates_of(request: Request, place: TrackPlace) -> list[TrackEstimate]:
    """Track estimates of a run: one for all channels, or of each phase history."""
    alone = len(place.channels) == 1
    return [
        TrackEstimate(
            channels=channels,
            folder=place.folder if alone else place.folder / f"{number}",
            fingerprint=fingerprint,
            grid=request.grid,
            control=request.control,
            ground=request.ground,
            terrain=request.terrain,
            interference=request.asked.interference,
        )
        for number, (channels, fingerprint) in enumerate(zip(place.channels, place.fingerprints, strict=True))
    ]
