"""Scene files: values are read correctly, and one error names every wrong field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import blocksar
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.progress import Listener
from blocksar.simulation.scene import Scene, next_smooth_even, shipped_scenes

PLAIN = """
title = "plain"
[radar]
carrier = 10e9
bandwidth = 100e6
range_sampling = 120e6
prf = 1000
pulse_width = 2e-6
[track]
position = [100.0, 200.0, 3000.0]
velocity = [150.0, 10.0, -20.0]
[time]
pulses = 101
[beam]
start_deg = 40
stop_deg = 60
width_deg = 8
[scene]
swath = [9500.0, 10500.0]
"""


POINT = """[[targets]]
name = "{}"
range = {}
yaw_deg = {}
"""


def plain(**replaced: str) -> str:
    """The plain scene with some lines replaced: key = whole new text of that line."""
    lines = []
    for line in PLAIN.strip().splitlines():
        key = line.split("=")[0].strip()
        lines.append(replaced.pop(key, line))
    assert not replaced
    return "\n".join(lines)


def problems(text: str, folder: Path | None = None) -> list[str]:
    with pytest.raises(InputError) as caught:
        Scene.parse(text, label="my.toml", folder=folder)
    header, *rest = str(caught.value).split("\n  ")
    assert header == f"my.toml has {len(rest)} wrong field{'s' if len(rest) > 1 else ''}:"
    return rest


def test_table1_agrees_with_table_1_of_paper_a() -> None:
    scene = Scene.read("table1")
    collection = scene.collection()
    assert (collection.carrier, scene.radar.bandwidth, scene.radar.pulse_width) == (15e9, 50e6, 10e-6)
    assert collection.n_pulse == 4800
    assert collection.time[2400] == 0.0
    assert collection.prf == pytest.approx(8e3)
    half = np.array([-40.0, 1300.0, -600.0]) * -0.3 + np.array([-15.0, -30.0, -35.0]) * 0.3**2 / 2
    assert collection.antenna_position[0] == pytest.approx(half + np.array([0, 0, 16500]), abs=1e-9)
    assert np.rad2deg(collection.beam_azimuth[[0, 2400]]) == pytest.approx([42.13, 50.0])
    # 15.74 degrees in 0.6 s for 0.162 s
    assert np.rad2deg(collection.beam_width) == pytest.approx(4.2498)
    assert collection.reference_range == pytest.approx(30e3)
    # Table 1's squint, 39.8 degrees, is asin(y / R) of the scene centre.
    assert np.rad2deg(np.arcsin(scene.centre[1] / 30e3)) == pytest.approx(39.8, abs=0.05)
    assert np.abs(collection.range_frequency).max() <= 25e6
    assert collection.bandwidth == pytest.approx(50e6, rel=1e-3)


def test_table1_matrix_lies_along_ground_range_and_is_lit_where_the_scene_says() -> None:
    scene = Scene.read("table1")
    geometry = Geometry(collection=scene.collection())
    targets = {target.name: target for target in scene.point_targets()}
    assert len(targets) == 81
    assert all(target.reflectivity == 1 for target in targets.values())
    place = {name: np.array([target.x, target.y]) for name, target in targets.items()}
    centre = place["B2"]
    assert np.hypot(*centre) == pytest.approx(np.sqrt(30e3**2 - 16.5e3**2))
    along = (place["C2"] - place["A2"]) / 5000
    assert along == pytest.approx([np.cos(np.deg2rad(50)), np.sin(np.deg2rad(50))])
    assert place["B3"] - place["B1"] == pytest.approx(5000 * np.array([-along[1], along[0]]))
    assert place["T01"] - place["A1"] == pytest.approx(625 * np.array([-along[1], along[0]]))
    yaw = {name: geometry.yaw(*point) for name, point in place.items()}
    assert yaw["A1"] < yaw["A2"] < yaw["A3"]
    ranges = geometry.epoch_range(*np.array(list(place.values())).T)
    assert ranges.min() > 27.5e3 and ranges.max() < 32.5e3
    dwell = {name: float(np.subtract(*geometry.beam.dwell_at(yaw[name], np.zeros(1))[::-1])) for name in yaw}
    for name in ("A2", "B1", "B2", "B3", "C1", "C2", "C3"):
        assert dwell[name] == pytest.approx(0.162, abs=1e-9)
    assert dwell["A1"] == pytest.approx(0.140, abs=5e-4)


@pytest.mark.parametrize("reference", ['"constant"', '"scene_centre"', "9000.0"])
def test_the_window_holds_every_lit_range_with_its_migration(reference: str) -> None:
    scene = Scene.parse(PLAIN + f"reference_range = {reference}\n")
    collection = scene.collection()
    yaw = np.linspace(*scene.lit_yaw, 201)
    for pulse in range(collection.n_pulse):
        seen = yaw[np.abs(yaw - collection.beam_azimuth[pulse]) <= collection.beam_width / 2]
        for slant in scene.area.swath:
            x, y = scene.ground_point(slant, seen)
            point = np.stack([x, y, np.zeros_like(x)], axis=-1)
            away = np.linalg.norm(point - collection.antenna_position[pulse], axis=-1)
            assert np.abs(away - collection.reference_range[pulse]).max() < collection.range_window / 2
    # Even and 5-smooth: the Fourier grid of the fast-time samples.
    n = round(120e6 / collection.range_frequency_step)
    assert n == next_smooth_even(n)
    assert collection.range_frequency == pytest.approx(np.rint(collection.range_frequency * n / 120e6) * 120e6 / n)


def test_the_raw_window_holds_every_whole_echo() -> None:
    scene = Scene.parse(PLAIN)
    collection, tau = scene.collection(raw=True), scene.fast_time
    assert np.diff(tau) == pytest.approx(1 / 120e6)
    x, y = scene.ground_point(np.array(scene.area.swath)[:, None], np.linspace(*scene.lit_yaw, 31))
    for pulse in (0, 50, 100):
        lit = np.abs(np.linspace(*scene.lit_yaw, 31) - collection.beam_azimuth[pulse]) <= collection.beam_width / 2
        px, py, pz = collection.antenna_position[pulse]
        delay = 2 * np.sqrt((x - px) ** 2 + (y - py) ** 2 + pz**2)[:, lit] / SPEED_OF_LIGHT
        assert tau[0] < delay.min() - 1e-6 and delay.max() + 1e-6 < tau[-1]
    assert collection.range_frequency_step == pytest.approx(120e6 / tau.size)
    with pytest.raises(InputError, match=r"radar\.pulse_width is missing"):
        Scene.parse(plain(pulse_width="")).collection(raw=True)


def test_an_odd_number_of_pulses_and_a_start_away_from_t_zero() -> None:
    assert Scene.parse(PLAIN).pulse_times[50] == 0.0
    late = Scene.parse(plain(pulses="duration = 0.1\nstart = 0.05")).collection()
    assert late.n_pulse == 100
    assert late.time[[0, -1]] == pytest.approx([0.05, 0.149])


def test_three_ways_to_give_a_track_agree(tmp_path: Path) -> None:
    time = np.linspace(-0.06, 0.06, 25)
    taylor = "velocity = [150.0, 10.0, -20.0]\nacceleration = [2.0, -4.0, 6.0]\njerk = [6.0, 0.0, -12.0]"
    vectors = [[100, 200, 3000], [150, 10, -20], [1, -2, 3], [1, 0, -2]]
    powers = f"coefficients = {vectors}"
    first = Scene.parse(plain(velocity=taylor)).collection().antenna_position
    second = Scene.parse(plain(position="", velocity=powers)).collection().antenna_position
    assert second == pytest.approx(first, abs=1e-9)
    place = np.polynomial.polynomial.polyval(time, np.array(vectors, dtype=float)).T
    rows = np.column_stack([time, place]).tolist()
    inline = f"samples = {rows}"
    np.savetxt(tmp_path / "track.csv", rows, delimiter=",", header="t,x,y,z", comments="", fmt="%.17g")
    for way in (inline, 'file = "track.csv"'):
        scene = Scene.parse(plain(position="", velocity=way), folder=tmp_path)
        # A cubic spline is exact for a cubic track.
        assert scene.collection().antenna_position == pytest.approx(first, abs=1e-8)
    short = f"samples = {rows[5:]}"
    with pytest.raises(InputError, match=r"track\.samples run from t = -0\.035 to 0\.06 s"):
        Scene.parse(plain(position="", velocity=short)).collection()


def test_three_ways_to_place_a_target_agree() -> None:
    scene = Scene.parse(
        PLAIN
        + """
        [[targets]]
        name = "polar"
        range = 10200.0
        yaw_deg = 52.0
        amplitude = 2.0
        phase_deg = 90.0
        """
    )
    (polar,) = scene.point_targets()
    assert polar.reflectivity == pytest.approx(2j)
    geometry = Geometry(collection=scene.collection())
    assert geometry.epoch_range(polar.x, polar.y) == pytest.approx(10200.0)
    assert np.rad2deg(geometry.yaw(polar.x, polar.y)) == pytest.approx(52.0)
    offset = np.array([polar.x, polar.y]) - scene.centre[:2]
    cos, sin = np.cos(np.deg2rad(50)), np.sin(np.deg2rad(50))
    ways = (
        {
            "x": polar.x,
            "y": polar.y,
        },
        {"ground_range_offset": offset @ [cos, sin], "cross_range_offset": offset @ [-sin, cos]},
    )
    for way in ways:
        text = "[[targets]]\nname = 'other'\n" + "\n".join(f"{key} = {float(value)!r}" for key, value in way.items())
        (other,) = Scene.parse(PLAIN + text).point_targets()
        assert (other.x, other.y) == pytest.approx((polar.x, polar.y), abs=1e-6)


def test_an_unsteered_scene_needs_and_uses_its_centre_yaw() -> None:
    text = PLAIN.replace("[beam]\nstart_deg = 40\nstop_deg = 60\nwidth_deg = 8\n", "")
    assert problems(text) == ["scene.centre_yaw_deg is missing: a scene without [beam] needs it"]
    text += "centre_yaw_deg = -120\n"
    assert problems(text + "[clutter]\nscatterers = 10\nseed = 1\n")[0].startswith("clutter.yaw_deg is missing: ")
    collection = Scene.parse(text).collection()
    assert not collection.steered
    assert np.isnan(collection.beam_azimuth).all()


def test_clutter_is_uniform_over_ground_area_and_has_its_power() -> None:
    text = PLAIN + "[clutter]\nscatterers = 200000\nseed = 5\npower = 3.0\n"
    x, y, sigma = Scene.parse(text).scatterers()
    again = Scene.parse(text).scatterers()
    assert all(np.array_equal(a, b) for a, b in zip((x, y, sigma), again, strict=True))
    distance2 = (x - 100) ** 2 + (y - 200) ** 2
    near, far = 9500.0**2 - 3000**2, 10500.0**2 - 3000**2
    assert near <= distance2.min() and distance2.max() <= far
    # The mean of n uniform numbers varies by 1 / sqrt(12 n) = 0.00065; five times that.
    assert (distance2.mean() - near) / (far - near) == pytest.approx(0.5, abs=0.0033)
    yaw = np.rad2deg(np.arctan2(y - 200, x - 100))
    assert yaw.min() >= 36 and yaw.max() <= 64
    # The mean power of n such numbers varies by 1 / sqrt(n) = 0.0022 of itself; five times that.
    assert np.mean(np.abs(sigma) ** 2) == pytest.approx(3.0, rel=0.011)
    assert abs(np.mean(sigma**2)) < 0.011 * 3


def test_a_reflectivity_map_puts_each_pixel_in_its_place(tmp_path: Path) -> None:
    pixels = np.zeros((3, 4))
    pixels[2, 1] = 5.0
    np.save(tmp_path / "map.npy", pixels)
    table = '[reflectivity]\nfile = "map.npy"\nx0 = 7000.0\ndx = 2.0\ny0 = 6000.0\ndy = -3.0\n'
    x, y, sigma = Scene.parse(PLAIN + table, folder=tmp_path).scatterers()
    assert (x.tolist(), y.tolist(), sigma.tolist()) == ([7002.0], [5994.0], [5.0])
    sigma = Scene.parse(PLAIN + table + "seed = 1\n", folder=tmp_path).scatterers().reflectivity
    assert np.abs(sigma) == pytest.approx(5.0)
    assert sigma[0].imag != 0
    (problem,) = problems(PLAIN + table.replace("map.npy", "none.npy"), folder=tmp_path)
    assert problem.startswith("reflectivity.file = 'none.npy': must be a readable .npy file")


def test_dropped_pulses_are_those_listed_and_a_random_share() -> None:
    text = PLAIN + "[dropped]\npulses = [3]\nranges = [[10, 12]]\n"
    assert Scene.parse(text).dropped_pulses().tolist() == [3, 10, 11, 12]
    some = Scene.parse(PLAIN + "[dropped]\nfraction = 0.2\nseed = 1\n").dropped_pulses()
    assert some.size == 20


def test_every_wrong_field_is_named_with_its_value_and_a_remedy() -> None:
    text = plain(
        carrier='carrier = "10e9"',
        prf="prf = -3",
        bandwidth="",
        start_deg="start_deg = true",
        swath='swath = [9500.0, "far"]\nreference_range = "there"\nswaths = 1',
        pulses="pulses = 10.5",
    )
    targets = "\n[[targets]]\nname = 'a'\nx = 1.0\n[[targets]]\nname = 'b'\nx = 1.0\ny = 2.0\ncolour = 3\n"
    found = problems(text + targets)
    starts = [
        "radar.carrier = '10e9': must be a valid number",
        "radar.bandwidth is missing: add",
        "radar.prf = -3: must be greater than 0",
        "time.pulses = 10.5: must be a valid integer",
        "beam.start_deg = True: must be a valid number",
        "scene.swath[1] = 'far': must be a valid number",
        "scene.swaths = 1: unknown key; did you mean swath?",
        "targets[0]: place of 'a' = x: give x + y, range + yaw_deg, or",
        "targets[1].colour = 3: unknown key; known here are name, x, y",
    ]
    for start in starts:
        assert sum(problem.startswith(start) for problem in found) == 1, (start, found)
    (either,) = [problem for problem in found if problem.startswith("scene.reference_range = 'there'")]
    assert "'constant' or 'scene_centre'" in either and "number" in either
    assert len(found) == len(starts) + 1


@given(least=st.integers(0, 200_000))
def test_next_smooth_even(least: int) -> None:
    n = next_smooth_even(least)
    assert n >= max(least, 16) and n % 2 == 0
    for factor in (2, 3, 5):
        while n % factor == 0:
            n //= factor
    assert n == 1


def test_names_of_targets_differ_also_in_large_scenes() -> None:
    """A matrix of 2500, one of which has the name of a target."""
    matrix = "[matrix]\nrows = 50\ncolumns = 50\nspacing = [5.0, 5.0]\n"
    named = PLAIN + matrix + POINT.format("other", 1e4, 50)
    assert len(Scene.parse(named).point_targets()) == 2501
    with pytest.raises(InputError, match=r"targets = \['other'\]: names must differ"):
        Scene.parse(named + POINT.format("other", 1e4, 51))


@pytest.mark.parametrize("cphd", [False, True])
def test_targets_that_no_pulse_lights_are_noted(cphd: bool, tmp_path: Path) -> None:
    told: list[str] = []

    class Notes(Listener):
        def note(self, text: str, *, again: bool = False) -> None:
            told.append(text)

    points = "".join(POINT.format(f"P{yaw}", 1e4, yaw) for yaw in (50, 63.9, 64.1, 36.1, 35.9))
    scene = tmp_path / "scene.toml"
    scene.write_text(PLAIN.replace("pulses = 101", "pulses = 1001") + points)
    blocksar.simulate(scene, tmp_path / "ph", cphd=cphd, progress=Notes())
    assert told == [
        "no pulse lights 2 of 5 targets (P64.1, P35.9), and no echo is simulated there; correct the places, or the beam"
    ]
    assert not any(Scene.read(name).unlit_targets() for name in shipped_scenes())
    unsteered = Scene.parse(scene.read_text().partition("[beam]")[0] + "[scene]\nswath = [9500.0, 10500.0]\n"
                            "centre_yaw_deg = 50\n" + points)  # fmt: skip
    assert unsteered.unlit_targets() == []
