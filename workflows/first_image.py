"""From a scene file to an image, in twenty lines: simulate, plan, focus, measure, look.

    python workflows/first_image.py first-image

A scene file says what radar flies where and what lies on the ground. `SCENE` below is one: 2000 pulses at 15 GHz from
a platform 16.5 km up, whose beam sweeps two and a half degrees over nine point targets on weak clutter, 30 km away.
Five calls make an image of it:

1. `blocksar.simulate` writes the phase history: the echo of every pulse at every range frequency, with exact
   ranges. Measured data take its place: `blocksar.ingest` reads CPHD and the Gotcha set, and any program may write
   the store.
2. `blocksar.plan` reads no sample. It divides the scan into angular blocks, fits the coefficients of each and says
   how sharp the image will be. Worth reading before a long run.
3. `blocksar.focus` carries the plan out, on two or more processes of this machine, and leaves a folder: the image,
   the Doppler spectrum, the patch of every block, and run.json that says how all of it came to be.
4. `blocksar.quality` measures every target of the scene against theory. Ideal are side lobes of -13.26 dB, a width
   over theory of 1, and a value of 1: the image is calibrated.
5. `blocksar.open` gives the image as an xarray dataset that reads nothing until it has to.

Afterwards first-image/ holds scene.toml, phase_history.zarr, run/ and image.png. In the picture, blue is ground that
no block covers, black is ground that no scatterer was put on, and at both ends of the scan, where the ground is lit
for ever fewer pulses, all that lies there smears. Change scene.toml and give the command again with --overwrite: a
PRF of 1e3 is refused with the reason; a `jerk` in [track] leaves the quality as it is, as the coefficients are fitted
to the track. `look_at_outputs.py first-image/run` goes on from here.

The call of `main` stands below `if __name__ == "__main__":` because the workers that `focus` starts are new
processes, which import this file again. The picture needs the extra `plots`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

import blocksar

SCENE = """\
title = "first image"
targets = [             # reflectivity 1; no two at one range or one yaw, for side lobes add up there
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

[track]                 # r(t) = position + velocity t + acceleration t^2 / 2: it dives, turns and brakes
position = [-16100.0, -19200.0, 16500.0]
velocity = [-40.0, 1300.0, -600.0]
acceleration = [-15.0, -30.0, -35.0]

[time]
duration = 0.25         # s; t = 0 is the middle

[beam]                  # steered forward, with the flight: squint-TOPS
start_deg = 48.75
stop_deg = 51.25
dwell = 0.1             # s that every target is lit: 3 m of azimuth

[scene]                 # slant ranges that are recorded, m
swath = [29700.0, 30300.0]

[clutter]               # ground that is not empty
scatterers = 20000
power = 1e-6            # of one scatterer; a target has 1
seed = 1
"""


def main(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="What to fill.")] = Path("first-image"),
    scene: Annotated[
        Path | None, typer.Option(help="Scene file; default: FOLDER/scene.toml, which is written if it is not there.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier call left there.")] = False,
) -> None:
    """From a scene file to an image, its quality and a picture of it.

    Example: python workflows/first_image.py first-image
    """
    out.mkdir(parents=True, exist_ok=True)
    if scene is None:
        scene = out / "scene.toml"
        if not scene.exists():
            scene.write_text(SCENE)
    history = blocksar.simulate(scene, out / "phase_history.zarr", overwrite=overwrite)

    planned = blocksar.plan(history)
    print(*planned.summary, sep="\n")

    focused = blocksar.focus(history, out / "run", overwrite=overwrite)
    print(*focused.summary, sep="\n")

    measured = blocksar.quality(out / "run").result
    for target in (target for target in measured["targets"] if target["covered"]):
        width = target["azimuth_irw"] / target["azimuth_irw_theory"]
        told = f"side lobes {target['azimuth_pslr']:.2f} dB, width / theory {width:.3f}, value {target['value'][0]:.3f}"
        print(f"{target['name']}: {told}")

    image = blocksar.open(out / "run")
    picture = image.sar.plot().figure
    picture.savefig(out / "image.png", dpi=150)
    print(f"{image.sizes['x']} x {image.sizes['y']} pixels; {out / 'image.png'} shows them")


if __name__ == "__main__":
    try:
        typer.run(main)
    except blocksar.InputError as error:
        print(f"first_image: {error}", file=sys.stderr)
        sys.exit(2)
