"""Channels of a phase history or of an image, such as polarisations: a leading dimension, and names along it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from blocksar import texts
from blocksar.errors import InputError, printable
from blocksar.places.place import Place
from blocksar.stores.contract import Variable
from blocksar.stores.regions import dimension_names, metadata_file, open_variable, read_array

NAMED = {
    "channel": "channel, such as a polarisation",
    "look": "look: part of each target's dwell, the first in time first",
}
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]{0,31}")  # also the name of a folder
MOST = 64
REMEDY = "give each a short name of letters, digits, _, + and -, such as HH"
POLARIZATIONS = ("V", "H", "X", "Y", "S", "E", "RHC", "LHC")  # of transmitter or receiver


def with_channels(schema: Mapping[str, Variable], *names: str, dimension: str = "channel") -> dict[str, Variable]:
    """Add a leading dimension, of channels or looks, to some variables of a schema, with its coordinate."""
    more = {name: replace(schema[name], dims=(dimension, *schema[name].dims)) for name in names}
    return {**schema, **more, dimension: Variable((dimension,), "T", "1", NAMED[dimension])}


def check_channels(names: Sequence[str]) -> tuple[str, ...]:
    """Check names of channels.

    Raises
    ------
    InputError
        If there is none, or too many, or one is given twice or is no name.
    """
    if not 0 < len(names) <= MOST:
        raise InputError(f"channel has {texts.count(len(names), 'name')}; give 1 to {MOST}")
    for name in names:
        if not NAME.fullmatch(name):
            raise InputError(f"channel {printable(str(name))[:40]!r} is no name of a channel; {REMEDY}")
    if len({name.casefold() for name in names}) != len(names):
        raise InputError(f"channel has a name twice ({', '.join(names)}); {REMEDY}")
    return tuple(names)


def read_channels(place: Place, count: int) -> tuple[str, ...]:
    """Read the names of the channels of an open store.

    Raises
    ------
    InputError
        If there are not `count` of them along `channel`, or they are no names.
    """
    if not metadata_file(place / "channel"):
        raise unnamed_channels(count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's, about text of fixed length, which xarray writes
        array = open_variable(place, "channel")
        if dimension_names(array) != ("channel",) or array.shape != (count,):
            raise InputError(
                f"channel has shape {array.shape} over {dimension_names(array)}, but the samples have "
                f"{texts.count(count, 'channel')}; make them agree"
            )
        names = read_array(array, (slice(None),), place, "channel", label="channel")
        return check_channels([text(name) for name in names])


def unnamed_channels(count: int) -> InputError:
    """Make the error about samples whose channels have no names."""
    samples = f"the samples have {texts.count(count, 'channel')}"
    return InputError(f"variable channel (channel) is missing, and {samples}; {REMEDY}")


def text(value: Any) -> str:
    """Convert a name of any type to text."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def look_name(number: int) -> str:
    """Name of a look; 0 is the first in time."""
    return f"look-{number + 1}"


def number_of(channels: Sequence[str], channel: str | None, label: str) -> int:
    """Return the number of a channel by name; 0 if none is given.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if channel is None:
        return 0
    if not channels:
        raise InputError(f"channel is {channel!r}, but {label} has a single one without a name; leave it out")
    known = [name.casefold() for name in channels]
    if str(channel).casefold() not in known:
        raise InputError(
            f"channel {printable(str(channel))[:40]!r} is none of {label}, which has {', '.join(channels)}"
        )
    return known.index(str(channel).casefold())


def attrs_of_channel(attrs: Mapping[str, Any], channels: Sequence[str], number: int) -> dict[str, Any]:
    """Attributes of a store for one channel: its name as `channel`, and targets with their reflectivity in it.

    If `polarizations` has the channel, that is its `polarization`.

    The `channels` of a target have its reflectivity in each: 0 where it is not seen. One that lacks them is the
    same in all.
    """
    if not channels:
        return dict(attrs)
    name, targets = channels[number], attrs.get("targets")
    polarizations = attrs.get("polarizations")
    if isinstance(polarizations, Mapping) and isinstance(polarizations.get(name), Mapping):
        attrs = {**attrs, "polarization": polarizations[name]}
    attrs = {**attrs, "channel": name}
    if not isinstance(targets, list):
        return attrs
    seen = []
    for target in targets:
        given = target.get("channels") if isinstance(target, Mapping) else None
        seen.append({**target, "reflectivity": given.get(name, [0.0, 0.0])} if isinstance(given, Mapping) else target)
    return {**attrs, "targets": seen}


def without_unseen(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the targets that a channel does not see from its attributes."""
    targets = attrs.get("targets")
    if "channel" not in attrs or not isinstance(targets, list):
        return dict(attrs)
    seen = [t for t in targets if not (isinstance(t, Mapping) and t.get("channels") and not any(t["reflectivity"]))]
    return {**attrs, "targets": seen}
