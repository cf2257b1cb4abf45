"""Every wrong input that a check is to name, applied to exact scenes, and how it is judged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from exact_scenes import ExactScene, lit

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.raw_echo import RawEcho
from blocksar.collection.region import plan_region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.inspection.alternatives import doppler_period
from blocksar.inspection.check import check
from blocksar.inspection.verdict import Findings
from blocksar.kernels.fourier import chirp_spectrum

OUTCOMES = ("named", "tied", "other", "untold", "missed", "refused")
TRACK = "prominent places reach"  # so much of the sharpness that a refocus gives them
LEAST = 0.3  # beam widths: smaller errors of a beam are not applied


@dataclass(frozen=True)
class WrongInput:
    """A scene with one thing wrong: how a warning begins that names it, and the error of a beam, degrees."""

    kind: str
    name: str
    signal: ComplexArray
    collection: Collection
    scene: ExactScene
    raw: RawEcho | None = None
    degrees: float | None = None

    def findings(self, *, thorough: bool) -> Findings:
        return check(
            self.signal, self.collection.centred(), grid=self.scene.grid, threads=1, thorough=thorough,
            terrain=self.scene.terrain, raw=self.raw,
        )  # fmt: skip


def wrong_inputs(scene: ExactScene) -> Iterator[WrongInput]:
    """All wrong inputs that change what is said of a scene."""
    yield from _samples(scene)
    yield from _echoes(scene)
    yield from _tracks(scene)
    yield from _beams(scene)


def _samples(scene: ExactScene) -> Iterator[WrongInput]:
    signal = scene.signal
    for name, values in (
        ("the signal is conjugated", np.conj(signal)),
        ("the range axis is reversed", signal[:, ::-1]),
        ("the phase of the carrier has the other sign", np.conj(signal[:, ::-1])),
        ("the pulses are in the opposite order", signal[::-1]),
    ):
        yield WrongInput(name, name, np.ascontiguousarray(values), scene.collection, scene)


def _echoes(scene: ExactScene) -> Iterator[WrongInput]:
    """Samples as they become when an echo of a chirp half as long as the range window is compressed wrongly."""
    signal, collection = scene.signal, scene.collection
    width, bandwidth = 0.5 / collection.range_frequency_step, collection.bandwidth
    time = np.arange(int(4 * width * bandwidth)) / (1.5 * bandwidth)
    raw = RawEcho(fast_time=time, chirp_rate=bandwidth / width, pulse_width=width, sampling_rate=1.5 * bandwidth)
    spectrum = chirp_spectrum(collection.range_frequency, chirp_rate=raw.chirp_rate, pulse_width=width)
    twice, half = np.exp(2j * np.angle(spectrum)).astype(np.complex64), SPEED_OF_LIGHT / 4 * width
    for name, values, shift in (
        ("the chirp has the other sign", signal * np.conj(twice), 0.0),
        ("the echo is conjugated", np.conj(signal[:, ::-1] * twice), 0.0),
        ("the delays count from the start of the pulse", signal, half),
        ("half of the pulse is missing in the delays", signal, -half),
    ):
        said = replace(collection, reference_range=collection.reference_range + shift)
        yield WrongInput(name, name, np.ascontiguousarray(values), said, scene, raw)


def _tracks(scene: ExactScene) -> Iterator[WrongInput]:
    collection, position = scene.collection, scene.collection.antenna_position
    steered = collection.steered or scene.terrain is not None
    dwell = max(int(np.median([lit(collection, target).sum() for target in scene.targets])), 64)
    middle, time = collection.n_pulse // 2, collection.time - collection.time.mean()
    velocity = (position[middle + 1] - position[middle - 1]) / (time[middle + 1] - time[middle - 1])
    half_way = np.linalg.norm(velocity) * dwell * collection.pulse_interval / 2
    distance, wavelength = float(collection.reference_range.mean()), collection.wavelength
    faster = min(wavelength * distance / (2 * half_way**2), 0.05)  # ends of a dwell are off by a turn of phase
    wave = wavelength / 6 * np.sin(3 * np.pi * np.arange(collection.n_pulse) / dwell)[:, None]
    sight = scene.targets.mean(axis=0) - position[middle]
    errors = (
        ("the track runs backwards", position[::-1]),
        *((("x and y are swapped", position[:, [1, 0, 2]]), ("x has the other sign", position * [-1, 1, 1]),
           ("y has the other sign", position * [1, -1, 1])) if steered else ()),
        ("a velocity by which a dwell's ends are off by a turn", position + faster * np.outer(time, velocity)),
        ("a wobble of a sixth of a wavelength", position + wave * sight / np.linalg.norm(sight)),
    )  # fmt: skip
    for kind, track in errors:
        if np.abs(track - position).max() > wavelength / 10:
            said = replace(collection, antenna_position=track)
            name = TRACK if kind.startswith("a ") else kind
            yield WrongInput(kind, name, scene.signal, said, scene)


def _beams(scene: ExactScene) -> Iterator[WrongInput]:
    collection, width = scene.collection, scene.collection.beam_width
    if width is None:
        return
    field = "beam_steering" if collection.has_axis else "beam_azimuth"
    beam = getattr(collection, field)
    geometry = Geometry(collection=collection.centred())
    period = doppler_period(geometry, plan_region(geometry, scene.grid))
    changes: list[tuple[str, str, Any, float | None]] = [
        ("the beam turns the other way", "", beam[::-1], None),
        ("the beam looks to the other side", "", -beam, None),
        ("the beam is off by its width", "the beam is off by", beam + width, width),
        ("the beam is off by a PRF", "the beam is off by", beam - period, -period),
        (f"{field} is in degrees", "", np.degrees(beam), None),
    ]
    for kind, name, angles, error in changes:
        if np.abs(angles - beam).max() > LEAST * width:
            degrees = None if error is None else float(np.degrees(error))
            yield from _said(kind.replace(field, "the beam's angle"), name or kind, scene, degrees, **{field: angles})
    yield from _said("a beam twice too wide", "the beam has about", scene, None, beam_width=2 * width)
    yield from _said("beam_width is in degrees", "beam_width is in degrees", scene, None, beam_width=np.degrees(width))


def _said(kind: str, name: str, scene: ExactScene, degrees: float | None, **fields: Any) -> Iterator[WrongInput]:
    try:
        yield WrongInput(
            kind, name, scene.signal, replace(scene.collection, **fields), scene, degrees=degrees
        )  # fmt: skip
    except InputError:  # such a collection cannot be written
        return


def outcome(wrong: WrongInput, *, thorough: bool = True) -> tuple[str, str]:
    """One of OUTCOMES, and what was said.

    named: the warning begins with what is wrong; tied: it is among what the warning says is not told from that; other:
    something else is named; untold: nothing is, and what is wrong is
    neither ruled out nor, without a trial of it, said to fit; missed: it is; refused: an error.
    """
    try:
        findings = wrong.findings(thorough=thorough)
    except InputError as error:
        return "refused", str(error)
    warning, name = findings.warning(), wrong.name
    if warning is not None:
        if warning.startswith(name):
            return ("named" if _as_large(wrong, warning) else "other"), warning
        return ("tied" if name in warning else "other"), warning
    trial = next((t for t in findings.trials[1:] if t.name.startswith(name)), None)
    sentence = findings.sentence()
    fits = sentence.startswith("the samples fit") and "may be narrower" not in sentence
    silent = not findings.speaks or (not fits if trial is None else trial.verdict != "ruled out")
    return ("untold" if silent else "missed"), sentence


def _as_large(wrong: WrongInput, warning: str) -> bool:
    """Whether the error of a beam is measured, to a third of its width."""
    if wrong.degrees is None or wrong.scene.collection.beam_width is None:
        return True
    said = float(warning.partition("off by ")[2].partition(" ")[0])
    return abs(said - wrong.degrees) < np.degrees(wrong.scene.collection.beam_width) / 3
