"""Interface of a processor: it plans an image, predicts the cost, and forms the image by units of work."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, runtime_checkable

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import (
    Region,
    check_seen,
    default_grid,
    joint_grid,
    plan_region,
    share_outside,
)
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError
from blocksar.planning import effort
from blocksar.planning.ambiguity import azimuth_ambiguities
from blocksar.planning.disk import exact_bytes
from blocksar.planning.tiling import units_of
from blocksar.progress import Work
from blocksar.table import Table
from blocksar.texts import size_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from blocksar.graph.machine import Resources
    from blocksar.graph.units import Executor
    from blocksar.runs.receipts import Run
    from blocksar.runs.record import PredictedBlock, Receipt
    from blocksar.tasks.forming import Form, FormParts
    from blocksar.tasks.segments import Segment
    from blocksar.tasks.stages import ReadSegment

Window = tuple[slice, slice]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedSegment:
    """A collection, or some pulses of one, that an image is formed from.

    Attributes
    ----------
    collection : int
        Number of the collection.
    pulses : (first, last) or None
        Its pulses first <= p < last; None for all of them.
    geometry : Geometry
        Over the ground of the image.
    plan : object or None
        Of a processor that plans each by itself, as chains do. Its blocks are numbered after those of the segments
        before it: from `first_block` on.
    """

    collection: int
    pulses: tuple[int, int] | None = None
    geometry: Geometry
    plan: Any = None
    first_block: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Input of planning: collections, grid, terrain, and the requested division and fidelity.

    Attributes
    ----------
    collections : sequence of Collection
        Of one frame, centred.
    grid : Grid or None
        None: the ground that they light.
    terrain : Terrain or None
        None: the plane at their height.
    blocks : int or "auto"
        Blocks that are asked for, of processors that have such.
    fidelity : float
        Coherence with exact back-projection that is asked for.
    weighting : Weighting
    options : object
        Of the processor's model of options.
    machine : Resources
    device : "cpu" or "gpu"
        What back-projection runs on.
    """

    collections: Sequence[Collection]
    grid: Grid | None
    terrain: Terrain | None
    blocks: int | Literal["auto"]
    fidelity: float
    weighting: Weighting
    options: Any
    machine: Resources
    device: str = "cpu"

    def with_options(self, options: Any) -> Problem:
        """Copy for another processor; what is known of the ground stays known."""
        other = replace(self, options=options)
        vars(other).update({name: value for name, value in vars(self).items() if name in ("points", "pieces")})
        return other

    @cached_property
    def points(self) -> Grid:
        """The grid, or the box around the ground that they light."""
        return self.grid or joint_grid([Geometry(collection=collection) for collection in self.collections])

    @cached_property
    def pieces(self) -> tuple[PlannedSegment, ...]:
        """Segments for processors that do not divide collections: each collection as a whole, over the ground.

        Raises
        ------
        OutsideSwath
            If none sees any of the grid.
        """
        ground = [over_terrain(each, self.terrain) for each in self.collections]
        check_seen(ground, self.points)
        return tuple(PlannedSegment(collection=i, geometry=each, first_block=i) for i, each in enumerate(ground))


class Bound(NamedTuple):
    """Bounds of what an image by a processor takes and is like, and why it is not planned whole.

    Attributes
    ----------
    reason : str
        In half a sentence, with the figure.
    seconds : float
        The least that a run takes, as `usual_seconds`; 0 where nothing is known.
    coherence : float
        The largest with exact back-projection; 1 where nothing is known.
    faithful : bool
        False where it does not keep the fidelity; True where nothing is known.
    """

    reason: str
    seconds: float = 0.0
    coherence: float = 1.0
    faithful: bool = True


def usual_seconds(work: Work, machine: Resources) -> float:
    """Seconds of a run with as many workers, on a machine whose pace is 1: those by which processors are compared."""
    seconds = effort.seconds_of(work, workers=max(machine.workers, 1), threads=machine.threads, pace=1.0)
    return sum(seconds.values())


