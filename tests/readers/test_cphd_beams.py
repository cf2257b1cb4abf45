"""Beams about the antenna's axis in CPHD files: from a scene to a file and back, from dwells alone, and wrong ones."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from axis_beams import axis_scene
from cphd_files import failures, ingest
from lxml import etree
from numpy.typing import NDArray
from sarkit import cphd as skcphd

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.simulation import cphd as cphd_simulation
from blocksar.simulation.cphd import GAIN_ERROR
from blocksar.simulation.scene import Scene

pytest.importorskip("sarkit", reason="the extra `formats` is not installed")

Array = NDArray[Any]
Edit = Callable[[Any, Array], None]

TARGET = """reference_range = "scene_centre"
[[targets]]
name = "P"
cross_range_offset = 10.0
ground_range_offset = 20.0
"""
STRIPMAP = 'mode = "stripmap"\nwidth_deg = 0.6'
TOPS = 'mode = "tops"\nwidth_deg = 1.0\nrate_deg = 3.0'
BEAMS = {
    "stripmap": (STRIPMAP, 0.0),
    "squinted": (f"{STRIPMAP}\nsquint_deg = 10.0", 10.0),
    "pitched": (f"{STRIPMAP}\naxis_yaw_deg = 90.0\naxis_pitch_deg = 2.0", 0.5),
    "sliding spotlight": ('mode = "sliding-spotlight"\nwidth_deg = 0.6\nrate_deg = -0.3', 0.0),
    "tops": (TOPS, 0.0),
    "scanned backwards": ('mode = "tops"\nwidth_deg = 1.0\nrate_deg = -4.0', 0.0),
}
PATTERNS = '\npattern = "taylor"\nelevation_pattern = "gaussian"\nelevation_width_deg = 4.0'
ELEVATION = 5e-3  # of the amplitude: what is one elevation is not quite one direction cosine as the beam is steered
SAMPLED = "\npattern = [[-0.4, 0.55], [-0.2, 0.9], [0.0, 1.05], [0.2, 0.95], [0.4, 0.6]]"


class Made(NamedTuple):
    """A scene, about its centre, and the CPHD file that was made from it."""

    scene: Scene
    path: Path

    @property
    def collection(self) -> Collection:
        """That of the scene, its positions about the scene centre."""
        direct = self.scene.collection()
        moved = direct.antenna_position - self.scene.centre
        return Collection(**{**direct.as_dict(), "antenna_position": moved, "ground_height": 0.0})


def make(folder: Path, beam: str, yaw: float = 0.0) -> Made:
    text = axis_scene(beam, yaw=yaw, more=TARGET)
    return Made(Scene.parse(text), cphd_simulation.simulate(Scene.parse(text), folder / "scene.cphd"))


@pytest.fixture(scope="module")
def stripmap(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("cphd"), STRIPMAP + PATTERNS)


@pytest.fixture(scope="module")
def tops(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("cphd"), TOPS + PATTERNS)


def ingested(path: Path, **options: Any) -> tuple[Collection, list[str]]:
    out = path.with_suffix(".zarr")
    said = ingest(path, out, overwrite=True, **options).messages
    return stores.open_phase_history(out).collection, said


def edited(made: Made, path: Path, edit: Edit) -> Path:
    """The file with its XML and per-vector parameters changed."""
    with open(made.path, "rb") as file:
        reader = skcphd.Reader(file)
        samples, vectors = reader.read_channel("1")
    tree = copy.deepcopy(reader.metadata.xmltree)
    native = vectors.astype(vectors.dtype.newbyteorder("="))
    edit(tree.getroot(), native)
    with open(path, "wb") as file:
        writer = skcphd.Writer(file, skcphd.Metadata(xmltree=tree))
        writer.write_signal("1", np.ascontiguousarray(samples.astype(np.complex64)))
        made_vectors = np.zeros(native.size, skcphd.get_pvp_dtype(tree))
        for name in made_vectors.dtype.names or ():
            made_vectors[name] = native[name]
        writer.write_pvp("1", made_vectors)
    return path


def node_at(root: Any, path: str) -> Any:
    (node,) = root.findall("/".join(f"{{*}}{part}" for part in path.split("/")))
    return node


def put(path: str, text: Any) -> Edit:
    def edit(root: Any, vectors: Array) -> None:
        node_at(root, path).text = str(text)

    return edit


def drop(*paths: str) -> Edit:
    def edit(root: Any, vectors: Array) -> None:
        for path in paths:
            node = node_at(root, path)
            node.getparent().remove(node)

    return edit


def both(*edits: Edit) -> Edit:
    def edit(root: Any, vectors: Array) -> None:
        for one in edits:
            one(root, vectors)

    return edit


def set_polynomial(node: Any, table: Array) -> None:
    """Coefficients (order + 1,) or (order1 + 1, order2 + 1)."""
    tag = node.tag.rpartition("}")[0] + "}Coef"
    for child in list(node):
        node.remove(child)
    for axis, size in enumerate(table.shape, 1):
        node.set(f"order{axis}", str(size - 1))
    for exponents in np.ndindex(table.shape):
        keys = {f"exponent{axis}": str(value) for axis, value in enumerate(exponents, 1)}
        etree.SubElement(node, tag, keys).text = repr(float(table[exponents]))


NO_ANTENNA = drop("Channel/Parameters/Antenna", "Antenna", "PVP/TxAntenna", "PVP/RcvAntenna")
NO_VECTORS = both(
    drop("PVP/TxAntenna", "PVP/RcvAntenna", "Antenna/AntCoordFrame/UseACFPVP", "Antenna/AntPattern/EB/UseEBPVP"),
)
NO_DWELLS = put("Channel/Parameters/DwellTimes/CODId", "nowhere")


def points(made: Made) -> tuple[Array, Array]:
    """Points all over the swath that is ever lit, about the scene centre, m."""
    yaw = np.linspace(*made.scene.lit_yaw, 101)
    x, y = made.scene.ground_point(np.linspace(9700.0, 10000.0, 5)[:, None], yaw)
    return np.ravel(x) - made.scene.centre[0], np.ravel(y) - made.scene.centre[1]


def differing(made: Made, collection: Collection) -> int:
    """The largest number of pulses, of those that light a point in one collection, that do not in the other."""
    x, y = points(made)
    ours, theirs = (Geometry(collection=one).beam.is_lit(x, y) for one in (made.collection, collection))
    assert ours.sum(axis=1).max() > 50
    return int((ours != theirs).sum(axis=1).max())


def gain_error(made: Made, collection: Collection) -> float:
    """Largest difference of the patterns' amplitudes, over lit pulses."""
    x, y = points(made)
    direct = Geometry(collection=made.collection)
    ours, theirs = (
        geometry.beam.gain(x[:, None], y[:, None], slice(None))
        for geometry in (direct, Geometry(collection=collection))
    )
    return float(np.abs(ours - theirs)[direct.beam.is_lit(x, y)].max())


