"""The beam of a channel, from its polynomials of centre of dwell and dwell time, and from its antenna.

The polynomials say when the samples hold a point: from half a dwell before the centre to half a dwell after. The store
has three kinds of beam, and the first that reproduces these dwells is taken: none, where the whole image area is lit
all the time; the antenna's own axis and steering, with the width that the dwells have about it; and the better of two
laws that are fitted to the dwells, a yaw about the nadir or a steering about the velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import turned_near
from blocksar.collection.collection import check_axis_beam
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.readers.cphd.antennas import ChannelAntenna, read_antenna, sampled
from blocksar.readers.cphd.areas import AS_IT_IS, SWAPPED, ImageArea, area_points, describe_turn, ecef_of
from blocksar.readers.cphd.files import CphdFile, child_of, polynomial_of, text_of
from blocksar.readers.cphd.vectors import Pulses


class DwellPoints(NamedTuple):
    """Points (n, 3) spread over the image area, scene frame, m, with centre of dwell and dwell time (n,), s."""

    ground: FloatArray
    centre: FloatArray
    length: FloatArray


def read_dwells(file: CphdFile, frame: Georeference, area: ImageArea, turn: FloatArray) -> DwellPoints:
    """Evaluate the channel's dwell polynomials, in image-area coordinates rotated by `turn` (2, 2).

    Raises
    ------
    InputError
        If the channel has an array instead, or the polynomials are missing, or not finite and above 0.
    """
    root = file.root
    parameters = child_of(root, f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']", "Channel/Parameters")
    if (parameters.findtext("{*}DwellTimes/{*}UseDTA") or "").strip() in ("true", "1"):
        raise InputError("the channel's dwell times are an array, not polynomials")
    tables = []
    for kind in ("COD", "Dwell"):
        name = text_of(parameters, f"DwellTimes/{kind}Id")
        if "'" in name:
            raise InputError(f"DwellTimes/{kind}Id is {name!r}")
        node = child_of(root, f"{{*}}Dwell/{{*}}{kind}Time[{{*}}Identifier='{name}']", f"Dwell/{kind}Time")
        tables.append(polynomial_of(child_of(node, f"{{*}}{kind}TimePoly", f"{kind}TimePoly"), 2))
    x, y = area_points(file, area)
    along, across = turn @ np.stack([x, y])
    cod, dwell = (polynomial.polyval2d(along, across, table) for table in tables)
    if not (np.isfinite(cod).all() and np.isfinite(dwell).all() and dwell.min() > 0):
        raise InputError("they are not finite and above 0 over the image area")
    return DwellPoints(frame.from_ecef(ecef_of(file, np.stack([x, y], axis=1))), np.asarray(cod), np.asarray(dwell))


FULL_DWELL = 0.95  # share of the collection from which a target counts as always lit
BEAM_TOLERANCE = 0.03  # of a dwell, by which the edges of a fitted beam may miss those of the dwells
CLOSE = 0.003  # of a dwell, within which a beam described by its yaw is not replaced by one about the velocity
ANTENNA_TOLERANCE = 0.1  # of a dwell, the same for the antenna's own beam
LEAST_POINTS = 9  # whose dwells lie within the collection
HIGHEST_ORDER = 5  # of the fitted laws
MOST_TURNED, TURNS = np.deg2rad(12.0), 13  # yaws of an antenna's axis off the velocity that are tried, rad
PATTERN_SAMPLES = 257
FLAT = 0.01  # dB of both ways within which a gain counts as constant
RISE = 1.0  # dB of both ways by which a gain may rise away from the boresight; polynomials do where they end
CHANGE = 0.5  # dB of both ways left in the samples, from which on a note says so
CHECKED_PULSES = 33
ELEVATION_MARGIN = 0.05  # of the image area's elevations, for which a pattern is sampled beyond them


class StatedBeam(NamedTuple):
    azimuth: FloatArray  # (n_pulse,) rad; NaN if not steered, or about an axis
    width: float | None  # rad
    messages: list[str]
    antenna: Mapping[str, Any] = {}  # axis, steering and patterns, by the names of `Collection`


class _Law(NamedTuple):
    """A beam fitted to dwells, and the largest error of its dwell ends relative to a dwell."""

    beam: StatedBeam
    miss: float


def fit_beam(
    file: CphdFile, pulses: Pulses, frame: Georeference, position: FloatArray, carrier: float, area: ImageArea
) -> StatedBeam:
    """Determine the beam of the store (see the module), with a sentence for everything used or left out.

    Where the image area is not as the file has it, the dwell polynomials may be in the coordinates of ImageArea, or in
    swapped ones: of these and of what the file says, the first that gives a beam is taken.

    Parameters
    ----------
    position : (n_pulse, 3) float
        In the scene frame, m.
    carrier : float
        Hz.
    """
    notes: list[str] = []
    antenna = None
    try:
        antenna = read_antenna(file, pulses, frame, position, carrier)
    except InputError as error:
        notes.append(f"the antenna's metadata cannot be used: {error}")
    turns = [AS_IT_IS] if area.message is None else [area.turn, AS_IT_IS, SWAPPED]
    for turn in turns:
        beam = _of_dwells(file, pulses, frame, position, area, antenna, notes, turn)
        if beam.width is not None and not np.array_equal(turn, AS_IT_IS):
            return beam._replace(
                messages=[*beam.messages, f"the dwell polynomials are read as if {describe_turn(turn)}"]
            )
        if beam.width is not None:
            return beam
    return _of_dwells(file, pulses, frame, position, area, antenna, notes, AS_IT_IS)


def _of_dwells(
    file: CphdFile,
    pulses: Pulses,
    frame: Georeference,
    position: FloatArray,
    area: ImageArea,
    antenna: ChannelAntenna | None,
    given: list[str],
    turn: FloatArray,
) -> StatedBeam:
    """Fit the beam to dwell polynomials in rotated coordinates, and to the antenna; `given` are notes so far."""
    notes = list(given)
    try:
        dwells = read_dwells(file, frame, area, turn)
    except InputError as error:
        without = f"dwell polynomials cannot be used ({error})"
        if antenna is None:
            return _unsteered(pulses, f"beam not steered: {without}", notes)
        ground = frame.from_ecef(ecef_of(file, np.stack(area_points(file, area), axis=1)))
        return _by_pattern(antenna, pulses, position, ground, [*notes, without])
    whole = pulses.reference_time[-1] - pulses.reference_time[0]
    if dwells.length.min() >= FULL_DWELL * whole:
        if antenna is not None:
            notes.append(f"the antenna's metadata are left out{_unused_gain(antenna, position, dwells.ground)}")
        return _unsteered(pulses, "beam not steered: the whole image area is lit all the time", notes)
    if antenna is not None:
        try:
            return _by_antenna(antenna, pulses, position, dwells, notes)
        except InputError as error:
            notes.append(f"the antenna's metadata are left out: {error}")
    return _by_dwells(pulses, position, dwells, notes)


def _unsteered(pulses: Pulses, message: str, notes: list[str]) -> StatedBeam:
    return StatedBeam(np.full(pulses.time.size, np.nan), None, [message, *notes])


# ---------------------------------------------------------------- the antenna's own beam


def _by_antenna(
    antenna: ChannelAntenna, pulses: Pulses, position: FloatArray, dwells: DwellPoints, notes: list[str]
) -> StatedBeam:
    """Combine the antenna's axis and steering with the width that dwells have about it.

    Raises
    ------
    InputError
        If it lights the image area at other times than the dwells say.
    """
    first, last, inside = _edges(pulses, dwells)
    if np.count_nonzero(inside) < LEAST_POINTS:
        raise InputError("too few dwells of the image area lie within the collection to compare it with them")
    offsets = [
        _angles(antenna.axis, position, pulses, dwells.ground[inside], time[inside])
        - np.interp(time[inside], pulses.reference_time, antenna.steering)
        for time in (first, last)
    ]
    widths = np.abs(offsets[1] - offsets[0])
    width = float(widths.mean())
    miss = max(float(np.abs(np.abs(side) - width / 2).max()) for side in offsets) / max(width, 1e-30)
    middle = float(np.abs(offsets[0] + offsets[1]).max()) / 2 / max(width, 1e-30)
    if not max(miss, middle) <= ANTENNA_TOLERANCE:
        raise InputError(
            f"its beam and the dwell polynomials disagree by up to {max(miss, middle):.2g} of a dwell about when "
            "targets are lit"
        )
    check_axis_beam(antenna.axis, antenna.steering, width)
    message = (
        f"{_words(antenna.steering)} about the antenna's axis, {np.degrees(width):.4g} degrees wide as the dwell "
        f"polynomials have it (they agree to {max(miss, middle):.2g} of a dwell)"
    )
    return _with_patterns(antenna, antenna.steering, width, pulses, position, dwells.ground, [message, *notes])


def _by_pattern(
    antenna: ChannelAntenna, pulses: Pulses, position: FloatArray, ground: FloatArray, notes: list[str]
) -> StatedBeam:
    """Combine the antenna's axis and steering with its one-way half-power width: for files without dwells."""
    edges = antenna.half_power()
    if edges is None:
        return _unsteered(
            pulses, "beam not steered: the antenna's gain polynomials do not fall to half of the power", notes
        )
    width, steering = edges[1] - edges[0], antenna.steering + (edges[0] + edges[1]) / 2
    try:
        check_axis_beam(antenna.axis, steering, width)
    except InputError as error:
        return _unsteered(pulses, "beam not steered", [*notes, f"the antenna's metadata are left out: {error}"])
    offsets = _offsets(antenna.axis, steering, position, ground)
    if np.abs(offsets).max() <= width / 2:
        gain = _unused_gain(antenna, position, ground)
        notes = [*notes, f"the antenna's metadata are left out{gain}"]
        return _unsteered(pulses, "beam not steered: the antenna lights the whole image area all the time", notes)
    message = f"{_words(steering)} about the antenna's axis, {np.degrees(width):.4g} degrees wide at half of its power"
    return _with_patterns(antenna, steering, width, pulses, position, ground, [message, *notes])


