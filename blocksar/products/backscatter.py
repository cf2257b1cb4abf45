"""Backscatter of an image: its power per area of the ground, of the slant plane, or across the line of sight.

    sigma0 = K |image|^2 / A,    beta0 = sigma0 / sin(incidence),    gamma0 = sigma0 / cos(incidence)

A, m^2, is the area of the point response on the ground (`imaging.response_area`), on a terrain that of its slope; the
incidence angle is the local one at the middle of the dwell. Broadside, beta0 is that of an area of the slant plane. K,
m^2, is the radar cross-section of a target that peaks at 1, one number for the image: the samples are free of what
changes over it, such as the spreading loss, unless patterns say so. Without K all is relative, as if it were 1 m^2.

On a terrain, layover and shadow are NaN: there, the power is that of several places, or of none.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.errors import InputError
from blocksar.imaging.response_area import AreaMap
from blocksar.imaging.terrain_layers import ROWS, Sight, box_of, level_incidence, slope_factors
from blocksar.inspection.samples import Inspection, merge
from blocksar.kernels.occlusion import VISIBLE
from blocksar.kernels.phase import Float32Array
from blocksar.products.shared_options import Quantity
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import RunRecord

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
READ = ("recover", "inspect")  # stages whose receipts have the findings in the samples
MEANINGS = {
    "sigma0": "per area of the ground",
    "beta0": "per area of the slant plane: sigma0 over the sine of the incidence angle",
    "gamma0": "per area across the line of sight: sigma0 over the cosine of the incidence angle",
}
UNCALIBRATED = "uncalibrated: relative, as if a target that peaks at 1 had a radar cross-section of 1 m2"


def check_quantity(quantity: Any) -> Quantity:
    """Return a quantity of backscatter.

    Raises
    ------
    InputError
        If it is none.
    """
    if quantity not in QUANTITIES:
        raise InputError(f"quantity = {quantity!r}: give one of {', '.join(QUANTITIES)}")
    return quantity


def describe_factor(factor: float | None) -> str:
    """Say how backscatter is calibrated."""
    return UNCALIBRATED if factor is None else f"a target that peaks at 1 has a radar cross-section of {factor:.6g} m2"


def label_of(quantity: Quantity, factor: float | None) -> str:
    """Label of a picture of a quantity in dB."""
    return f"{quantity} (dB{'' if factor is not None else ', uncalibrated'})"


def valid_pulses(record: RunRecord, segment: int | None) -> FloatArray | None:
    """Share of each pulse's samples that were valid, (n_pulse,), by a run's receipts; None if they do not say."""
    ending = "" if segment is None else f"-of-segment-{segment}"
    found = [
        Inspection.from_dict(dict(each.found))
        for each in record.receipts
        if each.stage in READ and each.found and (each.unit.endswith(ending) if ending else "-of-" not in each.unit)
    ]
    return merge(found).lit if found else None


def valid_of(run: FinishedRun, segment: int | None = None) -> FloatArray | None:
    """Share of each pulse's samples that were valid, of a run or a segment of it, if it is known."""
    valid = valid_pulses(run.record, segment)
    collection = (run.geometry if segment is None else run.segments[segment]).collection
    return valid if valid is not None and valid.size == collection.n_pulse else None


