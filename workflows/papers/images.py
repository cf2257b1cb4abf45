"""Paper A's Figures 12 and 13: blocks and mosaic."""

from __future__ import annotations

from functools import partial

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.steps.step import stages
from blocksar.products.pictures import blocks
from blocksar.products.pictures.overview import overview
from blocksar.products.pictures.panels import Mark, Panel, as_map, plot_panels
from blocksar.stores import read_region
from papers.bench import THREADS, Bench, Run, plan_scene, scene, targets
from papers.comparison import Exhibit, Row, above, below, crossed, listed
from papers.printed import BLOCK_COLUMNS, BLOCK_PIXELS, MIDDLE, MOSAIC_PIXELS, NAMES, PIXEL


def block_of(plan: Plan, target: Target) -> int:
    """Index of the block that owns a target."""
    yaw = float(plan.geometry.yaw(np.array(target.x), np.array(target.y)))
    return int(np.clip(np.searchsorted(plan.seams, yaw) - 1, 0, plan.n_blocks - 1))


def figure12(bench: Bench) -> Exhibit:
    """Images of the blocks in their range-Doppler grids, from the recovered spectrum of the run."""
    run, plan, path = bench.run("table1", blocks=3), plan_scene("table1", 3), bench.picture("fig12")
    owners = {target: block_of(plan, target) for target in targets("table1")}
    panels, off, doppler = [], 0.0, dict[str, float]()
    for block in plan.blocks:
        image, grid = _block_image(run, block), block.ground.doppler
        own = [target for target, owner in owners.items() if owner == block.index]
        row, column, *_ = block.ground.locate(np.array([t.x for t in own]), np.array([t.y for t in own]))
        off = max(off, _distance(image, row, column))
        doppler |= {target.name: grid.start + grid.step * c for target, c in zip(own, column, strict=True)}
        panels.append(_block_panel(image, block, {t.name: (r, c) for t, r, c in zip(own, row, column, strict=True)}))
    leaning = abs(doppler["C1"] - doppler["A1"]) / 1e3
    plot_panels(panels, path, columns=3, size=(3.7, 4.2), title="Focused blocks in range and Doppler",
                bar="power (dB, not calibrated)")  # fmt: skip
    return Exhibit(
        title="Figure 12: images of the angular blocks",
        text="The focused blocks of the run of Figure 13 before geometric correction: range against Doppler, the "
        "strongest sample in each cell of the picture. The columns of targets are tilted and bent by the geometric "
        "distortion. Names stand beside the predicted positions.",
        pictures=[path],
        rows=[
            Row("Doppler of A1 and C1, of one azimuth, differs by", leaning, "kHz", above(0.1, "obvious distortion")),
            Row("strongest samples, largest distance from the predicted positions", off, "samples"),
        ],
    )


def _block_image(run: Run, block: BlockPlan) -> ComplexArray:
    """Focus one block of the recovered spectrum: (range, Doppler)."""
    bins = slice(block.first_bin, block.first_bin + block.n_bin)
    samples = np.ascontiguousarray(read_region(run.folder / "spectrum.zarr", "spectrum", (bins, slice(None))).T)
    for stage in stages(block.chain):
        samples = stage.apply(samples, threads=THREADS)
    return samples[: block.ground.rows.size, : block.ground.doppler.size]


def _distance(image: ComplexArray, row: FloatArray, column: FloatArray, reach: int = 4) -> float:
    """Largest distance, in samples, of the strongest sample from the predicted position near which it lies."""
    worst = 0.0
    for r, c in zip(row, column, strict=True):
        r0, c0 = round(r) - reach, round(c) - reach
        about = np.abs(image[r0 : r0 + 2 * reach + 1, c0 : c0 + 2 * reach + 1])
        peak = np.unravel_index(int(about.argmax()), about.shape)
        worst = max(worst, abs(r0 + int(peak[0]) - r), abs(c0 + int(peak[1]) - c))
    return float(worst)


