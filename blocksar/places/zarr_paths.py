"""Places as zarr paths. This module loads zarr, which takes 0.1 to 0.3 s: `Place.zarr_path` does so on use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import zarr
from zarr.storage import LocalStore, ObjectStore, StorePath

if TYPE_CHECKING:
    from obstore.store import S3Store

FILES_AT_ONCE = 2  # chunks in flight per process: zarr's default of 10 is up to 1.7x slower, for copies of buffers

zarr.config.set({"async.concurrency": FILES_AT_ONCE})


def of_folder(path: Path) -> StorePath:
    """Convert a folder to a zarr path, not via text, in which '://' and '::' would mean URLs."""
    return StorePath(LocalStore(path))


def of_objects(bucket: S3Store, key: str) -> StorePath:
    """Convert a key of a bucket to a zarr path."""
    return StorePath(ObjectStore(bucket), key)
