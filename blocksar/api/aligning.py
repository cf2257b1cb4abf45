"""quality --against: chips of an image compared with those of another run, but for a shift and a ramp of the phase."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from blocksar.api.reports import Table
from blocksar.errors import InputError
from blocksar.measurement.coherence import align
from blocksar.runs.finished import FinishedRun

CHIPS = 6  # along either axis, evenly over the image; at most, and no more than it has room for
SIDE = 64  # pixels
DARK = 20.0  # dB below the brightest chip
COVERED = 0.5  # of a chip's pixels that both images have, at least
FIGURES = (
    ("as_is", "as they are"),
    ("shifted", "after the best shift"),
    ("ramped", "after a shift and a ramp of the phase"),
)


def compare_with(run: FinishedRun, other: FinishedRun) -> list[dict[str, Any]]:
    """Compare chips of two images on one grid; of each x and y (m), three coherences, shift (m) and ramp (rad/m).

    Those with more than DARK dB less power than the brightest hold side lobes of other places, and are left out.

    Raises
    ------
    InputError
        If the grids differ, or no chip has pixels of both.
    """
    for name, axis, theirs in (("x", run.x, other.x), ("y", run.y, other.y)):
        if axis.shape != theirs.shape or np.abs(axis - theirs).max() > 1e-6 * abs(axis[-1] - axis[0]):
            raise InputError(
                f"against={other.folder} has another {name} than {run.folder}: give runs on one grid, as from "
                "`blocksar focus --grid` with the same numbers"
            )
    step = np.array([axis[1] - axis[0] if axis.size > 1 else 1.0 for axis in (run.y, run.x)])
    found = []
    for rows, columns in _places(run):
        a, b = run.read(rows, columns), other.read(rows, columns)
        if (np.isfinite(a) & np.isfinite(b)).mean() < COVERED:
            continue
        aligned = align(a, b)
        if np.isnan(aligned.ramped):
            continue
        shift, ramp = np.array(aligned.shift) * step, np.array(aligned.ramp) / step
        found.append({
            "x": float(run.x[columns].mean()), "y": float(run.y[rows].mean()),
            "as_is": aligned.as_is, "shifted": aligned.shifted, "ramped": aligned.ramped,
            "shift": shift[::-1].tolist(), "ramp": ramp[::-1].tolist(), "power": float(np.nanmean(np.abs(b) ** 2)),
        })  # fmt: skip
    if not found:
        raise InputError(f"against={other.folder} and {run.folder} have no part in common that both cover; give others")
    least = max(chip["power"] for chip in found) * 10 ** (-DARK / 10)
    return [chip for chip in found if chip["power"] >= least]


def _places(run: FinishedRun) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of the chips."""
    spans = []
    for size in (run.y.size, run.x.size):
        starts = np.linspace(0, max(size - SIDE, 0), min(-(-size // SIDE), CHIPS)).round().astype(int).tolist()
        spans.append([slice(start, min(start + SIDE, size)) for start in starts])
    for rows in spans[0]:
        for columns in spans[1]:
            yield rows, columns


def alignment_lines(chips: list[dict[str, Any]], run: FinishedRun, other: FinishedRun) -> list[str]:
    """Least and median coherence, as it is and aligned; and that weights differ, if they do."""
    texts = []
    for name, words in FIGURES:
        values = [chip[name] for chip in chips]
        texts.append(f"{min(values):.4f} and {np.median(values):.4f} {words}")
    lines = [f"coherence with {other.folder}, least and median of {len(chips)} chips: {', '.join(texts)}"]
    if run.weighting != other.weighting:
        lines.append(
            f"weights differ, {run.weighting.text} here and {other.weighting.text} in {other.folder}: that alone takes "
            "coherence below 1"
        )
    return lines


def alignment_table(chips: list[dict[str, Any]]) -> Table:
    """The chips, one a row."""
    header = (
        "x (m)", "y (m)", "coherence", "shifted", "shift and ramp", "shift in x (mm)", "shift in y (mm)",
        "ramp in x (rad/m)", "ramp in y (rad/m)",
    )  # fmt: skip
    return header, [
        [
            f"{c['x']:.0f}", f"{c['y']:.0f}", f"{c['as_is']:.4f}", f"{c['shifted']:.4f}", f"{c['ramped']:.4f}",
            *(f"{1e3 * value:.1f}" for value in c["shift"]), *(f"{value:.4f}" for value in c["ramp"]),
        ]
        for c in chips
    ]  # fmt: skip
