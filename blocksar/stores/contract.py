"""Variables, attributes and units of every store, and the checks of a phase history's."""

from __future__ import annotations

import base64
import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.arrays import FloatArray, check_axis
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.stores.chunk_files import ChunkFiles
from blocksar.stores.labels import axis_order
from blocksar.stores.regions import (
    dimension_names,
    file_name,
    file_shape,
    metadata_file,
    open_variable,
    read_array,
    refuse_odd_chunks,
)

if TYPE_CHECKING:
    import zarr

# ---------------------------------------------------------------- variables


@dataclass(frozen=True)
class Variable:
    """One variable of a store: its dimensions, numpy dtype, units and long name, and whether it is compressed.

    `flags` has the meanings of 0, 1, 2 ... where the numbers are flags; `attrs` what it states besides.
    Samples are noise, which does not compress; images are compressed for their pixels that are not covered.
    """

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str
    compressed: bool = False
    flags: tuple[str, ...] = ()
    attrs: Mapping[str, Any] = field(default_factory=dict)


TIME = Variable(("pulse",), "float64", "s", "slow time")
FAST_TIME = Variable(("fast_time",), "float64", "s", "fast time, two-way delay")
RANGE_FREQUENCY = Variable(("range_frequency",), "float64", "Hz", "baseband range frequency")
DOPPLER = Variable(("doppler",), "float64", "Hz", "Doppler frequency")
X = Variable(("x",), "float64", "m", "scene-frame x")
Y = Variable(("y",), "float64", "m", "scene-frame y")
TRACK_AND_BEAM = {
    "reference_range": Variable(("pulse",), "float64", "m", "range whose phase was removed"),
    "antenna_position": Variable(
        ("pulse", "axis"), "float64", "m", "antenna phase centre in the scene frame (x, y, z), z up"
    ),
    "beam_azimuth": Variable(("pulse",), "float64", "rad", "beam-centre yaw; NaN where the beam is not steered"),
}
# A beam about the antenna's own axis, in place of beam_azimuth; and optional variables of a collection.
AXIS_BEAM = {
    "beam_axis": Variable(
        ("pulse", "axis"), "float64", "1", "unit vector along the antenna's azimuth axis, scene frame"
    ),
    "beam_steering": Variable(
        ("pulse",), "float64", "rad", "angle of the beam's centre off the plane normal to beam_axis"
    ),
}
PATTERNS = {
    "beam_pattern": Variable(("beam_offset",), "float64", "1", "two-way amplitude over the beam, in the signal"),
    "beam_offset": Variable(("beam_offset",), "float64", "rad", "angle off the beam's centre"),
    "elevation_pattern": Variable(("elevation",), "float64", "1", "two-way amplitude over elevation, in the signal"),
    "elevation": Variable(("elevation",), "float64", "rad", "angle of the line of sight below the horizontal"),
}
# Of a bistatic collection, instead of antenna_position.
ANTENNAS = {
    "transmitter_position": Variable(
        ("pulse", "axis"), "float64", "m", "phase centre of the transmitter in the scene frame (x, y, z), z up"
    ),
    "receiver_position": Variable(
        ("pulse", "axis"), "float64", "m", "phase centre of the receiver in the scene frame (x, y, z), z up"
    ),
}
OPTIONAL = {**AXIS_BEAM, **PATTERNS, **ANTENNAS}
COLLECTION = {"time": TIME, "range_frequency": RANGE_FREQUENCY, **TRACK_AND_BEAM}
PHASE_HISTORY = {
    "signal": Variable(("pulse", "range_frequency"), "complex64", "1", "range-frequency signal; NaN where missing"),
    **COLLECTION,
}
RAW_ECHO = {
    "echo": Variable(("pulse", "fast_time"), "complex64", "1", "raw chirped echo; NaN where missing"),
    "time": TIME,
    "fast_time": FAST_TIME,
    **TRACK_AND_BEAM,
}
SCHEMA = {**PHASE_HISTORY, **RAW_ECHO, **OPTIONAL}  # of phase histories of all kinds
TRUTH = {"antenna_position": TRACK_AND_BEAM["antenna_position"], "time": TIME}
SPECTRUM = {
    "spectrum": Variable(("doppler", "range_frequency"), "complex64", "1", "recovered Doppler spectrum"),
    "lit": Variable(("pulse",), "float64", "1", "fraction of the pulse's samples that are valid"),
    "doppler": DOPPLER,
    "range_frequency": RANGE_FREQUENCY,
}
GATED = {name: SPECTRUM[name] for name in ("spectrum", "doppler", "range_frequency")}
PATCH = {
    "image": Variable(
        ("y", "x"), "complex64", "1", "focused block on the ground; NaN where not covered", compressed=True
    ),
    "x": X,
    "y": Y,
}
IMAGE = {
    "image": Variable(("y", "x"), "complex64", "1", "calibrated complex image; NaN where not covered", compressed=True),
    "block": Variable(
        ("y", "x"), "int16", "1", "angular block the pixel comes from; -1 where not covered", compressed=True
    ),
    "x": X,
    "y": Y,
}
# Of a level of an image's pyramid.
LEVEL = {
    "power": Variable(
        ("y", "x"), "float32", "1", "mean power over that of unit reflectivity; NaN where not covered", compressed=True
    ),
    "x": X,
    "y": Y,
}
# Of a level whose map projection is known: its attributes are a CF grid mapping.
SPATIAL_REF = Variable((), "int16", "1", "map projection whose easting and northing are x and y")
# Of images of collections whose noise is known.
NOISE = {
    "noise_equivalent": Variable(
        ("y", "x"), "float32", "1", "expected mean squared magnitude of the image's noise; NaN where not covered",
        compressed=True,
    ),
}  # fmt: skip
# Of images on a terrain.
ON_TERRAIN = {
    "height": Variable(("y", "x"), "float32", "m", "height of the ground, scene-frame z", compressed=True),
    "incidence_angle": Variable(
        ("y", "x"), "float32", "rad", "local incidence angle, between the ground's normal and the line of sight at the "
        "middle of the dwell; NaN where not covered", compressed=True,
    ),
    "visibility": Variable(
        ("y", "x"), "uint8", "1", "visibility of the ground; 255 where not covered", compressed=True,
        flags=("visible", "layover", "shadow"),
    ),
}  # fmt: skip
TERRAIN = {
    "height": Variable(("y", "x"), "float64", "m", "height of the ground, scene-frame z", compressed=True),
    "x": X,
    "y": Y,
}
# Of an image of several collections.
COLLECTION_NUMBER = {
    "collection": Variable(
        ("y", "x"), "int16", "1", "collection the pixel comes from; -1 where not covered", compressed=True
    )
}
CONVENTIONS = "CF-1.11"
CALIBRATION_FACTOR = "calibration_factor"  # attribute of a phase history and its images
# Attributes of a collection with their fields of `Collection`; those of a raw echo. What its delays count from is kept
# in no store that blocksar writes: they count from the centre there.
COLLECTION_ATTRS = {
    "carrier_frequency": "carrier",
    **{name: name for name in ("beam_width", "ground_height", "noise_power", "side_of_track")},
}
RAW_ATTRS = ("chirp_rate", "pulse_width", "pulse_reference")
PULSE_REFERENCES = ("centre", "start")  # the first is the default
UNITS = {  # spellings of units, and how many of the contract's they are
    "s": {"s": 1.0, "sec": 1.0, "second": 1.0, "min": 60.0, "minute": 60.0},
    "Hz": {"hz": 1.0, "hertz": 1.0, "s-1": 1.0, "1/s": 1.0},
    "m": {"m": 1.0, "metre": 1.0, "meter": 1.0, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048},
    "rad": {"rad": 1.0, "radian": 1.0, **dict.fromkeys(("deg", "degree", "\N{DEGREE SIGN}"), math.pi / 180)},
    "Hz/s": {"hz/s": 1.0, "hz s-1": 1.0, "hertz/second": 1.0, "hertz / second": 1.0, "mhz/us": 1e12, "ghz/s": 1e9},
    "1": dict.fromkeys(("1", "", "none", "unitless", "dimensionless", "-"), 1.0),
}
PREFIXES = {
    "": 1.0, "k": 1e3, "kilo": 1e3, "mega": 1e6, "g": 1e9, "giga": 1e9, "tera": 1e12, "c": 1e-2, "centi": 1e-2,
    "milli": 1e-3, "u": 1e-6, "micro": 1e-6, "\N{MICRO SIGN}": 1e-6, "\N{GREEK SMALL LETTER MU}": 1e-6,
    "n": 1e-9, "nano": 1e-9, "p": 1e-12, "pico": 1e-12,
}  # fmt: skip
M_MEANS = {"Hz": 1e6}  # of others milli
PHASES = re.compile(r"\b(db\w*|decibels?|deg\w*|rad|radians?)\b", re.I)  # in which no samples are


