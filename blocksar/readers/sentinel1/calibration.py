"""The instrument's internal delay, measured by calibration pulses.

An echo takes as much longer than its way as the pulse needs from the generator to the antenna, and the echo from the
antenna to the converter: 0.43 us, 65 m of range. Calibration pulses go around parts of this path (signal types of
S1-IF-ASD-PL-0007, 3.2.5.14.3): by the transmit chain (tx), by the receive chain (rx), and past one or the other (epdn,
apdn, ta), each once through generator, coupling network and converter. Of their delays

    tx + rx - epdn + ta - apdn

is the way of an echo once: what is outside of both chains is added and taken off again. That is how the gains and
positions of these pulses are combined to a replica (Sentinel-1 Level 1 Detailed Algorithm Definition, 4.2.1.4, as the
open processor FastSAR cites it: of a data take of 2014 it finds 429.7 ns so, and ESA's product annotates 433.2 ns as
`internalTimeDelay`). Later satellites have no apdn, and their code of ta has another meaning: without apdn, both are
left out. Transmit pulses alone go once through everything but the receive chain's own part, and are taken where others
lack.

The receive window of a calibration pulse opens with the transmission, other than its header says, whose start of the
window is that of echoes. The first sample is taken for the beginning of the transmission, by which a measured transmit
pulse of stripmap comes 439.0 ns later; with what the decimation's filter suppresses it would be 1505 ns, which
contradicts the annotated delays.

The delay is where the correlation with the nominal chirp peaks. The measured pulse departs from that chirp by 1.5
degrees rms over the band, and compressed by it has side lobes of -13.05 dB instead of -13.24: the nominal chirp serves
as replica. How much of the delay lies before the mixer is not known: it shifts samples, and not the carrier's phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.places.ranges import Readable
from blocksar.readers.sentinel1.packets import Packets, Radar, read_samples

TX, RX, EPDN, TA, APDN = 8, 9, 10, 11, 12  # signal types
MOST = 16  # pulses of a type that are read
LONGEST = 2e-6  # s, longest plausible delay
ALIKE = 0.5  # of a pulse's power, which at least is that of the chirp
FINER = 20  # steps of a sample, between which the peak is a parabola
USUAL = 433e-9  # s, annotated in a level 1 product


class InternalDelay(NamedTuple):
    """Internal delay, s; types and number of the pulses that show it, and whether they have the echoes' chirp."""

    seconds: float
    types: str
    pulses: int
    same_chirp: bool


def internal_delay(sources: Sequence[tuple[Readable, Packets]], echoes: Packets) -> InternalDelay | None:
    """Measure the delay of the echoes' receiver by calibration pulses in files; None without usable ones.

    Raises
    ------
    InputError
        If a calibration pulse is damaged.
    """
    for same_chirp in (True, False):
        found: dict[int, list[float]] = {}
        for where, packets in sources:
            of_it = packets.receiver == echoes.receiver[0]
            if same_chirp:
                of_it &= _same_chirp(packets, echoes)
            for kind in (TX, RX, EPDN, TA, APDN):
                rows = np.flatnonzero(of_it & (packets.signal == kind))
                found.setdefault(kind, []).extend(_delays(where, packets, rows))
        if found_delay := _combined(found, same_chirp):
            return found_delay
    return None


def _combined(found: dict[int, list[float]], same_chirp: bool) -> InternalDelay | None:
    delay = {kind: float(np.median(values)) for kind, values in found.items() if values}
    if TX not in delay:
        return None
    seconds, types, used = delay[TX], "tx", [TX]
    if {RX, EPDN} <= delay.keys():
        seconds, types, used = seconds + delay[RX] - delay[EPDN], "tx + rx - epdn", [TX, RX, EPDN]
        if {TA, APDN} <= delay.keys():
            seconds, types, used = seconds + delay[TA] - delay[APDN], f"{types} + ta - apdn", [*used, TA, APDN]
    return InternalDelay(seconds, types, sum(len(found[kind]) for kind in used), same_chirp)


def _same_chirp(packets: Packets, echoes: Packets) -> BoolArray:
    same = np.ones(len(packets), bool)
    for name in ("ramp", "start", "length", "decimation"):
        same &= getattr(packets, name) == getattr(echoes, name)[0]
    return same


def _delays(where: Readable, packets: Packets, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[float]:
    """Delays, s, of those packets' pulses in which the chirp is found."""
    chosen = rows[np.unique(np.linspace(0, rows.size - 1, min(rows.size, MOST)).astype(int))] if rows.size else rows
    delays: list[float] = []
    if chosen.size:
        with where.open() as file:
            for row in chosen:
                one = packets[row : row + 1]
                if (delay := pulse_delay(read_samples(file, one)[0], one.radar)) is not None:
                    delays.append(delay)
    return delays


def pulse_delay(samples: ComplexArray, radar: Radar) -> float | None:
    """Time, s, from the first of samples (n,) to the beginning of the chirp; None if not found within LONGEST."""
    time = np.arange(int(radar.length * radar.rate) + 1) / radar.rate
    chirp = np.exp(2j * np.pi * (radar.start * time + radar.ramp / 2 * time**2))
    power = float((np.abs(samples) ** 2).sum())
    if samples.size < time.size / 2 or not power > 0:
        return None
    size = fast_length(samples.size + time.size)
    both = np.zeros((2, size), np.complex128)
    both[0, : samples.size], both[1, : time.size] = samples, chirp
    received, sent = fft_rows(both, inverse=False)
    spectrum = received * np.conj(sent)
    cycles = np.arange(size) / size
    frequency = radar.rate * (cycles - (cycles >= 0.5))
    coarse = np.abs(fft_rows(spectrum[None].copy(), inverse=True)[0])
    peak = int(coarse.argmax())
    late = (peak if peak < size // 2 else peak - size) / radar.rate
    near: FloatArray = late + np.arange(-FINER, FINER + 1) / (FINER * radar.rate)
    fine = np.array([abs((spectrum * np.exp(2j * np.pi * frequency * each)).sum()) for each in near]) / size
    i = int(np.clip(fine.argmax(), 1, near.size - 2))
    low, middle, high = fine[i - 1 : i + 2]
    delay = float(near[i]) + (low - high) / (2 * (low - 2 * middle + high)) / (FINER * radar.rate)
    if middle**2 < ALIKE * power * time.size or abs(delay) > LONGEST:
        return None
    return float(delay)
