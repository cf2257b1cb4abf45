"""Command-line options with arbitrary text and extreme values."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from bad_input import MANY, Bench
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from blocksar.cli import commands

# Options


@contextlib.contextmanager
def little_memory(spare: int = 1 << 30) -> Iterator[None]:
    """Limit the address space so that large allocations fail instead of exhausting the machine's memory."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + spare, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def command(*words: str) -> Any:
    with little_memory():
        return CliRunner().invoke(commands.app, words)


def told_well(bench: Bench, kind: str, result: Any) -> None:
    """Check that the command succeeded, or was refused with exit status 2 and one message."""
    assert result.exit_code in (0, 2), (result.exit_code, result.output, result.exception)
    if result.exit_code == 2:
        assert "Traceback" not in result.stderr and result.stderr.strip()
        if result.stderr.startswith("blocksar: "):
            assert len(result.stderr) < 1000 and result.stderr.count("\n") == 1
    bench.tally[kind, "refused" if result.exit_code else "taken at its word"] += 1


WORDS = st.text(alphabet="0123456789.:,-+einfax \u00b2\u0663", max_size=24) | st.text(max_size=12)
AXIS = st.lists(st.one_of(st.floats(), st.integers(-(10**20), 10**20)), min_size=3, max_size=3).map(
    lambda numbers: ":".join(map(repr, numbers))
)


@pytest.mark.slow
@settings(MANY, max_examples=20)
@given(grid=st.one_of(WORDS, st.lists(AXIS, min_size=2, max_size=2).map(",".join)))
def test_arbitrary_text_as_grid(bench: Bench, grid: str) -> None:
    told_well(bench, "--grid", command("plan", str(bench.store), "--processor", "backprojection", f"--grid={grid}"))


@pytest.mark.slow
@settings(MANY, max_examples=20)
@given(blocks=st.one_of(WORDS, st.integers(-3, 10**30).map(str), st.just("9" * 5000)))
def test_arbitrary_text_as_blocks(bench: Bench, blocks: str) -> None:
    told_well(
        bench, "--blocks", command("plan", str(bench.store), "--processor", "backprojection", f"--blocks={blocks}")
    )


@settings(MANY, max_examples=20)
@given(memory=st.one_of(WORDS, st.from_regex(r"\A[0-9]{1,3}(e[0-9]{1,4})?[kMGT]?i?B?\Z")))
def test_arbitrary_text_as_memory_limit(bench: Bench, memory: str) -> None:
    told_well(
        bench,
        "--memory-limit",
        command("plan", str(bench.store), f"--memory-limit={memory}", "--processor=backprojection"),
    )


@pytest.mark.slow
def test_extreme_settings(bench: Bench) -> None:
    """Every command ends within the deadline."""
    words = {
        "a thousand million blocks": ["--blocks=1000000000"],
        "more blocks than there are numbers": ["--blocks=" + "9" * 30],
        "a grid of 10^18 pixels": ["--grid=4000:4000000:0.001,0:1000000:0.001"],
        "a grid of 10^18 pixels, exact": ["--grid=4000:4000000:0.001,0:1000000:0.001", "--processor=backprojection"],
        "more pixels than there are numbers": ["--grid=0:1e308:1e-308,0:1:1"],
        "a step beyond the grid": ["--grid=4040:4120:1e9,-40:40:1e9", "--blocks=1"],
        "pixels too close to tell apart": ["--grid=4040:4040.0000000001:1e-11,0:1e-10:1e-11", "--blocks=1"],
        "no memory to speak of": ["--memory-limit=1B"],
        "memory beyond floats": ["--memory-limit=1e999T"],
        "all the workers of the world": ["--workers=1000000000", "--blocks=1"],
        "a negative number of workers": ["--workers=-1"],
    }
    bench.all(
        {
            name: lambda more=more: told_well(bench, "beyond reason", command("plan", str(bench.store), *more))
            for name, more in words.items()
        }
    )


def test_the_number_and_outcomes_of_cases_are_as_expected(bench: Bench, request: pytest.FixtureRequest) -> None:
    bench.check_tally(request, 70, ("taken at its word", "refused"))