def _words(steering: FloatArray) -> str:
    first, last = np.degrees([steering[0], steering[-1]])
    return f"beam steered from {first:.3f} to {last:.3f} degrees"


def _with_patterns(
    antenna: ChannelAntenna,
    steering: FloatArray,
    width: float,
    pulses: Pulses,
    position: FloatArray,
    ground: FloatArray,
    notes: list[str],
) -> StatedBeam:
    """Add the patterns of the antenna's gain polynomials to the beam, unless they are constant."""
    found: dict[str, FloatArray] = {"beam_axis": antenna.axis, "beam_steering": steering}
    shift = float(steering[0] - antenna.steering[0])
    offset = np.linspace(-width / 2, width / 2, PATTERN_SAMPLES)
    gain = antenna.azimuth_gain(offset + shift)
    taken, notes = [], list(notes)
    if _usable("azimuth", gain, float(antenna.azimuth_gain(np.zeros(1))[0]), notes):
        found |= sampled(("beam_offset", "beam_pattern"), offset, gain)
        taken.append(f"over the beam ({gain.min() - gain.max():.2g} dB at its lowest)")
    # Include the reference point, at the origin: the store requires the pattern to cover it.
    across = _across(antenna, position, np.concatenate([ground, np.zeros((1, 3))]), width)
    down, gain = antenna.elevation_gain(across)
    steps = np.diff(down)
    if not ((steps > 0).all() or (steps < 0).all()):
        if np.ptp(gain) > FLAT:
            notes.append("the antenna's gain across the beam is left out: the boresight passes the nadir")
    elif _usable("elevation", gain, 0.0, notes):
        found |= sampled(("elevation", "elevation_pattern"), down, gain)
        taken.append(f"over elevation ({gain.min() - gain.max():.2g} dB)")
        turned = _turned_gain(antenna, across, down, gain)
        if turned > CHANGE:
            notes.append(
                f"the antenna's gain over elevation changes by {turned:.2g} dB as the beam is steered or the antenna "
                "turned; that of the middle is taken"
            )
    if taken:
        notes.append(f"antenna patterns of both ways taken from the gain polynomials: {' and '.join(taken)}")
    scanned = _scanned_gain(antenna)
    if scanned > CHANGE:
        notes.append(f"the antenna's gain changes by {scanned:.2g} dB as the beam is steered, which stays in the image")
    if antenna.left:
        notes.append(f"not used of the antenna's metadata: {', '.join(antenna.left)}")
    return StatedBeam(np.full(pulses.time.size, np.nan), width, notes, found)


