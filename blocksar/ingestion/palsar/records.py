"""Records of CEOS files, of fixed length and layout: texts in the leader, big-endian numbers before each line."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np

from blocksar.errors import InputError, quoted

DESCRIPTOR = 720  # bytes: the first record of an image file
PREFIX = 412  # bytes of a line before its samples
# Codes of a leader's records, first and second.
SUMMARY, PLATFORM, ATTITUDE, CALIBRATION = b"\x12\x0a", b"\x12\x1e", b"\x12\x28", b"\x12\x78"


class Place(NamedTuple):
    """Where a field lies in its record: first byte, from 0, and length."""

    first: int
    length: int


SUMMARY_FIELDS = {
    "scene identifier": Place(20, 32), "number of SAR channels": Place(388, 4), "mission": Place(396, 16),
    "sensor and mode": Place(412, 32), "clock angle": Place(476, 8), "wavelength": Place(500, 16),
    "linear coefficient of the pulse": Place(550, 16), "sampling rate": Place(710, 16), "range gate": Place(726, 16),
    "pulse length": Place(742, 16), "DC bias of I": Place(818, 16), "DC bias of Q": Place(834, 16),
    "level": Place(1094, 16),
}  # fmt: skip
PLATFORM_FIELDS = {
    "number of points": Place(140, 4), "year": Place(144, 4), "month": Place(148, 4), "day": Place(152, 4),
    "seconds of the day": Place(160, 22), "interval": Place(182, 22), "coordinate system": Place(204, 64),
}  # fmt: skip
STATES, STATE = 386, 22  # of the platform: first byte, and bytes of a number
ATTITUDES, ATTITUDE_LENGTH = 16, 120
BANDWIDTH = Place(64, 4)  # MHz, of the calibration record
# Numbers before a line's samples, big-endian, by their first byte.
LINE = {
    "code": (4, ">u4"), "length": (8, ">i4"), "number": (12, ">i4"), "left fill": (20, ">i4"), "pixels": (24, ">i4"),
    "right fill": (28, ">i4"), "year": (36, ">i4"), "day of year": (40, ">i4"), "milliseconds": (44, ">i4"),
    "transmitted": (52, ">i2"), "received": (54, ">i2"), "PRF": (56, ">i4"), "scan": (60, ">i4"),
    "compressed": (64, ">i2"), "pulse length": (68, ">i4"), "linear coefficient": (76, ">i4"), "nought": (96, ">i4"),
    "slant range": (116, ">i4"), "window position": (120, ">i4"),
}  # fmt: skip
LINE_CODE = 0x320A1214


def text_of(record: bytes, place: Place) -> str:
    return record[place.first : place.first + place.length].decode("latin-1").strip(" \0")


def number_of(record: bytes, place: Place, name: str) -> float:
    """A number in text, in Fortran's spelling.

    Raises
    ------
    InputError
        If it is none.
    """
    text = text_of(record, place)
    try:
        value = float(text.upper().replace("D", "E"))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"the leader's {name} is {quoted(text)}, no number; get the file again")
    return value


def records_of(data: bytes) -> dict[bytes, bytes]:
    """The records of a leader, the first of each kind, by two codes.

    Raises
    ------
    InputError
        If it ends within one.
    """
    found: dict[bytes, bytes] = {}
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at + 8)
        if length < 12 or at + length > len(data):
            raise InputError(f"ends after {len(data)} bytes, within a record of {length} from byte {at}; get it again")
        found.setdefault(data[at + 4 : at + 6], data[at : at + length])
        at += length
    return found


def lines_dtype(length: int) -> np.dtype[Any]:
    """Of a line's numbers and samples, of so many bytes altogether."""
    samples = ("samples", (PREFIX, np.dtype(("u1", (length - PREFIX,)))))
    fields = {**LINE, samples[0]: samples[1]}
    return np.dtype({
        "names": list(fields), "offsets": [first for first, _ in fields.values()],
        "formats": [kind for _, kind in fields.values()], "itemsize": length,
    })  # fmt: skip
