"""The ideal response, by integrals over the dwell, against the sum over pulses."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns
from steps import collection
from summed_response import summed_response

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.measurement.axes import response_axes
from blocksar.measurement.figures import ideal_cuts, ideal_response, profile_quality
from blocksar.measurement.targets import Target


def arc(*, carrier: float, bandwidth: float, half_angle: float) -> Collection:
    """Unsteered, on a circle about (0, 0), 4 km away and 3 km above it."""
    n, k = 1200, 400
    turned = np.linspace(-half_angle, half_angle, n)
    position = np.stack([-4000 * np.cos(turned), 4000 * np.sin(turned), np.full(n, 3000.0)], axis=1)
    return Collection(
        carrier=carrier,
        time=(np.arange(n) - n // 2) / 100.0,
        range_frequency=(np.arange(k) - (k - 1) / 2) * bandwidth / k,
        reference_range=np.full(n, 5000.0),
        antenna_position=position,
        beam_azimuth=np.full(n, np.nan),
    )


def swept() -> Collection:
    """A beam that moves on by a tenth of its width within the response."""
    return with_patterns(axis_collection(n_pulse=4000, beam_width=0.012))


CASES = {
    "squint TOPS": (collection(n_frequency=160), (17710.0, 18040.0), "uniform", 3e-3),
    "squint TOPS, taylor": (collection(n_frequency=160), (17710.0, 18040.0), "taylor:4:-35", 1e-3),
    "patterns about an axis": (swept(), (9000.0, 12.0), "hamming", 1e-3),
    "a band of 50 %": (arc(carrier=400e6, bandwidth=200e6, half_angle=0.2), (3.0, -2.0), "uniform", 1e-3),
    "an arc of 40 degrees": (arc(carrier=9.6e9, bandwidth=200e6, half_angle=0.35), (0.5, 0.3), "taylor:4:-35", 1e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_integral_is_the_sum_over_pulses(name: str) -> None:
    of, (x, y), text, tolerance = CASES[name]
    geometry, weighting = Geometry(collection=of.centred()), Weighting.parse(text)
    axes = response_axes(geometry, x, y, weighting)
    assert axes is not None
    along, none = np.linspace(-10.5, 10.5, 127), np.zeros(127)
    for in_range, in_azimuth in ((along * axes.range_width, none), (none, along * axes.azimuth_width)):
        dx, dy = axes.ground_offset(in_range, in_azimuth)
        slow = summed_response(geometry, Target("T", x, y), x + dx, y + dy, weighting)
        np.testing.assert_allclose(
            ideal_response(geometry, (x, y), x + dx, y + dy, weighting), slow, rtol=0, atol=tolerance
        )


def test_a_wide_band_and_a_long_arc_do_not_have_the_side_lobes_of_a_rectangle() -> None:
    """Over a band of 40 % the azimuth lobes average out; an arc's range cut is that of a ring, narrower than 1 / B."""

    def figures(of: Collection) -> tuple[FloatArray, FloatArray]:
        geometry = Geometry(collection=of)
        axes = response_axes(geometry, 0.0, 0.0)
        assert axes is not None
        cuts = ideal_cuts(geometry, Target("T", 0.0, 0.0), axes)
        return tuple(
            np.array(profile_quality(offset, profile, width=width)) / [width, 1, 1]
            for offset, profile, width in (
                (cuts.range_offset, cuts.range_profile, axes.range_width),
                (cuts.azimuth_offset, cuts.azimuth_profile, axes.azimuth_width),
            )
        )  # type: ignore[return-value]

    in_range, in_azimuth = figures(arc(carrier=400e6, bandwidth=160e6, half_angle=0.08))
    assert in_range[:2] == pytest.approx([1, -13.26], abs=0.02)
    assert in_azimuth[:2] == pytest.approx([0.995, -14.45], abs=0.05)
    in_range, in_azimuth = figures(arc(carrier=9.6e9, bandwidth=150e6, half_angle=0.22))
    assert in_range[0] < 0.7 and in_range[1] < -20
    assert in_azimuth[:2] == pytest.approx([1, -13.2], abs=0.1)
