"""quality: point targets measured, and chips compared with exact back-projection."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.api import definitions, finding
from blocksar.api.aligning import alignment_lines, alignment_table, compare_with
from blocksar.api.look_figures import describe_looks, looks_table
from blocksar.api.raised import raised_line, seen_places
from blocksar.api.reference_chips import compare_with_exact
from blocksar.api.reports import Report, Table
from blocksar.api.shadows import in_shadow
from blocksar.api.target_files import targets_of
from blocksar.collection.weighting import Weighting
from blocksar.measurement.bar import rank
from blocksar.measurement.figures import PointResponse, as_json, measure_target, summary
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.table3 import TABLE3
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.runs.finished import FinishedRun, finished_record, folder_of, member_line
from blocksar.runs.track import TrackCorrection

WORST = 10  # targets that are shown of more
# Names of the figures of a summary, their unit, what a value is multiplied by for it, and decimals.
NAMES = {
    "range_pslr": ("range PSLR (dB)", 1, 2), "range_islr": ("range ISLR (dB)", 1, 2),
    "range_irw_over_theory": ("range IRW / theory", 1, 4), "azimuth_pslr": ("azimuth PSLR (dB)", 1, 2),
    "azimuth_islr": ("azimuth ISLR (dB)", 1, 2), "azimuth_irw_over_theory": ("azimuth IRW / theory", 1, 4),
    "error_x": ("position error in x (mm)", 1e3, 1), "error_y": ("position error in y (mm)", 1e3, 1),
    "amplitude": ("|value|", 1, 4), "phase": ("phase (rad)", 1, 4),
}  # fmt: skip


def quality(
    run: Location,
    *,
    targets: Location | Sequence[Target | Mapping[str, Any]] | None = None,
    reference: bool = False,
    against: Location | None = None,
    found: int = 0,
    area: str | tuple[tuple[float, float], tuple[float, float]] | None = None,
    channel: str | None = None,
) -> Report:
    """Measure the point targets of a finished run, and compare chips with exact back-projection.

    Parameters
    ----------
    run : path
        Folder of a finished run.
    targets : path, or sequence of Target or of mappings, optional
        JSON or CSV file of "name", "x", "y" and "reflectivity", scene file (TOML), or the targets themselves; x and y
        in m in the scene frame. Or a GeoJSON file of points, for runs with a georeference. Default: the targets that
        the collection was simulated with.
    reference : bool
        Also back-project chips of 64 x 64 pixels at the blocks' centres, seams and swath ends from the run's input, and
        compare. Default: False.
    against : path, optional
        Folder of another finished run on the same grid, as of another track: also compare chips of both images as they
        are, after the best shift, and after a shift and a ramp of the phase. Default: none.
    found : int
        Also find and measure this many of the brightest isolated points, with the places of their azimuth ambiguities,
        and the noise floor. Default: 0.
    area : str or ((float, float), (float, float)), optional
        Part of the image, "x0:x1,y0:y1" or the ends of x and of y in m, of which to measure the equivalent number of
        looks and the mean power. Default: none.
    channel : str, optional
        Of a run of several channels. Default: the first.

    Returns
    -------
    Report
        `tables` has the worst case of each figure and the ten worst targets, `details` all targets with all figures;
        `result` is what RUN/quality.json holds.

    Raises
    ------
    InputError
        If the run is not finished or damaged, the targets or the area are wrong, or the input for the reference is
        gone.
    ProcessingError
        If quality.json cannot be written.
    """
    folder = place(run)
    chosen, record = folder_of(folder, channel), finished_record(folder)
    looks = [folder_of(folder, name) for name in record.channels] if record.dimension == "look" else []
    other = None if against is None else folder_of(place(against), channel)
    report = measure(chosen, targets, reference, found=found, area=area, looks=looks, against=other)[0]
    return replace(report, summary=[*member_line(folder, channel), *report.summary])


def measure(
    folder: Place,
    targets: Location | Sequence[Target | Mapping[str, Any]] | None,
    reference: bool,
    *,
    found: int = 0,
    area: Any = None,
    looks: Sequence[Place] = (),
    against: Place | None = None,
) -> tuple[Report, list[Response]]:
    """Do what `quality` does; also return the responses of the targets of the paper's Table 3, to be drawn.

    `looks` are the folders of all looks, if the run is one of several; `against` is that of another run.
    """
    run = FinishedRun.open(folder)
    listed, weighting = targets_of(targets, run.attrs, run), run.weighting
    responses = measure_targets(run, listed)
    dark = [target.name for target, hidden in zip(listed, in_shadow(run, listed), strict=True) if hidden]
    result = as_json(responses, weighting)
    others: list[Table] = []
    lines = (
        [*_weighting_lines(weighting, run.collection.has_pattern), *_count_line(responses), *_seam_line(run, responses)]
        if responses
        else []
    ) + raised_line(listed, seen_places(run, listed))
    if not responses:
        lines.append("the collection names no targets: give --targets FILE to measure some, or --found N to find some")
    if dark:
        named = f"{', '.join(dark[:5])}{', ...' if len(dark) > 5 else ''}"
        lines.append(f"in shadow of the terrain, and not judged: {len(dark)} of {len(listed)} targets ({named})")
    if run.track is not None:
        result["autofocus"] = dict(run.track.figures)
        others.append(_track_table(run.track))
        lines += run.track.sentences()
    if run.attrs.get("scene") == "table1" and responses:
        result["table3"] = {name: row._asdict() for name, row in TABLE3.items()}
        others.append(_table3(responses))
        lines.append(
            "paper: Table 3 of the angular-division paper; its ISLR follows another, unstated definition, and its "
            "azimuth IRW hardly changes over the scene, as if one factor had turned Doppler into metres"
        )
    if run.noise is not None:
        result["noise"] = run.noise.as_json()
        lines.append(run.noise.sentence())
    others += _add_scenery(run, result, lines, found, area)
    if looks:
        result["looks"] = describe_looks([FinishedRun.open(look) for look in looks], area)
        others.append(looks_table(result["looks"]))
    drawn = [response for target in listed if target.name in TABLE3 and (response := read_target(run, target))]
    if reference:
        table, said = compare_with_exact(run, result)
        others.append(table)
        lines += said
    if against is not None:
        other = FinishedRun.open(against)
        result["against"] = compare_with(run, other)
        others.append(alignment_table(result["against"]))
        lines += alignment_lines(result["against"], run, other)
    stores.write_json(folder / "quality.json", result)
    worst, full = ([_summary_table(responses), _worst_table(responses)], [_response_table(responses)])
    if not responses:
        worst, full = [], []
    report = Report(
        tables=[*worst, *others], details=[*worst[:1], *full, *others], definitions=definitions.quality(),
        summary=lines, result=result,
    )  # fmt: skip
    return report, drawn


def read_target(run: FinishedRun, target: Target) -> Response | None:
    """The response of a target; None if the image does not hold it."""
    geometry, read = run.geometry_at(target.x, target.y), run.reader_at(target.x, target.y)
    return read_response(read, run.x, run.y, geometry, target, run.weighting)


def measure_targets(run: FinishedRun, targets: Sequence[Target]) -> list[PointResponse]:
    """Measure targets, in a mosaic each in the pixels of one collection; those in shadow of the terrain are not lit.

    Those off the ground are measured where it has their range and Doppler.
    """
    responses = [
        measure_target(
            run.reader_at(target.x, target.y), run.x, run.y, run.geometry_at(target.x, target.y), target, run.weighting
        )
        for target in seen_places(run, targets)
    ]
    hidden = in_shadow(run, targets)
    return [r._replace(full_dwell=False) if dark else r for r, dark in zip(responses, hidden, strict=True)]


def _add_scenery(run: FinishedRun, result: dict[str, Any], lines: list[str], found: int, area: Any) -> list[Table]:
    """Add points that are found, the floor, and the figures of an area, as far as they are asked for."""
    if area is not None:
        result["area"] = finding.describe_area(run, area)
        lines.append(finding.area_sentence(result["area"]))
    if not found:
        return []
    result["found"], result["floor"] = finding.find_points(run, found), finding.floor_of(run)
    lines.append(finding.floor_sentence(result["floor"]))
    if not result["found"]:
        lines.append("no point stands out by 20 dB, 10 widths from its like")
        return []
    if len(result["found"]) < found:
        lines.append(f"{len(result['found'])} of {found} points: no other stands out by 20 dB, 10 widths from its like")
    return [finding.found_table(result["found"])]


def _response_table(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "full dwell", "range PSLR", "range ISLR", "range IRW (m)", "range IRW / theory", "azimuth PSLR",
        "azimuth ISLR", "azimuth IRW (m)", "azimuth IRW / theory", "dx (mm)", "dy (mm)", "|value|", "phase (rad)",
    )  # fmt: skip
    rows = []
    for r in responses:
        rows.append([
            r.name, "yes" if r.full_dwell else "no", f"{r.range_pslr:.2f}", f"{r.range_islr:.2f}",
            f"{r.range_irw:.3f}", f"{r.range_irw / r.range_irw_theory:.4f}", f"{r.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{r.azimuth_irw:.3f}", f"{r.azimuth_irw / r.azimuth_irw_theory:.4f}",
            f"{1e3 * r.error_x:.1f}", f"{1e3 * r.error_y:.1f}", f"{abs(r.value):.4f}", f"{np.angle(r.value):.4f}",
        ])  # fmt: skip
    return header, rows


def _weighting_lines(weighting: Weighting, patterned: bool) -> list[str]:
    """What the tapers of a weighted image make of its ideal response."""
    if weighting.uniform:
        return []
    along = (("range", weighting.range), ("azimuth", weighting.azimuth))
    figures = [
        f"{name} {taper.text}: width {taper.ideal.width:.4f} / bandwidth, PSLR {taper.ideal.pslr:.2f} dB, "
        f"ISLR {taper.ideal.islr:.2f} dB"
        for name, taper in along
    ]
    beside = "; in azimuth each target has those of the weighting times the antenna's pattern" if patterned else ""
    return [f"ideal responses of the weighting: {'; '.join(figures)}{beside}"]


def _count_line(responses: Sequence[PointResponse]) -> list[str]:
    figures = summary(responses)
    return [f"{figures.measured} of {figures.full_dwell} full-dwell targets measured ({figures.targets} in all)"]


def _seam_line(run: FinishedRun, responses: Sequence[PointResponse]) -> list[str]:
    """How many targets are not measured because another collection's pixels lie in their responses."""
    if len(run.record.inputs) < 2:
        return []
    cut = sum(
        measure_target(
            run.read, run.x, run.y, run.geometry_at(r.x, r.y), Target(r.name, r.x, r.y), run.weighting
        ).covered
        for r in responses
        if r.full_dwell and not r.covered
    )
    if not cut:
        return []
    return [
        f"{cut} lie within 10 widths of a seam between collections, which see them from different sides: not judged"
    ]


