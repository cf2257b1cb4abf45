"""Checks and conversions of the arguments of `blocksar.collection`, as one table.

`enter` is the one way in: every argument passes all `CHECKS`, each by its kind in `ARGUMENTS`. The first line of a
check's docstring is its row of the table in stores/README.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from blocksar.collection.empty_pulses import real_numbers
from blocksar.errors import InputError, quoted
from blocksar.stores.contract import SAMPLES, SCHEMA, check_axis_precision, check_units, fill_value, unit_factor
from blocksar.stores.labels import COORDINATES, axis_order, canonical_dims, check_relation, order_by

NUMBERS = {
    "carrier_frequency": "Hz", "beam_width": "rad", "noise_power": None, "ground_height": "m", "chirp_rate": "Hz/s",
    "pulse_width": "s", "time_zero": "s",
}  # fmt: skip
OTHERS = (
    "side_of_track", "title", "targets", "georeference", "earth_centred", "channel", "polarization",
    "collection_start", "source", "pulse_reference",
)  # fmt: skip
ARGUMENTS = {**dict.fromkeys(SCHEMA, "array"), **dict.fromkeys(NUMBERS, "number"), **dict.fromkeys(OTHERS, "other")}
COMPONENTS = ({"i", "q"}, {"re", "im"}, {"real", "imag"}, {"r", "i"}, {"x", "y"})  # names of the fields of a pair


@dataclass
class Given:
    """Argument of `blocksar.collection` while it is checked and converted.

    Attributes
    ----------
    name : str
    value : object
        As given; after `check_container` an array, of a "number" or an "array".
    dims : tuple of str or None
        Dimensions that the value itself states.
    labels : mapping
        Coordinates by name: (dimensions, values, units).
    attrs : mapping
        Attributes of the value, such as `units`.
    """

    name: str
    value: Any
    dims: tuple[str, ...] | None = None
    labels: dict[str, tuple[tuple[str, ...], Any, Any]] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        return ARGUMENTS[self.name]

    @property
    def is_samples(self) -> bool:
        return self.name in SAMPLES


Arguments = Mapping[str, Given]


def enter(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Check and convert arguments of `blocksar.collection` to plain arrays and numbers in SI units, in order.

    Raises
    ------
    InputError
        If one cannot be taken; see `CHECKS`.
    """
    given = {name: Given(name, value) for name, value in arguments.items() if value is not None}
    for check in CHECKS:
        for each in given.values():
            check(each, given)
    return {name: given[name].value if name in given else None for name in arguments}


def check_container(given: Given, _: Arguments) -> None:
    """arrays of numpy, dask, xarray, pandas, zarr, h5py, torch; lists | taken, read whole; others are refused"""
    if given.kind == "other":
        return
    value = given.value
    if hasattr(value, "data_vars"):
        raise InputError(f"{given.name} is a {_type(value)}; give one of its variables")
    if isinstance(value, str | bytes | Mapping) or callable(getattr(value, "__next__", None)):
        raise InputError(
            f"{given.name} is a {type(value).__name__} ({quoted(value)}); give an array of numbers"
            if given.kind == "array"
            else f"{given.name} is {quoted(value)}; give a number"
        )
    for inner in _layers(value):
        _note_labels(given, inner)
        value = inner
    given.value = _as_array(given, value)


def _layers(value: Any) -> Iterator[Any]:
    """Iterate over a value and the arrays it wraps: xarray around pint, around dask, around numpy."""
    while True:
        yield value
        if hasattr(value, "dims") and hasattr(value, "data") and not hasattr(value, "data_vars"):
            value = value.data
        elif hasattr(value, "magnitude") and hasattr(value, "units"):
            value = value.magnitude
        elif hasattr(value, "compute") and hasattr(value, "dask"):
            value = value.compute()
        else:
            return


def _note_labels(given: Given, value: Any) -> None:
    """Note the dimensions, coordinates and attributes that a value states."""
    attrs = getattr(value, "attrs", None)
    if attrs is not None and not callable(attrs):
        given.attrs = {**given.attrs, **{str(name): attrs[name] for name in attrs}}
    units = getattr(value, "units", getattr(value, "unit", None))  # of pint, astropy
    if units is not None and not callable(units):
        given.attrs = {**given.attrs, "units": units}
    if hasattr(value, "coords") and hasattr(value, "dims"):
        for name, each in value.coords.items():
            given.labels[str(name)] = tuple(map(str, each.dims)), each.values, each.attrs.get("units")
    if hasattr(value, "dims") and not callable(value.dims):
        given.dims = tuple(map(str, value.dims))
    wanted = SCHEMA[given.name].dims if given.name in SCHEMA else ()
    for number, where in enumerate(("index", "columns")):  # of pandas
        labels = getattr(value, where, None)
        if labels is None or callable(labels) or number >= len(wanted):
            continue
        if not np.array_equal(np.asarray(labels), np.arange(len(labels))):
            name = str(getattr(labels, "name", None) or wanted[number])
            given.labels[name] = (wanted[number],), np.asarray(labels), None
            given.dims = wanted if len(wanted) == np.ndim(value) else given.dims


