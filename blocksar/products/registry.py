"""Registry of products for `export`: those of the package, and those that other packages add as entry points."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

from blocksar.errors import InputError, printable
from blocksar.options import options_of
from blocksar.plugins import Registry

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback

REPORT = "report", (".html", ".htm")  # no product, but a file that a user names, too
# Endings of formats that the package does not write.
OTHERS = (".jpg", ".jpeg", ".gif", ".webp", ".svg", ".pdf", ".csv", ".zarr", ".nc", ".h5", ".toml")


class Product(Protocol):
    """Interface of a product: a kind of file made from a finished run.

    Its module is imported for every help, so it imports what is slow to load inside `write`.

    Attributes
    ----------
    summary : str
        What is written, in a line for the list of products. More may follow an empty line, for the product's own help.
    endings : tuple of str
        Of its files' names, such as (".tif", ".tiff"), the usual one first.
    options : type
        A frozen dataclass, whose fields are the options; see `blocksar.options`.
    """

    @property
    def summary(self) -> str: ...
    @property
    def endings(self) -> tuple[str, ...]: ...
    @property
    def options(self) -> type: ...

    def write(
        self, run: Place, out: Location, options: Any, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; `products.writing.opened` opens the image, and `products.writing.replacing` the file.

        Parameters
        ----------
        run : Place
            Folder of a run, perhaps of several channels.
        out : path
            As the user gave it.
        options : object
            Of the type `options`.
        channel : str, optional
            The one to take of a run of several.
        overwrite : bool
            Whether what stands at `out` may be replaced.
        progress : callable
            Takes the number of finished parts and of all.

        Returns
        -------
        list of str
            Lines for the user about what was written.

        Raises
        ------
        InputError
            If the run does not suit, an option is wrong, or `out` cannot be written.
        ProcessingError
            If writing fails.
        """
        ...


def _check(product: Product) -> None:
    """Check that a product has all attributes that writing needs."""
    options_of(product.options)
    if not (product.summary and product.endings and callable(product.write)):
        raise TypeError("a product has a summary, endings and a function to write it")


PRODUCTS: Registry[Product] = Registry(
    "blocksar.products",
    "product",
    {
        "sicd": "blocksar.products.exports:SICD",
        "sidd": "blocksar.products.exports:SIDD",
        "geotiff": "blocksar.products.exports:GeoTIFF",
        "png": "blocksar.products.exports:PNG",
        "stac": "blocksar.products.exports:STAC",
    },
    _check,
)


def check_ending(kind: str, name: str) -> None:
    """Refuse a file name with the ending of another format; unknown endings are accepted.

    Parameters
    ----------
    kind : str
        A product, or "report".
    name : str

    Raises
    ------
    InputError
        If the ending is that of another kind of file.
    """
    endings = REPORT[1] if kind == REPORT[0] else PRODUCTS.get(kind).endings
    ending = os.path.splitext(name)[1].lower()
    if not ending or ending in endings:
        return
    other = next((each for each, taken in _endings() if ending in taken), None)
    if other or ending in OTHERS:
        owner = f"which is that of {other}" if other else "which is that of another kind of file"
        raise InputError(
            f"{printable(name)} ends in {ending}, {owner}; give {kind} a name that ends in {' or '.join(endings)}"
        )


def _endings() -> Iterator[tuple[str, tuple[str, ...]]]:
    yield REPORT
    yield from ((name, product.endings) for name, product in PRODUCTS.sound())
