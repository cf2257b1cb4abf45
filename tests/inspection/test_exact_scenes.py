"""Exact scenes of every kind: what is truly said of them is never called wrong, and what is wrongly said is named."""

from __future__ import annotations

from collections import Counter
from functools import cache

import pytest
from exact_scenes import exact_scene
from wrong_inputs import OUTCOMES, outcome, wrong_inputs

from blocksar.inspection.check import check

SLOW = pytest.mark.slow
FEW = (1, 29)  # points of a curved track, terrain under a beam turned in yaw
SCENES = (0, 1, 2, 3, 7, 11, 12, 14, 15, 16, 19, 20, 21, 24, 25, 26, 28, 29)  # every kind of collection, every content
# Least share of each wrong input that is named, or said not to be told from what is named. The others mirror the image
# of a straight track or of a small scene, and no samples tell; or too few places are points.
LEAST = {
    "the signal is conjugated": 0.5, "the range axis is reversed": 0.7,
    "the phase of the carrier has the other sign": 0.8, "the pulses are in the opposite order": 0.2,
    "the chirp has the other sign": 0.8, "the echo is conjugated": 0.8,
    "the delays count from the start of the pulse": 0.4, "half of the pulse is missing in the delays": 0.4,
    "the track runs backwards": 0.3, "x and y are swapped": 0.6, "x has the other sign": 0.6,
    "y has the other sign": 0.4, "a velocity by which a dwell's ends are off by a turn": 0.6,
    "a wobble of a sixth of a wavelength": 0.7, "the beam turns the other way": 0.5,
    "the beam looks to the other side": 0.6, "the beam is off by its width": 0.7, "the beam is off by a PRF": 0.7,
    "a beam twice too wide": 0.6, "beam_width is in degrees": 0.7, "the beam's angle is in degrees": 0.0,
}  # fmt: skip
scene_of = cache(exact_scene)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(seed, marks=() if seed in FEW else SLOW) for seed in range(30)])
def test_exact_samples_are_not_accused(seed: int) -> None:
    scene = exact_scene(seed)
    for thorough in (False, True):
        findings = check(
            scene.signal, scene.collection.centred(), grid=scene.grid, threads=1, thorough=thorough,
            terrain=scene.terrain,
        )  # fmt: skip
        assert findings.warning() is None, scene.name


@SLOW
@pytest.mark.parametrize("kind", LEAST)
def test_wrong_inputs_are_named(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A row of the page's table: how often a wrong input was named, and what was said otherwise."""
    wrong = (each for seed in SCENES for each in wrong_inputs(scene_of(seed)) if each.kind == kind)
    counts = Counter(outcome(each)[0] for each in wrong)
    with capsys.disabled():
        print(f"\n{kind}: " + ", ".join(f"{each} {counts[each]}" for each in OUTCOMES))
    assert counts["named"] + counts["tied"] >= LEAST[kind] * counts.total() > 0 or not LEAST[kind]
    assert counts["other"] + counts["missed"] <= 0.2 * counts.total()
