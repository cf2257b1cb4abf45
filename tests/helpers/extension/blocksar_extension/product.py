"""A ground overlay in KML: the image as a picture over the four corners of its ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from blocksar.errors import InputError
from blocksar.options import Option

KML_TEXT = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><GroundOverlay>
<color>{alpha:02x}ffffff</color><Icon><href>{picture}</href></Icon>
<gx:LatLonQuad><coordinates>{corners}</coordinates></gx:LatLonQuad>
</GroundOverlay></kml>
"""


def read_share(value: Any) -> float:
    try:
        share = float(value)
    except (TypeError, ValueError):
        share = -1.0
    if not 0 <= share <= 1:
        raise InputError(f"opacity = {value!r}: give a number from 0 to 1")
    return share


@dataclass(frozen=True, kw_only=True)
class KMLOptions:
    opacity: Annotated[float, Option("Of the picture, from 0 to 1.", metavar="SHARE", read=read_share)] = 1.0


class KML:
    summary = "Lay the image over the Earth, as a KML file.\n\nA picture is written beside it."
    endings = (".kml",)
    options = KMLOptions

    @staticmethod
    def write(
        run: Any, out: Any, options: KMLOptions, *, channel: str | None, overwrite: bool, progress: Any
    ) -> list[str]:
        import numpy as np
        from matplotlib.image import imsave

        from blocksar.products.pictures.overview import overview, reader_of, stretch
        from blocksar.products.writing import opened, replacing

        source, said = opened(run, channel)
        frame, picture = source.placed("a KML"), f"{out}.png"
        reduced = overview(reader_of(source, progress), source.x, source.y, max_pixels=1000, looks="mean")
        with np.errstate(divide="ignore"):
            decibel = 10 * np.log10(reduced.power)
        low, high = stretch(decibel)
        (west, east), (south, north) = reduced.x_edges[[0, -1]], reduced.y_edges[[0, -1]]
        ring = np.array([(west, south), (east, south), (east, north), (west, north)])
        places = frame.to_geodetic(np.column_stack([ring, np.full(4, source.ground_height)]))
        corners = " ".join(f"{longitude:.8f},{latitude:.8f}" for latitude, longitude, _ in places)
        alpha = round(255 * options.opacity)
        with replacing(picture, overwrite=overwrite) as drawn, replacing(out, overwrite=overwrite) as text:
            imsave(drawn, decibel[::-1], vmin=low, vmax=high, cmap="gray", format="png")
            Path(text).write_text(KML_TEXT.format(alpha=alpha, picture=Path(picture).name, corners=corners))
        return [*said, f"black is {low:.1f} dB, white is {high:.1f} dB"]
