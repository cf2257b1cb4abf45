"""Bad input: hundreds of damaged stores, runs, scene files, names and options through the public commands.

Each is handled, so that the image is the clean one, or differs by no more than what is missing or in error explains;
or it is taken at its word, where its words are sound though others; or it is refused: one sentence, nothing written.
A traceback, a hang, or a changed input is a defect. The table of outcomes is printed with `-s`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import pickle
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr
from distributed import Client
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import blocksar
from blocksar import cli, cluster, stores
from blocksar.parameters import InputError, ProcessingError
from blocksar.scene import Scene

SCENE = """
title = "tiny"
[radar]
carrier = 10e9
bandwidth = 40e6
range_sampling = 48e6
prf = 1000.0
[track]
position = [0.0, 0.0, 3000.0]
velocity = [0.0, 100.0, 0.0]
[time]
pulses = 200
[beam]
start_deg = -4.0
stop_deg = 4.0
dwell = 0.06
[scene]
swath = [4960.0, 5140.0]
[[targets]]
name = "P"
range = 5050.0
yaw_deg = 0.0
"""
LIT = 60  # pulses of a dwell
GRID = ((4040.0, 4120.0, 4.0), (-40.0, 40.0, 4.0))  # around the target, where every pixel has a full dwell
EXACT: dict[str, Any] = {"processor": "backprojection", "grid": GRID}  # a whole run in a tenth of a second
CHAIN: dict[str, Any] = {"blocks": 1, "grid": GRID}  # and in half a second
ROUNDING = 1e-5  # of images that are the same but for the order of additions
OUTLIER = 100  # times its neighbours: up to here a sample may be meant

MANY = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False
)  # fmt: skip


@contextlib.contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """A hang is an error of the case that hangs, and what pytest's own alarm has left goes on afterwards."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"it hangs: no answer within {seconds:g} s")

    handler = signal.signal(signal.SIGALRM, late)
    left, _ = signal.setitimer(signal.ITIMER_REAL, seconds)
    began = time.monotonic()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        if left:
            signal.setitimer(signal.ITIMER_REAL, max(left - (time.monotonic() - began), 0.01))


def listing(folder: Path) -> dict[str, tuple[int, int, int]]:
    """All that lies below, as it would have to stay: kind, size and time of each, links not followed."""
    found = {}
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            status = os.lstat(os.path.join(parent, name))
            folder_like = stat.S_ISDIR(status.st_mode)
            found[os.path.join(parent, name)] = (
                status.st_mode,
                0 if folder_like else status.st_size,
                0 if folder_like else status.st_mtime_ns,
            )
    return found


def one_sentence(error: BaseException | str) -> str:
    text = str(error)
    assert text and len(text) < 1000 and text.isprintable(), f"not one plain sentence: {text!r}"
    assert "Traceback" not in text
    return text


