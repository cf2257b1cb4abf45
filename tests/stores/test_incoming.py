"""All that may come as an argument of `blocksar.collection`: taken with the right values, or refused in a sentence."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from arrays import arrays

import blocksar
from blocksar import stores
from blocksar.errors import InputError
from blocksar.stores import incoming

Arrays = dict[str, Any]
DIMS = {"signal": ("pulse", "range_frequency"), "antenna_position": ("pulse", "axis")}
XYZ = ["x", "y", "z"]
PAGE = Path(incoming.__file__).with_name("README.md")


def labelled(a: Arrays, name: str, dims: Any = None, coords: Any = None, **attrs: Any) -> xr.DataArray:
    dims = dims or DIMS.get(name, ("pulse",) if name != "range_frequency" else ("range_frequency",))
    return xr.DataArray(a[name], dims=dims, coords=coords, attrs=attrs)


def masked(a: Arrays, name: str) -> Any:
    return np.ma.masked_array(a[name], mask=np.arange(np.size(a[name])).reshape(np.shape(a[name])) == 3)


def pairs(a: Arrays) -> Any:
    return (1000 * np.stack([a["signal"].real, a["signal"].imag], axis=-1)).astype(np.int16)


class Quantity:
    """A number with a unit, as pint has it."""

    def __init__(self, magnitude: Any, units: str) -> None:
        self.magnitude, self.units = magnitude, units


class OnDevice:
    """An array of which numpy makes none."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


