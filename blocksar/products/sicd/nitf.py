"""Writing an image and its metadata as one SICD file, which is a NITF file."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from blocksar.errors import InputError, library_for
from blocksar.places import Location
from blocksar.products.sicd.layout import Layout
from blocksar.products.sicd.metadata import ascii_text, build_metadata, classification
from blocksar.products.sicd.plane_image import PlaneImage
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun

MAX_BYTES = 10**10 - 2  # of one NITF image segment
# The letter in NITF headers by the first words of a classification.
MARKS = {"TOP SECRET": "T", "SECRET": "S", "CONFIDENTIAL": "C", "RESTRICTED": "R", "UNCLASSIFIED": "U"}


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
    frame, notes = source.placed("a SICD"), _about_segments(source)
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
    security = sksicd.NitfSecurityFields(clas=_security_mark(source))
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


def _about_segments(source: FinishedRun) -> list[str]:
    """State that the metadata are those of one segment of several, and how much of the image they do not describe."""
    if not source.segments:
        return []
    counts = np.zeros(len(source.segments), np.int64)
    for rows in source.strips(0):
        blocks, number = np.unique(source.read_block(rows, slice(None)), return_counts=True)
        for block, pixels in zip(blocks.tolist(), number, strict=True):
            if block >= 0:
                counts[source.segment_of(block)] += pixels
    own = source.segments.index(source.geometry)
    if counts[own] == (total := counts.sum()):
        return []
    of, share = source.record.segments[own], 100 * (1 - counts[own] / total)
    pulses = "" if of.pulses is None else f", pulses {of.pulses[0]} .. {of.pulses[1] - 1}"
    return [
        f"note: track, centre of aperture and spatial frequencies are those of {of.path}{pulses}, and not those of "
        f"{share:.3g} % of the covered pixels, which come from others; a SICD has one track"
    ]


def _write_pixels(source: FinishedRun, layout: Layout, file: BinaryIO, progress: Callback) -> None:
    """Write all rows in the file's order: big-endian, real and imaginary parts interleaved, zero where not covered."""
    axis = layout.row_axis
    strips = list(source.strips(axis))[:: int(layout.row.sum())]
    for done, strip in enumerate(strips, 1):
        values = source.read(*((strip, slice(None)) if axis == 0 else (slice(None), strip)))
        values = layout.reorder(values)
        file.write(np.nan_to_num(values, nan=0.0, copy=True).astype(">c8", order="C").data)
        progress(done, len(strips))


def _security_mark(source: FinishedRun) -> str:
    """The letter for the classification in NITF headers.

    Raises
    ------
    InputError
        If NITF has none.
    """
    text = classification(source)
    for word, letter in MARKS.items():
        if text.upper().startswith(word):
            return letter
    raise InputError(
        f"the classification of {source.image} is {text!r}, and NITF knows only those that begin with "
        f"{', '.join(MARKS)}; correct the phase history's attribute classification, and focus it again"
    )