@dataclass
class Bench:
    """A clean store, what it gives, and the cluster that everybody shares; counts what became of every case."""

    client: Client
    room: Path
    store: Path
    clean: dict[str, Any] = field(default_factory=dict)
    tally: Counter[tuple[str, str]] = field(default_factory=Counter)
    number: Iterator[int] = field(default_factory=itertools.count)

    def fresh(self, suffix: str = "") -> Path:
        return self.room / f"{next(self.number)}{suffix}"

    def copy(self) -> Path:
        return Path(shutil.copytree(self.store, self.fresh(".zarr"), symlinks=True))

    def finished_run(self, **wanted: Any) -> Path:
        """A copy of a finished run."""
        return Path(shutil.copytree(self.run(**wanted), self.fresh()))

    def run(self, **wanted: Any) -> Path:
        """The clean store's own run; made once."""
        name = f"clean-{wanted.get('processor', 'chain')}"
        if name not in self.clean:
            blocksar.focus(self.store, self.room / name, client=self.client, **wanted)
            self.clean[name] = blocksar.open(self.room / name).image.values
        return self.room / name

    def image(self, **wanted: Any) -> Any:
        return self.clean[self.run(**wanted).name]

    def attempt(self, kind: str, source: Any, *, out: Path | None = None, error: float = ROUNDING, **wanted: Any) -> str:
        """Focus a source that may be bad.

        Parameters
        ----------
        error : float
            By how much the image may differ from the clean one; infinite where the source may be taken at its word.
        """
        wanted = wanted or EXACT
        out = out or self.fresh()
        before = listing(Path(source)) if isinstance(source, str | Path) else {}
        try:
            with deadline(60):
                blocksar.focus(source, out, client=self.client, **wanted)
        except InputError as refusal:
            one_sentence(refusal)
            assert not os.path.lexists(out), "refused, but something was written"
            outcome = "refused"
        else:
            difference = self.difference(out, **wanted)
            assert difference <= error, f"the image differs by {difference:g}, more than {error:g}"
            outcome = "the clean image" if difference <= ROUNDING else "within what is missing or in error"
            if error == np.inf and difference > ROUNDING:
                outcome = "taken at its word"
        if before:
            assert listing(Path(source)) == before, "the input was changed"
        self.tally[kind, outcome] += 1
        return outcome

    def difference(self, run: Path, **wanted: Any) -> float:
        image, clean = blocksar.open(run).image.values, self.image(**wanted)
        if image.shape != clean.shape:
            return np.inf
        covered = np.isfinite(image.real)
        lost = np.isfinite(clean.real) & ~covered
        if not covered.any():
            return np.inf
        return np.inf if lost.any() else float(np.abs((image - clean)[covered]).max())

    def refused(self, kind: str, command: Callable[..., Any], *args: Any, **kwargs: Any) -> str:
        """A command that may only be refused, by an InputError."""
        with deadline(60), pytest.raises(InputError) as caught:
            command(*args, **kwargs)
        self.tally[kind, "refused"] += 1
        return one_sentence(caught.value)

    def all(self, cases: dict[str, Callable[[], Any]]) -> None:
        """Every case, and then the defects of all of them at once."""
        defects = []
        for name, case in cases.items():
            try:
                case()
            except (Exception, pytest.fail.Exception) as error:
                defects.append(f"{name}: {type(error).__name__}: {str(error)[:300]}")
        assert not defects, f"{len(defects)} of {len(cases)}:\n" + "\n".join(defects)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    room = tmp_path_factory.mktemp("bad")
    (room / "scene.toml").write_text(SCENE)
    store = blocksar.simulate(room / "scene.toml", room / "clean.zarr")
    with cluster.open_client(workers=1, threads=1, memory_limit=2 * 2**30) as client:
        yield Bench(client, room, store)


def seeded(name: str) -> np.random.Generator:
    return np.random.default_rng(list(name.encode()))


# ---------------------------------------------------------------- the files of a store

FILES = [
    "zarr.json",
    *(f"{name}/zarr.json" for name in stores.PHASE_HISTORY),
    *(f"{name}/c/0" for name in stores.PHASE_HISTORY if name not in ("signal", "antenna_position")),
    "antenna_position/c/0/0",
    "signal/c/0/0",
]


def truncated(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: rng.integers(len(data))])


