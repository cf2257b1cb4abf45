"""Parts of files: pulses, frequencies and areas, from a disk, an object store and a web server; disks without room."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import s3
from axis_beams import axis_collection, spotlight

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.places import place, ranges
from blocksar.readers import resampling
from blocksar.readers.cphd.files import open_file
from blocksar.simulation import cphd as cphd_simulation

pytest.importorskip("sarkit", reason="the extra `formats` is not installed")

# ---------------------------------------------------------------- low-passes


def response(filtered: resampling.LowPass, k: int, frequency: Any) -> Any:
    """H of one sum, from its definition."""
    lag = filtered.first[k] + np.arange(filtered.weights.shape[1]) - filtered.places[k]
    return np.exp(2j * np.pi * np.asarray(frequency)[:, None] * lag) @ filtered.weights[filtered.kind[k]]


@pytest.mark.parametrize("band", [0.3, 0.09])
def test_what_is_wanted_passes_and_nothing_folds_onto_it(band: float) -> None:
    steps = resampling.steps_of(band, 1.0)
    assert steps == int(1 / (resampling.SPARE * band))
    filtered = resampling.plan_lowpass(3000, steps, band)
    assert np.ptp(np.diff(filtered.places)) == 0 and filtered.places[1] - filtered.places[0] == steps
    passed = np.linspace(-band / 2, band / 2, 501)
    stopped = np.linspace(1 / steps - band / 2, 0.5, 501)
    middle = filtered.places.size // 2
    assert np.abs(response(filtered, middle, passed) - 1).max() < 1e-3  # TAPS give -77 dB
    assert np.abs(response(filtered, middle, stopped)).max() < 1e-3
    for k in np.flatnonzero(filtered.good)[[0, -1]]:  # beside the ends, as far as is said
        assert np.abs(response(filtered, k, passed) - 1).max() <= 1.01 * filtered.error <= 1.01 * resampling.MOST_ERROR
        assert np.abs(response(filtered, k, stopped)).max() <= 1.01 * filtered.error
    assert np.count_nonzero(~filtered.good) <= 4  # of the sums, two at either end


def test_missing_samples_are_not_used_and_cost_what_is_said() -> None:
    rng = np.random.default_rng(3)
    present = rng.random(900) > 0.02
    band = 0.2
    filtered = resampling.plan_lowpass(900, 4, band, present)
    for k in np.flatnonzero(filtered.good)[::9]:
        used = slice(filtered.first[k], filtered.first[k] + filtered.weights.shape[1])
        assert not filtered.weights[filtered.kind[k]][~present[used]].any()
        assert np.abs(response(filtered, k, np.linspace(-band / 2, band / 2, 301)) - 1).max() <= 1.01 * filtered.error
    assert 0.5 < filtered.good.mean() < 1


# ---------------------------------------------------------------- areas

AREA = ((8985.0, 9025.0), (-10.0, 20.0))
INSIDE = np.array([[9000.0, 0.0, 0.0], [9025.0, 20.0, 0.0], [8985.0, -10.0, 0.0], [9010.0, 5.0, 40.0]])
STRONG = 30.0  # amplitude of those outside


def signal_of(collection: Collection, points: Any, amplitude: float) -> Any:
    """The definition, summed over points."""
    frequency = collection.carrier + collection.range_frequency
    total = np.zeros((collection.n_pulse, frequency.size), complex)
    for point in points:
        distance = np.linalg.norm(collection.antenna_position - point, axis=1) - collection.reference_range
        total += amplitude * np.exp(-4j * np.pi * frequency * distance[:, None] / SPEED_OF_LIGHT)
    return total


def outside(kept: Collection) -> Any:
    """Points whose echoes fold onto the area where they are not stopped: in range, on either side, and in Doppler."""
    far = 1.1 * kept.range_window * np.hypot(9000, 4000) / 9000
    along = 1.1 * kept.prf * kept.wavelength * np.hypot(9000, 4000) / (2 * 200)
    return np.array([[9005.0 + far, 5.0, 0.0], [9005.0 - far, 5.0, 0.0], [9005.0, 5.0 + along, 0.0]])


def fine(make: Callable[..., Collection], **changes: Any) -> Collection:
    """A pass sampled densely enough that an area needs every third pulse and frequency at most."""
    return make(n_pulse=1500, range_frequency=(np.arange(1100) - 550) * 35e3, **changes)


def wandering(**changes: Any) -> Collection:
    """An unsteered beam, and a reference range that is off the scene's and moves."""
    n = changes["n_pulse"]
    whole = axis_collection(**changes)
    return Collection(**{
        **whole.as_dict(), "beam_axis": None, "beam_steering": None, "beam_width": None,
        "reference_range": np.linalg.norm(whole.antenna_position - [9e3, 9.0, 0.0], axis=1) + np.linspace(-20, 20, n),
    })  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("make", [spotlight, wandering])
