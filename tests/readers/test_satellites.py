"""Raw echoes of satellites, from files of the formats' layout: targets lie where they are on the Earth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from raw_satellites import GAIN, Radar, write_crsd, write_nisar, write_palsar
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli.commands import app
from blocksar.collection.georeference import Georeference


class Dithered(Radar):
    """Its pulses are sent up to 0.3 of an interval early or late."""

    @property
    def sent(self) -> NDArray[np.float64]:
        random = np.random.default_rng(1).uniform(-0.3, 0.3, self.n_pulse)
        return np.asarray(self.start + (np.arange(self.n_pulse) + random) / self.prf)


RADARS = {"nisar": Radar(side=-1), "dithered": Dithered(side=-1), "palsar": Radar(), "crsd": Radar()}
WRITERS = {"nisar": write_nisar, "dithered": write_nisar, "palsar": write_palsar, "crsd": write_crsd}


@pytest.fixture(scope="module", params=list(RADARS))
def image(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Radar, Path]:
    """A run over the targets, and what it is of."""
    folder, name = tmp_path_factory.mktemp("satellite"), request.param
    radar, source = RADARS[name], folder / "source"
    WRITERS[name](source, radar)  # type: ignore[operator]
    blocksar.ingest(None, source, folder / "ph.zarr", progress=False)
    blocksar.focus(folder / "ph.zarr", folder / "run", grid="-900:1000:2.5,-900:900:2.5", workers=0, progress=False)
    return name, radar, folder / "run"


AT_DATE_LINE = 181.99  # degrees, by which the targets come there


def targets_of(store: Path, radar: Radar) -> list[dict[str, Any]]:
    frame = Georeference.among(stores.open_phase_history(store).attrs)
    assert frame is not None
    places = frame.from_ecef(radar.targets).tolist()
    return [{"name": f"T{i}", "x": x, "y": y, "z": z} for i, (x, y, z) in enumerate(places)]


def test_targets_on_the_ellipsoid_lie_at_their_places(image: tuple[str, Radar, Path]) -> None:
    name, radar, run = image
    targets = targets_of(run.parent / "ph.zarr", radar)[:10]
    found = blocksar.quality(run, targets=targets).result["targets"]
    values = np.array([complex(*each["value"]) for each in found])
    assert len(found) == 10 and all(each["covered"] for each in found)
    for each in found:
        # 16 mm of it for PALSAR: times in milliseconds, of which no fraction fits at 1700 Hz but steps of 3 us.
        assert np.hypot(each["error_x"], each["error_y"]) < 0.05, each
        for axis in ("range", "azimuth"):
            assert each[f"{axis}_pslr"] == pytest.approx(each[f"{axis}_pslr_theory"], abs=0.1), each
            assert each[f"{axis}_irw"] == pytest.approx(each[f"{axis}_irw_theory"], rel=0.005), each
    mean = values.mean()
    assert np.abs(np.abs(values) / abs(mean) - 1).max() < 0.01
    assert np.abs(np.angle(values / mean)).max() < 0.03
    assert abs(mean) == pytest.approx(GAIN if name == "palsar" else 1.0, rel=0.01)


@pytest.mark.parametrize(
    ("write", "outside"),
    [pytest.param(write, outside, marks=() if (write, outside) == (write_palsar, 1e-4) else pytest.mark.slow)
     for write in (write_nisar, write_palsar) for outside in (1e-6, 1e-4, 1e-2)],
)  # fmt: skip
def test_targets_at_the_date_line_of_a_strip_that_the_orbit_does_not_cover(
    write: Any, outside: float, tmp_path: Path
) -> None:
    """The strip begins just before the first state, and ends just after the last."""
    radar = Radar(east=np.radians(AT_DATE_LINE))
    middle = radar.sent[[0, -1]] + radar.slant_range / 299792458.0
    radar = replace(radar, given=np.linspace(middle[0] + outside, middle[1] - outside, 4))
    source = write(tmp_path / "source", radar)
    blocksar.ingest(None, source, tmp_path / "ph.zarr", progress=False)
    frame = Georeference.among(stores.open_phase_history(tmp_path / "ph.zarr").attrs)
    assert frame is not None and 179.99 < abs(frame.longitude) <= 180
    run = tmp_path / "run"
    blocksar.focus(tmp_path / "ph.zarr", run, grid="-900:1000:2.5,-900:900:2.5", workers=0, progress=False)
    found = blocksar.quality(run, targets=targets_of(tmp_path / "ph.zarr", radar)[:10]).result["targets"]
    assert len(found) == 10 and all(each["covered"] for each in found)
    assert max(np.hypot(each["error_x"], each["error_y"]) for each in found) < 0.3
    blocksar.export("stac", run, tmp_path / "item.json")
    item = json.loads((tmp_path / "item.json").read_text())
    west, _, east, _ = item["bbox"]
    assert 179.97 < west < 180 and -180 < east < -179.97
    assert item["geometry"]["type"] == "MultiPolygon"
    ends = np.concatenate([np.array(part[0])[:, 0] for part in item["geometry"]["coordinates"]])
    assert (np.abs(ends) > 179.97).all() and (np.abs(ends) <= 180).all()


@pytest.mark.slow
@pytest.mark.parametrize("image", ["palsar"], indirect=True)
@pytest.mark.parametrize("surface", [None, "plane"])
def test_the_ground_is_the_ellipsoid_unless_said_otherwise(
    image: tuple[str, Radar, Path], surface: Any, tmp_path: Path
) -> None:
    _, radar, run = image
    store = run.parent / "ph.zarr"
    far = targets_of(store, radar)[10]
    x, y = 2.5 * round(far["x"] / 2.5), 2.5 * round(far["y"] / 2.5)
    grid = (x - 150, x + 150, 2.5), (y - 150, y + 150, 2.5)
    blocksar.focus(store, tmp_path / "run", grid=grid, surface=surface, workers=0, progress=False)
    place = {key: far[key] for key in ("name", "x", "y")}
    [found] = blocksar.quality(tmp_path / "run", targets=[place]).result["targets"]
    off = np.hypot(found["error_x"], found["error_y"])
    assert 1 < off < 4 if surface == "plane" else off < 0.05


SHORT = Radar(n_pulse=64, n_sample=640)


def ingested(source: Path, out: Path, **options: Any) -> tuple[Any, list[str]]:
    report = blocksar.ingest(None, source, out, progress=False, **options)
    return stores.open_phase_history(out), report.summary


@pytest.mark.parametrize("write", [write_nisar, write_palsar])
def test_channels_parts_and_times_of_files(write: Any, tmp_path: Path) -> None:
    source = write(tmp_path / "source", SHORT, polarizations=("HH", "HV"))
    history, _ = ingested(source, tmp_path / "all")
    assert history.channels == ("HH", "HV")
    both = [history.of_channel(name).read(slice(None), slice(None)) for name in history.channels]
    one, _ = ingested(source, tmp_path / "HV", polarization="hv", pulses="16:48")
    assert one.attrs["polarization"] == {"transmit": "H", "receive": "V"}
    np.testing.assert_array_equal(one.read(slice(None), slice(None)), both[1][16:48])
    np.testing.assert_allclose(both[0], 2 * both[1], atol=4)
    start = blocksar.ingest(None, source, tmp_path / "x", pulses="32:", progress=False).result
    assert start.n_pulse == 32
    source_of = history.attrs["source"]
    assert source_of["collection_start"].startswith("2026-03-04T10:00:00.2") and history.attrs["surface"] == "ellipsoid"
    # Positions are those of the middle of the way, whatever the times are.
    frame = Georeference.among(history.attrs)
    assert frame is not None
    middle = SHORT.earth_centred(SHORT.sent + SHORT.slant_range / 299792458.0)
    off = frame.to_ecef(history.collection.antenna_position) - middle
    # Times in milliseconds leave 59 us of 64 pulses at 1700 Hz, or 0.45 m.
    assert np.abs(off).max() < (0.5 if write is write_palsar else 0.05)
    moved, said = ingested(source, tmp_path / "m", time_tags="middle")
    later = Georeference.among(moved.attrs).to_ecef(moved.collection.antenna_position) - middle  # type: ignore[union-attr]
    assert np.linalg.norm(later, axis=1).mean() == pytest.approx(7500 * 830e3 / 3e8, rel=0.05)
    assert "--time-tags transmit" in " ".join(said)


@pytest.mark.parametrize("write", [write_nisar, write_palsar])
def test_the_atmosphere_is_told_and_taken_out(write: Any, tmp_path: Path) -> None:
    source = write(tmp_path / "source", SHORT)
    with_it, said = ingested(source, tmp_path / "a")
    without, _ = ingested(source, tmp_path / "b", troposphere="standard")
    removed = without.attrs["source"]["troposphere_removed"]
    assert 2.3 < removed < 4 and "--troposphere standard takes it out" in " ".join(said)
    assert with_it.raw is not None and without.raw is not None
    np.testing.assert_allclose(with_it.raw.fast_time - without.raw.fast_time, 2 * removed / 299792458.0, rtol=1e-6)
    np.testing.assert_allclose(with_it.collection.reference_range - without.collection.reference_range, removed)


def test_lost_lines_other_windows_and_another_prf(tmp_path: Path) -> None:
    n = SHORT.n_pulse
    late = np.where(np.arange(n) < 40, SHORT.first_range, SHORT.first_range + 31)  # m: ten samples
    number = np.arange(1, n + 1) + 3 * (np.arange(n) >= 20)
    prf = np.where(np.arange(n) < 50, 1_700_000, 1_650_000)
    nothing = np.arange(n) == 8
    sent = SHORT.sent + 3 / SHORT.prf * (np.arange(n) >= 20)
    tags = np.floor(1000 * (sent + 2 * SHORT.first_range / 299792458.0))
    source = write_palsar(
        tmp_path / "source", SHORT, b12=number, b44=tags, b56=prf, b96=nothing, b116=late,
        b120=np.round(2e9 * late / 299792458.0),
    )  # fmt: skip
    history, said = ingested(source, tmp_path / "out")
    text = " ".join(said)
    assert (
        "the PRF changes: lines 0 .. 49, 50 of 64" in text
        and "3 of 53 lines lost" in text
        and "1 of 50 lines marked as empty" in text
    )
    assert "receive windows change; the 630 samples that all pulses have" in text
    echo = history.read(slice(None), slice(None))
    assert echo.shape == (53, 630)
    assert np.flatnonzero(np.isnan(echo).all(axis=1)).tolist() == [8, 20, 21, 22]
    whole, _ = ingested(write_palsar(tmp_path / "plain", SHORT), tmp_path / "b")
    samples = whole.read(slice(None), slice(None))
    np.testing.assert_array_equal(echo[0], samples[0, 10:])
    np.testing.assert_array_equal(echo[-1], samples[49, :-10])


def test_pulses_that_calibrate_and_uneven_times(tmp_path: Path) -> None:
    n = SHORT.n_pulse
    marks = np.isin(np.arange(n), (5, 40)).astype(np.uint8) * 2
    quiet = Radar(n_pulse=n, n_sample=640)
    quiet.echo[5] = 0
    history, said = ingested(write_nisar(tmp_path / "a.h5", quiet, calType=marks), tmp_path / "a")
    assert np.flatnonzero(np.isnan(history.read(slice(None), slice(None))).all(axis=1)).tolist() == [5]
    assert "1 of 64 pulses for calibration only: missing in the store" in " ".join(said)
    jumped = SHORT.sent + 5000 / SHORT.prf * (np.arange(n) >= 40)
    history, said = ingested(write_nisar(tmp_path / "b.h5", SHORT, UTCtime=jumped), tmp_path / "b")
    assert "pulses 0 .. 39, 40 of 64, are taken" in " ".join(said) and history.collection.n_pulse == 40
    halved = SHORT.sent + 5000 / SHORT.prf * (np.arange(n) >= 20) + 5000 / SHORT.prf * (np.arange(n) >= 40)
    with pytest.raises(blocksar.InputError, match="leaves 24 of 64 pulses, less than half; take the part between"):
        ingested(write_nisar(tmp_path / "c.h5", SHORT, UTCtime=halved), tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_what_is_said_of_delay_and_chirp(tmp_path: Path) -> None:
    late = 0.4e-6
    slant = SHORT.first_range + np.arange(640) * 299792458.0 / 2 / SHORT.sampling_rate
    plain, _ = ingested(write_nisar(tmp_path / "a.h5", SHORT), tmp_path / "a")
    delayed = write_nisar(tmp_path / "b.h5", SHORT, slantRange=slant + late * 299792458.0 / 2)
    right, said = ingested(delayed, tmp_path / "b", range_delay=late)
    assert plain.raw is not None and right.raw is not None
    np.testing.assert_allclose(right.raw.fast_time, plain.raw.fast_time, atol=1e-15)
    assert right.attrs["source"]["range_delay_removed"] == late and "is taken out (--range-delay)" in " ".join(said)
    for value in ("x", 1.0, np.nan):
        with pytest.raises(blocksar.InputError, match=r"range_delay is .*; give the seconds, there and back"):
            ingested(delayed, tmp_path / "c", range_delay=value)
    magnitude = write_palsar(tmp_path / "d", SHORT, b76=abs(SHORT.chirp_rate) / 1e6)
    palsar, said = ingested(magnitude, tmp_path / "e")
    assert palsar.raw is not None and palsar.raw.chirp_rate == -4e12 and "has the other sign" not in " ".join(said)
    wrong, said = ingested(magnitude, tmp_path / "f", chirp_sign="up")
    assert wrong.raw is not None and wrong.raw.chirp_rate == 4e12
    assert "ingest again with --chirp-sign down" in " ".join(said)
    with pytest.raises(blocksar.InputError, match="chirp_sign is 'left'; it must be up or down"):
        ingested(magnitude, tmp_path / "g", chirp_sign="left")


def test_what_is_said_of_delay_and_chirp_on_the_command_line(tmp_path: Path) -> None:
    """Of other raw echoes as well: `test_sentinel1` has that of its packets."""
    source = write_crsd(tmp_path / "a.crsd", SHORT)
    plain, _ = ingested(source, tmp_path / "plain.zarr")
    words = ["ingest", "crsd", str(source), "--out", str(tmp_path / "b.zarr"), "--range-delay", "4e-7", "--chirp-sign"]
    assert CliRunner().invoke(app, [*words, "up"]).exit_code == 0
    moved = stores.open_phase_history(tmp_path / "b.zarr")
    assert plain.raw is not None and moved.raw is not None
    np.testing.assert_allclose(moved.raw.fast_time, plain.raw.fast_time - 4e-7, atol=1e-15)
    assert moved.raw.chirp_rate == abs(SHORT.chirp_rate) and plain.raw.chirp_rate == SHORT.chirp_rate
    source_of = moved.attrs["source"]
    assert source_of["range_delay_removed"] == 4e-7 and source_of["chirp_sign"] == "up"


def test_replica_and_phases_of_pulses(tmp_path: Path) -> None:
    length = round(SHORT.pulse_width * SHORT.sampling_rate)
    u = (np.arange(length) - (length - 1) / 2) / SHORT.sampling_rate
    replica = np.exp(1j * np.pi * SHORT.chirp_rate * u**2).astype(np.complex64)
    source = write_nisar(tmp_path / "a.h5", SHORT, chirpWaveform=replica, chirpSlope=2 * SHORT.chirp_rate)
    turns = np.exp(2j * np.pi * np.arange(64) / 7).astype(np.complex64)
    with h5py.File(source, "r+") as file:
        file["science/LSAR/RRSD/swaths/frequencyA/txH/rxH"]["basebandPhaseCorrection"] = turns
    found, said = ingested(source, tmp_path / "a")
    plain, _ = ingested(write_nisar(tmp_path / "b.h5", SHORT), tmp_path / "b")
    assert found.raw is not None and plain.raw is not None
    assert found.raw.chirp_rate == pytest.approx(SHORT.chirp_rate, rel=1e-4) and "and is taken" in " ".join(said)
    np.testing.assert_allclose(found.raw.fast_time - plain.raw.fast_time, 0.5 / SHORT.sampling_rate, atol=1e-12)
    both = [each.read(slice(None), slice(None)) for each in (found, plain)]
    np.testing.assert_allclose(both[0], both[1] * turns[:, None], atol=1e-5)


def test_counters_of_lines_are_finer_than_their_milliseconds(tmp_path: Path) -> None:
    received = SHORT.sent + 2 * SHORT.first_range / 299792458.0
    counter = np.rint(received % 1 * 1e6).astype(np.int64) % 1_000_000 << 8
    for name, rounded in (("a", np.floor), ("b", np.rint)):
        source = write_palsar(tmp_path / name, SHORT, b44=rounded(1000 * received), b296=counter)
        history, said = ingested(source, tmp_path / f"{name}.zarr")
        frame = Georeference.among(history.attrs)
        assert frame is not None and "their counters of microseconds" in " ".join(said)
        middle = SHORT.earth_centred(SHORT.sent + SHORT.slant_range / 299792458.0)
        assert np.abs(frame.to_ecef(history.collection.antenna_position) - middle).max() < 0.02


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def without_leader(folder: Path) -> None:
    next(folder.glob("LED*")).unlink()


def another_mission(folder: Path) -> None:
    leader = next(folder.glob("LED*"))
    leader.write_bytes(leader.read_bytes().replace(b"ALOS    ", b"ERS1    ", 1))


def no_wavelength(folder: Path) -> None:
    leader = next(folder.glob("LED*"))
    data = bytearray(leader.read_bytes())
    data[720 + 500 : 720 + 516] = b"none".ljust(16)
    leader.write_bytes(data)


WRONG: dict[str, tuple[Any, Any, str]] = {
    "cut": (write_nisar, cut, "is damaged, or no level 0B of NISAR's layout"),
    "cut image": (
        write_palsar,
        lambda folder: cut(next(folder.glob("IMG*"))),
        r"^\S+/IMG-\S+ has \S+ lines of .*, but should have 64; get it again",
    ),
    "cut leader": (
        write_palsar,
        lambda folder: cut(next(folder.glob("LED*"))),
        r"^\S+/LED-\S+ ends after .*within a record of 8192",
    ),
    "no leader": (write_palsar, without_leader, "0 leaders .* are there; give the files of one scene"),
    "another mission": (write_palsar, another_mission, "is of the mission 'ERS1'; only level 1.0 of ALOS PALSAR"),
    "no wavelength": (write_palsar, no_wavelength, "the leader's wavelength is 'none', no number"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    write, change, sentence = WRONG[name]
    source = write(tmp_path / "source", SHORT)
    change(source)
    for kind in (None, write.__name__.removeprefix("write_")):
        with pytest.raises(blocksar.InputError, match=sentence) as refusal:
            blocksar.ingest(kind, source, tmp_path / "out", progress=False)
        assert "\n" not in str(refusal.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"chirpSlope": None}, "is damaged, or no level 0B"),
        ({"UTCtime": SHORT.sent + 500}, "the orbit's states cover"),
        ({"slantRange": np.arange(10.0)}, "samples are .*, but UTCtime and slantRange of other lengths"),
        ({"validSamplesSubSwath1": np.array([[0, 200]] * 32 + [[400, 640]] * 32)}, "0 samples in common"),
    ],
)
def test_wrong_fields_are_refused_in_a_sentence(changes: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    source = write_nisar(tmp_path / "source.h5", SHORT, **changes)
    with pytest.raises(blocksar.InputError, match=sentence):
        blocksar.ingest("nisar", source, tmp_path / "out", progress=False)


def test_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    source = write_nisar(tmp_path / "source.h5", SHORT)
    for options, sentence in (
        ({"polarization": "VV"}, "polarization is VV, but the file has HH; give one of these"),
        ({"polarization": "X"}, "polarization is 'X'; give those of transmitter and receiver"),
        ({"frequency": "B"}, "frequency is B, but the file has A; give one of these"),
        ({"time_tags": "now"}, "time_tags is 'now'; it must be transmit or receive or middle"),
        ({"pulses": "60:"}, "4 pulses with finite times left"),
    ):
        with pytest.raises(blocksar.InputError, match=sentence):
            blocksar.ingest(None, source, tmp_path / "out", progress=False, **options)


@pytest.mark.parametrize("write", [write_crsd, write_nisar, write_palsar])
def test_info_describes_a_file(write: Any, tmp_path: Path) -> None:
    source = write(tmp_path / "source", SHORT)
    found = blocksar.info(source).result
    assert found["kind"] in ("CRSD file", "NISAR raw echo", "PALSAR raw echo") and found["facts"]["samples"].startswith(
        "64 pulses x 640"
    )
    command = found["next"][0]
    assert command[:2] == ["ingest", write.__name__.removeprefix("write_")]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"FxRate": np.linspace(-4e12, -3e12, 64)}, "PPP FxRate is .*; only equal pulses are read"),
        ({"FICRate": -4e12}, "mixed with a chirp"),
        ({"RcvStart": SHORT.sent - SHORT.start + 2 * SHORT.first_range / 299792458.0 + 1e-6 * (np.arange(64) > 9)},
         "receive windows move by 48 samples"),
        ({"RcvPos": SHORT.earth_centred(SHORT.sent) + np.array([20e3, 0, 0])}, "this is bistatic"),
    ],
)  # fmt: skip
def test_crsd_that_is_not_supported_is_refused_in_a_sentence(
    changes: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    source = write_crsd(tmp_path / "source.crsd", SHORT, **changes)
    with pytest.raises(blocksar.InputError, match=sentence):
        blocksar.ingest(None, source, tmp_path / "out", progress=False)
    assert not (tmp_path / "out").exists()


def test_vectors_of_crsd_without_signal_are_missing(tmp_path: Path) -> None:
    source = write_crsd(tmp_path / "source.crsd", SHORT, SIGNAL=np.where(np.arange(64) == 7, 0, 1))
    history, said = ingested(source, tmp_path / "out")
    echo = history.read(slice(None), slice(None))
    assert np.flatnonzero(np.isnan(echo).all(axis=1)).tolist() == [
        7
    ] and "1 of 64 vectors without a normal" in " ".join(said)
    assert history.attrs["polarization"] == {"transmit": "V", "receive": "H"}
    assert history.attrs["georeference"]["rotation_deg"] == 0 and history.attrs["surface"] == "ellipsoid"
    few = write_crsd(tmp_path / "few.crsd", SHORT, SIGNAL=np.arange(64) < 31)
    with pytest.raises(blocksar.InputError, match="no normal signal, which leaves 31 of 64 pulses, less than half"):
        blocksar.ingest(None, few, tmp_path / "few", progress=False)
    cut(source)
    with pytest.raises(blocksar.InputError, match=r"ends before its samples do; get it again"):
        blocksar.ingest(None, source, tmp_path / "cut", progress=False)
