"""Ingestion of CPHD files (NGA.STND.0068, versions 1.0 and 1.1).

The standard's signal, for a target whose echo arrives dTOA seconds after that of the vector's stabilisation reference
point (SRP), and for the absolute radio frequency fx, is

    S(fx) = sigma exp(2j pi SGN fx dTOA),   dTOA = 2 (R - R_SRP) / c,   R_SRP = |ARP - SRP|.

With SGN = -1 that is the store's own signal, sigma exp(-4j pi (fc + f)/c (R - reference_range)), for fc + f = fx and
reference_range = R_SRP, one per vector: if the SRP moves, so does reference_range. With SGN = +1 it is the complex
conjugate. In the TOA domain the mainlobe of the target has the phase 2 pi SGN fx_C dTOA,
fx_C = (FX1 + FX2) / 2, so that, conjugated where SGN = +1,

    S(fx) = SCSS (FX2 - FX1) sum over samples s of S_TOA(t_s) exp(-2j pi (fx - fx_C) t_s),   t_s = SC0 + s SCSS:

a target with a peak of 1 has |S(fx)| = 1. The sum is evaluated at the store's frequencies by a chirp z-transform,
without interpolation, even if SC0, SCSS and fx_C differ from vector to vector.

FX vectors whose SC0 and SCSS differ by less than `SAME_GRID` samples are taken as they are: a sample that is delta off
the grid is wrong by the phase 2 pi delta SCSS (dTOA - middle of the saved delays). Others are brought to one grid by
local interpolation. The samples contain only delays from TOA1 to TOA2, less than the unambiguous 1 / SCSS; of all
interpolators with as many samples (`TAPS`) the one used here is optimal for delays spread evenly over that interval
(least squares, so that one-sided interpolation at the ends of the band is accurate as well). The largest error over
those delays is computed, kept below `ACCURACY`, and reported; a few samples at either end of FX1 .. FX2, where it would
be exceeded, are left out, and where TOA1 .. TOA2 fills all of 1 / SCSS, the delays at its ends. Samples beyond FX1 and
FX2, which a vector may have but which carry no meaning, are not used.

Tropospheric and ionospheric delays up to the SRP are part of the file's reference and removed with it (`frequency_grid`
has the exceptions); their variation over the scene remains. With SGN = +1 the reflectivity is conjugated as
well, as if time ran backwards.

If the saved delays are not centred at the SRP, reference_range moves to their middle, because the range window of the
store is centred at reference_range.

Positions are converted from Earth-centred coordinates to x east, y north, z up (the ellipsoid's normal) at the scene's
reference point (IARP), which becomes the origin and is stored in the attribute `georeference`. Transmitter and receiver
of a monostatic collection are at two points of one track, since the platform moves during the pulse's travel time; the
phase centre is taken midway between them. This is exact at the SRP; the range error elsewhere is computed at the
corners of the image area, reported, and refused beyond `MAX_BISTATIC` wavelengths. Slow time is the time of
transmission relative to the middle vector. Vectors absent from the uniform times, and those that are lost (`vectors`,
`echoes`), are missing pulses. If times are not uniform, signals are referenced to one fixed point and resampled
(`resampling`) within the Doppler band of the image area, and the error is reported.

The beam is that of the dwell polynomials and of the antenna's metadata (`beams`, `antennas`).

A file is read in blocks of vectors, and only the samples in the common band if those are less than half of a vector.
"""

from __future__ import annotations

from blocksar.readers.cphd.files import NAMESPACE, library
from blocksar.readers.cphd.reader import Choices

__all__ = ["NAMESPACE", "Choices", "library"]