def _usable(which: str, gain: FloatArray, at_boresight: float, notes: list[str]) -> bool:
    """Tell whether a gain (n,), dB, is a usable pattern: not constant, and nowhere far above boresight."""
    if not (np.isfinite(gain).all() and gain.max() <= at_boresight + RISE):
        notes.append(
            f"the antenna's gain in {which} is left out: its polynomials rise by {gain.max() - at_boresight:.3g} dB "
            "off the boresight, so they do not hold over the image area"
        )
        return False
    return float(np.ptp(gain)) > FLAT


def _across(antenna: ChannelAntenna, position: FloatArray, ground: FloatArray, width: float) -> FloatArray:
    """Direction cosines across the beam, relative to boresight, that cover points (n, 3) with a margin, (m,)."""
    seen = [np.zeros(1)]
    for pulse in np.unique(np.linspace(0, position.shape[0] - 1, CHECKED_PULSES).astype(int)):
        sight = ground - position[pulse]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        offset = np.arcsin((sight * antenna.axis[pulse]).sum(axis=1)) - antenna.steering[pulse]
        inside = np.abs(offset) <= width / 2
        seen.append((sight[inside] * antenna.across[pulse]).sum(axis=1) - antenna.tilt[pulse])
    low, high = np.concatenate(seen).min(), np.concatenate(seen).max()
    margin = ELEVATION_MARGIN * (high - low)
    return np.linspace(low - margin, high + margin, PATTERN_SAMPLES)


