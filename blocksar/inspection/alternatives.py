"""Collections and samples as they would be if one thing about them were said wrongly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.errors import InputError

SAME_BEAM = 0.2  # beam widths: beams that differ by less are not tried


class Alternative(NamedTuple):
    """What could be wrong, and the collection and samples with it undone.

    `name` says it as a statement about the store, `remedy` what to change. `samples` gives the samples from those of
    the store; None if they stay. Of alternatives that places do not tell apart, the one with fewest `changes` is named.
    """

    name: str
    remedy: str
    collection: Collection
    samples: Callable[[ComplexArray], ComplexArray] | None
    changes: int = 1
    of_beam: bool = False


def as_given(collection: Collection) -> Alternative:
    """The collection and its samples unchanged."""
    return Alternative("as given", "", collection, None)


def alternatives(collection: Collection) -> list[Alternative]:
    """Everything that is tried: samples, order of pulses, track, and a beam that is reversed or negated.

    Other errors of the beam are found from when places are lit (`pointing`): places are hardly less sharp over a part
    of their dwell.
    """

    def of_samples(name: str, remedy: str, samples: Callable[[ComplexArray], ComplexArray]) -> Alternative:
        return Alternative(name, remedy, collection, samples)

    tried = [
        of_samples("the signal is conjugated", "write its conjugate", np.conj),
        of_samples("the range axis is reversed", "reverse signal along range_frequency", lambda s: s[:, ::-1]),
        of_samples(
            "the phase of the carrier has the other sign",
            "conjugate signal and reverse it along range_frequency",
            lambda s: np.conj(s[:, ::-1]),
        )._replace(changes=2),
        of_samples("the pulses are in the opposite order", "reverse signal along pulse", lambda s: s[::-1]),
    ]

    def of_metadata(name: str, remedy: str, *, of_beam: bool = False, **fields: object) -> None:
        try:
            changed = replace(collection, **fields)  # type: ignore[arg-type]
            tried.append(Alternative(name, remedy, changed, None, of_beam=of_beam))
        except InputError:
            return  # it would be refused

    position = collection.antenna_position
    of_metadata("x and y are swapped", "swap them in antenna_position", antenna_position=position[:, [1, 0, 2]])
    of_metadata("the track runs backwards", "reverse antenna_position along pulse", antenna_position=position[::-1])
    if collection.beam_width is not None:
        field = "beam_steering" if collection.has_axis else "beam_azimuth"
        beam = getattr(collection, field)
        for name, remedy, other in (
            ("the beam turns the other way", f"reverse {field} along pulse", beam[::-1]),
            ("the beam looks to the other side", f"negate {field}", -beam),
        ):
            if np.abs(other - beam).max() > SAME_BEAM * collection.beam_width:
                of_metadata(name, remedy, of_beam=True, **{field: other})
    return tried
