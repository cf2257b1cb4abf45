"""Writing an image and its metadata as one SICD file, which is a NITF file."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from blocksar.errors import InputError, library_for
from blocksar.places import Location
from blocksar.products.collect import about_segments, ascii_text, security_mark
from blocksar.products.sicd.layout import Layout
from blocksar.products.sicd.metadata import build_metadata
from blocksar.products.sicd.plane_image import PlaneImage
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun

MAX_BYTES = 10**10 - 2  # of one NITF image segment


def write(
    source: FinishedRun, out: Location, *, overwrite: bool = False, progress: Callback | None = None
) -> list[str]:
    """Write the image as one SICD file, holding one strip of pixels at a time.

    Returns
    -------
    list of str
        Notes for the user: orientation, and how well the polynomials fit.

    Raises
    ------
    InputError
        If the run has no georeference, its pixels are too far apart for its band, it is larger than one NITF image
        segment, NITF does not know its classification, sarkit is not installed, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    with library_for("SICD needs", "formats"):
        from sarkit import sicd as sksicd
    frame, notes = (
        source.placed("a SICD"),
        about_segments(source, "a SICD", "track, centre of aperture and spatial frequencies"),
    )
    if source.geometry.terrain is not None:
        source = PlaneImage.of(source)
        low, high = source.terrain.limits
        notes += [
            f"the ground, z = {low:.5g} .. {high:.5g} m, is laid on the plane z = {source.ground_height:.6g} m by "
            "equal range and Doppler: project pixels to their heights as SICD says"
        ]
    n_byte = 8 * source.x.size * source.y.size
    if n_byte > MAX_BYTES:
        raise InputError(
            f"the image has {n_byte / 1e9:.3g} GB, and one SICD file holds up to 10 GB; focus on a smaller --grid"
        )
    metadata = build_metadata(source, frame)
    security = sksicd.NitfSecurityFields(clas=security_mark(source))
    nitf = sksicd.NitfMetadata(
        xmltree=metadata.tree,
        file_header_part=sksicd.NitfFileHeaderPart(
            ostaid="blocksar", ftitle=ascii_text(source.title, 80), security=security
        ),
        im_subheader_part=sksicd.NitfImSubheaderPart(isorce=ascii_text(source.title, 42), security=security),
        de_subheader_part=sksicd.NitfDeSubheaderPart(security=security),
    )
    jbp = sksicd.jbp_from_nitf_metadata(nitf)
    with (
        replacing(out, overwrite=overwrite, room=n_byte) as part,
        open(part, "wb") as file,
        sksicd.NitfWriter(file, nitf, jbp),
    ):
        file.seek(jbp["ImageSegments"][0]["Data"].get_offset())
        _write_pixels(source, metadata.layout, file, progress or (lambda done, total: None))
    return [*notes, *metadata.notes]


def _write_pixels(source: FinishedRun, layout: Layout, file: BinaryIO, progress: Callback) -> None:
    """Write all rows in the file's order: big-endian, real and imaginary parts interleaved, zero where not covered."""
    axis = layout.row_axis
    strips = list(source.strips(axis))[:: int(layout.row.sum())]
    for done, strip in enumerate(strips, 1):
        values = source.read(*((strip, slice(None)) if axis == 0 else (slice(None), strip)))
        values = layout.reorder(values)
        file.write(np.nan_to_num(values, nan=0.0, copy=True).astype(">c8", order="C").data)
        progress(done, len(strips))