def _turned_gain(antenna: ChannelAntenna, across: FloatArray, down: FloatArray, gain: FloatArray) -> float:
    """Difference, dB, of the gain over elevation (n,) between the ends of the collection."""
    order, worst = np.argsort(down), 0.0
    for pulse in (0, antenna.steering.size - 1):
        other, changed = antenna.elevation_gain(across, pulse)
        common = (other >= down.min()) & (other <= down.max())
        if common.any():
            reference = np.interp(other[common], down[order], gain[order])
            worst = max(worst, float(np.abs(changed[common] - reference).max()))
    return worst


def _scanned_gain(antenna: ChannelAntenna) -> float:
    """Change, dB, of the two-way boresight gain over the steering, due to the element pattern."""
    p = antenna.pulse
    total = np.zeros(antenna.steering.size)
    for side in antenna.sides:
        total += polynomial.polyval2d(side.boresight[:, 0], side.boresight[:, 1], side.element)
    return float(np.abs(total - total[p]).max())


def _unused_gain(antenna: ChannelAntenna, position: FloatArray, ground: FloatArray) -> str:
    """Describe how much the unused gain varies over the image area."""
    offset = _offsets(antenna.axis, antenna.steering, position, ground)
    gain = antenna.azimuth_gain(np.linspace(offset.min(), offset.max(), PATTERN_SAMPLES))
    _, across = antenna.elevation_gain(_across(antenna, position, ground, np.inf))
    change = float(np.ptp(gain) + np.ptp(across))
    return f": their gain changes by {change:.2g} dB over the image area, which stays in it" if change > CHANGE else ""


# ---------------------------------------------------------------- beams fitted to dwells


def _by_dwells(pulses: Pulses, position: FloatArray, dwells: DwellPoints, notes: list[str]) -> StatedBeam:
    """Choose a yaw about the nadir or a steering about the velocity, whichever reproduces the dwells better."""
    although = "beam not steered, although targets are lit for part of the time only: "
    if np.ptp(dwells.centre) < 0.05 * dwells.length.mean():
        return _unsteered(pulses, f"{although}the image area's centre of dwell hardly changes", notes)
    yaw, axis = _yaw_law(pulses, position, dwells), _axis_law(pulses, position, dwells)
    for law in [yaw, axis] if yaw.miss <= max(CLOSE, axis.miss) else [axis, yaw]:
        if law.miss <= BEAM_TOLERANCE:
            return StatedBeam(law.beam.azimuth, law.beam.width, [*law.beam.messages, *notes], law.beam.antenna)
    return _unsteered(
        pulses,
        f"{although}of the laws that reproduce dwell polynomials, a yaw about the nadir {_missed(yaw)}, and a steering "
        f"about the velocity {_missed(axis)}: amplitudes are low",
        notes,
    )


