"""Measure impulse responses of point targets in a calibrated complex ground image.

The stored image carries the true carrier phase. About a target q, lit around t_m, it is an envelope times
exp(+4j pi fc/c (R_p(t_m) - R_q(t_m))), tens of cycles per metre on the ground, far beyond what the pixel
spacing can sample. Every measurement therefore first removes that phase, exactly and in float64. The rest is
band-limited to the wedge k(f, t) = 2 (fc + f)/c grad R(t) minus its centre, so it can be interpolated; the phase
removed at q is zero, so the value there keeps its true phase.

The response's own axes are neither x and y nor orthogonal. Its range cut runs along constant Doppler
(across the direction in which grad R turns during the dwell), its azimuth cut along constant range (across
grad R at t_m).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, FloatArray
from blocksar.collection.beam import has_full_dwell
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import CUT_WIDTHS, UNIFORM, Weighting
from blocksar.constants import SINC_ISLR, SINC_PSLR, SINC_WIDTH
from blocksar.measurement.axes import ResponseAxes, response_axes
from blocksar.measurement.ideal import ideal_response
from blocksar.measurement.response import ReadChip, Response, read_response
from blocksar.measurement.targets import Target

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
the target. Covered: no pixel is missing in what was measured; figures that touch missing pixels are NaN."""


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
    value = complex(response.at(np.array(target.x), np.array(target.y)))
    x, y = response.peak
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
        **_theory(*_qualities(ideal, axes)),
    )


def _qualities(cuts: Cuts, axes: ResponseAxes) -> tuple[ProfileQuality, ProfileQuality]:
    """The figures of both cuts."""
    return (
        profile_quality(cuts.range_offset, cuts.range_profile, width=axes.range_width),
        profile_quality(cuts.azimuth_offset, cuts.azimuth_profile, width=axes.azimuth_width),
    )


def _theory(along_range: ProfileQuality, along_azimuth: ProfileQuality) -> dict[str, float]:
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
        full_dwell=axes is not None and bool(has_full_dwell(geometry, target.x, target.y)),
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
    """Worst cases, in dB, ratios, m and rad; a figure that is NaN counts as the worst of all.

    `worst` is empty if no target is both fully lit and covered.
    """
    measured = [r for r in responses if r.full_dwell and r.covered]
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
