"""Spectra over the dwell of the looks of a run: each should fill its own part of the dwell, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.measurement.dwell_spectrum import dwell_spectrum, shares
from blocksar.runs.finished import FinishedRun

CHIP, LEAST_CHIP = 128, 16  # pixels along a side, at most and at least
PLACES = 5  # along each side of the image, at which chips are tried, beside the targets
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
    """Measure the spectra of the looks of a run; None where no chip is covered by all, or its pixels are too coarse."""
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
    """Rows and columns of chips over the image and about targets."""
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
