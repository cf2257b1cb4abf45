"""The run folder: its contents, its lock, and the run that can be resumed in it.

Every unit of work (a column group of the spectrum, the patch of a block, some chunks of the mosaic) leaves a receipt
once its data are written: the regions that it wrote, with checksums. A receipt is valid if it belongs to the same run
(same `identity`: settings, input, format, division into blocks) and the data on disk still have those checksums.
There is no other state: a resumed run depends neither on a scheduler nor on an earlier process.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from blocksar import stores
from blocksar.errors import FolderError, InputError, ProcessingError, is_full, no_room
from blocksar.places import lies_in, place
from blocksar.places.local import LocalPlace, is_temporary
from blocksar.places.place import Held, Place
from blocksar.runs.demonstration import HISTORY
from blocksar.runs.record import RECORD, RunRecord, Written
from blocksar.texts import count
from blocksar.version import __version__

PLAN = "plan.bin"  # the plan of an unfinished run
INPUT = "input.zarr"  # the phase history of a run whose samples came from memory
# All files of a run.
OWN = (
    RECORD,
    PLAN,
    INPUT,
    "collection.zarr",
    "spectrum.zarr",
    "compressed.zarr",
    "segments",
    "gated",
    "image.zarr",
    "channels",
    "looks",
    "terrain.zarr",
    "surroundings.zarr",
    "patches",
    "receipts",
    "scratch",
    "quality.json",
    "report.html",
    "mosaic.png",
    "contours.png",
)
SCRATCH = "scratch"
DASK = "dask-scratch-space"  # all that a run has there
TRACK = "autofocus"  # the folder of the estimate of the track's error, which comes before all else
KEPT = "kept"  # the files of such an estimate
ESTIMATE = (
    RECORD,
    INPUT,
    "collection.zarr",
    "terrain.zarr",
    "compressed.zarr",
    KEPT,
    "store.zarr",
    "receipts",
    SCRATCH,
)
TEMPORARY = (PLAN, "receipts", "compressed.zarr", "gated", SCRATCH)  # files that a finished run does not need
INTERMEDIATE = ("spectrum.zarr", "patches")  # those of OWN that nothing reads once a run is finished
LEFT_ALONE = (HISTORY,)  # may lie in the folder of a new run: `demo` puts its input there
LOCK, ASIDE = "run.lock", ".replaced"
AROUND = 4  # parent folders searched for a moved input: the member's own, two more of its run, and the one around it


def member(folder: Place, name: str, dimension: str = "channel") -> Place:
    """Return the folder of a channel's or look's own run, in a run of several."""
    return folder / f"{dimension}s" / name


def find_input(folder: Place, path: str, source: Place | None = None) -> Place:
    """Find the present place of a phase history that a run was made from.

    A run may have been moved together with its input, or copied to another machine.

    Parameters
    ----------
    folder : Place
        Folder of the run, or of its channel or look.
    path : str
        Where the input was, as the record says.
    source : Place, optional
        Where the user says that it is: the store, or the folder that holds it under its name.

    Returns
    -------
    Place
        The place in `source`; else `path`, if it exists; else that of the last one or two names of `path` in the run
        folder or in one around it; else `path`. What came from memory is looked for in the run folder first.
    """
    names = path.rsplit("/", 2)[-2:]
    if source is not None:
        within = source / names[-1]
        return within if within.exists() else source
    recorded = place(path)
    if f"/{INPUT}" not in path and recorded.exists():
        return recorded
    tried = (around / tail for around in _around(folder) for tail in ("/".join(names), names[-1]))
    return next((each for each in tried if each.exists()), recorded)


def _around(folder: Place) -> Iterator[Place]:
    """Iterate over a folder and its parents."""
    text = str(folder)
    for _ in range(AROUND):
        yield place(text)
        text = text.rpartition("/")[0]
        if text in ("", "s3:/"):
            return


@contextmanager
def claim(folder: Place) -> Iterator[None]:
    """Hold the lock of a folder during the block; the folder is created if needed.

    Raises
    ------
    FolderError
        If another run holds it, or the folder cannot be written.
    ProcessingError
        If the disk is full or broken.
    """
    with ExitStack() as held:
        try:
            if isinstance(folder, LocalPlace):
                held.callback(_remove_empty, [p for p in (folder.path, *folder.path.parents) if not os.path.lexists(p)])
                os.makedirs(folder, exist_ok=True)
            held.enter_context((folder / LOCK).lock())
        except Held as owner:
            raise FolderError(
                f"{folder} is being written by {owner}; wait until that run has ended, or choose another --out"
            ) from None
        except OSError as error:
            if is_full(error):
                raise no_room(folder, error) from error
            raise FolderError(
                f"{folder} cannot be written ({error.strerror or error}); choose another --out, or make it writable"
            ) from error
        yield


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that were created and remained empty."""
    for path in folders:
        with suppress(OSError):
            path.rmdir()


