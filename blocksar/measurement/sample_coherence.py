"""The coherence that is estimated over a window: its bias, and below which value it shows that a scene has changed.

The estimate |sum a conj(b)| / sqrt(sum |a|^2 sum |b|^2) over N independent pixels of circular Gaussian clutter of
coherence c has the density

    p(g) = 2 (N - 1) (1 - c^2)^N g (1 - g^2)^(N - 2) F(N, N; 1; c^2 g^2),   0 <= g <= 1

with Gauss's function F (Touzi et al., IEEE Trans. GRS 37(1), 1999, eq. 3). Its mean lies above c, the more so the
smaller N and c are: at c = 0 near sqrt(pi / (4 N)).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import Taper, Weighting

LEAST, MOST = 1.5, 200.0  # independent pixels that the density is computed for; more hardly change it
STEPS = 4000  # of the estimate, over which the density is summed
COHERENCES = np.linspace(0.0, 0.999, 334)  # for which means and thresholds are tabulated


def independent_pixels(
    window: tuple[int, int], spacing: tuple[float, float], sides: tuple[FloatArray, FloatArray], weighting: Weighting
) -> float:
    """Number of independent pixels in a window: that of which the mean power of clutter has the same variance.

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
    """Coherence of surface clutter of which two images see spectra that lie apart.

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
    """Value (...) that the estimate is below with this probability where the coherence is (...)."""
    _, thresholds = _tables(_rounded(looks), false_alarms)
    return np.asarray(np.interp(coherence, COHERENCES, thresholds))


def coherence_of_median(median: float, looks: float) -> FloatArray:
    """The coherence of which half of the estimates lie below `median`; 0 where chance alone has a higher one."""
    _, medians = _tables(_rounded(looks), 0.5)
    return np.asarray(np.interp(median, medians, COHERENCES))


def _rounded(looks: float) -> float:
    return round(min(max(looks, LEAST), MOST), 2)


@lru_cache(maxsize=8)
def _tables(looks: float, probability: float) -> tuple[FloatArray, FloatArray]:
    """Means of the estimate for COHERENCES, and values that it is below with a probability."""
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
