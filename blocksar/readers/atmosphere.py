"""The range delay of a standard atmosphere.

The zenith delay above a height h is that of Saastamoinen ("Atmospheric correction for the troposphere and stratosphere
in radio ranging of satellites", Geophysical Monograph 15, 1972),

    0.0022768 (P + (1255 / T + 0.05) e) / (1 - 0.00266 cos 2 latitude - 2.8e-7 h)  m,

with the standard atmosphere of Berg (1948): pressures P and e, hPa, and temperature T, K, at the height h. Between an
antenna and the ground it is the difference of both heights, times 1.001 / sqrt(0.002001 + sin^2 elevation) (Black and
Eisner, J. Geophys. Res. 89, 1984). It differs from the true delay by some 5 %, 0.2 m, from day to day.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference, geodetic_of
from blocksar.constants import SPEED_OF_LIGHT


def slant_delay(antenna: FloatArray, ground: FloatArray, frame: Georeference) -> FloatArray:
    """Delay between antennas and places on the ground, ECEF (n, 3) or (3,), m: m of one way (n,).

    `frame` is one whose z is up on the ground.
    """
    latitude, _, height = np.moveaxis(geodetic_of(antenna), -1, 0)
    sight = frame.from_ecef(antenna) - frame.from_ecef(ground)
    sine = sight[..., 2] / np.linalg.norm(sight, axis=-1)
    between = zenith_delay(geodetic_of(ground)[..., 2], latitude) - zenith_delay(height, latitude)
    return np.asarray(between * 1.001 / np.sqrt(0.002001 + sine**2))


def delay_words(delay: FloatArray) -> str:
    """Describe a delay (n,), m of range, in words."""
    return (
        f"{delay.mean() * 2e9 / SPEED_OF_LIGHT:.4g} ns or {delay.mean():.3g} m of range, which changes by "
        f"{np.ptp(delay):.2g} m over the collection"
    )


def zenith_delay(height: FloatArray, latitude: FloatArray) -> FloatArray:
    """Delay of a standard atmosphere above heights, m, at latitudes, degrees: m of one way (see the module).

    Examples
    --------
    >>> round(float(zenith_delay(np.array(0.0), np.array(45.0))), 2)
    2.41
    """
    low = np.clip(height, -500.0, 40e3)
    pressure = 1013.25 * np.clip(1 - 2.26e-5 * low, 0, None) ** 5.225
    temperature = np.maximum(291.15 - 0.0065 * low, 216.65)
    vapour = 0.5 * np.exp(-0.0006396 * low - 37.2465 + 0.213166 * temperature - 0.000256908 * temperature**2)
    gravity = 1 - 0.00266 * np.cos(np.radians(2 * latitude)) - 2.8e-7 * low
    return np.asarray(0.0022768 * (pressure + (1255 / temperature + 0.05) * vapour) / gravity)
