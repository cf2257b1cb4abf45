"""Measure impulse responses of point targets in a calibrated complex ground image.

The stored image carries the true carrier phase. About a target q, lit around t_m, it is an envelope times
exp(+4j pi fc/c (R_p(t_m) - R_q(t_m))), tens of cycles per metre on the ground, far beyond what the pixel
spacing can sample. Every measurement therefore first removes that phase, exactly and in float64. The rest is
band-limited to the wedge k(f, t) = 2 (fc + f)/c grad R(t) minus its centre, so it can be interpolated; the phase
removed at q is zero, so the value there keeps its true phase.

The response's own axes are neither x and y nor orthogonal. Its range cut runs along constant Doppler
(across the direction in which grad R turns during the dwell), its azimuth cut along constant range (across
grad R at t_m).

The ideal response of a point target is the exact back-projection of its echo alone.

With dR(t) the range of a point p less that of the target q, over the times at which both are lit,

    h(p) = integral of w_p g_q W^(2 B dR / c) exp(4j pi fc dR / c) dt / integral over p's own dwell of w_p g_p dt

W^(u) is the ideal response of the weighting over the band B (`Taper.response`), w that over the dwell, and g the
antenna's gain. On a small band and over a small turn of the line of sight h is the product of two such responses: the
wavenumbers fill a rectangle. Else they fill part of a ring, whose side lobes and widths differ: over a band of 40 % the
azimuth side lobes are -14.4 dB, and a flight through an arc of 25 degrees about a spot has side lobes of -25 dB in
range. Where the dwell is little longer than the response, the beam moves on between p and q, which widens h.

Pulses are taken as dense: the mean over them is an integral, from half an interval before the first one on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import Complex128Array, FloatArray
from blocksar.budget import SIDE_LOBE_BUDGET, WEIGHTED_SIDE_LOBE_BUDGET
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import CUT_WIDTHS, NODES, UNIFORM, Taper, Weighting
from blocksar.constants import SINC_ISLR, SINC_PSLR, SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.kernels.nonuniform import sum_phasors
from blocksar.measurement.axes import ResponseAxes, response_axes
from blocksar.measurement.response import ReadChip, Response, read_response
from blocksar.measurement.targets import Target

LEAST_NODES = 48  # over a dwell; two more for each turn of phase by which a point's range changes in it
GAP_NODES = 8  # times as many nodes over a dwell with gaps
MOMENT = 1e-9  # of the step between pulses, that what lies between two takes
STEPS = 128  # of the table of W^, per unit of u: linear between them to 1e-5


def ideal_response(
    geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, weighting: Weighting = UNIFORM
) -> Complex128Array:
    """The response h (n,) of a target of reflectivity 1 on the ground at `origin`, at ground points x, y (n,), m.

    0 where target and point are never lit together, NaN where the terrain has no height, and all NaN where it has none
    at the target, or the target is never lit.
    """
    collection, taper = geometry.collection, weighting.azimuth
    of_x, of_y, beam = np.array([origin[0]]), np.array([origin[1]]), geometry.beam
    begin, end = (float(edge[0]) for edge in beam.dwell(of_x, of_y))
    if not (begin < end and np.isfinite(geometry.on_ground(of_x, of_y)).all()):
        return np.full(x.shape, np.nan + 0j)
    own_begin, own_end = beam.dwell(x, y)
    known = np.isfinite(geometry.on_ground(x, y)).all(axis=-1)
    both = known & (np.minimum(own_end, end) > np.maximum(own_begin, begin))
    x, y, own_begin, own_end = x[both], y[both], own_begin[both], own_end[both]
    first, last = np.maximum(own_begin, begin), np.minimum(own_end, end)

    plain = taper.uniform and not collection.has_pattern
    swing = _swing(geometry, origin, x, y, np.linspace(begin, end, 17))
    count = max(LEAST_NODES + 2 * int(np.ceil(swing)), 0 if plain else NODES)
    nodes, weights = solvers.gauss_legendre(count)
    recorded, elapsed = _recorded_time(collection)
    if recorded.size:  # the integrand has steps at gaps
        nodes = (2 * np.arange(GAP_NODES * count) + 1) / (GAP_NODES * count) - 1
        weights = np.full(nodes.size, 2 / nodes.size)
        first, last, own_begin, own_end = (np.interp(t, elapsed, recorded) for t in (first, last, own_begin, own_end))

    def over(first: FloatArray, last: FloatArray) -> FloatArray:
        """Times (n, nodes) between those (n,)."""
        time = np.asarray((last + first)[:, None] / 2 + (last - first)[:, None] / 2 * nodes)
        return np.interp(time, recorded, elapsed) if recorded.size else time

    time = over(first, last)
    offset = _offset(geometry, origin, x, y, time)
    made = _over_band(weighting.range, collection, offset)
    whole = own_end - own_begin
    if not plain:
        made *= beam.at_times(time, lambda pulses: beam.weights(x[:, None], y[:, None], pulses, taper))
        made *= beam.at_times(time, lambda pulses: beam.gain(of_x, of_y, pulses))
        counted = beam.dwell_weight(x[:, None], y[:, None], over(own_begin, own_end), taper)
        whole = whole * (counted @ weights) / 2
    turned = (made * np.exp(4j * np.pi * collection.carrier / SPEED_OF_LIGHT * offset)) @ weights / 2
    response = np.where(known, 0j, np.nan + 0j)
    response[both] = turned * (last - first) / np.where(whole > 0, whole, np.inf)
    return response


def _offset(
    geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, time: FloatArray
) -> FloatArray:
    """Difference of range dR (m) of points (n,) from that of the origin, at times (n, m) or (m,)."""
    point, target = geometry.on_ground(x, y)[:, None, :], geometry.on_ground(*(np.array(at) for at in origin))
    return geometry.distance(point, time) - geometry.distance(target, time)


def _swing(geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, time: FloatArray) -> float:
    """Largest change, cycles at the top of the band, of the phase of dR of points (n,) over times (m,)."""
    collection = geometry.collection
    top = collection.carrier + collection.bandwidth / 2
    return float(2 * top / SPEED_OF_LIGHT * np.ptp(_offset(geometry, origin, x, y, time), axis=1).max(initial=0.0))


def _recorded_time(collection: Collection) -> tuple[FloatArray, FloatArray]:
    """Time that pulses stand for up to the borders of each, and slow time there, (2 n_pulse,), s; empty if uniform."""
    sampling, time = collection.pulses, collection.time
    if sampling.even:
        return np.zeros(0), np.zeros(0)
    before, after = sampling.halves(time)
    elapsed = np.stack([time - before, time + after], axis=1).ravel()
    gone = np.diff(elapsed, prepend=elapsed[0])
    gone[2::2] = MOMENT * sampling.step  # between pulses, where time has to go on
    return np.cumsum(gone), elapsed


def _over_band(taper: Taper, collection: Collection, offset: FloatArray) -> FloatArray | Complex128Array:
    """W^(2 B dR / c)."""
    u = 2 * collection.bandwidth / SPEED_OF_LIGHT * offset
    if not collection.band.even:
        weights = taper.weights(collection.range_frequency, collection.band)
        turns = (collection.range_frequency - (collection.range_frequency[[0, -1]]).mean()) / collection.bandwidth
        most = int(np.abs(u).max(initial=0.0) * STEPS) + 2
        known = np.arange(-most, most + 1) / STEPS
        values = sum_phasors((weights / weights.sum()).astype(np.complex128), turns / STEPS, known.size)
        return np.asarray(np.interp(u, known, values))
    if taper.uniform:
        return np.asarray(np.sinc(u))
    known = np.arange(int(np.abs(u).max(initial=0.0) * STEPS) + 2) / STEPS
    return np.interp(np.abs(u), known, taper.response(known))


SAMPLES_PER_WIDTH = 64  # of a cut: resolves the height of a side lobe to 0.001 dB
BEYOND = 0.5  # widths that a cut reaches beyond what is measured

DEFINITIONS = f"""\
Range cut: along constant Doppler, in slant range. Azimuth cut: along constant range, on the ground.
Both are straight, pass through the peak and are in general not at right angles.
Nominal width: that of a rectangle of wavenumbers, {SINC_WIDTH:.4f} / bandwidth along the cut, in range c / (2 B), in
azimuth from the line-of-sight rotation over the target's own dwell; of a weighted image, the width that its tapers
have over that bandwidth, and in azimuth with a known antenna pattern.
IRW: width of the main lobe at half power (-3 dB).
PSLR: highest side lobe outside the first minima on either side of the peak and within {CUT_WIDTHS:g} nominal widths
of it, relative to the peak, power in dB.
ISLR: energy outside the first minima and within {CUT_WIDTHS:g} nominal widths on either side of the peak, over the
energy between the first minima, along the cut, in dB.
Theory: the same figures of the exact back-projection of the target's echo alone, with its own track, beam, band and
weights. On a small band and rotation, unweighted: the nominal width, {SINC_PSLR:.2f} dB and {SINC_ISLR:.1f} dB.
Position error: peak of the magnitude minus the true position, in x and y. Value: complex image interpolated at
the true position, divided by the target's reflectivity (ideal 1 + 0j). Full dwell: the beam swept wholly over
the target. Covered: no pixel is missing in what was measured; figures that touch missing pixels are NaN.
Crowded: a cut has a side lobe above the peak, so that another peak is near, and the figures are not the target's
alone: they are NaN but for the value."""


class PointResponse(NamedTuple):
    """The figures of one target, as defined in `DEFINITIONS`. NaN where a figure could not be measured.

    PSLR and ISLR in dB; range widths in m of slant range, azimuth widths in m along the cut; positions and
    errors in m of the scene frame; value relative to the reflectivity, ideally 1 + 0j.
    """

    name: str
    x: float
    y: float
    range_pslr: float
    range_islr: float
    range_irw: float
    range_irw_theory: float
    azimuth_pslr: float
    azimuth_islr: float
    azimuth_irw: float
    azimuth_irw_theory: float
    error_x: float
    error_y: float
    value: complex
    full_dwell: bool
    covered: bool
    range_pslr_theory: float = SINC_PSLR
    range_islr_theory: float = SINC_ISLR
    azimuth_pslr_theory: float = SINC_PSLR
    azimuth_islr_theory: float = SINC_ISLR
    crowded: bool = False


Figure = Callable[[PointResponse], float]
# The ideal value of a figure, and the measured one.
_FIGURES: dict[str, tuple[Figure, Figure]] = {
    "range_pslr": (lambda r: r.range_pslr_theory, lambda r: r.range_pslr),
    "range_islr": (lambda r: r.range_islr_theory, lambda r: r.range_islr),
    "range_irw_over_theory": (lambda r: 1.0, lambda r: r.range_irw / r.range_irw_theory),
    "azimuth_pslr": (lambda r: r.azimuth_pslr_theory, lambda r: r.azimuth_pslr),
    "azimuth_islr": (lambda r: r.azimuth_islr_theory, lambda r: r.azimuth_islr),
    "azimuth_irw_over_theory": (lambda r: 1.0, lambda r: r.azimuth_irw / r.azimuth_irw_theory),
    "error_x": (lambda r: 0.0, lambda r: r.error_x),
    "error_y": (lambda r: 0.0, lambda r: r.error_y),
    "amplitude": (lambda r: 1.0, lambda r: abs(r.value)),
    "phase": (lambda r: 0.0, lambda r: float(np.angle(r.value))),
}


class Cuts(NamedTuple):
    """The two cuts through the peak: offsets in m from it, complex response (NaN = missing)."""

    range_offset: FloatArray
    range_profile: Complex128Array
    azimuth_offset: FloatArray
    azimuth_profile: Complex128Array


def cuts(response: Response) -> Cuts:
    """Sample the range cut (offsets in slant range, growing away from the radar) and the azimuth cut.

    Both reach half a nominal width beyond the measured part (`BEYOND`), with 64 samples per width.
    """
    axes, peak = response.axes, response.peak
    along_range, along_azimuth = _offsets(axes)
    if not np.isfinite(peak).all():
        missing = np.full(along_range.shape, np.nan + 0j)
        return Cuts(along_range, missing, along_azimuth, missing.copy())
    zero = np.zeros(1)
    return Cuts(
        range_offset=along_range,
        range_profile=response.at_own(peak, along_range, zero),
        azimuth_offset=along_azimuth,
        azimuth_profile=response.at_own(peak, zero, along_azimuth),
    )


def ideal_cuts(geometry: Geometry, target: Target, axes: ResponseAxes) -> Cuts:
    """The cuts through the ideal response of a target, sampled as those of `cuts`."""
    along_range, along_azimuth = _offsets(axes)
    zero, origin = np.zeros(along_range.shape), (target.x, target.y)
    profiles = [
        ideal_response(geometry, origin, target.x + dx, target.y + dy, axes.weighting)
        for dx, dy in (axes.ground_offset(along_range, zero), axes.ground_offset(zero, along_azimuth))
    ]
    return Cuts(along_range, profiles[0], along_azimuth, profiles[1])


def _offsets(axes: ResponseAxes) -> tuple[FloatArray, FloatArray]:
    """Offsets of the samples of both cuts, m."""
    n = int((CUT_WIDTHS + BEYOND) * SAMPLES_PER_WIDTH)
    widths = np.arange(-n, n + 1) / SAMPLES_PER_WIDTH
    return widths * axes.range_width, widths * axes.azimuth_width


class ResponseGrid(NamedTuple):
    """A response about its peak on its own axes: offsets in m, complex values (n_azimuth, n_range)."""

    range_offset: FloatArray
    azimuth_offset: FloatArray
    values: Complex128Array


def response_grid(response: Response, *, widths: float = 5.0, samples_per_width: int = 12) -> ResponseGrid:
    """Resample a response on its own axes, `widths` nominal widths on either side of the peak (for contours)."""
    axes = response.axes
    n = int(widths * samples_per_width)
    u = np.arange(-n, n + 1) / samples_per_width
    along_range, along_azimuth = u * axes.range_width, u * axes.azimuth_width
    if np.isfinite(response.peak).all():
        values = response.at_own(response.peak, along_range[None, :], along_azimuth[:, None])
    else:
        values = np.full((u.size, u.size), np.nan + 0j)
    return ResponseGrid(range_offset=along_range, azimuth_offset=along_azimuth, values=values)


class ProfileQuality(NamedTuple):
    """-3 dB width in the unit of the offsets; side lobe ratios in dB."""

    irw: float
    pslr: float
    islr: float


def profile_quality(offset: FloatArray, profile: Complex128Array, *, width: float) -> ProfileQuality:
    """IRW, PSLR and ISLR of a cut, as defined in `DEFINITIONS`.

    Parameters
    ----------
    offset : (n,) float
        Uniform, ascending; the peak lies at 0. At least 10 widths on either side.
    profile : (n,) complex
        NaN = missing.
    width : float
        Nominal one, unit of `offset`.

    Returns
    -------
    ProfileQuality
        The IRW is NaN if the main lobe does not fall to half power within 10 widths or is incomplete;
        PSLR and ISLR are NaN if anything within 10 widths is missing, or if no minimum lies there.
    """
    unmeasured = ProfileQuality(float("nan"), float("nan"), float("nan"))
    used = np.abs(offset) <= CUT_WIDTHS * width * (1 + 1e-9)
    offset, power = offset[used], np.abs(profile[used]) ** 2
    top = int(np.argmin(np.abs(offset)))
    if not np.isfinite(power[top]) or power[top] == 0:
        return unmeasured
    power = power / power[top]
    right = _lobe_edge(power[top:])
    left = _lobe_edge(power[top::-1])
    if right is None or left is None:
        return unmeasured
    step = float(offset[1] - offset[0])
    irw = (right.half_power + left.half_power) * step
    if right.minimum is None or left.minimum is None or not np.isfinite(power).all():
        return ProfileQuality(irw, float("nan"), float("nan"))
    low, high = top - left.minimum, top + right.minimum
    side = np.concatenate([power[:low], power[high + 1 :]])
    if side.size == 0:
        return ProfileQuality(irw, float("nan"), float("nan"))
    main_energy = np.trapezoid(power[low : high + 1])
    side_energy = np.trapezoid(power[: low + 1]) + np.trapezoid(power[high:])
    return ProfileQuality(irw, float(10 * np.log10(side.max())), float(10 * np.log10(side_energy / main_energy)))


class _LobeEdge(NamedTuple):
    half_power: float  # samples from the peak, fractional
    minimum: int | None  # samples from the peak


def _lobe_edge(power: FloatArray) -> _LobeEdge | None:
    """Find the half-power point and the first minimum beyond it, outwards from the peak at index 0."""
    below = np.flatnonzero(~(power > 0.5))
    if below.size == 0 or not np.isfinite(power[below[0]]):
        return None
    i = int(below[0])
    half_power = i - 1 + (power[i - 1] - 0.5) / (power[i - 1] - power[i])
    rising = np.flatnonzero(~(power[i + 1 :] <= power[i:-1]))
    minimum = i + int(rising[0]) if rising.size and np.isfinite(power[i + int(rising[0]) + 1]) else None
    return _LobeEdge(float(half_power), minimum)


def measure(response: Response) -> PointResponse:
    """Measure a response that has been read; see `DEFINITIONS`."""
    return measure_cuts(response, cuts(response), ideal_cuts(response.geometry, response.target, response.axes))


def measure_cuts(response: Response, profiles: Cuts, ideal: Cuts) -> PointResponse:
    """Measure a response of which the cuts, and those of the ideal response, are known; see `DEFINITIONS`."""
    axes, target = response.axes, response.target
    along_range, along_azimuth = _qualities(profiles, axes)
    crowded = along_range.pslr > 0 or along_azimuth.pslr > 0
    value = complex(response.at(np.array(target.x), np.array(target.y)))
    x, y = response.peak
    if crowded:
        nan = float("nan")
        along_range, along_azimuth, x, y = ProfileQuality(nan, nan, nan), ProfileQuality(nan, nan, nan), nan, nan
    within = [
        profile[np.abs(offset) <= CUT_WIDTHS * width]
        for offset, profile, width in (
            (profiles.range_offset, profiles.range_profile, axes.range_width),
            (profiles.azimuth_offset, profiles.azimuth_profile, axes.azimuth_width),
        )
    ]
    covered = bool(np.isfinite(value) and all(np.isfinite(profile).all() for profile in within))
    return PointResponse(
        name=target.name,
        x=float(target.x),
        y=float(target.y),
        range_pslr=along_range.pslr,
        range_islr=along_range.islr,
        range_irw=along_range.irw,
        azimuth_pslr=along_azimuth.pslr,
        azimuth_islr=along_azimuth.islr,
        azimuth_irw=along_azimuth.irw,
        error_x=float(x - target.x),
        error_y=float(y - target.y),
        value=value,
        full_dwell=response.full_dwell,
        covered=covered,
        crowded=crowded,
        **_theory(*_qualities(ideal, axes)),
    )


def _qualities(cuts: Cuts, axes: ResponseAxes) -> tuple[ProfileQuality, ProfileQuality]:
    """The figures of both cuts."""
    return (
        profile_quality(cuts.range_offset, cuts.range_profile, width=axes.range_width),
        profile_quality(cuts.azimuth_offset, cuts.azimuth_profile, width=axes.azimuth_width),
    )


def _theory(along_range: ProfileQuality, along_azimuth: ProfileQuality) -> dict[str, Any]:
    """The figures of an ideal response, by their fields of `PointResponse`."""
    return {
        f"{axis}_{figure}_theory": value
        for axis, ideal in (("range", along_range), ("azimuth", along_azimuth))
        for figure, value in ideal._asdict().items()
    }


def measure_target(
    read_chip: ReadChip,
    image_x: FloatArray,
    image_y: FloatArray,
    geometry: Geometry,
    target: Target,
    weighting: Weighting = UNIFORM,
) -> PointResponse:
    """Read and measure the response of one target; all NaN, and not covered, if it has none."""
    response = read_response(read_chip, image_x, image_y, geometry, target, weighting)
    if response is not None:
        return measure(response)
    axes, nan = response_axes(geometry, target.x, target.y, weighting), float("nan")
    ideal = _theory(*[ProfileQuality(nan, *taper.ideal[1:]) for taper in (weighting.range, weighting.azimuth)])
    if axes is not None:
        ideal = _theory(*_qualities(ideal_cuts(geometry, target, axes), axes))
    return PointResponse(
        name=target.name,
        x=float(target.x),
        y=float(target.y),
        range_pslr=nan,
        range_islr=nan,
        range_irw=nan,
        azimuth_pslr=nan,
        azimuth_islr=nan,
        azimuth_irw=nan,
        error_x=nan,
        error_y=nan,
        value=complex(nan, nan),
        full_dwell=axes is not None and bool(geometry.beam.has_full_dwell(target.x, target.y)),
        covered=False,
        **ideal,
    )


class Worst(NamedTuple):
    """The value farthest from the ideal one, and its target's name."""

    name: str
    value: float
    ideal: float


