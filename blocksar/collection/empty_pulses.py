"""Distinction between lost pulses and pulses that lit nothing, both of which hold zeros; detection of real samples.

Many files hold zeros where a pulse was lost. Such a pulse must not count as lit, or amplitudes are low. A pulse without
noise whose beam lit no scatterer holds zeros as well; it must count, or places beside a target would be divided by the
few pulses that hold its echo. What tells them apart, given that other pulses hold echoes:

- A beam that is not steered lights every scatterer with every pulse. A pulse without any echo is missing.
- Into a steered beam scatterers come over one edge, and they leave it over the other. If nothing was lit before pulse p
  and nothing adds noise, then all echoes of pulse p are at the edge over which scatterers enter; likewise those of the
  last pulse before the zeros at the edge over which they leave. Echoes from inside of the beam were lit in the zeros,
  too, and noise comes from nowhere: such zeros are missing.

Where in the beam the echoes of pulse p lie follows from their change of phase to a pulse q, farther from the zeros, in
each range cell. With d = (R_q - reference_range_q) - (R_p - reference_range_p) of a ground point at that range,

    conj(s_p) s_q  has the phase  -4 pi fc/c d,

so that the mean phase of all range cells, over what they have at the edge, is zero at the edge and grows in proportion
to the depth in the beam. q is so far from p that the beam's half width makes HALF_PHASE. Echoes at the depth x, as a
share of the width, were lit for x dwells before: so many zeros beside them are missing, twice as many for a mean, since
others lie deeper. Where phases disagree (noise), the whole run of zeros is; where echoes do not last until q, a dwell.

REAL SAMPLES where complex ones belong. Samples x over range frequency that are real are half the sum of those of the
scene, s, and of their conjugate. As

    s = sum sigma exp(-4j pi (carrier + f) (R - reference) / c),

the conjugate is a scene of targets at ranges 2 reference - R: each target has half its amplitude, and a mirror image.
Where no phase was removed (reference = 0) all ranges are positive, and s has negative delays over f only. Up to half
the range window, c / (4 step), the conjugate of the analytic signal of x along f is therefore s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import imaged_side
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import fft_rows

ROUNDED = 1e-3  # of the samples, that their imaginary part is where it is rounding; of complex ones it is some 0.7
MIRRORED = "each target would have half its amplitude, and a mirror image"
ANALYTIC = {
    "signal": "np.conj(scipy.signal.hilbert(recorded, axis=-1)), which holds ranges up to c / (4 step of "
    "range_frequency), times exp(4j pi (carrier_frequency + range_frequency) reference_range / c)",
    "echo": "scipy.signal.hilbert(recorded, axis=-1), times exp(-2j pi f fast_time) if it was recorded at an "
    "intermediate frequency f",
}


def real_numbers(name: str, kind: str, least: float) -> str:
    """Describe the error about samples of a real type, with the remedy.

    Parameters
    ----------
    name : {"signal", "echo"}
    kind : str
        Their type.
    least : float
        The least of them.
    """
    if least >= 0:
        return (
            f"{name} is {kind} and nowhere negative, but must be complex64; give complex samples: magnitudes have lost "
            "the phase that an image is formed of, and of a converter's counts the middle level has to be subtracted"
        )
    return f"{name} is {kind}, but must be complex64: {_of_real(name)}"


def _of_real(name: str) -> str:
    return f"of real samples {MIRRORED}; give the analytic signal of what was recorded, {ANALYTIC[name]}"


def find_real(name: str, collection: Collection, parts: Iterable[tuple[tuple[slice, ...], ComplexArray]]) -> str | None:
    """Describe complex samples that are real, with the remedy; None if they are complex.

    As they are, or but for the phase of the reference range. Samples of one sign may be those of a single target at
    that range.

    Parameters
    ----------
    name : {"signal", "echo"}
    collection : Collection
        For the reference phase of a signal.
    parts : iterable of ((..., slice, slice), array)
        Pulses and columns, and samples (..., n_pulse, n_column) of these. Not read beyond the first that tells.
    """
    plain, turned = True, name == "signal"
    signs: set[float] = set()
    frequency = collection.carrier + collection.range_frequency
    for (*_, pulses, columns), samples in parts:
        some = np.where(np.isfinite(samples), samples, 0)
        plain = plain and not some.imag.any()
        if not plain and turned:
            cycles = 2 / SPEED_OF_LIGHT * frequency[columns] * collection.reference_range[pulses, None]
            some = some * np.exp(-2j * np.pi * np.mod(cycles, 1.0))
            turned = bool(np.linalg.norm(some.imag) <= ROUNDED * np.linalg.norm(some))
        if not (plain or turned):
            return None
        level = ROUNDED * np.abs(some.real).max(initial=0.0)
        signs.update(np.unique(np.sign(some.real[np.abs(some.real) > level])).tolist())
    if len(signs) < 2:
        return None
    if plain:
        return f"{name} has no imaginary part: {_of_real(name)}"
    return f"{name} is real but for the phase of reference_range: {_of_real(name)}"


AT_THE_EDGE = 0.05  # of the beam's width: beams that are fitted to dwells miss their edges by up to 0.03
COHERENT = 0.5  # of the energy; noise has 1 / sqrt(number of range cells)
HALF_PHASE = 0.4 * np.pi  # rad over half of the beam's width: a phase is that of one depth from -1/4 to 1 of the width
MOST_APART = 1 / 8  # of a dwell between p and q
RANGES, TURNS = 5, 2048  # nodes of range over the window, and of angle about the antenna's foot


def missing_pulses(
    empty: BoolArray, known: BoolArray, collection: Collection, read: Callable[[int], ComplexArray]
) -> BoolArray:
    """Tell which pulses that hold zeros only were lost.

    Parameters
    ----------
    empty : (n_pulse,) bool
        Pulses whose samples are all zero.
    known : (n_pulse,) bool
        False for pulses that are missing anyway, which tell nothing.
    collection : Collection
    read : function (pulse)
        Samples of a pulse, (n_range_frequency,) complex64.

    Returns
    -------
    (n_pulse,) bool
        True only where `empty` is. Nothing is missing if all pulses are empty.
    """
    missing = np.zeros(empty.shape, np.bool_)
    empty = empty & known
    dark = empty | ~known
    if dark.all() or not empty.any():
        return missing
    if collection.beam_width is None:
        return empty.copy()
    geometry = Geometry(collection=collection)
    middle = [edge for way in (-1, 1) for edge in _edges(geometry, empty.size // 2, way)]
    runs = np.flatnonzero(np.diff(dark, prepend=False, append=False)).reshape(-1, 2)
    ends = np.concatenate([[0], runs.ravel(), [empty.size]]).reshape(-1, 2)  # of the pulses between the zeros
    for number, (first, last) in enumerate(runs):
        if not empty[first:last].any():
            continue
        for (begin, end), pulse, way in ((ends[number], first - 1, -1), (ends[number + 1], last, 1)):
            if begin == end:
                continue  # nothing but zeros up to the end of the collection
            if end - begin <= max((edge.apart for edge in middle), default=0):
                reach = int(np.ceil(max(edge.dwell for edge in middle)))
            else:
                reach = _lit_beside(geometry, int(pulse), way, int(end - begin), read)
            missing[slice(first, min(first + reach, last)) if way < 0 else slice(max(last - reach, first), last)] = True
    return missing & empty


def _lit_beside(geometry: Geometry, pulse: int, way: int, length: int, read: Callable[[int], ComplexArray]) -> int:
    """Number of zero pulses next to a pulse that would also contain its echoes; `n_pulse`, all, for noise.

    `way` leads away from the zeros, over `length` pulses with echoes: 1 if the zeros come before them, -1 if after.
    """
    reaches = [geometry.collection.n_pulse]
    for edge in _edges(geometry, pulse, way):
        if edge.apart >= length:
            reaches.append(int(np.ceil(edge.dwell)))
            continue
        coherence, phase = _phase_change(geometry.collection, edge, read(pulse), read(pulse + way * edge.apart))
        if coherence < COHERENT:
            continue
        whole = 2 * edge.half_phase
        turn = abs(2 * np.pi / whole)
        depth = float(np.mod(phase / whole + AT_THE_EDGE, turn)) - AT_THE_EDGE
        outside = depth <= AT_THE_EDGE or depth > 1 + AT_THE_EDGE
        reaches.append(0 if outside else int(np.ceil(2 * depth * edge.dwell)) + 1)
    return min(reaches)


class _Edge(NamedTuple):
    """Edge of the beam that scatterers cross when they enter or leave it, on one side of the track."""

    offset: FloatArray  # (n_range,) m about the reference range
    change: FloatArray  # (n_range,) m: d at the edge, from the pulse to the one `apart`
    half_phase: float  # rad, signed: of conj(s_p) s_q at the beam's centre, over that at the edge
    apart: int  # pulses
    dwell: float  # pulses


def _edges(geometry: Geometry, pulse: int, way: int) -> list[_Edge]:
    """Find the edges that meet the ground within the range window, on both sides of the track if it is unknown."""
    collection, found = geometry.collection, []
    side = {"left": 1, "right": -1}.get((imaged_side(geometry) if collection.has_axis else None) or "", 0)
    ahead = collection.antenna_position[-1] - collection.antenna_position[0]
    half = (collection.beam_width or 0.0) / 2
    offset, places = _places(geometry, pulse, (-half, half, 0.0))
    for sign, edge in ((sign, edge) for sign, some in zip((-1, 1), places, strict=False) for edge in some):
        known = np.flatnonzero(np.isfinite(edge[:, 0]))
        middle = int(known[known.size // 2])
        sight = edge[middle] - collection.antenna_position[pulse]
        if side * (ahead[0] * sight[1] - ahead[1] * sight[0]) < 0:
            continue
        moved = _offset_rate(geometry, edge[middle], pulse)
        centres = np.array([centre[middle] for centre in places[2]]).reshape(-1, 3)
        away = np.linalg.norm(centres - edge[middle], axis=1)
        if not sign * moved * way < 0 or not np.isfinite(away).any():
            continue  # scatterers leave over it where the others enter
        points = np.stack([edge[middle], centres[int(np.nanargmin(away))]])
        apart = 1
        for _ in range(2):
            change = _changes(collection, points, pulse, pulse + way * apart)
            phase = -4 * np.pi / collection.wavelength * float(change[1] - change[0])
            if apart == 1 and phase:
                most = max(MOST_APART * 2 * half / abs(moved), 1)
                apart = int(np.clip(np.rint(HALF_PHASE / abs(phase)), 1, most))
        if phase and 0 <= pulse + way * apart < collection.n_pulse:
            change = _changes(collection, edge[known], pulse, pulse + way * apart)
            found.append(_Edge(offset[known], change, phase, apart, 2 * half / abs(moved)))
    return found


def _places(geometry: Geometry, pulse: int, levels: Sequence[float]) -> tuple[FloatArray, list[list[FloatArray]]]:
    """Ground places with given offsets, rad, from the beam's centre, at ranges (n_range,) about the reference range, m.

    For each level there is an array of points (n_range, 3), m, for each such place about the antenna's foot, in the
    order of angles there; NaN where a range has fewer.
    """
    collection = geometry.collection
    antenna, height = collection.antenna_position[pulse], collection.ground_height
    offset = np.linspace(-0.5, 0.5, RANGES) * collection.range_window
    with np.errstate(invalid="ignore"):
        radius = np.sqrt((collection.reference_range[pulse] + offset) ** 2 - (antenna[2] - height) ** 2)
    turn = np.linspace(-np.pi, np.pi, TURNS + 1)
    x, y = (antenna[axis] + radius[:, None] * ray for axis, ray in ((0, np.cos(turn)), (1, np.sin(turn))))
    away, places = geometry.beam.offset(x, y, pulse, height), []
    for level in levels:
        above = away - level
        rise = np.diff(above, axis=1)
        passing = (above[:, :-1] * above[:, 1:] <= 0) & (above[:, :-1] != 0) & (np.abs(rise) < 1)
        rows, columns = np.nonzero(passing)
        angle = turn[columns] - above[rows, columns] / rise[rows, columns] * (turn[1] - turn[0])
        number = np.arange(rows.size) - np.searchsorted(rows, rows)
        points = np.full((int(number.max(initial=-1)) + 1, RANGES, 3), np.nan)
        points[number, rows, 0] = antenna[0] + radius[rows] * np.cos(angle)
        points[number, rows, 1] = antenna[1] + radius[rows] * np.sin(angle)
        points[number, rows, 2] = height
        places.append(list(points))
    return offset, places


def _offset_rate(geometry: Geometry, point: FloatArray, pulse: int) -> float:
    """Change of a point's offset from the beam's centre between pulses, rad."""
    around = np.clip([pulse - 1, pulse + 1], 0, geometry.collection.n_pulse - 1)
    before, after = geometry.beam.offset(point[0], point[1], around, float(point[2]))
    return float(after - before) / int(around[1] - around[0])


def _changes(collection: Collection, points: FloatArray, pulse: int, other: int) -> FloatArray:
    """d of points (n, 3) between two pulses, m (see the module); the last or first pulse stands for those beyond."""
    first, second = (
        np.linalg.norm(points - collection.antenna_position[p], axis=1) - collection.reference_range[p]
        for p in (pulse, min(max(other, 0), collection.n_pulse - 1))
    )
    return np.asarray(second - first)


def _phase_change(collection: Collection, edge: _Edge, one: ComplexArray, two: ComplexArray) -> tuple[float, float]:
    """Correlate two pulses over range cells, without the phase at the edge: magnitude (1: alike), phase, rad."""
    n = collection.n_range_frequency
    middle = float(np.median(edge.change))
    frequency = collection.carrier + collection.range_frequency
    rows = np.nan_to_num(np.stack([one, two]).astype(np.complex128), posinf=0, neginf=0) * np.hanning(n + 2)[1:-1]
    rows[1] *= np.exp(4j * np.pi / SPEED_OF_LIGHT * frequency * middle)
    cells = fft_rows(rows, inverse=True)
    place = np.mod(np.arange(n) / n + 0.5, 1) - 0.5  # of the window
    rest = np.interp(place * collection.range_window, edge.offset, edge.change) - middle
    energy = float((np.abs(cells[0]) ** 2).sum())
    product = np.conj(cells[0]) * cells[1] * np.exp(4j * np.pi / collection.wavelength * rest)
    mean = complex(product.sum()) / energy if energy > 0 else 0j
    return abs(mean), float(np.angle(mean))
