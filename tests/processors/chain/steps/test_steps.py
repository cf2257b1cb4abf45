"""A property of every step: simulate a target, apply the step, and the measured line equals the traced one.

Lines are a stationary-phase approximation. They are measured on a smoothly lit target (sin^2 over its dwell), because
sharp ends ring and would hide the last digits. A sharply lit target is then focused and compared with `focus`.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from steps import (
    Complex128Array,
    Planned,
    after_each_step,
    collection,
    compress_range,
    explicit_transform,
    line_of,
    measure_line,
    peak,
    planned,
    rows_to_frequency,
    sampling,
    signal_of,
    slab_of,
    taper,
)

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.method import Method
from blocksar.kernels import fourier, rows
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.steps.azimuth_steps import (
    AzimuthTransform,
    Deramp,
    DopplerResampling,
    DopplerTransform,
    FrequencyPerturbation,
)
from blocksar.processors.chain.steps.chains import steps_of
from blocksar.processors.chain.steps.dwell_gate import DwellGate
from blocksar.processors.chain.steps.lines import Line, RowPolynomial, focus
from blocksar.processors.chain.steps.range_steps import (
    Compression,
    DopplerCompression,
    Keystone,
    RangeCompression,
    ResidualRangeWalk,
)

GEOMETRIES: dict[str, dict[str, Any]] = {
    "table 1": {},
    "scan reversed": {"steering_deg": -26.23},
    "mirrored": {"yaw_deg": -50.0, "velocity": (-40.0, -1300.0, -600.0)},
    "acceleration cancels the Doppler rate": {"yaw_deg": -50.0},
    "backwards": {"yaw_deg": 130.0},
    "t = 0 off centre": {"middle": 0.11},
    "odd numbers of samples": {"n_pulse": 2401, "n_frequency": 81},
    "three times the relative bandwidth": {"carrier": 10e9, "bandwidth": 150e6, "n_frequency": 240},
    "not steered": {"steering_deg": None, "prf": 12e3},
    "jerk": {"jerk": (300.0, -400.0, 200.0)},
    "wobble": {"wobble": (0.015, 0.02, 0.01)},
    "not steered, wobble": {"steering_deg": None, "prf": 12e3, "wobble": (0.015, 0.02, 0.01)},
}
METHODS: dict[str, dict[str, Any]] = {  # on Table 1's geometry, unless another is named
    "closed form": {"coefficients": "closed-form"},
    "resampling": {"processor": "keystone-resampling"},
    "resampling, closed form": {"processor": "keystone-resampling", "coefficients": "closed-form"},
    "resampling, scan reversed": {"processor": "keystone-resampling"},
    "resampling, not steered": {"processor": "keystone-resampling"},
    "resampling, acceleration cancels the Doppler rate": {"processor": "keystone-resampling"},
    "resampling, wobble": {"processor": "keystone-resampling"},
    "high order phase, wobble": {"processor": "high-order-phase"},
    "high order phase": {"processor": "high-order-phase"},
    "high order phase, closed form": {"processor": "high-order-phase", "coefficients": "closed-form"},
    "high order phase, scan reversed": {"processor": "high-order-phase"},
    "high order phase, not steered": {"processor": "high-order-phase"},
    "high order phase, odd numbers of samples": {"processor": "high-order-phase"},
    "high order phase, three times the relative bandwidth": {"processor": "high-order-phase"},
    "no keystone": {"keystone": False},
    "frequency perturbation only": {"processor": "keystone-resampling", "perturbation": "frequency"},
    "no perturbation": {"perturbation": "none"},
}
EVERY = [*GEOMETRIES, *METHODS]
# Fractions 0 .. 1 across the block's yaws and ranges: off centre, where every coefficient counts.
PLACES = {"near, low yaw": (0.04, 0.15), "far, high yaw": (0.93, 0.8)}
# At either place every other geometry and method.
LINES = [
    pytest.param(name, at, id=f"{name}-{where}")
    for name, (where, at) in zip(EVERY, itertools.cycle(PLACES.items()), strict=False)
]


@lru_cache(maxsize=2)
def case_of(name: str) -> Planned:
    scene = collection(**GEOMETRIES.get(name.split(", ", 1)[-1], {}))
    return planned(scene, blocks=3 if scene.steered else 1, method=Method(**METHODS.get(name, {})))


def inner(values: FloatArray) -> FloatArray:
    """Without an eighth of the dwell at each end, which are three of 16 nodes."""
    ends = round(3 / 16 * values.size)
    return values[ends : values.size - ends]


def place_of(case: Planned, place: tuple[float, float]) -> tuple[float, float]:
    """(epoch range, yaw) of a target."""
    yaw = case.plan.low + (case.plan.high - case.plan.low) * place[0]
    near, far = case.region.at(np.array([yaw]))
    return float(near[0] + (far[0] - near[0]) * place[1]), yaw


DOPPLER_STEPS = (AzimuthTransform, DopplerCompression, FrequencyPerturbation, DopplerResampling)


def compressed(case: Planned, step: Any) -> bool:
    """Whether rows are ranges after a step, rather than range frequencies."""
    chain = case.plan.chain
    return chain.index(step) >= next(i for i, s in enumerate(chain) if isinstance(s, Compression))


def as_frequency(case: Planned, step: Any, samples: Any) -> tuple[Complex128Array, FloatArray]:
    """Samples after a step as S(range frequency, slow time), and the frequencies."""
    if isinstance(step, DOPPLER_STEPS):
        samples = rows.to_time(samples, case.plan.sampling.doppler, case.plan.sampling.long_time)
    if not compressed(case, step):
        return samples, case.collection.range_frequency
    compression = next(s for s in case.plan.chain if isinstance(s, Compression))
    return rows_to_frequency(samples, case.plan.sampling.rows, compression.period)


def time_of(case: Planned, step: Any) -> Axis:
    """Slow-time axis of `as_frequency`."""
    inside = isinstance(step, (*DOPPLER_STEPS, Deramp, DopplerTransform))
    return case.plan.sampling.long_time if inside else case.plan.sampling.time


def amplitude_of(case: Planned, step: Any) -> float:
    """Amplitude of a unit target: recovery and transforms between axes of different lengths change it."""
    level = case.recovery.padded / case.plan.sampling.time.size
    return level * case.plan.ground.scale if compressed(case, step) else level


@pytest.mark.parametrize(("name", "place"), LINES)
def test_after_every_step_the_measured_line_equals_the_traced_one(name: str, place: tuple[float, float]) -> None:
    case = case_of(name)
    at = place_of(case, place)
    cell = SPEED_OF_LIGHT / (2 * case.collection.bandwidth)
    line = line_of(case, *at)
    lit = taper(case.geometry, at[1], line.time + case.geometry.epoch)
    slab = slab_of(case, signal_of(case, *at, tapered=True))

    def check(step: Any, samples: Any, line: Line, *, time: Axis, name: str) -> None:
        values, frequency = as_frequency(case, step, samples)
        found = measure_line(values, line, time=time, frequency=frequency, cell=cell)
        # Stationary phase is accurate to 1e-3 rad here; before SRC the range response is not quite symmetric.
        assert np.abs(inner(found.phase)).max() * 2 * np.pi < 7e-3, name
        assert np.abs(inner(found.doppler)).max() < 0.2, name  # Hz; the dwell resolves 6
        assert np.abs(inner(found.range)).max() < 0.005 * cell, name
        wanted = amplitude_of(case, step) * lit / np.sqrt(line.stretch)
        # The taper is read at the sample nearest to the node.
        assert np.abs(inner(found.amplitude) / inner(wanted) - 1).max() < 0.025, name

    axes = case.plan.sampling
    recovered = rows.to_time(slab, axes.slab, axes.time)
    check(case.plan.chain[0], recovered, line, time=axes.time, name="recovery")
    seen = []
    for step, samples, traced in after_each_step(case, slab, line):
        seen.append(type(step))
        if isinstance(step, DopplerTransform):
            assert traced is line
            continue
        check(step, samples, traced, time=time_of(case, step), name=step.name)
        line = traced
    method = Method(**METHODS.get(name, {}))
    assert tuple(seen) == steps_of(method, measured="wobble" in name)
    if not method.variant:
        assert np.ptp(line.doppler) < (4.0 if "wobble" in name else 0.5)  # Hz: level, the purpose of the chain


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table 1", "not steered", "resampling"])
def test_the_perturbed_spectrum_equals_the_line_along_doppler(name: str) -> None:
    """In the Doppler domain: at f = line.doppler the phase is phase - f t +- 1/8 and the group delay is t."""
    case, kind = case_of(name), DopplerResampling if name == "resampling" else FrequencyPerturbation
    at = place_of(case, PLACES["near, low yaw"])
    line = line_of(case, *at)
    lit = taper(case.geometry, at[1], line.time + case.geometry.epoch)
    slab = slab_of(case, signal_of(case, *at, tapered=True))
    step, samples, line = next(each for each in after_each_step(case, slab, line) if type(each[0]) is kind)
    compression = next(s for s in case.plan.chain if isinstance(s, Compression))
    axes = case.plan.sampling
    values, frequency = rows_to_frequency(samples, axes.rows, compression.period)
    spectrum = compress_range(values, frequency, np.full((1, axes.doppler.size), line.range.mean()))[0]
    long = axes.long_time
    signal = explicit_transform(spectrum[None], axes.doppler, long, inverse=True, period=long.size)[0]

    def at_doppler(f: FloatArray) -> Complex128Array:
        cycles = np.multiply.outer(f, long.values)
        return np.exp(-2j * np.pi * (cycles - np.rint(cycles))) @ signal

    wanted = line.phase - line.doppler * line.time + np.sign(line.rate) / 8
    found = at_doppler(line.doppler) * np.exp(-2j * np.pi * wanted)
    assert np.abs(np.angle(found[4:12])).max() < 0.025
    level = amplitude_of(case, step) * lit / np.sqrt(line.stretch * np.abs(line.rate)) / axes.time.step
    np.testing.assert_allclose(np.abs(inner(found)), inner(level), rtol=0.03)
    h = 0.01  # Hz
    delay = -np.angle(at_doppler(line.doppler + h) * at_doppler(line.doppler - h).conj()) / (4 * np.pi * h)
    # Without a bias chirp the lines are short, and stationary phase is less accurate.
    tolerance = {"high order phase": 8e-4, "not steered": 4e-4}.get(name, 2e-4)
    np.testing.assert_allclose(inner(delay), inner(line.time), atol=tolerance)


# Lines of every case are measured after every step above.
FOCUSED = [
    "table 1", "three times the relative bandwidth", "not steered, wobble", "acceleration cancels the Doppler rate",
    "resampling, scan reversed", "high order phase, wobble",
]  # fmt: skip


@pytest.mark.parametrize("name", FOCUSED)
def test_a_target_focuses_as_its_line_predicts(name: str) -> None:
    """For a sharply lit target, compare place, phase and gain of the peak, and its line after each step to 0.02 rad."""
    case = case_of(name)
    at = place_of(case, (0.3, 0.6))
    cell = SPEED_OF_LIGHT / (2 * case.collection.bandwidth)
    signal = signal_of(case, *at, tapered=False)
    for step, samples, line in after_each_step(case, slab_of(case, signal), line_of(case, *at)):
        values, frequency = as_frequency(case, step, samples)
        if not isinstance(step, DopplerTransform):
            found = measure_line(values, line, time=time_of(case, step), frequency=frequency, cell=cell)
            assert np.abs(inner(found.phase)).max() * 2 * np.pi < 0.02, step.name
            assert np.abs(inner(found.range)).max() < 0.01 * cell, step.name
    # After the gate, the signal along Doppler is short, about t = 0, under a phase that all rows share.
    final = case.plan.sampling
    held = final.long_time if final.gate is None else final.gate.time
    in_time = rows.to_time(values.astype(np.complex64), final.image_doppler, held).astype(np.complex128)
    spot = focus(line)
    given, delay = 0.0, 0.0
    if final.gate is not None:
        given, delay, _ = (v.item() for v in final.gate.common.evaluate(spot.range, spot.doppler[None]))
    dwell = np.sum(line.weight * line.stretch)

    def response(doppler: FloatArray, rng: FloatArray) -> Complex128Array:
        cycles = np.multiply.outer(held.values, doppler)
        cut = in_time @ np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
        return np.exp(4j * np.pi / SPEED_OF_LIGHT * np.multiply.outer(rng, frequency)) @ cut / frequency.size

    around = np.linspace(-0.4, 0.4, 17)
    along = np.abs(response(spot.doppler + around / dwell, np.array([spot.range])))[0] ** 2
    across = np.abs(response(np.array([spot.doppler]), spot.range + around * cell))[:, 0] ** 2
    # A hundredth of a resolution cell: with cells of 1.9 m and 3 m, 2 and 3 cm.
    assert abs(peak(along, around)) < 0.01
    assert abs(peak(across, around)) < 0.01
    lit = np.count_nonzero(signal[:, 0])
    value = response(np.array([spot.doppler]), np.array([spot.range]))[0, 0] / (lit * case.plan.ground.scale)
    value *= np.exp(-2j * np.pi * (spot.phase + given)) / spot.gain
    assert abs(np.angle(value)) < 5e-3
    # Up to 1e-3 of a target's energy may lie outside its block's Doppler support. The gate's edges are soft, and lie at
    # other times at the ends of a wide band. Without keystone the residual walk smears the target in range, which lines
    # do not include.
    soft = {"no keystone": 0.05, "high order phase, wobble": 6e-3}
    tolerance = soft.get(name, 7e-3 if "three times the relative bandwidth" in name else 4e-3)
    assert abs(np.abs(value) - 1) < tolerance
    # The geometric correction removes this carrier along Doppler: the dwell's middle, less the common delay.
    behind, ahead = response(spot.doppler + np.array([-0.01, 0.01]), np.array([spot.range]))[0]
    middle = -np.angle(ahead * behind.conj()) / (2 * np.pi * 0.02)
    assert middle == pytest.approx(spot.time - delay, abs=0.01 * dwell)


def test_no_step_depends_on_the_number_of_threads_or_modifies_its_input() -> None:
    case = case_of("odd numbers of samples")
    rng = np.random.default_rng(5)
    shape = (case.collection.n_range_frequency, case.plan.n_bin)
    samples = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    for step in case.plan.chain:
        samples.flags.writeable = False
        one = step.apply(samples, threads=1)
        for threads in (2, 3):
            np.testing.assert_array_equal(step.apply(samples, threads=threads), one)
        assert one.dtype == np.complex64
        samples = one


# -- The dwell gate -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("growth", [0.0, 1e-5])  # s/Hz: the dwell's length changes by a tenth over 600 Hz
@pytest.mark.parametrize("slope", [-2e-4, 1.5e-4])  # s/Hz: the dwell's middle moves by 0.16 s over 800 Hz of Doppler
def test_the_gate_keeps_at_each_doppler_the_time_about_its_own_middle(slope: float, growth: float) -> None:
    """Compare with S(f) = sum over |t - c(f)| <= L(f) / 2 of x(t) exp(-2j pi f t), c and L linear, sample by sample."""
    length = 0.06
    time = fourier.centred(0.02, 1 / 1000, 500)
    doppler = fourier.dual(time, size=500, centre=0.0)
    ranges = Axis(-10.0, 5.0, 4)
    first = 0.013

    def row_polynomial(*powers: float) -> RowPolynomial:
        return RowPolynomial(series=np.array([powers]), near=-10.0, far=5.0, centre=0.0, scale=100.0)

    def phase(slope: float) -> RowPolynomial:
        """psi, with psi' = first + slope f."""
        return row_polynomial(0.0, first * 100, slope * 100**2 / 2)

    common = row_polynomial(0.0, 0.9 * first * 100, 0.9 * slope * 100**2 / 2)  # the part that all rows share
    gate = DwellGate(
        begin=phase(slope - growth / 2),
        end=phase(slope + growth / 2),
        common=common,
        begin_slope=row_polynomial(slope - growth / 2),
        end_slope=row_polynomial(slope + growth / 2),
        blur=time.step / 2,
        lift=0.0,
        length=length,
        time=fourier.centred(0.0, time.step, 400),
    )
    axes = sampling(long_time=time, focused_doppler=doppler, rows=ranges, gate=gate)
    step = DopplerTransform(sampling=axes)
    rng = np.random.default_rng(0)
    samples = (rng.standard_normal((4, 500)) + 1j * rng.standard_normal((4, 500))).astype(np.complex64)
    image = axes.image_doppler
    assert image.size == 400 and image.extent == pytest.approx(doppler.extent)
    found = step.apply(samples, threads=1)
    f, t = image.values, time.values
    given = common.evaluate(np.array(0.0), f)[0]
    kernel = np.exp(-2j * np.pi * np.multiply.outer(t, f))
    # A sharp gate cannot be sampled: at its edge a sample counts by the share that is lit.
    edge = ((length + growth * f) / 2 - np.abs(t[:, None] - (first + slope * f))) / time.step + 0.5
    wanted = samples @ (kernel * np.clip(edge, 0, 1)) * np.exp(2j * np.pi * given)
    inner = np.abs(f) < 300  # the windows of the outermost Dopplers reach beyond the samples' time, or wrap in Doppler
    error = np.sqrt(np.mean(np.abs(found - wanted)[:, inner] ** 2) / np.mean(np.abs(wanted[:, inner]) ** 2))
    assert error < 0.1
    # Without a gate the result is the plain transform.
    plain = DopplerTransform(sampling=replace(axes, gate=None)).apply(samples, threads=1)
    assert np.abs(plain - explicit_transform(samples, time, doppler, inverse=False, period=500)).max() < 1e-4


