"""simulate, ingest: where phase histories come from."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from blocksar.api.reports import Report, only_stage, resumed_stage
from blocksar.errors import InputError
from blocksar.graph.machine import resources
from blocksar.ingestion import readers
from blocksar.ingestion.found import found_at
from blocksar.ingestion.readers import READERS
from blocksar.ingestion.timeline import stated_times
from blocksar.options import read_options
from blocksar.places import Location, readable
from blocksar.places.place import Place
from blocksar.progress import Listener, as_listener
from blocksar.progress import Wanted as Progress
from blocksar.simulation import phase_history
from blocksar.simulation.scene import Scene


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
    callback = only_stage(listener, "simulate") if cphd else resumed_stage(listener, "simulate")
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
    else:
        written = phase_history.simulate(scene, out, raw=raw, threads=threads, overwrite=overwrite, progress=callback)
    _note_unlit(scene, listener)
    return written


def _note_unlit(scene: Scene, listener: Listener) -> None:
    """Note the targets of a scene that no pulse lights."""
    if unlit := scene.unlit_targets():
        names = ", ".join(unlit[:4]) + (", ..." if len(unlit) > 4 else "")
        listener.note(
            f"no pulse lights {len(unlit)} of {len(scene.point_targets())} targets ({names}), which leave no echo; "
            "correct their places, or the beam"
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
    history = readers.ingest(
        reader, sources, out, choices, times=stated_times(collection_start, time_zero), overwrite=overwrite,
        progress=resumed_stage(progress, "ingest"),
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
        raise InputError(f"{where} does not exist, or is no file; check the path (kinds of files are {kinds})")
    if found.reader is None:
        raise InputError(found.sentence(where))
    return found.reader


def ingest_cphd(
    source: Location,
    out: Location,
    *,
    channel: str | None = None,
    pulses: str | tuple[int | None, int | None] | None = None,
    frequencies: str | tuple[float | None, float | None] | None = None,
    area: str | tuple[tuple[float, float], tuple[float, float]] | None = None,
    ground_height: float = 0.0,
    sgn: int | None = None,
    range_window: Literal["saved", "reference"] | None = None,
    troposphere: Literal["file", "standard"] | None = None,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn a CPHD file into a phase history, in the tangent frame at its scene's reference point.

    Parameters
    ----------
    source : path
        CPHD file, version 1.0 or 1.1, monostatic: a path, s3://bucket/name, or the URL of a web server that sends parts
        of files.
    out : path
        Phase-history store to write.
    channel : str, optional
        Identifier of the channel. Needed if the file has several. "all" makes a store with a channel for each of the
        file's, which must have the same geometry.
    pulses : str or (int, int), optional
        Vectors "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    frequencies : str or (float, float), optional
        Band "f1:f2" that is read, Hz; either may be left out. Default: all.
    area : str or ((float, float), (float, float)), optional
        Ground "x0:x1,y0:y1", m in the scene frame, that images will show: of pulses and frequencies only what it needs
        is kept, after low-passes that stop the echoes of all else. Default: all.
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0, that of the file's reference point.
    sgn : {-1, 1}, optional
        Sign of the phase that the samples follow. Default: as declared.
    range_window : {"saved", "reference"}, optional
        The delays that are taken: those of TOA1 .. TOA2, or those about the reference point that the samples tell
        apart. Default: "saved", and refused if none of them is of the image area.
    troposphere : {"file", "standard"}, optional
        The troposphere's delay that the samples still hold, and that is taken out: that of TDTropoSRP, or that of a
        standard atmosphere. Default: none, as the standard has it.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products.
        Default: the file's own.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: the file's own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` says what was found in the file; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, or `out` exists and `overwrite` is False.
    """
    return ingest(
        "cphd", source, out, channel=channel, pulses=pulses, frequencies=frequencies, area=area,
        ground_height=ground_height, sgn=sgn, range_window=range_window, troposphere=troposphere,
        collection_start=collection_start, time_zero=time_zero, overwrite=overwrite, progress=progress,
    )  # fmt: skip


