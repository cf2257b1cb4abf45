"""CPHD files (NGA.STND.0068, versions 1.0.1 and 1.1.0) to a phase history.

The standard's signal, for a target whose echo comes dTOA seconds after that of the vector's stabilisation reference
point (SRP), and for the absolute radio frequency fx, is

    S(fx) = sigma exp(2j pi SGN fx dTOA),   dTOA = 2 (R - R_SRP) / c,   R_SRP = |ARP - SRP|.

With SGN = -1 that is the store's own signal, sigma exp(-4j pi (fc + f)/c (R - reference_range)), for fc + f = fx and
reference_range = R_SRP, one for each vector: where the SRP moves, so does reference_range. With SGN = +1 it is the
complex conjugate. In the TOA domain the mainlobe of the target has the phase 2 pi SGN fx_C dTOA,
fx_C = (FX1 + FX2) / 2, so that, conjugated where SGN = +1,

    S(fx) = SCSS (FX2 - FX1) sum over samples s of S_TOA(t_s) exp(-2j pi (fx - fx_C) t_s),   t_s = SC0 + s SCSS:

a target that peaks at 1 has |S(fx)| = 1. That sum is evaluated on the store's frequencies by a chirp z-transform,
without interpolation, whatever SC0, SCSS and fx_C are from vector to vector.

FX vectors whose SC0 and SCSS differ are brought to one grid by local interpolation. What is sampled holds delays from
TOA1 to TOA2 only, less than the 1 / SCSS that the samples tell apart; of all interpolators of `TAPS` samples the one
used here is the best for delays spread evenly over that (least squares, so that one-sided ones at the ends of the band
serve as well). The largest error over those delays is computed, held below `ACCURACY`, and reported; a few samples at
either end of FX1 .. FX2, where it would not hold, are left out. Samples beyond FX1 and FX2, which a vector may have and
which mean nothing there, are not used. Nothing is interpolated where the grids agree.

Delays of troposphere and ionosphere up to the SRP are in the file's own reference and gone with it; what they differ
by over the scene is left in. With SGN = +1 reflectivity comes out conjugate, too: that of time running backwards.

If the saved delays are not centred at the SRP, reference_range moves to their middle: the range window of the store
is centred at reference_range.

Positions go from Earth-centred coordinates to x east, y north, z up (the ellipsoid's normal) at the scene's reference
point (IARP), which becomes the origin; the attribute `georeference` keeps it. Transmitter and receiver of a monostatic
collection are at two places of one track, as the platform moves while the pulse is under way: their middle is taken,
which is exact at the SRP; the difference elsewhere is computed at the corners of the image area, reported, and refused
beyond `MAX_BISTATIC` wavelengths. Slow time is the time of transmission, counted from the middle vector; vectors that
are missing from their uniform times, and those whose SIGNAL is not 1, are missing pulses. Where times are not uniform,
signals are referenced to one fixed point and resampled (`resampling`) within the Doppler band of the image area, and
the error is reported.

A file is read by blocks of vectors, of which only the samples in the common band, where that is less than half of them.
"""

from __future__ import annotations

from blocksar.ingestion.cphd.files import NAMESPACE, library
from blocksar.ingestion.cphd.ingestion import ingest

__all__ = ["NAMESPACE", "ingest", "library"]
