"""Position of a scene frame on the Earth: origin, axes, coordinate conversions and a map projection of its plane.

A scene frame is Cartesian, with its origin at a geodetic position on WGS 84 and z along the ellipsoid's normal there. x
points east and y north, or both are turned from there by `rotation`, counter-clockwise seen from above. Points of the
frame convert to ECEF by

    ecef = origin + x x_axis + y y_axis + z z_axis

without approximation; PROJ converts ECEF to latitude, longitude and height.

The attribute `georeference` of stores is `Georeference.as_attribute()`: {"kind": "ENU", "latitude", "longitude"
(degrees), "height" (m above the ellipsoid), "rotation_deg"}. It also gives "ecef" (m), "east", "north" and "up" (unit
vectors) for readers without such a library.
"""

from __future__ import annotations

import reprlib
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

SEMI_MAJOR_AXIS = 6378137.0  # m, WGS 84
INVERSE_FLATTENING = 298.257223563
ECCENTRICITY_2 = (2 - 1 / INVERSE_FLATTENING) / INVERSE_FLATTENING
HEIGHTS = (-12e3, 100e3)  # m above the ellipsoid: accepted heights of an origin
ECEF_TOLERANCE = 0.01  # m that latitude, longitude and height may disagree with ecef
AXIS_TOLERANCE = 1e-7  # rad: 1 mm at 10 km
REMEDY = 'give {"kind": "ENU", "latitude": degrees, "longitude": degrees, "height": m above WGS 84}'


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """Origin and axes of a scene frame.

    Attributes
    ----------
    latitude, longitude : float
        Of the origin, geodetic, WGS 84, degrees.
    height : float
        Of the origin above the ellipsoid, m.
    rotation : float
        Of the x axis from east, counter-clockwise seen from above, degrees.

    Raises
    ------
    InputError
        If a number is not finite or out of its range.
    """

    latitude: float
    longitude: float
    height: float
    rotation: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "latitude": (-90.0, 90.0),
            "longitude": (-360.0, 360.0),
            "height": HEIGHTS,
            "rotation": (-360.0, 360.0),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(
                    f"georeference: {name} is {float(value)!r}, which is not in {low:g} .. {high:g}; {REMEDY}"
                )

    @classmethod
    def among(cls, attrs: Mapping[str, Any]) -> Georeference | None:
        """The georeference among the attributes of a store; None where they have none.

        Raises
        ------
        InputError
            As `from_attribute`.
        """
        attribute = attrs.get("georeference")
        return None if attribute is None else cls.from_attribute(attribute)

    @classmethod
    def from_attribute(cls, attribute: Any) -> Georeference:
        """Read the attribute `georeference` of a store.

        Raises
        ------
        InputError
            If it is not such a mapping, or its ecef or unit vectors contradict latitude, longitude and height.
        """
        if not isinstance(attribute, Mapping):
            raise InputError(f"georeference is {type(attribute).__name__} instead of a mapping; {REMEDY}")
        if (kind := attribute.get("kind")) != "ENU":
            raise InputError(f"georeference is of kind {reprlib.repr(kind)}, and only 'ENU' is known; {REMEDY}")
        names = {"latitude": "latitude", "longitude": "longitude", "height": "height", "rotation_deg": "rotation"}
        numbers = {names[key]: _number(attribute, key) for key in names if key != "rotation_deg" or key in attribute}
        georeference = cls(**numbers)
        for name, axis in zip(("east", "north", "up"), georeference.east_north_up, strict=True):
            if name in attribute and not np.allclose(_vector(attribute, name), axis, rtol=0, atol=AXIS_TOLERANCE):
                raise InputError(f"georeference: {name} is not that of its latitude and longitude; leave {name} out")
        if "ecef" in attribute:
            apart = float(np.linalg.norm(_vector(attribute, "ecef") - georeference.origin))
            if not apart <= ECEF_TOLERANCE:
                raise InputError(
                    f"georeference: ecef lies {apart:.4g} m from its latitude, longitude and height; leave ecef out"
                )
        return georeference

    @classmethod
    def at(cls, ecef: FloatArray, *, rotation: float = 0.0) -> Georeference:
        """The frame with its origin at a point (3,), ECEF, m."""
        latitude, longitude, height = geodetic_of(ecef).tolist()
        return cls(latitude=latitude, longitude=longitude, height=height, rotation=rotation)

    def as_attribute(self) -> dict[str, Any]:
        """The attribute `georeference` of stores, JSON-serialisable."""
        east, north, up = (axis.tolist() for axis in self.east_north_up)
        return {
            "kind": "ENU",
            "latitude": self.latitude,
            "longitude": self.longitude,
            "height": self.height,
            "rotation_deg": self.rotation,
            "ecef": self.origin.tolist(),
            "east": east,
            "north": north,
            "up": up,
        }

    @cached_property
    def east_north_up(self) -> FloatArray:
        """Unit vectors at the origin, one a row, (3, 3), ECEF."""
        lat, lon = np.radians([self.latitude, self.longitude])
        return np.array([
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ])  # fmt: skip

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors of x, y and z, one a row, (3, 3), ECEF."""
        cos, sin = np.cos(np.radians(self.rotation)), np.sin(np.radians(self.rotation))
        return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ self.east_north_up

    @cached_property
    def origin(self) -> FloatArray:
        """Origin (3,), ECEF, m: (N + h) up, with (1 - e^2) N in place of N for z; N is the prime vertical's radius."""
        up = self.east_north_up[2]
        normal = SEMI_MAJOR_AXIS / np.sqrt(1 - ECCENTRICITY_2 * up[2] ** 2)
        return (normal * np.array([1.0, 1.0, 1 - ECCENTRICITY_2]) + self.height) * up

    def to_ecef(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) of the frame, in ECEF, m."""
        return self.origin + np.asarray(points, np.float64) @ self.axes

    def from_ecef(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) given in ECEF, in the frame, m."""
        return (np.asarray(points, np.float64) - self.origin) @ self.axes.T

    def to_geodetic(self, points: FloatArray) -> FloatArray:
        """Latitude, longitude (degrees) and height (m) of points (..., 3) of the frame: (..., 3)."""
        return geodetic_of(self.to_ecef(points))

    def from_geodetic(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) given as latitude, longitude (degrees) and height (m), in the frame, m."""
        latitude, longitude, height = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        ecef = _geodetic_of_ecef().transform(longitude, latitude, height)
        return self.from_ecef(np.stack(ecef, axis=-1))

    def grid_mapping(self, ground_height: float = 0.0) -> dict[str, Any] | None:
        """CF grid mapping whose easting and northing are x and y of the plane z = ground_height.

        It is the transverse Mercator projection about the origin, scaled to the height of the plane. A tangent plane
        and this projection differ by d^3 / (3 R^2) at the distance d: 8 mm at 10 km, 0.2 m at 30 km. CF cannot
        describe axes that are turned from east and north: the result is then None.
        """
        if self.rotation % 360:
            return None
        return _mercator(self.latitude, self.longitude, self.height + ground_height)

    def projection(self, x: float, y: float, ground_height: float) -> CRS:
        """The transverse Mercator projection about the point (x, y), m, of the plane z = ground_height."""
        if (x, y) == (0.0, 0.0):
            return _crs(_mercator(self.latitude, self.longitude, self.height + ground_height))
        latitude, longitude, height = self.to_geodetic(np.array([x, y, ground_height]))
        return _crs(_mercator(float(latitude), float(longitude), float(height)))

    def map_projection(self, ground_height: float) -> dict[str, Any] | None:
        """The CF grid mapping, with its WKT 2 (`crs_wkt`) where PROJ, which is optional, is there."""
        mapping = self.grid_mapping(ground_height)
        if mapping is not None:
            with suppress(InputError, ImportError):
                mapping["crs_wkt"] = self.projection(0.0, 0.0, ground_height).to_wkt("WKT2_2019")
        return mapping

    def project(self, crs: CRS, points: FloatArray) -> FloatArray:
        """Easting and northing (..., 2), m, of points (..., 3) of the frame in a map projection."""
        from pyproj import Transformer

        geodetic = self.to_geodetic(points)
        to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
        return np.stack(to_map.transform(geodetic[..., 1], geodetic[..., 0]), axis=-1)


def geodetic_of(ecef: FloatArray) -> FloatArray:
    """Latitude, longitude (degrees) and height above WGS 84 (m) of points (..., 3) in ECEF, m: (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(ecef, np.float64), -1, 0)
    longitude, latitude, height = _geodetic_of_ecef().transform(x, y, z, direction="INVERSE")
    return np.stack([latitude, longitude, height], axis=-1)


