"""The record of a run, run.json, and the receipts in it: types, and their JSON layout.

Other programs read run.json: keys may be added, but not renamed or removed. A change that makes the data of older runs
unusable must raise FORMAT.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import nan
from typing import Any, ClassVar, Literal, Self

from blocksar import stores
from blocksar.constants import SINC_PSLR
from blocksar.errors import FolderError
from blocksar.places.place import Place
from blocksar.runs.schema import Count, Figure, Flag, Inside, Number, Record, Whole
from blocksar.version import __version__


@dataclass(frozen=True)
class RunInput(Record):
    """The phase history of a run; empty where the record does not name it."""

    path: str = ""
    fingerprint: str = ""


@dataclass(frozen=True)
class SampleCounts(Record):
    """Number of samples that are missing, and of those that are impossible."""

    missing: Whole
    impossible: Whole


@dataclass(frozen=True)
class CentroidError(Record):
    """Measured Doppler centroid minus that of track and beam, Hz, and the measurement's coherence; may be NaN."""

    error: Figure
    coherence: Figure


@dataclass(frozen=True, kw_only=True)
class RunSegment(Record):
    """A collection of a run, or a part of one along time, that is planned by itself.

    Attributes
    ----------
    collection : int
        Number of the collection, as in `collection` of the image.
    path, fingerprint : str
        Of its phase history.
    pulses : (first, last) or None
        Its pulses first <= p < last; None for all of them.
    blocks, parts : int or None
        Number of its blocks, and of range sub-blocks in each; None for back-projection.
    first_block : int
        Number of its first block in the run.
    """

    collection: Whole
    path: str
    fingerprint: str
    pulses: tuple[Whole, Whole] | None = None
    blocks: Count | None = None
    parts: Count | None = None
    first_block: Whole


@dataclass(frozen=True, kw_only=True)
class PredictedBlock(Record):
    """Predicted quality of a block, or of a range sub-block: that of its worst target.

    Attributes
    ----------
    block : int
    part : int or None
        Number of the range sub-block; None where the block is not divided in range.
    yaw, range : (low, high), (near, far)
        Borders in yaw, rad, and in range at t = 0, m.
    memory : float
        Peak of a worker, bytes.
    bias : float
        Range acceleration that the time perturbation adds, m/s^2.
    residual_phase, quadratic_phase : float
        Largest phase error over the dwell, and its quadratic part at the edge of the dwell, rad.
    pslr, ideal_pslr : float
        In azimuth, dB; and that of exact back-projection.
    width : float
        In azimuth, relative to the limit set by the dwell.
    migration : float
        Over the dwell, range resolution cells.
    resolution : float
        In azimuth, m.
    track_phase : float
        Root mean square phase that the noise of the track leaves over a dwell, rad.
    coherence : float
        With exact back-projection: 1 less the losses of the target that loses most.
    phase_loss, range_loss, dispersion_loss, track_loss : float
        What residual phase, range migration, the ends of the dwell and the noise of the track take from it.
    """

    block: Whole
    part: Whole | None = None
    yaw: tuple[Number, Number]
    range: tuple[Number, Number]
    memory: Number
    bias: Figure = nan
    residual_phase: Figure
    quadratic_phase: Figure = nan
    pslr: Figure
    width: Figure
    migration: Figure
    resolution: Figure = nan
    track_phase: Figure = nan
    coherence: Figure = nan
    phase_loss: Figure = nan
    range_loss: Figure = nan
    dispersion_loss: Figure = nan
    track_loss: Figure = nan
    ideal_pslr: Figure = SINC_PSLR

    @property
    def name(self) -> str:
        """Name of the block, `2`, or `2.0` for a range sub-block."""
        return str(self.block) if self.part is None else f"{self.block}.{self.part}"


@dataclass(frozen=True, kw_only=True)
class RunPlan(Record):
    """Division of a run into blocks, and its predicted quality.

    Attributes
    ----------
    blocks, parts : int or None
        Number of blocks, and of range sub-blocks in each; None for back-projection.
    memory : float or None
        Predicted peak of a worker, bytes.
    grid : (x0, x1, dx, y0, y1, dy) or None, m
    predicted : tuple of PredictedBlock
        Empty for back-projection.
    coherence : float or None
        Least predicted coherence with exact back-projection, of an image without blocks; None for the exact one.
    processor : str
        Where it was chosen by the plan; else empty, and that of the settings.
    checksum : str
        Of the plan that an unfinished run keeps in its folder; empty in runs of earlier versions.
    """

    if_any: ClassVar = ("coherence", "processor", "checksum")
    blocks: Count | None = None
    parts: Count | None = None
    memory: Number | None = None
    grid: tuple[Number, Number, Number, Number, Number, Number] | None = None
    predicted: tuple[PredictedBlock, ...] = ()
    coherence: Number | None = None
    processor: str = ""
    checksum: str = ""

    @property
    def least(self) -> float:
        """Least predicted coherence with exact back-projection; NaN if unknown."""
        return min(
            (block.coherence for block in self.predicted), default=nan if self.coherence is None else self.coherence
        )