class Summary(NamedTuple):
    """Counts of targets, and by figure the worst case over those with full dwell and full coverage."""

    targets: int
    full_dwell: int
    measured: int
    worst: dict[str, Worst]


def summary(responses: Sequence[PointResponse]) -> Summary:
    """Worst cases, in dB, ratios, m and rad, of targets that are judged; a figure that is NaN is the worst of all.

    `worst` is empty if no target is judged.
    """
    measured = select_judged(responses)
    worst = {}
    for figure, (ideal, value) in _FIGURES.items():
        if measured:
            values, ideals = (np.array([of(r) for r in measured]) for of in (value, ideal))
            # A target that is covered but has no main lobe is a failure, and must not be left out of the worst case.
            i = int(np.argmax(np.nan_to_num(np.abs(values - ideals), nan=np.inf)))
            worst[figure] = Worst(measured[i].name, float(values[i]), float(ideals[i]))
    return Summary(len(responses), sum(r.full_dwell for r in responses), len(measured), worst)


def as_json(responses: Sequence[PointResponse], weighting: Weighting = UNIFORM) -> dict[str, Any]:
    """All results as JSON values: definitions, summary, one record per target; NaN becomes null, complex [re, im]."""
    totals = summary(responses)
    return {
        "definitions": DEFINITIONS,
        "ideal": {"pslr": weighting.azimuth.ideal.pslr, "islr": weighting.azimuth.ideal.islr},
        "weighting": {"range": weighting.range.text, "azimuth": weighting.azimuth.text},
        "summary": {
            "targets": totals.targets,
            "full_dwell": totals.full_dwell,
            "measured": totals.measured,
            "worst": {figure: _plain(worst._asdict()) for figure, worst in totals.worst.items()},
        },
        "targets": [_plain(r._asdict()) for r in responses],
    }