def find_run(folder: Place, settings: Mapping[str, Any], fingerprint: str, *, overwrite: bool) -> RunRecord | None:
    """Return the record of the run in a folder, finished or to be resumed; None where a new one can start.

    Raises
    ------
    FolderError
        If the folder holds something else, or a run with other settings or another input, or an unfinished one of
        another version of blocksar, and `overwrite` is False.
    """
    if isinstance(folder, LocalPlace) and folder.exists() and not folder.path.is_dir():
        raise FolderError(f"{folder} is not a folder; choose another --out")
    names = _names(folder)
    refuse_links(folder)
    if RECORD not in names:
        foreign = foreign_names(folder, names)
        if "receipts" in foreign and set(foreign) <= set(OWN):
            if overwrite:
                return None
            raise FolderError(
                f"{folder} holds an unfinished run without its {RECORD}; use --overwrite to begin it again, or another "
                "--out",
                replaceable=True,
            )
        if foreign:
            raise FolderError(f"{folder} exists and holds no run of blocksar (but {foreign[0]}); choose another --out")
        return None
    if overwrite:
        return None
    record = _read_record(folder)
    if (difference := record.difference(settings, fingerprint)) is not None:
        raise FolderError(
            f"{folder} holds a run with {difference}, not what is asked for now; use --overwrite to replace it, or "
            "another --out",
            replaceable=True,
        )
    # Versions may divide the work into other units, or compute other values.
    if not record.finished and record.version != __version__:
        raise FolderError(
            f"{folder} holds an unfinished run of blocksar {record.version or 'unknown'}, which {__version__} does not "
            "resume; use --overwrite to begin it again, or another --out",
            replaceable=True,
        )
    return record


def foreign_names(folder: Place, names: Sequence[str]) -> list[str]:
    """Names in a folder without a record that neither `demo` nor a killed run has left."""
    foreign = [name for name in names if name not in (*LEFT_ALONE, LOCK, ASIDE) and not is_temporary(name)]
    if SCRATCH in foreign and _is_of_workers(folder / SCRATCH):  # killed while it was planned
        foreign.remove(SCRATCH)
    if TRACK in foreign and not foreign_to_estimate(folder / TRACK):  # killed before it was planned
        foreign.remove(TRACK)
    return foreign


def foreign_to_estimate(folder: Place) -> list[str]:
    """Names in the folder of a track's estimate, or of several, that belong to none."""
    names = _names(folder)
    own = {LOCK, *(ESTIMATE if _is_estimate(folder, names) else ())}
    foreign = [name for name in names if name not in own and not is_temporary(name)]
    if SCRATCH in foreign and _is_of_workers(folder / SCRATCH):
        foreign.remove(SCRATCH)
    return [name for name in foreign if not (_is_numbered(folder, name) and not foreign_to_estimate(folder / name))]


def _is_estimate(folder: Place, names: Sequence[str]) -> bool:
    """Tell whether a folder has the record of an estimate; an unreadable record counts as a damaged one."""
    if RECORD not in names:
        return False
    with suppress(InputError):
        record = stores.read_json(folder / RECORD)
        return isinstance(record, Mapping) and "identity" in record
    return True


def _is_numbered(folder: Place, name: str) -> bool:
    """Tell whether a name may be the folder of one collection's estimate among several."""
    inside = folder / name
    return name.isdecimal() and not (isinstance(inside, LocalPlace) and not inside.path.is_dir())


def refuse_foreign(folder: Place) -> None:
    """Refuse a folder for the estimate of a track if it holds anything else.

    Raises
    ------
    FolderError
        If something else is there.
    """
    if foreign := foreign_to_estimate(folder):
        raise FolderError(
            f"{folder / foreign[0]} is not of an estimate of the track, which is made in {folder}; move it away, or "
            "choose another --out"
        )


def clear_estimate(folder: Place) -> None:
    """Remove the files of a track's estimate from its folder, and nothing else; the record last."""
    if _is_estimate(folder, folder.names()):
        for name in reversed(ESTIMATE):
            if name != SCRATCH:
                (folder / name).remove()


def remove_estimate(folder: Place) -> None:
    """Remove the estimate of a track, or those of several collections, and their folder if nothing else is there."""
    for name in folder.names():
        if _is_numbered(folder, name):
            remove_estimate(folder / name)
    clear_estimate(folder)
    if _is_of_workers(folder / SCRATCH):
        (folder / SCRATCH).remove()
    folder.sweep()
    if set(folder.names()) <= {LOCK}:
        folder.remove()


