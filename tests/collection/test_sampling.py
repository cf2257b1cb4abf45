"""Shares of uneven axes, and what refuses them."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.collection.sampling import LONGEST_GAP, departure_of, places_of, refuse_departures, sampling_of
from blocksar.errors import InputError

EVEN = np.arange(64) * 0.01 - 0.3


def test_an_axis_uniform_to_a_thousandth_of_a_step_has_no_shares() -> None:
    off = np.where((np.arange(64) == 0) | (np.arange(64) == 63), 0.0, (-1.0) ** np.arange(64))
    found = sampling_of(EVEN + 0.9e-5 * off)
    assert found.even and found.shares is None and found.step == pytest.approx(0.01, rel=1e-4)
    assert not sampling_of(EVEN + 1.1e-5 * off).even


def test_a_sample_stands_for_half_the_way_to_either_neighbour() -> None:
    axis = np.cumsum(np.tile([0.9, 1.1, 1.0, 1.15, 0.85], 8)) * 0.01
    found = sampling_of(axis)
    assert found.shares is not None and not found.lacking
    # The mean step, where no step is a gap; what all stand for is the whole axis and half a step at either end.
    assert found.step == pytest.approx(np.diff(axis).mean())
    np.testing.assert_allclose(found.shares[1:-1] * found.step, (axis[2:] - axis[:-2]) / 2)
    assert found.shares.sum() * found.step == pytest.approx(axis[-1] - axis[0] + (0.011 + 0.0085) / 2)


def test_a_gap_is_nobodys() -> None:
    found = sampling_of(np.delete(EVEN, np.arange(20, 30)))
    assert found.shares is not None and found.lacking == 10 and found.step == pytest.approx(0.01)
    expected = np.ones(54)
    expected[[19, 20]] = 0.5 + LONGEST_GAP / 2
    np.testing.assert_allclose(found.shares, expected)


def test_places_on_an_axis_follow_its_steps() -> None:
    axis = np.array([0.0, 1.0, 3.0, 4.0])
    np.testing.assert_allclose(places_of(np.array([-2.0, 0.5, 2.0, 4.0, 5.0]), axis), [-2.0, 0.5, 1.5, 3.0, 4.0])


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        (
            np.delete(EVEN, np.arange(20, 30)),
            "time lacks 10 values of .* after index 19; write rows of NaN there, or t",
        ),
        (
            EVEN + 2e-3 * np.sin(np.arange(64)),
            r"time is not uniform: index \d+ lies 0\.\d+ steps from its place; take an",
        ),
    ],
)
def test_a_refusal_names_missing_samples_first(axis: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words):
        refuse_departures("a chain", [departure_of("time", axis, sampling_of(axis))], "take another")
    refuse_departures("a chain", [], "take another")
