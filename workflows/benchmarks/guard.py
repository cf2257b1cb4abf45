"""A guard against regressions: ratios of one run, compared with the bounds in a file.

Absolute times depend on the machine and its load; ratios of quantities that are measured side by side hardly do. The
file has the bound of each ratio, as measured when it was last set, with room for noise:

    {"end_to_end_over_floor": {"at_most": 2.0}, "block_stage_speedup": {"at_least": 1.7}}
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from blocksar.errors import InputError

BOUNDS = Path(__file__).with_name("bounds.json")


def read_bounds(path: Path) -> dict[str, dict[str, float]]:
    """The bounds by ratio.

    Raises
    ------
    InputError
        If the file cannot be read, or holds anything else.
    """
    try:
        bounds = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"--guard {path} cannot be read ({error}); give a file of bounds") from None
    if not isinstance(bounds, dict) or not all(_is_bound(bound) for bound in bounds.values()):
        raise InputError(f"--guard {path} holds no bounds; write {{ratio: {{at_most: number}}}} or at_least")
    return bounds


def _is_bound(bound: Any) -> bool:
    return (
        isinstance(bound, dict)
        and bool(bound)
        and set(bound) <= {"at_most", "at_least"}
        and all(isinstance(value, int | float) for value in bound.values())
    )


def violations(scenes: dict[str, dict[str, Any]], bounds: dict[str, dict[str, float]]) -> list[str]:
    """A sentence for each ratio whose median is outside its bounds, or that no scene has."""
    sentences = []
    for name, bound in bounds.items():
        measured = {
            scene: figures["ratios"][name]["median"] for scene, figures in scenes.items() if name in figures["ratios"]
        }
        if not measured:
            sentences.append(f"{name} was not measured")
        for scene, value in measured.items():
            if value > bound.get("at_most", value):
                sentences.append(f"{name} of {scene} is {value:.3g}, above {bound['at_most']:g}")
            if value < bound.get("at_least", value):
                sentences.append(f"{name} of {scene} is {value:.3g}, below {bound['at_least']:g}")
    return sentences
