"""The response of a point target: its image chip, band-limited interpolation, and its range and azimuth axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import CUT_WIDTHS, UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.axes import MIN_OVERSAMPLING, ResponseAxes, response_axes
from blocksar.measurement.targets import Target

ReadChip = Callable[[slice, slice], ComplexArray]  # (slice of y, slice of x) -> pixels
SEARCH_WIDTHS = 2.0  # widths searched for the peak on either side of the true position

MIN_HALF_TAPS = 12
KAISER_BETA = 12.0  # interpolation error about exp(-12) = 6e-6 of the peak
NO_WEIGHT = 1e-6  # of taps that may be missing: those of a point on a pixel, all but this pixel's own
MAX_CHIP = 1024  # pixels per side: a target lit so briefly that it needs more has no usable response


def carrier_phase(
    geometry: Geometry, time: float, x: float, y: float, *, at_x: FloatArray, at_y: FloatArray
) -> FloatArray:
    """4 pi fc/c (R_p(time) - R_q(time)) in rad, of points p = (at_x, at_y) (broadcast) relative to q = (x, y)."""
    collection = geometry.collection
    point, origin = geometry.on_ground(at_x, at_y), geometry.on_ground(np.array(x), np.array(y))
    when = np.array(time)
    difference = geometry.range_history(point, when)[0] - geometry.range_history(origin, when)[0]
    return 4 * np.pi * collection.carrier / SPEED_OF_LIGHT * difference


def interpolate(
    values: Complex128Array, *, row: FloatArray, column: FloatArray, half_taps: int = MIN_HALF_TAPS
) -> Complex128Array:
    """Interpolate a band-limited chip with a Kaiser-windowed sinc.

    Parameters
    ----------
    values : (n_row, n_column) complex
        Samples; NaN = missing. Largest |wavenumber| at most 1/2 - 12 / (2 pi half_taps) cycles/sample, for an
        error of about 1e-5 of the strongest sample.
    row, column : (n,) float
        Fractional indices.
    half_taps : int
        Taps on either side.

    Returns
    -------
    (n,) complex128
        NaN where a tap falls on a missing sample or outside; a point on a sample needs only this one.
    """
    row, column = np.asarray(row, dtype=np.float64), np.asarray(column, dtype=np.float64)
    bordered = np.pad(values, half_taps, constant_values=np.nan)
    missing = ~np.isfinite(bordered)
    bordered[missing] = 0
    out = np.full(row.shape, np.nan + 0j)
    inside = (row >= 0) & (row <= values.shape[0] - 1) & (column >= 0) & (column <= values.shape[1] - 1)
    where = np.flatnonzero(inside)
    for batch in np.array_split(where, max(1, where.size // 2048)):  # bounds the gathered taps to some 20 MB
        rows, row_weight = _taps(row[batch], half_taps)
        columns, column_weight = _taps(column[batch], half_taps)
        pick = (rows[:, :, None], columns[:, None, :])
        values_at = np.einsum("ni,nij,nj->n", row_weight, bordered[pick], column_weight, optimize=True)
        gone = missing[pick]
        lost = np.flatnonzero(gone.any(axis=(1, 2)))
        weight = np.einsum("ni,nij,nj->n", np.abs(row_weight[lost]), gone[lost], np.abs(column_weight[lost]))
        values_at[lost[weight > NO_WEIGHT]] = np.nan
        out[batch] = values_at
    return out


def _taps(index: FloatArray, half_taps: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Sample indices in the bordered chip and weights, both (n, 2 half_taps)."""
    base = np.floor(index).astype(np.intp)
    offset = np.arange(1 - half_taps, half_taps + 1)
    u = index[:, None] - (base[:, None] + offset)
    window = i0(KAISER_BETA * np.sqrt(np.maximum(1 - (u / half_taps) ** 2, 0))) / i0(KAISER_BETA)
    return base[:, None] + offset + half_taps, np.sinc(u) * window


