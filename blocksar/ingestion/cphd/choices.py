"""Options for a CPHD file, and what a user says of it against what it says itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from blocksar.errors import InputError
from blocksar.ingestion.cphd.samples import RangeWindow
from blocksar.ingestion.cphd.troposphere import Troposphere
from blocksar.ingestion.readers import ReaderOptions
from blocksar.options import Option
from blocksar.spans import parse_crop, parse_pulses, parse_span


def _read_band(span: Any) -> tuple[float, float]:
    return parse_span(span, "--frequencies", "--frequencies 9.5e9:9.7e9")


def _read_area(crop: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    return parse_crop(crop, "area")


@dataclass(frozen=True, kw_only=True)
class Choices(ReaderOptions):
    """The part of a file that is wanted, and what is not as the file has it; see `ReaderOptions`.

    Attributes
    ----------
    channel : str, optional
        Identifier of the channel. Needed if the file has several. "all" makes a store with a channel for each of the
        file's, which must have the same geometry.
    pulses : str or (int, int), optional
        Vectors "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    frequencies : str or (float, float), optional
        Band "f1:f2" that is read, Hz; either may be left out. Default: all.
    area : str or ((float, float), (float, float)), optional
        Ground "x0:x1,y0:y1", m in the scene frame, that images will show: of pulses and frequencies only what it needs
        is kept, after low-passes that stop the echoes of all else. Default: all.
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0, that of the file's reference point.
    sgn : {-1, 1}, optional
        Sign of the phase that the samples follow. Default: as declared.
    range_window : {"saved", "reference"}, optional
        The delays that are taken: those of TOA1 .. TOA2, or those about the reference point that the samples tell
        apart. Default: "saved", and refused if none of them is of the image area.
    troposphere : {"file", "standard"}, optional
        The troposphere's delay that the samples still hold, and that is taken out: that of TDTropoSRP, or that of a
        standard atmosphere. Default: none, as the standard has it.

    Raises
    ------
    InputError
        If one of the last three has another value.
    """

    channel: Annotated[
        str | None, Option("Channel to read, if the file has several; all: one store of all of them.", metavar="NAME")
    ] = None
    pulses: Annotated[
        tuple[int, int | None],
        Option("Vectors that are read: A to the one before B.", metavar="A:B", default="all", read=parse_pulses),
    ] = (0, None)
    frequencies: Annotated[
        tuple[float, float],
        Option("Band that is read, Hz.", metavar="F1:F2", default="all",
               read=_read_band),
    ] = (-math.inf, math.inf)  # fmt: skip
    area: Annotated[
        tuple[tuple[float, float], tuple[float, float]] | None,
        Option("Ground of the image, m: no more samples are kept than it needs.", metavar="x0:x1,y0:y1", default="all",
               read=_read_area),
    ] = None  # fmt: skip
    sgn: Annotated[int | None, Option("Sign SGN that the samples follow.", metavar="-1|+1", default="as declared")] = (
        None
    )
    range_window: Annotated[
        RangeWindow | None,
        Option("Delays to take: TOA1 .. TOA2, or those about the reference point that the samples tell apart.",
               metavar="saved|reference", default="saved, if the image area has any",
               read=str),
    ] = None  # fmt: skip
    troposphere: Annotated[
        Troposphere | None,
        Option("Delay to take out of samples that hold it: TDTropoSRP, or that of a standard atmosphere.",
               metavar="file|standard", default="none", read=str),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        if self.sgn not in (None, -1, 1) or isinstance(self.sgn, bool):
            raise InputError(f"--sgn is {self.sgn!r}; it must be -1 or +1")
        for option, values in (("range_window", ("saved", "reference")), ("troposphere", ("file", "standard"))):
            if (value := getattr(self, option)) not in (None, *values):
                raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(values)}")