def refuse_links(folder: Place) -> None:
    """Refuse symbolic links in place of files that a run writes: it would write elsewhere.

    Raises
    ------
    FolderError
        If something is.
    """
    if not isinstance(folder, LocalPlace):
        return
    for name in (*OWN, TRACK, LOCK, ASIDE):
        if (folder.path / name).is_symlink():
            raise FolderError(
                f"{folder / name} is a symbolic link, which a run would write through; remove it, or choose another "
                "--out"
            )


def _read_record(folder: Place) -> RunRecord:
    try:
        return RunRecord.read(folder)
    except FolderError:
        raise
    except InputError as error:  # not JSON
        raise FolderError(
            f"{folder / RECORD} cannot be read; use --overwrite, or choose another --out", replaceable=True
        ) from error


def _is_of_workers(scratch: Place) -> bool:
    """Tell whether a folder holds only temporary files of own workers."""
    return isinstance(scratch, LocalPlace) and scratch.path.is_dir() and set(_names(scratch)) <= {DASK}


def _names(folder: Place) -> list[str]:
    try:
        return folder.names()
    except OSError as error:
        raise FolderError(f"{folder} cannot be read ({error.strerror or error}); check --out") from error


def refuse_overlap(source: Place, folder: Place) -> None:
    """Check that a run does not lie in its input, nor the input among the files that the run replaces.

    Raises
    ------
    FolderError
        If it does.
    """
    if lies_in(folder, source):
        raise FolderError(f"--out {folder} lies in the input {source}; choose another place")
    if any(lies_in(source, folder / name) for name in OWN):
        raise FolderError(f"the input {source} lies among what a run in {folder} writes; choose another --out")


def clear(folder: Place) -> None:
    """Remove all files of a run and nothing else; the record last, since it marks the others as a run's."""
    for name in reversed(OWN):
        (folder / name).remove()


@contextmanager
def begin(folder: Place, *, resumed: bool = False) -> Iterator[Callable[[], None]]:
    """Begin a new run in a folder, or resume one; an InputError restores the earlier run that it replaces.

    Yields the function that removes the earlier run, to be called once the new input has been read. Until then that
    stays, also if the new run ends otherwise and is resumed. In an object store, where nothing can be renamed, it is
    removed at once.
    """
    aside = folder / ASIDE
    if not resumed:
        _put_aside(folder)
    try:
        yield partial(_remove_aside, folder)
    except InputError as error:
        if resumed and isinstance(error, FolderError):  # the input is not wrong
            raise
        if not resumed or (aside / RECORD).exists():
            clear(folder)
        if (aside / RECORD).exists():
            _move_own(aside, folder, OWN)
        aside.remove()
        raise


def is_begun(folder: Place, record: RunRecord) -> bool:
    """Tell whether a folder has this very run, unfinished: then it is resumed rather than begun again."""
    with suppress(InputError):
        there = RunRecord.read(folder)
        return not there.finished and _identifying(there) == _identifying(record)
    return False


def _identifying(record: RunRecord) -> tuple[object, ...]:
    """Fields that distinguish an unfinished run from others; with several channels or looks it has no identity yet."""
    several = record.channels, record.dimension, record.input.fingerprint
    return record.format, record.version, record.identity, several


def _put_aside(folder: Place) -> None:
    """Move an earlier run aside for a new one; an unfinished run that has itself moved one aside is removed."""
    if (folder / ASIDE / RECORD).exists():
        clear(folder)
        return
    (folder / ASIDE).remove()
    if not isinstance(folder, LocalPlace):
        clear(folder)
    elif (folder / RECORD).exists():
        # The record last: a folder without it is taken for another's.
        _move_own(folder, folder / ASIDE, reversed(OWN))


def _remove_aside(folder: Place) -> None:
    """Remove a run that was moved aside; its record first, so that a rest does not count as a run."""
    (folder / ASIDE / RECORD).remove()
    (folder / ASIDE).remove()


def _move_own(source: Place, target: Place, names: Iterable[str]) -> None:
    """Move all files of a run, in this order, to another folder of the same file system, or move none.

    Raises
    ------
    FolderError
        If one cannot be moved.
    """
    os.makedirs(str(target), exist_ok=True)
    moved: list[str] = []
    try:
        for name in names:
            if os.path.lexists(str(source / name)):
                os.rename(str(source / name), str(target / name))
                moved.append(name)
    except OSError as error:
        for done in reversed(moved):
            os.rename(str(target / done), str(source / done))
        target.remove()
        raise FolderError(
            f"{source / name} cannot be moved ({error.strerror or error}); make it writable, or choose another --out"
        ) from error


