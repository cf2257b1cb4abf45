"""simulate, ingest: make phase histories from scenes and from measured data."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from functools import partial
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import Any, Literal, TypedDict, TypeVar, Unpack

from blocksar.application.reports import Report, only_stage
from blocksar.errors import InputError, MissingInput
from blocksar.graph.machine import resources
from blocksar.options import options_of, read_options
from blocksar.places import Location, readable
from blocksar.places.place import Place
from blocksar.progress import Listener, as_listener
from blocksar.progress import Wanted as Progress
from blocksar.readers import registry as readers
from blocksar.readers.registry import READERS, found_at, stated_times
from blocksar.simulation import simulate as simulation
from blocksar.simulation.scene import Scene
from blocksar.texts import count

Reads = TypeVar("Reads", bound=Callable[..., Report])


def simulate(
    scene: Scene | str | Path,
    out: Location,
    *,
    raw: bool = False,
    cphd: bool = False,
    origin: tuple[float, float, float] | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path | Place:
    """Write the phase history of a scene, with exact ranges.

    Parameters
    ----------
    scene : Scene or path
        A scene, a scene file (TOML), or the name of a shipped scene: "table1", "paper_b", "paper_c".
    out : path
        Phase-history store to write, or the CPHD file if `cphd` is True.
    raw : bool
        Write a raw chirped echo instead of range-frequency samples. Default: False.
    cphd : bool
        Write a CPHD 1.1.0 file instead of a store. Default: False.
    origin : (latitude, longitude, height), optional
        Place of the scene centre in a CPHD file: degrees, and m above the WGS 84 ellipsoid. Default: that of the
        scene's georeference, or (39.78, -84.1, 300.0).
    threads : int, optional
        Threads that compute pulses. Default: the number of cores.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    path
        Where the phase history lies.

    Raises
    ------
    InputError
        If the scene is wrong, options exclude each other, or `out` exists and `overwrite` is False.
    """
    if not isinstance(scene, Scene | str | os.PathLike):
        raise InputError(f"scene is a {type(scene).__name__}; give a file, the name of a shipped scene, or a Scene")
    _, threads, _ = resources(1, threads, None)
    listener = as_listener(progress)
    callback = only_stage(listener, "simulate")
    if cphd and raw:
        raise InputError("raw is given together with cphd, but CPHD files hold compressed pulses; leave out one")
    if origin is not None and not cphd:
        raise InputError(f"origin is {origin}, but only CPHD files have one; leave it out")
    scene = scene if isinstance(scene, Scene) else Scene.read(scene)
    written: Path | Place
    if cphd:
        from blocksar.simulation import cphd as cphd_files  # optional libraries

        written = cphd_files.simulate(
            scene, out, origin=origin, threads=threads, overwrite=overwrite, progress=callback
        )
        if line := cphd_files.off_level(scene, origin):
            listener.note(line)
    else:
        written = simulation.simulate(scene, out, raw=raw, threads=threads, overwrite=overwrite, progress=callback)
    _note_unlit(scene, listener)
    return written


def _note_unlit(scene: Scene, listener: Listener) -> None:
    """Note the targets of a scene that no pulse lights, to the listener."""
    if unlit := scene.unlit_targets():
        names = ", ".join(unlit[:4]) + (", ..." if len(unlit) > 4 else "")
        listener.note(
            f"no pulse lights {len(unlit)} of {count(len(scene.point_targets()), 'target')} ({names}), and no echo "
            "is simulated there; correct the places, or the beam"
        )


def ingest(
    kind: str | None,
    source: Location | Sequence[Location],
    out: Location,
    *,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Report:
    """Turn measured data into a phase history, by the reader of their format.

    Parameters
    ----------
    kind : str or None
        Name of the reader, such as "cphd" or "gotcha"; None: that which knows the first of the files by its first
        bytes.
    source : path or sequence of paths
        A file, or the files of one collection.
    out : path
        Phase-history store to write.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products.
        Default: the file's own.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: the file's own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.
    **options
        Those of the reader: `ground_height`, and others; see `ingest_cphd`, `ingest_nisar` and their like.

    Returns
    -------
    Report
        `summary` says what was found in the files; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If `kind` is unknown, no reader knows the file, a file is damaged or not supported, an option is wrong or not
        one of the reader's, or `out` exists and `overwrite` is False.
    """
    if not isinstance(source, str | os.PathLike | Place | Sequence):
        raise InputError(f"source is {source!r}; give the path of a file, or a list of paths")
    sources = [source] if isinstance(source, str | os.PathLike | Place) else list(source)
    name = kind if kind is not None or not sources else reader_of(sources[0])
    if name not in READERS:
        raise InputError(f"kind is {kind!r}; it must be {' or '.join(map(repr, READERS.names()))}")
    reader = READERS.get(name)
    if not sources or (len(sources) > 1 and not reader.several):
        raise InputError(f"source is a list of {len(sources)}; {reader.kind.name} is ingested by itself")
    choices: Any = read_options(
        reader.options, options, str(name), ((other, each.options) for other, each in READERS.sound())
    )
    listener = as_listener(progress)
    history = readers.ingest(
        reader, sources, out, choices, times=stated_times(collection_start, time_zero), overwrite=overwrite,
        begun=partial(listener.begin, "ingest"), progress=partial(listener.update, "ingest"),
    )  # fmt: skip
    return Report(summary=[*history.messages, f"wrote {history.path}"], result=history.collection)


def reader_of(source: Location) -> str:
    """The name of the reader that knows a file by its first bytes.

    Raises
    ------
    InputError
        If there is none; it says what lies there.
    """
    where = readable(source)
    try:
        found = found_at(where)
    except OSError as error:
        raise InputError(f"{where} cannot be read ({error.strerror or error}); check its permissions") from error
    if found is None:
        kinds = ", ".join(READERS.names())
        raise MissingInput(f"{where} does not exist, or is no file; check the path (kinds of files are {kinds})")
    if found.reader is None:
        raise InputError(found.sentence(where))
    return found.reader


_SECTION = r"^{}\n-+\n(.*?)(?=^\S[^\n]*\n---|\Z)"  # of a docstring
_ENTRY = r"^(\w+) : [^\n]*\n(?:    [^\n]*\n|\n)+"


def _entries(documented: object, section: str) -> dict[str, str]:
    """The entries of a section of a docstring, by name."""
    text = re.search(_SECTION.format(section), getdoc(documented) or "", re.M | re.S)
    found = re.finditer(_ENTRY, f"{text[1]}\n" if text else "", re.M)
    return {entry[1]: entry[0].strip() for entry in found}


def _of_reader(function: Reads) -> Reads:
    """Complete signature and docstring of `ingest_NAME` from the reader's options and the arguments of `ingest`.

    What the function's own docstring says stays.
    """
    model = READERS.get(function.__name__.removeprefix("ingest_")).options
    *own, _ = signature(function).parameters.values()
    shared = [each for each in signature(ingest).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    options = [
        Parameter(
            each.name, Parameter.KEYWORD_ONLY, default=each.default if each.option.read is None else None,
            annotation=each.type,
        )
        for each in options_of(model)
    ]  # fmt: skip
    whole = signature(function).replace(parameters=[*own, *options, *shared])
    known = _entries(ingest, "Parameters")
    for each in reversed(model.__mro__):
        known |= _entries(each, "Attributes")
    known |= _entries(function, "Parameters")
    sections = "\n".join(known[name] for name in whole.parameters)
    text = getdoc(function) or ""
    start = text.index("Parameters\n---")
    rest = re.search(r"^(Returns|Raises)\n---", text[start:], re.M)
    assert rest is not None
    returns = "" if rest[1] == "Returns" else f"Returns\n-------\n{_RETURNS}\n\n"
    function.__doc__ = f"{text[:start]}Parameters\n----------\n{sections}\n\n{returns}{text[start + rest.start() :]}"
    function.__signature__ = whole  # type: ignore[attr-defined]
    return function


_RETURNS = """Report
    `summary` says what was found in the files; `result` is the collection that the store holds."""
Part = str | tuple[int | None, int | None] | None


class _Options(TypedDict, total=False):
    """Options of every reader as type checkers see them; a test compares them with the model."""

    ground_height: float
    collection_start: str | None
    time_zero: float | None
    overwrite: bool
    progress: Progress | None


class _CphdOptions(_Options, total=False):
    channel: str | None
    pulses: Part
    frequencies: str | tuple[float | None, float | None] | None
    area: str | tuple[tuple[float, float], tuple[float, float]] | None
    sgn: int | None
    range_window: Literal["saved", "reference"] | None
    troposphere: Literal["file", "standard"] | None


class _RawOptions(_Options, total=False):
    range_delay: float
    chirp_sign: Literal["up", "down"] | None


class _PartOptions(_RawOptions, total=False):
    polarization: str | None
    pulses: Part
    troposphere: Literal["standard"] | None


class _CrsdOptions(_PartOptions, total=False):
    channel: str | None


class _StripOptions(_PartOptions, total=False):
    time_tags: Literal["transmit", "receive", "middle"] | None


class _NisarOptions(_StripOptions, total=False):
    frequency: str | None


class _Sentinel1Options(_RawOptions, total=False):
    swath: str | None
    polarization: str | None
    bursts: Part
    orbit: Location | None
    time_tags: Literal["transmit", "middle"] | None
    troposphere: Literal["standard"] | None


@_of_reader
def ingest_cphd(source: Location, out: Location, **options: Unpack[_CphdOptions]) -> Report:
    """Turn a CPHD file into a phase history, in the tangent frame at its scene's reference point.

    Parameters
    ----------
    source : path
        CPHD file, version 1.0 or 1.1, monostatic: a path, s3://bucket/name, or the URL of a web server that sends parts
        of files.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, or `out` exists and `overwrite` is False.
    """
    return ingest("cphd", source, out, **options)


@_of_reader
def ingest_gotcha(source: Location | Sequence[Location], out: Location, **options: Unpack[_Options]) -> Report:
    """Join MATLAB files of the AFRL Gotcha set in azimuth into a phase history, in their scene-centred frame.

    Parameters
    ----------
    source : path or sequence of paths
        Files of one pass, in any order. Several polarisations become the channels of the store, if their pulses are at
        the same places.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products. Default:
        unknown.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: 0.

    Raises
    ------
    InputError
        If a file is damaged, files do not belong together, or `out` exists and `overwrite` is False.
    """
    return ingest("gotcha", source, out, **options)


@_of_reader
def ingest_crsd(source: Location, out: Location, **options: Unpack[_CrsdOptions]) -> Report:
    """Turn a CRSD file, of echoes that are not compressed, into a phase history in the frame of its reference point.

    Parameters
    ----------
    source : path
        CRSD file, version 1.0, monostatic: a path, s3://bucket/name, or a URL.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest("crsd", source, out, **options)


