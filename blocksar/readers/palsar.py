"""Raw echoes of ALOS PALSAR, CEOS level 1.0: a folder with a leader (LED) and an image file (IMG) a polarisation.

Records and fields are those of the product format description (JAXA) for level 1.0; names are the format's. Public
readers (isce3, GMTSAR) agree on what it leaves open: a line's time is that of its first sample's reception, cut to
whole milliseconds, which a counter of microseconds in its auxiliary data (24 bits, from byte 296) makes finer; the
pulse is a down-chirp; a sample's zero is the leader's DC bias. GMTSAR's own calibration, 2.08 ms earlier for the
positions, is what milliseconds alone give: half a way of 2.85 ms, less the half millisecond that cutting takes off.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import texts
from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, MissingInput, quoted
from blocksar.places.local import LocalPlace
from blocksar.places.ranges import Readable
from blocksar.readers.kinds import ECHOES, Kind, Start, begins, ceos
from blocksar.readers.orbit import Antenna, Orbit, inertial
from blocksar.readers.reading import reading
from blocksar.readers.registry import found_at, refuse_few
from blocksar.readers.strips import LEAST, Even, RawStrip, StripOptions, StripReader, common_window, even_pulses

# ---------------------------------------------------------------- records

DESCRIPTOR = 720  # bytes: the first record of an image file
PREFIX = 412  # bytes of a line before its samples

# Codes of a leader's records, first and second.
SUMMARY, PLATFORM, ATTITUDE, CALIBRATION = b"\x12\x0a", b"\x12\x1e", b"\x12\x28", b"\x12\x78"


class Slot(NamedTuple):
    """Position of a field in its record: first byte, from 0, and length."""

    first: int
    length: int


SUMMARY_FIELDS = {
    "scene identifier": Slot(20, 32), "number of SAR channels": Slot(388, 4), "mission": Slot(396, 16),
    "sensor and mode": Slot(412, 32), "clock angle": Slot(476, 8), "wavelength": Slot(500, 16),
    "linear coefficient of the pulse": Slot(550, 16), "sampling rate": Slot(710, 16), "range gate": Slot(726, 16),
    "pulse length": Slot(742, 16), "DC bias of I": Slot(818, 16), "DC bias of Q": Slot(834, 16),
    "level": Slot(1094, 16),
}  # fmt: skip
PLATFORM_FIELDS = {
    "number of points": Slot(140, 4), "year": Slot(144, 4), "month": Slot(148, 4), "day": Slot(152, 4),
    "seconds of the day": Slot(160, 22), "interval": Slot(182, 22), "coordinate system": Slot(204, 64),
}  # fmt: skip
STATES, STATE = 386, 22  # of the platform: first byte, and bytes of a number
ATTITUDES, ATTITUDE_LENGTH = 16, 120
BANDWIDTH = Slot(64, 4)  # MHz, of the calibration record
# Numbers before a line's samples, big-endian, by their first byte.
LINE = {
    "code": (4, ">u4"), "length": (8, ">i4"), "number": (12, ">i4"), "left fill": (20, ">i4"), "pixels": (24, ">i4"),
    "right fill": (28, ">i4"), "year": (36, ">i4"), "day of year": (40, ">i4"), "milliseconds": (44, ">i4"),
    "transmitted": (52, ">i2"), "received": (54, ">i2"), "PRF": (56, ">i4"), "scan": (60, ">i4"),
    "compressed": (64, ">i2"), "pulse length": (68, ">i4"), "linear coefficient": (76, ">i4"), "nought": (96, ">i4"),
    "slant range": (116, ">i4"), "window position": (120, ">i4"), "counter": (296, ">u4"),
}  # fmt: skip
LINE_CODE = 0x320A1214


def text_of(record: bytes, place: Slot) -> str:
    return record[place.first : place.first + place.length].decode("latin-1").strip(" \0")


def number_of(record: bytes, place: Slot, name: str) -> float:
    """Read a number written as text by Fortran.

    Raises
    ------
    InputError
        If it is none.
    """
    text = text_of(record, place)
    try:
        value = float(text.upper().replace("D", "E"))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"the leader's {name} is {quoted(text)}, no number; get the file again")
    return value


def records_of(data: bytes) -> dict[bytes, bytes]:
    """Divide a leader into records; the first of each kind, by two codes.

    Raises
    ------
    InputError
        If it ends within one.
    """
    found: dict[bytes, bytes] = {}
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at + 8)
        if length < 12 or at + length > len(data):
            raise InputError(f"ends after {len(data)} bytes, within a record of {length} from byte {at}; get it again")
        found.setdefault(data[at + 4 : at + 6], data[at : at + length])
        at += length
    return found


def lines_dtype(length: int) -> np.dtype[Any]:
    """Layout of a line of `length` bytes: header numbers and samples."""
    samples = ("samples", (PREFIX, np.dtype(("u1", (length - PREFIX,)))))
    fields = {**LINE, samples[0]: samples[1]}
    return np.dtype({
        "names": list(fields), "offsets": [first for first, _ in fields.values()],
        "formats": [kind for _, kind in fields.values()], "itemsize": length,
    })  # fmt: skip


# ---------------------------------------------------------------- the leader


@dataclass(frozen=True, kw_only=True, eq=False)
class Leader:
    """Leader file: orbit, attitude and radar of a scene.

    Attributes
    ----------
    records : dict
        By two codes.
    """

    records: dict[bytes, bytes]

    @classmethod
    def parse(cls, data: bytes) -> Leader:
        """Parse a leader; raises an InputError if it is truncated, lacks radar or orbit, or is of another sensor."""
        leader = cls(records=records_of(data))
        for code, name in ((SUMMARY, "data set summary"), (PLATFORM, "platform positions")):
            if code not in leader.records:
                raise InputError(f"has no record of {name}; get it again")
        if (mission := leader.text("mission")) != "ALOS":
            raise InputError(f"is of the mission {quoted(mission)}; only level 1.0 of ALOS PALSAR is read; {ECHOES}")
        return leader

    def text(self, name: str) -> str:
        return text_of(self.records[SUMMARY], SUMMARY_FIELDS[name])

    def number(self, name: str) -> float:
        return number_of(self.records[SUMMARY], SUMMARY_FIELDS[name], name)

    def known(self, name: str) -> float:
        """Read a number that may be missing; 0 then."""
        try:
            return self.number(name)
        except InputError:
            return 0.0

    @property
    def carrier(self) -> float:
        """Carrier frequency, Hz."""
        if not (wavelength := self.number("wavelength")) > 0:
            raise InputError(f"the leader's wavelength is {wavelength:g} m; get the file again")
        return SPEED_OF_LIGHT / wavelength

    @property
    def side(self) -> str:
        return "left" if self.known("clock angle") < 0 else "right"

    @property
    def bandwidth(self) -> float:
        """Bandwidth, Hz; 0 if not stated."""
        record = self.records.get(CALIBRATION)
        if record is None:
            return 0.0
        try:
            return 1e6 * number_of(record, BANDWIDTH, "bandwidth")
        except InputError:
            return 0.0

    def orbit(self, epoch: datetime) -> Orbit:
        """Read the orbit's states at seconds after an epoch.

        Raises
        ------
        InputError
            If they are not Earth-centred, or wrong.
        """
        record = self.records[PLATFORM]

        def number(name: str) -> float:
            return number_of(record, PLATFORM_FIELDS[name], name)

        system = text_of(record, PLATFORM_FIELDS["coordinate system"]).upper()
        if "ECI" in system or "INERTIAL" in system:
            raise InputError(f"the leader's orbit is in {quoted(system)}; it must turn with the Earth (ECR)")
        count = int(number("number of points"))
        if not 2 <= count <= (len(record) - STATES) // (6 * STATE):
            raise InputError(f"the leader's orbit has {count} states, which its record does not hold; get it again")
        try:
            day = datetime(int(number("year")), int(number("month")), int(number("day")), tzinfo=UTC)
        except ValueError:
            raise InputError("the leader's orbit has no date; get the file again") from None
        states = np.array(
            [number_of(record, Slot(STATES + STATE * k, STATE), f"state {k // 6 + 1}") for k in range(6 * count)]
        ).reshape(count, 6)
        first = (day - epoch).total_seconds() + number("seconds of the day")
        time = first + number("interval") * np.arange(count)
        return Orbit(time=np.asarray(time, np.float64), position=states[:, :3], velocity=states[:, 3:])

    def antenna(self, epoch: datetime, orbit: Orbit) -> Antenna | None:
        """Azimuth axis of the antenna: the body's long axis by yaw, pitch and roll relative to the inertial flight."""
        record = self.records.get(ATTITUDE)
        if record is None:
            return None
        try:
            count = int(number_of(record, Slot(12, 4), "number of attitudes"))
            rows = np.array([_attitude(record, k) for k in range(count)]).reshape(count, 4)
        except InputError:
            return None
        year = datetime(epoch.year, 1, 1, tzinfo=UTC)
        time = rows[:, 0] - (epoch - year) / timedelta(seconds=1)
        inside = (time >= orbit.time[0]) & (time <= orbit.time[-1]) & (np.diff(time, prepend=-np.inf) > 0)
        time, (pitch, yaw) = time[inside], rows[inside, 1:3].T
        if time.size < 2:
            return None
        position, velocity = orbit.at(time)
        flight = inertial(position, velocity)
        down = -position / np.linalg.norm(position, axis=1, keepdims=True)
        right = np.cross(down, flight)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        ahead = np.cross(right, down)
        parts: tuple[FloatArray, ...] = (np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch))
        axis = sum(part[:, None] * unit for part, unit in zip(parts, (ahead, right, down), strict=True))
        return Antenna(time=time, axis=np.asarray(axis))


