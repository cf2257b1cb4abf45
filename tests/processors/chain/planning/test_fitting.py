"""The fit of the coefficients, for a squinted straight track."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize
from straight_track import LAMBDA, levelled, straight_lines, straight_series

from blocksar.arrays import FloatArray
from blocksar.kernels import levelling
from blocksar.kernels.levelling import LevellingProblem
from blocksar.processors.chain.planning import coefficients, fitting
from blocksar.processors.chain.planning.fitting import ChainKind, FittedSteps
from blocksar.processors.chain.steps.lines import Line, focus

# ---------------------------------------------------------------- The fit


@pytest.mark.slow
@pytest.mark.parametrize(
    "freedom", [FittedSteps(True, True, False), FittedSteps(False, False, False), FittedSteps(True, True, True)]
)
def test_the_fit_and_its_derivatives(freedom: FittedSteps, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare with finite differences of the residuals, at a place where no term is zero, and with MINPACK's fit."""
    checked = []

    def check(problem: LevellingProblem, *limits: Any) -> FloatArray:
        start = problem.start

        def evaluated(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            size = 2 * problem.time.size + x.size
            residual, rows = np.empty(size), np.empty((x.size, size))
            levelling.evaluate(problem, x, residual, rows, True)
            return residual, rows

        rng = np.random.default_rng(len(checked))
        x = start + 0.02 * rng.standard_normal(start.size)
        found, step = evaluated(x)[1], 1e-6
        for i in range(x.size):
            moved = np.eye(x.size)[i] * step
            wanted = (evaluated(x + moved)[0] - evaluated(x - moved)[0]) / (2 * step)
            np.testing.assert_allclose(found[i], wanted, atol=1e-5 * np.abs(wanted).max() + 1e-6)
        # MINPACK, from the same start, finds no lower cost.
        best = scipy.optimize.least_squares(lambda x: evaluated(x)[0], start, lambda x: evaluated(x)[1].T, method="lm")
        reached = (evaluated(levelling.level_lines(problem, *limits))[0] ** 2).sum() / 2
        assert reached <= 1.02 * best.cost + 1e-9
        checked.append(x.size)
        return start

    monkeypatch.setattr(fitting, "level_lines", check)
    line = straight_lines(15e3, np.linspace(-300, 300, 5))
    whole = Line(**{name: np.stack([getattr(line, name)] * 2) for name in Line.__dataclass_fields__})
    ranges = np.array([14.9e3, 15.1e3])
    fitting.fit(whole, ranges=ranges, candidate=ChainKind(0.0, freedom.time), freedom=freedom, wavelength=LAMBDA)
    assert checked == [2 * freedom.time + 4 * freedom.doppler + 3 * freedom.resampling + 3] * 2


@pytest.mark.parametrize("freedom", [FittedSteps(False, True, False), FittedSteps(True, False, True)])
def test_the_fit_levels_lines_at_least_as_well_as_the_closed_form(freedom: FittedSteps) -> None:
    line = straight_lines(15e3, np.linspace(-300, 300, 7))
    k = straight_series(15e3)
    found = (
        coefficients.resampled(k, wavelength=LAMBDA, half_dwell=1.0)
        if freedom.resampling
        else coefficients.corrected(k, wavelength=LAMBDA)
    )
    whole = Line(**{name: np.stack([getattr(line, name)] * 2) for name in Line.__dataclass_fields__})
    whole = whole.shift_range(np.array([-15e3, -14.9e3])[:, None, None])
    ranges = np.array([0.0, 100.0])
    fitted = fitting.fit(
        whole, ranges=ranges, candidate=ChainKind(0.0, freedom.time), freedom=freedom, wavelength=LAMBDA
    )
    row = whole.range.mean(axis=-1)
    after = whole.multiply_time(*fitted.time.evaluate(row, whole.time))
    after = after.multiply_doppler(*fitted.doppler.evaluate(row, after.doppler))
    after = after.resample_doppler(*fitted.resampling.evaluate(row, after.doppler), middle=fitted.middle)
    after = after.multiply_time(*fitted.deramp.evaluate(row, after.time))
    assert focus(after).residual.max() < focus(levelled(line, found)).residual.max()