@_of_reader
def ingest_nisar(source: Location, out: Location, **options: Unpack[_NisarOptions]) -> Report:
    """Turn raw echoes of NISAR (level 0B RRSD, HDF5) into a phase history on the ellipsoid.

    Parameters
    ----------
    source : path
        File of NISAR, or of another sensor in its layout: a path, s3://bucket/name, or a URL.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest("nisar", source, out, **options)


@_of_reader
def ingest_palsar(source: Location | Sequence[Location], out: Location, **options: Unpack[_StripOptions]) -> Report:
    """Turn raw echoes of ALOS PALSAR (CEOS level 1.0) into a phase history on the ellipsoid.

    Parameters
    ----------
    source : path or sequence of paths
        Folder of a scene, or its files: the leader (LED) and images (IMG).

    Raises
    ------
    InputError
        If a file is damaged, contradicts others or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest("palsar", source, out, **options)


@_of_reader
def ingest_sentinel1(
    source: Location | Sequence[Location], out: Location, **options: Unpack[_Sentinel1Options]
) -> Report:
    """Turn Sentinel-1 level 0 (packets) into phase histories: one for each burst, in one frame on the ellipsoid.

    Parameters
    ----------
    source : path or sequence of paths
        Files of packets (.dat) of one data take, or the SAFE folder that they lie in.
    out : path
        Phase-history store to write; of several bursts a store of as many, which `focus` takes as one.
    collection_start : str, optional
        UTC from which the times of a single burst count. Default: the packets' own.
    time_zero : float, optional
        Seconds from there to its slow time 0. Default: the packets' own.

    Returns
    -------
    Report
        `summary` says what was found and assumed; `result` is the collection of the (first) burst.

    Raises
    ------
    InputError
        If a file is damaged or of another kind, no burst is left, the orbit is not known, or `out` exists and
        `overwrite` is False.
    """
    return ingest("sentinel1", source, out, **options)
