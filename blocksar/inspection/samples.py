"""Inspection of samples: what is missing, impossible or clipped, and whether track and beam belong to the data.

One compiled pass over all pulses of some columns finds samples that are not numbers, samples that no scene can give,
the extreme level of the components, and sums over pairs of neighbouring pulses that tell the Doppler centroid. What
is wrong is zeroed, which is how everything downstream reads "not lit". What a pass found is an `Inspection`: plain
numbers, that of a whole phase history the sum of those of its columns, whichever way they were grouped. Small
functions judge it and say it in sentences.

Outliers
--------
A scene's samples along the pulses of one range frequency change no faster than targets enter and leave the beam: a
strong target that comes into sight is its own neighbour at the next pulses, also where every other one is missing.
Rayleigh clutter exceeds its median by STANDS_OUT (40 dB) in one of exp(7000) samples, a jammed column is its own
median, and a single pulse that is jammed by more leaves nothing of its echoes that would be worth keeping. Damage
does exceed it: flipped, one of the five highest bits of the exponent multiplies by 2^8 and more, or finds nothing to
multiply. Samples BEYOND_ALL (160 dB) above the median are wrong in any company: those of a burst of damage, which
shield each other, and those all of whose neighbours are missing.

Pulse pairs
-----------
The mean of conj(s[p]) s[p + 1] exp(-2j pi expected advance) turns at the power-weighted centroid of Doppler, less
the expected one, with the expected advance that of the middle of what is lit (`Recovery.bulk` and its derotation). A
target that the beam sweeps over from edge to edge runs through the lit band from end to end, at a rate that is about
the same for all: its pairs add up to sinc(band / PRF) of its energy, at angle zero, wherever it lies and whatever
else there is. So the sum over an aperture of many dwells is real and positive, if track and beam are those of the data.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.constants import TURN
from blocksar.focusing.recovery import Recovery
from blocksar.kernels.groups import run_groups
from blocksar.kernels.lanes import LANES, load_imag, load_real, store
from blocksar.kernels.phase import Float32Array

SEGMENTS = 32  # of slow time, over which pulse pairs are summed: several to a dwell
STANDS_OUT = 100.0  # an impossible sample over its neighbours, and over its column's median
BEYOND_ALL = 1e8  # over its column's median alone
SQUARED = (1e-12, 1e15)  # samples whose squares are summed in float32 as they are

Counts = dict[int, int]


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """What was found in some columns of a phase history; of all of them once merged.

    Attributes
    ----------
    n_pulse, n_column : int
        What was looked at.
    missing : dict of int
        Samples that were not finite: their number, by pulse.
    outliers : dict of list
        Samples that were impossible: their columns, ascending, by pulse.
    valid : int
        Samples that are neither, and not zero.
    extreme : float
        Largest modulus of a real or imaginary part among them.
    at_extreme : tuple of int
        Real parts of exactly that modulus, and imaginary parts.
    pairs : (SEGMENTS, 3) list
        Of each segment of slow time: real and imaginary part of the sum over pairs of neighbouring pulses, and the
        energy of its pulses. Empty if nothing was expected of the Doppler.
    """

    n_pulse: int
    n_column: int
    missing: Counts = field(default_factory=dict)
    outliers: dict[int, list[int]] = field(default_factory=dict)
    valid: int = 0
    extreme: float = 0.0
    at_extreme: tuple[int, int] = (0, 0)
    pairs: list[list[float]] = field(default_factory=list)

    @property
    def n_outlier(self) -> int:
        return sum(map(len, self.outliers.values()))

    @property
    def lit(self) -> FloatArray:
        """Share of each pulse's samples that hold, (n_pulse,)."""
        lost = np.zeros(self.n_pulse)
        for pulse, count in self.missing.items():
            lost[pulse] += count
        for pulse, columns in self.outliers.items():
            lost[pulse] += len(columns)
        return 1 - lost / self.n_column

    def as_dict(self) -> dict[str, Any]:
        """For JSON, whose keys are strings."""
        plain = dict(vars(self))
        for name in ("missing", "outliers"):
            plain[name] = {str(pulse): found for pulse, found in plain[name].items()}
        return plain

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> Self:
        """From `as_dict`, through JSON or not."""
        keyed = {name: {int(pulse): found for pulse, found in plain[name].items()} for name in ("missing", "outliers")}
        return cls(**{**plain, **keyed, "at_extreme": tuple(plain["at_extreme"])})


def merge(parts: Iterable[Inspection]) -> Inspection:
    """The inspection of all the columns of some.

    Raises
    ------
    ValueError
        If there are none, or they are not of the same pulses.
    """
    first, *others = parts
    for part in others:
        first = _merged(first, part)
    return first


