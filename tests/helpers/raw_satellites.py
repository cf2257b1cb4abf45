"""Raw echoes of targets on the ellipsoid, seen by a satellite, as files of NISAR, of PALSAR and CRSD hold them.

Written from the formats' documents alone. A pulse begins at `sent`; its echo from x comes after the time tau of

    c tau = |p(sent) - x| + |p(sent + tau) - x| ,

since the antenna moves on while it travels.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.collection.georeference import Georeference

Floats = NDArray[np.float64]
SPEED_OF_LIGHT = 299792458.0
GRAVITY, SPIN = 3.986004418e14, 7.292115e-5  # m^3/s^2, rad/s
INCLINATION, LATITUDE = np.radians(98.2), np.radians(40.0)  # of the orbit; argument of latitude at t = 0
PLACES = [  # of targets, m across and along the track
    (0.0, 0.0), (-700.0, -520.0), (-420.0, 410.0), (-380.0, -190.0), (-110.0, 640.0), (130.0, -660.0), (300.0, 280.0),
    (480.0, -310.0), (610.0, 540.0), (790.0, 60.0),
    (200.0, 5200.0),  # where the ellipsoid lies 2 m below the plane
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Radar:
    """A sensor at L band, and a short window about its targets; seconds count from midnight."""

    carrier: float = 1.27e9
    chirp_rate: float = -4e12
    pulse_width: float = 10e-6
    sampling_rate: float = 48e6
    prf: float = 1700.0
    n_pulse: int = 1600
    n_sample: int = 1100
    radius: float = 7_070_000.0
    slant_range: float = 830e3
    side: int = 1  # to the right of the track; -1: left
    start: float = 36000.25  # s: the first pulse begins
    moving: bool = True  # while a pulse travels
    east: float = 0.0  # rad, by which the node lies farther east
    given: Floats | None = None  # times of the orbit's states, s

    def earth_centred(self, time: Floats) -> Floats:
        """Positions (..., 3) on a circular orbit, in axes that turn with the Earth, m."""
        t = np.asarray(time) - self.start
        along = LATITUDE + np.sqrt(GRAVITY / self.radius**3) * t
        x, y = self.radius * np.cos(along), self.radius * np.sin(along)
        px, py, pz = x, y * np.cos(INCLINATION), y * np.sin(INCLINATION)
        cos, sin = np.cos(SPIN * t - self.east), np.sin(SPIN * t - self.east)
        return np.stack([cos * px + sin * py, cos * py - sin * px, pz], axis=-1)

    def velocity(self, time: Floats) -> Floats:
        step = 1e-2
        return (self.earth_centred(time + step) - self.earth_centred(time - step)) / (2 * step)

    @property
    def sent(self) -> Floats:
        return self.start + np.arange(self.n_pulse) / self.prf

    @cached_property
    def first_range(self) -> float:
        """Of the first sample, whole metres, counted from the beginning of the pulse."""
        length = SPEED_OF_LIGHT / 2 * (self.n_sample / self.sampling_rate - self.pulse_width)
        return float(round(self.slant_range - length / 2))

    @cached_property
    def targets(self) -> Floats:
        """Ten places (n, 3) on WGS 84, ECEF, and one far from them."""
        middle = self.start + self.n_pulse / self.prf / 2 + self.slant_range / SPEED_OF_LIGHT * self.moving
        place, velocity = self.earth_centred(np.array(middle)), self.velocity(np.array(middle))
        along = velocity / np.linalg.norm(velocity)
        down = -place / np.linalg.norm(place)
        down -= along * (down @ along)
        down /= np.linalg.norm(down)
        right = self.side * np.cross(down, along)
        low, high = 0.1, 1.2
        axes = np.array([6378137.0, 6378137.0, 6356752.314245])
        for _ in range(60):
            angle = (low + high) / 2
            centre = place + self.slant_range * (np.sin(angle) * right + np.cos(angle) * down)
            above = np.linalg.norm(centre / axes) > 1
            low, high = (low, angle) if above else (angle, high)
        up = centre / axes**2
        up /= np.linalg.norm(up)
        across = right - up * (right @ up)
        across /= np.linalg.norm(across)
        frame = Georeference.at(centre)
        found = []
        for x, y in PLACES:
            latitude, longitude, _ = frame.to_geodetic(frame.from_ecef(centre + x * across + y * np.cross(up, across)))
            found.append(Georeference(latitude=float(latitude), longitude=float(longitude), height=0.0).origin)
        return np.array(found)

    @cached_property
    def echo(self) -> NDArray[np.complex64]:
        """Of targets of reflectivity 1."""
        delay = 2 * self.first_range / SPEED_OF_LIGHT + np.arange(self.n_sample) / self.sampling_rate
        echo = np.zeros((self.n_pulse, self.n_sample), np.complex128)
        here = self.earth_centred(self.sent)
        for target in self.targets:
            away = np.linalg.norm(here - target, axis=1)
            tau = 2 * away / SPEED_OF_LIGHT
            for _ in range(3 * self.moving):
                back = np.linalg.norm(self.earth_centred(self.sent + tau) - target, axis=1)
                tau = (away + back) / SPEED_OF_LIGHT
            within = delay - tau[:, None] - self.pulse_width / 2
            phase = np.pi * self.chirp_rate * within**2 - 2 * np.pi * self.carrier * tau[:, None]
            echo += np.where(np.abs(within) <= self.pulse_width / 2, np.exp(1j * phase), 0)
        return echo.astype(np.complex64)

    def states(self, interval: float = 10.0) -> tuple[Floats, Floats, Floats]:
        """Times, positions, velocities of the orbit."""
        time = np.floor(self.start) + interval * np.arange(-6, 7) if self.given is None else self.given
        return time, self.earth_centred(time), self.velocity(time)


def write_nisar(path: Path, radar: Radar, *, polarizations: tuple[str, ...] = ("HH",), **changes: Any) -> Path:
    """Level 0B: `changes` of the transmitter's group by name; None leaves one out."""
    import h5py

    time, position, velocity = radar.states()
    levels = np.arange(1 << 16, dtype=np.float32)
    levels[1 << 15 :] -= 1 << 16
    levels *= 16 / (1 << 15)
    levels[1 << 15] = 0
    since = "seconds since 2026-03-04T00:00:00"
    with h5py.File(path, "w") as file:
        band = file.create_group("science/LSAR")
        for name, text in {
            "productType": "RRSD", "productVersion": "1.0", "missionId": "NISAR",
            "lookDirection": "Right" if radar.side > 0 else "Left",
        }.items():  # fmt: skip
            band[f"identification/{name}"] = np.bytes_(text)
        orbit = band.create_group("RRSD/lowRateTelemetry/orbit")
        orbit["time"], orbit["position"], orbit["velocity"] = time, position, velocity
        orbit["time"].attrs["units"] = np.bytes_(since)
        attitude = band.create_group("RRSD/lowRateTelemetry/attitude")
        attitude["time"], attitude["quaternions"] = time, quaternions(position, velocity)
        attitude["time"].attrs["units"] = np.bytes_(since)
        swath = band.create_group("RRSD/swaths/frequencyA/txH")
        valid = np.tile([0, radar.n_sample], (radar.n_pulse, 1))
        fields = {
            "UTCtime": radar.sent, "centerFrequency": radar.carrier, "chirpDuration": radar.pulse_width,
            "chirpSlope": radar.chirp_rate, "nominalAcquisitionPRF": radar.prf, "numberOfSubSwaths": 1,
            "rangeBandwidth": abs(radar.chirp_rate) * radar.pulse_width, "calType": np.zeros(radar.n_pulse, np.uint8),
            "slantRange": radar.first_range + np.arange(radar.n_sample) * SPEED_OF_LIGHT / 2 / radar.sampling_rate,
            "validSamplesSubSwath1": valid, **changes,
        }  # fmt: skip
        for name, value in fields.items():
            if value is not None:
                swath[name] = value
        swath["UTCtime"].attrs["units"] = np.bytes_(since)
        if radar.moving:
            swath["UTCtime"].attrs["description"] = np.bytes_("UTC transmit time tag")
        for factor, name in enumerate(polarizations, start=1):
            group = swath.create_group(f"rx{name[1]}")
            group["BFPQLUT"] = levels
            coded = np.empty(radar.echo.shape, [("r", "<u2"), ("i", "<u2")])
            for part, values in (("r", radar.echo.real), ("i", radar.echo.imag)):
                coded[part] = np.rint(values / factor * (1 << 15) / 16).astype(np.int16).view(np.uint16)
            group.create_dataset(name, data=coded, chunks=(64, 256), compression="gzip", compression_opts=1)
    return path


