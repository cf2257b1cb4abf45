"""What ends of whole dwells lose in the echoes of what is lit there.

At the begin of a pixel's dwell its own Doppler has just entered the beam. The echoes of that moment come from there to
the other edge of the beam: in the signal without the pixel's own phase they have Dopplers from 0 to B, the band that is
lit at a time, all to one side. An error e(t) of the weights at that end then has the energy

    integral from 0 to B of g(f / B)^2 |E(f)|^2 df

with E the spectrum of e and g the antenna's pattern over the beam, from the edge at the pixel. Only if a pulse's echoes
filled all Dopplers was it that of e itself, which `fidelity.blurred_energy` has: at most half of that, and much less
where the PRF is high over the band.

The definition sums pulses, an interval p apart: from the first one in a dwell on, the sum of exp(2j pi f t) p is that
of an integral from half an interval before, over sinc(f p). Where that begins is spread evenly over an interval. The
chain integrates, from an end that is spread over +-b (`dwell_gate`), smeared by an area a, and displaced by d, either
way alike:

    |E(f)|^2 = (1 / sinc(f p)^2 + s^2 - 2 s cos(pi a f^2) cos(2 pi f d)) / (2 pi f)^2,    s = sinc(2 f b).
"""

from __future__ import annotations

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray

TURNS = 3.0  # of f, in the time by which ends are smeared and displaced, up to which cosines are followed
LEAST_SINC = 0.2  # echoes of the far edge of the beam last too briefly for their sum to be ambiguous
NODES, FAR_NODES = 40, 12  # of the integrals up to there and beyond, where cosines vanish in the mean


def lit_energy(
    area: FloatArray,
    displaced: FloatArray,
    spread: FloatArray,
    *,
    blur: float,
    pulse_interval: float,
    lit_band: FloatArray | float,
    band: tuple[FloatArray, FloatArray],
    gain: FloatArray | None = None,
) -> FloatArray:
    """Mean energy (...) by which the ends of a chain differ from those at whole pulses, in what is lit, s.

    Parameters
    ----------
    area, displaced, spread : (...) float
        s^2, s, and s: ends lie at `displaced` -+ `spread` at the edges of the band.
    blur : float
        That of the gate, s.
    pulse_interval : float
        s.
    lit_band : (...) float
        B, Hz.
    band : pair of (n,) float
        Nodes over the band, -1 .. 1, and their shares.
    gain : (..., n) float, optional
        Legendre series of g^2 over the beam, from -1 at the edge where the end is to 1 at the other; default: 1.
    """
    area, displaced, spread, top = np.broadcast_arrays(area, displaced, spread, lit_band)
    shifts = displaced[..., None] - spread[..., None] * band[0]
    long = np.maximum(np.sqrt(np.abs(area)), np.abs(shifts).max(axis=-1))
    last = np.minimum(top, TURNS / np.maximum(long, 1e-12))

    def over(f: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """g^2, the energy of the sum over pulses over that of an integral, and s, at frequencies (..., m)."""
        at = 2 * f / top[..., None] - 1
        series = None if gain is None else np.moveaxis(gain, -1, 0)[..., None]
        power = np.ones(f.shape) if series is None else np.polynomial.legendre.legval(at, series, tensor=False)
        summed = 1 / np.maximum(np.sinc(f * pulse_interval), LEAST_SINC) ** 2
        return np.maximum(power, 0.0), summed, np.sinc(2 * f * blur)

    nodes, weights = solvers.gauss_legendre(NODES)
    f = last[..., None] * (1 + nodes) / 2
    power, summed, s = over(f)
    shifted = sum(share * np.cos(2 * np.pi * f * shifts[..., i, None]) for i, share in enumerate(band[1].tolist()))
    both = s * np.cos(np.pi * area[..., None] * f**2) * shifted
    near = (weights * power * (summed + s**2 - 2 * both) / f**2).sum(axis=-1) * last / 2

    nodes, weights = solvers.gauss_legendre(FAR_NODES)
    width = 1 / last - 1 / top
    power, summed, s = over(1 / (1 / top[..., None] + width[..., None] * (1 + nodes) / 2))
    far = (weights * power * (summed + s**2)).sum(axis=-1) * width / 2
    return np.asarray((near + far) / (4 * np.pi**2))
