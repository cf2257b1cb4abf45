"""Object stores: stores below a prefix behave as stores in a folder, tested on a real server of the S3 protocol."""

from __future__ import annotations

import os
import pickle
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import s3
import xarray as xr
import zarr
from obstore.store import S3Store
from samples import noise
from scenes import scene
from zarr.storage import ObjectStore

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.cluster import open_client
from blocksar.places import objects, place
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.runs.finished import finished_record
from blocksar.stores import regions

ALL = (slice(None), slice(None))


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with s3.server():
        yield s3.make_bucket()


@pytest.fixture
def there(bucket: str) -> Place:
    """An unused prefix."""
    return place(f"s3://{bucket}/{secrets.token_hex(4)}")


@pytest.fixture
def unreached(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Set an endpoint on which no server listens; yields its URL."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with endpoint(port, monkeypatch) as url:
        yield url


@contextmanager
def endpoint(port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Use another endpoint within the block, with one retry."""
    with monkeypatch.context() as patch:
        patch.setattr(objects, "RETRIES", 1)
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        objects.open_bucket.cache_clear()
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            objects.open_bucket.cache_clear()


def contents(where: Place) -> dict[str, bytes]:
    """Return all files, or all objects, with their bytes."""
    return {name: (where / name).read_bytes() for name, _, _ in where.files()}


def history(where: Any, collection: Collection, **options: Any) -> stores.PhaseHistory:
    """Write a phase history with samples in chunks of 128 by 64."""
    stores.create(
        where,
        stores.PHASE_HISTORY,
        sizes={},
        coords={"time": collection.time, "range_frequency": collection.range_frequency},
        variables={name: getattr(collection, name) for name in stores.TRACK_AND_BEAM},
        attrs={"carrier_frequency": collection.carrier, "beam_width": collection.beam_width, "title": collection.title},
        chunks={"pulse": 128, "range_frequency": 64},
        **options,
    )
    stores.write_region(where, "signal", ALL, noise(collection.n_pulse, collection.n_range_frequency))
    return stores.open_phase_history(where)


def one_sentence(error: pytest.ExceptionInfo[Exception]) -> str:
    text = str(error.value)
    assert "\n" not in text and "Debug" not in text and len(text) < 500, text
    return text


# Agreement with folders


@pytest.mark.parametrize("name", ["PHASE_HISTORY", "RAW_ECHO", "COLLECTION", "SPECTRUM", "PATCH", "IMAGE"])
def test_every_store_has_the_same_bytes_as_in_a_folder(name: str, there: Place, tmp_path: Path) -> None:
    schema = getattr(stores, name)
    sizes = dict.fromkeys({dim for variable in schema.values() for dim in variable.dims}, 5)
    coords = {"x": np.arange(5.0), "y": np.arange(5.0)} if "x" in schema else {}
    for where in (there, LocalPlace(tmp_path / "s.zarr")):
        stores.create(where, schema, sizes=sizes, coords=coords, attrs={"a": [1, np.nan]}, chunks={"y": 2, "pulse": 3})
        for variable, stated in schema.items():
            if variable not in coords:
                values = noise(*(5,) * len(stated.dims))
                whole = (slice(None),) * values.ndim
                real = stated.dtype != "complex64"
                stores.write_region(where, variable, whole, values.real.astype(stated.dtype) if real else values)
    assert contents(there) == contents(LocalPlace(tmp_path / "s.zarr"))


@pytest.mark.slow
def test_regions_are_read_as_from_a_folder(small_collection: Collection, there: Place, tmp_path: Path) -> None:
    local = LocalPlace(tmp_path / "ph.zarr")
    for where in (there, local):
        history(where, small_collection)
        (where / "signal" / "c" / "1" / "0").remove()  # a chunk that was never written
    rng = np.random.default_rng(3)
    regions = [tuple(slice(*rng.integers(-2, n + 2, 2)) for n in (256, 128)) for _ in range(12)]
    for region in (*regions, ALL, np.s_[1::2, ::3], np.s_[5:5, :], np.s_[127:129, 63:65]):
        expected = stores.read_region(local, "signal", region)
        for out in (None, np.zeros_like(expected), np.zeros(expected.shape[::-1], np.complex64).T):
            found = stores.read_region(str(there), "signal", region, out=out)
            assert out is None or found is out
            assert found.dtype == expected.dtype and np.array_equal(found, expected, equal_nan=True)
    with pytest.raises(ValueError, match="out is"):
        stores.read_region(there, "signal", np.s_[:3, :3], out=np.zeros((3, 4), np.complex64))


def test_a_phase_history_can_be_pickled_for_other_processes(small_collection: Collection, there: Place) -> None:
    pickled = pickle.dumps(history(there, small_collection))
    assert len(pickled) < 50_000  # axes and track, but no samples
    objects.open_bucket.cache_clear()  # as in a process that has not opened it yet
    again = pickle.loads(pickled)
    assert np.array_equal(again.read(slice(3, 200), slice(0, 70)), noise(256, 128)[3:200, :70])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a b", "%41", "a#b?c=d&e", "é", "a::b", "a+b"])
def test_unusual_names_are_used_as_given(name: str, there: Place, tmp_path: Path, small_collection: Collection) -> None:
    for where in (there / name / "ph.zarr", LocalPlace(tmp_path) / name / "ph.zarr"):
        again = str(where)
        stores.write_collection(again, small_collection)
        assert where.names()[-1] == "zarr.json"
        assert stores.read_collection(again)[0].title == small_collection.title
        assert stores.open_dataset(again).sizes["pulse"] == 256


def test_chunks_of_object_stores_are_not_shared(there: Place, tmp_path: Path) -> None:
    axes = {"x": np.arange(4.0), "y": np.arange(4.0)}
    for where in (there / "a", there / "b", tmp_path / "c"):
        stores.create(where, stores.PATCH, sizes={}, coords=axes, attrs={}, chunks={})
        stores.write_region(where, "image", ALL, noise(4, 4))
    whole = (slice(0, 4), slice(0, 4))
    for source, target in ((there / "a", there / "b"), (there / "a", tmp_path / "c"), (tmp_path / "c", there / "b")):
        assert not stores.share_region(target, "image", whole, source=source, source_region=whole)


# Exchange with other programs


OTHERWISE: dict[str, dict[str, Any]] = {
    "compressed": {"encoding": {"signal": {"compressors": zarr.codecs.ZstdCodec(), "chunks": (100, 37)}}},
    "version 2": {"zarr_format": 2},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERWISE)
def test_stores_written_by_xarray_are_read(name: str, there: ObjectPlace, small_collection: Collection) -> None:
    c = small_collection
    data = {
        "signal": (("pulse", "range_frequency"), noise(256, 128)),
        "reference_range": ("pulse", c.reference_range),
        "antenna_position": (("pulse", "axis"), c.antenna_position),
        "beam_azimuth": ("pulse", c.beam_azimuth),
    }
    coords = {"time": ("pulse", c.time), "range_frequency": c.range_frequency}
    ds = xr.Dataset(data, coords, {"carrier_frequency": c.carrier, "beam_width": c.beam_width})
    target = ObjectStore(S3Store(there.bucket, prefix=there.key, client_options={"allow_http": True}))
    ds.to_zarr(target, **{"zarr_format": 3, "consolidated": False} | OTHERWISE[name])
    found = stores.open_phase_history(there)
    assert np.array_equal(found.read(slice(90, 256), slice(30, 128)), noise(256, 128)[90:, 30:])
    before = found.fingerprint()
    stores.write_region(there, "signal", ALL, noise(256, 128, seed=1))
    assert np.array_equal(found.read(*ALL), noise(256, 128, seed=1))
    assert stores.open_phase_history(there).fingerprint() != before


def test_xarray_opens_an_image(there: ObjectPlace) -> None:
    axes = {"x": np.arange(20.0), "y": np.arange(10.0)}
    stores.create(there, stores.IMAGE, sizes={}, coords=axes, attrs={"title": "image"}, chunks={"x": 8, "y": 8})
    stores.write_region(there, "image", ALL, noise(10, 20))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        store = S3Store(there.bucket, prefix=there.key, client_options={"allow_http": True})
        theirs = xr.open_zarr(ObjectStore(store, read_only=True), chunks=None)
        ours = stores.open_dataset(there)
    for ds in (theirs, ours):
        assert ds.attrs["title"] == "image" and set(ds.coords) == {"x", "y"}
        assert np.array_equal(ds["image"][3:, 5:].values, noise(10, 20)[3:, 5:])
        assert (ds["block"].values == -1).all()
    assert ours.encoding["source"] == str(there)


# Atomic creation


def make(where: Place, value: float, **options: Any) -> None:
    axes = {"x": np.arange(16.0), "y": np.arange(16.0)}
    stores.create(where, stores.PATCH, sizes={}, coords=axes, attrs={}, chunks={"x": 8, "y": 8}, **options)
    if "fill" not in options:
        stores.write_region(where, "image", ALL, np.full((16, 16), value, np.complex64))


KILLED = """
import os, signal, sys, time
import numpy as np
from blocksar import stores

def fill(part):
    stores.write_region(part, "image", np.s_[:8, :8], np.zeros((8, 8), np.complex64))
    os.kill(os.getpid(), signal.SIGKILL)

axes = {"x": np.arange(16.0), "y": np.arange(16.0)}
stores.create(
    sys.argv[1], stores.PATCH, sizes={}, coords=axes, attrs={}, chunks={"x": 8, "y": 8}, overwrite=True, fill=fill
)
"""


@pytest.mark.slow
def test_a_store_is_unfinished_if_its_writer_was_killed(there: Place) -> None:
    make(there / "whole", 1)
    make(there / "killed", 2)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(there / "killed")], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert "c" in (there / "killed" / "image").names()  # a chunk was already written
    for opened in (stores.open_dataset, stores.open_phase_history):
        with pytest.raises(InputError, match="left unfinished"):
            opened(there / "killed")
    with pytest.raises(InputError, match=r"left unfinished; .* overwritten"):
        make(there / "killed", 1)
    make(there / "killed", 1, overwrite=True)
    assert contents(there / "killed") == contents(there / "whole")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(5, "oh")])
def test_a_failed_creation_leaves_nothing(error: BaseException, there: Place, tmp_path: Path) -> None:
    def fill(part: Place) -> None:
        stores.write_region(part, "image", np.s_[:8, :8], np.zeros((8, 8), np.complex64))
        raise error

    for where in (there / "store", LocalPlace(tmp_path) / "store"):
        with pytest.raises((KeyboardInterrupt, ProcessingError, InputError)):
            make(where, 1, fill=fill)
        assert not where.exists()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", ["thesis/chapter1.tex", "thesis"])
def test_overwrite_spares_what_is_not_a_store(name: str, there: Place) -> None:
    precious = there / name
    precious.write_bytes(b"...")
    with pytest.raises(InputError, match="not a zarr store"):
        make(there / "thesis", 1, overwrite=True)
    assert precious.read_bytes() == b"..."


def test_overwrite_removes_the_group_metadata_first_and_writes_it_last(
    there: ObjectPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def spy(method: Callable[..., None]) -> Callable[..., None]:
        def told(where: ObjectPlace, *arguments: Any) -> None:
            order.append(f"{method.__name__} {str(where).removeprefix(f'{there}/')}")
            method(where, *arguments)

        return told

    make(there, 1)
    for method in (ObjectPlace.write_bytes, ObjectPlace.remove):
        monkeypatch.setattr(ObjectPlace, method.__name__, spy(method))
    make(there, 2, overwrite=True)
    assert order[:2] == [f"write_bytes {stores.UNFINISHED}", "remove zarr.json"]
    assert order[-2:] == ["write_bytes zarr.json", f"remove {stores.UNFINISHED}"]


@pytest.mark.slow
def test_a_copy_that_was_killed_while_it_was_published_is_published_again(
    there: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without being told to overwrite; what else is there stays. Until it is whole there is no store."""
    made, out = there / "made", there / "out"
    make(made, 1)
    make(out, 2)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        write = ObjectPlace.write_bytes

        def killed(where: ObjectPlace, data: bytes) -> None:
            if where.name == "1":
                patch.setattr(ObjectPlace, "remove", lambda where: None)
                raise KeyboardInterrupt
            write(where, data)

        patch.setattr(ObjectPlace, "write_bytes", killed)
        stores.publish(made, out, overwrite=True)
    with pytest.raises(InputError, match="left unfinished"):
        stores.open_dataset(out)
    make(there / "other", 1)
    assert not stores.was_being_published(there / "other", out)
    with pytest.raises(InputError, match=r"left unfinished; .* overwritten"):
        stores.publish(there / "other", out, overwrite=False)
    assert stores.was_being_published(made, out)
    stores.publish(made, out, overwrite=False)
    assert contents(out) == contents(made)


def test_a_writer_is_refused_if_another_replaces_its_store(there: Place) -> None:
    def overtaken(part: Place) -> None:
        stores.write_region(part, "image", np.s_[:8, :8], np.zeros((8, 8), np.complex64))
        make(there, 7, overwrite=True)  # another writer, which finishes first
        with pytest.raises(InputError, match="exists"):
            make(there, 8)

    with pytest.raises(ProcessingError, match="somebody else") as error:
        make(there, 1, overwrite=True, fill=overtaken)
    one_sentence(error)
    assert (stores.read_region(there, "image", ALL) == 7).all()
    assert stores.open_dataset(there).sizes == {"x": 16, "y": 16}


# Fingerprint


@pytest.mark.slow
def test_the_fingerprint_changes_with_every_change_of_the_store(small_collection: Collection, there: Place) -> None:
    found = history(there, small_collection)
    first = found.fingerprint()
    assert history(there / "elsewhere", small_collection).fingerprint() == first
    seen = {first}
    chunk = there / "signal" / "c" / "1" / "1"
    data = chunk.read_bytes()
    chunk.write_bytes(data)
    assert found.fingerprint() == first  # the same bytes give the same fingerprint
    chunk.write_bytes(data[:-1] + b"\x01")
    seen.add(found.fingerprint())
    chunk.remove()
    seen.add(found.fingerprint())
    stores.write_region(there, "reference_range", (slice(None),), np.full(256, 12_001.0))
    seen.add(found.fingerprint())
    metadata = (there / "zarr.json").read_bytes()
    (there / "zarr.json").write_bytes(metadata.replace(b"9600000000", b"9700000000"))
    seen.add(found.fingerprint())
    assert len(seen) == 5
    (there / "README").write_bytes(b"not of the store")
    assert found.fingerprint() in seen


# Errors


READERS: list[Callable[[Place], Any]] = [
    stores.open_phase_history,
    stores.read_collection,
    stores.open_dataset,
    stores.read_json,
    lambda where: stores.read_region(where, "signal", ALL),
    lambda where: stores.chunk_shape(where, "signal"),
]


def writers(collection: Collection) -> list[Callable[[Place], Any]]:
    return [
        lambda where: stores.create_phase_history(where, collection),
        lambda where: stores.write_collection(where, collection),
        lambda where: stores.write_json(where, {}),
        lambda where: stores.write_region(where, "signal", ALL, np.zeros((256, 128), np.complex64)),
    ]


def test_a_missing_store_is_refused(there: Place) -> None:
    (there / "object").write_bytes(b"...")
    for where in (there / "nothing", there / "object" / "below", place("s3://no-such-bucket/ph.zarr")):
        for read in READERS:
            with pytest.raises(InputError, match=r"does not exist|is not there") as error:
                read(where)
            assert str(where) in one_sentence(error)
    with pytest.raises(InputError, match="not a zarr store"):
        stores.open_phase_history(there / "object")


def test_writing_to_a_missing_bucket_is_refused(small_collection: Collection, there: Place) -> None:
    where = place("s3://no-such-bucket/ph.zarr")
    for write in writers(small_collection):
        with pytest.raises((InputError, ProcessingError), match="bucket does not exist") as error:
            write(where)
        assert str(where) in one_sentence(error)


def refused(call: Callable[[], Any], kinds: Any, words: str) -> None:
    with pytest.raises(kinds, match=words) as error:
        call()
    one_sentence(error)


def test_an_unreachable_endpoint_is_reported(small_collection: Collection, there: Place, unreached: str) -> None:
    for read in READERS:
        refused(lambda read=read: read(there), InputError, rf"{unreached} does not answer.*AWS_ENDPOINT_URL")
    for write in writers(small_collection):
        refused(lambda write=write: write(there), ProcessingError, f"{unreached} does not answer")


@pytest.mark.slow
def test_an_endpoint_that_stops_answering_is_reported(
    small_collection: Collection, there: Place, monkeypatch: Any
) -> None:
    found = history(there, small_collection)
    monkeypatch.setattr(objects, "REQUEST", "1s")
    monkeypatch.setattr(objects, "PATIENCE", 1.0)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        endpoint(listener.getsockname()[1], monkeypatch),
    ):
        refused(lambda: found.read(*ALL), InputError, "does not answer")
        refused(found.fingerprint, InputError, "does not answer")


@contextmanager
def unreliable(behind: str, failures: float, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Run an endpoint that refuses the first `failures` requests for chunks of samples; yields their paths."""
    failed: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "/signal/c/" in self.path and len(failed) < failures:
                failed.append(self.path)
                status, headers, body = 503, {}, b"<Error>\n<Code>Busy</Code>\n</Error>"
            else:
                try:
                    asked = urllib.request.Request(behind + self.path, headers=dict(self.headers))
                    with urllib.request.urlopen(asked) as answer:
                        status, headers, body = answer.status, dict(answer.headers), answer.read()
                except urllib.error.HTTPError as error:
                    with error:
                        status, headers, body = error.code, dict(error.headers), error.read()
            self.send_response(status)
            for name in ("ETag", "Last-Modified", "Content-Type"):
                if name in headers:
                    self.send_header(name, headers[name])
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            with endpoint(server.server_port, monkeypatch):
                yield failed
        finally:
            server.shutdown()
            thread.join()


def test_a_failed_request_is_repeated(small_collection: Collection, there: Place, monkeypatch: Any) -> None:
    found = history(there, small_collection)
    with unreliable(os.environ["AWS_ENDPOINT_URL"], 1, monkeypatch) as failed:
        assert np.array_equal(found.read(*ALL), noise(256, 128))
    assert len(failed) == 1


@pytest.mark.slow
def test_unreachable_samples_are_not_reported_as_damaged(
    small_collection: Collection, there: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = history(there, small_collection)
    with unreliable(os.environ["AWS_ENDPOINT_URL"], np.inf, monkeypatch) as failed:
        refused(lambda: found.read(slice(0, 9), slice(0, 9)), InputError, r"cannot be read .*503 .*; check AWS_")
    assert len(failed) == 2  # the same chunk, requested twice


def test_many_chunks_are_transferred_at_once() -> None:
    met = threading.Barrier(8)
    moved = []

    def move(there: stores.Region, here: stores.Region) -> None:
        met.wait()
        moved.append((there, here))

    regions.for_each_chunk(np.s_[3:16, 4:8], (4, 2), move)
    assert sorted(moved, key=repr) == sorted(
        (
            (
                ((slice(a, b), slice(c, c + 2)), (slice(a - 3, b - 3), slice(c - 4, c - 2)))
                for a, b in ((3, 4), (4, 8), (8, 12), (12, 16))
                for c in (4, 6)
            )
        ),
        key=repr,
    )


@pytest.mark.slow
def test_refused_credentials_are_reported(small_collection: Collection, monkeypatch: pytest.MonkeyPatch) -> None:
    with s3.refusing_server():
        where = place("s3://bucket/ph.zarr")
        for read in READERS:
            refused(lambda read=read: read(where), InputError, r"refuses these credentials.*AWS_ACCESS_KEY_ID")
        for write in writers(small_collection):
            refused(lambda write=write: write(where), (InputError, ProcessingError), "refuses these credentials")


def test_missing_credentials_are_reported(there: Place, unreached: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", unreached)  # credentials of the machine itself, which has none
    refused(lambda: stores.open_phase_history(there), InputError, r"no credentials.*AWS_ACCESS_KEY_ID")
    refused(lambda: finished_record(there), InputError, r"no credentials.*AWS_ACCESS_KEY_ID")


@pytest.mark.parametrize("url", ["s3://", "s3:///a", "s3://b/../c", "s3://b/a//c", "s3://b/./c"])
def test_a_url_that_is_not_a_place_is_refused(url: str) -> None:
    with pytest.raises(InputError) as error:
        place(url)
    one_sentence(error)


# Complete runs


POINT = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n'
GRID = ((15950.0, 16250.0, 1.5), (19050.0, 19350.0, 1.5))
FOCUS: dict[str, Any] = {"blocks": 3, "coefficients": "closed-form", "grid": GRID}
WORDS = ("--blocks", "3", "--coefficients", "closed-form", "--grid", "15950:16250:1.5,19050:19350:1.5")


def command(*words: str) -> subprocess.Popen[str]:
    """Start the command line in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "blocksar", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def wait_for(condition: Callable[[], bool], running: subprocess.Popen[str]) -> None:
    while not condition():
        assert running.poll() is None, running.communicate()[0]
        time.sleep(0.01)


def chunks(run: Place) -> dict[str, bytes]:
    return {name: data for name, data in contents(run / "image.zarr").items() if "/c/" in name}


@pytest.mark.slow
def test_a_run_that_was_killed_and_resumed_equals_the_run_in_a_folder(there: Place, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scene(swath=[29700.0, 30300.0], more=POINT))
    local = LocalPlace(tmp_path)
    for where in (there, local):
        blocksar.simulate(tmp_path / "scene.toml", where / "ph.zarr")

    words = ("focus", f"{there}/ph.zarr", "--out", f"{there}/run", "--workers", "1", *WORDS)
    run = there / "run"
    with command(*words) as first:
        wait_for(lambda: "run.json" in run.names(), first)
        with pytest.raises(InputError, match=rf"is being written by process {first.pid} on "):
            blocksar.focus(there / "ph.zarr", run, **FOCUS)
        wait_for(lambda: any(name.startswith("columns-") for name in (run / "receipts").names()), first)
        os.killpg(first.pid, signal.SIGKILL)
    assert stores.read_json(run / "run.json")["status"] == "unfinished"
    with open_client(workers=1, threads=1, memory_limit=3 * 2**30) as client:
        blocksar.focus(local / "ph.zarr", local / "run", client=client, **FOCUS)
        second = blocksar.focus(f"{there}/ph.zarr", f"{run}", client=client, **FOCUS)
    assert "went on from an unfinished run" in second.summary[0]

    assert chunks(run) == chunks(local / "run")
    assert run.names() == (local / "run").names()
    assert np.array_equal(blocksar.open(run)["block"].values, blocksar.open(local / "run")["block"].values)
    with command("quality", f"{run}") as measured:
        assert "1 of 1 full-dwell target measured" in measured.communicate()[0]
    blocksar.quality(local / "run")
    assert (run / "quality.json").read_bytes() == (local / "run" / "quality.json").read_bytes()


@pytest.mark.parametrize(
    "call",
    [
        blocksar.plan, blocksar.info, blocksar.open,
        lambda path: blocksar.focus(path, "run", grid="0:1:1,0:1:1", workers=0),
        lambda path: blocksar.ingest(None, path, "ph.zarr"),
    ],
)  # fmt: skip
def test_a_missing_bucket_is_one_sentence_in_python(call: Any, bucket: str) -> None:
    with pytest.raises(
        InputError, match=r"s3://no-such-bucket.*(the bucket does not exist|does not exist, or)"
    ) as caught:
        call("s3://no-such-bucket/place")
    assert isinstance(caught.value, FileNotFoundError)
    assert len("".join(traceback.format_exception(caught.value)).splitlines()) < 60
