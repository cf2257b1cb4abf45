"""Exact scenes of every kind: what is truly said of them is never called wrong, and what is wrongly said is named."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest
from exact_scenes import CONTENTS, KINDS, exact_scene
from wrong_inputs import OUTCOMES, outcome, wrong_inputs

from blocksar.inspection.check import check

SLOW = pytest.mark.slow
EACH = len(KINDS) * len(CONTENTS)  # every kind of collection with every content
FEW = (1, 20, 29)  # points of a curved track, clutter under a strip's beam, terrain under one turned in yaw
# Wrong inputs of which a share is told by their physics: others mirror the image of a straight track or a small scene.
ALWAYS = ("the chirp has the other sign", "the echo is conjugated")


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=() if seed in FEW else SLOW) for seed in range(100)])
def test_exact_samples_are_not_accused(seed: int) -> None:
    scene = exact_scene(seed)
    for thorough in (False, True):
        findings = check(
            scene.signal, scene.collection.centred(), grid=scene.grid, threads=1, thorough=thorough,
            terrain=scene.terrain,
        )  # fmt: skip
        assert findings.warning() is None, scene.name


@SLOW
def test_wrong_inputs_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    """The table of the page: for each wrong input, how often it was named, and what was said otherwise."""
    table: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for seed in range(EACH):
        for wrong in wrong_inputs(exact_scene(seed)):
            table[wrong.kind][outcome(wrong)[0]] += 1
    with capsys.disabled():
        print(f"\n{'':55s}" + "".join(f"{each:>9s}" for each in OUTCOMES))
        for kind, counts in table.items():
            print(f"{kind:55s}" + "".join(f"{counts[each]:9d}" for each in OUTCOMES))
    for kind, counts in table.items():
        assert counts["named"] + counts["tied"] >= LEAST[kind] * counts.total(), kind
        assert counts["other"] + counts["missed"] <= 0.1 * counts.total(), kind