def _half_taps(band: float) -> int:
    """Taps on either side that interpolate wavenumbers up to `band` cycles/sample to the Kaiser window's accuracy."""
    return max(MIN_HALF_TAPS, int(np.ceil(KAISER_BETA / (np.pi * (1 - 2 * band)))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """The chip about one target with its carrier removed, ready for interpolation at any point.

    Attributes
    ----------
    target : Target
    axes : ResponseAxes
    geometry : Geometry
    values : (n_y, n_x) complex128
        Demodulated and divided by the target's reflectivity; NaN = missing.
    x, y : (n_x,), (n_y,) float
        Pixel positions, m, uniform; they may reach beyond the image.
    full_dwell : bool
        Whether the beam swept over the whole target.
    """

    target: Target
    axes: ResponseAxes
    geometry: Geometry
    values: Complex128Array
    x: FloatArray
    y: FloatArray
    full_dwell: bool

    @cached_property
    def spacing(self) -> tuple[float, float]:
        """Pixel spacing in x and y, m."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @cached_property
    def half_taps(self) -> int:
        """Interpolation taps on either side that the response's band needs."""
        dx, dy = self.spacing
        return _half_taps(max(self.axes.band[0] * abs(dx), self.axes.band[1] * abs(dy)))

    def at(self, x: FloatArray, y: FloatArray) -> Complex128Array:
        """Interpolated response at scene positions (broadcast, m); NaN where pixels are missing."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        dx, dy = self.spacing
        row, column = (y.ravel() - self.y[0]) / dy, (x.ravel() - self.x[0]) / dx
        return interpolate(self.values, row=row, column=column, half_taps=self.half_taps).reshape(x.shape)

    def at_own(
        self, centre: tuple[float, float], range_offset: FloatArray, azimuth_offset: FloatArray
    ) -> Complex128Array:
        """Response at offsets (m) from `centre` = (x, y) along its own axes (broadcast)."""
        dx, dy = self.axes.ground_offset(range_offset, azimuth_offset)
        return self.at(centre[0] + dx, centre[1] + dy)

    @cached_property
    def peak(self) -> tuple[float, float]:
        """(x, y) of the largest magnitude near the target, m; NaN if pixels around it are missing.

        Found as the strongest pixel within 2 widths, then the strongest point of a fine grid about it, then by Newton
        steps on the interpolated power.
        """
        axes, target = self.axes, self.target
        own = axes.own_offset(self.x[None, :] - target.x, self.y[:, None] - target.y)
        near = (np.abs(own[0]) <= SEARCH_WIDTHS * axes.range_width) & (
            np.abs(own[1]) <= SEARCH_WIDTHS * axes.azimuth_width
        )
        power = np.where(near & np.isfinite(self.values), np.abs(self.values) ** 2, -1.0)
        row, column = np.unravel_index(int(power.argmax()), power.shape)
        if power[row, column] <= 0:
            return float("nan"), float("nan")
        fine = np.linspace(-1, 1, 9)
        x, y = np.meshgrid(self.x[column] + self.spacing[0] * fine, self.y[row] + self.spacing[1] * fine)
        power = np.nan_to_num(np.abs(self.at(x, y)), nan=-1.0)
        best = np.unravel_index(int(power.argmax()), power.shape)
        if power[best] < 0:
            return float("nan"), float("nan")
        return self._climb(float(x[best]), float(y[best]))

    def _climb(self, x: float, y: float) -> tuple[float, float]:
        """Find the maximum of |response|^2 by Newton's method, in units of the nominal widths."""
        axes = self.axes
        unit = np.array([axes.range_width, axes.azimuth_width])
        h = 0.02  # widths: small compared with the main lobe, large compared with the rounding of the samples
        stencil = h * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
        for _ in range(8):
            p = np.abs(self.at_own((x, y), stencil[:, 0] * unit[0], stencil[:, 1] * unit[1])) ** 2
            if not np.isfinite(p).all():
                return float("nan"), float("nan")
            gradient = np.array([p[1] - p[2], p[3] - p[4]]) / (2 * h)
            cross = (p[5] + p[6] - p[7] - p[8]) / (4 * h * h)
            hessian = np.array([[p[1] + p[2] - 2 * p[0], 0], [0, p[3] + p[4] - 2 * p[0]]]) / h**2
            hessian[0, 1] = hessian[1, 0] = cross
            if hessian[0, 0] >= 0 or np.linalg.det(hessian) <= 0:
                break  # not near a smooth maximum: keep the strongest point so far
            step = np.clip(-np.linalg.solve(hessian, gradient), -0.25, 0.25)
            dx, dy = axes.ground_offset(*(step * unit))
            x, y = x + float(dx), y + float(dy)
            if np.abs(step).max() < 1e-6:
                break
        return x, y


class _Window(NamedTuple):
    """Consecutive pixels along an axis, and a mask of those that the image holds."""

    position: FloatArray  # m, of every pixel, inside the image or not
    image: slice  # the pixels of the image inside the window
    chip: slice  # their place in the window


def _window(axis: FloatArray, centre: float, reach: float) -> _Window:
    """The pixels within `reach` (m) of `centre`, on an axis continued beyond its ends."""
    step = float(axis[-1] - axis[0]) / (axis.size - 1)
    first = int(np.floor((centre - reach - axis[0]) / step))
    last = int(np.ceil((centre + reach - axis[0]) / step)) + 1
    low, high = max(first, 0), min(last, axis.size)
    high = max(low, high)
    position = float(axis[0]) + step * np.arange(first, last, dtype=np.float64)
    return _Window(position=position, image=slice(low, high), chip=slice(low - first, high - first))


def read_response(
    read_chip: ReadChip,
    image_x: FloatArray,
    image_y: FloatArray,
    geometry: Geometry,
    target: Target,
    weighting: Weighting = UNIFORM,
) -> Response | None:
    """Read the chip about a target and remove its carrier.

    Parameters
    ----------
    read_chip : callable
        (slice of y, slice of x) -> complex pixels of the calibrated image, NaN where not covered. Called for the
        part that the cuts need.
    image_x, image_y : (n_x,), (n_y,) float
        Pixel positions, m; uniform, ascending.
    geometry : Geometry
    target : Target
    weighting : Weighting
        Tapers with which the image was made.

    Returns
    -------
    Response or None
        None if the target was never lit, lies outside the image, or was lit so briefly that its response
        spreads over more than 1024 pixels.

    Raises
    ------
    InputError
        If the pixels are too far apart to hold the response.
    """
    if image_x.size < 2 or image_y.size < 2:
        raise InputError(f"image has {image_y.size} x {image_x.size} pixels, but a response needs at least 2 x 2")
    axes = response_axes(geometry, target.x, target.y, weighting)
    if axes is None:
        return None
    spacing = np.array([image_x[-1] - image_x[0], image_y[-1] - image_y[0]]) / (image_x.size - 1, image_y.size - 1)
    band = axes.band * spacing
    if (2 * band * MIN_OVERSAMPLING > 1).any():
        needed = 1 / (2 * MIN_OVERSAMPLING * axes.band)
        raise InputError(
            f"the image's spacing is {spacing[0]:.4g} m in x and {spacing[1]:.4g} m in y, too coarse for the response "
            f"of target {target.name}; focus on a grid of at most {needed[0]:.4g} m and {needed[1]:.4g} m"
        )
    # The peak may lie off the true position by the search width, and the cuts start at the peak.
    along_range = axes.range_width * np.abs(axes.range_direction)
    along_azimuth = axes.azimuth_width * np.abs(axes.azimuth_direction)
    reach = SEARCH_WIDTHS * (along_range + along_azimuth) + (CUT_WIDTHS + 0.5) * np.maximum(along_range, along_azimuth)
    reach = reach + (_half_taps(float(band.max())) + 1) * spacing
    if (2 * reach / spacing > MAX_CHIP).any():
        return None
    columns = _window(image_x, target.x, float(reach[0]))
    rows = _window(image_y, target.y, float(reach[1]))
    if columns.image.start == columns.image.stop or rows.image.start == rows.image.stop:
        return None
    values = np.full((rows.position.size, columns.position.size), np.nan + 0j)
    values[rows.chip, columns.chip] = read_chip(rows.image, columns.image)
    at_x, at_y = columns.position[None, :], rows.position[:, None]
    phase = carrier_phase(geometry, axes.time, target.x, target.y, at_x=at_x, at_y=at_y)
    missing = ~np.isfinite(values)
    values = np.where(missing, 0, values) * np.exp(-1j * phase) / target.reflectivity
    values[missing] = np.nan
    return Response(
        target=target,
        axes=axes,
        geometry=geometry,
        values=values,
        x=columns.position,
        y=rows.position,
        full_dwell=bool(geometry.beam.has_full_dwell(target.x, target.y)),
    )
