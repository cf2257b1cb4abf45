"""The steering of the beam, from the polynomials of centre of dwell and dwell time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import FloatArray
from blocksar.collection.beam import turned_near
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.ingestion.cphd.files import CphdFile, child_of, library, numbers_of, text_of
from blocksar.ingestion.cphd.vectors import Pulses

FULL_DWELL = 0.95  # share of the collection from which a target counts as always lit
BEAM_TOLERANCE = 0.03  # of a dwell, to which the centre of dwell must depend on yaw alone


class _Beam(NamedTuple):
    azimuth: FloatArray  # (n_pulse,) rad; NaN if not steered
    width: float | None  # rad
    message: str


def fit_beam(file: CphdFile, pulses: Pulses, frame: Georeference, position: FloatArray) -> _Beam:
    """Fit the beam-centre yaw to the polynomials of centre of dwell and dwell time, where they determine one.

    The store's beam lights a target while |yaw - beam_azimuth| <= beam_width / 2, so that the centre of dwell depends
    only on the target's yaw about the nadir at t = 0. If that holds over the image area, beam_azimuth is the yaw as a
    polynomial of the centre of dwell, continued to the ends of the collection.
    """
    unsteered = np.full(pulses.time.size, np.nan)
    try:
        area, cod, dwell = _dwells(file)
    except InputError as error:
        return _Beam(unsteered, None, f"beam not steered: dwell polynomials cannot be used ({error})")
    moment = pulses.reference_time
    whole = moment[-1] - moment[0]
    if dwell.min() >= FULL_DWELL * whole:
        return _Beam(unsteered, None, "beam not steered: the whole image area is lit all the time")
    ground = frame.from_ecef(area)
    nadir = position[position.shape[0] // 2, :2]
    yaw = np.arctan2(ground[:, 1] - nadir[1], ground[:, 0] - nadir[0])
    turn = turned_near(yaw, float(yaw[0]))
    although = "beam not steered, although targets are lit for part of the time only: "
    if np.ptp(cod) < 0.05 * dwell.mean():
        return _Beam(unsteered, None, f"{although}the image area's centre of dwell hardly changes")
    scale = 2 / np.ptp(cod)
    u, ends = (cod - cod.mean()) * scale, (moment - cod.mean()) * scale
    fit, misfit = _fit_yaw(u, turn)
    rate = abs(float(np.ptp(polynomial.polyval(u, fit)) / np.ptp(cod)))
    late = misfit / max(rate, 1e-30)
    half = dwell / 2 * scale
    widths = np.abs(polynomial.polyval(u + half, fit) - polynomial.polyval(u - half, fit))
    azimuth = polynomial.polyval(ends, fit)
    steps = np.diff(azimuth)
    if late > BEAM_TOLERANCE * dwell.mean() or np.ptp(widths) > 4 * BEAM_TOLERANCE * widths.mean():
        return _Beam(
            unsteered, None,
            f"{although}centre of dwell and dwell do not depend on yaw alone (the centre deviates by {late:.3g} s, "
            f"of a dwell of {dwell.mean():.3g} s, the width by {np.ptp(widths) / widths.mean():.2g} of itself): "
            "amplitudes are low",
        )  # fmt: skip
    if not ((steps >= 0).all() or (steps <= 0).all()) or not np.abs(steps).max() <= widths.mean() < np.pi:
        return _Beam(unsteered, None, f"{although}the beam's yaw would reverse within the collection")
    degrees = np.degrees([azimuth[0], azimuth[-1], widths.mean()])
    return _Beam(
        np.asarray(azimuth), float(widths.mean()),
        f"beam steered from yaw {degrees[0]:.2f} to {degrees[1]:.2f} degrees, {degrees[2]:.2f} degrees wide, from the "
        f"dwell polynomials (accurate to {late:.2g} s)",
    )  # fmt: skip


def _fit_yaw(u: FloatArray, yaw: FloatArray) -> tuple[FloatArray, float]:
    """Polynomial of yaw in scaled time, of the lowest order that fits about as well as the next; its misfit, rad."""
    fits: list[tuple[FloatArray, float]] = []
    for order in range(1, 6):
        fit = polynomial.polyfit(u, yaw, order)
        fits.append((np.asarray(fit, np.float64), float(np.abs(polynomial.polyval(u, fit) - yaw).max())))
        if len(fits) > 1 and fits[-1][1] > fits[-2][1] / 4:
            return fits[-2]
    return fits[-1]


def _dwells(file: CphdFile) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of the image area, (n, 3) m Earth-centred, with their centre of dwell and dwell, (n,) s."""
    sarkit, root = library(), file.root
    parameters = child_of(root, f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']", "Channel/Parameters")
    if (parameters.findtext("{*}DwellTimes/{*}UseDTA") or "").strip() in ("true", "1"):
        raise InputError("the channel's dwell times are an array, not polynomials")
    tables = []
    for kind in ("COD", "Dwell"):
        name = text_of(parameters, f"DwellTimes/{kind}Id")
        if "'" in name:
            raise InputError(f"DwellTimes/{kind}Id is {name!r}")
        node = child_of(root, f"{{*}}Dwell/{{*}}{kind}Time[{{*}}Identifier='{name}']", f"Dwell/{kind}Time")
        tables.append(_polynomial(child_of(node, f"{{*}}{kind}TimePoly", f"{kind}TimePoly")))
    own = parameters.find("{*}ImageArea")
    x, y = _area_points(own if own is not None else child_of(root, "{*}SceneCoordinates/{*}ImageArea", "ImageArea"))
    cod, dwell = (polynomial.polyval2d(x, y, table) for table in tables)
    if not (np.isfinite(cod).all() and np.isfinite(dwell).all() and dwell.min() > 0):
        raise InputError("they are not finite and above 0 over the image area")
    ecef = np.asarray(sarkit.iac_to_ecf(file.tree, np.stack([x, y], axis=1)))
    return ecef, np.asarray(cod), np.asarray(dwell)


def _polynomial(node: Any) -> FloatArray:
    """Coefficients of a polynomial in two variables, (order1 + 1, order2 + 1)."""
    orders = [node.get(f"order{axis}", "") for axis in (1, 2)]
    if not all(text.isascii() and text.isdigit() and int(text) <= 32 for text in orders):
        raise InputError(f"a polynomial has the orders {orders}, but 0 to 32 are possible")
    table = np.zeros([int(text) + 1 for text in orders])
    for coefficient in node.findall("{*}Coef"):
        table[int(coefficient.get("exponent1")), int(coefficient.get("exponent2"))] = float(coefficient.text)
    return table


def _area_points(node: Any) -> tuple[FloatArray, FloatArray]:
    """x and y of points all over the image area, m."""
    (x1, y1), (x2, y2) = (numbers_of(node, corner, "XY") for corner in ("X1Y1", "X2Y2"))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(x1, x2, 33), np.linspace(y1, y2, 33)))
    outline = node.find("{*}Polygon")
    if outline is None:
        return x, y
    corners = sorted(outline.findall("{*}Vertex"), key=lambda vertex: int(vertex.get("index")))
    if not 3 <= len(corners) <= 10_000:
        raise InputError(f"the image area's polygon has {len(corners)} corners")
    polygon = np.array([[float(corner.findtext(f"{{*}}{axis}")) for axis in "XY"] for corner in corners])
    inside = np.zeros(x.size, bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return np.concatenate([x[inside], polygon[:, 0]]), np.concatenate([y[inside], polygon[:, 1]])
