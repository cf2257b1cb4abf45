"""The beam of a scene as CPHD describes it: image area, dwell polynomials, antenna frame, boresight and gain.

The antenna coordinate frame has ACX along the beam's axis and ACX x ACY towards the swath: at the depression of the
scene centre, at right angles to the axis. The electrical boresight is the beam's centre. Transmitter and receiver are
one antenna, so that a two-way amplitude g is a gain of 10 log10 g dB one way; it is written as polynomials of the
direction cosines, for the pulse whose steering is amid all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.beam import full_dwell_yaw
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene

RANGES, YAWS, SEARCHED = 9, 65, 1025  # points of the polynomials, and yaws among which full dwells are sought
LEAST_YAWS = 8  # of those
SEEN, CHECKED_PULSES = 257, 33  # yaws and pulses at which the directions that the beam sees are sought
POLYNOMIAL_ERROR = 1e-3  # of a dwell, by which the polynomials may be off
GAIN_ORDERS = range(2, 15)
GAIN_ERROR = 0.02  # of the largest amplitude, that the gain polynomials may be off
GAIN_SAMPLES = 513
CLOSE_ENOUGH = 1e-5  # the same, from which on no higher order is tried
FLOOR = 1e-4  # of the largest amplitude, below which a gain is not followed
TRACK_ORDER = 5  # of polynomials of time
MARGIN = 0.1  # of the lit directions across the beam, beyond which its gain is not followed


class LitArea(NamedTuple):
    """Image area, a clockwise polygon (n, 2) about the scene centre, m; polynomials of centre of dwell and dwell, s."""

    outline: FloatArray
    centre: FloatArray
    length: FloatArray


def lit_area(scene: Scene, collection: Collection, moment: FloatArray) -> LitArea:
    """The image area and its dwells; `moment` (n_pulse,) is the reference time, s.

    For a steered beam the area is what is lit for a whole dwell, or what is always lit if the beam moves by less than
    its width.

    Raises
    ------
    InputError
        If a beam about its axis passes wholly over none of the swath.
    """
    near, far = scene.area.swath
    whole = np.full((1, 1), (moment[0] + moment[-1]) / 2), np.full((1, 1), moment[-1] - moment[0])
    if collection.has_axis:
        return _axis_area(scene, collection, moment, whole)
    if collection.beam_width is None:
        ends = np.stack([np.stack(scene.ground_point(r, scene.centre_yaw)) for r in (near, far)]) - scene.centre[:2]
        half = float(np.linalg.norm(ends, axis=1).max())
        return LitArea(half * np.array([[-1.0, -1], [-1, 1], [1, 1], [1, -1]]), *whole)
    beam, width = collection.beam_azimuth, collection.beam_width
    low, high = full_dwell_yaw(collection)
    always = low >= high
    low, high = min(low, high), max(low, high)
    inset = 1e-3 * (high - low)
    yaw = np.linspace(low + inset, high - inset, 17)
    arcs = [np.stack(scene.ground_point(r, y), axis=-1) - scene.centre[:2] for r, y in ((near, yaw), (far, yaw[::-1]))]
    area = _clockwise(np.concatenate(arcs))
    if always:
        return LitArea(area, *whole)
    x, y = (axis.ravel() - c for axis, c in zip(
        scene.ground_point(np.linspace(near, far, RANGES)[:, None], np.linspace(low, high, YAWS)), scene.centre,
        strict=False,
    ))  # fmt: skip
    yaw = np.tile(np.linspace(low, high, YAWS), RANGES)
    order = np.argsort(beam, kind="stable")
    begin, end = (np.interp(yaw + side * width / 2, beam[order], moment[order]) for side in (-1, 1))
    return LitArea(area, _fit_polynomial(x, y, (begin + end) / 2), _fit_polynomial(x, y, np.abs(end - begin)))


def _axis_area(
    scene: Scene, collection: Collection, moment: FloatArray, whole: tuple[FloatArray, FloatArray]
) -> LitArea:
    """Image area for a beam about its axis, whose dwells depend on range as well as on yaw."""
    geometry, time = Geometry(collection=collection), collection.time
    ranges, yaws = np.linspace(*scene.area.swath, RANGES), np.linspace(*scene.lit_yaw, SEARCHED)
    first, last = geometry.beam.dwell_at(yaws, ranges[:, None], uncut=True)
    inset = collection.pulse_interval + POLYNOMIAL_ERROR * np.abs(last - first)
    full = (last > first) & (first >= time[0] + inset) & (last <= time[-1] - inset)
    always = (first <= time[0]) & (last >= time[-1])
    amid = int(np.abs(yaws - scene.centre_yaw).argmin())
    swept, still = _runs(full, amid), _runs(always, amid)
    runs = still if swept is None else swept
    if runs is None:
        raise InputError(
            f"beam.mode = {scene.beam.mode if scene.beam else None!r}: in {time.size} pulses the beam passes wholly "
            "over none of the swath at all ranges, so that a CPHD file has no image area; simulate more pulses, or "
            "give a smaller width_deg or swath"
        )
    low, high = yaws[runs[0]], yaws[runs[1]]
    if not low.max() <= scene.centre_yaw <= high.min():
        degrees = np.degrees([scene.centre_yaw, low.max(), high.min()])
        raise InputError(
            f"scene.centre_yaw_deg = {degrees[0]:g}: the scene centre becomes the reference point of a CPHD file, but "
            "is not lit for a whole dwell; "
            + (f"give {degrees[1]:.4g} .. {degrees[2]:.4g}" if low.max() < high.min() else "give a smaller swath")
        )
    edges = [np.stack(scene.ground_point(ranges, yaw), axis=-1) - scene.centre[:2] for yaw in (low, high)]
    area = _clockwise(np.concatenate([edges[0], edges[1][::-1]]))
    if swept is None:
        return LitArea(area, *whole)
    yaw = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, YAWS)
    grid = np.broadcast_to(ranges[:, None], yaw.shape)
    first, last = (np.interp(t, time, moment) for t in geometry.beam.dwell_at(yaw, grid, uncut=True))
    x, y = (axis.ravel() - c for axis, c in zip(scene.ground_point(grid, yaw), scene.centre, strict=False))
    return LitArea(
        area, _fit_polynomial(x, y, ((first + last) / 2).ravel()), _fit_polynomial(x, y, (last - first).ravel())
    )


def _runs(mask: BoolArray, amid: int) -> tuple[IntArray, IntArray] | None:
    """First and last index of the run of each row of a mask (n, m) nearest to an index; None if one is too short.

    The beam also lights the other side of the track, which is another run.
    """
    found = []
    for row in mask:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8))).reshape(-1, 2)
        if edges.size == 0:
            return None
        away = np.maximum(edges[:, 0] - amid, amid - (edges[:, 1] - 1))
        first, stop = edges[int(away.argmin())]
        if stop - first < LEAST_YAWS:
            return None
        found.append((first, stop - 1))
    low, high = np.array(found, np.int64).T
    return low, high


def _clockwise(area: FloatArray) -> FloatArray:
    following = np.roll(area, -1, axis=0)
    turned = np.sum(area[:, 0] * following[:, 1] - area[:, 1] * following[:, 0]) > 0
    return area[::-1] if turned else area


def _fit_polynomial(x: FloatArray, y: FloatArray, values: FloatArray, order: int = 6) -> FloatArray:
    """Return coefficients of x^i y^j, i + j <= order, (order + 1, order + 1), by least squares."""
    scale = float(max(np.abs(x).max(), np.abs(y).max()))
    i, j = np.nonzero(np.add.outer(np.arange(order + 1), np.arange(order + 1)) <= order)
    scaled = np.linalg.lstsq((x[:, None] / scale) ** i * (y[:, None] / scale) ** j, values, rcond=None)[0]
    table = np.zeros((order + 1, order + 1))
    table[i, j] = scaled / scale ** (i + j)
    return table


# ---------------------------------------------------------------- the antenna


class AntennaFrame(NamedTuple):
    """ACX, ACY (n_pulse, 3), scene frame, and the direction cosines (n_pulse, 2) of the electrical boresight."""

    x: FloatArray
    y: FloatArray
    boresight: FloatArray
    pulse: int  # whose steering is amid all

    def directions(self, along: FloatArray, across: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) of direction cosines (n,) at that pulse."""
        x, y = self.x[self.pulse], self.y[self.pulse]
        rest = np.sqrt(np.maximum(1 - along**2 - across**2, 0.0))
        return np.asarray(along[:, None] * x + across[:, None] * y + rest[:, None] * np.cross(x, y))


