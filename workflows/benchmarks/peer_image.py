"""Images by fastsar, in the environment of its own that runs this script: python peer_image.py IN.npz OUT.npz.

IN has signal (pulse, frequency), position (pulse, 3), reference (pulse,), frequency, Hz, x and y of pixels about
the origin, m. OUT gets an image (y, x) of each algorithm, and processor times without the compilation of its loops.
"""

import sys
import time
from importlib.metadata import version
from typing import Any

import fastsar
import numpy as np


def main(source: str, out: str) -> None:
    given = np.load(source)
    x, y, frequency = given["x"], given["y"], given["frequency"]
    step = (frequency[-1] - frequency[0]) / (frequency.size - 1)
    formers = {"fastsar": fastsar.ImageFormer, "fastsar, exact": fastsar.ExactFormer}
    found: dict[str, Any] = {"version": np.array(version("fastsar"))}
    for name, former in formers.items():
        for _ in range(2):
            started = time.process_time()
            form = former(
                given["position"], frequency[0], step, frequency.size, x.size, y.size, x[1] - x[0], y[1] - y[0],
                window=False, ref=given["reference"],
            )  # fmt: skip
            image = form(given["signal"])
            seconds = time.process_time() - started
        found[f"{name}: image"], found[f"{name}: seconds"] = np.asarray(image).T, np.array(seconds)
    np.savez(out, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
