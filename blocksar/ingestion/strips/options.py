"""Options for a satellite's raw echo, and what a user says of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from blocksar.errors import InputError, quoted
from blocksar.ingestion.readers import ReaderOptions
from blocksar.options import Option
from blocksar.spans import parse_pulses

TimeTags = Literal["transmit", "receive", "middle"]
TIME_TAGS = ("transmit", "receive", "middle")
POLARIZATIONS = tuple(transmit + receive for transmit in "HVLR" for receive in "HVLR")


def _read_polarization(value: Any) -> str | None:
    if value is None:
        return None
    if (text := str(value).upper()) not in POLARIZATIONS:
        raise InputError(f"--polarization is {quoted(value)}; give those of transmitter and receiver, such as HV")
    return text


def check_choices(options: Any, **choices: tuple[str, ...]) -> None:
    """Raise an InputError if an option is neither None nor one of its texts."""
    for option, values in choices.items():
        if (value := getattr(options, option)) not in (None, *values):
            raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(values)}")


@dataclass(frozen=True, kw_only=True)
class PartOptions(ReaderOptions):
    """The part of a file that is wanted, and what its samples hold; see `ReaderOptions`.

    Attributes
    ----------
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    troposphere : {"standard"}, optional
        Delay that the samples hold, and that is taken out: that of a standard atmosphere. Default: none.

    Raises
    ------
    InputError
        If the last has another value.
    """

    polarization: Annotated[
        str | None,
        Option("Transmitter and receiver.", metavar="HV", default="all of one transmitter, as channels",
               read=_read_polarization),
    ] = None  # fmt: skip
    pulses: Annotated[
        tuple[int, int | None],
        Option("Pulses that are read: A to the one before B.", metavar="A:B", default="all", read=parse_pulses),
    ] = (0, None)
    troposphere: Annotated[
        Literal["standard"] | None,
        Option("Delay to take out of the samples: that of a standard atmosphere.", metavar="standard", default="none",
               read=str),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        check_choices(self, troposphere=("standard",))


@dataclass(frozen=True, kw_only=True)
class StripOptions(PartOptions):
    """Options where a format gives times of pulses and an orbit.

    Attributes
    ----------
    time_tags : {"transmit", "receive", "middle"}, optional
        What times of pulses are those of: the pulse's transmission, its first sample's reception, or the antenna at the
        middle of the echo's way. Default: of NISAR "transmit" if the file describes them so, else "middle"; of PALSAR
        "receive".

    Raises
    ------
    InputError
        If it has another value.
    """

    time_tags: Annotated[
        TimeTags | None,
        Option("What times of pulses are those of.", metavar="|".join(TIME_TAGS), default="by the file", read=str),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, time_tags=TIME_TAGS)
