"""Bursts of packets to phase histories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.errors import InputError
from blocksar.ingestion.readers import Reading
from blocksar.ingestion.reading import reading
from blocksar.ingestion.sentinel1.ancillary import read_attitude, read_states
from blocksar.ingestion.sentinel1.bursts import Burst, Steering
from blocksar.ingestion.sentinel1.files import DAMAGED, REMEDY, Choice, choose, open_files
from blocksar.ingestion.sentinel1.histories import BurstHistory, Data, frame_of
from blocksar.ingestion.sentinel1.options import Sentinel1Options
from blocksar.ingestion.sentinel1.orbit_files import read_orbit_file
from blocksar.ingestion.sentinel1.remarks import remarks
from blocksar.places import Location

FARTHEST = 1e6  # m along the track, in which the Earth falls 20 km below a plane at both ends


def begin(sources: Sequence[Location], options: Sentinel1Options) -> dict[str, Reading]:
    """Read all but the samples: the bursts' phase histories by name.

    Raises
    ------
    InputError
        If a file is of another kind, cut or damaged, no burst is left, or the orbit is not known.
    """
    files = open_files(sources)
    choice = choose(files, options)
    kept = [each for each, wanted in zip(choice.bursts, choice.wanted, strict=True) if wanted]
    with reading(files[0].where, damaged=DAMAGED, remedy=REMEDY):
        data = _common(choice, [burst for _, burst in kept], options)
    frame = frame_of(kept[len(kept) // 2][1], data)
    ends = [data.track(burst)[0][burst.n_slot // 2] for _, burst in (kept[0], kept[-1])]
    if (apart := float(np.linalg.norm(ends[1] - ends[0]))) > FARTHEST:
        raise InputError(
            f"the bursts lie {apart / 1e3:.0f} km from each other, and one frame has room for {FARTHEST / 1e3:g} km; "
            "take some of them with --bursts"
        )
    histories = [BurstHistory(file=file, burst=burst, data=data, frame=frame) for file, burst in kept]
    said = [*choice.notes, *remarks(histories)]
    return {each.burst.name: each.reading(() if number else said) for number, each in enumerate(histories)}


def _common(choice: Choice, bursts: Sequence[Burst], options: Sentinel1Options) -> Data:
    """Find what the wanted bursts have in common; the law of the steering is told by all of a swath."""
    zero = choice.zero
    first = min(burst.sent for burst in bursts)
    last = max(burst.sent + (burst.n_slot + 32) * burst.interval for burst in bursts)  # with what is in the air
    if options.orbit is not None:
        orbit = read_orbit_file(options.orbit, first, last, zero)
    else:
        orbit = read_states(choice.packets, zero).reaching(first, last)
    attitude = read_attitude(choice.packets, zero, orbit)
    swaths = {burst.swath for burst in bursts}
    steering = {
        swath: Steering.of([burst for _, burst in choice.bursts if burst.swath == swath]) for swath in swaths
    }  # fmt: skip
    return Data(options=options, zero=zero, orbit=orbit, attitude=attitude, steering=steering)
