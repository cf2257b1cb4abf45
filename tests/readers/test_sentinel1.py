"""Sentinel-1 level 0: simulated bursts of IW1 from packets to places, and what is wrong, lost or changes in packets."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sentinel1_packets as s1
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.application.pulses import pulse_reader
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.cli.commands import app
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.processors.exact.sums import form_chips
from blocksar.readers import orbit
from blocksar.readers.sentinel1 import ancillary
from blocksar.readers.sentinel1.calibration import pulse_delay
from blocksar.readers.sentinel1.histories import ColumnResampling
from blocksar.readers.sentinel1.packets import read_headers, read_samples
from blocksar.readers.terrain_earth import ellipsoid

# Zero-Doppler time off the middle burst's, s, and range off the swath's middle, m. Two bursts see three of them: beams
# look ahead by the lean of the antenna's axis.
PLACES = [
    (-1.5, 0.0), (-1.15, 1000.0), (-0.637, 900.0), (-0.637, -900.0), (-0.3, -1200.0), (0.0, 0.0), (0.25, 700.0),
    (0.513, -300.0), (0.9, 500.0), (1.4, -1000.0),
]  # fmt: skip
AMPLITUDE = 90.0
HALF, STEP = 80.0, 1.0  # m: half length of a cut, and its spacing


@pytest.fixture(scope="module")
def packets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    targets = [s1.place_on_the_ellipsoid(10.0 + time, s1.MIDDLE + off) for time, off in PLACES]
    return s1.write_bursts(tmp_path_factory.mktemp("packets") / "s1a-iw-raw.dat", targets, amplitude=AMPLITUDE)


@pytest.fixture(scope="module")
def store(packets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bursts") / "iw1.zarr"
    report = blocksar.ingest(None, packets, out)
    said = " ".join(report.summary)
    assert "IW1 VV: 3 bursts of up to 700 pulses at 1717.13 Hz" in said and "9 pulses in the air" in said
    assert "broadside at beam address 512" in said
    assert "from the body to inertial axes (J2000): the antenna lies up to 0.029 degrees off" in said
    assert "nominal chirp" in said and "lie 0.07 m off along the track" in said
    return out


def cut(read: Any, geometry: Geometry, x: FloatArray, y: FloatArray) -> ComplexArray:
    """Exact image along a line."""
    return np.asarray(form_chips(read, geometry, [(x, y)], threads=2)[0]).ravel()


def side_lobes(line: ComplexArray) -> float:
    """Ratio of the highest side lobe to the peak, dB."""
    power = np.abs(line)
    peak = int(power.argmax())
    left = peak - int(np.argmax(np.diff(power[peak::-1]) > 0))
    right = peak + int(np.argmax(np.diff(power[peak:]) > 0))
    return float(20 * np.log10(max(power[:left].max(), power[right + 1 :].max()) / power[peak]))


def peak_of(line: ComplexArray) -> float:
    """Place of the peak off the middle, m."""
    power = np.abs(line)
    i = int(power.argmax())
    low, middle, high = power[i - 1 : i + 2]
    return STEP * (i - line.size // 2 + (low - high) / (2 * (low - 2 * middle + high)))


def test_ten_targets_of_three_bursts_lie_where_they_are(store: Path) -> None:
    """On the ellipsoid, alike in amplitude and phase, and the same in two bursts that see them."""
    seen: dict[int, list[complex]] = {}
    axis = np.arange(-HALF, HALF + STEP / 2, STEP)
    for burst in stores.collections_in(store):
        history = stores.open_phase_history(burst)
        frame = Georeference.among(history.attrs)
        assert frame is not None and frame.rotation == pytest.approx(11.1, abs=0.1)
        places = frame.from_ecef(
            np.array([s1.place_on_the_ellipsoid(10.0 + time, s1.MIDDLE + off) for time, off in PLACES])
        )
        ground = ellipsoid(frame, 0.0, (-6e3, 6e3), (-15e3, 15e3))
        geometry = over_terrain(history.collection.centred(), ground)
        first, last = geometry.beam.longest_pass(places[:, 0], places[:, 1])
        full = np.flatnonzero((first > 0) & (last < history.collection.n_pulse))
        read = pulse_reader(history)
        for number in full:
            x, y = places[number, :2]
            across = cut(read, geometry, x + axis, np.array([y]))
            seen.setdefault(int(number), []).append(complex(across[axis.size // 2]))
            assert abs(peak_of(across)) < 0.05
            if number % 3 == 0:  # of some, since cuts take their time
                along = cut(read, geometry, np.array([x]), y + axis)
                assert abs(peak_of(along)) < 0.08  # the orbit's last 0.4 s are carried on, by a flattened Earth
                assert side_lobes(across) == pytest.approx(-13.26, abs=0.1)
                assert side_lobes(along) == pytest.approx(-19.24, abs=0.4)  # of sinc^2 out to half of its nulls
    assert sorted(seen) == list(range(len(PLACES)))
    assert [len(seen[number]) for number in (2, 3, 7)] == [2, 2, 2]
    for values in seen.values():
        assert abs(20 * np.log10(abs(values[0] / values[-1]))) < 0.02
        assert abs(np.angle(values[0] / values[-1])) < 0.01
    values = np.array([value[0] for value in seen.values()])
    np.testing.assert_allclose(np.abs(values), AMPLITUDE, rtol=0.005)
    assert np.abs(np.angle(values / values.mean())).max() < 0.02


TX, RX, EPDN, TA, APDN = 8, 9, 10, 11, 12
EVERY_PULSE = {TX: 0.39e-6, RX: 0.36e-6, EPDN: 0.34e-6, TA: 0.33e-6, APDN: 0.32e-6}  # 0.42 us
# Where the orbit is and its node, degrees; how far the burst begins before the first state, s; calibration pulses;
# the delay that they tell, s; and lost pulses.
PASSES: dict[str, tuple[float, float, float | None, dict[int, float], float, tuple[int, ...]]] = {
    "south, date line, descending": (215.0, 3.5, 1e-6, {TX: 0.4e-6}, 0.4e-6, (100, 101, 444)),
    "south, ascending": (325.0, 100.0, 1e-4, EVERY_PULSE, 0.42e-6, (0, 1, 698, 699)),
    "far north": (80.0, 250.0, 1e-2, {TX: 0.43e-6, RX: 0.41e-6, EPDN: 0.4e-6}, 0.44e-6, ()),
}
IN_BURST = [(-0.3, -1200.0), (-0.25, 700.0), (-0.2, 0.0), (-0.1, 1100.0), (-0.05, -500.0), (0.0, 300.0), (0.1, -900.0),
            (0.15, 900.0), (0.25, -100.0), (0.3, 500.0)]  # fmt: skip


@pytest.mark.parametrize("where", PASSES)
def test_ten_targets_of_two_receivers_lie_where_they_are(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within 0.05 m, whatever the pass, the instrument's delay, the lost pulses and the first state are."""
    latitude, node, before, calibration, internal, lost = PASSES[where]
    monkeypatch.setattr(s1, "LATITUDE", latitude)
    monkeypatch.setattr(s1, "NODE", node)
    ground = np.array([s1.place_on_the_ellipsoid(10.0 + time, s1.MIDDLE + off) for time, off in IN_BURST])
    (folder := tmp_path / "S1A_IW_RAW__0SDV_20200615.SAFE").mkdir()
    for name, receiver, later, gone in (("vv", 0, 0.0, lost), ("vh", 1, 5.3e-9, (300,))):
        s1.write_bursts(
            folder / f"s1a-iw-raw-s-{name}.dat", list(ground), bursts=1, amplitude=AMPLITUDE / (1 + receiver),
            receiver=receiver, internal=internal + later, before=before, lost=gone,
            calibration={kind: delay + later for kind, delay in calibration.items()},
        )  # fmt: skip
    report = blocksar.ingest(None, folder, tmp_path / "x.zarr")
    said = " ".join(report.summary)
    assert f"IW1 VV: the instrument's internal delay of {1e9 * internal:.4g} ns" in said and "IW1 VH: the inst" in said
    assert ("receive chain's own share" in said) == (len(calibration) == 1)
    history = stores.open_phase_history(tmp_path / "x.zarr")
    assert history.channels == ("VV", "VH") and history.attrs["polarizations"]["VH"] == {
        "transmit": "V",
        "receive": "H",
    }
    frame = Georeference.among(history.attrs)
    assert frame is not None
    places = frame.from_ecef(ground)
    geometry = over_terrain(history.collection.centred(), ellipsoid(frame, 0.0, (-4e3, 4e3), (-4e3, 4e3)))
    axis = np.arange(-HALF, HALF + STEP / 2, STEP)
    chips = [chip for x, y, _ in places for chip in ((x + axis, np.array([y])), (np.array([x]), y + axis))]
    for channel, amplitude in (("VV", AMPLITUDE), ("VH", AMPLITUDE / 2)):
        one = history.of_channel(channel)
        cuts = [np.asarray(each).ravel() for each in form_chips(pulse_reader(one), geometry, chips, threads=2)]
        for across, along in zip(cuts[::2], cuts[1::2], strict=True):
            assert np.hypot(peak_of(across), peak_of(along)) < 0.05
            assert side_lobes(across) == pytest.approx(-13.26, abs=0.2)
            assert side_lobes(along) == pytest.approx(-19.24, abs=0.5)
        values = np.array([cut[axis.size // 2] for cut in cuts[::2]])
        np.testing.assert_allclose(np.abs(values), amplitude, rtol=0.01)
        assert np.abs(np.angle(values / values.mean())).max() < 0.05


def test_what_is_said_of_delay_and_chirp_is_taken(packets: Path, store: Path, tmp_path: Path) -> None:
    words = ["ingest", "sentinel1", str(packets), "--out", str(tmp_path / "b.zarr"), "--bursts", "0:1"]
    assert CliRunner().invoke(app, [*words, "--range-delay", "4e-7", "--chirp-sign", "down"]).exit_code == 0
    moved, plain = (
        stores.open_phase_history(tmp_path / "b.zarr"),
        stores.open_phase_history(stores.collections_in(store)[0]),
    )
    assert moved.raw is not None and plain.raw is not None
    np.testing.assert_allclose(moved.raw.fast_time, plain.raw.fast_time - 4e-7, atol=1e-12)
    assert moved.raw.chirp_rate == -plain.raw.chirp_rate < 0
    assert moved.attrs["source"]["range_delay_removed"] == 4e-7 and moved.attrs["source"]["chirp_sign"] == "down"


@pytest.mark.slow
def test_two_swaths_of_a_file_see_a_place_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """IW2 farther off, with another PRF and rate of the steering, and one pulse more in the air."""
    target = s1.place_on_the_ellipsoid(10.0, s1.MIDDLE + 1300.0)
    first = s1.write_bursts(tmp_path / "a.dat", [target], bursts=1).read_bytes()
    middle = s1.MIDDLE + 2611.0  # other than by whole wavelengths, as windows are rounded
    delay = 2 * middle / SPEED_OF_LIGHT + s1.T / 2 - (2 * s1.QUADS - 1) / 2 / s1.SAMPLE_RATE
    pri, rank = 20000 / s1.CLOCK, 10
    window = round((delay - rank * pri) * s1.CLOCK) - 40
    for name, value in {
        "INTERVAL": 20000, "PRI": pri, "RANK": rank, "WINDOW": window, "RATE": np.radians(0.979863325),
        "DELAY": rank * pri + (window + 40) / s1.CLOCK, "MIDDLE": middle,
    }.items():  # fmt: skip
        monkeypatch.setattr(s1, name, value)
    second = s1.write_bursts(tmp_path / "b.dat", [target], bursts=1, about=10.05, swath=11).read_bytes()
    (tmp_path / "both.dat").write_bytes(first + second)
    blocksar.ingest("sentinel1", tmp_path / "both.dat", tmp_path / "both.zarr")
    places, seen = stores.collections_in(tmp_path / "both.zarr"), []
    assert [place.name for place in places] == ["IW1-VV-000", "IW2-VV-000"]
    for place in places:
        history = stores.open_phase_history(place)
        frame = Georeference.among(history.attrs)
        assert frame is not None
        x, y, _ = frame.from_ecef(target)
        geometry = over_terrain(
            history.collection.centred(), ellipsoid(frame, 0.0, (x - 1e3, x + 1e3), (y - 1e3, y + 1e3))
        )
        seen.append(complex(cut(pulse_reader(history), geometry, np.array([x]), np.array([y]))[0]))
    assert np.abs(seen) == pytest.approx(AMPLITUDE, rel=0.005)
    # States are carried on for 0.3 s by a flattened Earth, which the truth lacks: 0.4 mm.
    assert abs(np.angle(seen[1] / seen[0])) < 0.08


def test_a_burst_says_what_it_is(store: Path, packets: Path, tmp_path: Path) -> None:
    places = stores.collections_in(store)
    assert [place.name for place in places] == ["IW1-VV-000", "IW1-VV-001", "IW1-VV-002"]
    history = stores.open_phase_history(places[1])
    assert history.attrs["polarization"] == {"transmit": "V", "receive": "V"}
    assert history.attrs["surface"] == "ellipsoid" and history.collection.side_of_track == "right"
    source = history.attrs["source"]
    assert source["swath"] == "IW1" and source["replica"] == "nominal chirp of the headers"
    start = np.datetime64(source["collection_start"].removesuffix("Z")) - np.datetime64("1980-01-06")
    middle = start / np.timedelta64(1, "us") * 1e-6 + 18 + source["time_zero"]
    assert middle == pytest.approx(s1.ZERO + 10.0, abs=5e-4)  # half a PRI, and half a pulse
    steering = history.collection.beam_steering
    assert steering is not None
    assert np.ptp(steering) == pytest.approx(s1.RATE * 699 * s1.PRI, rel=1e-6)
    assert abs(steering.mean()) < 0.02 * s1.LENGTH**-1 * 0.0555  # of the beam's width
    assert blocksar.info(store).result["next"][0] == ["plan", str(store)]
    assert "3 bursts of up to 700 pulses" in blocksar.info(packets).result["facts"]["IW1 VV"]
    one = blocksar.ingest("sentinel1", packets, tmp_path / "one.zarr", bursts="2:", troposphere="standard").result
    assert (
        one.title == "Sentinel-1 IW1 VV, burst 2" and stores.open_phase_history(tmp_path / "one.zarr").raw is not None
    )
    assert s1.MIDDLE - one.reference_range[0] == pytest.approx(2.8, abs=0.1)  # m, of the standard atmosphere


def test_a_safe_folder_is_ingested_and_named_elsewhere(packets: Path, tmp_path: Path) -> None:
    (folder := tmp_path / "S1A_IW_RAW__0SDV_20200615.SAFE").mkdir()
    (folder / "manifest.safe").write_text("<xfdu:XFDU/>")
    for name in ("annot", "index"):
        (folder / f"s1a-iw-raw-s-vv-{name}.dat").write_bytes(bytes(range(256)))
    (folder / "s1a-iw-raw-s-vv.dat").symlink_to(packets)
    blocksar.ingest(None, folder, tmp_path / "x.zarr", bursts="0:1")
    assert "3 bursts of up to 700 pulses" in blocksar.info(folder).result["facts"]["IW1 VV"]
    with pytest.raises(InputError, match=r"s1a-iw-raw-s-vv\.dat is a file of Sentinel-1 level 0 packets; turn it into"):
        blocksar.plan(folder)


def test_several_in_one_store_are_named_where_one_is_needed(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds 3 phase histories, and one is needed here; give one of them, such as"):
        blocksar.check(store)
    with pytest.raises(InputError, match="exists"):
        stores.create_collections(store, {}, origin="x", overwrite=False, fill=lambda place: None)
    odd = {"../a": stores.Group({}, {}, {}, {})}
    stores.create_collections(tmp_path / "odd.zarr", odd, origin="x", overwrite=False, fill=lambda place: None)
    with pytest.raises(InputError, match="attribute collections that is no list of names; correct it"):
        blocksar.plan(tmp_path / "odd.zarr")


@pytest.mark.slow
def test_a_burst_whose_beginning_is_lost_keeps_its_part_of_the_steering(
    packets: Path, store: Path, tmp_path: Path
) -> None:
    with packets.open("rb") as file:
        headers = read_headers(file)
    data = packets.read_bytes()
    gone = np.concatenate([np.arange(1, 250), np.arange(400, 408)])  # packet 0 is of calibration
    kept = np.setdiff1d(np.arange(len(headers)), gone)
    (cut_file := tmp_path / "cut.dat").write_bytes(
        b"".join(data[headers.offset[i] : headers.offset[i] + headers.size[i]] for i in kept)
    )
    report = blocksar.ingest("sentinel1", cut_file, tmp_path / "cut.zarr")
    assert "8 lost pulses missing" in " ".join(report.summary)
    whole, part = (
        stores.open_phase_history(each[0]) for each in map(stores.collections_in, (store, tmp_path / "cut.zarr"))
    )
    assert part.shape[0] == 700 - 249
    np.testing.assert_allclose(part.collection.beam_steering, whole.collection.beam_steering[249:], atol=3e-6)  # type: ignore[index]
    samples = part.read(slice(None), slice(None))
    missing = np.flatnonzero(np.isnan(samples[:, 0]))
    np.testing.assert_array_equal(missing, np.arange(400, 408) - 250)
    np.testing.assert_allclose(samples[60], whole.read(slice(309, 310), slice(None))[0], atol=0.05)


def written(path: Path, change: Callable[[int], dict[str, int]], *, pulses: int = 160, fill: bool = True) -> Path:
    """A burst with an even echo at one delay, whose codes change from pulse to pulse."""
    writer = s1.Writer()
    for i in range(pulses):
        codes = {"rank": s1.RANK, "window": s1.WINDOW, "quads": s1.QUADS, "azimuth": 400 + i, **change(i)}
        first = codes["rank"] * s1.PRI + (codes["window"] + 40) / s1.CLOCK
        delay = first - s1.DELAY + np.arange(2 * codes["quads"]) / s1.SAMPLE_RATE
        echo = 200 * np.exp(-(((delay - 15e-6) / 0.2e-6) ** 2)) + 0j
        received = 1.0 + (9000 + i + codes["rank"]) * s1.PRI
        lost = codes.pop("lost", 0)
        if not lost:
            writer.add(received, 9000 + i + codes["rank"], s1.bypass_rows(echo[None])[0], **codes)
    path.write_bytes(b"".join(writer.out))
    return path


def test_receive_windows_and_ranks_may_change_within_a_burst(tmp_path: Path) -> None:
    def change(i: int) -> dict[str, int]:
        """Later by 45 codes, 30 samples, from pulse 50 on; with one pulse less in the air from pulse 100 on."""
        window = s1.WINDOW + 45 if i >= 50 else s1.WINDOW
        return {"window": window + s1.INTERVAL, "rank": s1.RANK - 1} if i >= 100 else {"window": window}

    report = blocksar.ingest(
        "sentinel1", written(tmp_path / "x.dat", change), tmp_path / "x.zarr", time_tags="middle"
    )  # fmt: skip
    assert "receive windows change within 1 of IW1's bursts" in " ".join(report.summary)
    samples = stores.open_phase_history(tmp_path / "x.zarr").read(slice(None), slice(None))
    assert samples.shape == (160, 890)
    np.testing.assert_allclose(samples, np.broadcast_to(samples[:1], samples.shape), atol=1.5)  # of 200, rounded


def test_swaths_and_scans_divide_bursts_and_a_stripmap_is_one(tmp_path: Path) -> None:
    def change(i: int) -> dict[str, int]:
        """IW1, IW2, and IW1 again, whose beams begin anew."""
        return {"swath": (10, 11, 10, 10)[i // 40], "azimuth": 480 + i % 40, "lost": i in (5, 6)}

    path = written(tmp_path / "iw.dat", change)
    said = " ".join(blocksar.ingest("sentinel1", path, tmp_path / "iw.zarr").summary)
    assert "IW1 VV: 3 bursts of up to 40 pulses" in said and "2 lost pulses" in said and "IW2 VV: 1 burst of" in said
    names = [each.name for each in stores.collections_in(tmp_path / "iw.zarr")]
    assert names == ["IW1-VV-000", "IW2-VV-000", "IW1-VV-001", "IW1-VV-002"]
    path = written(tmp_path / "s3.dat", lambda i: {"swath": 2, "azimuth": 0, "polarization": 2, "receiver": 0})
    report = blocksar.ingest("sentinel1", path, tmp_path / "s3.zarr")
    assert "S3 HV: 1 burst of up to 160 pulses" in report.summary[0] and "not steered" in report.summary[0]
    assert not report.result.beam_steering.any()


WRONG = {
    "cut": (lambda data: data[: len(data) // 2 + 700], {}, r"x\.dat: it ends at byte \d+, within packet \d+"),
    "cut in a header": (lambda data: data + data[:40], {}, r"it ends within the headers of packet 160, at byte"),
    "shifted": (lambda data: data[:5000] + data[5001:], {}, r"at byte \d+ there is no packet \(number \d+\)"),
    "no such swath": (lambda data: data, {"swath": "IW2"}, r"no burst is left .* have 1 of IW1, counted from 0"),
    "no such polarisation": (lambda data: data, {"polarization": "VH"}, r"polarization is VH, but the packets have VV"),
    "no bursts": (lambda data: data, {"bursts": "5:"}, r"no burst is left by swath and bursts"),
    "no span": (lambda data: data, {"bursts": "b"}, r"bursts 'b' is not two .* as bursts"),
    "unknown swath": (lambda data: data, {"swath": "IW9"}, r"swath is 'IW9'; it must be S1 or"),
    "no orbit file": (lambda data: data, {"orbit": "none.EOF"}, r"none\.EOF does not exist; check the path"),
    "no orbit": (lambda data: data[: 20 * (len(data) // 160)], {}, r"no state of the orbit is in its \d+ packets, of"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_wrong_packets_and_options_are_told_in_a_sentence(what: str, tmp_path: Path) -> None:
    change, options, sentence = WRONG[what]
    path = written(tmp_path / "x.dat", lambda i: {})
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError, match=sentence):
        blocksar.ingest("sentinel1", path, tmp_path / "x.zarr", **options)
    assert not (tmp_path / "x.zarr").exists()


def test_a_precise_orbit_is_read(packets: Path, store: Path, tmp_path: Path) -> None:
    lines = []
    for second in range(-30, 51, 10):
        place, velocity = s1.state(float(second))
        moment = np.datetime64("1980-01-06") + np.timedelta64(s1.ZERO + second + 19, "s")  # TAI
        numbers = zip(("X", "Y", "Z", "VX", "VY", "VZ"), [*place, *velocity], strict=True)
        tags = "".join(f"<{name}>{value:.6f}</{name}>" for name, value in numbers)
        lines.append(f"<OSV><TAI>TAI={moment}.000000</TAI>{tags}</OSV>")
    text = f"<Earth_Explorer_File><List_of_OSVs>{''.join(lines)}</List_of_OSVs></Earth_Explorer_File>"
    (file := tmp_path / "S1A.EOF").write_text(text)
    one = blocksar.ingest("sentinel1", packets, tmp_path / "x.zarr", orbit=file, bursts="2:3").result
    frames = [
        Georeference.among(stores.open_phase_history(each).attrs)
        for each in (tmp_path / "x.zarr", stores.collections_in(store)[2])
    ]
    assert None not in frames
    other = stores.open_phase_history(stores.collections_in(store)[2]).collection
    apart = frames[0].to_ecef(one.antenna_position) - frames[1].to_ecef(other.antenna_position)  # type: ignore[union-attr]
    assert np.abs(apart).max() < 0.005  # the truth has no flattened Earth, by which states of packets are carried on
    (tmp_path / "odd.EOF").write_text("<a><OSV/></a>")
    with pytest.raises(InputError, match=r"odd\.EOF is no orbit file of Sentinel-1 \(EOF\)"):
        blocksar.ingest("sentinel1", packets, tmp_path / "y.zarr", orbit=tmp_path / "odd.EOF")


@pytest.mark.parametrize("frequency", [-600.0, 30.0, 600.0])  # Hz off the beam's centre, of 1717
def test_samples_are_resampled_to_the_moment_of_the_position(frequency: float) -> None:
    """Under a beam whose Doppler frequency passes through five PRFs; in pieces as at once."""
    time, late = s1.PRI * (np.arange(400) - 200), np.array([-90e-6, -20e-6, 0.0, 55e-6])

    def signal(moment: FloatArray) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * (500 * moment + 9e3 * moment**2 + frequency * moment)), np.complex64)

    resampling = ColumnResampling.of(500 + 18e3 * time, late, s1.PRI)
    received, wanted = signal(time[:, None] + late), signal(time[:, None] + 0 * late)
    received[390] = np.nan
    whole = resampling.apply(lambda pulses: received[pulses].copy(), slice(0, 400))
    parts = [resampling.apply(lambda pulses: received[pulses].copy(), slice(i, i + 100)) for i in range(0, 400, 100)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert np.isnan(whole[390]).all() and np.isnan(whole).any(axis=1).sum() == 1
    np.testing.assert_allclose(whole[10:370], wanted[10:370], atol=2e-3)  # -54 dB


def test_states_are_carried_on_as_gravity_has_it() -> None:
    """Against an integration in axes that do not turn."""
    place, velocity = s1.state(3.0)
    turn = np.array([0.0, 0.0, orbit.SPIN])

    def rates(_: float, y: FloatArray) -> FloatArray:
        r = float(np.linalg.norm(y[:3]))
        factor = 1.5 * orbit.OBLATENESS * (orbit.RADIUS / r) ** 2
        pull = 1 + factor * (np.array([1, 1, 3]) - 5 * (y[2] / r) ** 2)
        return np.concatenate([y[3:], -orbit.GRAVITY / r**3 * y[:3] * pull])

    start = np.concatenate([place, velocity + np.cross(turn, place)])
    for seconds in (-7.3, 0.4, 12.0):
        end = solve_ivp(rates, (0, seconds), start, rtol=1e-12, atol=1e-6).y[:, -1]
        c, s = np.cos(orbit.SPIN * seconds), np.sin(orbit.SPIN * seconds)
        expected = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ end[:3]
        found, _ = orbit.propagated(place, velocity, seconds)
        assert np.abs(found - expected).max() < 1e-4


@pytest.mark.parametrize("apart", [1e-6, 1e-4, 1e-2, 0.1, 1.0])  # s
@pytest.mark.parametrize("spacing", [1.0, 10.0])  # s
def test_times_just_outside_of_the_states_have_a_track(apart: float, spacing: float) -> None:
    """Of states as packets round them, 1 s apart, and of exact ones: within 1 mm and 1e-7 rad at both ends."""
    start, began = s1.state(3.0)
    time: FloatArray = 0.123456789 + spacing * np.arange(6)
    true = [orbit.propagated(start, began, float(each)) for each in time]
    place: FloatArray = np.array([each[0] for each in true])
    velocity: FloatArray = np.array([each[1] for each in true])
    if spacing == 1.0:
        time, velocity = np.floor(time * 2**24) / 2**24, velocity.astype(np.float32).astype(np.float64)
    first, last = float(time[0]) - apart, float(time[-1]) + apart
    track = orbit.States(time, place, velocity).reaching(first, last)
    asked: FloatArray = np.concatenate(
        [np.linspace(first, first + 2 * apart, 21), np.linspace(last - 2 * apart, last, 21)]
    )
    expected = [orbit.propagated(start, began, float(each)) for each in asked]
    found = track.at(asked)
    assert np.abs(found[0] - np.array([each[0] for each in expected])).max() < 1e-3
    assert np.abs(found[1] - np.array([each[1] for each in expected])).max() < 1e-7 * 7600
    alone = orbit.States(time[:1], place[:1], velocity[:1]).reaching(float(time[0]), float(time[0]) + 0.3)
    np.testing.assert_allclose(alone.at(time[:1])[0], place[:1], atol=1e-6)


def test_what_calibration_pulses_do_not_tell_is_told(packets: Path, tmp_path: Path) -> None:
    """Without pulses, with those of another file, and where noise is all that they have."""
    said = " ".join(blocksar.ingest("sentinel1", packets, tmp_path / "a.zarr", bursts="0:1").summary)
    assert "no calibration pulse in the packets tells the instrument's internal delay" in said
    assert re.search(r"433 ns \(64\.9 m of range, 1\d\d m on the ground\)", said) and "stays" in said
    alone = s1.Writer()
    for i in range(4):
        alone.add(
            float(i), 20 + i, s1.calibration_pulse(0.41e-6, -1.0), signal=8, calibration=1, quads=s1.CALIBRATION_QUADS
        )
    (other := tmp_path / "calibration.dat").write_bytes(b"".join(alone.out))
    both = blocksar.ingest("sentinel1", [packets, other], tmp_path / "b.zarr", bursts="0:1")
    assert "internal delay of 410 ns (61.5 m of range, 1" in " ".join(both.summary)
    assert "by 4 calibration pulses (tx); the receive chain's own share is not known" in " ".join(both.summary)
    first, moved = (stores.open_phase_history(tmp_path / name).raw for name in ("a.zarr", "b.zarr"))
    assert first is not None and moved is not None
    assert first.fast_time[0] - moved.fast_time[0] == pytest.approx(0.41e-6, abs=1e-10)  # 15 mm: the pulse is rounded
    with pytest.raises(InputError, match=r"holds 4 packets of noise or calibration and no echo; give those of echoes"):
        blocksar.ingest("sentinel1", other, tmp_path / "c.zarr")


def test_the_chirp_of_a_measured_calibration_pulse_is_found() -> None:
    """Of S1A in stripmap; by the slope of its phase over the band it is 439.04 ns."""
    if (folder := os.environ.get("BLOCKSAR_DATA")) is None:
        pytest.skip("BLOCKSAR_DATA does not say where measured packets of Sentinel-1 are")
    with (Path(folder) / "sentinel1" / "000008-txcal.dat").open("rb") as file:
        headers = read_headers(file)
        samples = read_samples(file, headers)[0]
    assert pulse_delay(samples, headers.radar) == pytest.approx(439.04e-9, abs=0.05e-9)
    assert pulse_delay(np.roll(samples, 200), headers.radar) is None  # 3 us later
    assert pulse_delay(np.random.default_rng(0).normal(size=3034) + 0j, headers.radar) is None


def test_a_file_of_both_receivers_is_as_two(tmp_path: Path) -> None:
    """And a burst that one of them lacks is left out with a note."""
    parts = [
        written(tmp_path / f"{i}.dat", lambda _, i=i: {"receiver": i, "azimuth": 0, "swath": 2}).read_bytes()  # type: ignore[misc]
        for i in (0, 1)
    ]
    (path := tmp_path / "both.dat").write_bytes(b"".join(parts))
    report = blocksar.ingest("sentinel1", path, tmp_path / "x.zarr")
    assert stores.open_phase_history(tmp_path / "x.zarr").channels == ("VV", "VH")
    assert "S3 VV, VH: 1 burst of up to 160 pulses" in report.summary[0]
    blocksar.ingest("sentinel1", path, tmp_path / "vh.zarr", polarization="VH")
    assert stores.open_phase_history(tmp_path / "vh.zarr").attrs["polarization"] == {"transmit": "V", "receive": "H"}
    path.write_bytes(parts[0] + parts[1][: len(parts[1]) // 160 * 10])
    with pytest.raises(InputError, match=r"no burst has its pulses in all of VV, VH; take one with polarization VV"):
        blocksar.ingest("sentinel1", path, tmp_path / "y.zarr")


def test_an_attitude_that_makes_no_sense_is_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s1, "quaternion", lambda time: np.array([1.0, 0.0, 0.0, 0.0]))
    report = blocksar.ingest("sentinel1", written(tmp_path / "x.dat", lambda i: {}), tmp_path / "x.zarr")
    assert "the antenna is taken to lie along the velocity over the Earth" in " ".join(report.summary)


def test_the_axis_of_the_attitude_is_found(packets: Path) -> None:
    with packets.open("rb") as file:
        headers = read_headers(file)
    zero = int(headers.seconds.min())
    orbit = ancillary.read_states(headers, zero).reaching(0.0, 4.0)
    attitude = ancillary.read_attitude(headers, zero, orbit)
    assert attitude is not None
    time = np.array([9.4, 10.6])
    axis = attitude.axis(time + s1.ZERO - zero, *s1.state(time))
    for found, moment in zip(axis, time, strict=True):
        assert np.arccos(found @ s1.frame(float(moment))[0]) < np.radians(
            0.002
        )  # of 0.03 that it lies off the velocity


@pytest.mark.slow
def test_bursts_become_one_mosaic_from_the_file_alone(store: Path, tmp_path: Path) -> None:
    """No grid, scene centre or track by hand; as sharp as it was predicted."""
    run = tmp_path / "run"
    blocksar.focus(store, run, surface="ellipsoid", workers=0)
    places = [s1.place_on_the_ellipsoid(10.0 + time, s1.MIDDLE + off) for time, off in PLACES]
    frame = Georeference.among(stores.open_phase_history(stores.collections_in(store)[0]).attrs)
    assert frame is not None
    targets = [
        {"name": f"P{i}", "x": x, "y": y, "z": z, "reflectivity": AMPLITUDE}
        for i, (x, y, z) in enumerate(frame.from_ecef(np.array(places)).tolist())
    ]
    found = blocksar.quality(run, targets=targets).result["targets"]
    inside = [target for target in found if target["covered"]]  # quality leaves seams alone, which see two bursts
    assert len(inside) >= 7 and all(target["full_dwell"] for target in found)
    for target in inside:
        assert np.hypot(target["error_x"], target["error_y"]) < 0.15
        for name in ("range", "azimuth"):
            assert target[f"{name}_pslr"] == pytest.approx(target[f"{name}_pslr_theory"], abs=0.2)
    image = blocksar.open(run)
    assert set(np.unique(image.collection.values)) == {-1, 0, 1, 2}
    values = np.array([complex(*target["value"]) for target in inside])
    np.testing.assert_allclose(np.abs(values), 1.0, rtol=0.01)
    assert np.abs(np.angle(values / values.mean())).max() < 0.05
    blocksar.export("geotiff", run, tmp_path / "bursts.tif")
