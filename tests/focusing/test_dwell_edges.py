"""Edges of dwells: those that are summed pulse by pulse, and the windows that fade them out."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
from axis_beams import axis_collection, spotlight, with_patterns
from slow_twins import back_projection, gain, lit, offset

from blocksar.arrays import ComplexArray
from blocksar.collection.beam import inner_interval, lit_interval
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper, Weighting
from blocksar.focusing.dwell_edges import EDGE_UPSAMPLING, add_edges, edge_profiles, take_unlit
from blocksar.focusing.dwell_taper import HalfDwell, faded_rise, faded_taper
from blocksar.focusing.lines import RowPolynomial
from blocksar.focusing.profiles import spline_error

FADE = 9
X, Y = 9000.0 + np.arange(-2.0, 3.0) * 17, np.arange(-1.0, 2.0) * 21  # m


def noise(collection: Collection) -> ComplexArray:
    shape = collection.n_pulse, 2 * collection.n_range_frequency
    signal = np.random.default_rng(2).standard_normal(shape, dtype=np.float32).view(np.complex64)
    signal[200:203] = np.nan
    return signal


def small(kind: str) -> Collection:
    if kind == "axis":
        return with_patterns(axis_collection("sliding spotlight"))
    plain = axis_collection()
    sign = 1.0 if kind == "scan" else -1.0
    beam = {"beam_axis": None, "beam_steering": None, "beam_azimuth": sign * 0.06 * plain.time, "beam_width": 0.02}
    return Collection(**{**plain.as_dict(), **beam})


@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("kind", ["scan", "scan back", "axis"])
def test_edges_are_the_sum_over_their_pulses(kind: str, weighting: str) -> None:
    """Against the double loop, whose mean is multiplied by the sum of weights; pixels that are not owned stay.

    Equal weights are divided by their number, not by the parts of pulses that the chain counts.
    """
    collection = small(kind)
    geometry, signal, tapers = Geometry(collection=collection), noise(collection), Weighting.parse(weighting)
    mesh = np.meshgrid(X, Y)

    def taken(v: np.ndarray) -> np.ndarray:
        v = np.asarray(v, np.float64)
        return tapers.azimuth(v) - faded_taper(tapers.azimuth, v, FADE)

    plain = Collection(**{**collection.as_dict(), "beam_offset": None, "beam_pattern": None, "elevation": None,
                          "elevation_pattern": None})  # fmt: skip
    mean = back_projection(plain, signal, *mesh, in_range=tapers.range, in_azimuth=taken)
    half, total = (collection.beam_width or 0.0) / 2, np.zeros(mesh[0].shape)
    denominator = np.full(total.shape, 40.0)
    divisor, valid = denominator.copy(), np.ones(collection.n_pulse)
    valid[200:203] = 0
    for pixel in np.ndindex(total.shape):
        x, y = mesh[0][pixel], mesh[1][pixel]
        there = [p for p in range(collection.n_pulse) if lit(collection, p, x, y) and not 200 <= p < 203]
        total[pixel] = sum(float(taken(np.array(offset(collection, p, x, y) / half))) for p in there)
        if weighting == "uniform" and kind != "axis":  # whose pattern weighs
            divisor[pixel] = len(there)
    image = np.full(total.shape, 2 + 1j, np.complex64)
    image[0, 0] = np.nan
    before = image.copy()
    kept = edge_profiles(lambda pulses: signal[pulses], collection, tapers, fade=FADE, threads=2)
    add_edges(image, kept, geometry, x=X, y=Y, lit=denominator, valid=valid, fade=FADE, weighting=tapers, threads=2)
    before *= (denominator / divisor).astype(np.float32)
    added, wanted = (image - before).ravel()[1:], (mean * total / divisor).ravel()[1:]
    assert np.isnan(image[0, 0]) and np.abs(wanted).min() > 0
    allowed = 1.6 * spline_error(upsampling=EDGE_UPSAMPLING)
    assert np.linalg.norm(added - wanted) < allowed * np.linalg.norm(wanted)


@pytest.mark.parametrize("weighting", [pytest.param("uniform", marks=pytest.mark.slow), "taylor:4:-35"])
def test_what_is_not_lit_is_taken_out(weighting: str) -> None:
    """From the double loop over all pulses to that over the lit ones."""
    collection = with_patterns(spotlight(beam_width=0.0045))
    signal, tapers, wide = noise(collection), Weighting.parse(weighting), 0.1
    x, y = 9000.0 + np.arange(-3.0, 4.0, 2.0) * 45, np.array([-25.0, -22.3, -22.15, -21.5, 0.0, 22.1, 23.0])
    mesh, half = np.meshgrid(x, y), (collection.beam_width or 0.0) / 2
    bare = dict.fromkeys(("beam_offset", "beam_pattern", "elevation", "elevation_pattern"))
    everything = Collection(**{**collection.as_dict(), **bare, "beam_width": wide})

    def over_all(v: np.ndarray) -> np.ndarray:
        return tapers.azimuth(np.asarray(v) * wide / 2 / half)

    mean = back_projection(everything, signal, *mesh, in_range=tapers.range, in_azimuth=over_all)
    weights, gains, divisor, number = (np.zeros(mean.shape) for _ in range(4))
    valid = np.ones(collection.n_pulse)
    valid[200:203] = 0.0
    for pixel in np.ndindex(mean.shape):
        at = float(mesh[0][pixel]), float(mesh[1][pixel])
        w = [float(tapers.azimuth(np.array(offset(collection, p, *at) / half))) for p in range(collection.n_pulse)]
        weights[pixel] = (valid * w).sum()
        counts = valid * w * [gain(collection, p, *at) for p in range(collection.n_pulse)]
        gains[pixel] = counts.sum()
        own = [lit(collection, p, *at) for p in range(collection.n_pulse)]
        divisor[pixel], number[pixel] = counts[own].sum(), sum(own)
    image = (mean * weights / gains).astype(np.complex64)
    image[0, 0] = np.nan
    before = image.copy()
    kept = edge_profiles(lambda pulses: signal[pulses], collection, tapers, fade=0, threads=2)
    take_unlit(
        image, kept, Geometry(collection=collection), x=x, y=y, valid=valid, threads=2,
        total=lambda px, py, _: gains[np.searchsorted(y, py), np.searchsorted(x, px)], weighting=tapers,
    )  # fmt: skip
    wanted = back_projection(collection, signal, *mesh, in_range=tapers.range, in_azimuth=tapers.azimuth)
    wanted[0, 0] = np.nan
    np.testing.assert_array_equal(np.isnan(image), np.isnan(wanted))
    known = np.isfinite(wanted)
    same, none = known & (image == before), ~known
    assert same.sum() >= 5 and none.sum() > 3 and (known & ~same).sum() > 5
    error = ((image - wanted) * divisor)[known]  # of the sums: what is taken out may be larger than the rest
    assert np.linalg.norm(error) < 6e-3 * np.linalg.norm((mean * weights)[known])
    few = known & (number < collection.n_pulse / 2)  # these hold no rest of the sum over all pulses
    assert few.sum() >= 2
    assert np.linalg.norm((image - wanted)[few]) < 6e-3 * np.linalg.norm(wanted[few])


@pytest.mark.parametrize("kind", ["scan", "axis", "spotlight"])
def test_edges_of_pixels_at_their_heights_are_those_on_planes_of_these_heights(kind: str) -> None:
    collection = spotlight(beam_width=0.0045) if kind == "spotlight" else small(kind)
    signal, tapers = noise(collection), Weighting.parse("taylor:4:-35")
    fade = 0 if kind == "spotlight" else FADE
    x, y = 9000.0 + np.arange(4) * 45, np.array([-22.3, -21.5, 22.1])
    z = np.random.default_rng(5).uniform(-40, 90, (y.size, x.size))

    def completed(ground: Collection, x: np.ndarray, y: np.ndarray, height: np.ndarray | None) -> ComplexArray:
        image = np.full((y.size, x.size), 2 + 1j, np.complex64)
        kept = edge_profiles(lambda pulses: signal[pulses], ground, tapers, fade=fade)
        where = {"x": x, "y": y, "height": height, "weighting": tapers}
        valid, total = np.ones(ground.n_pulse), np.full_like
        if fade:
            lit = np.full(image.shape, 4.0)
            add_edges(image, kept, Geometry(collection=ground), lit=lit, valid=valid, fade=fade, **where)
        else:
            take_unlit(
                image, kept, Geometry(collection=ground), total=lambda a, *_: total(a, 9.0), valid=valid, **where
            )
        return image

    found = completed(collection, x, y, z)
    for i, j in np.ndindex(z.shape):
        level = Collection(**{**collection.as_dict(), "ground_height": float(z[i, j])})
        alone = completed(level, x[j : j + 1], y[i : i + 1], None)[0, 0]
        assert found[i, j] == pytest.approx(alone, abs=1e-3, nan_ok=True)
    assert np.nanmax(np.abs(found - completed(collection, x, y, None))) > 0.01
    assert np.nanstd(found) > 0.01


@pytest.mark.parametrize("kind", ["scan", "scan back", "axis"])
def test_the_inner_interval_has_the_pulses_of_a_narrower_beam(kind: str) -> None:
    collection = small(kind)
    geometry, share = Geometry(collection=collection), 1 - 1 / FADE
    mesh = np.meshgrid(X, Y)
    first, last = inner_interval(geometry, *mesh, share)
    outer = lit_interval(geometry, *mesh)
    for pixel in np.ndindex(first.shape):
        away = [abs(offset(collection, p, mesh[0][pixel], mesh[1][pixel])) for p in range(collection.n_pulse)]
        inside = np.flatnonzero(np.array(away) <= share * (collection.beam_width or 0.0) / 2)
        assert (first[pixel], last[pixel]) == (inside[0], inside[-1] + 1)
        assert outer[0][pixel] <= first[pixel] < last[pixel] <= outer[1][pixel]


@pytest.mark.parametrize("taper", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("knots", [None, (1.3 / 80, 0.52)])
def test_a_faded_window_is_the_fresnel_integral_of_its_taper(
    taper: str, backwards: bool, knots: tuple[float, float] | None
) -> None:
    """The convolution with exp(1j pi u^2 / e) / sqrt(1j e), by a fine transform; the edge is passed more slowly.

    With knots, the place in the beam is a cubic through them, and weights rise by 3 % towards the end besides.
    """
    slope, length, step, n, edge = 2.65e-5, 0.081, 4e-6, 2**18, 1.2 / 80
    t = (np.arange(n) - n // 4) * step
    w, fade = Taper.parse(taper), 80
    v = np.interp(t, [0, edge * length, length], [1, 1 - 1 / fade, 0])
    if knots is not None:
        cubic = np.polyfit([0, *knots, 1], [1, 1 - 1 / fade, 0.5, 0], 3)
        v = np.polyval(cubic, np.clip(t / length, 0, 1))
    rise = w(v) * np.sin(np.pi / 2 * np.clip(fade * (1 - v), 0, 1)) ** 2 / w(np.array(0.0))
    if knots is not None:
        rise *= 1 + 0.03 * np.clip(1 - t / length, 0, 1)
    window = rise * np.clip((0.6 - t) / 0.1, 0, 1)
    kernel = np.exp(-1j * np.pi * slope * scipy.fft.fftfreq(n, step) ** 2)
    wanted = scipy.fft.ifft(scipy.fft.fft(window) * kernel)[::50]
    at = t[::50]
    near = (at > -0.02) & (at < 0.12)
    one = RowPolynomial(series=np.ones((1, 1)), near=0.0, far=1.0, centre=0.0, scale=1.0)
    half = HalfDwell(length=one, lengths=(length,), edge=edge, level=0.03 if knots else 0.0)
    turn = slice(None, None, -1 if backwards else 1)
    found = faded_rise(w, half, at[near][turn], length, knots, slope=slope, fade=fade)[turn]
    assert np.abs(found - wanted[near]).max() < 2e-3
