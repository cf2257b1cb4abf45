"""Inspection of samples: missing, impossible and clipped ones, and sums from which the Doppler centroid follows.

One compiled pass (`scan`) over all pulses of some columns finds samples that are not numbers, samples that no scene can
produce, the extreme level of the components, and sums over pairs of neighbouring pulses that give the Doppler centroid.
Invalid samples are set to zero, which everything downstream reads as "not lit". The result of a pass is an
`Inspection`: plain numbers, so that the inspection of a whole phase history is the sum of those of its columns, however
they were grouped. What follows and `centroid` evaluate it.

Outliers
--------
A scene's samples along the pulses of one range frequency change no faster than targets enter and leave the beam: a
strong target that comes into sight is present in the next pulses too, even where every other pulse is missing.
Rayleigh clutter exceeds its median by STANDS_OUT (40 dB) in one of exp(7000) samples, a jammed column has a high
median, and a single pulse jammed by more than that has no echoes worth keeping. Damaged samples do exceed it: flipping
one of the five highest bits of the exponent multiplies a sample by 2^8 or more, unless it is zero. Samples BEYOND_ALL
(160 dB) above the median are wrong whatever their neighbours: those in a burst of damage, which shield each other, and
those all of whose neighbours are missing.

Pulse pairs
-----------
The angle of the mean of conj(s[p]) s[p + 1] exp(-2j pi expected advance) is the power-weighted Doppler centroid minus
the expected one; the expected advance is that of the middle of the lit area (`Motion.bulk` and its derotation). A
target over which the beam sweeps from edge to edge runs through the lit band from end to end, at about the same rate
for all targets: its pairs add up to sinc(band / PRF) of its energy, at angle zero, wherever it lies and whatever else
is in the scene. So the sum over an aperture of many dwells is real and positive if track and beam match the data.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.track_shape import find_flaw
from blocksar.imaging.recorded_pulses import LEAST_SHARE
from blocksar.inspection.scan import BEYOND_ALL, STANDS_OUT, scan_pulses, sum_pairs
from blocksar.kernels.fourier import Axis
from blocksar.kernels.groups import run_groups
from blocksar.kernels.phase import Float32Array

SEGMENTS = 32  # of slow time, in which pulse pairs are summed: several per dwell
SQUARED = (1e-12, 1e15)  # extreme levels between which samples are squared in float32 without scaling

Counts = dict[int, int]


class Motion(Protocol):
    """Motion that all echoes share, which tells the Doppler to expect: a chain's `Recovery` is one.

    Attributes
    ----------
    carrier : float
        Hz.
    pulses : Axis
        Slow time of the pulses from the epoch, s.
    walk : float
        Unified range walk, m/s.
    common : object
        Range besides that all targets share: `at(time, derivative)`, m.
    bulk : (n_pulse,) float
        Cycles on the carrier, per pulse, that turn the stored reference range into the shared one.
    """

    @property
    def carrier(self) -> float: ...

    @property
    def pulses(self) -> Axis: ...

    @property
    def walk(self) -> float: ...

    @property
    def common(self) -> Any: ...

    @property
    def bulk(self) -> FloatArray: ...

    def derotation_cycles(self, time: FloatArray) -> FloatArray:
        """Phase of the derotation at slow times from the epoch, cycles on the carrier."""
        ...


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """The result of inspecting some columns of a phase history, or all of them once merged.

    Attributes
    ----------
    n_pulse, n_column : int
        Size of the inspected part.
    missing : dict of int
        Number of samples that were not finite, by pulse.
    outliers : dict of list
        Columns of the impossible samples, ascending, by pulse.
    empty : list of [first, last]
        Runs of pulses first .. last - 1 whose samples are all zero.
    valid : int
        Number of samples that are neither missing nor outliers nor zero.
    extreme : float
        Largest modulus of a real or imaginary part among the valid samples.
    at_extreme : tuple of int
        Numbers of real and of imaginary parts with exactly that modulus.
    pairs : (SEGMENTS, 3) list
        For each segment of slow time: real and imaginary part of the sum over pairs of neighbouring pulses, and the
        energy of its pulses. Empty if no Doppler was expected.
    """

    n_pulse: int
    n_column: int
    missing: Counts = field(default_factory=dict)
    outliers: dict[int, list[int]] = field(default_factory=dict)
    empty: list[list[int]] = field(default_factory=list)
    valid: int = 0
    extreme: float = 0.0
    at_extreme: tuple[int, int] = (0, 0)
    pairs: list[list[float]] = field(default_factory=list)

    @property
    def n_outlier(self) -> int:
        """Number of impossible samples."""
        return sum(map(len, self.outliers.values()))

    @property
    def lit(self) -> FloatArray:
        """Share of each pulse's samples that are neither missing nor outliers, (n_pulse,)."""
        lost = np.zeros(self.n_pulse)
        for pulse, count in self.missing.items():
            lost[pulse] += count
        for pulse, columns in self.outliers.items():
            lost[pulse] += len(columns)
        return 1 - lost / self.n_column

    @property
    def is_empty(self) -> BoolArray:
        """Find which pulses hold zeros only, (n_pulse,)."""
        mask = np.zeros(self.n_pulse, np.bool_)
        for first, last in self.empty:
            mask[first:last] = True
        return mask

    def without(self, pulses: BoolArray) -> Self:
        """Copy with some more pulses (n_pulse,) missing, all of their samples."""
        more = dict.fromkeys(np.flatnonzero(pulses).tolist(), self.n_column)
        return replace(self, missing=dict(sorted({**self.missing, **more}.items())))

    def as_dict(self) -> dict[str, Any]:
        """The attributes for JSON, whose keys are strings."""
        plain = dict(vars(self))
        for name in ("missing", "outliers"):
            plain[name] = {str(pulse): entry for pulse, entry in plain[name].items()}
        return plain

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> Self:
        """The inspection that `as_dict` gave, through JSON or not."""
        keyed = {name: {int(pulse): entry for pulse, entry in plain[name].items()} for name in ("missing", "outliers")}
        return cls(**{**plain, **keyed, "at_extreme": tuple(plain["at_extreme"])})


