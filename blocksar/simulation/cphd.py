"""Simulation of a scene into a CPHD 1.1.0 file: FX domain, SGN -1, CF8 (see `readers.cphd` for the format).

CPHD describes the beam by image area, dwell polynomials, antenna frame, boresight and gain.

The antenna coordinate frame has ACX along the beam's axis and ACX x ACY towards the swath: at the depression of the
scene centre, at right angles to the axis. The electrical boresight is the beam's centre. Transmitter and receiver are
one antenna, so that a two-way amplitude g is a gain of 10 log10 g dB one way; it is written as polynomials of the
direction cosines, for the pulse whose steering is amid all.
"""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.beam import full_dwell_yaw
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, in_the_way, unwritable
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace, flush_file, held_part, new_file
from blocksar.progress.listening import Callback
from blocksar.readers.cphd import NAMESPACE, library
from blocksar.simulation.scene import RANGE_GUARD, Scene, next_smooth_even
from blocksar.simulation.simulate import sampler, write_truth
from blocksar.version import __version__

if TYPE_CHECKING:
    from types import ModuleType

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
    """Image area, a clockwise polygon (n, 2) about the scene centre, m; polynomials of dwell centre and dwell, s."""

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
    """First and last index of the run nearest to index `amid` in each row of a mask (n, m); None if one is too short.

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
        """Convert direction cosines (n,) to unit vectors (n, 3) in the scene frame."""
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
    """Polynomial of the one-way gain, dB, in direction cosines off boresight: (order1 + 1, order2 + 1).

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
    """Direction cosines along ACY, and elevations, rad, at which the beam sees the swath: (m,) each."""
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
    # Fit a little beyond the swath, for readers that evaluate the polynomial there.
    margin = MARGIN * np.ptp(seen) * np.linspace(0, 1, RANGES)
    beyond = np.concatenate([seen.min() - margin, seen.max() + margin])
    directions = frame.directions(np.full(beyond.shape, frame.boresight[frame.pulse, 0]), beyond)
    return np.concatenate([seen, beyond]), np.concatenate([*elevations, np.arcsin(-directions[:, 2])])


