"""Inspect the output of a run with xarray: an image of any size, in the memory of a few chunks.

    python workflows/look_at_outputs.py demo-run

RUN is a finished run of `blocksar focus`, `blocksar demo` or `first_image.py`. Every function below answers one
question about a run, and can be copied on its own:

    decimate           the strongest pixel of every cell: `chunk` hands an array to dask, which processes it chunk by
                       chunk, so that no whole array is ever in memory
    fully_swept        whether ground was lit for a full dwell: collection.zarr holds track and beam. At the ends of a
                       scan a pixel is the mean of few pulses, in which everything at its range adds up: do not look
                       for targets there
    brightest_target   position of the strongest pixel: first its cell of the decimated picture, then the pixel, in dB
    look_direction     when and from where a point was lit
    cuts_through       dB along the look and across it, by band-limited interpolation. `image` keeps its carrier, tens
                       of cycles per metre: do not interpolate its `abs`, use `ds.sar.cut`
    print_coverage     the ground that each block covers, from `block`: -1 is no block, where `image` is NaN, never 0
    print_record       run.json: settings, the seconds of every stage, a receipt for every unit of work
    print_predictions  the prediction of the plan for each block and the measured figures. A prediction is for the
                       worst place of a block; targets that were not lit for a full dwell are left out
    same_pixels        whether the patch of a block in patches/ equals the image where the block owns it

Runs of back-projection have no blocks, spectrum or patches; these parts are skipped. The picture is written to
RUN/look.png, or to the path of --out, and needs the extra `plots`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import dask.array as da
import numpy as np
import typer
import xarray as xr

import blocksar
from blocksar.places import place
from blocksar.runs.record import RunRecord

CELLS = 800  # of a decimated picture, at most, along its longer side
CHUNK = 1024  # samples per side of the chunks that dask processes
AROUND = 25.0  # m on either side of the brightest target

Point = tuple[float, float]  # x and y, m


def decimate(samples: xr.DataArray) -> xr.DataArray:
    """The strongest |sample|^2 of every cell, dB; NaN where the whole cell is NaN."""
    cell = -(-max(samples.shape) // CELLS)
    lazy = samples.chunk(dict.fromkeys(samples.dims, CHUNK))
    power = (lazy.real**2 + lazy.imag**2).fillna(-1)  # less than any sample
    strongest = power.coarsen(dict.fromkeys(samples.dims, cell), boundary="pad").max().compute()
    with np.errstate(divide="ignore"):
        return xr.DataArray(10 * np.log10(strongest.where(strongest >= 0)))


def off_beam(collection: xr.Dataset, beam: Any, x: Any, y: Any) -> Any:
    """Yaw of a point relative to the centre of the beam, about the position of the platform at t = 0, rad."""
    x0, y0, _ = collection["antenna_position"].values[np.abs(collection["time"].values).argmin()]
    return (np.arctan2(y - y0, x - x0) - beam + np.pi) % (2 * np.pi) - np.pi


def fully_swept(collection: xr.Dataset, x: Any, y: Any) -> Any:
    """Whether points were lit for a full dwell; always true if the beam is not steered (beam_azimuth is NaN)."""
    beam = collection["beam_azimuth"].values
    margin = np.ptp(beam) / 2 - collection.attrs.get("beam_width", 0.0) / 2
    return ~(abs(off_beam(collection, (beam.min() + beam.max()) / 2, x, y)) > margin)


def brightest_target(image: xr.Dataset, picture: xr.DataArray, collection: xr.Dataset) -> Point:
    """Find the strongest pixel: the strongest cell of the decimated picture, then the pixel in it; x and y, m."""
    swept = picture.where(fully_swept(collection, picture.x, picture.y))
    if not swept.notnull().any():
        swept = picture
    cell = swept.isel(swept.argmax(["y", "x"]))
    side = float(picture.x[1] - picture.x[0])
    about = image.sar.crop(*((float(cell[axis]) - side, float(cell[axis]) + side) for axis in ("x", "y"))).sar.db()
    pixel = about.isel(about.argmax(["y", "x"]))
    print(f"brightest pixel: {float(pixel):.2f} dB at x = {float(pixel.x):.1f} m, y = {float(pixel.y):.1f} m")
    return float(pixel.x), float(pixel.y)


def look_direction(collection: xr.Dataset, point: Point) -> float:
    """Direction of the look on the ground, in the middle of a point's dwell: degrees from x towards y."""
    time, off = collection["time"].values, off_beam(collection, collection["beam_azimuth"].values, *point)
    lit = ~(abs(off) > collection.attrs.get("beam_width", np.inf) / 2)
    x, y, _ = collection["antenna_position"].values[lit].mean(axis=0)
    direction = float(np.degrees(np.arctan2(point[1] - y, point[0] - x)))
    print(f"lit by {lit.sum()} pulses, t = {time[lit][0]:.4f} .. {time[lit][-1]:.4f} s, along {direction:.2f} degrees")
    return direction


