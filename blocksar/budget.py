"""Limits of error by which a planned image may deviate from the ideal one, and limits of waiting time."""

from __future__ import annotations

FIDELITY = 0.999  # coherence with exact back-projection that `auto` keeps unless told otherwise
MOST_BLOCKS = 1000  # that a caller may ask for
LEAST_FIDELITY = 0.5  # that a caller may ask for; blocks that lose as much as that are refused as blurred
SIDE_LOBE_BUDGET = 0.2  # dB, change of the highest side lobe at FIDELITY; see `side_lobe_budget`
UNIFORM_SIDE_LOBES = -13.26  # dB, of an image without weighting
WEIGHTED_SIDE_LOBE_BUDGET = 0.5  # dB, of an image whose weighting has lower side lobes
AZIMUTH_TAP_ERROR = 1e-4  # of the interpolation along azimuth: keystone and Doppler resampling
IMAGE_TAP_ERROR = 1e-3  # of the interpolation of focused blocks
WAIT_WORKERS = 60.0  # s that a run waits for a worker of a running cluster that has none, unless told otherwise


def image_tap_error(fidelity: float) -> float:
    """Allowed error of the interpolation of focused blocks: less where a higher fidelity is asked for than usual."""
    return float(IMAGE_TAP_ERROR * min(((1 - fidelity) / (1 - FIDELITY)) ** 0.5, 1.0))


def side_lobe_budget(fidelity: float, ideal: float = UNIFORM_SIDE_LOBES) -> float:
    """Allowed change of the highest side lobe, which is ideally at `ideal` dB: up to SIDE_LOBE_BUDGET at any fidelity.

    What changes it is an amplitude, what costs coherence its square. The same amplitude changes lower side lobes more.
    """
    least = SIDE_LOBE_BUDGET * ((1 - fidelity) / (1 - FIDELITY)) ** 0.5
    return float(max(least, min(least * 10 ** ((UNIFORM_SIDE_LOBES - ideal) / 20), SIDE_LOBE_BUDGET)))
