"""The Doppler centroid of the samples, against the one that track and beam predict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scenes
from samples import N_SCATTERER, clutter

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.errors import InputError
from blocksar.inspection.centroid import Expectation, disagreement, expect, measure_centroid
from blocksar.inspection.samples import SEGMENTS, Inspection, zero_impossible
from blocksar.processors.chain.planning.spectrum_recovery import plan_recovery
from blocksar.processors.chain.steps.recovery import Recovery
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene

# ---------------------------------------------------------------- the Doppler centroid


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    geometry: Geometry
    region: Region
    recovery: Recovery

    @property
    def collection(self) -> Collection:
        return self.geometry.collection

    def expectation(self) -> Expectation:
        region = self.region
        found = expect(self.geometry, self.recovery, yaw=region.yaw, near=region.near, far=region.far)
        assert found is not None
        return found


def plan_of(collection: Collection) -> Plan:
    geometry = Geometry(collection=collection)
    region = plan_region(geometry, None)
    return Plan(geometry=geometry, region=region, recovery=plan_recovery(geometry, region))


def changed(collection: Collection, **fields: Any) -> Collection:
    return Collection(**{**collection.as_dict(), **fields})


def echoes(plan: Plan, thin: Collection, yaw: FloatArray, place: FloatArray, sigma: Any) -> ComplexArray:
    """Simulate targets at yaws and at places 0 .. 1 between near and far range."""
    near, far = plan.region.at(yaw)
    point = plan.geometry.ground_point(near + place * (far - near), yaw)
    return simulate_pulses(thin, point[:, 0], point[:, 1], sigma * np.ones(yaw.size), threads=2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A plan, a few widely spaced range frequencies, and clutter."""

    name: str
    plan: Plan
    thin: Collection
    clutter: ComplexArray


