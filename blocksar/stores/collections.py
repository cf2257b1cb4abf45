"""Stores of several phase histories in one frame, such as the bursts of a data take: a group for each.

The group that holds them names them in its attribute `collections`, in the order of time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.place import Place
from blocksar.stores.channels import NAME
from blocksar.stores.creation import Group, create, history_line
from blocksar.stores.records import read_json
from blocksar.stores.schema import CONVENTIONS

ATTRIBUTE = "collections"


def create_collections(
    path: Location,
    groups: Mapping[str, Group],
    *,
    origin: str,
    overwrite: bool,
    fill: Callable[[Place], None],
    identity: str | None = None,
) -> None:
    """Create a store of several phase histories by name, whose samples `fill` writes below the place it receives.

    Raises
    ------
    InputError, ProcessingError
        As for `create`.
    """
    attrs = {
        ATTRIBUTE: list(groups), "Conventions": CONVENTIONS,
        "history": history_line(f"ingested by blocksar from {origin}"),
    }  # fmt: skip
    create(
        path, {}, sizes={}, coords={}, attrs=attrs, chunks={}, groups=groups, overwrite=overwrite, fill=fill,
        identity=identity,
    )  # fmt: skip


def collections_in(path: Location) -> list[Place]:
    """The phase histories of a store of several; none of any other, or where nothing lies.

    Raises
    ------
    InputError
        If it names them wrongly.
    """
    place = place_of(path)
    names = None
    with suppress(InputError, OSError):
        match read_json(place / "zarr.json"):
            case {"attributes": {"collections": names}}:
                pass
    if names is None:
        return []
    if (
        not isinstance(names, list)
        or not names
        or not all(isinstance(each, str) and NAME.fullmatch(each) for each in names)
    ):
        raise InputError(f"{place} has an attribute {ATTRIBUTE} that is no list of names; correct it")
    return [place / name for name in names]