def datum_tie(crs: CRS, longitude: float, latitude: float) -> tuple[float, str]:
    """Accuracy of PROJ's tie of a CRS to WGS 84 at a place (degrees), m; 0 for the same datum, NaN without a tie.

    And the grid that a better tie needs, which is not installed; or nothing.
    """
    accuracy, lacking = _tie(crs, longitude, latitude)
    # Newer versions of PROJ know no accuracy where all is a map projection of the same datum.
    if accuracy < 0 and crs.geodetic_crs is not None and _tie(crs.geodetic_crs, longitude, latitude)[0] == 0:
        accuracy = 0.0
    return (accuracy if accuracy >= 0 else np.nan), lacking


def _tie(crs: CRS, longitude: float, latitude: float) -> tuple[float, str]:
    """Query PROJ for the accuracy of the tie, m, -1 for none, and the name of a missing grid that would improve it."""
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    longitude = longitude - 360 * round(longitude / 360)
    about = AreaOfInterest(longitude, latitude, longitude, latitude)
    with warnings.catch_warnings():  # warnings about the transformations that are returned
        warnings.simplefilter("ignore")
        ties = TransformerGroup("EPSG:4326", crs, always_xy=True, area_of_interest=about)
    accuracy = float(ties.transformers[0].accuracy) if ties.transformers else -1.0
    lacking = [grid.short_name for tie in ties.unavailable_operations[:1] for grid in tie.grids]
    return accuracy, lacking[0] if lacking else ""


