"""CPHD files: write from a scene, validate with the standard's checker, ingest; conventions against explicit sums."""

from __future__ import annotations

import copy
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cphd_files import (
    ORIGIN,
    SCENE,
    Array,
    Base,
    Parts,
    delays,
    echo,
    expected,
    failures,
    grid_of,
    ingest,
    ingested,
    parts_of,
    refused,
    vectors,
    without,
    write,
    xml,
)
from lxml import etree
from sarkit import cphd as skcphd
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.processors.exact.sums import form_image
from blocksar.readers.cphd import channel_parts, echoes, reader
from blocksar.readers.cphd.files import CphdFile, open_file
from blocksar.readers.cphd.frequency_grid import ACCURACY
from blocksar.simulation import cphd as cphd_simulation
from blocksar.simulation.scene import Scene

pytest.importorskip("sarkit", reason="the extra `formats` is not installed")

# ---------------------------------------------------------------- Files from a scene


@pytest.mark.slow
def test_the_checker_of_the_standard_reports_no_failure(base: Base) -> None:
    assert failures(base.path) == []


def test_the_checker_reports_a_fault(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    parts.set("Channel/Parameters/FxC", 9e9)
    assert any("fxc" in line for line in failures(write(tmp_path / "wrong.cphd", parts)))


def test_a_file_reads_back_as_it_was_written(base: Base) -> None:
    collection, samples, said, attrs = ingested(base.path)
    direct = base.scene.collection()
    np.testing.assert_allclose(collection.antenna_position + base.scene.centre, direct.antenna_position, atol=1e-6)
    np.testing.assert_allclose(collection.time, direct.time, atol=1e-12)
    assert collection.beam_width is None
    assert np.isnan(collection.beam_azimuth).all()
    np.testing.assert_allclose(
        collection.reference_range, np.linalg.norm(collection.antenna_position, axis=1), atol=1e-6
    )
    np.testing.assert_allclose(samples, expected(collection, base), atol=2e-5)
    assert any("lit all the time" in line for line in said)
    place = attrs["georeference"]
    assert (place["kind"], place["latitude"]) == ("ENU", pytest.approx(ORIGIN[0], abs=1e-9))
    assert (place["longitude"], place["height"]) == pytest.approx(ORIGIN[1:], abs=1e-6)
    assert attrs["source"]["format"] == "CPHD/1.1.0"
    assert (attrs["collector"], attrs["classification"]) == ("blocksar", "UNCLASSIFIED")
    assert "polarization" not in attrs  # point targets have none
    assert "ingested by blocksar from small.cphd" in attrs["history"]


def test_vectors_that_the_xml_does_not_count_are_told(base: Base, tmp_path: Path) -> None:
    assert not any("more such vectors" in line for line in ingested(shutil.copy(base.path, tmp_path / "whole.cphd"))[2])
    content = base.path.read_bytes()
    count = parts_of(base.path).samples.shape[0]
    short = f"<NumVectors>{count - 40:0{len(str(count))}d}</NumVectors>".encode()
    (tmp_path / "short.cphd").write_bytes(content.replace(f"<NumVectors>{count}</NumVectors>".encode(), short))
    assert any("room for 40 more such vectors" in line for line in ingested(tmp_path / "short.cphd")[2])


def test_the_collection_start_of_the_file_can_be_replaced(base: Base, tmp_path: Path) -> None:
    own = ingested(base.path)[3]["source"]
    history = blocksar.ingest("cphd", base.path, tmp_path / "ph.zarr", collection_start="2030-01-02 03:04:05")
    assert history.result.n_pulse == 160
    source = stores.open_phase_history(tmp_path / "ph.zarr").attrs["source"]
    assert source["collection_start"] == "2030-01-02T03:04:05.000000Z" != own["collection_start"]
    assert source["time_zero"] == own["time_zero"]


def test_positions_survive_conversion_to_the_earth_frame_and_back(base: Base) -> None:
    """Target places: latitude and longitude to ECEF by the textbook formula, compared with the peaks of the image."""
    collection, samples, _, attrs = ingested(base.path)
    a, e2 = 6378137.0, (2 - 1 / 298.257223563) / 298.257223563
    lat, lon = np.radians(ORIGIN[:2])
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    level = (n + ORIGIN[2]) * np.cos(lat)
    textbook = [level * np.cos(lon), level * np.sin(lon), (n * (1 - e2) + ORIGIN[2]) * np.sin(lat)]
    np.testing.assert_allclose(attrs["georeference"]["ecef"], textbook, atol=1e-6)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    np.testing.assert_allclose(attrs["georeference"]["up"], up, atol=1e-12)
    for target, sigma in zip(base.targets, base.sigma, strict=True):
        x, y = (target[axis] + np.linspace(-1, 1, 41) for axis in (0, 1))
        image = form_image(lambda pulses: samples[pulses], Geometry(collection=collection), x, y, threads=1)
        row, column = np.unravel_index(np.abs(image).argmax(), image.shape)
        assert np.hypot(x[column] - target[0], y[row] - target[1]) <= 0.05
        assert abs(image[20, 20] - sigma) < 0.05


def test_a_scene_that_was_used_before_gives_the_same_file(base: Base, tmp_path: Path) -> None:
    scene = Scene.parse(SCENE)
    assert np.ptp(scene.reference_range) == 0  # derived before: must not be reused
    assert scene.collection().n_pulse == 160
    parts = parts_of(cphd_simulation.simulate(scene, tmp_path / "a.cphd", origin=ORIGIN))
    np.testing.assert_array_equal(parts.samples, parts_of(base.path).samples)
    assert np.ptp(scene.reference_range) == 0


def test_a_scene_away_from_its_georeference_lies_level_at_its_centre(tmp_path: Path) -> None:
    placed = "\n[georeference]\nlatitude = 39.78\nlongitude = -84.1\nheight = 300.0\nrotation_deg = 20.0\n"
    scene = Scene.parse(SCENE + placed)
    assert scene.georeference is not None and np.hypot(*scene.centre[:2]) > 1e3
    path = tmp_path / "a.cphd"
    blocksar.simulate(scene, path, cphd=True, progress=False)
    vectors, collection = parts_of(path).vectors, scene.collection()
    np.testing.assert_allclose(vectors["SRPPos"], [scene.georeference.to_ecef(scene.centre)] * 160, rtol=0, atol=1e-6)
    away = np.linalg.norm(collection.antenna_position - scene.centre, axis=1)
    np.testing.assert_allclose(np.linalg.norm(vectors["TxPos"] - vectors["SRPPos"], axis=1), away, rtol=0, atol=1e-6)
    apart = np.linalg.norm(vectors["TxPos"] - scene.georeference.to_ecef(collection.antenna_position), axis=1).max()
    assert 0 < apart < np.hypot(*scene.centre[:2]) / 6.35e6 * away.max()
    assert f"its track up to {apart:.3g} m from where" in str(cphd_simulation.off_level(scene, None))
    assert cphd_simulation.off_level(scene, ORIGIN) is None
    blocksar.simulate(scene, path, cphd=True, origin=ORIGIN, overwrite=True, progress=False)
    there = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])
    np.testing.assert_allclose(parts_of(path).vectors["SRPPos"][0], there.origin, rtol=0, atol=1e-6)