def overwritten(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    start = rng.integers(len(data))
    data[start : start + 8] = rng.bytes(min(8, len(data) - start))
    file.write_bytes(data)


def flipped(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    file.write_bytes(data)


def grown(file: Path, rng: np.random.Generator) -> None:
    file.write_bytes(file.read_bytes() + rng.bytes(int(rng.integers(1, 100))))


def what_it_says(store: Path) -> Any:
    """The collection, if it can be read."""
    try:
        return stores.open_phase_history(store).collection.as_dict()
    except InputError:
        return None


def tolerance(bench: Bench, store: Path) -> float:
    """By how much the image of a store may differ: by nothing but rounding, where it says the same; where a few
    pulses are said otherwise, by their share of a dwell, once for what is missing and once for what is wrong;
    where a number that holds for all pulses is another, there is no knowing.
    """
    said, clean = what_it_says(store), what_it_says(bench.store)
    if said is None:
        return ROUNDING  # it will be refused
    if any(said[name] != clean[name] for name in ("carrier", "beam_width", "ground_height")):
        return np.inf
    if any(said[name].shape != clean[name].shape for name in clean if isinstance(clean[name], np.ndarray)):
        return np.inf
    pulses = np.zeros(clean["time"].size, bool)
    for name in ("reference_range", "antenna_position", "beam_azimuth"):
        pulses |= (said[name] != clean[name]).reshape(pulses.size, -1).any(axis=1)
    # An axis is uniform to a thousandth of a step, whatever is done to one of its values.
    axes = [name for name in ("time", "range_frequency") if (said[name] != clean[name]).any()]
    lit = 2 if pulses.any() else 0  # another track may light one pulse more or less at either end of a dwell
    return ROUNDING + 2 * (pulses.sum() + lit) / LIT + (0.02 if axes else 0.0)


@pytest.mark.parametrize("damage", [truncated, overwritten, flipped, grown])
def test_damaged_bytes(damage: Any, bench: Bench) -> None:
    def case(name: str, attempt: int) -> None:
        store = bench.copy()
        damage(store / name, seeded(f"{damage.__name__} {name} {attempt}"))
        if name == "signal/c/0/0":
            return samples(store)
        bench.attempt(f"bytes {damage.__name__}", store, error=tolerance(bench, store))
        shutil.rmtree(store)

    def samples(store: Path) -> None:
        bench.attempt(f"bytes {damage.__name__}", store, error=1.0)

    times = {truncated: 2, grown: 1}.get(damage, 4)
    bench.all({f"{name} {i}": lambda name=name, i=i: case(name, i) for name in FILES for i in range(times)})


REPLACED: dict[str, Callable[[Path], Any]] = {
    "deleted": lambda file: file.unlink(),
    "empty": lambda file: file.write_bytes(b""),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
    "a link to the file": lambda file: file.symlink_to(file.rename(file.with_name("elsewhere"))),
    "a link to nothing": lambda file: (file.unlink(), file.symlink_to("nothing")),
    "a link to itself": lambda file: (file.unlink(), file.symlink_to(file.name)),
    "a link to zeros without end": lambda file: (file.unlink(), file.symlink_to("/dev/zero")),
    "a link to nothing at all": lambda file: (file.unlink(), file.symlink_to("/dev/null")),
    "a pipe": lambda file: (file.unlink(), os.mkfifo(file)),
    "a socket": lambda file: (file.unlink(), bound(file)),
}


def bound(file: Path) -> None:
    with contextlib.chdir(file.parent), socket.socket(socket.AF_UNIX) as s:
        s.bind(file.name)


@pytest.mark.parametrize("how", REPLACED)
def test_files_that_are_something_else(how: str, bench: Bench) -> None:
    def case(name: str) -> None:
        store = bench.copy()
        REPLACED[how](store / name)
        outcome = bench.attempt("files replaced", store)
        optional = name.startswith("beam_azimuth/zarr")
        works = how == "a link to the file"
        assert outcome == ("the clean image" if works else "refused"), f"{outcome} {optional}"
        shutil.rmtree(store)

    bench.all({name: lambda name=name: case(name) for name in FILES})


# ---------------------------------------------------------------- samples


def with_samples(bench: Bench, change: Callable[[Any], Any]) -> Path:
    """The store with its samples changed in place."""
    store = bench.copy()
    array: Any = zarr.open_array(str(store / "signal"), mode="r+")
    samples = array[...]
    change(samples)
    array[...] = samples
    return store


def lit_samples(bench: Bench) -> Any:
    samples: Any = zarr.open_array(str(bench.store / "signal"), mode="r")[...]
    return np.flatnonzero(samples)


def test_one_flipped_bit_of_one_sample(bench: Bench) -> None:
    """Impossible samples count as missing; what can still be a sample moves the image by its share of it."""
    lit = lit_samples(bench)
    columns = lit.size / LIT

    def case(bit: int, **wanted: Any) -> None:
        place = int(seeded(f"sample {bit}").choice(lit))

        def flip(samples: Any) -> None:
            samples.reshape(-1).view(np.uint64)[place] ^= np.uint64(1 << bit)

        bench.attempt("one flipped bit", with_samples(bench, flip), error=1.5 * OUTLIER / (LIT * columns), **wanted)

    bench.all(
        {f"bit {bit}": lambda bit=bit: case(bit, **EXACT) for bit in range(64)}
        | {f"bit {bit}, chain": lambda bit=bit: case(bit, **CHAIN) for bit in (3, 30, 55, 62, 63)}
    )


def rows(value: complex, pulses: Any) -> Callable[[Any], None]:
    def change(samples: Any) -> None:
        samples[pulses] = value

    return change


def columns(value: complex, some: Any) -> Callable[[Any], None]:
    def change(samples: Any) -> None:
        samples[:, some] = value

    return change


MISSING: dict[str, tuple[Callable[[Any], None], float]] = {
    "three pulses of NaN": (rows(np.nan, [95, 100, 101]), 3 / LIT),
    "a pulse of infinity": (rows(complex(np.inf, -np.inf), [99]), 1 / LIT),
    "a pulse with a NaN imaginary part": (rows(complex(1, np.nan), [99]), 1 / LIT),
    "every other pulse of NaN": (rows(np.nan, slice(0, None, 2)), 1.0),
    "a column of NaN": (columns(np.nan, [7]), 1 / 50),
    "half of the columns NaN": (columns(np.nan, slice(0, 26)), 1.0),
}


@pytest.mark.parametrize("processor", [EXACT, CHAIN], ids=["exact", "chain"])
def test_missing_samples_cost_their_share(processor: dict[str, Any], bench: Bench) -> None:
    bench.all(
        {
            name: lambda change=change, share=share: bench.attempt(
                "missing samples", with_samples(bench, change), error=2 * share + ROUNDING, **processor
            )
            for name, (change, share) in MISSING.items()
        }
    )


@pytest.mark.parametrize("processor", [EXACT, CHAIN], ids=["exact", "chain"])
def test_no_sample_at_all_is_refused(processor: dict[str, Any], bench: Bench) -> None:
    for value in (np.nan, np.inf):
        store = with_samples(bench, rows(value, slice(None)))
        assert bench.attempt("missing samples", store, **processor) == "refused"


# ---------------------------------------------------------------- arrays that are not what the contract says


def altered(bench: Bench, change: Callable[[xr.Dataset], xr.Dataset], **options: Any) -> Path:
    """The store as another program would write it after some change."""
    with xr.open_zarr(bench.store, consolidated=False) as opened:
        dataset = opened.load()
    path = bench.fresh(".zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # data types that zarr 3 does not specify
        changed = change(dataset.drop_encoding()).drop_encoding()
        changed.to_zarr(path, **{"zarr_format": 3, "consolidated": False, **options})
    return path


def with_values(name: str, change: Callable[[Any], Any]) -> Callable[[xr.Dataset], xr.Dataset]:
    def altered(dataset: xr.Dataset) -> xr.Dataset:
        variable = dataset[name].variable
        return dataset.assign({name: (variable.dims, change(variable.values.copy()))})

    return altered


def put(where: Any, value: float) -> Callable[[Any], Any]:
    def change(values: Any) -> Any:
        values[where] = value
        return values

    return change


BAD_VALUES: dict[str, Callable[[Any], Any]] = {
    "one NaN": put(17, np.nan),
    "the last is NaN": put(-1, np.nan),
    "infinity": put(17, np.inf),
    "minus infinity": put(0, -np.inf),
    "one huge": put(17, 1e300),
    "all huge": lambda values: values + 1e300,
    "all tiny": lambda values: values * 1e-300,
    "zeros": np.zeros_like,
    "backwards": lambda values: values[::-1],
    "shuffled": lambda values: seeded("shuffled").permutation(values),
    "one repeated": lambda values: np.concatenate([values[:10], values[9:-1]]),
    "jittered": lambda values: values + 0.1 * np.ptp(values) / len(values) * seeded("j").standard_normal(values.shape),
    "a step in the middle": lambda values: values + 5.0 * (np.arange(values.size) // 2 > values.size // 4).reshape(values.shape),
    "in kilo": lambda values: values * 1e-3,
}
AXES = ("time", "range_frequency")


@pytest.mark.parametrize("name", [*AXES, *stores.TRACK_AND_BEAM])
def test_values_that_cannot_be(name: str, bench: Bench) -> None:
    def case(what: str) -> None:
        store = altered(bench, with_values(name, BAD_VALUES[what]))
        outcome = bench.attempt("bad values", store, error=np.inf)
        scaled = what in ("in kilo", "all tiny")  # an axis in other units is an axis
        if (name in AXES and not scaled) or what in ("one NaN", "the last is NaN", "infinity", "one huge", "all huge"):
            assert outcome == "refused"

    bench.all({what: lambda what=what: case(what) for what in BAD_VALUES})


def retyped(name: str, dtype: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(values: Any) -> Any:
        return (values.real if np.dtype(dtype).kind != "c" else values).astype(dtype)

    return with_values(name, change)


ALTERED: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "as it is": (lambda d: d, "the clean image"),
    "wider": (retyped("signal", "c16"), "the clean image"),
    "big-endian": (retyped("signal", ">c8"), "the clean image"),
    "time big-endian": (retyped("time", ">f8"), "the clean image"),
    "real samples": (retyped("signal", "f4"), "refused"),
    "whole samples": (retyped("signal", "i2"), "refused"),
    "time of strings": (with_values("time", lambda values: list(map(str, values))), "refused"),
    "time of booleans": (retyped("time", "?"), "refused"),
    "complex time": (retyped("time", "c8"), "refused"),
    "time as dates": (retyped("time", "M8[ns]"), "refused"),
    "half-precision time": (retyped("time", "f2"), "refused"),
    "transposed samples": (lambda d: d.transpose(), "refused"),
    "dimensions renamed": (lambda d: d.rename(pulse="azimuth"), "refused"),
    "dimensions exchanged": (lambda d: d.rename(pulse="axis", axis="pulse"), "refused"),
    "another dimension": (lambda d: d.expand_dims(channel=2), "refused"),
    "no pulses": (lambda d: d.isel(pulse=slice(0)), "refused"),
    "no frequencies": (lambda d: d.isel(range_frequency=slice(0)), "refused"),
    "one pulse": (lambda d: d.isel(pulse=slice(1)), "refused"),
    "one frequency": (lambda d: d.isel(range_frequency=slice(1)), "refused"),
    "two axes": (lambda d: d.isel(axis=slice(2)), "refused"),
    "no axes": (lambda d: d.isel(axis=slice(0)), "refused"),
    "signal is echo": (lambda d: d.rename(signal="echo"), "refused"),
    "signal and echo": (lambda d: d.assign(echo=d.signal), "refused"),
    "no signal": (lambda d: d.drop_vars("signal"), "refused"),
    "no track": (lambda d: d.drop_vars("antenna_position"), "refused"),
    "no time": (lambda d: d.drop_vars("time"), "refused"),
    "no beam, but its width": (lambda d: d.drop_vars("beam_azimuth"), "refused"),
    "no attributes": (lambda d: d.drop_attrs(deep=False), "refused"),
    "more variables": (lambda d: d.assign(more=("pulse", d.time.values)), "the clean image"),
    "every other pulse": (lambda d: d.isel(pulse=slice(0, None, 2)), "taken at its word"),
}


def test_altered_arrays(bench: Bench) -> None:
    def case(what: str) -> None:
        change, wanted = ALTERED[what]
        error = np.inf if wanted == "taken at its word" else ROUNDING
        assert bench.attempt("altered arrays", altered(bench, change), error=error) == wanted

    bench.all({what: lambda what=what: case(what) for what in ALTERED})


# ---------------------------------------------------------------- metadata

NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([0, -1, 2**31, 2**63, 10**400, 1e308, -0.0]))
JSON = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
ATTRIBUTES = ["carrier_frequency", "beam_width", "ground_height", "title", "history", "targets", "scene", "georeference"]
KEYS = [
    *("shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs", "attributes"),
    *("dimension_names", "zarr_format", "node_type", "storage_transformers", "consolidated_metadata", "unknown"),
]


def with_metadata(bench: Bench, name: str, change: Callable[[dict[str, Any]], Any]) -> Path:
    store = bench.copy()
    file = store / name / "zarr.json"
    metadata = json.loads(file.read_bytes())
    change(metadata)
    file.write_text(json.dumps(metadata))
    return store


@settings(MANY, max_examples=60)
@given(name=st.sampled_from(ATTRIBUTES), value=JSON)
def test_attributes_of_any_kind(bench: Bench, name: str, value: Any) -> None:
    store = with_metadata(bench, "", lambda m: m["attributes"].update({name: value}))
    bench.attempt("attributes", store, error=np.inf)
    shutil.rmtree(store)


@settings(MANY, max_examples=100)
@given(variable=st.sampled_from(["", *stores.PHASE_HISTORY]), key=st.sampled_from(KEYS), value=JSON)
def test_metadata_of_any_kind(bench: Bench, variable: str, key: str, value: Any) -> None:
    store = with_metadata(bench, variable, lambda m: m.update({key: value}))
    error = np.inf if key in ("fill_value", "attributes", "chunk_grid", "data_type") else ROUNDING
    bench.attempt("metadata", store, error=error)
    shutil.rmtree(store)


LIES: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "a chunk of 2^40": ("signal", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[1 << 40, 1 << 40])),
    "chunks of 0": ("signal", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[0, 0])),
    "chunks of 1": ("time", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[1])),
    "2^60 pulses": ("signal", lambda m: m.update(shape=[1 << 60, 53])),
    "2^25 pulses": ("time", lambda m: m.update(shape=[1 << 25])),
    "pulses by the half": ("time", lambda m: m.update(shape=[200.5])),
    "fewer pulses": ("signal", lambda m: m.update(shape=[100, 53])),
    "three dimensions": ("signal", lambda m: m.update(shape=[200, 53, 1])),
    "another separator": (
        "signal",
        lambda m: m.update(chunk_key_encoding={"name": "default", "configuration": {"separator": "."}}),
    ),
    "the other byte order": ("time", lambda m: m["codecs"][0]["configuration"].update(endian="big")),
    "compressed, it says": ("signal", lambda m: m["codecs"].append({"name": "zstd", "configuration": {"level": 1}})),
    "milliseconds": ("time", lambda m: m["attributes"].update(units="ms")),
    "packed": ("time", lambda m: m["attributes"].update(scale_factor=2.0)),
    "deep": ("", lambda m: m["attributes"].update(title=nested(400))),
}


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def test_metadata_that_lie(bench: Bench) -> None:
    def case(what: str) -> None:
        outcome = bench.attempt("lying metadata", with_metadata(bench, *LIES[what]))
        assert outcome == ("the clean image" if what == "deep" else "refused")

    bench.all({what: lambda what=what: case(what) for what in LIES})


