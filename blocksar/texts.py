"""Quantities as people read them, each in one form: bytes, times, frequencies, numbers of things."""

from __future__ import annotations

from blocksar.constants import GIB, MIB

FINE = 0.9999  # coherence from which on it is shown with six decimals


def size_text(size: float) -> str:
    """A number of bytes in MiB or GiB.

    Examples
    --------
    >>> size_text(3 * 2**20), size_text(5.5 * 2**30)
    ('3.0 MiB', '5.5 GiB')
    """
    return f"{size / GIB:.1f} GiB" if size >= GIB else f"{size / MIB:.{0 if size >= 100 * MIB else 1}f} MiB"


def time_text(seconds: float) -> str:
    """A predicted time with as many digits as it deserves.

    Examples
    --------
    >>> time_text(0.04), time_text(13.3), time_text(250), time_text(9000)
    ('1 s', '13 s', '4 min', '2.5 h')
    """
    if seconds < 100:
        return f"{max(round(seconds), 1)} s"
    return f"{round(seconds / 60)} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def frequency_text(frequency: float) -> str:
    """A frequency of a radar in MHz or GHz.

    Examples
    --------
    >>> frequency_text(9.65e9), frequency_text(96e6)
    ('9.65 GHz', '96 MHz')
    """
    return f"{frequency / 1e9:.6g} GHz" if abs(frequency) >= 1e9 else f"{frequency / 1e6:.6g} MHz"


def count(n: int, noun: str, plural: str = "") -> str:
    """A number of things, with the noun in singular or plural, by default with "s".

    Examples
    --------
    >>> count(1, "target"), count(0, "warning"), count(73, "target"), count(2, "echo", "echoes")
    ('1 target', 'no warnings', '73 targets', '2 echoes')
    """
    return f"{n or 'no'} {noun if n == 1 else plural or f'{noun}s'}"


def digits(coherence: float) -> str:
    """Format a coherence with four decimals, or with six if four would round its loss to 0."""
    return f"{coherence:.{4 if coherence < FINE else 6}f}"
