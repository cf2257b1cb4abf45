"""The image of a run as a SICD file (Sensor Independent Complex Data, NGA.STND.0024, version 1.3.0), through sarkit.

One file holds the whole image on its ground plane: Grid.Type PLANE, ImagePlane GROUND, ImageFormAlgo OTHER.

Why one ground-plane image. The standard could also hold one file per block, each in its own range-Doppler grid, but its
range-Doppler grids (RGAZIM, RGZERO, INCA) define a pixel's range and Doppler by the formulas of polar format, range
migration or plain azimuth compression. A block's grid, after keystone, fitted perturbation and deramp, follows none of
these. A PLANE grid requires only what holds for a calibrated ground image: pixels are uniform points of a plane, known
in ECEF, and each has a centre of aperture, which for a steered beam depends on its yaw (TimeCOAPoly). Range and Doppler
contours, layover and height sensitivity follow from plane, time and track, and are correct wherever the track is exact.
Block seams need no treatment: every pixel was focused with its own full dwell, whichever block it lies in.
A run of several collections, or segments of a strip, has several tracks, of which the file has that in the middle of
the image; a note tells how many pixels come from others.

An image on a terrain is laid on the plane first, by equal range and Doppler (`plane_image`).

Pixels. Rows of the file run along the axis of the scene, +x, +y, -x or -y, that points most directly away from the
radar, so that shadows fall downwards; columns follow, right-handed about z. Pixels equal those of the image bit for
bit; pixels that are not covered are zero and lie outside ValidData, which bounds the covered ones.

Spatial frequencies. A target at p0 is imaged as mean exp(+4j pi (fc + f)/c (R(p) - R(p0))), with no carrier removed:
about p0 that is exp(+2j pi K . (p - p0)), K = 2 (fc + f)/c times the line of sight along row and column. So Sgn is -1,
and K is not near zero but folded into the band that the spacing SS can hold. KCtr is the multiple of 1/SS nearest to K
at the scene centre point, which is frequency zero of the samples, and DeltaKCOAPoly gives K - KCtr at the centre of
aperture all over the image. Where it leaves +-1/(2 SS) the spectrum wraps, and DeltaK1, DeltaK2 span the whole band, as
the standard requires. ImpRespBW is the extent of K along row and column at the scene centre point, ImpRespWid the -3 dB
width of the cut through a target there. The support of the aperture is not aligned with the axes, so no WgtType is
given of an image without a weighting: it would imply widths of 0.886 / ImpRespBW. Of a weighted image, or under an
antenna's pattern, WgtFunct has the weights along each cut's band, those of the pattern included, and WgtType's
parameters name the tapers along range and azimuth.

Noise. Where the noise of the samples is known, NoisePoly of Radiometric's NoiseLevel has the power of the noise in a
pixel, dB: 0 dB is that of a target of reflectivity 1.

Backscatter. Where the radar cross-section K of a target that peaks at 1 is known, RCSSFPoly is K, and SigmaZeroSFPoly
is K / A with the area A of the point response on the ground plane (`imaging.response_area`). BetaZeroSFPoly is that
over the cosine of the angle between ground plane and slant plane, and GammaZeroSFPoly over that of the incidence angle,
as SICD defines them, both at the centre of aperture. Without K they are not given: the reflectivity then has no unit.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.polynomial import polynomial as power

from blocksar import stores
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, library_for
from blocksar.imaging.response_area import AreaMap
from blocksar.places import Location
from blocksar.products.backscatter import valid_of
from blocksar.products.plane_image import PlaneImage, Poly2D, arp_polynomial, fit_poly2d
from blocksar.products.shared_metadata import (
    FIT_POINTS,
    Layout,
    Support,
    about_segments,
    ascii_text,
    central_pixel,
    classification,
    collect_start,
    cut_weights,
    cut_width,
    find_support,
    lay_out,
    lines_of_sight,
    lit_times,
    polarization,
    radar_mode,
    refuse_bistatic,
    sample_pixels,
    security_mark,
    valid_data,
)
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import Coverage, FinishedRun
from blocksar.runs.track import ATTRIBUTE
from blocksar.version import __version__

if TYPE_CHECKING:
    from lxml.etree import _ElementTree as ElementTree

# ---------------------------------------------------------------- metadata

NAMESPACE = "urn:SICD:1.3.0"
TIME_ACCURACY = 1e-3  # of a dwell, that TimeCOAPoly may be off
EXACTLY = 1e-9  # s, that it may be off the polynomial by which pixels of a terrain are laid on the plane
BAND_ACCURACY = 1e-2  # of the bandwidth, that DeltaKCOAPoly may be off
NOISE_ACCURACY = 0.1  # dB, that NoisePoly may be off
SCALE_ACCURACY = 0.01  # of their mean, that scale factors to backscatter may be off
WEIGHTS = 65  # samples of WgtFunct
NEAR_ZERO = 1e-12  # degrees: sarkit 1.8 writes no NITF header of a corner on the equator or the meridian of Greenwich


class SICDMetadata(NamedTuple):
    """The XML tree, the layout of the pixels that it describes, and notes for the user."""

    tree: ElementTree
    layout: Layout
    notes: list[str]


def build_metadata(source: FinishedRun, frame: Georeference, factor: float | None = None) -> SICDMetadata:
    """Build the XML tree of an image whose scene lies at `frame`; `factor` is the K of the backscatter, if known, m2.

    Raises
    ------
    InputError
        If the image has no covered or no lit pixel, or is too coarse for its band.
    """
    from lxml import etree
    from sarkit import sicd as sksicd

    coverage = source.coverage()
    layout = lay_out(source)
    vertices = valid_data(coverage, layout)
    scp_pixel = central_pixel(vertices)
    scp = layout.point(*scp_pixel.astype(np.float64))
    support = find_support(source.geometry, scp, source.weighting)
    grid, notes = _grid(source, frame, layout, coverage, vertices, scp_pixel, support)

    root = etree.Element(f"{{{NAMESPACE}}}SICD", nsmap={None: NAMESPACE})
    sicd: Any = sksicd.ElementWrapper(root)
    start, known = collect_start(source)
    if not known:
        notes.append("the phase history has no date, so CollectStart is 1970-01-01")
    sicd["CollectionInfo"] = _collection_info(source, grid["TimeCOAPoly"])
    sicd["ImageCreation"] = {"Application": f"blocksar {__version__}", "DateTime": datetime.now(UTC)}
    rows, columns = layout.shape
    sicd["ImageData"] = {
        "PixelType": "RE32F_IM32F", "NumRows": rows, "NumCols": columns, "FirstRow": 0, "FirstCol": 0,
        "FullImage": {"NumRows": rows, "NumCols": columns}, "SCPPixel": scp_pixel, "ValidData": vertices,
    }  # fmt: skip
    ends = np.array([[0, 0], [0, columns - 1], [rows - 1, columns - 1], [rows - 1, 0]], np.float64)
    corners = frame.to_geodetic(layout.point(*ends.T))[:, :2]
    sicd["GeoData"] = {
        "EarthModel": "WGS_84",
        "SCP": {"ECF": frame.to_ecef(scp), "LLH": frame.to_geodetic(scp)},
        "ImageCorners": np.where(corners == 0, NEAR_ZERO, corners),
        "ValidData": frame.to_geodetic(layout.point(*vertices.T.astype(np.float64)))[:, :2],
    }
    sicd["Grid"] = grid
    sicd["Timeline"] = _timeline(source.geometry, start)
    track, misfit = arp_polynomial(source.geometry, frame)
    notes.append(f"ARPPoly is of order {len(track) - 1} and at most {misfit:.2g} m off the track")
    sicd["Position"] = {"ARPPoly": track}
    _set_radar(sicd, source)
    root.append(etree.Element(f"{{{NAMESPACE}}}SCPCOA"))
    root.replace(root[-1], sksicd.compute_scp_coa(root.getroottree()))
    radiometric: dict[str, Any] = {}
    if (level := _noise_level(source, layout, scp_pixel)) is not None:
        radiometric["NoiseLevel"] = {"NoiseLevelType": "ABSOLUTE", "NoisePoly": level.coefficients}
        notes.append(f"NoisePoly is of order {len(level.coefficients) - 1} and at most {level.error:.2g} dB off")
    if factor is not None:
        scales, worst = _scale_factors(source, layout, sample_pixels(coverage, layout), scp_pixel, factor)
        radiometric |= scales
        notes.append(f"scale factors to backscatter are at most {worst:.2g} dB off")
    if radiometric:
        sicd["Radiometric"] = radiometric
    return SICDMetadata(root.getroottree(), layout, notes)


def _grid(
    source: FinishedRun,
    frame: Georeference,
    layout: Layout,
    coverage: Coverage,
    vertices: Any,
    scp_pixel: Any,
    support: Support,
) -> tuple[dict[str, Any], list[str]]:
    """Build the Grid branch, with notes on the fit of its polynomials."""
    geometry, zero = source.geometry, source.collection.time[0]
    pixels = sample_pixels(coverage, layout)
    points = layout.point(*pixels.T)
    middle, lit, known = _centres_of_aperture(source, points)
    if not lit.any():
        raise InputError(f"the beam of the collection never lights {source.image}; check collection.zarr")
    offset = (pixels[lit] - scp_pixel) * layout.spacing
    coa = fit_poly2d(offset[:, 0], offset[:, 1], middle[lit] - zero, known or TIME_ACCURACY * support.dwell)
    time = np.asarray(power.polyval2d(offset[:, 0], offset[:, 1], coa.coefficients))
    sight, error = lines_of_sight(geometry, points[lit], time + zero), coa.error
    if isinstance(source, PlaneImage):
        error += source.time_error
    notes = [
        f"rows run along {_axis_name(layout.row)}, columns along {_axis_name(layout.column)}",
        f"TimeCOAPoly is of order {len(coa.coefficients) - 1} and at most {error:.2g} s, "
        f"{100 * error / support.dwell:.2g} % of the dwell, off the middle of a pixel's lit time",
    ]
    corners = (vertices - scp_pixel) * layout.spacing
    branches: dict[str, Any] = {}
    for name, direction, spacing in zip(("Row", "Col"), (layout.row, layout.column), layout.spacing, strict=True):
        k = 2 * geometry.collection.carrier / SPEED_OF_LIGHT * (sight[:, :2] @ direction)
        band = support.frequencies @ direction
        branch, note = _direction(direction, spacing, band, support.weights, offset, k, corners)
        branch |= _weighting(source, band, support.weights)
        branches[name] = {"UVectECF": np.array([*direction, 0.0]) @ frame.axes, **branch}
        notes.append(f"{name}.DeltaKCOAPoly {note}")
    return {"ImagePlane": "GROUND", "Type": "PLANE", "TimeCOAPoly": coa.coefficients, **branches}, notes


def _centres_of_aperture(source: FinishedRun, points: FloatArray) -> tuple[FloatArray, BoolArray, float]:
    """Centres of aperture of points (n, 3), s; whether points are lit; and the accuracy of the fit, s (0: default)."""
    if isinstance(source, PlaneImage):
        return source.times(points), np.ones(len(points), bool), EXACTLY
    first, last = lit_times(source.geometry, points)
    return (first + last) / 2, first < last, 0.0


def _direction(
    direction: FloatArray,
    spacing: float,
    band: FloatArray,
    weights: FloatArray,
    offset: FloatArray,
    k: FloatArray,
    corners: FloatArray,
) -> tuple[dict[str, Any], str]:
    """Build the Row or Col branch without its unit vector, and describe the fit of DeltaKCOAPoly.

    Parameters
    ----------
    direction : (2,) float
        Along which the index grows, in x and y.
    spacing : float
        m.
    band, weights : (n,) float
        Spatial frequencies of a target at the scene centre point, cycles/m, and their weights.
    offset, corners : (m, 2), (v, 2) float
        Fitted pixels and vertices of the valid data, m from the scene centre point along row and column.
    k : (m,) float
        Spatial frequency of the fitted pixels at the carrier and their centres of aperture, cycles/m.

    Raises
    ------
    InputError
        If the spacing cannot hold the band.
    """
    width = float(np.ptp(band))
    if width * spacing > 1:
        raise InputError(
            f"the image's spacing is {spacing:.4g} m in {_axis_name(direction)[-1]}, too coarse for the band of "
            f"its targets, which SICD cannot describe; focus again on a --grid of at most {1 / width:.4g} m"
        )
    centre = round(float(band.mean()) * spacing) / spacing
    delta = fit_poly2d(offset[:, 0], offset[:, 1], k - centre, BAND_ACCURACY * width)
    low, high = _extent(delta.coefficients, corners, width, spacing)
    branch = {
        "SS": spacing,
        "ImpRespWid": cut_width(band, weights),
        "Sgn": -1,
        "ImpRespBW": width,
        "KCtr": centre,
        "DeltaK1": low,
        "DeltaK2": high,
        "DeltaKCOAPoly": delta.coefficients,
    }
    note = (
        f"is of order {len(delta.coefficients) - 1} and at most {100 * delta.error / width:.2g} % of the bandwidth off"
    )
    return branch, note


def _weighting(source: FinishedRun, band: FloatArray, weights: FloatArray) -> dict[str, Any]:
    """WgtType and WgtFunct of a direction; empty without weighting and antenna pattern.

    The tapers lie along range and azimuth, not along rows and columns, so no known window describes a cut: WgtFunct has
    the weights that the band of the cut has, and the parameters name the tapers.
    """
    weighting, patterned = source.weighting, source.collection.has_pattern
    if weighting.uniform and not patterned:
        return {}
    parameters = [("RANGE", weighting.range.text), ("AZIMUTH", weighting.azimuth.text)]
    parameters += [("PATTERN", "antenna pattern, in the samples")] if patterned else []
    return {
        "WgtType": {"WindowName": "UNKNOWN", "Parameter": parameters},
        "WgtFunct": cut_weights(band, weights, WEIGHTS),
    }


def _noise_level(source: FinishedRun, layout: Layout, scp_pixel: Any) -> Poly2D | None:
    """Polynomial of the noise power, dB, over m from the scene centre point; None if unknown."""
    found = source.noise_levels(FIT_POINTS)
    if found is None:
        return None
    x, y, noise = found
    offset = np.stack([x, y], axis=1) - layout.point(*scp_pixel.astype(np.float64))[:2]
    return fit_poly2d(offset @ layout.row, offset @ layout.column, 10 * np.log10(noise), NOISE_ACCURACY)


def _scale_factors(
    source: FinishedRun, layout: Layout, pixels: FloatArray, scp_pixel: Any, factor: float
) -> tuple[dict[str, Any], float]:
    """Polynomials of the factors from power to backscatter, over m from the scene centre point; most dB off."""
    points, geometry = layout.point(*pixels.T), source.geometry
    area = AreaMap.of(geometry, source.weighting, valid_of(source)).at(points[:, 0], points[:, 1])
    middle, lit, _ = _centres_of_aperture(source, points)
    known = lit & np.isfinite(area)
    points, area, middle = points[known], area[known], middle[known]
    sight = points - geometry.track.position(middle)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    normal = np.cross(sight, geometry.track.velocity(middle))
    cosine = np.abs(normal[:, 2]) / np.linalg.norm(normal, axis=1)
    offset = (pixels[known] - scp_pixel) * layout.spacing
    found, worst = {"RCSSFPoly": np.array([[factor]])}, 0.0
    for name, scale in (("Sigma", 1.0), ("Beta", cosine), ("Gamma", -sight[:, 2])):
        values = factor / area / scale
        poly = fit_poly2d(offset[:, 0], offset[:, 1], values, SCALE_ACCURACY * float(values.mean()))
        found[f"{name}ZeroSFPoly"] = poly.coefficients
        fitted = np.asarray(power.polyval2d(offset[:, 0], offset[:, 1], poly.coefficients))
        with np.errstate(divide="ignore"):
            worst = max(worst, float(np.abs(10 * np.log10(np.maximum(fitted, 0) / values)).max()))
    return found, worst


def _extent(delta: FloatArray, corners: FloatArray, width: float, spacing: float) -> tuple[float, float]:
    """DeltaK1 and DeltaK2 by the standard's rule from the vertices of ValidData; the whole band if it wraps."""
    at_corners = np.asarray(power.polyval2d(corners[:, 0], corners[:, 1], delta))
    low, high = float(at_corners.min()) - width / 2, float(at_corners.max()) + width / 2
    if low < -0.5 / spacing or high > 0.5 / spacing:
        return -0.5 / spacing, 0.5 / spacing
    return low, high


