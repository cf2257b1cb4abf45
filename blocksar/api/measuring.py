"""quality: point targets measured, and chips compared with exact back-projection."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blocksar import stores
from blocksar.application import finding
from blocksar.application.reference_chips import compare_with_exact
from blocksar.application.reports import Report, Table, finite, quality_columns, rounded
from blocksar.application.target_files import targets_of
from blocksar.collection.beam import aperture
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import CUT_WIDTHS, Weighting
from blocksar.errors import InputError, ProcessingError, is_closed
from blocksar.kernels.occlusion import SHADOW
from blocksar.measurement.coherence import align
from blocksar.measurement.figures import TABLE3, PointResponse, as_json, measure_target, rank, summary
from blocksar.measurement.response import MIN_HALF_TAPS, Response, read_response
from blocksar.measurement.scenery import ground_place, measure_area
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.products.look_spectra import measure_looks
from blocksar.products.pictures.overview import mean_of
from blocksar.runs.finished import FinishedRun, finished_record, folder_of, member_line
from blocksar.runs.track import TrackCorrection
from blocksar.spans import parse_crop
from blocksar.texts import count

OVER_SHADOW = 1.0  # m over the ground, from which on the ground's shadow is not the target's


def in_shadow(run: FinishedRun, targets: Sequence[Target]) -> list[bool]:
    """Tell for each target whether the image has shadow there, in the middle of its dwell."""
    terrain = run.geometry.terrain
    if terrain is None or not (run.image / "visibility" / "zarr.json").exists():
        return [False] * len(targets)
    hidden = []
    for target in targets:
        row, column = run.pixel_at(target.x, target.y)
        ground = float(terrain(np.array(target.x), np.array(target.y)))
        if run.inside(row, column) and (target.z is None or target.z < ground + OVER_SHADOW):
            seen = run.read_layer("visibility", slice(row, row + 1), slice(column, column + 1))
            hidden.append(int(seen[0, 0]) == SHADOW)
        else:
            hidden.append(False)
    return hidden


CHIPS = 6  # along either axis, evenly over the image; at most, and no more than it has room for
SIDE = 64  # pixels
DARK = 20.0  # dB below the brightest chip
COVERED = 0.5  # of a chip's pixels that both images have, at least
FIGURES = (
    ("as_is", "as they are"),
    ("shifted", "after the best shift"),
    ("ramped", "after a shift and a ramp of the phase"),
)


def compare_with(run: FinishedRun, other: FinishedRun) -> list[dict[str, Any]]:
    """Compare chips of two images on one grid; of each x and y (m), three coherences, shift (m) and ramp (rad/m).

    Those with more than DARK dB less power than the brightest hold side lobes of other places, and are left out.

    Raises
    ------
    InputError
        If the grids differ, or no chip has pixels of both.
    """
    for name, axis, theirs in (("x", run.x, other.x), ("y", run.y, other.y)):
        if axis.shape != theirs.shape or np.abs(axis - theirs).max() > 1e-6 * abs(axis[-1] - axis[0]):
            raise InputError(
                f"against={other.folder} has another {name} than {run.folder}: give runs on one grid, as from "
                "`blocksar focus --grid` with the same numbers"
            )
    step = np.array([axis[1] - axis[0] if axis.size > 1 else 1.0 for axis in (run.y, run.x)])
    found = []
    for rows, columns in _places(run):
        a, b = run.read(rows, columns), other.read(rows, columns)
        if (np.isfinite(a) & np.isfinite(b)).mean() < COVERED:
            continue
        aligned = align(a, b)
        if np.isnan(aligned.ramped):
            continue
        shift, ramp = np.array(aligned.shift) * step, np.array(aligned.ramp) / step
        found.append({
            "x": float(run.x[columns].mean()), "y": float(run.y[rows].mean()),
            "as_is": aligned.as_is, "shifted": aligned.shifted, "ramped": aligned.ramped,
            "shift": shift[::-1].tolist(), "ramp": ramp[::-1].tolist(), "power": float(np.nanmean(np.abs(b) ** 2)),
        })  # fmt: skip
    if not found:
        raise InputError(f"against={other.folder} and {run.folder} have no part in common that both cover; give others")
    least = max(chip["power"] for chip in found) * 10 ** (-DARK / 10)
    return [chip for chip in found if chip["power"] >= least]


def _places(run: FinishedRun) -> Iterator[tuple[slice, slice]]:
    """Iterate over the rows and columns of the chips that are compared."""
    spans = []
    for size in (run.y.size, run.x.size):
        starts = np.linspace(0, max(size - SIDE, 0), min(-(-size // SIDE), CHIPS)).round().astype(int).tolist()
        spans.append([slice(start, min(start + SIDE, size)) for start in starts])
    for rows in spans[0]:
        for columns in spans[1]:
            yield rows, columns


def alignment_lines(chips: list[dict[str, Any]], run: FinishedRun, other: FinishedRun) -> list[str]:
    """State least and median coherence, as is and after alignment; and whether the weightings differ."""
    texts = []
    for name, words in FIGURES:
        values = [chip[name] for chip in chips]
        texts.append(f"{min(values):.4f} and {np.median(values):.4f} {words}")
    lines = [f"coherence with {other.folder}, least and median of {count(len(chips), 'chip')}: {', '.join(texts)}"]
    if run.weighting != other.weighting:
        lines.append(
            f"weights differ, {run.weighting.text} here and {other.weighting.text} in {other.folder}: that alone takes "
            "coherence below 1"
        )
    return lines


def alignment_table(chips: list[dict[str, Any]]) -> Table:
    """The chips, one a row."""
    header = (
        "x (m)", "y (m)", "coherence", "shifted", "shift and ramp", "shift in x (mm)", "shift in y (mm)",
        "ramp in x (rad/m)", "ramp in y (rad/m)",
    )  # fmt: skip
    return header, [
        [
            f"{c['x']:.0f}", f"{c['y']:.0f}", f"{c['as_is']:.4f}", f"{c['shifted']:.4f}", f"{c['ramped']:.4f}",
            *(f"{1e3 * value:.1f}" for value in c["shift"]), *(f"{value:.4f}" for value in c["ramp"]),
        ]
        for c in chips
    ]  # fmt: skip


def describe_looks(looks: Sequence[FinishedRun], area: Any) -> dict[str, Any]:
    """Describe each look by its part of the dwell and share of power; with an area, also by equivalent number of looks.

    That of an area also has that of the mean power of all looks: as large as their number times that of one, if their
    speckle is independent.
    """
    found = measure_looks(looks)
    records: list[dict[str, Any]] = [{"name": look.attrs.get("look", look.folder.name)} for look in looks]
    if found is not None:
        for record, part, within in zip(records, found.parts.tolist(), found.within.tolist(), strict=True):
            record |= {"part": part, "within": within}
    result: dict[str, Any] = {"each": records}
    if area is not None:
        parts = [look.cropped(*parse_crop(area, "area"), "area") for look in looks]
        for record, part in zip(records, parts, strict=True):
            record["looks"] = finite(measure_area(part.read, part.strips(0)).looks)
        result["mean_looks"] = finite(_of_mean(parts))
    return result


def _of_mean(parts: Sequence[FinishedRun]) -> float:
    """Return the equivalent number of looks of the mean power of several images, where all of them are covered."""
    return measure_area(mean_of([part.read for part in parts]), parts[0].strips(0)).looks


def looks_table(described: dict[str, Any]) -> Table:
    """The looks, one a row."""
    records = described["each"]
    header = ["look", "part of the dwell", "power in it"]
    rows = [
        [r["name"], *(["-", "-"] if "part" not in r else
         [f"{r['part'][0]:.3f} .. {r['part'][1]:.3f}", f"{100 * r['within']:.1f} %"])]
        for r in records
    ]  # fmt: skip
    if "mean_looks" in described:
        header.append("equivalent looks")
        for row, record in zip(rows, records, strict=True):
            row.append(rounded(record["looks"], 2))
        rows.append(["mean of all", "", "", rounded(described["mean_looks"], 2)])
    return tuple(header), rows


RAISED = 0.01  # m over or under the ground


def seen_places(run: FinishedRun, targets: Sequence[Target]) -> list[Target]:
    """Return the targets; one above or below the ground is moved to where its range and Doppler at mid-dwell put it.

    They stay where they are if there is no such ground, or it has no height.
    """
    return [_seen(run.geometry_at(target.x, target.y), target) for target in targets]


def raised_line(listed: Sequence[Target], seen: Sequence[Target]) -> list[str]:
    """Return a sentence that names the targets that `seen_places` moved; none if there are none."""
    moved = [(a, float(np.hypot(a.x - b.x, a.y - b.y))) for a, b in zip(listed, seen, strict=True) if a.z != b.z]
    if not moved:
        return []
    named = ", ".join(f"{target.name} {way:.3g} m" for target, way in moved[:5])
    return [
        f"off the ground, and measured where the ground has their range and Doppler: {len(moved)} of "
        f"{count(len(listed), 'target')} (away by: {named}{', ...' if len(moved) > 5 else ''})"
    ]


def _seen(geometry: Geometry, target: Target) -> Target:
    at = np.array([target.x, target.y])
    ground = float(geometry.height(*at))
    if target.z is None or not abs(target.z - ground) > RAISED:
        return target
    first, last = geometry.beam.dwell(*at)
    time = np.clip((first + last) / 2 if first < last else np.array(geometry.epoch), *aperture(geometry.collection))

    wanted = np.array(geometry.range_history(np.array([*at, target.z]), time))
    longest = abs(target.z - ground) + 1.0
    place = ground_place(geometry, (target.x, target.y), time, wanted, longest=longest)
    return target if place is None else target._replace(x=place[0], y=place[1], z=None)


WORST = 10  # targets that are shown of more
# For each figure of a summary: name with unit, factor to that unit, and decimals.
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
    source: Location | None = None,
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
    source : path, optional
        The phase history that the run was made from, for the reference; of several, the folder that holds them under
        their names. Default: where it was, or beside the run under its name, as after both were moved.

    Returns
    -------
    Report
        `tables` has the worst case of each figure and the ten worst targets, `details` all targets with all figures;
        `result` is what RUN/quality.json holds. Of a run on a read-only disk, or another user's, a note in `summary`
        says that the file is not written.

    Raises
    ------
    InputError
        If the run is not finished or damaged, the targets or the area are wrong, or the input for the reference is
        gone, or another one.
    ProcessingError
        If quality.json cannot be written for lack of room.
    """
    folder = place(run)
    chosen, record = folder_of(folder, channel), finished_record(folder)
    looks = [folder_of(folder, name) for name in record.channels] if record.dimension == "look" else []
    other = None if against is None else folder_of(place(against), channel)
    if source is not None and not reference:
        raise InputError(f"source is {source}, which only the reference needs; give --reference, or leave it out")
    report = measure(
        chosen, targets, reference, found=found, area=area, looks=looks, against=other,
        source=None if source is None else place(source),
    )[0]  # fmt: skip
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
    source: Place | None = None,
) -> tuple[Report, list[Response]]:
    """Measure as `quality` does; also return the responses of the targets of the paper's Table 3, to be drawn.

    `looks` are the folders of all looks, if the run is one of several; `against` is that of another run; `source` is
    where the run's input is, if not where it was.
    """
    run = FinishedRun.open(folder)
    listed = targets_of(targets, run.attrs, run)
    measured = measure_targets(run, listed)
    responses, asked = measured.responses, reference or found or area is not None or against or looks
    parts = [
        _about_targets(run, listed, measured, alone=not asked), _about_track(run), _beside_table3(run, responses),
        _about_noise(run), _about_area(run, area), _about_found(run, found), _about_looks(looks, area),
        _beside_exact(run, reference, source), _beside_another(run, against),
    ]  # fmt: skip
    drawn = [response for target in listed if target.name in TABLE3 and (response := read_target(run, target))]
    result = {name: value for part in parts for name, value in part.result.items()}
    lines = [line for part in parts for line in part.lines]
    try:
        stores.write_json(folder / "quality.json", result)
    except ProcessingError as error:
        if not is_closed(error.__cause__):
            raise
        lines.append(f"note: the figures are not kept, as {error}")
    tables = [table for part in parts for table in part.tables]
    worst = [_summary_table(responses), _worst_table(responses)] if responses else []
    full = [_response_table(responses)] if responses else []
    report = Report(
        tables=[*worst, *tables], details=[*worst[:1], *full, *tables], definitions=quality_columns(),
        summary=lines, result=result,
    )  # fmt: skip
    return report, drawn


