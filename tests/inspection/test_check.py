"""The check of the samples against what is said of them: each mistake is found and named, and right ones pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene
from scenes import PAPERS, scene, write_store
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.inspection.check import Findings, Trial, check, part_of, part_to_read
from blocksar.simulation.phase_history import sampler
from blocksar.simulation.scene import Scene

Part = tuple[ComplexArray, Collection, Grid | None]
GRID = PAPERS["paper_b"][1]


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
    return Path(blocksar.simulate("paper_b", tmp_path_factory.mktemp("spotlight") / "ph.zarr"))


@pytest.fixture(scope="module")
def steered(steered_store: Path) -> Part:
    return part(steered_store, None)


@pytest.fixture(scope="module")
def spotlight(spotlight_store: Path) -> Part:
    return part(spotlight_store, GRID)


def run(signal: ComplexArray, collection: Collection, grid: Grid | None, *, thorough: bool = False) -> Findings:
    return check(signal, collection, grid=grid, threads=2, thorough=thorough)


@pytest.mark.parametrize("kind", ["steered", "spotlight"])
@pytest.mark.parametrize("thorough", [pytest.param(False, marks=pytest.mark.slow), True])  # more trials
def test_right_samples_pass(kind: str, thorough: bool, request: pytest.FixtureRequest) -> None:
    findings = run(*request.getfixturevalue(kind), thorough=thorough)
    assert findings.speaks
    assert findings.warning() is None
    assert findings.sentence().startswith("the samples fit what is said of them")
    assert findings.sharpness > 0.9
    if thorough:
        assert len(findings.trials) > 5
        assert findings.given.sharpness > max(trial.sharpness for trial in findings.trials[1:])


SAMPLES: dict[str, Callable[[ComplexArray], ComplexArray]] = {
    "the signal is conjugated": np.conj,
    "the range axis is reversed": lambda s: s[:, ::-1],
    "the phase of the carrier has the other sign": lambda s: np.conj(s[:, ::-1]),
    "the pulses are in the opposite order": lambda s: s[::-1],
}


CONJUGATED = "the signal is conjugated"  # under a beam that is not steered the hardest to tell
OTHER_SIGN = "the phase of the carrier has the other sign"
SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(("steered", CONJUGATED), ("steered", OTHER_SIGN), ("spotlight", CONJUGATED)),
        *(pytest.param("steered", name, marks=SLOW) for name in SAMPLES if name not in (CONJUGATED, OTHER_SIGN)),
        *(pytest.param("spotlight", name, marks=SLOW) for name in SAMPLES if name != CONJUGATED),
    ],
)
def test_wrong_samples_are_found_and_named(name: str, kind: str, request: pytest.FixtureRequest) -> None:
    signal, collection, grid = request.getfixturevalue(kind)
    warning = run(SAMPLES[name](signal), collection, grid).warning()
    assert warning is not None
    if kind == "spotlight" and name == OTHER_SIGN:  # by 0.2 dB only
        assert f"do not tell whether {name}" in warning
    else:
        assert warning.startswith(name)


METADATA: dict[str, Callable[[Collection], dict[str, Any]]] = {
    "x and y are swapped": lambda c: {"antenna_position": c.antenna_position[:, [1, 0, 2]]},
    "the track runs backwards": lambda c: {"antenna_position": c.antenna_position[::-1]},
    "the beam turns the other way": lambda c: {"beam_azimuth": c.beam_azimuth[::-1]},
    "the beam looks to the other side": lambda c: {"beam_azimuth": -c.beam_azimuth},
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n.startswith("the beam") else SLOW) for n in METADATA])
def test_wrong_tracks_and_beams_are_found_and_named(name: str, steered: Part) -> None:
    signal, collection, _ = steered
    warning = run(signal, replace(collection, **METADATA[name](collection)), None).warning()
    assert warning is not None
    assert warning.startswith(name)


def wobble(collection: Collection, size: float) -> Collection:
    """A sinusoidal error of the track, `size` m, in all axes."""
    error = size * np.sin(2 * np.pi * 0.7 * collection.time)[:, None] * np.array([0.6, 0.3, 0.74])
    return replace(collection, antenna_position=collection.antenna_position + error)


def test_six_millimetres_of_track_error_are_noticed(spotlight: Part) -> None:
    signal, collection, grid = spotlight
    findings = run(signal, wobble(collection, 0.006), grid)
    assert findings.blurred
    assert findings.sharpness < 0.7
    assert "autofocus" in (findings.warning() or "")
    assert run(signal, wobble(collection, 0.0003), grid).warning() is None


@pytest.mark.slow
def test_an_error_of_velocity_or_height_is_measured(spotlight: Part) -> None:
    signal, collection, grid = spotlight
    position, time = collection.antenna_position, collection.time - collection.time.mean()
    velocity = (position[-1] - position[0]) / (time[-1] - time[0])
    fast = replace(collection, antenna_position=position + 0.01 * np.outer(time, velocity))
    assert "a velocity that is about 0.99 % too high" in (run(signal, fast, grid).warning() or "")
    high = replace(collection, antenna_position=position + np.array([0.0, 0.0, 20.0]))
    assert "an offset of about 20 m towards +z" in (run(signal, high, grid).warning() or "")


def test_a_scene_without_prominent_places_tells_nothing(steered: Part) -> None:
    signal, collection, _ = steered
    rng = np.random.default_rng(0)
    noise = (rng.standard_normal(signal.shape) + 1j * rng.standard_normal(signal.shape)).astype(np.complex64)
    findings = run(noise, collection, None)
    assert not findings.speaks
    assert findings.warning() is None
    assert "no prominent places" in findings.sentence()


def test_missing_samples_and_spikes_do_not_matter(steered: Part) -> None:
    signal, collection, _ = steered
    damaged = signal.copy()
    damaged[::7] = np.nan
    damaged[100, 50] = 1e30
    findings = run(damaged, collection, None)
    assert findings.speaks
    assert findings.warning() is None


def test_constant_samples_are_a_target_that_the_reference_range_follows(steered: Part) -> None:
    signal, collection, _ = steered
    findings = run(np.full_like(signal, 1 + 2j), collection, None)
    assert findings.speaks and findings.sharpness > 0.9 and not findings.blurred
    assert (findings.warning() or "").startswith("the beam ")  # it is lit by all pulses, though the beam turns


def test_the_command_compares_everything(steered_store: Path) -> None:
    result = CliRunner().invoke(commands.app, ["check", str(steered_store)], prog_name="blocksar")
    assert result.exit_code == 0
    for words in ("as given", "the signal is conjugated", "the samples fit what is said of them"):
        assert words in result.output


def test_a_spotlight_collection_needs_a_grid(spotlight_store: Path) -> None:
    with pytest.raises(InputError, match="grid is missing"):
        blocksar.check(spotlight_store)


@pytest.mark.parametrize("squint", [0.0, pytest.param(12.0, marks=pytest.mark.slow)])
def test_a_strip_is_not_called_wrong_by_its_mirror_image(squint: float, tmp_path: Path) -> None:
    """A beam about its axis on a straight track: flown backwards, the scene is mirrored, and as sharp at broadside."""
    rng = np.random.default_rng(2)
    along = 10392 * np.tan(np.radians(squint))
    ground = "\n".join(
        f'[[targets]]\nname = "{k}"\nx = {x:.2f}\ny = {y:.2f}'
        for k, (x, y) in enumerate(zip(rng.uniform(10350, 10450, 16), along + rng.uniform(-150, 150, 16), strict=True))
    )
    (tmp_path / "strip.toml").write_text(
        "[radar]\ncarrier = 9.6e9\nbandwidth = 100e6\nrange_sampling = 120e6\nprf = 400\npulse_width = 2e-6\n"
        "[track]\nposition = [0, 0, 6000]\nvelocity = [0, 120, 0]\n[time]\nduration = 6\n"
        f"[scene]\nswath = [11700, 12700]\ncentre_yaw_deg = {squint}\nreference_range = 'constant'\n"
        f"[beam]\nmode = 'stripmap'\nwidth_deg = 2.0\nsquint_deg = {0.87 * squint}\npattern = 'sinc2'\n{ground}\n"
    )
    blocksar.simulate(tmp_path / "strip.toml", tmp_path / "strip.zarr")
    signal, collection, grid = part(
        tmp_path / "strip.zarr", ((10300, 10500, 1), (along - 200, along + 200, 1))
    )  # fmt: skip
    assert run(signal, collection, grid, thorough=True).warning() is None
    if squint:
        backwards = replace(collection, antenna_position=collection.antenna_position[::-1])
        assert run(signal, backwards, grid, thorough=True).warning() is not None


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


def meadows(seed: int, *, points: bool) -> Part:
    """Four patches of clutter under a beam about its axis, else nothing, or with a point in each."""
    rng, rows = np.random.default_rng(seed), ""
    for k, (x, y) in enumerate(((8510.0, -100.0), (8720.0, -40.0), (8560.0, 30.0), (8750.0, 100.0))):
        dx, dy, phases = rng.uniform(-40, 40, 120), rng.uniform(-40, 40, 120), rng.uniform(0, 360, 120)
        rows += "".join(
            f'[[targets]]\nname = "{k}-{i}"\nx = {x + a:.2f}\ny = {y + b:.2f}\nphase_deg = {phase:.1f}\n'
            for i, (a, b, phase) in enumerate(zip(dx, dy, phases, strict=True))
        )
        if points:
            rows += f'[[targets]]\nname = "P{k}"\nx = {x}\ny = {y}\namplitude = 60.0\n'
    beam = 'mode = "tops"\nwidth_deg = 0.6\nrate_deg = 3.0'
    shape = {"prf": 1200.0, "range_sampling": 48e6, "swath": [9650.0, 10350.0], "time": "duration = 0.8"}
    made = Scene.parse(axis_scene(beam, more=rows, **shape))
    collection = made.collection()
    signal = sampler(made, collection)(slice(0, collection.n_pulse))
    return signal, collection.centred(), Grid(8400.0, 8840.0, 1.0, -150.0, 150.0, 1.0)


@pytest.mark.slow
def test_clutter_that_fills_no_more_than_patches_is_no_error_of_the_track() -> None:
    """A refocus fits each line's own phase and gains by that: it is no error that other places would show."""
    signal, collection, grid = meadows(6, points=False)
    findings = run(signal, collection, grid)
    assert findings.sharpness < 0.8  # as if the track were wrong
    assert not findings.blurred and findings.warning() is None
    assert "clutter or broad targets" in findings.sentence()


