"""CPHD files as they come: lost vectors, signs, range windows, the troposphere, image areas, amplitude factors."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cphd_files import (
    ORIGIN,
    Array,
    Base,
    Parts,
    delays,
    echo,
    expected,
    grid_of,
    ingested,
    parts_of,
    refused,
    write,
    xml,
)

from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.processors.exact.sums import form_image
from blocksar.readers.atmosphere import zenith_delay
from blocksar.readers.cphd import Choices
from blocksar.readers.cphd.areas import read_area
from blocksar.readers.cphd.files import NEEDED, CphdFile, open_file
from blocksar.readers.cphd.reader import Prepared, describe, describe_sign, prepare
from blocksar.readers.cphd.vectors import Lost, describe_lost

INNER, ENDS = [40, 41, 100], [0, 1, 2, 158, 159]
FRAME = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])


@pytest.fixture(scope="module")
def file(base: Base) -> CphdFile:
    with open(base.path, "rb") as stream:
        return open_file(stream, base.path, None)


def prepared(file: CphdFile, change: Callable[[Array], None], **choices: Any) -> Prepared:
    """What a file would give whose vectors are changed."""
    vectors = file.vectors.copy()
    change(vectors)
    with np.errstate(all="ignore"):  # as `ingest` does
        return prepare(replace(file, vectors=vectors), Choices(**choices))


def put(name: str, value: float, where: list[int], *, flag: int = 1) -> Callable[[Array], None]:
    def change(vectors: Array) -> None:
        vectors[name][where] = value
        vectors["SIGNAL"][where] = flag

    return change


def peaks(path: Path, base: Base, **choices: Any) -> tuple[Array, list[str]]:
    """Values of the image at the targets' places, over their reflectivities; and what was said."""
    collection, samples, said, _ = ingested(path, choices=Choices(**choices))
    image = form_image(
        lambda pulses: samples[pulses], Geometry(collection=collection), np.sort(base.targets[:, 0]),
        np.sort(base.targets[:, 1]), threads=1,
    )  # fmt: skip
    at = [np.argsort(np.argsort(base.targets[:, axis])) for axis in (1, 0)]
    return image[at[0], at[1]] / base.sigma, said


# ---------------------------------------------------------------- Lost vectors


@pytest.mark.parametrize(
    ("name", "value", "flag"),
    [*((name, value, 1) for name in NEEDED for value in (np.nan, 0.0)), ("all", np.inf, 0), ("all", 0.0, 0)],
)
def test_a_vector_with_any_wrong_parameter_is_a_missing_pulse(
    file: CphdFile, base: Base, name: str, value: float, flag: int
) -> None:
    """At the ends and inside, whatever is wrong: the other pulses are where and when they were."""
    direct = base.scene.collection().antenna_position - base.scene.centre

    def change(vectors: Array) -> None:
        for each in NEEDED if name == "all" else (name,):
            put(each, value, [*INNER, *ENDS], flag=flag)(vectors)

    made = prepared(file, change)
    vector = made.echoes.pulses.vector
    lost = [v for v in [*INNER, *ENDS] if not (name == "TxTime" and value == 0 and v == 0)]
    if name == "TxTime" and value == 0:
        lost = [*INNER, 1, 2, 158, 159, 0]
    kept = np.setdiff1d(np.arange(160), lost)
    np.testing.assert_array_equal(vector[vector >= 0], kept)
    slots = np.rint((made.echoes.pulses.time - made.echoes.pulses.time[0]) * 400).astype(int) + int(vector[0])
    if vector[0] >= 0:
        np.testing.assert_allclose(made.collection.antenna_position, direct[slots], atol=1e-3)
    assert "0 .. 2, 40 .. 41, 100, 158 .. 159" in describe_lost(made.echoes.pulses.lost)


