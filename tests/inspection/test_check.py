"""The check of the samples against what is said of them: each mistake is found and named, and right ones pass."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wrong_tracks
import xarray as xr
from axis_beams import axis_scene
from exact_scenes import exact_scene
from scenes import PAPERS, scene, write_store
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.inspection.check import check, part_of, part_to_read
from blocksar.inspection.prominent import Contrast
from blocksar.inspection.verdict import Concentrations, Findings, Trial
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import sampler

Part = tuple[ComplexArray, Collection, Grid | None]
GRID = wrong_tracks.GRID


def targets() -> str:
    rng = np.random.default_rng(4)
    places = zip(rng.uniform(29750, 30250, 24), rng.uniform(43.0, 57.0, 24), strict=True)
    return "\n".join(
        f'[[targets]]\nname = "{k}"\nrange = {r:.3f}\nyaw_deg = {y:.4f}' for k, (r, y) in enumerate(places)
    )


def part(store: Path, grid: Any) -> Part:
    history = stores.open_phase_history(store)
    collection = history.collection.centred()
    pulses, columns = part_to_read(collection)
    points = None if grid is None else Grid(*grid[0], *grid[1])
    return history.read(pulses, columns), part_of(collection, pulses, columns), points


@pytest.fixture(scope="module")
def steered_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("steered"), swath=[29700.0, 30300.0], more=targets())


@pytest.fixture(scope="module")
def spotlight_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All of the scene is lit all the time: the Doppler centroid tells nothing."""
    return wrong_tracks.make(tmp_path_factory.mktemp("spotlight"), wrong_tracks.targets(14, 3), error="")


@pytest.fixture(scope="module")
def steered(steered_store: Path) -> Part:
    return part(steered_store, None)


@pytest.fixture(scope="module")
def spotlight(spotlight_store: Path) -> Part:
    return part(spotlight_store, GRID)


def run(signal: ComplexArray, collection: Collection, grid: Grid | None, *, thorough: bool = False) -> Findings:
    return check(signal, collection, grid=grid, threads=2, thorough=thorough)


def test_right_samples_pass(spotlight: Part) -> None:
    findings = run(*spotlight, thorough=True)
    assert findings.speaks
    assert findings.warning() is None
    assert findings.sentence().startswith(
        "the image is sharp as given, but whether it is mirrored or moved is not told"
    )
    assert findings.sharpness > 0.9
    assert len(findings.trials) > 5
    assert findings.better is None


def test_the_mirror_image_of_a_spotlight_is_said_not_to_be_told(spotlight: Part) -> None:
    """A conjugated signal mirrors it about its middle, hardly less sharp."""
    signal, collection, grid = spotlight
    sentence = run(np.conj(signal), collection, grid, thorough=True).sentence()
    assert "not told from what is given: the signal is conjugated" in sentence


def wobble(collection: Collection, size: float) -> Collection:
    """A sinusoidal error of the track, `size` m, along the sight."""
    error = size * np.sin(2 * np.pi * 0.7 * collection.time)[:, None] * np.array([0.8, 0.0, -0.6])
    return replace(collection, antenna_position=collection.antenna_position + error)


def test_six_millimetres_of_track_error_are_noticed(spotlight: Part) -> None:
    signal, collection, grid = spotlight
    findings = run(signal, wobble(collection, 0.006), grid)
    assert findings.blurred
    assert findings.sharpness < 0.7
    assert "autofocus" in (findings.warning() or "")
    assert run(signal, wobble(collection, 0.0003), grid).warning() is None


@pytest.mark.slow
def test_an_error_of_velocity_or_height_is_measured(tmp_path: Path) -> None:
    store = blocksar.simulate("paper_b", tmp_path / "ph.zarr")
    signal, collection, grid = part(Path(store), PAPERS["paper_b"][1])
    position, time = collection.antenna_position, collection.time - collection.time.mean()
    velocity = (position[-1] - position[0]) / (time[-1] - time[0])
    fast = replace(collection, antenna_position=position + 0.01 * np.outer(time, velocity))
    assert "a velocity that is about 0.99 % too high" in (run(signal, fast, grid).warning() or "")
    high = replace(collection, antenna_position=position + np.array([0.0, 0.0, 20.0]))
    assert "an offset of about 20 m towards +z" in (run(signal, high, grid).warning() or "")


@pytest.mark.slow
def test_a_scene_without_prominent_places_tells_nothing(steered: Part) -> None:
    signal, collection, _ = steered
    rng = np.random.default_rng(0)
    noise = (rng.standard_normal(signal.shape) + 1j * rng.standard_normal(signal.shape)).astype(np.complex64)
    findings = run(noise, collection, None)
    assert not findings.speaks
    assert findings.warning() is None
    assert "nothing can be said of the samples' sign and order" in findings.sentence()


@pytest.mark.slow
def test_missing_samples_and_spikes_do_not_matter(steered: Part) -> None:
    signal, collection, _ = steered
    damaged = signal.copy()
    damaged[::7] = np.nan
    damaged[100, 50] = 1e30
    findings = run(damaged, collection, None)
    assert findings.speaks
    assert findings.warning() is None