def _merged(a: Inspection, b: Inspection) -> Inspection:
    if a.n_pulse != b.n_pulse or bool(a.pairs) != bool(b.pairs):
        raise ValueError(f"{a.n_pulse} and {b.n_pulse} pulses, or pairs in one only, are no one phase history")
    extreme = max(a.extreme, b.extreme)
    pulses = sorted({*a.missing, *b.missing})
    struck = sorted({*a.outliers, *b.outliers})
    return Inspection(
        n_pulse=a.n_pulse,
        n_column=a.n_column + b.n_column,
        missing={p: a.missing.get(p, 0) + b.missing.get(p, 0) for p in pulses},
        outliers={p: sorted(a.outliers.get(p, []) + b.outliers.get(p, [])) for p in struck},
        valid=a.valid + b.valid,
        extreme=extreme,
        at_extreme=(
            sum(part.at_extreme[0] for part in (a, b) if part.extreme == extreme),
            sum(part.at_extreme[1] for part in (a, b) if part.extreme == extreme),
        ),
        pairs=[[x + y for x, y in zip(*rows, strict=True)] for rows in zip(a.pairs, b.pairs, strict=True)],
    )


def levels(parts: Iterable[Inspection]) -> Inspection:
    """What was found in a raw echo, pulses after pulses: only counts; what is missing is told of the signal."""
    parts = list(parts)
    extreme = max(part.extreme for part in parts)
    counts = [part.at_extreme for part in parts if part.extreme == extreme]
    struck = [columns for part in parts for columns in part.outliers.values()]
    return Inspection(
        n_pulse=sum(part.n_pulse for part in parts),
        n_column=parts[0].n_column,
        outliers=dict(enumerate(struck)),
        valid=sum(part.valid for part in parts),
        extreme=extreme,
        at_extreme=(sum(real for real, _ in counts), sum(imag for _, imag in counts)),
    )


# ---------------------------------------------------------------- the pass over the samples


def inspect(
    signal: ComplexArray,
    *,
    range_frequency: FloatArray,
    recovery: Recovery | None,
    first_column: int = 0,
    threads: int = 1,
) -> Inspection:
    """Look at some columns of a phase history; what is not finite or impossible becomes 0, in place.

    A sample's modulus is here the larger one of its two parts, its neighbours are one and two pulses before and after,
    and neighbours and median count samples that are finite and not zero. A column is suspect if any of its samples
    exceeds STANDS_OUT times the largest of its neighbours or has none, or exceeds BEYOND_ALL times those before it or
    those after it. In a suspect column a sample is impossible if it exceeds STANDS_OUT times the median, and as many
    times the largest of its neighbours, of which it has some; or BEYOND_ALL times the median. Columns are judged each
    by itself, so that it does not matter how they are grouped. Cannot be told: damage that makes samples smaller or a
    little larger, and damage within two pulses of another's, by less than BEYOND_ALL. A target that is lit for a single
    pulse, 40 dB above all else, is lost.

    Parameters
    ----------
    signal : (n_pulse, n_column) complex64, C-contiguous
        All pulses. Changed.
    range_frequency : (n_column,) float
        Hz, from `recovery.carrier`; uniform.
    recovery : Recovery or None
        Says what Doppler is expected; None where that says nothing, see `disagreement`: no pairs are summed then.
    first_column : int
        That the outliers' columns are counted from.
    threads : int
        The result does not depend on it, nor do the samples.

    Returns
    -------
    Inspection

    Raises
    ------
    ValueError
        If the signal is not contiguous, or not that of the recovery's pulses.
    """
    n_pulse, n_column = signal.shape
    if not signal.flags.c_contiguous or signal.dtype != np.complex64 or range_frequency.shape != (n_column,):
        raise ValueError(f"{signal.dtype} samples {signal.shape} of {range_frequency.shape=} must be C-contiguous")
    if recovery is not None and recovery.pulses.size != n_pulse:
        raise ValueError(f"{signal.shape=}, but the recovery is of {recovery.pulses.size} pulses")
    scan = _scan(signal, range_frequency, recovery, threads)
    missing, outliers = scan.missing, {}
    if missing.any() or scan.suspect.any():
        # The sums are spoilt: zeroed, and once more.
        signal[missing > 0] = _finite(signal[missing > 0])
        outliers = _strike(signal, np.flatnonzero(scan.suspect.any(axis=0)))
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
        valid=int(scan.valid.sum()),
        extreme=extreme,
        at_extreme=(int(real), int(imag)),
        pairs=scan.pairs.tolist() if recovery is not None else [],
    )


@dataclass(frozen=True, eq=False)
class _Scan:
    """Of one pass: missing by pulse, suspects by segment and column, the rest by segment."""

    missing: IntArray
    suspect: BoolArray
    valid: IntArray
    extreme: NDArray[np.int32]
    at_extreme: IntArray
    pairs: FloatArray


