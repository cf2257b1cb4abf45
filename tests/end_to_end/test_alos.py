"""Measured raw echoes of ALOS PALSAR: the whole swath as a plain numpy chain has it, and no ghosts at its edges.

The tests need h5py and the environment variable BLOCKSAR_DATA: a folder with alos/alos_palsar_raw.h5, 1000 pulses over
forest and rivers (JAXA; as repackaged for the test suite of isce3 in the layout of NISAR's level 0B).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import blocksar
from blocksar import stores
from blocksar.collection.georeference import Georeference

pytestmark = pytest.mark.slow

SPEED_OF_LIGHT = 299792458.0
GRID = ((-20500.0, 20500.0, 10.0), (-160.0, 160.0, 10.0))  # x along range, y along the track
PADDED, FINE, OVERSAMPLED = 4096, 16, 8  # samples of a transform; times finer profiles, and samples of the replica
TOGETHER, CHIP = 100, 64  # pulses; columns


class Measured(NamedTuple):
    """What the file holds: arguments of `blocksar.collection`, and the frame's positions of the antenna, m."""

    arguments: dict[str, Any]
    position: NDArray[np.float64]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    pytest.importorskip("h5py")
    folder = os.environ.get("BLOCKSAR_DATA")
    path = Path(folder or "", "alos", "alos_palsar_raw.h5")
    if not folder or not path.exists():
        pytest.skip("BLOCKSAR_DATA does not say where measured data of ALOS are")
    store = tmp_path_factory.mktemp("alos") / "ph.zarr"
    blocksar.ingest(None, path, store, progress=False)
    history = stores.open_phase_history(store)
    raw, collection = history.raw, history.collection
    assert raw is not None
    # Without the beam: all pulses light this strip, and the chain takes it. Ground is the plane.
    arguments = {
        "echo": history.read(slice(None), slice(None)), "fast_time": raw.fast_time, "chirp_rate": raw.chirp_rate,
        "pulse_width": raw.pulse_width, "time": collection.time, "antenna_position": collection.antenna_position,
        "reference_range": float(collection.reference_range[0]), "carrier_frequency": collection.carrier,
        "georeference": history.attrs["georeference"],
    }  # fmt: skip
    return Measured(arguments, collection.antenna_position)


def test_the_scene_lies_inside_the_polygon_of_the_file(measured: Measured) -> None:
    # Of the data's page: at 2 degrees south, 57 degrees west, inside of these.
    frame = Georeference.from_attribute(measured.arguments["georeference"])
    x, y = np.meshgrid([-13700.0, 13500.0], [-8500.0, 8500.0])
    latitude, longitude, _ = np.moveaxis(frame.to_geodetic(np.stack([x, y, 0 * x], axis=-1)), -1, 0)
    polygon = [(-2.127, -57.360), (-1.980, -56.680), (-0.990, -56.890), (-1.136, -57.569)]
    for (south, west), (north, east) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        inside = (latitude - south) * (east - west) - (longitude - west) * (north - south)
        assert (inside > -0.01).all()  # degrees squared over sides of a degree: 1 km


def filter_of(arguments: dict[str, Any], step: float) -> NDArray[np.complex128]:
    """One over the spectrum of the chirp, by a finely sampled replica, times the part of each step in its band."""
    rate, pulse, frequency = arguments["chirp_rate"], arguments["pulse_width"], np.fft.fftfreq(PADDED, step)
    weight = np.clip((abs(rate) * pulse / 2 - np.abs(frequency)) * PADDED * step + 0.5, 0, 1)
    band = weight > 0
    n = round(pulse / step * OVERSAMPLED)
    tau = ((np.arange(n) + 0.5) / n - 0.5) * pulse
    replica = (np.exp(-2j * np.pi * np.outer(frequency[band], tau)) @ np.exp(1j * np.pi * rate * tau**2)) * pulse / n
    inverse = np.zeros(PADDED, complex)
    inverse[band] = step * weight[band] / replica
    return inverse / weight.sum()