@pytest.mark.slow
def test_the_command_compares_everything(steered_store: Path) -> None:
    result = CliRunner().invoke(commands.app, ["check", str(steered_store)], prog_name="blocksar")
    assert result.exit_code == 0
    for words in ("as given", "the signal is conjugated", "the samples fit what is said of them"):
        assert words in result.output


@pytest.mark.slow
@pytest.mark.checked
def test_a_run_says_what_the_check_finds(steered_store: Path, tmp_path: Path) -> None:
    few = ((16000.0, 16040.0, 8.0), (19100.0, 19140.0, 8.0))
    settings: dict[str, Any] = {"grid": few, "processor": "backprojection", "workers": 0}
    with xr.open_zarr(steered_store) as source:
        wrong = source.load().assign(signal=np.conj(source.signal))
    report = blocksar.focus(wrong, tmp_path / "run", **settings)
    assert any("the signal is conjugated" in warning for warning in report.result["warnings"])
    assert any("the signal is conjugated" in line for line in report.summary)


@pytest.mark.slow
def test_a_strip_is_not_called_wrong_by_its_mirror_image(tmp_path: Path) -> None:
    """A beam about its axis on a straight track: flown backwards, the scene is mirrored, and as sharp at broadside."""
    rng = np.random.default_rng(2)
    ground = "\n".join(
        f'[[targets]]\nname = "{k}"\nx = {x:.2f}\ny = {y:.2f}'
        for k, (x, y) in enumerate(zip(rng.uniform(10350, 10450, 16), rng.uniform(-150, 150, 16), strict=True))
    )
    (tmp_path / "strip.toml").write_text(
        "[radar]\ncarrier = 9.6e9\nbandwidth = 100e6\nrange_sampling = 120e6\nprf = 400\npulse_width = 2e-6\n"
        "[track]\nposition = [0, 0, 6000]\nvelocity = [0, 120, 0]\n[time]\nduration = 6\n"
        "[scene]\nswath = [11700, 12700]\ncentre_yaw_deg = 0\nreference_range = 'constant'\n"
        f"[beam]\nmode = 'stripmap'\nwidth_deg = 2.0\npattern = 'sinc2'\n{ground}\n"
    )
    blocksar.simulate(tmp_path / "strip.toml", tmp_path / "strip.zarr")
    sides = part(tmp_path / "strip.zarr", ((10300, 10500, 1), (-200, 200, 1)))
    assert run(*sides, thorough=True).warning() is None


@pytest.mark.slow
def test_a_mountain_is_no_error_of_the_track_if_its_heights_are_known() -> None:
    """Places far above the plane have other Doppler rates than it says, as if the track were wrong."""
    places = ((0, 0), (-500, -300), (500, 300), (-400, 400), (420, -380))
    rows = "".join(
        f'[[targets]]\nname = "{k}"\nx = {16105 + x}.0\ny = {19193 + y}.0\n' for k, (x, y) in enumerate(places)
    )
    mountain = "[terrain]\nhills = [{x = 16105.0, y = 19193.0, height = 1500.0, width = 3800.0}]\n"
    text = scene(swath=[28800.0, 31200.0], steering=None, prf=4e3, duration=0.3, bandwidth=30e6, range_sampling=36e6)
    made = Scene.parse(text + mountain + rows)
    collection = made.collection()
    signal = sampler(made, collection)(slice(0, collection.n_pulse))
    grid = Grid(15305.0, 16905.0, 2.0, 18593.0, 19793.0, 2.0)
    plane = run(signal, collection.centred(), grid)
    known = check(signal, collection.centred(), grid=grid, threads=2, thorough=False, terrain=made.terrain)
    assert plane.warning() is not None and plane.given.sharpness < 0.5
    assert known.warning() is None and known.given.sharpness > 0.8


def meadows(seed: int) -> Part:
    """Four patches of clutter under a beam about its axis, with a point in each."""
    rng, rows = np.random.default_rng(seed), ""
    for k, (x, y) in enumerate(((8510.0, -100.0), (8720.0, -40.0), (8560.0, 30.0), (8750.0, 100.0))):
        dx, dy, phases = rng.uniform(-40, 40, 120), rng.uniform(-40, 40, 120), rng.uniform(0, 360, 120)
        rows += "".join(
            f'[[targets]]\nname = "{k}-{i}"\nx = {x + a:.2f}\ny = {y + b:.2f}\nphase_deg = {phase:.1f}\n'
            for i, (a, b, phase) in enumerate(zip(dx, dy, phases, strict=True))
        )
        rows += f'[[targets]]\nname = "P{k}"\nx = {x}\ny = {y}\namplitude = 60.0\n'
    beam = 'mode = "tops"\nwidth_deg = 0.6\nrate_deg = 3.0'
    shape = {"prf": 1200.0, "range_sampling": 48e6, "swath": [9650.0, 10350.0], "time": "duration = 0.8"}
    made = Scene.parse(axis_scene(beam, more=rows, **shape))
    collection = made.collection()
    signal = sampler(made, collection)(slice(0, collection.n_pulse))
    return signal, collection.centred(), Grid(8400.0, 8840.0, 1.0, -150.0, 150.0, 1.0)


