"""A run as a tree of datasets: its image, its channels or looks, its blocks as planned, its targets as measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import xarray as xr

from blocksar import stores
from blocksar.errors import InputError
from blocksar.measurement.figures import DEFINITIONS, PointResponse
from blocksar.places.place import Place
from blocksar.products import dataset
from blocksar.products.page.facts import responses_of
from blocksar.runs.finished import finished_record
from blocksar.runs.folder import member
from blocksar.runs.record import PredictedBlock

QUALITY = "quality.json"
# Units by the last word of a figure's name, but `theory`; those of other figures are ratios.
UNITS = {
    "yaw": "rad", "range": "m", "memory": "byte", "bias": "m s-2", "phase": "rad", "pslr": "dB", "islr": "dB",
    "irw": "m", "resolution": "m", "x": "m", "y": "m",
}  # fmt: skip


def groups_of(run: Place) -> dict[str, xr.Dataset]:
    """The datasets of a finished run by their place in the tree.

    Returns
    -------
    dict
        "/": as `blocksar.open`. "/blocks" over `block`: the plan's prediction for each block, if it has any; `number`
        is that of the image's variable `block`. "/quality" over `target`: what `blocksar quality` has measured, if it
        has been. "/channels/NAME" or "/looks/NAME": all this of each channel or look.

    Raises
    ------
    InputError
        If there is no finished run, or it is damaged.
    """
    record = finished_record(run)
    groups = {"/": dataset.open(run)}
    if record.plan.predicted:
        groups["/blocks"] = _blocks(record.plan.predicted)
    if (run / QUALITY).exists():
        groups["/quality"] = _quality(run)
    for name in record.channels:
        for path, group in groups_of(member(run, name, record.dimension)).items():
            groups[f"/{record.dimension}s/{name}{path}".rstrip("/")] = group
    return groups


def _blocks(predicted: Sequence[PredictedBlock]) -> xr.Dataset:
    figures: dict[str, Any] = {
        field.name: [getattr(block, field.name) for block in predicted] for field in fields(PredictedBlock)
    }
    figures["number"] = figures.pop("block")
    figures["part"] = [-1 if part is None else part for part in figures["part"]]
    return _table("block", [block.name for block in predicted], figures, {"title": "blocks as planned"})


def _quality(run: Place) -> xr.Dataset:
    try:
        responses = responses_of(stores.read_json(run / QUALITY))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{run / QUALITY} is damaged ({error}); run `blocksar quality {run}` again") from error
    named = {"x": "target_x", "y": "target_y"}  # x and y are the axes of the image above
    figures = {
        named.get(name, name): [getattr(response, name) for response in responses]
        for name in PointResponse._fields
        if name != "name"
    }
    return _table(
        "target",
        [response.name for response in responses],
        figures,
        {"title": "targets as measured", "comment": DEFINITIONS},
    )


def _table(along: str, names: Sequence[str], figures: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """A dataset of figures along a dimension with names; pairs have the dimension `end` as well."""
    made = {}
    for name, values in figures.items():
        array = np.asarray(values)
        unit = UNITS.get(name.removesuffix("_theory").rpartition("_")[2], "1")
        made[name] = ((along, "end")[: array.ndim], array, {"units": unit, "long_name": name.replace("_", " ")})
    return xr.Dataset(made, coords={along: np.array(names, dtype=np.str_)}, attrs=attrs)