def test_an_error_of_the_track_is_found_amid_patches_of_clutter() -> None:
    signal, collection, grid = meadows(6, points=True)
    assert run(signal, collection, grid).warning() is None
    error = 0.02 * np.sin(2 * np.pi * 6.0 * collection.time + 0.3)[:, None] * np.array([0.6, 0.3, 0.74])
    findings = run(signal, replace(collection, antenna_position=collection.antenna_position + error), grid)
    assert findings.blurred and "the track is off by a phase of" in (findings.warning() or "")


@pytest.mark.parametrize(
    ("given", "other", "believed"),
    [  # two points amid clutter, seen as they are and by a beam that is off; a dwell that is wrong for most points; the
        # same two points of a spotlight with a conjugated signal, whose image is mirrored
        ((0.04, 0.05, 0.06, 0.06, 0.06, 0.09, 0.69, 0.69), (0.05, 0.05, 0.06, 0.07, 0.16, 0.21, 0.35, 0.35), False),
        ((0.05, 0.06, 0.07, 0.08, 0.10, 0.50, 0.62, 0.66), (0.05, 0.07, 0.08, 0.09, 0.38, 0.50, 0.66, 0.70), False),
        ((0.05, 0.06, 0.07, 0.08, 0.10, 0.20, 0.62, 0.66), (0.50, 0.60, 0.65, 0.70, 0.70, 0.71, 0.71, 0.72), True),
        ((0.02, 0.02, 0.03, 0.03, 0.04, 0.04, 0.05, 0.06), (0.05, 0.07, 0.08, 0.09, 0.10, 0.11, 0.20, 0.25), True),
        ((*[0.82] * 6, *[0.99] * 6), (*[0.819] * 4, 0.91, 0.91, *[0.998] * 6), False),
    ],
)
def test_clutter_that_differs_by_chance_is_not_believed(
    given: tuple[float, ...], other: tuple[float, ...], believed: bool
) -> None:
    trials = Trial("as given", "", given, 100.0), Trial("the beam is off", "move it", other, 100.0)
    found = Findings(trials, float(np.median(given)), 0.1, "", "")
    assert (found.better is not None) == believed and (found.warning() is not None) == believed


