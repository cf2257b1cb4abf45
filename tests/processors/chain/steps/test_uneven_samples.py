"""Back-projection of uneven pulses and range frequencies: against the double sum, and against the even collection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from turning_beam import around, collection

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.noise import NoiseMap
from blocksar.measurement.figures import ideal_response
from blocksar.processors.exact.sums import form_points

N, STEP, CARRIER = 240, 1 / 750.0, 10e9
EVEN: FloatArray = (np.arange(N) - N / 2) * STEP
STAGGERED = np.cumsum(np.tile([0.9, 1.1, 1.0, 1.15, 0.85], N)[:N]) * STEP
STAGGERED -= STAGGERED.mean()
BAND: FloatArray = (np.arange(96) - 48) * 0.5e6
TIMES = {"even": EVEN, "staggered": STAGGERED, "rows cut out": np.delete(EVEN, np.arange(90, 130))}
BANDS = {
    "even": BAND, "steps off by a third": BAND + 0.15e6 * np.sin(np.arange(96.0)),
    "a gap of 12 %": np.delete(BAND, np.arange(36, 48)),
}  # fmt: skip
KINDS = [(time, band) for time in TIMES for band in BANDS]


def straight(time: FloatArray, band: FloatArray, **fields: Any) -> Collection:
    track = np.stack([0 * time - 8000.0, 120.0 * time, 0 * time + 5000.0], axis=1)
    return Collection(
        carrier=CARRIER, time=time, range_frequency=band, antenna_position=track,
        reference_range=np.linalg.norm(track, axis=1), beam_azimuth=np.full(time.size, np.nan), **fields,
    )  # fmt: skip


def echoes(c: Collection, x: float, y: float) -> np.ndarray:
    away = np.linalg.norm(c.antenna_position - [x, y, c.ground_height], axis=1) - c.reference_range
    return np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(away, c.carrier + c.range_frequency)).astype(np.complex64)


def double_sum(
    c: Collection, signal: np.ndarray, x: FloatArray, y: FloatArray, shares: FloatArray, of_band: FloatArray
) -> np.ndarray:
    """The definition: a mean under given weights of pulses and of frequencies."""
    valid, total = ~np.isnan(signal), np.zeros(x.shape, complex)
    weights = np.outer(shares, of_band) * valid
    for k, (px, py) in enumerate(zip(x, y, strict=True)):
        away = np.linalg.norm(c.antenna_position - [px, py, c.ground_height], axis=1) - c.reference_range
        lit = Geometry(collection=c).beam.is_lit(np.array(px), np.array(py))
        turned = np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(away, c.carrier + c.range_frequency))
        total[k] = (np.where(valid, signal, 0) * turned * weights)[lit].sum() / weights[lit].sum()
    return total


def half_ways(axis: FloatArray) -> FloatArray:
    """Shares by their definition, in a loop."""
    steps, found = np.diff(axis), []
    longest = 2 * np.quantile(steps, 0.75)
    for i in range(axis.size):
        before, after = steps[max(i - 1, 0)], steps[min(i, steps.size - 1)]
        found.append(min(before, longest) / 2 + min(after, longest) / 2)
    return np.array(found)


def noise(c: Collection) -> np.ndarray:
    signal = np.random.default_rng(0).standard_normal((c.n_pulse, 2 * c.n_range_frequency), dtype=np.float32)
    signal = signal.view(np.complex64)
    signal[5], signal[9, 3:20] = np.nan, np.nan
    return signal


@pytest.mark.parametrize(("time", "band"), KINDS[1:])
def test_back_projection_is_the_sum_weighed_by_shares(time: str, band: str) -> None:
    c = straight(TIMES[time], BANDS[band])
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-90, 90, (2, 40))
    signal = noise(c)
    image = form_points(lambda p: signal[p], Geometry(collection=c), x, y, threads=2)
    expected = double_sum(c, signal, x, y, half_ways(c.time), half_ways(c.range_frequency))
    error = np.sqrt(np.mean(np.abs(image - expected) ** 2) / np.mean(np.abs(expected) ** 2))
    assert error < 5e-4  # the spline's, as of an even collection
    target = echoes(c, 30.0, -24.0)
    at = np.array([30.0]), np.array([-24.0])
    assert abs(form_points(lambda p: target[p], Geometry(collection=c), *at, threads=1)[0] - 1) < 1e-3


@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35"])
def test_a_steered_beam_with_lost_pulses_and_frequencies(weighting: str) -> None:
    whole = collection()
    rng = np.random.default_rng(2)
    pulses, columns = (np.sort(rng.permutation(n)[: int(0.8 * n)]) for n in (whole.n_pulse, whole.n_range_frequency))
    by_pulse = ("time", "reference_range", "antenna_position", "beam_azimuth")
    cut = {name: getattr(whole, name)[pulses] for name in by_pulse}
    c = Collection(**{**whole.as_dict(), **cut, "range_frequency": whole.range_frequency[columns]})
    assert not c.even
    w = Weighting.parse(weighting)
    x, y = around(c, rng.uniform(-60, 60, 30), rng.uniform(-50, 50, 30))
    signal = noise(c)
    image = form_points(lambda p: signal[p], Geometry(collection=c), x, y, threads=2, weighting=w)
    f, geometry = c.range_frequency, Geometry(collection=c)
    of_band = half_ways(f) * w.range((2 * f - f[0] - f[-1]) / c.bandwidth)
    for k in range(0, x.size, 5):
        here = np.array(x[k]), np.array(y[k])
        v = geometry.beam.offset(*here, slice(None)) / (c.beam_width or 1.0) * 2
        expected = double_sum(c, signal, x[k : k + 1], y[k : k + 1], half_ways(c.time) * w.azimuth(v), of_band)
        assert abs(image[k] - expected[0]) < 2e-3 * np.abs(image).mean()


def cut_along_the_track(c: Collection, offset: FloatArray) -> FloatArray:
    """The response of a target at (30, -24), dB."""
    signal = echoes(c, 30.0, -24.0)
    image = form_points(
        lambda p: signal[p], Geometry(collection=c), np.full(offset.size, 30.0), -24.0 + offset, threads=1
    )
    return np.asarray(20 * np.log10(np.abs(image)))


@pytest.mark.parametrize("time", ["staggered", "random, 15 %"])
def test_side_lobes_are_those_of_the_even_collection(time: str) -> None:
    jitter = EVEN + STEP * np.random.default_rng(3).uniform(-0.15, 0.15, N)
    offset = np.linspace(-30.0, 30.0, 481)
    found, even = (
        cut_along_the_track(straight(t, BAND), offset)
        for t in (STAGGERED if time == "staggered" else jitter, EVEN)
    )  # fmt: skip
    lobes = (even > -32) & (np.abs(offset) > 4)
    assert np.count_nonzero(lobes) > 50
    peaks = lobes & (even > np.roll(even, 1)) & (even > np.roll(even, -1))
    assert np.abs(found - even)[peaks].max() < 0.5
    assert abs(found[240]) < 0.09  # 1 %


@pytest.mark.parametrize(("time", "band"), [("rows cut out", "a gap of 12 %"), ("staggered", "steps off by a third")])
def test_the_ideal_response_is_that_of_the_collection(time: str, band: str) -> None:
    c = straight(TIMES[time], BANDS[band]).centred()
    rng = np.random.default_rng(4)
    x, y = 30.0 + rng.uniform(-15, 15, 60), -24.0 + rng.uniform(-20, 20, 60)
    expected = double_sum(c, echoes(c, 30.0, -24.0), x, y, half_ways(c.time), half_ways(c.range_frequency))
    found = ideal_response(Geometry(collection=c), (30.0, -24.0), x, y)
    assert np.abs(found - expected).max() < 6e-3


def test_noise_is_predicted_with_shares() -> None:
    c = straight(TIMES["rows cut out"], BANDS["a gap of 12 %"], noise_power=2.0)
    found = NoiseMap.of(Geometry(collection=c), Weighting(), np.ones(c.n_pulse))
    assert found is not None
    pulses, band = half_ways(c.time), half_ways(c.range_frequency)
    expected = 2.0 * (pulses**2).sum() / pulses.sum() ** 2 * (band**2).sum() / band.sum() ** 2
    axis = np.array([0.0, 1.0])
    assert found.over(axis, axis)[0, 0] == pytest.approx(expected, rel=2e-3)
