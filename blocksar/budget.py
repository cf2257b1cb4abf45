"""How far a planned image may be from the ideal one."""

from __future__ import annotations

LOSS_BUDGET = 0.02  # of a dwell, taken from its ends by dispersion: clutter feels it where side lobes do not

PHASE_BUDGET = 0.1  # rad at the edge of the dwell; pi/4 is the usual limit
SIDE_LOBE_BUDGET = 0.2  # dB that the highest side lobe may change: a quartic phase does that below its budget
MIGRATION_BUDGET = 0.25  # range resolution cells over the dwell
AZIMUTH_TAP_ERROR = 1e-4  # of the interpolation along azimuth: keystone and Doppler resampling
IMAGE_TAP_ERROR = 1e-3  # of the interpolation of focused blocks
