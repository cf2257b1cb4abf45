"""Back-projection: sums over lit pulses at pixels, and what they are divided by.

    image(x, y) = mean over lit pulses p and frequencies f of
                  signal[p, f] exp(+4j pi (fc + f) / c (R_xy(p) - reference_range[p]))

R of a bistatic collection is half the way from the transmitter to the pixel and on to the receiver: two square roots.
The mean over frequencies is one inverse transform per pulse, the range profile, interpolated at R_xy - reference_range;
this interpolation is the only approximation, of -69 dB (`profiles.spline_error`). Ranges and phases are float64, for
every pixel and pulse: no far field, no mean velocity. `kernels.projection` evaluates the square root of a range by its
series about the centre of a tile, where that errs by less than 1e-9 m, or 1e-7 cycles of phase at X band: -120 dB.

The pulses that light a pixel are an interval, so the loop over them needs no test; or a few intervals, which are summed
one after the other (`Beam.passes`).
With an antenna pattern g (`Beam.gain`) the sum over lit pulses is divided by that of g instead of
their number, and under a weighting w by that of w g, so that a target of reflectivity 1 still has the value 1. NaN
samples are excluded from the mean. Pulses and frequencies that are not uniform count by their shares of time and band
(`collection.sampling`). The image is NaN where no valid sample is lit, where the pattern in elevation is too
small for an image (`pattern_sums.LEAST_ELEVATION`), and where a lit pulse, missing or not, sees the pixel outside the
unambiguous window |R_xy - reference_range| <= c / (4 df). Where a raw echo recorded parts of pulses only, the mean is
divided by them (`recorded_pulses`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.pattern_sums import add_gains, mean_elevations
from blocksar.imaging.profiles import Profiles, profile_bins, profile_frequency
from blocksar.imaging.recorded_pulses import divide_by_recorded
from blocksar.kernels.device import CPU, Device, Tile, tiles
from blocksar.kernels.groups import run_groups
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.projection import UPSAMPLING, BeamTaper, LitPixels, Sights

ReadPulses = Callable[[slice], ComplexArray]  # (n, n_range_frequency) samples of a slice of pulses
Pass = tuple[Tile, IntArray, IntArray]  # pixels, and the pulses first <= p < last that light them

BLOCK_BYTES = 32 * 1024**2  # profiles of a block of pulses: malloc maps larger blocks afresh, page by page
GPU_BLOCK_BYTES = 512 * 1024**2  # on a GPU
MIN_PULSE_BLOCK, MAX_PULSE_BLOCK = 16, 512


def accumulate(
    image: ComplexArray,
    outside: BoolArray,
    profiles: Profiles,
    *,
    geometry: Geometry,
    pixels: LitPixels,
    threads: int,
    taper: Taper = FLAT,
    weight: Float32Array | None = None,
    device: Device = CPU,
) -> None:
    """Add a block of pulses to the image in place: profiles interpolated at each pixel's range, over its lit pulses.

    Parameters
    ----------
    image : (n_row, n_column) complex64
    outside : (n_row, n_column) bool
        Set where a lit pulse sees the pixel outside the unambiguous window.
    profiles : Profiles
    geometry : Geometry
    pixels : LitPixels
        (n_row, n_column), lit by one of `Beam.passes`.
    threads : int
        The result does not depend on it: one thread sums each pixel, in a fixed order.
    taper : Taper
        Weighting over a steered beam.
    weight : (n_row, n_column) float32, optional
        Rises by the sum of weights; needed under a weighting.
    device : Device
        Which has the arrays of pixels, and the profiles.

    Raises
    ------
    ValueError
        If a weighting has no array of weights.
    """
    if not taper.uniform and weight is None:
        raise ValueError(f"{taper.text} needs an array for the sum of weights")
    collection, pulses = geometry.collection, profiles.pulses
    sights = Sights(
        start=pulses.start,
        values=profiles.values,
        middle=profiles.centre,
        bins_per_metre=1 / profiles.spacing,
        cycles_per_metre=2 * (collection.carrier + profile_frequency(collection)) / SPEED_OF_LIGHT,
        antenna=(
            collection.antenna_position if collection.transmitter_position is None else collection.transmitter_position
        )[pulses],
        receiver=None if collection.receiver_position is None else collection.receiver_position[pulses],
        reference_range=collection.reference_range[pulses],
        half_window=collection.range_window / 2,
        taper=None if taper.uniform else _beam_taper(taper, profiles, geometry),
    )
    device.project(image, outside, sights, pixels, weight, threads)


def _beam_taper(taper: Taper, profiles: Profiles, geometry: Geometry) -> BeamTaper:
    """The weights of a block of pulses under a taper over the beam."""
    start, half = profiles.pulses.start, (geometry.collection.beam_width or np.inf) / 2

    def place(x: FloatArray, y: FloatArray, z: FloatArray, pulses: IntArray) -> FloatArray:
        return geometry.beam.offset(x, y, pulses + start, z) / half

    valid = profiles.valid / geometry.collection.n_range_frequency
    return BeamTaper(terms=taper.series[0], frequency=taper.series[1], valid=valid, place=place)


def weighed(profiles: Profiles, weights: Float32Array, device: Device = CPU) -> Profiles:
    """Profiles times weights of their pulses (n,), in place; so are the numbers of their valid samples."""
    np.multiply(profiles.values, device.put(weights[:, None]), out=profiles.values)
    return replace(profiles, valid=np.asarray(profiles.valid * weights, np.float64))


class DevicePixels:
    """Pixels on a device to which profiles are added; `take` returns them to `sums`."""

    def __init__(self, sums: PixelSums, device: Device) -> None:
        self.sums, self.device = sums, device
        weight = None if sums.over_beam.uniform else np.zeros(sums.x.shape, np.float32)
        self.image, self.outside, self.weight = map(device.put, (sums.image, sums.outside, weight))
        x, y, z = map(device.put, (sums.x, sums.y, sums.z))
        self.passes = [
            (part, LitPixels(x[part], y[part], z[part], device.put(first), device.put(last)))
            for part, first, last in sums.passes
        ]

    def add(self, profiles: Profiles, threads: int) -> None:
        """Add a block of pulses."""
        for part, pixels in self.passes:
            accumulate(
                self.image[part], self.outside[part], profiles, geometry=self.sums.geometry, pixels=pixels,
                threads=threads, taper=self.sums.over_beam,
                weight=None if self.weight is None else self.weight[part], device=self.device,
            )  # fmt: skip

    def take(self) -> Float32Array | None:
        """Copy the sums back to `sums`; return the sums of weights, if there are any."""
        take = self.device.take
        self.sums.image, self.sums.outside = take(self.image), take(self.outside)
        return None if self.weight is None else np.asarray(take(self.weight))


class PixelSums:
    """Sums over pulses at pixels, and their divisors.

    Parameters
    ----------
    geometry : Geometry
    x, y : (n_row, n_column) float
        m, scene frame.
    weighting : Weighting
    threads : int

    Attributes
    ----------
    image : (n_row, n_column) complex64
        The sums, zero at first.
    outside : (n_row, n_column) bool
        Pixels that get no value.
    z : (n_row, n_column) float
        m; of pixels without a height, which are outside, ground_height.
    passes : list of Pass
    over_beam : Taper
        Weighting over a steered beam.
    over_pulses : (n_pulse,) float32 or None
        Weights of pulses that are the same for all pixels, among them their shares of time.

    Raises
    ------
    InputError
        From `Beam.passes`.
    """

    def __init__(self, geometry: Geometry, x: FloatArray, y: FloatArray, weighting: Weighting, threads: int) -> None:
        self.geometry, self.x, self.y, self.threads, collection = geometry, x, y, threads, geometry.collection
        self._weighting = weighting
        self.passes = _lit_passes(geometry, x, y, threads)
        self.z, known = geometry.known_height(x, y)
        self.image, self.outside = np.zeros(x.shape, np.complex64), ~known
        if collection.elevation_pattern is not None:
            _find_dark(self.outside, geometry, x, y, self.z, threads)
        self.over_beam, over_pulses = weighting.azimuth, collection.pulses.shares
        if not (collection.steered or self.over_beam.uniform):  # every pixel has the same weights
            over_pulses = self.over_beam.weights(collection.time, collection.pulses)
            self.over_beam = FLAT
        self.over_pulses = None if over_pulses is None else over_pulses.astype(np.float32)
        # Sums of integers are exact: without weights nothing is rounded.
        self._valid: Any = np.zeros(
            collection.n_pulse, np.int64 if weighting.uniform and collection.even else np.float64
        )
        self._gains: FloatArray | None = None

    def lit(self) -> BoolArray:
        """Find which pulses light any pixel."""
        n = self.geometry.collection.n_pulse
        return np.asarray(np.any([lit_pulses(first, last, n) for _, first, last in self.passes], axis=0))

    def note_valid(self, pulses: slice, valid: IntArray | FloatArray) -> None:
        """Take the number of valid samples (n,) of some pulses, or the sum of their weights."""
        self._valid[pulses] = valid

    def add_gains(self, pulses: slice) -> None:
        """Add pulses with known valid samples to the sums of weights times the antenna's pattern."""
        self._gains = np.zeros(self.image.shape) if self._gains is None else self._gains
        for part, first, last in self.passes:
            pixels = LitPixels(self.x[part], self.y[part], self.z[part], first, last)
            self._add_gains_at(self._gains[part], pixels, pulses)

    def _add_gains_at(self, gains: FloatArray, pixels: LitPixels, pulses: slice) -> None:
        """`pattern_sums.add_gains` tile by tile, in threads."""

        def work(tile: Tile) -> None:
            add_gains(
                gains[tile], self.geometry, pixels.of(tile), pulses=pulses, valid=self._valid[pulses],
                taper=self.over_beam,
            )  # fmt: skip

        _run_tiles(work, gains.shape, self.threads)

    def mean(self, weight: Float32Array | None = None) -> ComplexArray:
        """Divide the sums, in place, and return them.

        By the sums of weights times the pattern, if these were added; else by `weight` (n_row, n_column), or by the
        number of valid samples of lit pulses.
        """
        n_frequency = self.geometry.collection.n_range_frequency
        if self._gains is not None:
            weight = (self._gains / n_frequency).astype(np.float32)
        if weight is not None:
            _normalise_weighted(self.image, self.outside, weight)
            return self._divided()
        before = np.concatenate(([0], np.cumsum(self._valid)))
        count = np.zeros(self.image.shape, before.dtype)
        for part, first, last in self.passes:
            count[part] += before[last] - before[first]
        _normalise(self.image, self.outside, count, n_frequency)
        return self._divided()

    def _divided(self) -> ComplexArray:
        """Divide pixels of partly recorded pulses by the recorded share, and return the image."""
        divide_by_recorded(
            self.image, self.geometry, self.x, self.y, self.z, weighting=self._weighting, threads=self.threads
        )
        return self.image