def _as_array(given: Given, value: Any) -> Any:
    if isinstance(value, list | tuple) and any(isinstance(each, np.ma.MaskedArray) for each in value):
        value = np.ma.array(value)  # np.asarray drops the masks
    try:
        array = value if isinstance(value, np.ma.MaskedArray) else np.asarray(value)
    except ValueError as error:
        if isinstance(value, list | tuple):
            raise InputError(f"{given.name} is a list of rows of different lengths; give one array") from None
        raise _no_array(given, value, error) from error
    except Exception as error:
        raise _no_array(given, value, error) from error
    if array.dtype.kind == "O":
        rows = isinstance(value, list | tuple) or array.ndim
        what = f"holds objects, such as {quoted(array.ravel()[0])}" if rows and array.size else f"is a {_type(value)}"
        raise InputError(
            f"{given.name} {what}; give an array of numbers, such as .toarray() or .to_numpy(float) returns"
        )
    return array


def _no_array(given: Given, value: Any, error: Exception) -> InputError:
    cause = " ".join(str(error).split())[:100]
    return InputError(
        f"{given.name} is a {_type(value)}, of which numpy makes no array ({cause}); give one, such as .cpu().numpy() "
        "of a tensor or .to_numpy() of a table returns"
    )


def _type(value: Any) -> str:
    return f"{type(value).__module__.partition('.')[0]}.{type(value).__name__}".removeprefix("builtins.")


def check_packed(given: Given, _: Arguments) -> None:
    """attributes `_FillValue`, `missing_value` | such values are masked; `scale_factor`, `add_offset` are refused"""
    if given.kind == "other":
        return
    for key, idle in (("scale_factor", 1), ("add_offset", 0)):
        if given.attrs.get(key, idle) != idle:
            raise InputError(
                f"{given.name} is packed with {key} = {given.attrs[key]!r}; give its values, which are "
                "number * scale_factor + add_offset"
            )
    for fill in fill_value(given.attrs):
        given.value = np.ma.masked_where(np.asarray(given.value == fill), given.value)


def check_masked(given: Given, _: Arguments) -> None:
    """masked arrays, also in dask, xarray and lists | masked samples are missing (NaN); masked metadata are refused"""
    if given.kind == "other":
        count, size = (1, 1) if _holds_mask(given.value) else (0, 1)
    elif isinstance(given.value, np.ma.MaskedArray):
        mask = np.ma.getmaskarray(given.value)
        if given.is_samples and given.value.dtype.kind == "c":
            given.value = given.value.filled(np.nan)
            return
        count = int(np.count_nonzero(mask.view(bool) if mask.dtype.names else mask))
        size, given.value = mask.size, given.value.data if not given.is_samples else given.value
    else:
        return
    if count and not given.is_samples:
        raise InputError(
            f"{given.name} is masked at {count} of {size} values; give all of them, and mask samples of `signal` or "
            "`echo` where pulses are in doubt"
        )
    if given.is_samples:
        given.value = given.value.data  # of another kind than complex, which is refused


def _holds_mask(value: Any) -> bool:
    if isinstance(value, np.ma.MaskedArray):
        return bool(np.ma.getmaskarray(value).any())
    if isinstance(value, Mapping):
        return any(map(_holds_mask, value.values()))
    return isinstance(value, list | tuple) and any(map(_holds_mask, value))


def check_dimensions(given: Given, arguments: Arguments) -> None:
    """named dimensions | put in order; dimensions of another meaning are refused"""
    if given.kind != "array" or given.dims is None:
        return
    wanted = SCHEMA[given.name].dims
    if given.is_samples and "channel" in arguments:
        wanted = ("channel", *wanted)
    if np.ndim(given.value) != len(wanted):
        return  # refused later, with the shape
    dims = canonical_dims(given.name, given.dims, wanted)
    if dims is None:  # names that xarray gives by itself
        given.dims = wanted
        return
    renamed = dict(zip(given.dims, dims, strict=True))
    given.labels = {
        name: (tuple(renamed.get(dim, dim) for dim in over), values, units)
        for name, (over, values, units) in given.labels.items()
    }
    given.value, given.dims = np.transpose(given.value, [dims.index(dim) for dim in wanted]), wanted