# ---------------------------------------------------------------- from a scene and back


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pitched", "scanned backwards", "sliding spotlight"])
def test_a_beam_survives_the_way_through_a_file(name: str, tmp_path: Path) -> None:
    beam, yaw = BEAMS[name]
    made = make(tmp_path, beam + PATTERNS, yaw)
    assert failures(made.path) == []
    collection, said = ingested(made.path)
    direct = made.collection
    assert collection.beam_axis is not None and direct.beam_axis is not None
    assert collection.beam_steering is not None and direct.beam_steering is not None
    np.testing.assert_allclose(collection.beam_axis, direct.beam_axis, atol=1e-12)
    np.testing.assert_allclose(collection.beam_steering, direct.beam_steering, atol=1e-12)
    assert collection.beam_width == pytest.approx(direct.beam_width, rel=1e-6)
    assert differing(made, collection) <= 1  # on the very edge
    assert any("about the antenna's axis" in line for line in said)
    assert gain_error(made, collection) < ELEVATION
    assert any("antenna patterns of both ways" in line for line in said)


@pytest.mark.slow
def test_a_sampled_pattern_comes_back_within_the_error_of_its_polynomial(tmp_path: Path) -> None:
    made = make(tmp_path, STRIPMAP + SAMPLED)
    assert gain_error(made, ingested(made.path)[0]) < GAIN_ERROR


@pytest.mark.slow
def test_the_antenna_without_per_vector_parameters(stripmap: Made, tmp_path: Path) -> None:
    """As in version 1.0.1: polynomials of time only, of order 5."""
    collection, _ = ingested(edited(stripmap, tmp_path / "polynomials.cphd", NO_VECTORS))
    assert collection.beam_axis is not None and stripmap.collection.beam_axis is not None
    np.testing.assert_allclose(collection.beam_axis, stripmap.collection.beam_axis, atol=1e-5)
    assert differing(stripmap, collection) <= 1
    assert gain_error(stripmap, collection) < ELEVATION


