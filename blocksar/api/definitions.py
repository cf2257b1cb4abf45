"""Definitions of the columns of tables, one sentence each: printed by `--explain`."""

from __future__ import annotations

import re

PLAN = (
    "block: number of the angular block; 0.0, 0.1, ... are its range sub-blocks.",
    "yaw, range: what the block owns: an interval of yaw, and of range at t = 0. Each pixel has one owner.",
    "coherence: of the image with exact back-projection, predicted for the target with full dwell that is worst; 1 "
    "less what is lost by residual phase, by range migration, at the ends of the dwell, and by noise of the track.",
    "residual phase: largest phase error of any target over its dwell after the deramp; below 0.1 rad it is in focus. "
    "Quadratic: the quadratic part of it at the edge of the dwell; pi/4 is the usual limit.",
    "PSLR: azimuth side lobes that this residual gives the worst target; the ideal is -13.26 dB unweighted.",
    "width / limit: azimuth width over the one that the dwell allows; 1 is ideal. Azimuth width: amid the block.",
    "migration: range cells that a target still moves through over its dwell; below a quarter it does not matter.",
    "memory: peak of a worker that focuses the block, with interpreter and libraries.",
    "Doppler bins, padded: the block's part of the recovered spectrum, and the Doppler samples of the focused block.",
    "bias: range acceleration that the time perturbation adds; 0 is the chain as the papers print it.",
)
CHECK = (
    "if: what was changed, one thing at a time.",
    "echoes: of prominent places, which stand out in short apertures that hardly depend on what is wrong; without "
    "any, of patches of clutter. The same echoes are compared with what is given; no more where the first decide.",
    "contrast: N sum(I^2) / (sum I)^2 over the N cells of a small image about an echo, formed over its whole dwell: "
    "3 dB for speckle, 20 dB and more for a point in focus. More than 0 dB against as given speaks for the change.",
    "standard deviations: the gain over what speckle and side lobes give it by chance.",
    "verdict: sharper above 5 of these, ruled out below -5, otherwise not told: then the image is as sharp, as is a "
    "mirrored one.",
)


def quality() -> tuple[str, ...]:
    """The definitions of measured figures, one a line.

    Examples
    --------
    >>> [line.partition(":")[0] for line in quality()][:7]
    ['Range cut', 'Azimuth cut', 'Nominal width', 'IRW', 'PSLR', 'ISLR', 'Theory']
    """
    from blocksar.measurement.figures import DEFINITIONS  # slow to load, and a plan needs none of it

    return tuple(re.split(r"(?<=\.) (?=[A-Z][A-Za-z ]*: )", DEFINITIONS.replace("\n", " ")))
