"""Narrow-band interference: lines over range frequency, detected and cut by groups of pulses.

Detection
---------
The power of a group of pulses over range frequency is compared with the larger of two medians: those of a quarter of
the band before a cell and after it. A line stands out of both sides, the end of a band of one only. Echoes do not: the
sum of many targets at one frequency is circular Gaussian, so that its power is distributed exponentially, also where
all pulses of a group see the same targets and averaging over them does not help; fewer targets have lower peaks. A
cell is a line if its power exceeds ln(1 / FALSE_ALARMS) times the mean that the median tells, median / ln 2: 14.2 dB
over the median. What is weaker stays. A line may be as wide as an eighth of the band. An impossible sample is a line,
too, and its frequency is cut in its group.

Notch
-----
Lines are extended to where the power, averaged over neighbours, has fallen to the echoes', and these cells become
missing (NaN). Missing samples are left out of every image's mean, so that a target keeps its amplitude; where a share q
of the band is lost in a whole dwell, noise power rises by 1 / (1 - q), and side lobes of amplitude up to q / (1 - q)
of the peak appear in range, around each target.

A tone that the ends of the receive window cut off leaks over the band, as the inverse of the distance: strong ones over
all of it. A notch would take what stands out of the leak, and the rest would stay.

Eigen
-----
The leak of a line has the line's own course over the pulses. The line's cells C tell it: the dominant eigenvectors of
their covariance over the pulses, left singular vectors U of X_C, with squared singular values above those that echoes
can have. Independent echoes of power `level` have up to the Marchenko-Pastur edge, level (sqrt(n) + sqrt(m))^2 in n x m
samples, and such as are alike in all of them level n m. Of these courses those leak that the frequencies beside the
line have too: in U^H X_B, of NEAR cells on both sides, the left singular vectors above the same bound. Their r courses
are projected out of the band, X - P P^H X, and lines that were hidden under the leak are found in what is left. Missing
become the cells that the courses come from, whose echoes go with them: those with more than LOST of what P^H X_C spans,
and all cells of lines without a leak.

A target's course over the pulses is independent of the interference's: of its amplitude it loses the share r / pulses
on the mean, as a random vector has so much of its energy in r of so many dimensions. Samples are divided by what is
left, so that it keeps its amplitude; the power of the noise rises by as much.

Singular vectors are LAPACK's, whose last bits depend on memory addresses: images by `eigen` repeat to about 1e-7 of
their samples and not to the bit, as all others do; a resumed run's as well.

The leak must be the same in all pulses of a group: the receive window must follow the reference range, or its delays
before it (`cycles`) be known, as those of a raw echo are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.errors import InputError
from blocksar.imaging.method import Cutting

FALSE_ALARMS = 1e-8  # of the cells, at most, in a scene of many targets with equal echoes in all pulses
GROUP = 128  # pulses in which a line is found, about: a pulsed one is cut in all of them
LEAST = 64  # range frequencies
STANDS_OUT = np.log(1 / FALSE_ALARMS) / np.log(2)  # over the medians on either side
SKIRT, NEIGHBOURS = 1.5, 3  # a line ends where the mean of NEIGHBOURS cells falls to SKIRT times the medians
NEAR = 16  # cells on either side of a line in which its leakage is sought
PASSES = 8  # at most: lines that are hidden by others' leak
LOST = 0.1  # of a frequency's echoes with the courses: beyond it is missing
MOST = 0.25  # of the pulses of a group: vectors over them that are subtracted


@dataclass(frozen=True, kw_only=True)
class Interference:
    """Interference that was cut from some pulses, or from all of them after `merge`.

    Attributes
    ----------
    groups, affected : int
        Groups of pulses, and those with lines.
    lines : list of [first, end]
        Range frequencies that are cut in some group, by number.
    cut, samples : int
        Samples that became missing, and all.
    peak : float
        Largest power of a cell over the median of those beside it; 0 without lines.
    removed, kept : float
        Energy of the samples that was taken out, and what is left.
    """

    groups: int
    affected: int
    lines: list[list[int]]
    cut: int
    samples: int
    peak: float
    removed: float
    kept: float

    def as_dict(self) -> dict[str, Any]:
        """The attributes for JSON."""
        return dict(vars(self))

    @classmethod
    def merge(cls, parts: Sequence[Self]) -> Self:
        """Merge the interference that was cut from one or more groups of pulses."""
        ends = max((line[1] for part in parts for line in part.lines), default=0)
        mask = np.zeros(ends, np.bool_)
        for part in parts:
            for first, end in part.lines:
                mask[first:end] = True
        return cls(
            lines=runs(mask), peak=max(part.peak for part in parts), groups=sum(part.groups for part in parts),
            affected=sum(part.affected for part in parts), cut=sum(part.cut for part in parts),
            samples=sum(part.samples for part in parts), removed=sum(part.removed for part in parts),
            kept=sum(part.kept for part in parts),
        )  # fmt: skip

    def sentence(self, method: str, frequency: FloatArray) -> str:
        """Describe the interference that was cut; `frequency` (n_range_frequency,), Hz, includes the carrier."""
        if not self.affected:
            return f"interference ({method}): none stands out, and nothing is cut"
        half, widest = (frequency[1] - frequency[0]) / 2, sorted(self.lines, key=lambda line: line[0] - line[1])[:NAMED]
        bands = ", ".join(
            f"{(frequency[first] - half) / 1e6:.2f}-{(frequency[end - 1] + half) / 1e6:.2f}"
            for first, end in sorted(widest)
        )
        more = f" and {len(self.lines) - NAMED} more" if len(self.lines) > NAMED else ""
        share = 10 * np.log10(self.removed / self.kept) if self.removed and self.kept else -np.inf
        return (
            f"interference ({method}): {len(self.lines)} {'line' if len(self.lines) == 1 else 'lines'} at {bands} MHz"
            f"{more}, in {self.affected} of {self.groups} groups of pulses, up to {10 * np.log10(self.peak):.0f} dB "
            f"above what lies beside them; what was taken out had {share:+.0f} dB of the rest's energy; "
            f"{self.cut / self.samples:.1%} of the samples are missing now"
        )


NAMED = 4  # lines in the sentence


def runs(mask: BoolArray) -> list[list[int]]:
    """The runs first .. end - 1 of a mask (n,)."""
    edges: list[list[int]] = np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2).tolist()
    return edges


def check_band(n_range_frequency: int) -> None:
    """Check that narrow-band lines can be distinguished from echoes.

    Raises
    ------
    InputError
        If there are fewer than LEAST range frequencies.
    """
    if n_range_frequency < LEAST:
        raise InputError(
            f"--interference needs at least {LEAST} range frequencies to tell lines from echoes, and the samples have "
            f"{n_range_frequency}; leave it out"
        )


def cut_interference(
    signal: ComplexArray, *, method: Cutting, cycles: tuple[FloatArray, FloatArray] | None = None
) -> Interference:
    """Cut interference from pulses, in place; pulses of zeros, and samples without lines, keep every bit.

    Parameters
    ----------
    signal : (n_pulse, n_range_frequency) complex64
        Samples that are not finite stay so.
    method : {"notch", "eigen"}
    cycles : (n_pulse,) and (n_range_frequency,) float, optional
        Delays in s and frequencies in Hz: their product is the phase, in cycles, by which the samples were turned, so
        that the receive window follows the reference range no more. Only "eigen" needs it.

    Raises
    ------
    InputError
        If there are fewer than LEAST range frequencies.
    """
    n_pulse, n_column = signal.shape
    check_band(n_column)
    count = max(1, round(n_pulse / GROUP))
    edges = np.arange(count + 1) * n_pulse // count
    found = []
    for first, end in pairwise(edges):
        turn = None if cycles is None else np.exp(2j * np.pi * np.outer(cycles[0][first:end], cycles[1]))
        found.append(_cut_group(signal[first:end], method, turn))
    return Interference.merge(found)


def _cut_group(signal: ComplexArray, method: Cutting, turn: Complex128Array | None) -> Interference:
    """Cut the interference of a group of pulses, in place; see `cut_interference`."""
    with np.errstate(invalid="ignore"):  # garbage may have signalling NaN
        valid = np.isfinite(signal)
        there = (valid & (signal != 0)).any(axis=1)
        samples = np.where(valid, signal, 0).astype(np.complex128)
    ratio = over_medians(samples, valid)
    peak, energy = float(ratio.max(initial=0)), float((np.abs(samples) ** 2).sum())
    if peak <= STANDS_OUT:
        return Interference(
            groups=1, affected=0, lines=[], cut=0, samples=signal.size, peak=0.0, removed=0.0, kept=energy
        )
    missing = np.zeros(signal.shape[1], np.bool_)
    if method == "eigen":
        samples, missing = _subtract_leak(samples if turn is None else samples * turn.conj(), valid, there)
        samples = samples if turn is None else samples * turn
        signal[valid] = samples.astype(np.complex64)[valid]
        ratio = over_medians(samples, valid & ~missing)
    missing |= lines_of(ratio)
    remaining = float((np.abs(samples[:, ~missing]) ** 2).sum())
    signal[np.ix_(there, missing)] = np.nan
    return Interference(
        groups=1, affected=1, lines=runs(missing), cut=int((valid & there[:, None])[:, missing].sum()),
        samples=signal.size, peak=peak, removed=max(energy - remaining, 0.0), kept=remaining,
    )  # fmt: skip


def over_medians(samples: Complex128Array, valid: BoolArray) -> FloatArray:
    """Power of each frequency relative to the larger median on either side, (n_column,); 0 without samples there."""
    power = (np.abs(samples) ** 2).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    n, width = power.size, max(LEAST // 2, power.size // 4)
    starts = np.unique(np.append(np.arange(0, n - width, max(1, width // 16)), n - width))
    windows = power[starts[:, None] + np.arange(width)]
    windows[windows == 0] = np.nan
    medians = np.zeros(starts.size)
    known = np.isfinite(windows).any(axis=1)
    medians[known] = np.nanmedian(windows[known], axis=1)
    cell = np.arange(n)
    before = np.searchsorted(starts + width, cell, side="right") - 1  # ends at the cell or earlier
    after = np.searchsorted(starts, cell, side="right")  # starts behind the cell
    level = np.maximum(
        np.where(before >= 0, medians[before], 0), np.where(after < starts.size, medians[after % starts.size], 0)
    )
    return np.divide(power, level, out=np.zeros(n), where=level > 0)


def lines_of(ratio: FloatArray) -> BoolArray:
    """Mask (n_column,) of lines and their skirts, from the power relative to the medians."""
    seeds = ratio > STANDS_OUT
    if not seeds.any():
        return seeds
    smooth = np.convolve(np.pad(ratio, NEIGHBOURS // 2, mode="edge"), np.full(NEIGHBOURS, 1 / NEIGHBOURS), "valid")
    above = (smooth > SKIRT) | seeds
    mask = np.zeros_like(seeds)
    for first, end in runs(above):
        mask[first:end] = seeds[first:end].any()
    return mask


def _subtract_leak(samples: Complex128Array, valid: BoolArray, there: BoolArray) -> tuple[Complex128Array, BoolArray]:
    """Remove the leakage of a group's lines from the rest of the band; return the samples and the mask of lines."""
    missing, rank, most = np.zeros(samples.shape[1], np.bool_), 0, int(MOST * there.sum())
    for _ in range(PASSES):
        cells = ~missing & (over_medians(samples, valid & ~missing) > STANDS_OUT)
        if not cells.any():
            break
        courses = _courses(samples, cells, missing)[:, : most - rank]
        along = courses.conj().T @ samples
        missing[cells] = True if courses.shape[1] == 0 else _shares(along[:, cells]) > LOST
        samples[:, ~missing] -= courses @ along[:, ~missing]
        rank += courses.shape[1]
    return samples / (1 - rank / max(there.sum(), 1)), missing


def _shares(samples: Complex128Array) -> FloatArray:
    """Share (m,) of each column of samples (n, m) in the space that their rows span; they sum to at most n."""
    spanned = np.linalg.svd(samples, full_matrices=False)[2]
    return np.asarray((np.abs(spanned) ** 2).sum(axis=0))


def _courses(samples: Complex128Array, cells: BoolArray, missing: BoolArray) -> Complex128Array:
    """Orthonormal time courses (n_pulse, r) of lines that neighbouring frequencies share."""
    near = (np.convolve(cells, np.ones(2 * NEAR + 1), "same") > 0) & ~missing & ~cells
    level = float(np.median((np.abs(samples[:, ~missing]) ** 2).mean(axis=0)))
    own = _strong(samples[:, cells], level)
    return np.asarray(own @ _strong(own.conj().T @ samples[:, near], level))


def _strong(samples: Complex128Array, level: float) -> Complex128Array:
    """Left singular vectors of samples (n, m) whose power exceeds that of echoes of power `level`."""
    vectors, values, _ = np.linalg.svd(samples, full_matrices=False)
    n, m = samples.shape
    most = max(n * m, (np.sqrt(n) + np.sqrt(m)) ** 2)
    return np.asarray(vectors[:, values**2 > level * most])
