"""Planning of a block's gates: the range gate of a sub-block, and the dwell gate of the final transform."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import Focus, Line, RowPolynomial
from blocksar.focusing.range_steps import RangeGate
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.planning.target_lines import middle_line

RANGE_GUARD = 48  # range cells on either side of a sub-block, for side lobes of targets at its ends
GATE_ROOM = 1.62  # dwells that the sampling in Doppler has room for


def plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """The gate that holds the ranges of lines (n_range, n_yaw) at each Doppler, with room for side lobes."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # In a Doppler bin the ends of the band belong to other times than the carrier: a smear that SRC removes later.
    edge = max(abs(full.start), abs(full.start + full.extent)) / carrier
    rate = np.maximum(np.abs(line.rate), 1e-3 * np.abs(line.rate).max())
    smear = SPEED_OF_LIGHT / (2 * carrier) * line.doppler**2 / rate * edge
    cell = SPEED_OF_LIGHT / (2 * full.extent)
    low = float((spread - np.abs(smear)).min()) - RANGE_GUARD * cell
    high = float((spread + np.abs(smear)).max()) + RANGE_GUARD * cell
    period = fourier.fast_length(full.size)
    step = 1 / (period * full.step)
    size, n_frequency = _gate_length((high - low) * 2 / SPEED_OF_LIGHT / step, full.size / period, period)
    gate = fourier.centred((low + high) / SPEED_OF_LIGHT, step, size)
    coarse = 1 / (size * step)
    ramp = np.clip((np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / (RANGE_GUARD / 2), 0, 1)
    normalised = np.clip((2 * slab.values - 2 * slab.start - slab.extent) / slab.extent, u.min(), u.max())
    return RangeGate(
        slab=slab,
        centre=np.asarray(chebyshev.chebval(normalised, centre)),
        gate=gate,
        window=np.sin(np.pi / 2 * ramp) ** 2,
        full=full,
        range_frequency=Axis(full.start - full.step / 2 + coarse / 2, coarse, n_frequency),
    )


def _gate_length(needed: float, share: float, at_most: int) -> tuple[int, int]:
    """A fast length of about `needed` samples, and the number of its frequencies that fits the band best."""
    lengths = {fourier.fast_length(n) for n in np.linspace(needed, 1.06 * needed + 8, 24)}
    lengths = {n for n in lengths if n < at_most} or {at_most}
    return min(((n, round(n * share)) for n in lengths), key=lambda pair: abs(pair[1] / pair[0] / share - 1))


def plan_gate(line: Line, spots: Focus, *, rows: Axis, slow: Axis) -> DwellGate | None:
    """The gate that follows the middles of the dwells along Doppler, from the lines (n_range, n_yaw) with full dwell.

    Targets with a dwell cut by the ends of the collection are gated as if it continued. None where all targets dwell at
    the same time, as under a beam that is not steered: a gate could not separate them.
    """
    weight = line.weight * line.stretch
    lengths = weight.sum(axis=-1)
    middles = (weight * line.time).sum(axis=-1) / lengths
    if np.ptp(middles) < 0.02 * lengths.max():
        return None
    lit = line.weight.sum(axis=-1)[0]
    full = lit >= 0.999 * lit.max()
    if full.sum() < 6:  # a narrow block at an end of the swath has cut dwells only
        full = np.ones_like(full)
    doppler = spots.doppler[:, full]
    centre, scale = float((doppler.min() + doppler.max()) / 2), max(float(np.ptp(spots.doppler) / 2), 1e-6)
    near, far = rows.start, rows.start + rows.extent
    u = (2 * spots.range[:, full] - near - far) / (far - near)
    z = (doppler - centre) / scale
    basis = chebyshev.chebvander2d(u.ravel(), z.ravel(), [2, 3])
    series = solvers.least_squares(
        np.asarray(basis.T, np.float64), middles[:, full].ravel(), damping=1e-20 * u.size
    ).reshape(3, 4)
    powers = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [-1, 0, 2, 0], [0, -3, 0, 4]], dtype=float)
    series = solvers.product(series, powers)  # from Chebyshev to powers of z
    integral = np.zeros((3, 5))
    integral[:, 1:] = series / np.arange(1, 5) * scale
    phase = RowPolynomial(series=integral, near=near, far=far, centre=centre, scale=scale)
    at_middle = phase.coefficients(np.array((near + far) / 2))[None]
    common = RowPolynomial(series=at_middle, near=near, far=far, centre=centre, scale=scale)
    slope = RowPolynomial(series=series[:, 1:2] / scale, near=near, far=far, centre=centre, scale=scale)
    # The longest dwell: a gate that cuts one costs width and amplitude, a gate slightly too wide only some coherence.
    length = float(lengths[:, full].max())
    _, own, _ = phase.evaluate(spots.range, spots.doppler[..., None])
    _, shared, _ = common.evaluate(spots.range, spots.doppler[..., None])
    apart = float(np.abs(own - shared).max())
    size = min(fourier.fast_length((GATE_ROOM * length + 2 * apart) / slow.step), slow.size)
    return DwellGate(phase=phase, common=common, slope=slope, length=length, time=fourier.centred(0.0, slow.step, size))
