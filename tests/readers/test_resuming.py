"""An ingestion that ended early is gone on with: nothing twice, nothing half, and the bytes of one that did not."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import s3
import sentinel1_packets as s1
from raw_satellites import Radar, write_nisar
from scipy.io import savemat

import blocksar
from blocksar import stores
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.progress import Listener
from blocksar.readers.sentinel1 import histories
from blocksar.stores import pieces

cphd_files = pytest.importorskip("cphd_files", reason="the extra `formats` is not installed")


def read_little_at_once(patch: pytest.MonkeyPatch) -> None:
    """A chunk of pulses of most sources, less of bursts."""
    patch.setattr(pieces, "AT_ONCE", 1)
    patch.setattr(histories, "AT_ONCE", MIB)


@pytest.fixture(autouse=True)
def little_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read_little_at_once(monkeypatch)


def write_gotcha(path: Path, n_pulse: int = 2900) -> Path:
    """Noise seen along a part of a circle."""
    azimuth, generator = np.radians(0.0085) * np.arange(n_pulse), np.random.default_rng(1)
    x, y, z = 7000 * np.cos(azimuth), 7000 * np.sin(azimuth), np.full(n_pulse, 7200.0)
    samples = (generator.standard_normal((16, n_pulse)) + 1j).astype(np.complex64)
    axes = {"x": x, "y": y, "z": z, "r0": np.hypot(7000.0, z), "th": np.degrees(azimuth), "phi": np.full(n_pulse, 45.8)}
    savemat(path, {"data": {"fp": samples, "freq": 9.6e9 + 1.5e6 * np.arange(16.0)[:, None], **axes}})
    return path


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """CPHD with lost vectors, of which chunks are given twice; a circle; two channels of a strip; three bursts."""
    folder = tmp_path_factory.mktemp("sources")
    (folder / "scene.toml").write_text(cphd_files.SCENE.replace("pulses = 160", "pulses = 1700"))
    blocksar.simulate(folder / "scene.toml", folder / "whole.cphd", cphd=True)
    parts = cphd_files.parts_of(folder / "whole.cphd")
    parts.samples[[30, 1100]] = 0
    return {
        "cphd": cphd_files.write(folder / "lost.cphd", parts),
        "gotcha": write_gotcha(folder / "data_3dsar_pass1_az001_HH.mat"),
        "nisar": write_nisar(folder / "strip.h5", Radar(n_pulse=1100, n_sample=640), polarizations=("HH", "HV")),
        "sentinel1": s1.write_bursts(folder / "bursts.dat", [s1.place_on_the_ellipsoid(10.0, s1.MIDDLE)]),
    }


WRITTEN = {"cphd": 4 + 2, "gotcha": 6, "nisar": 2 * 3, "sentinel1": 3 * 2}  # pieces


class Shown(Listener):
    """The progress that is shown."""

    def __init__(self) -> None:
        self.lines: list[tuple[int, int]] = []
        self.reused = 0

    def begin(self, stage: str, reused: int = 0) -> None:
        self.reused = reused

    def update(self, stage: str, done: int, total: int) -> None:
        self.lines.append((done, total))


def contents(where: Any) -> dict[str, bytes]:
    """All files of a store, without the times at which it was made."""
    found = place(where)
    stamp = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ (?=ingested)")
    return {name: stamp.sub(b"", (found / name).read_bytes()) for name, _, _ in found.files()}


def left(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name.endswith(".part")]


def stopping(monkeypatch: pytest.MonkeyPatch, after: int, error: BaseException | None = None) -> list[int]:
    """Let the piece after so many fail; the list grows with each that is written."""
    written: list[int] = []
    write = pieces.write_region

    def stop(*arguments: Any) -> None:
        if len(written) == after:
            raise error or KeyboardInterrupt
        write(*arguments)
        written.append(1)

    monkeypatch.setattr(pieces, "write_region", stop)
    return written


@pytest.fixture(scope="module")
def whole(sources: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Any, list[str]]]:
    """Bytes and messages of ingestions that nothing ended."""
    folder, made = tmp_path_factory.mktemp("whole"), {}
    with pytest.MonkeyPatch.context() as patch:
        read_little_at_once(patch)
        for name, source in sources.items():
            report = blocksar.ingest(name, source, folder / "ph.zarr", overwrite=True)
            made[name] = contents(folder / "ph.zarr"), report.summary[:-1]
    return made


@pytest.mark.slow
@pytest.mark.parametrize(("name", "after"), [("cphd", 0), ("cphd", 5), ("gotcha", 1), ("nisar", 4), ("sentinel1", 4)])
def test_what_was_written_stays_and_the_rest_is_written(
    name: str, after: int, sources: dict[str, Path], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, shown = tmp_path / "ph.zarr", Shown()
    with monkeypatch.context() as patch:
        stopping(patch, after)
        with pytest.raises(KeyboardInterrupt):
            blocksar.ingest(name, sources[name], out)
    assert not out.exists() and len(left(tmp_path)) == 1
    written = stopping(monkeypatch, -1)
    report = blocksar.ingest(name, sources[name], out, progress=shown)
    assert len(written) == WRITTEN[name] - after
    assert os.listdir(tmp_path) == ["ph.zarr"] and contents(out) == whole[name][0]
    total = shown.lines[-1][1]
    assert (shown.reused > 0) == (after > 0) and (not after or shown.lines[0] == (shown.reused, total))
    assert shown.lines[-1] == (total, total) and sorted(shown.lines) == shown.lines
    told = f"{shown.reused} of {total} pulses kept from a call that ended early"
    assert report.summary[:-1] == [*whole[name][1], *([told] if after else [])]


KILLED = """
import os, signal, sys
import blocksar
from blocksar.stores import pieces