def merge(parts: Iterable[Inspection]) -> Inspection:
    """Merge the inspections of groups of columns.

    Raises
    ------
    ValueError
        If there are none, or they do not have the same pulses.
    """
    first, *others = parts
    for part in others:
        first = _merge_pair(first, part)
    return first


def _merge_pair(a: Inspection, b: Inspection) -> Inspection:
    if a.n_pulse != b.n_pulse or bool(a.pairs) != bool(b.pairs):
        raise ValueError(f"{a.n_pulse} and {b.n_pulse} pulses, or pairs in one only, are not of one phase history")
    extreme = max(a.extreme, b.extreme)
    pulses = sorted({*a.missing, *b.missing})
    outliers = sorted({*a.outliers, *b.outliers})
    return Inspection(
        n_pulse=a.n_pulse,
        n_column=a.n_column + b.n_column,
        missing={p: a.missing.get(p, 0) + b.missing.get(p, 0) for p in pulses},
        outliers={p: sorted(a.outliers.get(p, []) + b.outliers.get(p, [])) for p in outliers},
        empty=_runs(a.is_empty & b.is_empty),
        valid=a.valid + b.valid,
        extreme=extreme,
        at_extreme=(
            sum(part.at_extreme[0] for part in (a, b) if part.extreme == extreme),
            sum(part.at_extreme[1] for part in (a, b) if part.extreme == extreme),
        ),
        pairs=[[x + y for x, y in zip(*rows, strict=True)] for rows in zip(a.pairs, b.pairs, strict=True)],
    )