def expected(measured: Measured, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.complex128]:
    """The image by its definition from a padded compression, divided by the recorded part of the pulse."""
    arguments, position = measured
    pulse, fast = arguments["pulse_width"], arguments["fast_time"]
    step = (fast[-1] - fast[0]) / (fast.size - 1)
    inverse = filter_of(arguments, step)
    first, last = fast[0] - step / 2, fast[-1] + step / 2
    early = round(pulse / step + 100) * FINE  # bins that hold the delays before the first sample
    total, parts = np.zeros((y.size, x.size), complex), np.zeros((y.size, x.size))
    for start in range(0, len(position), TOGETHER):
        spectra = np.fft.fft(arguments["echo"][start : start + TOGETHER], PADDED) * inverse
        # As many zeros in the middle of the spectrum: finer profiles.
        wide = np.zeros((len(spectra), FINE * PADDED), np.complex64)
        wide[:, : PADDED // 2], wide[:, -PADDED // 2 :] = spectra[:, : PADDED // 2], spectra[:, -PADDED // 2 :]
        profiles = np.roll(np.fft.ifft(wide), early, axis=1) * (FINE * PADDED)
        for place, row in zip(position[start : start + TOGETHER], profiles, strict=True):
            away = np.sqrt((x - place[0]) ** 2 + (y[:, None] - place[1]) ** 2 + place[2] ** 2)
            delay = 2 * away / SPEED_OF_LIGHT
            index = (delay - fast[0]) / step * FINE + early
            k = index.astype(int)
            value = row[k] + (index - k) * (row[k + 1] - row[k])
            carrier = 4 * np.pi * arguments["carrier_frequency"] / SPEED_OF_LIGHT
            total += value * np.exp(1j * carrier * (away - arguments["reference_range"]))
            parts += np.clip((np.minimum(delay + pulse / 2, last) - np.maximum(delay - pulse / 2, first)) / pulse, 0, 1)
    return total / parts


@pytest.fixture(scope="module")
def chips(measured: Measured) -> dict[int, NDArray[np.complex128]]:
    """What is expected of CHIP columns of the grid, by the first, at both edges, inside of them and in the middle."""
    x, y = (np.arange(*axis) for axis in GRID)
    slant = np.hypot(x - measured.position[500, 0], measured.position[500, 2])
    edges = measured.arguments["fast_time"][[0, -1]] * SPEED_OF_LIGHT / 2
    pulse = measured.arguments["pulse_width"] * SPEED_OF_LIGHT / 2
    # Of the pulse, so that these ranges have parts of 0.15, 0.6 and 1 of it at either end.
    first = [int(np.searchsorted(slant, edges[0] + (part - 0.5) * pulse)) for part in (0.15, 0.6, 1.0)]
    last = [int(np.searchsorted(slant, edges[1] - (part - 0.5) * pulse)) - CHIP for part in (0.15, 0.6, 1.0)]
    columns = np.concatenate([np.arange(start, start + CHIP) for start in (*first, x.size // 2, *last)])
    image = expected(measured, x[columns], y)
    return {int(columns[k]): image[:, k : k + CHIP] for k in range(0, columns.size, CHIP)}


def test_the_swath_is_that_of_a_padded_compression_up_to_both_edges(
    measured: Measured, chips: dict[int, NDArray[np.complex128]], tmp_path: Path
) -> None:
    dataset = blocksar.collection(**measured.arguments)
    blocksar.focus(dataset, tmp_path / "run", grid=GRID, processor="angular-division", workers=0, progress=False)
    image = blocksar.open(tmp_path / "run")["image"].values
    for start, wanted in chips.items():
        chip = image[:, start : start + CHIP]
        power = 10 * np.log10(np.mean(np.abs(chip) ** 2) / np.mean(np.abs(wanted) ** 2))
        coherence = abs(np.vdot(wanted, chip)) / np.linalg.norm(wanted) / np.linalg.norm(chip)
        assert abs(power) < 0.5 and coherence >= 0.999