@pytest.mark.slow
def test_an_error_of_the_track_is_found_amid_patches_of_clutter() -> None:
    signal, collection, grid = meadows(6)
    assert run(signal, collection, grid).warning() is None
    error = 0.02 * np.sin(2 * np.pi * 6.0 * collection.time + 0.3)[:, None] * np.array([0.6, 0.3, 0.74])
    findings = run(signal, replace(collection, antenna_position=collection.antenna_position + error), grid)
    assert findings.blurred and "the track is off by a phase of" in (findings.warning() or "")


def trial(gain: float, *, echoes: int = 12, focus: float = 0.9, sharpness: float = 0.6, of_beam: bool = False) -> Trial:
    """An alternative that gains so many dB over what is given, each contrast with a variance of 1 dB^2."""
    return Trial(
        "something is wrong", "mend it", (Contrast(20.0, 1.0),) * echoes, (Contrast(20.0 + gain, 1.0),) * echoes,
        (focus,) * echoes, (sharpness,) * echoes, of_beam=of_beam,
    )  # fmt: skip


def given(*, focus: float = 0.9, sharpness: float = 0.6) -> Trial:
    return replace(trial(0.0, focus=focus, sharpness=sharpness), name="as given")


@pytest.mark.parametrize(
    ("gain", "echoes", "believed"), [(2.0, 12, False), (2.1, 12, True), (7.0, 1, False), (7.2, 1, True)]
)
def test_an_alternative_is_believed_beyond_five_standard_deviations(gain: float, echoes: int, believed: bool) -> None:
    found = Findings((given(), trial(gain, echoes=echoes)), 0.6)
    assert (found.better is not None) == believed and (found.warning() is not None) == believed
    assert found.trials[1].verdict == ("sharper" if believed else "not told")


def test_an_alternative_that_takes_points_out_of_focus_is_not_believed() -> None:
    """Contrast that is gained by bringing energy to few cells, none of which is a point, as given places are."""
    assert Findings((given(), trial(9.0, focus=0.4)), 0.6).better is None
    assert Findings((given(focus=0.1), trial(9.0, focus=0.4)), 0.6).better is not None


@pytest.mark.parametrize(("refocus", "believed"), [(8.0, False), (4.1, True), (1.0, True)])
def test_what_an_error_of_the_track_explains_better_is_not_believed(refocus: float, believed: bool) -> None:
    """Of what ties with a refocus, which has a phase to fit and gains by that, the alternative is believed."""
    found = Findings((given(sharpness=0.3), trial(3.0)), 0.6, 1.0, refocus=trial(refocus))
    assert (found.better is not None) == believed
    assert ("the track is off by" in (found.warning() or "")) != believed


def test_a_beam_is_not_believed_where_a_phase_makes_points() -> None:
    """No phase error lights pulses of a dwell; of a blurred dwell a part is less blurred."""
    mended, moved = Concentrations(0.3, 0.9, 0.85), trial(5.0, of_beam=True)
    assert Findings((given(sharpness=0.3), moved), 0.9, points=mended).better is None
    assert Findings((given(sharpness=0.3), replace(moved, of_beam=False)), 0.9, points=mended).better is not None
    assert Findings((given(sharpness=0.3), moved), 0.4, points=Concentrations(0.3, 0.4, 0.35)).better is not None


@pytest.mark.parametrize(("refocused", "doubted"), [(0.08, False), (0.3, True)])
def test_a_track_is_doubted_only_where_a_refocus_makes_points(refocused: float, doubted: bool) -> None:
    """At 20 % of bandwidth points of an exact track reached 0.046 as given, and 0.08: 5 rad were said."""
    found = Findings((given(sharpness=0.5 * refocused),), refocused, 5.0)
    assert (found.warning() is not None) == doubted


@pytest.mark.slow
def test_of_a_beam_in_degrees_that_lights_nothing_for_long_the_unit_is_doubted() -> None:
    scene = exact_scene(11)
    said = replace(scene.collection, beam_azimuth=np.degrees(scene.collection.beam_azimuth)).centred()
    sentence = run(scene.signal, said, scene.grid, thorough=True).sentence()
    assert sentence.startswith("nothing was tested: no place is lit by 64 pulses or more, as if the angles of the beam")


def test_where_nothing_can_be_compared_nothing_is_said_to_fit() -> None:
    assert (
        Findings((Trial("as given", ""),), empty="no place is lit").sentence() == "nothing was tested: no place is lit"
    )
    near_chance = Findings((given(focus=0.1, sharpness=0.05), trial(0.1, focus=0.1)), 0.06)
    assert near_chance.warning() is None and "nothing can be said" in near_chance.sentence()
