"""Pulses that hold zeros: lost ones are told from those of a beam that lit nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axis_beams import MODES, axis_collection, spotlight
from strips import strip_collection

from blocksar.arrays import BoolArray, ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.empty_pulses import AT_THE_EDGE, missing_pulses
from blocksar.collection.sublooks import narrowed, whole_beam
from blocksar.simulation.scatterers import simulate_pulses

STRIP = strip_collection(1.0, prf=1000.0)  # a dwell of 150 pulses; targets at y = 0 are lit in pulses 424 .. 575


def signal_of(collection: Collection, x: list[float], y: list[float], *, noise: float = 0.0) -> ComplexArray:
    """Samples of targets of different brightness, m, and of noise of that amplitude."""
    sigma = np.linspace(0.5, 1, len(x)) * np.exp(2j * np.arange(len(x)))
    pulses = slice(0, collection.n_pulse)
    signal = simulate_pulses(collection, np.array(x), np.array(y), sigma, pulses=pulses, threads=1)
    rng = np.random.default_rng(1)
    more = noise * (rng.standard_normal(signal.shape) + 1j * rng.standard_normal(signal.shape))
    return (signal + more).astype(np.complex64)


def judged(
    collection: Collection, signal: ComplexArray, lost: slice | list[int] = slice(0)
) -> tuple[BoolArray, BoolArray]:
    """The pulses with echoes that were lost after all, and those that are found missing."""
    signal = signal.copy()
    before = signal.any(axis=1)
    signal[lost] = 0
    after = signal.any(axis=1)
    missing = missing_pulses(~after, ~np.isnan(signal[:, 0]), collection, lambda pulse: signal[pulse])
    assert not missing[after].any()
    return before & ~after, missing


def steered(mode: str, small: Collection) -> tuple[Collection, ComplexArray]:
    """A collection, and the samples of two targets close to each other that it lights for a part of the time."""
    if mode == "yaw":
        yaw, far = np.radians(50), float(np.sqrt(12_000.0**2 - 5000.0**2))
        return small, signal_of(
            small, [far * np.cos(yaw), (far + 40) * np.cos(yaw)], [far * np.sin(yaw), (far + 40) * np.sin(yaw)]
        )
    collection = axis_collection(mode, n_pulse=1200, side_of_track="right", beam_width=0.004)
    ahead = float(np.hypot(9000, 4000) * np.tan(MODES[mode][0]))
    return collection, signal_of(collection, [9000.0, 9030.0], [ahead, ahead + 8])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [*MODES, "yaw"])
def test_a_steered_beam_may_light_nothing(mode: str, small_collection: Collection) -> None:
    collection, signal = steered(mode, small_collection)
    empty = ~signal.any(axis=1)
    assert 0.1 < empty.mean() < 0.95
    lost, missing = judged(collection, signal)
    assert not lost.any()
    assert not missing.any()


@pytest.mark.parametrize("mode", [*MODES, "yaw"])
@pytest.mark.parametrize("where", ["inside", "first half", "last third"])
def test_zeros_within_dwells_are_missing(mode: str, where: str, small_collection: Collection) -> None:
    collection, signal = steered(mode, small_collection)
    lit = np.flatnonzero(signal.any(axis=1))
    first, count = int(lit[0]), lit.size
    cut = {
        "inside": slice(first + count // 3, first + count // 3 + 9), "first half": slice(0, first + count // 2),
        "last third": slice(first + count - count // 3, None),
    }[where]  # fmt: skip
    lost, missing = judged(collection, signal, cut)
    assert lost.any()
    assert missing[lost].all()
    # Zeros beyond the dwell may be taken along, but not far: they are twice as many as are missing on the average.
    assert np.count_nonzero(missing) <= 2.2 * np.count_nonzero(lost) + 20


@pytest.mark.parametrize("share", [0.5 * AT_THE_EDGE, 1.5 * AT_THE_EDGE])
def test_the_begin_of_a_dwell_is_missed_up_to_the_tolerance(share: float) -> None:
    signal = signal_of(STRIP, [917.0], [0.0])
    lit = np.flatnonzero(signal.any(axis=1))
    lost, missing = judged(STRIP, signal, slice(0, int(lit[0] + share * lit.size)))
    assert missing[lost].all() == (share > AT_THE_EDGE)
    assert missing.any() == (share > AT_THE_EDGE)


def test_land_without_noise_ends_somewhere() -> None:
    rng = np.random.default_rng(3)
    signal = signal_of(STRIP, list(rng.uniform(900, 930, 200)), list(rng.uniform(-40, 40, 200)))
    assert not judged(STRIP, signal)[1].any()
    lost, missing = judged(STRIP, signal, slice(450, 480))
    assert missing[450:480].all()
    assert np.array_equal(missing, lost)


@pytest.mark.parametrize("mode", ["stripmap", "yaw"])
def test_noise_comes_with_every_pulse(mode: str, small_collection: Collection) -> None:
    """40 dB below the targets, in the gap, far from any target and where there is none."""
    collection = STRIP if mode == "stripmap" else small_collection
    n = collection.n_pulse
    signal = signal_of(collection, [917.0], [0.0], noise=0.01)
    cut = [*range(20), *range(n // 2, n // 2 + 30), *range(n - 5, n)]
    lost, missing = judged(collection, signal, cut)
    assert np.count_nonzero(lost) == len(cut)
    assert np.array_equal(missing, lost)


@pytest.mark.slow
def test_every_other_pulse_is_missing_where_a_target_is_lit() -> None:
    signal = signal_of(STRIP, [917.0], [0.0])
    lost, missing = judged(STRIP, signal, list(range(0, STRIP.n_pulse, 2)))
    assert missing[lost].all()
    noisy = signal_of(STRIP, [917.0], [0.0], noise=0.01)
    lost, missing = judged(STRIP, noisy, list(range(0, STRIP.n_pulse, 2)))
    assert np.array_equal(missing, lost)


def test_a_beam_that_is_not_steered_lights_everything() -> None:
    collection = axis_collection().unsteered()
    signal = signal_of(collection, [9000.0], [0.0])
    lost, missing = judged(collection, signal, [*range(14), 200, *range(370, 400)])
    assert np.count_nonzero(lost) == 45
    assert np.array_equal(missing, lost)
    assert not judged(collection, np.zeros_like(signal))[1].any()  # a scene without anything


def test_a_beam_that_stays_on_its_target() -> None:
    collection = spotlight()
    lost, missing = judged(collection, signal_of(collection, [9000.0], [0.0]), [*range(14), 200, 201])
    assert np.array_equal(missing, lost)


def test_pulses_that_are_missing_anyway_tell_nothing() -> None:
    """Beside zeros, and within a dwell."""
    signal = signal_of(STRIP, [917.0], [0.0])
    lit = np.flatnonzero(signal.any(axis=1))
    signal[[lit[0] - 1, lit[0] - 7, lit[-1] + 1, 500]] = np.nan
    assert not judged(STRIP, signal)[1].any()


def test_a_look_is_judged_by_its_whole_beam() -> None:
    for collection in (STRIP, replace(axis_collection("tops"), beam_width=0.02)):
        again = whole_beam(narrowed(collection, 2, 3, -1.0), (2, 3, -1.0))
        assert again.beam_width == collection.beam_width
        assert again.lit_width is None
        assert again.beam_steering is not None
        np.testing.assert_allclose(again.beam_steering, collection.beam_steering, atol=1e-15)