def check_components(given: Given, _: Arguments) -> None:
    """labels along `axis`: x, y, z; east, north, up | put in order x, y, z; others, such as down, are refused"""
    if given.kind != "array" or given.dims is None or "axis" not in given.dims:
        return
    for name, (over, values, _units) in given.labels.items():
        if over == ("axis",):
            order = axis_order(given.name, name, values)
            given.value = given.value[..., order]


def check_units_stated(given: Given, _: Arguments) -> None:
    """attribute `units`, units of pint and astropy | converted to the contract's; those that cannot be are refused"""
    units = given.attrs.get("units")
    if given.kind == "other" or units is None:
        return
    text = units.decode("utf-8", "replace") if isinstance(units, bytes) else str(units)
    wanted = SCHEMA[given.name].units if given.kind == "array" else NUMBERS[given.name]
    if given.is_samples or wanted is None:
        check_units(given.name, "samples", text)
        return
    factor = unit_factor(text, wanted)
    if factor is None:
        check_units(given.name, wanted, text)
    elif factor != 1:
        given.value = np.asarray(given.value, np.float64) * factor


def check_labels(given: Given, arguments: Arguments) -> None:
    """coordinates of two arguments along one dimension | put in the order of the axis; other values are refused"""
    if given.kind != "array" or given.dims is None:
        return
    for name, (over, stated, units) in given.labels.items():
        if len(over) != 1 or over[0] not in given.dims or over == ("axis",):
            continue
        other = _reference(given, name, over[0], arguments)
        if other is None:
            continue
        label, reference = other
        factor = unit_factor(str(units), SCHEMA[name].units) if name in SCHEMA and units is not None else None
        values = stated if factor in (None, 1) else np.asarray(stated) * factor
        order = order_by(given.name, name, values, label, reference)
        if order is not None:
            given.value = np.take(given.value, order, axis=given.dims.index(over[0]))
            given.labels = {
                key: (dims, np.asarray(old)[order] if dims == over else old, unit)
                for key, (dims, old, unit) in given.labels.items()
            }


def _reference(given: Given, name: str, dim: str, arguments: Arguments) -> tuple[str, Any] | None:
    """Find the reference of a coordinate along a dimension: the argument of its name, or of the first that has it."""
    for each in (name, COORDINATES.get(name, name)):
        if each in arguments and each != given.name:
            over = SCHEMA[each].dims if each in SCHEMA else (each,)
            if over == (dim,):
                return f"argument {each}", arguments[each].value
    for other in arguments.values():
        if other is given:
            return None
        over, values, _ = other.labels.get(name, ((), None, None))
        if over == (dim,):
            return f"coordinate {name} of {other.name}", values
    return None


def check_relations(given: Given, arguments: Arguments) -> None:
    """coordinates that repeat another argument, such as `carrier_frequency` | refused where they disagree"""
    for name, (over, values, units) in given.labels.items():
        if name in arguments and name != given.name and len(over) != 1 and ARGUMENTS[name] != "other":
            wanted = SCHEMA[name].units if name in SCHEMA else NUMBERS[name]
            factor = 1.0 if units is None or wanted is None else unit_factor(str(units), wanted) or 1.0
            check_relation(given.name, name, np.asarray(values) * factor, arguments[name].value)