Case = Callable[[Arrays], Arrays]
STEPS = np.arange(400)
# For each check: what is taken as if it were the plain arrays, and what is refused, with the sentence.
TAKEN: dict[str, dict[str, Case]] = {
    "check_container": {
        "lists": lambda a: {"time": a["time"].tolist(), "antenna_position": a["antenna_position"].tolist()},
        "dask": lambda a: {"signal": da.from_array(a["signal"], chunks=(100, 96)), "time": da.from_array(a["time"])},
        "xarray": lambda a: {name: labelled(a, name) for name in ("signal", "time", "antenna_position")},
        "xarray around dask": lambda a: {"signal": labelled(a, "signal").chunk(pulse=100)},
        "pandas": lambda a: {"time": pd.Series(a["time"]), "antenna_position": pd.DataFrame(a["antenna_position"])},
        "a memory map's kind": lambda a: {"signal": a["signal"].astype(">c8"), "time": a["time"].astype(">f8")},
        "Fortran order": lambda a: {"signal": np.asfortranarray(a["signal"])},
        "a number of no dimension": lambda a: {"carrier_frequency": np.array(10e9), "beam_width": np.float64(0.02)},
    },
    "check_packed": {"NaN as fill value": lambda a: {"time": labelled(a, "time", _FillValue=np.nan)}},
    "check_masked": {
        "no mask": lambda a: {"time": np.ma.masked_array(a["time"]), "signal": np.ma.masked_array(a["signal"])},
    },
    "check_units_stated": {
        "km": lambda a: {"antenna_position": xr.DataArray(a["antenna_position"] / 1e3, attrs={"units": "km"})},
        "ms": lambda a: {"time": xr.DataArray(a["time"] * 1e3, attrs={"units": "ms"})},
        "MHz": lambda a: {"range_frequency": xr.DataArray(a["range_frequency"] / 1e6, attrs={"units": "MHz"})},
        "degrees": lambda a: {"beam_azimuth": xr.DataArray(np.degrees(a["beam_azimuth"]), attrs={"units": "degrees"})},
        "pint": lambda a: {"carrier_frequency": Quantity(10.0, "gigahertz"), "time": Quantity(a["time"] * 1e9, "ns")},
        "volts": lambda a: {"signal": labelled(a, "signal", units="V")},
    },
    "check_dimensions": {
        "transposed": lambda a: {name: labelled(a, name).T for name in DIMS},
        "other names": lambda a: {"signal": labelled(a, "signal", ("slow_time", "frequency")).T},
        "one unknown": lambda a: {"antenna_position": labelled(a, "antenna_position", ("pulse", "place")).T},
        "none": lambda a: {"signal": xr.DataArray(a["signal"]), "time": xr.DataArray(a["time"])},
    },
    "check_components": {
        "y, x, z": lambda a: {
            "antenna_position": labelled(a, "antenna_position", coords={"axis": XYZ}).sel(axis=["y", "x", "z"])
        },
        "north, east, up": lambda a: {
            "antenna_position": labelled(a, "antenna_position", coords={"axis": ["east", "north", "up"]}).isel(
                axis=[1, 0, 2]
            )
        },
        "numbers": lambda a: {
            "antenna_position": labelled(a, "antenna_position", coords={"axis": range(3)}).isel(axis=[2, 0, 1])
        },
        "columns": lambda a: {"antenna_position": pd.DataFrame(a["antenna_position"], columns=XYZ)[["z", "x", "y"]]},
    },
    "check_labels": {
        "reversed": lambda a: {"signal": labelled(a, "signal", coords={"pulse": STEPS})[::-1],
                               "time": labelled(a, "time", coords={"pulse": STEPS})},
        "reversed, by time": lambda a: {"signal": labelled(a, "signal", coords={"time": ("pulse", a["time"])})[::-1]},
        "dates": lambda a: {
            "signal": labelled(
                a, "signal",
                coords={"time": ("pulse", np.datetime64("2026-01-01") + (a["time"] * 1e9).astype("m8[ns]"))},
            )[::-1]
        },
        "descending frequency": lambda a: {
            "signal": labelled(a, "signal", coords={"range_frequency": 1e10 + a["range_frequency"]})[:, ::-1]
        },
        "frequency in MHz": lambda a: {
            "signal": labelled(
                a, "signal",
                coords={"range_frequency": ("range_frequency", a["range_frequency"] / 1e6, {"units": "MHz"})},
            )
        },
        "an index of pandas": lambda a: {
            "time": pd.Series(a["time"], index=STEPS + 7),
            "antenna_position": pd.DataFrame(a["antenna_position"], index=STEPS + 7).sample(frac=1, random_state=1),
        },
    },
    "check_relations": {
        "the same": lambda a: {"signal": labelled(a, "signal", coords={"carrier_frequency": 10e9})},
        "in GHz": lambda a: {
            "signal": labelled(a, "signal", coords={"carrier_frequency": ((), 10.0, {"units": "GHz"})})
        },
    },
    "check_pairs": {},
    "check_type": {
        "other precision": lambda a: {"signal": a["signal"].astype("c16"), "time": a["time"].astype("f16")},
    },
    "check_finite": {},
}  # fmt: skip
REFUSED: dict[str, dict[str, tuple[Case, str]]] = {
    "check_container": {
        "a mapping": (lambda a: {"time": {"t": a["time"]}}, "time is a dict .* give an array"),
        "a file": (lambda a: {"signal": "signal.npy"}, "signal is a str .'signal.npy'.; give an array"),
        "a generator": (lambda a: {"time": (t for t in a["time"])}, "time is a generator .* give an array"),
        "an object": (lambda a: {"time": object()}, "time is a object; give an array of numbers"),
        "None within": (lambda a: {"reference_range": [None, *[1e4] * 399]}, "reference_range holds objects"),
        "a device's": (lambda a: {"signal": OnDevice()}, r"OnDevice, of which numpy makes no array .* \.cpu"),
        "a set": (lambda a: {"time": set(a["time"])}, "time is a set; give an array"),
        "NA of pandas": (lambda a: {"time": pd.array([*a["time"][:-1], pd.NA])}, "time holds objects|not finite"),
        "a dataset": (lambda a: {"signal": xr.Dataset({"signal": labelled(a, "signal")})}, "signal is a .*Dataset"),
        "ragged": (lambda a: {"signal": [[1j], [1j, 2j]]}, "list of rows of different lengths"),
        "text for a number": (lambda a: {"carrier_frequency": "10e9"}, "carrier_frequency is '10e9'; give a number"),
    },
    "check_packed": {
        "scaled": (lambda a: {"time": labelled(a, "time", scale_factor=0.5)}, "packed with scale_factor = 0.5"),
        "filled": (
            lambda a: {"time": labelled(a, "time", _FillValue=a["time"][5])},
            "time is masked at 1 of 400 values; give all",
        ),
    },
    "check_masked": {
        **{
            name: (lambda a, name=name: {name: masked(a, name)}, rf"^{name} is masked at 1 of \d+ values; give all")
            for name in ("time", "range_frequency", "antenna_position", "beam_azimuth")
        },
        "in dask": (lambda a: {"time": da.from_array(masked(a, "time"))}, "time is masked at 1 of 400"),
        "in a list": (lambda a: {"antenna_position": list(masked(a, "antenna_position"))}, "is masked at 1 of 1200"),
        "a number": (lambda a: {"carrier_frequency": np.ma.masked}, "carrier_frequency is masked"),
        "names": (lambda a: {"channel": np.ma.array(["HH"], mask=[True])}, "channel is masked at 1"),
        "a target": (lambda a: {"targets": [{"name": "A", "x": np.ma.masked, "y": 0.0}]}, "targets is masked"),
    },
    "check_units_stated": {
        "dB": (lambda a: {"signal": labelled(a, "signal", units="dB")}, "signal is in 'dB', but must be linear"),
        "unknown": (lambda a: {"time": labelled(a, "time", units="parsec")}, "time is in 'parsec', but must be in s"),
        "degrees of a map": (
            lambda a: {"antenna_position": labelled(a, "antenna_position", units="degrees_north")},
            "antenna_position is in 'degrees_north', but must be in m",
        ),
    },
    "check_dimensions": {
        "of others": (
            lambda a: {"antenna_position": labelled(a, "antenna_position", ("range_frequency", "axis"))},
            r"has dimensions \(range_frequency, axis\), but must have \(pulse, axis\)",
        ),
        "two unknown": (lambda a: {"signal": labelled(a, "signal", ("a", "b"))}, r"give signal\.values if"),
        "an axis of another": (lambda a: {"time": labelled(a, "time", ("fast_time",))}, r"must have \(pulse\)"),
    },
    "check_components": {
        "down": (
            lambda a: {"antenna_position": labelled(a, "antenna_position", coords={"axis": ["north", "east", "down"]})},
            "axis = north, east, down along its axis; give x = east, y = north and z = -down",
        ),
        "latitude": (
            lambda a: {"antenna_position": labelled(a, "antenna_position", coords={"axis": ["lat", "lon", "h"]})},
            "pyproj.Transformer.* with earth_centred=True",
        ),
        "twice": (
            lambda a: {"antenna_position": labelled(a, "antenna_position", coords={"axis": ["x", "x", "z"]})},
            "give x, y and z, with z up",
        ),
    },
    "check_labels": {
        "other times": (
            lambda a: {"signal": labelled(a, "signal", coords={"time": ("pulse", 2 * a["time"])})},
            "signal has the coordinate time = .*, but argument time is .*; make them agree",
        ),
        "other pulses": (
            lambda a: {"time": labelled(a, "time", coords={"pulse": STEPS}),
                       "signal": labelled(a, "signal", coords={"pulse": STEPS + 100})},
            "signal has the coordinate pulse = 100 .*, but coordinate pulse of time is 0 ",
        ),
        "other channels": (
            lambda a: {"channel": ["HH", "VV"], "signal": xr.DataArray(
                np.stack([a["signal"]] * 2), dims=("channel", *DIMS["signal"]), coords={"channel": ["HH", "HV"]})},
            "signal has the coordinate channel = .*'HV'.*, but argument channel",
        ),
    },
    "check_relations": {
        "another carrier": (
            lambda a: {"signal": labelled(a, "signal", coords={"carrier_frequency": 9.6e9})},
            r"coordinate carrier_frequency = 9.6e\+09, but argument carrier_frequency is 1e\+10",
        ),
    },
    "check_pairs": {
        "last": (lambda a: {"signal": pairs(a)}, r"give complex samples: signal\[\.\.\., 0\] \+ 1j \* "),
        "first": (lambda a: {"signal": np.moveaxis(pairs(a), -1, 0)}, r"signal\[0\] \+ 1j \* signal\[1\]"),
        "floats": (lambda a: {"signal": pairs(a).astype("f4")}, r"signal\[\.\.\., 0\] \+ 1j \* "),
        "fields": (
            lambda a: {"signal": pairs(a).view([("q", "i2"), ("i", "i2")])[..., 0]},
            r'signal\["i"\] \+ 1j \* signal\["q"\]',
        ),
        "interleaved": (lambda a: {"signal": pairs(a).reshape(400, 192)}, r"signal\[\.\.\., 0::2\] \+ 1j \* "),
        "rows": (lambda a: {"signal": np.moveaxis(pairs(a), -1, 1).reshape(800, 96)}, r"signal\[0::2\] \+ 1j"),
        "unsigned": (
            lambda a: {"signal": (pairs(a) // 100 + 128).astype("u1")},
            r"\(signal\[\.\.\., 0\] - level\) \+ 1j .* such as 128\.0 of 8 bits",
        ),
    },
    "check_type": {
        "real": (lambda a: {"signal": a["signal"].real}, "give the analytic signal"),
        "dates": (lambda a: {"time": np.datetime64("2026-01-01") + STEPS}, "give seconds as numbers"),
        "bool": (lambda a: {"reference_range": a["time"] > 0}, "reference_range is bool, but must be float64"),
        "complex": (lambda a: {"time": a["time"] + 0j}, "time is complex128, but must be float64"),
        "fields": (
            lambda a: {"antenna_position": a["antenna_position"].copy().view([(name, "f8") for name in XYZ])[:, 0]},
            r'np.stack\(\[antenna_position\["x"\], antenna_position\["y"\]',
        ),
    },
    "check_finite": {
        "a number": (lambda a: {"carrier_frequency": np.nan}, "carrier_frequency is nan; give a finite number"),
        "a height": (lambda a: {"ground_height": -np.inf}, "ground_height is -inf; give a finite number"),
        "a position": (lambda a: {"antenna_position": a["antenna_position"] + [0, 0, np.inf]}, "not finite at 400 of"),
        "a range": (lambda a: {"reference_range": np.where(STEPS == 3, np.nan, 1e4)}, "not finite at 1 of 400 pulses"),
        "all samples": (lambda a: {"signal": a["signal"] + np.inf}, "holds no finite sample"),
    },
}  # fmt: skip


def cases(table: dict[str, dict[str, Any]]) -> Any:
    return [pytest.param(each, id=f"{check}: {name}") for check, of in table.items() for name, each in of.items()]


def test_every_argument_and_every_check_is_in_the_table() -> None:
    assert set(inspect.signature(blocksar.collection).parameters) == set(incoming.ARGUMENTS)
    names = [check.__name__ for check in incoming.CHECKS]
    assert names == list(TAKEN) == list(REFUSED)


def test_the_page_has_the_table() -> None:
    said = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    assert [row for row in (f"| {what} | {then} |" for what, then in incoming.rows()) if row not in said] == []


@pytest.mark.parametrize("case", cases(TAKEN))
def test_what_is_taken_is_the_same_as_plain_arrays(case: Case) -> None:
    given = arrays()
    plain, other = blocksar.collection(**given), blocksar.collection(**{**given, **case(given)})
    for name, variable in plain.variables.items():
        np.testing.assert_allclose(other[name].values, variable.values, rtol=1e-6, atol=1e-9)
    for key, value in plain.attrs.items():
        assert other.attrs[key] == (pytest.approx(value) if isinstance(value, float) else value)


@pytest.mark.parametrize("case", cases(REFUSED))
def test_what_is_refused_is_named_in_one_sentence(case: tuple[Case, str]) -> None:
    change, sentence = case
    given = arrays()
    with pytest.raises(InputError, match=sentence) as caught:
        blocksar.collection(**{**given, **change(given)})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [name for name, of in REFUSED["check_pairs"].items() if name != "unsigned"])
def test_the_expression_joins_pairs(name: str) -> None:
    given = arrays()
    signal = REFUSED["check_pairs"][name][0](given)["signal"]
    with pytest.raises(InputError) as caught:
        blocksar.collection(**{**given, "signal": signal})
    expression = re.search(r"complex samples: ([^;]*)", str(caught.value))
    assert expression is not None
    joined = eval(expression[1], {"signal": signal})
    if name == "fields":  # whose first is q
        joined = 1j * np.conj(joined)
    np.testing.assert_allclose(joined, 1000 * given["signal"], atol=2)
    blocksar.collection(**{**given, "signal": joined})


@pytest.mark.parametrize("wrap", [np.ma.asarray, da.from_array, lambda m: xr.DataArray(da.from_array(m)), list])
def test_masked_samples_are_missing(wrap: Any) -> None:
    given = arrays()
    flagged = np.ma.masked_array(given["signal"], mask=np.zeros((400, 96), bool))
    flagged[100:200] = np.ma.masked
    flagged.data[100:200] = 50
    values = blocksar.collection(**{**given, "signal": wrap(flagged)})["signal"].values
    assert np.isnan(values[100:200]).all()
    assert np.isfinite(values[:100]).all()


def test_masked_samples_of_a_dataset_are_missing() -> None:
    dataset = blocksar.collection(**arrays())
    flagged = np.ma.masked_array(dataset["signal"].values, mask=np.zeros((400, 96), bool))
    flagged[7] = np.ma.masked
    dataset["signal"] = (DIMS["signal"], da.from_array(flagged, chunks=(100, 96)))
    history = stores.history_in_memory(dataset)
    assert np.isnan(history.read(slice(0, 9), slice(None))).any(axis=1).tolist() == [False] * 7 + [True, False]


LABELS = {
    "y, x, z": (["y", "x", "z"], [1, 0, 2]), "north, east, up": (["north", "east", "up"], [1, 0, 2]),
    "x, y, z": (XYZ, [0, 1, 2]), "down": (["north", "east", "down"], None), "places": (["lat", "lon", "height"], None),
}  # fmt: skip


@pytest.mark.parametrize("labels", LABELS)
@pytest.mark.parametrize("how", ["store", "dataset"])
def test_labels_of_components_are_obeyed(labels: str, how: str, tmp_path: Path) -> None:
    names, order = LABELS[labels]
    dataset = blocksar.collection(**arrays())
    right = dataset["antenna_position"].values
    put = right if order is None else right[:, np.argsort(order)]
    dataset["antenna_position"] = (DIMS["antenna_position"], put)
    dataset = dataset.assign_coords(axis=names)
    source: Any = dataset
    if how == "store":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # zarr's, about text
            dataset.to_zarr(tmp_path / "ph.zarr", zarr_format=3, consolidated=False)
        source = tmp_path / "ph.zarr"
    if order is None:
        with pytest.raises(InputError, match=r"antenna_position has axis = .* along its axis; give"):
            blocksar.plan(source, grid="-40:40:1,-20:20:1")
        return
    history = stores.open_phase_history(source) if how == "store" else stores.history_of(source)
    np.testing.assert_array_equal(history.collection.antenna_position, right)


def test_a_store_with_fill_values_is_refused(tmp_path: Path) -> None:
    dataset = blocksar.collection(**arrays())
    values = dataset["antenna_position"].values.copy()
    values[9] = -1.0
    dataset["antenna_position"] = dataset["antenna_position"].copy(data=values)
    dataset["antenna_position"].encoding["_FillValue"] = -1.0
    dataset.to_zarr(tmp_path / "ph.zarr", zarr_format=3, consolidated=False)
    with pytest.raises(InputError, match="antenna_position is missing at 3 of 1200 values, which are -1, its fill"):
        stores.open_phase_history(tmp_path / "ph.zarr")
