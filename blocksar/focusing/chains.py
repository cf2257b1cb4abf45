"""The processors as lists of steps; a variant is the same list with a step changed or left out.

    angular-division     paper A: keystone, RCMC, frequency perturbation, deramp
    keystone-resampling  paper B: keystone, RCMC, time perturbation, Doppler resampling, deramp
    high-order-phase     paper C: RCMC in the 2-D frequency domain, frequency perturbation, deramp

Only this module knows the order of steps. Planning binds their constants and traces lines through them, the graph
applies them, and both treat all processors alike.
"""

from __future__ import annotations

from blocksar.focusing.azimuth_steps import (
    AzimuthTransform,
    Deramp,
    DopplerResampling,
    DopplerTransform,
    FrequencyPerturbation,
    TimePerturbation,
)
from blocksar.focusing.method import Chain, Method
from blocksar.focusing.motion import MotionCompensation, RangeMotionCompensation, RangeMotionInFrequency
from blocksar.focusing.range_steps import (
    DopplerCompression,
    Keystone,
    RangeCompression,
    ResidualRangeWalk,
    TimeDomainCompression,
)
from blocksar.focusing.step import Step

Steps = tuple[type[Step], ...]

CHAINS: dict[Chain, Steps] = {
    "angular-division": (
        ResidualRangeWalk, MotionCompensation, Keystone, RangeCompression, RangeMotionCompensation,
        TimePerturbation, AzimuthTransform, FrequencyPerturbation, Deramp, DopplerTransform,
    ),
    "keystone-resampling": (
        ResidualRangeWalk, MotionCompensation, Keystone, RangeCompression, RangeMotionCompensation,
        TimePerturbation, AzimuthTransform, DopplerResampling, Deramp, DopplerTransform,
    ),
    "high-order-phase": (
        ResidualRangeWalk, MotionCompensation, RangeMotionInFrequency, AzimuthTransform, DopplerCompression,
        FrequencyPerturbation, Deramp, DopplerTransform,
    ),
}  # fmt: skip


MOTION = (MotionCompensation, RangeMotionCompensation, RangeMotionInFrequency)


def steps_of(method: Method, *, measured: bool = False) -> Steps:
    """The kinds of steps in order; range sub-blocks have a range gate before them.

    Only the chain for a measured track, one that is no polynomial, has motion compensation.
    """
    chain = CHAINS[method.processor]
    if not measured:
        chain = tuple(s for s in chain if s not in MOTION)
    if not method.keystone:
        chain = tuple(TimeDomainCompression if s is RangeCompression else s for s in chain if s is not Keystone)
    if method.perturbation == "frequency":
        chain = tuple(FrequencyPerturbation if s is DopplerResampling else s for s in chain)
    if method.perturbation == "none":
        chain = tuple(s for s in chain if s not in (DopplerResampling, FrequencyPerturbation))
    if method.perturbation != "all":
        chain = tuple(s for s in chain if s is not TimePerturbation)
    return chain