def _fit_gain(name: str, cosine: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Fit a polynomial of the lowest sufficient order to a one-way gain, dB, over direction cosines (n,)."""
    peak, scale = float(amplitude.max()), float(np.abs(cosine).max())
    gain = 10 * np.log10(np.maximum(amplitude, FLOOR * peak))
    best, least = np.zeros(1), np.inf
    for order in GAIN_ORDERS:
        # Weight by amplitude: an error of the gain in dB is a relative error of the amplitude.
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
    """Content of the element `Antenna`: `time` (n_pulse,), s, of transmission; `f` is the reference frequency, Hz."""
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


ROWS = TILE[0]  # pulses in memory at a time
VECTOR = {  # per-vector parameters: format, and size in words of 8 bytes
    **dict.fromkeys(("TxTime",), ("F8", 1)),
    **dict.fromkeys(("TxPos", "TxVel"), ("X=F8;Y=F8;Z=F8;", 3)),
    **dict.fromkeys(("RcvTime",), ("F8", 1)),
    **dict.fromkeys(("RcvPos", "RcvVel", "SRPPos"), ("X=F8;Y=F8;Z=F8;", 3)),
    **dict.fromkeys(("aFDOP", "aFRR1", "aFRR2", "FX1", "FX2", "TOA1", "TOA2", "TDTropoSRP", "SC0", "SCSS"), ("F8", 1)),
    "SIGNAL": ("I8", 1),
}
ANTENNA = {f"{side}Antenna": {  # per-vector parameters of a beam about the antenna's axis
    **dict.fromkeys((f"{side}ACX", f"{side}ACY"), ("X=F8;Y=F8;Z=F8;", 3)), f"{side}EB": ("DCX=F8;DCY=F8;", 2),
} for side in ("Tx", "Rcv")}  # fmt: skip
OVERSAMPLING = 1.2  # ratio of the window to the lit ranges, as the standard asks
ORIGIN = (39.78, -84.1, 300.0)  # default latitude and longitude in degrees, and height in m
MOST_AWAY = 1e-3  # m of a scene centre from the origin of its georeference
START = "2000-01-01T00:00:00.000000Z"  # time of a simulated collection


def simulate(
    scene: Scene | str | os.PathLike[str],
    out: Location,
    *,
    origin: tuple[float, float, float] | None = None,
    threads: int = 1,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Path:
    """Simulate a scene into a CPHD 1.1.0 file, by chunks of pulses: FX domain, SGN -1, CF8.

    The scene centre becomes IARP and SRP. The axes x and y point east and north there, or as the scene's georeference
    turns them; the ground is the horizontal plane through it. Signals are referenced to the SRP, whatever the scene
    file states; the frequencies are spaced so that the lit ranges fill 1 / 1.2 of the window, as the standard asks. A
    lost pulse has SIGNAL = 0. A steered beam is described by the polynomials of centre of dwell and dwell time, over
    the sector that is lit for a whole dwell; a beam about the antenna's axis also by that antenna: frame and boresight
    of each vector, and its pattern.

    Parameters
    ----------
    scene : Scene, or path of a scene file, or name of a shipped scene
    out : path
        The file to write.
    origin : (latitude, longitude, height), optional
        Position of the scene centre: degrees, and m above the WGS 84 ellipsoid. Default: that of the scene's
        georeference, or `ORIGIN`.
    threads : int
        Number of threads; the samples do not depend on it.
    overwrite : bool
        Replace an existing CPHD file.
    progress : callable (done, total)
        Called after each chunk with the numbers of finished pulses and of all pulses.

    Raises
    ------
    InputError
        If the scene or the origin is wrong or CPHD cannot describe its beam, or `out` exists and overwrite is False.
    """
    sarkit = library()
    if threads < 1:
        raise InputError(f"threads = {threads}: must be at least 1")
    where = _free_file(out, overwrite=overwrite)
    scene = scene if isinstance(scene, Scene) else Scene.read(os.fspath(scene))
    if scene.channels:
        raise InputError(
            f"channels = {list(scene.channels)}: CPHD files are simulated with a single channel; leave channels out, "
            "or simulate a store"
        )
    scene = _about_centre(scene)
    frame = _frame(scene, origin)
    collection, toa = _oversampled(scene)
    vectors, tree = _metadata(sarkit, scene, collection, frame, toa)
    samples = sampler(scene, collection, threads=threads)
    try:
        where.parent.mkdir(parents=True, exist_ok=True)
        with held_part(where, new_file) as part, open(part, "w+b") as file:
            sarkit.Writer(file, sarkit.Metadata(xmltree=tree)).write_pvp("1", vectors)
            file.seek(0)
            file.seek(int(sarkit.read_file_header(file)[1]["SIGNAL_BLOCK_BYTE_OFFSET"]))
            for first in range(0, collection.n_pulse, ROWS):
                pulses = slice(first, min(first + ROWS, collection.n_pulse))
                block = samples(pulses)
                block[vectors["SIGNAL"][pulses] == 0] = 0
                file.write(block.astype(">c8").data)
                if progress is not None:
                    progress(pulses.stop, collection.n_pulse)
            unturned = replace(frame, rotation=0.0)  # as a store has it that is ingested
            write_truth(scene, where, lambda p: unturned.from_ecef(frame.to_ecef(p - scene.centre)))
            file.flush()
            flush_file(part)
            os.replace(part, where)
    except OSError as error:
        raise unwritable(where, error) from error
    return where


def _free_file(out: Location, *, overwrite: bool) -> Path:
    """Return the path to write to; raise an InputError if something there may not be replaced."""
    where = place(out)
    if not isinstance(where, LocalPlace):
        raise InputError(f"{where} is in an object store, where CPHD files are not written; give the path of a file")
    path = where.path
    if os.path.lexists(path):
        if not overwrite:
            raise in_the_way(path)
        is_cphd = path.is_file()
        if is_cphd:
            with open(path, "rb") as file:
                is_cphd = file.read(5) == b"CPHD/"
        if not is_cphd:
            raise InputError(
                f"{path} exists and is no CPHD file, so it is not overwritten; remove it, or choose another name"
            )
    return path


def _frame(scene: Scene, origin: tuple[float, float, float] | None) -> Georeference:
    """Return where the scene centre lies on the Earth, and the scene's axes.

    Where the centre is not the origin of the scene's georeference, its plane is laid level at the centre's place, and
    turned so that x keeps its direction; see `off_level`.

    Raises
    ------
    InputError
        If the origin is wrong.
    """
    placed = scene.georeference
    if placed is None or origin is not None:
        try:
            latitude, longitude, height = map(float, origin or ORIGIN)
            possible = abs(latitude) <= 89.9 and abs(longitude) <= 180 and abs(height) < 1e5
        except (TypeError, ValueError):
            possible = False
        if not possible:
            raise InputError(
                f"origin is {origin}: give a latitude within 89.9 degrees, a longitude within 180, and a height in m"
            )
        rotation = 0.0 if placed is None else placed.rotation
        return Georeference(latitude=latitude, longitude=longitude, height=height, rotation=rotation)
    if _away(scene) <= MOST_AWAY:
        return replace(placed, height=placed.height + scene.area.ground_height)
    level = Georeference.at(placed.to_ecef(scene.centre))
    east, north = level.east_north_up[:2] @ placed.axes[0]
    return replace(level, rotation=float(np.degrees(np.arctan2(north, east))))


def _away(scene: Scene) -> float:
    """Ground distance, m, of the scene centre from the origin of the frame."""
    return float(np.hypot(*scene.centre[:2]))


def off_level(scene: Scene, origin: tuple[float, float, float] | None) -> str | None:
    """Warn that the scene in the file is level at its centre, far from the georeference's origin; None if near.

    The plane of a CPHD file is that of its reference point. The plane that is level at the origin slopes there by the
    distance over the radius of the Earth, so that places about the centre differ by as much of their distance to it.
    """
    if scene.georeference is None or origin is not None or _away(scene) <= MOST_AWAY:
        return None
    level, places = _frame(scene, None), scene.collection().antenna_position
    ground = np.array([[target.x, target.y, scene.centre[2]] for target in scene.point_targets()]).reshape(-1, 3)
    off = [
        float(np.linalg.norm(scene.georeference.to_ecef(at) - level.to_ecef(at - scene.centre), axis=1).max(initial=0))
        for at in (ground, places)
    ]
    return (
        f"the scene centre lies {1e-3 * _away(scene):.3g} km from the origin of its [georeference], and the file's "
        f"plane is level at the centre: its targets lie up to {off[0]:.2g} m, its track up to {off[1]:.3g} m from "
        "where the scene has them; a store has them there"
    )


def _about_centre(scene: Scene) -> Scene:
    """Return the scene with its signals referenced to its centre."""
    copy = scene.model_copy(update={"area": scene.area.model_copy(update={"reference_range": "scene_centre"})})
    for name in set(vars(copy)) - set(Scene.model_fields):
        vars(copy).pop(name)  # remove cached values that depend on the old reference
    return copy


def _oversampled(scene: Scene) -> tuple[Collection, float]:
    """Return the scene's collection with the same band on finer frequencies, and half the extent of lit delays, s."""
    collection = scene.collection()
    lit = 1 / (RANGE_GUARD * collection.range_frequency_step)
    n = next_smooth_even(int(np.ceil(OVERSAMPLING * lit * collection.bandwidth)))
    middle = float(collection.range_frequency[0] + collection.range_frequency[-1]) / 2
    grid = middle + (np.arange(n) - (n - 1) / 2) * (collection.bandwidth / n)
    return Collection(**{**collection.as_dict(), "range_frequency": grid}), lit / 2


def _metadata(
    sarkit: ModuleType, scene: Scene, collection: Collection, frame: Georeference, toa: float
) -> tuple[NDArray[Any], Any]:
    """Return the per-vector parameters and the XML tree."""
    from lxml import etree

    lost = scene.dropped_pulses()
    time = collection.time - collection.time[0]
    local = collection.antenna_position - scene.centre
    delay = 2 * np.linalg.norm(local, axis=1) / SPEED_OF_LIGHT
    step, first = collection.range_frequency_step, collection.carrier + collection.range_frequency[0]
    band = (first - step / 2, first + (collection.n_range_frequency - 0.5) * step)
    area, cod, dwell = lit_area(scene, collection, time + delay / 2)
    antenna = _antenna(scene, collection, frame, (band[0] + band[1]) / 2)
    root = etree.Element(f"{{{NAMESPACE}1.1.0}}CPHD", nsmap={None: f"{NAMESPACE}1.1.0"})
    _build(root, _collection_id(scene))
    _build(root, {
        "Global": {
            "DomainType": "FX", "SGN": "-1",
            "Timeline": {"CollectionStart": START, "TxTime1": time[0], "TxTime2": time[-1]},
            "FxBand": {"FxMin": band[0], "FxMax": band[1]},
            "TOASwath": {"TOAMin": -toa, "TOAMax": toa},
        },
        "SceneCoordinates": _scene_coordinates(frame, area, SPEED_OF_LIGHT / (4 * collection.bandwidth)),
        "Data": {
            "SignalArrayFormat": "CF8", "NumBytesPVP": 8 * _words(VECTOR, *antenna.layout.values()),
            "NumCPHDChannels": 1,
            "Channel": {
                "Identifier": "1", "NumVectors": collection.n_pulse, "NumSamples": collection.n_range_frequency,
                "SignalArrayByteOffset": 0, "PVPArrayByteOffset": 0,
            },
            "NumSupportArrays": 0,
        },
        "Channel": {
            "RefChId": "1", "FXFixedCPHD": True, "TOAFixedCPHD": True, "SRPFixedCPHD": True,
            "Parameters": {
                "Identifier": "1", "RefVectorIndex": collection.n_pulse // 2,
                "FXFixed": True, "TOAFixed": True, "SRPFixed": True, "SignalNormal": not lost.size,
                "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": "UNSPECIFIED"},
                "FxC": (band[0] + band[1]) / 2, "FxBW": band[1] - band[0], "TOASaved": 2 * toa,
                "DwellTimes": {"CODId": "1", "DwellId": "1"}, **antenna.channel,
            },
        },
        "PVP": _vector_layout(antenna.layout),
        "Dwell": {
            "NumCODTimes": 1, "CODTime": {"Identifier": "1", "CODTimePoly": _polynomial_element(cod)},
            "NumDwellTimes": 1, "DwellTime": {"Identifier": "1", "DwellTimePoly": _polynomial_element(dwell)},
        },
    })  # fmt: skip
    tree = root.getroottree()
    vectors = np.zeros(collection.n_pulse, sarkit.get_pvp_dtype(tree))
    _fill_vectors(vectors, collection, frame, local)
    vectors["FX1"], vectors["FX2"] = band
    vectors["TOA1"], vectors["TOA2"] = -toa, toa
    vectors["SIGNAL"] = 1
    vectors["SIGNAL"][lost] = 0
    for name, values in antenna.vectors.items():
        vectors[name] = values
    root.append(sarkit.compute_reference_geometry(tree, vectors))
    _build(root, antenna.content)
    application = {"Application": f"blocksar {__version__}", "DateTime": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"}
    _build(root, {"ProductInfo": {"CreationInfo": application}})
    return vectors, tree


def _fill_vectors(vectors: NDArray[Any], collection: Collection, frame: Georeference, local: FloatArray) -> None:
    """Set times, places and frequencies; `local` (n_pulse, 3) are positions about the scene centre, m."""
    time = collection.time - collection.time[0]
    vectors["TxTime"], vectors["RcvTime"] = time, time + 2 * np.linalg.norm(local, axis=1) / SPEED_OF_LIGHT
    vectors["TxPos"] = vectors["RcvPos"] = frame.to_ecef(local)
    velocity = Geometry(collection=collection).track.velocity(collection.time)
    vectors["TxVel"] = vectors["RcvVel"] = velocity @ frame.axes
    vectors["SRPPos"] = frame.origin
    vectors["SC0"] = collection.carrier + collection.range_frequency[0]
    vectors["SCSS"] = collection.range_frequency_step


class _AntennaParts(NamedTuple):
    """The antenna in CPHD: per-vector parameters, their layout, and elements; empty without a description."""

    layout: dict[str, dict[str, tuple[str, int]]]
    vectors: dict[str, NDArray[Any]]
    channel: dict[str, Any]
    content: dict[str, Any]


def _antenna(scene: Scene, collection: Collection, frame: Georeference, frequency: float) -> _AntennaParts:
    if not collection.has_axis:
        if collection.has_pattern:
            raise InputError(
                "beam.pattern and beam.elevation_pattern are not written to a CPHD file for a beam that is described "
                "by its yaw; give beam.mode instead of start_deg and stop_deg, or simulate a store"
            )
        return _AntennaParts({}, {}, {}, {})
    made = antenna_frame(scene, collection)
    vectors: dict[str, NDArray[Any]] = {}
    for side in ("Tx", "Rcv"):
        vectors |= {f"{side}ACX": made.x @ frame.axes, f"{side}ACY": made.y @ frame.axes, f"{side}EB": made.boresight}
    identifiers = dict.fromkeys(("TxAPCId", "TxAPATId", "RcvAPCId", "RcvAPATId"), "1")
    time = collection.time - collection.time[0]
    content = antenna_content(made, frame, time, frequency, gain_table(scene, collection, made))
    return _AntennaParts(ANTENNA, vectors, {"Antenna": identifiers}, {"Antenna": content})


def _collection_id(scene: Scene) -> dict[str, Any]:
    return {
        "CollectionID": {
            "CollectorName": "blocksar", "CoreName": scene.name or "scene", "CollectType": "MONOSTATIC",
            "RadarMode": {"ModeType": _mode(scene)},
            "Classification": "UNCLASSIFIED", "ReleaseInfo": "UNRESTRICTED",
        }
    }  # fmt: skip


def _mode(scene: Scene) -> str:
    if scene.beam is None or scene.beam.mode == "spotlight":
        return "SPOTLIGHT"
    return "STRIPMAP" if scene.beam.mode == "stripmap" else "DYNAMIC STRIPMAP"


def _words(*layouts: dict[str, tuple[str, int]]) -> int:
    return sum(size for layout in layouts for _, size in layout.values())


def _vector_layout(groups: dict[str, dict[str, tuple[str, int]]]) -> dict[str, Any]:
    """Layout of the per-vector parameters; those of the antenna form groups."""
    offset = 0

    def places(parameters: dict[str, tuple[str, int]]) -> dict[str, Any]:
        nonlocal offset
        layout = {}
        for name, (form, size) in parameters.items():
            layout[name] = {"Offset": offset, "Size": size, "Format": form}
            offset += size
        return layout

    return {**places(VECTOR), **{name: places(parameters) for name, parameters in groups.items()}}


def _scene_coordinates(frame: Georeference, area: FloatArray, spacing: float) -> dict[str, Any]:
    """Return the ground plane, image area and grid; `area` (n, 2) is a clockwise polygon, m."""
    low, high = area.min(axis=0), area.max(axis=0)
    corners = np.array([[low[0], low[1], 0], [low[0], high[1], 0], [high[0], high[1], 0], [high[0], low[1], 0]])
    degrees = frame.to_geodetic(corners)
    lines, columns = (max(int(np.ceil(width / spacing)), 1) for width in high - low)
    return {
        "EarthModel": "WGS_84",
        "IARP": {
            "ECF": _xyz(frame.origin),
            "LLH": dict(zip(("Lat", "Lon", "HAE"), frame.to_geodetic(np.zeros(3)).tolist(), strict=True)),
        },
        "ReferenceSurface": {"Planar": {"uIAX": _xyz(frame.axes[0]), "uIAY": _xyz(frame.axes[1])}},
        "ImageArea": {
            "X1Y1": _xyz(low), "X2Y2": _xyz(high),
            "Polygon": ({"size": len(area)}, {"Vertex": [({"index": i + 1}, _xyz(p)) for i, p in enumerate(area)]}),
        },
        "ImageAreaCornerPoints": {
            "IACP": [({"index": i + 1}, {"Lat": p[0], "Lon": p[1]}) for i, p in enumerate(degrees)]
        },
        "ImageGrid": {
            "IARPLocation": {"Line": -low[0] / spacing - 0.5, "Sample": -low[1] / spacing - 0.5},
            "IAXExtent": {"LineSpacing": spacing, "FirstLine": 0, "NumLines": lines},
            "IAYExtent": {"SampleSpacing": spacing, "FirstSample": 0, "NumSamples": columns},
        },
    }  # fmt: skip


def _xyz(vector: FloatArray) -> dict[str, Any]:
    return dict(zip("XYZ", vector.tolist(), strict=False))


def _polynomial_element(table: FloatArray) -> tuple[dict[str, Any], dict[str, Any]]:
    used = [({"exponent1": i, "exponent2": j}, table[i, j]) for i, j in zip(*np.nonzero(table), strict=True)]
    zero: list[Any] = [({"exponent1": 0, "exponent2": 0}, 0.0)]
    return {"order1": table.shape[0] - 1, "order2": table.shape[1] - 1}, {"Coef": used or zero}


def _build(parent: Any, content: Any) -> None:
    """Add children {name: content} to an XML element: a list gives several; a pair is attributes and content."""
    if not isinstance(content, dict):
        parent.text = str(content).lower() if isinstance(content, bool) else str(content)
        return
    namespace = parent.tag.partition("}")[0]
    for name, item in content.items():
        for entry in item if isinstance(item, list) else [item]:
            attributes, inner = entry if isinstance(entry, tuple) else ({}, entry)
            node = parent.makeelement(f"{namespace}}}{name}", {key: str(value) for key, value in attributes.items()})
            parent.append(node)
            _build(node, inner)
