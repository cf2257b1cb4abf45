"""Packets of quantised samples: what an encoder writes is decoded, and measured packets as another decoder has them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from sentinel1_packets import encoded

from blocksar.arrays import ComplexArray
from blocksar.kernels import quantised_packets as loops
from blocksar.readers.sentinel1.packets import read_headers, read_samples


def decode(data: bytes, kind: int, count: int) -> tuple[ComplexArray, int]:
    out = np.empty(count, np.complex64)
    padded = np.frombuffer(data + bytes(loops.PADDING), np.uint8)
    marks = np.empty((2, -(-count // 256)), np.int64)
    tables = loops.code_table(), loops.amplitude_table()
    return out, loops.decode_packet(padded, len(data), kind, 128, *tables, marks, out.view(np.float32))


@pytest.mark.parametrize("kind", range(loops.KINDS))
@pytest.mark.parametrize("threshold", [2, 9, 140])
def test_what_is_encoded_is_decoded(kind: int, threshold: int) -> None:
    random = np.random.default_rng(10 * kind + threshold)
    levels = loops.amplitude_table()[kind, threshold]
    levels = np.arange(512.0, dtype=np.float32) if kind == 0 else levels[: len(levels.nonzero()[0]) or None]
    levels = np.unique(levels[levels > 0])
    parts = random.choice(levels, (2, 700)) * random.choice([-1, 1], (2, 700))
    samples = (parts[0] + 1j * parts[1]).astype(np.complex64)
    data = encoded(samples, kind, threshold)
    found, bits = decode(data, min(kind, loops.FDBAQ), samples.size)
    np.testing.assert_array_equal(found, samples)
    assert len(data) - 2 < bits / 8 <= len(data)
    assert decode(data[: len(data) // 2], min(kind, loops.FDBAQ), samples.size)[1] == loops.CUT


def test_a_bit_rate_that_is_not_defined_is_told() -> None:
    assert decode(b"\xff" * 4000, loops.FDBAQ, 700)[1] == loops.WRONG_CODE


@pytest.mark.parametrize(
    ("name", "compression"), [("000000-noise", 5), ("000008-txcal", 0), ("000408-echo", 12)], ids=str
)
def test_measured_packets_are_decoded_as_by_another_decoder(name: str, compression: int) -> None:
    folder = os.environ.get("BLOCKSAR_DATA")
    if folder is None or not (path := Path(folder) / "sentinel1" / f"{name}.dat").exists():
        pytest.skip("BLOCKSAR_DATA does not say where measured packets of Sentinel-1 are")
    with path.open("rb") as file:
        packets = read_headers(file)
        samples = read_samples(file, packets)[0]
    assert packets.compression[0] == compression
    with np.load(path.with_suffix(".npz")) as truth:
        np.testing.assert_allclose(samples, truth["udf"], rtol=0, atol=1e-5)  # which rounds amplitudes to float32
    if compression == 12:  # an echo of swath 3: V sent, V received, 10 pulses in the air, 59.4 MHz in 44.2 us
        radar = packets.radar
        assert packets.echo[0] and packets.swath[0] == 2 and packets.rank[0] == 10 and packets.polarization[0] == 7
        assert radar.bandwidth == pytest.approx(59.409e6, rel=1e-4) and abs(radar.middle) < 2e3
        assert packets.times(1276273467)[0] == pytest.approx(61863.5 / 65536)
