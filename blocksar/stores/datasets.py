"""Phase histories in memory: datasets of xarray, checked against the contract of a store and written as one."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import xxhash

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import TILE
from blocksar.collection.empty_pulses import find_real
from blocksar.errors import InputError
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.stores.channels import attrs_of_channel, check_channels, number_of, text, unnamed_channels, with_channels
from blocksar.stores.contract import (
    ANTENNAS,
    SAMPLES,
    SCHEMA,
    Variable,
    check_type,
    check_units,
    in_order,
    missing,
    raw_echo_from,
    refuse_filled,
)
from blocksar.stores.creation import create_phase_history, history_line
from blocksar.stores.phase_history import PhaseHistory, collection_from, not_one_of_two, open_phase_history, other_attrs
from blocksar.stores.records import json_checksum, plain_value
from blocksar.stores.regions import metadata_file, write_region

if TYPE_CHECKING:
    import xarray as xr

CONTENT = "content"  # attribute of a store written from memory: the fingerprint of its content
IN_MEMORY = "the dataset"  # stands for the path in messages
STORE_LAYERS = 2  # of dask's graph of a variable that was opened and nothing else
AXES = ("time", "range_frequency", "fast_time", "beam_offset", "elevation")


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetHistory(PhaseHistory):
    """A phase history whose samples are those of a dataset: in memory, or read and computed on demand.

    Attributes
    ----------
    samples : xarray.Variable
        ([n_channel,] n_pulse, n_column) complex.
    given : dict
        Attributes as the dataset has them: of all channels.
    """

    samples: Any
    given: dict[str, Any]

    @property
    def label(self) -> str:
        return IN_MEMORY

    def of_channel(self, name: str | None) -> DatasetHistory:
        """A channel alone, without the others; the first for None.

        Raises
        ------
        InputError
            If there is none of that name.
        """
        number = number_of(self.channels, name, self.label)
        attrs = attrs_of_channel(self.given, self.channels, number)
        samples = self.samples[number] if self.channels else self.samples
        return replace(self, samples=samples, channels=(), channel=0, attrs=attrs, given=attrs)

    def read(self, pulses: slice, columns: slice) -> ComplexArray:
        return self._read((self.channel, pulses, columns) if self.channels else (pulses, columns))

    def _read(self, region: tuple[int | slice, ...]) -> ComplexArray:
        with np.errstate(over="ignore"):
            return np.asarray(unmasked(self.variable, self.samples[region])).astype(np.complex64, copy=False)

    def pinned(self) -> Self:
        return self  # a dataset has no versions

    def parts(self) -> Iterator[tuple[tuple[slice, ...], ComplexArray]]:
        """Iterate over the samples of all channels by groups of pulses, in whole chunks of a store: regions, values."""
        n_pulse, n_column = self.shape
        leads: list[tuple[slice, ...]] = [(slice(k, k + 1),) for k in range(len(self.channels))]
        for lead in leads or [()]:
            for first in range(0, n_pulse, TILE[0]):
                region = (*lead, slice(first, min(first + TILE[0], n_pulse)), slice(0, n_column))
                yield region, self._read(region)

    @cached_property
    def _content(self) -> str:
        digest, valid, nonzero = xxhash.xxh3_128(), False, False
        values = {**self.collection.as_dict(), **(vars(self.raw) if self.raw is not None else {})}
        if self.raw is not None:  # they follow from the rest, and from what is imaged
            del values["range_frequency"], values["recorded"]
        elif self.collection.recorded is None:
            del values["recorded"]  # as before there was any
        if not self.collection.bistatic:
            for name in ANTENNAS:
                del values[name]  # likewise
        for name, value in sorted(values.items()):
            digest.update(f"{name} {np.shape(value)} ".encode())
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        digest.update(json_checksum(_lasting(self.given)).encode())
        for _, part in self.parts():
            digest.update(np.ascontiguousarray(part).view(np.uint8).data)
            finite = np.isfinite(part)
            valid = valid or bool(finite.any())
            nonzero = nonzero or bool(part[finite].any())
        if not valid:
            raise InputError(f"{self.variable} of {IN_MEMORY} holds no finite sample; check how it was computed")
        if not nonzero:
            raise InputError(f"{self.variable} of {IN_MEMORY} holds zeros only; fill it with the samples")
        if (reason := find_real(self.variable, self.collection, self.parts())) is not None:
            raise InputError(reason)
        return digest.hexdigest()

    def fingerprint(self) -> str:
        """Return a hash of everything, samples included: a dataset that is built again has the same.

        Raises
        ------
        InputError
            If no sample is finite, all are zero, or all are real.
        """
        return self._content

    def write(self, path: Location, *, overwrite: bool = False) -> PhaseHistory:
        """Write a store of the same content, by groups of pulses; return it opened.

        Raises
        ------
        InputError, ProcessingError
            As for `create`.
        """

        def fill(store: Place) -> None:
            for region, part in self.parts():
                write_region(store, self.variable, region, part)

        lines = history_line("written from a dataset in memory by blocksar", self.given.get("history"))
        attrs = {**self.given, "history": lines, CONTENT: self.fingerprint()}
        create_phase_history(
            path, self.collection, raw=self.raw, channels=self.channels, attrs=attrs, overwrite=overwrite, fill=fill
        )
        return open_phase_history(path)

    def stored(self, path: Place) -> PhaseHistory:
        """Open the store at a place of the run if it has this content; else write it."""
        if metadata_file(path):
            history = open_phase_history(path)
            if history.attrs.get(CONTENT) == self.fingerprint():
                return history
        return self.write(path, overwrite=True)


def _lasting(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes without those that change each time the same data are written."""
    return {name: value for name, value in attrs.items() if name not in ("history", CONTENT)}


