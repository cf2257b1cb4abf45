"""What a user wants of a CPHD file, and says of it against what it says itself."""

from __future__ import annotations

from dataclasses import dataclass

from blocksar.errors import InputError
from blocksar.ingestion.cphd.delays import RangeWindow
from blocksar.ingestion.cphd.troposphere import Troposphere
from blocksar.ingestion.reading import Part


@dataclass(frozen=True, kw_only=True)
class Choices(Part):
    """The part of a file that is wanted, and what is not as the file has it; None: as it has it.

    Attributes
    ----------
    sgn : {-1, 1} or None
        The sign that the samples follow.
    range_window : {"saved", "reference"} or None
        See `delays.find_delays`.
    troposphere : {"file", "standard"} or None
        The delay that the samples hold, see `troposphere`.

    Raises
    ------
    InputError
        If one has another value.
    """

    sgn: int | None = None
    range_window: RangeWindow | None = None
    troposphere: Troposphere | None = None

    def __post_init__(self) -> None:
        if self.sgn not in (None, -1, 1) or isinstance(self.sgn, bool):
            raise InputError(f"--sgn is {self.sgn!r}; it must be -1 or +1")
        for option, choices in (("range_window", ("saved", "reference")), ("troposphere", ("file", "standard"))):
            if (value := getattr(self, option)) not in (None, *choices):
                raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(choices)}")
