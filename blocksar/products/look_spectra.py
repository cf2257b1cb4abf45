"""Spectra of a run's looks over the dwell, which show whether each look fills exactly its own part.

A pixel's wave vector on the ground is K = 2 (fc + f) / c u(t), with u the horizontal part of the unit vector from the
antenna to it. Its direction depends on time alone, and its length tells the range frequency. So the power of a chip's
two-dimensional spectrum, sorted by the direction of K, is the spectrum over the dwell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import fft_rows
from blocksar.runs.finished import FinishedRun

BINS, BEYOND = 96, 0.25  # of the spectrum; share of the dwell that it shows on either side
PADDED = 256  # samples of a chip's spectrum along each axis, at least
TIMES = 129  # of the dwell, between which directions are interpolated

SpanAt = Callable[[float, float], tuple[float, float]]  # x, y (m) -> start and end of the dwell, s


def shares() -> FloatArray:
    """Middles of the bins: 0 is the beginning of the dwell, 1 its end."""
    edges = np.linspace(-BEYOND, 1 + BEYOND, BINS + 1)
    return np.asarray((edges[1:] + edges[:-1]) / 2)


def dwell_spectrum(
    chip: ComplexArray, x: FloatArray, y: FloatArray, geometry: Geometry, span_at: SpanAt
) -> FloatArray | None:
    """Mean power of a chip's spectrum over the dwell, (BINS,).

    Parameters
    ----------
    chip : (n_y, n_x) complex
        Pixels, all covered; they hold the carrier's phase.
    x, y : (n_x,), (n_y,) float
        m.
    geometry : Geometry
    span_at : callable
        The dwell of a ground point.

    Returns
    -------
    (BINS,) float or None
        NaN where the chip's spectrum has no sample; None if the pixels are too far apart for the band.
    """
    half = geometry.collection.bandwidth / 2
    middle = np.array([x[x.size // 2], y[y.size // 2]])
    start, end = span_at(*middle)
    time = np.linspace(start - BEYOND * (end - start), end + BEYOND * (end - start), TIMES)
    sight = _sight(geometry, middle, time)
    lit = sight[(time >= start) & (time <= end)]
    support = 2 / SPEED_OF_LIGHT * np.concatenate([(geometry.collection.carrier + f) * lit for f in (-half, half)])
    if (np.ptp(support, axis=0) * (abs(x[1] - x[0]), abs(y[1] - y[0])) > 1).any():
        return None
    carrier, turn = _wave_vector(geometry, span_at, middle), _turn(geometry, span_at, middle, x, y)
    at = np.stack(np.meshgrid(x - middle[0], y - middle[1]), axis=-1)
    phase = 2 * np.pi * (at @ carrier + np.einsum("...i,ij,...j", at, turn, at) / 2)
    taper = np.multiply.outer(np.hanning(y.size), np.hanning(x.size))
    # Padded, so that every bin has samples.
    padded = np.zeros((max(y.size, PADDED), max(x.size, PADDED)), np.complex128)
    padded[: y.size, : x.size] = chip * np.exp(-1j * phase) * taper
    along_x = fft_rows(padded, inverse=False)
    power = np.abs(fft_rows(np.ascontiguousarray(along_x.T), inverse=False).T) ** 2
    k_x, k_y = np.meshgrid(
        *(k + _frequencies(n, axis) for k, n, axis in zip(carrier, power.shape[::-1], (x, y), strict=True))
    )
    return _by_share(k_x, k_y, power, sight, geometry.collection.carrier + np.array([-half, half]))


def _frequencies(n: int, axis: FloatArray) -> FloatArray:
    """Frequencies of the samples of a transform of length n, cycles/m, half of them negative."""
    return (np.arange(n) + n // 2) % n / (n * (axis[1] - axis[0])) - n // 2 / (n * (axis[1] - axis[0]))


def _by_share(k_x: FloatArray, k_y: FloatArray, power: FloatArray, sight: FloatArray, band: FloatArray) -> FloatArray:
    """Mean power of wave vectors within the band, Hz, in bins of the share of the dwell given by their directions."""
    direction = np.unwrap(np.arctan2(sight[:, 1], sight[:, 0]))
    order = np.argsort(direction)
    centre = direction[TIMES // 2]
    turned = centre + np.angle(np.exp(1j * (np.arctan2(k_y, k_x) - centre)))
    share = np.linspace(-BEYOND, 1 + BEYOND, TIMES)
    at = np.interp(turned, direction[order], share[order], left=np.nan, right=np.nan)
    length = np.interp(turned, direction[order], np.linalg.norm(sight, axis=1)[order])
    frequency = SPEED_OF_LIGHT / 2 * np.hypot(k_x, k_y) / length
    used = np.isfinite(at) & (frequency > band[0]) & (frequency < band[1])
    edges = np.linspace(-BEYOND, 1 + BEYOND, BINS + 1)
    total, _ = np.histogram(at[used], edges, weights=power[used])
    count, _ = np.histogram(at[used], edges)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _sight(geometry: Geometry, place: FloatArray, time: FloatArray) -> FloatArray:
    """Horizontal components (n, 2) of unit vectors from the antenna at times (n,) to a ground point (2,)."""
    height = float(geometry.height(*np.asarray(place, np.float64)))
    sight = np.array([*place, height]) - geometry.track.position(time)
    return np.asarray((sight / np.linalg.norm(sight, axis=-1, keepdims=True))[..., :2])


def _wave_vector(geometry: Geometry, span_at: SpanAt, place: FloatArray) -> FloatArray:
    """Wave vector (2,), cycles/m, at the carrier and the middle of the dwell of a ground point."""
    middle = sum(span_at(*place)) / 2
    return 2 * geometry.collection.carrier / SPEED_OF_LIGHT * _sight(geometry, place, np.array([middle]))[0]


def _turn(geometry: Geometry, span_at: SpanAt, middle: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Change of the wave vector between pixels, (2, 2) symmetric, cycles/m^2."""
    columns = []
    for axis, places in enumerate((x, y)):
        step = np.zeros(2)
        step[axis] = np.ptp(places) / 2
        ahead, behind = (_wave_vector(geometry, span_at, middle + sign * step) for sign in (1, -1))
        columns.append((ahead - behind) / np.ptp(places))
    jacobian = np.stack(columns, axis=1)
    return np.asarray((jacobian + jacobian.T) / 2)