def quaternions(position: Floats, velocity: Floats) -> Floats:
    """Of an antenna (n, 4), whose y lies along the flight and whose x points up, w first."""
    y = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    x = position - y * (position * y).sum(axis=1, keepdims=True)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=2)).as_quat()
    return np.roll(found, 1, axis=1)


GAIN, BIAS = 6.0, 15.5  # of 8-bit samples: of a target, and the level of nothing


def write_palsar(folder: Path, radar: Radar, *, polarizations: tuple[str, ...] = ("HH",), **changes: Any) -> Path:
    """Level 1.0: a leader and images. A line's time is that of its first sample, cut to milliseconds.

    `changes` of lines, as arrays by their first byte ("b56" and so on).
    """
    folder.mkdir()
    (folder / "LED-ALPSRP000010800-H1.0__A").write_bytes(leader(radar, len(polarizations)))
    length = 412 + 2 * radar.n_sample
    for factor, name in enumerate(polarizations, start=1):
        head = bytearray(b"\x00\x00\x00\x01\x32\xc0\x12\x12" + struct.pack(">I", 720) + b" " * 708)
        for at, text in {
            180: f"{radar.n_pulse:6d}{length:6d}", 216: f"{8:4d}{2:4d}{2:4d}", 276: f"{412:4d}{2 * radar.n_sample:8d}",
            400: "COMPLEX INTEGER*1".ljust(28) + "CI*1",
        }.items():  # fmt: skip
            head[at : at + len(text)] = text.encode()
        lines = np.zeros((radar.n_pulse, length), np.uint8)
        received = radar.sent + 2 * radar.first_range / SPEED_OF_LIGHT * radar.moving
        numbers = {
            0: np.arange(2, radar.n_pulse + 2), 4: 0x320A1214, 8: length, 12: np.arange(1, radar.n_pulse + 1), 16: 1,
            24: radar.n_sample, 36: 2026, 40: 63, 44: np.floor(received * 1000 + 1e-6), 48: 1 << 16,
            52: ("HV".index(name[0]) << 16) + "HV".index(name[1]), 56: round(radar.prf * 1000),
            68: round(radar.pulse_width * 1e9), 76: round(radar.chirp_rate / 1e6), 116: radar.first_range,
            120: round(2 * radar.first_range / SPEED_OF_LIGHT * 1e9),
            **{int(at[1:]): value for at, value in changes.items()},
        }  # fmt: skip
        for at, value in numbers.items():
            column = np.broadcast_to(np.asarray(value, np.int64), radar.n_pulse).astype(">i4")
            lines[:, at : at + 4] = column.view(np.uint8).reshape(-1, 4)
        parts = np.ascontiguousarray(radar.echo).view(np.float32) * (GAIN / factor) + BIAS
        lines[:, 412:] = np.rint(parts).astype(np.int8).view(np.uint8)
        (folder / f"IMG-{name}-ALPSRP000010800-H1.0__A").write_bytes(bytes(head) + lines.tobytes())
    return folder


