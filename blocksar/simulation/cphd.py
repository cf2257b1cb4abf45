"""Simulation of a scene into a CPHD 1.1.0 file: FX domain, SGN -1, CF8 (see `ingestion.cphd` for the format)."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.chunks import TILE
from blocksar.collection.beam import full_dwell_yaw
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.cphd import NAMESPACE, library
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace, replacing_file
from blocksar.progress.listening import Callback
from blocksar.simulation.phase_history import sampler
from blocksar.simulation.scene import RANGE_GUARD, Scene, next_smooth_even
from blocksar.version import __version__

if TYPE_CHECKING:
    from types import ModuleType

ROWS = TILE[0]  # pulses in memory at a time
VECTOR = {  # per-vector parameters: format, and size in words of 8 bytes
    **dict.fromkeys(("TxTime",), ("F8", 1)),
    **dict.fromkeys(("TxPos", "TxVel"), ("X=F8;Y=F8;Z=F8;", 3)),
    **dict.fromkeys(("RcvTime",), ("F8", 1)),
    **dict.fromkeys(("RcvPos", "RcvVel", "SRPPos"), ("X=F8;Y=F8;Z=F8;", 3)),
    **dict.fromkeys(("aFDOP", "aFRR1", "aFRR2", "FX1", "FX2", "TOA1", "TOA2", "TDTropoSRP", "SC0", "SCSS"), ("F8", 1)),
    "SIGNAL": ("I8", 1),
}
OVERSAMPLING = 1.2  # ratio of the window to the lit ranges, as the standard asks
ORIGIN = (39.78, -84.1, 300.0)  # default latitude and longitude in degrees, and height in m
START = "2000-01-01T00:00:00.000000Z"  # time of a simulated collection


def simulate(
    scene: Scene | str | os.PathLike[str],
    out: Location,
    *,
    origin: tuple[float, float, float] = ORIGIN,
    threads: int = 1,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Path:
    """Simulate a scene into a CPHD 1.1.0 file, chunk of pulses by chunk: FX domain, SGN -1, CF8.

    The scene centre becomes IARP and SRP. The axes x and y point east and north there; the ground is the horizontal
    plane through it. Signals are referenced to the SRP, whatever the scene file states; the frequencies are spaced so
    that the lit ranges fill 1 / 1.2 of the window, as the standard asks. A lost pulse has SIGNAL = 0. A steered
    beam is described by the polynomials of centre of dwell and dwell time, over the sector that is lit for a whole
    dwell.

    Parameters
    ----------
    scene : Scene, or path of a scene file, or name of a shipped scene
    out : path
        The file to write.
    origin : (latitude, longitude, height)
        Position of the scene centre: degrees, and m above the WGS 84 ellipsoid.
    threads : int
        Number of threads; the samples do not depend on it.
    overwrite : bool
        Replace an existing CPHD file.
    progress : callable (done, total)
        Called after each chunk with the numbers of finished pulses and of all pulses.

    Raises
    ------
    InputError
        If the scene or the origin is wrong, or `out` exists and overwrite is False.
    """
    sarkit = library()
    if threads < 1:
        raise InputError(f"threads = {threads}: must be at least 1")
    latitude, longitude, height = origin
    if not (abs(latitude) <= 89.9 and abs(longitude) <= 180 and abs(height) < 1e5):
        raise InputError(
            f"origin is {origin}: give a latitude within 89.9 degrees, a longitude within 180, and a height in m"
        )
    where = _free_file(out, overwrite=overwrite)
    scene = _about_centre(scene if isinstance(scene, Scene) else Scene.read(os.fspath(scene)))
    collection, toa = _oversampled(scene)
    frame = Georeference(latitude=latitude, longitude=longitude, height=height)
    vectors, tree = _metadata(sarkit, scene, collection, frame, toa)
    samples = sampler(scene, collection, threads=threads)
    try:
        where.parent.mkdir(parents=True, exist_ok=True)
        with replacing_file(where) as part, open(part, "w+b") as file:
            sarkit.Writer(file, sarkit.Metadata(xmltree=tree)).write_pvp("1", vectors)
            file.seek(0)
            file.seek(int(sarkit.read_file_header(file)[1]["SIGNAL_BLOCK_BYTE_OFFSET"]))
            for first in range(0, collection.n_pulse, ROWS):
                pulses = slice(first, min(first + ROWS, collection.n_pulse))
                block = samples(pulses)
                block[vectors["SIGNAL"][pulses] == 0] = 0
                file.write(block.astype(">c8").data)
                if progress is not None:
                    progress(pulses.stop, collection.n_pulse)
    except OSError as error:
        raise InputError(
            f"{where} cannot be written ({error.strerror or error}); choose another place, or make room or permission"
        ) from error
    return where


def _free_file(out: Location, *, overwrite: bool) -> Path:
    """Return the path to write to; raise an InputError if something there may not be replaced."""
    where = place(out)
    if not isinstance(where, LocalPlace):
        raise InputError(f"{where} is in an object store, where CPHD files are not written; give the path of a file")
    path = where.path
    if os.path.lexists(path):
        if not overwrite:
            raise InputError(f"{path} exists; choose another name, or have it overwritten (--overwrite)")
        is_cphd = path.is_file()
        if is_cphd:
            with open(path, "rb") as file:
                is_cphd = file.read(5) == b"CPHD/"
        if not is_cphd:
            raise InputError(
                f"{path} exists and is no CPHD file, so it is not overwritten; remove it, or choose another name"
            )
    return path


def _about_centre(scene: Scene) -> Scene:
    """Return the scene with its signals referenced to its centre."""
    copy = scene.model_copy(update={"area": scene.area.model_copy(update={"reference_range": "scene_centre"})})
    for name in set(vars(copy)) - set(Scene.model_fields):
        vars(copy).pop(name)  # remove cached values that depend on the old reference
    return copy


def _oversampled(scene: Scene) -> tuple[Collection, float]:
    """Return the scene's collection with the same band on finer frequencies, and half the extent of lit delays, s."""
    collection = scene.collection()
    lit = 1 / (RANGE_GUARD * collection.range_frequency_step)
    n = next_smooth_even(int(np.ceil(OVERSAMPLING * lit * collection.bandwidth)))
    middle = float(collection.range_frequency[0] + collection.range_frequency[-1]) / 2
    grid = middle + (np.arange(n) - (n - 1) / 2) * (collection.bandwidth / n)
    return Collection(**{**collection.as_dict(), "range_frequency": grid}), lit / 2


