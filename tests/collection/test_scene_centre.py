"""The scene frame at a range to one side of a track, against points that the track was built about."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError

Vector = Any


def pass_by(rng: np.random.Generator, *, away: float, above: float) -> tuple[Georeference, Vector, float, str]:
    """A random point of the Earth, a straight track that sees it at a random squint, that squint, and the side."""
    place = Georeference(
        latitude=float(rng.uniform(-89, 89)), longitude=float(rng.uniform(-180, 180)),
        height=float(rng.uniform(-300, 5000)),
    )  # fmt: skip
    course = rng.uniform(0, 2 * np.pi)
    antenna = place.to_ecef(np.array([away * np.cos(course), away * np.sin(course), above]))
    sight = place.origin - antenna
    up = antenna / np.linalg.norm(antenna)  # of the flight only the angle with the line of sight counts
    squint = float(rng.uniform(-0.4, 0.4)) * away / np.hypot(away, above)
    flat = sight - (sight @ up) * up
    ahead, beside = flat / np.linalg.norm(flat), np.cross(up, flat / np.linalg.norm(flat))
    share = np.sin(squint) * np.linalg.norm(sight) / np.linalg.norm(flat)
    turn = float(rng.choice([-1.0, 1.0]))
    along = share * ahead + turn * np.sqrt(1 - share**2) * beside
    # Right of the flight lies along x up: the sight leads there, or to the left.
    side = "right" if np.cross(along, up) @ sight > 0 else "left"
    return place, antenna + np.linspace(-500, 500, 11)[:, None] * along, squint, side


@pytest.mark.parametrize(("away", "above"), [(2e3, 3e3), (30e3, 11e3), (350e3, 630e3)])
def test_the_point_that_a_track_was_built_about_is_found(away: float, above: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(25):
        place, track, squint, side = pass_by(rng, away=away, above=above)
        slant = float(np.linalg.norm(track[5] - place.origin))
        found = blocksar.scene_centre(track, slant, side_of_track=side, height=place.height, squint=squint)
        assert np.linalg.norm(np.array(found["ecef"]) - place.origin) < 1e-3
        assert Georeference.from_attribute(found).height == place.height


def test_the_pulse_is_chosen() -> None:
    """As far along the track as the pulse, on ground that curves by micrometres."""
    place, track, squint, side = pass_by(np.random.default_rng(3), away=2e3, above=3e3)
    slant = float(np.linalg.norm(track[5] - place.origin))
    found = [
        blocksar.scene_centre(track, slant, side_of_track=side, height=place.height, squint=squint, pulse=pulse)
        for pulse in (0, 5, 10)
    ]
    assert found[1] == blocksar.scene_centre(track, slant, side_of_track=side, height=place.height, squint=squint)
    apart = np.diff([each["ecef"] for each in found], axis=0)
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 500, atol=1)


def test_what_no_ground_answers_is_refused() -> None:
    _, track, _, _ = pass_by(np.random.default_rng(0), away=30e3, above=11e3)
    for settings, said in (
        ({"slant_range": 9e3, "side_of_track": "left"}, r"slant_range is 9000 m, but the antenna is 1[0-9]{4}.* above"),
        ({"slant_range": 9e5, "side_of_track": "left"}, r"slant_range is 900000 m, beyond the horizon"),
        ({"slant_range": 3e4, "side_of_track": "port"}, "side_of_track is 'port'; it must be 'left' or 'right'"),
    ):
        with pytest.raises(InputError, match=said):
            blocksar.scene_centre(track, **settings)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"has the shape \(2, 3\); give \(n_pulse, 3\)"):
        blocksar.scene_centre(track[:2], 3e4, side_of_track="left")
