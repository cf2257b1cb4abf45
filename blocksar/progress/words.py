"""Times and rates as text."""

from __future__ import annotations

import math


def clock_time(seconds: float) -> str:
    """Format a time as m:ss or h:mm:ss.

    Examples
    --------
    >>> clock_time(7.9), clock_time(3725)
    ('0:07', '1:02:05')
    """
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def rough_time(seconds: float) -> str:
    """Format the time left, no finer than it is known.

    Examples
    --------
    >>> rough_time(34.6), rough_time(330), rough_time(8000)
    ('35 s', '6 min', '2 h 15 min')
    """
    if seconds < 90:
        return f"{math.ceil(seconds)} s"
    if seconds < 90 * 60:
        return f"{math.ceil(seconds / 60)} min"
    hours, minutes = divmod(5 * math.ceil(seconds / 300), 60)
    return f"{hours} h {minutes:02} min"


def rate_text(rate: float | None) -> str:
    """Format a rate, in units per second, minute or hour: the shortest in which a unit is finished.

    Examples
    --------
    >>> rate_text(2.51), rate_text(0.2), rate_text(0.001)
    ('2.5/s', '12/min', '3.6/h')
    """
    if rate is None:
        return ""
    seconds, unit = next(((s, unit) for s, unit in ((1, "s"), (60, "min")) if rate * s >= 1), (3600, "h"))
    return f"{rate * seconds:.2g}/{unit}" if rate * seconds < 10 else f"{rate * seconds:.0f}/{unit}"
