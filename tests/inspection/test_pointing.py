"""The beam against when places are lit: errors of its angle, width and turn are measured, and true ones pass."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from axis_beams import axis_scene
from exact_scenes import exact_scene, samples

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import plan_region
from blocksar.inspection.check import check
from blocksar.inspection.pointing import Pointing, point
from blocksar.inspection.prominent import Contrast, ProfiledSamples
from blocksar.inspection.verdict import Findings, Trial
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import sampler

SLOW = pytest.mark.slow

# The beam, its yaw, PRF and pulses, the swath, and the middle of the targets along y (m). By angle and speed the PRF
# tells 1.4 to 3.1 degrees apart.
BEAMS = {
    "strip": ('mode = "stripmap"\nwidth_deg = 0.8', {"time": "pulses = 601"}, -30.0),
    "squint": (
        'mode = "stripmap"\nwidth_deg = 0.8\nsquint_deg = 14.3',
        {"yaw": 15.0, "swath": [10000.0, 10300.0]},
        2350.0,
    ),
    "tops": ('mode = "tops"\nwidth_deg = 0.8\nrate_deg = 0.8', {"prf": 480, "time": "pulses = 901"}, -30.0),
    "yaw": ("start_deg = -2.5\nstop_deg = 2.5\nwidth_deg = 1.2", {"prf": 640, "time": "pulses = 901"}, -20.0),
}


@cache
def made(kind: str) -> tuple[ComplexArray, Collection]:
    """Samples of 24 points under one of the BEAMS, and what is truly said of them."""
    beam, shape, along = BEAMS[kind]
    rng = np.random.default_rng(5)
    rows = "".join(
        f'[[targets]]\nname = "{i}"\nx = {9000 + dx:.2f}\ny = {along + dy:.2f}\nphase_deg = {phase:.0f}\n'
        for i, (dx, dy, phase) in enumerate(
            zip(rng.uniform(-100, 100, 24), rng.uniform(-80, 80, 24), rng.uniform(0, 360, 24), strict=True)
        )
    )
    scene = Scene.parse(axis_scene(beam, more=rows, **shape))
    collection = scene.collection()
    signal = sampler(scene, collection)(slice(0, collection.n_pulse))
    noise = np.random.default_rng(6).standard_normal((2, *signal.shape))
    signal = (signal + 0.3 * (noise[0] + 1j * noise[1])).astype(np.complex64)
    signal.flags.writeable = False
    return signal, collection.centred()


def found(signal: ComplexArray, collection: Collection, *, thorough: bool = False) -> Findings:
    return check(signal, collection, grid=None, threads=2, thorough=thorough)


def off(collection: Collection, degrees: float) -> Collection:
    field = "beam_azimuth" if collection.beam_steering is None else "beam_steering"
    return replace(collection, **{field: getattr(collection, field) + np.radians(degrees)})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "error"),  # half a width; nearly a PRF, where echoes look hardly displaced; towards the PRF's other end
    [("squint", 0.8), pytest.param("tops", -2.0, marks=SLOW), ("yaw", -0.6), pytest.param("strip", 1.2, marks=SLOW)],
)
def test_a_beam_that_is_off_is_named_with_its_error_and_field(kind: str, error: float) -> None:
    signal, collection = made(kind)
    warning = found(signal, off(collection, error)).warning() or ""
    assert warning.startswith("the beam is off by ")
    assert float(warning.split()[5]) == pytest.approx(error, abs=0.05)
    field = "beam_azimuth" if kind == "yaw" else "beam_steering"
    remedy = next(part for part in warning.split("; ") if part.startswith("add "))
    assert float(remedy.split()[1]) == pytest.approx(-error, abs=0.05)
    assert remedy.split()[4].rstrip(".") == field


@pytest.mark.slow
def test_a_beam_of_half_the_width_is_found() -> None:
    signal, collection = made("yaw")
    width = collection.beam_width or 0.0
    warning = found(signal, replace(collection, beam_width=2 * width)).warning() or ""
    assert warning.startswith("the beam has about 0.5 of the ")
    assert f"give beam_width as {width:.3g} rad" in warning


@pytest.mark.slow
def test_a_beam_between_the_nulls_of_its_pattern_is_not_called_too_wide() -> None:
    """Its middle is brighter a pulse, by 1.7 dB; if the rest was dark, by 3."""
    scene = exact_scene(2)
    collection, width = scene.collection, scene.collection.beam_width
    assert collection.beam_axis is not None and collection.beam_steering is not None and width is not None
    signal = np.zeros_like(scene.signal)
    for dx, dy in ((-20, -12), (-10, 12), (0, 0), (10, -6), (20, 6)):
        place = np.array([scene.targets[:, 0].mean() + dx, dy, 0.0])
        sight = place - collection.antenna_position
        sine = (sight * collection.beam_axis).sum(axis=1) / np.linalg.norm(sight, axis=1)
        two_way = np.sinc(2 * (np.arcsin(sine) - collection.beam_steering) / width) ** 2
        signal += (two_way[:, None] * samples(collection, place[None], np.ones(1))).astype(np.complex64)
    told = judged(signal, collection.centred())
    assert told is not None and told.told and told.found is None and told.narrower


def test_of_tied_alternatives_that_with_fewest_changes_is_believed() -> None:
    given = (Contrast(3.0, 1.0),) * 12

    def trial(name: str, remedy: str, gain: float, changes: int = 1) -> Trial:
        return Trial(name, remedy, given, (Contrast(3.0 + gain, 1.0),) * 12, (0.9,) * 12, (0.7,) * 12, changes)

    trials = trial("as given", "", 0.0), trial("two things are wrong", "mend both", 12.0, 2)
    warning = Findings((*trials, trial("one thing is wrong", "mend it", 11.0)), 0.7).warning() or ""
    assert warning.startswith("one thing is wrong, it seems") and "mend it. " in warning
    assert "do not tell whether two things are wrong" in warning
    warning = Findings((*trials, trial("one thing is wrong", "mend it", 10.0)), 0.7).warning() or ""
    assert warning.startswith("two things are wrong")


def judged(signal: ComplexArray, collection: Collection) -> Pointing | None:
    return point(
        ProfiledSamples(signal, collection, threads=2),
        collection,
        lambda c: Geometry(collection=c),
        lambda geometry: plan_region(geometry, None),
        thorough=True,
    )


def test_noise_tells_nothing_of_the_beam() -> None:
    signal, collection = made("strip")
    rng = np.random.default_rng(1)
    noise = (rng.standard_normal(signal.shape) + 1j * rng.standard_normal(signal.shape)).astype(np.complex64)
    told = judged(noise, collection)
    assert told is not None and not told.told and told.found is None


def test_a_look_and_a_beam_that_is_not_steered_are_not_judged() -> None:
    signal, collection = made("strip")
    assert judged(signal, replace(collection, lit_width=2 * (collection.beam_width or 0.0))) is None
    assert judged(signal, collection.unsteered()) is None


@pytest.mark.slow
def test_an_error_within_a_fifth_of_the_width_is_left_alone() -> None:
    signal, collection = made("yaw")
    assert found(signal, off(collection, 0.18), thorough=True).warning() is None