FORMAT = 6  # version of the run folder's layout
FINISHED: Literal["finished"] = "finished"
UNFINISHED: Literal["unfinished"] = "unfinished"
RECORD = "run.json"
# Receipts of version 0.1.0 do not name the stage: derive it from the unit's name, here and nowhere else.
# Back-projection uses the same unit names, for columns that it only inspects and for chunks of the image.
_STAGES = {"pulses": "range-compress", "columns": "recover", "block": "focus", "chunk": "mosaic", "store": "create"}
_BACK_PROJECTION_STAGES = _STAGES | {"columns": "inspect", "chunk": "backprojection"}


@dataclass(frozen=True)
class Written(Record):
    """A region of a variable that a task has written, with its checksum.

    Attributes
    ----------
    store : str
        Path of the store, relative to the run folder.
    variable : str
    region : tuple of (first, end)
        One pair for each dimension.
    checksum : str
        Of the values.
    """

    store: Inside
    variable: Inside
    region: tuple[tuple[Whole, Whole], ...]
    checksum: str

    def intact(self, folder: Place) -> bool:
        """Read the values and compare their checksum.

        Raises
        ------
        InputError
            If they cannot be read.
        """
        region = tuple(slice(*span) for span in self.region)
        values = stores.read_region(folder / self.store, self.variable, region)
        return stores.checksum(values) == self.checksum


@dataclass(frozen=True, kw_only=True)
class Receipt(Record):
    """The receipt of a unit of work: what it wrote, its time and memory.

    Attributes
    ----------
    unit : str
        Name of the unit, unique in its run.
    stage : str
        The stage that the unit belongs to, such as `recover`; empty if unknown.
    run : str
        Identity of the run.
    seconds : float
        Duration, s.
    written : tuple of Written
    peak_memory : float or None
        Of the worker since its start, bytes; None if unknown.
    found : mapping or None
        Findings of the inspection of the samples, as `Inspection.as_dict` gives them.
    origin : (row, column) or None
        First pixel of a block's patch in the image.
    steps : mapping of str to float
        Seconds of each step of a block.
    files : mapping of str to str
        Checksums of small files, by path relative to the run folder.
    reused : bool
        Whether an earlier process did the work.
    damaged : bool
        Whether an earlier process did the work, and it had to be repeated because its data were damaged.
    """

    if_any: ClassVar = ("peak_memory", "found", "origin", "steps", "files", "reused", "damaged")
    run: str = ""
    unit: str
    stage: str = ""
    seconds: Number = 0.0
    written: tuple[Written, ...] = ()
    peak_memory: Number | None = None
    found: Mapping[str, Any] | None = None
    origin: tuple[Whole, Whole] | None = None
    steps: Mapping[str, Number] = field(default_factory=dict)
    files: Mapping[Inside, str] = field(default_factory=dict)
    reused: Flag = False
    damaged: Flag = False


def block_unit(block: str) -> str:
    """Return the name of the unit of work that focuses a block."""
    return f"block-{block}"


_BEFORE = {"weighting_range": "uniform", "weighting_azimuth": "uniform", "surface": "plane"}  # of older runs
_RESULTS = ("warnings", "samples", "check", "doppler_centroid", "receipts", "timings", "peak_memory")
_IF_USED = ("autofocus", "control", "track_input", "interference")  # settings that only runs with them have