CHIP, LEAST_CHIP = 128, 16  # pixels along a side, at most and at least
PLACES = 5  # along each side of the image, at which chips are tried, in addition to targets
MOST_TARGETS = 16


class LookSpectra(NamedTuple):
    """Spectra of n looks, summed over chips.

    Attributes
    ----------
    names : tuple of str
    share : (n_bin,) float
        Of the dwell: 0 is its beginning, 1 its end.
    power : (n, n_bin) float
        Over the largest of each look.
    parts : (n, 2) float
        Beginning and end of each look's own part of the dwell.
    within : (n,) float
        Share of each look's power that lies in its own part.
    """

    names: tuple[str, ...]
    share: FloatArray
    power: FloatArray
    parts: FloatArray
    within: FloatArray


def measure_looks(looks: Sequence[FinishedRun]) -> LookSpectra | None:
    """Measure the spectra of a run's looks; None if no chip is covered by all looks, or pixels are too coarse."""
    first, share = looks[0], shares()
    total = np.zeros((len(looks), share.size))
    parts: list[FloatArray] = []
    for rows, columns in _chips(first):
        chips = [look.read(rows, columns) for look in looks]
        if not all(np.isfinite(chip).all() for chip in chips):
            continue
        x, y = first.x[columns], first.y[rows]
        start, end = _span(looks, (float(x[x.size // 2]), float(y[y.size // 2])))
        if not start < end:
            continue
        spectra = [
            dwell_spectrum(chip, x, y, look.geometry, lambda *at: _span(looks, at))
            for chip, look in zip(chips, looks, strict=True)
        ]
        for number, spectrum in enumerate(spectra):
            if spectrum is None:
                return None
            total[number] += np.nan_to_num(spectrum)
        spans = [_part(look, (float(x[x.size // 2]), float(y[y.size // 2]))) for look in looks]
        parts.append((np.array(spans) - start) / (end - start))
    if not parts or not (total.sum(axis=1) > 0).all():
        return None
    mean = np.mean(parts, axis=0)
    own = (share >= mean[:, :1]) & (share <= mean[:, 1:])
    return LookSpectra(
        names=tuple(str(look.attrs.get("look", look.folder.name)) for look in looks),
        share=share,
        power=total / total.max(axis=1, keepdims=True),
        parts=mean,
        within=(total * own).sum(axis=1) / total.sum(axis=1),
    )


def _chips(run: FinishedRun) -> Iterator[tuple[slice, slice]]:
    """Iterate over rows and columns of chips, spread over the image and about targets."""
    side = min(CHIP, run.x.size, run.y.size)
    if side < LEAST_CHIP:
        return
    rows, columns = (np.linspace(0, axis.size - side, PLACES).round().astype(int) for axis in (run.y, run.x))
    corners = [(int(row), int(column)) for row in rows for column in columns]
    for target in list(run.attrs.get("targets") or [])[:MOST_TARGETS]:
        at = (int(np.abs(axis - target[name]).argmin()) - side // 2 for axis, name in ((run.y, "y"), (run.x, "x")))
        row, column = (min(max(k, 0), axis.size - side) for k, axis in zip(at, (run.y, run.x), strict=True))
        corners.append((row, column))
    for row, column in dict.fromkeys(corners):
        yield slice(row, row + side), slice(column, column + side)


def _part(look: FinishedRun, place: tuple[float, float]) -> tuple[float, float]:
    """Start and end, s, of a ground point's dwell in a look."""
    first, last = look.geometry.beam.dwell(*map(np.array, place))
    return float(first), float(last)


def _span(looks: Sequence[FinishedRun], place: tuple[float, float]) -> tuple[float, float]:
    """Start and end, s, of a ground point's dwell in all looks."""
    return _part(looks[0], place)[0], _part(looks[-1], place)[1]
