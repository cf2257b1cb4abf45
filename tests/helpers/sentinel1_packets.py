"""Packets of Sentinel-1's IW1 that tests write: real layout, orbit, steering, PRF, pulses in the air; a narrow swath.

Smaller than in truth: the chirp (20 MHz in 15 us instead of 56 MHz in 52 us), the receive window (37 us instead of 380
us), bursts (0.41 s instead of 0.82 s) and the way between them (1.15 s instead of 2.76 s). Echoes are those of an
antenna that moves while a pulse is out: both ways are computed by themselves, and the range changes within the pulse.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.georeference import find_scene_centre
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import quantised_packets as loops

CLOCK, CARRIER = 37.53472224e6, 5.405000454334350e9  # Hz
SPIN, RADIUS, INCLINATION = 7.2921159e-5, 7.0706e6, np.radians(98.18)
ZERO = 1276273467  # GPS second
LENGTH = 12.3  # m, of the antenna
RATE = np.radians(1.590368784)  # rad/s, of IW1
STEP = 0.036 / 1023  # rad, of a beam address
INTERVAL, RANK, WINDOW = 21859, 9, 4640  # codes: PRI, pulses in the air, start of the receive window
RAMP, PULSE, DECIMATION = 1985, 563, 7
SAMPLE_RATE = 4 * CLOCK / 6
N_PULSE, CYCLE = 700, 1.15  # pulses of a burst, and s from burst to burst
QUADS = 460
LATITUDE, NODE = 40.0, 60.0  # degrees, at ZERO: along the orbit from the equator, and the node's longitude
CALIBRATION_QUADS = 250
LEAN = np.radians(0.03)  # of the antenna's axis across the velocity


def signed(value: float) -> int:
    return round(abs(value)) | (0x8000 if value >= 0 else 0)


CHIRP = RAMP * CLOCK**2 / 2**21
START = signed((-CHIRP * PULSE / CLOCK / 2 - CHIRP / (4 * CLOCK)) * 2**14 / CLOCK)
FIRST = CHIRP / (4 * CLOCK) - (START & 0x7FFF) * CLOCK / 2**14
T = PULSE / CLOCK
PRI = INTERVAL / CLOCK
DELAY = RANK * PRI + (WINDOW + 40) / CLOCK  # of the first sample
MIDDLE = SPEED_OF_LIGHT / 2 * (DELAY + (2 * QUADS - 1) / 2 / SAMPLE_RATE - T / 2)  # m, range of the swath's middle


def state(time: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (..., 3) on a circular orbit, Earth-fixed, at times after ZERO."""
    t = np.asarray(time, float)
    rate = np.sqrt(3.986004418e14 / RADIUS**3)
    angle, node = np.radians(LATITUDE) + rate * t, np.radians(NODE) - SPIN * t
    ci, si, ca, sa, cn, sn = (
        *(f(INCLINATION) for f in (np.cos, np.sin)),
        np.cos(angle),
        np.sin(angle),
        np.cos(node),
        np.sin(node),
    )
    place = RADIUS * np.stack([cn * ca - sn * ci * sa, sn * ca + cn * ci * sa, si * sa], axis=-1)
    along = RADIUS * rate * np.stack([-cn * sa - sn * ci * ca, -sn * sa + cn * ci * ca, si * ca], axis=-1)
    return place, along - SPIN * np.stack([-place[..., 1], place[..., 0], 0 * t], axis=-1)


