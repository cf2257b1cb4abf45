"""The record of a run, run.json, and the receipts in it: types, and their JSON layout.

Other programs read run.json: keys may be added, but not renamed or removed. A change that makes the data of older runs
unusable must raise FORMAT.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from math import nan
from typing import Any, Self, TypeVar

from blocksar import stores
from blocksar.constants import SINC_PSLR
from blocksar.errors import FolderError
from blocksar.places.place import Place
from blocksar.version import __version__

T = TypeVar("T")
LARGEST = 1 << 63  # magnitude of a valid number


@dataclass(frozen=True)
class Field:
    """A value of a JSON file.

    All conversions raise FolderError where the value is missing or of another type; see `optional`.

    Attributes
    ----------
    value : any JSON value
        None where the file has null, or no such field.
    name : str
        Path of the field within the file, such as `plan.predicted[3].yaw`; empty for the whole.
    file : str
        The file, for messages.
    present : bool
        Whether the file has the field.
    """

    value: Any
    name: str
    file: str
    present: bool = True

    def fail(self, expected: str) -> FolderError:
        """Return the error that names the field, its value and the remedy."""
        actual = "missing" if not self.present else "null" if self.value is None else reprlib.repr(self.value)
        return FolderError(
            f"{self.file} is damaged: {self.name or 'the record'} is {actual}, not {expected}; "
            "focus again with --overwrite",
            replaceable=True,
        )

    def __getitem__(self, key: str) -> Field:
        """Return a member of an object."""
        if not isinstance(self.value, Mapping):
            raise self.fail("an object")
        return Field(self.value.get(key), f"{self.name}.{key}".lstrip("."), self.file, key in self.value)

    def __bool__(self) -> bool:
        """Tell whether there is a value: neither missing nor null."""
        return self.value is not None

    def __iter__(self) -> Iterator[Field]:
        """Iterate over the members of a list; a missing list is empty."""
        if not isinstance(self.value, list | tuple | None):
            raise self.fail("a list")
        for index, value in enumerate(self.value or ()):
            yield Field(value, f"{self.name}[{index}]", self.file)

    def optional(self, convert: Callable[[Field], T]) -> T | None:
        """Convert a value; None where it is missing or null."""
        return convert(self) if self else None

    def mapping(self) -> dict[str, Any]:
        """Return an object as it is, empty if missing."""
        if not isinstance(self.value, Mapping | None):
            raise self.fail("an object")
        return dict(self.value or {})

    def items(self) -> Iterator[tuple[str, Field]]:
        """Iterate over the members of an object, with their keys; none if it is missing."""
        return ((key, self[key]) for key in self.mapping())

    def text(self, default: str | None = None) -> str:
        if self.value is None and default is not None:
            return default
        if not isinstance(self.value, str):
            raise self.fail("a text")
        return self.value

    def path(self) -> str:
        """Return a path below the folder of the file."""
        parts = self.text().split("/")
        if not all(parts) or {".", ".."} & set(parts) or "\0" in self.text():
            raise self.fail("a path within the run")
        return self.text()

    def number(self) -> float:
        """Return a finite number; integers stay integers."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
            raise self.fail("a number")
        return value

    def number_or_nan(self) -> float:
        """Return a finite number, or NaN for null, which stands for it in JSON."""
        return nan if self.present and self.value is None else float(self.number())

    def integer(self) -> int:
        if (value := self.number()) != int(value):
            raise self.fail("a whole number")
        return int(value)

    def count(self) -> int:
        """Return a whole number that is at least 1."""
        if (value := self.integer()) < 1:
            raise self.fail("at least 1")
        return value

    def flag(self) -> bool:
        """Return true or false; false if missing."""
        if not isinstance(self.value, bool | None):
            raise self.fail("true or false")
        return bool(self.value)

    def pair(self) -> tuple[float, float]:
        numbers = [member.number() for member in self]
        if len(numbers) != 2:
            raise self.fail("a pair of numbers")
        return numbers[0], numbers[1]

    def integers(self) -> tuple[int, int]:
        numbers = [member.integer() for member in self]
        if len(numbers) != 2:
            raise self.fail("a pair of whole numbers")
        return numbers[0], numbers[1]


