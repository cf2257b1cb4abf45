"""Options for Sentinel-1's packets, and what a user says of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from blocksar.errors import InputError, quoted
from blocksar.ingestion.readers import ReaderOptions
from blocksar.ingestion.sentinel1.packets import SWATHS
from blocksar.options import Option
from blocksar.places import Location
from blocksar.places.place import Place
from blocksar.spans import parse_pulses

TimeTags = Literal["transmit", "middle"]
TIME_TAGS = ("transmit", "middle")
POLARIZATIONS = tuple(sent + received for sent in "HV" for received in "HV")


def _one_of(option: str, values: tuple[str, ...], value: Any) -> str | None:
    if value is None:
        return None
    found = {each.lower(): each for each in values}.get(str(value).lower())
    if found is None:
        raise InputError(f"{option} is {quoted(value)}; it must be {' or '.join(values)}")
    return found


def _path(value: Any) -> Any:
    if value is not None and not isinstance(value, str | os.PathLike | Place):
        raise InputError(f"--orbit is {quoted(value)}; give the path of an EOF file")
    return value


@dataclass(frozen=True, kw_only=True)
class Sentinel1Options(ReaderOptions):
    """The part of the data that is wanted, and what is said of it; see `ReaderOptions`.

    Attributes
    ----------
    swath : str, optional
        The one swath that is read, such as "IW1". Default: all.
    polarization : str, optional
        Of transmitter and receiver. Default: that of like ones, "VV" or "HH".
    bursts : str or (int, int), optional
        Bursts "a:b" of each swath that are read, from a to the one before b, counted from 0. Default: all.
    orbit : path, optional
        Precise orbit (EOF). Default: the states in the packets.
    time_tags : {"transmit", "middle"}, optional
        What the packets' times are those of: the pulse's transmission, or the positions of an antenna that stands still
        while a pulse is out, as in simulations. Default: the PRI in which the echo is received.
    troposphere : {"standard"}, optional
        The delay that the samples hold, and that is taken out: a standard atmosphere's. Default: none.
    """

    swath: Annotated[
        str | None,
        Option("The one swath that is read.", metavar="IW1", default="all",
               read=partial(_one_of, "--swath", tuple(SWATHS.values()))),
    ] = None  # fmt: skip
    polarization: Annotated[
        str | None,
        Option("Of transmitter and receiver.", metavar="VV", default="VV or HH",
               read=partial(_one_of, "--polarization", POLARIZATIONS)),
    ] = None  # fmt: skip
    bursts: Annotated[
        tuple[int, int | None],
        Option("Bursts of each swath that are read: A to the one before B.", metavar="A:B", default="all",
               read=partial(parse_pulses, option="--bursts", example="--bursts 0:3")),
    ] = (0, None)  # fmt: skip
    orbit: Annotated[
        Location | None,
        Option("Precise orbit.", metavar="FILE.EOF", default="the states in the packets", read=_path),
    ] = None
    time_tags: Annotated[
        TimeTags | None,
        Option("What times of packets are those of.", metavar="|".join(TIME_TAGS), default="the PRI that receives",
               read=partial(_one_of, "--time-tags", TIME_TAGS)),
    ] = None  # fmt: skip
    troposphere: Annotated[
        Literal["standard"] | None,
        Option("Delay to take out of the samples: that of a standard atmosphere.", metavar="standard", default="none",
               read=partial(_one_of, "--troposphere", ("standard",))),
    ] = None  # fmt: skip
