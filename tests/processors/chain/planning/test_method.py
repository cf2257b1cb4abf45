"""Methods and their options."""

from __future__ import annotations

from blocksar.imaging.method import Method


def test_a_method_names_its_departures() -> None:
    method = Method(processor="keystone-resampling", perturbation="frequency", derotation="linear")
    assert method.departures == ["perturbation", "derotation"]
    assert method.variant and not Method(processor="high-order-phase").variant
