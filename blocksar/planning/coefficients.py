"""Choice of a block's coefficients: several kinds of chain are fitted, and the cheapest good one is chosen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.focusing.lines import AzimuthPolynomials, Line, focus
from blocksar.focusing.method import Method
from blocksar.planning import closed_form, fitting
from blocksar.planning.binding import AzimuthPart, RangePart
from blocksar.planning.fitting import Candidate


def choose(
    geometry: Geometry,
    line: Line,
    range_part: RangePart,
    method: Method,
    *,
    ranges: FloatArray,
    epoch_range: FloatArray,
    yaws: FloatArray,
    shift: float,
    candidate: Candidate | None,
) -> tuple[AzimuthPolynomials, Candidate]:
    """Coefficients by the method: in closed form, or of the cheapest fitted chain whose lines end level and unfolded.

    Parameters
    ----------
    geometry : Geometry
    line : Line
        (n_range, n_yaw, n) after range compression; row i belongs to apparent range ranges[i].
    range_part : RangePart
    method : Method
    ranges : (n_range,) float
        Ascending, m from the range origin.
    epoch_range : (n_range, n_yaw) float
        Epoch ranges of the targets that come to lie there, m.
    yaws : (n_yaw,) float
        rad.
    shift : float
        Doppler that recovery and the range part remove from every line, Hz.
    candidate : Candidate or None
        The kind of chain; None to choose it.
    """
    lam, freedom = geometry.collection.wavelength, range_part.freedom
    if method.coefficients == "closed-form":
        polynomials = closed_form.levelling(
            geometry, freedom, epoch_range=epoch_range, ranges=ranges, yaws=yaws, shift=shift,
            in_doppler=range_part.compression.in_doppler, range_model=method.range_model,
        )  # fmt: skip
        return polynomials, Candidate(0.0, False)
    chosen = candidate or _find_cheapest(line, range_part, ranges=ranges, wavelength=lam)
    return fitting.fit(line, ranges=ranges, candidate=chosen, freedom=freedom, wavelength=lam), chosen


def _find_cheapest(line: Line, range_part: RangePart, *, ranges: FloatArray, wavelength: float) -> Candidate:
    """The kind of chain with the least cost: phase error or loss above the good ones, times the growth in samples."""
    freedom = range_part.freedom
    rows = np.array([0, ranges.size // 2, ranges.size - 1])
    subset = Line(**{name: _pick(getattr(line, name), rows, ranges.size) for name in Line.__dataclass_fields__})
    best: tuple[float, Candidate] | None = None
    kinds = fitting.candidates(line, wavelength=wavelength, freedom=freedom)
    if len(kinds) == 1:
        return kinds[0]
    for candidate in kinds:
        polynomials = fitting.fit(
            subset, ranges=ranges[rows], candidate=candidate, freedom=freedom, wavelength=wavelength, roughly=True
        )
        azimuth = AzimuthPart.bind(range_part, polynomials, subset)
        biased, traced = azimuth.perturb_time(subset), azimuth.trace(subset)
        spread = biased.rate * subset.weight.sum(axis=-1, keepdims=True) ** 2
        if traced.folded or not np.isfinite(traced.time).all():
            continue
        if spread.min() * spread.max() < 0:
            continue
        residual = float(focus(traced).residual.max())
        loss = float(fitting.end_loss(traced, biased.rate).max())
        length = np.ptp(traced.time) / np.ptp(subset.time)
        fault = max(residual / fitting.GOOD_RESIDUAL, loss / fitting.GOOD_LOSS, 1.0)
        growth = max(length, 1.0) * max(np.ptp(biased.doppler) / np.ptp(subset.doppler), 1.0)
        cost = fault * growth
        if best is None or cost < 0.9 * best[0]:
            best = (cost, candidate)
        if fault <= 1.0 and growth < 2.5:
            break
    return Candidate(0.0, freedom.time) if best is None else best[1]


def _pick(values: FloatArray, which: NDArray[np.intp], size: int) -> FloatArray:
    """Some rows of an array (size, ...); arrays that broadcast along rows are returned unchanged."""
    return values[which] if values.shape[0] == size else values
