"""Collections and samples as they would be if one thing about them were said wrongly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.errors import InputError

OFFSETS = (-1.0, -0.5, 0.5, 1.0)  # of the beam, in beam widths


class Alternative(NamedTuple):
    """What could be wrong, and the collection and samples with it undone.

    `name` says it as a statement about the store, `remedy` what to change. `samples` gives the samples from those of
    the store; None if they stay.
    """

    name: str
    remedy: str
    collection: Collection
    samples: Callable[[ComplexArray], ComplexArray] | None


def as_given(collection: Collection) -> Alternative:
    """The collection and its samples unchanged."""
    return Alternative("as given", "", collection, None)


def alternatives(collection: Collection) -> list[Alternative]:
    """Everything that is tried: samples, order of pulses, track, and beam if it is described by its yaw."""

    def of_samples(name: str, remedy: str, samples: Callable[[ComplexArray], ComplexArray]) -> Alternative:
        return Alternative(name, remedy, collection, samples)

    tried = [
        of_samples("the signal is conjugated", "write its conjugate", np.conj),
        of_samples("the range axis is reversed", "reverse signal along range_frequency", lambda s: s[:, ::-1]),
        of_samples(
            "the phase of the carrier has the other sign",
            "conjugate signal and reverse it along range_frequency",
            lambda s: np.conj(s[:, ::-1]),
        ),
        of_samples("the pulses are in the opposite order", "reverse signal along pulse", lambda s: s[::-1]),
    ]

    def of_metadata(name: str, remedy: str, **changes: object) -> None:
        try:
            tried.append(Alternative(name, remedy, replace(collection, **changes), None))  # type: ignore[arg-type]
        except InputError:
            return  # it would be refused

    position = collection.antenna_position
    of_metadata("x and y are swapped", "swap them in antenna_position", antenna_position=position[:, [1, 0, 2]])
    of_metadata("the track runs backwards", "reverse antenna_position along pulse", antenna_position=position[::-1])
    # Not of a beam about its axis: places are hardly less sharp over a part of their dwell.
    if collection.beam_width is not None and not collection.has_axis:
        beam, width = collection.beam_azimuth, collection.beam_width
        of_metadata("the beam turns the other way", "reverse beam_azimuth along pulse", beam_azimuth=beam[::-1])
        of_metadata("the beam looks to the other side", "negate beam_azimuth", beam_azimuth=-beam)
        for offset in OFFSETS:
            degrees = np.degrees(offset * width)
            name, remedy = f"the beam is off by {-degrees:+.3g} degrees", f"add {degrees:+.3g} degrees to beam_azimuth"
            of_metadata(name, remedy, beam_azimuth=beam + offset * width)
    return tried