class ReportPart(NamedTuple):
    """Part of a report on one subject: entries of its result, sentences and tables."""

    result: Mapping[str, Any]
    lines: Sequence[str] = ()
    tables: Sequence[Table] = ()


NOTHING = ReportPart({})


def read_target(run: FinishedRun, target: Target) -> Response | None:
    """Read the response of a target; None if it lies outside the image."""
    geometry, read = run.geometry_at(target.x, target.y), run.reader_at(target.x, target.y)
    return read_response(read, run.x, run.y, geometry, target, run.weighting)


class Measured(NamedTuple):
    """Targets as an image shows them, in the order of the list that they are measured from.

    Attributes
    ----------
    responses : list of PointResponse
        Those of targets in shadow of the terrain are not lit.
    seen : list of Target
        The targets where they are measured: those off the ground where it has their range and Doppler.
    dark : list of bool
        Whether each lies in shadow.
    """

    responses: list[PointResponse]
    seen: list[Target]
    dark: list[bool]


def measure_targets(run: FinishedRun, targets: Sequence[Target]) -> Measured:
    """Measure targets, in a mosaic each in the pixels of one collection."""
    seen, dark = seen_places(run, targets), in_shadow(run, targets)
    responses = [
        measure_target(
            run.reader_at(target.x, target.y), run.x, run.y, run.geometry_at(target.x, target.y), target, run.weighting
        )
        for target in seen
    ]
    lit = [r._replace(full_dwell=False) if hidden else r for r, hidden in zip(responses, dark, strict=True)]
    return Measured(lit, seen, dark)


