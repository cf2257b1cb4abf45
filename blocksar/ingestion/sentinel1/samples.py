"""Samples of packets, decoded."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.errors import InputError
from blocksar.ingestion.sentinel1.packets import HEADERS, Packets

COMPRESSIONS = {0: "bypass", 3: "BAQ 3", 4: "BAQ 4", 5: "BAQ 5", 12: "FDBAQ", 13: "FDBAQ", 14: "FDBAQ"}


def read_samples(file: BinaryIO, packets: Packets) -> ComplexArray:
    """Read the samples (n, 2 quads) complex64 of packets that have as many.

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