def _block_panel(image: ComplexArray, block: BlockPlan, places: dict[str, tuple[float, float]]) -> Panel:
    doppler, rng = block.ground.doppler, block.ground.rows
    picture = overview(lambda r, c: image[r, c], doppler.values, rng.values, max_pixels=500)
    marks = [
        Mark(name, (doppler.start + doppler.step * (c + 60)) / 1e3, (rng.start + rng.step * (r + 60)) / 1e3)
        for name, (r, c) in places.items() if name in NAMES
    ]  # fmt: skip
    title = f"({'abc'[block.index]}) block {block.index + 1}"
    shown = as_map(picture, scale=(1e-3, 1e-3))
    return Panel(title, "Doppler (kHz)", "range from the centre (km)", map=shown, marks=marks)


def pixel(target: Target, response: PointResponse) -> tuple[float, float]:
    """Measured position in pixels of the paper's picture: ground range, azimuth."""
    area = scene("table1")
    cos, sin = np.cos(area.centre_yaw), np.sin(area.centre_yaw)
    dx, dy = target.x + response.error_x - area.centre[0], target.y + response.error_y - area.centre[1]
    return MIDDLE + float(dx * cos + dy * sin) / PIXEL, MIDDLE + float(dy * cos - dx * sin) / PIXEL


def figure13(bench: Bench) -> Exhibit:
    """Each block after geometric correction, and the mosaic; positions of targets."""
    run, path, whole = bench.run("table1", blocks=3), bench.picture("fig13"), bench.picture("fig13d")
    panels = []
    for index in range(3):
        picture = overview(partial(_owned, run, index), run.x, run.y, max_pixels=500)
        title, shown = f"({'abc'[index]}) block {index + 1}", as_map(picture, scale=(1e-3, 1e-3))
        panels.append(Panel(title, "x (km)", "y (km)", map=shown, equal=True))
    plot_panels(panels, path, columns=3, size=(3.7, 3.3), title="Blocks after geometric correction",
                bar="power (dB, unit reflectivity = 0)")  # fmt: skip
    blocks.plot_mosaic(
        run.read, run.x, run.y, whole, read_block=run.read_block, targets=targets("table1"), labels=NAMES,
        title="(d) blocks combined",
    )  # fmt: skip
    measured = run.measured("table1")
    places = {target.name: pixel(target, measured[target.name]) for target in targets("table1")}
    off = max(float(np.hypot(r.error_x, r.error_y)) for r in measured.values())
    pixels = [
        *(row for name in MOSAIC_PIXELS for row in _pixel_rows(f"{name}, mosaic", places[name], MOSAIC_PIXELS[name])),
        *(row for name in BLOCK_PIXELS for row in _pixel_rows(f"{name}, block {name[1]}", (
            places[name][0], places[name][1] - BLOCK_COLUMNS[name[1]]), BLOCK_PIXELS[name])),
    ]  # fmt: skip
    accuracy = Row(
        f"largest position error of {len(measured)} targets", off, "m", below(PIXEL, "within a 2 m cell"), digits=4
    )
    return Exhibit(
        title="Figure 13: images after geometric correction",
        text="(a) to (c) show the part of the mosaic (d) that each block owns, the strongest pixel in each cell of the "
        "picture; yellow lines are the borders of the blocks. Positions are measured peaks in pixels of the paper's "
        "picture: 2 m, ground range first, B2 at (1276, 1276). The pictures of the blocks begin at columns 0, 850 and "
        "1700 of the mosaic, as follows from the printed A2, A3 and B2.",
        pictures=[path, whole],
        rows=[accuracy, *pixels],
        tables=[listed([accuracy]), crossed(pixels)],
        notes=["The paper lists C1 twice among the mosaic's targets; the fourth position is that of A3."],
    )


def _owned(run: Run, index: int, rows: slice, columns: slice) -> ComplexArray:
    """Pixels of the mosaic that one block owns; NaN elsewhere."""
    return np.where(run.read_block(rows, columns) == index, run.read(rows, columns), np.complex64(np.nan))


def _pixel_rows(name: str, ours: tuple[float, float], printed: tuple[int, int]) -> list[Row]:
    axes = ("ground range", "azimuth")
    return [Row(f"{name}: {axis}", o, "pixels", p, 1.0) for axis, o, p in zip(axes, ours, printed, strict=True)]