def test_vectors_are_consistent(base: Base) -> None:
    v = parts_of(base.path).vectors
    assert (1 / (v["SCSS"] * (v["TOA2"] - v["TOA1"]))).min() >= 1.2
    rate = np.gradient(v["TxPos"], v["TxTime"], axis=0)
    np.testing.assert_allclose(v["TxVel"][1:-1], rate[1:-1], atol=1e-3)
    np.testing.assert_allclose(
        v["RcvTime"] - v["TxTime"], 2 * np.linalg.norm(v["TxPos"] - v["SRPPos"], axis=1) / 3e8, rtol=1e-3
    )
    assert v["TxTime"][0] == 0


# ---------------------------------------------------------------- Conventions, against the direct samples


def check(path: Path, base: Base, tolerance: float = 2e-5, inner: float = 1.0) -> tuple[Collection, list[str]]:
    """Ingest, and compare the inner part of the band with the definition."""
    collection, samples, said, _ = ingested(path)
    want = expected(collection, base)
    cut = round(samples.shape[1] * (1 - inner) / 2)
    part = slice(cut, samples.shape[1] - cut)
    assert np.abs(want).max() > 1
    np.testing.assert_allclose(samples[:, part], want[:, part], rtol=0, atol=tolerance)
    return collection, said


@pytest.mark.parametrize("sign", [-1, 1])
def test_sgn(base: Base, tmp_path: Path, sign: int) -> None:
    parts = parts_of(base.path)
    parts.set("Global/SGN", f"{sign:+d}")
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, sign)
    check(write(tmp_path / "sgn.cphd", parts), base)


@pytest.mark.parametrize("form", ["CI4", "CI2"])
def test_sample_formats_and_amplitude_factors(base: Base, tmp_path: Path, form: str) -> None:
    parts = parts_of(base.path)
    exact = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    factor = 0.5 + np.random.default_rng(1).random(len(exact))
    parts.set("Data/SignalArrayFormat", form)
    vectors = np.zeros(len(exact), [*parts.vectors.dtype.descr, ("AmpSF", "f8")])
    for name in parts.vectors.dtype.names or ():
        vectors[name] = parts.vectors[name]
    factor *= 4 / (2 ** {"CI4": 15, "CI2": 7}[form] - 1)
    integers = np.rint(exact / factor[:, None])
    samples = np.zeros(exact.shape, skcphd.binary_format_string_to_dtype(form))
    samples["real"], samples["imag"] = integers.real, integers.imag
    tolerance = 0.71 * factor.max() + 2e-5
    vectors["AmpSF"] = factor
    check(write(tmp_path / "form.cphd", Parts(parts.root, vectors, samples), {"AmpSF": "F8"}), base, tolerance)


def test_frequency_grids_that_differ(base: Base, tmp_path: Path) -> None:
    """SC0 and SCSS vary, so that no two vectors share a grid."""
    parts = parts_of(base.path)
    rng = np.random.default_rng(2)
    v, n = parts.vectors, parts.samples.shape[1]
    step = v["SCSS"][0]
    v["SCSS"] = step * (1 - 0.02 * rng.random(v.size))
    v["SC0"] += step * 5 * rng.random(v.size)
    v["FX1"], v["FX2"] = v["SC0"], v["SC0"] + (n - 1) * v["SCSS"]
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    path = write(tmp_path / "wandering.cphd", parts)
    bound = ACCURACY * np.abs(base.sigma).sum()
    collection, said = check(path, base, bound)
    assert any("resampled to one grid, error below" in line for line in said)
    assert collection.bandwidth > 0.85 * 100e6
    error = ingested(path)[3]["source"]["frequency_resampling_error"]
    assert 0 < error <= ACCURACY


def test_interpolation_does_not_use_samples_beyond_the_band(base: Base, tmp_path: Path) -> None:
    """A vector is valid in FX1 .. FX2: invalid samples on either side must not reach any frequency of the store."""
    parts = parts_of(base.path)
    v, n = parts.vectors, parts.samples.shape[1]
    v["SC0"] += v["SCSS"] * np.random.default_rng(6).random(v.size)
    v["FX1"], v["FX2"] = v["SC0"] + 3.2 * v["SCSS"], v["SC0"] + (n - 5.3) * v["SCSS"]
    fx = grid_of(parts)
    parts.samples[...] = echo(fx, delays(parts, base), base.sigma, -1)
    parts.samples[(fx < v["FX1"][:, None]) | (fx > v["FX2"][:, None])] = 50.0
    _, said = check(write(tmp_path / "guard.cphd", parts), base, ACCURACY * np.abs(base.sigma).sum())
    assert any("resampled to one grid" in line for line in said)


