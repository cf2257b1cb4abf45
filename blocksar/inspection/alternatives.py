"""Collections and samples with one assumption about them changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.beam import wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.raw_echo import RawEcho
from blocksar.collection.region import Region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.inspection.prominent import Echo
from blocksar.kernels.fourier import chirp_spectrum

SAME_BEAM = 0.2  # beam widths: beams that differ by less are not tried
IN_DEGREES = 0.1  # rad: smaller angles are not taken for degrees
WHOLE_PRFS = (1, -1, 2, -2)  # by which a beam's Doppler may be off


Change = tuple[str, str, dict[str, Any]]  # a name, a remedy, and fields of the collection


class Alternative(NamedTuple):
    """An assumption about collection and samples that may be wrong, and both with the error undone.

    Attributes
    ----------
    name : str
        A statement about the store.
    remedy : str
        What to change.
    collection : Collection
    samples : callable or None
        Gives the samples from those of the store; None if they stay.
    signs : (int, int, int)
        Of time, range and Doppler, -1 where the samples of an echo have the opposite one.
    changes : int
        Of alternatives that echoes do not tell apart, the one with fewest is named.
    of_beam : bool
        Whether it changes what is lit.
    moves_in_range : bool
        Whether it brings echoes to other ranges than `signs` tells.
    of_sign : bool
        Whether it is a sign of the samples, which clutter tells best.
    """

    name: str
    remedy: str
    collection: Collection
    samples: Callable[[ComplexArray], ComplexArray] | None
    signs: tuple[int, int, int] = (1, 1, 1)
    changes: int = 1
    of_beam: bool = False
    moves_in_range: bool = False
    of_sign: bool = False

    def echo(self, given: Echo) -> Echo:
        """Map an echo to the samples of this alternative; applied twice, it returns the echo."""
        time, offset, doppler = self.signs
        pulse = given.pulse if time > 0 else self.collection.n_pulse - 1 - given.pulse
        return Echo(pulse, offset * given.offset, doppler * given.doppler)


def alternatives(geometry: Geometry, region: Region | None, raw: RawEcho | None) -> list[Alternative]:
    """List all alternatives: samples, order of pulses, delays, track, and the beam by law, unit and whole PRFs.

    Other errors of the beam are found from when places are lit (`pointing`): places are hardly less sharp over a part
    of their dwell. Without a region, as the beam lights nothing, whole PRFs are left out. Under a beam that is not
    steered, on a plane, a track in a mirrored frame is left out as well: it mirrors the image, and nothing else.
    """
    collection = geometry.collection
    tried = _of_samples(collection) if raw is None else _of_echoes(collection, raw)
    tried.append(
        Alternative(
            "the pulses are in the opposite order", f"reverse {'signal' if raw is None else 'echo'} along pulse",
            collection, lambda s: s[::-1], signs=(-1, 1, -1),
        )
    )  # fmt: skip
    frames = collection.steered or geometry.terrain is not None
    for name, remedy, fields in (*_of_track(collection, frames=frames), *_of_delay(collection, raw)):
        _append(tried, name, remedy, collection, fields)
    period = 0.0 if region is None or not collection.steered else doppler_period(geometry, region)
    for name, remedy, fields in _of_beam(collection, period):
        _append(tried, name, remedy, collection, fields, of_beam=True)
    return tried


def _append(
    tried: list[Alternative], name: str, remedy: str, collection: Collection, fields: dict[str, Any],
    *, of_beam: bool = False,
) -> None:  # fmt: skip
    try:
        changed = replace(collection, **fields)
        tried.append(Alternative(name, remedy, changed, None, of_beam=of_beam))
    except InputError:
        return  # it would be refused


def _of_samples(collection: Collection) -> list[Alternative]:
    return [
        Alternative(
            "the signal is conjugated", "write its conjugate", collection, np.conj, signs=(1, -1, -1), of_sign=True
        ),
        Alternative(
            "the range axis is reversed", "reverse signal along range_frequency", collection, lambda s: s[:, ::-1],
            signs=(1, -1, 1),
        ),
        Alternative(
            "the phase of the carrier has the other sign", "conjugate signal and reverse it along range_frequency",
            collection, lambda s: np.conj(s[:, ::-1]), signs=(1, 1, -1), changes=2,
        ),
    ]  # fmt: skip


def _of_echoes(collection: Collection, raw: RawEcho) -> list[Alternative]:
    """List what may be wrong with a raw echo, as changes to the range frequencies after compression.

    Compression has divided the echo's spectrum by that of the chirp, C(f), which is even. The chirp of the other sign
    has conj C, so that the right division follows from the wrong one by the factor exp(2j arg C). Of a conjugated echo
    the spectrum is conjugated and reversed.
    """
    spectrum = chirp_spectrum(collection.range_frequency, chirp_rate=raw.chirp_rate, pulse_width=raw.pulse_width)
    twice = np.exp(2j * np.angle(spectrum)).astype(np.complex64)
    return [
        Alternative(
            "the chirp has the other sign", "negate chirp_rate", collection, lambda s: s * twice, moves_in_range=True,
            of_sign=True,
        ),
        Alternative(
            "the echo is conjugated", "write its conjugate", collection,
            lambda s: np.conj(s[:, ::-1]) * np.conj(twice), signs=(1, 1, -1), moves_in_range=True, of_sign=True,
        ),
        Alternative(
            "the phase of the carrier has the other sign, and the chirp too", "conjugate echo and negate chirp_rate",
            collection, lambda s: np.conj(s[:, ::-1]), signs=(1, 1, -1), changes=2,
        ),
    ]  # fmt: skip


def _of_delay(collection: Collection, raw: RawEcho | None) -> list[Change]:
    if raw is None:
        return []
    half = SPEED_OF_LIGHT / 2 * raw.pulse_width / 2
    return [
        (
            "the delays count from the start of the pulse", "subtract half of pulse_width from fast_time",
            {"reference_range": collection.reference_range - half},
        ),
        (
            "half of the pulse is missing in the delays", "add half of pulse_width to fast_time",
            {"reference_range": collection.reference_range + half},
        ),
    ]  # fmt: skip


def _of_track(collection: Collection, *, frames: bool) -> list[Change]:
    position = collection.antenna_position
    backwards: Change = (
        "the track runs backwards", "reverse antenna_position along pulse", {"antenna_position": position[::-1]}
    )  # fmt: skip
    if not frames:
        return [backwards]
    return [
        backwards,
        ("x and y are swapped", "swap them in antenna_position", {"antenna_position": position[:, [1, 0, 2]]}),
        ("x has the other sign", "negate x in antenna_position", {"antenna_position": position * [-1, 1, 1]}),
        ("y has the other sign", "negate y in antenna_position", {"antenna_position": position * [1, -1, 1]}),
    ]


def doppler_period(geometry: Geometry, region: Region) -> float:
    """Angle of the beam over which Doppler changes by the PRF, rad, in the middle of the region."""
    collection, p = geometry.collection, geometry.collection.n_pulse // 2
    track, time = collection.antenna_position, collection.time
    velocity = (track[p + 1] - track[p - 1]) / (time[p + 1] - time[p - 1])
    yaw = (region.yaw[0] + region.yaw[-1]) / 2 + np.array([-1e-3, 1e-3])
    near, far = region.at(yaw)
    point = geometry.ground_point((near + far) / 2, yaw)
    sight = point - track[p]
    approach = sight @ velocity / np.linalg.norm(sight, axis=1)
    angle = geometry.beam.offset(point[:, 0], point[:, 1], p)
    slope = abs(float(np.diff(approach)[0] / wrapped(np.diff(angle))[0]))
    return collection.wavelength * collection.prf / 2 / max(slope, 1e-12)


def _of_beam(collection: Collection, period: float) -> list[Change]:
    """List beams with another law or unit, or whole PRFs away, each of which is `period` (rad, 0: unknown)."""
    width = collection.beam_width
    if width is None:
        return []
    field = collection.pointing
    beam: FloatArray = getattr(collection, field)
    laws: list[Change] = [
        ("the beam turns the other way", f"reverse {field} along pulse", {field: beam[::-1]}),
        ("the beam looks to the other side", f"negate {field}", {field: -beam}),
    ]
    angles = {field: np.radians(beam)} if np.abs(beam).max() > IN_DEGREES else {}
    widths = {"beam_width": np.radians(width)} if width > IN_DEGREES else {}
    for fields in [part for part in (angles, widths) if part] + ([angles | widths] if angles and widths else []):
        names = " and ".join(fields)
        laws.append((f"{names} {'are' if len(fields) > 1 else 'is'} in degrees", f"give {names} in rad", fields))
    for turns in WHOLE_PRFS if period else ():
        degrees = np.degrees(turns * period)
        laws.append((
            f"the beam is off by {-degrees:+.3g} degrees ({abs(turns)} PRF)", f"add {degrees:+.3g} degrees to {field}",
            {field: beam + turns * period},
        ))  # fmt: skip
    least = SAME_BEAM * width
    return [law for law in laws if "beam_width" in law[2] or np.abs(law[2][field] - beam).max() > least]