TEXTS = {
    "twice the same key": ('"zarr_format"', '"zarr_format": 2, "zarr_format"'),
    "twice the same attribute": ('"carrier_frequency"', '"carrier_frequency": 1e6, "carrier_frequency"'),
    "NaN": ('"ground_height": 0.0', '"ground_height": NaN'),
    "infinity": ('"ground_height": 0.0', '"ground_height": -Infinity'),
    "beyond floats": ('"ground_height": 0.0', '"ground_height": 1e999'),
    "ten thousand digits": ('"ground_height": 0.0', f'"ground_height": {"9" * 10_000}'),
    "nested without end": ('"ground_height": 0.0', f'"ground_height": {"[" * 100_000}'),
    "a lone surrogate": ('"title": "tiny"', '"title": "\\udcff"'),
    "control characters": ('"title": "tiny"', '"title": "\\u0000\\u001b[31m\\n"'),
    "an unfinished string": ('"title": "tiny"', '"title": "tiny'),
    "a comment": ('"title": "tiny"', '/* hello */ "title": "tiny"'),
}


def test_metadata_as_text(bench: Bench) -> None:
    def case(what: str) -> None:
        store = bench.copy()
        text = (store / "zarr.json").read_text()
        assert TEXTS[what][0] in text
        (store / "zarr.json").write_text(text.replace(*TEXTS[what]))
        bench.attempt("metadata as text", store, error=tolerance(bench, store))

    bench.all({what: lambda what=what: case(what) for what in TEXTS})