def check_pairs(given: Given, arguments: Arguments) -> None:
    """I and Q apart: fields, a last or first axis of two, interleaved | refused, with the expression that joins them"""
    if not given.is_samples:
        return
    array, name = given.value, given.name
    fields = array.dtype.names
    if fields is not None:
        if len(fields) != 2 or {each.lower() for each in fields} not in COMPONENTS:
            raise InputError(f"{name} has the fields {', '.join(fields)}; give complex samples")
        real, imaginary = _ordered(fields)
        raise _pairs(f"the fields {fields[0]} and {fields[1]}", given, f'{name}["{real}"]', f'{name}["{imaginary}"]',
                     float(min(array[each].min() for each in fields)) if array.size else 0.0)  # fmt: skip
    axes = SCHEMA[name].dims
    sizes = [np.size(arguments[axis].value) for axis in ("time", axes[-1]) if axis in arguments]
    if array.dtype.kind not in "fiu" or len(sizes) != 2 or not array.size:
        return
    least, shape = float(np.nanmin(array)), list(array.shape)
    lead = [np.size(arguments["channel"].value)] if "channel" in arguments else []
    whole = [*lead, *sizes]
    if shape == [*whole, 2]:
        raise _pairs("a last axis of two", given, f"{name}[..., 0]", f"{name}[..., 1]", least)
    if shape == [2, *whole] and not lead:
        raise _pairs("a first axis of two", given, f"{name}[0]", f"{name}[1]", least)
    if shape == [*whole[:-1], 2 * whole[-1]]:
        half = f"; where all I come before all Q, {name}[..., :{whole[-1]}] + 1j * {name}[..., {whole[-1]}:]"
        raise _pairs(f"twice the columns of {axes[-1]}", given, f"{name}[..., 0::2]", f"{name}[..., 1::2]", least, half)
    if shape == [2 * sizes[0], sizes[1]]:
        raise _pairs("twice the rows of time", given, f"{name}[0::2]", f"{name}[1::2]", least)


def _ordered(fields: Sequence[str]) -> tuple[str, str]:
    first = next((each for each in fields if each.lower() in ("re", "real", "r", "x")), None)
    if first is None:
        first = next(each for each in fields if each.lower() == "i")
    return first, next(each for each in fields if each != first)


def _pairs(what: str, given: Given, real: str, imaginary: str, least: float, more: str = "") -> InputError:
    """Make the error about separate real and imaginary parts; for unsigned counts it subtracts a level."""
    if least >= 0:
        real, imaginary = f"({real} - level)", f"({imaginary} - level)"
        more += "; level is the counts' middle, such as 128.0 of 8 bits"
    kind = "mixed" if given.value.dtype.names else str(given.value.dtype)
    return InputError(
        f"{given.name} is {kind} with {what}, as real and imaginary parts (I and Q) are recorded; give complex "
        f"samples: {real} + 1j * {imaginary}{more}"
    )


def check_type(given: Given, _: Arguments) -> None:
    """numbers of any precision | float64, complex64; real samples, float16 axes, dates, bool and text are refused"""
    if given.kind == "number":
        if np.ndim(given.value) == 0 and given.value.dtype.kind in "fiu":
            given.value = given.value.item()
        return
    if given.kind == "other":
        return
    name, array, dtype = given.name, given.value, SCHEMA[given.name].dtype
    kind = array.dtype.kind
    check_axis_precision(name, array.dtype)
    if kind in ("c" if given.is_samples else "fiu"):
        with np.errstate(over="ignore"):
            given.value = array.astype(dtype, copy=False)
        return
    if kind in "mM":
        seconds = f'({name} - {name}[0]) / np.timedelta64(1, "s")'
        raise InputError(f"{name} is {array.dtype}; give seconds as numbers, such as {seconds}")
    if given.is_samples and kind in "fiu":
        raise InputError(real_numbers(name, str(array.dtype), float(np.nanmin(array)) if array.size else 0.0))
    if array.dtype.names:
        columns = ", ".join(f'{name}["{each}"]' for each in array.dtype.names)
        raise InputError(f"{name} has the fields {', '.join(array.dtype.names)}; give np.stack([{columns}], axis=-1)")
    remedy = "give complex samples" if given.is_samples else "give real numbers"
    raise InputError(f"{name} is {array.dtype}, but must be {dtype}; {remedy}")


def check_finite(given: Given, _: Arguments) -> None:
    """NaN, infinities | samples are missing, also in gaps; `beam_azimuth`: NaN if not steered; refused elsewhere"""
    # Arrays are checked where it is known what each pulse needs (`Collection`).
    if given.kind != "number" or not isinstance(given.value, float) or np.isfinite(given.value):
        return
    if given.name != "beam_width" or not np.isnan(given.value):
        raise InputError(f"{given.name} is {given.value}; give a finite number")


CHECKS: tuple[Callable[[Given, Arguments], None], ...] = (
    check_container, check_packed, check_masked, check_units_stated, check_dimensions, check_components, check_labels,
    check_relations, check_pairs, check_type, check_finite,
)  # fmt: skip


def rows() -> list[tuple[str, str]]:
    """List accepted arguments and their treatment, from the checks, for the table in stores/README.md."""
    return [tuple(" ".join((check.__doc__ or "").split()).split(" | ")) for check in CHECKS]  # type: ignore[misc]