write, written = pieces.write_region, []

def write_and_die(*arguments):
    write(*arguments)
    written.append(1)
    if len(written) == 3:
        os.kill(os.getpid(), signal.SIGKILL)

pieces.AT_ONCE, pieces.write_region = 1, write_and_die
blocksar.ingest("cphd", *sys.argv[1:])
"""


@pytest.fixture(scope="module")
def killed(sources: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a process left that was killed once it had written a third piece, which its ledger lacks."""
    out = tmp_path_factory.mktemp("killed") / "ph.zarr"
    ended = subprocess.run([sys.executable, "-c", KILLED, str(sources["cphd"]), str(out)], check=False)
    assert ended.returncode == -signal.SIGKILL and not out.exists()
    return out.parent


@pytest.mark.parametrize("damage", [None, "cut", "other", "ledger"])
def test_a_killed_process_leaves_what_is_whole(
    damage: str | None, killed: Path, sources: dict[str, Path], whole: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    """A loss of power may have spoilt what its ledger has."""
    shutil.copytree(killed, tmp_path, dirs_exist_ok=True)
    out, [part] = tmp_path / "ph.zarr", left(tmp_path)
    chunk = tmp_path / part / "signal" / "c" / "1" / "0"
    if damage == "ledger":
        (tmp_path / part / pieces.LEDGER).write_bytes(b"{")
    elif damage is not None:
        data = chunk.read_bytes()
        chunk.write_bytes(data[:-1] if damage == "cut" else bytes(8) + data[8:])
    written = stopping(monkeypatch, -1)
    blocksar.ingest("cphd", sources["cphd"], out)
    assert len(written) == WRITTEN["cphd"] - {None: 2, "ledger": 0}.get(damage, 1)
    assert os.listdir(tmp_path) == ["ph.zarr"] and contents(out) == whole["cphd"][0]


@pytest.mark.slow
@pytest.mark.parametrize("change", ["file", "option", "version"])
def test_what_has_changed_begins_anew(
    change: str, sources: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out, options = tmp_path / "a.cphd", tmp_path / "ph.zarr", {}
    source.write_bytes(sources["cphd"].read_bytes())
    with monkeypatch.context() as patch:
        stopping(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            blocksar.ingest("cphd", source, out)
    if change == "file":
        source.write_bytes(source.read_bytes()[:-8] + bytes(8))
        os.utime(source, (1, 1))
    elif change == "option":
        options = {"sgn": +1}
    else:
        monkeypatch.setattr("blocksar.readers.registry.__version__", "0.0.1")
    shown = Shown()
    blocksar.ingest("cphd", source, out, progress=shown, **options)
    assert shown.reused == 0 and sorted(os.listdir(tmp_path)) == ["a.cphd", "ph.zarr"]
    blocksar.ingest("cphd", source, tmp_path / "b.zarr", **options)
    assert contents(out) == contents(tmp_path / "b.zarr")


def test_only_what_may_succeed_later_is_kept(
    sources: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for cause, kept in ((OSError(5, "the server does not answer"), True), (None, False)):
        error = InputError("a.cphd cannot be read")
        error.__cause__ = cause
        with monkeypatch.context() as patch:
            stopping(patch, 2, error)
            with pytest.raises(InputError, match="cannot be read"):
                blocksar.ingest("cphd", sources["cphd"], tmp_path / "ph.zarr")
        assert bool(left(tmp_path)) == kept


@pytest.mark.slow
def test_an_object_store_is_gone_on_with(
    sources: dict[str, Path], whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bucket: Place
) -> None:
    out, source = str(bucket / "ph.zarr"), sources["sentinel1"]
    with monkeypatch.context() as patch:
        stopping(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            blocksar.ingest("sentinel1", source, out)
    with pytest.raises(InputError, match="was left unfinished"):
        stores.open_phase_history(out)
    with pytest.raises(InputError, match=r"is not a zarr store"):
        stores.open_phase_history(f"{out}/IW1-VV-000")
    with pytest.raises(InputError, match=r"was left unfinished; .* overwritten"):
        blocksar.ingest("sentinel1", source, out, troposphere="standard")
    with place(f"{out}.lock").lock(), pytest.raises(InputError, match=r"is being written by process \d+ on"):
        blocksar.ingest("sentinel1", source, out)
    written = stopping(monkeypatch, -1)
    blocksar.ingest("sentinel1", source, out)
    assert len(written) == 3 and contents(out) == whole["sentinel1"][0]
    assert bucket.names() == ["ph.zarr"]
    with pytest.raises(InputError, match="exists; choose another name"):
        blocksar.ingest("sentinel1", source, out)


@pytest.fixture
def bucket() -> Iterator[Place]:
    with s3.server():
        yield place(f"s3://{s3.make_bucket()}")
