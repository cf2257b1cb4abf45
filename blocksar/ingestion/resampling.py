"""Resampling of pulses at uneven slow times to uniform ones, with error bounds known in advance.

Once the range to the scene's centre is removed, the echoes of a scene fill a limited Doppler band, |nu| <= band / 2.
Of all weighted sums of the pulses at times t_m nearest to a time t, the one used here has the least mean square error
over echoes spread evenly over that band:

    w = (K + SOFTNESS I)^-1 k,    K_mn = sinc(band (t_m - t_n)),    k_m = sinc(band (t_m - t)),

sinc(x) = sin(pi x) / (pi x). The weights are computed for each pulse from the times of its neighbours. For an echo of
Doppler nu the error of the sum, relative to the echo's amplitude, is exactly

    e(nu) = |sum_m w_m exp(2j pi nu (t_m - t)) - 1|.

Its largest value over the band is a bound for every echo of the scene, and so for every sum of them in a pixel. Pulses
for which it exceeds MOST_ERROR become missing pulses: beside gaps, and at the ends, where there are neighbours on one
side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray

NEIGHBOURS = 64  # pulses in a sum
SOFTNESS = 1e-8  # keeps weights small where the band leaves them undetermined, and errors above 1e-4
MOST_ERROR = 0.05  # of an echo's amplitude, -26 dB
MOST_GAIN = 2.0  # of receiver noise, in amplitude
OCCUPIED = 0.9  # of the mean PRF: the widest Doppler band; beyond it, sums of so few pulses are too inaccurate
GROUP = 256  # pulses whose weights are computed at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """Weights that turn uneven pulses into uniform ones.

    Attributes
    ----------
    first : (n_out,) int
        First of the consecutive uneven pulses that are summed.
    weights : (n_out, n_neighbour) float
    bound : (n_out,) float
        Largest error of any echo within the band, relative to its amplitude.
    spread : (n_out,) float
        Root mean square error over the band.
    good : (n_out,) bool
        False where the pulse is missing: its neighbours do not determine it.
    """

    first: IntArray
    weights: FloatArray
    bound: FloatArray
    spread: FloatArray
    good: BoolArray

    def part(self, pulses: slice) -> Resampling:
        """The weights of some of the uniform pulses."""
        return Resampling(**{name: getattr(self, name)[pulses] for name in self.__dataclass_fields__})

    def inputs(self, pulses: slice) -> slice:
        """The uneven pulses from which these uniform ones are computed."""
        first = self.first[pulses]
        return slice(int(first.min()), int(first.max()) + self.weights.shape[1])

    def apply(self, signal: ComplexArray, pulses: slice) -> ComplexArray:
        """Compute some of the uniform pulses.

        Parameters
        ----------
        signal : (n, n_column) complex64
            The uneven pulses `inputs(pulses)`.
        pulses : slice
            Of the uniform pulses.

        Returns
        -------
        (n_out, n_column) complex64
            Rows of NaN where `good` is False.
        """
        start, count = self.inputs(pulses).start, self.weights.shape[1]
        out = np.full((self.first[pulses].size, signal.shape[1]), complex(np.nan, np.nan), np.complex64)
        rows = zip(self.first[pulses], self.weights[pulses], self.good[pulses], strict=True)
        for row, (first, weights, good) in enumerate(rows):
            if good:
                out[row] = weights @ signal[first - start : first - start + count]
        return out


def plan_resampling(time: FloatArray, uniform: FloatArray, *, band: float) -> Resampling:
    """Compute weights and errors from the times alone.

    Parameters
    ----------
    time : (n,) float
        Times of the pulses, s, ascending.
    uniform : (n_out,) float
        Times of the uniform pulses, s, ascending.
    band : float
        Width of the Doppler band that echoes fill, centred at zero, Hz.

    Raises
    ------
    ValueError
        If times do not ascend or `band` is not above zero.
    """
    if not (np.diff(time) > 0).all() or not (np.diff(uniform) > 0).all():
        raise ValueError("time and uniform must ascend")
    if not band > 0:
        raise ValueError(f"{band=} must be above 0 Hz")
    count = min(NEIGHBOURS, time.size)
    first = np.clip(np.searchsorted(time, uniform) - count // 2, 0, time.size - count)
    doppler = np.linspace(0, band / 2, 2 * count + 1)  # the error is an even function of Doppler
    weights, bound, spread = np.empty((uniform.size, count)), np.empty(uniform.size), np.empty(uniform.size)
    for start in range(0, uniform.size, GROUP):
        group = slice(start, start + GROUP)
        lag = time[first[group, None] + np.arange(count)] - uniform[group, None]
        covariance = np.sinc(band * (lag[:, :, None] - lag[:, None, :])) + SOFTNESS * np.eye(count)
        solved = np.linalg.solve(covariance, np.sinc(band * lag)[:, :, None])[:, :, 0]
        cycles = lag[:, :, None] * doppler
        phase = 2 * np.pi * (cycles - np.rint(cycles))
        real = np.einsum("ik,ikd->id", solved, np.cos(phase)) - 1
        error = np.hypot(real, np.einsum("ik,ikd->id", solved, np.sin(phase)))
        weights[group], bound[group] = solved, error.max(axis=1)
        spread[group] = np.sqrt((error**2).mean(axis=1))
    gain = np.sqrt((weights**2).sum(axis=1))
    good = (bound <= MOST_ERROR) & (gain <= MOST_GAIN)
    return Resampling(first=first, weights=weights, bound=bound, spread=spread, good=good)
