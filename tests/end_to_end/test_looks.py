"""Sub-aperture looks: parts of each dwell, whose sum is the image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from axis_beams import axis_scene
from scenes import write_store

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.collection.sublooks import entering_side
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.processors.chain.processor import predicted_blocks
from blocksar.runs.record import RunRecord

SETTINGS: dict[str, Any] = {"workers": 0}
CLUTTER = "[clutter]\nscatterers = 500\npower = 1e-3\nseed = 3\n"


TARGET = '[[targets]]\nname = "T"\nx = 9000.0\ny = 0.0\n'


def coherence(a: Any, b: Any) -> float:
    seen = np.isfinite(a) & np.isfinite(b)
    assert seen.mean() > 0.5
    a, b = a[seen].astype(complex), b[seen].astype(complex)
    return float(abs(np.vdot(a, b)) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real))


def check_sum(store: Path, folder: Path, grid: Any, count: int, **more: Any) -> None:
    """The looks, each times its number of lit pulses, sum up to the image, and follow each other in time."""
    settings = {**SETTINGS, **more, "grid": grid}
    blocksar.focus(store, folder / "whole", **settings)
    said = blocksar.focus(store, folder / "looks", looks=count, **settings).summary
    assert f"has the images of {count} looks" in said[-1]
    history = stores.open_phase_history(store)
    if history.collection.steered:  # that the samples saw more than a look of the beam is no fault
        assert not any("note:" in line for line in said)
    whole, looks = blocksar.open(folder / "whole").image, blocksar.open(folder / "looks").image
    assert looks.dims == ("look", "y", "x") and looks.look.values.tolist()[0] == "look-1"
    x, y = np.meshgrid(whole.x.values, whole.y.values)
    side, total, pulses, before = 1.0, 0, 0, -1
    geometry = Geometry(collection=history.collection.centred())
    if history.collection.steered:
        side = entering_side(geometry, float(x.mean()), float(y.mean()))
    dated = replace(history, attrs={"source": {"time_zero": 7.0}})
    for number in range(count):
        view = dated.of_look(number, count, side)
        first, last = Geometry(collection=view.collection.centred()).beam.longest_pass(x, y)
        start = 0 if view.cut is None else view.cut[0]
        middle = start + int(first[first.shape[0] // 2, first.shape[1] // 2])
        assert middle > before
        before = middle
        since = view.attrs["source"]["time_zero"] - 7.0  # its slow time counts from there
        np.testing.assert_allclose(since + view.collection.time, history.collection.time[start:][: view.shape[0]])
        total = total + np.nan_to_num(looks.values[number]) * (last - first)
        pulses = pulses + (last - first)
    assert coherence(total / np.maximum(pulses, 1), np.where(pulses > 0, whole.values, np.nan)) > 0.998


@pytest.mark.slow
def test_looks_of_a_steered_beam_sum_up_to_the_image(tmp_path: Path) -> None:
    where = "range = [29950.0, 30050.0]\nyaw_deg = [49.9, 50.1]\n"
    store = write_store(tmp_path, swath=[29_800.0, 30_200.0], more=CLUTTER + where)
    geometry = Geometry(collection=stores.open_phase_history(store).collection.centred())
    x, y, _ = (round(float(at)) for at in geometry.ground_point(np.array(30_000.0), np.array(np.radians(50.0))))
    grid = ((x - 30.0, x + 30.0, 1.0), (y - 30.0, y + 30.0, 1.0))
    check_sum(store, tmp_path, grid, 2, blocks=1, coefficients="closed-form")
    for dry in (False, True):
        with pytest.raises(InputError, match=r"^look look-1: grid .* lies outside the swath"):
            blocksar.focus(store, tmp_path / "no", looks=2, grid="98980:99020:1,-20:20:1", dry_run=dry, **SETTINGS)
    run = tmp_path / "looks"
    report = blocksar.quality(run, area=f"{x - 25}:{x + 25},{y - 25}:{y + 25}")
    found = report.result["looks"]
    assert [look["name"] for look in found["each"]] == ["look-1", "look-2"]
    assert [look["part"] for look in found["each"]] == [pytest.approx(part, abs=0.01) for part in ([0, 0.5], [0.5, 1])]
    assert min(look["within"] for look in found["each"]) > 0.9  # the rest leaks out of chips of 60 pixels
    assert found["mean_looks"] > 1.1 * max(look["looks"] for look in found["each"])
    assert report.summary[0] == "look-1 of look-1, look-2; --channel chooses another"
    blocksar.report(run)
    page = (run / "looks" / "look-2" / "report.html").read_text()
    assert "of the power of a look lie in its own part" in page and "<h1>test, look-2</h1>" in page


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strip")
    more = CLUTTER + "x = [8950.0, 9050.0]\ny = [-50.0, 50.0]\n"
    (folder / "scene.toml").write_text(axis_scene('mode = "stripmap"\nwidth_deg = 0.8\n', more=more))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "phase_history.zarr"))


@pytest.mark.slow
def test_looks_of_a_beam_about_its_axis_sum_up_to_the_image(strip: Path, tmp_path: Path) -> None:
    check_sum(strip, tmp_path, ((8980.0, 9020.0, 1.0), (-20.0, 20.0, 0.5)), 2, processor="backprojection")


@pytest.mark.slow
def test_a_plan_of_looks_is_the_one_that_focus_makes(strip: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {**SETTINGS, "grid": ((8980.0, 9020.0, 1.0), (-20.0, 20.0, 0.5)), "looks": 2}
    settings |= {"processor": "angular-division", "blocks": 1}
    plan = blocksar.plan(strip, **settings)
    rehearsed = blocksar.focus(strip, tmp_path / "run", dry_run=True, **settings)
    assert list(map(predicted_blocks, rehearsed.result)) == list(map(predicted_blocks, plan.result))
    would = [line.partition(": about")[0] for line in rehearsed.summary if "would write" in line]
    assert would == [f"look-{n}: would write {tmp_path}/run/looks/look-{n}" for n in (1, 2)]
    assert sum("nothing was done" in line for line in rehearsed.summary) == 1 and not (tmp_path / "run").exists()
    blocksar.focus(strip, tmp_path / "run", threads=1, **settings)
    for number, planned in enumerate(plan.result, 1):
        record = RunRecord.read(place(tmp_path / "run" / "looks" / f"look-{number}"))
        assert record.plan.predicted == predicted_blocks(planned) and record.plan.memory == planned.memory
    whole = blocksar.plan(strip, **settings | {"looks": None})
    (header, rows), (blocks, _) = plan.tables
    widths = [float(row[header.index("azimuth width (m)")].split()[-1]) for row in rows]
    assert [row[0] for row in rows] == ["whole dwell", "look-1", "look-2"] and blocks[0] == "look-1: block"
    assert rows[0][1] == str(whole.result.n_blocks) and widths[1] == pytest.approx(2 * widths[0], rel=0.2)
    assert plan.summary[0] == "each look sees 0.4 of the beam's 0.8 degrees, the first in time first"
    assert len(plan.details) == 1 + 2 * len(whole.details)
    # Of exact back-projection, the pulses of each.
    exact = blocksar.plan(strip, **settings | {"processor": "backprojection", "blocks": "auto"}).summary
    pulses = [int(line.split(" lit pulses")[0].split()[-1]) for line in exact[1:4]]
    assert pulses[0] == pytest.approx(sum(pulses[1:]), abs=2)


@pytest.mark.slow
def test_a_beam_that_stays_on_its_ground_has_no_looks(tmp_path: Path) -> None:
    """Parts of its width see parts of the ground: without the beam, looks are parts of the pulses."""
    (tmp_path / "scene.toml").write_text(axis_scene('mode = "spotlight"\nwidth_deg = 0.8\n', more=TARGET))
    store = Path(blocksar.simulate(tmp_path / "scene.toml", tmp_path / "phase_history.zarr"))
    grid = ((8980.0, 9020.0, 1.0), (-20.0, 20.0, 0.5))
    for call in (blocksar.plan, lambda source, **given: blocksar.focus(source, tmp_path / "no", **given)):
        with pytest.raises(InputError, match=r"^looks = 3: the beam stays on its ground, .*; write the phase history"):
            call(store, looks=3, grid=grid, **SETTINGS)
    with xr.open_zarr(store) as dataset:
        still = dataset.load().drop_vars(["beam_axis", "beam_steering"])
        still.attrs = {
            name: value for name, value in still.attrs.items() if name not in ("beam_width", "side_of_track")
        }
        blocksar.write(still, tmp_path / "still.zarr")
    still_looks = blocksar.plan(tmp_path / "still.zarr", looks=3, grid=grid, processor="angular-division", **SETTINGS)
    assert len(still_looks.result) == 3


@pytest.mark.slow
def test_looks_of_an_unsteered_collection_are_parts_of_its_pulses(tmp_path: Path) -> None:
    time = (np.arange(400) - 200) / 200.0
    track = np.stack([-6000 + 0 * time, 150 * time, 4000 + 0 * time], axis=1)
    frequency, reference = (np.arange(96) - 48) * 1e6, np.linalg.norm(track, axis=1)
    signal = np.zeros((time.size, frequency.size), np.complex128)
    for x, y in np.random.default_rng(0).uniform(-25, 25, (60, 2)):
        distance = np.linalg.norm([x, y, 0.0] - track, axis=1) - reference
        signal += np.exp(-4j * np.pi / 299792458.0 * np.outer(distance, 9.6e9 + frequency))
    dataset = blocksar.collection(
        signal=signal, time=time, range_frequency=frequency, reference_range=reference, antenna_position=track,
        carrier_frequency=9.6e9, noise_power=0.01,
    )  # fmt: skip
    blocksar.write(dataset, tmp_path / "ph.zarr")
    check_sum(tmp_path / "ph.zarr", tmp_path, ((-30.0, 30.0, 0.5), (-30.0, 30.0, 0.5)), 3)
    with blocksar.open(tmp_path / "looks") as joint:  # each has the noise of its own weights
        assert joint.noise_equivalent.dims == ("look", "y", "x")
        for number, name in enumerate(joint.look.values):
            with xr.open_zarr(tmp_path / "looks" / "looks" / name / "image.zarr", consolidated=False) as alone:
                np.testing.assert_array_equal(joint.noise_equivalent[number], alone.noise_equivalent)
        level = joint.isel(look=1).sar.noise_db()
        assert level.dims == ("y", "x") and np.isfinite(level).mean() > 0.9
    with pytest.raises(InputError, match="take fewer looks"):
        blocksar.focus(tmp_path / "ph.zarr", tmp_path / "wrong", looks=30, **SETTINGS)
    with pytest.raises(InputError, match="in a store"):
        blocksar.focus(dataset, tmp_path / "wrong", looks=2, grid=((-30.0, 30.0, 0.5), (-30.0, 30.0, 0.5)))