@pytest.mark.slow
def test_axes_that_are_swapped_or_turned_describe_the_same_beam(tops: Made, tmp_path: Path) -> None:
    """ACY along the track backwards, ACX across: the gain is then a function of -DCY and DCX."""

    def turn(root: Any, vectors: Array) -> None:
        for side in ("Tx", "Rcv"):
            x, y = vectors[f"{side}ACX"].copy(), vectors[f"{side}ACY"].copy()
            vectors[f"{side}ACX"], vectors[f"{side}ACY"] = y, -x
            vectors[f"{side}EB"] = np.stack([vectors[f"{side}EB"][:, 1], -vectors[f"{side}EB"][:, 0]], axis=1)
        node = node_at(root, "Antenna/AntPattern/Array/GainPoly")
        table = np.zeros([int(node.get(f"order{axis}")) + 1 for axis in (1, 2)])
        for child in node:
            table[int(child.get("exponent1")), int(child.get("exponent2"))] = float(child.text)
        set_polynomial(node, (table * (-1.0) ** np.arange(table.shape[0])[:, None]).T)

    collection, _ = ingested(edited(tops, tmp_path / "turned.cphd", turn))
    assert differing(tops, collection) <= 1
    assert gain_error(tops, collection) < ELEVATION


def test_gains_follow_the_frequency_where_they_say_so(tops: Made, tmp_path: Path) -> None:
    """At the carrier, 1.2 times FreqZero, the boresight's direction cosine is 1.2 times smaller, the lobe narrower."""

    def shift(root: Any, vectors: Array) -> None:
        pattern = node_at(root, "Antenna/AntPattern")
        node_at(pattern, "FreqZero").text = repr(9.6e9 / 1.2)
        for name in ("EBFreqShift", "MLFreqDilation"):
            node_at(pattern, name).text = "true"
        for side in ("Tx", "Rcv"):
            vectors[f"{side}EB"] *= 1.2
        node = node_at(pattern, "Array/GainPoly")
        for child in node:
            order = int(child.get("exponent1")) + int(child.get("exponent2"))
            child.text = repr(float(child.text) / 1.2**order)

    collection, _ = ingested(edited(tops, tmp_path / "shifted.cphd", shift))
    assert differing(tops, collection) <= 1
    assert gain_error(tops, collection) < ELEVATION


def test_an_element_pattern_adds_to_the_array_s_and_changes_with_the_steering(tops: Made, tmp_path: Path) -> None:
    slope = np.array([[0.0], [-20.0]])  # dB for a direction cosine of 1, one way

    def element(root: Any, vectors: Array) -> None:
        set_polynomial(node_at(root, "Antenna/AntPattern/Element/GainPoly"), slope)

    plain, _ = ingested(tops.path)
    collection, said = ingested(edited(tops, tmp_path / "element.cphd", element))
    assert collection.beam_offset is not None and plain.beam_offset is not None
    change = 20 * np.log10(np.asarray(collection.beam_pattern) / np.asarray(plain.beam_pattern))
    np.testing.assert_allclose(change, -40 * np.sin(collection.beam_offset), atol=1e-6)
    (line,) = [line for line in said if "as the beam is steered" in line]
    assert float(line.split(" dB")[0].split()[-1]) == pytest.approx(40 * np.sin(np.deg2rad(2.8125)), abs=0.05)


def test_what_is_not_used_is_named(stripmap: Made, tmp_path: Path) -> None:
    def add(root: Any, vectors: Array) -> None:
        set_polynomial(node_at(root, "Antenna/AntPattern/Array/PhasePoly"), np.array([[0.0], [0.1]]))
        node = node_at(root, "Antenna/AntPattern/EB")
        node.addprevious(node.makeelement(node.tag.replace("EB", "GainBSPoly"), {"order1": "0"}))
        last = node_at(root, "Antenna/AntPattern/Element")
        last.addnext(last.makeelement(last.tag.replace("Element", "GainPhaseArray")))

    _, said = ingested(edited(stripmap, tmp_path / "more.cphd", add))
    (line,) = [line for line in said if line.startswith("not used of the antenna's metadata")]
    assert all(name in line for name in ("GainPhaseArray", "GainBSPoly", "PhasePoly"))


# ---------------------------------------------------------------- dwells alone, antenna alone


