"""Channels of a CPHD file combined in one phase history: their names, and checks that one geometry serves them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, FloatArray
from blocksar.collection.collection import Collection
from blocksar.errors import InputError, printable
from blocksar.readers.cphd.files import CphdFile, identifiers_of, open_file
from blocksar.readers.cphd.vectors import Pulses
from blocksar.stores.channels import NAME, check_channels

ALL = "all"
SAME_PLACE = 1 / 100  # wavelengths: 0.13 rad
SAME_BEAM = 1 / 100  # of its width
SAME_PATTERN = 0.01  # of the amplitude at the peak
LETTERS = {name: name[0] for name in ("H", "V", "X", "Y", "S", "E", "RHC", "LHC")}  # of the standard's polarisations
ALONE = "give --channel an identifier, and ingest each by itself"
Prepared = tuple[Collection, Pulses]


def open_channels(stream: BinaryIO, path: Any, channel: str | None) -> list[CphdFile]:
    """Open the requested channel; each channel of the file for `ALL`, unless that is an identifier.

    Raises
    ------
    InputError
        As `open_file`.
    """
    if channel != ALL:
        return [open_file(stream, path, channel)]
    first = open_file(stream, path, None, any_channel=True)
    names = identifiers_of(first.root)
    if ALL in names:
        return [open_file(stream, path, ALL)]
    return [first, *(open_file(stream, path, name) for name in names[1:])]


def names_of(identifiers: Sequence[str], polarizations: Sequence[Mapping[str, str] | None]) -> tuple[str, ...]:
    """Name channels by their polarisations, such as HH, if distinct; otherwise by valid forms of their identifiers.

    None for a single one.

    Examples
    --------
    >>> names_of(["1", "2"], [{"transmit": "H", "receive": "H"}, {"transmit": "H", "receive": "V"}])
    ('HH', 'HV')
    >>> names_of(["Ch 1", "Ch 2"], [{"transmit": "S", "receive": "S"}, {"transmit": "S", "receive": "E"}])
    ('SS', 'SE')
    >>> names_of(["SWATH 1/HH", "SWATH 2/HH"], [None, None])
    ('SWATH_1_HH', 'SWATH_2_HH')
    """
    if len(identifiers) < 2:
        return ()
    letters = [
        "".join(LETTERS.get(p[way], "?") for way in ("transmit", "receive")) if p else "?" for p in polarizations
    ]
    if not any("?" in name for name in letters) and len(set(letters)) == len(letters):
        return check_channels(letters)
    names: list[str] = []
    for number, identifier in enumerate(identifiers, 1):
        name = re.sub(r"[^A-Za-z0-9_+-]", "_", identifier).lstrip("_+-")[:32]
        taken = {other.casefold() for other in names}
        if not NAME.fullmatch(name) or name.casefold() in taken:
            name = f"{name[:28]}_{number}".lstrip("_")
        names.append(name)
    return check_channels(names)


def check_same_geometry(identifiers: Sequence[str], prepared: Sequence[Prepared]) -> list[str]:
    """Refuse channels with another geometry than the first; return a note about patterns that differ.

    Raises
    ------
    InputError
        If pulses, frequencies, track, reference point or beam differ.
    """
    notes = []
    for identifier, other in zip(identifiers[1:], prepared[1:], strict=True):
        difference = next(_differences(prepared[0], other), None)
        if difference is not None:
            raise InputError(f"channels {identifiers[0]!r} and {identifier!r} differ in {difference}; {ALONE}")
        if not _same_patterns(prepared[0][0], other[0]):
            notes.append(
                f"the antenna's pattern in channel {printable(identifier)[:40]} is not that of the first, which is "
                "taken out of all"
            )
    return notes


def _differences(first: Prepared, second: Prepared) -> Iterator[str]:
    """Describe differences of two channels, by increasing depth: later ones require equal shapes."""
    (one, pulses), (two, others) = first, second
    if one.n_pulse != two.n_pulse:
        yield f"their numbers of pulses, {one.n_pulse} and {two.n_pulse}"
    step = one.range_frequency[1] - one.range_frequency[0]
    bands = [c.carrier + c.range_frequency for c in (one, two)]
    if bands[0].size != bands[1].size or np.abs(bands[0] - bands[1]).max() > UNIFORM_TOLERANCE * step:
        yield "frequencies: " + " and ".join(f"{b.size} from {b[0]:.10g} to {b[-1]:.10g} Hz" for b in bands)
    late = float(np.abs(one.time - two.time).max())
    if late > UNIFORM_TOLERANCE * (one.time[1] - one.time[0]):
        yield f"the times between pulses, by up to {late:.4g} s"
    most = SAME_PLACE * one.wavelength
    for what, apart in (
        ("the antenna's positions (TxPos, RcvPos)", _apart(one.antenna_position, two.antenna_position)),
        ("the reference point (SRPPos)", _apart(pulses.reference_point, others.reference_point)),
        ("the reference range (SRPPos, TOA1, TOA2)", float(np.abs(one.reference_range - two.reference_range).max())),
    ):
        if apart > most:
            yield f"{what}, by up to {apart:.4g} m, more than {most:.2g} m"
    if not _same_beams(one, two):
        yield "their beams (dwell polynomials, antenna)"


def _apart(first: FloatArray, second: FloatArray) -> float:
    """Largest distance, m, between corresponding points (n, 3)."""
    return float(np.linalg.norm(first - second, axis=1).max())


def _same_beams(first: Collection, second: Collection) -> bool:
    """Tell whether two beams light the same ground at the same times."""
    widths = [c.beam_width for c in (first, second)]
    if None in widths:
        return widths[0] == widths[1]
    off = SAME_BEAM * float(widths[0] or 0)
    if abs(float(widths[0] or 0) - float(widths[1] or 0)) > off:
        return False
    for name in ("beam_azimuth", "beam_axis", "beam_steering"):
        one, two = getattr(first, name), getattr(second, name)
        if (one is None) != (two is None) or not (one is None or np.allclose(one, two, 0, off, equal_nan=True)):
            return False
    return True


def _same_patterns(first: Collection, second: Collection) -> bool:
    """Whether the antenna's patterns agree."""
    for angle, name in (("beam_offset", "beam_pattern"), ("elevation", "elevation_pattern")):
        one, two = getattr(first, name), getattr(second, name)
        if one is None or two is None:
            if one is not two:
                return False
            continue
        there = np.interp(getattr(first, angle), getattr(second, angle), two)
        if np.abs(there - one).max() > SAME_PATTERN * np.abs(one).max():
            return False
    return True
