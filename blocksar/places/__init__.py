"""Locations of stores and runs: folders of a local file system, or prefixes in an object store (s3://bucket/prefix).

A place is only a name, like a path: creating one accesses nothing. Both kinds provide what a run needs: atomic writing
(a reader sees the old bytes or the new ones, never a mixture), listing, removal, and a lock that is free again when its
owner has died. Chunks of arrays are accessed through zarr or, on a local file system, directly as files (`stores`).

Credentials and endpoint of an object store come from the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,
AWS_SESSION_TOKEN, AWS_REGION, AWS_ENDPOINT_URL) or from the metadata service of the cloud machine.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable, WebFile

Location = str | os.PathLike[str] | Place  # as users give it: a path, the URL of an object store, or a place


def place(path: Location) -> Place:
    """Return the place that a path or an object store's URL names.

    Raises
    ------
    InputError
        If it is empty, or a URL that is not of an object store or names no bucket, or obstore, which reads it, is not
        installed.
    """
    if isinstance(path, Place):
        return path
    try:
        text = os.fspath(path)
        zero = "\0" in text
    except TypeError:  # no path, or one of bytes
        raise InputError(
            f"a path is needed, but a {type(path).__name__} was given; give a str or a pathlib.Path"
        ) from None
    if not text:
        raise InputError("a path is '', which names nothing; give the name of a file or folder")
    if zero:
        raise InputError(f"{text} is not a valid name: it contains a zero byte; remove that")
    if (url := re.fullmatch(r"s3://([^/]*)/*(.*?)/*", text, re.DOTALL)) is None:
        if re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", text):
            raise InputError(f"{text} is a URL that blocksar does not read; give a path, or s3://bucket/name")
        return LocalPlace(Path(os.path.abspath(text)))
    bucket, key = url.groups()
    if not bucket:
        raise InputError(f"{text} names no bucket; give s3://bucket/name")
    if key and any(part in ("", ".", "..") for part in key.split("/")):
        raise InputError(f"{text} is not a plain name below a bucket; leave out empty parts, '.' and '..'")
    try:
        import obstore  # noqa: F401  (only to report that it is missing)
    except ModuleNotFoundError:
        raise InputError(f"{text} needs obstore, which is not installed; install blocksar[s3]") from None
    _check_endpoint(os.environ.get("AWS_ENDPOINT_URL", ""))
    return ObjectPlace(bucket, key)


def readable(path: Location) -> Readable:
    """Return the file that a path or URL names, also one on a web server, of which only parts are read.

    Raises
    ------
    InputError
        As `place`.
    """
    if isinstance(path, str) and re.match(r"https?://[^/]+/.", path):
        return WebFile(path)
    return place(path)


def lies_at(place: Place) -> str:
    """Return the real location of a place, with links of a local file system followed."""
    return os.path.realpath(place.path) if isinstance(place, LocalPlace) else str(place)


def lies_in(inner: Place, outer: Place) -> bool:
    """Tell whether a place is another one, or lies in it."""
    return f"{lies_at(inner)}/".startswith(f"{lies_at(outer)}/")


def _check_endpoint(endpoint: str) -> None:
    """Check the address of the object store; no message repeats it, since it may hold a password."""
    try:
        parts = urlsplit(endpoint)
        good = not endpoint or (parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0)
        secret = parts.username is not None or parts.password is not None
    except ValueError:
        good, secret = False, False
    if not good or secret or not endpoint.isascii() or any(c.isspace() for c in endpoint):
        what = "holds a user name or password" if good and secret else "is no address"
        raise InputError(
            f"AWS_ENDPOINT_URL {what}; give http://host:port or https://host:port, and keys in AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY"
        )