def _mercator(latitude: float, longitude: float, height: float) -> dict[str, Any]:
    # The mean radius of curvature, sqrt(M N).
    radius = SEMI_MAJOR_AXIS * np.sqrt(1 - ECCENTRICITY_2) / (1 - ECCENTRICITY_2 * np.sin(np.radians(latitude)) ** 2)
    return {
        "grid_mapping_name": "transverse_mercator",
        "latitude_of_projection_origin": latitude,
        "longitude_of_central_meridian": longitude,
        "scale_factor_at_central_meridian": float(1 + height / radius),
        "false_easting": 0.0,
        "false_northing": 0.0,
        "semi_major_axis": SEMI_MAJOR_AXIS,
        "inverse_flattening": INVERSE_FLATTENING,
        "reference_ellipsoid_name": "WGS 84",
        "horizontal_datum_name": "World Geodetic System 1984",
        "geographic_crs_name": "WGS 84",
        "projected_crs_name": "transverse Mercator about the scene",
        "prime_meridian_name": "Greenwich",
        "longitude_of_prime_meridian": 0.0,
    }


def _crs(mapping: dict[str, Any]) -> CRS:
    from pyproj import CRS

    return CRS.from_cf(mapping)


@cache
def _geodetic_of_ecef() -> Transformer:
    """Transformer from longitude, latitude (degrees) and height to ECEF; its inverse converts back."""
    try:
        from pyproj import Transformer
    except ModuleNotFoundError:
        raise InputError("pyproj is not installed, which georeferences need; install blocksar[formats]") from None
    return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def _number(attribute: Mapping[str, Any], name: str) -> float:
    value = attribute.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e9:
        raise InputError(f"georeference: {name} is {reprlib.repr(value)} instead of a number; {REMEDY}")
    return float(value)


def _vector(attribute: Mapping[str, Any], name: str) -> FloatArray:
    try:
        values = np.array(attribute[name], np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(
            f"georeference: {name} is {reprlib.repr(attribute[name])} instead of three numbers; "
            "leave it out, or correct it"
        )
    return values


ROUNDED = 1e-12  # rad, to which the angle about the track is bisected: 1 micrometre at 1000 km


def find_scene_centre(
    position: FloatArray, velocity: FloatArray, *, slant_range: float, side: str, height: float, squint: float
) -> Georeference:
    """The frame about the point at a range from an antenna, at a height above WGS 84.

    The point p + R (sin(squint) t + cos(squint) (cos(a) d + sin(a) s)), with t along the velocity, d as close to the
    downward direction as a normal of t can be, and s to the side, rises with the angle a; a is bisected until the point
    has the height that is asked for.

    Parameters
    ----------
    position, velocity : (3,) float
        Of the antenna, Earth-centred, Earth-fixed, m and m/s; of the velocity only the direction counts.
    slant_range : float
        R, m.
    side : {"left", "right"}
        Of the track, seen along the flight.
    height : float
        m above WGS 84.
    squint : float
        Angle of the line of sight ahead of the plane normal to the velocity, rad; 0: where Doppler is zero.

    Raises
    ------
    InputError
        If no ground lies there: the range is shorter than the antenna's height, or reaches beyond the horizon.
    """
    along = velocity / np.linalg.norm(velocity)
    up, own = _up(position), geodetic_of(position)[2] - height
    down = -(up - float((up * along).sum()) * along)
    down /= np.linalg.norm(down)
    across = np.cross(along, down) if side == "left" else np.cross(down, along)
    centre, radius = position + slant_range * np.sin(squint) * along, slant_range * np.cos(squint)

    def point(angle: float) -> FloatArray:
        return np.asarray(centre + radius * (np.cos(angle) * down + np.sin(angle) * across))

    if geodetic_of(point(0.0))[2] >= height:
        raise InputError(
            f"slant_range is {slant_range:.6g} m, but the antenna is {own:.6g} m above the height of {height:g} m; "
            "correct one of them"
        )
    ground = point(_bisect(lambda angle: geodetic_of(point(angle))[2] - height))
    if float(((position - ground) * _up(ground)).sum()) <= 0:
        raise InputError(
            f"slant_range is {slant_range:.6g} m, beyond the horizon of an antenna {own:.6g} m high; correct it"
        )
    latitude, longitude, _ = geodetic_of(ground).tolist()
    return Georeference(latitude=latitude, longitude=longitude, height=height)


def _up(point: FloatArray) -> FloatArray:
    """The normal of the ellipsoid (3,) at a point, ECEF."""
    latitude, longitude, _ = geodetic_of(point).tolist()
    return np.asarray(Georeference(latitude=latitude, longitude=longitude, height=0.0).east_north_up[2])


def _bisect(value: Callable[[float], float]) -> float:
    """Root, by bisection up to half a turn, of a function that rises from below zero at 0."""
    low, high = 0.0, np.pi
    while high - low > ROUNDED:
        middle = (low + high) / 2
        low, high = (middle, high) if value(middle) < 0 else (low, middle)
    return (low + high) / 2
