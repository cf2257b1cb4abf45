"""Shadow of the terrain in simulated samples, against steps along every ray."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import slow_twins
from echoes import SCENE

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.terrain import Terrain
from blocksar.places import place
from blocksar.simulation import cphd
from blocksar.simulation.scatterers import field, phase_history
from blocksar.simulation.scene import Scene
from blocksar.simulation.scene_ground import cast_shadow
from blocksar.simulation.simulate import sampler

N = 400  # pulses


def passing(beam_width: float | None = None) -> Collection:
    """An antenna that passes by at 3 km, low enough for long shadows, without a beam or with one that turns."""
    time = (np.arange(N) - N // 2) / 100.0
    track = np.array([-2600.0, 0.0, 1500.0]) + time[:, None] * [20.0, 900.0, 10.0]
    yaw = np.full(N, np.nan) if beam_width is None else 0.1 * time
    return Collection(
        carrier=10e9, time=time, range_frequency=(np.arange(16) - 8) * 1e6, reference_range=np.full(N, 3000.0),
        antenna_position=track, beam_azimuth=yaw, beam_width=beam_width, ground_height=0.0,
    )  # fmt: skip


def hills() -> Terrain:
    x, y = np.meshgrid(20.0 * np.arange(-60, 61), 20.0 * np.arange(-60, 61))
    heights = 350 * np.exp(-((x / 130) ** 2) - (y / 200) ** 2) + 200 * np.exp(
        -(((x + 400) / 90) ** 2) - ((y - 250) / 90) ** 2
    )
    return Terrain(x0=-1200.0, dx=20.0, y0=-1200.0, dy=20.0, heights=heights)


@pytest.mark.slow
@pytest.mark.parametrize("beam_width", [pytest.param(None, marks=pytest.mark.slow), 0.12])
def test_pulses_whose_ray_passes_below_the_ground_are_hidden(beam_width: float | None) -> None:
    collection, terrain, random = passing(beam_width), hills(), np.random.default_rng(2)
    x, y = random.uniform(-100, 700, 60), random.uniform(-300, 300, 60)
    z = terrain(x, y) + np.where(np.arange(60) % 5 == 0, 30.0, 0.0)  # some stand above the ground
    shadow = cast_shadow(collection, terrain, x, y, z)
    assert shadow is not None
    pulses = np.arange(0, N, 8)
    found = np.array([shadow.at(pulse, 0, 60) for pulse in pulses]).T
    points, track = np.stack([x, y, z], axis=1), collection.antenna_position
    lit = np.array([[slow_twins.lit(collection, p, px, py) for p in pulses] for px, py in zip(x, y, strict=True)])
    above = np.array([[slow_twins.ray_clearance(terrain, track[p], point) for p in pulses] for point in points])
    wanted = above < 0
    changing = (wanted & lit).any(axis=1) & (~wanted & lit).any(axis=1)
    assert changing.sum() >= 10 and (wanted | ~lit).all(axis=1).any() and (~wanted).all(axis=1).any()
    # The ground is bilinear there and cubic here: only rays that graze it may differ.
    assert (np.abs(above[(found != wanted) & lit]) < 1.5).all()
    assert (found == wanted)[lit].mean() > 0.99
    part = shadow.at(155, 20, 41)
    assert (part == shadow.at(155, 0, 60)[20:41]).all()
    twice = cast_shadow(collection, terrain, x, y, z, threads=2)
    assert twice is not None and (twice.at(200, 0, 60) == shadow.at(200, 0, 60)).all()


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0, 10**9], ids=["transform", "direct"])
def test_scatterers_in_shadow_do_not_echo(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["blocksar.simulation.scatterers"], "DIRECT_LIMIT", limit)
    collection, terrain, random = passing(0.12), hills(), np.random.default_rng(5)
    x, y, sigma = random.uniform(50, 600, 25), random.uniform(-300, 300, 25), np.exp(1j * random.uniform(-3, 3, 25))
    z = terrain(x, y)
    seen = field(collection, x, y, sigma, z, terrain=terrain)
    assert seen.shadow is not None and seen.z is not None
    everyone = slice(0, N)
    total, lacking = np.zeros((N, 16), complex), 0
    for i in range(25):
        echo = phase_history(field(collection, seen.x[i], seen.y[i], seen.reflectivity[i], seen.z[i]), pulses=everyone)
        hidden = np.array([seen.shadow.at(pulse, i, i + 1)[0] for pulse in range(N)])
        lacking += (hidden & (np.abs(echo).max(axis=1) > 0)).sum()
        total += np.where(hidden[:, None], 0, echo)
    assert lacking > 500
    assert np.abs(phase_history(seen, pulses=everyone) - total).max() < 2e-5


def test_a_scene_loses_what_its_hill_hides(tmp_path: Path) -> None:
    scene = (
        SCENE
        + """
[terrain]
spacing = 20.0
hills = [{x = 6000.0, y = 7000.0, height = 700.0, width = 400.0}]
[[targets]]
name = "behind"
x = 6180.0
y = 7190.0
[[targets]]
name = "before"
x = 5700.0
y = 6700.0
"""
    )
    format_ = pytest.importorskip("sarkit.cphd", reason="the extra `formats` is not installed")
    hilly = Scene.parse(scene)
    collection = hilly.collection()
    for keep, peak in ((0, 0.0), (1, 1.0)):
        alone = hilly.model_copy(update={"targets": (hilly.targets[keep],)})
        assert np.abs(sampler(alone, collection)(slice(0, 151))).max() == pytest.approx(peak, abs=1e-3)
        with open(cphd.simulate(alone, tmp_path / f"{keep}.cphd"), "rb") as file, format_.Reader(file) as reader:
            assert np.abs(reader.read_signal("1")).max() == pytest.approx(peak, abs=1e-3)
    flat = cast_shadow(collection, Terrain.flat(12.0, (5000.0, 7000.0), (6000.0, 8000.0)), *np.full((3, 1), 6500.0))
    assert flat is None


def test_a_mountain_before_the_scene_hides_its_targets(tmp_path: Path) -> None:
    """It stands between the antenna and all that is lit; from hills, and from a file."""
    hill = "hills = [{x = 3870.0, y = 4534.0, height = HEIGHT, width = 400.0}]\nspacing = 40.0\n"
    target = '[[targets]]\nname = "A"\nx = 6180.0\ny = 7190.0\n'

    def echo(terrain: str) -> float:
        scene = Scene.parse(f"{SCENE}[terrain]\n{terrain}{target}")
        assert scene.terrain is not None and np.ptp(scene.terrain.heights) < 1e-3
        return float(np.abs(sampler(scene, scene.collection())(slice(0, 151))).max())

    assert echo(hill.replace("HEIGHT", "1500.0")) == 0.0
    assert echo(hill.replace("HEIGHT", "900.0")) == pytest.approx(1.0, abs=1e-3)  # the ray passes 1150 m high
    x, y = 40.0 * np.arange(60, 210), 40.0 * np.arange(90, 230)
    away = (x - 3870) ** 2 + (y[:, None] - 4534) ** 2
    ground = Terrain(x0=x[0], dx=40.0, y0=y[0], dy=40.0, heights=12 + 1500 * np.exp(-away / 240**2))
    stores.write_terrain(place(tmp_path / "ground.zarr"), ground)
    assert echo(f'file = "{tmp_path}/ground.zarr"\n') == 0.0
