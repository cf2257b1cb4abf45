"""What a run leaves, looked at with xarray: an image of any size, in the memory of a few chunks.

    python workflows/look_at_outputs.py demo-run

RUN is a finished run of `blocksar focus`, `blocksar demo` or `first_image.py`. Every function below is one thing that
people ask of a run, and stands by itself, to be copied:

    decimated         the strongest pixel of every cell: `chunk` hands an array to dask, which then takes it chunk
                      by chunk, so that nothing here is ever held as a whole
    swept_wholly      collection.zarr holds track and beam. At the ends of a scan, a pixel is the mean of the few
                      pulses that lit it, in which all that lies at its range adds up: no place to look for
                      targets
    brightest_target  found in the decimated picture, then among the pixels of its cell, in dB
    look_direction    when a point was lit, and from where
    cuts_through      dB along the look and across it, by band-limited interpolation. `image` keeps its carrier,
                      tens of cycles a metre: interpolating `abs` of it is wrong, `ds.sar.cut` is right
    say_coverage      the ground that each block covers, of `block`: -1 is no block, where `image` is NaN, never 0
    say_record        run.json: settings, the seconds of every stage, a receipt for every unit of work
    say_promises      what the plan promised of each block against what was measured there. A promise is for the
                      worst place of a block; targets that the beam did not sweep wholly are left out
    same_pixels       whether a block's patch in patches/ holds the bytes that the image shows where the block is

Runs of back-projection have neither blocks nor spectrum nor patches: what is not there is left out. The picture goes
to RUN/look.png, or wherever --out says, and needs the extra `plots`.
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

CELLS = 800  # of a decimated picture, along its longer side at most
CHUNK = 1024  # samples a side that dask takes at a time
AROUND = 25.0  # m on either side of the brightest target

Point = tuple[float, float]  # x and y, m


# ---------------------------------------------------------------- the image


def decimated(samples: xr.DataArray) -> xr.DataArray:
    """The strongest |sample|^2 of every cell, dB; NaN where all of a cell is."""
    cell = -(-max(samples.shape) // CELLS)
    lazy = samples.chunk(dict.fromkeys(samples.dims, CHUNK))
    power = (lazy.real**2 + lazy.imag**2).fillna(-1)  # which loses against any sample
    strongest = power.coarsen(dict.fromkeys(samples.dims, cell), boundary="pad").max().compute()
    with np.errstate(divide="ignore"):
        return xr.DataArray(10 * np.log10(strongest.where(strongest >= 0)))


def off_beam(collection: xr.Dataset, beam: Any, x: Any, y: Any) -> Any:
    """How far ground lies from the middle of the beam, in yaw about the platform's place at t = 0, rad."""
    x0, y0, _ = collection["antenna_position"].values[np.abs(collection["time"].values).argmin()]
    return (np.arctan2(y - y0, x - x0) - beam + np.pi) % (2 * np.pi) - np.pi


def swept_wholly(collection: xr.Dataset, x: Any, y: Any) -> Any:
    """Whether ground was lit for a whole dwell; all of it, where the beam is not steered and beam_azimuth NaN."""
    beam = collection["beam_azimuth"].values
    room = np.ptp(beam) / 2 - collection.attrs.get("beam_width", 0.0) / 2
    return ~(abs(off_beam(collection, (beam.min() + beam.max()) / 2, x, y)) > room)


def brightest_target(image: xr.Dataset, picture: xr.DataArray, collection: xr.Dataset) -> Point:
    """Where the strongest pixel lies, found in the cell of the decimated picture that holds it: x and y, m."""
    swept = picture.where(swept_wholly(collection, picture.x, picture.y))
    if not swept.notnull().any():
        swept = picture
    cell = swept.isel(swept.argmax(["y", "x"]))
    side = float(picture.x[1] - picture.x[0])
    about = image.sar.crop(*((float(cell[axis]) - side, float(cell[axis]) + side) for axis in ("x", "y"))).sar.db()
    pixel = about.isel(about.argmax(["y", "x"]))
    print(f"brightest pixel: {float(pixel):.2f} dB at x = {float(pixel.x):.1f} m, y = {float(pixel.y):.1f} m")
    return float(pixel.x), float(pixel.y)


def look_direction(collection: xr.Dataset, point: Point) -> float:
    """Along which direction on the ground a point was seen, in the middle of its dwell: degrees from x towards y."""
    time, off = collection["time"].values, off_beam(collection, collection["beam_azimuth"].values, *point)
    lit = ~(abs(off) > collection.attrs.get("beam_width", np.inf) / 2)
    x, y, _ = collection["antenna_position"].values[lit].mean(axis=0)
    direction = float(np.degrees(np.arctan2(point[1] - y, point[0] - x)))
    print(f"lit by {lit.sum()} pulses, t = {time[lit][0]:.4f} .. {time[lit][-1]:.4f} s, along {direction:.2f} degrees")
    return direction


def cuts_through(image: xr.Dataset, point: Point, direction: float) -> dict[str, xr.DataArray]:
    """The response of a target along the look and across it, through its peak between the pixels, dB."""
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


# ---------------------------------------------------------------- how it came to be


