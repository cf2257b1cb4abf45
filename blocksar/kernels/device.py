"""Devices for back-projection loops: the CPU's cores, or a GPU. Plans and geometry do not depend on them.

A device keeps arrays of its own (`put`, `take`), which NumPy's functions take as they do NumPy's; on the CPU they are
NumPy's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Protocol

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.errors import InputError, ProcessingError, library_for
from blocksar.kernels.decimation import Decimation, add_decimated, turn_and_decimate
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.groups import PART_BYTES, row_groups, run_groups
from blocksar.kernels.projection import UPSAMPLING, LitPixels, Sights, Tiles, project

Tile = tuple[slice, slice]
TILE = 128  # pixels per side: enough that the preparation of a tile costs little


class Device(Protocol):
    """Interface of a device for back-projection.

    Attributes
    ----------
    name : str
    upsampling : int
        Bins of range profiles per range cell in exact back-projection.
    group_bytes : int
        Of the samples of parts that are worked on at a time.
    """

    name: str
    upsampling: int
    group_bytes: int

    def limit(self, memory: int) -> None:
        """Limit the device's memory, bytes.

        Raises
        ------
        MemoryError
            If less is free.
        """

    def put(self, values: Any) -> Any:
        """Copy a NumPy array to the device; None for None."""

    def take(self, values: Any) -> Any:
        """Copy an array of the device to NumPy."""

    def empty(self, shape: Any, dtype: Any) -> Any:
        """Allocate an array on the device, not cleared."""

    def fft_rows(self, group: Any, *, inverse: bool) -> Any:
        """Transform as `fourier.fft_rows`."""

    def run(self, work: Callable[[slice], None], rows: int, length: int, threads: int) -> None:
        """Call `work` for groups of rows of `length` samples, as many as suit the device."""

    def turn_and_decimate(
        self, values: Any, source: IntArray, first: FloatArray, step: FloatArray, decimation: Decimation,
        target: IntArray, out: Any, others: Any,
    ) -> None:  # fmt: skip
        """`decimation.turn_and_decimate`."""

    def add_decimated(self, rows: Any, runs: IntArray, decimation: Decimation, out: Any) -> None:
        """`decimation.add_decimated`."""

    def project(
        self, image: Any, outside: Any, sights: Sights, pixels: LitPixels, weight: Any, threads: int = 1,
        given: Tiles | None = None,
    ) -> None:  # fmt: skip
        """`projection.project`, whose arrays of pixels are the device's; `weight` is None without weights.

        Where no tiles are given, all of the image is divided into some.
        """


class Cpu:
    """The cores of this machine."""

    name = "cpu"
    upsampling = UPSAMPLING["cpu"]
    group_bytes = PART_BYTES

    def limit(self, memory: int) -> None:
        """Ignore the limit, which dask enforces for processes."""

    def put(self, values: Any) -> Any:
        return values

    def take(self, values: Any) -> Any:
        return values

    def empty(self, shape: Any, dtype: Any) -> Any:
        return np.empty(shape, dtype)

    def fft_rows(self, group: ComplexArray, *, inverse: bool) -> ComplexArray:
        return fft_rows(group, inverse=inverse)

    def run(self, work: Callable[[slice], None], rows: int, length: int, threads: int) -> None:
        run_groups(work, row_groups(0, rows, length), threads)

    def turn_and_decimate(
        self, values: ComplexArray, source: IntArray, first: FloatArray, step: FloatArray, decimation: Decimation,
        target: IntArray, out: ComplexArray, others: ComplexArray,
    ) -> None:  # fmt: skip
        turn_and_decimate(values, source, first, step, decimation, target, out, others)

    def add_decimated(self, rows: ComplexArray, runs: IntArray, decimation: Decimation, out: ComplexArray) -> None:
        add_decimated(rows, runs, decimation, out)

    def project(
        self, image: Any, outside: Any, sights: Sights, pixels: LitPixels, weight: Any, threads: int = 1,
        given: Tiles | None = None,
    ) -> None:  # fmt: skip
        weight = np.empty(image.shape, np.float32) if weight is None else weight
        if given is not None:
            project(image, outside, sights, pixels, weight, given)
            return
        block = sights.start, sights.start + sights.reference_range.size

        def work(tile: Tile) -> None:
            project(image, outside, sights, pixels, weight, Tiles.of(pixels, [tile], block))

        run_groups(work, tiles(image.shape), threads)


CPU = Cpu()


def tiles(shape: tuple[int, ...]) -> list[Tile]:
    """Divide an image (n_row, n_column) into tiles to be processed one by one."""
    height = TILE if shape[0] > 1 else 1
    width = TILE**2 // height
    return [
        (slice(row, min(row + height, shape[0])), slice(column, min(column + width, shape[1])))
        for row in range(0, shape[0], height)
        for column in range(0, shape[1], width)
    ]


def has_gpu() -> bool:
    """Tell whether this process can use a GPU: hardware and packages are present."""
    try:
        device("gpu")
    except InputError:
        return False
    return True


@cache
def device(name: str) -> Device:
    """Return the device of a name.

    Raises
    ------
    InputError
        If it is not there.
    """
    if name == "cpu":
        return CPU
    try:
        with library_for("--device gpu needs", "gpu"):
            from blocksar.kernels.gpu import Gpu, missing
    except ImportError as error:  # of libraries that are there, but lack others of the system
        raise InputError(f"device gpu: {' '.join(str(error).split())}; leave --device out") from None
    if (lack := missing()) is not None:
        raise InputError(f"device gpu: {lack}; leave --device out")
    return Gpu()


@contextmanager
def on_device(name: str, memory: int) -> Iterator[Device]:
    """Yield the device of a name; an InputError if a GPU lacks `memory` bytes (0: all of it).

    Raises
    ------
    ProcessingError
        If its memory does not suffice.
    """
    try:
        opened = device(name)
        opened.limit(memory)
        yield opened
    except MemoryError as error:
        if name == "cpu":
            raise
        cause = " ".join(str(error).split())
        raise ProcessingError(
            f"the GPU has too little memory ({cause}); end what else uses it, give fewer --workers, or leave --device "
            "out"
        ) from None
