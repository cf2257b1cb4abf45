"""Fingerprints of what runs read, as run.json holds them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from blocksar import stores


def joint_fingerprint(fingerprints: Sequence[str]) -> str:
    """The fingerprint of a run's input, by those of its collections: its own if there is one only."""
    return fingerprints[0] if len(fingerprints) == 1 else stores.checksum_bytes("\n".join(fingerprints).encode())


def input_fingerprint(histories: Sequence[stores.PhaseHistory]) -> str:
    """The fingerprint of the input of a run, which run.json holds: of all channels, where there are some."""
    channels = histories[0].channels
    if not channels or any(history.channels != channels for history in histories):
        return fingerprint_of_members([histories])
    return fingerprint_of_members([[history.of_channel(name) for history in histories] for name in channels])


def fingerprint_of_members(members: Iterable[Sequence[stores.PhaseHistory]]) -> str:
    """The fingerprint of the input of a run of several images, by the phase histories of each."""
    return joint_fingerprint([joint_fingerprint([each.fingerprint() for each in some]) for some in members])