def cuts_through(image: xr.Dataset, point: Point, direction: float) -> dict[str, xr.DataArray]:
    """Cut the response of a target along the look and across it, through its interpolated peak; dB."""
    for azimuth in (direction, direction + 90):
        cut = image.sar.cut(*point, azimuth=azimuth, length=AROUND / 4, samples=2001)
        peak = cut.isel(distance=cut.argmax("distance"))
        point = float(peak.x), float(peak.y)
    cuts = {}
    for name, azimuth in (("along the look", direction), ("across the look", direction + 90)):
        cuts[name] = image.sar.cut(*point, azimuth=azimuth, length=2 * AROUND, samples=5001)
        main_lobe = cuts[name].where(cuts[name] > cuts[name].max() - 3.0103, drop=True).distance
        print(f"{name}: {float(cuts[name].max()):.2f} dB, {float(np.ptp(main_lobe.values)):.2f} m wide at half power")
    return cuts


def read_record(run: Path) -> RunRecord:
    """Read run.json of a finished run.

    Raises
    ------
    blocksar.InputError
        If there is none, or the run is not finished.
    """
    if not (run / "run.json").is_file():
        raise blocksar.InputError(f"{run} holds no run.json; give the folder that `blocksar focus --out` has written")
    record = RunRecord.read(place(run))
    if not record.finished:
        raise blocksar.InputError(f"{run} is {record.status}; give the command that started it again")
    return record


def print_coverage(image: xr.Dataset) -> None:
    pixel = float(image.x[1] - image.x[0]) * float(image.y[1] - image.y[0])  # m^2
    block = image["block"].chunk({"y": CHUNK, "x": CHUNK}).data
    numbers, counts = (array.compute() for array in da.unique(block, return_counts=True))
    for number, count in zip(numbers, counts, strict=True):
        print(f"{'no block' if number < 0 else f'block {number}'}: {count * pixel / 1e6:.3f} km^2")


def print_record(record: RunRecord) -> None:
    print("settings:", ", ".join(f"{name} {value}" for name, value in record.settings.items()))
    print("stages:", ", ".join(f"{name} {seconds:.1f} s" for name, seconds in record.timings.items()))
    slowest = sorted(record.receipts, key=lambda receipt: -receipt.seconds)[:3]
    print("slowest units of work:", ", ".join(f"{receipt.unit} {receipt.seconds:.2f} s" for receipt in slowest))
    planned = [block.memory / 2**20 for block in record.plan.predicted]
    largest = f", {max(planned):.0f} MiB planned for the largest block" if planned else ""
    print(f"memory of a worker: {(record.peak_memory or 0) / 2**20:.0f} MiB{largest}")
    for warning in record.warnings:
        print("warning:", warning)


def print_predictions(run: Path, image: xr.Dataset, record: RunRecord) -> None:
    """Print side lobes and widths in azimuth: the worst prediction for each block, and its worst target."""
    targets = [t for t in blocksar.quality(run).result["targets"] if t["full_dwell"] and t["covered"]]
    at = {axis: xr.DataArray([target[axis] for target in targets], dims="target") for axis in ("x", "y")}
    blocks = image["block"].sel(at, method="nearest").values if targets else np.array([])
    predicted = record.plan.predicted
    for number in sorted({part.block for part in predicted}):
        parts = [part for part in predicted if part.block == number]  # range sub-blocks
        worst = max(part.pslr for part in parts), max(part.width for part in parts)
        held = [target for target, block in zip(targets, blocks, strict=True) if block == number]
        line = f"block {number}: predicted {worst[0]:.2f} dB, width {worst[1]:.3f} of theory"
        if held:
            lobes = max(target["azimuth_pslr"] for target in held)
            width = max(target["azimuth_irw"] / target["azimuth_irw_theory"] for target in held)
            line += f"; measured at {len(held)} targets {lobes:.2f} dB, {width:.3f}"
        print(line)