def pulse_block_size(collection: Collection) -> int:
    """Pulses in memory at a time, by default."""
    row = 8 * profile_bins(collection)
    # Whole vectors of pulses: a remainder would be processed one by one.
    pulses = BLOCK_BYTES // row // MIN_PULSE_BLOCK * MIN_PULSE_BLOCK
    return min(max(pulses, MIN_PULSE_BLOCK), MAX_PULSE_BLOCK)


def gpu_pulse_block(collection: Collection) -> int:
    """Pulses on a GPU at a time."""
    return max(GPU_BLOCK_BYTES // (8 * profile_bins(collection, UPSAMPLING["gpu"])), 1)


def _run_tiles(work: Callable[[Tile], None], shape: tuple[int, ...], threads: int) -> None:
    """Call `work` for every tile of the image, in threads."""
    run_groups(work, tiles(shape), threads)


def _lit_passes(geometry: Geometry, x: FloatArray, y: FloatArray, threads: int) -> list[Pass]:
    """Passes over pixels, computed by tiles to save memory: first passes of the whole image, later ones by tile."""
    first, last = np.empty(x.shape, np.int64), np.empty(x.shape, np.int64)
    further: list[Pass] = []

    def work(tile: Tile) -> None:
        firsts, lasts = geometry.beam.passes(x[tile], y[tile])
        first[tile], last[tile] = firsts[0], lasts[0]
        further.extend((tile, *ends) for ends in zip(firsts[1:], lasts[1:], strict=True))

    _run_tiles(work, x.shape, threads)
    return [((slice(None), slice(None)), first, last), *further]


def _find_dark(
    outside: BoolArray, geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray, threads: int
) -> None:
    """Set `outside` where the pattern in elevation is too small, tile by tile."""

    def work(tile: Tile) -> None:
        at = x[tile], y[tile], z[tile]
        outside[tile] |= mean_elevations(geometry, *at, passes=geometry.beam.passes(*at)).dark(geometry)

    _run_tiles(work, x.shape, threads)


def _normalise(image: ComplexArray, outside: BoolArray, count: IntArray | FloatArray, n_frequency: int) -> None:
    """Turn sums into means in place: divide by the number (or weights) of the valid samples of lit pulses."""
    missing = outside | (count == 0)
    image *= (n_frequency / np.where(missing, 1, count)).astype(np.float32)
    image[missing] = complex(np.nan, np.nan)


def _normalise_weighted(image: ComplexArray, outside: BoolArray, weight: Float32Array) -> None:
    """Turn sums into weighted means in place: divide by the lit pulses' sum of weights, times the pattern's gain."""
    missing = outside | (weight <= 0)
    image /= np.where(missing, np.float32(1), weight)
    image[missing] = complex(np.nan, np.nan)


def lit_pulses(first: IntArray, last: IntArray, n_pulse: int) -> BoolArray:
    """Find which pulses light any pixel."""
    begins = np.bincount(first.ravel(), minlength=n_pulse + 1)
    ends = np.bincount(last.ravel(), minlength=n_pulse + 1)
    return np.asarray(np.cumsum(begins - ends)[:-1] > 0)


def pulse_blocks(lit: BoolArray, pulse_block: int) -> list[slice]:
    """Divide lit pulses into slices of at most `pulse_block`, on fixed borders; unlit ends are left out."""
    blocks = []
    for start in range(0, lit.size, pulse_block):
        inside = start + np.flatnonzero(lit[start : start + pulse_block])
        if inside.size:
            blocks.append(slice(int(inside[0]), int(inside[-1]) + 1))
    return blocks
