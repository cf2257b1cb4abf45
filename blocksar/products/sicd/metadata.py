"""SICD metadata: the XML tree that describes an image."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial as power

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.products.collect import ascii_text, classification, collect_start, polarization, radar_mode
from blocksar.products.sicd.layout import (
    FIT_POINTS,
    Layout,
    Support,
    central_pixel,
    cut_weights,
    cut_width,
    find_support,
    lay_out,
    lines_of_sight,
    lit_times,
    sample_pixels,
    valid_data,
)
from blocksar.products.sicd.plane_image import PlaneImage, Poly2D, arp_polynomial, fit_poly2d
from blocksar.runs.finished import Coverage, FinishedRun
from blocksar.runs.track import ATTRIBUTE
from blocksar.version import __version__

if TYPE_CHECKING:
    from lxml.etree import _ElementTree as ElementTree


NAMESPACE = "urn:SICD:1.3.0"
TIME_ACCURACY = 1e-3  # of a dwell, that TimeCOAPoly may be off
EXACTLY = 1e-9  # s, that it may be off the polynomial by which pixels of a terrain are laid on the plane
BAND_ACCURACY = 1e-2  # of the bandwidth, that DeltaKCOAPoly may be off
NOISE_ACCURACY = 0.1  # dB, that NoisePoly may be off
WEIGHTS = 65  # samples of WgtFunct
NEAR_ZERO = 1e-12  # degrees: sarkit 1.8 writes no NITF header of a corner on the equator or the meridian of Greenwich


class Metadata(NamedTuple):
    """The XML tree, the layout of the pixels that it describes, and notes for the user."""

    tree: ElementTree
    layout: Layout
    notes: list[str]


def build_metadata(source: FinishedRun, frame: Georeference) -> Metadata:
    """Build the XML tree of an image whose scene lies at `frame`.

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
    if (level := _noise_level(source, layout, scp_pixel)) is not None:
        sicd["Radiometric"] = {"NoiseLevel": {"NoiseLevelType": "ABSOLUTE", "NoisePoly": level.coefficients}}
        notes.append(f"NoisePoly is of order {len(level.coefficients) - 1} and at most {level.error:.2g} dB off")
    return Metadata(root.getroottree(), layout, notes)


def _grid(
    source: FinishedRun,
    frame: Georeference,
    layout: Layout,
    coverage: Coverage,
    vertices: Any,
    scp_pixel: Any,
    support: Support,
) -> tuple[dict[str, Any], list[str]]:
    """The Grid branch, and notes on the fit of its polynomials."""
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
    """Middles of the lit times of points (n, 3), s; whether they are lit; how exactly to follow them, s (0: not so)."""
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
    """The Row or Col branch without its unit vector, and how well DeltaKCOAPoly fits.

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
    """WgtType and WgtFunct of a direction; none of an image without a weighting and an antenna's pattern.

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
    """The power of the noise in a pixel, dB, over m from the scene centre point; None if it is not known."""
    found = source.noise_levels(FIT_POINTS)
    if found is None:
        return None
    x, y, noise = found
    offset = np.stack([x, y], axis=1) - layout.point(*scp_pixel.astype(np.float64))[:2]
    return fit_poly2d(offset @ layout.row, offset @ layout.column, 10 * np.log10(noise), NOISE_ACCURACY)


def _extent(delta: FloatArray, corners: FloatArray, width: float, spacing: float) -> tuple[float, float]:
    """DeltaK1 and DeltaK2, by the standard's rule: from the vertices of ValidData; the whole band if it wraps."""
    at_corners = np.asarray(power.polyval2d(corners[:, 0], corners[:, 1], delta))
    low, high = float(at_corners.min()) - width / 2, float(at_corners.max()) + width / 2
    if low < -0.5 / spacing or high > 0.5 / spacing:
        return -0.5 / spacing, 0.5 / spacing
    return low, high


def _axis_name(direction: FloatArray) -> str:
    """+x, -x, +y or -y."""
    return ("+" if direction.sum() > 0 else "-") + ("x" if direction[0] else "y")


def _timeline(geometry: Geometry, start: datetime) -> dict[str, Any]:
    """The Timeline branch."""
    collection = geometry.collection
    duration = collection.n_pulse / collection.prf
    pulses = {"TStart": 0.0, "TEnd": duration, "IPPStart": 0, "IPPEnd": collection.n_pulse - 1}
    return {
        "CollectStart": start,
        "CollectDuration": duration,
        "IPP": {"@size": 1, "Set": [{"@index": 1, **pulses, "IPPPoly": np.array([0.0, collection.prf])}]},
    }


def _collection_info(source: FinishedRun, centre_of_aperture: FloatArray) -> dict[str, Any]:
    """The CollectionInfo branch."""
    collection = source.collection
    return {
        "CollectorName": ascii_text(str(source.attrs.get("collector") or "unknown"), 80),
        "CoreName": ascii_text(f"{source.title} {source.record.identity[:8]}".strip(), 80),
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": radar_mode(collection, one_aperture=centre_of_aperture.size == 1)},
        "Classification": classification(source),
    }


def _set_radar(sicd: Any, source: FinishedRun) -> None:
    """Set the branches RadarCollection and ImageFormation."""
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
        "TEndProc": collection.n_pulse / collection.prf,
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