def frame(time: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The antenna's axis, and the directions right of it and down, at a time (3,)."""
    place, velocity = state(time)
    along = velocity / np.linalg.norm(velocity)
    outward = place - (place @ along) * along
    outward /= np.linalg.norm(outward)
    along = np.cos(LEAN) * along + np.sin(LEAN) * np.cross(along, outward)
    down = -(outward - (outward @ along) * along)
    down /= np.linalg.norm(down)
    return along, np.cross(down, along), down


def quaternion(time: float) -> FloatArray:
    """From the body (x along the axis, rolled to the right) to inertial axes of J2000, scalar first."""
    x, right, down = frame(time)
    roll = np.radians(29.45)
    z = np.cos(roll) * down + np.sin(roll) * right
    days = (ZERO + time - 18 - 630763200) / 86400
    turn = Rotation.from_euler("z", 280.46061837 + 360.98564736629 * days, degrees=True).as_matrix()
    zeta, theta = (np.radians(each * days / 36525 / 3600) for each in (2306.2181, 2004.3109))
    c, s, ct, st = np.cos(zeta), np.sin(zeta), np.cos(theta), np.sin(theta)
    z_turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    precession = z_turn @ np.array([[ct, 0, -st], [0, 1, 0], [st, 0, ct]]) @ z_turn
    body = precession.T @ turn @ np.stack([x, np.cross(z, x), z], axis=1)
    q = Rotation.from_matrix(body).as_quat()
    return np.asarray(q[[3, 0, 1, 2]])


def place_on_the_ellipsoid(time: float, slant_range: float) -> FloatArray:
    """Earth-centred place (3,) that is broadside of the track at a time."""
    position, velocity = state(time)
    return find_scene_centre(position, velocity, slant_range=slant_range, side="right", height=0.0, squint=0.0).origin


@dataclass
class Writer:
    """Packets, one after another, each with the next ancillary word; the first state may be of a stated time."""

    first_state: float | None = None
    words: list[tuple[int, int]] = field(default_factory=list)
    out: list[bytes] = field(default_factory=list)

    def next_word(self, time: float) -> tuple[int, int]:
        if not self.words:
            at = np.floor(time * 2) / 2  # states have some age
            if self.first_state is not None:
                at = self.first_state + max(np.floor((time - self.first_state) * 2) / 2, 0.0)
            place, velocity = state(at)
            stamp = int((ZERO + at) * 2**24).to_bytes(8, "big")
            data = place.astype(">f8").tobytes() + velocity.astype(">f4").tobytes() + stamp
            data += quaternion(at).astype(">f4").tobytes() + bytes(12) + stamp + bytes(2)
            data += bytes(2 * 64 - len(data))
            values = np.frombuffer(data, ">u2").tolist()
            self.words = list(enumerate(values, start=1))
        return self.words.pop(0)

    def add(self, time: float, pulse: int, samples: bytes, **codes: int) -> None:
        c = {"signal": 0, "swath": 10, "azimuth": 512, "rank": RANK, "window": WINDOW, "quads": QUADS, "baq": 0,
             "calibration": 0, "polarization": 6, "receiver": 0, "interval": INTERVAL, **codes}  # fmt: skip
        fine = int(time * 2**16)
        index, value = self.next_word(time)
        header = b"".join([
            (ZERO + (fine >> 16)).to_bytes(4, "big"), (fine & 0xFFFF).to_bytes(2, "big"), b"\x35\x2e\xf8\x53",
            (7).to_bytes(4, "big"), bytes([8, c["receiver"]]), (1).to_bytes(4, "big"), bytes([index]),
            value.to_bytes(2, "big"), len(self.out).to_bytes(4, "big"), pulse.to_bytes(4, "big"),
            bytes([c["baq"], 31, 0, DECIMATION, 8]), (RAMP | 0x8000).to_bytes(2, "big"), START.to_bytes(2, "big"),
            PULSE.to_bytes(3, "big"), bytes([c["rank"]]), c["interval"].to_bytes(3, "big"),
            c["window"].to_bytes(3, "big"), (2 * c["quads"] * 6 // 4).to_bytes(3, "big"),
            bytes([(c["calibration"] << 7) | (c["polarization"] << 4)]),
            ((6 << 12) | c["azimuth"]).to_bytes(2, "big"), bytes([0, c["signal"] << 4, c["swath"]]),
            c["quads"].to_bytes(2, "big"), b"\0",
        ])  # fmt: skip
        assert len(header) == 62
        samples += bytes(-(len(samples) + 68) % 4)
        length = len(header) + len(samples) - 1
        count = len(self.out) & 0x3FFF
        self.out.append(
            b"\x0c\x1c" + (0xC000 | count).to_bytes(2, "big") + length.to_bytes(2, "big") + header + samples
        )


def encoded(samples: ComplexArray, kind: int = 0, threshold: int = 0) -> bytes:
    """Samples (2 quads,) in bypass, BAQ (kinds 1 to 3) or FDBAQ (4 to 8), all blocks of one threshold."""
    table, amplitudes = loops.code_table(), loops.amplitude_table()[kind, threshold]
    codes: dict[int, str] = {}
    for window in range(1 << (loops.WINDOW - 1)):
        entry = int(table[kind, window])
        if entry:
            codes[entry & 0xFFFF] = f"{window:0{loops.WINDOW}b}"[1 : entry >> 16]
    parts = (samples.real[::2], samples.real[1::2], samples.imag[::2], samples.imag[1::2])
    out = b""
    for channel, part in enumerate(parts):
        bits = ""
        if kind == 0:
            magnitudes = np.rint(np.abs(part)).astype(int)
        else:
            levels = amplitudes[: len(codes)]
            magnitudes = np.abs(np.abs(part)[:, None] - levels).argmin(axis=1)
        for i, (value, magnitude) in enumerate(zip(part, magnitudes, strict=True)):
            if i % 128 == 0 and kind >= 4 and channel == 0:
                bits += f"{kind - 4:03b}"
            if i % 128 == 0 and kind and channel == 2:
                bits += f"{threshold:08b}"
            bits += ("1" if value < 0 else "0") + codes[int(magnitude)]
        bits += "0" * (-len(bits) % 16)
        out += int(bits, 2).to_bytes(len(bits) // 8, "big")
    return out


def bypass_rows(samples: ComplexArray) -> list[bytes]:
    """Rows of samples (n, 2 quads) in bypass."""
    n = samples.shape[0]
    assert max(np.abs(samples.real).max(), np.abs(samples.imag).max()) < 511
    parts = np.stack([samples.real[:, ::2], samples.real[:, 1::2], samples.imag[:, ::2], samples.imag[:, 1::2]], axis=1)
    codes = np.rint(np.abs(parts)).astype(np.int64) | ((parts < 0).astype(np.int64) << 9)
    bits = ((codes[..., None] >> np.arange(9, -1, -1)) & 1).astype(np.uint8).reshape(n, 4, -1)
    whole = np.concatenate([bits, np.zeros((n, 4, -bits.shape[-1] % 16), np.uint8)], axis=-1)
    return [row.tobytes() for row in np.packbits(whole.reshape(n, -1), axis=1)]


def echoes(
    sent: FloatArray, angle: FloatArray, targets: list[FloatArray], *, delay: float, amplitude: float
) -> ComplexArray:
    """Samples (n_pulse, 2 QUADS) of pulses that begin at times, s; the beam is steered by angles at their middles."""
    out = np.zeros((sent.size, 2 * QUADS), np.complex128)
    samples = delay + np.arange(2 * QUADS) / SAMPLE_RATE
    length = CARRIER / SPEED_OF_LIGHT * LENGTH
    axes = np.stack([frame(float(t))[0] for t in sent[:: sent.size - 1] + DELAY / 2])
    share = np.linspace(0, 1, sent.size)[:, None]
    axis = axes[0] + share * (axes[1] - axes[0])
    for target in targets:
        way = np.full(sent.size, 2 * MIDDLE)
        for _ in range(3):  # of the pulse's centre, there and back
            there, back = (state(sent + T / 2 + later)[0] - target for later in (0.0, way / SPEED_OF_LIGHT))
            way = np.linalg.norm(there, axis=1) + np.linalg.norm(back, axis=1)
        position, velocity = state(sent + T / 2 + way / (2 * SPEED_OF_LIGHT))
        sight = target - position
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        offset = np.arcsin((sight * axis).sum(axis=1)) - angle
        gain = np.where(np.abs(offset * length) < 1, np.sinc(length * np.sin(offset)) ** 2, 0.0)
        speed = -(velocity * sight).sum(axis=1)
        lit = np.flatnonzero(gain > 0)
        tau, change = (way[lit] / SPEED_OF_LIGHT)[:, None], (2 * speed[lit] / SPEED_OF_LIGHT)[:, None]
        # The delay of what is received at each moment: the range is that of the middle of the way.
        own = tau + change * (samples - tau - T / 2)
        u = samples - own
        pulse = np.where((u >= 0) & (u <= T), np.exp(2j * np.pi * (FIRST * u + CHIRP / 2 * u**2)), 0)
        out[lit] += amplitude * gain[lit, None] * pulse * np.exp(-2j * np.pi * ((CARRIER * own) % 1.0))
    return out


def calibration_pulse(delay: float, sign: float) -> bytes:
    """Samples of a calibration pulse whose chirp begins so late after the first of them, s."""
    u = np.arange(2 * CALIBRATION_QUADS) / SAMPLE_RATE - delay
    chirp = np.where((u >= 0) & (u <= T), np.exp(2j * np.pi * (FIRST * u + CHIRP / 2 * u**2 + 0.1)), 0)
    return bypass_rows(sign * 180 * chirp[None])[0]


def write_bursts(
    path: Path,
    targets: list[FloatArray],
    *,
    bursts: int = 3,
    amplitude: float = 90.0,
    about: float = 10.0,
    swath: int = 10,
    receiver: int = 0,
    internal: float = 0.0,
    calibration: dict[int, float] | None = None,
    before: float | None = None,
    lost: tuple[int, ...] = (),
) -> Path:
    """Write a swath's bursts, middles CYCLE apart about a time after ZERO, s, of targets at Earth-centred places.

    Echoes come later by the delay `internal`, s, calibration pulses by those of their types; the first burst begins by
    `before`, s, ahead of the first state, and states go on for 2 s after the last.
    """
    writer = Writer()
    for number in range(bursts):
        middle = about + (number - (bursts - 1) / 2) * CYCLE  # when the pulses' ways have their middle, s
        sent = middle - DELAY / 2 + (np.arange(N_PULSE) - (N_PULSE - 1) / 2) * PRI
        pulse = round(sent[0] / PRI)
        sent += pulse * PRI - sent[0]
        turned = sent + RANK / 2 * PRI  # the beam's law counts with the PRI, between both ways
        angle = RATE * (turned - turned.mean())
        if number == 0 and before is not None:
            writer.first_state = float(sent[0]) + before
        rows = bypass_rows(echoes(sent, angle, targets, delay=DELAY - internal, amplitude=amplitude))
        received = sent + RANK * PRI
        address = np.rint(512 + RATE * (received - received.mean()) / STEP).astype(int)
        writer.add(float(received[0] - PRI), pulse + RANK - 1, bytes(8), signal=8, calibration=1, quads=1)
        for i, (kind, delay) in enumerate([*(calibration or {}).items()] * 2):
            writer.add(
                float(received[0]) - (20 - i) * PRI, pulse + RANK - 20 + i,
                calibration_pulse(delay, 1.0 if i < len(calibration or {}) else -1.0), signal=kind, calibration=1,
                quads=CALIBRATION_QUADS, swath=52, receiver=receiver,
            )  # fmt: skip
        for i in range(N_PULSE):
            if i not in lost:
                writer.add(
                    float(received[i]), pulse + RANK + i, rows[i], azimuth=int(address[i]), swath=swath,
                    receiver=receiver,
                )  # fmt: skip
    if before is not None:
        pulse += RANK + N_PULSE
        for later in range(0, round(2.5 / PRI), 14):  # noise, whose words hold five more states
            writer.add(float(received[-1]) + (1 + later) * PRI, pulse + later, bytes(8), signal=1, quads=1, swath=swath)
    path.write_bytes(b"".join(writer.out))
    return path