def test_a_first_time_of_zero_is_a_time(file: CphdFile) -> None:
    assert file.vectors["TxTime"][0] == 0
    assert prepared(file, lambda _: None).echoes.pulses.vector[0] == 0
    late = prepared(
        file, lambda v: (v["TxTime"].__iadd__(100), v["RcvTime"].__iadd__(100), v["TxTime"].__setitem__(0, 0))[0]
    )
    np.testing.assert_array_equal(late.echoes.pulses.vector, np.arange(1, 160))


def test_a_window_of_delays_may_begin_at_the_srp(file: CphdFile) -> None:
    """A TOA1 that passes through 0 from vector to vector is none that was filled with zeros."""
    step = np.ptp(file.vectors["TOA1"][:1]) + (file.vectors["TOA2"][0] - file.vectors["TOA1"][0]) / 400

    def change(vectors: Array) -> None:
        vectors["TOA1"] = (np.arange(160) - 80) * step
        vectors["TOA2"] = vectors["TOA1"] + 200 * step

    assert (prepared(file, change).echoes.pulses.vector >= 0).all()


@pytest.mark.parametrize("where", ["ends", "inside"])
def test_vectors_of_zeros_are_missing(base: Base, tmp_path: Path, where: str) -> None:
    parts = parts_of(base.path)
    lost = np.r_[0:14, 146:160] if where == "ends" else np.r_[30, 70:80]
    parts.samples[lost] = 0
    gains, said = peaks(write(tmp_path / "zeros.cphd", parts), base)
    assert np.abs(gains - 1).max() < 0.02  # side lobes of the other target
    ranges = "0 .. 13, 146 .. 159" if where == "ends" else "30, 70 .. 79"
    assert any(f"lost vectors: {ranges} (all samples are 0)" in line for line in said)
    assert any(f"160 pulses, {lost.size} of them missing" in line for line in said)


def test_a_file_of_which_most_vectors_are_lost_is_refused(base: Base, tmp_path: Path) -> None:
    flagged, zeros = parts_of(base.path), parts_of(base.path)
    flagged.vectors["SIGNAL"][40:130] = 0
    zeros.samples[40:130] = 0
    for parts, remedy in ((flagged, "such as --pulses 0:40"), (zeros, "with --pulses")):
        path = write(tmp_path / "few.cphd", parts)
        refusal = f"vectors are lost: 40 .. 129 .* which leaves 70 of 160 pulses, less than half; .* {remedy}"
        with pytest.raises(InputError, match=refusal):
            ingested(path)
    collection, *_ = ingested(write(tmp_path / "part.cphd", flagged), pulses=(0, 40))
    assert collection.n_pulse == 40


def test_lost_vectors_at_uneven_times_spoil_no_others(base: Base, tmp_path: Path) -> None:
    """Pulses are sums of vectors there: those that lean on a lost one are missing, and the others as they were."""
    parts = parts_of(base.path)
    v, track = parts.vectors, base.scene.geometry.track
    jitter = 0.2 / 400 * np.random.default_rng(5).random(v.size)
    v["TxPos"] = FRAME.to_ecef(track.position(base.scene.pulse_times + jitter) - base.scene.centre)
    v["RcvPos"] = v["TxPos"]
    for name in ("TxTime", "RcvTime"):
        v[name] += jitter
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    parts.samples[60], parts.samples[90, 5], v["TxPos"][120] = 0, np.nan, np.nan
    collection, samples, said, attrs = ingested(write(tmp_path / "uneven.cphd", parts))
    lit = np.isfinite(samples[:, 0])
    error = np.abs(samples - expected(collection, base))[lit]
    # Half of what a lost vector adds at MOST_ERROR of the weights, as it is one of two targets and two of them at most.
    assert error.max() <= attrs["source"]["slow_time_resampling_error"] * np.abs(base.sigma).sum() + 0.1
    assert 120 < np.count_nonzero(lit) < 155
    assert any("60 (all samples are 0); 90 (samples are not finite); 120 (invalid PVP TxPos)" in line for line in said)