@pytest.mark.parametrize(
    ("steered", "refocused", "believed"), [(True, 0.65, False), (False, 0.65, False), (False, 0.7, True)]
)
def test_a_mirrored_image_is_believed_only_if_a_refocus_gains(steered: bool, refocused: float, believed: bool) -> None:
    """True samples of a measured spotlight had 0.65, a refocus gained nothing, and with x and y swapped it was 0.83.

    Under a steered beam so small a gain is what a wrong velocity gives; where it is believed, it says so itself.
    """
    trials = Trial("as given", "", (0.65,) * 12, 100.0), Trial("x and y are swapped", "swap them", (0.83,) * 12, 100.0)
    found = Findings(trials, refocused, 0.1, "", "", steered=steered)
    assert (found.warning() is not None) == believed


@pytest.mark.parametrize(("refocused", "doubted"), [(0.08, False), (0.3, True)])
def test_a_track_is_doubted_only_where_a_refocus_makes_points(refocused: float, doubted: bool) -> None:
    """At 20 % of bandwidth points of an exact track reached 0.046 as given, and 0.08: 5 rad were said."""
    given = Trial("as given", "", (0.5 * refocused,) * 9, 300.0, pulses=6000)
    assert (Findings((given,), refocused, 5.0, "", "").warning() is not None) == doubted


def test_an_alternative_that_sees_a_part_of_the_dwell_is_believed_of_points_only() -> None:
    """Clutter of few pulses is more concentrated by chance; with no places as given, it was named by 289 dB."""
    given = Trial("as given", "", (0.05,) * 9, 300.0, pulses=6000)
    part = Trial("the track runs backwards", "reverse it", (0.2,) * 9, 60.0, pulses=650)
    assert Findings((given, part), 0.05, 0.1, "", "").better is None
    assert Findings((given, replace(part, pulses=6000)), 0.05, 0.1, "", "").better is not None
    assert Findings((given, replace(part, concentration=(0.9,) * 9)), 0.05, 0.1, "", "").better is not None
    few = replace(given, concentration=(0.05,) * 2)  # of two places; the other trial had the best of twelve
    assert Findings((few, replace(part, pulses=6000, concentration=(0.07,) * 12)), 0.05, 0.1, "", "").better is None
    none = Findings((Trial("as given", ""), part), 0.0, 0.1, "", "")
    assert none.better is None and not none.speaks
    assert none.sentence().startswith("no prominent places")
