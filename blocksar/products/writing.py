"""What every product starts from: the image of a finished run read by strips, what of it is covered, where it lies.

A product is one file. It is written under a temporary name, in strips of whole chunks, and takes its place when it is
complete: there is no half of one, and no process holds the image.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from blocksar.errors import InputError, ProcessingError
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace, replacing_file


@contextmanager
def replacing(out: Location, *, overwrite: bool) -> Iterator[str]:
    """A temporary name for a product, which takes its place, on the disk, when the block ends well.

    Raises
    ------
    InputError
        If something stands at `out` that is not to be replaced, or no file can.
    ProcessingError
        If there is no room, or another fault of the file system.
    """
    target = place(out)
    if not isinstance(target, LocalPlace):
        raise InputError(f"{target} is no local path, and products are written to those only; copy it there afterwards")
    if target.path.is_dir():
        raise InputError(f"{target} is a folder; give --out the name of a file")
    if target.exists() and not target.path.is_file():
        raise InputError(f"{target} is no regular file, and is not replaced; choose another name")
    if target.exists() and not overwrite:
        raise InputError(f"{target} exists; choose another name, or have it overwritten (--overwrite)")
    try:
        os.makedirs(target.path.parent, exist_ok=True)
        with replacing_file(target.path) as part:
            with open(part, "xb"):
                pass  # what cannot be written is said now, and alike whatever library writes
            yield part
            descriptor = os.open(part, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); choose another name") from error
    except OSError as error:
        raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
