"""What a run read: its input, its segments, and what was found in the samples."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

from blocksar.runs.fields import Field


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
