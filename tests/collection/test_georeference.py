"""Georeferences, against PROJ."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pyproj import CRS, Transformer

from blocksar.collection.georeference import Georeference, datum_tie

# ---------------------------------------------------------------- georeference


def test_the_frame_is_the_topocentric_frame_of_proj() -> None:
    frame = Georeference(latitude=47.5, longitude=-122.3, height=120.0)
    points = np.random.default_rng(4).uniform(-2e4, 2e4, (50, 3))
    where = "+lat_0=47.5 +lon_0=-122.3 +h_0=120"
    pipeline = Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 {where}")
    ecef = frame.to_ecef(points)
    assert np.stack(pipeline.transform(*ecef.T), axis=1) == pytest.approx(points, abs=1e-6)
    assert frame.from_ecef(ecef) == pytest.approx(points, abs=1e-6)
    turned = Georeference(latitude=47.5, longitude=-122.3, height=120.0, rotation=90.0)
    assert turned.to_ecef(np.array([5.0, 0.0, 0.0])) == pytest.approx(frame.to_ecef(np.array([0.0, 5.0, 0.0])))


def test_a_georeference_survives_json() -> None:
    frame = Georeference(latitude=-12.25, longitude=130.125, height=33.0, rotation=-7.0)
    assert Georeference.from_attribute(json.loads(json.dumps(frame.as_attribute()))) == frame
    at = Georeference.at(frame.origin, rotation=-7.0)
    assert (at.latitude, at.longitude, at.height) == pytest.approx((-12.25, 130.125, 33.0), abs=1e-6)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (39.78, -84.1, 300.0), (-89.9, 179.0, -50.0), (90.0, 0.0, 5e3)])
def test_the_origin_agrees_with_proj(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    exact = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(longitude, latitude, height)
    origin = Georeference(latitude=latitude, longitude=longitude, height=height).origin
    assert np.abs(origin - exact).max() < 1e-6


@pytest.mark.parametrize("height", [0.0, 2500.0])
def test_easting_and_northing_are_x_and_y(height: float) -> None:
    frame = Georeference(latitude=63.0, longitude=17.0, height=100.0)
    points = np.random.default_rng(4).uniform(-1e4, 1e4, (50, 3))
    points[:, 2] = height
    found = frame.project(frame.projection(0.0, 0.0, height), points)
    assert np.abs(found - points[:, :2]).max() < 0.03  # d^3 / (3 R^2), and the ellipsoid's two radii at this height


@pytest.mark.parametrize(
    ("crs", "accuracy", "grid"),
    [("EPSG:32632", 0.0, ""), ("EPSG:25832", 1.0, ""), ("EPSG:31468", 3.0, "BETA2007"), ("EPSG:4267", np.nan, "")],
)
def test_a_datum_is_tied_to_wgs_84_as_well_as_proj_says(crs: str, accuracy: float, grid: str) -> None:
    """At Munich: the same datum, a continental one, a national one without its grid, and one of another continent."""
    found, lacking = datum_tie(CRS(crs), 11.5, 48.1)
    if grid and not lacking:
        pytest.skip(f"the grid {grid} is installed")
    assert found == pytest.approx(accuracy, nan_ok=True) and grid in lacking