def merge_echoes(parts: Iterable[Inspection]) -> Inspection:
    """Merge the inspections of groups of pulses of a raw echo: counts only.

    Missing samples are left out, as they are reported for the compressed signal. Outliers keep neither pulse nor order.
    """
    parts = list(parts)
    extreme = max(part.extreme for part in parts)
    counts = [part.at_extreme for part in parts if part.extreme == extreme]
    outliers = [columns for part in parts for columns in part.outliers.values()]
    return Inspection(
        n_pulse=sum(part.n_pulse for part in parts),
        n_column=parts[0].n_column,
        outliers=dict(enumerate(outliers)),
        valid=sum(part.valid for part in parts),
        extreme=extreme,
        at_extreme=(sum(real for real, _ in counts), sum(imag for _, imag in counts)),
    )


def join_segments(parts: Sequence[tuple[int, Inspection]], n_pulse: int) -> Inspection:
    """Join the inspections of segments of one collection, each with its first pulse: counts only.

    Pulses that segments share are counted once where samples are missing or impossible.
    """
    extreme = max(part.extreme for _, part in parts)
    counts = [part.at_extreme for _, part in parts if part.extreme == extreme]
    return Inspection(
        n_pulse=n_pulse,
        n_column=parts[0][1].n_column,
        missing={first + pulse: count for first, part in parts for pulse, count in part.missing.items()},
        outliers={first + pulse: columns for first, part in parts for pulse, columns in part.outliers.items()},
        empty=sorted([first + begin, first + end] for first, part in parts for begin, end in part.empty),
        valid=sum(part.valid for _, part in parts),
        extreme=extreme,
        at_extreme=(sum(real for real, _ in counts), sum(imag for _, imag in counts)),
    )


def zero_impossible(
    signal: ComplexArray,
    *,
    range_frequency: FloatArray,
    recovery: Motion | None,
    first_column: int = 0,
    threads: int = 1,
) -> Inspection:
    """Inspect some columns of a phase history, and set samples that are not finite or impossible to zero in place.

    The modulus of a sample means the larger modulus of its two parts; its neighbours are one and two pulses before and
    after; neighbours and median include only samples that are finite and not zero. A column is suspect if any of its
    samples exceeds STANDS_OUT times the largest of its neighbours or has none, or exceeds BEYOND_ALL times those before
    it or those after it. In a suspect column a sample is impossible if it has neighbours and exceeds STANDS_OUT times
    both their largest and the median, or if it exceeds BEYOND_ALL times the median. Each column is judged by itself, so
    the grouping of columns does not matter. Not detected: damage that makes samples smaller or slightly larger, and
    damage below BEYOND_ALL within two pulses of other damage. A target that is lit for a single pulse, 40 dB above all
    else, is lost.

    Parameters
    ----------
    signal : (n_pulse, n_column) complex64, C-contiguous
        All pulses. Changed.
    range_frequency : (n_column,) float
        Hz, from `recovery.carrier`; uniform.
    recovery : Motion or None
        Gives the expected Doppler. None where no Doppler can be expected (see `centroid.expect`): no pairs are summed.
    first_column : int
        Number of the first column in the phase history, for the columns of outliers.
    threads : int
        Neither the result nor the samples depend on it.

    Returns
    -------
    Inspection

    Raises
    ------
    ValueError
        If the signal is not contiguous, or does not have the recovery's pulses.
    """
    n_pulse, n_column = signal.shape
    if not signal.flags.c_contiguous or signal.dtype != np.complex64 or range_frequency.shape != (n_column,):
        raise ValueError(f"{signal.dtype} samples {signal.shape} of {range_frequency.shape=} must be C-contiguous")
    if recovery is not None and recovery.pulses.size != n_pulse:
        raise ValueError(f"{signal.shape=}, but the recovery is of {recovery.pulses.size} pulses")
    with np.errstate(invalid="ignore"):  # garbage may have signalling NaN
        empty = signal[:, 0] == 0  # of few pulses, so that the others are not read once more
    empty[empty] = ~signal[empty].any(axis=1)
    scan = _scan(signal, range_frequency, recovery, threads)
    missing, outliers = scan.missing, {}
    if missing.any() or scan.suspect.any():
        # Invalid samples spoil the sums: set them to zero and scan again.
        signal[missing > 0] = _finite(signal[missing > 0])
        outliers = _zero_outliers(signal, np.flatnonzero(scan.suspect.any(axis=0)))
        scan = _scan(signal, range_frequency, recovery, threads)
    extreme = float(scan.extreme.max().view(np.float32))
    if recovery is not None and extreme > 0 and not SQUARED[0] < extreme < SQUARED[1]:
        exponent = np.clip(np.frexp(extreme)[1], -100, 100)
        scan = _scan(signal, range_frequency, recovery, threads, scale=2.0 ** -float(exponent))
    real, imag = scan.at_extreme[scan.extreme == scan.extreme.max()].sum(axis=0)
    return Inspection(
        n_pulse=n_pulse,
        n_column=n_column,
        missing={int(p): int(missing[p]) for p in np.flatnonzero(missing)},
        outliers={p: [first_column + c for c in columns] for p, columns in outliers.items()},
        empty=_runs(empty),
        valid=int(scan.valid.sum()),
        extreme=extreme,
        at_extreme=(int(real), int(imag)),
        pairs=scan.pairs.tolist() if recovery is not None else [],
    )