def test_metadata_in_other_encodings(bench: Bench) -> None:
    def case(change: Callable[[bytes], bytes]) -> None:
        store = bench.copy()
        (store / "zarr.json").write_bytes(change((store / "zarr.json").read_bytes()))
        bench.attempt("metadata as text", store)

    bench.all(
        {
            "UTF-16": lambda: case(lambda data: data.decode().encode("utf-16")),
            "a byte-order mark": lambda: case(lambda data: b"\xef\xbb\xbf" + data),
            "latin-1": lambda: case(lambda data: data.replace(b"tiny", b"t\xefny")),
            "zeros": lambda: case(lambda data: bytes(len(data))),
            "65 MiB of spaces": lambda: case(lambda data: data + b" " * (65 << 20)),
        }
    )


# ---------------------------------------------------------------- stores of other kinds


def foreign(bench: Bench) -> dict[str, Callable[[Path], Any]]:
    """Makers of things that are stores, or look like it."""
    example = xr.Dataset({"air": (("lat", "lon"), np.ones((4, 5)))}, {"lat": np.arange(4.0), "lon": np.arange(5.0)})
    return {
        "xarray's example": lambda path: example.to_zarr(path, zarr_format=3, consolidated=False),
        "xarray's example, version 2": lambda path: example.to_zarr(path, zarr_format=2, consolidated=True),
        "an empty group": lambda path: zarr.create_group(str(path)),
        "an empty group, version 2": lambda path: zarr.create_group(str(path), zarr_format=2),
        "a single array": lambda path: zarr.create_array(str(path), shape=(8, 8), dtype="c8"),
        "a single array, version 2": lambda path: zarr.create_array(str(path), shape=(8, 8), dtype="c8", zarr_format=2),
        "a variable of a store": lambda path: shutil.copytree(bench.store / "signal", path),
        "an image": lambda path: shutil.copytree(bench.run(**EXACT) / "image.zarr", path),
        "a collection without samples": lambda path: shutil.copytree(bench.run(**EXACT) / "collection.zarr", path),
        "a run": lambda path: shutil.copytree(bench.run(**EXACT), path),
        "groups for variables": lambda path: [zarr.create_group(str(path / n)) for n in ("", *stores.PHASE_HISTORY)],
        "an empty folder": lambda path: path.mkdir(),
        "a file": lambda path: path.write_text("not a store"),
        "an empty file": lambda path: path.write_bytes(b""),
        "a pipe": lambda path: os.mkfifo(path),
        "nothing": lambda path: None,
        "a link to nothing": lambda path: path.symlink_to("nowhere"),
        "a link to itself": lambda path: path.symlink_to(path.name),
        "below a file": lambda path: path.write_text("x"),
    }


