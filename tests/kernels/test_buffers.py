"""Memory of large arrays: kept and used again, never more than has been in use at once."""

from __future__ import annotations

import mmap
import pickle
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from blocksar.arrays import ComplexArray
from blocksar.constants import MIB
from blocksar.kernels import buffers
from blocksar.kernels.buffers import GRAIN, SMALLEST, Memory


def address(array: ComplexArray) -> int:
    return int(array.__array_interface__["data"][0])


def samples(mib: float) -> tuple[int]:
    return (int(mib * MIB) // 8,)


def test_memory_is_used_again_once_all_views_are_gone() -> None:
    memory = Memory()
    array = memory.empty((1000, 2000))
    assert array.dtype == np.complex64
    assert array.flags.c_contiguous
    assert array.flags.writeable
    place, view = address(array), array[10:20].T
    del array
    assert memory.kept == 0
    del view
    assert 16_000_000 <= memory.kept < 16_000_000 + GRAIN
    again = memory.empty((2000, 1000))
    assert address(again) == place
    assert memory.kept == 0


def test_arrays_of_other_sizes_use_the_memory_that_was_written() -> None:
    memory = Memory()
    large, small = memory.empty(samples(173)), memory.empty(samples(29))
    places = address(large), address(small)
    del large, small
    assert memory.kept == 202 * MIB
    larger = memory.empty(samples(182))  # fewest pages are new where the large one was
    assert address(larger) == places[0] and memory.kept + memory.used == 202 * MIB
    smaller = memory.empty(samples(20))
    assert address(smaller) == places[1] and memory.kept == 0


def test_what_is_given_back_holds_no_numbers() -> None:
    memory = Memory()
    first, second = memory.empty(samples(8)), memory.empty(samples(8))
    first[:], second[:] = 1, 2
    del first
    memory.release()
    assert memory.kept == 0
    assert (second == 2).all()
    assert not memory.empty(samples(8)).any()


def test_memory_that_is_lent_exactly_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_exact(size: int, map_: Callable[[int], mmap.mmap] = buffers.map_pages) -> mmap.mmap:
        if size != 5 * MIB:
            raise OSError("Cannot allocate memory")
        return map_(size)

    monkeypatch.setattr(buffers, "map_pages", only_exact)
    memory = Memory()
    array = memory.empty(samples(5))
    array[:] = 1
    assert memory.used == 5 * MIB


def test_an_array_may_go_while_its_thread_takes_another(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = Memory()
    arrays = [memory.empty(samples(5))]
    cut = buffers.Block.cut

    def collecting(*arguments: Any, **options: Any) -> None:
        arrays.clear()
        cut(*arguments, **options)

    monkeypatch.setattr(buffers.Block, "cut", collecting)
    other = memory.empty(samples(6))
    assert memory.used == other.nbytes


@pytest.mark.parametrize("seed", range(5))
def test_kept_and_used_memory_never_exceed_what_was_in_use_at_once(seed: int) -> None:
    rng, memory = np.random.default_rng(seed), Memory()
    arrays: list[ComplexArray] = []
    most = 0
    for _ in range(300):
        if arrays and rng.random() < 0.5:
            arrays.pop(rng.integers(len(arrays)))
        else:
            arrays.append(memory.empty(samples(rng.uniform(4.1, 40))))
        used = sum(-(-array.nbytes // GRAIN) * GRAIN for array in arrays)
        most = max(most, used)
        assert memory.used == used
        assert memory.kept + used <= most


def test_arrays_do_not_share_memory() -> None:
    memory = Memory()

    def work(number: int) -> None:
        for _ in range(20):
            array = memory.empty(samples(5))
            array[:] = number
            assert (array == number).all()

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(8)))


def test_small_arrays_are_not_kept() -> None:
    memory = Memory()
    memory.empty((SMALLEST // 8 - 1,))
    assert memory.kept == 0


def test_kept_memory_is_given_back() -> None:
    memory = Memory()
    memory.empty(samples(8))
    memory.release()
    assert memory.kept == memory.used == 0


def test_memory_that_is_idle_is_given_back() -> None:
    memory = Memory(idle=0.2)
    memory.empty(samples(8))
    assert memory.kept
    while memory.kept:
        time.sleep(0.01)


def test_an_array_can_be_sent_to_another_process() -> None:
    array = Memory().empty(samples(5))
    array[:] = 1j
    assert (pickle.loads(pickle.dumps(array)) == 1j).all()
