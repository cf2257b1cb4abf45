"""Creation of phase histories and collections."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from blocksar.chunks import TILE, stored_bytes
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import ATTRIBUTE as RECORDED
from blocksar.collection.raw_echo import RawEcho
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.place import REMEDY, Place, check_room
from blocksar.stores.channels import check_channels, with_channels
from blocksar.stores.contract import stated
from blocksar.stores.creation import create
from blocksar.stores.schema import COLLECTION, COLLECTION_ATTRS, CONVENTIONS, PHASE_HISTORY, RAW_ECHO


def create_phase_history(
    path: Location,
    collection: Collection,
    *,
    raw: RawEcho | None = None,
    channels: Sequence[str] = (),
    attrs: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    fill: Callable[[Place], None] | None = None,
) -> None:
    """Create a phase history without its samples: `fill` writes those by region, in chunks of `TILE`.

    Without `fill` they may be written later; until then all pulses of the store are missing.

    Parameters
    ----------
    path : path
    collection : Collection
    raw : RawEcho, optional
        For a raw echo, whose samples are `echo` over its fast_time.
    channels : sequence of str
        Names along a leading dimension of the samples; none by default.
    attrs : dict
        In addition to those of `collection` and `raw`: history, targets, scene, georeference ...
    overwrite, fill
        As for `create`.

    Raises
    ------
    InputError, ProcessingError
        As for `create`, and if the disk has no room for the samples that are filled in.
    """
    if fill is not None:
        refuse_full(path, collection, max(len(channels), 1), raw=raw)
    column, axis = ("range_frequency", collection.range_frequency) if raw is None else ("fast_time", raw.fast_time)
    schema, angles, variables = stated(collection, PHASE_HISTORY if raw is None else RAW_ECHO)
    named: dict[str, Any] = {}
    if channels:
        schema = with_channels(schema, "signal" if raw is None else "echo")
        named = {"channel": np.asarray(check_channels(channels), "T")}
    create(
        path,
        schema,
        sizes={},
        coords={"time": collection.time, column: axis, **angles, **named},
        variables=variables,
        attrs=_collection_attrs(collection, raw, attrs),
        chunks={"channel": 1, "pulse": TILE[0], column: TILE[1]},
        overwrite=overwrite,
        fill=fill,
    )


def refuse_full(
    path: Location, collection: Collection, n_channel: int, other: str = "", *, raw: RawEcho | None = None
) -> None:
    """Check that the disk has room for a phase history; `other` is what else would make it fit.

    Raises
    ------
    InputError
        If it has not, with both figures.
    """
    remedy = f"make room, choose another place, or {other}" if other else REMEDY
    check_room(place_of(path), history_bytes(collection, n_channel, raw), remedy)


def history_bytes(collection: Collection, n_channel: int, raw: RawEcho | None) -> int:
    """Bytes that the samples of a phase history take on a disk."""
    columns = collection.n_range_frequency if raw is None else raw.fast_time.size
    return n_channel * stored_bytes((collection.n_pulse, columns))


def write_collection(path: Location, collection: Collection, attrs: Mapping[str, Any] | None = None) -> None:
    """Write a collection: a phase history without samples. An existing store is replaced.

    Raises
    ------
    InputError
        As for `create`.
    """
    schema, angles, variables = stated(collection, COLLECTION)
    create(
        path,
        schema,
        sizes={},
        coords={"time": collection.time, "range_frequency": collection.range_frequency, **angles},
        variables=variables,
        attrs=_collection_attrs(collection, None, attrs),
        chunks={},
        overwrite=True,
    )


def _collection_attrs(collection: Collection, raw: RawEcho | None, attrs: Mapping[str, Any] | None) -> dict[str, Any]:
    own = {name: getattr(collection, field) for name, field in COLLECTION_ATTRS.items()}
    if raw is not None:
        own |= {name: getattr(raw, name) for name in ("chirp_rate", "pulse_width")}
    elif collection.recorded is not None:
        own[RECORDED] = collection.recorded.as_attribute()
    general = {
        "Conventions": CONVENTIONS,
        "title": collection.title,
        "history": history_line("created by blocksar"),
        **(attrs or {}),
    }
    if collection.title:
        general["title"] = collection.title
    return {**general, **{name: value for name, value in own.items() if value is not None}}


def history_line(action: str, earlier: Any = None) -> str:
    """Return the history attribute: the action with the time, above the earlier history."""
    line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {action}"
    return f"{line}\n{earlier}" if earlier else line
