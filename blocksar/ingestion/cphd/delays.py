"""The delays that the samples hold, after that of the SRP: those of TOA1 .. TOA2, or those about the SRP.

Samples SCSS apart tell delays apart only within 1 / SCSS: an echo beyond folds back by whole multiples of it. TOA1 ..
TOA2 may be a little longer, where the echoes end before. Some files give many times as much, or an interval that holds
nothing of the image area. Whether the echoes are those about the SRP then, nothing in the file tells; the user does.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.cphd.areas import ImageArea, area_delays
from blocksar.ingestion.cphd.files import CphdFile

MAX_FOLD = 2.0  # saved delays over the unambiguous ones; no file is sampled more sparsely
RangeWindow = Literal["saved", "reference"]


class Delays(NamedTuple):
    """The part of the echo that is taken: middle of the delays, by vector, and their largest extent, s; messages."""

    middle: FloatArray
    extent: float
    messages: tuple[str, ...] = ()


def find_delays(file: CphdFile, used: IntArray, area: ImageArea, window: RangeWindow | None) -> Delays:
    """Determine the delays that are taken; `used` are the vectors that matter.

    Parameters
    ----------
    window : {"saved", "reference"} or None
        TOA1 .. TOA2, or the unambiguous delays about the SRP; None for the first, if the image area has any of them.

    Raises
    ------
    InputError
        If TOA1 .. TOA2 cannot be what the samples hold.
    """
    early, late = file.parameter("TOA1"), file.parameter("TOA2")
    unambiguous = float(1 / file.parameter("SCSS")[used].max()) if file.domain == "FX" else np.inf
    if window == "reference":
        if file.domain != "FX":
            raise InputError(
                "--range-window reference is given, but the samples are over delay (DomainType TOA), and SC0 and SCSS "
                "say where; leave it out"
            )
        told = f"the {_metres(unambiguous):.6g} m of range about the SRP are taken, whatever TOA1 and TOA2 say"
        return Delays(np.zeros(early.size), unambiguous, (told,))
    own = late - early
    where = int(used[own[used].argmax()])
    fold = float(own[where] / unambiguous)
    if fold > MAX_FOLD or (window is None and not _meets(file, used, area)):
        raise InputError(_reason(file, where, area, unambiguous))
    first, last = early[used].min(), late[used].max()
    middle, extent = (first + last) / 2, last - first
    if abs(middle) < 1e-3 * extent:
        middle = 0.0
    messages: list[str] = []
    if middle:
        ends = [_metres(float(value[where])) for value in (early, late)]
        messages.append(
            f"the saved delays are not centred at the SRP, but run from {ends[0]:.6g} to {ends[1]:.6g} m of range "
            f"after it (vector {file.first_vector + where}): reference_range is at their middle"
        )
    if fold > 1:
        messages.append(
            f"TOA1 .. TOA2 has {fold:.3g} times the delays that samples SCSS apart tell apart: echoes more than "
            f"{_metres(unambiguous) / 2:.6g} m of range off its middle fold back into the image"
        )
    if extent * 1.05 <= unambiguous or np.ptp(early[used]) + np.ptp(late[used]) == 0:
        return Delays(
            np.full(early.size, middle),
            min(float(2 * max(last - middle, middle - first)), unambiguous),
            tuple(messages),
        )
    # The saved delays move too far to have one middle.
    return Delays((early + late) / 2, min(float(own[used].max()), unambiguous), tuple(messages))


def _metres(delay: float) -> float:
    return delay * SPEED_OF_LIGHT / 2


def _meets(file: CphdFile, used: IntArray, area: ImageArea) -> bool:
    """Whether any of the saved delays is of the image area."""
    for vector in used[[0, used.size // 2, -1]]:
        first, last = area_delays(file, area, int(vector))
        if first <= file.parameter("TOA2")[vector] and last >= file.parameter("TOA1")[vector]:
            return True
    return False


def _reason(file: CphdFile, vector: int, area: ImageArea, unambiguous: float) -> str:
    """Why a vector's TOA1 .. TOA2 cannot be what its samples hold, in a sentence."""
    early, late = (_metres(float(file.parameter(name)[vector])) for name in ("TOA1", "TOA2"))
    first, last = (_metres(delay) for delay in area_delays(file, area, vector))
    apart = ""
    if np.isfinite(unambiguous):
        apart = (
            f"; samples SCSS = {file.parameter('SCSS')[vector]:.6g} Hz apart tell {_metres(unambiguous):.6g} m apart, "
            f"{(late - early) / _metres(unambiguous):.3g} times less"
            if late - early > _metres(unambiguous)
            else f"; samples SCSS apart tell {_metres(unambiguous):.6g} m apart"
        )
    remedy = "--range-window reference takes those about the SRP" if apart else "correct TOA1 and TOA2"
    return (
        f"PVP TOA1 .. TOA2 saves echoes from {early:.6g} to {late:.6g} m of range after the SRP (vector "
        f"{file.first_vector + vector}), and the image area lies {first:.6g} to {last:.6g} m after it{apart}: {remedy}"
    )
