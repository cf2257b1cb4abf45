"""The delay of the troposphere: what a file says of it, and taking it out of the samples.

The standard's reference delay is that of the SRP through the troposphere: 2 R_SRP / c + TDTropoSRP. Samples hold delays
after it, so that an echo of the SRP has dTOA = 0, and nothing is to be done but for the change of the delay over the
scene, which stays. In files whose reference delay is 2 R_SRP / c alone, all echoes are late by the delay td:

    dTOA = 2 (R - R_SRP) / c + td = 2 (R - (R_SRP - c td / 2)) / c,

so that reference_range is R_SRP - c td / 2 and the samples stay as they are. td is that of the file, or, where the file
has none, that of a standard atmosphere (`atmosphere`).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.atmosphere import delay_words, slant_delay
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
            model, f"the troposphere's delay is taken out: that of a standard atmosphere, {delay_words(model[used])}"
        )
    if wanted == "file":
        if given is None:
            raise InputError(
                f"--troposphere file is given, but PVP {NAME} is missing, not finite or 0; give --troposphere standard"
            )
        return TroposphericDelay(
            given, f"the troposphere's delay is taken out: that of {NAME}, {delay_words(given[used])}"
        )
    if given is not None:
        return TroposphericDelay(
            0 * model,
            f"the troposphere's delay {NAME} is {delay_words(given[used])}: a part of the file's reference, as the "
            "standard has it; if places lie too far by that much, the samples hold it: --troposphere file takes it out",
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


def _standard(file: CphdFile, used: IntArray, frame: Georeference) -> FloatArray:
    """The delay of a standard atmosphere between antenna and SRP, m of range, of some vectors."""
    return slant_delay(file.parameter("TxPos", used), file.parameter("SRPPos", used), frame)
