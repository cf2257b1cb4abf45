"""Predicted coherence: the closed form of what the ends of a dwell lose, and what a plan says of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene
from scenes import PAPERS, SMALL_SCAN, scene
from scipy.special import fresnel

import blocksar
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Taper
from blocksar.processors.chain.dwells.dwell_ends import end_energy
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.planning.prediction import ImageEdges
from blocksar.processors.chain.processor import describe_shortfall
from blocksar.simulation.scene import Scene


@pytest.mark.parametrize("displaced", [0.0, 0.3e-3, -1e-3, 4e-3])  # s
@pytest.mark.parametrize("area", [1e-6, -4e-7])  # s^2
def test_the_energy_at_an_end_is_that_of_its_integral(area: float, displaced: float) -> None:
    """Integrate |F(t) - H(t - d)|^2 with F the Fresnel-smoothed step, sample by sample; its tails fall as 1 / t^2."""
    step, reach = 1e-6, 0.5
    t = np.arange(-reach, reach, step) + step / 2
    sine, cosine = fresnel(t * np.sqrt(2 / abs(area)))
    smeared = 0.5 + (cosine + 1j * sine) * np.exp(-0.25j * np.pi) / np.sqrt(2)
    total = np.sum(np.abs(smeared - (t > displaced)) ** 2) * step + abs(area) / (2 * np.pi**2 * reach)
    assert end_energy(np.array(area), np.array(displaced)) == pytest.approx(total, rel=2e-3)


def test_the_energy_of_an_end_is_that_of_the_fresnel_integrals() -> None:
    """Between knots of the table, at them, and beyond it."""
    z = np.concatenate([np.linspace(0, 9, 4001), np.geomspace(1e-9, 1e3, 1000), np.arange(9.0)])
    sine, cosine = fresnel(z)
    quarter = np.pi / 2 * z**2
    exact = (z * (sine + cosine) + (np.cos(quarter) - np.sin(quarter)) / np.pi) / np.sqrt(2)
    np.testing.assert_allclose(end_energy(np.ones(1), z / np.sqrt(2)), exact, rtol=1e-11, atol=0)
    assert np.isnan(end_energy(np.ones(1), np.array([np.nan]))).all()


def test_a_sharp_end_loses_its_displacement() -> None:
    assert end_energy(np.array(0.0), np.array(-2e-3)) == pytest.approx(2e-3, rel=1e-3)


def test_a_plan_predicts_coherence_and_what_it_is_made_of() -> None:
    report = blocksar.plan("table1", blocks=3)
    for block in report.result.blocks:
        p = block.prediction
        losses = (p.phase_loss, p.range_loss, p.dispersion_loss, p.track_loss)
        assert p.coherence == pytest.approx(1 - sum(losses))
        assert 0.999 < p.coherence < 0.9998
        assert p.dispersion_loss == max(losses)
    assert report.result.coherence == min(block.prediction.coherence for block in report.result.blocks)
    assert len(report.details[1][1]) == 3
    assert any("predicted coherence" in line for line in report.summary)


def test_without_a_steered_beam_nothing_is_lost_at_the_ends_of_dwells() -> None:
    processor, grid = PAPERS["paper_b"]
    for block in blocksar.plan("paper_b", processor=processor, blocks=3, grid=grid).result.blocks:
        assert block.prediction.dispersion_loss == 0.0
        assert 0.99 < block.prediction.coherence < 1.0


def test_a_fidelity_that_no_division_keeps_is_told_with_what_is_reached(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(scene(**SMALL_SCAN | {"steering": None, "dwell": None, "prf": 12e3}))
    grid = ((16090.0, 16130.0, 0.5), (19170.0, 19210.0, 0.5))
    report = blocksar.plan(path, fidelity=0.99999999, grid=grid, processor="angular-division")
    (told,) = (line for line in report.summary if "is not kept" in line)
    plan = report.result
    assert told.startswith("fidelity 0.99999999 is not kept by any division that was tried: ")
    assert f"{plan.n_blocks} block" in told and f"coherence {plan.coherence:.6g} predicted" in told
    assert "--blocks" not in told and "--processor" in told
    # A plan that keeps the coherence but changes the side lobes too much says so.
    worst = plan.blocks[0].prediction
    changed = worst._replace(coherence=1.0, pslr=worst.ideal_pslr + 1.0)
    told = describe_shortfall(replace(plan, blocks=[replace(plan.blocks[0], prediction=changed)]))
    assert told.startswith("fidelity 0.99999999 is kept in coherence, but side lobes to ")
    assert f"side lobes of {changed.pslr:.2f} dB instead of {worst.ideal_pslr:.2f} predicted" in told


@pytest.mark.slow
def test_side_lobes_are_judged_by_those_of_back_projection() -> None:
    """On a curved track a target is not seen at evenly spaced angles: the sum over all pulses has other side lobes."""
    processor, grid = PAPERS["paper_b"]
    plan = blocksar.plan("paper_b", processor=processor, blocks=7, grid=grid, weighting="taylor:4:-35").result
    collection, geometry, block = plan.geometry.collection, plan.geometry, plan.blocks[3]
    taper, time = Taper.parse("taylor:4:-35"), collection.time
    weights = taper(2 * (time - time.mean()) / (np.ptp(time) + collection.pulse_interval))
    rng, yaw = (block.ground.near + block.ground.far) / 2, (block.low + block.high) / 2
    point, beside = (geometry.ground_point(np.array(rng), np.array(yaw + turn)) for turn in (0.0, 1e-6))
    away = [np.linalg.norm(collection.antenna_position - place, axis=1) for place in (point, beside)]
    turns = 2 / collection.wavelength * (away[1] - away[0]) / 1e-6  # cycles/rad
    offsets = np.linspace(-4, 4, 801) / np.ptp(turns)
    response = np.abs((weights * np.exp(2j * np.pi * np.outer(offsets, turns - turns.mean()))).sum(axis=1))
    lobes = response[1:-1][(response[1:-1] > response[:-2]) & (response[1:-1] > response[2:])]
    side = 20 * np.log10(np.sort(lobes)[-2] / lobes.max())
    assert side > taper.ideal.pslr + 0.4
    assert block.prediction.ideal_pslr == pytest.approx(side, abs=0.05)
    assert block.prediction.pslr == pytest.approx(side, abs=0.25)


@pytest.mark.slow
def test_a_high_fidelity_leaves_less_residual_phase() -> None:
    """The outermost blocks of `table1` too, where the first kind of chain that is tried folds lines at some ranges."""
    sharp = blocksar.plan("table1", blocks=7, weighting="taylor:4:-35", fidelity=0.999995).result
    assert max(block.prediction.phase_loss for block in sharp.blocks) < 0.3 * (1 - sharp.fidelity)


@pytest.mark.slow
def test_a_weighting_is_planned_and_predicted() -> None:
    """Ends of dwells lose by the square of their weight, and slopes some; widths and side lobes are the taper's."""
    plain = blocksar.plan("table1", blocks=3).result
    report = blocksar.plan("table1", blocks=3, weighting="taylor:4:-35")
    azimuth = blocksar.plan("table1", blocks=3, weighting_azimuth="taylor:4:-35").result
    share = Taper.parse("taylor:4:-35")
    v = np.linspace(-1, 1, 2001)
    lost = float(share(np.array(1.0))) ** 2 / float(np.mean(share(v) ** 2))
    for before, tapered, block in zip(plain.blocks, azimuth.blocks, report.result.blocks, strict=True):
        assert 0.95 < tapered.prediction.dispersion_loss / (lost * before.prediction.dispersion_loss) < 1.06
        # The weighting of the band counts its ends less, where the keystone moves the ends of dwells most.
        assert 0.7 < block.prediction.dispersion_loss / tapered.prediction.dispersion_loss < 0.95
        # -34.86 dB in exact back-projection: the beam moves on from pixel to pixel.
        assert block.prediction.pslr == pytest.approx(-34.86, abs=0.1)
        assert block.prediction.ideal_pslr == pytest.approx(-34.86, abs=0.05)
        widened = block.prediction.resolution / before.prediction.resolution
        assert widened == pytest.approx(share.ideal.width / 0.885893, rel=1e-3)
    assert any("ideal side lobes -35.17 dB in range" in line for line in report.summary)


