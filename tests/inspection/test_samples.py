"""Inspection of samples: damage is found, and undamaged samples are left alone."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from samples import clutter

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.inspection.centroid import measure_centroid
from blocksar.inspection.samples import (
    SEGMENTS,
    Inspection,
    describe,
    is_saturated,
    mask_outliers,
    merge,
    refusal,
    zero_impossible,
)
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.steps.recovery import Recovery

CARRIER, STEP = 10e9, 1e6  # Hz


def recovery_of(n_pulse: int, *, seed: int = 0) -> Recovery:
    """A recovery with only the fields that inspection reads; the reference range varies at random."""
    rng = np.random.default_rng(seed)
    return Recovery(
        carrier=CARRIER,
        pulses=Axis(-0.2, 1 / 4e3, n_pulse),
        padded=2 * n_pulse,
        origin=30e3,
        walk=-500.0,
        bulk=np.cumsum(rng.normal(12, 40, n_pulse)),
        derotation=np.array([3.0, 40.0, 25.0, -10.0]),
        doppler=Axis(-4e3, 1.0, 8000),
        n_time=8000,
        band=(-1e3, 1e3),
    )


def frequency(n_column: int, first: int = 0) -> FloatArray:
    return (np.arange(first, first + n_column) - 20) * STEP


def look(signal: ComplexArray, **options: Any) -> tuple[Inspection, ComplexArray]:
    """Return the inspection and the samples as it leaves them."""
    left = signal.copy()
    options = {"recovery": recovery_of(signal.shape[0]), "range_frequency": frequency(signal.shape[1])} | options
    return zero_impossible(left, **options), left


# ---------------------------------------------------------------- The pass against explicit loops


def outliers_of(column: list[float]) -> list[int]:
    """Indices of the impossible samples in a column of moduli; a modulus of 0 marks a missing sample."""
    held = sorted(m for m in column if m > 0)
    if not held:
        return []
    median = (held[(len(held) - 1) // 2] + held[len(held) // 2]) / 2
    n = len(column)
    sides = []
    for p in range(n):
        before = max((column[q] for q in (p - 2, p - 1) if q >= 0), default=0)
        after = max((column[q] for q in (p + 1, p + 2) if q < n), default=0)
        sides.append((before, after))
    suspect = any(
        (m > 0 and m > 100 * max(side)) or (min(side) > 0 and m > 1e8 * min(side))
        for m, side in zip(column, sides, strict=True)
    )
    lone = [p for p in range(n) if max(sides[p]) > 0 and column[p] > 100 * max(*sides[p], median)]
    return sorted({*lone, *(p for p in range(n) if suspect and column[p] > 1e8 * median)})


def slowly(signal: ComplexArray, recovery: Recovery) -> tuple[Inspection, ComplexArray]:
    n_pulse, n_column = signal.shape
    left = signal.copy()
    missing: dict[int, int] = {}
    outliers: dict[int, list[int]] = {}
    empty: list[list[int]] = []
    for p in range(n_pulse):
        if all(value == 0 for value in signal[p]):
            before = empty.pop() if empty and empty[-1][1] == p else [p, p]
            empty.append([before[0], p + 1])
    for p in range(n_pulse):
        for c in range(n_column):
            if not np.isfinite(left[p, c]):
                left[p, c] = 0
                missing[p] = missing.get(p, 0) + 1
    for c in range(n_column):
        moduli = [max(abs(float(s.real)), abs(float(s.imag))) for s in left[:, c]]
        for p in outliers_of(moduli):
            left[p, c] = 0
            outliers.setdefault(p, []).append(c)
    real, imag = np.abs(left.real), np.abs(left.imag)
    extreme = max(real.max(), imag.max())
    advance = np.diff(recovery.bulk + recovery.derotation_cycles(recovery.pulses.values))
    pairs = np.zeros((SEGMENTS, 3))
    segment = np.searchsorted(np.arange(SEGMENTS + 1) * n_pulse // SEGMENTS, np.arange(n_pulse), side="right") - 1
    wide = left.astype(complex)
    for p in range(n_pulse):
        pairs[segment[p], 2] += np.sum(np.abs(wide[p]) ** 2)
        if p + 1 < n_pulse:
            turn = np.exp(-2j * np.pi * advance[p] * (1 + frequency(n_column) / CARRIER))
            product = np.sum(wide[p].conj() * wide[p + 1] * turn)
            pairs[segment[p], :2] += product.real, product.imag
    found = Inspection(
        n_pulse=n_pulse,
        n_column=n_column,
        missing=missing,
        outliers=dict(sorted(outliers.items())),
        empty=empty,
        valid=int(np.count_nonzero(left)),
        extreme=float(extreme),
        at_extreme=(int((real == extreme).sum()), int((imag == extreme).sum())) if extreme else (0, 0),
        pairs=pairs.tolist(),
    )
    return found, left


def same(found: Inspection, wanted: Inspection) -> None:
    assert replace(found, pairs=[]) == replace(wanted, pairs=[])
    scale = max((row[2] for row in wanted.pairs), default=0)
    np.testing.assert_allclose(found.pairs, wanted.pairs, rtol=2e-6, atol=2e-6 * scale)


DAMAGE = st.tuples(
    st.sampled_from([np.nan, np.inf, complex(0, -np.inf), complex(1, np.nan), 0, 90, 130j, 3e4, 1e12, 1e30, -1e38]),
    st.integers(0, 10**6),
    st.integers(1, 3),  # pulses
    st.sampled_from([1, 1, 2, 10**6]),  # columns
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@example(shape=(8, 1), seed=0, levels=False, damage=[(np.nan, 0, 2, 1), (1e30, 2, 3, 1)])  # half of the samples
@example(shape=(13, 2), seed=0, levels=False, damage=[(np.nan, 7, 2, 1), (3e4, 11, 1, 1), (1e12, 0, 3, 2)])
@given(
    shape=st.tuples(st.integers(8, 90), st.sampled_from([1, 2, 31, 32, 33, 70])),
    seed=st.integers(0, 99),
    levels=st.booleans(),
    damage=st.lists(DAMAGE, max_size=8),
)
def test_the_pass_finds_the_same_as_explicit_loops(
    shape: tuple[int, int], seed: int, levels: bool, damage: list[tuple[complex, int, int, int]]
) -> None:
    signal = clutter(*shape, seed=seed)
    if levels:
        signal = np.round(signal.view(np.float32) * 2).clip(-3, 3).view(np.complex64)
    for value, place, pulses, columns in damage:
        p, c = divmod(place % signal.size, shape[1])
        signal[p : p + pulses, c if columns <= 2 else 0 :][:, :columns] = value
    found, left = look(signal)
    wanted, wanted_left = slowly(signal, recovery_of(shape[0]))
    same(found, wanted)
    np.testing.assert_array_equal(left, wanted_left)


@pytest.mark.parametrize("level", [1e-30, 1e-13, 1e14, 1e37])
def test_sums_hold_at_any_level(level: float) -> None:
    signal = clutter(64, 40) * np.float32(level)
    same(look(signal)[0], slowly(signal, recovery_of(64))[0])


def damaged(n_pulse: int, n_column: int) -> ComplexArray:
    """Samples with every kind of damage."""
    signal = clutter(n_pulse, n_column, seed=4).view(np.float32).clip(-1.5, 1.5).view(np.complex64)
    signal[17:20] = np.nan
    signal[40, ::7] = np.inf
    signal[60, 5] = signal[60, 50] = 1e30
    signal[61, 6] = signal[62, 6] = 1e25j
    signal[-1, -1] = 4e3
    return signal


@settings(max_examples=20, deadline=None)
@given(cuts=st.sets(st.integers(1, 69)))
def test_merging_does_not_depend_on_the_grouping(cuts: set[int]) -> None:
    signal = damaged(128, 70)
    whole, left = look(signal)
    assert whole.n_outlier == 5
    assert whole.at_extreme > (100, 100)
    parts, lefts = [], []
    for first, last in pairwise([0, *sorted(cuts), 70]):
        part = np.ascontiguousarray(signal[:, first:last])
        found, part_left = look(part, range_frequency=frequency(last - first, first), first_column=first)
        parts.append(Inspection.from_dict(json.loads(json.dumps(found.as_dict(), allow_nan=False))))
        lefts.append(part_left)
    same(merge(parts), whole)
    same(merge(parts[::-1]), whole)
    np.testing.assert_array_equal(np.hstack(lefts), left)


def test_merging_counts_at_the_higher_extreme() -> None:
    signal = clutter(64, 4).view(np.float32).clip(-1, 1).view(np.complex64)
    lower, _ = look(signal, recovery=None)
    higher, _ = look(signal * np.float32(1.5), recovery=None)
    assert min(lower.at_extreme) > 10
    for parts in ([lower, higher], [higher, lower]):
        found = merge(parts)
        assert (found.extreme, found.at_extreme, found.n_column) == (1.5, higher.at_extreme, 8)
    assert merge([lower, lower]).at_extreme == tuple(2 * count for count in lower.at_extreme)


def test_threads_change_no_bit() -> None:
    signal = damaged(500, 70)
    one, left = look(signal)
    for threads in (2, 3, 5):
        found, also = look(signal, threads=threads)
        assert found == one
        np.testing.assert_array_equal(also, left)


def test_without_a_recovery_there_are_no_pairs() -> None:
    with_pairs, left = look(damaged(128, 70))
    without, also = look(damaged(128, 70), recovery=None)
    assert without == replace(with_pairs, pairs=[])
    np.testing.assert_array_equal(left, also)
    with pytest.raises(ValueError, match="no pulse pairs"):
        measure_centroid(without, prf=1.0)
    with pytest.raises(ValueError, match="not of one phase history"):
        merge([with_pairs, without])


# ---------------------------------------------------------------- Impossible and possible samples


@pytest.mark.parametrize(("times", "found"), [(99.0, False), (101.0, True)])
@pytest.mark.parametrize("pulse", [0, 1, 50, 98, 99])
@pytest.mark.parametrize("highest", ["neighbour", "median"])
def test_an_outlier_stands_a_hundredfold_above_neighbours_and_median(
    times: float, found: bool, pulse: int, highest: str
) -> None:
    signal = np.ones((100, 1), np.complex64)
    near = signal[max(pulse - 2, 0) : pulse + 3]
    near[:] = 0.1
    if highest == "neighbour":
        near[-1 if pulse < 98 else 0] = 3  # two pulses away, or one where two are not possible
    signal[pulse] = -1j * times * (3 if highest == "neighbour" else 1)
    assert look(signal)[0].outliers == ({pulse: [0]} if found else {})
    # The same in a column that is examined because of another sample.
    signal[(pulse + 50) % 100] = 1e12
    assert set(look(signal)[0].outliers) == {(pulse + 50) % 100} | ({pulse} if found else set())


def targets(n_pulse: int, lit: list[tuple[int, int, float]]) -> ComplexArray:
    rng = np.random.default_rng(7)
    signal = np.zeros((n_pulse, 3), np.complex64)
    for first, last, level in lit:
        phase = rng.uniform(0, 1, 3) + np.linspace(0, 9, last - first)[:, None] ** 2
        signal[first:last] += (level * np.exp(2j * np.pi * phase)).astype(np.complex64)
    return signal


def gaps(signal: ComplexArray) -> ComplexArray:
    signal[::2] = np.nan
    return signal


def jammed(signal: ComplexArray, place: Any, level: float) -> ComplexArray:
    signal[place] *= level
    return signal


POSSIBLE: dict[str, ComplexArray] = {
    "a strong target comes and goes": targets(400, [(0, 400, 1.0), (100, 140, 1e4), (250, 252, 1e4)]),
    "80 dB between targets, none elsewhere": targets(400, [(20, 60, 1.0), (300, 340, 1e4), (398, 400, 1e4)]),
    "lit before and after all else": targets(400, [(0, 2, 1e4), (100, 300, 1.0)]),
    "strong and weak ones, every other pulse missing": gaps(targets(400, [(0, 400, 1.0), (100, 140, 1e4)])),
    "clutter": clutter(4000, 200, seed=9),
    "one jammed pulse": jammed(clutter(400, 3), np.s_[200], 30.0),
    "one jammed column": jammed(clutter(400, 3), np.s_[:, 1], 1e6),
    "jammed pulses": jammed(clutter(400, 3), np.s_[200:203], 1e4),
    "one pulse in five": jammed(clutter(400, 3), np.arange(400) % 5 > 0, 0.0),
    "nothing": np.zeros((40, 3), np.complex64),
    "tiny": clutter(400, 3) * np.float32(1e-25),
    "huge": clutter(400, 3) * np.float32(1e37),
}


@pytest.mark.parametrize("name", POSSIBLE)
def test_possible_samples_of_scenes_and_jammers_are_left_alone(name: str) -> None:
    signal = POSSIBLE[name]
    found, left = look(signal, recovery=None)
    assert not found.outliers
    np.testing.assert_array_equal(left, np.nan_to_num(signal, nan=0.0))


def test_damage_is_found_where_neighbours_are_missing_or_damaged() -> None:
    signal = clutter(400, 3)
    signal[98:103, 1] = np.nan
    signal[100, 1] = 1e30
    signal[200:210, 2] = 1e20
    found, left = look(signal)
    assert found.outliers == {100: [1], **{p: [2] for p in range(200, 210)}}
    assert np.abs(left).max() < 10


def test_outliers_are_masked_in_groups_of_pulses() -> None:
    signal = damaged(128, 70)
    found, _ = look(signal)
    rows = signal[50:62].copy()
    mask_outliers(rows, found, pulses=slice(50, 62))
    assert np.argwhere(np.isnan(rows)).tolist() == [[10, 5], [10, 50], [11, 6]]
    np.testing.assert_array_equal(np.nan_to_num(rows, nan=7), np.where(np.isnan(rows), 7, signal[50:62]))


# ---------------------------------------------------------------- Messages


@pytest.mark.parametrize(
    ("name", "signal", "wanted"),
    [
        ("clipped", clutter(400, 30).view(np.float32).clip(-1.5, 1.5).view(np.complex64), True),
        ("clipped here and there", clutter(400, 30).view(np.float32).clip(-2.9, 2.9).view(np.complex64), True),
        ("hardly ever", clutter(400, 30).view(np.float32).clip(-3.6, 3.6).view(np.complex64), False),
        ("not clipped", clutter(400, 30), False),
        ("one bit", np.sign(clutter(400, 30).view(np.float32)).view(np.complex64), False),
        ("one target", targets(4000, [(500, 2500, 1.0)]), False),
        ("one target at the reference", np.full((400, 3), 1 - 1e-5j, np.complex64), False),
        ("nothing", np.zeros((40, 3), np.complex64), False),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_saturation(name: str, signal: ComplexArray, wanted: bool) -> None:
    if name == "one target at the reference":
        signal[1::3] = signal[2::3] = 0.9999999
    found, _ = look(signal, recovery=None)
    assert is_saturated(found) is wanted
    assert any(line.startswith("saturated: ") for line in describe(found)) is wanted


WHOLE = {p: 10 for p in range(12)}


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({}, []),
        ({"missing": WHOLE}, ["12 of 100 pulses are missing: counted as not lit"]),
        ({"missing": {5: 10}}, ["1 of 100 pulses is missing: counted as not lit"]),
        (
            {"missing": {**WHOLE, 40: 9, 41: 4}},
            ["12 of 100 pulses are missing, 13 more samples are not numbers: counted as not lit"],
        ),
        (
            {"missing": WHOLE, "empty": [[3, 5], [20, 30]]},  # the others belong to a beam that lit nothing
            ["12 of 100 pulses are missing (2 hold zeros only): counted as not lit"],
        ),
        ({"missing": {40: 1}}, ["1 sample is not a number: counted as not lit"]),
        ({"outliers": {3: [1]}}, ["1 sample stands 100-fold above its neighbours: counted as not lit"]),
        ({"outliers": {3: [1, 2], 8: [1]}}, ["3 samples stand 100-fold above their neighbours: counted as not lit"]),
        (
            {"at_extreme": (45, 9), "extreme": 127.0},
            [
                "saturated: 5.0% of the real and 1.0% of the imaginary parts stand at the largest value, 127: levels "
                "are too low there, and strong targets smeared"
            ],
        ),
    ],
    ids=str,
)
def test_the_description_lists_missing_samples_outliers_and_saturation(facts: dict[str, Any], said: list[str]) -> None:
    assert describe(Inspection(n_pulse=100, n_column=10, valid=900, **facts)) == said


def test_a_damaged_store_is_refused() -> None:
    few = Inspection(n_pulse=100, n_column=100, valid=9900, outliers={3: list(range(100))})
    assert refusal(few) is None
    assert refusal(Inspection(n_pulse=100, n_column=100)) is None
    said = refusal(replace(few, outliers={3: list(range(100)), 4: [7]}))
    assert said is not None
    assert said.startswith("signal holds 101 impossible samples among 10001 (1.0%)")
    assert "write it again" in said
    assert "\n" not in said
    garbage = np.random.default_rng(0).integers(0, 2**32, (200, 60), np.uint64).astype(np.uint32).view(np.complex64)
    assert refusal(look(garbage, recovery=None)[0]) is not None
