"""Description of files of packets, by their headers."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.readers import Described
from blocksar.ingestion.sentinel1.bursts import find_bursts
from blocksar.ingestion.sentinel1.files import open_files
from blocksar.ingestion.sentinel1.gps import utc
from blocksar.places import Location
from blocksar.places.ranges import Readable
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
        rows.append(("file", f"{file.where.name}: {len(packets)} packets, {int(packets.echo.sum())} echoes, {size}"))
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
