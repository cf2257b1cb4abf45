"""Every parameter of the public functions and methods is documented: its shape, its unit and its default."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

import pytest
from docstrings import entries

import blocksar
from blocksar import api
from blocksar.application.shown import PlanReport, RunReport
from blocksar.products.dataset import SarAccessor

FUNCTIONS = {
    name: getattr(api, name) for name in [*blocksar.__all__, "ingest_cphd", "ingest_gotcha", "demo"]
    if inspect.isfunction(getattr(api, name, None))
}  # fmt: skip
METHODS = {
    f"{owner.__name__}.{name}": method
    for owner in (SarAccessor, PlanReport, RunReport)
    for name, method in vars(owner).items()
    if inspect.isfunction(method) and not name.startswith("_")
}


def parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return [p for p in inspect.signature(function).parameters.values() if p.name != "self"]


CASES = [
    pytest.param(function, parameter, id=f"{name}-{parameter.name}")
    for name, function in {**FUNCTIONS, **METHODS}.items()
    for parameter in parameters(function)
]


def test_all_public_functions_are_looked_at() -> None:
    assert {"collection", "write", "focus", "plan", "quality", "open", "simulate"} <= set(FUNCTIONS)
    assert {"SarAccessor.cut", "PlanReport.plot", "RunReport.plot"} <= set(METHODS)


@pytest.mark.parametrize("name", [*FUNCTIONS, *METHODS])
def test_nothing_is_documented_that_is_not_there(name: str) -> None:
    function = {**FUNCTIONS, **METHODS}[name]
    assert set(entries(function)) <= {p.name for p in parameters(function)}


@pytest.mark.parametrize(("function", "parameter"), CASES)
def test_a_default_is_stated_and_true(function: Callable[..., Any], parameter: inspect.Parameter) -> None:
    kind, meaning = entries(function)[parameter.name]
    default = parameter.default
    if default is inspect.Parameter.empty:
        assert "optional" not in kind and "Default" not in meaning
    elif default is None:
        assert "optional" in kind
        assert re.search(r"Default: |\(default\)|Needed|Only for|instead|over the (band|dwell)|that is in the", meaning)
    else:
        assert "optional" not in kind
        stated = re.search(r"Default: (\"[^\"]*\"|\([^)]*\)|[\w.*+-]*\w)", meaning)
        if isinstance(default, int | float) and not isinstance(default, bool):
            assert stated and float(stated[1]) == default
        elif isinstance(default, str) and default:
            assert (stated and stated[1] == f'"{default}"') or f'"{default}" (default)' in meaning
        else:
            assert stated and stated[1] == ("none" if default == "" else repr(default))
