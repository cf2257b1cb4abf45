"""The place where the track of a run's collections is estimated: one for all runs that share the track."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from blocksar import stores
from blocksar.collection.sampling import refuse_departures
from blocksar.errors import FolderError, InputError
from blocksar.places.place import Place
from blocksar.runs import folder as run_folder

if TYPE_CHECKING:
    from blocksar.autofocusing.finishing import Result


def joint_fingerprint(fingerprints: Sequence[str]) -> str:
    """Combine the fingerprints of collections into that of a run's input; a single one stays as it is."""
    return fingerprints[0] if len(fingerprints) == 1 else stores.checksum_bytes("\n".join(fingerprints).encode())


def input_fingerprint(histories: Sequence[stores.PhaseHistory]) -> str:
    """Return the fingerprint of a run's input as run.json holds it; of several channels, of them all."""
    channels = histories[0].channels
    if not channels or any(history.channels != channels for history in histories):
        return fingerprint_of_members([histories])
    return fingerprint_of_members([[history.of_channel(name) for history in histories] for name in channels])


def fingerprint_of_members(members: Iterable[Sequence[stores.PhaseHistory]]) -> str:
    """Combine the fingerprints of the phase histories of several images into that of their run."""
    return joint_fingerprint([joint_fingerprint([each.fingerprint() for each in some]) for some in members])


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackPlace:
    """Place where the track of a run's collections is estimated. Channels have one antenna and share the estimate.

    Attributes
    ----------
    folder : Place
        For the estimate, or those of several collections.
    channels : tuple of tuples of PhaseHistory
        Of each collection its channels, pinned; of one in memory the collection itself.
    fingerprints : tuple of str
        Of each collection with all its channels.
    results : dict
        Estimates that this process has carried out, by folder and identity.
    """

    folder: Place
    channels: tuple[tuple[stores.PhaseHistory, ...], ...]
    fingerprints: tuple[str, ...]
    results: dict[tuple[str, str], Result] = field(default_factory=dict)

    @classmethod
    def of(
        cls, folder: Place, histories: Sequence[stores.PhaseHistory], fingerprints: Sequence[str] | None = None
    ) -> Self:
        """Return the place for phase histories, with all channels of their stores.

        `fingerprints` are those of the phase histories, if they are known.

        Raises
        ------
        InputError
            If pulses or range frequencies are not uniform, which no estimate takes.
        """
        for history in histories:
            refuse_departures("autofocus", history.collection.departures, "take the track as it is")
        channels = tuple(channels_of_track(history) for history in histories)
        known: Sequence[str | None] = fingerprints or [None] * len(channels)
        return cls(
            folder=folder,
            channels=channels,
            fingerprints=tuple(
                own if own is not None and len(some) == 1 else joint_fingerprint([one.fingerprint() for one in some])
                for own, some in zip(known, channels, strict=True)
            ),
        )

    def settings(self, fingerprint: str) -> dict[str, Any]:
        """Return the run's settings on its track; with the fingerprint of the track's input if that is another one."""
        track_input = joint_fingerprint(self.fingerprints)
        return {"autofocus": True, **({} if track_input == fingerprint else {"track_input": track_input})}

    @contextmanager
    def removed_if_wrong(self) -> Iterator[None]:
        """Remove what is estimated there if an InputError is raised in the block."""
        try:
            yield
        except FolderError:  # the folder may belong to another run
            raise
        except InputError:
            run_folder.remove_estimate(self.folder)
            raise


def channels_of_track(history: stores.PhaseHistory) -> tuple[stores.PhaseHistory, ...]:
    """All channels of a phase history's store, pinned; of one in memory itself."""
    if isinstance(history, stores.DatasetHistory):
        return (history,)
    return tuple(history.of_channel(name).pinned() for name in history.channels) or (history.pinned(),)
