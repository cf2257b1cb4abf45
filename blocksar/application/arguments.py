"""Arguments that several commands share: the source, the grid and control points."""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError, MissingInput, quoted
from blocksar.graph.machine import why_no_workers
from blocksar.places import Location, lies_at, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.readers.registry import found_at
from blocksar.runs.record import RECORD
from blocksar.simulation import shipped_scenes

if TYPE_CHECKING:
    import xarray as xr

    from blocksar.measurement.targets import Target
    from blocksar.simulation.scene import Scene


def mistaken(source: Location) -> str | None:
    """Describe what lies at a path that is no phase history, with the remedy; None if nothing useful can be said."""
    where = place(source)
    try:
        return _told(where, str(source))
    except OSError:  # the caller's error states what cannot be read
        return None


def _told(where: Place, text: str) -> str | None:
    if isinstance(where, LocalPlace):
        path = where.path
        if not os.path.exists(path):
            return _missing(path, text)
        if (path / RECORD).exists() or (path / "receipts").exists():
            return (
                f"{where} is a run, not a phase history; `blocksar info` names the phase history that it was made from"
            )
        for name, kind in (("image", "an image"), ("spectrum", "a spectrum")):
            if (path / name / "zarr.json").exists():
                return f"{where} is {kind} of a run, not a phase history; give the run's input"
        if (path / "zarr.json").exists() or (path / ".zgroup").exists():
            return None
    found = found_at(where)
    return None if found is None else found.sentence(where, text)


def _missing(path: Path, text: str) -> str | None:
    """Explain a missing path: a shipped scene's name, a broken link, or a similar name nearby; None if neither."""
    if text in shipped_scenes():
        return (
            f"{text} is a shipped scene, not a phase history; write one first: `blocksar simulate {text} --out "
            f"{text}.zarr`"
        )
    if path.is_symlink():
        return f"{path} is a symbolic link to {os.readlink(path)}, which does not exist; correct the link"
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    close = difflib.get_close_matches(path.name, [*names, *shipped_scenes()], n=1, cutoff=0.75)
    return f"{path} does not exist; did you mean {close[0]}?" if close else None


One: TypeAlias = "Location | xr.Dataset | stores.PhaseHistory"
Source: TypeAlias = "One | Sequence[One]"
OnGround: TypeAlias = "Callable[[Sequence[stores.PhaseHistory]], list[stores.PhaseHistory]]"
SMALL = 1 << 24  # samples, 128 MiB: for less, a cluster takes longer to start than it saves


def in_this_process(workers: int | None, collections: Sequence[Collection]) -> bool:
    """Tell whether the calling process does the work.

    By default that of small collections, in interactive sessions, and all where no workers can start.
    """
    if workers is None:
        samples = sum(each.n_pulse * each.n_range_frequency for each in collections)
        return (hasattr(sys, "ps1") and samples <= SMALL) or why_no_workers() is not None
    return workers == 0


def gpu_workers(workers: int | None) -> int:
    """Return the number of workers of a local run on a GPU, which share it: one by default; 0 is the calling process.

    Raises
    ------
    InputError
        If there is no GPU.
    """
    from blocksar.kernels.device import device  # with the loops, which take long to load

    device("gpu")
    return 1 if workers is None else workers


def collection_of(source: One) -> Collection:
    """Return the collection of a scene (a TOML file or the name of a shipped one) or of a phase history, centred."""
    scene = scene_of(source)
    return (history_of(source).collection if scene is None else scene.collection()).centred()


def scene_of(source: One) -> Scene | None:
    """Return the scene that a source is (a TOML file or the name of a shipped one); None if it is none."""
    if not is_scene(source):
        return None
    from blocksar.simulation.scene import Scene  # slow to load

    return Scene.read(str(source))


def sources_of(source: Source) -> list[One]:
    """Return the sources of a command that takes one or several.

    Raises
    ------
    InputError
        If there is none, or one of them twice.
    """
    if not isinstance(source, list | tuple):
        return _members(source)  # type: ignore[arg-type]
    if not source:
        raise InputError("source is empty: give at least one phase history")
    paths = [
        lies_at(place(each)) if isinstance(each, str | os.PathLike | Place) else f"dataset {id(each)}"
        for each in source
    ]
    if twice := [path for number, path in enumerate(paths) if path in paths[:number]]:
        raise InputError(f"{twice[0]} is given twice; give each collection once")
    return [member for each in source for member in _members(each)]


def _members(source: One) -> list[One]:
    """Return the phase histories of a store that holds several, or the source itself."""
    return [*(stores.collections_in(source) if isinstance(source, str | os.PathLike | Place) else ())] or [source]


def check_one_frame(histories: Sequence[stores.PhaseHistory]) -> None:
    """Check that several collections are in one frame, so that one grid is the same ground for all.

    Raises
    ------
    InputError
        If neither their `georeference` nor their attribute `frame` is the same, their ground has several heights, they
        are calibrated differently, or their carriers are farther apart than half of a band.
    """
    for first, other in pairwise(histories):
        georeferences = [Georeference.among(history.attrs) for history in (first, other)]
        frames = [history.attrs.get("frame") for history in (first, other)]
        if None not in georeferences:
            if georeferences[0] != georeferences[1]:
                raise InputError(
                    f"{first.label} and {other.label} have different georeferences ({georeferences[0]} and "
                    f"{georeferences[1]}); write both in one frame"
                )
        elif frames[0] is None or frames[0] != frames[1]:
            raise InputError(
                f"{first.label} and {other.label} are not known to be in one frame (frame {frames[0]!r} and "
                f"{frames[1]!r}); give both the same georeference, or an attribute frame of equal text"
            )
        heights = [history.collection.ground_height for history in (first, other)]
        if heights[0] != heights[1]:
            raise InputError(
                f"ground_height is {heights[0]:g} m in {first.label} and {heights[1]:g} m in {other.label}, but one "
                "image has one ground; write them with the same"
            )
        factors = [history.attrs.get(stores.CALIBRATION_FACTOR) for history in (first, other)]
        if factors[0] != factors[1]:
            raise InputError(
                f"{stores.CALIBRATION_FACTOR} is {factors[0]} in {first.label} and {factors[1]} in {other.label}, but "
                "one image has one; multiply the samples of one by the root of what they differ by"
            )
        bands = [history.collection.centred() for history in (first, other)]
        if abs(bands[0].carrier - bands[1].carrier) > min(band.bandwidth for band in bands) / 2:
            raise InputError(
                f"carrier_frequency is {bands[0].carrier:.12g} Hz in {first.label} and {bands[1].carrier:.12g} Hz in "
                f"{other.label}, but one image has one carrier; focus each alone"
            )