# ---------------------------------------------------------------- checks

SAMPLES = ("signal", "echo")  # which may have a leading dimension `channel`
MAX_AXIS = 1 << 22  # samples of an axis: metadata that states more is damaged, and could exhaust the memory
MAX_CHUNK, MAX_PADDED = 1 << 34, 1 << 26  # bytes of a chunk of samples, and of one that is larger than its axis
MAX_CHUNKS = 1 << 15  # chunks of a variable that is read as a whole: more take minutes, or do not exist


def stated(
    collection: Collection, schema: Mapping[str, Variable]
) -> tuple[dict[str, Variable], dict[str, FloatArray], dict[str, FloatArray]]:
    """Schema of what the collection states, with the angles of its patterns and its small variables as values."""
    absent = {name for name in OPTIONAL if getattr(collection, name) is None}
    if "beam_axis" not in absent:
        absent.add("beam_azimuth")
    if collection.bistatic:
        absent.add("antenna_position")
    present = {name: variable for name, variable in {**schema, **OPTIONAL}.items() if name not in absent}
    small = {name: getattr(collection, name) for name in {**TRACK_AND_BEAM, **OPTIONAL} if name in present}
    angles = {name: small.pop(name) for name in list(small) if PATTERNS.get(name) and PATTERNS[name].dims == (name,)}
    return present, angles, small


