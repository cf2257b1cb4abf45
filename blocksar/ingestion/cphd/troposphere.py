"""The delay of the troposphere: what a file says of it, and taking it out of the samples.

The standard's reference delay is that of the SRP through the troposphere: 2 R_SRP / c + TDTropoSRP. Samples hold delays
after it, so that an echo of the SRP has dTOA = 0, and nothing is to be done but for the change of the delay over the
scene, which stays. In files whose reference delay is 2 R_SRP / c alone, all echoes are late by the delay td:

    dTOA = 2 (R - R_SRP) / c + td = 2 (R - (R_SRP - c td / 2)) / c,

so that reference_range is R_SRP - c td / 2 and the samples stay as they are. td is that of the file, or, where the file
has none, that of a standard atmosphere.

The zenith delay of an atmosphere above a height h is that of Saastamoinen ("Atmospheric correction for the troposphere
and stratosphere in radio ranging of satellites", Geophysical Monograph 15, 1972),

    0.0022768 (P + (1255 / T + 0.05) e) / (1 - 0.00266 cos 2 latitude - 2.8e-7 h)  m,

with the standard atmosphere of Berg (1948): pressures P and e, hPa, and temperature T, K, at the height h. Between an
antenna and the ground it is the difference of both heights, times 1.001 / sqrt(0.002001 + sin^2 elevation) (Black and
Eisner, J. Geophys. Res. 89, 1984). It differs from the true delay by some 5 %, 0.2 m, from day to day.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.cphd.files import CphdFile

Troposphere = Literal["file", "standard"]
NAME = "TDTropoSRP"


class TroposphericDelay(NamedTuple):
    """Delay taken out of the ranges of vectors (n_vector,), m; and what was found, in words."""

    removed: FloatArray
    message: str | None


def find_troposphere(
    file: CphdFile, used: IntArray, frame: Georeference, wanted: Troposphere | None, cell: float
) -> TroposphericDelay:
    """Tell the delay, and give what is to be taken out.

    Parameters
    ----------
    used : (n,) int
        The vectors that matter.
    wanted : {"file", "standard"} or None
        The delay that the samples hold.
    cell : float
        Range resolution, m. A delay that the file lacks is told if it is longer.

    Raises
    ------
    InputError
        If that of the file is wanted, and it has none.
    """
    given = _given(file, used)
    model = np.zeros(file.shape[0])
    model[used] = _standard(file, used, frame)
    if wanted == "standard":
        return TroposphericDelay(
            model, f"the troposphere's delay is taken out: that of a standard atmosphere, {_words(model[used])}"
        )
    if wanted == "file":
        if given is None:
            raise InputError(
                f"--troposphere file is given, but PVP {NAME} is missing, not finite or 0; give --troposphere standard"
            )
        return TroposphericDelay(given, f"the troposphere's delay is taken out: that of {NAME}, {_words(given[used])}")
    if given is not None:
        return TroposphericDelay(
            0 * model,
            f"the troposphere's delay {NAME} is {_words(given[used])}: a part of the file's reference, as the standard "
            "has it; if places lie too far by that much, the samples hold it: --troposphere file takes it out",
        )
    message = None
    if model.max() > cell:
        message = (
            f"{NAME} is 0: if the samples hold the troposphere's delay, places lie too far by some "
            f"{model[used].mean():.3g} m, which --troposphere standard takes out"
        )
    return TroposphericDelay(0 * model, message)


def _given(file: CphdFile, used: IntArray) -> FloatArray | None:
    """The file's delay in m of range, from neighbours where it is not finite; None if it has none."""
    if NAME not in (file.vectors.dtype.names or ()) or file.vectors.dtype[NAME] != np.dtype("f8"):
        return None
    delay = file.parameter(NAME) * SPEED_OF_LIGHT / 2
    known = used[np.isfinite(delay[used])]
    if not known.size or not np.any(delay[known]):
        return None
    return np.interp(np.arange(delay.size), known, delay[known])


def _words(delay: FloatArray) -> str:
    """A delay (n,), m of range, in words."""
    return (
        f"{delay.mean() * 2e9 / SPEED_OF_LIGHT:.4g} ns or {delay.mean():.3g} m of range, which changes by "
        f"{np.ptp(delay):.2g} m over the collection"
    )


def _standard(file: CphdFile, used: IntArray, frame: Georeference) -> FloatArray:
    """The delay of a standard atmosphere between antenna and SRP, m of range, of some vectors."""
    import sarkit.wgs84

    antenna, srp = (file.parameter(f"{name}Pos", used) for name in ("Tx", "SRP"))
    latitude, _, height = np.moveaxis(np.asarray(sarkit.wgs84.cartesian_to_geodetic(antenna)), -1, 0)
    ground = np.asarray(sarkit.wgs84.cartesian_to_geodetic(srp))[:, 2]
    sight = frame.from_ecef(antenna) - frame.from_ecef(srp)
    sine = sight[:, 2] / np.linalg.norm(sight, axis=1)
    between = zenith_delay(ground, latitude) - zenith_delay(height, latitude)
    return np.asarray(between * 1.001 / np.sqrt(0.002001 + sine**2))


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
