"""The whole estimate on a small spotlight collection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from serial_estimate import find_track_error

from blocksar.autofocusing import estimation
from blocksar.autofocusing.estimation import coarse_error
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Refused, stands_out
from blocksar.autofocusing.work import EstimatorSettings
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.simulation.scatterers import simulate_pulses
from tests.helpers.samples import noise
from tests.helpers.track_errors import CENTRE, GRID, SIZE, echoes, error, residual_phase, spotlight

STATED = Geometry(collection=spotlight())
PLACES = np.array([[CENTRE[0] + a * SIZE, b * SIZE] for a in (-0.4, 0, 0.4) for b in (-0.4, 0, 0.4)])


def found(signal: np.ndarray, **options: Any) -> Result:
    return find_track_error(lambda pulses: signal[pulses], STATED, GRID, **options)


@pytest.fixture(scope="module")
def signal() -> np.ndarray:
    return echoes(spotlight(), error(spotlight().time))


@pytest.fixture(scope="module")
def result(signal: np.ndarray) -> Result:
    return found(signal)


def test_the_track_is_mended(result: Result) -> None:
    true = STATED.collection.antenna_position + error(STATED.collection.time)
    assert residual_phase(STATED, STATED.collection.antenna_position - true, PLACES).min() > 2
    left = residual_phase(STATED, result.antenna_position - true, PLACES)
    assert np.sqrt(np.mean(left**2)) < 0.05
    assert left.max() < 0.08
    assert result.figures["entropy_after"] < result.figures["entropy_before"] - 0.5
    assert result.figures["halves_apart"] < 0.1
    predicted = result.figures["predicted_error"]
    assert predicted / 2 < np.sqrt(np.mean(left**2)) < 2 * predicted


def test_what_is_known_of_it(result: Result) -> None:
    assert result.track_error.shape == result.uncertainty.shape == (result.time.size, 3)
    assert (result.uncertainty > 0).all()
    assert (result.uncertainty <= 1.01 * EstimatorSettings().displacement).all()
    assert result.chips_after.max(axis=(1, 2)) == pytest.approx(1)
    assert (result.chips_before.max(axis=(1, 2)) < 0.9).all()


@pytest.mark.slow
def test_the_same_bytes_with_more_threads(signal: np.ndarray, result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    searches: list[Any] = []

    def counted(*arguments: Any, **options: Any) -> Any:
        searches.append(options)
        return coarse_error(*arguments, **options)

    monkeypatch.setattr(estimation, "coarse_error", counted)
    again = found(signal, threads=2)
    assert result.figures["loops"] > 1
    assert len(searches) == 1  # the error is smooth: later loops and the halves need no other
    assert again.antenna_position.tobytes() == result.antenna_position.tobytes()
    assert again.figures == result.figures


@pytest.mark.slow
def test_a_regular_matrix_of_equal_points() -> None:
    """All lines hold many points alike: the phase gradient alone is deceived, and no point stands alone."""
    stated = spotlight()
    wrong = error(stated.time)
    x, y = (a.ravel() for a in np.meshgrid(CENTRE[0] + np.linspace(-60, 60, 9), np.linspace(-60, 60, 9)))
    true = Collection(**{**stated.as_dict(), "antenna_position": stated.antenna_position + wrong})
    result = found(simulate_pulses(true, x, y, np.ones(x.size, complex)))
    left = result.antenna_position - true.antenna_position
    assert np.sqrt(np.mean(residual_phase(STATED, left, PLACES) ** 2)) < 0.05
    # Constant and line, which the samples do not tell, are not invented.
    u = np.linspace(-1, 1, stated.n_pulse)
    for values in result.antenna_position.T - stated.antenna_position.T:
        assert abs(values.mean()) < 2e-3
        assert abs((u * values).sum() / (u * u).sum()) < 4e-3


@pytest.mark.slow
def test_noise_is_refused() -> None:
    stated = spotlight(n_pulse=256)
    signal = noise(stated.n_pulse, stated.n_range_frequency)
    with pytest.raises(Refused, match=r": 0 of \d\d points stand out of noise and clutter, and 20 tell .* differ by"):
        find_track_error(
            lambda pulses: signal[pulses], Geometry(collection=stated), GRID, settings=EstimatorSettings(loops=2)
        )


@pytest.mark.parametrize(("amplitude", "points"), [(0.0, 1), (1.0, 1), (1.0, 18)])
def test_too_few_points_are_refused(amplitude: float, points: int) -> None:
    """Sidelobes of points are no points."""
    stated = spotlight()
    with pytest.raises(Refused, match=r"the scene has .* prominent points?"):
        found((amplitude * echoes(stated, np.zeros((stated.n_pulse, 3)), points=points)).astype(np.complex64))


def test_maxima_of_noise_do_not_stand_out() -> None:
    """Once in a hundred searches they may; of exponential power p times the median has the probability 2^-p."""
    random = np.random.default_rng(0)
    power = random.exponential(size=(2000, 500))  # searches
    prominence = power.max(axis=1) / np.median(power, axis=1)
    assert stands_out(prominence, 500).mean() < 0.02
    assert stands_out(prominence, 5).mean() > 0.3


def test_a_collection_too_short() -> None:
    with pytest.raises(InputError, match="time has 40 pulses"):
        find_track_error(
            lambda pulses: np.zeros((0, 0), np.complex64), Geometry(collection=spotlight(n_pulse=40)), GRID
        )


@pytest.mark.slow
def test_a_gap_of_the_collection_is_bridged_though_other_pulses_are_missing() -> None:
    """Whole turns of the phase after the gap are not told, and do not matter."""
    stated = spotlight()
    wrong, gap = error(stated.time), slice(200, 226)
    signal = echoes(stated, wrong, seed=4).copy()
    signal[gap] = np.nan
    signal[np.random.default_rng(3).uniform(size=stated.n_pulse) < 0.05] = np.nan
    result = found(signal)
    left = result.antenna_position - stated.antenna_position - wrong
    sight = CENTRE - stated.antenna_position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    turn = np.where(np.arange(stated.n_pulse) < gap.stop, 0.0, stated.wavelength / 2)[:, None] * sight
    there = np.setdiff1d(np.arange(stated.n_pulse), np.arange(stated.n_pulse)[gap])
    rest = [residual_phase(STATED, left - turns * turn, PLACES, there) for turns in (-1, 0, 1)]
    assert min(np.sqrt(np.mean(phase**2)) for phase in rest) < 0.05
    assert result.figures["predicted_error"] < 0.05
