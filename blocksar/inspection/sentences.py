"""The results of an inspection as sentences for people, and what makes a collection doubtful."""

from __future__ import annotations

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.collection.track_shape import find_flaw
from blocksar.inspection.samples import Inspection
from blocksar.inspection.scan import STANDS_OUT

MAX_OUTLIERS = 0.01  # of the valid samples and outliers; beyond that the store is damaged
SATURATED = (1e-3, 0.5)  # share of the components at the extreme value: fewer is chance, more is a coarse quantiser

SLOW, HIGH = 10.0, 1000.0  # m/s, m: what flies higher than this is faster than that


def is_saturated(inspection: Inspection) -> bool:
    """Whether both the real and the imaginary parts reach the extreme value more often than by chance.

    Both, because a target that stays in phase with the reference has all its real parts at 1 without being clipped.
    """
    low, high = SATURATED
    return inspection.valid > 0 and all(low <= count / inspection.valid <= high for count in inspection.at_extreme)


def refusal(inspection: Inspection) -> str | None:
    """The reason why a whole phase history is not worth focusing: one sentence, or None."""
    count, total = inspection.n_outlier, inspection.valid + inspection.n_outlier
    if count <= MAX_OUTLIERS * total:
        return None
    return (
        f"signal holds {count} impossible samples among {total} ({count / total:.1%}), at least {STANDS_OUT:g}-fold "
        "above their neighbours: the store is damaged, or holds no complex64 phase history; write it again from its "
        "source"
    )


def describe(inspection: Inspection) -> list[str]:
    """Describe what is wrong in a merged inspection, one sentence each; none if nothing is."""
    messages = []
    lost = [pulse for pulse, count in inspection.missing.items() if count == inspection.n_column]
    whole, zeros = len(lost), int(inspection.is_empty[lost].sum())
    more = sum(inspection.missing.values()) - whole * inspection.n_column
    missing = [f"{whole} of {inspection.n_pulse} pulses {'is' if whole == 1 else 'are'} missing"] if whole else []
    if zeros:
        missing[0] += f" ({zeros} {'holds' if zeros == 1 else 'hold'} zeros only)"
    if more:
        missing.append(f"{_samples(more, ' more' if whole else '')} not {'a number' if more == 1 else 'numbers'}")
    if missing:
        messages.append(f"{', '.join(missing)}: counted as not lit")
    if inspection.outliers:
        one = inspection.n_outlier == 1
        messages.append(
            f"{inspection.n_outlier} {'sample stands' if one else 'samples stand'} {STANDS_OUT:g}-fold above "
            f"{'its' if one else 'their'} neighbours: counted as not lit"
        )
    if is_saturated(inspection):
        real, imag = (count / inspection.valid for count in inspection.at_extreme)
        messages.append(
            f"saturated: {real:.1%} of the real and {imag:.1%} of the imaginary parts stand at the largest value, "
            f"{inspection.extreme:g}: levels are too low there, and strong targets smeared"
        )
    return messages


def _samples(count: int, more: str) -> str:
    return f"{count}{more} {'sample is' if count == 1 else 'samples are'}"


def doubts_of_track(collection: Collection, *, exact: bool = False) -> list[str]:
    """What is unusual about the track, a sentence each; `exact`: for back-projection, which takes any."""
    flaw = find_flaw(collection)
    doubts = [doubted_time(collection), None if flaw is None else flaw.fact if exact else str(flaw)]
    return [doubt for doubt in doubts if doubt is not None]


def doubted_time(collection: Collection) -> str | None:
    """A sentence if the platform is too slow for its height, as it is with times in ms or pulse numbers; else None.

    An image does not depend on the unit of time if all times have the same; its products do.
    """
    way = float(np.linalg.norm(np.diff(collection.antenna_position, axis=0), axis=1).sum())
    speed = way / float(collection.time[-1] - collection.time[0])
    height = float(np.median(collection.antenna_position[:, 2])) - collection.ground_height
    if speed >= SLOW or height < HIGH:
        return None
    numbered = abs(collection.pulse_interval - 1) < 1e-9
    return (
        f"antenna_position moves at {speed:.3g} m/s, {height:.5g} m above the ground, which no aircraft does: time "
        + ("looks like pulse numbers; divide it by the PRF" if numbered else "looks like ms; give it in s")
    )
