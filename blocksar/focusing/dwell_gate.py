"""The dwell gate: limits each Doppler of the image to its own dwell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fresnel

from blocksar.arrays import ComplexArray
from blocksar.focusing.lines import RowPolynomial
from blocksar.kernels.fourier import Axis


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellGate:
    """Limit each Doppler of the image to its own dwell, as back-projection does, so that fewer samples suffice.

    The final transform sums over all of slow time, so the sharp ends of other targets' dwells leave side lobes.
    Back-projection sums over the pixel's own lit pulses and has none; on clutter the difference costs 0.005 of
    coherence. A window rect((t - c(f)) / length) in time with a centre that moves along Doppler is a convolution in
    Doppler. With psi' = c, and exactly where c is linear, it is

        S(f) -> exp(-2j pi psi) F{ G(t) F^-1{ exp(2j pi psi) S } },
        G(t) = integral of rect((t - u) / length) exp(j pi u^2 / c') / sqrt(j c') du,

    a Fresnel-smoothed rectangle. Between these transforms all targets lie about t = 0, so the last one is short.

    Attributes
    ----------
    phase : RowPolynomial
        psi(r, f), cycles.
    common : RowPolynomial
        psi at the middle range, for all rows. It stays applied, so that the image can be sampled coarsely in Doppler.
    slope : RowPolynomial
        One coefficient, c'(r), s/Hz.
    length : float
        The dwell after all steps, s.
    time : Axis
        Slow time after the gate, about 0, s.
    """

    phase: RowPolynomial
    common: RowPolynomial
    slope: RowPolynomial
    length: float
    time: Axis

    def window(self, slope: float) -> ComplexArray:
        """G over `time`, (time.size,) complex64."""
        scale = np.sqrt(2 / abs(slope))
        upper_sine, upper_cosine = fresnel(scale * (self.time.values + self.length / 2))
        lower_sine, lower_cosine = fresnel(scale * (self.time.values - self.length / 2))
        window = (upper_cosine - lower_cosine + 1j * (upper_sine - lower_sine)) * np.exp(-0.25j * np.pi) / np.sqrt(2)
        return (window if slope > 0 else window.conj()).astype(np.complex64)
