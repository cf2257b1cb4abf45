"""Point targets at known positions, read from a store's attributes and checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from blocksar.collection.collection import FARTHEST
from blocksar.errors import InputError


class Target(NamedTuple):
    """A point target: scene-frame x, y in m, complex reflectivity, and z in m; None: on the ground."""

    name: str
    x: float
    y: float
    reflectivity: complex = 1.0
    z: float | None = None

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Target:
        """Read an entry of a store's `targets`: name, x, y, and optionally z and "reflectivity": [re, im].

        Raises
        ------
        InputError
            If a field is missing or is not a number, or if the reflectivity is zero.
        """
        try:
            reflectivity = record.get("reflectivity", 1.0)
            if not isinstance(reflectivity, (int, float, complex)):
                real, imaginary = reflectivity
                reflectivity = complex(float(real), float(imaginary))
            z = None if record.get("z") is None else float(record["z"])
            target = cls(str(record["name"]), float(record["x"]), float(record["y"]), complex(reflectivity), z)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(
                f"target {record!r} cannot be read; give it name, x and y in m and, if it is not 1, "
                "reflectivity as [real, imaginary]"
            ) from None
        if not (np.isfinite([target.x, target.y, target.z or 0.0]).all() and np.isfinite(target.reflectivity)):
            raise InputError(f"target {record!r} has a value that is not finite; give numbers")
        if target.reflectivity == 0:
            raise InputError(f"target {target.name} has reflectivity 0, so there is nothing to measure; leave it out")
        farthest = max(abs(target.x), abs(target.y), abs(target.z or 0.0))
        if farthest > FARTHEST or not 1e-15 < abs(target.reflectivity) < 1e15:
            raise InputError(f"target {record!r} is far outside any scene; give metres, and a reflectivity about 1")
        return target

    def as_record(self) -> dict[str, Any]:
        """The entry that `from_record` reads."""
        sigma = complex(self.reflectivity)
        known = {"name": self.name, "x": self.x, "y": self.y, "reflectivity": [sigma.real, sigma.imag]}
        return known if self.z is None else {**known, "z": self.z}
