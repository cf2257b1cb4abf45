"""Error budgets: how far a planned image may deviate from the ideal one."""

from __future__ import annotations

LOSS_BUDGET = 0.02  # fraction of a dwell lost to dispersion at its ends: it affects clutter, but not side lobes
PHASE_BUDGET = 0.1  # rad at the edge of the dwell; pi/4 is the usual limit
SIDE_LOBE_BUDGET = 0.2  # dB, change of the highest side lobe: a quartic phase within PHASE_BUDGET can exceed it
MIGRATION_BUDGET = 0.25  # range resolution cells over the dwell
AZIMUTH_TAP_ERROR = 1e-4  # of the interpolation along azimuth: keystone and Doppler resampling
IMAGE_TAP_ERROR = 1e-3  # of the interpolation of focused blocks