def _axis_name(direction: FloatArray) -> str:
    """Name of the axis that a direction points along: +x, -x, +y or -y."""
    return ("+" if direction.sum() > 0 else "-") + ("x" if direction[0] else "y")


def _timeline(geometry: Geometry, start: datetime) -> dict[str, Any]:
    """Build the Timeline branch."""
    collection = geometry.collection
    duration = collection.duration
    if not collection.pulses.even:  # the number of pulses is no polynomial of time
        return {"CollectStart": start, "CollectDuration": duration}
    pulses = {"TStart": 0.0, "TEnd": duration, "IPPStart": 0, "IPPEnd": collection.n_pulse - 1}
    return {
        "CollectStart": start,
        "CollectDuration": duration,
        "IPP": {"@size": 1, "Set": [{"@index": 1, **pulses, "IPPPoly": np.array([0.0, collection.prf])}]},
    }


def _collection_info(source: FinishedRun, centre_of_aperture: FloatArray) -> dict[str, Any]:
    """Build the CollectionInfo branch."""
    collection = source.collection
    return {
        "CollectorName": ascii_text(str(source.attrs.get("collector") or "unknown"), 80),
        "CoreName": ascii_text(f"{source.title} {source.record.identity[:8]}".strip(), 80),
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": radar_mode(collection, one_aperture=centre_of_aperture.size == 1)},
        "Classification": classification(source),
    }


