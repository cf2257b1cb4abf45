"""Gotcha files: simulated files ingest to the simulated samples, and damaged files give a one-sentence error.

The tests of measured files need the environment variable BLOCKSAR_DATA: a folder with these files in its
subfolder gotcha/.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy.io import savemat
from typer.testing import CliRunner

from blocksar import api, places, stores
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.measurement.coherence import coherence
from blocksar.measurement.targets import Target
from blocksar.processors.chain.dwells import target_lines
from blocksar.processors.chain.planning import spectrum_recovery
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.steps import recovery
from blocksar.processors.exact.sums import form_image
from blocksar.readers import gotcha, gotcha_files
from blocksar.readers import registry as readers
from blocksar.readers.gotcha import GOTCHA
from blocksar.readers.gotcha_files import read_struct
from blocksar.readers.reading import Ingested
from blocksar.readers.registry import ReaderOptions
from blocksar.readers.resampling import plan_resampling
from blocksar.simulation.scatterers import simulate_pulses

N_FREQUENCY = 48
FREQUENCY = 9.6e9 + 1.5e6 * (np.arange(N_FREQUENCY) - N_FREQUENCY // 2)  # Hz
RADIUS, HEIGHT, STEP = 7000.0, 7200.0, np.radians(0.0085)  # m, m, rad
SCENE = (np.array([-20.0, 3.0, 31.0]), np.array([12.0, -5.0, 25.0]), np.array([1.0, 0.5j, -0.7 + 0.2j]))
Record = dict[str, Any]


def ingest(source: Path | list[Path], out: Path, **settings: Any) -> Ingested:
    sources = source if isinstance(source, list) else [source]
    return readers.ingest(GOTCHA, sources, out, ReaderOptions(), **settings)


def collection_at(position: np.ndarray) -> Collection:
    """Collection with pulses at positions (n, 3) and the range to the origin as reference range."""
    n = len(position)
    return Collection(
        carrier=9.6e9,
        time=np.arange(n) * 0.01,
        range_frequency=FREQUENCY - 9.6e9,
        reference_range=np.linalg.norm(position, axis=1),
        antenna_position=position,
        beam_azimuth=np.full(n, np.nan),
    )


def circle(azimuth: np.ndarray, height: np.ndarray | float = HEIGHT) -> np.ndarray:
    return np.stack([RADIUS * np.cos(azimuth), RADIUS * np.sin(azimuth), height + 0 * azimuth], axis=1)


def record_of(position: np.ndarray) -> Record:
    """The struct of a file, with float32 rows as in measured files."""
    collection = collection_at(position)
    away = collection.reference_range
    fields = {
        "x": position[:, 0],
        "y": position[:, 1],
        "z": position[:, 2],
        "r0": away,
        "th": np.mod(np.degrees(np.arctan2(position[:, 1], position[:, 0])), 360),
        "phi": np.degrees(np.arcsin(position[:, 2] / away)),
    }
    record: Record = {name: values.astype(np.float32)[None, :] for name, values in fields.items()}
    record["fp"] = simulate_pulses(collection, *SCENE).T.copy()
    record["freq"] = FREQUENCY.astype(np.float32)[:, None]
    record["af"] = {name: np.zeros((1, len(position)), np.float32) for name in ("r_correct", "ph_correct")}
    return record


def packed(record: Record, *, name: str = "data", compressed: bool = False) -> bytes:
    stream = io.BytesIO()
    savemat(stream, {name: record}, do_compression=compressed)
    return stream.getvalue()


def written(folder: Path, *positions: np.ndarray, first: int = 1) -> list[Path]:
    """Write one file for each array of positions."""
    paths = []
    for k, position in enumerate(positions, first):
        paths.append(folder / f"data_3dsar_pass1_az{k:03d}_HH.mat")
        paths[-1].write_bytes(packed(record_of(position)))
    return paths


@pytest.fixture(scope="module")
def record() -> Record:
    return record_of(circle(STEP * np.arange(20)))


AZIMUTH = STEP * np.arange(90)


def samples(path: Path) -> np.ndarray:
    return stores.open_phase_history(path).read(slice(None), slice(None))


# ---------------------------------------------------------------- Joining files


def test_files_in_any_order_are_joined_in_azimuth(tmp_path: Path) -> None:
    paths = written(tmp_path, *np.split(circle(AZIMUTH), 3))
    made = ingest([paths[2], paths[0], paths[1]], tmp_path / "ph.zarr")
    wanted = collection_at(circle(AZIMUTH))
    history = stores.open_phase_history(tmp_path / "ph.zarr")
    found = history.collection
    assert found.n_pulse == 90
    assert np.abs(found.antenna_position - wanted.antenna_position).max() < 3e-4  # float32
    # The reference range is computed from x, y and z; r0 has its own rounding.
    assert np.abs(found.reference_range - np.linalg.norm(found.antenna_position, axis=1)).max() < 1e-9
    assert np.abs(found.carrier + found.range_frequency - FREQUENCY).max() < 1100  # Hz, float32 again
    assert np.array_equal(samples(tmp_path / "ph.zarr"), simulate_pulses(wanted, *SCENE))
    assert "3 files, 90 pulses; AFRL Gotcha, pass 1, HH" in made.messages[0]
    assert history.attrs["source"]["files"] == [paths[2].name, paths[0].name, paths[1].name]
    assert history.attrs["polarization"] == {"transmit": "H", "receive": "H"}
    assert any("af" in line and "not applied" in line for line in made.messages)


@pytest.mark.parametrize("turn", [-0.4, 5.0])
def test_the_circle_has_no_seam(tmp_path: Path, turn: float) -> None:
    """Files on either side of azimuth zero are neighbours; a flight in the other direction is sorted."""
    position = circle(AZIMUTH + turn * STEP * 90)[::-1]
    made = ingest(written(tmp_path, *np.split(position, 2)), tmp_path / "ph.zarr")
    assert np.abs(made.collection.antenna_position - position[::-1]).max() < 3e-4
    assert np.array_equal(samples(tmp_path / "ph.zarr"), simulate_pulses(collection_at(position[::-1]), *SCENE))


def test_duplicate_pulses_are_kept_once(tmp_path: Path) -> None:
    position = circle(AZIMUTH)
    paths = written(tmp_path, position[:50], position[40:])
    made = ingest([*paths, paths[0]], tmp_path / "ph.zarr")
    assert "60 of 150 pulses that repeat another: left out" in made.messages
    assert np.array_equal(samples(tmp_path / "ph.zarr"), simulate_pulses(collection_at(position), *SCENE))


def test_a_few_lost_pulses_become_missing(tmp_path: Path) -> None:
    position = circle(AZIMUTH)
    made = ingest(written(tmp_path, position[:40], position[45:]), tmp_path / "ph.zarr")
    wanted = simulate_pulses(collection_at(position), *SCENE)
    wanted[40:45] = np.nan
    assert np.array_equal(samples(tmp_path / "ph.zarr"), wanted, equal_nan=True)
    assert np.abs(made.collection.antenna_position - position).max() < 3e-4
    assert any("missing pulses: 5 of 90" in line for line in made.messages)


def test_chunks_of_pulses_are_gathered_across_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for holder in (gotcha, stores.pieces, stores.creation):
        monkeypatch.setattr(holder, "TILE", (16, 1024))
    told: list[tuple[int, int]] = []
    ingest(written(tmp_path, *np.split(circle(AZIMUTH), 9)), tmp_path / "ph.zarr", progress=lambda *n: told.append(n))
    assert np.array_equal(samples(tmp_path / "ph.zarr"), simulate_pulses(collection_at(circle(AZIMUTH)), *SCENE))
    assert told == [(n, 90) for n in (16, 32, 48, 64, 80, 90)]


def test_track_figures_are_reported(tmp_path: Path) -> None:
    """A vertical wobble of 4 mm that no polynomial follows appears as the misfit; almost none of it remains."""
    wobble = 0.004 * np.sin(2.0 * np.arange(90))
    made = ingest(written(tmp_path, circle(AZIMUTH, HEIGHT + wobble)), tmp_path / "ph.zarr")
    line = next(line for line in made.messages if line.startswith("track"))
    track = Geometry(collection=made.collection).track
    assert f"{track} misses" in line
    assert 3 < float(line.split("at most ")[1].split(" mm")[0]) < 5
    # At 46 m from the centre the line of sight differs by this angle: its share of the 4 mm.
    assert float(line.split("leaves ")[1].split(" mm")[0]) < 0.004 * 1e3 * 90 / 10_000
    found = samples(tmp_path / "ph.zarr")
    assert np.array_equal(found, simulate_pulses(collection_at(circle(AZIMUTH, HEIGHT + wobble)), *SCENE))


def test_r0_is_kept_where_it_differs_from_the_distance(tmp_path: Path) -> None:
    position = circle(AZIMUTH)
    record = record_of(position)
    record["r0"] = record["r0"].astype(np.float64) + 3.0
    (tmp_path / "a.mat").write_bytes(packed(record))
    made = ingest(tmp_path / "a.mat", tmp_path / "ph.zarr")
    assert np.abs(made.collection.reference_range - np.linalg.norm(position, axis=1) - 3).max() < 2e-3


# ---------------------------------------------------------------- Polarisations


def polarised(paths: list[Path], name: str, factor: complex) -> list[Path]:
    """Copies of files of HH as another polarisation, in which every target has `factor` times the reflectivity."""
    copies = [path.with_name(path.name.replace("HH", name)) for path in paths]
    for path, copied in zip(paths, copies, strict=True):
        fields = read_struct(path.read_bytes(), "data")
        record = {key: value for key, value in fields.items() if key not in ("af", "fp")}
        copied.write_bytes(packed({**record, "fp": (factor * fields["fp"]).astype(np.complex64)}))
    return copies


def test_polarisations_become_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for holder in (gotcha, stores.pieces, stores.creation):
        monkeypatch.setattr(holder, "TILE", (16, 1024))
    position = circle(AZIMUTH)
    factors = {"HH": 1, "HV": 0.25j, "VH": 0.5, "VV": -2}
    alone = written(tmp_path, position[:40], position[45:])
    ingest(alone, tmp_path / "hh.zarr")
    others = [path for name in ("VV", "HV", "VH") for path in polarised(alone, name, factors[name])]
    told: list[tuple[int, int]] = []
    made = ingest([*others, *alone], tmp_path / "ph.zarr", progress=lambda *n: told.append(n))
    assert "8 files, 85 pulses in each of the channels HH, HV, VH, VV;" in made.messages[0]
    assert told[-1] == (360, 360) and len(told) == 24
    single, history = (stores.open_phase_history(tmp_path / name) for name in ("hh.zarr", "ph.zarr"))
    assert single.channels == () and history.channels == ("HH", "HV", "VH", "VV")
    for name in ("time", "reference_range", "antenna_position", "range_frequency"):
        assert np.array_equal(getattr(history.collection, name), getattr(single.collection, name))
    wanted = samples(tmp_path / "hh.zarr")
    assert np.isnan(wanted[40:45]).all()
    for name, factor in factors.items():
        channel = history.of_channel(name)
        found = channel.read(slice(None), slice(None))
        assert np.array_equal(found, (factor * wanted).astype(np.complex64), equal_nan=True), name
        assert channel.attrs["polarization"] == {"transmit": name[0], "receive": name[1]}


def test_uneven_polarisations_are_resampled_alike(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    alone = written(tmp_path, circle(STEP * (np.arange(150) + random.uniform(-0.2, 0.2, 150))))
    ingest(alone, tmp_path / "hh.zarr")
    ingest([*alone, *polarised(alone, "VV", -2)], tmp_path / "ph.zarr")
    history, wanted = stores.open_phase_history(tmp_path / "ph.zarr"), samples(tmp_path / "hh.zarr")
    for name, factor in (("HH", 1), ("VV", -2)):
        found = history.of_channel(name).read(slice(None), slice(None))
        assert np.array_equal(found, (factor * wanted).astype(np.complex64), equal_nan=True)


def test_polarisations_of_other_places_are_refused(tmp_path: Path) -> None:
    position = circle(AZIMUTH)
    alone = written(tmp_path, position)

    def other(name: str, **fields: np.ndarray) -> Path:
        path = tmp_path / name
        path.write_bytes(packed({**record_of(position), **fields}))
        return path

    record = record_of(position)
    aside = other("aside_VV.mat", z=record["z"] + np.float32(0.004))
    referred = other("referred_VV.mat", r0=record["r0"] + np.float32(0.004))
    close = other("close_VV.mat", z=record["z"] + np.float32(0.0005))  # less than a float32's rounding
    short = tmp_path / "short_VV.mat"
    short.write_bytes(packed(record_of(position[:-1])))
    nameless = other("nameless.mat")
    for given, said in (
        ([aside], r"x, y and z of VV and HH differ by 0\.00\d+ m at azimuth"),
        ([referred], r"r0 of VV and HH differ by 0\.00\d+ m"),
        ([short], "polarisation VV has 89 pulses, but HH 90"),
        ([close, nameless], "nameless.mat has no polarisation in its name, but others are of HH and VV"),
    ):
        with pytest.raises(InputError, match=said) as refused:
            ingest([*alone, *given], tmp_path / "ph.zarr")
        one_sentence(str(refused.value).replace(str(tmp_path), "").replace(".mat", ""))
        assert not (tmp_path / "ph.zarr").exists()
    made = ingest([*alone, close], tmp_path / "ph.zarr")
    assert made.collection.n_pulse == 90


# ---------------------------------------------------------------- Uneven pulses


@pytest.mark.parametrize(("band", "jitter", "most"), [(0.5, 0.3, 2e-3), (0.9, 0.2, 4e-3)])
def test_no_echo_exceeds_the_error_bound(band: float, jitter: float, most: float) -> None:
    random = np.random.default_rng(7)
    time = np.arange(300) + random.uniform(-jitter, jitter, 300)
    uniform = np.arange(300.0)
    made = plan_resampling(time, uniform, band=band)
    doppler = random.uniform(-band / 2, band / 2, 64)
    echoes = np.exp(2j * np.pi * time[:, None] * doppler).astype(np.complex64)
    found = made.apply(echoes[made.inputs(slice(0, 300))], slice(0, 300))
    error = np.abs(found - np.exp(2j * np.pi * uniform[:, None] * doppler))
    assert np.isnan(error[~made.good]).all() and np.count_nonzero(~made.good) <= 12
    good = made.good
    assert (error[good] <= made.bound[good, None] + 2e-6).all()
    assert made.bound[good].max() <= 0.05
    assert made.bound[20:-20].max() < most
    # The bound is tight: echoes come near it. Without resampling the error would be far larger.
    assert (error[good].max(axis=1) > 0.2 * made.bound[good] - 2e-6).mean() > 0.9
    assert np.abs(echoes - np.exp(2j * np.pi * uniform[:, None] * doppler)).max() > 10 * error[good].max()


def test_even_pulses_are_not_changed() -> None:
    time = np.arange(40.0)
    made = plan_resampling(time, time, band=0.7)
    echoes = np.exp(2j * np.pi * 0.3 * time)[:, None].astype(np.complex64)
    assert np.abs(made.apply(echoes, slice(0, 40)) - echoes).max() < 2e-4
    assert made.good.all()


def test_gaps_that_neighbours_cannot_fill_are_missing() -> None:
    time = np.delete(np.arange(120.0), slice(50, 60))
    made = plan_resampling(time, np.arange(120.0), band=0.8)
    assert not made.good[51:59].any()
    assert made.good[:48].all() and made.good[62:].all()


def test_uneven_pulses_become_uniform_within_the_reported_error(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    azimuth = STEP * (np.arange(300) + random.uniform(-0.2, 0.2, 300))
    made = ingest(written(tmp_path, *np.split(circle(azimuth), 2)), tmp_path / "ph.zarr")
    found = made.collection
    steps = np.diff(np.arctan2(found.antenna_position[:, 1], found.antenna_position[:, 0]))
    assert np.ptp(steps) < 1e-3 * STEP  # uniform after resampling
    line = next(line for line in made.messages if line.startswith("slow time"))
    bound = 10 ** (float(line.split("at most ")[1].split(" dB")[0]) / 20)
    assert bound < 0.06
    error = np.abs(samples(tmp_path / "ph.zarr") - simulate_pulses(found, *SCENE))
    assert np.nanmax(error) < 1.1 * bound * np.abs(SCENE[2]).sum()
    assert np.median(error[~np.isnan(error)]) < 2e-3
    assert found.n_pulse > 285


# ---------------------------------------------------------------- Refusals


def changed(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Record], bytes]:
    return lambda record: packed({**record, name: change(record[name])})


def without(name: str) -> Callable[[Record], bytes]:
    return lambda record: packed({key: value for key, value in record.items() if key != name})


def cut(share: float) -> Callable[[Record], bytes]:
    return lambda record: (data := packed(record))[: int(share * len(data))]


def put(values: np.ndarray, where: Any, value: complex) -> np.ndarray:
    values = values.copy()
    values[where] = value
    return values


def patched(offset: int, what: bytes, *, compressed: bool = False) -> Callable[[Record], bytes]:
    def make(record: Record) -> bytes:
        data = bytearray(packed(record, compressed=compressed))
        data[offset : offset + len(what)] = what
        return bytes(data)

    return make


def with_rows(count: int) -> Callable[[Record], bytes]:
    """Make a vector that claims `count` rows, more than memory could hold."""

    def make(record: Record) -> bytes:
        data = bytearray(packed(record))
        at = data.index(struct.pack("<IIii", 5, 8, 1, 20))
        data[at + 8 : at + 12] = struct.pack("<i", count)
        return bytes(data)

    return make


MUTATIONS: dict[str, tuple[Callable[[Record], bytes], str]] = {
    "empty": (lambda _: b"", "is an empty file"),
    "text": (lambda _: b"x" * 5000, "is a text file"),
    "header only": (cut(0.002), "MATLAB|no variable"),
    "half": (cut(0.5), "truncated"),
    "flipped, compressed": (patched(2000, b"\x00\xff\x00\xff", compressed=True), "damaged"),
    "version 7.3": (patched(124, b"\x00\x02"), "-v7"),
    "other byte order": (patched(126, b"MI"), "7.3|damaged|truncated"),
    "length of an element": (patched(132, b"\xff\xff\xff\x7f"), "truncated"),
    "type of an element": (patched(128, b"\x63"), "damaged|no variable"),
    "rows of a vector": (with_rows(1 << 30), "damaged"),
    "rows below zero": (with_rows(-1), "damaged"),
    "another variable": (lambda record: packed(record, name="datum"), "no variable"),
    "no struct": (lambda _: packed(np.zeros((3, 3))), "struct"),  # type: ignore[arg-type]
    "no fp": (without("fp"), "no field fp"),
    "no r0": (without("r0"), "no field r0"),
    "fp real": (changed("fp", np.real), "fp is of type float32"),
    "fp turned": (changed("fp", np.transpose), "transposed"),
    "fp short": (changed("fp", lambda fp: fp[:-1]), "freq has 48"),
    "fp a cell array": (changed("fp", lambda fp: fp.astype(object)), "fp is a cell array"),
    "fp fewer pulses": (changed("fp", lambda fp: fp[:, :-1]), "x has 20 values, but fp has 19"),
    "fp NaN": (changed("fp", lambda fp: put(fp, (3, 7), np.nan)), "frequency 3 of pulse 7"),
    "fp with a flipped bit": (changed("fp", lambda fp: put(fp, (1, 2), 1e34)), "frequency 1 of pulse 2"),
    "freq descending": (changed("freq", lambda f: f[::-1]), "must ascend"),
    "freq NaN": (changed("freq", lambda f: put(f, (5, 0), np.nan)), "freq is nan at index 5"),
    "freq uneven": (changed("freq", lambda f: put(f, (5, 0), f[5, 0] + 3e5)), "index 5"),
    "freq a matrix": (changed("freq", lambda f: f.reshape(2, -1)), "must be a vector"),
    "freq baseband": (changed("freq", lambda f: f - 9.6e9), "above 0 Hz"),
    "x complex": (changed("x", lambda x: x * 1j), "x is complex"),
    "y too many": (changed("y", lambda y: np.hstack([y, y])), "y has 40 values"),
    "z below the ground": (changed("z", lambda z: -z), "height"),
    "r0 of another collection": (changed("r0", lambda r: r + 500), "range window"),
    "th in radians": (changed("th", lambda th: np.radians(th) + 1), "th is"),
    "phi as azimuth": (lambda record: packed({**record, "phi": record["th"]}), "phi is"),
    "one place": (
        lambda record: packed({k: v if k in ("fp", "freq", "af") else v[:, :1] + 0 * v for k, v in record.items()}),
        "two different pulses|th is",
    ),
    "too few pulses": (
        lambda record: packed({k: v if k in ("freq", "af") else v[:, :7] for k, v in record.items()}),
        "7 pulses",
    ),
}


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path: Path, record: Record, mutation: str) -> None:
    make, said = MUTATIONS[mutation]
    file = tmp_path / "az001_HH.mat"
    file.write_bytes(make(record))
    with pytest.raises(InputError, match=said) as refused:
        ingest(file, tmp_path / "ph.zarr")
    one_sentence(str(refused.value))
    assert "az001_HH.mat" in str(refused.value) or "source" in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def one_sentence(text: str) -> None:
    assert "\n" not in text and ". " not in text and not text.endswith("."), text
    assert len(text) < 600, text


@pytest.mark.parametrize("compressed", [False, True])
def test_flipped_bytes_give_a_valid_store_or_a_one_sentence_error(
    tmp_path: Path, record: Record, compressed: bool
) -> None:
    """Whichever byte changes, the file either reads sensibly or gives a one-sentence error."""
    whole = packed(record, compressed=compressed)
    random = np.random.default_rng(11)
    # In the uncompressed file, flip bytes of the structure, which are few among those of the samples.
    places = random.integers(120, min(len(whole), 1500), 30) if not compressed else random.integers(0, len(whole), 20)
    file, refused = tmp_path / "a.mat", 0
    for at in places:
        data = bytearray(whole)
        data[at] ^= 1 << int(random.integers(0, 8))
        file.write_bytes(bytes(data))
        try:
            ingest(file, tmp_path / "ph.zarr", overwrite=True)
        except InputError as error:
            refused += 1
            one_sentence(str(error))
    assert refused > 9


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    position = circle(STEP * np.arange(200))
    first, second, far = written(tmp_path, position[:40], position[40:80], position[150:])
    other = tmp_path / "data_3dsar_pass1_az002_VV.mat"
    other.write_bytes(second.read_bytes())
    another = tmp_path / "data_3dsar_pass2_az002_HH.mat"
    another.write_bytes(second.read_bytes())
    moved = tmp_path / "moved_HH.mat"
    record = record_of(position[40:80])
    moved.write_bytes(packed({**record, "freq": record["freq"] + 2e6}))
    fewer = tmp_path / "fewer_HH.mat"
    fewer.write_bytes(packed({**record, "freq": record["freq"][:-1], "fp": record["fp"][:-1]}))
    higher = tmp_path / "higher_HH.mat"  # of another pass, which the name does not show
    higher.write_bytes(packed(record_of(circle(STEP * np.arange(40, 80), HEIGHT + 30))))
    bump = tmp_path / "bump_HH.mat"
    bump.write_bytes(packed(record_of(circle(STEP * np.arange(40, 80), HEIGHT + 30.0 * (np.arange(40) >= 20)))))
    over = tmp_path / "over_HH.mat"
    over.write_bytes(packed(record_of(circle(STEP * (0.4 + np.arange(20, 60))))))
    same = tmp_path / "same_HH.mat"
    again = record_of(position[40:80])
    same.write_bytes(packed({**again, "fp": 2 * again["fp"]}))
    for given, said in (
        ([first, other], "x, y and z of VV and HH differ by"),
        ([first, another], "pass 2"),
        ([first, moved], "freq from"),
        ([first, fewer], "47 samples"),
        ([first, over], "overlap"),
        ([first, second, same], "overlap|two different pulses"),
        ([first, far], "missing between"),
        ([first, higher], "30.* m apart at azimuth .* as files of two passes do"),
        ([first, bump], "x, y and z 30.* m apart"),
    ):
        with pytest.raises(InputError, match=said) as refused:
            ingest(given, tmp_path / "ph.zarr")
        one_sentence(str(refused.value).replace(str(tmp_path), ""))
        assert not (tmp_path / "ph.zarr").exists()


def test_pulses_too_uneven_to_resample_are_refused(tmp_path: Path) -> None:
    azimuth = STEP * np.sort(np.random.default_rng(1).uniform(0, 200, 200))  # at random places
    with pytest.raises(InputError, match=r"so unevenly in azimuth .* which leaves .* less than half; ingest the part"):
        ingest(written(tmp_path, circle(azimuth)), tmp_path / "ph.zarr")
    bursts = np.concatenate([20 * k + np.arange(8) for k in range(9)])
    with pytest.raises(InputError, match=r"which leaves 72 of 168 pulses, less than half; ingest files without"):
        ingest(written(tmp_path, circle(STEP * bursts)), tmp_path / "ph.zarr")


def test_a_compressed_variable_without_an_end_is_refused(record: Record) -> None:
    whole = packed(record, compressed=True)
    short = struct.pack("<II", 15, 1000) + whole[136:1136]
    with pytest.raises(InputError, match="does not end"):
        read_struct(whole[:128] + short, "data")


def test_a_file_that_changes_during_ingestion_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path,) = written(tmp_path, circle(AZIMUTH))
    lay_out = gotcha.lay_out

    def meddling(joined: Any) -> Any:
        written(tmp_path, circle(AZIMUTH + STEP))
        return lay_out(joined)

    monkeypatch.setattr(gotcha, "lay_out", meddling)
    with pytest.raises(InputError, match="changed while"):
        ingest(path, tmp_path / "ph.zarr")
    assert not (tmp_path / "ph.zarr").exists()


def test_the_start_of_the_collection_is_stated_by_the_user(tmp_path: Path) -> None:
    (path,) = written(tmp_path, circle(AZIMUTH))
    words = ["ingest", "gotcha", str(path), "--out", str(tmp_path / "ph.zarr"), "--collection-start"]
    run = CliRunner().invoke(commands.app, [*words, "2008-08-19T16:03:21.5+02:00", "--time-zero", "3.5"])
    assert run.exit_code == 0, run.output
    source = stores.open_phase_history(tmp_path / "ph.zarr").attrs["source"]
    assert (source["collection_start"], source["time_zero"]) == ("2008-08-19T14:03:21.500000Z", 3.5)


# ---------------------------------------------------------------- Planning for such a track


@pytest.fixture(scope="module")
def bumpy() -> Collection:
    """A circle with a fifth-order bump of 3 mm towards the scene: the same for every target."""
    n = 256
    azimuth = np.radians(4.0) * np.linspace(-0.5, 0.5, n)
    u = np.linspace(-1, 1, n)
    position = (
        circle(azimuth) * (1 + 0.003 / np.hypot(RADIUS, HEIGHT) * chebyshev.chebval(u, [0, 0, 0, 0, 0, 1]))[:, None]
    )
    collection = collection_at(position)
    return replace(
        collection, time=(np.arange(n) - n // 2) * 0.01, reference_range=np.linalg.norm(circle(azimuth), axis=1)
    )


GRID = Grid(-20, 20, 0.5, -20, 20, 0.5)


@pytest.mark.slow
def test_range_variation_common_to_all_targets_is_no_phase_error(
    bumpy: Collection, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = plan_collection(bumpy, blocks=1, grid=GRID)
    prediction = made.blocks[0].prediction
    assert prediction.residual_phase < 0.01 and prediction.migration < 0.03  # cells of 2 m
    assert np.abs(made.recovery.common.series).sum() == pytest.approx(0.003, rel=0.05)
    # Azimuth steps have no terms of such orders: they would leave it in full.
    monkeypatch.setattr(spectrum_recovery, "COMMON_LEAST", np.inf)
    without = plan_collection(bumpy, blocks=1, grid=GRID).blocks[0].prediction
    assert without.residual_phase > 0.5


def test_a_wide_band_keeps_both_ends_of_a_dwell(tmp_path: Path) -> None:
    """768 MHz at 9.6 GHz: the keystone shifts the ends of dwells by 4 %, and weights frequencies by as much."""
    position = circle(np.radians(4.0) * np.linspace(-0.5, 0.5, 256))
    wide = replace(collection_at(position), range_frequency=16e6 * (np.arange(48) - 24.0)).centred()
    x, y = np.meshgrid(np.arange(-3.0, 3.5, 1.5), np.arange(-3.0, 3.5, 1.5))
    sigma = np.exp(1j * np.arange(x.size))
    signal = simulate_pulses(wide, x.ravel(), y.ravel(), sigma)
    stores.create_phase_history(
        tmp_path / "ph.zarr", wide,
        fill=lambda store: stores.write_region(store, "signal", (slice(0, 256), slice(0, 48)), signal),
    )  # fmt: skip
    axis = (-4.0, 4.0, 0.1)
    api.focus(tmp_path / "ph.zarr", tmp_path / "run", blocks=1, grid=(axis, axis), workers=0, threads=1)
    image = api.open(tmp_path / "run")
    exact = form_image(lambda p: signal[p], Geometry(collection=wide), image.x.values, image.y.values, threads=1)
    found = coherence(image.image.values, exact)
    assert abs(found.coherence) > 0.999
    assert found.gain == pytest.approx(1, abs=2e-3)


def test_lines_exclude_the_common_range(bumpy: Collection) -> None:
    """Phase, Doppler and Doppler rate of a line derive from one function: range less walk and the common part."""
    geometry = Geometry(collection=bumpy)
    common = recovery.CommonRange(series=np.array([0, 0, 0, 0, 0, 2e-3, 1e-3]), centre=0.3, half=2.0)
    where = {"yaw": np.array(np.pi), "origin": 10_000.0, "walk": 1.0}
    with_it = target_lines.Dwells(geometry=geometry, **where, common=common).lines(np.array(10_030.0))
    plain = target_lines.Dwells(geometry=geometry, **where).lines(np.array(10_030.0))
    cycles = -2 / bumpy.wavelength
    assert np.abs(plain.range - with_it.range - common.at(plain.time)).max() < 1e-9
    assert np.abs(with_it.phase - plain.phase + cycles * common.at(plain.time)).max() < 1e-6
    assert np.abs(with_it.doppler - plain.doppler + cycles * common.at(plain.time, 1)).max() < 1e-9
    assert np.abs(with_it.rate - plain.rate + cycles * common.at(plain.time, 2)).max() < 1e-9


def test_derivatives_and_series_of_the_common_range_agree() -> None:
    common = recovery.CommonRange(series=np.array([0, 0, 0, 0, 0, 2e-3, 1e-3]), centre=0.3, half=2.0)
    time = np.linspace(-1.5, 2.0, 7)
    for derivative in (1, 2):
        step = (common.at(time + 1e-4, derivative - 1) - common.at(time - 1e-4, derivative - 1)) / 2e-4
        assert np.abs(common.at(time, derivative) - step).max() < 1e-7
    powers = common.taylor(8)
    assert np.abs(np.polynomial.polynomial.polyval(time, powers) - common.at(time)).max() < 1e-12


# ---------------------------------------------------------------- Measured data

POINTS = ((-27.8, 38.8), (-15.5, 21.6))  # m: the two point-like targets


@pytest.fixture(scope="module")
def measured() -> list[Path]:
    folder = os.environ.get("BLOCKSAR_DATA")
    if not folder:
        pytest.skip("BLOCKSAR_DATA does not say where measured data are")
    gotcha_files = sorted((Path(folder) / "gotcha").glob("*.mat"))
    if len(gotcha_files) < 4:
        pytest.skip(f"{folder} has no gotcha/ with four files")
    return gotcha_files[:4]


@pytest.fixture(scope="module")
def store(measured: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gotcha") / "ph.zarr"
    api.ingest("gotcha", measured, path)
    return path


@pytest.fixture(scope="module")
def reference(store: Path) -> np.ndarray:
    """Exact back-projection of the whole scene."""
    history = stores.open_phase_history(store)
    axis = -50 + 0.125 * np.arange(800)
    geometry = Geometry(collection=history.collection.centred())
    return form_image(lambda pulses: history.read(pulses, slice(None)), geometry, axis, axis, threads=1)


def test_measured_figures(measured: list[Path], tmp_path: Path) -> None:
    made = ingest(measured[::-1], tmp_path / "ph.zarr")
    assert made.collection.n_pulse == 469 and made.collection.n_range_frequency == 424
    track = Geometry(collection=made.collection).track
    assert track.order <= 6 and track.max_misfit < 2e-3
    assert any("number serves as slow time" in line for line in made.messages)
    assert any("its rounding" in line for line in made.messages)


@pytest.mark.slow
def test_measured_sign_and_reference(store: Path, reference: np.ndarray, measured: list[Path]) -> None:
    """The two points are at their places, and brightest with the stored reference range."""
    history = stores.open_phase_history(store)
    collection = history.collection.centred()
    signal = history.read(slice(None), slice(None))
    rounded = np.concatenate([gotcha_files.read_file(places.place(path)).r0 for path in measured])
    axis = -50 + 0.125 * np.arange(800)
    for x, y in POINTS:
        near = np.hypot(axis[None, :] - x, axis[:, None] - y) < 3
        opposite = np.hypot(axis[None, :] + x, axis[:, None] + y) < 3
        assert np.abs(reference[near]).max() > 10 * np.abs(reference[opposite]).max()

    def power(reference_range: np.ndarray) -> float:
        geometry = Geometry(collection=replace(collection, reference_range=reference_range))
        offset = np.arange(-0.4, 0.4, 0.02)
        images = (form_image(lambda p: signal[p], geometry, x + offset, y + offset, threads=1) for x, y in POINTS)
        return float(sum(np.abs(image).max() ** 2 for image in images))

    assert power(collection.reference_range) > 1.01 * power(rounded)


def test_the_measured_image_agrees_with_back_projection(store: Path, reference: np.ndarray, tmp_path: Path) -> None:
    axis = (-50.0, 50.0, 0.125)
    api.focus(store, tmp_path / "run", processor="angular-division", grid=(axis, axis), workers=0, threads=1)
    image = api.open(tmp_path / "run").image.values
    assert np.isfinite(image).all()
    found = coherence(image, reference)
    assert abs(found.coherence) > 0.9995
    assert found.gain == pytest.approx(1, abs=1e-3) and abs(found.phase) < 1e-3
    # Cars and points are much brighter than the median of the ground.
    power = np.abs(image) ** 2
    assert np.quantile(power, 0.999) > 100 * np.median(power)
    targets = [Target(f"point {i}", x, y, 1.0) for i, (x, y) in enumerate(POINTS)]
    ours = api.quality(tmp_path / "run", targets=targets).result
    stores.write_region(tmp_path / "run" / "image.zarr", "image", (slice(0, 800), slice(0, 800)), reference)
    theirs = api.quality(tmp_path / "run", targets=targets).result
    for a, b in zip(ours["targets"], theirs["targets"], strict=True):
        for width in ("range_irw", "azimuth_irw"):
            assert a[width] == pytest.approx(b[width], rel=2e-3), (a, b)


def test_a_circle_needs_a_bias_chirp(store: Path, tmp_path: Path) -> None:
    """A circle has no Doppler rate: a chain without a bias chirp names this reason, not the look direction."""
    axis = (-50.0, 50.0, 0.125)
    with pytest.raises(InputError, match="acceleration cancels the Doppler rate"):
        api.focus(store, tmp_path / "run", processor="high-order-phase", grid=(axis, axis))
    assert not (tmp_path / "run").exists()
