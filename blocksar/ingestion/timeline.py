"""When a collection was made: UTC, as the attribute `source` of a phase history states it."""

from __future__ import annotations

from datetime import UTC, datetime
from numbers import Real
from typing import Any

from blocksar.errors import InputError

LONGEST = 1e9  # s from the start of a collection to slow time 0: some 30 years


def stated_times(start: str | None, zero: float | None) -> dict[str, Any]:
    """Return `collection_start` and `time_zero` as a user gives them, for the attribute `source`; empty if not given.

    Parameters
    ----------
    start : str or None
        UTC in ISO 8601, such as 2008-08-19T14:03:21.5Z; without a zone it is taken for UTC.
    zero : float or None
        Seconds from the start to slow time 0.

    Raises
    ------
    InputError
        If the start is no date with a time, or the seconds are no number, or more than LONGEST.

    Examples
    --------
    >>> stated_times("2008-08-19T16:03:21.5+02:00", 3.25)
    {'collection_start': '2008-08-19T14:03:21.500000Z', 'time_zero': 3.25}
    """
    times: dict[str, Any] = {}
    if start is not None:
        start = str(start)
        try:
            if not ("T" in start or " " in start.strip()):
                raise ValueError
            moment = datetime.fromisoformat(start.strip())
            moment = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).astimezone(UTC)
        except (ValueError, OverflowError):
            raise InputError(
                f"--collection-start {start!r} is not a date with a time; give UTC in ISO 8601, such as "
                "2008-08-19T14:03:21.5Z"
            ) from None
        times["collection_start"] = f"{moment:%Y-%m-%dT%H:%M:%S.%f}Z"
    if zero is not None:
        if not isinstance(zero, Real) or not abs(zero) <= LONGEST:
            raise InputError(
                f"--time-zero is {zero!r} s; give the seconds from --collection-start to slow time 0, "
                f"{LONGEST:g} at most"
            )
        times["time_zero"] = float(zero)
    return times