def _set_radar(sicd: Any, source: FinishedRun) -> None:
    """Add the branches RadarCollection and ImageFormation."""
    collection = source.collection
    transmit, transmit_receive = polarization(source)
    half = collection.range_frequency[-1] + (collection.range_frequency[1] - collection.range_frequency[0]) / 2
    low, high = float(collection.carrier - half), float(collection.carrier + half)
    sicd["RadarCollection"] = {
        "TxFrequency": {"Min": low, "Max": high},
        "TxPolarization": transmit,
        "RcvChannels": {"@size": 1, "ChanParameters": [{"@index": 1, "TxRcvPolarization": transmit_receive}]},
    }
    sicd["ImageFormation"] = {
        "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
        "TxRcvPolarizationProc": transmit_receive,
        "TStartProc": 0.0,
        "TEndProc": collection.duration,
        "TxFrequencyProc": {"MinProc": low, "MaxProc": high},
        "ImageFormAlgo": "OTHER",
        "STBeamComp": "NO",
        "ImageBeamComp": "SV" if collection.has_pattern else "NO",  # pixels are divided by the mean of the pattern
        "AzAutofocus": "SV" if ATTRIBUTE in source.attrs else "NO",
        "RgAutofocus": "NO",
    }
    if isinstance(source, PlaneImage):
        low, high = source.terrain.limits
        what = f"focused on a terrain of z = {low:.4g} .. {high:.4g} m in the scene frame, and laid on the plane "
        how = f"z = {source.ground_height:.6g} m by equal range and Doppler at the center of aperture"
        sicd["ImageFormation"]["Processing"] = [{"Type": what + how, "Applied": True}]


# ---------------------------------------------------------------- file

MAX_BYTES = 10**10 - 2  # of one NITF image segment


def write(
    source: FinishedRun,
    out: Location,
    *,
    calibration: float | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> list[str]:
    """Write the image as one SICD file, holding one strip of pixels at a time.

    Parameters
    ----------
    calibration : float, optional
        Radar cross-section of a target that peaks at 1, m2. Default: the run's attribute.

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
    refuse_bistatic(source, "a SICD")
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
    factor = stores.calibration_of(source.attrs) if calibration is None else calibration
    metadata = build_metadata(source, frame, factor)
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
    """Write rows in the file's order: big-endian, real and imaginary parts interleaved, zero where not covered."""
    axis = layout.row_axis
    strips = list(source.strips(axis))[:: int(layout.row.sum())]
    for done, strip in enumerate(strips, 1):
        values = source.read(*((strip, slice(None)) if axis == 0 else (slice(None), strip)))
        values = layout.reorder(values)
        file.write(np.nan_to_num(values, nan=0.0, copy=True).astype(">c8", order="C").data)
        progress(done, len(strips))