def test_the_interpolation_error_stays_below_its_bound(base: Base, tmp_path: Path) -> None:
    """One target at each end of the saved delays, where interpolation is worst: the reported error covers it."""
    parts = parts_of(base.path)
    v = parts.vectors
    v["SC0"] += v["SCSS"] * np.linspace(0, 1, v.size, endpoint=False)
    v["FX1"], v["FX2"] = v["SC0"], v["SC0"] + (parts.samples.shape[1] - 1) * v["SCSS"]
    for edge in ("TOA1", "TOA2"):
        v[edge] += 0.3 / v["SCSS"]  # the saved delays are not centred at the SRP
    worst = []
    for edge in ("TOA1", "TOA2"):
        parts.samples[...] = echo(grid_of(parts), v[edge][:, None], np.ones(1), -1)
        collection, samples, _, attrs = ingested(write(tmp_path / "edge.cphd", parts))
        middle = collection.reference_range - np.linalg.norm(collection.antenna_position, axis=1)
        away = v[edge] * SPEED_OF_LIGHT / 2 - middle
        fx = collection.carrier + collection.range_frequency
        want = np.exp(-4j * np.pi * fx / SPEED_OF_LIGHT * away[:, None])
        worst.append(np.abs(samples - want).max())
        assert worst[-1] <= attrs["source"]["frequency_resampling_error"] + 2e-5
    assert max(worst) > 1e-4  # large enough to test the bound