def record(number: int, codes: bytes, length: int, fields: dict[int, str]) -> bytes:
    data = bytearray(struct.pack(">I", number) + codes + struct.pack(">I", length) + b" " * (length - 12))
    for at, text in fields.items():
        data[at : at + len(text)] = text.encode()
    return bytes(data)


def leader(radar: Radar, channels: int) -> bytes:
    time, position, velocity = radar.states(60.0)
    summary = {
        20: "ALPSRP000010800", 388: f"{channels:4d}", 396: "ALOS", 412: "ALOS  -L -H60",
        476: f"{90.0 * radar.side:8.3f}", 500: f"{SPEED_OF_LIGHT / radar.carrier:16.12f}", 518: "LINEAR FM CHIRP",
        710: f"{radar.sampling_rate / 1e6:16.7f}", 726: f"{2e6 * radar.first_range / SPEED_OF_LIGHT:16.7f}",
        742: f"{radar.pulse_width * 1e6:16.7f}", 798: f"{5:8d}", 818: f"{BIAS:16.7f}{BIAS:16.7f}",
        934: f"{radar.prf * 1000:16.7f}", 1094: "1.0", 1110: "UNPROCESSED SIGNAL DATA",
    }  # fmt: skip
    day = 86400.0 if time[0] < 0 else 0.0
    platform = {
        12: "2", 204: "ECR",
        140: f"{time.size:4d}{2026:4d}{3:4d}{4:4d}{63:4d}{time[0] + day:22.15E}{time[1] - time[0]:22.15E}",
        386: "".join(f"{value:22.15E}" for row in np.hstack([position, velocity]) for value in row),
    }  # fmt: skip
    # An orbit whose flight turns with the Earth as well: the antenna is turned to look where Doppler is zero.
    flight = velocity + SPIN * np.stack([-position[:, 1], position[:, 0], 0 * time], axis=1)
    down = -position / np.linalg.norm(position, axis=1, keepdims=True)
    right = np.cross(down, flight)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    yaw = np.degrees(np.arctan2((along * right).sum(axis=1), (along * np.cross(right, down)).sum(axis=1)))
    pitch = np.degrees(-np.arcsin((along * down).sum(axis=1)))
    rows = "".join(
        f"{63:4d}{round(1000 * t):8d}" + f"{0:4d}" * 3 + f"{p:14.6f}{0.0:14.6f}{y:14.6f}" + f"{0:4d}" * 3
        + f"{0.0:14.6f}" * 3 for t, p, y in zip(time, pitch, yaw, strict=True)
    )  # fmt: skip
    return b"".join([
        record(1, b"\x0b\xc0\x12\x12", 720, {}), record(2, b"\x12\x0a\x12\x14", 4096, summary),
        record(3, b"\x12\x1e\x12\x14", 4680, platform),
        record(4, b"\x12\x28\x12\x14", 8192, {12: f"{time.size:4d}{rows}"}),
    ])  # fmt: skip