def _plain(record: Mapping[str, Any]) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if isinstance(value, complex):
            return [plain(value.real), plain(value.imag)] if np.isfinite(value) else [None, None]
        if isinstance(value, (float, np.floating)):
            return float(value) if np.isfinite(value) else None
        return value

    return {name: plain(value) for name, value in record.items()}


class Bar(NamedTuple):
    """Largest deviation of a figure from the ideal one that counts as good."""

    name: str
    limit: float  # of |deviation|
    text: str  # the limit with its unit, for people
    deviation: Callable[[PointResponse], float]


LOW = SINC_PSLR - 1.0  # dB: below lie those of all weights, and of a band of a third or more
LOBES = f"{SIDE_LOBE_BUDGET:g} dB"
BARS = {
    "range_pslr": Bar("range PSLR", SIDE_LOBE_BUDGET, LOBES, lambda r: r.range_pslr - r.range_pslr_theory),
    "range_irw": Bar("range width", 0.01, "1 %", lambda r: r.range_irw / r.range_irw_theory - 1),
    "azimuth_pslr": Bar("azimuth PSLR", SIDE_LOBE_BUDGET, LOBES, lambda r: r.azimuth_pslr - r.azimuth_pslr_theory),
    "azimuth_irw": Bar("azimuth width", 0.01, "1 %", lambda r: r.azimuth_irw / r.azimuth_irw_theory - 1),
    "error_x": Bar("position in x", 0.05, "50 mm", lambda r: r.error_x),
    "error_y": Bar("position in y", 0.05, "50 mm", lambda r: r.error_y),
    "amplitude": Bar("amplitude", 0.02, "2 %", lambda r: abs(r.value) - 1),
    "phase": Bar("phase", 0.05, "0.05 rad", lambda r: float(np.angle(r.value))),
}