@dataclass(frozen=True)
class RunInput:
    """The phase history of a run; empty where the record does not name it."""

    path: str = ""
    fingerprint: str = ""

    @classmethod
    def of(cls, entry: Field) -> Self:
        return cls(entry["path"].text(""), entry["fingerprint"].text(""))


@dataclass(frozen=True)
class SampleCounts:
    """Number of samples that are missing, and of those that are impossible."""

    missing: int
    impossible: int

    @classmethod
    def of(cls, entry: Field) -> Self:
        return cls(entry["missing"].integer(), entry["impossible"].integer())


@dataclass(frozen=True)
class CentroidError:
    """Measured Doppler centroid minus that of track and beam, Hz, and the coherence of the measurement; may be NaN."""

    error: float
    coherence: float

    @classmethod
    def of(cls, entry: Field) -> Self:
        return cls(entry["error"].number_or_nan(), entry["coherence"].number_or_nan())


@dataclass(frozen=True, kw_only=True)
class RunSegment:
    """A collection of several, or a part of one along time, which was planned by itself.

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

    collection: int
    path: str
    fingerprint: str
    pulses: tuple[int, int] | None
    blocks: int | None
    parts: int | None
    first_block: int

    @classmethod
    def of(cls, entry: Field) -> Self:
        return cls(
            collection=entry["collection"].integer(),
            path=entry["path"].text(),
            fingerprint=entry["fingerprint"].text(),
            pulses=entry["pulses"].optional(Field.integers),
            blocks=entry["blocks"].optional(Field.count),
            parts=entry["parts"].optional(Field.count),
            first_block=entry["first_block"].integer(),
        )

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"pulses": self.pulses and list(self.pulses)}


# Figures of a block that records of earlier versions lack.
_ADDED = (
    "bias", "quadratic_phase", "resolution", "track_phase", "coherence", "phase_loss", "range_loss",
    "dispersion_loss", "track_loss", "ideal_pslr",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PredictedBlock:
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

    block: int
    part: int | None
    yaw: tuple[float, float]
    range: tuple[float, float]
    memory: float
    bias: float = nan
    residual_phase: float
    quadratic_phase: float = nan
    pslr: float
    width: float
    migration: float
    resolution: float = nan
    track_phase: float = nan
    coherence: float = nan
    phase_loss: float = nan
    range_loss: float = nan
    dispersion_loss: float = nan
    track_loss: float = nan
    ideal_pslr: float = SINC_PSLR

    @property
    def name(self) -> str:
        """`2`, or `2.0` for a range sub-block."""
        return str(self.block) if self.part is None else f"{self.block}.{self.part}"

    @classmethod
    def of(cls, entry: Field) -> Self:
        required = ("residual_phase", "pslr", "width", "migration")
        optional = [name for name in _ADDED if entry[name]]
        return cls(
            block=entry["block"].integer(),
            part=entry["part"].optional(Field.integer),
            yaw=entry["yaw"].pair(),
            range=entry["range"].pair(),
            memory=entry["memory"].number(),
            **{name: entry[name].number_or_nan() for name in (*required, *optional)},
        )

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"yaw": list(self.yaw), "range": list(self.range)}


@dataclass(frozen=True, kw_only=True)
class RunPlan:
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

    blocks: int | None = None
    parts: int | None = None
    memory: float | None = None
    grid: tuple[float, ...] | None = None
    predicted: tuple[PredictedBlock, ...] = ()
    coherence: float | None = None
    processor: str = ""
    checksum: str = ""

    @property
    def least(self) -> float:
        """Least predicted coherence with exact back-projection; NaN if unknown."""
        return min(
            (block.coherence for block in self.predicted), default=nan if self.coherence is None else self.coherence
        )

    @classmethod
    def of(cls, entry: Field) -> Self:
        grid = tuple(number.number() for number in entry["grid"]) if entry["grid"] else None
        if grid is not None and len(grid) != 6:
            raise entry["grid"].fail("x0, x1, dx, y0, y1, dy")
        return cls(
            blocks=entry["blocks"].optional(Field.count),
            parts=entry["parts"].optional(Field.count),
            memory=entry["memory"].optional(Field.number),
            grid=grid,
            predicted=tuple(map(PredictedBlock.of, entry["predicted"])),
            coherence=entry["coherence"].optional(Field.number),
            processor=entry["processor"].text(""),
            checksum=entry["checksum"].text(""),
        )

    def as_json(self) -> dict[str, Any]:
        return {
            "blocks": self.blocks,
            "parts": self.parts,
            "memory": self.memory,
            "grid": self.grid and list(self.grid),
            "predicted": [block.as_json() for block in self.predicted],
            **({"coherence": self.coherence} if self.coherence is not None else {}),
            **({"processor": self.processor} if self.processor else {}),
            **({"checksum": self.checksum} if self.checksum else {}),
        }


FORMAT = 6  # version of the run folder's layout
FINISHED, UNFINISHED = "finished", "unfinished"
RECORD = "run.json"
# Receipts of version 0.1.0 do not name the stage: derive it from the unit's name, here and nowhere else.
# Back-projection uses the same unit names, for columns that it only inspects and for chunks of the image.
_STAGES = {"pulses": "range-compress", "columns": "recover", "block": "focus", "chunk": "mosaic", "store": "create"}
_BACK_PROJECTION_STAGES = _STAGES | {"columns": "inspect", "chunk": "backprojection"}


@dataclass(frozen=True)
class Written:
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

    store: str
    variable: str
    region: tuple[tuple[int, int], ...]
    checksum: str

    @classmethod
    def of(cls, entry: Field) -> Self:
        region = tuple(span.integers() for span in entry["region"])
        return cls(entry["store"].path(), entry["variable"].path(), region, entry["checksum"].text())

    def as_json(self) -> dict[str, Any]:
        # Thousands are written at the end of a run: `asdict`, which copies every number, takes ten times as long.
        region = [list(span) for span in self.region]
        return {"store": self.store, "variable": self.variable, "region": region, "checksum": self.checksum}

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
class Receipt:
    """The receipt of a unit of work: what it wrote, and what it cost.

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

    unit: str
    stage: str
    run: str = ""
    seconds: float = 0.0
    written: tuple[Written, ...] = ()
    peak_memory: float | None = None
    found: Mapping[str, Any] | None = None
    origin: tuple[int, int] | None = None
    steps: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    reused: bool = False
    damaged: bool = False

    @classmethod
    def of(cls, entry: Field, *, back_projection: bool = False) -> Self:
        unit = entry["unit"].text()
        return cls(
            run=entry["run"].text(""),
            unit=unit,
            stage=entry["stage"].text(_stage_of(unit, back_projection=back_projection)),
            seconds=entry["seconds"].number(),
            written=tuple(map(Written.of, entry["written"])),
            peak_memory=entry["peak_memory"].optional(Field.number),
            found=entry["found"].optional(Field.mapping),
            origin=entry["origin"].optional(Field.integers),
            steps={name: seconds.number() for name, seconds in entry["steps"].items()},
            files={
                Field(name, f"a name in {checksum.name}", entry.file).path(): checksum.text()
                for name, checksum in entry["files"].items()
            },
            reused=entry["reused"].flag(),
            damaged=entry["damaged"].flag(),
        )

    @classmethod
    def from_json(cls, value: Any, file: str) -> Self:
        """Convert from JSON; `file` is for messages.

        Raises
        ------
        FolderError
            If a field is missing or of another type.
        """
        return cls.of(Field(value, "", file))

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON, without the fields that are empty."""
        optional = {
            "peak_memory": self.peak_memory,
            "found": self.found,
            "origin": self.origin and list(self.origin),
            "steps": dict(self.steps) or None,
            "files": dict(self.files) or None,
            "reused": self.reused or None,
            "damaged": self.damaged or None,
        }
        return {
            "run": self.run,
            "unit": self.unit,
            "stage": self.stage,
            "seconds": self.seconds,
            "written": [part.as_json() for part in self.written],
            **{name: value for name, value in optional.items() if value is not None},
        }


def block_unit(block: str) -> str:
    """Return the name of the unit of work that focuses a block."""
    return f"block-{block}"


def _stage_of(unit: str, *, back_projection: bool) -> str:
    return (_BACK_PROJECTION_STAGES if back_projection else _STAGES).get(unit.partition("-")[0], "")


_BEFORE = {"weighting_range": "uniform", "weighting_azimuth": "uniform", "surface": "plane"}  # of older runs
_IF_USED = ("autofocus", "control", "track_input", "interference")  # settings that only runs with them have


@dataclass(frozen=True, kw_only=True)
class RunRecord:
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

    status: str
    format: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    input: RunInput = field(default_factory=RunInput)
    segments: tuple[RunSegment, ...] = ()
    channels: tuple[str, ...] = ()
    dimension: str = "channel"
    identity: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    workers: int | None = None
    threads: int | None = None
    memory_limit: float | None = None
    plan: RunPlan = field(default_factory=RunPlan)
    warnings: tuple[str, ...] = ()
    samples: SampleCounts | None = None
    check: str = ""
    doppler_centroid: CentroidError | None = None
    receipts: tuple[Receipt, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    peak_memory: float | None = None

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
        entry = Field(value, "", file)
        form = entry["format"].optional(Field.integer)
        if form is not None and form > FORMAT:
            raise FolderError(
                f"{file} has format {form}, and blocksar {__version__} knows formats up to {FORMAT}; "
                "use a newer blocksar, or focus again with --overwrite",
                replaceable=True,
            )
        if entry["status"].value not in (FINISHED, UNFINISHED):
            raise entry["status"].fail(f"'{FINISHED}' or '{UNFINISHED}'")
        settings = entry["settings"].mapping()
        exact = settings.get("processor") == "backprojection"
        return cls(
            status=entry["status"].text(),
            format=form,
            settings=settings,
            input=entry["input"].optional(RunInput.of) or RunInput(),
            segments=tuple(map(RunSegment.of, entry["segments"])),
            channels=tuple(name.path() for name in entry["channels"]),
            dimension=entry["dimension"].text("channel"),
            identity=entry["identity"].text(""),
            versions={name: version.text() for name, version in entry["versions"].items()},
            workers=entry["workers"].optional(Field.count),
            threads=entry["threads"].optional(Field.count),
            memory_limit=entry["memory_limit"].optional(Field.number),
            plan=entry["plan"].optional(RunPlan.of) or RunPlan(),
            warnings=tuple(line.text() for line in entry["warnings"]),
            samples=entry["samples"].optional(SampleCounts.of),
            check=entry["check"].text(""),
            doppler_centroid=entry["doppler_centroid"].optional(CentroidError.of),
            receipts=tuple(Receipt.of(receipt, back_projection=exact) for receipt in entry["receipts"]),
            timings={name: seconds.number() for name, seconds in entry["timings"].items()},
            peak_memory=entry["peak_memory"].optional(Field.number),
        )

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON; results are part of it once the run is finished."""
        begun = {
            "format": self.format,
            "status": self.status,
            "settings": dict(self.settings),
            "input": asdict(self.input),
            **({"segments": [segment.as_json() for segment in self.segments]} if self.segments else {}),
            **({"channels": list(self.channels), "dimension": self.dimension} if self.channels else {}),
            "identity": self.identity,
            "versions": dict(self.versions),
            "workers": self.workers,
            "threads": self.threads,
            "memory_limit": self.memory_limit,
            "plan": self.plan.as_json(),
        }
        if not self.finished:
            return begun
        return begun | {
            "warnings": list(self.warnings),
            "samples": self.samples and asdict(self.samples),
            **({"check": self.check} if self.check else {}),
            **({"doppler_centroid": asdict(self.doppler_centroid)} if self.doppler_centroid else {}),
            "receipts": [receipt.as_json() for receipt in self.receipts],
            "timings": dict(self.timings),
            "peak_memory": self.peak_memory,
        }

    def write(self, folder: Place) -> None:
        """Write run.json.

        Raises
        ------
        ProcessingError
            If it cannot be written.
        """
        stores.write_json(folder / RECORD, self.as_json())

    def difference(self, settings: Mapping[str, Any], fingerprint: str) -> str | None:
        """Tell how a run with these settings and this input differs from the recorded one; None if it does not."""
        if self.format != FORMAT:
            return f"format {self.format!r}"
        own = _BEFORE | dict(self.settings)
        recorded = {name: own.get(name) for name in (*settings, *(name for name in _IF_USED if name in own))}
        if self.finished and recorded.get("processor") == "angular-division" and settings.get("processor") == "auto":
            recorded["processor"] = "auto"  # of version 0.2.0, whose default it was
        if changed := {name: value for name, value in recorded.items() if value != settings.get(name)}:
            return ", ".join(f"{name} {value!r}" for name, value in changed.items())
        return None if self.input.fingerprint == fingerprint else "another input"
