"""Check of samples against metadata: the contrast of the same echoes as given and under alternatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.collection.raw_echo import RawEcho
from blocksar.collection.terrain import Terrain
from blocksar.inspection.alternatives import IN_DEGREES, Alternative, alternatives
from blocksar.inspection.comparison import (
    FEW_PATCHES,
    PATCHES,
    ClutterGround,
    Refocus,
    View,
    after_refocus,
    as_given,
    blurring_phase,
    compare,
    concentration,
    explain,
    judged_by_others,
    refocus,
)
from blocksar.inspection.pointing import beam_angle, point
from blocksar.inspection.prominent import SHORT, SIGNIFICANT, PointLine, ProfiledSamples
from blocksar.inspection.verdict import FOCUSED, SHARP, Concentrations, Findings, Trial

FEWEST = 2  # of these, from which the track is judged
CLEAR = 0.65  # concentration that only points in focus have
EXPLAINED = 0.8  # of a phase error: causes that explain more are named
COVERED = 0.5  # of a dwell: with less, other places do not judge a place, and it judges itself if it is CLEAR
POINTS = 1 / 3  # of the places: as many that become FOCUSED judge the track alone, without those that are clutter
# Samples to read: a part of the band and, of very many pulses, the middle ones. Under a beam that is not steered less
# depends on the sign and order of the samples.
MOST_SAMPLES, MOST_UNSTEERED = 1 << 20, 1 << 21
SPIKE = 1e4  # times the median modulus: samples that are left out
LEAST_BAND, MOST_PULSES = 128, 1 << 15


def part_to_read(collection: Collection) -> tuple[slice, slice]:
    """Pulses and range frequencies that a check reads: the middle of the band."""
    most = MOST_SAMPLES if collection.steered else MOST_UNSTEERED
    pulses = _middle(collection.n_pulse, MOST_PULSES)
    width = max(most // (pulses.stop - pulses.start), LEAST_BAND)
    return pulses, _middle(collection.n_range_frequency, width)


def part_of(collection: Collection, pulses: slice, columns: slice) -> Collection:
    """The collection of some pulses and range frequencies."""
    names = ["time", "reference_range", "antenna_position", "beam_azimuth"]
    names += ["beam_axis", "beam_steering"] if collection.has_axis else []
    return replace(
        collection,
        range_frequency=collection.range_frequency[columns],
        **{name: getattr(collection, name)[pulses] for name in names},
    )


def _middle(size: int, at_most: int) -> slice:
    width = min(size, at_most)
    return slice((size - width) // 2, (size - width) // 2 + width)


def check(
    signal: ComplexArray,
    collection: Collection,
    *,
    grid: Grid | None,
    threads: int,
    thorough: bool,
    terrain: Terrain | None = None,
    raw: RawEcho | None = None,
) -> Findings:
    """Compare the contrast of echoes as given with that under the alternatives.

    Parameters
    ----------
    signal : (n_pulse, n_range_frequency) complex64
    collection : Collection
        Of these samples.
    grid : Grid or None
        Where to look; needed if the beam is not steered.
    threads : int
    thorough : bool
        Try all alternatives, even if the places are sharp as given.
    terrain : Terrain, optional
        The ground that places stand on; where it has no height, and by default, the plane.
    raw : RawEcho, optional
        The echo that was compressed to the signal.

    Raises
    ------
    InputError
        If the beam is not steered and there is no grid, or the grid lies outside the swath.
    """
    signal = _cleaned(signal)
    ground = ClutterGround(grid, terrain, PATCHES if thorough else FEW_PATCHES)
    view = View(
        Alternative("as given", "", collection, None), ProfiledSamples(signal, collection, threads=threads), ground
    )
    if not signal.any():
        return Findings((Trial("as given", ""),), empty="all samples are zeros or missing", steered=collection.steered)
    if view.outside is not None and not collection.steered:
        raise view.outside
    findings, phase = _of_the_track(view)
    pointing = point(view.samples, collection, ground.geometry, ground.region, thorough=thorough)
    moved = pointing.found if pointing is not None else None
    findings = replace(findings, pointing=pointing)
    doubtful = moved is not None or not findings.in_focus or findings.sharpness < SHARP
    if view.lit and (thorough or doubtful):
        tried = alternatives(view.lines.geometry, view.region, raw)
        tried = tried if thorough or moved is not None or not findings.clutter else [t for t in tried if t.of_sign]
        if moved is not None:
            tried = [*(other for other in tried if other.name != moved.name), moved]
        others = sorted((compare(view, other) for other in tried), key=lambda trial: -trial.gain)
        gained = any(trial.deviations >= SIGNIFICANT for trial in others)
        findings = replace(
            findings, trials=(findings.given, *others), mirrored=not collection.steered and terrain is None,
            refocus=after_refocus(view, phase) if gained and phase is not None else None,
        )  # fmt: skip
    if view.outside is not None and findings.warning() is None:
        raise view.outside
    return findings


def _of_the_track(view: View) -> tuple[Findings, FloatArray | None]:
    """Judge the track by prominent places; also return the phase error that a refocus removes, (n_pulse,) rad."""
    trial, collection, lines = as_given(view), view.lines.geometry.collection, [line for _, line in view.prominent]
    dark = "the ground that was looked at returns hardly any of the energy"
    unlit = f"no place is lit by {SHORT} pulses or more"
    if collection.steered and np.abs(beam_angle(collection)).max() > IN_DEGREES:
        unlit += ", as if the angles of the beam were in degrees; they must be in rad"
    empty = "" if trial.echoes else dark if view.lit else unlit
    if len(lines) < FEWEST:
        return Findings((trial,), trial.sharpness, steered=collection.steered, empty=empty), None
    mended = refocus(lines, collection.n_pulse)
    good = [error for error in explain(lines, mended.phase, collection) if error.explained > EXPLAINED]
    findings = Findings(
        (trial,), float(np.median(mended.concentration)), blurring_phase(lines, mended.phase),
        " or ".join(error.text for error in good),
        good[0].remedy if good else "mend the track from the data (autofocus)",
        points=_points(lines, mended, collection.n_pulse), steered=collection.steered,
    )  # fmt: skip
    return findings, mended.phase


def _points(lines: list[PointLine], mended: Refocus, n_pulse: int) -> Concentrations:
    """Return the concentrations that judge the track: of places that are points if there are enough, else of all."""
    given, others = np.array([concentration(line.values) for line in lines]), judged_by_others(lines, n_pulse)
    alone = np.where(mended.concentration >= CLEAR, mended.concentration, given)
    by_others = np.where(others.covered >= COVERED, others.concentration, alone)
    points = np.maximum(given, by_others) >= FOCUSED
    if points.sum() < max(FEWEST, POINTS * len(lines)):
        points[:] = True
    return Concentrations(*(float(np.median(values[points])) for values in (given, mended.concentration, by_others)))


def _cleaned(signal: ComplexArray) -> ComplexArray:
    """Divide the samples by their median modulus, and set missing ones and spikes to zero."""
    modulus = np.abs(signal).astype(np.float64)
    valid = np.isfinite(modulus) & (modulus > 0)
    if not valid.any():
        return np.zeros_like(signal)
    median = float(np.median(modulus[valid]))
    valid &= modulus < SPIKE * median
    clean = np.zeros(signal.shape, np.complex64)
    np.divide(signal, median, out=clean, where=valid, casting="unsafe")
    return clean
