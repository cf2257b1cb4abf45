"""Writes by other threads: memory is used again only when it is written, and failures are not lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from threading import Event, Timer, get_ident

import pytest

from blocksar.runs.record import Written
from blocksar.tasks.writing import ComputeTurn, WritesBehind, in_threads, turns_at_once


def part(number: int) -> Written:
    return Written("store", "array", ((number, number + 1),), "")


def test_a_turn_waits_for_the_write_whose_memory_it_takes() -> None:
    written = Event()

    def write(number: int) -> list[Written]:
        assert number or written.wait()
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


@pytest.mark.parametrize("threads", [1, 3])
def test_chunks_are_computed_in_threads_and_written_in_their_order(threads: int) -> None:
    """No turn takes memory whose content is not written yet."""
    held, by, together = set[int](), set[int](), Event()

    def compute(turn: ComputeTurn, number: int) -> tuple[ComputeTurn, int]:
        by.add(get_ident())
        if number == threads - 1:
            together.set()
        assert together.wait()  # as many as there are threads are computed at once
        return turn, number

    def write(turn: ComputeTurn, number: int) -> list[Written]:
        held.remove(turn.memory)
        return [part(number)]

    def jobs(behind: WritesBehind) -> Iterator[Callable[[], tuple[ComputeTurn, int]]]:
        for number in range(20):
            turn = behind.turn()
            assert turn.memory not in held
            held.add(turn.memory)
            assert len(held) <= behind.held
            yield partial(compute, turn, number)

    with WritesBehind(threads=threads) as behind:
        for turn, number in in_threads(jobs(behind), threads):
            turn.submit(write, turn, number)
    assert behind.written == tuple(part(number) for number in range(20))
    assert len(by) == threads and behind.held > turns_at_once(threads)
