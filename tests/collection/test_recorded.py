"""Recorded parts of pulses: their share of the band, the ground that they leave, and their attribute in stores."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.raw_echo import RawEcho, RecordedRanges
from blocksar.collection.region import default_grid, plan_region
from blocksar.collection.weighting import Taper
from blocksar.errors import OutsideSwath
from blocksar.kernels.fourier import chirp_spectrum

RECORDED = RecordedRanges(near=9000.0, far=11000.0, pulse=600.0)


def test_a_pulse_is_whole_between_the_ends_and_fades_over_its_length() -> None:
    distance = np.array([8700.0, 8850.0, 9000.0, 9300.0, 10000.0, 10700.0, 11000.0, 11300.0, 12000.0])
    np.testing.assert_allclose(RECORDED.part(distance), [0, 0.25, 0.5, 1, 1, 1, 0.5, 0, 0], atol=1e-12)
    assert RECORDED.whole == (9300.0, 10700.0) and RECORDED.reached == (8700.0, 11300.0)


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35", "hann"])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_share_is_what_the_divided_spectrum_of_the_part_sums_to(text: str, sign: int) -> None:
    """Of a chirp of 400 cycles, by Fresnel integrals over the recorded part at either end of the window."""
    taper, duration, band = Taper.parse(text), 1.0, 400.0
    rate, n = sign * band / duration, 8000
    frequency = (np.arange(n) + 0.5 - n / 2) / n * band
    whole, weight = chirp_spectrum(frequency, chirp_rate=rate, pulse_width=duration), taper.samples(n)
    for part in (0.3, 0.5, 0.8):
        distance = RECORDED.near + (part - 0.5) * RECORDED.pulse
        for first, last, at in (
            (0.5 - part, 0.5, distance), (-0.5, part - 0.5, RECORDED.near + RECORDED.far - distance)
        ):  # fmt: skip
            ends = np.sqrt(2 * band) * (np.array([[first], [last]]) - frequency / rate)
            sine, cosine = np.diff(fresnel(ends), axis=1)[:, 0]
            integral = cosine + 1j * (sine if sign > 0 else -sine)
            some = np.exp(-1j * np.pi * frequency**2 / rate) * integral / np.sqrt(2 * band)
            found = (weight * some / whole).sum() / weight.sum()
            assert abs(found - RECORDED.share(np.array(at), taper)) < 0.005


def test_without_a_grid_ground_with_whole_pulses_is_imaged(small_collection: Collection) -> None:
    free = Geometry(collection=small_collection)
    region = plan_region(free, None)
    near, far, pulse = float(region.near.min()), float(region.far.max()), 60.0
    recorded = RecordedRanges(near=near, far=far, pulse=pulse)
    geometry = Geometry(collection=replace(small_collection, recorded=recorded))
    inside = plan_region(geometry, None)
    grid = default_grid(geometry, inside)
    x, y = np.meshgrid(grid.x[:: max(grid.x.size // 40, 1)], grid.y[:: max(grid.y.size // 40, 1)])
    # Ranges change by some metres over the dwell.
    assert (inside.near >= region.near).all() and inside.near.min() == pytest.approx(near + pulse / 2, abs=15)
    assert (inside.far <= region.far).all() and inside.far.max() == pytest.approx(far - pulse / 2, abs=15)
    distance = geometry.epoch_range(x, y)
    assert distance.min() < near + pulse and distance.max() > far - pulse
    parts = replace(recorded, partial=True)
    assert plan_region(Geometry(collection=replace(small_collection, recorded=parts)), None).near.min() <= near + 1
    none = replace(recorded, near=far - 10, far=far)
    with pytest.raises(OutsideSwath, match=r"of no range the whole pulse.*; give --grid for ground of which parts"):
        plan_region(Geometry(collection=replace(small_collection, recorded=none)), None)


def test_a_longer_transform_has_steps_that_fill_the_band() -> None:
    raw = RawEcho(fast_time=60e-6 + np.arange(999) / 60e6, chirp_rate=5e12, pulse_width=7e-6, sampling_rate=60e6)
    frequency = raw.padded_range_frequency
    step = frequency[1] - frequency[0]
    assert frequency[0] == -frequency[-1] and frequency.size * step == pytest.approx(35e6, abs=step / 2)
    assert 60e6 / step >= 999 + 2 * 7e-6 * 60e6
    short = raw.range_frequency
    assert short[1] - short[0] == pytest.approx(60e6 / 999) and 0.0 in short


def test_stores_of_compressed_echoes_keep_it(small_collection: Collection, tmp_path: Path) -> None:
    collection = replace(small_collection, recorded=replace(RECORDED, partial=True))
    stores.create_phase_history(tmp_path / "ph.zarr", collection)
    opened = stores.open_phase_history(tmp_path / "ph.zarr")
    assert opened.collection.recorded == collection.recorded and "recorded" not in opened.attrs
    assert opened.with_partial_pulses() is opened
    cut = opened.collection.unsteered().segment(3, 90)
    assert cut.recorded == collection.recorded and cut.centred().recorded == collection.recorded
