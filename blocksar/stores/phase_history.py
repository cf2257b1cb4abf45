"""Phase histories, one or several in one frame: creation, and opening with all checks of the contract.

A simulated phase history whose own track has an error has the track as flown beside it. A group that holds several
names them in its attribute `collections`, in the order of time.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import xxhash

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection import sublooks
from blocksar.collection.collection import Collection
from blocksar.collection.frames import check_scene_frame
from blocksar.collection.georeference import Georeference
from blocksar.collection.raw_echo import ATTRIBUTE as RECORDED
from blocksar.collection.raw_echo import RawEcho, RecordedRanges
from blocksar.errors import InputError, MissingInput, changes_while_read
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace, os_errors
from blocksar.places.place import Place
from blocksar.stores.channels import NAME, attrs_of_channel, look_name, number_of, read_channels
from blocksar.stores.chunk_files import METADATA, group_attrs, refuse_odd_file
from blocksar.stores.contract import (
    ANTENNAS,
    COLLECTION_ATTRS,
    CONVENTIONS,
    OPTIONAL,
    PHASE_HISTORY,
    RAW_ATTRS,
    RAW_ECHO,
    TRUTH,
    calibration_of,
    checked,
    number,
    raw_echo_from,
    read_real,
)
from blocksar.stores.creation import UNFINISHED, Group, create, history_line
from blocksar.stores.records import cause_of, json_checksum, read_json, unreachable
from blocksar.stores.regions import chunk_names, metadata_file, open_variable, read_array, refuse_codecs

if TYPE_CHECKING:
    import xarray as xr
    import zarr


@dataclass(frozen=True, kw_only=True, eq=False)
class PhaseHistory:
    """An open phase history: its collection, and its samples on demand. It keeps no file open, and its pickle is small.

    Attributes
    ----------
    path : Place
        The store; `str` gives it as the user named it.
    collection : Collection
        For a raw echo, its range_frequency is `raw.range_frequency`: the axis that range compression leads to.
    raw : RawEcho or None
        None if the samples are `signal`, over range frequency; otherwise they are `echo`, over fast time.
    attrs : dict
        Other attributes of the store: title, history, targets, scene, georeference ...
    versions : mapping of str to str or None
        Version of each chunk of samples, by name relative to their variable, if they are `pinned`; see `Place.version`.
    cut : (first, total) or None
        In a `segment`: the pulse of the store that is its first one, and the store's number of pulses.
    channels : tuple of str
        Names along the samples' leading dimension `channel`; empty if they have none.
    channel : int
        Number of the channel that is read.
    look : (number, count, sign) or None
        Of a part of each dwell, see `of_look`.
    ground_height : float or None
        That of the imaged plane instead of the store's, m, see `on_ground`.
    """

    path: Place
    collection: Collection
    raw: RawEcho | None = None
    attrs: dict[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] | None = None
    cut: tuple[int, int] | None = None
    channels: tuple[str, ...] = ()
    channel: int = 0
    look: tuple[int, int, float] | None = None
    ground_height: float | None = None

    @property
    def label(self) -> str:
        """Name in messages."""
        return str(self.path)

    @property
    def variable(self) -> str:
        """Name of the samples: `signal` or `echo`."""
        return "signal" if self.raw is None else "echo"

    @property
    def shape(self) -> tuple[int, int]:
        """Pulses, and columns: range frequencies, or fast-time samples of a raw echo."""
        columns = self.collection.range_frequency if self.raw is None else self.raw.fast_time
        return self.collection.n_pulse, int(columns.size)

    @property
    def chunks(self) -> tuple[int, int]:
        """Pulses and columns of one chunk."""
        *_, pulse, column = open_variable(self.path, self.variable).chunks
        return int(pulse), int(column)

    def of_channel(self, name: str | None) -> PhaseHistory:
        """Copy with the samples of another channel; the first for None.

        Raises
        ------
        InputError
            If there is none of that name.
        """
        number = number_of(self.channels, name, str(self.path))
        return replace(self, channel=number, versions=None, attrs=attrs_of_channel(self.attrs, self.channels, number))

    def of_look(self, number: int, count: int, sign: float) -> PhaseHistory:
        """Copy with a collection that sees one of `count` parts of each dwell, see `collection.sublooks`."""
        collection = sublooks.look_of(self.collection, number, count, sign)
        first, n_pulse = sublooks.pulses_of(self.collection, number, count).start, self.collection.n_pulse
        attrs = _counted_from(self.attrs, float(self.collection.time[first] - collection.time[0]))
        return replace(
            self, collection=collection, cut=self.cut if self.collection.steered else (first, n_pulse),
            look=(number, count, sign), attrs={**attrs, "look": look_name(number)},
        )  # fmt: skip

    def with_partial_pulses(self) -> PhaseHistory:
        """Copy that includes ground with partly recorded pulses of a raw echo: its transform is longer."""
        if self.raw is None:
            return self
        frequency, recorded = self.raw.padded_range_frequency, self.raw.recorded(partial=True)
        return replace(self, collection=replace(self.collection, range_frequency=frequency, recorded=recorded))

    def on_ground(self, height: float | None) -> Self:
        """Copy over another plane, z = height, m; unchanged for None."""
        other = self.collection if height is None else replace(self.collection, ground_height=height)
        return self if height is None else replace(self, collection=other, ground_height=height)

    @property
    def part_of_a_beam(self) -> bool:
        """Whether this is a look of a steered beam, whose samples hold what the whole beam saw."""
        return self.look is not None and self.collection.steered

    def opened_again(self) -> PhaseHistory:
        """Open the store again, for the same channel and look.

        Raises
        ------
        InputError
            As `open_phase_history`.
        """
        history = open_phase_history(self.path).on_ground(self.ground_height)
        history = history.of_channel(self.channels[self.channel] if self.channels else None)
        return history if self.look is None else history.of_look(*self.look)

    def _region(self, pulses: slice, columns: slice) -> tuple[slice, ...]:
        """Region of the variable that holds pulses and columns of the channel."""
        lead = (slice(self.channel, self.channel + 1),) if self.channels else ()
        return (*lead, self._in_store(pulses), columns)

    def same(self, other: PhaseHistory) -> bool:
        """Tell whether two phase histories agree in everything that is read when they are opened."""
        mine, yours = self.collection.as_dict(), other.collection.as_dict()
        return (
            (self.raw is None) == (other.raw is None)
            and json_checksum(self.attrs) == json_checksum(other.attrs)
            and all(np.array_equal(mine[name], yours[name], equal_nan=name == "beam_azimuth") for name in mine)
        )

    def pinned(self) -> PhaseHistory:
        """Copy bound to the current versions of its chunks: it refuses to read changed ones.

        Raises
        ------
        InputError
            If they cannot be listed.
        """
        with _reading(self.path):
            versions = {
                name.partition("/")[2]: version for name, version, _ in replace(self, versions=None)._files() if version
            }
        return replace(self, versions=versions)

    def segment(self, first: int, last: int) -> PhaseHistory:
        """The pulses first <= p < last as a phase history of their own, which counts time from its middle pulse."""
        collection = self.collection.segment(first, last)
        attrs = _counted_from(self.attrs, float(self.collection.time[first] - collection.time[0]))
        return replace(self, collection=collection, cut=(first, self.collection.n_pulse), attrs=attrs)

    def _in_store(self, pulses: slice) -> slice:
        """Convert pulses of the segment to pulses of the store."""
        if self.cut is None:
            return pulses
        start, stop, _ = pulses.indices(self.collection.n_pulse)
        return slice(self.cut[0] + start, self.cut[0] + stop)

    def within(self, pulses: slice = slice(None), columns: slice = slice(None)) -> PhaseHistory:
        """Copy that knows only the versions of chunks with these samples: its pickle is small."""
        if self.versions is None:
            return self
        array = open_variable(self.path, self.variable)
        names = chunk_names(array, self._region(pulses, columns))
        return replace(self, versions={name: self.versions.get(name, "") for name in names})

    def read(self, pulses: slice, columns: slice) -> ComplexArray:
        """Read the samples of some pulses and columns.

        Returns
        -------
        (n_pulse, n_column) complex64
            NaN rows where pulses are missing.

        Raises
        ------
        InputError
            If a chunk is damaged (the message names it), or the store has changed since it was opened or pinned.
        """
        array = open_variable(self.path, self.variable)
        lead = (len(self.channels),) if self.channels else ()
        shape = (*lead, self.shape[0] if self.cut is None else self.cut[1], self.shape[1])
        if array.shape != shape:
            raise InputError(
                f"{self.variable} in {self.path} now has shape {array.shape}, not {shape}; it changed since it "
                "was opened: start again"
            )
        seen = None if self.versions is None else self._refuse_change
        samples = read_array(array, self._region(pulses, columns), self.path, self.variable, seen=seen)
        with np.errstate(over="ignore"):
            return samples.reshape(samples.shape[-2:]).astype(np.complex64, copy=False)

    def _refuse_change(self, name: str, version: str) -> None:
        assert self.versions is not None
        if version != self.versions.get(name, ""):
            what = "was gone" if not version else "appeared" if not self.versions.get(name) else "was written"
            raise changes_while_read(self.path, f": {self.variable}/{name} {what} after the start")

    def fingerprint(self) -> str:
        """Return a hash that identifies the input without reading its samples.

        It covers all bytes of metadata, axes, track and beam; of the samples it covers the chunks' names, sizes and
        times of modification, or their versions in an object store: those that are pinned, if any are.

        Raises
        ------
        InputError
            If a file cannot be read.
        """
        ways = [repr(way) for way in (self.look, self.ground_height) if way is not None]
        digest = xxhash.xxh3_128("".join(ways).encode())
        try:
            for name, chunk, file in self._files():
                digest.update(os.fsencode(f"{name}\n"))
                if not chunk and isinstance(file, LocalPlace):
                    refuse_odd_file(file.path, sys.maxsize)
                digest.update(f"{chunk}\n".encode() if chunk else file.read_bytes())
        except OSError as error:
            raise unreachable(self.path, error) from error
        return digest.hexdigest()

    def _files(self) -> Iterator[tuple[str, str, Place]]:
        """Iterate over all files: name, size and version if it is a chunk of samples (else empty), and place."""
        present = self.path.names()
        yield from ((name, "", self.path / name) for name in METADATA if name in present)
        for variable in sorted({**(PHASE_HISTORY if self.raw is None else RAW_ECHO), **OPTIONAL}):
            files = sorted((self.path / variable).files(), key=lambda file: file[0].split("/"))
            mine = self._mine() if variable == self.variable and self.channels else None
            for name, size, version in files:
                chunk = variable == self.variable and name not in METADATA
                if chunk and mine is not None and name not in mine:
                    continue
                known = (self.versions or {}).get(name, f"{size} {version}")
                yield f"{variable}/{name}", known if chunk else "", self.path / variable / name

    def _mine(self) -> set[str]:
        """Names of the chunks that hold the channel."""
        array = open_variable(self.path, self.variable)
        return set(chunk_names(array, self._region(slice(None), slice(None))))


def open_phase_history(path: Location) -> PhaseHistory:
    """Open a phase history of any origin, and check everything except its samples against the contract.

    Raises
    ------
    InputError
        If there is no such store, it is damaged, or it departs from the contract; the message says where.
    """
    with _reading(path) as place:
        attrs = _attrs(place)
        names = [name for name in ("signal", "echo") if metadata_file(place / name)]
        if len(names) != 1:
            raise not_one_of_two(names, (name for name in place.names() if metadata_file(place / name)))
        samples = checked(place, names[0])
        channels = read_channels(place, samples.shape[0]) if samples.ndim == 3 else ()
        for name, n in zip(
            ("time", "range_frequency" if names == ["signal"] else "fast_time"), samples.shape[-2:], strict=True
        ):
            if (shape := checked(place, name).shape) != (n,):
                raise InputError(f"{names[0]} has shape {samples.shape}, but {name} has {shape}; make them agree")
        raw = raw_echo_from(read_real(place, "fast_time"), attrs) if names == ["echo"] else None
        collection = _read_collection(place, attrs, raw)
        others = attrs_of_channel(other_attrs(attrs, raw), channels, 0)
        return PhaseHistory(path=place, collection=collection, raw=raw, attrs=others, channels=channels)


def not_one_of_two(names: Sequence[str], variables: Iterable[str]) -> InputError:
    """Make the error about a store with both or neither of signal and echo."""
    return InputError(
        f"it holds {'both' if names else 'neither'} signal {'and' if names else 'nor'} echo (it holds "
        f"{', '.join(variables) or 'nothing'}); a phase history has one of the two"
    )


def other_attrs(attrs: Mapping[str, Any], raw: RawEcho | None) -> dict[str, Any]:
    """Attributes of a store that belong neither to its collection nor to its raw echo."""
    own = (*COLLECTION_ATTRS, *(RAW_ATTRS if raw is not None else (RECORDED,)))
    return {name: value for name, value in attrs.items() if name not in own}


def _counted_from(attrs: dict[str, Any], later: float) -> dict[str, Any]:
    """Shift `time_zero` of the attribute `source` for pulses whose slow time starts `later`, s."""
    match attrs.get("source"):
        case {"time_zero": int() | float() as zero, **others}:
            return {**attrs, "source": {**others, "time_zero": zero + later}}
    return attrs


def read_collection(path: Location) -> tuple[Collection, dict[str, Any]]:
    """Read a store of `write_collection`: the collection, and the other attributes.

    Raises
    ------
    InputError
        As for `open_phase_history`.
    """
    with _reading(path) as place:
        attrs = _attrs(place)
        collection = _read_collection(place, attrs, None)
        return collection, other_attrs(attrs, None)


def open_dataset(path: Location) -> xr.Dataset:
    """Open any store lazily as a dataset, as `xarray.open_zarr` does.

    Raises
    ------
    InputError
        If there is no such store, or it is damaged.
    """
    import xarray as xr  # takes half a second, and only this function needs it

    with _reading(path) as place:
        with _group_metadata(place) as (name, _):
            group = _open_group(place, name)
        for child in place.names() if isinstance(place, LocalPlace) else []:
            metadata_file(place / child)  # refuses pipes, at which zarr would hang
        with os_errors(place), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about files that do not belong to the store
            for name, array in group.arrays():
                refuse_codecs(array, f"{place}/{name}")
            zarr_path = place.zarr_path()
            dataset = xr.open_zarr(zarr_path.store, group=zarr_path.path or None, consolidated=False, chunks=None)
        dataset.encoding["source"] = str(place)  # as xarray does for a path
        for variable in dataset.variables.values():  # codecs of zarr 3 would keep it from being written as zarr 2
            for codec in ("serializer", "compressors", "filters", "shards"):
                variable.encoding.pop(codec, None)
        return dataset


@contextmanager
def _reading(path: Location) -> Iterator[Place]:
    """Turn every error while a store is read, whatever library raises it, into one InputError that names the store."""
    place = place_of(path)
    try:
        yield place
    except InputError as error:
        text = str(error)
        kind = MissingInput if isinstance(error, MissingInput) else InputError
        raise kind(text if str(place) in text else f"{place}: {text}") from error.__cause__
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise unreachable(place, error) from error
        if isinstance(error, PermissionError):
            denied = error.filename or place
            raise InputError(f"{denied} may not be read by this user; change its permissions") from error
        raise InputError(
            f"{place} is damaged, or not a store of this kind ({cause_of(error)}); write it again"
        ) from error


@contextmanager
def _group_metadata(place: Place) -> Iterator[tuple[str, Any]]:
    """Check that a place is a group; yield the name and the content of its metadata file.

    An error in the block means that the file is damaged.
    """
    if isinstance(place, LocalPlace) and place.exists():
        if not place.path.is_dir():
            raise InputError(
                f"{place} is not a directory; give the path of a zarr store, which is a directory (blocksar ingest "
                "creates one from a CPHD or Gotcha file)"
            )
        os.listdir(place)  # a PermissionError is clearer than missing metadata
    metadata = metadata_file(place)
    if not metadata:
        if not place.exists():
            raise MissingInput(f"{place} does not exist; check the path")
        if isinstance(place, ObjectPlace) and (place / UNFINISHED).exists():
            raise InputError(f"{place} is being written, or was left unfinished; wait, or write it again")
        raise InputError(f"{place} is not a zarr store: it has no zarr.json; check the path, or write it again")
    try:
        kind = json.loads((place / metadata).read_bytes())
        if metadata == ".zarray" or kind.get("node_type", "group") != "group":
            raise InputError(f"{place} is a single zarr array, not a group; give the path of the store that holds it")
        yield metadata, kind
    except (InputError, PermissionError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise
        raise InputError(f"{place / metadata} is damaged ({cause_of(error)}); write the store again") from error


def _open_group(place: Place, metadata: str) -> zarr.Group:
    import zarr

    # Consolidated metadata is a copy that may be out of date.
    with os_errors(place):
        version: Any = 3 if metadata == "zarr.json" else 2
        return zarr.open_group(store=place.zarr_path(), mode="r", zarr_format=version, use_consolidated=False)


def _attrs(place: Place) -> dict[str, Any]:
    with _group_metadata(place) as (metadata, content):
        attrs = group_attrs(content) if metadata == "zarr.json" else None
        if attrs is None:
            attrs = _open_group(place, metadata).attrs.asdict()
    # xarray's list of variables is meaningless in another store.
    return {name: value for name, value in attrs.items() if name != "coordinates"}


def _read_collection(place: Place, attrs: Mapping[str, Any], raw: RawEcho | None) -> Collection:
    return collection_from(partial(read_real, place), lambda name: bool(metadata_file(place / name)), attrs, raw)


def collection_from(
    read: Callable[[str], FloatArray],
    present: Callable[[str], bool],
    attrs: Mapping[str, Any],
    raw: RawEcho | None,
) -> Collection:
    """Return the collection that variables and attributes describe.

    Parameters
    ----------
    read, present : function (name)
        Reads a variable of the contract; tells whether there is one.
    attrs : dict
        All attributes of the store.
    raw : RawEcho or None
        Whose range frequencies are those of the collection; None to read them.

    Raises
    ------
    InputError
        If they depart from the contract, or the attribute `georeference` or `calibration_factor` is none.
    """
    # Whatever is done with the collection: wrong ones are refused before the work starts.
    Georeference.among(attrs)
    calibration_of(attrs)
    time = read("time")
    beam_azimuth = read("beam_azimuth") if present("beam_azimuth") else np.full(time.shape, np.nan)
    beam_width = number(attrs, "beam_width", "rad", None)
    unsteered = np.isnan(beam_azimuth).all() and not present("beam_axis")
    if beam_width is not None and np.isnan(beam_width) and unsteered:
        beam_width = None
    carrier = number(attrs, "carrier_frequency", "Hz")
    ground_height = number(attrs, "ground_height", "m", 0.0)
    reference, position = read("reference_range"), _positions(read, present)
    check_scene_frame(
        carrier=carrier, time=time, position=position, reference=reference, ground_height=ground_height
    )  # fmt: skip
    return Collection(
        carrier=carrier,
        time=time,
        range_frequency=read("range_frequency") if raw is None else raw.range_frequency,
        reference_range=reference,
        antenna_position=position,
        beam_azimuth=beam_azimuth,
        beam_width=beam_width,
        ground_height=ground_height,
        title=str(attrs.get("title") or ""),
        noise_power=number(attrs, "noise_power", "the square of signal's", None),
        side_of_track=attrs.get("side_of_track"),
        recorded=RecordedRanges.among(attrs) if raw is None else raw.recorded(),
        **{name: read(name) for name in OPTIONAL if present(name)},  # type: ignore[arg-type]  # arrays, all of them
    )


def _positions(read: Callable[[str], FloatArray], present: Callable[[str], bool]) -> FloatArray:
    """The antenna's positions (n, 3), m, or the middle of those of transmitter and receiver."""
    given = [name for name in ANTENNAS if present(name)]
    if not given:
        return read("antenna_position")
    if present("antenna_position"):
        raise InputError(f"{given[0]} and antenna_position are both given; leave out one, or the other")
    places = [read(name) for name in given]
    return places[0] if len({place.shape for place in places}) > 1 else np.asarray(sum(places) / len(places))


TITLE = "track as flown; the phase history beside it has the track as known"


def write_truth(path: Location, time: FloatArray, positions: FloatArray) -> None:
    """Write slow times (n,), s, and positions (n, 3), m, in the frame of the phase history; replaces an earlier one."""
    create(
        path,
        TRUTH,
        sizes={},
        coords={"time": time},
        variables={"antenna_position": positions},
        attrs={"Conventions": CONVENTIONS, "title": TITLE},
        chunks={},
        overwrite=True,
    )


def is_truth(path: Location) -> bool:
    """Tell whether a store is one that `write_truth` wrote."""
    try:
        return open_dataset(path).attrs.get("title") == TITLE
    except InputError:
        return False


# ---------------------------------------------------------------- several in one frame

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
    """List the phase histories in a store of several; empty for any other, or if nothing exists there.

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
