"""A run's folder: what lies in it, who may write it, and which of its receipts are trusted.

Every unit of work (a column group of the spectrum, the patch of a block, some chunks of the mosaic) leaves a receipt
once its data are written: what it wrote, region by region, with checksums. A receipt is trusted if it is of this very
run (settings, input, format, division into blocks: its `identity`) and the data on disk still have those checksums.
That is all the state there is: no scheduler and no memory of an earlier process matters to a run that goes on.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.places.local import LocalPlace, is_temporary
from blocksar.places.place import Held, Place
from blocksar.runs.receipts import Run, Written

FORMAT = 4  # of run folders: a run of another format is not resumed
OWN = (
    "run.json",
    "collection.zarr",
    "spectrum.zarr",
    "compressed.zarr",
    "image.zarr",
    "patches",
    "receipts",
    "scratch",
    "quality.json",
    "report.html",
    "mosaic.png",
    "contours.png",
)
TEMPORARY = ("receipts", "compressed.zarr", "scratch")  # of those, what a finished run needs no more
LEFT_ALONE = ("phase_history.zarr",)  # may stand in a new run's folder: `demo` puts its input there
LOCK, ASIDE = "run.lock", ".replaced"
FINISHED, UNFINISHED = "finished", "unfinished"


# ---------------------------------------------------------------- who may write


@contextmanager
def claimed(folder: Place) -> Iterator[None]:
    """The only writer of a folder, which is made if need be.

    Raises
    ------
    InputError
        If another run has it, or the folder cannot be written.
    """
    with ExitStack() as held:
        try:
            if isinstance(folder, LocalPlace):
                held.callback(_remove_empty, [p for p in (folder.path, *folder.path.parents) if not os.path.lexists(p)])
                os.makedirs(folder, exist_ok=True)
            held.enter_context((folder / LOCK).lock())
        except Held as owner:
            raise InputError(
                f"{folder} is being written by {owner}; wait until that run has ended, or choose another --out"
            ) from None
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise ProcessingError(f"{folder} cannot be written ({error.strerror})") from error
            raise InputError(
                f"{folder} cannot be written ({error.strerror or error}); choose another --out, or make it writable"
            ) from error
        yield


def _remove_empty(folders: Iterable[Path]) -> None:
    """Those that were made in vain."""
    for path in folders:
        with suppress(OSError):
            path.rmdir()


# ---------------------------------------------------------------- what is there


def existing(folder: Place, settings: Mapping[str, Any], fingerprint: str, *, overwrite: bool) -> dict[str, Any] | None:
    """The record of a run in this folder that may be resumed or is finished; None where a new one may begin.

    Raises
    ------
    InputError
        If the folder holds something else, or a run with other settings or another input, and `overwrite` is False.
    """
    if isinstance(folder, LocalPlace) and folder.exists() and not folder.path.is_dir():
        raise InputError(f"{folder} is not a folder; choose another --out")
    names = _names(folder)
    if "run.json" not in names:
        foreign = [name for name in names if name not in (*LEFT_ALONE, LOCK, ASIDE) and not is_temporary(name)]
        if foreign:
            raise InputError(f"{folder} exists and holds no run of blocksar (but {foreign[0]}); choose another --out")
        return None
    if overwrite:
        return None
    try:
        record = stores.read_json(folder / "run.json")
        stored = record["settings"]
        different = {name: stored.get(name) for name in settings if stored.get(name) != settings[name]}
        form, known = record["format"], record["input"]["fingerprint"]
        divided = record["plan"]["blocks"], record["plan"]["parts"]
        sound = record["status"] in (FINISHED, UNFINISHED) and all(n is None or n >= 1 for n in divided)
    except (InputError, KeyError, TypeError, AttributeError):
        sound = False
    if not sound:
        raise InputError(f"{folder / 'run.json'} cannot be read; use --overwrite, or choose another --out")
    if form != FORMAT:
        why = f"format {form!r}"
    elif different:
        why = ", ".join(f"{name} {value!r}" for name, value in different.items())
    elif known != fingerprint:
        why = "another input"
    else:
        return dict(record)
    raise InputError(
        f"{folder} holds a run with {why}, not what is asked for now; use --overwrite to replace it, or another --out"
    )


def _names(folder: Place) -> list[str]:
    try:
        return folder.names()
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror or error}); check --out") from error


def refuse_overlap(source: Place, folder: Place) -> None:
    """Neither may a run lie in its input, nor an input among what a run replaces.

    Raises
    ------
    InputError
        If so.
    """
    inside, outside = (os.path.realpath(p) if isinstance(p, LocalPlace) else str(p) for p in (source, folder))
    if f"{outside}/".startswith(f"{inside}/"):
        raise InputError(f"--out {folder} lies in the input {source}; choose another place")
    if any(f"{inside}/".startswith(f"{outside}/{name}/") for name in OWN):
        raise InputError(f"the input {source} lies among what a run in {folder} writes; choose another --out")


def clear(folder: Place) -> None:
    """Remove what runs leave, and nothing else."""
    for name in OWN:
        (folder / name).remove()


@contextmanager
def begun(folder: Place) -> Iterator[Callable[[], None]]:
    """A new run in a folder: where its input turns out to be wrong, the folder is as it was before.

    Yields the function that gives an earlier run there up, to be called once the new input has been read. In an object
    store, where nothing can be renamed, the earlier run is removed at once.
    """
    aside = folder / ASIDE
    aside.remove()
    if not isinstance(folder, LocalPlace):
        clear(folder)
    elif (folder / "run.json").exists():
        _move_own(folder, aside)
    try:
        yield aside.remove
    except InputError:
        clear(folder)
        if aside.exists():
            _move_own(aside, folder)
        raise
    finally:
        aside.remove()


def _move_own(source: Place, target: Place) -> None:
    os.makedirs(str(target), exist_ok=True)
    for name in OWN:
        with suppress(FileNotFoundError):
            os.rename(str(source / name), str(target / name))


def finish(run: Run, record: Mapping[str, Any]) -> None:
    """Call a run finished, once all that it wrote is on the disk; what only an unfinished one needs goes.

    Raises
    ------
    ProcessingError
        If it cannot be written.
    """
    try:
        run.folder.settle()
    except OSError as error:
        raise ProcessingError(f"{run.folder} cannot be written ({error.strerror or error})") from error
    stores.write_json(run.folder / "run.json", {**record, "status": FINISHED})
    tidy(run.folder)


def tidy(folder: Place) -> None:
    """Remove what is in a finished run's folder for no use: also what a process left that was killed here."""
    for name in (*TEMPORARY, ASIDE):
        (folder / name).remove()
    folder.sweep()