def test_grids_that_differ_by_whole_samples_are_not_interpolated(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    v, n = parts.vectors, parts.samples.shape[1]
    v["SC0"] += v["SCSS"] * np.random.default_rng(3).integers(0, 9, v.size)
    v["FX1"], v["FX2"] = v["SC0"], v["SC0"] + (n - 1) * v["SCSS"]
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    collection, said = check(write(tmp_path / "shifted.cphd", parts), base)
    assert collection.n_range_frequency == n - 8
    assert "samples are taken as they are" in said


def test_toa_domain_by_lines(base: Base, tmp_path: Path) -> None:
    """A TOA vector that is a sum of the lines of the band converts back exactly."""
    parts = parts_of(base.path)
    fx = grid_of(parts)
    for sign in (-1, 1):
        samples, v = lines_to_toa(parts, echo(fx, delays(parts, base), base.sigma, sign), sign, fx)
        parts.set("Global/DomainType", "TOA")
        parts.set("Global/SGN", f"{sign:+d}")
        path = write(tmp_path / f"toa{sign}.cphd", Parts(copy.deepcopy(parts.root), v, samples))
        collection, said = check(path, base, 1e-4)
        np.testing.assert_allclose(collection.carrier + collection.range_frequency, fx[0], rtol=0, atol=1e-2)
        assert any("TOA domain" in line for line in said)


def lines_to_toa(parts: Parts, spectrum: Array, sign: int, fx: Array) -> tuple[Array, Array]:
    """Time samples as a mean of lines exp(-2j pi sign (fx - fx_C) t), and their per-vector parameters."""
    v, n = parts.vectors.copy(), fx.shape[1]
    count = round(1.25 * n)
    step = 1 / (count * parts.vectors["SCSS"][0])
    v["FX1"], v["FX2"] = fx[:, 0] - v["SCSS"] / 2, fx[:, -1] + v["SCSS"] / 2
    v["SC0"], v["SCSS"] = -(count // 2) * step, step
    t = v["SC0"][0] + step * np.arange(count)
    middle = (v["FX1"] + v["FX2"]) / 2
    samples = spectrum @ np.exp(-2j * np.pi * sign * np.outer(fx[0] - middle[0], t)) / n
    return samples.astype(np.complex64), v


@pytest.mark.slow
def test_toa_domain_by_its_closed_form(base: Base, tmp_path: Path) -> None:
    """The standard's mainlobes, with SC0, SCSS and fx_C different for every vector; the window cuts side lobes off."""
    parts = parts_of(base.path)
    rng = np.random.default_rng(4)
    v, n = parts.vectors, 4000
    dtoa = delays(parts, base)
    v["SCSS"] = (1 - 0.05 * rng.random(v.size)) / 130e6
    v["SC0"] = -(n / 2) * v["SCSS"] + 1e-7 * rng.random(v.size)
    shift = 2e6 * rng.random(v.size)
    v["FX1"], v["FX2"] = 9.95e9 + shift, 10.05e9 + shift
    t = v["SC0"][:, None] + v["SCSS"][:, None] * np.arange(n)
    middle, band = (v["FX1"] + v["FX2"]) / 2, v["FX2"] - v["FX1"]
    samples = np.zeros((v.size, n), np.complex64)
    for sigma, late in zip(base.sigma, dtoa.T, strict=True):
        phase = np.exp(-2j * np.pi * middle * late)  # of the mainlobe
        samples += (sigma * phase)[:, None] * np.sinc(band[:, None] * (t - late[:, None]))
    parts.set("Global/DomainType", "TOA")
    collection, _ = check(write(tmp_path / "toa.cphd", Parts(parts.root, v, samples)), base, 0.02, inner=0.9)
    assert collection.bandwidth == pytest.approx(98e6, rel=0.01)


def test_a_moving_srp(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    v = parts.vectors
    frame = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])
    places = np.array([[0.0, 0, 0], [12, -5, 0], [3, 9, 1], [-8, 4, 0]])[np.arange(v.size) // 40]
    v["SRPPos"] = frame.to_ecef(places)
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    collection, said = check(write(tmp_path / "moving.cphd", parts), base)
    away = np.linalg.norm(collection.antenna_position - places, axis=1)
    np.testing.assert_allclose(collection.reference_range, away, atol=1e-6)
    assert any("the SRP moves" in line for line in said)
    # An image needs nothing else.
    exact, samples, _, _ = ingested(tmp_path / "moving.cphd")
    x, y = base.targets[0, 0] + np.array([0.0, 40]), base.targets[0, 1] + np.array([0.0, 40])
    image = form_image(lambda pulses: samples[pulses], Geometry(collection=exact), x, y, threads=1)
    assert abs(image[0, 0] - base.sigma[0]) < 0.05


def test_saved_delays_that_are_not_centred_at_the_srp(base: Base, tmp_path: Path) -> None:
    """The range window is centred at the saved delays, not at the SRP."""
    parts = parts_of(base.path)
    v = parts.vectors
    late = 0.7 / v["SCSS"][0]
    v["TOA1"] += late
    v["TOA2"] += late
    far = Base(base.path, base.scene, base.targets * 3 + [0, 0, 0], base.sigma)
    parts.samples[...] = echo(grid_of(parts), delays(parts, far), far.sigma, -1)
    collection, said = check(write(tmp_path / "beside.cphd", parts), far, 5e-5)
    srp = np.linalg.norm(collection.antenna_position, axis=1)
    np.testing.assert_allclose(collection.reference_range - srp, late * SPEED_OF_LIGHT / 2, atol=1e-6)
    assert any("not centred at the SRP" in line for line in said)


def test_transmitter_and_receiver_at_different_places(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    v = parts.vectors
    arp = v["TxPos"].copy()
    along = 1.5 * v["TxVel"] / np.linalg.norm(v["TxVel"], axis=1, keepdims=True)
    v["TxPos"], v["RcvPos"] = arp - along, arp + along
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    collection, said = check(write(tmp_path / "apart.cphd", parts), base, 0.02)
    direct = base.scene.collection().antenna_position - base.scene.centre
    np.testing.assert_allclose(collection.antenna_position, direct, atol=1e-6)
    assert any("up to 3 m apart" in line for line in said)


def test_only_the_samples_of_a_narrow_band_are_read(
    base: Base, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = parts_of(base.path)
    v, n = parts.vectors, parts.samples.shape[1]
    v["FX1"] = v["SC0"] + 10 * v["SCSS"]
    v["FX2"] = v["SC0"] + 49 * v["SCSS"]
    path = write(tmp_path / "narrow.cphd", parts)
    taken: list[int] = []
    take = CphdFile.take

    def counted(self: Any, file: Any, start: int, count: int) -> Any:
        taken.append(count)
        return take(self, file, start, count)

    monkeypatch.setattr(CphdFile, "take", counted)
    collection, _ = check(path, base)
    assert collection.n_range_frequency == 40
    assert max(taken) == 40
    assert sum(taken) == 40 * v.size
    taken.clear()
    ingested(base.path)
    assert max(taken) == echoes.PART * n or max(taken) < echoes.PART * n  # blocks of vectors
    assert sum(taken) == n * v.size


def test_gaps_and_vectors_without_signal_are_missing_pulses(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    parts.vectors["SIGNAL"][20:23] = [0, 2, 0]
    for name in ("FX1", "FX2", "TOA1", "TOA2", "SC0", "SCSS"):
        parts.vectors[name][20] = np.nan
    parts.vectors["TxTime"][22] = np.nan
    kept = np.delete(np.arange(parts.vectors.size), [7, 8, 9, 50])
    path = write(tmp_path / "gaps.cphd", Parts(parts.root, parts.vectors[kept], parts.samples[kept]))
    collection, samples, said, _ = ingested(path)
    missing = [7, 8, 9, 20, 21, 22, 50]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(samples).all(axis=1)), missing)
    want = expected(collection, base)
    lit = np.delete(np.arange(collection.n_pulse), missing)
    np.testing.assert_allclose(samples[lit], want[lit], atol=2e-5)
    direct = base.scene.collection().antenna_position - base.scene.centre
    np.testing.assert_allclose(collection.antenna_position, direct, atol=1e-4)
    assert any("7 of them missing" in line for line in said)


@pytest.mark.parametrize("version", [b"1.0.0", b"1.0.1", b"1.1.1"])
def test_versions_that_are_laid_out_alike_are_read(base: Base, tmp_path: Path, version: bytes) -> None:
    """They differ from 1.1.0 in the text of the standard."""
    (tmp_path / "other.cphd").write_bytes(base.path.read_bytes().replace(b"1.1.0", version))
    check(tmp_path / "other.cphd", base)


def with_two_channels(
    path: Path,
    base: Base,
    *,
    change: Callable[[Array], None] = lambda vectors: None,
    names: tuple[str, str] = ("1", "2"),
    polarizations: tuple[str, ...] = (),
) -> Path:
    """Write a file of two channels, the samples of the first 3 times those of the second, whose vectors may change."""
    parts = parts_of(base.path)
    for where in ("Data/Channel", "Channel/Parameters"):
        (node,) = parts.root.findall("/".join(f"{{*}}{part}" for part in where.split("/")))
        second = copy.deepcopy(node)
        node.addnext(second)
        for channel, name in ((node, names[0]), (second, names[1])):
            channel.find("{*}Identifier").text = name
    data = parts.root.findall("{*}Data/{*}Channel")[1]
    data.find("{*}SignalArrayByteOffset").text = str(8 * parts.samples.size)
    data.find("{*}PVPArrayByteOffset").text = str(parts.vectors.nbytes)
    parts.root.find("{*}Channel/{*}RefChId").text = names[0]
    for node, pair in zip(parts.root.findall("{*}Channel/{*}Parameters"), polarizations, strict=False):
        for key, letter in zip(("TxPol", "RcvPol"), pair, strict=True):
            node.find(f"{{*}}Polarization/{{*}}{key}").text = letter
    vectors = parts.vectors.copy()
    change(vectors)
    with open(path, "wb") as file:
        writer = skcphd.Writer(file, skcphd.Metadata(xmltree=parts.root.getroottree()))
        for name, factor, parameters in ((names[0], 3, parts.vectors), (names[1], 1, vectors)):
            writer.write_signal(name, (factor * parts.samples).astype(np.complex64))
            writer.write_pvp(name, parameters)
    return path


def test_two_channels(base: Base, tmp_path: Path) -> None:
    path = with_two_channels(tmp_path / "two.cphd", base)
    with pytest.raises(InputError, match=r"2 channels.*--channel, one of '1', '2'"):
        ingested(path)
    collection, samples, _, _ = ingested(path, channel="2")
    np.testing.assert_allclose(samples, expected(collection, base), atol=2e-5)
    assert not (tmp_path / "x.zarr").exists()


def test_channels_with_one_signal_array_are_told_and_overlapping_ones_refused(base: Base, tmp_path: Path) -> None:
    path = with_two_channels(tmp_path / "two.cphd", base)
    with open(path, "rb") as file:
        root = skcphd.Reader(file).metadata.xmltree.getroot()
    size = int(root.findall("{*}Data/{*}Channel/{*}SignalArrayByteOffset")[1].text)

    def with_offset(name: str, offset: int) -> Path:
        node = root.findall(f"{{*}}Data/{{*}}Channel/{{*}}{name}ArrayByteOffset")[1]
        before, node.text = node.text, str(offset)
        with_xml(path, tmp_path / f"{name}{offset}.cphd", etree.tostring(root))
        node.text = before
        return tmp_path / f"{name}{offset}.cphd"

    said = ingested(with_offset("Signal", 0), channel="2")[2]
    assert any("channel '2' has the signal array of '1' as well" in line for line in said)
    assert not any("has the signal array" in line for line in ingested(path, channel="2")[2])
    for name, offset in (("Signal", size // 2), ("PVP", 800)):
        words = f"arrays of channels '1' and '2' overlap: bytes 0 .. .* and {offset} .. .*correct {name}ArrayByteOffset"
        refused(with_offset(name, offset), words, channel="1")


def test_all_channels_of_one_geometry_become_one_store(base: Base, tmp_path: Path) -> None:
    def lose(vectors: Array) -> None:  # a tenth of a millimetre off, and some signals
        vectors["TxPos"] += 1e-4
        vectors["SIGNAL"][7:10] = 0

    path = with_two_channels(tmp_path / "pair.cphd", base, change=lose, polarizations=("HH", "HV"))
    told: list[tuple[int, int]] = []
    made = ingest(path, tmp_path / "ph.zarr", channel="all", progress=lambda *n: told.append(n))
    assert made.messages[0] == "channels HH (1), HV (2) have one geometry"
    assert told == [(160, 320), (320, 320)]
    both = stores.open_phase_history(tmp_path / "ph.zarr")
    assert both.channels == ("HH", "HV") and both.attrs["source"]["channel"] == "1, 2"
    collection, single, _, attrs = ingested(path, channel="1")
    np.testing.assert_array_equal(both.read(slice(None), slice(None)), single)
    for name in ("time", "antenna_position", "reference_range", "range_frequency", "beam_azimuth"):
        np.testing.assert_array_equal(getattr(both.collection, name), getattr(collection, name))
    assert attrs["polarization"] == {"transmit": "H", "receive": "H"} == both.attrs["polarization"]
    second = both.of_channel("HV")
    assert second.attrs["polarization"] == {"transmit": "H", "receive": "V"}
    _, alone, _, _ = ingested(path, channel="2")
    np.testing.assert_array_equal(second.read(slice(None), slice(None)), alone)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(alone[:, 0])), [7, 8, 9])
    # A file of one channel has no channels, unless one of two is called so.
    assert stores.open_phase_history(ingest(base.path, tmp_path / "a.zarr", channel="all").path).channels == ()
    called = with_two_channels(tmp_path / "called.cphd", base, names=("all", "b"))
    assert stores.open_phase_history(ingest(called, tmp_path / "b.zarr", channel="all").path).channels == ()


@pytest.mark.parametrize(
    ("identifiers", "polarizations", "wanted"),
    [
        (["1", "2"], ["HH", "HV"], ("HH", "HV")),
        (["1", "2"], ["HH", "HH"], ("1", "2")),
        (["a b", "a/b", "()"], ["HH", "HV", None], ("a_b", "a_b_2", "3")),
        (["c" * 40 + "1", "c" * 40 + "2"], [None, None], ("c" * 32, "c" * 28 + "_2")),
    ],
)
def test_names_of_channels_are_fit_for_a_store(
    identifiers: list[str], polarizations: list[str | None], wanted: tuple[str, ...]
) -> None:
    known = [None if p is None else {"transmit": p[0], "receive": p[1]} for p in polarizations]
    assert channel_parts.names_of(identifiers, known) == wanted


def shift(name: str, by: Any) -> Callable[[Array], None]:
    def change(vectors: Array) -> None:
        vectors[name] += by

    return change


def move_both(vectors: Array) -> None:
    for name in ("TxPos", "RcvPos"):
        vectors[name] += 0.01


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (move_both, r"the antenna's positions \(TxPos, RcvPos\), by up to 0.01732 m, more than 0.0003 m"),
        (shift("SRPPos", np.array([0.0, 0.02, 0.0])), r"the reference point \(SRPPos\), by up to 0.02 m"),
        (shift("SC0", 5e5), "frequencies: "),
    ],
)
def test_channels_of_other_geometry_are_refused(
    base: Base, tmp_path: Path, change: Callable[[Array], None], said: str
) -> None:
    path = with_two_channels(tmp_path / "two.cphd", base, change=change)
    with pytest.raises(InputError, match=rf"two.cphd: channels '1' and '2' differ in {said}.*; give --channel") as no:
        ingest(path, tmp_path / "ph.zarr", channel="all")
    assert "\n" not in str(no.value) and not (tmp_path / "ph.zarr").exists()


def test_beams_and_patterns_of_channels_are_compared(base: Base) -> None:
    with open(base.path, "rb") as stream:
        made = reader.prepare(open_file(stream, base.path, None), reader.Choices())
    n, pulses = made.collection.n_pulse, made.echoes.pulses

    def steered(azimuth: float, width: float, **more: Any) -> tuple[Collection, Any]:
        return replace(made.collection, beam_azimuth=np.full(n, azimuth), beam_width=width, **more), pulses

    first, angle = steered(0.3, 0.1), np.linspace(-0.06, 0.06, 9)
    assert channel_parts.check_same_geometry(["a", "b"], [first, steered(0.3005, 0.1)]) == []
    others = (steered(0.302, 0.1), steered(0.3, 0.102), (made.collection, pulses))
    for other in others:
        with pytest.raises(InputError, match="'a' and 'b' differ in their beams"):
            channel_parts.check_same_geometry(["a", "b"], [first, other])
    shaped = steered(0.3, 0.1, beam_offset=angle, beam_pattern=1 - 50 * angle**2)
    (note,) = channel_parts.check_same_geometry(["a", "b"], [shaped, first])
    assert "pattern in channel b is not that of the first" in note
    assert channel_parts.check_same_geometry(["a", "b"], [shaped, shaped]) == []


def test_a_surface_of_constant_height(base: Base, tmp_path: Path) -> None:
    """With the dwell over an image area given in latitude and longitude, positions do not change."""
    parts = parts_of(base.path)
    planar = parts.root.find("{*}SceneCoordinates/{*}ReferenceSurface/{*}Planar")
    surface = planar.getparent()
    surface.remove(planar)
    scale = 1 / 6.37e6
    for name, (lat, lon) in {"uIAXLL": (0, scale / np.cos(np.radians(ORIGIN[0]))), "uIAYLL": (scale, 0)}.items():
        hae = surface.find("{*}HAE")
        if hae is None:
            hae = etree.SubElement(surface, planar.tag.replace("Planar", "HAE"))
        node = etree.SubElement(hae, planar.tag.replace("Planar", name))
        for axis, value in (("Lat", lat), ("Lon", lon)):
            etree.SubElement(node, planar.tag.replace("Planar", axis)).text = str(value)
    check(write(tmp_path / "hae.cphd", parts), base)


def uneven(base: Base) -> Parts:
    """Parts with times that jitter by a third of a step, positions and samples to match, and a moving SRP."""
    parts = parts_of(base.path)
    v, track = parts.vectors, base.scene.geometry.track
    frame = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])
    jitter = 0.3 / 400 * np.random.default_rng(5).random(v.size)
    position = frame.to_ecef(track.position(base.scene.pulse_times + jitter) - base.scene.centre)
    along = 0.5 * v["TxVel"] / np.linalg.norm(v["TxVel"], axis=1, keepdims=True)
    v["TxPos"], v["RcvPos"] = position - along, position + along
    v["SRPPos"] = frame.to_ecef(np.array([[4.0, -3, 0], [-4, 3, 0]])[np.arange(v.size) // 40 % 2])
    v["TxTime"] += jitter
    v["RcvTime"] += jitter
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    return parts


@pytest.mark.slow
def test_uneven_times_are_resampled_within_the_reported_error(base: Base, tmp_path: Path) -> None:
    path = write(tmp_path / "uneven.cphd", uneven(base))
    collection, samples, said, attrs = ingested(path)
    bound = attrs["source"]["slow_time_resampling_error"]
    lit = ~np.isnan(samples[:, 0])
    assert np.count_nonzero(lit) > 150
    track = base.scene.geometry.track.position(collection.time + float(attrs["source"]["time_zero"]) - 0.2)
    np.testing.assert_allclose(collection.antenna_position + base.scene.centre, track, atol=1e-4)
    assert bound < 0.06
    want = expected(collection, base)
    error = np.abs(samples - want)[lit]
    assert error.max() <= bound * np.abs(base.sigma).sum()
    assert error[10:-10].max() < 2e-3  # away from the ends
    assert any("vectors are 0.00" in line and "dB on any echo of the image area" in line for line in said)


# ---------------------------------------------------------------- Beams


def dwell(parts: Parts, cod: dict[tuple[int, int], float], length: dict[tuple[int, int], float]) -> None:
    for kind, table in (("COD", cod), ("Dwell", length)):
        (node,) = parts.root.findall(f"{{*}}Dwell/{{*}}{kind}Time/{{*}}{kind}TimePoly")
        tag = node.tag.replace(f"{kind}TimePoly", "Coef")
        for child in list(node):
            node.remove(child)
        for (i, j), value in table.items():
            etree.SubElement(node, tag, {"exponent1": str(i), "exponent2": str(j)}).text = str(value)
        for axis in (1, 2):
            node.set(f"order{axis}", str(max(key[axis - 1] for key in table)))


@pytest.mark.slow
def test_dwells_of_no_beam_are_not_reported_as_steered(base: Base, tmp_path: Path) -> None:
    """Neither a yaw about the nadir nor a steering about the velocity has such centres of dwell."""
    parts = parts_of(base.path)
    dwell(parts, {(0, 0): 0.2, (0, 1): 1e-3, (1, 0): 2e-3}, {(0, 0): 0.05})
    collection, said = check(write(tmp_path / "strip.cphd", parts), base)
    assert collection.beam_width is None
    assert any("a yaw about the nadir misses them by" in line for line in said)


def test_a_constant_centre_of_dwell_is_not_reported_as_steered(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    dwell(parts, {(0, 0): 0.2}, {(0, 0): 0.05})
    collection, said = check(write(tmp_path / "short.cphd", parts), base)
    assert collection.beam_width is None
    assert any("hardly changes" in line for line in said)


# ---------------------------------------------------------------- Refusals


def test_times_that_are_too_uneven_are_refused_with_figures(base: Base, tmp_path: Path) -> None:
    """Every third vector, unevenly: the Doppler band of the image area exceeds their sampling."""
    parts = uneven(base)
    kept = np.flatnonzero(np.random.default_rng(7).random(160) < 0.3)
    parts = Parts(parts.root, parts.vectors[kept], parts.samples[kept])
    refused(write(tmp_path / "uneven.cphd", parts), r"not uniform: steps run from .* Doppler of [\d.]+ Hz is too wide")


def test_bistatic_places_are_refused_with_figures(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    parts.vectors["RcvPos"] += [500.0, 0, 0]
    refused(write(tmp_path / "far.cphd", parts), r"500 m apart, which changes ranges .* wavelengths: that is bistatic")


MUTATIONS: dict[str, tuple[Callable[[Parts], None], str]] = {
    "bistatic": (xml("CollectionID/CollectType", "BISTATIC"), "'BISTATIC'; only MONOSTATIC"),
    "other domain": (xml("Global/DomainType", "RANGE"), "DomainType is 'RANGE'; it must be FX or TOA"),
    "sign 0": (xml("Global/SGN", 0), "SGN is '0'"),
    "sign missing": (without("Global/SGN"), "Global/SGN is 0 times"),
    "IARP elsewhere": (xml("SceneCoordinates/IARP/ECF/X", 1e6), "IARP has an ECF and an LLH that lie"),
    "IARP is text": (xml("SceneCoordinates/IARP/ECF/X", "here"), "ECF/X is 'here'; it must be a number"),
    "IARP beyond the pole": (xml("SceneCoordinates/IARP/LLH/Lat", 123), "latitude"),
    "IARP not finite": (xml("SceneCoordinates/IARP/LLH/Lat", "NaN"), "must be finite"),
    "no surface": (without("SceneCoordinates/ReferenceSurface/Planar"), "damaged, or no CPHD file"),
    "PVP of single precision": (xml("PVP/SC0/Format", "F4"), "PVP/SC0 has a format of float32, but must be float64"),
    "PVP overlap": (xml("PVP/RcvTime/Offset", 1), "reaches to byte .* of a vector, into"),
    "PVP missing": (without("PVP/TOA1"), "PVP/TOA1 is missing"),
    "times are NaN": (vectors("TxTime", np.nan), "PVP TxTime is not finite in 160 of 160 vectors"),
    "SRP is NaN in most": (vectors("SRPPos", np.nan, slice(79, None)), "SRPPos is not finite in 81 .*vector 79"),
    "times do not ascend": (vectors("TxTime", 1e-3, 80), "TxTime does not ascend at vector 80"),
    "received before transmitted": (vectors("RcvTime", -1.0), "RcvTime is before TxTime"),
    "platform in the Earth": (vectors("TxPos", 1.0), "TxPos lies 1.73205 .* m from the Earth's centre"),
    "one position off": (vectors("TxPos", [7e6, 0, 0], 40), "PVP TxPos, .* leaves its neighbours by .* m at pulse 40"),
    "one track, then another": (
        lambda p: [p.vectors[name][80:].__iadd__([300.0, 0, 0]) for name in ("TxPos", "RcvPos")].clear(),
        "moves .* m from pulse 79 to 80",
    ),
    "SRP on the other side": (vectors("SRPPos", [6.4e6, 0, 0]), "SRPPos lies up to"),
    "SCSS negative": (vectors("SCSS", -1.0), "PVP SCSS falls to -1, but must be above 0, in 160 of"),
    "band elsewhere": (lambda p: (vectors("FX1", 1e9)(p), vectors("FX2", 2e9)(p))[0], "does not meet the samples"),
    "bands without anything in common": (
        lambda p: (vectors("FX2", 9.97e9, slice(80))(p), vectors("FX1", 10.02e9, slice(80, None))(p))[0],
        "leave only 0 Hz in common",
    ),
    "delays upside down": (vectors("TOA1", 1.0), "TOA1 is not below TOA2"),
    "delays in microseconds": (
        lambda p: (p.vectors["TOA1"].__imul__(1e6), p.vectors["TOA2"].__imul__(1e6))[0],
        r"TOA1 .. TOA2 saves echoes from -.*e\+07 to .*e\+07 m .* Hz apart tell .* m apart, 8.*e\+05 times less: --",
    ),
    "no signal anywhere": (vectors("SIGNAL", 0), "SIGNAL is 1 in 0 of 160 vectors"),
    "grids that cannot be resampled": (
        lambda p: (vectors("SC0", np.linspace(9.95e9, 9.9501e9, 160))(p), vectors("FX2", 9.956e9)(p))[0],
        "too much to resample",
    ),
    "compressed": (
        lambda p: p.insert("Data/SignalCompressionID", "Channel", "zip"),
        "compressed \\('zip'\\), which is not supported",
    ),
    "other samples": (xml("Data/SignalArrayFormat", "CF16"), "SignalArrayFormat is 'CF16'; it must be one of"),
    "no identifier": (xml("Data/Channel/Identifier", "1'2"), "identifiers"),
    "channel of another name": (xml("Channel/Parameters/Identifier", "9"), ""),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_mutated_parts(base: Base, tmp_path: Path, name: str) -> None:
    change, match = MUTATIONS[name]
    parts = parts_of(base.path)
    path = tmp_path / "mutated.cphd"
    if "PVP" in name or name in ("vector where a number is", "compressed", "other samples", "no identifier"):
        # sarkit would not write these: replace the XML of a good file.
        change(parts)
        with_xml(base.path, path, etree.tostring(parts.root))
    else:
        change(parts)
        write(path, parts)
    if match:
        refused(path, match)
    else:
        ingested(path)  # unused fields may be wrong


def with_xml(source: Path, path: Path, text: bytes) -> None:
    """Write a copy of the file with another XML block."""
    with open(source, "rb") as file:
        _, header = skcphd.read_file_header(file)
    data = source.read_bytes()
    names = ("PVP_BLOCK", "SIGNAL_BLOCK")
    blocks = {n: data[int(header[f"{n}_BYTE_OFFSET"]) :][: int(header[f"{n}_SIZE"])] for n in names}
    start = 1024
    offsets = {"PVP_BLOCK": start + len(text) + 2}
    offsets["SIGNAL_BLOCK"] = offsets["PVP_BLOCK"] + len(blocks["PVP_BLOCK"])
    header |= {"XML_BLOCK_SIZE": str(len(text)), "XML_BLOCK_BYTE_OFFSET": str(start)}
    header |= {f"{n}_BYTE_OFFSET": str(offset) for n, offset in offsets.items()}
    head = b"CPHD/1.1.0\n" + "".join(f"{k} := {v}\n" for k, v in header.items()).encode() + b"\f\n"
    path.write_bytes(head.ljust(start, b"\0") + text + b"\f\n" + blocks["PVP_BLOCK"] + blocks["SIGNAL_BLOCK"])


def header_line(key: str, value: str | None) -> Callable[[bytes], bytes]:
    """Change a line of the header in place, without moving what follows."""

    def change(data: bytes) -> bytes:
        end = data.index(b"\f\n")
        lines = data[:end].split(b"\n")
        kept = [b"%s := %s" % (key.encode(), (value or "").encode()) if line.startswith(key.encode()) else line
                for line in lines if value is not None or not line.startswith(key.encode())]  # fmt: skip
        first = int(next(line for line in lines if line.startswith(b"XML_BLOCK_BYTE_OFFSET")).split(b" := ")[1])
        return (b"\n".join(kept) + b"\f\n").ljust(first, b"\0")[:first] + data[first:]

    return change


BYTES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "half a header": (lambda d: d[:100], "header does not end"),
    "last byte missing": (lambda d: d[:-1], "it was cut short"),
    "no XML size": (header_line("XML_BLOCK_SIZE", None), "XML_BLOCK_SIZE is missing"),
    "XML size 0": (header_line("XML_BLOCK_SIZE", "0"), "no number of bytes"),
    "offset is text": (header_line("SIGNAL_BLOCK_BYTE_OFFSET", "here"), "no number of bytes"),
    "PVP at the samples": (header_line("PVP_BLOCK_BYTE_OFFSET", "100000"), "."),
    "PVP block too small": (header_line("PVP_BLOCK_SIZE", "800"), "PVP array needs bytes"),
    "signal block too small": (header_line("SIGNAL_BLOCK_SIZE", "800"), "signal array needs bytes"),
    "XML of other text": (lambda d: d.replace(b"<CollectionID>", b"<CollectionIQ>", 1), "damaged, or no CPHD file"),
    "another namespace": (lambda d: d.replace(b"cphd/1.1.0", b"cphd/9.9.9", 1), "make them agree"),
}  # fmt: skip


@pytest.mark.parametrize("name", BYTES)
def test_mutated_bytes(base: Base, tmp_path: Path, name: str) -> None:
    change, match = BYTES[name]
    path = tmp_path / "mutated.cphd"
    path.write_bytes(change(base.path.read_bytes()))
    refused(path, match)


def test_a_file_that_shrinks_during_reading(base: Base, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "shrinking.cphd"
    shutil.copy(base.path, path)
    prepare = reader.prepare

    def then_cut(*given: Any) -> Any:
        made = prepare(*given)
        path.write_bytes(base.path.read_bytes()[:-1000])
        return made

    monkeypatch.setattr(reader, "prepare", then_cut)
    refused(path, "became shorter")


def test_a_file_is_replaced_on_demand(base: Base, tmp_path: Path) -> None:
    scene, path = Scene.parse(SCENE), tmp_path / "a.cphd"
    shutil.copy(base.path, path)
    cphd_simulation.simulate(scene, path, overwrite=True, origin=ORIGIN)
    assert parts_of(path).vectors.size == 160
    ingested(path)


def test_without_sarkit_the_error_names_the_extra(base: Base, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sarkit.cphd", None)
    with pytest.raises(InputError, match=r"install blocksar\[formats\]"):
        ingest(base.path, tmp_path / "out.zarr")


# ---------------------------------------------------------------- Commands


def test_the_commands(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    runner, file, store = CliRunner(), str(tmp_path / "a.cphd"), str(tmp_path / "a.zarr")
    words = ["simulate", str(tmp_path / "scene.toml"), "--out", file, "--cphd", "--origin", "10,20,30", "--quiet"]
    with caplog.at_level(logging.WARNING):
        assert runner.invoke(commands.app, words).exit_code == 0
    assert not caplog.records  # no warning of sarkit's either
    done = runner.invoke(commands.app, ["ingest", "cphd", file, "--out", store])
    assert (done.exit_code, store in done.output) == (0, True)
    assert "latitude 10.0000000, longitude 20.0000000, height 30.00 m" in done.output
    assert stores.open_phase_history(store).shape[0] == 160
