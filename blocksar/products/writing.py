"""Writing of a product: one local file, under a temporary name until it is complete.

A product is written in strips of whole chunks and renamed when it is complete, so there is never an incomplete product
and no process holds the whole image.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager

from blocksar.errors import InputError, ProcessingError, in_the_way, is_full, no_room
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace, flush_file, held_part, new_file
from blocksar.places.place import Place, check_room
from blocksar.products.shared_options import Box, Quantity
from blocksar.runs.finished import FinishedRun, folder_of, member_line
from blocksar.runs.record import RECORD


def opened(
    run: Place,
    channel: str | None,
    crop: Box | None = None,
    quantity: Quantity | None = None,
    calibration: float | None = None,
) -> tuple[FinishedRun, list[str]]:
    """Open a channel of a run, or a part of it, perhaps with backscatter for power; and lines that say what it is.

    Raises
    ------
    InputError
        If the run is not finished, or has no such channel, nothing of it lies in `crop`, the quantity is none, or a
        calibration is given without one.
    """
    source, said = FinishedRun.open(folder_of(run, channel)), member_line(run, channel)
    source = source if crop is None else source.cropped(*crop)
    if quantity is not None:
        from blocksar.products.backscatter import BackscatterRun, describe_factor  # loads numba

        source = BackscatterRun.of(source, quantity, calibration)
        said = [*said, f"{quantity}: {describe_factor(source.factor)}"]
    elif calibration is not None:
        raise InputError(
            f"calibration = {calibration:g} is of a quantity of backscatter; give one, such as sigma0, too"
        )
    return source, said


def refuse_parts(target: LocalPlace) -> None:
    """Refuse a file that would lie inside a zarr store, or replace the record of a run."""
    for parent in target.path.absolute().parents:
        if (parent / "zarr.json").exists():
            raise InputError(f"{target} would lie within the store {parent}; choose another name")
    if target.name == RECORD:
        raise InputError(f"{target} is the name of a run's record, and is not replaced; choose another name")


@contextmanager
def replacing(out: Location, *, overwrite: bool, room: int = 0) -> Iterator[str]:
    """Yield a temporary name for a product; it is renamed to `out` when the block ends without error.

    `room` is what it will take of the disk at least, bytes.

    The file is flushed to the disk before it is renamed. If the block raises, `out` stays as it was.

    Raises
    ------
    InputError
        If `out` exists and must not be replaced, no file can be written there, or the disk has no room for it.
    ProcessingError
        If the disk is full, or the file system fails otherwise.
    """
    target = place(out)
    if not isinstance(target, LocalPlace):
        raise InputError(
            f"{target} is no local path, and products are written only to local paths; copy the file there afterwards"
        )
    if os.path.isdir(target.path):
        raise InputError(f"{target} is a folder; give --out the name of a file")
    refuse_parts(target)
    if target.exists() and not os.path.isfile(target.path):
        raise InputError(f"{target} is no regular file, and is not replaced; choose another name")
    if target.exists() and not overwrite:
        raise in_the_way(target)
    check_room(target, room)
    try:
        os.makedirs(target.path.parent, exist_ok=True)
        # Fail now if the file cannot be written, with the same message whichever library writes it.
        with held_part(target.path, new_file) as part:
            yield part
            flush_file(part)
            os.replace(part, target.path)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); choose another name") from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{target} cannot be written ({error.strerror}); choose a shorter name") from error
        if is_full(error):
            raise no_room(target, error) from error
        raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