@dataclass(frozen=True, eq=False)
class _Scan:
    """The arrays that one pass fills."""

    missing: IntArray  # (n_pulse,)
    suspect: BoolArray  # (SEGMENTS, n_column)
    valid: IntArray  # (SEGMENTS,)
    extreme: NDArray[np.int32]  # (SEGMENTS,) bits of a float32
    at_extreme: IntArray  # (SEGMENTS, 2)
    pairs: FloatArray  # (SEGMENTS, 3)


def _scan(
    signal: ComplexArray,
    range_frequency: FloatArray,
    recovery: Motion | None,
    threads: int,
    *,
    scale: float = 1.0,
) -> _Scan:
    """Run one pass. Pairs are summed of samples times `scale`, a power of two, and the sums scaled back."""
    n_pulse, n_column = signal.shape
    scan = _Scan(
        np.zeros(n_pulse, np.int64),
        np.zeros((SEGMENTS, n_column), np.bool_),
        np.zeros(SEGMENTS, np.int64),
        np.zeros(SEGMENTS, np.int32),
        np.zeros((SEGMENTS, 2), np.int64),
        np.zeros((SEGMENTS, 3)),
    )
    advance, factor = np.zeros(0), np.ones(2)
    if recovery is not None:
        advance = np.diff(recovery.bulk + recovery.derotation_cycles(recovery.pulses.values))
        step = (range_frequency[-1] - range_frequency[0]) / max(n_column - 1, 1)
        factor = np.array([1 + range_frequency[0] / recovery.carrier, step / recovery.carrier])
    parts = signal.view(np.float32)
    part_bits = parts.view(np.int32)
    edges = np.arange(SEGMENTS + 1) * n_pulse // SEGMENTS

    def work(k: int) -> None:
        first, last = int(edges[k]), int(edges[k + 1])
        moduli = np.zeros((5, n_column), np.float32)
        bits = moduli.view(np.int32)
        levels = scan_pulses(parts, part_bits, moduli, bits, first, last, scan.missing, scan.suspect[k])
        scan.valid[k], scan.extreme[k], scan.at_extreme[k] = levels[0], levels[1], levels[2:]
        if recovery is not None:
            sum_pairs(signal, np.float32(scale), first, last, advance, factor, scan.pairs[k])
            scan.pairs[k] /= scale**2

    run_groups(work, range(SEGMENTS), threads)
    return scan


