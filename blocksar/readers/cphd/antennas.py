"""The antenna of a channel: its frame, the pointing of its beam, and its gain.

The antenna coordinate frame (ACF) has the axes ACX and ACY in the aperture, and ACX x ACY along its mechanical
boresight. A direction u has the direction cosines DCX = u . ACX and DCY = u . ACY, and the electrical boresight (EB) is
given by its own. With f0 = FreqZero, the gain towards u, in dB and one way, is

    Array(m (DCX - e EB_X), m (DCY - e EB_Y)) + Element(DCX, DCY),   e = f0/f, m = f/f0,

where e and m are 1 unless EBFreqShift and MLFreqDilation say so; of these, EBFreqShiftSF and MLFreqDilationSF take a
part. They are taken at the carrier. The polynomials hold within the main lobe only.

The azimuth axis of the store's beam is the one of ACX and ACY that lies closer to the velocity, turned towards it, and
its steering is asin of the boresight's direction cosine along it. Of transmitter and receiver, the mean is taken. The
patterns are sampled from the gain of both ways, at the pulse whose steering is amid all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.readers.cphd.files import CphdFile, child_of, numbers_of, polynomial_of, text_of
from blocksar.readers.cphd.vectors import MOST_LOST, Pulses, filled_with_zeros
from blocksar.texts import count

UNIT = 1e-3  # by which ACX and ACY may be off unit length and a right angle
ALONG = 0.5  # least cosine of the azimuth axis with the velocity
HALF_POWER = 20 * np.log10(2)  # dB of both ways at the edges of a beam: half of the power one way
WIDEST = 0.7  # rad off the boresight within which the beam's edges are sought
REACH = 8  # vectors whose slope continues a parameter beyond the first and the last vector
SIDES = ("Tx", "Rcv")


class _Side(NamedTuple):
    """The transmitting or the receiving antenna: axes (n, 3), boresight (n, 2) at the pulses, and its gain."""

    x: FloatArray
    y: FloatArray
    boresight: FloatArray
    array: FloatArray
    element: FloatArray
    dilation: FloatArray  # (2,) of the array pattern at the carrier

    def gain(self, pulse: int, directions: FloatArray) -> FloatArray:
        """One-way gain, dB, at a pulse towards unit vectors (..., 3); that of the element relative to boresight."""
        axes = np.stack([self.x[pulse], self.y[pulse]])
        own = (directions[..., None, :] * axes).sum(axis=-1)
        at = self.boresight[pulse]
        away = self.dilation * (own - at)
        element = polynomial.polyval2d(own[..., 0], own[..., 1], self.element)
        return np.asarray(
            polynomial.polyval2d(away[..., 0], away[..., 1], self.array)
            + element
            - polynomial.polyval2d(at[0], at[1], self.element)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ChannelAntenna:
    """The antenna at the pulses, in the scene frame.

    Attributes
    ----------
    axis, across, normal : (n_pulse, 3) float
        Unit vectors along the azimuth axis, towards the velocity; along the other side; along the boresight's side.
    steering : (n_pulse,) float
        rad, of the electrical boresight off the plane normal to the axis.
    tilt : (n_pulse,) float
        Direction cosine of the electrical boresight along `across`.
    sides : of `_Side`
        Transmitter and receiver.
    left : of str
        What the file gives and the store does not keep, in words.
    """

    axis: FloatArray
    across: FloatArray
    normal: FloatArray
    steering: FloatArray
    tilt: FloatArray
    sides: tuple[_Side, ...]
    left: tuple[str, ...]

    @property
    def pulse(self) -> int:
        """Pulse in the middle of the steering."""
        return int(np.abs(self.steering - (self.steering.min() + self.steering.max()) / 2).argmin())

    def directions(self, along: FloatArray, across: FloatArray, p: int) -> FloatArray:
        """Unit vectors (..., 3) at a pulse: angles off the plane normal to the axis, rad, and direction cosines."""
        first = np.sin(along)
        rest = np.sqrt(np.maximum(1 - first**2 - across**2, 0.0))
        return np.asarray(
            first[..., None] * self.axis[p] + across[..., None] * self.across[p] + rest[..., None] * self.normal[p]
        )

    def azimuth_gain(self, offset: FloatArray, pulse: int | None = None) -> FloatArray:
        """Two-way gain, dB, over angles off the beam's centre (...), rad."""
        p = self.pulse if pulse is None else pulse
        directions = self.directions(self.steering[p] + offset, np.full(offset.shape, self.tilt[p]), p)
        return np.asarray(sum(side.gain(p, directions) for side in self.sides))

    def elevation_gain(self, away: FloatArray, pulse: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Angle below the horizontal, rad, and two-way gain relative to boresight, dB.

        `away` (n,) are direction cosines along `across` off the boresight's.
        """
        p = self.pulse if pulse is None else pulse
        directions = self.directions(np.full(away.shape, self.steering[p]), self.tilt[p] + away, p)
        gain = sum(side.gain(p, directions) for side in self.sides) - self.azimuth_gain(np.zeros(1), p)
        return np.arcsin(np.clip(-directions[..., 2], -1, 1)), np.asarray(gain)

    def half_power(self) -> tuple[float, float] | None:
        """Angles off boresight, rad, where the one-way power falls to half; None if it does not."""
        edges = []
        at_centre = float(self.azimuth_gain(np.zeros(1))[0])
        for sign in (-1.0, 1.0):
            reach = np.geomspace(1e-4, WIDEST, 400)
            low = np.flatnonzero(self.azimuth_gain(sign * reach) < at_centre - HALF_POWER)
            if low.size == 0:
                return None
            inner, outer = (float(reach[low[0] - 1]) if low[0] else 0.0), float(reach[low[0]])
            fine = np.linspace(inner, outer, 1025)
            below = np.flatnonzero(self.azimuth_gain(sign * fine) < at_centre - HALF_POWER)
            edges.append(sign * float(fine[below[0]]))
        return edges[0], edges[1]


# ---------------------------------------------------------------- reading


def read_antenna(
    file: CphdFile, pulses: Pulses, frame: Georeference, position: FloatArray, carrier: float
) -> ChannelAntenna | None:
    """Read the antenna that the channel names; None if it names none.

    Parameters
    ----------
    position : (n_pulse, 3) float
        Of the antenna in the scene frame, m.
    carrier : float
        Hz.

    Raises
    ------
    InputError
        If its metadata are missing or contradict each other.
    """
    channel = file.root.find(f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']/{{*}}Antenna")
    if channel is None:
        return None
    used = np.unique(pulses.vector[pulses.vector >= 0])
    source = _Source(file, channel, used, pulses, frame, carrier)
    left: list[str] = []
    try:
        sides = tuple(_side(source, name, left) for name in SIDES)
    except (ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"Antenna has a value that is no number: {error}") from None
    velocity = np.gradient(position, pulses.time, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    cosines = np.array([
        np.mean([(axis * velocity).sum(axis=1) / speed for axis in axes])
        for axes in zip(*((side.x, side.y) for side in sides), strict=True)
    ])  # fmt: skip
    which = int(np.abs(cosines).argmax())
    if abs(cosines[which]) < ALONG:
        raise InputError(
            f"ACX and ACY lie {np.degrees(np.arccos(np.abs(cosines[0]))):.3g} and "
            f"{np.degrees(np.arccos(np.abs(cosines[1]))):.3g} degrees off the velocity: neither is along the track"
        )
    sign = 1.0 if cosines[which] > 0 else -1.0
    axis = _unit(sign * np.sum([side[which] for side in sides], axis=0))
    across = _unit(_perpendicular(np.sum([side[1 - which] for side in sides], axis=0), axis))
    apart = float(np.arccos(np.clip((_unit(sides[0][which]) * _unit(sides[1][which])).sum(axis=1), -1, 1)).max())
    if apart > UNIT:
        left.append(f"the angle of {np.degrees(apart):.3g} degrees between transmitter and receiver")
    boresight = np.mean([side.boresight for side in sides], axis=0)
    normal = np.cross(axis, across) * (1.0 if (which == 0) == (sign > 0) else -1.0)
    antenna = ChannelAntenna(
        axis=axis, across=across, normal=normal, steering=np.arcsin(np.clip(sign * boresight[:, which], -1, 1)),
        tilt=boresight[:, 1 - which], sides=sides, left=tuple(dict.fromkeys(left)),
    )  # fmt: skip
    p = antenna.pulse
    if not antenna.directions(antenna.steering[p : p + 1], antenna.tilt[p : p + 1], p)[0, 2] < 0:
        raise InputError("the electrical boresight points above the horizontal: ACX, ACY or EB is wrong")
    return antenna


class _Source(NamedTuple):
    """Input for reading a channel's antennas from a file: its element, used vectors, pulses, frame and carrier."""

    file: CphdFile
    channel: Any  # the channel's element Antenna
    used: IntArray  # vectors that are pulses
    pulses: Pulses
    frame: Georeference
    carrier: float  # Hz


def _side(source: _Source, name: str, left: list[str]) -> _Side:
    """Read the transmitting or receiving antenna; names of unused elements are added to `left`."""
    antenna = child_of(source.file.root, "{*}Antenna", "Antenna")
    centre = _named(antenna, "AntPhaseCenter", text_of(source.channel, f"{name}APCId"))
    coordinates = _named(antenna, "AntCoordFrame", text_of(centre, "ACFId"))
    pattern = _named(antenna, "AntPattern", text_of(source.channel, f"{name}APATId"))
    x, y, boresight = (
        _in_time(source, f"{name}{parameter}", node, flag, paths, left)
        for parameter, node, flag, paths in (
            ("ACX", coordinates, "UseACFPVP", [f"XAxisPoly/{{*}}{c}" for c in "XYZ"]),
            ("ACY", coordinates, "UseACFPVP", [f"YAxisPoly/{{*}}{c}" for c in "XYZ"]),
            ("EB", pattern, "EB/{*}UseEBPVP", [f"EB/{{*}}{c}Poly" for c in ("DCX", "DCY")]),
        )
    )
    _check_side(name, x, y, boresight)
    reference = float(text_of(pattern, "FreqZero"))
    if not (np.isfinite(reference) and reference > 0):
        raise InputError(f"AntPattern/FreqZero is {reference:.6g}; it must be a frequency above 0 Hz")
    shift = _share(pattern, "EBFreqShift") * (reference / source.carrier - 1) + 1
    dilation = _share(pattern, "MLFreqDilation") * (source.carrier / reference - 1) + 1
    if pattern.find("{*}GainPhaseArray") is not None:
        left.append("sampled patterns (GainPhaseArray)")
    if pattern.find("{*}GainBSPoly") is not None:
        left.append("gain over frequency (GainBSPoly)")
    array, element = (
        polynomial_of(child_of(pattern, f"{{*}}{part}/{{*}}GainPoly", f"{part}/GainPoly"), 2)
        for part in ("Array", "Element")
    )
    phases = [node for part in ("Array", "Element") for node in pattern.findall(f"{{*}}{part}/{{*}}PhasePoly")]
    if any(np.count_nonzero(polynomial_of(node, 2)) for node in phases):
        left.append("phase patterns (PhasePoly)")
    axes = source.frame.axes.T
    return _Side(_unit(x) @ axes, _unit(y) @ axes, boresight * shift, array, element, dilation)


def _in_time(
    source: _Source, parameter: str, node: Any, flag: str, paths: Sequence[str], left: list[str]
) -> FloatArray:
    """Read an axis or boresight at the pulses, (n_pulse, 3 or 2): from per-vector parameters, or from polynomials."""
    file, used, pulses = source.file, source.used, source.pulses
    if _by_vector(file, node, flag, parameter):
        return _vectors(source, parameter, left)
    sent = file.parameter("TxTime", used)
    moment = "RcvTime" if parameter.startswith("Rcv") else "TxTime"
    time = pulses.time + np.interp(pulses.time, sent, file.parameter(moment, used) - sent)
    tables = [polynomial_of(child_of(node, f"{{*}}{path}", path.replace("{*}", "")), 1) for path in paths]
    return np.stack([np.asarray(polynomial.polyval(time, table), np.float64) for table in tables], axis=1)


def _named(antenna: Any, kind: str, name: str) -> Any:
    if "'" in name:
        raise InputError(f"{kind} is called {name!r}; rename it without a quotation mark")
    return child_of(antenna, f"{{*}}{kind}[{{*}}Identifier='{name}']", f"Antenna/{kind} {name!r}")


def _by_vector(file: CphdFile, node: Any, flag: str, parameter: str) -> bool:
    """Tell whether a per-vector parameter is present and not declared unused."""
    stated = (node.findtext(f"{{*}}{flag}") or "true").strip()
    return stated in ("true", "1") and parameter in (file.vectors.dtype.names or ())


def _vectors(source: _Source, name: str, left: list[str]) -> FloatArray:
    """Read a per-vector parameter of the antenna at the pulses, (n_pulse, 2 or 3).

    Between vectors it is linear; beyond the first and the last that are used, it goes on with the slope there. Vectors
    in which it is not finite, or filled with zeros, are not used.
    """
    file, used, pulses = source.file, source.used, source.pulses
    values = np.asarray(file.vectors[name][used], np.float64)
    if values.shape != (used.size, 2 if name.endswith("EB") else 3):
        raise InputError(f"PVP {name} has {count(values[0].size, 'value')} in a vector; correct its format in the XML")
    wrong = ~np.isfinite(values).all(axis=1) | filled_with_zeros(np.linalg.norm(values, axis=1))
    if wrong.any():
        first = file.first_vector + used[int(np.argmax(wrong))]
        where = f"{np.count_nonzero(wrong)} of {wrong.size} vectors (first: vector {first})"
        if np.count_nonzero(wrong) > MOST_LOST * wrong.size:
            raise InputError(f"PVP {name} is not finite or 0 in {where}")
        left.append(f"PVP {name} of {where} that is not finite or 0")
        values, used = values[~wrong], used[~wrong]
    time = file.parameter("TxTime", used)
    found = np.stack([np.interp(pulses.time, time, column) for column in values.T], axis=1)
    reach = min(REACH, used.size - 1)
    for end, other, beyond in ((0, reach, pulses.time < time[0]), (-1, -1 - reach, pulses.time > time[-1])):
        slope = (values[other] - values[end]) / (time[other] - time[end])
        found[beyond] = values[end] + (pulses.time[beyond, None] - time[end]) * slope
    return found


def _check_side(name: str, x: FloatArray, y: FloatArray, boresight: FloatArray) -> None:
    """Refuse axes that are not perpendicular unit vectors, and a boresight that is not a direction."""
    for which, axis in (("ACX", x), ("ACY", y)):
        length = np.linalg.norm(axis, axis=1)
        worst = int(np.abs(length - 1).argmax())
        if not abs(length[worst] - 1) <= UNIT:
            raise InputError(f"{name}{which} has a length of {length[worst]:.6g}, but must be a unit vector")
    skew = float(np.abs((x * y).sum(axis=1)).max())
    if not skew <= UNIT:
        raise InputError(f"{name}ACX and {name}ACY are not at a right angle (the cosine is {skew:.3g})")
    size = float(np.linalg.norm(boresight, axis=1).max())
    if not size < 1:
        raise InputError(f"{name}EB has direction cosines of length {size:.6g}, but must stay below 1")


def _share(pattern: Any, name: str) -> FloatArray:
    """Dependence of a pattern on frequency along ACX and ACY, (2,): 0 none, 1 like that of its aperture."""
    if (pattern.findtext(f"{{*}}{name}") or "false").strip() not in ("true", "1"):
        return np.zeros(2)
    if pattern.find(f"{{*}}{name}SF") is None:
        return np.ones(2)
    return numbers_of(pattern, f"{name}SF", ("DCXSF", "DCYSF"))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _perpendicular(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    return np.asarray(vectors - (vectors * axis).sum(axis=1, keepdims=True) * axis)


# ---------------------------------------------------------------- patterns


def sampled(names: Sequence[str], angle: FloatArray, gain: FloatArray) -> dict[str, FloatArray]:
    """Convert a pattern to the names of `Collection`: ascending angles, rad, and two-way gain, dB, as amplitude."""
    order = slice(None) if angle[-1] > angle[0] else slice(None, None, -1)
    return dict(zip(names, (angle[order], 10 ** (gain[order] / 20)), strict=True))