def _about_targets(run: FinishedRun, listed: Sequence[Target], measured: Measured, *, alone: bool) -> ReportPart:
    """Report responses, and which targets are measured elsewhere or not judged; `alone`: nothing else was requested."""
    responses, lines = measured.responses, []
    if responses:
        lines += _weighting_lines(run.weighting, run.collection.has_pattern)
        lines += [*_count_line(responses), *_unjudged_lines(run, responses)]
    lines += raised_line(listed, measured.seen)
    if alone and not responses:
        lines.append("the collection names no targets: give --targets FILE to measure some, or --found N to find some")
    if dark := [target.name for target, hidden in zip(listed, measured.dark, strict=True) if hidden]:
        lines.append(f"in shadow of the terrain, and not judged: {len(dark)} of "
                     f"{count(len(listed), 'target')} ({_first(dark)})")  # fmt: skip
    return ReportPart(as_json(responses, run.weighting), lines)


def _about_track(run: FinishedRun) -> ReportPart:
    """Report how the track was corrected, if it was."""
    if run.track is None:
        return NOTHING
    return ReportPart({"autofocus": dict(run.track.figures)}, run.track.sentences(), [_track_table(run.track)])


def _beside_table3(run: FinishedRun, responses: Sequence[PointResponse]) -> ReportPart:
    """Report the paper's figures beside those of the shipped scene."""
    if run.attrs.get("scene") != "table1" or not responses:
        return NOTHING
    line = (
        "paper: Table 3 of the angular-division paper; its ISLR follows another, unstated definition, and its "
        "azimuth IRW hardly changes over the scene, as if one factor had turned Doppler into metres"
    )
    return ReportPart({"table3": {name: row._asdict() for name, row in TABLE3.items()}}, [line], [_table3(responses)])


