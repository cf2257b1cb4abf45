"""Files written and read past the page cache: any length, any order, file systems without it; files of a folder."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from blocksar.places import direct, place

SIZES = [1, 511, 4095, 4096, 4097, direct.BUFFER - 1, direct.BUFFER, direct.BUFFER + 1, 2 * direct.BUFFER + 5000]


def some_bytes(size: int) -> bytes:
    return np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()


def refuse() -> NoReturn:
    raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))


@pytest.fixture(params=["direct", "refused when opened", "refused when used"])
def file_system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Refuse direct transfers as file systems do that lack them, when a file is opened or at its first transfer."""
    opened, written, read = os.open, os.write, os.preadv

    def is_direct(descriptor: int) -> bool:
        return bool(fcntl.fcntl(descriptor, fcntl.F_GETFL) & direct.DIRECT)

    if request.param == "refused when opened":
        monkeypatch.setattr(os, "open", lambda *a, **k: refuse() if a[1] & direct.DIRECT else opened(*a, **k))
    if request.param == "refused when used":
        monkeypatch.setattr(os, "write", lambda fd, data: refuse() if is_direct(fd) else written(fd, data))
        monkeypatch.setattr(os, "preadv", lambda fd, *a: refuse() if is_direct(fd) else read(fd, *a))
    return str(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("cached", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_a_file_holds_what_was_written(size: int, cached: bool, file_system: str, tmp_path: Path) -> None:
    data = some_bytes(size)
    with direct.writing(str(tmp_path / "file"), cached=cached) as file:
        for first in range(0, size, 700_001):  # parts of no round length
            file.write(memoryview(data)[first : first + 700_001])
    assert (tmp_path / "file").read_bytes() == data


@pytest.mark.parametrize("size", SIZES)
def test_parts_of_a_file_are_read(size: int, file_system: str, tmp_path: Path) -> None:
    data = some_bytes(size)
    (tmp_path / "file").write_bytes(data)
    for first, last in ((0, size), (size // 3, size // 2), (size - 1, size), (size // 2, size + 10)):
        with direct.reading(str(tmp_path / "file")) as file:
            target = bytearray(last - first)
            file.seek(first)
            count = file.readinto(memoryview(target))
        assert count == min(last, size) - first
        assert bytes(target[:count]) == data[first:last]


def test_a_file_is_read_in_several_parts(tmp_path: Path) -> None:
    data = some_bytes(3_000_000)
    (tmp_path / "file").write_bytes(data)
    with direct.reading(str(tmp_path / "file")) as file:
        for first, size in ((100, 5000), (5100, 4096), (1_000_001, 1_500_000), (2_999_999, 1)):
            target = bytearray(size)
            file.seek(first)
            assert file.readinto(memoryview(target)) == size
            assert bytes(target) == data[first : first + size]


def test_an_error_of_the_disk_is_not_taken_for_a_missing_feature(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"), direct.writing(str(tmp_path / "file")) as file:
        file.write(bytes(5000))


def test_links_that_lead_nowhere_are_no_files(tmp_path: Path) -> None:
    """A run with one ended in a traceback when its room on the disk was counted."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_bytes(b"1234")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder" / "nowhere").symlink_to("nothing")
    assert [(name, size) for name, size, _ in place(tmp_path).files()] == [("folder/file", 4)]
    assert place(tmp_path).taken() > 0