def _scan(
    signal: ComplexArray,
    range_frequency: FloatArray,
    recovery: Recovery | None,
    threads: int,
    *,
    scale: float = 1.0,
) -> _Scan:
    """One pass; the pairs are summed of samples times `scale`, a power of two, and scaled back."""
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
    edges = np.arange(SEGMENTS + 1) * n_pulse // SEGMENTS

    def work(k: int) -> None:
        first, last = int(edges[k]), int(edges[k + 1])
        seen = _look(parts, first, last, scan.missing, scan.suspect[k])
        scan.valid[k], scan.extreme[k], scan.at_extreme[k] = seen[0], seen[1], seen[2:]
        if recovery is not None:
            _sum_pairs(signal, np.float32(scale), first, last, advance, factor, scan.pairs[k])
            scan.pairs[k] /= scale**2

    run_groups(work, range(SEGMENTS), threads)
    return scan


def _finite(signal: ComplexArray) -> ComplexArray:
    return np.where(np.isfinite(signal), signal, np.complex64(0))


def _strike(signal: ComplexArray, columns: IntArray) -> dict[int, list[int]]:
    """Zero the impossible samples of some columns, all of whose samples are finite; where they were."""
    struck: dict[int, list[int]] = {}
    for column in columns:
        samples = signal[:, column]
        found = np.flatnonzero(_impossible(np.maximum(np.abs(samples.real), np.abs(samples.imag))))
        samples[found] = 0
        for pulse in found:
            struck.setdefault(int(pulse), []).append(int(column))
    return dict(sorted(struck.items()))


def _impossible(modulus: Float32Array) -> BoolArray:
    """Which samples of a suspect column (n_pulse,) are impossible."""
    padded = np.pad(modulus, 2)
    near = np.maximum.reduce([padded[:-4], padded[1:-3], padded[3:-1], padded[4:]])
    median = np.median(modulus[modulus > 0])
    with np.errstate(over="ignore"):
        lone = (near > 0) & (modulus > np.float32(STANDS_OUT) * near) & (modulus > STANDS_OUT * median)
        return lone | (modulus > BEYOND_ALL * median)


# Compiled. A row of samples is read from memory once, and stays in the cache for what else is done with it.

_SAMPLES = types.Array(types.complex64, 2, "C", readonly=True)
_PARTS = types.Array(types.float32, 2, "C", readonly=True)
_LARGEST = np.float32(np.finfo(np.float32).max)
_SIGNLESS = np.int32(0x7FFFFFFF)
_LONE, _ALL = np.float32(STANDS_OUT), np.float32(BEYOND_ALL)


@njit(cache=True, nogil=True)
def _moduli(row: Float32Array, modulus: Float32Array) -> None:
    """The larger part of each sample; -1 where one is not finite."""
    for c in range(modulus.size):
        a, b = abs(row[2 * c]), abs(row[2 * c + 1])
        larger = a if a > b else b
        modulus[c] = larger if (a <= _LARGEST) & (b <= _LARGEST) else np.float32(-1)


@njit(cache=True, nogil=True)
def _extent(bits: Any) -> tuple[Any, int, int]:
    """Of a row of moduli, as integers, which stand in the same order and are compared a vector at a time.

    Which one is the largest, how many are above zero, and how many below.
    """
    largest, valid, missing = np.int32(0), 0, 0
    for c in range(bits.size):
        largest = max(largest, bits[c])
        valid += bits[c] > 0
        missing += bits[c] < 0
    return largest, valid, missing


