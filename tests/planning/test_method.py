"""Methods and their options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import blocksar
from blocksar.errors import InputError
from blocksar.focusing.method import Method
from blocksar.processors import options_for


def _split(options: dict[str, Any]) -> dict[str, Any]:
    return {"name": options["processor"], "given": {k: v for k, v in options.items() if k != "processor"}}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"processor": "omega-k"}, "processor 'omega-k' is unknown; use angular-division"),
        ({"perturbation": "some"}, "perturbation 'some' is unknown; use all, frequency, none"),
        ({"keystone": 3}, "keystone 3 is unknown; use True, False"),
        ({"processor": "high-order-phase", "keystone": False}, "high-order-phase has no keystone to leave out"),
        ({"range_model": "conventional"}, "conventional makes closed-form coefficients for angular-division"),
        ({"processor": "backprojection", "derotation": "linear"}, "backprojection has no derotation to choose"),
        (
            {"processor": "hierarchical-backprojection", "keystone": False},
            "an option of angular-division, keystone-resampling and high-order-phase only; leave it out",
        ),
    ],
)
def test_meaningless_options_are_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        options_for(**_split({"processor": "angular-division", **options}))
    with pytest.raises(InputError, match=message):
        blocksar.plan("table1", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_method_names_its_departures() -> None:
    method = Method(processor="keystone-resampling", perturbation="frequency", derotation="linear")
    assert method.departures == ["perturbation", "derotation"]
    assert method.variant and not Method(processor="high-order-phase").variant
