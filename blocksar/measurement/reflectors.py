"""Reflectors of known radar cross-section: what the power of their responses says of an image's calibration.

Cross-sections along the axis of symmetry, for a side a and a wavelength w that is short against it (Ruck, Radar Cross
Section Handbook, 1970): of a trihedral with triangular faces, whose inner edges are a long, 4 pi a^4 / (3 w^2); of a
dihedral of two squares 8 pi a^4 / w^2; of a sphere of diameter a pi (a / 2)^2.

The power p of a response at its peak, and that of the clutter about it, c, follow from two sums: of |image|^2 over the
main lobe, within LOBE nominal widths of the peak along both axes, and over the corners, FIRST to LAST widths away along
both, where side lobes are weakest. With the ideal response h, each is p sum |h|^2 + c n. A target that peaks at 1 has
the cross-section of the reflector over p. The phase is that at the peak, without the carrier from the reflector's place
to there: a place that is wrong by d along the line of sight turns it by 4 pi d / wavelength.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.measurement.figures import ideal_response
from blocksar.measurement.response import Response
from blocksar.measurement.targets import Target

Kind = Literal["trihedral", "dihedral", "sphere"]
KINDS: tuple[Kind, ...] = get_args(Kind)
LOBE = 1.0  # widths of the response on either side of its peak
FIRST, LAST = 3.0, 8.0  # widths, between which there is clutter
PER_WIDTH = 4  # samples of the response along each axis
LEAST_CLUTTER = 1e-30  # over which the power of a response is given


class Reflector(NamedTuple):
    """A reflector at a place: `side` in m, as the module says."""

    target: Target
    kind: Kind
    side: float


class Reflected(NamedTuple):
    """Figures of a reflector's response.

    Attributes
    ----------
    cross_section : float
        m^2
    factor : float
        Cross-section of a target that peaks at 1, m^2.
    phase : float
        Of the reflector, if it lies at its place, rad.
    over_clutter : float
        Power of its peak over the mean about it.
    error_x, error_y : float
        Its peak's place less its own, m.
    """

    cross_section: float
    factor: float
    phase: float
    over_clutter: float
    error_x: float
    error_y: float


def cross_section(kind: Kind, side: float, wavelength: float) -> float:
    """Radar cross-section of a reflector along its axis of symmetry, m^2; `side` and `wavelength` in m.

    Examples
    --------
    >>> round(cross_section("trihedral", 1.0, 0.03))
    4654
    """
    if kind == "sphere":
        return math.pi * side**2 / 4
    return {"trihedral": 4 / 3, "dihedral": 8.0}[kind] * math.pi * side**4 / wavelength**2


def measure_reflector(response: Response, reflector: Reflector) -> Reflected | None:
    """Measure a reflector whose response has been read; None where pixels of it are missing or it has no peak."""
    axes, geometry, (x, y) = response.axes, response.geometry, response.peak
    if not np.isfinite([x, y]).all():
        return None
    steps = np.arange(-int(LAST * PER_WIDTH), int(LAST * PER_WIDTH) + 1) / PER_WIDTH
    v, u = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    u, v = (part[_used(u, v)] for part in (u, v))
    lobe = (np.abs(u) <= LOBE) & (np.abs(v) <= LOBE)
    along = u * axes.range_width, v * axes.azimuth_width
    image = response.at_own((x, y), *along)
    origin = reflector.target.x, reflector.target.y
    dx, dy = axes.ground_offset(*along)
    ideal = ideal_response(geometry, origin, origin[0] + dx, origin[1] + dy, axes.weighting)
    known = np.isfinite(image) & np.isfinite(ideal)
    if not known[lobe].all() or known[~lobe].sum() < 0.5 * (~lobe).sum():
        return None
    sums = [
        (float((np.abs(image[some]) ** 2).sum()), float((np.abs(ideal[some]) ** 2).sum()), int(some.sum()))
        for some in (lobe, ~lobe & known)
    ]
    (e1, h1, n1), (e2, h2, n2) = sums
    power = (e1 * n2 - e2 * n1) / (h1 * n2 - h2 * n1)
    if power <= 0:
        return None
    clutter = max((e2 - power * h2) / n2, LEAST_CLUTTER)
    section = cross_section(reflector.kind, reflector.side, geometry.collection.wavelength)
    return Reflected(
        section, section / power, float(np.angle(response.at(np.array(x), np.array(y)))), power / clutter,
        x - origin[0], y - origin[1],
    )  # fmt: skip


def _used(u: FloatArray, v: FloatArray) -> BoolArray:
    """Find which offsets, in widths, are of the main lobe or of the corners."""
    lobe = (np.abs(u) <= LOBE) & (np.abs(v) <= LOBE)
    return np.asarray(lobe | ((np.abs(u) >= FIRST) & (np.abs(v) >= FIRST)))