@dataclass(frozen=True, kw_only=True)
class RunRecord(Record):
    """The contents of run.json. Only `status` is always present: records of older formats hold less.

    Attributes
    ----------
    status : str
        FINISHED or UNFINISHED.
    format : int or None
        Format of the run folder.
    settings : mapping
        Settings of `focus`, by parameter name.
    input : RunInput
        Of several collections: the first one's path, and a fingerprint of all.
    segments : tuple of RunSegment
        Empty unless there are several collections, or segments of one.
    channels : tuple of str
        Names of the channels or looks, each of which has a run of its own; empty in such a run.
    dimension : str
        What they are: "channel" or "look".
    identity : str
        Hash of format, settings, input and division into blocks.
    versions : mapping of str to str
        Of blocksar and its libraries.
    workers, threads : int or None
        Processes, and threads in each.
    memory_limit : float or None
        Of a worker, bytes.
    plan : RunPlan
    warnings : tuple of str
    samples : SampleCounts or None
    check : str
        What the check of the samples against track and beam gave; empty where it was not made.
    doppler_centroid : CentroidError or None
    receipts : tuple of Receipt
    timings : mapping of str to float
        Seconds of each stage, and `total`.
    peak_memory : float or None
        Of a worker, bytes.
    """

    if_any: ClassVar = ("segments", "channels", "check", "doppler_centroid")
    format: Whole | None = None
    status: Literal["finished", "unfinished"]
    settings: Mapping[str, Any] = field(default_factory=dict)
    input: RunInput = RunInput()
    segments: tuple[RunSegment, ...] = ()
    channels: tuple[Inside, ...] = ()
    dimension: str = "channel"
    identity: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    workers: Count | None = None
    threads: Count | None = None
    memory_limit: Number | None = None
    plan: RunPlan = RunPlan()
    warnings: tuple[str, ...] = ()
    samples: SampleCounts | None = None
    check: str = ""
    doppler_centroid: CentroidError | None = None
    receipts: tuple[Receipt, ...] = ()
    timings: Mapping[str, Number] = field(default_factory=dict)
    peak_memory: Number | None = None

    @property
    def finished(self) -> bool:
        return self.status == FINISHED

    @property
    def inputs(self) -> tuple[str, ...]:
        """Paths of the phase histories; empty if unknown."""
        paths = tuple(dict.fromkeys(segment.path for segment in self.segments)) or (self.input.path,)
        return tuple(filter(None, paths))

    def fingerprint_of(self, path: str) -> str:
        """Fingerprint of one of `inputs` as the run began; empty if unknown."""
        by_path = {segment.path: segment.fingerprint for segment in self.segments}
        return by_path.get(path, self.input.fingerprint)

    @property
    def processor(self) -> str:
        """Name of the processor that formed the image; empty if unknown."""
        return self.plan.processor or str(self.settings.get("processor", ""))

    @property
    def version(self) -> str:
        """Version of blocksar that wrote the record; empty if unknown."""
        return self.versions.get("blocksar", "")

    @classmethod
    def read(cls, folder: Place) -> Self:
        """Read the record of a run folder.

        Raises
        ------
        InputError
            If run.json is missing, or is not JSON.
        FolderError
            If a field is missing or of another type, or the record is of a newer format.
        """
        place = folder / RECORD
        remedy = f"run `blocksar focus` with --out {folder} --overwrite to begin the run again"
        return cls.from_json(stores.read_json(place, remedy), f"{place}")

    @classmethod
    def from_json(cls, value: Any, file: str = RECORD) -> Self:
        """Convert from JSON; `file` is for messages.

        Raises
        ------
        FolderError
            If a field is missing or of another type, or the record is of a newer format.
        """
        form = value.get("format") if isinstance(value, dict) else None
        if isinstance(form, int | float) and form > FORMAT:
            raise FolderError(
                f"{file} has format {form}, and blocksar {__version__} knows formats up to {FORMAT}; "
                "use a newer blocksar, or focus again with --overwrite",
                replaceable=True,
            )
        record = super().from_json(value, file)
        stages = _BACK_PROJECTION_STAGES if record.settings.get("processor") == "backprojection" else _STAGES
        receipts = tuple(
            each if each.stage else replace(each, stage=stages.get(each.unit.partition("-")[0], ""))
            for each in record.receipts
        )
        return replace(record, receipts=receipts)

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON; results are part of it once the run is finished."""
        left_out = (() if self.channels else ("dimension",)) + (() if self.finished else _RESULTS)
        return {name: value for name, value in super().as_json().items() if name not in left_out}

    def write(self, folder: Place) -> None:
        """Write run.json.

        Raises
        ------
        ProcessingError
            If it cannot be written.
        """
        stores.write_json(folder / RECORD, self.as_json())

    def difference(self, settings: Mapping[str, Any], fingerprint: str) -> str | None:
        """Describe how a run with these settings and this input differs from the recorded one; None if it does not."""
        if self.format != FORMAT:
            return f"format {self.format!r}"
        own = _BEFORE | dict(self.settings)
        recorded = {name: own.get(name) for name in (*settings, *(name for name in _IF_USED if name in own))}
        if self.finished and recorded.get("processor") == "angular-division" and settings.get("processor") == "auto":
            recorded["processor"] = "auto"  # of version 0.2.0, whose default it was
        if changed := {name: value for name, value in recorded.items() if value != settings.get(name)}:
            return ", ".join(f"{name} {value!r}" for name, value in changed.items())
        return None if self.input.fingerprint == fingerprint else "another input"