def _metadata(
    sarkit: ModuleType, scene: Scene, collection: Collection, frame: Georeference, toa: float
) -> tuple[NDArray[Any], Any]:
    """Return the per-vector parameters and the XML tree."""
    from lxml import etree

    lost = scene.dropped_pulses()
    time = collection.time - collection.time[0]
    local = collection.antenna_position - scene.centre
    delay = 2 * np.linalg.norm(local, axis=1) / SPEED_OF_LIGHT
    step, first = collection.range_frequency_step, collection.carrier + collection.range_frequency[0]
    band = (first - step / 2, first + (collection.n_range_frequency - 0.5) * step)
    area, cod, dwell = _lit_area(scene, collection, time + delay / 2)
    root = etree.Element(f"{{{NAMESPACE}1.1.0}}CPHD", nsmap={None: f"{NAMESPACE}1.1.0"})
    _build(root, _collection_id(scene))
    _build(root, {
        "Global": {
            "DomainType": "FX", "SGN": "-1",
            "Timeline": {"CollectionStart": START, "TxTime1": time[0], "TxTime2": time[-1]},
            "FxBand": {"FxMin": band[0], "FxMax": band[1]},
            "TOASwath": {"TOAMin": -toa, "TOAMax": toa},
        },
        "SceneCoordinates": _scene_coordinates(frame, area, SPEED_OF_LIGHT / (4 * collection.bandwidth)),
        "Data": {
            "SignalArrayFormat": "CF8", "NumBytesPVP": 8 * sum(size for _, size in VECTOR.values()),
            "NumCPHDChannels": 1,
            "Channel": {
                "Identifier": "1", "NumVectors": collection.n_pulse, "NumSamples": collection.n_range_frequency,
                "SignalArrayByteOffset": 0, "PVPArrayByteOffset": 0,
            },
            "NumSupportArrays": 0,
        },
        "Channel": {
            "RefChId": "1", "FXFixedCPHD": True, "TOAFixedCPHD": True, "SRPFixedCPHD": True,
            "Parameters": {
                "Identifier": "1", "RefVectorIndex": collection.n_pulse // 2,
                "FXFixed": True, "TOAFixed": True, "SRPFixed": True, "SignalNormal": not lost.size,
                "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": "UNSPECIFIED"},
                "FxC": (band[0] + band[1]) / 2, "FxBW": band[1] - band[0], "TOASaved": 2 * toa,
                "DwellTimes": {"CODId": "1", "DwellId": "1"},
            },
        },
        "PVP": _vector_layout(),
        "Dwell": {
            "NumCODTimes": 1, "CODTime": {"Identifier": "1", "CODTimePoly": _polynomial_element(cod)},
            "NumDwellTimes": 1, "DwellTime": {"Identifier": "1", "DwellTimePoly": _polynomial_element(dwell)},
        },
    })  # fmt: skip
    tree = root.getroottree()
    vectors = np.zeros(collection.n_pulse, sarkit.get_pvp_dtype(tree))
    vectors["TxTime"], vectors["RcvTime"] = time, time + delay
    vectors["TxPos"] = vectors["RcvPos"] = frame.to_ecef(local)
    velocity = Geometry(collection=collection).track.velocity(collection.time)
    vectors["TxVel"] = vectors["RcvVel"] = velocity @ frame.axes
    vectors["SRPPos"] = frame.origin
    vectors["FX1"], vectors["FX2"] = band
    vectors["TOA1"], vectors["TOA2"] = -toa, toa
    vectors["SC0"], vectors["SCSS"] = first, step
    vectors["SIGNAL"] = 1
    vectors["SIGNAL"][lost] = 0
    root.append(sarkit.compute_reference_geometry(tree, vectors))
    application = {"Application": f"blocksar {__version__}", "DateTime": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"}
    _build(root, {"ProductInfo": {"CreationInfo": application}})
    return vectors, tree


def _collection_id(scene: Scene) -> dict[str, Any]:
    return {
        "CollectionID": {
            "CollectorName": "blocksar", "CoreName": scene.name or "scene", "CollectType": "MONOSTATIC",
            "RadarMode": {"ModeType": "SPOTLIGHT" if scene.beam is None else "DYNAMIC STRIPMAP"},
            "Classification": "UNCLASSIFIED", "ReleaseInfo": "UNRESTRICTED",
        }
    }  # fmt: skip


def _vector_layout() -> dict[str, Any]:
    layout, offset = {}, 0
    for name, (form, size) in VECTOR.items():
        layout[name] = {"Offset": offset, "Size": size, "Format": form}
        offset += size
    return layout


def _scene_coordinates(frame: Georeference, area: FloatArray, spacing: float) -> dict[str, Any]:
    """Return the ground plane, image area and grid; `area` (n, 2) is a clockwise polygon, m."""
    low, high = area.min(axis=0), area.max(axis=0)
    corners = np.array([[low[0], low[1], 0], [low[0], high[1], 0], [high[0], high[1], 0], [high[0], low[1], 0]])
    degrees = frame.to_geodetic(corners)
    lines, columns = (max(int(np.ceil(width / spacing)), 1) for width in high - low)
    return {
        "EarthModel": "WGS_84",
        "IARP": {
            "ECF": _xyz(frame.origin), "LLH": {"Lat": frame.latitude, "Lon": frame.longitude, "HAE": frame.height},
        },
        "ReferenceSurface": {"Planar": {"uIAX": _xyz(frame.axes[0]), "uIAY": _xyz(frame.axes[1])}},
        "ImageArea": {
            "X1Y1": _xyz(low), "X2Y2": _xyz(high),
            "Polygon": ({"size": len(area)}, {"Vertex": [({"index": i + 1}, _xyz(p)) for i, p in enumerate(area)]}),
        },
        "ImageAreaCornerPoints": {
            "IACP": [({"index": i + 1}, {"Lat": p[0], "Lon": p[1]}) for i, p in enumerate(degrees)]
        },
        "ImageGrid": {
            "IARPLocation": {"Line": -low[0] / spacing - 0.5, "Sample": -low[1] / spacing - 0.5},
            "IAXExtent": {"LineSpacing": spacing, "FirstLine": 0, "NumLines": lines},
            "IAYExtent": {"SampleSpacing": spacing, "FirstSample": 0, "NumSamples": columns},
        },
    }  # fmt: skip


def _xyz(vector: FloatArray) -> dict[str, Any]:
    return dict(zip("XYZ", vector.tolist(), strict=False))


def _polynomial_element(table: FloatArray) -> tuple[dict[str, Any], dict[str, Any]]:
    used = [({"exponent1": i, "exponent2": j}, table[i, j]) for i, j in zip(*np.nonzero(table), strict=True)]
    zero: list[Any] = [({"exponent1": 0, "exponent2": 0}, 0.0)]
    return {"order1": table.shape[0] - 1, "order2": table.shape[1] - 1}, {"Coef": used or zero}


def _build(parent: Any, content: Any) -> None:
    """Add children {name: content} to an XML element: a list gives several; a pair is attributes and content."""
    if not isinstance(content, dict):
        parent.text = str(content).lower() if isinstance(content, bool) else str(content)
        return
    namespace = parent.tag.partition("}")[0]
    for name, item in content.items():
        for entry in item if isinstance(item, list) else [item]:
            attributes, inner = entry if isinstance(entry, tuple) else ({}, entry)
            node = parent.makeelement(f"{namespace}}}{name}", {key: str(value) for key, value in attributes.items()})
            parent.append(node)
            _build(node, inner)


def _lit_area(scene: Scene, collection: Collection, moment: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the image area, a clockwise polygon (n, 2), m, and polynomials of centre of dwell and dwell time, s.

    `moment` (n_pulse,) is the reference time, s. For a steered beam the area is the sector that is lit for a whole
    dwell, or the sector that is always lit if the beam turns by less than its width.
    """
    near, far = scene.area.swath
    whole = np.full((1, 1), (moment[0] + moment[-1]) / 2), np.full((1, 1), moment[-1] - moment[0])
    if collection.has_axis:
        raise InputError(
            "beam.mode describes a beam about the antenna's axis, which is not written to CPHD files; simulate a "
            "store, or give start_deg and stop_deg"
        )
    if collection.beam_width is None:
        ends = np.stack([np.stack(scene.ground_point(r, scene.centre_yaw)) for r in (near, far)]) - scene.centre[:2]
        half = float(np.linalg.norm(ends, axis=1).max())
        return half * np.array([[-1.0, -1], [-1, 1], [1, 1], [1, -1]]), *whole
    beam, width = collection.beam_azimuth, collection.beam_width
    low, high = full_dwell_yaw(collection)
    always = low >= high
    low, high = min(low, high), max(low, high)
    inset = 1e-3 * (high - low)
    yaw = np.linspace(low + inset, high - inset, 17)
    arcs = [np.stack(scene.ground_point(r, y), axis=-1) - scene.centre[:2] for r, y in ((near, yaw), (far, yaw[::-1]))]
    area = np.concatenate(arcs)
    following = np.roll(area, -1, axis=0)
    if np.sum(area[:, 0] * following[:, 1] - area[:, 1] * following[:, 0]) > 0:
        area = area[::-1]
    if always:
        return area, *whole
    x, y = (axis.ravel() - c for axis, c in zip(
        scene.ground_point(np.linspace(near, far, 9)[:, None], np.linspace(low, high, 65)), scene.centre, strict=False
    ))  # fmt: skip
    yaw = np.tile(np.linspace(low, high, 65), 9)
    order = np.argsort(beam, kind="stable")
    begin, end = (np.interp(yaw + side * width / 2, beam[order], moment[order]) for side in (-1, 1))
    return area, _fit_polynomial(x, y, (begin + end) / 2), _fit_polynomial(x, y, np.abs(end - begin))


def _fit_polynomial(x: FloatArray, y: FloatArray, values: FloatArray, order: int = 6) -> FloatArray:
    """Return coefficients of x^i y^j, i + j <= order, (order + 1, order + 1), by least squares."""
    scale = float(max(np.abs(x).max(), np.abs(y).max()))
    i, j = np.nonzero(np.add.outer(np.arange(order + 1), np.arange(order + 1)) <= order)
    scaled = np.linalg.lstsq((x[:, None] / scale) ** i * (y[:, None] / scale) ** j, values, rcond=None)[0]
    table = np.zeros((order + 1, order + 1))
    table[i, j] = scaled / scale ** (i + j)
    return table
