"""The variables, attributes and units of every store, for writing and for checking."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Variable:
    """One variable of a store: its dimensions, numpy dtype, units and long name, and whether it is compressed.

    `flags` has the meanings of 0, 1, 2 ... where the numbers are flags.
    Samples are noise, which does not compress; images are compressed for their pixels that are not covered.
    """

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str
    compressed: bool = False
    flags: tuple[str, ...] = ()


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
# Of a beam about the antenna's own axis, instead of beam_azimuth; and what a collection may have besides.
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
OPTIONAL = {**AXIS_BEAM, **PATTERNS}
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
# Attributes of a collection with their fields of `Collection`; those of a raw echo. What its delays count from is kept
# in no store that blocksar writes: they count from the centre there.
COLLECTION_ATTRS = {
    "carrier_frequency": "carrier",
    **{name: name for name in ("beam_width", "ground_height", "noise_power", "side_of_track")},
}
RAW_ATTRS = ("chirp_rate", "pulse_width", "pulse_reference")
PULSE_REFERENCES = ("centre", "start")  # the first is the default
UNITS = {  # accepted spellings of the contract's units
    "s": ("s", "sec", "second", "seconds"),
    "Hz": ("hz", "hertz", "s-1", "1/s"),
    "m": ("m", "metre", "metres", "meter", "meters"),
    "rad": ("rad", "radian", "radians"),
}