@pytest.mark.slow
@pytest.mark.parametrize("name", ["squinted", "tops"])
def test_dwells_alone_give_a_steering_about_the_velocity(name: str, tmp_path: Path) -> None:
    made = make(tmp_path, *BEAMS[name])
    collection, said = ingested(edited(made, tmp_path / "dwells.cphd", NO_ANTENNA))
    assert collection.has_axis and not collection.has_pattern
    assert collection.beam_width == pytest.approx(made.collection.beam_width, rel=1e-3)
    assert differing(made, collection) <= 2
    assert any("about the velocity" in line and "from the dwell polynomials" in line for line in said)


@pytest.mark.slow
def test_dwells_alone_find_an_axis_that_is_turned_from_the_velocity(tmp_path: Path) -> None:
    made = make(tmp_path, f"{TOPS}\naxis_yaw_deg = 93.0", 3.2)
    collection, said = ingested(edited(made, tmp_path / "dwells.cphd", NO_ANTENNA))
    assert differing(made, collection) <= 2
    assert any("degrees from the velocity" in line for line in said)


@pytest.mark.slow
def test_lost_pulses_have_a_beam(tmp_path: Path) -> None:
    text = axis_scene(TOPS + PATTERNS, more=TARGET) + "[dropped]\npulses = [0, 1, 2, 100, 101, 600]\n"
    made = Made(Scene.parse(text), cphd_simulation.simulate(Scene.parse(text), tmp_path / "scene.cphd"))
    assert differing(made, ingested(made.path)[0]) <= 1


def test_a_pattern_over_elevation_that_turns_with_the_steering_is_refused(tmp_path: Path) -> None:
    """Under a squint of 40 degrees, the direction cosine of one elevation changes with the steering."""
    pattern = 'elevation_pattern = "gaussian"\nelevation_width_deg = 1.0'
    with pytest.raises(InputError, match=r"beam\.elevation_pattern cannot be written to a CPHD file"):
        make(tmp_path, f'mode = "tops"\nwidth_deg = 1.0\nrate_deg = 4.0\nsquint_deg = 35.0\n{pattern}', 39.5)


def test_dwells_that_depend_on_yaw_alone_stay_a_yaw(tmp_path: Path) -> None:
    made = make(tmp_path, "start_deg = -4.0\nstop_deg = 4.0\nwidth_deg = 1.0")
    collection, said = ingested(made.path)
    assert not collection.has_axis
    np.testing.assert_allclose(collection.beam_azimuth, made.collection.beam_azimuth, atol=1e-4)
    assert any("beam steered from yaw" in line for line in said)


def test_an_antenna_without_dwells_is_as_wide_as_half_of_its_power(stripmap: Made, tmp_path: Path) -> None:
    collection, said = ingested(edited(stripmap, tmp_path / "antenna.cphd", NO_DWELLS))
    assert collection.beam_width == pytest.approx(stripmap.collection.beam_width, rel=1e-3)
    assert any("wide at half of its power" in line for line in said)
    assert any("dwell polynomials cannot be used" in line for line in said)


@pytest.mark.slow
def test_without_dwells_and_gain_the_beam_is_undefined(tmp_path: Path) -> None:
    made = make(tmp_path, STRIPMAP)
    lit = {"pulses": (298, 471)}  # of the rest all samples are 0
    collection, said = ingested(edited(made, tmp_path / "neither.cphd", NO_DWELLS), **lit)
    assert not collection.steered
    assert any("do not fall to half of the power" in line for line in said)


@pytest.mark.slow
def test_an_antenna_that_lights_everything_all_the_time_is_left_out(tmp_path: Path) -> None:
    made = make(tmp_path, f'mode = "spotlight"\nwidth_deg = 1.0{PATTERNS}')
    assert failures(made.path) == []
    collection, said = ingested(made.path)
    assert not collection.steered and not collection.has_pattern
    (line,) = [line for line in said if "the antenna's metadata are left out" in line]
    assert "which stays in it" in line
    said = ingested(edited(made, tmp_path / "antenna.cphd", NO_DWELLS))[1]
    assert any("lights the whole image area all the time" in line for line in said)


def test_an_antenna_that_contradicts_the_dwells_is_left_out(stripmap: Made, tmp_path: Path) -> None:
    def squint(root: Any, vectors: Array) -> None:
        for side in ("Tx", "Rcv"):
            vectors[f"{side}EB"][:, 0] += np.sin(np.deg2rad(0.2))

    collection, said = ingested(edited(stripmap, tmp_path / "squinted.cphd", squint))
    assert any("left out" in line and "disagree by up to 0.33 of a dwell" in line for line in said)
    assert any("from the dwell polynomials" in line for line in said)
    assert differing(stripmap, collection) <= 2


