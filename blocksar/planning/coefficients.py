"""The choice of a block's coefficients: several kinds of chain are fitted, the cheapest good one is taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.focusing.lines import Line, focus
from blocksar.planning import closed_form, fitting
from blocksar.planning.binding import Binding
from blocksar.planning.fitting import Candidate


def choose(
    geometry: Geometry,
    line: Line,
    chain: Binding,
    *,
    ranges: FloatArray,
    epoch_range: FloatArray,
    yaws: FloatArray,
    shift: float,
    candidate: Candidate | None,
) -> Candidate:
    """Give the chain its coefficients as asked: among fitted ones the cheapest whose lines end level and unfolded."""
    lam, freedom = geometry.collection.wavelength, chain.freedom
    if chain.method.coefficients == "closed-form":
        chain.polynomials = closed_form.levelling(
            geometry, freedom, epoch_range=epoch_range, ranges=ranges, yaws=yaws, shift=shift,
            in_doppler=chain.in_doppler, range_model=chain.method.range_model,
        )  # fmt: skip
        return Candidate(0.0, False)
    chosen = candidate or _cheapest(line, chain, ranges=ranges, wavelength=lam)
    chain.polynomials = fitting.fit(line, ranges=ranges, candidate=chosen, freedom=freedom, wavelength=lam)
    return chosen


def _cheapest(line: Line, chain: Binding, *, ranges: FloatArray, wavelength: float) -> Candidate:
    freedom = chain.freedom
    some = np.array([0, ranges.size // 2, ranges.size - 1])
    part = Line(**{name: _pick(getattr(line, name), some, ranges.size) for name in Line.__dataclass_fields__})
    best: tuple[float, Candidate] | None = None
    tried = fitting.candidates(line, wavelength=wavelength, freedom=freedom)
    if len(tried) == 1:
        return tried[0]
    for candidate in tried:
        chain.polynomials = fitting.fit(
            part, ranges=ranges[some], candidate=candidate, freedom=freedom, wavelength=wavelength, roughly=True
        )
        biased = chain.perturbed(part)
        traced = chain.trace_azimuth(part)
        spread = biased.rate * part.weight.sum(axis=-1, keepdims=True) ** 2
        if traced.folded or not np.isfinite(traced.time).all():
            continue
        if spread.min() * spread.max() < 0:
            continue
        residual = float(focus(traced).residual.max())
        loss = float(fitting.end_loss(traced, biased.rate).max())
        length = np.ptp(traced.time) / np.ptp(part.time)
        fault = max(residual / fitting.GOOD_RESIDUAL, loss / fitting.GOOD_LOSS, 1.0)
        growth = max(length, 1.0) * max(np.ptp(biased.doppler) / np.ptp(part.doppler), 1.0)
        cost = fault * growth
        if best is None or cost < 0.9 * best[0]:
            best = (cost, candidate)
        if fault <= 1.0 and growth < 2.5:
            break
    return Candidate(0.0, freedom.time) if best is None else best[1]


def _pick(values: FloatArray, which: NDArray[np.intp], size: int) -> FloatArray:
    return values[which] if values.shape[0] == size else values
