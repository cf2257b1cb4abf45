"""calibrate: find the radar cross-section of a target that peaks at 1, from reflectors whose own is known."""

from __future__ import annotations

import cmath
import math
from typing import Any, NamedTuple

import numpy as np

from blocksar import stores
from blocksar.api.measuring import read_target
from blocksar.application.reports import Report
from blocksar.application.target_files import read_reflectors
from blocksar.errors import InputError, in_the_way
from blocksar.measurement.reflectors import Reflected, Reflector, measure_reflector
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.products.writing import refuse_parts
from blocksar.runs.finished import FinishedRun, folder_of, member_line

FILE = "calibration.json"
DIM = 10.0  # dB over the clutter, below which a reflector is measured, but noted


def calibrate(
    run: Location,
    reflectors: Location,
    *,
    out: Location | None = None,
    channel: str | None = None,
    overwrite: bool = False,
) -> Report:
    """Calibrate a finished run by reflectors: find the radar cross-section of a target that peaks at 1.

    Parameters
    ----------
    run : path
        Folder of a finished run.
    reflectors : path
        JSON, CSV or GeoJSON file with name, place, kind ("trihedral", "dihedral" or "sphere") and side (m) of each.
    out : path, optional
        File to write, which `calibration` of `export` takes. Default: RUN/calibration.json, which is always replaced.
    channel : str, optional
        Of a run of several channels. Default: the first.
    overwrite : bool
        Replace what stands at `out`. Default: False.

    Returns
    -------
    Report
        `result` is what the file holds: `calibration_factor`, m2, `scatter_db`, `phase` (rad), and of each reflector
        its cross-section, factor, residual and phase.

    Raises
    ------
    InputError
        If the run is not finished, the file is wrong, no reflector can be measured, or `out` exists.
    ProcessingError
        If `out` cannot be written.
    """
    folder = folder_of(place(run), channel)
    source = FinishedRun.open(folder)
    target = folder / FILE if out is None else _checked_out(out, overwrite=overwrite)
    asked = read_reflectors(place(reflectors), source)
    measured, lost = [], []
    for reflector in asked:
        response = read_target(source, reflector.target)
        found = None if response is None else measure_reflector(response, reflector)
        if found is None:
            lost.append(reflector.target.name)
        else:
            measured.append(Measured(reflector, found))
    if not measured:
        raise InputError(
            f"{source.image} shows none of the {len(asked)} reflectors of {reflectors}: they lie outside, or where "
            "pixels are not covered; check their places, or focus on a --grid that holds them"
        )
    result = _result(source, measured)
    stores.write_json(target, result)
    lines = [*member_line(place(run), channel), *_lines(result, measured, lost), f"wrote {target}"]
    return Report(tables=[(HEADER, _rows(result))], summary=lines, result=result)


class Measured(NamedTuple):
    """A reflector and the figures of its response."""

    reflector: Reflector
    found: Reflected


HEADER = (
    "reflector", "kind", "cross-section [dB m2]", "residual [dB]", "phase [rad]", "over clutter [dB]",
    "off its place [m]",
)  # fmt: skip


def _checked_out(out: Location, *, overwrite: bool) -> Place:
    target = place(out)
    if isinstance(target, LocalPlace):
        refuse_parts(target)
    if target.exists() and not overwrite:
        raise in_the_way(target)
    return target


def _result(source: FinishedRun, measured: list[Measured]) -> dict[str, Any]:
    """Figures of all reflectors: the factor is the mean of their decibels, the phase that of their phasors."""
    factors = np.array([10 * math.log10(each.found.factor) for each in measured])
    phase = cmath.phase(sum(cmath.exp(1j * each.found.phase) for each in measured))
    listed = [
        {
            "name": each.reflector.target.name, "kind": each.reflector.kind, "side": each.reflector.side,
            **each.found._asdict(), "residual_db": float(level - factors.mean()),
            "residual_phase": cmath.phase(cmath.exp(1j * (each.found.phase - phase))),
        }
        for each, level in zip(measured, factors, strict=True)
    ]  # fmt: skip
    return {
        stores.CALIBRATION_FACTOR: float(10 ** (factors.mean() / 10)),
        "scatter_db": float(factors.std(ddof=1)) if len(measured) > 1 else None,
        "phase": phase,
        "run": source.record.identity,
        "reflectors": listed,
    }


def _rows(result: dict[str, Any]) -> list[list[str]]:
    return [
        [
            each["name"], each["kind"], f"{10 * math.log10(each['cross_section']):.2f}", f"{each['residual_db']:+.2f}",
            f"{each['phase']:+.3f}", f"{10 * math.log10(each['over_clutter']):.1f}",
            f"{math.hypot(each['error_x'], each['error_y']):.3f}",
        ]
        for each in result["reflectors"]
    ]  # fmt: skip


def _lines(result: dict[str, Any], measured: list[Measured], lost: list[str]) -> list[str]:
    """Describe what was found."""
    factor, scatter = result[stores.CALIBRATION_FACTOR], result["scatter_db"]
    spread = "of one reflector" if scatter is None else f"{len(measured)} reflectors scatter by {scatter:.2f} dB"
    lines = [
        f"a target that peaks at 1 has a radar cross-section of {factor:.6g} m2 ({10 * math.log10(factor):.2f} dB m2); "
        f"{spread}; phase {result['phase']:+.3f} rad"
    ]
    dim = [each.reflector.target.name for each in measured if 10 * math.log10(each.found.over_clutter) < DIM]
    if dim:
        lines.append(f"less than {DIM:g} dB over the clutter, and so uncertain: {', '.join(dim)}")
    if lost:
        lines.append(f"not measured, as they lie outside or beside pixels that are not covered: {', '.join(lost)}")
    return lines
