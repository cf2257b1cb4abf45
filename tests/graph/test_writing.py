"""Writes by other threads: memory is used again only when it is written, and failures are not lost."""

from __future__ import annotations

from threading import Event, Timer

import pytest

from blocksar.graph.writing import WritesBehind
from blocksar.runs.record import Written


def part(number: int) -> Written:
    return Written("store", "array", ((number, number + 1),), "")


def test_a_turn_waits_for_the_write_whose_memory_it_takes() -> None:
    written = Event()

    def write(number: int) -> list[Written]:
        assert number or written.wait(60)
        return [part(number)]

    with WritesBehind(2) as behind:
        for number in range(5):
            if number == 2:
                Timer(0.05, written.set).start()
            turn = behind.turn()
            assert turn.memory == number % 2
            assert written.is_set() == (number >= 2)
            turn.submit(write, number)
    assert behind.written == tuple(part(number) for number in range(5))
    assert behind.waited > 0


def test_a_write_that_fails_fails_the_task() -> None:
    def write() -> list[Written]:
        raise OSError("no space left")

    with WritesBehind() as behind:
        behind.turn().submit(write)
    with pytest.raises(OSError, match="no space"):
        _ = behind.written
