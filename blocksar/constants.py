"""Physical and mathematical constants, and units."""

from __future__ import annotations

import math

SPEED_OF_LIGHT = 299_792_458.0  # m/s
TURN = 2 * math.pi  # rad
SINC_PSLR = -13.2615  # dB, highest side lobe of sinc(u)^2
SINC_ISLR = -10.216  # dB, side lobes of sinc(u)^2 within ten widths of the peak over its main lobe
SINC_WIDTH = 0.885893  # -3 dB width of sinc(u)^2 in u: the unweighted response's width times its bandwidth
MIB = 2**20  # bytes
GIB = 2**30  # bytes


def unit_of_lengths(largest: float) -> tuple[str, float]:
    """The unit in which people read lengths of at most `largest` m, and its metres.

    Examples
    --------
    >>> unit_of_lengths(12.0), unit_of_lengths(30e3)
    (('m', 1.0), ('km', 1000.0))
    """
    return ("m", 1.0) if largest < 1e3 else ("km", 1e3)