# -- Single steps, without a plan ---------------------------------------------------------------------------

CARRIER, BANDWIDTH, N_FREQUENCY = 10e9, 400e6, 64
FREQUENCY = fourier.centred(0.0, BANDWIDTH / N_FREQUENCY, N_FREQUENCY)
TIME = fourier.centred(0.0, 1 / 60e3, 6000)  # 0.1 s, at a rate that holds the Doppler of 300 m/s


def echo(rng: FloatArray) -> np.ndarray:
    """S(f, t) for a range history relative to the origin."""
    cycles = -2 / SPEED_OF_LIGHT * np.multiply.outer(CARRIER + FREQUENCY.values, rng)
    samples = fourier.unit_phasor(cycles)
    samples.flags.writeable = False
    return samples


def peaks(samples: np.ndarray, times: np.ndarray, near: FloatArray) -> FloatArray:
    """Range of the envelope's peak at the given time samples, m."""
    around = np.linspace(-0.2, 0.2, 41)
    power = np.abs(compress_range(samples[:, times], FREQUENCY.values, near + around[:, None])) ** 2
    return near + np.array([peak(column, around) for column in power.T])


@pytest.mark.parametrize("speed", [-300.0, -20.0, 0.0, 45.0, 290.0])  # m/s: up to 30 m, 80 cells, in the dwell
def test_the_keystone_straightens_any_linear_walk(speed: float) -> None:
    t, cell = TIME.values, SPEED_OF_LIGHT / (2 * BANDWIDTH)
    samples = echo(1.7 + speed * t)
    axes = sampling(time=TIME, range_frequency=FREQUENCY, time_occupancy=0.75)
    keystone = Keystone(carrier=CARRIER, sampling=axes)
    straight = keystone.apply(samples, threads=1)
    times = np.arange(200, 5800, 400)  # the outermost 2 % come from beyond the ends at half of the frequencies
    assert np.ptp(peaks(straight, times, np.full(times.size, 1.7))) < 0.01 * cell
    middle = N_FREQUENCY // 2  # f = 0: the keystone does not change the carrier
    assert np.abs(straight[middle] - samples[middle])[20:-20].max() < 1e-3
    # Nothing wraps: values from beyond an end are zero.
    scale = CARRIER / (CARRIER + FREQUENCY.values[0])
    beyond = np.abs(t * scale) > np.abs(t[0]) + 10 * TIME.step
    assert beyond.any() and (straight[0, beyond] == 0).all()