def number(attrs: Mapping[str, Any], name: str, unit: str, default: Any = ...) -> Any:
    """Return an attribute that is a number; without a default it must exist."""
    value = attrs.get(name)
    if value is None:
        if default is not ...:
            return default
        raise InputError(f"attribute {name} is missing; add it, in {unit}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"attribute {name} is {value!r}; it must be a number, in {unit}")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"attribute {name} is a whole number with hundreds of digits; correct it, in {unit}") from None


def calibration_of(attrs: Mapping[str, Any]) -> float | None:
    """Radar cross-section of a target that peaks at 1, m2, of a store's attributes; None if they do not say.

    Raises
    ------
    InputError
        If it is no positive number.
    """
    factor: float | None = number(attrs, CALIBRATION_FACTOR, "m2", None)
    if factor is not None and not 0 < factor < math.inf:
        raise InputError(
            f"attribute {CALIBRATION_FACTOR} is {factor!r}; it must be positive: the radar cross-section of a target "
            "that peaks at 1, m2"
        )
    return factor


def missing(name: str, variable: Variable) -> InputError:
    """Make the error about a missing variable."""
    return InputError(f"variable {name} ({', '.join(variable.dims)}) is missing; write it, in {variable.units}")


def check_type(name: str, variable: Variable, dims: tuple[Any, ...] | None, dtype: np.dtype[Any]) -> None:
    """Check that a variable has the dimensions and the type of the contract."""
    if dims == ("channel", *variable.dims) and name in SAMPLES:
        dims = variable.dims
    if dims != variable.dims:
        actual = "none" if dims is None else f"({', '.join(map(str, dims))})"
        remedy = "transpose it" if dims and sorted(map(str, dims)) == sorted(variable.dims) else "rename them"
        raise InputError(f"{name} has dimensions {actual}, but must have ({', '.join(variable.dims)}); {remedy}")
    if dtype.kind in "mM":
        raise InputError(
            f"{name} is {dtype}, but must be {variable.dtype} in {variable.units}; convert it, such as "
            f'({name} - {name}[0]) / np.timedelta64(1, "s")'
        )
    if dtype.kind not in ("c" if variable.dtype == "complex64" else "fiu"):
        raise InputError(f"{name} is {dtype}, but must be {variable.dtype}; write it as that")
    check_axis_precision(name, dtype)


def check_axis_precision(name: str, dtype: np.dtype[Any]) -> None:
    """Refuse an axis in half precision, whose steps would be taken as uneven."""
    if dtype == np.float16 and name in ("time", "range_frequency"):
        raise InputError(f"{name} is float16, which holds three digits, so that steps are uneven; give float64")


def unit_factor(text: str, unit: str) -> float | None:
    """Factor from a stated unit to the contract's, such as 1000 from "km" to m; None if it is no such unit."""
    text = " ".join(text.split()).lower()
    prefixes = {**PREFIXES, "m": M_MEANS.get(unit, 1e-3)}
    for spelling, factor in UNITS.get(unit, {}).items():
        for word in (spelling, f"{spelling}s") if spelling.isalpha() else (spelling,):
            if text == word:
                return factor
            if text.endswith(word) and spelling.isalpha() and (prefix := prefixes.get(text.removesuffix(word))):
                return prefix * factor
    return None


def check_units(name: str, unit: str, units: Any) -> None:
    """Check that the units stated by a variable are the contract's; for samples, that they are linear.

    Raises
    ------
    InputError
        If they are others; it says by what to multiply.
    """
    if units is None:
        return
    if name in SAMPLES or unit == "samples":
        if PHASES.search(str(units)):
            raise InputError(f"{name} is in {units!r}, but must be linear; give complex samples of amplitude")
        return
    factor = unit_factor(str(units), unit) if unit in UNITS else 1.0
    if factor != 1:
        remedy = "convert it" if factor is None else f"convert it: multiply it by {factor:.12g}"
        raise InputError(f"{name} is in {units!r}, but must be in {unit}; {remedy}")


def fill_value(attrs: Mapping[str, Any]) -> list[float]:
    """Values that stand for missing ones by the attributes `_FillValue` and `missing_value`, besides NaN."""
    found = []
    for name in ("_FillValue", "missing_value"):
        value = attrs.get(name)
        if isinstance(value, str):  # as xarray writes numbers in stores of format 3
            try:
                value = np.frombuffer(base64.b64decode(value, validate=True), "<f8")[0]
            except (ValueError, IndexError):
                continue
        for each in np.ravel(value) if value is not None else ():
            if isinstance(each, int | float | np.number) and not isinstance(each, bool) and not np.isnan(each):
                found.append(float(np.real(each)))
    return found


def checked(place: Place, name: str) -> ChunkFiles | zarr.Array[Any]:
    """Open a variable of the contract, and check all but its values."""
    variable = SCHEMA[name]
    if not metadata_file(place / name):
        raise missing(name, variable)
    array = open_variable(place, name)
    if isinstance(place, LocalPlace):
        refuse_odd_chunks(place / name, len(file_name(array, [0] * array.ndim).split("/")))
    check_type(name, variable, dimension_names(array), array.dtype)
    size = prod(array.shape)
    if max(array.shape) > MAX_AXIS or (name not in SAMPLES and size > 3 * MAX_AXIS):
        raise InputError(f"{name} claims the shape {array.shape}, beyond {MAX_AXIS} per axis; its metadata is damaged")
    chunks = file_shape(array)
    if not 0 < prod(chunks) * array.dtype.itemsize <= MAX_CHUNK:
        raise InputError(f"{name} claims chunks of {chunks}; its metadata is damaged, write it again")
    if name not in SAMPLES and prod(chunks) * array.dtype.itemsize > max(MAX_PADDED, 2 * size * array.dtype.itemsize):
        raise InputError(f"{name} has chunks of {chunks}, far larger than itself; write it again")
    count = prod(-(-n // chunk) for n, chunk in zip(array.shape, chunks, strict=True))
    if count > MAX_CHUNKS and name not in SAMPLES:
        raise InputError(f"{name} has {count} chunks, but is read as a whole; write it in at most {MAX_CHUNKS}")
    check_units(name, variable.units, array.attrs.get("units"))
    if name in SAMPLES and (fill := fill_value(array.attrs)):
        raise InputError(f"{name} has the fill value {fill[0]:g}; write missing samples as NaN, without the attribute")
    packed = [key for key, idle in (("scale_factor", 1), ("add_offset", 0)) if array.attrs.get(key, idle) != idle]
    if packed:
        raise InputError(
            f"{name} is packed with {packed[0]} = {array.attrs[packed[0]]!r}; write its values as they are"
        )
    return array


def read_real(place: Place, name: str) -> FloatArray:
    """Check and read a variable of real numbers."""
    array = checked(place, name)
    values = np.asarray(read_array(array, (slice(None),) * array.ndim, place, name, label=name), dtype=np.float64)
    refuse_filled(name, values, dict(array.attrs))
    return in_order(name, values, lambda: _component_labels(place)) if "axis" in SCHEMA[name].dims else values


def refuse_filled(name: str, values: FloatArray, attrs: Mapping[str, Any]) -> None:
    """Refuse metadata with values that their attributes declare missing."""
    for fill in fill_value(attrs):
        if count := int(np.count_nonzero(values == fill)):
            raise InputError(
                f"{name} is missing at {count} of {values.size} values, which are {fill:g}, its fill value; write all "
                "of them, and the samples of pulses in doubt as NaN"
            )


def in_order(name: str, values: FloatArray, labels: Callable[[], Any]) -> FloatArray:
    """Reorder components (n, 3) to x, y, z if labels state another order; None: no labels.

    Raises
    ------
    InputError
        If labels state something else.
    """
    stated = labels()
    return values if stated is None or values.ndim != 2 else values[:, axis_order(name, "axis", stated)]


def _component_labels(place: Place) -> Any:
    """Read the coordinate `axis` that other programs add to components; None without one."""
    if not metadata_file(place / "axis"):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's, about text of fixed length, which xarray writes
        array = open_variable(place, "axis")
        if dimension_names(array) != ("axis",) or array.shape != (3,):
            return None
        return read_array(array, (slice(None),), place, "axis", label="axis")


def raw_echo_from(fast_time: FloatArray, attrs: Mapping[str, Any]) -> RawEcho:
    """Make the raw echo that fast time (n_fast_time,), s, and attributes describe.

    Its own fast time is the delay of the pulse's centre, whichever delay the store's is.
    """
    check_axis(fast_time, "fast_time", "s")
    pulse_width = number(attrs, "pulse_width", "s")
    reference = attrs.get("pulse_reference", PULSE_REFERENCES[0])
    if reference not in PULSE_REFERENCES:
        raise InputError(f"pulse_reference is {reference!r}; it must be 'centre' or 'start', or absent")
    return RawEcho(
        fast_time=fast_time - pulse_width / 2 if reference == "start" else fast_time,
        chirp_rate=number(attrs, "chirp_rate", "Hz/s"),
        pulse_width=pulse_width,
        sampling_rate=float((fast_time.size - 1) / (fast_time[-1] - fast_time[0])),
    )