def test_samples_of_an_area_are_those_of_its_targets_alone(make: Callable[..., Collection]) -> None:
    whole = fine(make)
    present = np.ones(whole.n_pulse, bool)
    present[[742, 753]] = False
    cut = resampling.plan_cut(whole, AREA, present)
    kept = cut.collection
    assert whole.n_pulse / kept.n_pulse > 1.9 and whole.n_range_frequency / kept.n_range_frequency > 1.9
    others = outside(kept)
    samples = (signal_of(whole, INSIDE, 1.0) + signal_of(whole, others, STRONG)).astype(np.complex64)
    samples[~present] = complex(np.nan, np.nan)
    asked: list[slice] = []

    def read(pulses: slice) -> Any:
        asked.append(pulses)
        return samples[pulses]

    reader = cut.reader(read, whole.carrier + whole.range_frequency)
    n = kept.n_pulse
    got = np.concatenate([reader(slice(0, n // 2)), reader(slice(n // 2, n))])
    wanted = signal_of(kept, INSIDE, 1.0)
    error = np.abs(got - wanted).max(axis=1)
    filtered = cut.pulses.error + cut.frequencies.error
    most = (
        filtered * resampling.MOST_GROWTH * (len(INSIDE) + STRONG * len(others))
    )  # one stops what the other lets grow
    lit = np.isfinite(error)
    assert lit.mean() > 0.95 and error[lit].max() <= most
    middle = np.abs(got - wanted)[n // 8 : n // 3, 10:-10]  # away from ends and missing pulses
    assert np.nanmax(middle) <= 1e-3 * (len(INSIDE) + STRONG * len(others))
    places = np.searchsorted(whole.time, kept.time + cut.later - 1e-9)
    np.testing.assert_array_equal(kept.antenna_position, whole.antenna_position[places])
    assert max(each.stop - each.start for each in asked) <= resampling.PART  # memory does not grow with the file


def test_only_pulses_that_light_an_area_are_kept() -> None:
    whole = fine(axis_collection)
    cut = resampling.plan_cut(whole, ((8990.0, 9010.0), (40.0, 60.0)), np.ones(whole.n_pulse, bool))
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(8990, 9010, 9), np.linspace(40, 60, 9)))
    sight = np.stack([x, y, 0 * x], axis=1) - whole.antenna_position[:, None]
    assert whole.beam_axis is not None and whole.beam_steering is not None and whole.beam_width is not None
    along = np.einsum("npk,nk->np", sight / np.linalg.norm(sight, axis=2, keepdims=True), whole.beam_axis)
    offset = np.arcsin(along) - whole.beam_steering[:, None]
    lit = np.flatnonzero((np.abs(offset) <= whole.beam_width / 2).any(axis=1))
    kept = np.searchsorted(whole.time, cut.collection.time[[0, -1]] + cut.later - 1e-9)
    assert kept == pytest.approx(lit[[0, -1]], abs=4)  # of places between those that are asked, and steps
    assert cut.collection.n_pulse * cut.collection.pulse_interval < 0.6 * whole.n_pulse * whole.pulse_interval
    with pytest.raises(InputError, match=r"--area 8990:9010,4000:4060 is lit at no time; give an area that the beam"):
        resampling.plan_cut(whole, ((8990.0, 9010.0), (4000.0, 4060.0)), np.ones(whole.n_pulse, bool))


def test_an_area_that_was_not_recorded_is_refused() -> None:
    whole = fine(wandering)
    with pytest.raises(
        InputError, match=r"--area 20000:20100,0:100 lies 10575.8 m in range from the middle of what was"
    ):
        resampling.plan_cut(whole, ((20000.0, 20100.0), (0.0, 100.0)), np.ones(whole.n_pulse, bool))


# ---------------------------------------------------------------- files

SCENE = """
[radar]
carrier = 10e9
bandwidth = 300e6
range_sampling = 540e6
prf = 800.0
[track]
position = [0.0, 0.0, 5000.0]
velocity = [0.0, 120.0, 0.0]
[time]
pulses = 1200
[scene]
swath = [7850.0, 8150.0]
centre_yaw_deg = 0.0
reference_range = "constant"
[[targets]]
name = "wanted"
ground_range_offset = 20.0
cross_range_offset = -15.0
[[targets]]
name = "another"
ground_range_offset = -50.0
cross_range_offset = 40.0
amplitude = 5.0
"""


class Made(NamedTuple):
    path: Path
    store: Path  # all of it
    target: Any  # (2,) of the wanted one in the store's frame, m


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("parts")
    (folder / "scene.toml").write_text(SCENE)
    path = folder / "collect.cphd"
    cphd_simulation.simulate(folder / "scene.toml", path, origin=(-33.5, 151.2, 40.0))
    blocksar.ingest("cphd", path, folder / "whole.zarr")
    image = blocksar.open(blocksar.focus(
        folder / "whole.zarr", folder / "run", grid="-60:60:0.4,-60:60:0.4", processor="backprojection", workers=0,
    ).folder).image  # fmt: skip
    near = image.where((abs(image.x) < 35) & (abs(image.y) < 35) & (image.x + 1j * image.y != 0), 0)
    row, column = np.unravel_index(int(np.abs(near.values).argmax()), near.shape)
    return Made(path, folder / "whole.zarr", np.array([image.x.values[column], image.y.values[row]]))


def samples_of(store: Path) -> tuple[Collection, Any]:
    history = stores.open_phase_history(store)
    return history.collection, history.read(slice(None), slice(None))


@pytest.mark.slow
def test_some_pulses_and_frequencies_are_those_of_the_whole(made: Made, tmp_path: Path) -> None:
    whole, samples = samples_of(made.store)
    low, high = whole.carrier - 30e6, whole.carrier + 20e6
    blocksar.ingest("cphd", made.path, tmp_path / "a.zarr", pulses="100:400", frequencies=f"{low}:{high}")
    part, own = samples_of(tmp_path / "a.zarr")
    frequency, had = part.carrier + part.range_frequency, whole.carrier + whole.range_frequency
    columns = np.flatnonzero((had >= low) & (had <= high))
    np.testing.assert_allclose(frequency, had[columns], rtol=1e-12)
    np.testing.assert_array_equal(own, samples[100:400, columns])
    np.testing.assert_array_equal(part.antenna_position, whole.antenna_position[100:400])
    np.testing.assert_array_equal(part.reference_range, whole.reference_range[100:400])
    sources = [dict(stores.open_phase_history(each).attrs["source"]) for each in (made.store, tmp_path / "a.zarr")]
    times = [source["time_zero"] + each.time[0] for source, each in zip(sources, (whole, part), strict=True)]
    assert times[1] - times[0] == pytest.approx(100 * whole.pulse_interval, abs=1e-9)


@pytest.mark.slow
def test_an_area_of_a_file_shows_what_the_whole_shows(made: Made, tmp_path: Path) -> None:
    x, y = made.target
    ground = f"{x - 12}:{x + 12},{y - 12}:{y + 12}"
    report = blocksar.ingest("cphd", made.path, tmp_path / "a.zarr", area=ground)
    assert any("one pulse of" in line and "one frequency of" in line for line in report.summary)
    whole, part = samples_of(made.store)[0], samples_of(tmp_path / "a.zarr")[0]
    assert part.n_pulse * part.n_range_frequency < whole.n_pulse * whole.n_range_frequency / 6
    grid = f"{x - 2}:{x + 2.1}:0.25,{y - 2}:{y + 2.1}:0.25"
    for processor in ("backprojection", "high-order-phase"):
        runs = [
            blocksar.focus(store, tmp_path / f"{processor}{k}", grid=grid, processor=processor, workers=0).folder
            for k, store in enumerate((made.store, tmp_path / "a.zarr"))
        ]
        one, two = (blocksar.open(run).image.values for run in runs)
        peak = np.unravel_index(int(np.abs(one).argmax()), one.shape)
        assert two[peak] == pytest.approx(one[peak], abs=0.02)  # the strong neighbour's side lobes reach 0.01
        assert np.unravel_index(int(np.abs(two).argmax()), two.shape) == peak


@pytest.mark.slow
def test_lost_vectors_are_left_out_of_an_area(made: Made, tmp_path: Path) -> None:
    """Vectors of zeros are found as samples are read; sums leave them out, and are NaN where they miss too many."""
    lost = [*range(400, 480), 700]
    with made.path.open("rb") as stream:
        file = open_file(stream, made.path, None)
    data = bytearray(made.path.read_bytes())
    row = file.shape[1] * file.dtype.itemsize
    for vector in lost:
        start = file.first_byte + vector * row
        data[start : start + row] = bytes(row)
    (tmp_path / "lost.cphd").write_bytes(data)
    x, y = made.target
    options: dict[str, Any] = {"area": f"{x - 12}:{x + 12},{y - 12}:{y + 12}", "pulses": "100:1100"}
    said = blocksar.ingest("cphd", tmp_path / "lost.cphd", tmp_path / "lost.zarr", **options).summary
    blocksar.ingest("cphd", made.path, tmp_path / "whole.zarr", **options)
    assert any("lost vectors: 400 .. 479, 700 (all samples are 0)" in line for line in said)
    (collection, samples), (_, whole) = (samples_of(tmp_path / name) for name in ("lost.zarr", "whole.zarr"))
    lit = np.isfinite(samples[:, 0])
    assert np.count_nonzero(~lit) * collection.pulse_interval * 800 == pytest.approx(80, abs=6)  # two sums
    matched = np.conj(signal_of(collection, [[x, y, 0.0]], 1.0))
    gain = (samples * matched)[lit].mean() / (whole * matched)[lit].mean()
    assert gain == pytest.approx(1, abs=0.005)  # side lobes of the neighbour; 0.91 with zeros in the sums


def test_a_disk_without_room_is_said_before_samples_are_read(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    with pytest.raises(InputError, match=r"needs [\d.]+ MiB of disk, and 1.0 MiB are free there; make room, choose"):
        blocksar.ingest("cphd", made.path, tmp_path / "deep" / "a.zarr")
    assert not list(tmp_path.iterdir())
    blocksar.ingest("cphd", made.path, tmp_path / "a.zarr", pulses=":60")


# ---------------------------------------------------------------- from afar


class Served(NamedTuple):
    url: str
    sent: list[int]  # bytes of each reply


@contextmanager
def web_server(folder: Path, *, parts: bool = True) -> Iterator[Served]:
    """A web server of a folder's files, with or without range requests."""
    sent: list[int] = []

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            path, _, query = self.path.partition("?")
            if query and query != "signature=right":
                return self.send_error(403)
            if not (folder / path[1:]).is_file():
                return self.send_error(404)
            data = (folder / path[1:]).read_bytes()
            asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            if parts and asked:
                start, stop = int(asked[1]), min(int(asked[2]) + 1, len(data))
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(data)}")
                data = data[start:stop]
            else:
                self.send_response(200)
            sent.append(len(data))
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield Served(f"http://127.0.0.1:{server.server_port}", sent)
        server.shutdown()


@pytest.mark.slow
def test_a_web_server_sends_only_what_is_read(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranges, "AHEAD", 1 << 14)
    with web_server(made.path.parent) as served:
        source = f"{served.url}/{made.path.name}?signature=right"
        assert blocksar.info(source).result["kind"] == "CPHD file"
        served.sent.clear()
        blocksar.ingest("cphd", source, tmp_path / "a.zarr", pulses="200:300")
        assert sum(served.sent) < made.path.stat().st_size / 3
        with pytest.raises(
            InputError, match=r"collect.cphd cannot be read \(the server refuses: 403 Forbidden; ask for"
        ):
            blocksar.ingest("cphd", source.replace("right", "wrong"), tmp_path / "b.zarr")
        with pytest.raises(InputError, match="nothing does not exist"):
            blocksar.info(f"{served.url}/nothing")
        with pytest.raises(InputError, match="is a scene"):
            blocksar.ingest("cphd", f"{served.url}/scene.toml", tmp_path / "b.zarr")
    np.testing.assert_array_equal(samples_of(tmp_path / "a.zarr")[1], samples_of(made.store)[1][200:300])


def test_a_web_server_without_parts_is_said_to_be_one(made: Made, tmp_path: Path) -> None:
    refusal = pytest.raises(InputError, match="is on a server that sends no parts of files; download it, and give the")
    with web_server(made.path.parent, parts=False) as served, refusal:
        blocksar.ingest("cphd", f"{served.url}/{made.path.name}", tmp_path / "a.zarr")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # sockets of the server's threads
def test_an_object_store_is_read_as_a_disk_is(made: Made, tmp_path: Path) -> None:
    with s3.server():
        there = place(f"s3://{s3.make_bucket()}/collect.cphd")
        there.write_bytes(made.path.read_bytes())
        assert blocksar.info(str(there)).result["kind"] == "CPHD file"
        blocksar.ingest("cphd", str(there), tmp_path / "a.zarr", pulses="200:300")
        with pytest.raises(InputError, match="is a CPHD file; turn it into a phase history first"):
            blocksar.plan(str(there))
    np.testing.assert_array_equal(samples_of(tmp_path / "a.zarr")[1], samples_of(made.store)[1][200:300])
