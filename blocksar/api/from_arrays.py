"""collection, scene_centre, write: phase histories from arrays, and datasets to stores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from blocksar import stores
from blocksar.application.arguments import is_dataset
from blocksar.collection.frames import check_centre, check_earth_centred
from blocksar.collection.georeference import Georeference, find_scene_centre
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.targets import Target
from blocksar.places import Location, lies_at, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.readers.registry import stated_times

if TYPE_CHECKING:
    import xarray as xr


def collection(
    *,
    time: ArrayLike,
    reference_range: ArrayLike,
    carrier_frequency: float,
    antenna_position: ArrayLike | None = None,
    transmitter_position: ArrayLike | None = None,
    receiver_position: ArrayLike | None = None,
    signal: ArrayLike | None = None,
    range_frequency: ArrayLike | None = None,
    echo: ArrayLike | None = None,
    fast_time: ArrayLike | None = None,
    chirp_rate: float | None = None,
    pulse_width: float | None = None,
    pulse_reference: Literal["centre", "start"] | None = None,
    beam_azimuth: ArrayLike | None = None,
    beam_width: float | None = None,
    beam_axis: ArrayLike | None = None,
    beam_steering: ArrayLike | None = None,
    beam_offset: ArrayLike | None = None,
    beam_pattern: ArrayLike | None = None,
    elevation: ArrayLike | None = None,
    elevation_pattern: ArrayLike | None = None,
    noise_power: float | None = None,
    side_of_track: str | None = None,
    ground_height: float = 0.0,
    title: str = "",
    targets: Sequence[Target | Mapping[str, Any]] | None = None,
    georeference: Mapping[str, Any] | None = None,
    earth_centred: bool = False,
    channel: Sequence[str] | None = None,
    polarization: str | None = None,
    collection_start: str | datetime | None = None,
    time_zero: float = 0.0,
    source: str | None = None,
) -> xr.Dataset:
    """Build a phase history from arrays, and check it against the contract of its store.

    A target of reflectivity sigma at range R(pulse) contributes
    sigma exp(-4j pi (carrier_frequency + range_frequency) / c (R - reference_range)) to `signal` while it is lit. The
    scene frame is any local frame in m with z up.

    Parameters
    ----------
    time : (n_pulse,) float
        Slow time, s; ascending. t = 0 defines the polar frame. Where it is not uniform, exact back-projection serves.
    reference_range : (n_pulse,) float, or float
        Range whose phase was removed, m; a constant near the middle of the swath where none was.
    carrier_frequency : float
        Hz.
    antenna_position : (n_pulse, 3) float, optional
        Phase centre (x, y, z) in the scene frame, m. Needed unless the two following are given.
    transmitter_position, receiver_position : (n_pulse, 3) float, optional
        Phase centres of two antennas, m, instead of `antenna_position`: half the way from one to the target and on to
        the other is R then. Exact back-projection serves.
    signal : (n_pulse, n_range_frequency) complex, optional
        Samples over range frequency, 1; NaN where missing. Needed unless there is `echo`.
    range_frequency : (n_range_frequency,) float, optional
        Hz, relative to the carrier; ascending, uniform or, for exact back-projection, not. Needed with `signal`.
    echo : (n_pulse, n_fast_time) complex, optional
        Raw chirped samples, 1, instead of `signal`; NaN where missing, as in gaps of a pulse.
    fast_time : (n_fast_time,) float, optional
        Two-way delay, s; uniform, ascending. Needed with `echo`.
    chirp_rate : float, optional
        Hz/s; negative for a down-chirp. Needed with `echo`.
    pulse_width : float, optional
        s. Needed with `echo`.
    pulse_reference : {"centre", "start"}, optional
        What a target's delay 2 R / c in `fast_time` counts to: the centre of its pulse, or the start, as files of NISAR
        and CEOS have it. Only with `echo`. Default: "centre".
    beam_azimuth : (n_pulse,) float, optional
        Yaw of the beam's centre about the platform's nadir at t = 0, from the x axis to the y axis, rad. Default: the
        beam is not steered, and all of the scene is lit all the time.
    beam_width : float, optional
        Full width of the beam, rad. Needed with `beam_azimuth` or `beam_axis`.
    beam_axis : (n_pulse, 3) float, optional
        Unit vector, 1, along the antenna's azimuth axis, for a beam about it instead of `beam_azimuth`.
    beam_steering : (n_pulse,) float, optional
        Angle of the beam's centre off the plane normal to `beam_axis`, rad. Needed with `beam_axis`.
    beam_offset, beam_pattern : (n,) float, optional
        Two-way amplitude, 1, that is in the signal, over the angle off the beam's centre, rad, ascending.
    elevation, elevation_pattern : (n,) float, optional
        Two-way amplitude, 1, that is in the signal, over the angle of the line of sight below the horizontal, rad.
    noise_power : float, optional
        Mean squared magnitude of the noise of a sample, the unit of `signal` squared. Default: unknown.
    side_of_track : {"left", "right"}, optional
        Which side of its track an antenna with `beam_axis` lights, seen along the flight; ground on the other side is
        dark at that pulse. Default: both, and the default grid is where the scene frame's origin is, if the reference
        range follows it.
    ground_height : float
        Height of the imaged plane in the scene frame, m. Default: 0.
    title : str
        Shown above pictures. Default: none.
    targets : sequence of Target or of mappings, optional
        Known point targets, which `quality` measures: {"name", "x", "y"} with x and y in m in the scene frame,
        "reflectivity" if it is not 1, and "z" in m if they are not on the ground. Default: none are known.
    georeference : mapping, optional
        Place of the scene frame on the Earth: {"kind": "ENU", "latitude", "longitude", "height"}, in degrees, and in m
        above WGS 84. Default: unknown.
    earth_centred : bool
        Positions and `beam_axis` are Earth-centred, Earth-fixed (WGS 84), and are carried into the frame of
        `georeference`. Default: False.
    channel : (n_channel,) str, optional
        Names of channels, such as polarisations, where `signal` or `echo` is (n_channel, n_pulse, ...). Default: one
        without a name.
    polarization : str, optional
        Of transmitter and receiver, such as "HV" or "RHC:H". Default: unknown, or what the names of channels say.
    collection_start : str or datetime, optional
        UTC, a text in ISO 8601 or a datetime; without a zone it is taken for UTC. Default: unknown.
    time_zero : float
        Seconds from `collection_start` to t = 0. Default: 0.
    source : str, optional
        Where the data come from, such as the sensor and the name of its file. Default: unknown.

    Returns
    -------
    xarray.Dataset
        The phase history, for `plan`, `focus`, `check` and `write`. It shares memory with arrays of the right type.

    Raises
    ------
    InputError
        If an array has the wrong shape, kind or unit, something needed is missing, or no sample is finite.
    """
    given = stores.enter(dict(locals()))
    _check_samples(given)
    if given["pulse_reference"] is not None and given["echo"] is None:
        raise InputError(f"pulse_reference is {pulse_reference!r}, but signal has no pulses; leave it out")
    if given["time"] is None:
        raise InputError("time is None; give the times of the pulses, s")
    _check_reference(given)
    if earth_centred:
        given |= _into_frame(given)
    if np.ndim(given["reference_range"]) == 0:
        given["reference_range"] = np.broadcast_to(given["reference_range"], np.shape(given["time"])[:1])
    variables = {name: given[name] for name in (*stores.SCHEMA, "channel")}
    unchanged = (*stores.NUMBERS, "side_of_track", "pulse_reference", "title")
    attrs: dict[str, Any] = {name: given[name] for name in unchanged if name != "time_zero"}
    attrs["Conventions"] = stores.CONVENTIONS
    if targets is not None:
        if not np.iterable(targets):
            raise InputError(f"targets is {targets!r}; give a list of targets")
        attrs["targets"] = [_target_record(target) for target in targets]
    if georeference is not None:
        attrs["georeference"] = Georeference.from_attribute(georeference).as_attribute()
    attrs["polarization"] = _polarization(polarization, channel)
    origin = {"format": source} if source is not None else {}
    if collection_start is not None:
        origin |= stated_times(str(collection_start), given["time_zero"])
    attrs["source"] = origin or None
    from blocksar.products import dataset  # registers the accessor, and loads xarray

    return dataset.prepare(stores.dataset_of(variables, attrs))


def _into_frame(given: Mapping[str, Any]) -> dict[str, Any]:
    """Transform Earth-centred antenna positions (n, 3), m, and beam axes (n, 3) into the frame of the georeference."""
    if given["georeference"] is None:
        raise InputError(
            "earth_centred = True, but no georeference is given, which says where the scene frame lies; give one"
        )
    frame = Georeference.from_attribute(given["georeference"])
    axis, moved = given["beam_axis"], {}
    for name in ("antenna_position", *stores.ANTENNAS):
        places = given[name]
        if places is None and (name in stores.ANTENNAS or any(given[each] is not None for each in stores.ANTENNAS)):
            continue
        if np.ndim(places) != 2 or places.shape[1] != 3:
            raise InputError(f"{name} has the shape {np.shape(places)}; give (n_pulse, 3): x, y and z, m")
        check_earth_centred(
            carrier=given["carrier_frequency"], time=given["time"], position=places,
            reference=given["reference_range"], frame=frame,
        )  # fmt: skip
        moved[name] = frame.from_ecef(places)
    return {**moved, "beam_axis": None if axis is None else np.asarray(axis, np.float64) @ frame.axes.T}


def scene_centre(
    antenna_position: ArrayLike,
    slant_range: float,
    *,
    side_of_track: str,
    height: float = 0.0,
    squint: float = 0.0,
    pulse: int | None = None,
) -> dict[str, Any]:
    """Find the place on the Earth at a range to one side of a track, and the scene frame about it.

    Parameters
    ----------
    antenna_position : (n_pulse, 3) float
        Earth-centred, Earth-fixed (WGS 84), m; n_pulse at least 3.
    slant_range : float
        Range from the antenna to the place, such as that of the middle of the swath, m.
    side_of_track : {"left", "right"}
        Where the place lies, seen along the flight.
    height : float
        Height of the place above WGS 84, m. Default: 0.
    squint : float
        Angle of the line of sight ahead of the plane normal to the track, rad. Default: 0, where Doppler is zero.
    pulse : int, optional
        Pulse from which the place is seen so. Default: the middle one.

    Returns
    -------
    dict
        The `georeference` of a scene frame with its origin there, x east and y north: "latitude", "longitude",
        "height", "ecef" and more. `collection` takes it, and with `earth_centred=True` the same track.

    Raises
    ------
    InputError
        If no ground lies there, or the track has another shape.
    """
    track = np.asarray(stores.enter({"antenna_position": antenna_position})["antenna_position"], np.float64)
    if track.ndim != 2 or track.shape[0] < 3 or track.shape[1] != 3:
        raise InputError(f"antenna_position has the shape {track.shape}; give (n_pulse, 3) of at least three pulses")
    check_centre(track)
    if side_of_track not in ("left", "right"):
        raise InputError(f"side_of_track is {side_of_track!r}; it must be 'left' or 'right'")
    at = min(max(track.shape[0] // 2 if pulse is None else pulse, 1), track.shape[0] - 2)
    place = track[at if pulse is None else pulse]
    frame = find_scene_centre(
        place, track[at + 1] - track[at - 1], slant_range=slant_range, side=side_of_track, height=height, squint=squint
    )
    return frame.as_attribute()


def _polarization(text: str | None, channel: Any) -> dict[str, str] | None:
    """The attribute `polarization`; None where it is not given."""
    if text is None:
        return None
    if channel is not None:
        raise InputError(f"polarization is {text!r}, but channels are given; name each by its own, such as HH and HV")
    parts = tuple(str(text).upper().split(":")) if ":" in str(text) else tuple(str(text).upper())
    if len(parts) != 2 or not set(parts) <= set(stores.POLARIZATIONS):
        raise InputError(
            f"polarization is {text!r}; give those of transmitter and receiver, such as 'HV' or 'RHC:H', of "
            f"{', '.join(stores.POLARIZATIONS)}"
        )
    return {"transmit": parts[0], "receive": parts[1]}


def _check_samples(given: Mapping[str, Any]) -> None:
    """Check that the samples come with their axis."""
    signal, echo, range_frequency, fast_time = (
        given[name] for name in ("signal", "echo", "range_frequency", "fast_time")
    )
    if (signal is None) == (echo is None):
        raise InputError(
            f"{'neither signal nor echo is' if signal is None else 'signal and echo are both'} given; give signal over "
            "range frequency, or a raw echo over fast time"
        )
    pairs = (("signal", signal, "range_frequency", range_frequency, "fast_time", fast_time),
             ("echo", echo, "fast_time", fast_time, "range_frequency", range_frequency))  # fmt: skip
    for name, samples, axis, values, other, unfit in pairs:
        if samples is not None and values is None:
            raise InputError(f"{name} is given without {axis}; give its axis as well")
        if samples is not None and unfit is not None:
            raise InputError(f"{other} is given, but {name} lies over {axis}; leave {other} out")


def _check_reference(given: Mapping[str, Any]) -> None:
    """Check the reference range: zero is plausible only if half the range window reaches the ground."""
    range_frequency = given["range_frequency"]
    try:
        least = float(np.nanmin(given["reference_range"]))
        places = [given[name] for name in ("antenna_position", *stores.ANTENNAS) if given[name] is not None]
        height = min(float(np.nanmin(place[..., 2])) for place in places) - given["ground_height"]
        step = 0.0 if range_frequency is None else abs(float(np.diff(range_frequency[:2])[0]))
    except (TypeError, ValueError, IndexError):
        return  # refused later, with the shape
    if least > 0 or (least == 0 and step and SPEED_OF_LIGHT / (4 * step) > height):
        return
    raise InputError(
        f"reference_range is {least:g} m; give R0, the range of the middle of the swath, and multiply samples "
        "whose phase nobody has removed by exp(4j pi (carrier_frequency + range_frequency) R0 / c)"
    )


def _target_record(target: Target | Mapping[str, Any]) -> dict[str, Any]:
    known = target if isinstance(target, Target) else Target.from_record(target)
    channels = {} if isinstance(target, Target) or "channels" not in target else {"channels": target["channels"]}
    return {**known.as_record(), **channels}


def write(source: xr.Dataset, out: Location, *, overwrite: bool = False) -> Path | Place:
    """Write a phase history as a store, by groups of pulses.

    Parameters
    ----------
    source : xarray.Dataset
        A dataset of the contract, such as `collection` builds, or one derived from a phase history with xarray.
    out : path
        Store to write: a folder, or a prefix in an object store.
    overwrite : bool
        Replace what stands at `out`. Default: False.

    Returns
    -------
    path
        Where the store lies.

    Raises
    ------
    InputError
        If the dataset departs from the contract, it was opened from `out`, or `out` exists and `overwrite` is False.
    """
    if not is_dataset(source):
        raise InputError(f"source is a {type(source).__name__}; give a dataset, which blocksar.collection builds")
    history, target = stores.history_in_memory(source), place(out)
    opened = source.encoding.get("source")
    if opened is not None and lies_at(place(opened)) == lies_at(target):
        raise InputError(f"{target} is what the dataset was opened from; write it to another place")
    history.write(target, overwrite=overwrite)
    return target.path if isinstance(target, LocalPlace) else target