def limit(response: PointResponse, figure: str) -> tuple[float, str]:
    """Limit of a figure's deviation, and its text; wider for the lower side lobes of a weighting."""
    bar = BARS[figure]
    if figure.endswith("pslr") and getattr(response, f"{figure}_theory") < LOW:
        return WEIGHTED_SIDE_LOBE_BUDGET, f"{WEIGHTED_SIDE_LOBE_BUDGET:g} dB"
    return bar.limit, bar.text


def excess(response: PointResponse, figure: str) -> float:
    """A figure's deviation divided by its limit; infinite where it could not be measured."""
    deviation = BARS[figure].deviation(response)
    return float(np.nan_to_num(abs(deviation) / limit(response, figure)[0], nan=np.inf))


def worst_excess(response: PointResponse) -> float:
    """The largest excess of all figures; a response within the limits has at most 1."""
    return max(excess(response, figure) for figure in BARS)


def is_judged(response: PointResponse) -> bool:
    """Whether the limits apply to a target: lit over its full dwell, covered, and the only peak in its cuts."""
    return response.full_dwell and response.covered and not response.crowded


def select_judged(responses: Sequence[PointResponse]) -> list[PointResponse]:
    """The responses to which the limits apply."""
    return [r for r in responses if is_judged(r)]


def rank(response: PointResponse) -> tuple[bool, float]:
    """Sort key: judged targets first, and among them the worst."""
    return not is_judged(response), -worst_excess(response)