def collections_of(source: Source, ground_height: float | None, *, terrain: object) -> list[Collection]:
    """Return the collections of scenes or phase histories, centred; several phase histories are of one frame."""
    sources = sources_of(source)
    scenes = [each for each in sources if is_scene(each)]
    stored = [history_of(each) for each in sources if not is_scene(each)]
    if scenes and stored:
        raise InputError(
            f"{scenes[0]} is a scene among phase histories, whose frames nothing compares; plan it alone, or "
            "simulate it first"
        )
    if scenes and ground_height is not None:
        raise InputError(
            f"--ground-height is given for {scenes[0]}, a scene on z = 0; simulate it first, or leave it out"
        )
    histories = on_ground(stored, ground_height, terrain=terrain)
    check_one_frame(histories)
    return [collection_of(each) for each in [*scenes, *histories]]


def is_scene(source: One) -> bool:
    """Tell whether a source is a scene: a TOML file, or the name of a shipped one if nothing lies there."""
    text = str(source) if isinstance(source, str | Path) else ""
    if text.endswith(".toml") or not text or os.path.exists(text):
        return text.endswith(".toml")
    from blocksar.simulation import shipped_scenes

    return text in shipped_scenes()


def history_of(source: One) -> stores.PhaseHistory:
    """Open the phase history that a path names, or that a dataset is.

    Raises
    ------
    InputError
        If there is none, or it departs from the contract.
    """
    if isinstance(source, stores.PhaseHistory):
        return source
    if isinstance(source, str | os.PathLike | Place):
        if several := stores.collections_in(source):
            raise InputError(
                f"{place(source)} holds {len(several)} phase histories, and one is needed here; give one of them, such "
                f"as {several[0]}"
            )
        try:
            return stores.open_phase_history(source)
        except InputError as error:
            from blocksar.application.arguments import mistaken  # only where something is wrong

            if (better := mistaken(source)) is None:
                raise
            raise (MissingInput if isinstance(error, MissingInput) else InputError)(better) from None
    if is_dataset(source):
        return stores.history_of(source)
    what = f"{type(source).__module__.partition('.')[0]}.{type(source).__name__}".removeprefix("builtins.")
    raise InputError(
        f"source is a {what}; give the path of a phase history, or a dataset, which blocksar.collection builds from "
        "arrays"
    )


def on_ground(histories: Sequence[stores.PhaseHistory], height: Any, *, terrain: object) -> list[stores.PhaseHistory]:
    """Put phase histories over the plane at a height that the user gives, m; None: at that of the stores.

    Raises
    ------
    InputError
        If it is no finite number, not below the antenna, or a terrain is given as well.
    """
    if height is None:
        return list(histories)
    if isinstance(height, bool) or not isinstance(height, int | float | np.number) or not np.isfinite(height):
        raise InputError(f"--ground-height is {quoted(height)}; give a finite number of m, such as 30")
    if terrain is not None:
        raise InputError(
            f"--ground-height {height:g} is given together with --terrain, which has heights; leave one out"
        )
    return [history.on_ground(float(height)) for history in histories]


def channels_of(source: Source) -> tuple[str, ...]:
    """Names of the channels of phase histories that are paths or datasets; none of others."""
    first = sources_of(source)[0]
    if isinstance(first, stores.PhaseHistory) or is_scene(first):
        return ()
    if not is_dataset(first) and not (place(first) / "channel").exists():  # sooner known than by opening the store
        return ()
    return history_of(first).channels


def control_points(
    control: Location | Sequence[Target] | None,
    source: Source,
    ground_height: float | None = None,
    *,
    used: bool = True,
) -> tuple[Target, ...]:
    """Read control points in the frame of a phase history, from a file or a list of targets; none by default.

    Without heights they lie at `ground_height`, m, by default that of the phase history.

    Raises
    ------
    InputError
        If there are none in the file, or they are not `used`.
    """
    if control is None:
        return ()
    if not used:
        raise InputError("control is given without autofocus, which alone uses it; give both, or leave it out")
    from blocksar.application.target_files import TargetFrame, targets_of  # with SciPy, slow to load

    history = history_of(sources_of(source)[0])
    level = history.collection.ground_height if ground_height is None else ground_height
    frame = TargetFrame(Georeference.among(history.attrs), level)
    found = tuple(targets_of(control, {}, frame))
    if not found:
        raise InputError(f"control {control} names no points; give some, or leave it out")
    return found


def is_dataset(source: object) -> bool:
    """Tell whether something is a dataset of xarray."""
    xarray = sys.modules.get("xarray")  # who has a dataset has loaded it
    return xarray is not None and isinstance(source, xarray.Dataset)
