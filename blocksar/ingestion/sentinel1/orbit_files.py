"""Precise orbits of Sentinel-1: EOF files, states every 10 s in Earth-fixed axes."""

from __future__ import annotations

from datetime import UTC, datetime
from xml.etree import ElementTree

import numpy as np

from blocksar.errors import InputError
from blocksar.ingestion.reading import reading
from blocksar.ingestion.sentinel1.gps import GPS
from blocksar.ingestion.strips.orbit import Orbit
from blocksar.places import Location, readable

TAI_AHEAD = 19.0  # s, of GPS time
MARGIN = 60.0  # s before and after the data, of which states are taken
STATE = ("X", "Y", "Z", "VX", "VY", "VZ")


def read_orbit_file(path: Location, first: float, last: float, zero: int) -> Orbit:
    """Read the states about times first .. last, s after the GPS second `zero`.

    Raises
    ------
    InputError
        If it is no such file, damaged, or of another time.
    """
    where = readable(path)
    with reading(
        where, damaged="no orbit file of Sentinel-1 (EOF)", remedy="give one, such as S1A_OPER_AUX_POEORB_*.EOF"
    ):
        with where.open() as file:
            root = ElementTree.parse(file).getroot()
        times, states = [], []
        for state in root.iter("OSV"):
            text = state.findtext("TAI", "").removeprefix("TAI=")
            moment = datetime.fromisoformat(text).replace(tzinfo=UTC) - GPS
            times.append(moment.days * 86400 - zero + moment.seconds + moment.microseconds * 1e-6 - TAI_AHEAD)
            states.append([float(state.findtext(name, "nan")) for name in STATE])
        if not times:
            raise InputError("it holds no states of an orbit (OSV); give a file of precise or restituted orbits")
        time, values = np.array(times), np.array(states)
        near = (time >= first - MARGIN) & (time <= last + MARGIN)
        if time.min() > first or time.max() < last or near.sum() < 2:
            raise InputError(
                f"its states begin {time.min() - first:.6g} s after the data do and end {time.max() - last:.6g} s "
                "after them; give the file of the day of the data"
            )
        return Orbit(time=time[near], position=values[near, :3], velocity=values[near, 3:])