@dataclass(frozen=True, eq=False)
class GroundFactors:
    """Factors that turn the power of a run's pixels into backscatter.

    Attributes
    ----------
    run : FinishedRun
    quantity : {"sigma0", "beta0", "gamma0"}
    """

    run: FinishedRun
    quantity: Quantity

    @cached_property
    def _areas(self) -> list[AreaMap]:
        """The areas of the responses of each segment."""
        run = self.run
        if not run.segments:
            return [AreaMap.of(run.geometry, run.weighting, valid_of(run))]
        return [AreaMap.of(each, run.weighting, valid_of(run, number)) for number, each in enumerate(run.segments)]

    @cached_property
    def _sights(self) -> list[Sight]:
        """The antenna as the pixels of each segment see it."""
        run, terrain = self.run, self.run.geometry.terrain
        levels = (run.ground_height, run.ground_height) if terrain is None else terrain.limits
        return [Sight.of(each, box_of(run.x, run.y), levels) for each in run.segments or (run.geometry,)]

    def over(
        self, x: FloatArray, y: FloatArray, owner: NDArray[Any] | None = None, visible: NDArray[Any] | None = None
    ) -> Float32Array:
        """Factors at pixels of columns x (n_x,) and rows y (n_y,), m, either way: (n_y, n_x), 1/m^2.

        NaN where no pulse lights a pixel, where `owner` (n_y, n_x), the block of each, is below 0, and where `visible`
        (n_y, n_x), the layer `visibility`, is not VISIBLE.
        """
        along_x, along_y = (slice(None, None, -1 if axis.size > 1 and axis[0] > axis[-1] else 1) for axis in (x, y))
        x, y, factor = x[along_x], y[along_y], np.full((y.size, x.size), np.nan, np.float32)
        segment = np.zeros(factor.shape, np.int64)
        if owner is not None:
            owner = owner[along_y, along_x]
            for block in np.unique(owner):
                segment[owner == block] = -1 if block < 0 else self.run.segment_of(int(block))
        for number in np.unique(segment[segment >= 0]).tolist():
            np.copyto(factor, self._of(number, x, y), where=segment == number)
        factor = factor[along_y, along_x]
        if visible is not None:
            factor[visible != VISIBLE] = np.nan
        return factor

    def _of(self, number: int, x: FloatArray, y: FloatArray) -> Float32Array:
        """Factors as a segment has them."""
        area, sight, terrain = self._areas[number], self._sights[number], self.run.geometry.terrain
        if terrain is None:
            factor, incidence = 1 / area.over(x, y), level_incidence(sight, x, y, self.run.ground_height)
        else:
            factor, incidence = 1 / area.over(x, y, terrain.on_grid(x, y)), np.empty((y.size, x.size))
            for first in range(0, y.size, ROWS):
                rows = slice(first, first + ROWS)
                slopes = slope_factors(terrain, sight, x, y[rows])
                factor[rows] *= slopes.area
                incidence[rows] = slopes.incidence
        if self.quantity == "sigma0":
            return factor.astype(np.float32)
        return np.asarray(factor / (np.sin if self.quantity == "beta0" else np.cos)(incidence), np.float32)


@dataclass(frozen=True, eq=False)
class BackscatterRun(FinishedRun):
    """A finished run whose pixels have the power of a quantity of backscatter.

    Attributes
    ----------
    ground : GroundFactors
    factor : float or None
        Radar cross-section of a target that peaks at 1, m^2; None: unknown.
    """

    ground: GroundFactors | None = None
    factor: float | None = None

    @classmethod
    def of(cls, source: FinishedRun, quantity: Quantity, calibration: float | None = None) -> Self:
        """The run with backscatter for power; its own attribute holds where no calibration is given.

        Raises
        ------
        InputError
            If the quantity is none.
        """
        own = {field.name: getattr(source, field.name) for field in fields(FinishedRun)}
        factor = stores.calibration_of(source.attrs) if calibration is None else calibration
        return cls(**own, ground=GroundFactors(source, check_quantity(quantity)), factor=factor)

    @property
    def quantity(self) -> Quantity:
        assert self.ground is not None
        return self.ground.quantity

    @property
    def label(self) -> str:
        """Label of a picture in dB."""
        return label_of(self.quantity, self.factor)

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        """Read pixels times the root of their factors; NaN also in layover and shadow."""
        assert self.ground is not None
        pixels, owner = super().read(rows, columns), self.read_block(rows, columns)
        visible = None
        if self.geometry.terrain is not None:
            visible = self.read_layer("visibility", rows, columns)
        factor = self.ground.over(self.x[columns], self.y[rows], owner, visible)
        return np.asarray(pixels * np.sqrt((self.factor or 1.0) * factor), np.complex64)
