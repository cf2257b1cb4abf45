"""Space packets of Sentinel-1: headers, and decoding of samples.

By "Sentinel-1 SAR Space Packet Protocol Data Unit" (S1-IF-ASD-PL-0007) a packet is a primary header of 6 bytes, which
has its length, a secondary one of 62, and the samples. Numbers are big-endian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import BinaryIO, NamedTuple, Self

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.readers.kinds import Kind, begins

SYNC = b"\x35\x2e\xf8\x53"
SYNC_AT = 12
HEADERS = 68  # bytes
REFERENCE = 37.53472224e6  # Hz, the clock of all times and rates
CARRIER = 5.405000454334350e9  # Hz
FINE = 2.0**-16  # s, of the time of a packet, which is cut off
SUPPRESSED = 40 / REFERENCE  # s after the start of the window, in which the decimation's filter settles (3.2.5.11)
ECHO = 0  # signal type
AT_ONCE = 16 * MIB  # bytes of a file
# Sampling rate relative to the converter's, four times the clock, by the code of decimation (3.2.5.4).
DECIMATION = {
    0: (3, 4), 1: (2, 3), 3: (5, 9), 4: (4, 9), 5: (3, 8), 6: (1, 3), 7: (1, 6), 8: (3, 7), 9: (5, 16), 10: (3, 26),
    11: (4, 11),
}  # fmt: skip
MODES = {8: "IW", 9: "WV", 32: "EW", 45: "IW", 46: "WV", 44: "EW"}  # by the ECC number; others are stripmaps
# Swath numbers.
SWATHS = {
    **{number: f"S{number + 1}" for number in range(4)}, 4: "S5N", 5: "S5S", 6: "S6", 8: "WV1", 9: "WV2",
    **{10 + number: f"IW{number + 1}" for number in range(3)},
    **{13 + number: f"EW{number + 1}" for number in range(5)},
}  # fmt: skip
KIND = Kind("a file of Sentinel-1 level 0 packets", begins(SYNC, at=SYNC_AT),
            "turn it into phase histories first: `blocksar ingest {path} --out {store}`")  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Packets:
    """Headers of packets as arrays (n,).

    Attributes
    ----------
    offset, size : int
        Of a packet in its file, bytes.
    seconds, fine : int
        GPS time: seconds since 1980-01-06, and 2**-16 s.
    take, mode : int
        Number of the data take, and ECC number.
    receiver : int
        0: vertical, 1: horizontal.
    word, value : int
        Index and value of the ancillary word.
    pulse : int
        Number of the PRI, in the data take.
    compression, block : int
        BAQ mode, and samples of a block in each of the four channels.
    decimation, rank : int
    ramp, start, length, interval, window : int
        Of the pulse: rate, first frequency and length; PRI; start of the receive window: codes.
    calibration : bool
        Of the antenna's configuration: no imaging.
    polarization, elevation, azimuth : int
        Codes of its polarisation and beams.
    signal, swath, quads : int
        Signal type, swath number, and half the number of samples.
    """

    offset: IntArray
    size: IntArray
    seconds: IntArray
    fine: IntArray
    take: IntArray
    mode: IntArray
    receiver: IntArray
    word: IntArray
    value: IntArray
    pulse: IntArray
    compression: IntArray
    block: IntArray
    decimation: IntArray
    rank: IntArray
    ramp: IntArray
    start: IntArray
    length: IntArray
    interval: IntArray
    window: IntArray
    calibration: BoolArray
    polarization: IntArray
    elevation: IntArray
    azimuth: IntArray
    signal: IntArray
    swath: IntArray
    quads: IntArray

    @classmethod
    def of(cls, headers: np.ndarray[tuple[int, int], np.dtype[np.uint8]], offset: IntArray, size: IntArray) -> Self:
        """Parse headers (n, HEADERS) uint8 of packets."""

        def number(first: int, count: int) -> IntArray:
            value = np.zeros(headers.shape[0], np.int64)
            for column in range(first, first + count):
                value = (value << 8) | headers[:, column]
            return value

        return cls(
            offset=offset, size=size, seconds=number(6, 4), fine=number(10, 2), take=number(16, 4), mode=number(20, 1),
            receiver=number(21, 1) & 15, word=number(26, 1), value=number(27, 2), pulse=number(33, 4),
            compression=number(37, 1) & 31, block=4 * (number(38, 1) + 1), decimation=number(40, 1),
            ramp=number(42, 2), start=number(44, 2), length=number(46, 3), rank=number(49, 1) & 31,
            interval=number(50, 3), window=number(53, 3), calibration=number(59, 1) >= 128,
            polarization=(number(59, 1) >> 4) & 7, elevation=number(60, 1) >> 4, azimuth=number(60, 2) & 1023,
            signal=number(63, 1) >> 4, swath=number(64, 1), quads=number(65, 2),
        )  # fmt: skip

    def __getitem__(self, which: IntArray | BoolArray | slice) -> Packets:
        return Packets(**{each.name: getattr(self, each.name)[which] for each in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Packets]) -> Packets:
        """Join the packets of several files, one after the other."""
        return cls(**{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls)})

    def __len__(self) -> int:
        return self.offset.size

    @cached_property
    def echo(self) -> BoolArray:
        """Mask of packets that hold an echo rather than noise or a calibration pulse."""
        return np.asarray((self.signal == ECHO) & ~self.calibration)

    @property
    def radar(self) -> Radar:
        """Pulse parameters of the first packet."""
        return Radar.of(int(self.ramp[0]), int(self.start[0]), int(self.length[0]), int(self.decimation[0]))

    def times(self, zero: int) -> FloatArray:
        """Times of the packets (n,), s after a GPS second, centred in the resolution of the fine time."""
        return np.asarray((self.seconds - zero) + (self.fine + 0.5) * FINE)


class Radar(NamedTuple):
    """Transmitted pulse and sampling: chirp rate, Hz/s; start frequency, Hz; length, s; sampling rate, Hz."""

    ramp: float
    start: float
    length: float
    rate: float

    @classmethod
    def of(cls, ramp: int, start: int, length: int, decimation: int) -> Radar:
        """Parse the codes of a header (3.2.5.4, 3.2.5.6 to 3.2.5.8).

        Raises
        ------
        InputError
            If they tell no chirp about the carrier.
        """

        def signed(code: int) -> int:
            return (code & 0x7FFF) * (1 if code >> 15 else -1)

        if decimation not in DECIMATION:
            raise InputError(f"the code of decimation is {decimation}, which is not defined; get the file again")
        share, of = DECIMATION[decimation]
        rate = signed(ramp) * REFERENCE**2 / 2**21
        first = rate / (4 * REFERENCE) + signed(start) * REFERENCE / 2**14
        radar = cls(rate, first, length / REFERENCE, 4 * REFERENCE * share / of)
        if not (radar.ramp and radar.length) or abs(radar.middle) > 0.01 * radar.bandwidth:
            raise InputError(
                f"the pulse sweeps {(radar.middle - radar.bandwidth / 2) / 1e6:.6g} .. "
                f"{(radar.middle + radar.bandwidth / 2) / 1e6:.6g} MHz about the carrier, and only chirps about it are "
                "read"
            )
        return radar

    def signed(self, sign: float) -> Radar:
        """Copy about the same frequency whose chirp rises (1) or falls (-1)."""
        ramp = sign * abs(self.ramp)
        return self._replace(ramp=ramp, start=self.middle - ramp * self.length / 2)

    @property
    def bandwidth(self) -> float:
        """Bandwidth, Hz."""
        return abs(self.ramp) * self.length

    @property
    def middle(self) -> float:
        """Frequency at the middle of the pulse off the carrier, Hz."""
        return self.start + self.ramp * self.length / 2


def read_headers(file: BinaryIO, most: int | None = None) -> Packets:
    """Read the headers of a packet file, or only of its first `most` packets.

    Raises
    ------
    InputError
        If it ends within a packet, or holds something else.
    """
    offsets: list[int] = []
    sizes: list[int] = []
    headers: list[bytes] = []
    data, begin, place = b"", 0, 0  # bytes of the file from `begin` on; the next packet
    while most is None or len(offsets) < most:
        if place + HEADERS > begin + len(data):
            file.seek(place)
            data, begin = file.read(AT_ONCE if most is None else 64 * HEADERS), place
            if not data:
                break
        at = place - begin
        header = data[at : at + HEADERS]
        if len(header) < HEADERS:
            raise InputError(f"it ends within the headers of packet {len(offsets)}, at byte {place}; get it again")
        if header[SYNC_AT : SYNC_AT + 4] != SYNC:
            raise InputError(
                f"at byte {place} there is no packet (number {len(offsets)}) of Sentinel-1; get the file again"
            )
        size = 7 + int.from_bytes(header[4:6], "big")
        offsets.append(place)
        sizes.append(size)
        headers.append(header)
        place += size
    if not offsets:
        raise InputError("it is empty; get it again")
    if (end := file.seek(0, 2)) < place:
        raise InputError(
            f"it ends at byte {end}, within packet {len(offsets) - 1}, which goes on to byte {place}; get it again"
        )
    table = np.frombuffer(b"".join(headers), np.uint8).reshape(-1, HEADERS)
    return Packets.of(table, np.array(offsets, np.int64), np.array(sizes, np.int64))


COMPRESSIONS = {0: "bypass", 3: "BAQ 3", 4: "BAQ 4", 5: "BAQ 5", 12: "FDBAQ", 13: "FDBAQ", 14: "FDBAQ"}


def read_samples(file: BinaryIO, packets: Packets) -> ComplexArray:
    """Read samples (n, 2 quads) complex64 of packets with equal numbers of them.

    Raises
    ------
    InputError
        If a packet is damaged, or its compression is unknown.
    """
    from blocksar.kernels import quantised_packets as loops  # with numba, slow to load

    kinds = {0: loops.BYPASS, **{bits: loops.BAQ + bits - 3 for bits in (3, 4, 5)}}
    kinds |= dict.fromkeys((12, 13, 14), loops.FDBAQ)
    quads = int(packets.quads[0])
    out = np.empty((len(packets), 2 * quads), np.complex64)
    codes, amplitudes = loops.code_table(), loops.amplitude_table()
    for row in range(len(packets)):
        mode, block = int(packets.compression[row]), int(packets.block[row])
        if mode not in kinds:
            raise InputError(f"the packet at byte {packets.offset[row]} has BAQ mode {mode}, which is not defined")
        file.seek(int(packets.offset[row]) + HEADERS)
        data = np.zeros(int(packets.size[row]) - HEADERS + loops.PADDING, np.uint8)
        read = file.read(data.size - loops.PADDING)
        data[: len(read)] = np.frombuffer(read, np.uint8)
        marks = np.empty((2, -(-quads // block)), np.int64)
        bits = loops.decode_packet(
            data, len(read), kinds[mode], block, codes, amplitudes, marks, out[row].view(np.float32)
        )
        if bits < 0:
            why = "ends before its last sample" if bits == loops.CUT else "has an undefined Huffman code"
            raise InputError(f"the packet at byte {packets.offset[row]} {why}; get the file again")
    return out
