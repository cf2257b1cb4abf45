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

from blocksar.geometry import Geometry
from blocksar.lanes import LANES, load_imag, load_real, store
from blocksar.parameters import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.phase import Float32Array
from blocksar.recovery import Recovery
from blocksar.rows import run_groups

SEGMENTS = 32  # of slow time, over which pulse pairs are summed: several to a dwell
STANDS_OUT = 100.0  # an impossible sample over its neighbours, and over its column's median
BEYOND_ALL = 1e8  # over its column's median alone
MAX_OUTLIERS = 0.01  # of the samples that hold something; beyond that the store is damaged
SATURATED = (1e-3, 0.5)  # of the components, at the extreme value: fewer is chance, more is a coarse quantiser
MAX_OFFSET = 0.08  # of the PRF, and a quarter of a target's sweep: beyond the figures expected
TURNING = 0.9  # of the least real part: segments that add up to less of what they hold do not belong together
EVEN = 0.8  # of its share that the rest must hold, whichever dwell is left out, for a scene to be lit evenly
SIGNIFICANT = 5  # deviations of noise
DWELL_NODES = 16  # of a target's dwell at which its Doppler is taken
SQUARED = (1e-12, 1e15)  # samples whose squares are summed in float32 as they are
TURN = 2 * np.pi

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


# ---------------------------------------------------------------- the Doppler centroid


@dataclass(frozen=True, kw_only=True, eq=False)
class Centroid:
    """Measured less expected Doppler centroid.

    Attributes
    ----------
    offset : (SEGMENTS,) float
        Of each segment of slow time, Hz; known modulo the PRF only. Anywhere in the lit band for a single target.
    coherence : (SEGMENTS,) float
        Modulus of the segment's sum over its energy; 0 where there is none.
    mean_offset, mean_coherence : float
        Of all of them together.
    """

    offset: FloatArray
    coherence: FloatArray
    mean_offset: float
    mean_coherence: float


def centroid(found: Inspection, *, prf: float) -> Centroid:
    """The Doppler centroid of a merged inspection, PRF in Hz.

    Raises
    ------
    ValueError
        If it has no pairs.
    """
    sums, energy = _sums(found)
    total = sums.sum()
    return Centroid(
        offset=np.angle(sums) / TURN * prf,
        coherence=np.abs(sums) / np.where(energy > 0, energy, 1),
        mean_offset=float(np.angle(total) / TURN * prf),
        mean_coherence=float(np.abs(total) / (energy.sum() or 1)),
    )


def _sums(found: Inspection) -> tuple[NDArray[np.complex128], FloatArray]:
    if not found.pairs:
        raise ValueError("no pulse pairs were summed")
    pairs = np.array(found.pairs)
    return pairs[:, 0] + 1j * pairs[:, 1], pairs[:, 2]


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """What the pulse pairs of a target add up to over a whole dwell, over its energy: a vector in the complex plane.

    Attributes
    ----------
    prf : float
        Hz.
    angle : tuple of float
        Between which its angle lies for all targets, Hz.
    sweep : float
        The least Doppler that any of them runs through, Hz.
    real : float
        Its least real part.
    whole : tuple of int
        The segments first .. last - 1 in which no target is lit that the ends of the collection cut.
    dwell : int
        Segments that one dwell may touch.
    """

    prf: float
    angle: tuple[float, float]
    sweep: float
    real: float
    whole: tuple[int, int]
    dwell: int


