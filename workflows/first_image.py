"""From a scene file to an image in twenty lines: simulate, plan, focus, measure, plot.

    python workflows/first_image.py first-image

A scene file describes the radar, its track and the ground. `SCENE` below is one: 2000 pulses at 15 GHz from a
platform at 16.5 km altitude, whose beam sweeps 2.5 degrees over nine point targets on weak clutter, 30 km away. Five
calls turn it into an image:

1. `blocksar.simulate` writes the phase history: the echo of every pulse at every range frequency, with exact ranges.
   For measured data use `blocksar.ingest`, which reads CPHD and the Gotcha set, or write the store with a program of
   your own.
2. `blocksar.plan` reads no samples. It divides the scan into angular blocks, fits the coefficients of each and
   predicts the quality of the image: worth a look before a long run.
3. `blocksar.focus` carries out the plan in two or more processes on this machine and writes a folder: the image, the
   Doppler spectrum, the patch of every block, and run.json with settings, timings and checksums.
4. `blocksar.quality` measures every target of the scene against theory. Ideal values are side lobes of -13.26 dB, a
   width over theory of 1, and a value of 1: the image is calibrated.
5. `blocksar.open` returns the image as a lazily loaded xarray dataset.

Afterwards first-image/ holds scene.toml, phase_history.zarr, run/ and image.png. In the picture, blue is ground that
no block covers and black is ground without scatterers. At both ends of the scan the ground is lit for fewer and fewer
pulses, so everything there is smeared. Change scene.toml and repeat the command with --overwrite: a PRF of 1e3 is
refused with a reason; a `jerk` in [track] does not change the quality, as the coefficients are fitted to the track.
Continue with `look_at_outputs.py first-image/run`.

`main` is called below `if __name__ == "__main__":` because the workers that `focus` starts are new processes, which
import this file again. The picture needs the extra `plots`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

import blocksar

SCENE = """\
title = "first image"
targets = [             # reflectivity 1; no two share a range or a yaw, where side lobes would add up
    { name = "A1", range = 29805.0, yaw_deg = 49.51 },
    { name = "near", range = 29820.0, yaw_deg = 49.96 },
    { name = "A3", range = 29835.0, yaw_deg = 50.41 },
    { name = "B1", range = 29985.0, yaw_deg = 49.55 },
    { name = "centre", range = 30000.0, yaw_deg = 50.00 },
    { name = "B3", range = 30015.0, yaw_deg = 50.45 },
    { name = "C1", range = 30165.0, yaw_deg = 49.59 },
    { name = "far", range = 30180.0, yaw_deg = 50.04 },
    { name = "C3", range = 30195.0, yaw_deg = 50.49 },
]

[radar]
carrier = 15e9          # Hz
bandwidth = 50e6        # Hz: 2.66 m of slant range
range_sampling = 60e6   # Hz
prf = 8e3               # Hz

[track]                 # r(t) = position + velocity t + acceleration t^2 / 2: diving, turning, braking
position = [-16100.0, -19200.0, 16500.0]
velocity = [-40.0, 1300.0, -600.0]
acceleration = [-15.0, -30.0, -35.0]

[time]
duration = 0.25         # s; t = 0 is the middle

[beam]                  # steered forward, with the flight: squint-TOPS
start_deg = 48.75
stop_deg = 51.25
dwell = 0.1             # s for which every target is lit: 3 m of azimuth

[scene]                 # recorded slant ranges, m
swath = [29700.0, 30300.0]

[clutter]               # on the ground between the targets
scatterers = 20000
power = 1e-6            # of each scatterer; a target has 1
seed = 1
"""


def main(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder for all files.")] = Path("first-image"),
    scene: Annotated[
        Path | None, typer.Option(help="Scene file; default: FOLDER/scene.toml, written if it does not exist.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier call.")] = False,
) -> None:
    """From a scene file to an image, its quality and its picture.

    Example: python workflows/first_image.py first-image
    """
    out.mkdir(parents=True, exist_ok=True)
    if scene is None:
        scene = out / "scene.toml"
        if not scene.exists():
            scene.write_text(SCENE)
    history = blocksar.simulate(scene, out / "phase_history.zarr", overwrite=overwrite)

    plan = blocksar.plan(history)
    print(*plan.summary, sep="\n")

    report = blocksar.focus(history, out / "run", processor="angular-division", overwrite=overwrite)
    print(*report.summary, sep="\n")

    quality = blocksar.quality(out / "run").result
    for target in (target for target in quality["targets"] if target["covered"]):
        width = target["azimuth_irw"] / target["azimuth_irw_theory"]
        name, lobes, value = target["name"], target["azimuth_pslr"], target["value"][0]
        print(f"{name}: side lobes {lobes:.2f} dB, width / theory {width:.3f}, value {value:.3f}")

    image = blocksar.open(out / "run")
    picture = image.sar.plot().figure
    picture.savefig(out / "image.png", dpi=150)
    print(f"{image.sizes['x']} x {image.sizes['y']} pixels; picture: {out / 'image.png'}")


if __name__ == "__main__":
    try:
        typer.run(main)
    except blocksar.InputError as error:
        print(f"first_image: {error}", file=sys.stderr)
        sys.exit(2)
