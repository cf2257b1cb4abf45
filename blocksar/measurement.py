"""Measure a calibrated complex ground image: impulse responses of point targets, coherence of chips.

The stored image carries the true carrier phase. About a target q, lit around t_m, it is an envelope times
exp(+4j pi fc/c (R_p(t_m) - R_q(t_m))), tens of cycles a metre on the ground, far beyond the pixel spacing.
Every measurement therefore first takes that phase off, exactly and in float64. What is left is limited to
the wedge k(f, t) = 2 (fc + f)/c grad R(t) less its centre, so it can be interpolated; at q the phase taken
off is zero, so the value there keeps its true phase.

The response's own axes are neither x and y nor at right angles. Its range cut runs along constant Doppler
(across the direction in which grad R turns during the dwell), its azimuth cut along constant range (across
grad R at t_m).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import diric, i0

from blocksar.geometry import Geometry
from blocksar.parameters import (
    FARTHEST,
    SINC_PSLR,
    SINC_WIDTH,
    SPEED_OF_LIGHT,
    BoolArray,
    ComplexArray,
    FloatArray,
    InputError,
)

Complex128Array = NDArray[np.complex128]
ReadChip = Callable[[slice, slice], ComplexArray]  # (slice of y, slice of x) -> pixels

IDEAL_ISLR = -10.216  # dB, of sinc^2, by the definition below
CUT_WIDTHS = 10.0  # widths measured on either side of the peak
SEARCH_WIDTHS = 2.0  # widths searched for the peak on either side of the true position
SAMPLES_PER_WIDTH = 64  # of a cut: a side lobe's height is then read to 0.001 dB

MIN_HALF_TAPS = 12
KAISER_BETA = 12.0  # interpolation error about exp(-12) = 6e-6 of the peak
MIN_OVERSAMPLING = 1.2  # below it the interpolator would need ever more taps
MAX_CHIP = 1024  # pixels a side: a target lit so briefly that it needs more has no response to speak of

DEFINITIONS = f"""\
Range cut: along constant Doppler, in slant range. Azimuth cut: along constant range, on the ground.
Both are straight, pass through the peak and are in general not at right angles.
IRW: width of the main lobe at half power (-3 dB). Theory: {SINC_WIDTH:.4f} / bandwidth along the cut,
in range c / (2 B), in azimuth from the line-of-sight rotation over the target's own dwell.
PSLR: highest side lobe outside the first minima on either side of the peak and within {CUT_WIDTHS:g} theoretical
IRW of it, relative to the peak, power in dB (unweighted ideal {SINC_PSLR:.2f} dB).
ISLR: energy outside the first minima and within {CUT_WIDTHS:g} theoretical IRW on either side of the peak, over the
energy between the first minima, along the cut, in dB (unweighted ideal {IDEAL_ISLR:.1f} dB).
Position error: peak of the magnitude minus the true position, in x and y. Value: complex image interpolated at
the true position, divided by the target's reflectivity (ideal 1 + 0j). Full dwell: the beam swept wholly over
the target. Covered: no pixel is missing in what was measured; figures that touch missing pixels are NaN."""


class Target(NamedTuple):
    """A point target on the ground plane: scene-frame x, y in m, complex reflectivity."""

    name: str
    x: float
    y: float
    reflectivity: complex = 1.0

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Target:
        """From a store's `targets` attribute: {"name", "x", "y", "reflectivity": [re, im]}; the last may be absent.

        Raises
        ------
        InputError
            If a field is missing, is no number, or the reflectivity is zero.
        """
        try:
            reflectivity = record.get("reflectivity", 1.0)
            if not isinstance(reflectivity, (int, float, complex)):
                real, imaginary = reflectivity
                reflectivity = complex(float(real), float(imaginary))
            target = cls(str(record["name"]), float(record["x"]), float(record["y"]), complex(reflectivity))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(
                f"target {record!r} cannot be read; give it name, x and y in m and, if it is not 1, "
                "reflectivity as [real, imaginary]"
            ) from None
        if not (np.isfinite([target.x, target.y]).all() and np.isfinite(target.reflectivity)):
            raise InputError(f"target {record!r} has a value that is not finite; give numbers")
        if target.reflectivity == 0:
            raise InputError(f"target {target.name} has reflectivity 0, so there is nothing to measure; leave it out")
        if max(abs(target.x), abs(target.y)) > FARTHEST or not 1e-15 < abs(target.reflectivity) < 1e15:
            raise InputError(f"target {record!r} is nowhere near a scene; give metres, and a reflectivity about 1")
        return target


class PointResponse(NamedTuple):
    """What was measured at one target; `DEFINITIONS` says how. NaN where it could not be measured.

    PSLR and ISLR in dB; range widths in m of slant range, azimuth widths in m along the cut; positions and
    errors in m of the scene frame; value relative to the reflectivity, ideally 1 + 0j.
    """

    name: str
    x: float
    y: float
    range_pslr: float
    range_islr: float
    range_irw: float
    range_irw_theory: float
    azimuth_pslr: float
    azimuth_islr: float
    azimuth_irw: float
    azimuth_irw_theory: float
    error_x: float
    error_y: float
    value: complex
    full_dwell: bool
    covered: bool


@dataclass(frozen=True, kw_only=True)
class ResponseAxes:
    """Directions and theoretical widths of one target's response.

    Attributes
    ----------
    time : float
        t_m, the middle of the dwell, s.
    range_direction, azimuth_direction : (2,) float
        Ground step (dx, dy) in m for 1 m of slant range along constant Doppler, and for 1 m along constant
        range. The second is a unit vector; the first is longer than one.
    range_width, azimuth_width : float
        Theoretical IRW, m of slant range and m along the cut.
    band : (2,) float
        Largest |wavenumber| in x and y, cycles/m, of the response once its carrier is taken off.
    """

    time: float
    range_direction: FloatArray
    azimuth_direction: FloatArray
    range_width: float
    azimuth_width: float
    band: FloatArray

    def ground_offset(self, range_offset: FloatArray, azimuth_offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(dx, dy) in m on the ground, at offsets in m along the two axes (broadcast)."""
        (rx, ry), (ax, ay) = self.range_direction, self.azimuth_direction
        return range_offset * rx + azimuth_offset * ax, range_offset * ry + azimuth_offset * ay

    def own_offset(self, dx: FloatArray, dy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse of `ground_offset`."""
        (rx, ry), (ax, ay) = self.range_direction, self.azimuth_direction
        area = rx * ay - ry * ax
        return (dx * ay - dy * ax) / area, (rx * dy - ry * dx) / area


def _range_gradient(geometry: Geometry, point: FloatArray, time: FloatArray) -> FloatArray:
    """grad_xy R of a ground point (3,) at slow times (n,): (n, 2)."""
    sight = point - geometry.track.position(time)
    return np.asarray(sight[:, :2] / np.linalg.norm(sight, axis=1, keepdims=True))


def response_axes(geometry: Geometry, x: float, y: float) -> ResponseAxes | None:
    """Axes of the response of a target at x, y (m); None where it is never lit or its axes fall together.

    The azimuth band is exact for a ground gradient that turns uniformly over the dwell: it is taken between
    the first and the last lit pulse edge (`Geometry.dwell`), at the carrier.
    """
    collection = geometry.collection
    start, end = (float(edge) for edge in geometry.dwell(geometry.yaw(np.array(x), np.array(y))))
    if not start < end:
        return None
    point = np.array([x, y, collection.ground_height])
    first, middle, last = _range_gradient(geometry, point, np.array([start, (start + end) / 2, end]))
    turn = last - first
    length, turned = float(np.hypot(*middle)), float(np.hypot(*turn))
    if length == 0 or turned == 0:
        return None
    azimuth = np.array([-middle[1], middle[0]]) / length
    along_doppler = np.array([-turn[1], turn[0]]) / turned
    slope = float(along_doppler @ middle)  # dR/ds; its sign makes the cut run away from the radar
    extent = 2 * collection.carrier / SPEED_OF_LIGHT * abs(float(turn @ azimuth))
    # Both vanish together, where the line of sight turns along itself: no two-dimensional image there.
    if abs(slope) < 1e-6 * length or extent == 0:
        return None
    carrier, half_band = collection.carrier, collection.bandwidth / 2
    corners = [2 * (carrier + f) / SPEED_OF_LIGHT * k for f in (-half_band, half_band) for k in (first, middle, last)]
    band = np.abs(np.array(corners) - 2 * carrier / SPEED_OF_LIGHT * middle).max(axis=0)
    return ResponseAxes(
        time=(start + end) / 2,
        range_direction=along_doppler / slope,
        azimuth_direction=azimuth,
        range_width=SINC_WIDTH * SPEED_OF_LIGHT / (2 * collection.bandwidth),
        azimuth_width=SINC_WIDTH / extent,
        band=band,
    )


def has_full_dwell(geometry: Geometry, x: float, y: float) -> bool:
    """Whether the beam sweeps wholly over a target at x, y (m), within a pulse; true if it is not steered."""
    collection = geometry.collection
    if collection.beam_width is None:
        return True
    beam = collection.beam_azimuth
    low, high = float(beam.min()), float(beam.max())
    yaw = float(geometry.yaw(np.array(x), np.array(y)))
    yaw = (low + high) / 2 + float(np.mod(yaw - (low + high) / 2 + np.pi, 2 * np.pi)) - np.pi
    half = collection.beam_width / 2
    if low == high:
        return bool(abs(yaw - low) <= half)
    pulse = (high - low) / (collection.n_pulse - 1)
    return bool(low - pulse <= yaw - half and yaw + half <= high + pulse)


def carrier_phase(
    geometry: Geometry, time: float, x: float, y: float, *, at_x: FloatArray, at_y: FloatArray
) -> FloatArray:
    """4 pi fc/c (R_p(time) - R_q(time)) in rad, of points p = (at_x, at_y) (broadcast) against q = (x, y)."""
    collection = geometry.collection
    at_x, at_y = np.broadcast_arrays(at_x, at_y)
    point = np.stack([at_x, at_y, np.full(at_x.shape, collection.ground_height)], axis=-1)
    origin = np.array([x, y, collection.ground_height])
    when = np.array(time)
    difference = geometry.range_history(point, when)[0] - geometry.range_history(origin, when)[0]
    return 4 * np.pi * collection.carrier / SPEED_OF_LIGHT * difference


def interpolate(
    values: Complex128Array, *, row: FloatArray, column: FloatArray, half_taps: int = MIN_HALF_TAPS
) -> Complex128Array:
    """Interpolate a band-limited chip by a Kaiser-windowed sinc.

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
        NaN where a tap falls on a missing sample or outside.
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
        found = np.einsum("ni,nij,nj->n", row_weight, bordered[pick], column_weight, optimize=True)
        found[missing[pick].any(axis=(1, 2))] = np.nan
        out[batch] = found
    return out


def _taps(index: FloatArray, half_taps: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Sample numbers in the bordered chip and weights, both (n, 2 half_taps)."""
    base = np.floor(index).astype(np.intp)
    offset = np.arange(1 - half_taps, half_taps + 1)
    u = index[:, None] - (base[:, None] + offset)
    window = i0(KAISER_BETA * np.sqrt(np.maximum(1 - (u / half_taps) ** 2, 0))) / i0(KAISER_BETA)
    return base[:, None] + offset + half_taps, np.sinc(u) * window


def _half_taps(band: float) -> int:
    """Taps on either side that interpolate a band of `band` cycles/sample to the accuracy of the Kaiser window."""
    return max(MIN_HALF_TAPS, int(np.ceil(KAISER_BETA / (np.pi * (1 - 2 * band)))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """The chip about one target with its carrier taken off, ready to be interpolated anywhere.

    Attributes
    ----------
    target : Target
    axes : ResponseAxes
    values : (n_y, n_x) complex128
        Demodulated and divided by the target's reflectivity; NaN = missing.
    x, y : (n_x,), (n_y,) float
        Pixel positions, m, uniform; they may reach beyond the image.
    full_dwell : bool
    """

    target: Target
    axes: ResponseAxes
    values: Complex128Array
    x: FloatArray
    y: FloatArray
    full_dwell: bool

    @cached_property
    def spacing(self) -> tuple[float, float]:
        """(dx, dy), m."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @cached_property
    def half_taps(self) -> int:
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
        """(x, y) of the greatest magnitude near the target, m; NaN if its surroundings are missing.

        The strongest pixel within 2 widths, then the strongest of a fine grid about it, then Newton steps on
        the interpolated power.
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
        """Newton's method for the maximum of |response|^2, in units of the theoretical widths."""
        axes = self.axes
        unit = np.array([axes.range_width, axes.azimuth_width])
        h = 0.02  # widths: small against the main lobe, large against the samples' rounding
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
                break  # not the top of anything smooth: the strongest point of the fine grid has to do
            step = np.clip(-np.linalg.solve(hessian, gradient), -0.25, 0.25)
            dx, dy = axes.ground_offset(*(step * unit))
            x, y = x + float(dx), y + float(dy)
            if np.abs(step).max() < 1e-6:
                break
        return x, y


class _Window(NamedTuple):
    """A run of pixels along one axis, with the part of it that the image holds."""

    position: FloatArray  # m, of every pixel, in the image or not
    image: slice
    chip: slice


def _window(axis: FloatArray, centre: float, reach: float) -> _Window:
    step = float(axis[-1] - axis[0]) / (axis.size - 1)
    first = int(np.floor((centre - reach - axis[0]) / step))
    last = int(np.ceil((centre + reach - axis[0]) / step)) + 1
    low, high = max(first, 0), min(last, axis.size)
    high = max(low, high)
    position = float(axis[0]) + step * np.arange(first, last, dtype=np.float64)
    return _Window(position=position, image=slice(low, high), chip=slice(low - first, high - first))


def read_response(
    read_chip: ReadChip, image_x: FloatArray, image_y: FloatArray, geometry: Geometry, target: Target
) -> Response | None:
    """Read the chip about a target and take its carrier off.

    Parameters
    ----------
    read_chip : callable
        (slice of y, slice of x) -> complex pixels of the calibrated image, NaN where not covered. Only the
        part that the cuts need is asked for.
    image_x, image_y : (n_x,), (n_y,) float
        Pixel positions, m; uniform, ascending.
    geometry : Geometry
    target : Target

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
    axes = response_axes(geometry, target.x, target.y)
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
    # The peak may lie off the true position by the search width, and the cuts run from the peak.
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
        values=values,
        x=columns.position,
        y=rows.position,
        full_dwell=has_full_dwell(geometry, target.x, target.y),
    )


class Cuts(NamedTuple):
    """The two cuts through the peak: offsets in m from it, complex response (NaN = missing)."""

    range_offset: FloatArray
    range_profile: Complex128Array
    azimuth_offset: FloatArray
    azimuth_profile: Complex128Array


def cuts(response: Response) -> Cuts:
    """Sample the range cut (offsets in slant range, growing away from the radar) and the azimuth cut.

    Both reach half a width beyond what is measured, at 64 samples a theoretical width.
    """
    axes, peak = response.axes, response.peak
    n = int((CUT_WIDTHS + 0.5) * SAMPLES_PER_WIDTH)
    widths = np.arange(-n, n + 1) / SAMPLES_PER_WIDTH
    along_range, along_azimuth = widths * axes.range_width, widths * axes.azimuth_width
    if not np.isfinite(peak).all():
        nothing = np.full(widths.shape, np.nan + 0j)
        return Cuts(along_range, nothing, along_azimuth, nothing.copy())
    zero = np.zeros(1)
    return Cuts(
        range_offset=along_range,
        range_profile=response.at_own(peak, along_range, zero),
        azimuth_offset=along_azimuth,
        azimuth_profile=response.at_own(peak, zero, along_azimuth),
    )


class ResponseGrid(NamedTuple):
    """A response about its peak on its own axes: offsets in m, complex values (n_azimuth, n_range)."""

    range_offset: FloatArray
    azimuth_offset: FloatArray
    values: Complex128Array


def response_grid(response: Response, *, widths: float = 5.0, samples_per_width: int = 12) -> ResponseGrid:
    """Resample a response on its own axes, `widths` theoretical widths to either side of the peak (for contours)."""
    axes = response.axes
    n = int(widths * samples_per_width)
    u = np.arange(-n, n + 1) / samples_per_width
    along_range, along_azimuth = u * axes.range_width, u * axes.azimuth_width
    if np.isfinite(response.peak).all():
        values = response.at_own(response.peak, along_range[None, :], along_azimuth[:, None])
    else:
        values = np.full((u.size, u.size), np.nan + 0j)
    return ResponseGrid(range_offset=along_range, azimuth_offset=along_azimuth, values=values)


class ProfileQuality(NamedTuple):
    """-3 dB width in the unit of the offsets; side lobe ratios in dB."""

    irw: float
    pslr: float
    islr: float


def profile_quality(offset: FloatArray, profile: Complex128Array, *, width: float) -> ProfileQuality:
    """IRW, PSLR and ISLR of a cut, as `DEFINITIONS` has them.

    Parameters
    ----------
    offset : (n,) float
        Uniform, ascending; the peak lies at 0. At least 10 widths on either side.
    profile : (n,) complex
        NaN = missing.
    width : float
        Theoretical IRW, unit of `offset`.

    Returns
    -------
    ProfileQuality
        The IRW is NaN if the main lobe does not fall to half power within 10 widths or is not all there;
        PSLR and ISLR are NaN if anything within 10 widths is missing, or if no minimum lies there.
    """
    nothing = ProfileQuality(float("nan"), float("nan"), float("nan"))
    used = np.abs(offset) <= CUT_WIDTHS * width * (1 + 1e-9)
    offset, power = offset[used], np.abs(profile[used]) ** 2
    top = int(np.argmin(np.abs(offset)))
    if not np.isfinite(power[top]) or power[top] == 0:
        return nothing
    power = power / power[top]
    right = _lobe_edge(power[top:])
    left = _lobe_edge(power[top::-1])
    if right is None or left is None:
        return nothing
    step = float(offset[1] - offset[0])
    irw = (right.half_power + left.half_power) * step
    if right.minimum is None or left.minimum is None or not np.isfinite(power).all():
        return ProfileQuality(irw, float("nan"), float("nan"))
    low, high = top - left.minimum, top + right.minimum
    side = np.concatenate([power[:low], power[high + 1 :]])
    if side.size == 0:
        return ProfileQuality(irw, float("nan"), float("nan"))
    main_energy = np.trapezoid(power[low : high + 1])
    side_energy = np.trapezoid(power[: low + 1]) + np.trapezoid(power[high:])
    return ProfileQuality(irw, float(10 * np.log10(side.max())), float(10 * np.log10(side_energy / main_energy)))


class _LobeEdge(NamedTuple):
    half_power: float  # samples from the peak, fractional
    minimum: int | None  # samples from the peak


def _lobe_edge(power: FloatArray) -> _LobeEdge | None:
    """Half-power point and first minimum beyond it, going outwards from the peak at index 0."""
    below = np.flatnonzero(~(power > 0.5))
    if below.size == 0 or not np.isfinite(power[below[0]]):
        return None
    i = int(below[0])
    half_power = i - 1 + (power[i - 1] - 0.5) / (power[i - 1] - power[i])
    rising = np.flatnonzero(~(power[i + 1 :] <= power[i:-1]))
    minimum = i + int(rising[0]) if rising.size and np.isfinite(power[i + int(rising[0]) + 1]) else None
    return _LobeEdge(float(half_power), minimum)


def measure(response: Response) -> PointResponse:
    """Measure a response that has been read: see `DEFINITIONS`."""
    axes, target = response.axes, response.target
    sampled = cuts(response)
    along_range = profile_quality(sampled.range_offset, sampled.range_profile, width=axes.range_width)
    along_azimuth = profile_quality(sampled.azimuth_offset, sampled.azimuth_profile, width=axes.azimuth_width)
    value = complex(response.at(np.array(target.x), np.array(target.y)))
    x, y = response.peak
    within = [
        profile[np.abs(offset) <= CUT_WIDTHS * width]
        for offset, profile, width in (
            (sampled.range_offset, sampled.range_profile, axes.range_width),
            (sampled.azimuth_offset, sampled.azimuth_profile, axes.azimuth_width),
        )
    ]
    covered = bool(np.isfinite(value) and all(np.isfinite(profile).all() for profile in within))
    return PointResponse(
        name=target.name,
        x=float(target.x),
        y=float(target.y),
        range_pslr=along_range.pslr,
        range_islr=along_range.islr,
        range_irw=along_range.irw,
        range_irw_theory=axes.range_width,
        azimuth_pslr=along_azimuth.pslr,
        azimuth_islr=along_azimuth.islr,
        azimuth_irw=along_azimuth.irw,
        azimuth_irw_theory=axes.azimuth_width,
        error_x=float(x - target.x),
        error_y=float(y - target.y),
        value=value,
        full_dwell=response.full_dwell,
        covered=covered,
    )


def measure_target(
    read_chip: ReadChip, image_x: FloatArray, image_y: FloatArray, geometry: Geometry, target: Target
) -> PointResponse:
    """Measure one target in the image: `read_response`, then `measure`; all NaN and not covered if there is none."""
    response = read_response(read_chip, image_x, image_y, geometry, target)
    if response is not None:
        return measure(response)
    axes, nan = response_axes(geometry, target.x, target.y), float("nan")
    return PointResponse(
        name=target.name,
        x=float(target.x),
        y=float(target.y),
        range_pslr=nan,
        range_islr=nan,
        range_irw=nan,
        range_irw_theory=axes.range_width if axes else nan,
        azimuth_pslr=nan,
        azimuth_islr=nan,
        azimuth_irw=nan,
        azimuth_irw_theory=axes.azimuth_width if axes else nan,
        error_x=nan,
        error_y=nan,
        value=complex(nan, nan),
        full_dwell=axes is not None and has_full_dwell(geometry, target.x, target.y),
        covered=False,
    )


def _lit(geometry: Geometry, yaw: FloatArray, pulses: slice) -> BoolArray:
    """Which pulses light targets at yaws (n,): (n, n_pulse)."""
    collection = geometry.collection
    beam = collection.beam_azimuth[pulses]
    if collection.beam_width is None:
        return np.ones((yaw.size, beam.size), dtype=np.bool_)
    off = np.mod(yaw[:, None] - beam + np.pi, 2 * np.pi) - np.pi
    return np.asarray(np.abs(off) <= collection.beam_width / 2)


def ideal_response(geometry: Geometry, target: Target, x: FloatArray, y: FloatArray) -> Complex128Array:
    """What exact back-projection of a target's noise-free signal gives at ground points (n,), m.

    The mean over a pixel's lit pulses and all range frequencies of
    sigma exp(4j pi (fc + f)/c (R_p - R_q)); the sum over the uniform range frequencies is closed. It is the
    truth for one target alone, side lobes and carrier phase included. NaN where a pixel is never lit.
    """
    collection = geometry.collection
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    point = np.stack([x, y, np.full(x.shape, collection.ground_height)], axis=-1)[:, None, :]
    origin = np.array([target.x, target.y, collection.ground_height])
    middle = collection.carrier + float(collection.range_frequency[0] + collection.range_frequency[-1]) / 2
    yaw = geometry.yaw(x, y)
    total, count = np.zeros(x.shape, dtype=np.complex128), np.zeros(x.shape)
    for first in range(0, collection.n_pulse, 64):
        pulses = slice(first, first + 64)
        time = collection.time[pulses]
        of_pixel = _lit(geometry, yaw, pulses)
        count += of_pixel.sum(axis=1)
        lit = of_pixel & _lit(geometry, geometry.yaw(np.array([target.x]), np.array([target.y])), pulses)
        if not lit.any():
            continue
        delay = (geometry.range_history(point, time)[0] - geometry.range_history(origin, time)[0]) * 2 / SPEED_OF_LIGHT
        comb = diric(2 * np.pi * collection.range_frequency_step * delay, collection.n_range_frequency)
        total += (lit * comb * np.exp(2j * np.pi * middle * delay)).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(target.reflectivity * total / count)


class ChipComparison(NamedTuple):
    """How an image chip a compares with a reference chip b over the pixels that both hold.

    coherence = <a, b> / (|a| |b|), complex; gain = |<a, b>| / <b, b>; phase of a against b, rad; pixels used.
    """

    coherence: complex
    gain: float
    phase: float
    pixels: int


def coherence(a: ComplexArray, b: ComplexArray) -> ChipComparison:
    """Compare a chip with a reference of the same shape; all NaN if they share no pixel or one is all zero.

    <a, b> = sum a conj(b), over pixels finite in both, in float64.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"chips must have one shape, got {a.shape} and {b.shape}")
    both = np.isfinite(a) & np.isfinite(b)
    first, second = a[both].astype(np.complex128), b[both].astype(np.complex128)
    inner = complex(np.vdot(second, first))
    energy_a, energy_b = float(np.vdot(first, first).real), float(np.vdot(second, second).real)
    if energy_a == 0 or energy_b == 0:
        nan = float("nan")
        return ChipComparison(complex(nan, nan), nan, nan, int(both.sum()))
    normalised = inner / float(np.sqrt(energy_a) * np.sqrt(energy_b))
    return ChipComparison(normalised, abs(inner) / energy_b, float(np.angle(inner)), int(both.sum()))


class PaperResponse(NamedTuple):
    """One row of the paper's Table 3: dB, dB, m (range: slant range), in range and in azimuth."""

    range_pslr: float
    range_islr: float
    range_irw: float
    azimuth_pslr: float
    azimuth_islr: float
    azimuth_irw: float


# Table 3 of paper A (angular division): its proposed method. Its ISLR definition is not stated.
TABLE3: dict[str, PaperResponse] = {
    "A1": PaperResponse(-13.26, -10.97, 2.68, -12.81, -10.30, 1.85),
    "A2": PaperResponse(-13.23, -10.98, 2.68, -13.10, -10.52, 1.85),
    "A3": PaperResponse(-13.21, -10.92, 2.68, -13.30, -10.79, 1.89),
    "B1": PaperResponse(-13.23, -10.98, 2.68, -13.25, -10.77, 1.89),
    "B2": PaperResponse(-13.14, -10.89, 2.67, -13.24, -10.70, 1.89),
    "B3": PaperResponse(-13.24, -10.97, 2.68, -13.14, -10.59, 1.89),
    "C1": PaperResponse(-13.19, -10.95, 2.68, -13.14, -10.64, 1.85),
    "C2": PaperResponse(-13.18, -10.97, 2.68, -13.21, -10.65, 1.85),
    "C3": PaperResponse(-13.25, -10.96, 2.68, -12.92, -10.41, 1.85),
}


class Worst(NamedTuple):
    """The value farthest from the ideal one, and whose it is."""

    name: str
    value: float
    ideal: float


class Summary(NamedTuple):
    """Worst cases over the targets with full dwell and full coverage, by figure."""

    targets: int
    full_dwell: int
    measured: int
    worst: dict[str, Worst]


_FIGURES: dict[str, tuple[float, Callable[[PointResponse], float]]] = {
    "range_pslr": (SINC_PSLR, lambda r: r.range_pslr),
    "range_islr": (IDEAL_ISLR, lambda r: r.range_islr),
    "range_irw_over_theory": (1.0, lambda r: r.range_irw / r.range_irw_theory),
    "azimuth_pslr": (SINC_PSLR, lambda r: r.azimuth_pslr),
    "azimuth_islr": (IDEAL_ISLR, lambda r: r.azimuth_islr),
    "azimuth_irw_over_theory": (1.0, lambda r: r.azimuth_irw / r.azimuth_irw_theory),
    "error_x": (0.0, lambda r: r.error_x),
    "error_y": (0.0, lambda r: r.error_y),
    "amplitude": (1.0, lambda r: abs(r.value)),
    "phase": (0.0, lambda r: float(np.angle(r.value))),
}


def summary(responses: Sequence[PointResponse]) -> Summary:
    """Worst cases: dB, ratios, m, and rad; a figure that is NaN counts as the worst of all.

    `worst` is empty if no target is both fully lit and covered.
    """
    measured = [r for r in responses if r.full_dwell and r.covered]
    worst = {}
    for figure, (ideal, value) in _FIGURES.items():
        if measured:
            values = np.array([value(r) for r in measured])
            # A target that is covered but has no main lobe is a failure, and must not drop out of the worst case.
            i = int(np.argmax(np.nan_to_num(np.abs(values - ideal), nan=np.inf)))
            worst[figure] = Worst(measured[i].name, float(values[i]), ideal)
    return Summary(len(responses), sum(r.full_dwell for r in responses), len(measured), worst)


def as_json(responses: Sequence[PointResponse]) -> dict[str, Any]:
    """Everything as JSON values: definitions, summary, one record a target; NaN becomes null, complex [re, im]."""
    found = summary(responses)
    return {
        "definitions": DEFINITIONS,
        "ideal": {"pslr": SINC_PSLR, "islr": IDEAL_ISLR},
        "summary": {
            "targets": found.targets,
            "full_dwell": found.full_dwell,
            "measured": found.measured,
            "worst": {figure: _plain(worst._asdict()) for figure, worst in found.worst.items()},
        },
        "targets": [_plain(r._asdict()) for r in responses],
    }


def _plain(record: Mapping[str, Any]) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if isinstance(value, complex):
            return [plain(value.real), plain(value.imag)]
        if isinstance(value, (float, np.floating)):
            return float(value) if np.isfinite(value) else None
        return value

    return {name: plain(value) for name, value in record.items()}