@contextmanager
def resumable() -> Iterator[None]:
    """Add to a ProcessingError in the block that the same command resumes the run."""
    try:
        yield
    except ProcessingError as error:
        if error.resumable:
            raise
        message = f"{error}; what was finished stays, the same command goes on from there"
        raise ProcessingError(message, resumable=True) from error


def finish(folder: Place, record: RunRecord) -> None:
    """Write the record of a finished run, once all its data are on the disk, and remove temporary files.

    Raises
    ------
    ProcessingError
        If it cannot be written.
    """
    try:
        folder.settle()
    except OSError as error:
        raise ProcessingError(f"{folder} cannot be written ({error.strerror or error})") from error
    record.write(folder)
    tidy(folder)


def tidy(folder: Place) -> None:
    """Remove leftovers from a finished run, including those of a killed process, as far as that is allowed."""
    for name in (*TEMPORARY, ASIDE):
        with suppress(PermissionError):
            (folder / name).remove()
    with suppress(PermissionError):
        remove_estimate(folder / TRACK)
    folder.sweep()


def discard_intermediate(folder: Place) -> None:
    """Remove the spectra and the patches of a finished run; its image stays as it is."""
    for part in (folder, *(folder / "segments" / number for number in (folder / "segments").names())):
        for name in INTERMEDIATE:
            (part / name).remove()


def scratch(folder: Place) -> str | None:
    """Return a folder for temporary files of own workers; None where there can be none that dask accepts."""
    path = str(folder / SCRATCH)
    if not isinstance(folder, LocalPlace) or not path.isprintable():
        return None
    with suppress(OSError):
        (folder / SCRATCH).remove()
        os.makedirs(path)
        return path
    return None


def is_tidy(folder: Place) -> bool:
    """Tell whether a finished run has no leftovers."""
    names = set(folder.names())
    return not {*TEMPORARY, ASIDE} & names and (TRACK not in names or bool(foreign_to_estimate(folder / TRACK)))


def check_finished(folder: Place, record: RunRecord) -> None:
    """Check that all chunks of a finished run's image exist and are not empty, without reading them.

    Raises
    ------
    FolderError
        If some are missing.
    """
    image = folder / "image.zarr"
    if not record.receipts:
        raise FolderError(f"{folder} is damaged (no receipts); use --overwrite to focus it anew", replaceable=True)
    names = {name for name, size, _ in image.files() if size}
    parts = [part for receipt in record.receipts for part in receipt.written if part.store == image.name]
    try:
        chunks = {_chunk(image, part) for part in parts}
    except (InputError, ValueError) as error:
        raise FolderError(
            f"{folder} is damaged ({error}); use --overwrite to focus it anew", replaceable=True
        ) from error
    if missing := sorted({"zarr.json", *chunks} - names):
        raise FolderError(
            f"{folder} was finished, but its image lacks the contents of {count(len(missing), 'file')} (first: "
            f"{missing[0]}); "
            "use --overwrite to focus it anew",
            replaceable=True,
        )


def check_unchanged(folder: Place, record: RunRecord, *, every: bool = False) -> None:
    """Check as `check_finished`, and read the chunks written after the record; with `every`, all of them.

    With `every`, read all of them in any case.

    Raises
    ------
    FolderError
        If some are missing, or do not have the checksums of their receipts.
    """
    check_finished(folder, record)
    image = folder / "image.zarr"
    later = {name for name, _, _ in image.files()} if every else set(image.written_after(folder / RECORD))
    changed = []
    for receipt in record.receipts if later else ():
        for part in receipt.written:
            if part.store == image.name and (chunk := _chunk(image, part)) in later:
                try:
                    values = stores.read_region(image, part.variable, tuple(slice(*span) for span in part.region))
                    same = stores.checksum(values) == part.checksum
                except (InputError, ProcessingError):  # compressed chunks have checksums of their own
                    same = False
                changed += [] if same else [chunk]
    if changed:
        raise FolderError(
            f"{folder} was finished, but its image has {count(len(set(changed)), 'file')} that changed since (first: "
            f"{min(changed)}); use --overwrite to focus it anew",
            replaceable=True,
        )


def _chunk(store: Place, part: Written) -> str:
    """Return the path of the chunk that a region begins in, relative to its store."""
    sides = stores.chunk_shape(store, part.variable)
    cell = (str(first // side) for (first, _), side in zip(part.region, sides, strict=True))
    return "/".join((part.variable, "c", *cell))
