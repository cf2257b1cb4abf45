"""What the record of a run says of its plan: division into blocks, and predicted quality."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import nan
from typing import Any, Self

from blocksar.constants import SINC_PSLR
from blocksar.runs.fields import Field

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