def test_foreign_stores(bench: Bench) -> None:
    def case(name: str, make: Callable[[Path], Any]) -> None:
        path = bench.fresh(".zarr")
        make(path)
        assert bench.attempt("foreign stores", path / "x" if name == "below a file" else path) == "refused"

    bench.all({name: lambda name=name, make=make: case(name, make) for name, make in foreign(bench).items()})


@pytest.mark.parametrize("version", [2, 3])
def test_stores_of_other_programs_work(version: int, bench: Bench) -> None:
    compressors = [numcodecs.Zlib(1), numcodecs.Blosc(), numcodecs.Zstd(1), numcodecs.BZ2(1), numcodecs.LZMA(preset=0)]
    modern = [zarr.codecs.GzipCodec(level=1), zarr.codecs.BloscCodec(), zarr.codecs.ZstdCodec(level=1)]
    for compressor in compressors if version == 2 else modern:
        encoding = {name: {"compressors": [compressor]} for name in stores.PHASE_HISTORY}
        if version == 2:
            encoding["time"]["filters"] = [numcodecs.Delta("<f8"), numcodecs.Shuffle(8)]
        store = altered(bench, lambda d: d, zarr_format=version, encoding=encoding)
        error = tolerance(bench, store)
        bench.attempt("other programs", store, error=error)
    if version == 3:
        shards = {"signal": {"chunks": (50, 53), "shards": (100, 53)}}
        assert bench.attempt("other programs", altered(bench, lambda d: d, encoding=shards)) == "the clean image"


