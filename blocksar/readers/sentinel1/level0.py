"""Sentinel-1 level 0 as a reader, for `blocksar ingest sentinel1` and `info`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.places.ranges import Readable
from blocksar.readers.kinds import Kind
from blocksar.readers.reading import reading
from blocksar.readers.registry import Described, Reading
from blocksar.readers.sentinel1.ancillary import read_attitude, read_orbit_file, read_states, utc
from blocksar.readers.sentinel1.bursts import (
    DAMAGED,
    REMEDY,
    Burst,
    BurstChoice,
    Channel,
    Sentinel1Options,
    Steering,
    choose,
    find_bursts,
    open_files,
)
from blocksar.readers.sentinel1.calibration import InternalDelay, internal_delay
from blocksar.readers.sentinel1.histories import BurstHistory, Data, frame_of, remarks
from blocksar.readers.sentinel1.packets import KIND
from blocksar.texts import count, frequency_text, size_text


def describe(files: Sequence[Readable], given: str) -> Described:
    """Read the headers of files of one data take.

    Raises
    ------
    InputError
        As `Sentinel1Reader.read`.
    """
    sources: list[Location] = [str(file) for file in files]
    rows: list[tuple[str, str]] = []
    for file in open_files(sources):
        packets = file.packets
        zero = int(packets.seconds[0])
        times, size = packets.times(zero), size_text(int(packets.size.sum()))
        held = f"{count(len(packets), 'packet')}, {count(int(packets.echo.sum()), 'echo', 'echoes')}, {size}"
        rows.append(("file", f"{file.where.name}: {held}"))
        rows.append(("time", f"{utc(zero, float(times[0]))} for {times[-1] - times[0]:.4g} s"))
        bursts, notes = find_bursts(packets, zero)
        for swath in dict.fromkeys(burst.swath for burst in bursts):
            own = [burst for burst in bursts if burst.swath == swath]
            radar, prf = own[0].radar, 1 / own[0].interval
            samples, most = 2 * int(own[0].packets.quads.max()), max(each.n_slot for each in own)
            bursts_text = f"{count(len(own), 'burst')} of up to {most} pulses"
            chirp = f"{frequency_text(radar.bandwidth)} in {1e6 * radar.length:.4g} us"
            rows.append((
                f"{swath} {own[0].polarization}",
                f"{bursts_text} at {prf:.6g} Hz, {samples} samples at {frequency_text(radar.rate)}; chirp of {chirp}",
            ))  # fmt: skip
        rows += [("left out", note) for note in notes]
    name = given.rstrip("/").rpartition("/")[2].partition(".")[0].replace("*", "") or "sentinel1"
    return Described(
        kind="Sentinel-1 level 0", rows=rows, command=["ingest", "sentinel1", given, "--out", f"{name}.zarr"]
    )


FARTHEST = 1e6  # m along the track, in which the Earth falls 20 km below a plane at both ends


def begin(sources: Sequence[Location], options: Sentinel1Options) -> dict[str, Reading]:
    """Read everything but the samples: the selected bursts' phase histories, by name.

    Raises
    ------
    InputError
        If a file is of another kind, cut or damaged, no burst is left, or the orbit is not known.
    """
    files = open_files(sources)
    choice = choose(files, options)
    with reading(files[0].where, damaged=DAMAGED, remedy=REMEDY):
        data = _common(choice, [channels[0][1] for channels in choice.wanted], options)
    delays: dict[tuple[str, str], InternalDelay | None] = {}
    sources_of_delay = [(file.where, file.packets) for file in files]
    corrected: list[tuple[tuple[Channel, ...], tuple[InternalDelay | None, ...]]] = []
    for channels in choice.wanted:
        for file, burst in channels:
            if (burst.swath, burst.polarization) not in delays:
                with reading(file.where, damaged=DAMAGED, remedy=REMEDY):
                    delays[burst.swath, burst.polarization] = internal_delay(sources_of_delay, burst.packets)
        own = tuple(delays[burst.swath, burst.polarization] for _, burst in channels)
        late = [0.0 if delay is None else delay.seconds for delay in own]
        moved = tuple(
            (file, replace(burst, internal=seconds))
            for (file, burst), seconds in zip(channels, late, strict=True)
        )  # fmt: skip
        corrected.append((moved, own))
    bursts = [channels[0][1] for channels, _ in corrected]
    frame = frame_of(bursts[len(bursts) // 2], data)
    ends = [data.track(burst)[0][burst.n_slot // 2] for burst in (bursts[0], bursts[-1])]
    if (apart := float(np.linalg.norm(ends[1] - ends[0]))) > FARTHEST:
        raise InputError(
            f"the bursts lie {apart / 1e3:.0f} km from each other, and one frame has room for {FARTHEST / 1e3:g} km; "
            "take some of them with --bursts"
        )
    histories = [BurstHistory(channels=channels, delays=own, data=data, frame=frame) for channels, own in corrected]
    notes = [*choice.notes, *remarks(histories)]
    return {each.name: each.reading(() if number else notes) for number, each in enumerate(histories)}


def _common(choice: BurstChoice, bursts: Sequence[Burst], options: Sentinel1Options) -> Data:
    """Collect the facts that the selected bursts share; the steering is derived from all bursts of a swath."""
    zero = choice.zero
    first = min(burst.sent for burst in bursts)
    last = max(burst.sent + (burst.n_slot + 32) * burst.interval for burst in bursts)  # with pulses in the air
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


class Sentinel1Reader:
    """Reader of stripmap, wave and TOPS bursts of Sentinel-1."""

    summary = (
        "Convert Sentinel-1 level 0 (packets) to phase histories.\n\n"
        "Several bursts become a store of as many phase histories in one frame, which focus makes one mosaic of."
    )
    example = "S1A_IW_RAW__0SDV_....SAFE --swath IW1 --out iw1.zarr"
    source = "SOURCE.dat|FOLDER.SAFE...", "Files of packets of one data take, or the SAFE folder that they lie in."
    several = True
    kind: Kind = KIND
    options = Sentinel1Options

    def read(self, sources: Sequence[Location], options: Sentinel1Options) -> Mapping[str, Reading]:
        return begin(sources, options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        return describe(files, given)


SENTINEL1 = Sentinel1Reader()
