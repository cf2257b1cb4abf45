"""Backscatter of datasets that were opened of runs, for their accessor: computed in parts where they have chunks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import xarray as xr

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.places import Location, place
from blocksar.products.backscatter import MEANINGS, GroundFactors, check_quantity, describe_factor
from blocksar.products.shared_options import Quantity, parse_calibration
from blocksar.runs.finished import FinishedRun, finished_record
from blocksar.runs.folder import member

SCATTERING = "surface_backwards_scattering_coefficient_of_radar_wave"  # CF's name of sigma0
DIMENSIONS = ("channel", "look")
Power = Callable[[xr.Dataset], FloatArray]
Grounds = Mapping[str, GroundFactors]  # by channel or look; of an image without them by ""


def compute(
    dataset: xr.Dataset,
    power: Power,
    names: list[str],
    quantity: str,
    calibration: float | Location | None,
    *,
    db: bool,
) -> xr.DataArray:
    """Compute the backscatter of a power: see `SarAccessor.backscatter`.

    Parameters
    ----------
    dataset : Dataset
        As opened of a run, or a part of it.
    power : callable
        Gives the power ([channel,] y, x) of a dataset with the variables of some names.
    names : list of str
        These variables; the first has the dimensions of the power.

    Raises
    ------
    InputError
        If the quantity or the calibration is none, or the run is not found or lacks what is needed.
    """
    checked = check_quantity(quantity)
    factor = None if calibration is None else parse_calibration(calibration)
    grounds = _open_grounds(dataset, checked)
    run = next(iter(grounds.values())).run
    if factor is None:
        factor = stores.calibration_of({**run.attrs, **dataset.attrs})
    needed = [name for name in ("block", "visibility") if name in dataset]
    for name, why in (("block", len(run.segments) > 1), ("visibility", run.geometry.terrain is not None)):
        if why and name not in needed:
            raise InputError(f"the dataset has no {name}, on which backscatter depends here; keep it beside image")
    part = dataset[[*names, *needed]].unify_chunks()
    scale = partial(_scale, grounds=grounds, power=power, name=names[0], factor=factor or 1.0, db=db)
    template = part[names[0]].real.astype(np.float32)
    found: xr.DataArray = xr.map_blocks(scale, part, template=template)
    mapping = dataset[names[0]].attrs.get("grid_mapping")
    found.attrs = {
        "units": "dB" if db else "1",
        "long_name": f"backscatter {checked}, {MEANINGS[checked]}",
        **({"standard_name": SCATTERING} if checked == "sigma0" and not db else {}),
        "calibration": describe_factor(factor),
        **({} if factor is None else {stores.CALIBRATION_FACTOR: factor}),
        **({} if mapping is None else {"grid_mapping": mapping}),
    }
    found.encoding = {}
    return found.rename(checked)


def _open_grounds(dataset: xr.Dataset, quantity: Quantity) -> Grounds:
    """Open the run that a dataset is of, and find what scales its images."""
    source = str(dataset.encoding.get("source") or "")
    try:
        if not source:
            raise InputError("of which this dataset tells nothing")
        folder = place(source.rstrip("/").removesuffix("/image.zarr"))
        record = finished_record(folder)
    except InputError as error:
        raise InputError(
            f"backscatter depends on track, beam and ground, which are in the folder of the run ({error}); open the "
            "run with blocksar.open, and take .sar.backscatter of what it returns, or of parts of that"
        ) from error
    if not record.channels:
        return {"": GroundFactors(FinishedRun.open(folder), quantity)}
    if record.dimension not in dataset.coords:
        raise InputError(f"the dataset has no coordinate {record.dimension}; keep it beside image")
    names = [str(name) for name in np.atleast_1d(dataset[record.dimension].values)]
    return {name: GroundFactors(FinishedRun.open(member(folder, name, record.dimension)), quantity) for name in names}


def _scale(part: xr.Dataset, *, grounds: Grounds, power: Power, name: str, factor: float, db: bool) -> xr.DataArray:
    """Compute the backscatter of a part of a dataset, of variable `name` for its dimensions."""
    template = part[name]
    x, y = (np.asarray(part[axis].values, np.float64) for axis in "xy")
    layers = [part[layer].values if layer in part else None for layer in ("block", "visibility")]
    own = list(grounds.values())
    if list(grounds) != [""]:
        dimension = next(dimension for dimension in DIMENSIONS if dimension in part.coords)
        own = [grounds[str(each)] for each in np.atleast_1d(part[dimension].values)]
    factors = [ground.over(x, y, *layers) for ground in own]
    values = power(part) * factor * (np.stack(factors) if template.ndim > 2 else factors[0])
    if db:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = 10 * np.log10(values)
    return template.copy(data=np.asarray(values, np.float32))