def history_of(dataset: xr.Dataset) -> PhaseHistory:
    """Return the phase history of a dataset: that of the store it was opened from, unless it was modified.

    A dataset counts as unchanged if its samples were not loaded and everything else equals what the store holds.

    Raises
    ------
    InputError
        If the dataset, or the store that it was opened from, departs from the contract.
    """
    source = dataset.encoding.get("source")
    if source is None or not metadata_file(place(source)):
        return history_in_memory(dataset)
    lazy = all(_is_as_opened(dataset.variables[name]) for name in ("signal", "echo") if name in dataset.variables)
    if not lazy:
        return history_in_memory(dataset)
    history, own = open_phase_history(source), history_in_memory(dataset)
    same_raw = history.raw is None or own.raw is None or np.array_equal(history.raw.fast_time, own.raw.fast_time)
    same_samples = own.shape == history.shape and own.channels == history.channels
    return history if same_raw and same_samples and own.same(history) else own


def _is_as_opened(variable: xr.Variable) -> bool:
    """Tell whether a variable's samples are still those of the store; False if xarray does not show it."""
    if getattr(variable, "_in_memory", True):
        return False
    layers = getattr(getattr(variable.data if variable.chunks else None, "dask", None), "layers", ())
    return not variable.chunks or 0 < len(layers) <= STORE_LAYERS


def history_in_memory(dataset: xr.Dataset) -> DatasetHistory:
    """Check a dataset against the contract, except the values of its samples; its own samples are used, not a store's.

    Raises
    ------
    InputError
        If it departs from the contract.
    """
    try:
        return _checked(dataset)
    except InputError as error:
        text = str(error)
        raise InputError(text if IN_MEMORY in text else f"{IN_MEMORY}: {text}") from error.__cause__


def _checked(dataset: xr.Dataset) -> DatasetHistory:
    names = [name for name in ("signal", "echo") if name in dataset.variables]
    if len(names) != 1:
        raise not_one_of_two(names, map(str, dataset.variables))
    try:
        attrs = {str(name): plain_value(value, str(name)) for name, value in dataset.attrs.items()}
    except ValueError as error:
        raise InputError(f"{error}; remove it, or write it as text") from None

    def read(name: str) -> FloatArray:
        if name not in dataset.variables:
            raise missing(name, SCHEMA[name])
        variable = dataset.variables[name]
        check_type(name, SCHEMA[name], tuple(variable.dims), variable.dtype)
        check_units(name, SCHEMA[name].units, variable.attrs.get("units"))
        values = np.asarray(unmasked(name, variable), np.float64)
        refuse_filled(name, values, variable.attrs)
        if "axis" not in SCHEMA[name].dims:
            return values
        return in_order(name, values, lambda: _component_labels(dataset))

    samples = dataset.variables[names[0]]
    check_type(names[0], SCHEMA[names[0]], tuple(samples.dims), samples.dtype)
    check_units(names[0], SCHEMA[names[0]].units, samples.attrs.get("units"))
    channels = _channels(dataset, samples.shape[0]) if samples.ndim > len(SCHEMA[names[0]].dims) else ()
    raw = raw_echo_from(read("fast_time"), attrs) if names == ["echo"] else None
    present = dataset.variables.__contains__
    collection = collection_from(read, present, attrs, raw)
    given = other_attrs(attrs, raw)
    if not channels and "channel" in dataset.variables and not dataset.variables["channel"].ndim:  # one taken out
        given = attrs_of_channel(given, check_channels([text(dataset.variables["channel"].values.item())]), 0)
    return DatasetHistory(
        path=place(IN_MEMORY), collection=collection, raw=raw, attrs=attrs_of_channel(given, channels, 0), given=given,
        channels=channels, samples=samples,
    )  # fmt: skip