def test_losses_at_edges_are_interpolated_between_targets_on_either_side() -> None:
    """Along yaw: what is imaged may end within a block, or lie between two targets."""
    yaw, lost = np.array([0.0, 1.0, 3.0, 4.0]), np.array([[0.0, 1.0, 3.0, 8.0], [0.0, 2.0, 6.0, 16.0]])
    full = np.ones((2, 4), np.bool_)

    def between(first: float, last: float, full: Any = full) -> ImageEdges:
        return ImageEdges.between(yaw, np.full(2, first), np.full(2, last), axis=1).of_dwells(full)

    some = between(0.5, 3.25)
    np.testing.assert_array_equal(some.held, [[False, True, True, False]] * 2)
    np.testing.assert_allclose(some.at(lost), [[0.5, 1.0, 3.0, 4.25], [1.0, 2.0, 6.0, 8.5]])
    narrow = between(1.5, 2.0)
    np.testing.assert_array_equal(narrow.held, [[False, True, True, False]] * 2)
    np.testing.assert_allclose(narrow.at(lost)[0], [0.0, 1.5, 2.0, 8.0])
    assert between(-1.0, 5.0).held.all() and not between(-1.0, 5.0).before.any()
    cut = between(0.5, 3.25, full & (np.arange(4) < 3))
    assert cut.before[:, 0].all() and not cut.behind.any()


def test_a_window_of_few_cells_is_judged_at_its_edges() -> None:
    """Targets are traced over 64 cells at least; migration in a narrower one was judged at the outermost inside."""
    rng, near, far = np.array([0.0, 10.0, 20.0]), np.full(1, 4.0), np.full(1, 17.0)
    edges = ImageEdges.between(rng, near, far, axis=0)
    np.testing.assert_allclose(edges.at(np.array([[10.0], [0.0], [20.0]]))[:, 0], [6.0, 0.0, 14.0])


@pytest.mark.slow
def test_a_swath_close_to_the_nadir_is_mapped_by_ground_range() -> None:
    """Targets of one apparent range are sought beyond the swath: nearer than the platform's height there are none."""
    text = axis_scene(
        'mode = "stripmap"\nwidth_deg = 2.0', bandwidth=200e6, range_sampling=240e6, prf=600, pulse_width=1e-6,
        height=3000.0, velocity=[0.0, 120.0, 0.0], acceleration=[0.0, 0.0, 0.0], time="duration = 4.0",
        swath=[3002.0, 3140.0], more='reference_range = "scene_centre"',
    )  # fmt: skip
    grid = Grid(200.0, 800.0, 2.3, -60.0, 60.0, 0.3)
    collection = Scene.parse(text).collection()
    whole = plan_collection(collection, grid=grid, blocks=7)
    # Measured: 0.9995 in the worst 32 pixels. A map in range instead of ground range left 0.967 there.
    assert 0.992 < whole.coherence < 0.9995
    assert max(block.prediction.range_loss for block in whole.blocks) < 2e-3
