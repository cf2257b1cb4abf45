"""A run before it starts: the request of a user, its settings, its plan, and the first state of its record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal

from blocksar import stores
from blocksar.api.arguments import history_of
from blocksar.api.ground import PLANE, geometry_over, ground_settings, image_grid, read_ground
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.errors import FolderError, InputError, ProcessingError
from blocksar.focusing.method import Method
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.range_compression import RawCompression
from blocksar.graph.machine import Resources
from blocksar.ingestion.terrain.reading import Ground
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.planning import effort
from blocksar.planning.memory import checked_back_projection_memory, checked_memory, compression_memory
from blocksar.planning.plan import Plan, plan_collection
from blocksar.progress import Work
from blocksar.runs import folder as run_folder
from blocksar.runs.record import FORMAT, UNFINISHED, PredictedBlock, RunInput, RunPlan, RunRecord
from blocksar.version import __version__

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class Request:
    """A phase history to be focused into a folder, and how.

    Attributes
    ----------
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
    fingerprint : str
        Of the phase history.
    ground : Ground
        What the user says of the ground.
    terrain : Terrain or None
        The ground itself, under the grid; None for the plane.
    overwrite : bool
        Whether to replace a run of other settings or another input.
    """

    history: stores.PhaseHistory
    folder: Place
    method: Method | None
    blocks: int | Literal["auto"]
    fidelity: float
    weighting: Weighting
    grid: Grid | None
    fingerprint: str
    overwrite: bool
    ground: Ground = PLANE
    terrain: Terrain | None = None

    @classmethod
    def open(
        cls,
        source: Location | xr.Dataset,
        folder: Place,
        *,
        method: Method | None,
        blocks: int | Literal["auto"],
        fidelity: float,
        weighting: Weighting = UNIFORM,
        grid: Grid | None,
        overwrite: bool,
        ground: Ground = PLANE,
    ) -> Request:
        """Open the phase history; nothing is written.

        Raises
        ------
        InputError
            If there is none, its georeference is wrong, or it and the folder lie in each other; or the ground cannot be
            read.
        """
        history = history_of(source).pinned()
        if "georeference" in history.attrs:
            Georeference.from_attribute(history.attrs["georeference"])  # refuse a wrong one before the work starts
        fingerprint = history.fingerprint()
        if isinstance(history, stores.DatasetHistory):
            if (opened := getattr(source, "encoding", {}).get("source")) is not None:
                run_folder.refuse_overlap(place(opened), folder)  # it may still be read
            history = replace(history, path=folder / run_folder.INPUT)
        else:
            if not stores.open_phase_history(history.path).same(history):
                raise InputError(f"{history.path} changes while it is read; start again once nothing writes to it")
            run_folder.refuse_overlap(place(history.path), folder)
        return cls(
            history=history, folder=folder, method=method, blocks=blocks, fidelity=fidelity, weighting=weighting,
            grid=grid, fingerprint=fingerprint, overwrite=overwrite, ground=ground,
            terrain=read_ground(ground, history.collection.centred(), grid, history.attrs, exact=method is None),
        )  # fmt: skip

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
            **ground_settings(self.ground, self.terrain),
        }

    def identity(self, division: tuple[int | None, int | None] | None) -> str:
        """Hash everything that the results depend on; `division` is the number of blocks, and of parts of each."""
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
        if record is not None and not record.finished:
            division = None if self.method is None else (record.plan.blocks, record.plan.parts)
            if record.identity != self.identity(division):
                raise FolderError(
                    f"{self.folder} is damaged: its run.json does not have the plan that the run began with; use "
                    "--overwrite to begin it again",
                    replaceable=True,
                )
        return record


@dataclass(frozen=True, kw_only=True)
class Job:
    """A request with its plan.

    Attributes
    ----------
    plan : Plan or None
        None for back-projection.
    memory : int
        Predicted peak memory of a worker, bytes.
    """

    request: Request
    geometry: Geometry
    grid: Grid
    machine: Resources
    plan: Plan | None
    memory: int

    @property
    def history(self) -> stores.PhaseHistory:
        return self.request.history

    @classmethod
    def of(cls, request: Request, earlier: RunRecord | None, machine: Resources) -> Job:
        """Plan a run; a resumed one keeps its division into blocks.

        Raises
        ------
        InputError
            If there is no such plan, or it needs more memory than there is.
        """
        history, grid = request.history, request.grid
        collection = history.collection.centred()
        geometry = geometry_over(collection, request.terrain)
        compression = checked_memory(
            "range compression", compression_memory(history.collection, history.raw), machine.memory_limit
        )
        if request.method is None:
            grid = image_grid(collection, grid)
            needed = checked_back_projection_memory(collection, grid, machine.threads, machine.memory_limit)
            memory = max(compression, needed)
            return cls(request=request, geometry=geometry, grid=grid, machine=machine, plan=None, memory=memory)
        division = RunPlan() if earlier is None else earlier.plan
        plan = plan_collection(
            collection,
            blocks=division.blocks or request.blocks,
            parts=division.parts or "auto",
            method=request.method,
            fidelity=request.fidelity,
            weighting=request.weighting,
            grid=grid if request.terrain is None else image_grid(collection, grid),
            workers=machine.workers,
            memory_limit=machine.memory_limit,
        )
        if plan.refusal is not None:
            raise InputError(plan.refusal)
        memory = max(compression, plan.memory)
        return cls(request=request, geometry=geometry, grid=plan.grid, machine=machine, plan=plan, memory=memory)

    def with_stored_input(self) -> Job:
        """The same job with its samples in a store: those in memory are written into the run folder, once.

        Tasks read their input by chunks, and a run that is resumed reads the same.

        Raises
        ------
        ProcessingError
            If they cannot be written.
        """
        history = self.history
        if not isinstance(history, stores.DatasetHistory):
            return self
        try:
            stored = history.stored(history.path).pinned()
        except InputError as error:  # about the run's own store, not about the input
            raise ProcessingError(str(error)) from error
        return replace(self, request=replace(self.request, history=stored))

    def noise(self, lit: FloatArray) -> NoiseMap | None:
        """The noise of the image, where that of the samples is known; `lit` has the valid fraction of each pulse."""
        raw, collection = self.history.raw, self.history.collection
        if not collection.noise_power:
            return None
        spectrum = 1.0 if raw is None else RawCompression.of_echo(raw, collection).noise_spectrum
        return NoiseMap.of(self.geometry.over(None), self.request.weighting, lit, spectrum)

    def predict_effort(self) -> Work:
        """Predict the relative cost of the stages."""
        raw = self.history.raw
        echo = 0 if raw is None else raw.fast_time.size * self.history.collection.n_pulse
        if self.plan is None:
            return effort.of_backprojection(self.geometry, self.grid, echo_samples=echo)
        return effort.of_plan(self.plan, echo_samples=echo)

    def identity(self) -> str:
        """Hash everything that the results depend on: settings, input, format, and the division into blocks."""
        return self.request.identity(None if self.plan is None else (self.plan.n_blocks, self.plan.parts))

    def record(self) -> RunRecord:
        """Return the record of the run at its start."""
        request, plan = self.request, self.plan
        return RunRecord(
            status=UNFINISHED,
            format=FORMAT,
            settings=request.settings,
            input=RunInput(str(request.history.path), request.fingerprint),
            identity=self.identity(),
            versions=_versions(),
            **self.machine._asdict(),
            plan=RunPlan(
                blocks=None if plan is None else plan.n_blocks,
                parts=None if plan is None else plan.parts,
                memory=self.memory,
                grid=grid_numbers(self.grid),
                predicted=() if plan is None else predicted_blocks(plan),
            ),
        )


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


def _versions() -> dict[str, str]:
    names = ("numpy", "scipy", "numba", "dask", "zarr", "xarray")
    return {"blocksar": __version__} | {name: metadata.version(name) for name in names}