def ingest_gotcha(
    source: Location | Sequence[Location],
    out: Location,
    *,
    ground_height: float = 0.0,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Join MATLAB files of the AFRL Gotcha set in azimuth into a phase history, in their scene-centred frame.

    Parameters
    ----------
    source : path or sequence of paths
        Files of one pass, in any order. Several polarisations become the channels of the store, if their pulses are at
        the same places.
    out : path
        Phase-history store to write.
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0, that of the scene's centre.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products. Default:
        unknown.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: 0.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` says what was found in the files; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If a file is damaged, files do not belong together, or `out` exists and `overwrite` is False.
    """
    return ingest(
        "gotcha", source, out, ground_height=ground_height, collection_start=collection_start, time_zero=time_zero,
        overwrite=overwrite, progress=progress,
    )  # fmt: skip


def ingest_crsd(
    source: Location,
    out: Location,
    *,
    polarization: str | None = None,
    channel: str | None = None,
    pulses: str | tuple[int | None, int | None] | None = None,
    ground_height: float = 0.0,
    troposphere: Literal["standard"] | None = None,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn a CRSD file, of echoes that are not compressed, into a phase history in the frame of its reference point.

    Parameters
    ----------
    source : path
        CRSD file, version 1.0, monostatic: a path, s3://bucket/name, or a URL.
    out : path
        Phase-history store to write.
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    channel : str, optional
        Identifier of the channel, if several have the polarisation.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    troposphere : {"standard"}, optional
        Delay that the samples hold, and that is taken out: that of a standard atmosphere. Default: none.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products.
        Default: the file's own.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: the file's own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` says what was found in the file; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest(
        "crsd", source, out, polarization=polarization, channel=channel, pulses=pulses,
        ground_height=ground_height, troposphere=troposphere, collection_start=collection_start,
        time_zero=time_zero, overwrite=overwrite, progress=progress,
    )  # fmt: skip


def ingest_nisar(
    source: Location,
    out: Location,
    *,
    polarization: str | None = None,
    frequency: str | None = None,
    pulses: str | tuple[int | None, int | None] | None = None,
    ground_height: float = 0.0,
    time_tags: Literal["transmit", "receive", "middle"] | None = None,
    troposphere: Literal["standard"] | None = None,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn raw echoes of NISAR (level 0B RRSD, HDF5) into a phase history on the ellipsoid.

    Parameters
    ----------
    source : path
        File of NISAR, or of another sensor in its layout: a path, s3://bucket/name, or a URL.
    out : path
        Phase-history store to write.
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    frequency : {"A", "B"}, optional
        Band of the two. Default: "A", or the only one.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    time_tags : {"transmit", "receive", "middle"}, optional
        What times of pulses are those of: the pulse's transmission, its first sample's reception, or the antenna at the
        middle of the echo's way. Default: "transmit" if the
        file describes them so, else "middle".
    troposphere : {"standard"}, optional
        Delay that the samples hold, and that is taken out: that of a standard atmosphere. Default: none.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products.
        Default: the file's own.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: the file's own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` says what was found in the file; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest(
        "nisar", source, out, polarization=polarization, frequency=frequency, pulses=pulses,
        ground_height=ground_height, time_tags=time_tags, troposphere=troposphere,
        collection_start=collection_start, time_zero=time_zero, overwrite=overwrite, progress=progress,
    )  # fmt: skip


def ingest_palsar(
    source: Location | Sequence[Location],
    out: Location,
    *,
    polarization: str | None = None,
    pulses: str | tuple[int | None, int | None] | None = None,
    ground_height: float = 0.0,
    time_tags: Literal["transmit", "receive", "middle"] | None = None,
    troposphere: Literal["standard"] | None = None,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn raw echoes of ALOS PALSAR (CEOS level 1.0) into a phase history on the ellipsoid.

    Parameters
    ----------
    source : path or sequence of paths
        Folder of a scene, or its files: the leader (LED) and images (IMG).
    out : path
        Phase-history store to write.
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    time_tags : {"transmit", "receive", "middle"}, optional
        What times of pulses are those of: the pulse's transmission, its first sample's reception, or the antenna at the
        middle of the echo's way. Default: "receive".
    troposphere : {"standard"}, optional
        Delay that the samples hold, and that is taken out: that of a standard atmosphere. Default: none.
    collection_start : str, optional
        UTC from which the collection's times count, ISO 8601, such as "2008-08-19T14:03:21.5Z"; for products.
        Default: the file's own.
    time_zero : float, optional
        Seconds from there to slow time 0. Default: the file's own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` says what was found in the file; `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, a library is missing, or `out` exists and
        `overwrite` is False.
    """
    return ingest(
        "palsar", source, out, polarization=polarization, pulses=pulses, ground_height=ground_height,
        time_tags=time_tags, troposphere=troposphere, collection_start=collection_start, time_zero=time_zero,
        overwrite=overwrite, progress=progress,
    )  # fmt: skip


def ingest_sentinel1(
    source: Location | Sequence[Location],
    out: Location,
    *,
    swath: str | None = None,
    polarization: str | None = None,
    bursts: str | tuple[int | None, int | None] | None = None,
    orbit: Location | None = None,
    time_tags: Literal["transmit", "middle"] | None = None,
    troposphere: Literal["standard"] | None = None,
    ground_height: float = 0.0,
    collection_start: str | None = None,
    time_zero: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn Sentinel-1 level 0 (packets) into phase histories: one for each burst, in one frame on the ellipsoid.

    Parameters
    ----------
    source : path or sequence of paths
        Files of packets (.dat) of one data take, or the SAFE folder that they lie in.
    out : path
        Phase-history store to write; of several bursts a store of as many, which `focus` takes as one.
    swath : str, optional
        The one swath that is read, such as "IW1". Default: all.
    polarization : str, optional
        Of transmitter and receiver. Default: that of like ones, "VV" or "HH".
    bursts : str or (int, int), optional
        Bursts "a:b" of each swath that are read, from a to the one before b, counted from 0. Default: all.
    orbit : path, optional
        Precise orbit (EOF). Default: the states in the packets.
    time_tags : {"transmit", "middle"}, optional
        What the packets' times are those of: the pulse's transmission, or the positions of an antenna that stands still
        while a pulse is out, as in simulations. Default: the PRI in which the echo is received.
    troposphere : {"standard"}, optional
        The delay that the samples hold, and that is taken out: a standard atmosphere's. Default: none.
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0.
    collection_start : str, optional
        UTC from which the times of a single burst count. Default: the packets' own.
    time_zero : float, optional
        Seconds from there to its slow time 0. Default: the packets' own.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

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
    return ingest(
        "sentinel1", source, out, swath=swath, polarization=polarization, bursts=bursts, orbit=orbit,
        time_tags=time_tags, troposphere=troposphere, ground_height=ground_height, collection_start=collection_start,
        time_zero=time_zero, overwrite=overwrite, progress=progress,
    )  # fmt: skip