def read_record(run: Path) -> RunRecord:
    """run.json, of a finished run."""
    if not (run / "run.json").is_file():
        raise blocksar.InputError(f"{run} holds no run.json; give the folder that `blocksar focus --out` left")
    record = RunRecord.read(place(run))
    if not record.finished:
        raise blocksar.InputError(f"{run} is {record.status}; give the command that began it once more")
    return record


def say_coverage(image: xr.Dataset) -> None:
    pixel = float(image.x[1] - image.x[0]) * float(image.y[1] - image.y[0])  # m^2
    block = image["block"].chunk({"y": CHUNK, "x": CHUNK}).data
    numbers, counts = (found.compute() for found in da.unique(block, return_counts=True))
    for number, count in zip(numbers, counts, strict=True):
        print(f"{'no block' if number < 0 else f'block {number}'}: {count * pixel / 1e6:.3f} km^2")


def say_record(record: RunRecord) -> None:
    print("settings:", ", ".join(f"{name} {value}" for name, value in record.settings.items()))
    print("stages:", ", ".join(f"{name} {seconds:.1f} s" for name, seconds in record.timings.items()))
    slowest = sorted(record.receipts, key=lambda receipt: -receipt.seconds)[:3]
    print("slowest units of work:", ", ".join(f"{receipt.unit} {receipt.seconds:.2f} s" for receipt in slowest))
    planned = [block.memory / 2**20 for block in record.plan.predicted]
    told = f", {max(planned):.0f} MiB planned for the largest block" if planned else ""
    print(f"memory of a worker: {(record.peak_memory or 0) / 2**20:.0f} MiB{told}")
    for warning in record.warnings:
        print("warning:", warning)


def say_promises(run: Path, image: xr.Dataset, record: RunRecord) -> None:
    """Side lobes and widths in azimuth: the worst that the plan has for a block, and the worst target in it."""
    targets = [t for t in blocksar.quality(run).result["targets"] if t["full_dwell"] and t["covered"]]
    at = {axis: xr.DataArray([target[axis] for target in targets], dims="target") for axis in ("x", "y")}
    blocks = image["block"].sel(at, method="nearest").values if targets else np.array([])
    for number in sorted({planned.block for planned in record.plan.predicted}):
        parts = [planned for planned in record.plan.predicted if planned.block == number]  # range sub-blocks
        promised = max(part.pslr for part in parts), max(part.width for part in parts)
        held = [target for target, block in zip(targets, blocks, strict=True) if block == number]
        line = f"block {number}: promised {promised[0]:.2f} dB, width {promised[1]:.3f} of theory"
        if held:
            lobes = max(target["azimuth_pslr"] for target in held)
            width = max(target["azimuth_irw"] / target["azimuth_irw_theory"] for target in held)
            line += f"; measured at {len(held)} targets {lobes:.2f} dB, {width:.3f}"
        print(line)


def same_pixels(patch: xr.Dataset, image: xr.Dataset) -> bool:
    """Whether every pixel that a patch holds is the image's, to the last bit."""
    part = image.sar.crop(*((float(patch[axis][0]), float(patch[axis][-1])) for axis in ("x", "y")))
    own, shown = (ds["image"].chunk({"y": CHUNK, "x": CHUNK}) for ds in (patch, part))
    return bool(((own == shown) | own.isnull()).all())


# ---------------------------------------------------------------- all of it


def draw(path: Path, pictures: dict[str, xr.DataArray], cuts: dict[str, xr.DataArray]) -> None:
    """Pictures in grey, from their 2nd to their 98th percentile, the target's in 50 dB; blocks in colours; cuts."""
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
    out: Annotated[Path | None, typer.Option(metavar="PNG", help="The picture; default: RUN/look.png.")] = None,
) -> None:
    """Look at a run with xarray: image, cuts, blocks, timings, promises against measurements, spectrum, a patch.

    Example: python workflows/look_at_outputs.py demo-run
    """
    record = read_record(run)
    image = blocksar.open(run)
    print(image)
    pictures = {"image": decimated(image["image"])}
    collection = blocksar.open(run / "collection.zarr").load()
    point = brightest_target(image, pictures["image"], collection)
    cuts = cuts_through(image, point, look_direction(collection, point))
    about = image.sar.crop(*((middle - AROUND, middle + AROUND) for middle in point))
    pictures["the brightest target"] = about.sar.db()
    say_coverage(image)
    say_record(record)
    say_promises(run, image, record)
    if record.plan.predicted:
        first = min((run / "patches").iterdir())
        patch = blocksar.open(first)
        print(f"patches/{first.name} {'is' if same_pixels(patch, image) else 'is NOT'} what the image shows of it")
        every = -(-max(image["block"].shape) // CELLS)
        pictures["blocks"] = image["block"][::every, ::every]  # xarray reads it chunk by chunk
        pictures[f"patch of block {first.name}"] = decimated(patch["image"])
        pictures["spectrum"] = decimated(blocksar.open(run / "spectrum.zarr")["spectrum"])
    draw(out or run / "look.png", pictures, cuts)
    print(f"{out or run / 'look.png'} shows all of it")


if __name__ == "__main__":
    try:
        typer.run(main)
    except ModuleNotFoundError as error:
        print(f"look_at_outputs: {error.name} is not installed; install blocksar[plots]", file=sys.stderr)
        sys.exit(2)
    except blocksar.InputError as error:
        print(f"look_at_outputs: {error}", file=sys.stderr)
        sys.exit(2)
