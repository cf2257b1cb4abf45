"""Positions in another frame than is said: named with what they look like, and with a remedy that works."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyproj
import pytest

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError

Array = Any
C, CARRIER = 299792458.0, 9.6e9
GM, SPIN = 3.986004418e14, 7.2921159e-5
PLACE = {"kind": "ENU", "latitude": 30.0, "longitude": 0.0, "height": 0.0}
FRAME = Georeference.from_attribute(PLACE)
TIME = (np.arange(256) - 128) / 900.0
FREQUENCY = (np.arange(64) - 32) * 0.6e6


def orbit(time: Array) -> Array:
    """Positions of a satellite (n, 3), inertial, m: a circle of free fall that passes 350 km beside the origin."""
    start = np.asarray(FRAME.to_ecef(np.array([-350e3, 0.0, 520e3])))
    radius = np.linalg.norm(start)
    ahead = np.cross(FRAME.axes[0], start)
    ahead *= radius / np.linalg.norm(ahead)
    turn = np.sqrt(GM / radius**3) * time
    return np.outer(np.cos(turn), start) + np.outer(np.sin(turn), ahead)


def turned(position: Array, time: Array) -> Array:
    """Inertial positions in the frame that turns with the Earth; both agree at t = 0."""
    cosine, sine = np.cos(SPIN * time), np.sin(SPIN * time)
    x, y, z = position.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


ECI, ECEF = orbit(TIME), turned(orbit(TIME), TIME)
LOCAL = FRAME.from_ecef(ECEF)
DISTANCE = np.linalg.norm(LOCAL, axis=1)
LATITUDE = np.stack(pyproj.Transformer.from_crs(4978, 4979).transform(*ECEF.T), axis=1)
AIRCRAFT = np.stack([0 * TIME - 8e3, 120.0 * TIME, 0 * TIME + 5e3], axis=1)
FLOWN = np.linalg.norm(AIRCRAFT, axis=1)
ABOVE = np.stack(pyproj.Transformer.from_crs(4978, 4979).transform(*FRAME.to_ecef(AIRCRAFT).T), axis=1)


def collection(position: Array, reference: Array, **more: Any) -> Any:
    point = np.array([10.0, 5.0, 0.0])
    track = LOCAL if np.max(reference) > 1e5 else AIRCRAFT
    walk = np.linalg.norm(track - point, axis=1) - reference
    signal = np.exp(-4j * np.pi / C * np.outer(walk, CARRIER + FREQUENCY))
    return blocksar.collection(
        signal=signal, time=TIME, range_frequency=FREQUENCY, antenna_position=position, reference_range=reference,
        carrier_frequency=CARRIER, georeference=PLACE, **more,
    )  # fmt: skip


Wrong = tuple[Array, Array, bool, str]
WRONG: dict[str, Wrong] = {
    "km": (ECEF / 1e3, DISTANCE, True, "looks like km: multiply it by 1000"),
    "mm": (ECEF * 1e3, DISTANCE, True, "moves at|looks like mm"),
    "km, as local": (ECEF / 1e3, DISTANCE, False, "looks Earth-centred, in km: multiply it by 1000;"),
    "Earth-centred, as local": (ECEF, DISTANCE, False, "looks Earth-centred; give earth_centred=True, and the georef"),
    "local, as Earth-centred": (LOCAL, DISTANCE, True, "looks like a local frame: leave out earth_centred"),
    "degrees": (LATITUDE, DISTANCE, True, "latitude and longitude in degrees, and height; convert it .*pyproj"),
    "degrees, as local": (LATITUDE, DISTANCE, False, "looks like latitude and longitude in degrees"),
    "longitude first": (LATITUDE[:, [1, 0, 2]], DISTANCE, False, "looks like latitude and longitude in degrees"),
    "height in km": (LATITUDE * [1, 1, 1e-3], DISTANCE, False, "in degrees, and height in km"),
    "radians": (LATITUDE * [np.pi / 180, np.pi / 180, 1], DISTANCE, True, "latitude and longitude in radians"),
    "degrees of an aircraft": (ABOVE, FLOWN, False, "looks like latitude and longitude in degrees"),
    "float32": (ECEF.astype("f4"), DISTANCE, True, r"rounded to float32, to steps of 0\.5 m, or 58.* rad of phase"),
    "float32, local": (LOCAL.astype("f4"), DISTANCE, False, "rounded to float32, to steps of 0.0312 m"),
    "inertial": (ECI, np.full(256, DISTANCE.mean()), True, "looks inertial .ECI.: .* turn it into the Earth-fixed"),
    "inertial, elsewhere": (turned(ECEF, 12e3), DISTANCE, True, "below its horizon; correct the georeference, or turn"),
    "z down": (AIRCRAFT * [1, 1, -1], FLOWN, False, "z looks like down, but must point up; of north, east and down"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_another_frame_is_named(name: str) -> None:
    position, reference, centred, sentence = WRONG[name]
    with pytest.raises(InputError, match=sentence) as caught:
        collection(position, reference, earth_centred=centred)
    assert "\n" not in str(caught.value)


RIGHT: dict[str, tuple[Array, Array, bool]] = {
    "Earth-fixed": (ECEF, DISTANCE, True),
    "Earth-fixed, constant reference": (ECEF, np.full(256, DISTANCE.mean()), True),
    "local": (LOCAL, DISTANCE, False),
    "float32 of short ranges": (AIRCRAFT.astype("f4"), FLOWN, False),
    "round numbers in float32": (
        np.stack([0 * TIME - 4e5, 0.5 * np.arange(256.0), 0 * TIME + 5e5], axis=1).astype("f4"), DISTANCE, False
    ),
    "a map projection": (AIRCRAFT + np.array([500e3, 6.9e6, 0]), FLOWN, False),
    "a map projection at the Earth's radius": (AIRCRAFT + np.array([500e3, 6.362e6, 0]), FLOWN, False),
    "a simulation on an Earth that stands still": (
        ECI, np.linalg.norm(FRAME.from_ecef(ECI), axis=1), True
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_unusual_positions_are_taken(name: str) -> None:
    position, reference, centred = RIGHT[name]
    collection(position, reference, earth_centred=centred)


REMEDIES: dict[str, Callable[[], Array]] = {
    "km": lambda: ECEF / 1e3 * 1000,
    "degrees": lambda: np.stack(
        pyproj.Transformer.from_crs(4979, 4978).transform(*LATITUDE.T), axis=-1
    ),
    "inertial": lambda: turned(ECI, TIME),
}  # fmt: skip


@pytest.mark.parametrize("name", REMEDIES)
def test_the_remedies_give_the_track(name: str) -> None:
    made = collection(REMEDIES[name](), DISTANCE, earth_centred=True)
    np.testing.assert_allclose(made["antenna_position"].values, LOCAL, atol=5e-3)  # m: of the conversion to degrees


def test_a_store_of_another_writer_is_held_to_the_same(tmp_path: Any) -> None:
    dataset = collection(LOCAL, DISTANCE)
    dataset["antenna_position"] = (("pulse", "axis"), ECEF)
    dataset.to_zarr(tmp_path / "ph.zarr", zarr_format=3, consolidated=False)
    for source in (dataset, tmp_path / "ph.zarr"):
        with pytest.raises(InputError, match="looks Earth-centred; give earth_centred=True"):
            blocksar.plan(source, grid="-40:40:1,-40:40:1")
