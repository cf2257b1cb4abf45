"""Pulses at uneven slow times to uniform ones, with the error known beforehand.

Once the range to the scene's centre is taken out, echoes of a scene fill a limited band of Doppler, |nu| <= band / 2.
Of all weighted sums of the pulses at t_m nearest to a time t, the one taken here has the least mean square error over
echoes spread evenly over that band:

    w = (K + SOFTNESS I)^-1 k,    K_mn = sinc(band (t_m - t_n)),    k_m = sinc(band (t_m - t)),

sinc(x) = sin(pi x) / (pi x). Weights are found anew for every pulse, from where its neighbours are. On an echo of
Doppler nu the sum errs by

    e(nu) = |sum_m w_m exp(2j pi nu (t_m - t)) - 1|

of the echo's amplitude, exactly. The largest e over the band is a bound: no echo of the scene, and so no sum of them in
a pixel, is off by a larger part of its amplitude. Pulses for which that is more than MOST_ERROR are missing pulses:
beside gaps, and at the ends, where neighbours are on one side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray

NEIGHBOURS = 64  # pulses of a sum
SOFTNESS = 1e-8  # keeps weights small where the band leaves them undetermined, and errors above 1e-4
MOST_ERROR = 0.05  # of an echo's amplitude, -26 dB
MOST_GAIN = 2.0  # of receiver noise, in amplitude
OCCUPIED = 0.9  # of the mean PRF: no scene may fill more Doppler, and no sum of so few pulses would serve
GROUP = 256  # pulses whose weights are found at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """Weights from uneven pulses to uniform ones.

    Attributes
    ----------
    first : (n_out,) int
        First of the consecutive pulses that are summed.
    weights : (n_out, n_neighbour) float
    bound : (n_out,) float
        Largest error on any echo within the band, of its amplitude.
    spread : (n_out,) float
        Root mean square of it over the band.
    good : (n_out,) bool
        False where the pulse is missing: its neighbours do not determine it.
    """

    first: IntArray
    weights: FloatArray
    bound: FloatArray
    spread: FloatArray
    good: BoolArray

    def part(self, pulses: slice) -> Resampling:
        """Of some of the uniform pulses."""
        return Resampling(**{name: getattr(self, name)[pulses] for name in self.__dataclass_fields__})

    def needs(self, pulses: slice) -> slice:
        """Which uneven pulses these uniform ones are made of."""
        first = self.first[pulses]
        return slice(int(first.min()), int(first.max()) + self.weights.shape[1])

    def apply(self, signal: ComplexArray, pulses: slice) -> ComplexArray:
        """Make some uniform pulses.

        Parameters
        ----------
        signal : (n, n_column) complex64
            The uneven pulses `needs(pulses)`.

        Returns
        -------
        (n_out, n_column) complex64
            Rows of NaN where `good` is False.
        """
        start, count = self.needs(pulses).start, self.weights.shape[1]
        out = np.full((self.first[pulses].size, signal.shape[1]), complex(np.nan, np.nan), np.complex64)
        rows = zip(self.first[pulses], self.weights[pulses], self.good[pulses], strict=True)
        for row, (first, weights, good) in enumerate(rows):
            if good:
                out[row] = weights @ signal[first - start : first - start + count]
        return out


def plan_resampling(time: FloatArray, uniform: FloatArray, *, band: float) -> Resampling:
    """Weights and errors; no sample is needed.

    Parameters
    ----------
    time : (n,) float
        Of the pulses, s, ascending.
    uniform : (n_out,) float
        Of the pulses wanted, s, ascending.
    band : float
        Doppler that echoes fill, about zero, Hz.

    Raises
    ------
    ValueError
        If times do not ascend or band is not above zero.
    """
    if not (np.diff(time) > 0).all() or not (np.diff(uniform) > 0).all():
        raise ValueError("time and uniform must ascend")
    if not band > 0:
        raise ValueError(f"{band=} must be above 0 Hz")
    count = min(NEIGHBOURS, time.size)
    first = np.clip(np.searchsorted(time, uniform) - count // 2, 0, time.size - count)
    doppler = np.linspace(0, band / 2, 2 * count + 1)  # the error at -nu is that at nu
    weights, bound, spread = np.empty((uniform.size, count)), np.empty(uniform.size), np.empty(uniform.size)
    for start in range(0, uniform.size, GROUP):
        group = slice(start, start + GROUP)
        lag = time[first[group, None] + np.arange(count)] - uniform[group, None]
        covariance = np.sinc(band * (lag[:, :, None] - lag[:, None, :])) + SOFTNESS * np.eye(count)
        found = np.linalg.solve(covariance, np.sinc(band * lag)[:, :, None])[:, :, 0]
        cycles = lag[:, :, None] * doppler
        turned = 2 * np.pi * (cycles - np.rint(cycles))
        real = np.einsum("ik,ikd->id", found, np.cos(turned)) - 1
        error = np.hypot(real, np.einsum("ik,ikd->id", found, np.sin(turned)))
        weights[group], bound[group] = found, error.max(axis=1)
        spread[group] = np.sqrt((error**2).mean(axis=1))
    gain = np.sqrt((weights**2).sum(axis=1))
    good = (bound <= MOST_ERROR) & (gain <= MOST_GAIN)
    return Resampling(first=first, weights=weights, bound=bound, spread=spread, good=good)
