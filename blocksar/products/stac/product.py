"""A STAC item as a product of `export`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from blocksar.options import Option

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback


def parse_files(files: Any) -> tuple[str, ...]:
    """Read names of files: a text with commas between them, or several.

    Examples
    --------
    >>> parse_files("image.tif, image.nitf")
    ('image.tif', 'image.nitf')
    """
    several = files.split(",") if isinstance(files, str) else files if isinstance(files, Iterable) else (files,)
    return tuple(name for each in several if (name := str(each).strip()))


@dataclass(frozen=True, kw_only=True)
class STACOptions:
    """Options of an item: the files that were exported of the run."""

    assets: Annotated[
        tuple[str, ...] | None,
        Option(
            "Exported files, assets of the item beside image.zarr.",
            metavar="FILE,FILE",
            default="none",
            read=parse_files,
        ),
    ] = None


class STAC:
    """Place, time, radar and processing of a run, and where its files are; see `item`."""

    summary = "Describe the run and what was exported of it as a STAC item.\n\nThe run must be georeferenced."
    endings = (".json",)
    options = STACOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: STACOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.stac import item
        from blocksar.products.writing import opened

        source, said = opened(run, channel)
        whole = run if channel is None else source.folder
        lines = item.write(source, whole, out, options.assets or (), overwrite=overwrite)
        progress(1, 1)
        return [*(said if channel else ()), *lines]