def test_lost_vectors_are_listed_by_their_reasons() -> None:
    def lost(reason: str, *vectors: int) -> Lost:
        return Lost(reason, np.isin(np.arange(100), vectors))

    assert describe_lost([lost("TxPos")]) == ""
    assert describe_lost([lost("A", 1, 2), lost("B", 2), lost("all samples are 0", 7)]) == (
        "1 (invalid PVP A); 2 (invalid PVP A, B); 7 (all samples are 0)"
    )
    many = describe_lost([lost(name, *range(0, 40, 2)) for name in "ABCDEF"])
    assert many == "0, 2, 4, 6, 8, 10, 12, 14 and 12 more ranges (invalid PVP A, B, C, D and 2 more)"


@pytest.mark.parametrize("value", [np.nan, 1e-60])
def test_an_amplitude_factor_of_nothing_is_a_missing_pulse(base: Base, tmp_path: Path, value: float) -> None:
    parts = parts_of(base.path)
    vectors = np.zeros(160, [*parts.vectors.dtype.descr, ("AmpSF", "f8")])
    for name in parts.vectors.dtype.names or ():
        vectors[name] = parts.vectors[name]
    vectors["AmpSF"] = 1.0
    vectors["AmpSF"][[0, 70, 71]] = value
    path = write(tmp_path / "scaled.cphd", parts._replace(vectors=vectors), {"AmpSF": "F8"})
    collection, samples, said, _ = ingested(path)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(samples).all(axis=1)), [0, 70, 71])
    lit = ~np.isnan(samples[:, 0])
    np.testing.assert_allclose(samples[lit], expected(collection, base)[lit], atol=2e-5)
    assert any("0, 70 .. 71 (invalid PVP AmpSF)" in line for line in said)


# ---------------------------------------------------------------- The sign