class PaperResponse(NamedTuple):
    """One row of the paper's Table 3: PSLR and ISLR in dB, IRW in m (of slant range in range)."""

    range_pslr: float
    range_islr: float
    range_irw: float
    azimuth_pslr: float
    azimuth_islr: float
    azimuth_irw: float


# The rows of the paper's proposed method. The paper does not state its definition of the ISLR.
TABLE3: dict[str, PaperResponse] = {
    "A1": PaperResponse(-13.26, -10.97, 2.68, -12.81, -10.30, 1.85),
    "A2": PaperResponse(-13.23, -10.98, 2.68, -13.10, -10.52, 1.85),
    "A3": PaperResponse(-13.21, -10.92, 2.68, -13.30, -10.79, 1.89),
    "B1": PaperResponse(-13.23, -10.98, 2.68, -13.25, -10.77, 1.89),
    "B2": PaperResponse(-13.14, -10.89, 2.67, -13.24, -10.70, 1.89),
    "B3": PaperResponse(-13.24, -10.97, 2.68, -13.14, -10.59, 1.89),
    "C1": PaperResponse(-13.19, -10.95, 2.68, -13.14, -10.64, 1.85),
    "C2": PaperResponse(-13.18, -10.97, 2.68, -13.21, -10.65, 1.85),
    "C3": PaperResponse(-13.25, -10.96, 2.68, -12.92, -10.41, 1.85),
}
