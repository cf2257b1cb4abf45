"""Writing a detected image and its metadata as one SIDD file, which is a NITF file."""

from __future__ import annotations

import os

import numpy as np

from blocksar.collection.georeference import Georeference
from blocksar.errors import library_for
from blocksar.places import Location
from blocksar.places.local import temporary_name
from blocksar.products.collect import about_segments, ascii_text, security_mark
from blocksar.products.pixels import Pixels
from blocksar.products.sidd.metadata import Grid, build_metadata, grid_of
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback


def write(
    pixels: Pixels, frame: Georeference, out: Location, *, overwrite: bool = False, progress: Callback | None = None
) -> list[str]:
    """Write pixels, whole numbers of dB in 8 bits, as one SIDD file, holding one strip of them at a time.

    Returns
    -------
    list of str
        Notes for the user: grid, range, and how well the polynomials fit.

    Raises
    ------
    InputError
        If the image has no covered pixel, its ground lies where no map is, NITF does not know its classification,
        sarkit is not installed, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    with library_for("SIDD needs", "formats"):
        from sarkit import sidd as sksidd
    grid, source = grid_of(pixels, frame), pixels.source
    metadata = build_metadata(grid)
    security = sksidd.NitfSecurityFields(clas=security_mark(source))
    nitf = sksidd.NitfMetadata(
        file_header_part=sksidd.NitfFileHeaderPart(
            ostaid="blocksar", ftitle=ascii_text(source.title, 80), security=security
        ),
        images=[
            sksidd.NitfProductImageMetadata(
                xmltree=metadata.tree,
                im_subheader_part=sksidd.NitfImSubheaderPart(security=security),
                de_subheader_part=sksidd.NitfDeSubheaderPart(security=security),
            )
        ],
    )
    size = grid.shape[0] * grid.shape[1]
    with replacing(out, overwrite=overwrite, room=2 * size) as part:
        plain = temporary_name(part, "part")
        try:
            # Rows of the file may be columns of the image, which is read by rows.
            file = np.memmap(plain, np.uint8, "w+", shape=grid.shape)
            _fill(grid, file, progress or (lambda done, total: None))
            with open(part, "wb") as nitf_file, sksidd.NitfWriter(nitf_file, nitf) as writer:
                writer.write_image(0, file)
            del file
        finally:
            if os.path.exists(plain):
                os.unlink(plain)
    low, high = pixels.limits
    scale = f"8 bits: 1 is {low:g} dB, 255 is {high:g} dB, 0 is not covered"
    return [*about_segments(source, "a SIDD", "track and centre of aperture"), *metadata.notes, scale]


def _fill(grid: Grid, file: np.memmap[tuple[int, int], np.dtype[np.uint8]], progress: Callback) -> None:
    """Fill the file's array."""
    upright, raster = grid.upright(file), grid.raster
    strips = list(raster.strips())
    for done, rows in enumerate(strips, 1):
        upright[rows] = raster.coded(raster.measured(rows))
        progress(done, len(strips))