class Comparison(NamedTuple):
    """Table of compared processors, and the reason for the choice."""

    reason: str
    table: Table


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ImagePlan(ABC):
    """Plan of an image: how a processor forms it, from metadata alone, before any sample is read.

    It is kept in the run folder, so that a run that is resumed has the very same.

    Attributes
    ----------
    processor : str
        Name of the processor.
    grid : Grid
        The image's points.
    pieces : tuple of PlannedSegment
        Collections that cover some of the grid.
    """

    processor: str
    grid: Grid
    pieces: tuple[PlannedSegment, ...]

    refusal: str | None = None  # why the image cannot be formed, with the figure
    device: str = "cpu"  # or "gpu": what back-projection runs on
    coherence: float = 1.0  # least predicted coherence with exact back-projection
    faithful: bool = True  # whether it keeps the requested fidelity
    compared: Comparison | None = None  # with other processors, where one was chosen

    @abstractmethod
    def memory(self, threads: int) -> int:
        """Predict the peak memory of a worker with `threads` threads, bytes."""

    @abstractmethod
    def work(self) -> Work:
        """Seconds of each stage's units without those of raw echoes: see `planning.effort`."""

    @abstractmethod
    def stored(self) -> dict[str, int]:
        """Return the bytes that a run writes, by store; the image under `image`; see `planning.disk.room_of_run`."""

    def stored_bytes(self) -> int:
        """Return the bytes that a run writes to all stores."""
        return sum(self.stored().values())

    @abstractmethod
    def form(self, execution: Execution) -> list[Receipt]:
        """Form the image in a run's folder; return the receipts of all units of work.

        Raises
        ------
        InputError
            If the samples are not those of a radar.
        ProcessingError
            If a unit of work fails.
        """

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.headline()}>"

    def blocks(self) -> tuple[PredictedBlock, ...]:
        """Predictions of each block."""
        return ()

    def loops(self) -> Sequence[str]:
        """Compiled loops of its own tasks besides `graph.compiling.TASKS`; of a universal processor, besides `READ`."""
        return ()

    def notes(self) -> list[str]:
        """Warnings for the user of the image."""
        return []

    def lines(self) -> list[str]:
        """The plan in sentences."""
        return [
            f"image of {self.grid.shape[1]} x {self.grid.shape[0]} pixels by {self.processor}",
            f"peak memory of a worker {size_text(self.memory(1))}",
            f"a run writes about {size_text(self.stored_bytes())}",
            *self.notes(),
        ]

    def tables(self) -> list[Table]:
        """Return the table of the figures that matter most."""
        return []

    def details(self) -> list[Table]:
        """Return the tables of all figures."""
        return self.tables()

    def headline(self) -> str:
        """The plan in one line."""
        return self.lines()[0]

    def draw(self, axes: Axes | None) -> Axes:
        """Draw grid and track on the ground."""
        from blocksar.products.pictures.blocks import draw_plan  # optional, and slow to load

        return draw_plan(self.pieces[0].geometry, self.grid, axes=axes)

    @property
    def result(self) -> Any:
        """Value of `plan(...).result` in Python."""
        return self


def outside_window(lit: Sequence[tuple[Geometry, Region]], grid: Grid) -> list[str]:
    """Warn that part of a given grid lies outside the range windows of all collections; empty if not."""
    if all(geometry.collection.steered and grid == default_grid(geometry, region) for geometry, region in lit):
        return []  # the corners of the box about what is lit
    share = share_outside(lit, grid)
    if share == 0:
        return []
    collections, terrain = [geometry.collection for geometry, _ in lit], lit[0][0].terrain
    heights = "" if terrain is None else f", or correct the terrain's heights, z = {terrain.limits[0]:.6g} .. "
    heights += "" if terrain is None else f"{terrain.limits[1]:.6g} m"
    unrecorded = {each.recorded.partial for each in collections if each.recorded is not None}
    pulses = (
        "" if not unrecorded else ", or have no recorded pulse," if any(unrecorded) else ", or have no whole pulse,"
    )
    return [
        f"{100 * share:.2g} % of the grid's pixels lie outside the range window "
        f"({max(each.range_window for each in collections):.5g} m about the reference range){pulses} and stay NaN; "
        f"move the grid, or give a smaller one{heights}"
    ]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PartPlan(ImagePlan):
    """A plan that forms parts of the image, whole chunks, directly from the samples.

    A run then inspects all samples, and forms the parts, each a unit of work of the stage that has the processor's
    name. Several collections, noise, and the layers of a terrain are taken care of.

    Attributes
    ----------
    needed : int
        Peak memory of a worker, bytes.
    terrain : Terrain or None
        The ground, if the processor takes one.
    chunks : tuple of int
        Rows and columns of chunks of the image in a unit of work.
    on_gpu : int
        Memory of the GPU, bytes; 0 without one.
    """

    needed: int
    terrain: Terrain | None = None
    chunks: tuple[int, int] = (1, 1)
    on_gpu: int = 0

    def parts(self) -> dict[str, list[Window]]:
        """Windows of the image, in whole chunks, that each unit of work forms."""
        return {f"part-{number}": windows for number, windows in enumerate(units_of(self.grid, self.chunks))}

    def memory_lines(self) -> list[str]:
        """Describe the memory of a worker."""
        gpu = f", and {size_text(self.on_gpu)} of its GPU" if self.on_gpu else ""
        return [f"peak memory of a worker {size_text(self.needed)}{gpu}"]

    @abstractmethod
    def forming_parts(self, number: int, weighting: Weighting) -> FormParts:
        """The function that forms a part of the image from the samples of a piece: see `tasks.forming.FormParts`."""

    def memory(self, threads: int) -> int:
        return self.needed

    @cached_property
    def _ambiguities(self) -> list[str]:
        return azimuth_ambiguities([piece.geometry for piece in self.pieces], self.grid)

    @cached_property
    def _outside(self) -> list[str]:
        """What the range window says of the grid, where a region of yaws and ranges can be planned for it."""
        geometries = [piece.geometry for piece in self.pieces]
        if any(geometry.collection.bistatic for geometry in geometries):
            return []
        with suppress(InputError):
            return outside_window([(each, plan_region(each, self.grid)) for each in geometries], self.grid)
        return []

    def notes(self) -> list[str]:
        return [*self._ambiguities, *self._outside]

    def stored(self) -> dict[str, int]:
        noise = any(piece.geometry.collection.noise_power for piece in self.pieces)
        return exact_bytes(self.grid, self.terrain, noise=noise)

    def form(self, execution: Execution) -> list[Receipt]:
        from blocksar.tasks import stages  # with dask

        executor, run, segments = execution.executor, execution.run, execution.segments
        read = execution.accept_read("inspect", stages.inspect_samples(executor, segments, run))
        forms = [self.forming_parts(number, execution.weighting) for number in range(len(segments))]
        formed = stages.form_parts(executor, self.processor, forms, self.parts(), read, self.grid, run, on=self.device)
        execution.end(self.processor)
        layers = stages.layers_of_parts(executor, segments, run, self.grid, formed)
        if layers:
            execution.end("layers")
        return [*(receipt for each in read for receipt in each.receipts), *formed, *layers]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ChunkPlan(PartPlan):
    """A plan that forms each chunk of the image independently of the others.

    It states what a chunk takes and the function that forms one.
    """

    @abstractmethod
    def seconds(self, geometry: Geometry, x: FloatArray, y: FloatArray) -> float:
        """Predict a thread's seconds to form a chunk at x (n_x,) and y (n_y,), m, from a collection's samples."""

    @abstractmethod
    def forming(self, weighting: Weighting) -> Form:
        """The function that forms pixels from the samples of a collection: see `tasks.forming.Form`."""

    def forming_parts(self, number: int, weighting: Weighting) -> FormParts:
        from blocksar.tasks.forming import each_alone  # with dask

        return partial(each_alone, form=self.forming(weighting))

    def work(self) -> Work:
        return effort.of_chunks([piece.geometry for piece in self.pieces], self.grid, self.processor, self.seconds)