def _summary_table(responses: Sequence[PointResponse]) -> Table:
    """The worst case of each figure over the targets with full dwell."""
    rows = []
    for figure, worst in summary(responses).worst.items():
        name, factor, digits = NAMES[figure]
        rows.append([name, f"{factor * worst.value:.{digits}f}", f"{factor * worst.ideal:.{digits}f}", worst.name])
    return ("figure", "worst case", "ideal", "target"), rows


def _worst_table(responses: Sequence[PointResponse]) -> Table:
    """The targets that are farthest from the limits of quality, or all if there are few; in their own order."""
    chosen = {id(r) for r in sorted(responses, key=rank)[:WORST]}
    few = len(responses) <= WORST
    header = (
        "target" if few else f"worst {WORST} of {len(responses)}", "range PSLR", "azimuth PSLR", "range IRW / theory",
        "azimuth IRW / theory", "error (mm)", "|value|", "full dwell",
    )  # fmt: skip
    rows = [
        [
            r.name, f"{r.range_pslr:.2f}", f"{r.azimuth_pslr:.2f}", f"{r.range_irw / r.range_irw_theory:.4f}",
            f"{r.azimuth_irw / r.azimuth_irw_theory:.4f}", f"{1e3 * math.hypot(r.error_x, r.error_y):.1f}",
            f"{abs(r.value):.4f}", "yes" if r.full_dwell else "no",
        ]
        for r in responses
        if id(r) in chosen
    ]  # fmt: skip
    return header, rows