# ---------------------------------------------------------------- nothing in a store is run


class Bomb:
    """What pickle runs when it reads it."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.file),)


class Trojan(numcodecs.abc.Codec):
    """As a codec that some installed package offers, and that trusts what it decodes."""

    codec_id = "trojan"

    def encode(self, buf: Any) -> Any:
        return buf

    def decode(self, buf: Any, out: Any = None) -> Any:
        return pickle.loads(buf)


ARMED = {
    "a filter that unpickles": {"filters": [{"id": "pickle"}]},
    "a compressor that unpickles": {"compressor": {"id": "pickle"}},
    "objects": {"dtype": "|O", "fill_value": None, "filters": [{"id": "pickle"}]},
    "strings, pickled": {"dtype": "|O", "fill_value": None, "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}]},
    "a codec of another package": {"filters": [{"id": "trojan"}]},
    "a compressor of another package": {"compressor": {"id": "trojan"}},
    "behind one that is allowed": {"filters": [{"id": "shuffle", "elementsize": 8}, {"id": "trojan"}]},
}


@pytest.fixture
def armed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every safety catch of the libraries off: ours is to hold alone."""
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    monkeypatch.setitem(numcodecs.registry.codec_registry, "trojan", Trojan)


@pytest.mark.parametrize("variable", ["time", "signal", "antenna_position"])
@pytest.mark.parametrize("how", ARMED)
def test_nothing_is_unpickled(how: str, variable: str, armed: None, bench: Bench) -> None:
    store = altered(bench, lambda d: d, zarr_format=2)
    fuse = bench.fresh()
    arm(store / variable, fuse, ARMED[how])
    with contextlib.suppress(InputError):
        blocksar.plan(store)
    assert bench.attempt("armed", store) == "refused"
    bench.refused("armed", blocksar.plan, store)
    assert not fuse.exists()


