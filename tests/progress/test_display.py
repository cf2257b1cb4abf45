"""Progress on a terminal and in a pipe."""

from __future__ import annotations

import io
import re
import sys

import pytest
from fake_clock import HIDDEN, SHOWN, Clock, under_way
from rich.console import Console

from blocksar.progress import Progress, display

# Display


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines_of(told: Progress, width: int, height: int = 40) -> list[str]:
    screen = io.StringIO()
    Console(file=screen, width=width, force_terminal=True, no_color=True).print(told.frame(width, height))
    return [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in screen.getvalue().splitlines()]


@pytest.mark.parametrize("width", [120, 80, 60, 42, 30])
def test_a_frame_fits_the_terminal(width: int) -> None:
    lines = lines_of(under_way(Clock()), width)
    assert max(map(len, lines)) <= width
    assert [line.split()[0] for line in lines[:5]] == ["plan", "recover", "focus", "mosaic", "finish"]
    assert "60/120" in lines[2] and lines[2].endswith("1:06:40")
    assert ("54/h" in lines[2]) == (width >= display.RATE_NEEDS)
    assert ("━" in lines[2]) == (width >= display.BAR_NEEDS)
    # One more round of blocks takes 4000 s; mosaic and finish add a fiftieth.
    assert lines[5] == "in all 1:06:40 elapsed, about 68 min left"[:width].rstrip()
    assert lines[6].startswith("60 workers, the fullest holds 1.5 of 4.0 GiB"[:width].rstrip())
    assert lines[7].startswith("at work: block-60") and "more" in lines[7]
    assert len(lines) == 8


def test_a_low_terminal_shows_the_unfinished_stages_and_the_totals() -> None:
    lines = lines_of(under_way(Clock()), 80, height=6)
    assert [line.split()[0] for line in lines] == ["focus", "mosaic", "in", "60", "at"]


def test_terminal_output_is_not_interpreted_as_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with Progress() as told:
        told.update("focus [block 1]", 1, 4)
        told.note("half [red] done")
    assert "focus [block 1]" in screen.getvalue() and "half [red] done" in screen.getvalue()
    assert screen.getvalue().encode().rfind(SHOWN) > screen.getvalue().encode().rfind(HIDDEN) >= 0


def test_a_dumb_terminal_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "dumb")
    with under_way(Clock()) as told:
        told.update("focus", 120, 120)
    assert "focus: 120 of 120" in screen.getvalue() and "\x1b" not in screen.getvalue()


def test_plain_lines_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with under_way(clock) as told:
        for done in range(2):
            told.update("plan", done, 1)  # it has ended before
        told.dashboard("http://127.0.0.1:8787/status")
        told.note("said with the result", again=True)
        told.note("one pulse is missing")
        for done in range(61, 121):
            clock.now += 10.0
            told.update("focus", done, 120)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:5] == [
        "plan: done; in all 0:00 elapsed",
        "recover: 4 of 4; in all 0:00 elapsed",
        "focus: 60 of 120; in all 1:06:40 elapsed, about 68 min left",
        "dashboard: http://127.0.0.1:8787/status",
        "note: one pulse is missing",
    ]
    assert len(lines) == 5 + 10
    assert lines[-1] == "focus: 120 of 120; in all 1:16:40 elapsed, about 46 s left"


def test_quiet_progress_prints_nothing(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for screen in (sys.stderr, Terminal()):
        monkeypatch.setattr(sys, "stderr", screen)
        with under_way(Clock(), quiet=True) as told:
            told.dashboard("http://127.0.0.1:8787/status")
            told.note("a note")
    assert screen.getvalue() == ""  # type: ignore[attr-defined]
    assert capsys.readouterr().err == ""
