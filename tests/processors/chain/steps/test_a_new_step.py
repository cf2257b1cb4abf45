"""A new step needs its own class and a place in a chain; planning, applying and tracing follow without a change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest
from steps import collection, line_of, planned, signal_of, slab_of

from blocksar.arrays import FloatArray
from blocksar.imaging.method import Method
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation, Turn
from blocksar.kernels.phase import Phase
from blocksar.processors.chain.steps import chains
from blocksar.processors.chain.steps.azimuth_steps import AzimuthTransform, DopplerTransform
from blocksar.processors.chain.steps.chains import CHAINS
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.range_steps import Keystone
from blocksar.processors.chain.steps.step import Constants, Step, trace

pytestmark = pytest.mark.slow


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnAndBack(Step):
    """Multiply by a phase along slow time and by its conjugate: samples and lines do not change."""

    name = "turn-and-back"
    centre: float
    chirp: float  # Hz/s
    compressed: bool

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        line = arriving()
        return cls(
            centre=float(line.time.mean()),
            chirp=float(np.abs(line.rate).max()),
            compressed=constants.polynomials is not None,
        )

    @property
    def source(self) -> Axis:
        return self.axes.time

    @property
    def n_row(self) -> int:
        return (self.axes.rows if self.compressed else self.axes.range_frequency).size

    def operations(self) -> list[Operation]:
        cycles: FloatArray = np.array([[0.0, 0.0, self.chirp / 2]])
        return [Turn(Phase(sign * cycles, self.centre, 1.0)) for sign in (1.0, -1.0)]

    def trace(self, line: Line) -> Line:
        offset = line.time - self.centre
        turned = line.multiply_time(self.chirp / 2 * offset**2, self.chirp * offset, np.array(self.chirp))
        return turned.multiply_time(-self.chirp / 2 * offset**2, -self.chirp * offset, np.array(-self.chirp))


@pytest.mark.parametrize("before", [Keystone, AzimuthTransform])
def test_a_new_step_needs_its_class_and_a_place_in_the_chain(
    before: type[Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = planned(collection())
    kinds = list(CHAINS["angular-division"])
    kinds.insert(kinds.index(before), TurnAndBack)
    monkeypatch.setitem(chains.CHAINS, "angular-division", tuple(kinds))
    case = planned(collection())
    assert tuple(type(step) for step in case.plan.chain) == chains.steps_of(Method())
    assert TurnAndBack in chains.steps_of(Method())
    yaw = (case.plan.low + case.plan.high) / 2
    line = line_of(case, 30e3, yaw)
    for name in ("doppler", "time", "range", "phase"):
        ours, other = (getattr(trace(c.plan.chain, line), name) for c in (case, plain))
        np.testing.assert_allclose(ours, other, rtol=1e-9, atol=1e-6)
    assert case.plan.prediction.residual_phase == pytest.approx(plain.plan.prediction.residual_phase, rel=1e-3)

    def focused(plan: tuple[Step, ...]) -> np.ndarray:
        samples = slab_of(case, signal_of(case, 30e3, yaw, tapered=False))
        for step in plan:
            samples = step.apply(samples)
        return samples

    assert isinstance(case.plan.chain[-1], DopplerTransform)
    ours, other = focused(case.plan.chain), focused(plain.plan.chain)
    assert np.abs(ours - other).max() < 1e-4 * np.abs(other).max()
