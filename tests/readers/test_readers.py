"""Readers of other packages stand beside the own ones: in help, commands, Python, `info` and messages."""

from __future__ import annotations

import json
from inspect import signature
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from extension import install, run_commands
from near_range import near_range

import blocksar
from blocksar import api, stores
from blocksar.options import options_of
from blocksar.readers.registry import READERS, ReaderOptions

Flight = dict[str, Any]


@pytest.fixture(scope="module")
def flight() -> Flight:
    along = np.linspace(-2, 2, 300)
    return near_range(n_frequency=64, track=np.stack([0 * along - 5.0, along, 0 * along + 1.5], axis=1))


def written(folder: Path, flight: Flight) -> Path:
    """A file of the extension's format."""
    signal, frequency = np.asarray(flight["signal"], "<c8"), np.asarray(flight["range_frequency"])
    told = {
        "pulses": signal.shape[0], "columns": signal.shape[1], "carrier": flight["carrier_frequency"], "by": "a test",
        "prf": 1 / float(flight["time"][1] - flight["time"][0]), "step": float(frequency[1] - frequency[0]),
        "reference_range": float(np.ravel(flight["reference_range"])[0]), "title": "a flight",
    }  # fmt: skip
    path = folder / "flight.bin"
    track = np.asarray(flight["antenna_position"], "<f8")
    path.write_bytes(b"MADEUP 1\n" + json.dumps(told).encode() + b"\n" + track.tobytes() + signal.tobytes())
    return path


@pytest.mark.slow
def test_a_reader_of_another_package_has_a_command_and_knows_its_files(tmp_path: Path, flight: Flight) -> None:
    environment, path = install(tmp_path / "site"), written(tmp_path, flight)
    cut = tmp_path / "cut.bin"
    cut.write_bytes(path.read_bytes()[:-9])
    outs, options = [tmp_path / f"{name}.zarr" for name in "ab"], ("--gain", "2", "-q")
    listed, shown, told, *ingested, refused, mistaken = run_commands(
        environment,
        ("ingest", "--help"),
        ("ingest", "madeup", "--help"),
        ("info", str(path)),
        ("ingest", "madeup", str(path), "--out", str(outs[0]), *options),  # by its name
        ("ingest", str(path), "--out", str(outs[1]), *options),  # by the file's first bytes
        ("ingest", str(cut), "--out", str(tmp_path / "c.zarr")),
        ("plan", str(path)),
    )
    assert "│ madeup Convert a MADEUP file" in " ".join(listed.stdout.split()) and all(
        name in listed.stdout for name in READERS.own
    )
    assert all(option in shown.stdout for option in ("--gain", "--ground-height", "--collection-start"))
    assert told.returncode == 0 and "by a test" in " ".join(told.stdout.split()), told.stderr
    for done, out in zip(ingested, outs, strict=True):
        assert done.returncode == 0 and "300 pulses of 64 samples, by a test" in done.stdout, done.stderr
        history = stores.open_phase_history(out)
        assert np.array_equal(history.read(slice(None), slice(None)), 2 * np.asarray(flight["signal"], np.complex64))
        assert history.attrs["source"] == {"format": "MADEUP", "by": "a test"}
        assert np.array_equal(history.collection.antenna_position, flight["antenna_position"])

    assert refused.returncode == 2 and "cut.bin is damaged" in refused.stderr and not (tmp_path / "c.zarr").exists()
    assert "is a MADEUP file; turn it into a phase history first: `blocksar ingest" in mistaken.stderr


def test_what_no_reader_knows_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(blocksar.InputError, match=r"a\.png is a PNG picture"):
        blocksar.ingest(None, tmp_path / "a.png", tmp_path / "a.zarr")


@pytest.mark.parametrize("name", READERS.own)
def test_an_own_reader_has_a_function_with_the_options_of_its_model(name: str) -> None:
    model, function = READERS.get(name).options, getattr(api, f"ingest_{name}")
    assert issubclass(model, ReaderOptions)
    known = signature(function).parameters
    for option in options_of(model):
        expected = None if option.option.read is not None else option.default
        assert known[option.name].default == expected
    [told] = get_args(get_type_hints(function)["options"])  # what type checkers know
    assert set(get_type_hints(told)) == set(known) - {"source", "out"}