def _runs(mask: BoolArray) -> list[list[int]]:
    """The runs first .. last - 1 of a mask (n,)."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2).tolist()


def _finite(signal: ComplexArray) -> ComplexArray:
    return np.where(np.isfinite(signal), signal, np.complex64(0))


def _zero_outliers(signal: ComplexArray, columns: IntArray) -> dict[int, list[int]]:
    """Set the impossible samples of some columns, all finite, to zero; return their columns by pulse."""
    outliers: dict[int, list[int]] = {}
    for column in columns:
        samples = signal[:, column]
        pulses = np.flatnonzero(_impossible(np.maximum(np.abs(samples.real), np.abs(samples.imag))))
        samples[pulses] = 0
        for pulse in pulses:
            outliers.setdefault(int(pulse), []).append(int(column))
    return dict(sorted(outliers.items()))


def _impossible(modulus: Float32Array) -> BoolArray:
    """Mask of the impossible samples of a suspect column (n_pulse,)."""
    padded = np.pad(modulus, 2)
    near = np.maximum.reduce([padded[:-4], padded[1:-3], padded[3:-1], padded[4:]])
    median = np.median(modulus[modulus > 0])
    with np.errstate(over="ignore"):
        lone = (near > 0) & (modulus > np.float32(STANDS_OUT) * near) & (modulus > STANDS_OUT * median)
        return lone | (modulus > BEYOND_ALL * median)


def mask_outliers(signal: ComplexArray, inspection: Inspection, *, pulses: slice) -> None:
    """Set outliers, infinities and missing pulses to NaN in place, for callers that read by pulse.

    Parameters
    ----------
    signal : (n, n_column) complex64
        All columns of these pulses.
    inspection : Inspection
        Of the whole phase history.
    pulses : slice
        The n pulses of `signal`.
    """
    signal[np.isinf(signal)] = np.nan
    signal[inspection.lit[pulses] == 0] = np.nan
    for pulse, columns in inspection.outliers.items():
        if pulses.start <= pulse < pulses.stop:
            signal[pulse - pulses.start, columns] = np.nan


MAX_OUTLIERS = 0.01  # of the valid samples and outliers; beyond that the store is damaged
SATURATED = (1e-3, 0.5)  # share of the components at the extreme value: fewer is chance, more is a coarse quantiser

GAP, BESIDE = 8, 4  # samples that a gap has at least, and pulses before and after that have others there

SLOW, HIGH = 10.0, 1000.0  # m/s, m: platforms above HIGH are faster than SLOW


def count_zero_gaps(echo: ComplexArray) -> int:
    """Count samples that look like gaps written as zeros in pulses (n, n_fast_time) of a raw echo.

    They are runs of more than GAP zeros which the pulses BESIDE before and after have not. Zeros where nothing echoes,
    as before the first target of an echo without noise, are in all of these pulses.
    """
    zero = echo == 0
    alone = zero[BESIDE:-BESIDE] & ~(zero[: -2 * BESIDE] | zero[2 * BESIDE :])
    if not alone.any():
        return 0
    edges = np.flatnonzero(np.diff(np.pad(alone, ((0, 0), (1, 1))).ravel().astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths > GAP].sum())


def describe_gaps(parts: Sequence[Inspection], zeros: int) -> list[str]:
    """Describe the gaps in pulses of a raw echo, from its groups' inspections and the number of zeros like gaps."""
    counts = [n for part in parts for n in part.missing.values() if n < part.n_column]
    size = sum(part.n_pulse for part in parts) * parts[0].n_column
    messages = []
    if counts:
        messages.append(
            f"{100 * sum(counts) / size:.2g} % of the echo's samples are missing, gaps in {len(counts)} "
            f"pulse{'s' if len(counts) > 1 else ''}: these are divided by the part of them that was recorded; noise "
            f"rises by its inverse, and echoes of which less than {LEAST_SHARE:g} was recorded stay too weak"
        )
    if zeros:
        messages.append(
            f"{100 * zeros / size:.2g} % of the echo's samples are zeros in gaps that the pulses beside do not have, "
            "as of transmit events: echoes are too weak by their share; give NaN there, and pulses are divided by the "
            "part of them that was recorded"
        )
    return messages


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
    """Describe unusual properties of the track, a sentence each; `exact`: for back-projection, which takes any."""
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
