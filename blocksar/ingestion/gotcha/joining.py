"""Join Gotcha files to one pass: check that they belong together, order their pulses, drop duplicates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, BoolArray, FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.errors import InputError
from blocksar.ingestion.gotcha.files import File

MAX_GAP = 32  # pulses that may be missing in one place; an omitted file leaves a larger gap
MAX_JUMP = 5.0  # largest distance between two pulses over the usual one; a single pass stays below it

SAME_PLACE = 1 / 32  # wavelengths: two polarisations' positions; those of float32 are rounded to half of that


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """Pulses of all files in order of azimuth (rad, unwrapped): file, index in the file, position, r0."""

    files: list[File]
    file: IntArray
    index: IntArray
    azimuth: FloatArray
    position: FloatArray
    r0: FloatArray

    @property
    def step(self) -> float:
        """Step in azimuth between pulses, rad, where none is missing."""
        return float(np.median(np.diff(self.azimuth)))


def check_same_collection(files: Sequence[File]) -> None:
    """Refuse files that differ in pass or frequency grid, with an InputError."""
    first = files[0]
    step = first.frequency[1] - first.frequency[0]
    for other in files[1:]:
        if first.pass_ and other.pass_ and first.pass_ != other.pass_:
            raise InputError(
                f"{other.path} is of pass {other.pass_}, but {first.path} of pass {first.pass_}; ingest each pass by "
                "itself"
            )
        same = other.frequency.size == first.frequency.size
        if not same or np.abs(other.frequency - first.frequency).max() > UNIFORM_TOLERANCE * step:
            raise InputError(
                f"{other.path} has {describe_band(other.frequency)}, but {first.path} "
                f"{describe_band(first.frequency)}; ingest files of one grid"
            )


def by_polarisation(files: Sequence[File]) -> dict[str, list[File]]:
    """The files of each polarisation, in alphabetical order; all of them under one name if there is only one.

    Raises
    ------
    InputError
        If there are several, and the name of a file has none.
    """
    names = sorted({file.polarisation for file in files if file.polarisation})
    if len(names) < 2:
        return {names[0] if names else "": list(files)}
    for file in files:
        if not file.polarisation:
            raise InputError(
                f"{file.path} has no polarisation in its name, but others are of {' and '.join(names)}; rename it, "
                f"such as {names[0]}.mat, or ingest each polarisation by itself"
            )
    return {name: [file for file in files if file.polarisation == name] for name in names}


def check_same_geometry(channels: Mapping[str, Joined]) -> None:
    """Refuse polarisations whose pulses are not at the same places.

    Raises
    ------
    InputError
        If numbers of pulses differ, or a position or r0 by more than `SAME_PLACE` wavelengths.
    """
    (name, first), *others = channels.items()
    most = SAME_PLACE * SPEED_OF_LIGHT / float(first.files[0].frequency[-1])
    alone = "ingest each polarisation by itself"
    for other, joined in others:
        if joined.azimuth.size != first.azimuth.size:
            raise InputError(
                f"polarisation {other} has {joined.azimuth.size} pulses, but {name} {first.azimuth.size}; give the "
                f"same files of both, or {alone}"
            )
        for what, apart in (
            ("x, y and z", np.linalg.norm(joined.position - first.position, axis=1)),
            ("r0", np.abs(joined.r0 - first.r0)),
        ):
            where = int(apart.argmax())
            if apart[where] > most:
                raise InputError(
                    f"{what} of {other} and {name} differ by {apart[where]:.4g} m at azimuth "
                    f"{np.degrees(first.azimuth[where]):.4f} degrees, more than {1e3 * most:.2g} mm, so that they make "
                    f"no single image; {alone}"
                )


def describe_band(frequency: FloatArray) -> str:
    """The frequency grid in words."""
    return f"freq from {frequency[0]:.9g} to {frequency[-1]:.9g} Hz in {frequency.size} samples"


def join(files: list[File]) -> Joined:
    """Order all pulses by azimuth, starting after the largest gap of the circle, and drop duplicate pulses.

    Raises
    ------
    InputError
        If there are fewer than 8 pulses, files overlap, or a gap or jump between pulses is too large.
    """
    file = np.repeat(np.arange(len(files)), [len(f.checksums) for f in files])
    index = np.concatenate([np.arange(len(f.checksums)) for f in files])
    position, r0 = np.concatenate([f.position for f in files]), np.concatenate([f.r0 for f in files])
    azimuth = np.mod(np.arctan2(position[:, 1], position[:, 0]), TURN)
    if azimuth.size < 8:
        raise InputError(f"source holds {azimuth.size} pulses altogether; at least 8 are needed")
    order = np.lexsort((file, azimuth))
    ahead = np.append(np.diff(azimuth[order]), azimuth[order[0]] + TURN - azimuth[order[-1]])
    order = np.roll(order, -1 - int(ahead.argmax()))
    azimuth = np.unwrap(azimuth[order])
    file, index, position, r0 = file[order], index[order], position[order], r0[order]
    unique = _unique_pulses(files, file, index, position)
    joined = Joined(
        files=files,
        file=file[unique],
        index=index[unique],
        azimuth=azimuth[unique],
        position=position[unique],
        r0=r0[unique],
    )
    _check_sequence(joined)
    return joined


def _unique_pulses(files: Sequence[File], file: IntArray, index: IntArray, position: FloatArray) -> BoolArray:
    """False for pulses that repeat the one before: the same position and the same samples."""
    sums = [files[f].checksums[i] for f, i in zip(file, index, strict=True)]
    same = np.array([a == b for a, b in pairwise(sums)])
    return np.append(True, ~(same & (np.diff(position, axis=0) == 0).all(axis=1)))


def _check_sequence(joined: Joined) -> None:
    """Refuse overlapping files, two pulses at one azimuth, gaps as a missing file leaves them, and jumps."""
    degrees = np.degrees(joined.azimuth)

    def file_of(k: int) -> str:
        return f"{joined.files[joined.file[k]].path}"

    changes = np.flatnonzero(np.diff(joined.file)) + 1
    seen = {int(joined.file[0])}
    for k in changes.tolist():
        if int(joined.file[k]) in seen:
            raise InputError(
                f"{file_of(k)} and {file_of(k - 1)} overlap at azimuth {degrees[k]:.4f} degrees but hold different "
                "pulses there; leave out one, or ingest each by itself"
            )
        seen.add(int(joined.file[k]))
    steps = np.diff(joined.azimuth)
    if joined.azimuth.size < 8 or not steps.min() > 1e-6 * joined.step:
        where = int(steps.argmin()) if steps.size else 0
        raise InputError(
            f"{file_of(where)} has two different pulses at azimuth {degrees[where]:.4f} degrees, or fewer than 8 "
            "altogether; keep one of them in all fields"
        )
    gap = int(steps.argmax())
    if steps[gap] > (MAX_GAP + 1) * joined.step:
        raise InputError(
            f"{file_of(gap)} ends at azimuth {degrees[gap]:.3f} degrees and {file_of(gap + 1)} goes on at "
            f"{degrees[gap + 1]:.3f}: some {steps[gap] / joined.step:.0f} pulses are missing between; add the file "
            "that holds them, or ingest each side by itself"
        )
    distance = np.linalg.norm(np.diff(joined.position, axis=0), axis=1)
    usual = float(np.median(distance / np.maximum(np.rint(steps / joined.step), 1)))
    ratio = distance / (np.maximum(steps / joined.step, 1) * usual)
    jump = int(ratio.argmax())
    if ratio[jump] > MAX_JUMP:
        apart = (
            f"{distance[jump]:.4g} m apart at azimuth {degrees[jump]:.3f} degrees, where pulses are {usual:.3g} m "
            "from one another"
        )
        if joined.file[jump] == joined.file[jump + 1]:
            raise InputError(f"{file_of(jump)} has x, y and z {apart}; correct them, or split it there")
        raise InputError(
            f"{file_of(jump)} and {file_of(jump + 1)} lie {apart}, as files of two passes do; ingest each pass by "
            "itself"
        )
