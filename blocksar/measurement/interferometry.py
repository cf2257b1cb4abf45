"""Interferometry of two images: interferogram and coherence over a window, effects of height and baseline.

An image is the exact back-projection of its pulses onto the ground (`imaging.backprojection`): what lies on that
ground has in each image the phase of its reflectivity. In the interferogram a conj(b) the phase of the ranges, also
called flat-earth phase and topographic phase, is thus out already, for both tracks and on a terrain as on a plane. What
remains at a pixel X is that of a scatterer P that does not lie where the images assume it,

    phase = 4 pi / c [f_b (R_b(P) - R_b(X)) - f_a (R_a(P) - R_a(X))]

with the ranges R at the middles of the dwells and the carriers f. It comes from

- height: P = X + h d, see `vertical_wavenumber`: phase = h k_z;
- motion: P moves by r along the line of sight, away from the antenna, after image a: phase = 4 pi f_b / c r;
- all else that changes the path or the reflectivity: the air, errors of the tracks, moisture, growth.

The coherence estimated over a window has a bias, and a threshold below which it shows that a scene has changed.

The estimate |sum a conj(b)| / sqrt(sum |a|^2 sum |b|^2) over N independent pixels of circular Gaussian clutter of
coherence c has the density

    p(g) = 2 (N - 1) (1 - c^2)^N g (1 - g^2)^(N - 2) F(N, N; 1; c^2 g^2),   0 <= g <= 1

with Gauss's function F (Touzi et al., IEEE Trans. GRS 37(1), 1999, eq. 3). Its mean lies above c, the more so the
smaller N and c are: at c = 0 near sqrt(pi / (4 N)).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import ground_spectrum
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.weighting import Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT

LEAST, MOST = 1.5, 200.0  # independent pixels that the density is computed for; more hardly change it
STEPS = 4000  # of the estimate, over which the density is summed
COHERENCES = np.linspace(0.0, 0.999, 334)  # for which means and thresholds are tabulated


def independent_pixels(
    window: tuple[int, int], spacing: tuple[float, float], sides: tuple[FloatArray, FloatArray], weighting: Weighting
) -> float:
    """Number of independent pixels in a window: as many average to the same variance of clutter power.

    n^2 over the sum of |rho|^2 over all pairs of its n pixels; rho is the correlation of clutter at their distance, the
    transform of its power spectrum.

    Parameters
    ----------
    window : (int, int)
        Pixels along y and x.
    spacing : (float, float)
        Distance of pixels in y and x, m.
    sides : pair of (2,) float
        Of the spectrum on the ground by band and dwell, cycles/m along x and y: `collection.grid.ground_spectrum`.
    weighting : Weighting
        Tapers along the sides.
    """
    lags = [np.arange(1 - n, n) for n in window]
    pairs = np.outer(*(n - np.abs(lag) for n, lag in zip(window, lags, strict=True)))
    y, x = (lag * step for lag, step in zip(lags, spacing, strict=True))
    squared = np.ones(pairs.shape)
    for side, taper in zip(sides, (weighting.range, weighting.azimuth), strict=True):
        cycles = (side[0] * x[None, :] + side[1] * y[:, None]).ravel()
        squared *= _correlation(taper, cycles).reshape(pairs.shape) ** 2
    return float((window[0] * window[1]) ** 2 / (pairs * squared).sum())


def _correlation(taper: Taper, cycles: FloatArray) -> FloatArray:
    """Transform of w^2, 1 at 0, at lags (n,) in cycles over the whole width of the taper."""
    if taper.uniform:
        return np.sinc(cycles)
    v = (np.arange(512) + 0.5) / 256 - 1
    power = taper(v) ** 2
    return np.asarray((np.cos(np.pi * cycles[:, None] * v) * power).sum(axis=1) / power.sum())


def overlap(shifts: tuple[float, float], weighting: Weighting) -> float:
    """Coherence of surface clutter seen by two images whose spectra are shifted against each other.

    Parameters
    ----------
    shifts : (float, float)
        Distance of the spectra along the sides by band and dwell, as parts of these.
    weighting : Weighting
        Of both images.
    """
    product = 1.0
    for shift, taper in zip(shifts, (weighting.range, weighting.azimuth), strict=True):
        v = (np.arange(4096) + 0.5) / 2048 - 1
        other = v - 2 * shift
        both = np.abs(other) <= 1
        product *= float((taper(v[both]) * taper(other[both])).sum() / (taper(v) ** 2).sum())
    return product


def mean_estimate(coherence: FloatArray | float, looks: float) -> FloatArray:
    """Mean of the estimate (...) where the coherence is (...), for a number of independent pixels."""
    means, _ = _tables(_rounded(looks), 0.5)
    return np.asarray(np.interp(coherence, COHERENCES, means))


def threshold(coherence: FloatArray | float, looks: float, false_alarms: float) -> FloatArray:
    """Threshold (...) of estimated coherence, below which it falls with probability `false_alarms`."""
    _, thresholds = _tables(_rounded(looks), false_alarms)
    return np.asarray(np.interp(coherence, COHERENCES, thresholds))


def coherence_of_median(median: float, looks: float) -> FloatArray:
    """True coherence whose estimates have this median; 0 if chance alone gives a higher median."""
    _, medians = _tables(_rounded(looks), 0.5)
    return np.asarray(np.interp(median, medians, COHERENCES))


def _rounded(looks: float) -> float:
    return round(min(max(looks, LEAST), MOST), 2)


@lru_cache(maxsize=8)
def _tables(looks: float, probability: float) -> tuple[FloatArray, FloatArray]:
    """Means of the estimate for COHERENCES, and the quantiles at a probability."""
    from scipy.special import hyp2f1

    n, g = looks, (np.arange(STEPS) + 0.5) / STEPS
    means, limits = np.empty(COHERENCES.size), np.empty(COHERENCES.size)
    for k, c in enumerate(COHERENCES):
        z = (c * g) ** 2
        # Euler's transformation: all terms of the series are positive and it converges up to z = 1.
        log = n * np.log1p(-(c**2)) + (n - 2) * np.log1p(-(g**2)) + (1 - 2 * n) * np.log1p(-z)
        log += np.log(g) + np.log(hyp2f1(1 - n, 1 - n, 1, z))
        density = np.exp(log - log.max())
        total = np.cumsum(density)
        means[k] = (g * density).sum() / total[-1]
        limits[k] = np.interp(probability, total / total[-1], g + 0.5 / STEPS)
    return means, limits


class Windowed(NamedTuple):
    """Means over a window about each pixel, of the pixels that both images have; NaN where one lacks the pixel itself.

    Attributes
    ----------
    inner : (n_y, n_x) complex128
        Mean of a conj(b).
    power_a, power_b : (n_y, n_x) float64
        Means of |a|^2 and |b|^2.
    """

    inner: Complex128Array
    power_a: FloatArray
    power_b: FloatArray

    @property
    def coherence(self) -> FloatArray:
        """|mean of a conj(b)| / sqrt(mean of |a|^2 times that of |b|^2); NaN where one image is zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            estimate = np.abs(self.inner) / np.sqrt(self.power_a * self.power_b)
        return np.where(np.isfinite(estimate), np.minimum(estimate, 1.0), np.nan)

    @property
    def amplitude_ratio(self) -> FloatArray:
        """sqrt(mean of |b|^2 / mean of |a|^2); NaN where a is zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.sqrt(self.power_b / self.power_a)
        return np.where(np.isfinite(ratio), ratio, np.nan)


def over_window(a: ComplexArray, b: ComplexArray, window: tuple[int, int]) -> Windowed:
    """Means of two images (n_y, n_x) over a window of odd numbers of pixels along y and x; the ends have fewer."""
    both = np.isfinite(a) & np.isfinite(b)
    first, second = (np.where(both, each, 0).astype(np.complex128) for each in (a, b))
    inner = first * second.conj()
    share = _mean(both.astype(np.float64), window)

    def mean(values: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(both, _mean(values, window) / share, np.nan)

    powers = [mean(each.real**2 + each.imag**2) for each in (first, second)]
    return Windowed(mean(inner.real) + 1j * mean(inner.imag), *(np.maximum(each, 0.0) for each in powers))


def _mean(values: FloatArray, window: tuple[int, int]) -> FloatArray:
    return np.asarray(uniform_filter(values, window, mode="constant"))


class LinesOfSight(NamedTuple):
    """Unit vectors (..., 3) from antenna to points at mid-dwell, its velocity (..., 3), m/s, and ranges (...), m."""

    unit: FloatArray
    velocity: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray | float) -> LinesOfSight:
        """Geometry of sight to points x, y, z (...), m; NaN where a point is never lit.

        Raises
        ------
        InputError
            If the collection is bistatic.
        """
        refuse_departures("a baseline", geometry.collection.two_antennas, "compare images of one antenna")
        first, last = np.broadcast_arrays(*geometry.beam.dwell(x, y, z=z), x)[:2]
        middle = np.where(first < last, (first + last) / 2, geometry.epoch)
        away = np.stack(np.broadcast_arrays(x, y, z), axis=-1) - geometry.track.position(middle)
        away = np.where((first < last)[..., None], away, np.nan)
        distance = np.sqrt((away**2).sum(axis=-1))
        return cls(away / distance[..., None], geometry.track.velocity(middle), distance)


def layover_direction(sight: LinesOfSight) -> FloatArray:
    """Displacement (..., 3) of a scatterer for a metre of height that keeps its range and Doppler.

    d is orthogonal to the line of sight u and to its rate, which lies in the plane of u and the velocity v, and
    d_z = 1: u x v over its z.
    """
    along = np.cross(sight.unit, sight.velocity)
    return np.asarray(along / along[..., 2:])


def vertical_wavenumber(a: Geometry, b: Geometry, x: FloatArray, y: FloatArray) -> FloatArray:
    """Interferometric phase, rad, for a metre of height over the assumed ground at x, y (...), m.

    A pixel X of image a shows what has its range and Doppler: at a height h, the scatterer X + h d, whose range is the
    same in a, and in b changes by h u_b . d: k_z = 4 pi f_b / c u_b . d. That is 4 pi B / (lambda R sin(incidence)) of
    the perpendicular baseline B. 2 pi / |k_z| is the height of ambiguity. NaN where one does not see the point.
    """
    z = a.height(x, y)
    direction, sight = layover_direction(LinesOfSight.of(a, x, y, z)), LinesOfSight.of(b, x, y, z)
    return np.asarray(4 * np.pi * b.collection.carrier / SPEED_OF_LIGHT * (sight.unit * direction).sum(axis=-1))


class Baseline(NamedTuple):
    """Baseline of two tracks at a ground point.

    Attributes
    ----------
    perpendicular, parallel : float
        Of the way from the antenna of a to that of b at the middles of the dwells, m: across the line of sight in the
        direction of `layover_direction`, positive where the phase rises with height; and along the line of sight.
    wavenumber : float
        `vertical_wavenumber`, rad/m.
    surface : float
        Coherence of clutter on the ground, of which the images see spectra that lie apart by the baseline.
    """

    perpendicular: float
    parallel: float
    wavenumber: float
    surface: float

    @classmethod
    def at(cls, a: Geometry, b: Geometry, x: float, y: float, weighting: Weighting) -> Baseline:
        """The baseline at a point x, y, m; NaN where one does not see it."""
        point = np.array(x), np.array(y), np.asarray(a.height(np.array(x), np.array(y)))
        first, second = LinesOfSight.of(a, *point), LinesOfSight.of(b, *point)
        direction = layover_direction(first)
        way = first.unit * first.distance - second.unit * second.distance
        perpendicular = -float((way * direction).sum() / np.sqrt((direction**2).sum()))
        wavenumber = float(vertical_wavenumber(a, b, *point[:2]))
        return cls(perpendicular, float((way * first.unit).sum()), wavenumber, _surface(a, b, point, weighting))


def _surface(a: Geometry, b: Geometry, point: tuple[FloatArray, FloatArray, FloatArray], weighting: Weighting) -> float:
    """Coherence left by the baseline for surface clutter: overlap of the two spectra on the ground."""
    first, second = (
        2 * each.collection.carrier / SPEED_OF_LIGHT * LinesOfSight.of(each, *point).unit[:2] for each in (a, b)
    )
    by_band, by_dwell = sides_at(a, float(point[0]), float(point[1]))
    area = by_band[0] * by_dwell[1] - by_band[1] * by_dwell[0]
    away = second - first
    shifts = (
        float((away[0] * by_dwell[1] - away[1] * by_dwell[0]) / area),
        float((by_band[0] * away[1] - by_band[1] * away[0]) / area),
    )
    return overlap(shifts, weighting) if np.isfinite(shifts).all() else float("nan")


def sides_at(geometry: Geometry, x: float, y: float) -> tuple[FloatArray, FloatArray]:
    """Sides of a target's spectrum on the ground at x, y, m, by band and by dwell: see `ground_spectrum`."""
    at = np.array(x), np.array(y)
    return ground_spectrum(geometry, float(geometry.epoch_range(*at)), float(geometry.yaw(*at)))


def changed(estimate: FloatArray, limit: FloatArray, chance: float) -> NDArray[np.uint8]:
    """Flags (...) of where a coherence lies below a limit: 0 unchanged, 1 changed, 2 not judged, 255 not covered.

    Not judged is what lies above a limit that is below `chance`, the median where nothing is coherent: most change
    would, too.
    """
    flags = np.where(estimate < limit, 1, np.where(limit > chance, 0, 2))
    return np.where(np.isfinite(estimate), flags, 255).astype(np.uint8)