def _about_noise(run: FinishedRun) -> ReportPart:
    """Report the noise of the image, if that of the samples is known."""
    return NOTHING if run.noise is None else ReportPart({"noise": run.noise.as_json()}, [run.noise.sentence()])


def _about_area(run: FinishedRun, area: Any) -> ReportPart:
    """Report the figures of an area, if one is given."""
    if area is None:
        return NOTHING
    described = finding.describe_area(run, area)
    return ReportPart({"area": described}, [finding.area_sentence(described)])


def _about_found(run: FinishedRun, count: int) -> ReportPart:
    """Report bright points and the noise floor, if they are requested."""
    if not count:
        return NOTHING
    points, floor = finding.find_points(run, count), finding.floor_of(run)
    result, lines = {"found": points, "floor": floor}, [finding.floor_sentence(floor)]
    if not points:
        return ReportPart(result, [*lines, "no point stands out by 20 dB, 10 widths from its like"])
    if len(points) < count:
        lines.append(f"{len(points)} of {count} points: no other stands out by 20 dB, 10 widths from its like")
    return ReportPart(result, lines, [finding.found_table(points)])


def _about_looks(looks: Sequence[Place], area: Any) -> ReportPart:
    """Report the spectra of a run's looks, and the figures of an area in each."""
    if not looks:
        return NOTHING
    described = describe_looks([FinishedRun.open(look) for look in looks], area)
    return ReportPart({"looks": described}, tables=[looks_table(described)])


