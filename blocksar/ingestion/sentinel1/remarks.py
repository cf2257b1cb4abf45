"""Remarks on ingested bursts for a user: what was found, and what was assumed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.ingestion.sentinel1.ancillary import TILTED
from blocksar.ingestion.sentinel1.histories import BurstHistory
from blocksar.ingestion.sentinel1.samples import COMPRESSIONS
from blocksar.texts import count, frequency_text

UNTOLD = 1e-9  # s, by which receive windows may differ


def remarks(histories: Sequence[BurstHistory]) -> list[str]:
    """All of them, a sentence each."""
    swaths: dict[str, list[BurstHistory]] = {}
    for each in histories:
        swaths.setdefault(each.burst.swath, []).append(each)
    first, frame = histories[0], histories[0].frame
    taken = "taken out" if first.removed else "in the samples; --troposphere standard takes it out"
    return [
        *(line for swath, own in swaths.items() for line in _swath(swath, own)),
        f"orbit from {_orbit(first)}; {_attitude(first)}",
        "assumed: the nominal chirp of the headers as replica (calibration pulses are not used); a beam pattern of an "
        "evenly lit aperture along the track, and none in elevation",
        _times(histories),
        f"the delay of a standard atmosphere, {first.atmosphere:.3g} m of range, is {taken}",
        f"scene frame: x away from the track, {frame.rotation:.2f} degrees from east, z up at latitude "
        f"{frame.latitude:.6f}, longitude {frame.longitude:.6f} on the ellipsoid, which is the ground by default",
    ]


def _swath(swath: str, own: Sequence[BurstHistory]) -> list[str]:
    burst = own[0].burst
    lost = sum(each.burst.n_slot - len(each.burst.packets) for each in own)
    windows = sum(bool(np.ptp(each.burst.delay) > UNTOLD) for each in own)
    modes = {COMPRESSIONS.get(int(code), "?") for each in own for code in each.burst.packets.compression}
    missing = f"; {lost} lost pulses are missing" if lost else ""
    return [
        f"{swath} {burst.polarization}: {count(len(own), 'burst')} of up to "
        f"{max(each.burst.n_slot for each in own)} pulses at {1 / burst.interval:.6g} Hz, "
        f"{own[0].raw.fast_time.size} samples at {frequency_text(burst.radar.rate)} ({', '.join(sorted(modes))}), "
        f"{int(burst.packets.rank[0])} pulses in the air{missing}; {own[0].data.steering[swath].describe()}",
        *([f"receive windows change within {windows} of {swath}'s bursts; what all pulses have is taken"]
          if windows else []),
    ]  # fmt: skip


def _orbit(history: BurstHistory) -> str:
    given = history.data.options.orbit is not None
    return "the file" if given else "the packets, whose accuracy is some metres (--orbit takes a precise one)"


def _attitude(history: BurstHistory) -> str:
    attitude = history.data.attitude
    if attitude is None:
        return (
            f"no attitude within {np.degrees(TILTED):g} degree of zero Doppler is in the packets, and the antenna is "
            "taken to lie along the velocity over the Earth"
        )
    return (
        f"attitude from the packets, its quaternions read {attitude.reading}: the antenna lies up to "
        f"{np.degrees(attitude.off):.2g} degrees off the velocity over the Earth"
    )


def _times(histories: Sequence[BurstHistory]) -> str:
    tags = histories[0].data.options.time_tags
    if tags == "middle":
        return "the packets' times are taken for those of an antenna that stands still while a pulse is out"
    of = "the PRI that receives the echo" if tags is None else "transmission"
    speed = float(np.linalg.norm(histories[0].track[1], axis=1).mean())
    off = speed * max(np.ptp(each.raw.fast_time) for each in histories) / 4
    return (
        f"the packets' times are taken for those of {of}, and positions at the middle of a pulse's way; samples are "
        f"resampled to its moment, without which places at the swath's edges lie {off:.2g} m off along the track"
    )
