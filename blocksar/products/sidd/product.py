"""SIDD as a product of `export`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from blocksar.products.options import Crop, Decibels, Looks, decibels

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback


@dataclass(frozen=True, kw_only=True)
class SIDDOptions:
    """Options of a SIDD: which part, how smooth, and over which range."""

    looks: Looks = None
    range: Annotated[Decibels | None, decibels("the 8 bits")] = None
    crop: Crop = None


class SIDD:
    """The detected image, see `nitf`."""

    summary = (
        "Write the detected image, on the plane or on its terrain, as a SIDD file.\n\nThe run must be georeferenced."
    )
    endings = (".nitf", ".ntf", ".nsf")
    options = SIDDOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: SIDDOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.pixels import pixels_of
        from blocksar.products.sidd import nitf
        from blocksar.products.writing import opened

        source, said = opened(run, channel, options.crop)
        looks = (1, 1) if options.looks is None else options.looks
        frame = source.placed("a SIDD")
        pixels = pixels_of(source, content="db", looks=looks, scale="uint8", limits=options.range)
        return [*said, *nitf.write(pixels, frame, out, overwrite=overwrite, progress=progress)]