def _beside_exact(run: FinishedRun, wanted: bool, source: Place | None) -> ReportPart:
    """Compare chips with exact back-projection, if requested."""
    if not wanted:
        return NOTHING
    result: dict[str, Any] = {}
    table, lines = compare_with_exact(run, result, source)
    return ReportPart(result, lines, [table])


def _beside_another(run: FinishedRun, folder: Place | None) -> ReportPart:
    """Compare chips with those of another run, if one is given."""
    if folder is None:
        return NOTHING
    other = FinishedRun.open(folder)
    compared = compare_with(run, other)
    return ReportPart({"against": compared}, alignment_lines(compared, run, other), [alignment_table(compared)])


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
    """Describe the ideal response that the tapers of the weighting lead to."""
    if weighting.uniform:
        return []
    along = (("range", weighting.range), ("azimuth", weighting.azimuth))
    figures = [
        f"{name} {taper.text}: width {taper.ideal.width:.4f} / bandwidth, PSLR {taper.ideal.pslr:.2f} dB, "
        f"ISLR {taper.ideal.islr:.2f} dB"
        for name, taper in along
    ]
    besides = "; in azimuth each target has those of the weighting times the antenna's pattern" if patterned else ""
    return [f"ideal responses of the weighting: {'; '.join(figures)}{besides}"]


def _count_line(responses: Sequence[PointResponse]) -> list[str]:
    figures = summary(responses)
    noun = "target" if figures.full_dwell == 1 else "targets"
    return [f"{figures.measured} of {figures.full_dwell} full-dwell {noun} measured ({figures.targets} in all)"]


def _unjudged_lines(run: FinishedRun, responses: Sequence[PointResponse]) -> list[str]:
    """Count the targets that are not measured because pixels are missing, by where these lie.

    Pixels of another collection show a target as seen from another side.
    """
    missed = [r for r in responses if r.full_dwell and not r.covered]
    seam = [r for r in missed if len(run.record.inputs) > 1 and _measured_in_any(run, r)]
    ends = (run.x[0], run.x[-1], run.y[0], run.y[-1])
    outside = [r for r in missed if not (ends[0] <= r.x <= ends[1] and ends[2] <= r.y <= ends[3])]
    edge = [r for r in missed if r not in seam and r not in outside]
    lines = []
    if crowded := [r.name for r in responses if r.full_dwell and r.covered and r.crowded]:
        lines.append(
            f"{count(len(crowded), 'target')} with a side lobe above the peak ({_first(crowded)}): another peak is "
            "near, or the image is out of focus there; not measured"
        )
    if seam:
        lines.append(
            f"{count(len(seam), 'target')} within 10 widths of a seam between collections, which see a target from "
            "different sides: not judged"
        )
    if outside:
        names = _first([r.name for r in outside])
        lines.append(f"{count(len(outside), 'target')} outside the image ({names}): not measured")
    if edge:
        lines.append(
            f"{count(len(edge), 'target')} close to the edge of what the image covers "
            f"({_first([r.name for r in edge])}): not judged, figures that need pixels beyond it are nan; they need "
            f"{CUT_WIDTHS:g} widths and {MIN_HALF_TAPS} pixels on either side, and the value of a target on a pixel "
            "needs that pixel alone"
        )
    return lines


def _measured_in_any(run: FinishedRun, r: PointResponse) -> bool:
    """Tell whether a response is covered if the pixels of all collections count, not only those of its own."""
    target = Target(r.name, r.x, r.y)
    return measure_target(run.read, run.x, run.y, run.geometry_at(r.x, r.y), target, run.weighting).covered


def _first(names: Sequence[str]) -> str:
    """The first five names."""
    return f"{', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"


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
    """Tabulate the correction of the track along each axis, mm."""
    header = ("track's error", "at the first pulse (mm)", "in the middle (mm)", "at the last pulse (mm)", "r.m.s. (mm)",
              "largest uncertainty (mm)")  # fmt: skip
    middle = track.time.size // 2
    rows = []
    for axis, name in enumerate("xyz"):
        error, spread = 1e3 * track.error[:, axis], 1e3 * track.uncertainty[:, axis]
        figures = (error[0], error[middle], error[-1], np.sqrt(np.mean(error * error)), spread.max())
        rows.append([name, *(f"{value:.2f}" for value in figures)])
    return header, rows
