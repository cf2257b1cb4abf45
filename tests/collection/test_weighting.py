"""Tapers: their definitions, their ideal responses, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import windows
from steps import collection

from blocksar.collection.beam import weighted_pulses
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Taper, Weighting

TAPERS = ["uniform", "taylor:4:-35", "taylor:5:-30", "hamming", "hann", "kaiser:2.5", "kaiser:6"]


@pytest.mark.parametrize("n", [100, 101])
def test_tapers_are_those_of_scipy(n: int) -> None:
    v = (2 * np.arange(n) + 1 - n) / n
    np.testing.assert_allclose(Taper.parse("taylor:4:-35").samples(n), windows.taylor(n, 4, 35, norm=False), atol=1e-12)
    np.testing.assert_allclose(Taper.parse("hamming")(v), 0.54 + 0.46 * np.cos(np.pi * v), atol=1e-12)
    np.testing.assert_allclose(Taper.parse("hann")(v), np.cos(np.pi * v / 2) ** 2, atol=1e-12)
    edge = np.linspace(-1, 1, n)
    np.testing.assert_allclose(Taper.parse("kaiser:6")(edge), windows.kaiser(n, 6), atol=1e-12)
    assert (Taper()(v) == 1).all()


@pytest.mark.parametrize("text", TAPERS)
def test_every_taper_is_its_series_of_cosines(text: str) -> None:
    taper, v = Taper.parse(text), np.linspace(-1, 1, 1001)
    terms, frequency = taper.series
    total = sum(a * np.cos(np.pi * frequency * k * v) for k, a in enumerate(terms))
    np.testing.assert_allclose(taper(v), total, atol=1e-10)
    assert Taper.parse(taper.text) == taper


@pytest.mark.slow
@pytest.mark.parametrize("text", TAPERS)
def test_ideal_figures_are_those_of_the_response(text: str) -> None:
    """The response by adaptive quadrature, at a few places; its figures by reading a finely sampled one."""
    taper = Taper.parse(text)
    v = (np.arange(1000) + 0.5) / 500 - 1
    u = np.linspace(0, 10 * taper.ideal.width, 2001)
    response = np.array([(taper(v) * np.cos(np.pi * v * at)).sum() for at in u]) / taper(v).sum()
    whole = quad(lambda at: float(taper(np.array(at))), -1, 1)[0]
    wave = quad(lambda at: float(taper(np.array(at))) * np.cos(np.pi * at * u[350]), -1, 1, limit=200)[0]
    assert response[350] == pytest.approx(wave / whole, abs=1e-6)
    power = response**2
    first = int(np.flatnonzero(np.diff(power) > 0)[0])
    assert np.interp(taper.ideal.width / 2, u, power) == pytest.approx(0.5, abs=1e-4)
    assert 10 * np.log10(power[first:].max()) == pytest.approx(taper.ideal.pslr, abs=0.02)
    side, main = np.trapezoid(power[first:]), np.trapezoid(power[: first + 1])
    assert 10 * np.log10(side / main) == pytest.approx(taper.ideal.islr, abs=0.03)


def test_a_taper_for_one_axis_takes_precedence() -> None:
    both = Weighting.parse("hann", azimuth="taylor:4:-35")
    assert both == Weighting(Taper("hann"), Taper("taylor", (4.0, -35.0)))
    assert both.text == "hann in range, taylor:4:-35 in azimuth"
    assert Weighting.parse() == UNIFORM and UNIFORM.uniform and not both.uniform


def test_kaiser_falls_on_beyond_its_ends() -> None:
    """Places of targets that are not lit: its series of cosines grows to 1e20 there, or turns negative."""
    for taper in (Taper("kaiser", (2.5,)), Taper("kaiser", (12.0,))):
        v = np.linspace(1.0, 3.0, 201)
        assert (taper(v) > 0).all() and (np.diff(taper(v)) <= 0).all()
        np.testing.assert_allclose(taper(1 + v * 1e-9), taper(np.array(1.0)), rtol=1e-5)
        np.testing.assert_array_equal(taper(-v), taper(v))
        np.testing.assert_allclose(np.diff(taper(np.array([1.0, 1.0 + 1e-6]))) / 1e-6, taper.slope(v[:1]), rtol=1e-3)
        np.testing.assert_array_equal(taper.slope(v), taper.slope(v[:1]).repeat(v.size))


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35", "kaiser:6"])
@pytest.mark.parametrize("change", [{}, {"steering_deg": -26.23, "yaw_deg": 179.5}, {"steering_deg": None}])
def test_the_sum_of_weights_is_that_of_all_lit_pulses(text: str, change: dict[str, Any]) -> None:
    """Pulse by pulse, for points with full dwells and cut ones; some pulses are missing."""
    c, taper = collection(n_pulse=240, prf=800.0, **change), Taper.parse(text)
    geometry = Geometry(collection=c)
    yaw = np.radians(change.get("yaw_deg", 50.0)) + np.linspace(-0.09, 0.09, 41)
    valid = np.ones(c.n_pulse)
    valid[[3, 100, 101]] = [0.0, 0.5, 0.0]
    x, y = geometry.ground_axes(np.full(yaw.size, 30e3), yaw)
    v = np.broadcast_to((2 * np.arange(c.n_pulse) + 1 - c.n_pulse) / c.n_pulse, (yaw.size, c.n_pulse))
    if c.beam_width is not None:
        v = 2 * geometry.beam.offset(x[:, None], y[:, None], slice(None)) / c.beam_width
    wanted = (geometry.beam.is_lit(x, y) * valid * taper(v)).sum(axis=1)
    np.testing.assert_allclose(weighted_pulses(c, geometry.yaw(x, y), valid, taper), wanted, atol=1e-9 * c.n_pulse)