def _attitude(record: bytes, number: int) -> tuple[float, float, float, float]:
    """Read an attitude: seconds of the year, then pitch, yaw and roll, rad."""
    at = ATTITUDES + ATTITUDE_LENGTH * number
    day, milliseconds = (number_of(record, Slot(at + first, n), "time of attitude") for first, n in ((0, 4), (4, 8)))
    pitch, roll, yaw = (number_of(record, Slot(at + 24 + 14 * k, 14), "attitude") for k in range(3))
    return 86400 * (day - 1) + milliseconds / 1000, *np.radians([pitch, yaw, roll]).tolist()


# ---------------------------------------------------------------- image files

LENGTH = 8.9  # m, of the antenna along the track
MOST_LEADER = 1 << 24  # bytes
LEADER = begins(b"\x0b\xc0\x12\x12", at=4)
MILLI, MICRO = 1e-3, 1e-6


@contextmanager
def reading_file(path: Readable) -> Iterator[None]:
    with reading(path, damaged="damaged, or no CEOS file of level 1.0", remedy="get it again"):
        yield


class Files(NamedTuple):
    """Leader and image files of a scene."""

    leader: LocalPlace
    images: list[LocalPlace]


def find_files(sources: Sequence[Readable]) -> Files:
    """Find a scene's files by their first bytes, in a folder or among given files.

    Raises
    ------
    InputError
        If they are not those of one scene.
    """
    local = [each for each in sources if isinstance(each, LocalPlace)]
    if len(local) < len(sources):
        raise InputError(f"{sources[0]} is on a server; copy the files of the scene to a local folder first")
    for each in local:
        if not each.path.exists():
            raise MissingInput(f"{each} does not exist; check the path")
    # One file alone stands for the folder that it lies in.
    given = [LocalPlace(local[0].path.parent)] if len(local) == 1 and not local[0].path.is_dir() else local
    files = [
        part for each in given for part in ([each / name for name in each.names()] if each.path.is_dir() else [each])
    ]
    leaders, images = [], []
    for file in files:
        if file.path.is_file():
            with reading_file(file), file.open() as stream:
                start = Start(file.name, stream.read(DESCRIPTOR + PREFIX), whole=False)
            if LEADER(start):
                leaders.append(file)
            elif ceos(start, b"\x32\x0a"):
                images.append(file)
    where = local[0] if len(local) == 1 else f"{local[0]} and others"
    if not images:
        if len(local) == 1 and local[0].path.is_file() and (found := found_at(local[0])) is not None:
            raise InputError(found.sentence(local[0]))
        raise InputError(
            f"{where}: no CEOS file of raw echoes (IMG-HH-...) is there; give the folder of a scene of level 1.0"
        )
    if len(leaders) != 1:
        raise InputError(
            f"{where}: {len(leaders)} leaders (LED-...) are there; give the files of one scene, with its leader"
        )
    return Files(leaders[0], sorted(images, key=lambda image: image.name))


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """Image file: the lines of one polarisation.

    Attributes
    ----------
    path : LocalPlace
    length : int
        Bytes of a line.
    count : int
        Of lines.
    unsigned : bool
        Whether samples are.
    """

    path: LocalPlace
    length: int
    count: int
    unsigned: bool

    @classmethod
    def open(cls, path: LocalPlace) -> Image:
        """Open an image file; raises an InputError if it is truncated or not one of lines."""
        with reading_file(path), path.open() as stream:
            head = stream.read(DESCRIPTOR + PREFIX)
            if len(head) < DESCRIPTOR + PREFIX or not ceos(Start(path.name, head, whole=False), b"\x32\x0a"):
                raise InputError("ends before its first line, or has no CEOS descriptor; get it again")
            length = int.from_bytes(head[DESCRIPTOR + 8 : DESCRIPTOR + 12], "big")
            count = head[180:186].decode("latin-1").strip()
            size = path.path.stat().st_size - DESCRIPTOR
            if length < PREFIX + 16 or length > 1 << 20:
                raise InputError(f"has lines of {length} bytes, which cannot be; get it again")
            if size % length or (count.isdigit() and int(count) != size // length):
                raise InputError(
                    f"has {size / length:.6g} lines of {length} bytes, but should have {count or 'some'}; get it again"
                )
            unsigned = head[428:432].decode("latin-1").strip().upper() in ("CIU1", "UI*1", "CIU*")
            return cls(path=path, length=length, count=size // length, unsigned=unsigned)

    @property
    def lines(self) -> Any:
        """All lines as they are stored."""
        return np.memmap(self.path.path, lines_dtype(self.length), "r", DESCRIPTOR, (self.count,))

    @cached_property
    def fields(self) -> dict[str, NDArray[np.int64]]:
        """Header numbers of the lines, (count,) each."""
        lines = self.lines
        return {name: lines[name].astype(np.int64) for name in lines.dtype.names if name != "samples"}

    @property
    def polarization(self) -> str:
        codes = self.fields["transmitted"][0], self.fields["received"][0]
        if not set(codes) <= {0, 1}:
            raise InputError(f"{self.path}: polarisations are coded {codes[0]} and {codes[1]}, not 0 (H) or 1 (V); "
                             "get it again")  # fmt: skip
        return "".join("HV"[code] for code in codes)

    def check(self) -> None:
        """Refuse lines that are damaged or not from strip mode."""
        fields = self.fields
        wrong = np.flatnonzero((fields["code"] != LINE_CODE) | (fields["length"] != self.length))
        if wrong.size:
            raise InputError(f"{self.path}: line {wrong[0] + 1} of {self.count} begins with no record of its length; "
                             "get it again")  # fmt: skip
        if fields["scan"].any():
            raise InputError(f"{self.path}: it is of ScanSAR, whose bursts are not read; give a strip (FBS, FBD, PLR)")
        if fields["compressed"].any():
            raise InputError(f"{self.path}: its echoes are range-compressed; give level 1.0")


def begin(sources: Sequence[Readable], options: StripOptions) -> RawStrip:
    """Read everything but the samples.

    Raises
    ------
    InputError
        If files are damaged, not supported, or not those of one scene.
    """
    files = find_files(sources)
    with reading_file(files.leader), files.leader.open() as stream:
        leader = Leader.parse(stream.read(MOST_LEADER))
    images = [Image.open(path) for path in files.images]
    for image in images:
        with reading_file(image.path):
            image.check()
    chosen, notes = _chosen(images, options)
    with reading_file(files.leader):
        return _strip(leader, chosen, options, notes).taking(options)


def _chosen(images: Sequence[Image], options: StripOptions) -> tuple[list[Image], list[str]]:
    """Select the requested images, by default those of the first transmitter."""
    names = [image.polarization for image in images]
    if len(set(names)) < len(names):
        raise InputError(f"{images[0].path}: images beside it have its polarisation; give the files of one scene")
    order = sorted(range(len(names)), key=lambda i: names[i])
    if options.polarization is not None:
        if options.polarization not in names:
            raise InputError(
                f"--polarization is {options.polarization}, but there are {', '.join(sorted(names))}; give one"
            )
        return [images[names.index(options.polarization)]], []
    first = images[order[0]]
    same = [
        images[i] for i in order
        if names[i][0] == names[order[0]][0] and images[i].length == first.length
        and np.array_equal(images[i].fields["milliseconds"], first.fields["milliseconds"])
    ]  # fmt: skip
    others = ", ".join(names[i] for i in order if images[i] not in same)
    note = f"{others}: of other pulses, not taken; --polarization takes one"
    return same, [note] if others else []


def _strip(leader: Leader, images: list[Image], options: StripOptions, notes: list[str]) -> RawStrip:
    fields = images[0].fields
    epoch = datetime(int(fields["year"][0]), 1, 1, tzinfo=UTC) + timedelta(days=int(fields["day of year"][0]) - 1)
    with reading_file(images[0].path):
        even = _even(images[0], options, leader.known("number of SAR channels") == 4, notes)
        first = _first_delay(fields, even.pulses, leader, notes)
    sampling_rate = 1e6 * leader.number("sampling rate")
    width = (images[0].length - PREFIX) // 2
    shift = np.rint((first - first[0]) * sampling_rate).astype(np.int64)
    pulses = even.pulses
    pixels = np.where(fields["pixels"][pulses] > 0, fields["pixels"][pulses], width)
    left = fields["left fill"][pulses]
    stop = np.minimum(left + pixels, width - fields["right fill"][pulses])
    window, note = common_window(shift + left, shift + stop, int((shift + stop).max()))
    notes += [note] if note else []
    delay = first[0] + np.arange(window.start, window.stop) / sampling_rate
    pulse_width = float(fields["pulse length"][0]) * 1e-9 or 1e-6 * leader.number("pulse length")
    bias = complex(leader.known("DC bias of I"), leader.known("DC bias of Q"))
    return RawStrip(
        title=f"ALOS PALSAR {leader.text('scene identifier')}".strip(), format="CEOS level 1.0",
        collector="ALOS PALSAR", epoch=epoch, even=even, tags="receive", orbit=(orbit := leader.orbit(epoch)),
        antenna=leader.antenna(epoch, orbit), length=LENGTH, side=leader.side, delay=delay,
        chirp_rate=_chirp_rate(fields, leader, pulse_width, sampling_rate, notes), pulse_width=pulse_width,
        carrier=leader.carrier, sampling_rate=sampling_rate,
        polarizations=tuple(image.polarization for image in images),
        read=_Samples(tuple(images), pulses, window.start - shift, window.stop - window.start, bias), notes=notes,
    )  # fmt: skip


def _counted(fields: dict[str, Any], run: IntArray, seconds: FloatArray) -> FloatArray | None:
    """Times of lines, s, from their counters of microseconds in a second; None if these are unusable.

    The milliseconds tell the second, however they are rounded.
    """
    counter = (fields["counter"][run] >> 8) * MICRO
    if not counter.any() or (counter >= 1).any():
        return None
    fine = seconds + (counter - seconds + 0.5) % 1 - 0.5
    return np.asarray(fine) if np.abs(fine - seconds).max() <= 1.1 * MILLI and (np.diff(fine) > 0).all() else None


def _even(image: Image, options: StripOptions, quad: bool, notes: list[str]) -> Even:
    """Find the longest part at one PRF, and its even time axis.

    By the counters of microseconds, where lines have them. Otherwise by the lines' numbers: times are cut to
    milliseconds, and the PRF is exact, so that t0 is the earliest for which no t0 + slot / PRF lies before its line's
    millisecond, which no longer holds of any earlier one.
    """
    fields = image.fields
    chosen = np.arange(image.count)[slice(*options.pulses)]
    ends = np.flatnonzero(np.diff(fields["PRF"][chosen], prepend=-1, append=-1))
    if chosen.size < LEAST:
        raise InputError(f"--pulses leaves {chosen.size} of {image.count} lines; at least {LEAST} are needed")
    longest = int(np.argmax(np.diff(ends)))
    run = chosen[ends[longest] : ends[longest + 1]]
    prf = float(fields["PRF"][run[0]]) * MILLI
    if not prf > 0 or run.size < LEAST:
        run_length = texts.count(run.size, "line")
        raise InputError(f"{image.path}: the PRF is {prf:g} Hz over at most {run_length}; get it again")
    if run.size < chosen.size:
        refuse_few(run.size, chosen.size, "the PRF changes", f"lines {run[0]}:{run[-1] + 1} have one of {prf:.6g} Hz: "
                   "take them with --pulses")  # fmt: skip
        notes.append(f"the PRF changes: lines {run[0]} .. {run[-1]}, {run.size} of {chosen.size}, have one of "
                     f"{prf:.6g} Hz and are taken; others with --pulses")  # fmt: skip
    number = fields["number"][run]
    slots = number - number[0] if (np.diff(number) > 0).all() else np.arange(run.size)
    days = (fields["day of year"][run] - fields["day of year"][0]) + 365 * (fields["year"][run] - fields["year"][0])
    seconds = 86400.0 * np.clip(days, 0, 1) + fields["milliseconds"][run] * MILLI
    nought = fields["nought"][run] != 0
    counted = _counted(fields, run, seconds)
    if counted is not None:
        even, even_notes = even_pulses(counted)
        even = even.of_file(run)
        notes += ["times of lines are those of their counters of microseconds", *even_notes]
        return _with_echoes(even, nought[np.searchsorted(run, even.pulses)], image, notes)
    way = float(seconds[-1] - seconds[0])
    # With four channels, every other pulse belongs to one; the times show how the PRF counts.
    likely = [(2 if quad else 1) / prf, (1 if quad else 2) / prf]
    interval = min(likely, key=lambda each: abs(each * slots[-1] - way))
    if abs(interval * slots[-1] - way) > max(2 * MILLI, 0.02 * way):
        raise InputError(
            f"{image.path}: {slots[-1] + 1} lines take {way:.6g} s by their times, {interval * slots[-1]:.6g} s by the "
            f"PRF of {prf:.6g} Hz; get it again"
        )
    start = seconds - interval * slots
    low, high = float(start.max()), float(start.min()) + MILLI
    if low > high:
        notes.append(f"times of lines depart from the PRF by {1e3 * (low - high):.3g} ms; the middle is taken")
        low = (low + high) / 2
    time = low + interval * np.arange(slots[-1] + 1)
    notes.append("lines have no counters of microseconds: their times are by milliseconds and the PRF")
    slots = slots.astype(np.int64)
    if lost := int(time.size - slots.size):
        notes.append(f"{lost} of {time.size} lines lost: missing in the store")
    whole = Even(run, np.asarray(time[slots]), slots, time, interval, (int(run[0]), int(run[-1]) + 1))
    return _with_echoes(whole, nought, image, notes)


def _with_echoes(even: Even, nought: BoolArray, image: Image, notes: list[str]) -> Even:
    """Drop lines (n,) that are marked as empty."""
    if nought.any():
        n_left = int(np.count_nonzero(~nought))
        refuse_few(n_left, nought.size, "lines are marked as empty", "take others with --pulses")
        notes.append(f"{nought.size - n_left} of {nought.size} lines marked as empty: missing in the store")
        even = even.without(np.flatnonzero(nought))
    if even.pulses.size < LEAST:
        lines = texts.count(even.pulses.size, "line")
        raise InputError(f"{image.path}: {lines} with echoes; at least {LEAST} are needed")
    return even


def _first_delay(fields: dict[str, Any], pulses: IntArray, leader: Leader, notes: list[str]) -> FloatArray:
    """Delay of the first sample of lines, s: from slant range in m, or from finer fields that agree with it."""
    delay = 2.0 * fields["slant range"][pulses] / SPEED_OF_LIGHT
    metre = 2.0 / SPEED_OF_LIGHT
    position = 1e-9 * fields["window position"][pulses]
    if not delay.all():
        raise InputError("lines have no slant range of their first sample; get the files again")
    if np.abs(position - delay).max() <= metre:
        delay = position
    gate = 1e-6 * leader.known("range gate")
    if abs(gate - delay[0]) <= metre:
        delay = delay + (gate - delay[0])
    else:
        notes.append(f"slant ranges are in whole metres, so that places may lie up to {0.5:g} m off in range")
    return np.asarray(delay)


def _chirp_rate(
    fields: dict[str, Any], leader: Leader, pulse_width: float, sampling_rate: float, notes: list[str]
) -> float:
    """Chirp rate, Hz/s: of the lines, of the leader, or from the bandwidth; always negative.

    The pulse is a down-chirp, and the files give the magnitude of its rate, as other processors read them.

    Raises
    ------
    InputError
        If none can be.
    """
    stated = (
        ("the lines", 1e6 * float(fields["linear coefficient"][0])),
        ("the leader", leader.known("linear coefficient of the pulse")),
        ("the leader's bandwidth", leader.bandwidth / pulse_width),
    )
    for name, rate in stated:
        if rate and 0.1 * sampling_rate < abs(rate) * pulse_width <= sampling_rate:
            notes.append(
                f"chirp of {abs(rate):.6g} Hz/s over {1e6 * pulse_width:g} us, by {name}, taken to fall; --chirp-sign "
                "up if it rises"
            )
            return -abs(rate)
    raise InputError("neither the lines nor the leader tell the chirp's rate; get the files again")


@dataclass(frozen=True, eq=False)
class _Samples:
    """Reader of channels' samples, whose lines begin at different delays."""

    images: tuple[Image, ...]
    pulses: IntArray
    first: IntArray  # sample of each of the pulses, at which the common window begins
    width: int
    bias: complex

    def __call__(self, channel: int, pulses: IntArray) -> ComplexArray:
        image = self.images[channel]
        with reading_file(image.path):
            raw = image.lines["samples"][pulses]
            parts = raw.view("u1" if image.unsigned else "i1").reshape(pulses.size, -1)
            first = self.first[np.searchsorted(self.pulses, pulses)]
            samples = np.empty((pulses.size, self.width), np.complex64)
            for row, at, line in zip(samples, first, parts, strict=True):
                row.real = line[2 * at : 2 * (at + self.width) : 2]
                row.imag = line[2 * at + 1 : 2 * (at + self.width) : 2]
            return samples - np.complex64(self.bias)


PALSAR = StripReader(
    name="palsar",
    title="PALSAR raw echo",
    summary="Convert raw echoes of ALOS PALSAR (CEOS level 1.0) to a phase history on the ellipsoid.",
    example="ALPSRP267211110-L1.0 --out palsar.zarr",
    source=("FOLDER", "Folder of one scene, or its files: leader (LED) and images (IMG)."),
    several=True,
    kind=Kind(
        "a CEOS file of raw echoes", lambda start: ceos(start, b"\x32\x0a"),
        "if it is of PALSAR, turn its folder into a phase history first: `blocksar ingest palsar {path} --out {store}`",
    ),
    options=StripOptions,
    begin=begin,
)  # fmt: skip
