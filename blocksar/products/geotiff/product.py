"""GeoTIFF as a product of `export`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from blocksar.options import Option
from blocksar.products.options import Content, Crop, Decibels, Looks, Scale, decibels

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback


@dataclass(frozen=True, kw_only=True)
class GeoTIFFOptions:
    """Options of pixels and of the map."""

    content: Annotated[
        Content | None,
        Option(
            "Pixel values, in float32, or complex64; the last four of images on a terrain.",
            metavar="amplitude, power, db, complex, height, incidence, visibility, gamma",
            default="amplitude; db with --scale",
        ),
    ] = None
    looks: Looks = None
    scale: Annotated[
        Scale | None,
        Option("Store dB as whole numbers, 0 where not covered.", metavar="uint8, uint16", default="float32"),
    ] = None
    range: Annotated[Decibels | None, decibels("--scale")] = None
    crop: Crop = None
    crs: Annotated[
        str | None,
        Option(
            "Orthorectify to this coordinate reference system.",
            metavar="EPSG:n",
            default="the scene frame's own, without resampling",
        ),
    ] = None


class GeoTIFF:
    """Pixels of the image, their power or what the ground is like there, on a map; see `cog`."""

    summary = "Write the image as a cloud-optimised GeoTIFF.\n\nThe run must be georeferenced."
    endings = (".tif", ".tiff")
    options = GeoTIFFOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: GeoTIFFOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.geotiff import cog
        from blocksar.products.pixels import pixels_of
        from blocksar.products.writing import opened

        source, said = opened(run, channel, options.crop)
        pixels = pixels_of(
            source,
            content=options.content,
            looks=(1, 1) if options.looks is None else options.looks,
            scale=options.scale,
            limits=options.range,
        )
        return [*said, *cog.write(pixels, out, crs=options.crs, overwrite=overwrite, progress=progress)]