def expect(
    geometry: Geometry, recovery: Recovery, *, yaw: FloatArray, near: FloatArray, far: FloatArray
) -> Expectation | None:
    """What is expected of a steered collection from its metadata alone.

    Parameters
    ----------
    geometry : Geometry
    recovery : Recovery
    yaw : (n,) float
        Of what is lit, rad.
    near, far : (n,) float
        Epoch ranges there, m.

    Returns
    -------
    Expectation or None
        None if no target is lit for a whole dwell, or if the beam is not steered: then all that is in sight is lit
        all the time, and the centroid is wherever the scene is bright.
    """
    collection = geometry.collection
    first, last = geometry.dwell(yaw)
    start, end = collection.time[[0, -1]] + collection.pulse_interval * np.array([-0.5, 0.5])
    late, early = first <= start, last >= end  # begun too late, or ended too early, to see all of them
    uncut = ~(late | early)
    if not uncut.any():  # as it is where the beam is not steered: lit from start to end
        return None
    nodes, weights = np.polynomial.legendre.leggauss(DWELL_NODES)
    first, last = first[uncut, None], last[uncut, None]
    time = (first + last) / 2 + (last - first) / 2 * nodes
    offsets = []
    for epoch_range in (near, (near + far) / 2, far):
        point = geometry.ground_point(epoch_range[uncut], yaw[uncut])[:, None, :]
        _, rate = geometry.range_history(point, time)
        slow, half = time - geometry.epoch, collection.pulse_interval / 2
        turned = recovery.derotation_cycles(slow + half) - recovery.derotation_cycles(slow - half)
        left = rate - recovery.walk - recovery.common.at(slow, 1)
        offsets.append(-2 / collection.wavelength * left - turned * collection.prf)
    offset = np.concatenate(offsets)
    vector = np.exp(1j * TURN / collection.prf * offset) @ weights / 2
    cuts = np.array([geometry.dwell(yaw)[1][late].max(initial=start), geometry.dwell(yaw)[0][early].min(initial=end)])
    segments = (cuts - start) / (end - start) * SEGMENTS
    return Expectation(
        prf=collection.prf,
        angle=(
            float(np.angle(vector).min() / TURN * collection.prf),
            float(np.angle(vector).max() / TURN * collection.prf),
        ),
        sweep=float(np.ptp(offset, axis=1).min()),
        real=float(vector.real.min()),
        whole=(int(np.ceil(segments[0])), int(np.floor(segments[1]))),
        dwell=int(np.ceil((last - first).max() / (end - start) * SEGMENTS)) + 1,
    )


def disagreement(found: Inspection, expected: Expectation) -> str | None:
    """One sentence with figures if track, beam and samples do not belong together, else None.

    Two things are looked at. The sum over all segments must lie between the vectors that targets add up to, but for
    what targets may contribute that the ends of the collection cut: no more than the moduli of the segments they can
    be lit in. That holds for any scene. And the segments of a scene that is lit about evenly must add up, with one
    dwell or another left out if need be, and not turn from one to the next as when the phase has the wrong sign.

    Not seen are errors that move Doppler by less than MAX_OFFSET or by whole PRFs; that turn or shift track and beam
    together, or move both along the line of sight by a constant; in scenes of one or a few targets, a part of all
    errors, and those of phase most; where the dwell is longer than half the collection, nothing; nor where noise is
    stronger than the echoes by about the root of the number of samples in it.
    """
    sums, energy = _sums(found)
    pulses = np.diff(np.arange(SEGMENTS + 1) * found.n_pulse // SEGMENTS)
    noise = energy / np.sqrt(np.maximum(pulses * found.n_column, 1))  # deviation of a sum of nothing but noise
    first, last = expected.whole
    cut = np.abs(sums).sum() - np.abs(sums[first:last]).sum() if last > first else np.inf
    total = sums.sum()
    doubt = cut + SIGNIFICANT * float(np.hypot.reduce(noise))
    tolerance = min(MAX_OFFSET * expected.prf, expected.sweep / 4)
    check = "check antenna_position, beam_azimuth and the sign of the phase"
    angle = float(np.angle(total))
    low, high = ((expected.angle[k] + sign * tolerance) / expected.prf * TURN for k, sign in enumerate((-1, 1)))
    beyond = max(angle - high, low - angle)
    if beyond > 0 and abs(total) * np.sin(min(beyond, np.pi / 2)) > doubt:
        offset = angle / TURN * expected.prf
        return (
            f"the measured Doppler centroid lies {abs(offset):.0f} Hz ({abs(offset) / expected.prf:.2f} PRF) "
            f"{'above' if offset > 0 else 'below'} what the track and the beam say, "
            f"mean of {SEGMENTS} segments; {check}"
        )
    if _turning(sums, noise, expected):
        share = max(total.real, 0) / np.abs(sums).sum()
        return (
            f"the measured Doppler centroid wanders through the PRF of {expected.prf:.6g} Hz where the track and the "
            f"beam have it stand: {SEGMENTS} segments add up to {share:.0%} of what they hold; {check}"
        )
    return None


def _turning(sums: NDArray[np.complex128], noise: FloatArray, expected: Expectation) -> bool:
    """Whether segments that each have a centroid do not add up, whichever dwell is left out."""
    if expected.whole[0] >= expected.whole[1]:
        return False
    held = np.maximum(np.abs(sums) - 2 * noise, 0)
    for first in range(-expected.dwell, SEGMENTS - expected.dwell + 1):  # at first, none is
        kept = np.ones(SEGMENTS, np.bool_)
        kept[max(first, 0) : max(first + expected.dwell, 0)] = False
        least = TURNING * expected.real * held[kept].sum() - SIGNIFICANT * np.hypot.reduce(noise[kept])
        if held[kept].sum() < EVEN * kept.mean() * held.sum() or sums[kept].sum().real >= least:
            return False
    return True


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