def test_the_residual_walk_is_removed_over_the_whole_band() -> None:
    """From Doppler to time with the walk removed at each frequency, not only at the carrier."""
    t = TIME.values
    speed = 37.3  # m/s
    doppler = fourier.dual(TIME, size=TIME.size, centre=-2 * CARRIER / SPEED_OF_LIGHT * speed)
    spectrum = rows.to_doppler(echo(1.7 + speed * t), TIME, doppler)
    step = ResidualRangeWalk(
        walk=-2 * CARRIER / SPEED_OF_LIGHT * speed, carrier=CARRIER,
        sampling=sampling(slab=doppler, time=TIME, range_frequency=FREQUENCY),
    )  # fmt: skip
    assert np.abs(step.apply(spectrum, threads=1) - echo(1.7 + 0 * t)).max() < 1e-4


def test_range_compression_straightens_its_reference_exactly() -> None:
    """All orders at once, without an expansion in f / fc: the keystoned reference becomes one row, phase included."""
    reference = np.array([0.0, 0.0, 18.0, -40.0, 300.0])
    t, f = TIME.values, FREQUENCY.values
    # After keystone, order n of the range has become (fc + f) (fc / (fc + f))^n: paper A (18).
    order = np.arange(5)
    scaled = ((1 + f / CARRIER)[:, None] ** (1 - order)) * reference
    cycles = -2 * CARRIER / SPEED_OF_LIGHT * (scaled @ t ** order[:, None])
    cell = SPEED_OF_LIGHT / (2 * BANDWIDTH)
    period = 96
    ranges = Axis(-20 * cell, cell * N_FREQUENCY / period, 60)
    axes = sampling(time=TIME, range_frequency=FREQUENCY, rows=ranges)
    step = RangeCompression(carrier=CARRIER, reference=reference, sampling=axes)
    found = step.apply(fourier.unit_phasor(cycles), threads=1)
    # The profile of one row times the phase of the carrier at each time.
    profile = compress_range(np.ones((N_FREQUENCY, 1)), f, ranges.values[:, None]) * N_FREQUENCY / period
    carrier = -2 * CARRIER / SPEED_OF_LIGHT * (reference @ t ** order[:, None])
    assert np.abs(found - profile * np.exp(2j * np.pi * carrier)).max() < 1e-5