@njit(cache=True, nogil=True)
def _count(bits: Any, modulus: int) -> tuple[int, int]:
    """The real and the imaginary parts of a row that are of this modulus, as integers."""
    real, imag = 0, 0
    for c in range(bits.size // 2):
        real += (bits[2 * c] & _SIGNLESS) == modulus
        imag += (bits[2 * c + 1] & _SIGNLESS) == modulus
    return real, imag


@njit(inline="always")
def _suspicious(m: Any, before: Any, after: Any) -> Any:
    larger, smaller = max(before, after), min(before, after)
    return ((m > _LONE * larger) & (m > 0)) | ((smaller > 0) & (m > _ALL * smaller))


@njit(cache=True, nogil=True)
def _suspects(moduli: Float32Array, p: int, suspect: BoolArray) -> None:
    """Mark the columns in which pulse p stands out; pulse q is row q % 5."""
    a, b, m, d, e = moduli[(p - 2) % 5], moduli[(p - 1) % 5], moduli[p % 5], moduli[(p + 1) % 5], moduli[(p + 2) % 5]
    count = 0
    for c in range(m.size):
        count += _suspicious(m[c], max(a[c], b[c]), max(d[c], e[c]))
    if count:
        for c in range(m.size):
            suspect[c] |= _suspicious(m[c], max(a[c], b[c]), max(d[c], e[c]))


@njit([(_PARTS, types.int64, types.int64, types.int64[::1], types.boolean[::1])], cache=True, nogil=True)
def _look(
    parts: Float32Array, first: int, last: int, missing: IntArray, suspect: BoolArray
) -> tuple[int, int, int, int]:
    """Pulses first .. last - 1: samples that hold something, bits of the extreme part, real and imaginary ones there.

    Fills in what is missing in them, and marks the columns that are suspect.
    """
    n_pulse, n_column = parts.shape[0], parts.shape[1] // 2
    moduli = np.zeros((5, n_column), np.float32)
    bits, part_bits = moduli.view(np.int32), parts.view(np.int32)
    valid, extreme, real, imag = 0, 0, 0, 0
    for ahead in range(first - 2, last + 2):
        if 0 <= ahead < n_pulse:
            _moduli(parts[ahead], moduli[ahead % 5])
        else:
            moduli[ahead % 5] = 0
        p = ahead - 2
        if p < first:
            continue
        _suspects(moduli, p, suspect)
        largest, count, missing[p] = _extent(bits[p % 5])
        valid += count
        if largest > extreme:
            extreme, real, imag = largest, 0, 0
        if largest == extreme and count:
            more_real, more_imag = _count(part_bits[p], extreme)
            real, imag = real + more_real, imag + more_imag
    return valid, extreme, real, imag


@njit(inline="always")
def _conjugate_product(a: Any, b: Any, i: Any, scale: Any) -> Any:
    """LANES samples from i on, times `scale`: conj(a) b, and the energy of a."""
    ar, ai, br, bi = load_real(a, i) * scale, load_imag(a, i) * scale, load_real(b, i) * scale, load_imag(b, i) * scale
    return ar * br + ai * bi, ar * bi - ai * br, ar * ar + ai * ai


@njit(
    [(_SAMPLES, types.float32, types.int64, types.int64, types.float64[::1], types.float64[::1], types.float64[::1])],
    cache=True,
    nogil=True,
    fastmath={"contract", "nsz"},
)
def _sum_pairs(
    signal: ComplexArray,
    scale: np.float32,
    first: int,
    last: int,
    advance: FloatArray,
    factor: FloatArray,
    out: FloatArray,
) -> None:
    """out = sum over p of conj(s[p, c]) s[p + 1, c] exp(-2j pi (factor[0] + c factor[1]) advance[p]), and the energy.

    The phase is linear along a row: a polynomial in its step's phasor, by Horner's rule, LANES columns at a time.
    """
    n_pulse, n_column = signal.shape
    whole = n_column - n_column % LANES
    rest, rest_next = np.zeros(LANES, np.complex64), np.zeros(LANES, np.complex64)
    reals, imags, energies = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for p in range(first, last):
        paired = p + 1 < n_pulse
        row, after = signal[p], signal[p + 1 if paired else p]
        cycles, step = (advance[p] * factor[0], advance[p] * factor[1]) if paired else (0.0, 0.0)
        turn = -TURN * LANES * step
        wr, wi = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        rest[: n_column - whole], rest_next[: n_column - whole] = row[whole:], after[whole:]
        real, imag, energy = _conjugate_product(rest, rest_next, 0, scale)
        for k in range(whole // LANES):
            pr, pi, more = _conjugate_product(row, after, whole - LANES * (k + 1), scale)
            real, imag = real * wr - imag * wi + pr, real * wi + imag * wr + pi
            energy = energy + more
        store(reals, 0, real)
        store(imags, 0, imag)
        store(energies, 0, energy)
        total = 0j
        phasor, by = np.exp(-1j * TURN * (cycles - np.rint(cycles))), np.exp(-1j * TURN * step)
        for k in range(LANES):
            total += phasor * complex(reals[k], imags[k])
            phasor *= by
            out[2] += energies[k]
        if paired:
            out[0] += total.real
            out[1] += total.imag


def strike(signal: ComplexArray, found: Inspection, *, pulses: slice) -> None:
    """Make the outliers that were found missing, and what is infinite: NaN, in place, for who reads by pulse.

    Parameters
    ----------
    signal : (n, n_column) complex64
        All columns of these pulses.
    found : Inspection
        Merged.
    pulses : slice
        n of them.
    """
    signal[np.isinf(signal)] = np.nan
    for pulse, columns in found.outliers.items():
        if pulses.start <= pulse < pulses.stop:
            signal[pulse - pulses.start, columns] = np.nan