class Processor(Protocol):
    """A way to form images.

    Attributes
    ----------
    name : str
        As in commands and settings.
    summary : str
        What it is, in half a sentence for the help.
    options : type
        Model of its options; see `blocksar.options`.
    universal : bool
        Whether it takes any track and grid: nothing is expanded about a place or a time.
    compared : bool
        Whether `auto` considers it.
    on_gpu : bool
        Whether it can run on a GPU.
    general : bool, optional
        Whether it takes pulses and range frequencies that are not uniform, and bistatic collections. Default: False.
    """

    name: str
    summary: str
    options: type
    universal: bool
    compared: bool
    on_gpu: bool

    def check(self, options: Any) -> None:
        """Check that options go together.

        Raises
        ------
        InputError
            If they do not.
        """

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image.

        Raises
        ------
        InputError
            If there is no such plan, or a worker has too little memory.
        """


@runtime_checkable
class Bounding(Processor, Protocol):
    """A processor that may know early that a plan is not worth to be made."""

    def plan_within(self, problem: Problem, seconds: float) -> ImagePlan | Bound:
        """Plan an image, or say why no plan keeps the fidelity in so many seconds, as soon as that is known.

        The plan is that of `plan`. It may still take longer, or not keep the fidelity.

        Raises
        ------
        InputError
            As `plan`.
        """


def is_general(processor: Processor) -> bool:
    """Whether a processor takes collections that are bistatic or not uniform; see `Collection.departures`."""
    return bool(getattr(processor, "general", False))


def check_taken(processor: Processor, collections: Sequence[Collection]) -> None:
    """Check that a processor takes collections of this kind.

    Raises
    ------
    InputError
        If one is bistatic or not uniform, and it does not.
    """
    if not is_general(processor):
        for each in collections:
            refuse_departures(processor.name, each.departures, "take --processor backprojection or auto")


def plan_image(processor: Processor, problem: Problem) -> ImagePlan:
    """Plan an image by a processor.

    Raises
    ------
    InputError
        If pulses or range frequencies are not uniform, or the collection is bistatic, which it does not take, or from
        `Processor.plan`.
    """
    check_taken(processor, problem.collections)
    return processor.plan(problem)


@dataclass(frozen=True)
class NoOptions:
    """Empty options, of a processor that has none."""


@dataclass(kw_only=True)
class Execution:
    """Context in which a run's stages execute: executor, folder and input.

    Attributes
    ----------
    executor : Executor
    run : Run
    segments : sequence of Segment
        The pieces of the plan with their samples, range-compressed.
    weighting : Weighting
    discard : bool
        Whether what is not read any more is to be removed.
    accept_read : callable
        Takes the name of the stage that has read all samples, and what it has found; ends the stage, and creates the
        image without pixels. Returns the findings with receipts of what came before, and with the noise of the image.
    end : callable
        Takes the name of a stage at its end.
    """

    executor: Executor
    run: Run
    segments: Sequence[Segment]
    weighting: Weighting
    discard: bool
    accept_read: Callable[[str, Sequence[ReadSegment]], list[ReadSegment]]
    end: Callable[[str], None]
