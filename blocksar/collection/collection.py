"""Metadata of a collection: radar, axes, track and beam, without samples.

Simulation, planning, focusing and back-projection all compute from a `Collection`. It is frozen, in SI units, and
validated on construction, so that they need not check it again.

Checks of a beam about the antenna's own axis, and of antenna patterns, are part of this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from blocksar.arrays import FloatArray, IntArray, check_axis
from blocksar.collection.raw_echo import RecordedRanges
from blocksar.collection.sampling import TWO_ANTENNAS, Departure, Sampling, departure_of, places_of, sampling_of
from blocksar.collection.spline import smoothed
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.texts import count, frequency_text

MOST_ANGLE = 3.15  # rad: patterns may be known all round
MOST_GAIN = 1e12  # of a pattern's peak, and one over the least

UNIT = 1e-6  # by which the length of a unit vector may be off
COVERED = 1e-9  # rad by which a pattern may fall short of the beam's edge


def check_axis_beam(axis: FloatArray, steering: FloatArray, width: float | None) -> None:
    """Check the antenna's azimuth axis (n, 3), the steering (n,), rad, and the beam's width, rad.

    Raises
    ------
    InputError
        If values are not finite, the axis is no unit vector, the beam reaches the axis, or anything jumps.
    """
    for name, values in (("beam_axis", axis), ("beam_steering", steering)):
        bad = np.flatnonzero(~np.isfinite(values.reshape(steering.size, -1)).all(axis=1))
        if bad.size:
            raise InputError(
                f"{name} is not finite at {bad.size} of {steering.size} pulses (first: pulse {bad[0]}); every pulse "
                "needs it, also a missing one"
            )
    length = np.sqrt((axis * axis).sum(axis=1))
    worst = int(np.abs(length - 1).argmax())
    if abs(length[worst] - 1) > UNIT:
        raise InputError(
            f"beam_axis has a length of {length[worst]:.9g} at pulse {worst}, but must be a unit vector; divide it by "
            "its length"
        )
    if width is None or not 0 < width < np.pi:
        degrees = width is not None and np.pi <= width <= 180
        raise InputError(
            f"beam_width must lie between 0 and pi rad where beam_axis is given, got {width!r}"
            + ("; it looks like degrees" if degrees else "")
        )
    worst = int(np.abs(steering).argmax())
    if abs(steering[worst]) + width / 2 >= np.pi / 2:
        raise InputError(
            f"beam_steering is {steering[worst]:.6g} rad at pulse {worst}: with half of beam_width, {width / 2:.6g} "
            "rad, it must stay below pi / 2 off the plane normal to beam_axis; correct it, or its unit"
        )
    _refuse_jump("beam_axis", np.sqrt((np.diff(axis, axis=0) ** 2).sum(axis=1)), width)
    _refuse_jump("beam_steering", np.abs(np.diff(steering)), width)


def _refuse_jump(name: str, steps: FloatArray, width: float) -> None:
    where = int(steps.argmax())
    if steps[where] > width:
        raise InputError(
            f"{name} jumps by {steps[where]:.6g} rad at pulse {where + 1}, more than beam_width = {width:.6g} rad: "
            "ground between is never lit; cut the collection there"
        )


def check_pattern(name: str, coordinate: str, angle: FloatArray, amplitude: FloatArray) -> None:
    """Check a two-way amplitude over its angles, both (n,).

    Raises
    ------
    InputError
        If shapes disagree, values are not finite, angles do not ascend, or amplitudes are negative, zero throughout or
        of an absurd size.
    """
    if angle.ndim != 1 or angle.size < 2 or amplitude.shape != angle.shape:
        raise InputError(
            f"{name} has shape {amplitude.shape} and {coordinate} has {angle.shape}; give both one value for each of "
            "at least two angles"
        )
    for which, values in ((coordinate, angle), (name, amplitude)):
        if not np.isfinite(values).all():
            wrong = np.count_nonzero(~np.isfinite(values))
            raise InputError(f"{which} is not finite at {wrong} of {values.size} values")
    if np.abs(angle).max() > MOST_ANGLE:
        raise InputError(
            f"{coordinate} runs from {angle.min():.6g} to {angle.max():.6g} rad, more than half a turn away; "
            "correct its unit (it looks like degrees)"
        )
    if not (np.diff(angle) > 0).all():
        raise InputError(f"{coordinate} does not ascend at index {int(np.argmin(np.diff(angle) > 0)) + 1}; sort it")
    if amplitude.min() < 0 or not amplitude.any():
        raise InputError(
            f"{name} runs from {amplitude.min():.6g} to {amplitude.max():.6g}, but is an amplitude: at least 0, and "
            "above 0 somewhere; put the phase into the samples"
        )
    if not 1 / MOST_GAIN <= amplitude.max() <= MOST_GAIN:
        raise InputError(
            f"{name} is {amplitude.max():.6g} at most, which no antenna's amplitude is; give it relative to its "
            "largest value, and divide the samples by that"
        )


def check_cover(name: str, coordinate: str, angle: FloatArray, low: float, high: float, what: str) -> None:
    """Refuse a pattern whose angles (n,) do not cover low .. high, rad."""
    if angle[0] > low + COVERED or angle[-1] < high - COVERED:
        raise InputError(
            f"{name} covers {coordinate} = {angle[0]:.6g} .. {angle[-1]:.6g} rad, but {what} needs {low:.6g} .. "
            f"{high:.6g} rad; give it for all of that"
        )


CARRIERS = (1e6, 1e15)  # Hz: accepted carriers, from below HF radar to beyond visible light
FARTHEST = 1e9  # m: largest coordinate; beyond the moon, and float64 still resolves phase there
TWO_TURNS = 4 * np.pi  # rad: where all beam azimuths are larger, they are taken for degrees
MAX_YAW = 100.0  # rad: likewise where any is larger
GRAZING = 2e-3  # rad: least angle at which the ground is seen, about a tenth of a degree
SPEEDS = (1e-3, 20e3)  # m/s: of platforms, from a carriage on a rail to a satellite on a high orbit
SPIKE = 1.0  # m: a single pulse that deviates more than this from its neighbours is corrupt
BENT = 5.0  # times the usual change of steps from pulse to pulse: a bent track deviates by less at its ends and turns
JUMP = 50.0  # times the median step between pulses: a larger step is a gap between two passes
LEAST_PULSES = 4  # in an interval of a spline that a smooth beam follows
STEADY_PARTS = 16  # intervals of the spline that tells whether a beam wobbles
WOBBLES = 1e-4  # of its width, by which a beam departs from that on average
NOISE_POWERS = 1e-30, 1e30  # that single-precision images can have, besides none
PATTERNS = {"beam_pattern": "beam_offset", "elevation_pattern": "elevation"}  # and their angles
ANTENNAS = ("transmitter_position", "receiver_position")  # of a bistatic collection
OPTIONAL = ("beam_axis", "beam_steering", *PATTERNS, *PATTERNS.values(), *ANTENNAS)  # arrays that may be None


@dataclass(frozen=True, kw_only=True, eq=False)
class Collection:
    """Metadata of one phase history: the contents of `phase_history.zarr` except the samples.

    The signal of a target of reflectivity sigma at range R(t) is

        signal[pulse, f] = sigma exp(-4j pi (carrier + f) / c (R(t_pulse) - reference_range[pulse]))

    while the target is lit, times the antenna's pattern where one is given. Of a bistatic collection R is half the way
    from the transmitter to the target and on to the receiver. There are three kinds of beam, and
    `collection.beam` has the rule for each: one that is described by its yaw (beam_azimuth), one about the antenna's
    own axis (beam_axis and beam_steering), and none, if the beam is not steered.

    Attributes
    ----------
    carrier : float
        fc, Hz.
    time : (n_pulse,) float
        Slow time, s; ascending; t = 0 defines the polar frame.
    range_frequency : (n_range_frequency,) float
        Baseband range frequency, Hz; ascending.
    reference_range : (n_pulse,) float
        Range whose phase was removed, m.
    antenna_position : (n_pulse, 3) float
        Phase centre in the scene frame (x, y, z), m; z up. Of a bistatic collection, whatever is given, the middle
        between transmitter and receiver, about which its polar frame lies; ranges are none from there.
    beam_azimuth : (n_pulse,) float
        Beam-centre yaw, rad; all NaN if the beam is not steered, or has an axis.
    beam_width : float or None
        Full width of the beam, rad: in yaw, or about its axis; None if the beam is not steered.
    ground_height : float
        Height of the imaged plane in the scene frame, m.
    beam_axis : (n_pulse, 3) float or None
        Unit vector along the antenna's azimuth axis, scene frame.
    beam_steering : (n_pulse,) float or None
        Angle of the beam's centre off the plane normal to the axis, rad, positive towards the axis.
    beam_offset, beam_pattern : (n,) float or None
        Two-way amplitude, already in the signal, over the angle off the beam's centre, rad, ascending.
    elevation, elevation_pattern : (n,) float or None
        Two-way amplitude, already in the signal, over the angle of the line of sight below the horizontal, rad.
    noise_power : float or None
        Mean squared magnitude of the noise of a sample of the signal; of a raw echo, of a sample of the echo.
    side_of_track : {"left", "right"} or None
        Which side of its track an antenna with an axis lights, seen along the flight; None: unknown, both are lit.
    lit_width : float or None
        Of a look of a steered beam: the width of the whole beam, whose echoes the samples hold, rad; None: beam_width.
    recorded : RecordedRanges or None
        Of a raw echo: from which ranges it recorded pulses, and which of them are imaged; None: from all in the window.
    transmitter_position, receiver_position : (n_pulse, 3) float or None
        Phase centres of the two antennas of a bistatic collection, m; its beam is not steered, without a pattern.

    Raises
    ------
    InputError
        If an array has the wrong shape, is not finite or implausibly large, an axis does not ascend, a single pulse
        deviates far from its neighbours, the variables of the beam do not agree, or a pattern does not cover it.
    """

    carrier: float
    time: FloatArray
    range_frequency: FloatArray
    reference_range: FloatArray
    antenna_position: FloatArray
    beam_azimuth: FloatArray
    beam_width: float | None = None
    ground_height: float = 0.0
    title: str = ""
    beam_axis: FloatArray | None = None
    beam_steering: FloatArray | None = None
    beam_offset: FloatArray | None = None
    beam_pattern: FloatArray | None = None
    elevation: FloatArray | None = None
    elevation_pattern: FloatArray | None = None
    noise_power: float | None = None
    side_of_track: str | None = None
    lit_width: float | None = None
    recorded: RecordedRanges | None = None
    transmitter_position: FloatArray | None = None
    receiver_position: FloatArray | None = None

    def __post_init__(self) -> None:
        given = [name for name in OPTIONAL if getattr(self, name) is not None]
        if len(alone := [name for name in ANTENNAS if name in given]) == 1:
            (other,) = set(ANTENNAS) - set(alone)
            raise InputError(f"{alone[0]} is given without {other}; a bistatic collection needs both")
        for name in ("time", "range_frequency", "reference_range", "antenna_position", "beam_azimuth", *given):
            try:
                array = np.array(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError):
                raise InputError(f"{name} must be an array of real numbers") from None
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        check_axis(self.time, "time", "s", uneven=True)
        check_axis(self.range_frequency, "range_frequency", "Hz", uneven=True)
        n = self.time.size
        if self.transmitter_position is not None and self.receiver_position is not None:
            for name in ANTENNAS:
                self._check_shape(name, (n, 3))
            middle = (self.transmitter_position + self.receiver_position) / 2
            middle.flags.writeable = False
            object.__setattr__(self, "antenna_position", middle)
        self._check_shape("reference_range", (n,))
        self._check_shape("antenna_position", (n, 3))
        self._check_shape("beam_azimuth", (n,))
        for name in ("reference_range", *self.antennas):
            bad = np.flatnonzero(~np.isfinite(getattr(self, name).reshape(n, -1)).all(axis=1))
            if bad.size:
                raise InputError(
                    f"{name} is not finite at {bad.size} of {n} pulses (first: pulse {bad[0]}); "
                    "every pulse needs a position and a reference range, also a missing one"
                )
            self._check_size(name, "m", FARTHEST)
            self._check_spikes(name)
        ways = {name: np.linalg.norm(np.diff(getattr(self, name), axis=0), axis=1) for name in self.antennas}
        for name, way in ways.items():
            self._check_jumps(name, way)
        self._check_speed(*max(ways.items(), key=lambda each: float(each[1].sum())))
        self._check_band()
        self._check_cells()
        if not np.isfinite(self.ground_height):
            raise InputError(f"ground_height must be a finite number of m, got {self.ground_height!r}")
        for name in self.antennas:
            if (lowest := np.min(getattr(self, name)[:, 2])) <= self.ground_height:
                raise InputError(
                    f"{name} falls to z = {lowest:.6g} m, not above ground_height = {self.ground_height:.6g} m; z "
                    "must point up"
                )
        self._check_grazing()
        self._check_beam()
        self._check_patterns()

    def _check_shape(self, name: str, shape: tuple[int, ...]) -> None:
        array = getattr(self, name)
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}, but the collection needs {shape}")

    def _check_size(self, name: str, unit: str, largest: float) -> None:
        array = getattr(self, name)
        with np.errstate(invalid="ignore"):
            worst = float(np.nanmax(np.abs(array)))
        if worst > largest:
            raise InputError(
                f"{name} reaches {worst:.6g} {unit}, beyond the {largest:g} {unit} that can be meant; correct it, or "
                "its unit"
            )

    def _check_spikes(self, name: str) -> None:
        """Refuse a pulse far off both neighbours: steps and noise may be meant, a single pulse elsewhere is not."""
        values = getattr(self, name).reshape(self.n_pulse, -1)
        # Beyond either end, what its two neighbours lead one to expect.
        steps = np.diff(self.time)
        before = np.concatenate([values[1:2] - (values[2:3] - values[1:2]) * (steps[0] / steps[1]), values[:-1]])
        after = np.concatenate([values[1:], values[-2:-1] + (values[-2:-1] - values[-3:-2]) * (steps[-1] / steps[-2])])
        median = np.maximum(np.minimum(before, after), np.minimum(np.maximum(before, after), values))
        off = np.abs(values - median).max(axis=1)
        where = int(off.argmax())
        bend = float(np.median(np.abs(np.diff(values, 2, axis=0)).max(axis=1)))
        if off[where] > max(SPIKE, 50 * float(np.quantile(off, 0.9)), BENT * bend):
            raise InputError(
                f"{name} leaves its neighbours by {off[where]:.6g} m at pulse {where} alone; correct it there, and "
                "write the pulse's samples as NaN if they are in doubt"
            )

    def _check_jumps(self, name: str, way: FloatArray) -> None:
        """Refuse a track with a jump, as two passes joined into one collection have; way between pulses (n - 1,), m.

        Not the rows of a raster, which are as long as each other, nor the way that is flown in a gap of time.
        """
        usual, where = float(np.median(way)), int(way.argmax())
        steps = 1.0 if self.pulses.even else np.maximum(np.diff(self.time) / self.pulses.step, 1.0)
        jumps = np.flatnonzero(way > np.maximum(SPIKE, JUMP * usual * steps))
        if jumps.size == 1 or (jumps.size and np.ptp(np.diff([-1, *jumps, way.size])) > 1):
            raise InputError(
                f"{name} moves {way[where]:.6g} m from pulse {where} to {where + 1}, and {usual:.3g} m "
                "between pulses otherwise; correct it there, or give each part as a collection of its own"
            )

    def _check_speed(self, name: str, way: FloatArray) -> None:
        speed = float(way.sum() / (self.time[-1] - self.time[0]))
        if speed > SPEEDS[1]:
            raise InputError(
                f"{name} moves at {speed:.6g} m/s, but platforms move at up to {SPEEDS[1]:g} m/s: correct "
                f"the unit of {name} (m) or of time (s)"
            )
        if speed < SPEEDS[0]:
            raise InputError(
                f"{name} moves at {speed:.6g} m/s, but an aperture needs at least {SPEEDS[0]:g} m/s: correct "
                f"the unit of {name} (it looks like km) or of time (it looks like ms, us or pulse numbers)"
            )

    def _check_band(self) -> None:
        if not (np.isfinite(self.carrier) and self.carrier > 0):
            raise InputError(f"carrier_frequency must be a positive number of Hz, got {self.carrier!r}")
        if not CARRIERS[0] <= self.carrier <= CARRIERS[1]:
            unit = " (it looks like GHz or MHz)" if self.carrier < CARRIERS[0] else ""
            raise InputError(
                f"carrier_frequency is {self.carrier:.6g} Hz, but must lie between {CARRIERS[0]:g} and "
                f"{CARRIERS[1]:g} Hz; correct it, or its unit{unit}"
            )
        self._check_size("range_frequency", "Hz", CARRIERS[1])
        if self.range_window > FARTHEST:
            raise InputError(
                f"range_frequency is spaced by {self.range_frequency_step:.3g} Hz, for a range window of "
                f"{self.range_window:.3g} m, beyond the {FARTHEST:g} m that can be meant; correct it, or its unit"
            )
        if self.carrier + self.range_frequency[0] <= 0:
            raise InputError(
                f"range_frequency starts at {self.range_frequency[0]:.6g} Hz, below minus the carrier "
                f"({self.carrier:.6g} Hz); it must be baseband, relative to carrier_frequency"
            )
        low, high = self.range_frequency[[0, -1]]
        if low > self.carrier / 2 or 0 < low <= self.carrier <= high:
            raise InputError(
                f"range_frequency is {low:.6g} .. {high:.6g} Hz with carrier_frequency = {self.carrier:.6g} Hz: it "
                "looks absolute; subtract the carrier"
            )

    def _check_cells(self) -> None:
        cell, distance = SPEED_OF_LIGHT / (2 * self.bandwidth), float(np.median(self.reference_range))
        if 0 < distance < cell:
            raise InputError(
                f"range_frequency is {self.range_frequency[0]:.6g} .. {self.range_frequency[-1]:.6g} Hz, for range "
                f"cells of {cell:.3g} m at a range of {distance:.6g} m; correct its unit (it looks like MHz), or that "
                "of reference_range (m)"
            )

    def _check_grazing(self) -> None:
        height = float(np.median(self.antenna_position[:, 2])) - self.ground_height
        distance = float(np.median(self.reference_range))
        if 0 < height < GRAZING * distance:
            raise InputError(
                f"antenna_position lies {height:.6g} m above the ground, which a range of {distance:.6g} m would reach "
                f"at {np.degrees(height / distance):.2g} degrees: correct the unit of antenna_position (it looks like "
                "km), or ground_height"
            )

    def _check_beam(self) -> None:
        if self.bistatic:
            given = [name for name in ("beam_axis", "beam_steering", *PATTERNS) if getattr(self, name) is not None]
            if self.beam_width is not None or given or not np.isnan(self.beam_azimuth).all():
                raise InputError(
                    f"{given[0] if given else 'beam_azimuth'} is given with transmitter_position: of a bistatic "
                    "collection no beam is known to which both antennas keep; leave the beam and its patterns out"
                )
            return
        if self.beam_axis is None and self.beam_steering is None:
            self._check_yaw_beam()
        else:
            self._check_axis_beam()

    def _check_yaw_beam(self) -> None:
        finite = np.isfinite(self.beam_azimuth)
        if not finite.any():
            if self.beam_width is not None:
                raise InputError(
                    f"beam_width is {self.beam_width:.6g} rad but beam_azimuth is NaN throughout; give the "
                    "beam's yaw, or leave out beam_width for a beam that is not steered"
                )
            return
        if not finite.all():
            raise InputError(
                f"beam_azimuth is NaN at {np.count_nonzero(~finite)} of {finite.size} pulses; give it for "
                "every pulse, or NaN for all of them if the beam is not steered"
            )
        if self.beam_width is None or not 0 < self.beam_width < np.pi:
            degrees = self.beam_width is not None and np.pi <= self.beam_width <= 180
            raise InputError(
                f"beam_width must lie between 0 and pi rad where beam_azimuth is given, got {self.beam_width!r}"
                + ("; it looks like degrees" if degrees else "")
            )
        least = float(np.abs(self.beam_azimuth).min())
        if least > TWO_TURNS:
            raise InputError(
                f"beam_azimuth is {self.beam_azimuth[0]:.6g} .. {self.beam_azimuth[-1]:.6g} rad, more than two turns "
                "throughout" + ("; it looks like degrees" if least <= 360 else "; correct it, or its unit")
            )
        self._check_size("beam_azimuth", "rad", MAX_YAW)
        azimuth = np.unwrap(self.beam_azimuth)
        azimuth.flags.writeable = False
        object.__setattr__(self, "beam_azimuth", azimuth)
        steps = np.diff(azimuth)
        if not ((steps >= 0).all() or (steps <= 0).all()):
            raise InputError(
                "beam_azimuth turns back at pulse "
                f"{int(np.argmax(np.sign(steps) != np.sign(azimuth[-1] - azimuth[0]))) + 1}: the beam must scan "
                "one way; cut the collection there"
            )
        if np.abs(steps).max() > self.beam_width:
            where = int(np.abs(steps).argmax()) + 1
            raise InputError(
                f"beam_azimuth jumps by {abs(steps[where - 1]):.6g} rad at pulse {where}, more than beam_width = "
                f"{self.beam_width:.6g} rad: yaws between are never lit; cut the collection there"
            )

    def _check_axis_beam(self) -> None:
        if self.beam_axis is None or self.beam_steering is None:
            given, missing = ("steering", "axis") if self.beam_axis is None else ("axis", "steering")
            raise InputError(f"beam_{given} is given without beam_{missing}; a beam about its axis needs both")
        if not np.isnan(self.beam_azimuth).all():
            raise InputError(
                "beam_azimuth and beam_axis are both given, but describe two kinds of beam; leave out beam_azimuth for "
                "an antenna that turns about itself, beam_axis and beam_steering otherwise"
            )
        self._check_shape("beam_axis", (self.n_pulse, 3))
        self._check_shape("beam_steering", (self.n_pulse,))
        check_axis_beam(self.beam_axis, self.beam_steering, self.beam_width)

    def _check_patterns(self) -> None:
        least, most = NOISE_POWERS
        if self.noise_power is not None and not (self.noise_power == 0 or least <= self.noise_power <= most):
            raise InputError(f"noise_power must be 0 or between {least:g} and {most:g}, got {self.noise_power!r}")
        if self.side_of_track not in (None, "left", "right"):
            raise InputError(f"side_of_track is {self.side_of_track!r}; it must be 'left' or 'right', or absent")
        for name, coordinate in PATTERNS.items():
            angle, amplitude = getattr(self, coordinate), getattr(self, name)
            if angle is None and amplitude is None:
                continue
            if angle is None or amplitude is None:
                given, missing = (name, coordinate) if angle is None else (coordinate, name)
                raise InputError(f"{given} is given without {missing}; a pattern needs its angles and its amplitudes")
            check_pattern(name, coordinate, angle, amplitude)
        if self.beam_offset is not None:
            if self.beam_width is None:
                raise InputError(
                    "beam_pattern is given, but neither beam_azimuth nor beam_axis; say where the beam points, or "
                    "leave the pattern out"
                )
            half = self.beam_width / 2
            check_cover("beam_pattern", "beam_offset", self.beam_offset, -half, half, "the beam")
        if self.elevation is not None:
            middle = self.n_pulse // 2
            height = float(self.antenna_position[middle, 2] - self.ground_height)
            if (distance := float(self.reference_range[middle])) > height:
                down = float(np.arcsin(height / distance))
                check_cover(
                    "elevation_pattern", "elevation", self.elevation, down, down, "ground at reference_range"
                )  # fmt: skip

    def __repr__(self) -> str:
        return f"<Collection: {self.headline()}>"

    def headline(self) -> str:
        """Summary of the collection on one line: size, band, rate and beam."""
        beam = "not steered" if not self.steered else "about its axis" if self.has_axis else "steered in yaw"
        return (
            f"{self.n_pulse} pulses x {self.n_range_frequency} range frequencies, {frequency_text(self.carrier)}, "
            f"{frequency_text(self.bandwidth)}, {self.rate_text}, "
            f"{'bistatic' if self.bistatic else f'beam {beam}'}"
        )

    @property
    def n_pulse(self) -> int:
        return int(self.time.size)

    @property
    def n_range_frequency(self) -> int:
        return int(self.range_frequency.size)

    @property
    def steered(self) -> bool:
        """Tell whether the beam is steered, so that a target may be lit for part of the time only."""
        return self.beam_width is not None

    @property
    def bistatic(self) -> bool:
        """Whether transmitter and receiver are two antennas."""
        return self.transmitter_position is not None

    @property
    def half_baseline(self) -> float:
        """Half the largest distance of two antennas, m: R exceeds the range from their middle by less. 0 of one."""
        if self.transmitter_position is None or self.receiver_position is None:
            return 0.0
        return float(np.linalg.norm(self.transmitter_position - self.receiver_position, axis=1).max()) / 2

    @property
    def two_antennas(self) -> list[Departure]:
        """The departure from one antenna of a bistatic collection; else none."""
        return [TWO_ANTENNAS] if self.bistatic else []

    @property
    def antennas(self) -> tuple[str, ...]:
        """The fields with the phase centres of the antennas: one, or transmitter and receiver."""
        return ANTENNAS if self.bistatic else ("antenna_position",)

    def distances(self, points: FloatArray, pulses: slice | IntArray = slice(None)) -> FloatArray:
        """R of points (..., 3), m, at pulses, with which they are broadcast."""
        ways = [np.linalg.norm(points - getattr(self, name)[pulses], axis=-1) for name in self.antennas]
        return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)

    @property
    def has_axis(self) -> bool:
        """Whether the beam is described by the antenna's own axis."""
        return self.beam_axis is not None

    @property
    def pointing(self) -> Literal["beam_azimuth", "beam_steering"]:
        """The field with the angle of the beam's centre at each pulse."""
        return "beam_steering" if self.has_axis else "beam_azimuth"

    @property
    def has_pattern(self) -> bool:
        """Tell whether the signal contains a known antenna pattern."""
        return self.beam_pattern is not None or self.elevation_pattern is not None

    @property
    def peak_gain(self) -> float:
        """The largest two-way amplitude of the antenna's pattern over the beam; 1 without one."""
        return 1.0 if self.beam_pattern is None else float(self.beam_pattern.max())

    @cached_property
    def without_elevation(self) -> Collection:
        """Copy of the collection without the antenna's pattern in elevation."""
        if self.elevation_pattern is None:
            return self
        return Collection(**{**self.as_dict(), "elevation": None, "elevation_pattern": None})

    @cached_property
    def pulses(self) -> Sampling:
        """Sampling of slow time."""
        return sampling_of(self.time)

    @cached_property
    def band(self) -> Sampling:
        """Sampling of the band."""
        return sampling_of(self.range_frequency)

    @property
    def even(self) -> bool:
        """Whether pulses and range frequencies are uniform."""
        return self.pulses.even and self.band.even

    @property
    def departures(self) -> list[Departure]:
        """Departures from one antenna, and from uniform slow time and range frequencies."""
        axes = ("time", self.time, self.pulses), ("range_frequency", self.range_frequency, self.band)
        uneven = [departure_of(*axis) for axis in axes if not axis[-1].even]
        return [*self.two_antennas, *uneven]

    def pulse_place(self, time: FloatArray) -> FloatArray:
        """Number of the pulse, with fractions, at slow times (...), s."""
        return (time - self.time[0]) * self.prf if self.pulses.even else places_of(time, self.time)

    @property
    def pulse_interval(self) -> float:
        """Time between pulses, s; where it is not the same, see `Sampling.step`."""
        return self.pulses.step

    @property
    def prf(self) -> float:
        return 1.0 / self.pulse_interval

    @property
    def duration(self) -> float:
        """Time that the pulses stand for, s: half a step more than from the first to the last, at either end."""
        even = self.n_pulse / self.prf
        return even if self.pulses.even else float(self.time[-1] - self.time[0]) + self.pulse_interval

    @property
    def rate_text(self) -> str:
        """The PRF in words."""
        text = f"PRF {self.prf:.6g} Hz"
        if self.pulses.lacking:
            return f"{text}, {count(self.pulses.lacking, 'pulse')} cut out"
        if self.pulses.even:
            return text
        low, high = np.quantile(np.diff(self.time), (0, 1))
        return f"{text} on average, pulses {1e3 * low:.4g} .. {1e3 * high:.4g} ms apart"

    @property
    def range_frequency_step(self) -> float:
        """Step between range frequencies, Hz; where it is not the same, see `Sampling.step`."""
        return self.band.step

    @property
    def n_band(self) -> int:
        """Steps that cover the band: of uniform range frequencies their number."""
        return self.n_range_frequency if self.band.even else math.ceil(self.bandwidth / self.band.step - 1e-6)

    @property
    def bandwidth(self) -> float:
        """Band in which each sample is the midpoint of one step, Hz; half a step beyond the ends if they are uneven."""
        if self.band.even:
            return self.range_frequency_step * self.n_range_frequency
        return float(self.range_frequency[-1] - self.range_frequency[0]) + self.band.step

    @property
    def range_window(self) -> float:
        """Unambiguous range interval, c / (2 step), m."""
        return SPEED_OF_LIGHT / (2 * self.range_frequency_step)

    @property
    def wavelength(self) -> float:
        return SPEED_OF_LIGHT / self.carrier

    def centred(self) -> Collection:
        """Copy of the collection with its carrier in the middle of the band, as processing requires.

        The signal depends on carrier + range_frequency only, so the samples stay as they are.
        """
        middle = float(self.range_frequency[0] + self.range_frequency[-1]) / 2
        moved = {"carrier": self.carrier + middle, "range_frequency": self.range_frequency - middle}
        return Collection(**{**self.as_dict(), **moved})

    def segment(self, first: int, last: int) -> Collection:
        """The pulses first <= p < last, with t = 0 at their middle pulse, about which their polar frame then lies.

        Not for a beam that is described by its yaw, which refers to the frame of the whole collection.
        """
        assert self.has_axis or not self.steered
        by_pulse = ("reference_range", "antenna_position", "beam_azimuth", "beam_axis", "beam_steering", *ANTENNAS)
        cut = {name: value[first:last] for name in by_pulse if (value := getattr(self, name)) is not None}
        time = self.time[first:last] - self.time[first + (last - first) // 2]
        return Collection(**{**self.as_dict(), **cut, "time": time})

    def steadied(self, n_interval: int) -> Collection:
        """Copy whose steered beam follows cubic splines of `n_interval` intervals; with 0, straight lines.

        Itself where its pulses are too few for that, or a yaw would turn back or stand still.
        """
        if n_interval * LEAST_PULSES > self.n_pulse:
            return self
        if self.beam_axis is not None and self.beam_steering is not None:
            axis = smoothed(self.time, self.beam_axis, n_interval)
            axis /= np.sqrt((axis * axis).sum(axis=1, keepdims=True))
            steering = smoothed(self.time, self.beam_steering[:, None], n_interval)[:, 0]
            return Collection(**{**self.as_dict(), "beam_axis": axis, "beam_steering": steering})
        azimuth = smoothed(self.time, self.beam_azimuth[:, None], n_interval)[:, 0]
        steps = np.diff(azimuth)
        if not ((steps > 0).all() or (steps < 0).all()):
            return self
        return Collection(**{**self.as_dict(), "beam_azimuth": azimuth})

    @cached_property
    def unevenness(self) -> float:
        """The most by which the beam's yaw departs from an even scan, rad; infinite for a beam about its axis."""
        if not self.steered:
            return 0.0
        azimuth = self.beam_azimuth[:, None]
        return math.inf if self.has_axis else float(np.abs(azimuth - smoothed(self.time, azimuth, 0)).max())

    @cached_property
    def steady(self) -> Collection:
        """Copy whose beam about its axis is smooth over 1 / STEADY_PARTS of the collection.

        The same collection where they lie next to nothing apart.
        """
        assert self.beam_axis is not None and self.beam_steering is not None and self.beam_width is not None
        steady = self.steadied(STEADY_PARTS)
        assert steady.beam_axis is not None and steady.beam_steering is not None
        turned = np.sqrt(((self.beam_axis - steady.beam_axis) ** 2).sum(axis=1))
        leaning = np.maximum(np.abs(self.beam_steering), np.abs(steady.beam_steering)).max() + self.beam_width / 2
        apart = np.abs(self.beam_steering - steady.beam_steering) + 1.1 * turned / max(float(np.cos(leaning)), 1e-3)
        return steady if apart.mean() > WOBBLES * self.beam_width else self

    def unsteered(self) -> Collection:
        """Copy of the collection under a beam that lights everything all the time."""
        beam = ("beam_width", "beam_axis", "beam_steering", "beam_offset", "beam_pattern")
        nowhere = {"beam_azimuth": np.full(self.n_pulse, np.nan)}
        return Collection(**{**self.as_dict(), **dict.fromkeys(beam), **nowhere})

    @property
    def lit_widths(self) -> float:
        """Width over which the samples hold echoes, in beam widths: 1, or for a look whole beam over look."""
        return 1.0 if self.lit_width is None or self.beam_width is None else self.lit_width / self.beam_width

    def as_dict(self) -> dict[str, Any]:
        """The fields by name, usable as keyword arguments of `Collection`."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}