def _table3(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "range PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
        "azimuth PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
    )  # fmt: skip
    rows = []
    for r in responses:
        if (p := TABLE3.get(r.name)) is None:
            continue
        rows.append([
            r.name if r.full_dwell else f"{r.name} (part of a dwell)",
            f"{r.range_pslr:.2f}", f"{p.range_pslr:.2f}", f"{r.range_islr:.2f}", f"{p.range_islr:.2f}",
            f"{r.range_irw:.2f}", f"{p.range_irw:.2f}", f"{r.azimuth_pslr:.2f}", f"{p.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{p.azimuth_islr:.2f}", f"{r.azimuth_irw:.2f}", f"{p.azimuth_irw:.2f}",
        ])  # fmt: skip
    return header, rows


def _track_table(track: TrackCorrection) -> Table:
    """What was taken off the track, axis by axis, mm."""
    header = ("track's error", "at the first pulse (mm)", "in the middle (mm)", "at the last pulse (mm)", "r.m.s. (mm)",
              "largest uncertainty (mm)")  # fmt: skip
    middle = track.time.size // 2
    rows = []
    for axis, name in enumerate("xyz"):
        error, spread = 1e3 * track.error[:, axis], 1e3 * track.uncertainty[:, axis]
        figures = (error[0], error[middle], error[-1], np.sqrt(np.mean(error * error)), spread.max())
        rows.append([name, *(f"{value:.2f}" for value in figures)])
    return header, rows