# ---------------------------------------------------------------- wrong antennas


def vectors_of(name: str, change: Callable[[Array], Any]) -> Edit:
    def edit(root: Any, vectors: Array) -> None:
        vectors[name] = change(vectors[name])

    return edit


def upwards(root: Any, vectors: Array) -> None:
    for side in ("Tx", "Rcv"):
        vectors[f"{side}ACY"] = -vectors[f"{side}ACY"]


def rising(root: Any, vectors: Array) -> None:
    set_polynomial(node_at(root, "Antenna/AntPattern/Array/GainPoly"), np.array([[0.0], [0.0], [1e6]]))


def out_of_order(root: Any, vectors: Array) -> None:
    node_at(root, "Antenna/AntPattern/Array/GainPoly")[0].set("exponent1", "99")


WRONG: dict[str, tuple[Edit, str]] = {
    "pattern": (put("Channel/Parameters/Antenna/TxAPATId", "2"), "AntPattern '2' is 0 times"),
    "phase centre": (put("Channel/Parameters/Antenna/RcvAPCId", "2"), "AntPhaseCenter '2' is 0 times"),
    "frame": (put("Antenna/AntPhaseCenter/ACFId", "2"), "AntCoordFrame '2' is 0 times"),
    "quotation mark": (put("Antenna/AntPhaseCenter/ACFId", "a'b"), "without a quotation mark"),
    "frequency": (put("Antenna/AntPattern/FreqZero", "-1"), "FreqZero is -1"),
    "no number": (put("Antenna/AntPattern/FreqZero", "x"), "no number"),
    "not finite": (
        vectors_of("TxACX", lambda v: v * np.nan),
        "PVP TxACX is not finite or 0 in 601 of 601 vectors (first",
    ),
    "length": (vectors_of("RcvACY", lambda v: 2 * v), "RcvACY has a length of 2"),
    "angle": (vectors_of("TxACY", lambda v: v[::-1] * 0 + 1 / np.sqrt(3)), "not at a right angle"),
    "boresight": (vectors_of("TxEB", lambda v: v + 1), "TxEB has direction cosines of length"),
    "upwards": (upwards, "points above the horizontal"),
    "rising gain": (rising, "gain in azimuth is left out"),
    "no antenna": (drop("Antenna"), "Antenna is 0 times"),
    "exponent": (out_of_order, "of exponents [99"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_antenna_is_named_and_the_dwells_are_used(name: str, stripmap: Made, tmp_path: Path) -> None:
    edit, words = WRONG[name]
    collection, said = ingested(edited(stripmap, tmp_path / "wrong.cphd", edit))
    assert any(words in line for line in said), said
    assert collection.has_axis and differing(stripmap, collection) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_antennas_of_some_vectors_are_given_by_others(value: float, tops: Made, tmp_path: Path) -> None:
    """At the ends and inside. A boresight that passes through 0 is none that was filled with zeros."""
    lost = [0, 1, 100, 101, 102, 600]
    names = [f"{side}{what}" for side in ("Tx", "Rcv") for what in ("ACX", "ACY", "EB")]

    def lose(root: Any, vectors: Array) -> None:
        for name in names:
            vectors[name][lost] = value

    whole, before = ingested(tops.path)
    collection, said = ingested(edited(tops, tmp_path / "lost.cphd", lose))
    assert not any("not finite" in line for line in before)
    for name in names:
        assert any(re.search(rf"PVP {name} of 6 of \d+ vectors \(first: vector 0\) that is", line) for line in said)
    assert np.abs(collection.beam_axis - whole.beam_axis).max() < 1e-5  # of a width of 0.017 rad
    assert np.abs(collection.beam_steering - whole.beam_steering).max() < 1e-5
    assert collection.beam_width == pytest.approx(whole.beam_width, rel=1e-3) and differing(tops, collection) <= 2


# ---------------------------------------------------------------- scenes that no file describes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beam", "yaw", "words"),
    [
        ('mode = "stripmap"\nwidth_deg = 8.0\nsquint_deg = 6.0', 6.0, None),
        (STRIPMAP, 2.0, "the scene centre becomes the reference point"),
        (f"{STRIPMAP}\npattern = [[-0.4, 0.0], [-0.2, 0.9], [-0.1, 0.0], [0.0, 1.0], [0.4, 0.1]]", 0.0, "beam.pattern"),
        ("start_deg = -4.0\nstop_deg = 4.0\nwidth_deg = 1.0\npattern = 'taylor'", 0.0, "give beam.mode instead"),
    ],
)
def test_scenes_that_no_file_describes_are_refused(beam: str, yaw: float, words: str | None, tmp_path: Path) -> None:
    if words is None:  # lit all the time: described as such
        assert not ingested(make(tmp_path, beam, yaw).path)[0].steered
        return
    with pytest.raises(InputError, match=words):
        make(tmp_path, beam, yaw)
    assert not list(tmp_path.iterdir())


def test_a_swath_that_is_lit_all_the_time_at_some_ranges_only_is_refused(tmp_path: Path) -> None:
    text = axis_scene('mode = "stripmap"\nwidth_deg = 2.6', more=TARGET)
    wide = Scene.parse(text.replace("[9700.0, 10000.0]", "[7000.0, 10000.0]"))
    with pytest.raises(InputError, match=r"wholly over none of the swath at all ranges, .* simulate more pulses"):
        cphd_simulation.simulate(wide, tmp_path / "scene.cphd")


# ---------------------------------------------------------------- Image areas and pulses that are not as they should be


@pytest.mark.parametrize("swapped", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_image_area_in_samples_keeps_the_beam(swapped: bool, stripmap: Made, tmp_path: Path) -> None:
    """Axes swapped and numbers of samples in ImageArea, with corner points that are right."""

    def edit(root: Any, _: Array) -> None:
        area = root.find("{*}SceneCoordinates/{*}ImageArea")
        for corner in ("X1Y1", "X2Y2"):
            x, y = (area.find(f"{{*}}{corner}/{{*}}{axis}") for axis in "XY")
            x.text, y.text = str(7 * float(y.text)), str(5 * float(x.text))
        outline = area.find("{*}Polygon")
        if outline is not None:
            area.remove(outline)
        if not swapped:
            return
        for node in root.iter("{*}Coef"):
            if node.getparent().tag.endswith(("CODTimePoly", "DwellTimePoly")):
                one, two = node.get("exponent1"), node.get("exponent2")
                node.set("exponent1", two), node.set("exponent2", one)
        for name in ("COD", "Dwell"):
            poly = node_at(root, f"Dwell/{name}Time/{name}TimePoly")
            one, two = poly.get("order1"), poly.get("order2")
            poly.set("order1", two), poly.set("order2", one)

    collection, said = ingested(edited(stripmap, tmp_path / "area.cphd", edit))
    plain, _ = ingested(stripmap.path)
    assert collection.has_axis
    assert collection.beam_width == pytest.approx(plain.beam_width, rel=0.02)
    assert np.abs(np.asarray(collection.beam_steering) - np.asarray(plain.beam_steering)).max() < 0.02 * 0.0105
    assert any("ImageArea of" in line and "the corner points are taken" in line for line in said)
    assert any("polynomials are read as if x and y were swapped" in line for line in said) == swapped


def test_zeros_of_a_beam_that_lit_nothing_are_no_lost_pulses(stripmap: Made, tmp_path: Path) -> None:
    """One target, without noise: zeros before and after its dwell, and in a gap of it."""
    lost = 25
    with open(stripmap.path, "rb") as file:
        samples, _ = skcphd.Reader(file).read_channel("1")
    lit = np.flatnonzero(np.asarray(samples).any(axis=1))
    assert 50 < lit.size < 0.8 * samples.shape[0]
    gap = slice(int(lit[lit.size // 3]), int(lit[lit.size // 3]) + lost)
    path = tmp_path / "gap.cphd"
    with open(stripmap.path, "rb") as file, open(path, "wb") as out:
        reader = skcphd.Reader(file)
        changed, vectors = reader.read_channel("1")
        changed = np.array(changed)
        changed[gap] = 0
        writer = skcphd.Writer(out, reader.metadata)
        writer.write_signal("1", changed)
        writer.write_pvp("1", vectors)
    _, said = ingested(path)
    assert any(f"{samples.shape[0]} pulses, {lost} of them missing" in line for line in said)
    history = stores.open_phase_history(path.with_suffix(".zarr"))
    missing = np.isnan(history.read(slice(None), slice(None))).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(missing), np.arange(gap.start, gap.stop))
