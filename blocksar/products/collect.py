"""Facts of the collection for products: its date, mode, polarization and classification."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.runs.finished import FinishedRun
from blocksar.stores import POLARIZATIONS

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
STILL = 0.1  # of its width, by which the beam of a strip map may turn
# The letter in NITF headers by the first words of a classification.
MARKS = {"TOP SECRET": "T", "SECRET": "S", "CONFIDENTIAL": "C", "RESTRICTED": "R", "UNCLASSIFIED": "U"}


def collect_start(source: FinishedRun) -> tuple[datetime, bool]:
    """UTC of the first pulse, and whether it is known; EPOCH if not."""
    start = date_of(source.attrs.get("source"), float(source.collection.time[0]))
    return (EPOCH, False) if start is None else (start, True)


def date_of(told: Any, time: float) -> datetime | None:
    """UTC of a slow time, s; None if it is not known.

    The attribute `source` of ingested data holds `collection_start`, UTC in ISO 8601, and `time_zero`, s from there to
    slow time 0.
    """
    match told:
        case {"collection_start": str(text), "time_zero": int() | float() as zero}:
            try:
                start = datetime.fromisoformat(text)
                start = start if start.tzinfo else start.replace(tzinfo=UTC)
                return start.astimezone(UTC) + timedelta(seconds=zero + time)
            except (ValueError, OverflowError):
                pass  # the date is optional, so a damaged one does not stop the export
    return None


def radar_mode(collection: Collection, *, one_aperture: bool) -> str:
    """The mode: spotlight if all pixels have one centre of aperture; dynamic if the beam is steered otherwise."""
    if one_aperture:
        return "SPOTLIGHT"
    angle = collection.beam_azimuth if collection.beam_steering is None else collection.beam_steering
    return "STRIPMAP" if np.ptp(angle) < STILL * (collection.beam_width or 0.0) else "DYNAMIC STRIPMAP"


def classification(source: FinishedRun) -> str:
    """Classification of the collection as ASCII text; UNCLASSIFIED if it names none."""
    return ascii_text(str(source.attrs.get("classification") or "UNCLASSIFIED"), 200)


def polarization(source: FinishedRun) -> tuple[str, str]:
    """Polarization of the transmitter, and of transmitter and receiver, as SICD names them.

    That of the attribute; else that which a channel's name states, such as HV.
    """
    match source.attrs.get("polarization"):
        case {"transmit": str(transmit), "receive": str(receive)} if {transmit, receive} <= set(POLARIZATIONS):
            return transmit, f"{transmit}:{receive}"
    match tuple(str(source.attrs.get("channel") or "").upper()):
        case ("H" | "V" as transmit, "H" | "V" as receive):
            return transmit, f"{transmit}:{receive}"
    return "UNKNOWN", "UNKNOWN"


def security_mark(source: FinishedRun) -> str:
    """The letter for the classification in NITF headers.

    Raises
    ------
    InputError
        If NITF has none.
    """
    text = classification(source)
    for word, letter in MARKS.items():
        if text.upper().startswith(word):
            return letter
    raise InputError(
        f"the classification of {source.image} is {text!r}, and NITF knows only those that begin with "
        f"{', '.join(MARKS)}; correct the phase history's attribute classification, and focus it again"
    )


def ascii_text(text: str, length: int) -> str:
    """Text as NITF headers may hold it: printable ASCII, at most `length` characters."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:length]


def about_segments(source: FinishedRun, product: str, what: str) -> list[str]:
    """State that the metadata are those of one segment of several, and how much of the image they do not describe."""
    if not source.segments:
        return []
    counts = np.zeros(len(source.segments), np.int64)
    for rows in source.strips(0):
        blocks, number = np.unique(source.read_block(rows, slice(None)), return_counts=True)
        for block, pixels in zip(blocks.tolist(), number, strict=True):
            if block >= 0:
                counts[source.segment_of(block)] += pixels
    own = source.segments.index(source.geometry)
    if counts[own] == (total := counts.sum()):
        return []
    of, share = source.record.segments[own], 100 * (1 - counts[own] / total)
    pulses = "" if of.pulses is None else f", pulses {of.pulses[0]} .. {of.pulses[1] - 1}"
    return [
        f"note: {what} are those of {of.path}{pulses}, and not those of "
        f"{share:.3g} % of the covered pixels, which come from others; {product} has one track"
    ]