def arm(variable: Path, fuse: Path, change: dict[str, Any]) -> None:
    metadata = json.loads((variable / ".zarray").read_bytes())
    (variable / ".zarray").write_text(json.dumps({**metadata, "filters": None, "compressor": None, **change}))
    for chunk in variable.iterdir():
        if not chunk.name.startswith(".z"):
            chunk.write_bytes(pickle.dumps(Bomb(fuse)))


@pytest.mark.parametrize("how", ARMED)
def test_nothing_is_unpickled_when_an_image_is_opened(how: str, armed: None, bench: Bench) -> None:
    run, fuse = bench.fresh(), bench.fresh()
    blocksar.open(bench.run(**EXACT)).drop_encoding().to_zarr(run / "image.zarr", zarr_format=2, consolidated=False)
    arm(run / "image.zarr" / "x", fuse, ARMED[how])
    bench.refused("armed", blocksar.open, run)
    assert not fuse.exists()


def test_the_bomb_goes_off_where_nobody_is_careful(armed: None, bench: Bench) -> None:
    """Else the tests above say nothing."""
    store, fuse = altered(bench, lambda d: d, zarr_format=2), bench.fresh()
    arm(store / "time", fuse, ARMED["a codec of another package"])
    with contextlib.suppress(Exception):
        print(zarr.open_array(str(store / "time"), mode="r")[...])
    assert fuse.exists()


def test_codecs_within_shards_are_known_too(monkeypatch: pytest.MonkeyPatch, bench: Bench) -> None:
    encoding = {"signal": {"chunks": (50, 53), "shards": (100, 53)}}
    store = altered(bench, lambda d: d, encoding=encoding)
    monkeypatch.setattr(stores, "CODECS", stores.CODECS - {"crc32c"})  # the index's
    assert "crc32c" in bench.refused("armed", blocksar.plan, store)
    monkeypatch.setattr(stores, "CODECS", stores.CODECS - {"zstd"})  # the samples'
    assert "zstd" in bench.refused("armed", blocksar.plan, store)