def antenna_frame(scene: Scene, collection: Collection) -> AntennaFrame:
    """The antenna coordinate frame of a beam about its axis."""
    assert collection.beam_axis is not None and collection.beam_steering is not None
    axis, steering = collection.beam_axis, collection.beam_steering
    pulse = int(np.abs(steering - (steering.min() + steering.max()) / 2).argmin())
    sight = scene.centre - collection.antenna_position[pulse]
    level = np.cross(axis, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    down = np.cross(axis, level)
    level, down = level * np.sign(sight @ level[pulse]), down * np.sign(sight @ down[pulse])
    depression = np.arctan2(sight @ down[pulse], sight @ level[pulse])
    normal = np.cos(depression) * level + np.sin(depression) * down
    boresight = np.stack([np.sin(steering), np.zeros(steering.size)], axis=1)
    return AntennaFrame(axis, np.cross(normal, axis), boresight, pulse)


def gain_table(scene: Scene, collection: Collection, frame: AntennaFrame) -> FloatArray:
    """One-way gain in dB: coefficients of the direction cosines off the boresight's, (order1 + 1, order2 + 1).

    Raises
    ------
    InputError
        If no polynomial follows a pattern.
    """
    along, across = np.zeros(1), np.zeros(1)
    if collection.beam_offset is not None and collection.beam_pattern is not None:
        half = (collection.beam_width or 0.0) / 2
        offset = np.linspace(-half, half, GAIN_SAMPLES)
        centre = float(frame.boresight[frame.pulse, 0])
        amplitude = np.interp(offset, collection.beam_offset, collection.beam_pattern)
        along = _fit_gain("beam.pattern", np.sin(np.arcsin(centre) + offset) - centre, amplitude)
    if collection.elevation is not None and collection.elevation_pattern is not None:
        cosine, seen = _seen_across(scene, collection, frame)
        amplitude = np.interp(seen, collection.elevation, collection.elevation_pattern)
        across = _fit_gain("beam.elevation_pattern", cosine, amplitude)
    table = np.zeros((along.size, across.size))
    table[:, 0] += along
    table[0] += across
    return table


def _seen_across(scene: Scene, collection: Collection, frame: AntennaFrame) -> tuple[FloatArray, FloatArray]:
    """Direction cosines along ACY at which the beam sees the swath, and elevations there, rad, (m,)."""
    yaw = np.linspace(*scene.lit_yaw, SEEN)
    x, y = (np.ravel(axis) for axis in scene.ground_point(np.linspace(*scene.area.swath, RANGES)[:, None], yaw))
    ground = np.stack([x, y, np.full(x.size, collection.ground_height)], axis=1)
    geometry, half = Geometry(collection=collection), (collection.beam_width or 0.0) / 2
    cosines, elevations = [], []
    for pulse in np.unique(np.linspace(0, collection.n_pulse - 1, CHECKED_PULSES).astype(int)):
        sight = ground - collection.antenna_position[pulse]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        side = np.cross(frame.x[pulse], frame.y[pulse])[:2]
        lit = (np.abs(geometry.beam.offset(x, y, int(pulse))) <= half) & ((sight[:, :2] * side).sum(axis=1) > 0)
        cosines.append((sight[lit] * frame.y[pulse]).sum(axis=1))
        elevations.append(np.arcsin(-sight[lit, 2]))
    seen = np.concatenate(cosines)
    # The polynomial is to hold a little beyond, for readers that take it there.
    margin = MARGIN * np.ptp(seen) * np.linspace(0, 1, RANGES)
    beyond = np.concatenate([seen.min() - margin, seen.max() + margin])
    directions = frame.directions(np.full(beyond.shape, frame.boresight[frame.pulse, 0]), beyond)
    return np.concatenate([seen, beyond]), np.concatenate([*elevations, np.arcsin(-directions[:, 2])])


def _fit_gain(name: str, cosine: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Coefficients of a one-way gain in dB over direction cosines (n,), of the lowest order that is close enough."""
    peak, scale = float(amplitude.max()), float(np.abs(cosine).max())
    gain = 10 * np.log10(np.maximum(amplitude, FLOOR * peak))
    best, least = np.zeros(1), np.inf
    for order in GAIN_ORDERS:
        # An error of the gain in dB is one of the amplitude in proportion to it.
        fit = polynomial.polyfit(cosine / scale, gain, order, w=np.maximum(amplitude, FLOOR * peak))
        error = float(np.abs(10 ** (polynomial.polyval(cosine / scale, fit) / 10) - amplitude).max()) / peak
        if error < least:
            best, least = fit / scale ** np.arange(order + 1.0), error
        if least < CLOSE_ENOUGH:
            break
    if least > GAIN_ERROR:
        raise InputError(
            f"{name} cannot be written to a CPHD file: gains are polynomials there, and one of order "
            f"{GAIN_ORDERS[-1]} is off by {least:.2g} of its peak; smooth it, steer by less, or simulate a store"
        )
    return np.asarray(best)


def antenna_content(
    frame: AntennaFrame, scene_frame: Georeference, time: FloatArray, f: float, gain: FloatArray
) -> Any:
    """The element `Antenna`: `time` (n_pulse,) s, of transmission; `f` is the reference frequency, Hz."""
    axes = {
        f"{name}AxisPoly": {
            axis: _time_polynomial(time, column)
            for axis, column in zip("XYZ", (vectors @ scene_frame.axes).T, strict=True)
        }
        for name, vectors in (("X", frame.x), ("Y", frame.y))
    }
    boresight = {
        f"{name}Poly": _time_polynomial(time, column)
        for name, column in zip(("DCX", "DCY"), frame.boresight.T, strict=True)
    }
    used = [({"exponent1": i, "exponent2": j}, gain[i, j]) for i, j in zip(*np.nonzero(gain), strict=True)]
    zero: Any = ({"order1": 0, "order2": 0}, {"Coef": ({"exponent1": 0, "exponent2": 0}, 0.0)})
    orders = {"order1": gain.shape[0] - 1, "order2": gain.shape[1] - 1}
    return {
        "NumACFs": 1, "NumAPCs": 1, "NumAntPats": 1,
        "AntCoordFrame": {"Identifier": "1", **axes, "UseACFPVP": True},
        "AntPhaseCenter": {"Identifier": "1", "ACFId": "1", "APCXYZ": {"X": 0.0, "Y": 0.0, "Z": 0.0}},
        "AntPattern": {
            "Identifier": "1", "FreqZero": f, "EBFreqShift": False, "MLFreqDilation": False,
            "EB": {**boresight, "UseEBPVP": True},
            "Array": {"GainPoly": (orders, {"Coef": used}) if used else zero, "PhasePoly": zero},
            "Element": {"GainPoly": zero, "PhasePoly": zero},
        },
    }  # fmt: skip


def _time_polynomial(time: FloatArray, values: FloatArray) -> Any:
    scale = float(time[-1])
    fit = polynomial.polyfit(time / scale, values, TRACK_ORDER) / scale ** np.arange(TRACK_ORDER + 1.0)
    return {"order1": TRACK_ORDER}, {"Coef": [({"exponent1": i}, value) for i, value in enumerate(fit)]}
