"""Lengths of Fourier transforms."""

from __future__ import annotations


def next_smooth_even(least: int) -> int:
    """Return the least even number >= max(least, 16) whose prime factors are 2, 3 and 5.

    >>> next_smooth_even(2342)
    2400
    """
    n = max(least + least % 2, 16)
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 2