def same_pixels(patch: xr.Dataset, image: xr.Dataset) -> bool:
    """Whether every pixel of a patch equals that of the image, to the last bit."""
    part = image.sar.crop(*((float(patch[axis][0]), float(patch[axis][-1])) for axis in ("x", "y")))
    pixels, expected = (ds["image"].chunk({"y": CHUNK, "x": CHUNK}) for ds in (patch, part))
    return bool(((pixels == expected) | pixels.isnull()).all())


def draw(path: Path, pictures: dict[str, xr.DataArray], cuts: dict[str, xr.DataArray]) -> None:
    """Draw pictures in grey (2nd to 98th percentile; the target over 50 dB), blocks in colours, and cuts."""
    import matplotlib.pyplot as plt  # optional, and slow to load

    figure, axes = plt.subplots(2, 3, figsize=(16, 9), layout="constrained")
    for ax, (title, picture) in zip(axes.flat, pictures.items(), strict=False):
        if picture.name == "block":
            last = int(picture.max())
            colours: dict[str, Any] = {"cmap": plt.get_cmap("viridis", last + 1), "vmin": -0.5, "vmax": last + 0.5}
            bar = {"label": "block", "ticks": range(last + 1)}
            picture.where(picture >= 0).plot.imshow(ax=ax, interpolation="nearest", cbar_kwargs=bar, **colours)
        else:
            scale: dict[str, Any] = {"vmin": float(picture.max()) - 50} if picture.name == "power" else {"robust": True}
            picture.plot.imshow(ax=ax, cmap="gray", cbar_kwargs={"label": "dB"}, **scale)
        ax.set(title=title, aspect="equal" if "x" in picture.dims else "auto")
        ax.locator_params(nbins=5)
    for name, cut in cuts.items():
        cut.plot.line(ax=axes.flat[5], label=name)
    axes.flat[5].set(title="cuts through the brightest target", ylabel="dB", ylim=(cut.max() - 50, cut.max() + 3))
    axes.flat[5].legend()
    figure.savefig(path, dpi=110, bbox_inches="tight")


def main(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    out: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture; default: RUN/look.png.")] = None,
) -> None:
    """Inspect a run with xarray: image, cuts, blocks, timings, predictions and measurements, spectrum, a patch.

    Example: python workflows/look_at_outputs.py demo-run
    """
    record = read_record(run)
    image = blocksar.open(run)
    print(image)
    pictures = {"image": decimate(image["image"])}
    collection = blocksar.open(run / "collection.zarr").load()
    point = brightest_target(image, pictures["image"], collection)
    cuts = cuts_through(image, point, look_direction(collection, point))
    neighbourhood = image.sar.crop(*((middle - AROUND, middle + AROUND) for middle in point))
    pictures["brightest target"] = neighbourhood.sar.db()
    print_coverage(image)
    print_record(record)
    print_predictions(run, image, record)
    if record.plan.predicted:
        first = min((run / "patches").iterdir())
        patch = blocksar.open(first)
        print(f"patches/{first.name} {'equals' if same_pixels(patch, image) else 'DIFFERS FROM'} the image")
        every = -(-max(image["block"].shape) // CELLS)
        pictures["blocks"] = image["block"][::every, ::every]  # read chunk by chunk
        pictures[f"patch of block {first.name}"] = decimate(patch["image"])
        pictures["spectrum"] = decimate(blocksar.open(run / "spectrum.zarr")["spectrum"])
    draw(out or run / "look.png", pictures, cuts)
    print(f"wrote {out or run / 'look.png'}")


if __name__ == "__main__":
    try:
        typer.run(main)
    except ModuleNotFoundError as error:
        print(f"look_at_outputs: {error.name} is not installed; install blocksar[plots]", file=sys.stderr)
        sys.exit(2)
    except blocksar.InputError as error:
        print(f"look_at_outputs: {error}", file=sys.stderr)
        sys.exit(2)
