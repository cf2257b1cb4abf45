"""The range gate against its definition, target by target and sum by sum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from steps import Complex128Array

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import Axis
from blocksar.kernels.rows import Program
from blocksar.processors.chain.planning.gating import plan_range_gate
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.range_gate import RangeGate


def gate_of(n: int, kept: int, centre: FloatArray, *, offset: int = 0, start: float = -20e6) -> RangeGate:
    """A gate of `kept` delays, on a 40 MHz band of n frequencies, about centres in steps of 25 ns."""
    full = Axis(start, 40e6 / n, n)
    step = 1 / full.extent
    coarse = full.extent / kept
    edge = np.minimum(np.arange(kept), np.arange(kept)[::-1])
    return RangeGate(
        slab=Axis(-300.0, 25.0, centre.size),
        centre=np.rint(centre).astype(np.int64),
        gate=Axis((offset - kept // 2) * step, step, kept),
        window=np.sin(np.pi / 2 * np.clip((edge + 0.5) / 12, 0, 1)) ** 2,
        full=full,
        range_frequency=Axis(full.start - full.step / 2 + coarse / 2, coarse, kept),
        taper=np.ones(kept),
    )


def by_sums(gate: RangeGate, signal: Complex128Array) -> Complex128Array:
    """The gate of rows (n_bin, n), sum by sum in double precision: to delays, windowed, and back."""
    period = gate.to_delay.period
    found = np.empty((gate.range_frequency.size, gate.n_row), np.complex128)
    for b, row in enumerate(signal):
        delay = gate.gate.step * gate.centre[b] + gate.gate.values
        profile = np.exp(2j * np.pi * np.multiply.outer(delay, gate.full.values)) @ row / period
        back = np.exp(-2j * np.pi * np.multiply.outer(gate.range_frequency.values, delay))
        found[:, b] = gate.taper * (back @ (gate.window * profile))
    return found


@pytest.mark.parametrize(("n", "kept"), [(200, 84), (187, 61)])
def test_a_range_gate_keeps_targets_inside_it_on_fewer_frequencies(n: int, kept: int) -> None:
    """A target inside the gate, whose centre moves, keeps its spectrum on the coarser frequencies; others vanish."""
    gate = gate_of(n, kept, 240 + 10 * np.cos(np.arange(24) / 9))
    cell = SPEED_OF_LIGHT / (2 * gate.full.extent)

    def target(f: FloatArray, beside: float) -> Complex128Array:
        """Spectrum of a target that lies `beside` whole cells from the gate's centre at each bin: a single delay."""
        cycles = -2 / SPEED_OF_LIGHT * np.multiply.outer(f, cell * (gate.centre + beside))
        return np.exp(2j * np.pi * cycles)

    for beside in (0.0, 9.0, -14.0):
        found = gate.apply(target(gate.full.values, beside).astype(np.complex64), threads=1)
        assert found.shape == (kept, 24)
        # A single delay of one gate sample has the same phase ramp on both grids, except for the half step between
        # their edges.
        turned = found * target(gate.range_frequency.values, beside).conj()
        assert np.abs(turned - turned.mean(axis=0)).max() < 2e-4
        np.testing.assert_allclose(np.abs(turned.mean(axis=0)), 1.0, atol=2e-4)
        assert np.abs(np.angle(turned.mean(axis=0))).max() < 1e-3
    for beside in (kept / 2 + 3, -kept / 2 - 9):
        outside = np.round(beside)
        assert np.abs(gate.apply(target(gate.full.values, outside).astype(np.complex64), threads=2)).max() < 1e-4


# Gates that wrap around the ends of the period, and far ones, whose delays are many periods away.
@pytest.mark.parametrize("centre", [-3.0, 0.0, 199.0, 4321.0, -777.0])
@pytest.mark.parametrize("start", [-20e6, -19.913e6])
def test_a_range_gate_equals_its_sums(centre: float, start: float) -> None:
    gate = gate_of(200, 60, centre + np.arange(9.0), offset=7, start=start)
    rng = np.random.default_rng(4)
    signal = rng.standard_normal((9, 200)) + 1j * rng.standard_normal((9, 200))
    gate = replace(gate, taper=rng.uniform(0, 1, 60))
    wanted = by_sums(gate, signal)
    found = gate.apply(np.ascontiguousarray(signal.T, np.complex64), threads=1)
    assert np.abs(found - wanted).max() < 2e-6 * np.abs(wanted).max()


def test_one_transform_to_delay_serves_several_gates() -> None:
    bins = np.arange(31.0)
    gates = [
        gate_of(180, kept, first + bins * slope) for kept, first, slope in ((60, 20, 0.5), (72, 90, -1), (50, 2, 3))
    ]
    rng = np.random.default_rng(8)
    signal = (rng.standard_normal((31, 180)) + 1j * rng.standard_normal((31, 180))).astype(np.complex64)
    transform = gates[0].to_delay
    delays = Program([transform], source=transform.source, n_row=31).run(signal)
    for gate in gates:
        assert gate.to_delay == transform
        alone = gate.apply(np.ascontiguousarray(signal.T))
        shared = gate.from_delay.run(delays)
        np.testing.assert_allclose(shared.T, alone, atol=1e-5 * np.abs(alone).max())
        # A part of the bins is gated as in the whole.
        part = gate.within(7, 20)
        np.testing.assert_allclose(part.from_delay.run(delays[7:20]), shared[7:20], atol=1e-5 * np.abs(alone).max())
        assert part.slab.values.tolist() == gate.slab.values[7:20].tolist()


@pytest.mark.parametrize("n", [600, 643])
def test_pixels_at_the_ends_of_a_gate_lose_nothing(n: int) -> None:
    """The sum over the band at any place of a sub-block, from echoes at all delays: as from all range frequencies."""
    full = Axis(-20e6, 40e6 / n, n)
    cell, slab = SPEED_OF_LIGHT / (2 * full.extent), Axis(-300.0, 25.0, 24)
    shape = (3, 2, 24)
    near, far, flat = 150 * cell, 260 * cell, np.ones(shape)
    ranges = np.array([near, (near + far) / 2, far])[:, None, None] * flat
    line = Line(time=flat, doppler=slab.values * flat, rate=50 * flat, phase=flat, range=ranges, stretch=flat,
                weight=flat)  # fmt: skip
    gate = plan_range_gate(full, slab, line, 10e9)
    assert gate.range_frequency.size < 0.6 * n
    rng = np.random.default_rng(3)
    signal = rng.standard_normal((24, n)) + 1j * rng.standard_normal((24, n))
    kept = gate.apply(np.ascontiguousarray(signal.T, np.complex64)).T

    def pixels(values: Complex128Array, axis: Axis, at: FloatArray) -> Complex128Array:
        turns = 2 / SPEED_OF_LIGHT * np.multiply.outer(axis.values, at)
        return np.asarray(values @ np.exp(2j * np.pi * turns) * axis.step)

    for at in (near + cell * (np.arange(4) + 0.37), far - cell * (np.arange(4) + 0.37), np.linspace(near, far, 9)):
        wanted = pixels(signal, full, at)
        error = pixels(kept, gate.range_frequency, at) - wanted
        assert np.mean(np.abs(error) ** 2) < 10 ** (-6.3) * np.mean(np.abs(wanted) ** 2)
