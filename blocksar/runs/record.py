"""The record of a run, run.json, and the receipts in it: types, and their JSON layout.

Other programs read run.json: keys may be added, but not renamed or removed. A change that makes the data of older runs
unusable must raise FORMAT.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

from blocksar import stores
from blocksar.errors import FolderError
from blocksar.places.place import Place
from blocksar.runs.fields import Field
from blocksar.runs.planned import RunPlan
from blocksar.runs.sources import CentroidError, RunInput, RunSegment, SampleCounts
from blocksar.version import __version__

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
_IF_USED = ("autofocus", "control", "track_input")  # settings that only runs with them have


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