def test_the_sign_can_be_stated(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    parts.set("Global/SGN", "+1")
    path = write(tmp_path / "wrong.cphd", parts)
    collection, samples, _, attrs = ingested(path, choices=Choices(sgn=-1))
    np.testing.assert_allclose(samples, expected(collection, base), atol=2e-5)
    assert (attrs["source"]["sgn"], attrs["source"]["sgn_declared"]) == (-1, 1)
    assert "sgn_declared" not in ingested(base.path, choices=Choices(sgn=-1))[3]["source"]
    for sgn in (0, 2, "-1"):
        with pytest.raises(InputError, match=r"--sgn is .*; it must be -1 or \+1"):
            Choices(sgn=sgn)  # type: ignore[arg-type]


@pytest.mark.parametrize("declared", [-1, 1])
@pytest.mark.parametrize("follows", [-1, 1])
def test_energy_outside_of_the_saved_delays_tells_a_wrong_sign(
    base: Base, tmp_path: Path, declared: int, follows: int
) -> None:
    """Saved delays that are not centred at the SRP; some noise."""
    parts = parts_of(base.path)
    parts.set("Global/SGN", f"{declared:+d}")
    late = 0.35 / parts.vectors["SCSS"][0]
    for edge in ("TOA1", "TOA2"):
        parts.vectors[edge] += late - (0.25 / parts.vectors["SCSS"][0] if edge == "TOA2" else 0)
    inside = np.full((160, 1), float(parts.vectors["TOA1"][0] + parts.vectors["TOA2"][0]) / 2)
    signal = echo(grid_of(parts), inside, np.ones(1), follows)
    rng = np.random.default_rng(4)
    parts.samples[...] = signal + 0.3 * (rng.standard_normal(signal.shape) + 1j * rng.standard_normal(signal.shape))
    said = ingested(write(tmp_path / "sign.cphd", parts))[2]
    told = [line for line in said if "contradicts the samples" in line]
    assert bool(told) == (declared != follows)
    assert all(f"ingest again with --sgn {follows:+d}" in line for line in told)


def test_a_scene_about_the_srp_tells_nothing_of_the_sign_but_its_maker_may(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    parts.set("Global/SGN", "+1")
    assert not any("SGN +1 is" in line for line in ingested(write(tmp_path / "one.cphd", parts))[2])
    parts.set("CollectionID/CollectorName", "capella-radar-13")
    path = write(tmp_path / "two.cphd", parts)
    assert any("SGN +1 is doubtful: files of capella-radar-13" in line for line in ingested(path)[2])
    assert not any("doubtful" in line for line in ingested(path, choices=Choices(sgn=-1))[2])
    assert any("SGN +1 is doubtful" in line for line in describe(LocalPlace(path), "").notes)
    assert describe_sign(None, -1, "capella", given=False) is None


# ---------------------------------------------------------------- Frequency grids


@pytest.mark.parametrize(
    ("off", "said"), [(0.04, "of a sample: samples are taken as they are"), (0.3, "resampled to one grid")]
)
@pytest.mark.parametrize("full", [0.7, 1.0])
def test_grids_that_wobble(base: Base, tmp_path: Path, off: float, said: str, full: float) -> None:
    """SCSS differs by parts per million, whatever the saved delays fill; targets are where they were."""
    parts = parts_of(base.path)
    v, n = parts.vectors, parts.samples.shape[1]
    v["TOA2"] = full / 2 / v["SCSS"]
    v["TOA1"] = -v["TOA2"]
    v["SCSS"] *= 1 + np.random.default_rng(1).uniform(-1, 1, v.size) * off / (n - 1)
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    collection, samples, told, attrs = ingested(write(tmp_path / "wobble.cphd", parts))
    (line,) = [line for line in told if said in line]
    bound = attrs["source"]["frequency_resampling_error"]
    assert 0 < bound < (0.16 if off < 0.05 else 2e-3)
    error = np.abs(samples - expected(collection, base)).max() / np.abs(base.sigma).sum()
    assert error <= bound + 2e-5
    assert ("but for the" in line) == (off > 0.05 and full > 0.9)
    assert collection.n_range_frequency > 0.85 * n


def test_grids_that_wobble_far_from_the_srp(base: Base, tmp_path: Path) -> None:
    """The error of samples that are taken as they are grows from the middle of the saved delays, not from the SRP."""
    parts = parts_of(base.path)
    v, n = parts.vectors, parts.samples.shape[1]
    for edge in ("TOA1", "TOA2"):
        v[edge] += 0.4 / v["SCSS"]
    v["SCSS"] *= 1 + np.random.default_rng(1).uniform(-1, 1, v.size) * 0.04 / (n - 1)
    middle = float(v["TOA1"][0] + v["TOA2"][0]) / 2
    parts.samples[...] = echo(grid_of(parts), np.full((160, 1), middle), np.ones(1), -1)
    samples = ingested(write(tmp_path / "wobble.cphd", parts))[1]
    assert np.abs(samples - 1).max() < 1e-4


def test_few_samples_are_resampled_as_well(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    v = parts.vectors
    v["FX2"] = v["FX1"] + 99.5 * v["SCSS"]
    v["SC0"] += v["SCSS"] * np.random.default_rng(2).uniform(0, 0.4, v.size)
    v["FX1"] = v["SC0"]
    parts.samples[...] = echo(grid_of(parts), delays(parts, base), base.sigma, -1)
    collection, samples, _, attrs = ingested(write(tmp_path / "few.cphd", parts))
    error = np.abs(samples - expected(collection, base)).max()
    assert error <= attrs["source"]["frequency_resampling_error"] * np.abs(base.sigma).sum() + 2e-5


# ---------------------------------------------------------------- Saved delays


@pytest.mark.parametrize(
    ("first", "last", "reason"),
    [
        (3.13, 5.39, r"saves echoes from .* m of range after the SRP .* 2.26 times less: --range-window reference"),
        (-1.2, 1.2, r"2.4 times less: --range-window reference"),
        (2.0, 3.5, r"the image area lies -.* to .* m after it; .* 1.5 times less"),
        (1.0, 1.8, r"samples SCSS apart tell .* m apart: --range-window reference takes those about the SRP"),
    ],
)
def test_saved_delays_that_samples_cannot_hold(
    base: Base, tmp_path: Path, first: float, last: float, reason: str
) -> None:
    parts = parts_of(base.path)
    v = parts.vectors
    v["TOA1"], v["TOA2"] = first / v["SCSS"], last / v["SCSS"]
    path = write(tmp_path / "long.cphd", parts)
    refused(path, reason)
    collection, samples, said, attrs = ingested(path, choices=Choices(range_window="reference"))
    np.testing.assert_allclose(samples, expected(collection, base), atol=2e-5)
    assert attrs["source"]["range_window"] == "reference"
    assert any("m of range about the SRP are taken" in line for line in said)


def test_saved_delays_are_taken_if_that_is_asked_for(file: CphdFile) -> None:
    def late(vectors: Array) -> None:
        vectors["TOA1"], vectors["TOA2"] = 1.0 / vectors["SCSS"], 1.8 / vectors["SCSS"]

    made = prepared(file, late, range_window="saved")
    beyond = made.collection.reference_range - np.linalg.norm(made.collection.antenna_position, axis=1)
    np.testing.assert_allclose(beyond, 1.4 * made.collection.range_window, rtol=1e-6)


def test_delays_that_fold_are_told(file: CphdFile) -> None:
    def long(vectors: Array) -> None:
        vectors["TOA1"], vectors["TOA2"] = -0.9 / vectors["SCSS"], 0.9 / vectors["SCSS"]

    assert any("1.8 times the delays" in line and "fold back" in line for line in prepared(file, long).notes)


# ---------------------------------------------------------------- The troposphere


@pytest.mark.parametrize("held", [False, True])
def test_the_delay_of_the_file(base: Base, tmp_path: Path, held: bool) -> None:
    """Samples that follow the standard, and samples that still hold the delay: each right with its option."""
    parts = parts_of(base.path)
    delay = 25e-9 + 0.3e-9 * np.linspace(-1, 1, 160) ** 2
    parts.vectors["TDTropoSRP"] = delay
    parts.samples[...] = echo(grid_of(parts), delays(parts, base) + held * delay[:, None], base.sigma, -1)
    gains, said = peaks(write(tmp_path / "tropo.cphd", parts), base, troposphere="file" if held else None)
    assert np.abs(gains - 1).max() < 0.02
    (line,) = [line for line in said if "troposphere" in line]
    assert "25.1 ns or 3.76 m of range, which changes by 0.045 m" in line
    assert ("is taken out: that of TDTropoSRP" in line) == held


def test_a_delay_that_the_file_forgot(file: CphdFile) -> None:
    made = prepared(file, lambda _: None)
    assert any("TDTropoSRP is 0: if the samples hold" in line for line in made.notes)
    other = prepared(file, lambda _: None, troposphere="standard")
    removed = made.collection.reference_range - other.collection.reference_range
    antenna = made.collection.antenna_position
    height, distance = antenna[:, 2], np.linalg.norm(antenna, axis=1)
    latitude = np.full(160, ORIGIN[0])
    between = zenith_delay(np.full(160, ORIGIN[2]), latitude) - zenith_delay(height + ORIGIN[2], latitude)
    np.testing.assert_allclose(removed, between * distance / height, rtol=0.01)  # straight rays through flat layers
    assert other.attributes["source"]["troposphere_removed"] == pytest.approx(removed.mean())
    with pytest.raises(InputError, match="PVP TDTropoSRP is missing, not finite or 0; give --troposphere standard"):
        prepared(file, lambda _: None, troposphere="file")


def test_a_delay_with_holes_is_that_of_neighbours(file: CphdFile) -> None:
    def change(vectors: Array) -> None:
        vectors["TDTropoSRP"] = np.linspace(20e-9, 21e-9, 160)
        vectors["TDTropoSRP"][[0, 50, 51]] = np.nan

    made = prepared(file, change, troposphere="file")
    plain = prepared(file, lambda _: None)
    removed = plain.collection.reference_range - made.collection.reference_range
    want = np.linspace(20e-9, 21e-9, 160) * SPEED_OF_LIGHT / 2
    np.testing.assert_allclose(removed[1:], want[1:], atol=1e-6)


def test_the_standard_atmosphere() -> None:
    """2.3 m of dry and 0.1 m of wet delay at sea level; next to nothing above 40 km."""
    sea, high, orbit = zenith_delay(np.array([0.0, 9000.0, 500e3]), np.full(3, 45.0))
    assert 2.3 < sea < 2.5
    assert 0.25 < high / sea < 0.35  # the share of the air's mass above
    assert 0 <= orbit < 0.02


# ---------------------------------------------------------------- The image area


def strip(parts: Parts) -> None:
    """An image area that is longer than wide, corner points and axes to match."""
    iax = FRAME.to_ecef(np.eye(3)[:2]) - FRAME.to_ecef(np.zeros((1, 3)))
    for name, axis in zip(("uIAX", "uIAY"), iax, strict=True):
        for key, value in zip("XYZ", axis, strict=True):
            parts.set(f"SceneCoordinates/ReferenceSurface/Planar/{name}/{key}", float(value))
    area(parts, -30.0, -60.0, 40.0, 80.0)
    corners = FRAME.to_ecef(np.array([[x, y, 0.0] for x, y in ((-30, -60), (-30, 80), (40, 80), (40, -60))]))
    import sarkit.wgs84

    for node, place in zip(
        parts.root.findall("{*}SceneCoordinates/{*}ImageAreaCornerPoints/{*}IACP"),
        sarkit.wgs84.cartesian_to_geodetic(corners), strict=True,
    ):  # fmt: skip
        node.find("{*}Lat").text, node.find("{*}Lon").text = str(place[0]), str(place[1])


def area(parts: Parts, x1: float, y1: float, x2: float, y2: float) -> None:
    for name, value in (("X1Y1/X", x1), ("X1Y1/Y", y1), ("X2Y2/X", x2), ("X2Y2/Y", y2)):
        xml(f"SceneCoordinates/ImageArea/{name}", value)(parts)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((-30, -60, 40, 80), None),
        (
            (-60, -30, 80, 40),
            r"disagrees with its corner points, 70 x 140 m \(as if x and y were swapped\): the corner",
        ),
        (
            (-1200, -300, 1600, 400),
            r"of 2800 x 700 m .*\(corners lie up to .* m apart\): the corner points are taken, as",
        ),
        ((-30, -80, 40, 60), r"70 x 140 m \(as if an axis were reversed\): the corner points are taken"),
        ((40, 80, -30, -60), None),
    ],
    ids=["as it is", "swapped", "samples, swapped", "left-handed", "the other way round"],
)
def test_an_image_area_is_compared_with_its_corner_points(
    base: Base, tmp_path: Path, given: Any, said: str | None
) -> None:
    parts = parts_of(base.path)
    strip(parts)
    area(parts, *given)
    path = write(tmp_path / "area.cphd", parts)
    with open(path, "rb") as stream:
        found = read_area(open_file(stream, path, None))
    np.testing.assert_allclose([*found.low, *found.high], [-30, -60, 40, 80], atol=0.02)
    messages = ingested(path)[2]
    told = [line for line in messages if "ImageArea" in line]
    assert len(told) == (said is not None)
    assert all(re.search(said or "", line) for line in told)


def test_corner_points_that_do_not_fit_the_saved_delays_are_left(base: Base, tmp_path: Path) -> None:
    parts = parts_of(base.path)
    strip(parts)
    for node in parts.root.findall("{*}SceneCoordinates/{*}ImageAreaCornerPoints/{*}IACP"):
        node.find("{*}Lat").text = str(float(node.findtext("{*}Lat")) + 0.1)
    assert any("ImageArea is taken" in line for line in ingested(write(tmp_path / "corners.cphd", parts))[2])