def case_of(name: str) -> Case:
    plan = plan_of(Scene.parse(scenes.scene(**scenes.GEOMETRIES[name])).collection().centred())
    band = plan.collection.range_frequency
    thin = changed(plan.collection, range_frequency=band[:: band.size // 24])
    rng = np.random.default_rng(3)
    yaw = rng.uniform(plan.region.yaw[0], plan.region.yaw[-1], N_SCATTERER)
    sigma = rng.standard_normal(N_SCATTERER) + 1j * rng.standard_normal(N_SCATTERER)
    signal = echoes(plan, thin, yaw, rng.uniform(0.05, 0.95, N_SCATTERER), sigma)
    signal.flags.writeable = False
    return Case(name=name, plan=plan, thin=thin, clutter=signal)


CASES = ("table1", "yaw past 90", "30-degree scan", "motion-compensated, odd pulses, t = 0 off centre")


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return case_of(request.param)


@pytest.fixture(scope="module")
def table1() -> Case:
    return case_of("table1")


def judge(signal: ComplexArray, thin: Collection, plan: Plan) -> str | None:
    found = zero_impossible(signal.copy(), range_frequency=thin.range_frequency, recovery=plan.recovery, threads=2)
    assert not found.outliers
    return disagreement(found, plan.expectation())


@pytest.mark.slow
def test_the_right_track_and_beam_cause_no_disagreement(case: Case) -> None:
    plan, thin = case.plan, case.thin
    assert judge(case.clutter, thin, plan) is None
    rng = np.random.default_rng(2)
    low, high = plan.region.yaw[[0, -1]]
    width = thin.beam_width or 0.0
    for yaw in (
        [(low + high) / 2],
        [low + 0.3 * width],
        [high - 0.01 * width],
        [low + 1.1 * width, (low + high) / 2, high - 0.6 * width],
        [low + 0.2 * width, low + 0.9 * width],
    ):
        place, sigma = rng.uniform(0, 1, len(yaw)), 10 ** rng.uniform(-1, 1, len(yaw))
        assert judge(echoes(plan, thin, np.array(yaw), place, sigma), thin, plan) is None
    noise = clutter(*case.clutter.shape, seed=5) * np.float32(10 * np.sqrt(np.mean(np.abs(case.clutter) ** 2) / 2))
    assert judge(case.clutter + noise, thin, plan) is None


def wrong_plans(collection: Collection) -> dict[str, Collection]:
    track, beam = collection.antenna_position, collection.beam_azimuth
    middle, width = track[collection.n_pulse // 2], collection.beam_width or 0.0
    return {
        "faster": changed(collection, antenna_position=middle + 1.03 * (track - middle)),
        "slower": changed(collection, antenna_position=middle + 0.97 * (track - middle)),
        "beam ahead": changed(collection, beam_azimuth=beam + width),
        "beam behind": changed(collection, beam_azimuth=beam - width),
        "mirrored in x": changed(collection, antenna_position=track * [-1, 1, 1]),
        "mirrored in y": changed(collection, antenna_position=track * [1, -1, 1]),
    }


# These errors shift Doppler by about whole PRFs at some times and by other amounts at others. The least real part is
# then so small that segments of clutter may add up to it: the error is not reported.
UNSEEN = {("30-degree scan", "mirrored in y")}


@pytest.mark.slow
def test_a_wrong_track_or_beam_is_reported(case: Case) -> None:
    for error, collection in wrong_plans(case.plan.collection).items():
        try:
            wrong = plan_of(collection)
        except InputError as refused:  # detected before a sample is read
            assert "PRF" in str(refused) or "swath" in str(refused)
            continue
        said = judge(case.clutter, case.thin, wrong)
        if (case.name, error) in UNSEEN:
            assert said is None
            continue
        assert said is not None, error
        assert "measured Doppler centroid" in said
        assert said.endswith("check antenna_position, beam_azimuth and the sign of the phase")
        assert "\n" not in said


def test_a_phase_of_the_wrong_sign_is_reported(case: Case) -> None:
    said = judge(case.clutter.conj(), case.thin, case.plan)
    assert said is not None
    assert "wanders" in said


def test_the_measured_offset_is_the_doppler_shift(table1: Case) -> None:
    """A Doppler shift of clutter is measured modulo the PRF, and reported beyond a tolerance on either side."""
    plan, thin = table1.plan, table1.thin
    prf, wanted = thin.prf, plan.expectation()
    offsets = {}
    for shift in (0.0, -900.0, 1800.0, 1800.0 + prf, -2500.0):
        turn = np.exp(2j * np.pi * shift * thin.time)[:, None].astype(np.complex64)
        signal = table1.clutter * turn
        found = zero_impossible(signal, range_frequency=thin.range_frequency, recovery=plan.recovery)
        measured = measure_centroid(found, prf=prf)
        offsets[shift] = measured.mean_offset
        assert measured.offset.shape == measured.coherence.shape == (SEGMENTS,)
        assert 0.2 < measured.mean_coherence <= measured.coherence.max() < 1
        np.testing.assert_allclose(np.mean(measured.coherence), measured.mean_coherence, rtol=0.1)
        said = disagreement(found, wanted)
        assert (said is None) is (abs(shift) < 1000)
        if said:
            assert f"lies {abs(measured.mean_offset):.0f} Hz" in said
            assert ("above" in said) is (shift > 0)
    assert offsets[0.0] == pytest.approx(0, abs=0.04 * prf)
    for shift, offset in offsets.items():
        assert (offset - shift - offsets[0.0] + prf / 2) % prf - prf / 2 == pytest.approx(0, abs=0.05)


@pytest.mark.slow
def test_expectations_hold_for_targets_anywhere(table1: Case) -> None:
    plan, thin = table1.plan, table1.thin
    wanted = plan.expectation()
    low, high = plan.region.yaw[[0, -1]]
    width = thin.beam_width or 0.0
    vectors = []
    for yaw in np.linspace(low + 1.001 * width, high - 1.001 * width, 4):
        for place in (0.0, 0.5, 1.0):
            signal = echoes(plan, thin, np.array([yaw]), np.array([place]), 1.0)
            found = zero_impossible(signal, range_frequency=thin.range_frequency, recovery=plan.recovery)
            pairs = np.array(found.pairs)
            vectors.append((pairs[:, 0].sum() + 1j * pairs[:, 1].sum()) / pairs[:, 2].sum())
            lit = np.flatnonzero(pairs[:, 2])
            assert lit.size <= wanted.dwell
    angle = np.angle(vectors) / (2 * np.pi) * thin.prf
    assert wanted.angle[0] - 20 < angle.min() < angle.max() < wanted.angle[1] + 20  # Hz: the band's tails
    assert wanted.real - 0.02 < np.real(vectors).min() < wanted.real + 0.1
    # Targets whose dwell the ends cut are lit outside the whole segments, and reach at least to their edge.
    for yaw, side in ((low + 0.999 * width, 0), (high - 0.999 * width, -1)):
        signal = echoes(plan, thin, np.array([yaw]), np.array([0.5]), 1.0)
        found = zero_impossible(signal, range_frequency=thin.range_frequency, recovery=plan.recovery)
        lit = np.flatnonzero(np.array(found.pairs)[:, 2])
        assert lit[side] == (0, SEGMENTS - 1)[side]
        assert not set(lit) & set(range(*wanted.whole))
        assert min(abs(int(k) - edge) for k in lit for edge in wanted.whole) <= 2


def test_without_a_beam_or_a_whole_dwell_there_is_no_expectation(small_collection: Collection) -> None:
    plan = plan_of(small_collection)
    lit = {"yaw": plan.region.yaw, "near": plan.region.near, "far": plan.region.far}
    assert expect(plan.geometry, plan.recovery, **lit) is not None
    still = plan_of(changed(small_collection, beam_azimuth=np.full(256, np.radians(50)) + 0.1 * small_collection.time))
    assert expect(still.geometry, still.recovery, **lit) is None
    free = Geometry(
        collection=changed(small_collection, beam_width=None, beam_azimuth=np.full(small_collection.n_pulse, np.nan))
    )
    x, y = plan.geometry.ground_point(np.array(12e3), np.radians(50.0))[:2]
    region = plan_region(free, Grid(x - 50, x + 50, 1.0, y - 50, y + 50, 1.0))
    recovery = plan_recovery(free, region)
    assert expect(free, recovery, yaw=region.yaw, near=region.near, far=region.far) is None


def drawn(
    rng: np.random.Generator, *, sweep: float, dwell: float, count: int, decades: float, ends: float, shift: float = 0.0
) -> Inspection:
    """Segments of random targets, a share `ends` of them near the start; PRF and aperture are 1."""
    n = 640
    time = (np.arange(n) + 0.5) / n
    middle = rng.uniform(-dwell / 2, 1 + dwell / 2, count)
    middle[rng.random(count) < ends] %= dwell / 2
    pairs, energy = np.zeros(n, complex), np.zeros(n)
    for at, level in zip(middle, 10 ** rng.uniform(-decades, 0, count), strict=True):
        lit = np.abs(time - at) <= dwell / 2
        pairs[lit] += level * np.exp(2j * np.pi * (shift - sweep * (time[lit] - at) / dwell))
        energy[lit] += level
    sums = np.stack([pairs.real, pairs.imag, energy], axis=1).reshape(SEGMENTS, -1, 3).sum(axis=1)
    return Inspection(n_pulse=4800, n_column=1000, pairs=sums.tolist())


def drawn_expectation(sweep: float, dwell: float) -> Expectation:
    touched = int(np.ceil(dwell * SEGMENTS))
    return Expectation(
        prf=1.0,
        angle=(0.0, 0.0),
        sweep=sweep,
        real=float(np.sinc(sweep)),
        whole=(touched, SEGMENTS - touched),
        dwell=touched + 1,
    )


@pytest.mark.slow
@pytest.mark.parametrize("sweep", [0.3, pytest.param(0.6, marks=pytest.mark.slow), 0.9])
@pytest.mark.parametrize("dwell", [0.1, 0.4])
def test_a_scene_alone_causes_no_disagreement(sweep: float, dwell: float) -> None:
    rng, wanted = np.random.default_rng(11), drawn_expectation(sweep, dwell)
    alarms = sum(
        disagreement(drawn(rng, sweep=sweep, dwell=dwell, count=count, decades=decades, ends=0.5), wanted) is not None
        for count in (2, 3, 6, 30)
        for decades in (1, 4)
        for _ in range(80)
    )
    assert alarms <= 1
    if dwell < 0.2:
        lit = {"sweep": sweep, "dwell": dwell, "count": 200, "decades": 0.5, "ends": 0.0}
        assert all(disagreement(drawn(rng, **lit, shift=shift), wanted) for shift in (-0.4, 0.45) for _ in range(10))


def test_noise_is_not_reported_as_disagreement() -> None:
    rng, wanted = np.random.default_rng(12), drawn_expectation(0.6, 0.05)
    deviation = 1 / np.sqrt(4800 / SEGMENTS * 1000)  # of a sum, relative to its energy
    for _ in range(200):
        sums = rng.normal(0, deviation / np.sqrt(2), (SEGMENTS, 2))
        pairs = np.concatenate([sums, np.ones((SEGMENTS, 1))], axis=1)
        assert disagreement(Inspection(n_pulse=4800, n_column=1000, pairs=pairs.tolist()), wanted) is None
        pairs[:, 0] -= 4 * deviation
        assert disagreement(Inspection(n_pulse=4800, n_column=1000, pairs=pairs.tolist()), wanted) is not None


def test_noise_alone_and_empty_samples_report_nothing(table1: Case) -> None:
    wanted = table1.plan.expectation()
    assert judge(clutter(*table1.clutter.shape, seed=8), table1.thin, table1.plan) is None
    empty = Inspection(n_pulse=4800, n_column=24, pairs=[[0.0, 0.0, 0.0]] * SEGMENTS)
    assert disagreement(empty, wanted) is None
    assert measure_centroid(empty, prf=1.0).mean_coherence == 0
