"""Make the picture of README.md: a simulated coast, focused by blocksar and drawn with `ds.sar.plot`.

    python deploy/site/focused_scene.py focused-scene

The ground is a reflectivity map of 1000 m x 760 m with a random phase for every scatterer: sea, an airfield, fields, a
village and ships. The collection is squint-TOPS from 30 km with the platform of the shipped scene `table1` and 150 MHz
of bandwidth. The picture goes to FOLDER/focused_scene.png with few grey levels, which keeps it below 150 kB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer

import blocksar

Map = npt.NDArray[np.float64]

STEP = 0.9  # m between scatterers, below the resolution of 1.1 m x 1.5 m
WIDTH, HEIGHT = 1000.0, 760.0  # m, the ground about the origin

SCENE = """\
title = "A simulated coast"

[radar]
carrier = 15e9
bandwidth = 150e6
range_sampling = 165e6
prf = 8e3

[track]
position = [-16100.0, -19200.0, 16500.0]
velocity = [-40.0, 1300.0, -600.0]
acceleration = [-15.0, -30.0, -35.0]

[time]
duration = 0.31

[beam]
start_deg = 46.3
stop_deg = 53.7
dwell = 0.2

[scene]
swath = [29420.0, 30580.0]

[reflectivity]
file = "coast.npy"
x0 = {x0}
dx = {step}
y0 = {y0}
dy = {step}
seed = 7
"""


def box(x: Map, y: Map, *, centre: tuple[float, float], size: tuple[float, float], turn: float = 0.0) -> Map:
    """Mask of a rectangle: size along its own axes, turned counter-clockwise by `turn` degrees."""
    angle = np.radians(turn)
    along = (x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)
    across = (y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)
    return (np.abs(along) <= size[0] / 2) & (np.abs(across) <= size[1] / 2)


def coast() -> tuple[Map, Map, Map]:
    """x, y of the scatterers, m, and their amplitudes (y, x)."""
    random = np.random.default_rng(3)
    axis_x, axis_y = (np.arange(-extent / 2, extent / 2, STEP) for extent in (WIDTH, HEIGHT))
    x, y = np.meshgrid(axis_x, axis_y)
    power = np.full(x.shape, -14.0)  # dB of one scatterer
    cells = np.stack([random.uniform(-520, 520, 60), random.uniform(-400, 400, 60)])
    turn = np.radians(24)
    along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    parcels = (np.floor(along / 118) * 7 + np.floor(across / 74) * 13).astype(int)
    power += np.array([0.0, -3.5, 2.5, -6.0, 4.0, -1.5, 1.0, -4.5])[parcels % 8]
    hedges = (np.abs((along / 118) % 1 - 0.5) > 0.488) | (np.abs((across / 74) % 1 - 0.5) > 0.482)
    power[hedges] = -6.0
    wood = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 24.0**2)) for cx, cy in cells.T[:7] * 0.25 + [330, 230])
    power[wood > 0.75] = -7.0
    road = np.abs(across - 55 - 18 * np.sin(along / 130)) < 3.5
    power[road] = -24.0
    power[box(x, y, centre=(60, 55), size=(640, 120), turn=-14)] = -15.0  # the airfield: grass
    for offset, wide in ((-18.0, 26.0), (28.0, 11.0)):
        middle = (60 - offset * np.sin(np.radians(-14)), 55 + offset * np.cos(np.radians(-14)))
        power[box(x, y, centre=middle, size=(600, wide), turn=-14)] = -30.0
    power[box(x, y, centre=(205, 65), size=(110, 46), turn=-14)] = -28.0  # apron
    shore = -205 + 34 * np.sin(x / 105 + 0.6) + 15 * np.sin(x / 37) + 0.16 * x
    power[y < shore + 9] = -10.0  # surf and beach
    power[y < shore] = -27.0 + 1.6 * np.sin((0.8 * x + 0.6 * y) / 7.5)[y < shore]
    for centre, size, turned in (((-60, -222), (9, 130), 12.0), ((60, -225), (9, 150), -16.0)):
        power[box(x, y, centre=centre, size=size, turn=turned)] = -2.0  # moles
    amplitude = 10 ** (power / 20)
    for row in range(4):  # the village: bright walls towards the radar, dark behind
        for house in range(7):
            centre = (-430 + 30 * house + 9 * row, 215 + 34 * row - 5 * house)
            amplitude[box(x, y, centre=(centre[0] + 6, centre[1] + 7), size=(13, 11), turn=-10)] = 0.03
            amplitude[box(x, y, centre=centre, size=(13, 10), turn=-10)] = 0.35
            amplitude[box(x, y, centre=(centre[0] - 1, centre[1] - 5), size=(13, 1.6), turn=-10)] = 2.2
    for centre, size, turned in (
        ((300, -320), (64, 9), 20.0),
        ((-330, -330), (46, 8), -35.0),
        ((-150, -300), (24, 5), 70.0),
    ):
        amplitude[box(x, y, centre=centre, size=size, turn=turned)] = 1.3
    for shift in range(4):
        amplitude[box(x, y, centre=(165 + 26 * shift, 78 - 6.5 * shift), size=(17, 3), turn=-14)] = 1.6  # aircraft
        amplitude[box(x, y, centre=(165 + 26 * shift, 78 - 6.5 * shift), size=(3, 15), turn=-14)] = 1.6
    for lamp in np.linspace(-300, 300, 21):
        for side in (-34.0, -2.0):
            angle = np.radians(-14)
            place = (60 + lamp * np.cos(angle) - side * np.sin(angle), 55 + lamp * np.sin(angle) + side * np.cos(angle))
            amplitude[box(x, y, centre=place, size=(1.5, 1.5))] = 2.0
    return axis_x, axis_y, amplitude


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="What to fill.")] = Path("focused-scene"),
) -> None:
    """Simulate a coast, focus it and draw it.

    Example: python deploy/site/focused_scene.py focused-scene
    """
    folder.mkdir(parents=True, exist_ok=True)
    x, y, amplitude = coast()
    np.save(folder / "coast.npy", amplitude.astype(np.float32))
    scene = folder / "coast.toml"
    scene.write_text(SCENE.format(x0=x[0], y0=y[0], step=STEP))
    print(*blocksar.plan(scene, blocks=7).summary, sep="\n")
    history = blocksar.simulate(scene, folder / "coast.zarr", overwrite=True)
    grid = ((-470.0, 470.0, 0.5), (-350.0, 350.0, 0.5))
    print(*blocksar.focus(history, folder / "run", blocks=7, grid=grid, overwrite=True).summary, sep="\n")
    picture = draw(folder)
    print(f"{picture}: {picture.stat().st_size} bytes")


def draw(folder: Path) -> Path:
    """Draw the focused image of `folder` with few grey levels."""
    from matplotlib import pyplot as plt
    from PIL import Image

    figure, axes = plt.subplots(figsize=(7.8, 5.0), layout="constrained")
    blocksar.open(folder / "run").sar.plot(axes)
    axes.set_title("")
    for artist in (*axes.patches, *axes.texts):
        artist.remove()  # the scale bar, which would hide a ship; the axes are in metres
    figure.savefig(folder / "full.png", dpi=100)
    picture = folder / "focused_scene.png"
    Image.open(folder / "full.png").convert("L").quantize(16).save(picture, optimize=True)
    return picture


if __name__ == "__main__":
    typer.run(main)