def unmasked(name: str, variable: xr.Variable) -> Any:
    """Values of a variable, with NaN for masked samples, also in dask arrays of masked ones.

    Raises
    ------
    InputError
        If metadata are masked.
    """
    values = variable.data.compute() if variable.chunks else variable.values
    if not isinstance(values, np.ma.MaskedArray):
        return values
    mask = np.ma.getmaskarray(values)
    if name not in SAMPLES and mask.any():
        raise InputError(f"{name} is masked at {np.count_nonzero(mask)} of {mask.size} values; give all of them")
    return values.filled(np.nan) if name in SAMPLES else values.data


def _component_labels(dataset: xr.Dataset) -> Any:
    """Labels x, y, z along a dataset's dimension `axis`; None without them."""
    named = [each.values for each in dataset.coords.values() if each.dims == ("axis",) and each.size == 3]
    return named[0] if named else None


def _channels(dataset: xr.Dataset, count: int) -> tuple[str, ...]:
    """Names of the channels along the samples' leading dimension."""
    if "channel" not in dataset.variables:
        raise unnamed_channels(count)
    return check_channels([text(name) for name in np.atleast_1d(dataset.variables["channel"].values)])


def dataset_of(variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Build a dataset of the contract from arrays, with units and long names.

    Parameters
    ----------
    variables : mapping of str to array
        By name, as `incoming.enter` returns them; those that are None are left out. With `channel`, the names of
        channels, samples lie along these first.
    attrs : mapping of str to object
        Likewise.

    Raises
    ------
    InputError
        If an array has the wrong shape or kind, or the collection is impossible.
    """
    import xarray as xr  # takes half a second

    given = {name: value for name, value in variables.items() if value is not None}
    lengths: dict[str, tuple[int, str]] = {"axis": (3, "x, y, z")}
    schema: Mapping[str, Variable] = SCHEMA
    if "channel" in given:
        if isinstance(given["channel"], str) or not np.iterable(given["channel"]):
            raise InputError(f"channel is {given['channel']!r}; give a list of names")
        names = check_channels([text(name) for name in given["channel"]])
        given["channel"], lengths["channel"] = names, (len(names), "channel")
        schema = with_channels(SCHEMA, *SAMPLES)
    for name in AXES:
        if name in given:
            if given[name].ndim != 1:
                raise InputError(
                    f"{name} has shape {given[name].shape}, but must be an axis: one value for each sample along it"
                )
            lengths[SCHEMA[name].dims[0]] = (given[name].size, name)
    made = {}
    for name, value in given.items():
        array = np.asarray(value)
        _check_shape(name, array, schema[name].dims, lengths)
        made[name] = (schema[name].dims, array, {"units": schema[name].units, "long_name": schema[name].long_name})
    dataset = xr.Dataset(
        {name: value for name, value in made.items() if name not in (*AXES, "channel")},
        coords={name: value for name, value in made.items() if name in (*AXES, "channel")},
        attrs={name: copy.deepcopy(value) for name, value in attrs.items() if value is not None},
    )
    _checked(dataset).fingerprint()  # which reads all samples
    return dataset


def _check_shape(name: str, array: Any, dims: Sequence[str], lengths: Mapping[str, tuple[int, str]]) -> None:
    expected = tuple(lengths[dim][0] for dim in dims)
    if array.shape == expected:
        return
    meaning = ", ".join(f"{lengths[dim][0]} of {lengths[dim][1]}" for dim in dims)
    remedy = f"give {name}.T" if array.shape == expected[::-1] else f"make it ({', '.join(dims)})"
    raise InputError(f"{name} has shape {array.shape}, but must have {expected} ({meaning}); {remedy}")
