"""Recovery: from folded pulses to the spectrum that a sufficient PRF would have given."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import slow_twins
from steps import collection, explicit_transform, taper, target_at

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import plan_region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.imaging.compression import COMPRESSED_ROWS, RawCompression
from blocksar.kernels import fourier, rows
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.planning.spectrum_recovery import plan_recovery
from blocksar.processors.chain.steps.recovery import Recovery, recover_columns
from blocksar.simulation.scatterers import simulate_pulses

COLUMNS = slice(None, None, 13)  # every 13th range frequency, from the first to nearly the last


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    collection: Collection
    geometry: Geometry
    recovery: Recovery


def case_of(**options: Any) -> Case:
    scene = collection(**options)
    geometry = Geometry(collection=scene)
    grid = None
    if not scene.steered:
        at = target_at(geometry, 30e3, np.radians(50.0))
        grid = Grid(at[0] - 100, at[0] + 100, 1.0, at[1] - 100, at[1] + 100, 1.0)
    return Case(collection=scene, geometry=geometry, recovery=plan_recovery(geometry, plan_region(geometry, grid)))


def samples(case: Case, yaw: float, *, epoch_range: float = 30e3) -> ComplexArray:
    """The samples of one target, (n_pulse, n_column)."""
    point = target_at(case.geometry, epoch_range, yaw)
    signal = simulate_pulses(case.collection, point[:1], point[1:2], np.ones(1, complex))[:, COLUMNS].copy()
    signal.flags.writeable = False
    return signal


def recovered(case: Case, signal: ComplexArray, **options: Any) -> ComplexArray:
    frequency = case.collection.range_frequency[COLUMNS]
    return recover_columns(signal, range_frequency=frequency, recovery=case.recovery, **options).T


def lit_at(case: Case, yaw: float, slow: FloatArray) -> np.ndarray:
    first, last = case.geometry.beam.dwell_at(np.array(yaw), np.zeros(1))
    return (slow + case.geometry.epoch >= first) & (slow + case.geometry.epoch <= last)


def direct(case: Case, yaw: float, *, epoch_range: float = 30e3, smooth: bool = True) -> ComplexArray:
    """The same target seen at the recovered signal's own high rate, straight to its spectrum.

    exp(-4j pi (fc + f) / c (R(t) - origin - walk t)): what is left after the unified walk.
    """
    recovery, scene = case.recovery, case.collection
    slow = recovery.time.values
    point = target_at(case.geometry, epoch_range, yaw)
    rng, _ = case.geometry.range_history(point, slow + case.geometry.epoch)
    cycles = (
        -2
        / SPEED_OF_LIGHT
        * np.multiply.outer(
            scene.carrier + scene.range_frequency[COLUMNS], rng - recovery.origin - recovery.walk * slow
        )
    )
    light = taper(case.geometry, yaw, slow + case.geometry.epoch) if smooth else lit_at(case, yaw, slow)
    # The samples are not folded: the axis covers the whole Doppler band.
    return rows.to_doppler(fourier.unit_phasor(cycles) * light.astype(np.float32), recovery.time, recovery.doppler)


def smooth(case: Case, signal: ComplexArray, yaw: float) -> ComplexArray:
    return signal * taper(case.geometry, yaw, case.collection.time)[:, None].astype(np.float32)


def relative(found: ComplexArray, wanted: ComplexArray, *, ratio: float = 1.0) -> float:
    """Root mean square of the difference over the root mean square of the expected values."""
    return float(np.linalg.norm(found - ratio * wanted) / np.linalg.norm(ratio * wanted))


CASES: dict[str, dict[str, Any]] = {
    "table 1": {},
    "scan reversed": {"steering_deg": -26.23},
    "backwards": {"yaw_deg": 130.0},
    "odd number of pulses": {"n_pulse": 2401},
    "t = 0 off centre": {"middle": 0.13},
    "t = 0 before the collection": {"middle": 0.2, "n_pulse": 2399},
    "constant reference range": {"reference": "constant"},
    "three times the relative bandwidth": {"carrier": 10e9, "bandwidth": 150e6},
    "jerk": {"jerk": (300.0, -400.0, 200.0)},
    "not steered": {"steering_deg": None, "prf": 12e3},
}


@pytest.mark.parametrize("name", CASES)
def test_the_recovered_spectrum_is_that_of_a_sufficient_prf(name: str) -> None:
    """Test the first, a middle and the last fully lit yaw: three places in the band, each folded differently."""
    case = case_of(**CASES[name])
    scene, recovery = case.collection, case.recovery
    assert recovery.doppler.size % 2 == 0
    # A plain sum over pulses, on an axis of more samples: each sample counts for less.
    ratio = recovery.padded / recovery.time.size
    yaws = [np.radians(50.0)]
    if scene.steered:
        assert recovery.doppler.extent > 1.3 * scene.prf  # otherwise recovery is not needed
        beam, half = scene.beam_azimuth, scene.beam_width / 2
        low, high = np.sort(beam[[0, -1]])
        yaws = [low + 1.1 * half, (low + high) / 2 + 0.003, high - 1.1 * half]
    for yaw in yaws:
        signal = samples(case, yaw, epoch_range=30_030.0)
        found = recovered(case, smooth(case, signal, yaw))
        assert relative(found, direct(case, yaw, epoch_range=30_030.0), ratio=ratio) < 2e-6
        # Sharp ends: the two samplings cut the dwell differently, by half a pulse of some 1300 at each end.
        sharp = direct(case, yaw, epoch_range=30_030.0, smooth=False)
        assert relative(recovered(case, signal), sharp, ratio=ratio) < 0.05


def with_reference(case: Case, ranges: FloatArray) -> Case:
    """The same plan for samples with another stored reference range: only a bulk phase per pulse differs."""
    scene = Collection(**{**case.collection.as_dict(), "reference_range": ranges})
    moved = 2 * scene.carrier / SPEED_OF_LIGHT * (ranges - case.collection.reference_range)
    recovery = replace(case.recovery, bulk=case.recovery.bulk + moved)
    return Case(collection=scene, geometry=Geometry(collection=scene), recovery=recovery)


def test_any_reference_range_gives_the_same_spectrum() -> None:
    yaw = np.radians(51.0)
    following = case_of()
    n = following.collection.n_pulse
    wanted = recovered(following, samples(following, yaw))
    wild = following.collection.reference_range + np.random.default_rng(1).normal(0, 50, n)
    for ranges in (np.full(n, 30e3), np.full(n, 29_512.345), wild):
        case = with_reference(following, ranges)
        signal = samples(case, yaw)
        assert relative(recovered(case, signal), wanted) < 1e-6


def test_noise_of_the_track_is_removed_as_bulk_phase() -> None:
    """A track with noise of 1 mm recovers to the spectrum of the smooth track: 0.6 rad r.m.s. is corrected."""
    still = collection()
    shake = 1e-3 * np.random.default_rng(6).standard_normal(still.time.size)[:, None] * [0.6, -0.48, 0.64]
    scene = Collection(**{**still.as_dict(), "antenna_position": still.antenna_position + shake})
    geometry = Geometry(collection=scene)
    case = Case(collection=scene, geometry=geometry, recovery=plan_recovery(geometry, plan_region(geometry, None)))
    assert geometry.track.max_misfit > 1e-3
    yaw = np.radians(50.4)
    found = recovered(case, smooth(case, samples(case, yaw), yaw))
    # Exact at the beam's centre; towards its edges, 2 degrees off, a thirtieth of the noise remains.
    assert relative(found, direct(case, yaw), ratio=case.recovery.padded / case.recovery.time.size) < 0.03


def test_missing_pulses_remove_only_their_own_part() -> None:
    """Samples that are zero remove their own part of the spectrum and nothing else; the energy comes from the rest."""
    case, yaw = case_of(n_pulse=2401), np.radians(50.4)
    signal = samples(case, yaw)
    missing = np.zeros(signal.shape[0], bool)
    missing[np.random.default_rng(2).choice(signal.shape[0], 240, replace=False)] = True
    missing[1150:1240] = True
    kept, gaps = signal.copy(), signal.copy()
    kept[missing], gaps[~missing] = 0, 0
    whole = recovered(case, signal)
    assert relative(recovered(case, kept) + recovered(case, gaps), whole) < 2e-6
    for part in (signal, kept):
        lit = np.count_nonzero(part[:, 0])
        energy = np.sum(np.abs(recovered(case, part)).astype(float) ** 2, axis=1)
        # A plain sum over the padded aperture spreads each pulse evenly over that many bins.
        np.testing.assert_allclose(energy, lit * case.recovery.padded, rtol=1e-5)
    assert not recovered(case, np.zeros_like(signal)).any()


def test_threads_change_no_bit_and_the_input_is_not_modified() -> None:
    case = case_of(n_pulse=2401)
    rng = np.random.default_rng(3)
    signal = (rng.standard_normal((2401, 79)) + 1j * rng.standard_normal((2401, 79))).astype(np.complex64)
    before = signal.copy()
    frequency = case.collection.range_frequency[:79]
    one = recover_columns(signal, range_frequency=frequency, recovery=case.recovery)
    for threads in (2, 3, 5):
        found = recover_columns(signal, range_frequency=frequency, recovery=case.recovery, threads=threads)
        np.testing.assert_array_equal(found, one)
    np.testing.assert_array_equal(signal, before)
    # A column's spectrum does not depend on its neighbours: any groups of columns give the same result.
    part = recover_columns(signal[:, 40:47], range_frequency=frequency[40:47], recovery=case.recovery)
    assert relative(part, one[:, 40:47]) < 1e-6


# -- Sufficient PRF -----------------------------------------------------------------------------------------


def needed(message: str) -> float:
    found = re.search(r"PRF of at least ([0-9.e+]+) Hz is needed", message)
    assert found, message
    return float(found[1])


@pytest.mark.parametrize("options", [{}, {"yaw_deg": 130.0}, {"steering_deg": -26.23}], ids=str)
def test_a_prf_that_is_too_low_is_refused_and_the_stated_prf_suffices(options: dict[str, Any]) -> None:
    duration = 0.3
    with pytest.raises(InputError, match="PRF 4000 Hz is too low") as caught:
        case_of(prf=4000.0, n_pulse=round(duration * 4000), **options)
    named = needed(str(caught.value))
    with pytest.raises(InputError, match="is too low"):
        case_of(prf=0.99 * named, n_pulse=round(duration * 0.99 * named), **options)
    prf = 1.002 * named  # another PRF cuts the dwells slightly differently
    case = case_of(prf=prf, n_pulse=round(duration * prf), **options)
    ratio = case.recovery.padded / case.recovery.time.size
    beam, half = case.collection.beam_azimuth, case.collection.beam_width / 2
    low, high = np.sort(beam[[0, -1]])
    for yaw in (low, low + 1.02 * half, (low + high) / 2, high - 1.02 * half, high):
        for offset in (-60.0, 60.0):
            epoch_range = case.recovery.origin + offset
            signal = smooth(case, samples(case, yaw, epoch_range=epoch_range), yaw)
            wanted = direct(case, yaw, epoch_range=epoch_range)
            # The band nearly fills the PRF: the faint tails of the outermost target fold, 1e-4 of it.
            assert relative(recovered(case, signal), wanted, ratio=ratio) < 2e-4


def test_at_two_thirds_of_the_required_prf_the_spectrum_folds() -> None:
    """The refusal is necessary: a recovery forced at two thirds of that PRF gives a wrong spectrum."""
    good = case_of()
    prf = good.collection.prf / 2
    slow = Collection(
        **{
            **good.collection.as_dict(),
            **{
                name: getattr(good.collection, name)[::2]
                for name in ("time", "reference_range", "antenna_position", "beam_azimuth")
            },
        }
    )
    assert slow.prf == pytest.approx(prf)
    pulses = Axis(good.recovery.pulses.start, 2 * good.recovery.pulses.step, slow.n_pulse)
    recovery = replace(
        good.recovery, pulses=pulses, padded=good.recovery.padded // 2, bulk=good.recovery.bulk[::2].copy()
    )
    folded = Case(collection=slow, geometry=Geometry(collection=slow), recovery=recovery)
    yaw = np.radians(50.0)
    found, wanted = recovered(folded, samples(folded, yaw)), direct(good, yaw, smooth=False)
    assert relative(found, wanted, ratio=recovery.padded / recovery.time.size) > 0.3


# -- Raw echoes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chirp_rate", [12.5e12, -12.5e12])
def test_a_raw_echo_compresses_to_the_phase_history(chirp_rate: float) -> None:
    sampling, pulse_width = 60e6, 4e-6
    scene = collection(n_frequency=500, bandwidth=50e6, n_pulse=1201, prf=4000.0)
    fast_time = 2 * 30e3 / SPEED_OF_LIGHT + (np.arange(600) - 300) / sampling
    band = (np.arange(600) - 300) / 600 * sampling
    frequency = band[np.abs(band) <= abs(chirp_rate) * pulse_width / 2]
    scene = Collection(**{**scene.as_dict(), "range_frequency": frequency, "reference_range": np.full(1201, 30_040.0)})
    point = target_at(Geometry(collection=scene), 30_030.0, np.radians(50.0))
    pulses = [590, 600, 611]
    targets = [(float(point[0]), float(point[1]), 1.0 + 0j)]
    # Simulate an ideal receiver in front of the sampler: sample sixteen times as fast and keep the receiver's band.
    # Otherwise the sharp ends of the chirp would fold back into the band.
    fine = fast_time[0] + np.arange(16 * 600) / (16 * sampling)
    dense = slow_twins.raw_echo(
        scene, targets, fast_time=fine, chirp_rate=chirp_rate, pulse_width=pulse_width, pulses=pulses
    )
    spectrum = explicit_transform(
        dense, Axis(0.0, 1.0, 9600), Axis(-300 / 9600, 1 / 9600, 600), inverse=False, period=1
    )
    echo = explicit_transform(spectrum, Axis(-300 / 600, 1 / 600, 600), Axis(0.0, 1.0, 600), inverse=True, period=9600)
    compression = RawCompression.of(
        fast_time=fast_time,
        chirp_rate=chirp_rate,
        pulse_width=pulse_width,
        range_frequency=frequency,
        reference_range=scene.reference_range,
    )
    wanted = slow_twins.phase_history(scene, targets, pulses)
    for row, pulse in enumerate(pulses):
        found = compression.apply(echo[row : row + 1].astype(np.complex64), pulses=slice(pulse, pulse + 1))[0]
        # The part that still folds, at sixteen times the rate, is 1 / (16 times 200) of the chirp.
        assert np.abs(found - wanted[row]).max() < 0.02
        assert relative(found, wanted[row]) < 0.004
        assert abs(np.vdot(wanted[row], found) / frequency.size - 1) < 2e-3
    gap = echo[:2].astype(np.complex64)
    gap[0], gap[1, 250:290] = np.nan, np.nan  # nothing, and an echo of 200 samples without a fifth of them
    found = compression.apply(gap, pulses=slice(590, 592))
    assert np.isnan(found[0]).all()
    assert abs(np.vdot(wanted[1], found[1]) / frequency.size - 1) < 0.02


@pytest.mark.parametrize("length", [4000, 4608])  # of the transform: as the echo, and padded
def test_compression_keeps_only_a_few_pulses_in_double_precision(length: int) -> None:
    n_pulse, n_time, n_band = 512, 4000, 3 * length // 4
    band = (np.arange(n_band) - n_band // 2) / length * 60e6
    compression = RawCompression.of(
        fast_time=2e-4 + np.arange(n_time) / 60e6, chirp_rate=12.5e12, pulse_width=4e-6,
        range_frequency=band, reference_range=np.linspace(30_000.0, 30_100.0, n_pulse),
    )  # fmt: skip
    rng = np.random.default_rng(2)
    echo = (rng.standard_normal((n_pulse, n_time)) + 1j * rng.standard_normal((n_pulse, n_time))).astype(np.complex64)
    assert compression.length == length
    compression.apply(echo[:40], pulses=slice(0, 40))
    tracemalloc.start()
    found = compression.apply(echo, pulses=slice(0, n_pulse))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak - found.nbytes <= COMPRESSED_ROWS * (2 * 8 * length + 5 * 16 * n_band)
    np.testing.assert_array_equal(found[48:52], compression.apply(echo[48:52], pulses=slice(48, 52)))  # of an FFT


def test_the_padding_leaves_room_on_both_sides_of_the_pulses() -> None:
    """The keystone shifts the ends of a dwell by the band's share of their time: early ends become earlier."""
    case = case_of()
    recovery, band = case.recovery, np.abs(case.collection.range_frequency).max() / case.collection.carrier
    pulses, time = recovery.pulses.values, recovery.time.values
    assert time[0] <= pulses[0] * (1 + band) and time[-1] >= pulses[-1] * (1 + band)