INTFRAC, PLACE = [("Int", ">i8"), ("Frac", ">f8")], [("X", ">f8"), ("Y", ">f8"), ("Z", ">f8")]
COSINES = [("DCX", ">f8"), ("DCY", ">f8")]
PULSE = [("TxTime", INTFRAC), ("TxPos", PLACE), ("TxVel", PLACE), ("FX1", ">f8"), ("FX2", ">f8"), ("TXmt", ">f8"),
         ("PhiX0", INTFRAC), ("FxFreq0", ">f8"), ("FxRate", ">f8"), ("TxRadInt", ">f8"), ("TxACX", PLACE),
         ("TxACY", PLACE), ("TxEB", COSINES), ("FxResponseIndex", ">i8")]  # fmt: skip
VECTOR = [("RcvStart", INTFRAC), ("RcvPos", PLACE), ("RcvVel", PLACE), ("FRCV1", ">f8"), ("FRCV2", ">f8"),
          ("RefPhi0", INTFRAC), ("RefFreq", ">f8"), ("DFIC0", ">f8"), ("FICRate", ">f8"), ("RcvACX", PLACE),
          ("RcvACY", PLACE), ("RcvEB", COSINES), ("SIGNAL", ">i8"), ("AmpSF", ">f8"), ("DGRGC", ">f8"),
          ("TxPulseIndex", ">i8")]  # fmt: skip
OFFSET = 1.5e6  # Hz, of the receiver's reference frequency below the pulse's


def parameters(fields: Any, values: dict[str, Any], n: int) -> NDArray[Any]:
    """Of pulses or vectors (n,)."""
    out = np.zeros(n, fields)
    for name, value in values.items():
        if fields is not None and out.dtype[name].names is None:
            out[name] = value
        elif out.dtype[name].names == ("Int", "Frac"):
            out[name]["Int"], out[name]["Frac"] = np.floor(value), np.asarray(value) - np.floor(value)
        else:
            for axis, part in zip(out.dtype[name].names or (), np.moveaxis(np.asarray(value), -1, 0), strict=True):
                out[name][axis] = part
    return out


def described(tag: str, fields: Any) -> str:
    """The XML of parameters."""
    kinds, at, parts = {">f8": "F8", ">i8": "I8"}, 0, []
    for name, kind in fields:
        one = isinstance(kind, str)
        form = kinds[kind] if one else "".join(f"{part}={kinds[each]};" for part, each in kind)
        size = 1 if one else len(kind)
        parts.append(f"<{name}><Offset>{at}</Offset><Size>{size}</Size><Format>{form}</Format></{name}>")
        at += size
    return f"<{tag}>{''.join(parts)}</{tag}>"