def _missed(law: _Law) -> str:
    return f"misses them by {law.miss:.2g} of a dwell" if np.isfinite(law.miss) else "is no beam of a store"


def _yaw_law(pulses: Pulses, position: FloatArray, dwells: DwellPoints) -> _Law:
    """Fit a yaw that is a polynomial of the centre of dwell, extrapolated to the ends of the collection."""
    moment, cod = pulses.reference_time, dwells.centre
    nadir = position[position.shape[0] // 2, :2]
    turn = np.arctan2(dwells.ground[:, 1] - nadir[1], dwells.ground[:, 0] - nadir[0])
    turn = turned_near(turn, float(turn[0]))
    scale = 2 / np.ptp(cod)
    u, ends = (cod - cod.mean()) * scale, (moment - cod.mean()) * scale
    fit, misfit = _fit_yaw(u, turn)
    rate = abs(float(np.ptp(polynomial.polyval(u, fit)) / np.ptp(cod)))
    late = misfit / max(rate, 1e-30)
    half = dwells.length / 2 * scale
    widths = np.abs(polynomial.polyval(u + half, fit) - polynomial.polyval(u - half, fit))
    azimuth = np.asarray(polynomial.polyval(ends, fit))
    steps, width = np.diff(azimuth), float(widths.mean())
    miss = max(late / float(dwells.length.mean()), float(np.ptp(widths)) / 4 / max(width, 1e-30))
    one_way = (steps >= 0).all() or (steps <= 0).all()
    if not (one_way and np.abs(steps).max() <= width < np.pi and np.isfinite(miss)):
        miss = np.inf
    degrees = np.degrees([azimuth[0], azimuth[-1], width])
    message = (
        f"beam steered from yaw {degrees[0]:.2f} to {degrees[1]:.2f} degrees, {degrees[2]:.2f} degrees wide, from the "
        f"dwell polynomials (accurate to {late:.2g} s)"
    )
    return _Law(StatedBeam(azimuth, width, [message]), miss)


def _fit_yaw(u: FloatArray, yaw: FloatArray) -> tuple[FloatArray, float]:
    """Fit a polynomial of yaw in scaled time, of the lowest sufficient order; also its misfit, rad."""
    fits: list[tuple[FloatArray, float]] = []
    for order in range(1, HIGHEST_ORDER + 1):
        fit = polynomial.polyfit(u, yaw, order)
        fits.append((np.asarray(fit, np.float64), float(np.abs(polynomial.polyval(u, fit) - yaw).max())))
        if len(fits) > 1 and fits[-1][1] > fits[-2][1] / 4:
            return fits[-2]
    return fits[-1]


def _axis_law(pulses: Pulses, position: FloatArray, dwells: DwellPoints) -> _Law:
    """Fit a steering about the velocity, or about an axis at a yaw off it if that reproduces the dwells better."""
    law = _steering_law(pulses, position, dwells, 0.0)
    if law.miss <= CLOSE or np.count_nonzero(_edges(pulses, dwells)[2]) < LEAST_POINTS:
        return law
    from scipy.optimize import minimize_scalar

    def miss(turn: float) -> float:
        return min(_steering_law(pulses, position, dwells, turn).miss, 1e3)

    turns = np.linspace(-MOST_TURNED, MOST_TURNED, TURNS)
    nearest, step = float(turns[int(np.argmin([miss(turn) for turn in turns]))]), float(turns[1] - turns[0])
    best = minimize_scalar(miss, bounds=(nearest - step, nearest + step), method="bounded", options={"xatol": 1e-5})
    turned = _steering_law(pulses, position, dwells, float(best.x))
    return turned if turned.miss < law.miss / 2 else law


def _steering_law(pulses: Pulses, position: FloatArray, dwells: DwellPoints, turn: float) -> _Law:
    """Fit a polynomial steering s(t) and a width w by least squares, about the velocity rotated by `turn`, rad.

    With a(t) the angle of a point off the plane normal to the axis, a = s - w/2 at one end of its dwell, and
    a = s + w/2 at the other.
    """
    velocity = np.gradient(position, pulses.reference_time, axis=0)
    axis = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    cos, sin = np.cos(turn), np.sin(turn)
    axis = np.stack([cos * axis[:, 0] - sin * axis[:, 1], sin * axis[:, 0] + cos * axis[:, 1], axis[:, 2]], axis=1)
    first, last, inside = _edges(pulses, dwells)
    none = _Law(StatedBeam(np.full(pulses.time.size, np.nan), None, []), np.inf)
    if np.count_nonzero(inside) < LEAST_POINTS:
        return none
    times = np.concatenate([first[inside], last[inside]])
    ground = np.tile(dwells.ground[inside], (2, 1))
    angles = _angles(axis, position, pulses, ground, times)
    if not np.isfinite(angles).all():
        return none
    sides = np.repeat([-0.5, 0.5], times.size // 2)
    start, end = pulses.reference_time[[0, -1]]
    u, at = (2 * (t - start) / (end - start) - 1 for t in (times, pulses.reference_time))
    fits = []
    for order in range(HIGHEST_ORDER + 1):
        terms = np.concatenate([polynomial.polyvander(u, order), sides[:, None]], axis=1)
        fit = np.linalg.lstsq(terms, angles, rcond=None)[0]
        fits.append((fit, float(np.abs(terms @ fit - angles).max())))
    least = min(misfit for _, misfit in fits)
    fit, misfit = next((fit, misfit) for fit, misfit in fits if misfit <= 4 * least)
    width, steering = abs(float(fit[-1])), np.asarray(polynomial.polyval(at, fit[:-1]))
    try:
        check_axis_beam(axis, steering, width)
    except InputError:
        return none
    miss = misfit / width
    about = f"an axis turned by {np.degrees(turn):.3f} degrees from the velocity" if turn else "the velocity"
    message = (
        f"{_words(steering)} about {about}, {np.degrees(width):.4g} degrees wide, from the dwell polynomials (accurate "
        f"to {miss:.2g} of a dwell)"
    )
    beam = StatedBeam(none.beam.azimuth, width, [message], {"beam_axis": axis, "beam_steering": steering})
    return _Law(beam, miss)


# ---------------------------------------------------------------- angles


def _edges(pulses: Pulses, dwells: DwellPoints) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Beginning and end of each dwell (n,), s, and whether both lie within the collection."""
    first, last = dwells.centre - dwells.length / 2, dwells.centre + dwells.length / 2
    start, end = pulses.reference_time[[0, -1]]
    interval = (end - start) / (pulses.time.size - 1)
    return first, last, (first >= start - interval) & (last <= end + interval)


def _angles(axis: FloatArray, position: FloatArray, pulses: Pulses, ground: FloatArray, time: FloatArray) -> FloatArray:
    """Angles, rad, of points (n, 3) off the plane normal to the axis, each at its own reference time (n,)."""
    moment = pulses.reference_time
    at, along = (
        np.stack([np.interp(time, moment, column) for column in values.T], axis=1) for values in (position, axis)
    )
    sight = ground - at
    return np.arcsin((sight * along).sum(axis=1) / np.linalg.norm(sight, axis=1))


def _offsets(axis: FloatArray, steering: FloatArray, position: FloatArray, ground: FloatArray) -> FloatArray:
    """Angles, rad, of points (n, 3) off the beam's centre, at each of some pulses."""
    some = np.unique(np.linspace(0, steering.size - 1, 9).astype(int))
    return np.concatenate([
        np.arcsin(((ground - position[p]) * axis[p]).sum(axis=1) / np.linalg.norm(ground - position[p], axis=1))
        - steering[p]
        for p in some
    ])  # fmt: skip
