"""What was found in the samples, in sentences."""

from __future__ import annotations

from blocksar.inspection.samples import STANDS_OUT, Inspection

MAX_OUTLIERS = 0.01  # of the samples that hold something; beyond that the store is damaged
SATURATED = (1e-3, 0.5)  # of the components, at the extreme value: fewer is chance, more is a coarse quantiser


# ---------------------------------------------------------------- what is said of it


def saturated(found: Inspection) -> bool:
    """Whether real and imaginary parts, each of them, stand at the extreme more often than chance has it.

    Each, because a target that stays in phase with the reference has all its real parts at 1, and is not clipped.
    """
    low, high = SATURATED
    return found.valid > 0 and all(low <= count / found.valid <= high for count in found.at_extreme)


def refusal(found: Inspection) -> str | None:
    """Why a whole phase history, merged, is not worth focusing: one sentence, or None."""
    count, held = found.n_outlier, found.valid + found.n_outlier
    if count <= MAX_OUTLIERS * held:
        return None
    return (
        f"signal holds {count} impossible samples among {held} ({count / held:.1%}), {STANDS_OUT:g}-fold above their "
        "neighbours and more: the store is damaged, or holds no complex64 phase history; write it again from its source"
    )


def lines(found: Inspection) -> list[str]:
    """What was found, merged, in plain sentences; none if nothing is wrong."""
    said = []
    whole = sum(count == found.n_column for count in found.missing.values())
    more = sum(found.missing.values()) - whole * found.n_column
    missing = [f"{whole} of {found.n_pulse} pulses {'is' if whole == 1 else 'are'} missing"] if whole else []
    if more:
        missing.append(f"{_samples(more, ' more' if whole else '')} not {'a number' if more == 1 else 'numbers'}")
    if missing:
        said.append(f"{', '.join(missing)}: counted as not lit")
    if found.outliers:
        one = found.n_outlier == 1
        said.append(
            f"{found.n_outlier} {'sample stands' if one else 'samples stand'} {STANDS_OUT:g}-fold above "
            f"{'its' if one else 'their'} neighbours: counted as not lit"
        )
    if saturated(found):
        real, imag = (count / found.valid for count in found.at_extreme)
        said.append(
            f"saturated: {real:.1%} of the real and {imag:.1%} of the imaginary parts stand at the largest value, "
            f"{found.extreme:g}: levels are too low there, and strong targets smeared"
        )
    return said


def _samples(count: int, more: str) -> str:
    return f"{count}{more} {'sample is' if count == 1 else 'samples are'}"
