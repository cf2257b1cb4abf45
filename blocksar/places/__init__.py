"""Where stores and runs lie: a folder of a local file system, or a prefix of an object store (s3://bucket/prefix).

A place is a name, as a path is: making one touches nothing. What both kinds can do is what a run needs: bytes that
are the old ones or the new ones and never half of either, a list of what lies below, removal, a lock that tells a
living owner from a dead one. Chunks of arrays go through zarr, or, locally, straight into files (`stores`).

Credentials and endpoint of an object store are read where its users keep them, in the environment: AWS_ACCESS_KEY_ID,
AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN, AWS_REGION, AWS_ENDPOINT_URL; or from the machine that it runs on.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place

Location = str | os.PathLike[str] | Place  # what people give: a path, the URL of an object store, or a place


def place(path: Location) -> Place:
    """A path, or the URL of an object store, as a place.

    Raises
    ------
    InputError
        If a URL names no bucket, or what reads it is not installed.
    """
    if isinstance(path, Place):
        return path
    text = os.fspath(path)
    if "\0" in text:
        raise InputError(f"{text} is no name: it has a zero byte")
    if (found := re.fullmatch(r"s3://([^/]*)/*(.*?)/*", text, re.DOTALL)) is None:
        return LocalPlace(Path(os.path.abspath(text)))
    if not found[1]:
        raise InputError(f"{text} names no bucket; give s3://bucket/name")
    if any(part in ("", ".", "..") for part in found[2].split("/")) and found[2]:
        raise InputError(f"{text} is no plain name below a bucket; leave out empty parts, '.' and '..'")
    try:
        import obstore  # noqa: F401  (asked for here, where a sentence can be made of it)
    except ModuleNotFoundError:
        raise InputError(f"{text} needs obstore, which is not installed; install blocksar[s3]") from None
    return ObjectPlace(found[1], found[2])