def scratch(folder: Place) -> str | None:
    """Where workers of our own put their temporary files; None where that is no folder, or has no name in Unicode."""
    path = str(folder / "scratch")
    return path if isinstance(folder, LocalPlace) and path.isprintable() else None


def is_tidy(folder: Place) -> bool:
    """Whether nothing is left of the work on a finished run."""
    return not {*TEMPORARY, ASIDE} & set(folder.names())


def check_finished(folder: Place, record: Mapping[str, Any]) -> None:
    """Whether a finished run still has its image: all chunks that were written, unread.

    Raises
    ------
    InputError
        If some of it is gone.
    """
    image = folder / "image.zarr"
    there = {name for name, _, _ in image.files()}
    try:
        parts = [Written.of(part) for receipt in record["receipts"] for part in receipt["written"]]
        chunks = {_chunk(image, part) for part in parts if part.store == image.name}
    except (InputError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder} is damaged ({error}); use --overwrite to focus it anew") from error
    if missing := sorted({"zarr.json", *chunks} - there):
        raise InputError(
            f"{folder} was finished, but {len(missing)} files of its image are gone (first: {missing[0]}); "
            "use --overwrite to focus it anew"
        )


def _chunk(store: Place, part: Written) -> str:
    sides = stores.chunk_shape(store, part.variable)
    cell = (str(first // side) for (first, _), side in zip(part.region, sides, strict=True))
    return "/".join((part.variable, "c", *cell))