def write_crsd(path: Path, radar: Radar, **changes: Any) -> Path:
    """CRSD 1.0: what imaging needs of it; `changes` of pulses and vectors, by name. Mixed down by another frequency."""
    n, half = radar.n_pulse, radar.pulse_width / 2
    centre = radar.sent - radar.start + half
    begun = radar.sent - radar.start + 2 * radar.first_range / SPEED_OF_LIGHT
    phases = np.random.default_rng(5).uniform(0, 9, (2, n))
    velocity = [radar.velocity(radar.start + time) for time in (centre, begun)]
    along = velocity[0] / np.linalg.norm(velocity[0], axis=1, keepdims=True)
    normal = np.cross(along, radar.earth_centred(radar.sent))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pulses = {
        "TxTime": centre, "TxPos": radar.earth_centred(radar.start + centre), "TxVel": velocity[0],
        "TXmt": radar.pulse_width, "PhiX0": phases[0], "FxFreq0": radar.carrier, "FxRate": radar.chirp_rate,
        "TxACX": along, "TxACY": normal,
    }  # fmt: skip
    vectors = {
        "RcvStart": begun, "RcvPos": radar.earth_centred(radar.start + begun), "RcvVel": velocity[1],
        "RefPhi0": phases[1], "RefFreq": radar.carrier - OFFSET, "SIGNAL": 1, "AmpSF": 0.5,
        "TxPulseIndex": np.arange(n),
    }  # fmt: skip
    for name, value in changes.items():
        (pulses if name in dict(PULSE) else vectors)[name] = value
    # The samples have -carrier tau: what the format has besides is put on.
    after = begun - centre
    within = after[:, None] + np.arange(radar.n_sample) / radar.sampling_rate
    cycles = (
        (phases[0] - phases[1])[:, None] + radar.carrier * within
        - (radar.carrier - OFFSET) * (within - after[:, None])
    )  # fmt: skip
    signal = (2 * radar.echo * np.exp(2j * np.pi * np.mod(cycles, 1))).astype(np.complex64)
    blocks = [parameters(PULSE, pulses, n), parameters(VECTOR, vectors, n), signal.view(np.float32).astype(">f4")]
    origin = radar.targets[0]
    place = "".join(f"<{axis}>{value!r}</{axis}>" for axis, value in zip("XYZ", origin.tolist(), strict=True))
    data = (
        f"<Data><Support><NumSupportArrays>0</NumSupportArrays></Support><Transmit><NumBytesPPP>{blocks[0].itemsize}"
        f"</NumBytesPPP><NumTxSequences>1</NumTxSequences><TxSequence><TxId>T</TxId><NumPulses>{n}</NumPulses>"
        "<PPPArrayByteOffset>0</PPPArrayByteOffset></TxSequence></Transmit><Receive><SignalArrayFormat>CF8"
        f"</SignalArrayFormat><NumBytesPVP>{blocks[1].itemsize}</NumBytesPVP><NumCRSDChannels>1</NumCRSDChannels>"
        f"<Channel><ChId>C</ChId><NumVectors>{n}</NumVectors><NumSamples>{radar.n_sample}</NumSamples>"
        "<SignalArrayByteOffset>0</SignalArrayByteOffset><PVPArrayByteOffset>0</PVPArrayByteOffset></Channel>"
        "</Receive></Data>"
    )
    transmitted = "<TxPolarization><PolarizationID>V</PolarizationID></TxPolarization>"
    xml = (
        '<CRSDsar xmlns="http://api.nsgreg.nga.mil/schema/crsd/1.0"><ProductInfo><ProductName>ten targets</ProductName>'
        "</ProductInfo><ReceiveInfo><SensorName>a radar</SensorName></ReceiveInfo><Global><CollectionRefTime>"
        "2026-03-04T10:00:00.25Z</CollectionRefTime></Global><SceneCoordinates><IARP><ECF>"
        f"{place}</ECF></IARP></SceneCoordinates>{data}<Channel><Parameters><Identifier>C</Identifier><Fs>"
        f"{radar.sampling_rate!r}</Fs><RcvPolarization><PolarizationID>H</PolarizationID></RcvPolarization><SARImage>"
        f"<TxId>T</TxId>{transmitted}</SARImage></Parameters></Channel><ReferenceGeometry><SARImage><SideOfTrack>"
        f"{'R' if radar.side > 0 else 'L'}</SideOfTrack></SARImage></ReferenceGeometry>{described('PPP', PULSE)}"
        f"{described('PVP', VECTOR)}</CRSDsar>"
    ).encode()
    keys, at = {"XML": len(xml), "PPP": blocks[0].nbytes, "PVP": blocks[1].nbytes, "SIGNAL": blocks[2].nbytes}, 1024
    head = "CRSDsar/1.0\n"
    for name, size in keys.items():
        head += f"{name}_BLOCK_SIZE := {size}\n{name}_BLOCK_BYTE_OFFSET := {at}\n"
        at += size + (2 if name == "XML" else 0)
    head += "SUPPORT_BLOCK_SIZE := 0\nSUPPORT_BLOCK_BYTE_OFFSET := 0\nCLASSIFICATION := U\nRELEASE_INFO := U\n\f\n"
    path.write_bytes(head.encode().ljust(1024, b"\0") + xml + b"\f\n" + b"".join(each.tobytes() for each in blocks))
    return path
