"""The correction of a track, as the attribute `autofocus` of a phase history and of its runs holds it."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.runs.schema import Figure, Number, Record, Whole, read
from blocksar.texts import count
from blocksar.version import __version__

ATTRIBUTE = "autofocus"
DEPTH = 40.0  # dB between the brightest level of chips and 0
COLUMNS = 97  # Doppler samples of a chip that are kept, about the brightest
_NOT_FIGURES = {"identity", "settings", "version", "track", "chips"}
SHOWN = 129  # times of the track's error, at most


UNTOLD = (
    "not told by the samples: a constant and a line over time of the error along the line of sight; they do not blur, "
    "but shift and turn the image and ramp its phase, so that after the best shift alone it differs from that of the "
    "true track; control points tell them"
)


@dataclass(frozen=True)
class _Track(Record):
    time: tuple[Number, ...]
    error: tuple[tuple[Number, Number, Number], ...]
    uncertainty: tuple[tuple[Number, Number, Number], ...]


@dataclass(frozen=True)
class _Chips(Record):
    places: tuple[tuple[Number, Number], ...]
    shape: tuple[Whole, Whole, Whole]
    before: str
    after: str


@dataclass(frozen=True, kw_only=True)
class _Attribute(Record):
    points: Figure
    knots: Figure
    halves_apart: Figure
    predicted_error: Figure
    entropy_before: Figure
    entropy_after: Figure
    identity: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    track: _Track
    chips: _Chips


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackCorrection:
    """Correction of a track: its samples over time, and the figures of its estimate.

    Attributes
    ----------
    figures : mapping
        Number of `points`, of those that are `distinct` from noise and clutter, and of `knots`; `halves_apart`, the
        difference of two estimates from disjoint halves of the points; `predicted_error`, of what is left;
        `entropy_before` and `entropy_after` of the chips; `history`, the figures of each loop; `channel`, from which
        the points come, where there are several; and others.
    identity : str
        Hash of what the correction depends on; empty if unknown.
    settings : mapping
    time : (n,) float
        Slow time, s.
    error, uncertainty : (n, 3) float
        What was taken off the track in x, y, z, and its predicted standard deviation, m.
    before, after : (n_chip, n_row, n_column) uint8
        Chips about some points before and after: 255 at the brightest of both, 0 at `DEPTH` dB below it or less.
    places : (n_chip, 2) float
        x, y of the chips' points, m.
    """

    figures: Mapping[str, Any]
    identity: str
    settings: Mapping[str, Any]
    time: FloatArray
    error: FloatArray
    uncertainty: FloatArray
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    places: FloatArray

    def as_json(self) -> dict[str, Any]:
        return {
            **self.figures,
            "identity": self.identity,
            "settings": dict(self.settings),
            "version": __version__,
            "track": {
                "time": _rounded(self.time), "error": _rounded(self.error), "uncertainty": _rounded(self.uncertainty),
            },
            "chips": {
                "places": _rounded(self.places), "shape": list(self.before.shape), "decibels": DEPTH,
                "before": base64.b64encode(self.before.tobytes()).decode(),
                "after": base64.b64encode(self.after.tobytes()).decode(),
            },
        }  # fmt: skip

    @classmethod
    def of(cls, value: Any, file: str) -> Self:
        """Convert from the attribute; `file` is for messages.

        Raises
        ------
        InputError
            If it is damaged.
        """
        what, remedy = f"{file}: the attribute {ATTRIBUTE}", "correct the track anew"
        entry = read(_Attribute, value, what, remedy)
        track, chips = entry.track, entry.chips
        try:
            before, after = (
                np.frombuffer(base64.b64decode(text, validate=True), np.uint8).reshape(chips.shape)
                for text in (chips.before, chips.after)
            )
            if (n := len(track.time)) < 2:
                raise ValueError(f"track.time has {n} values")
            time, error, uncertainty, places = (
                np.array(values, np.float64).reshape(shape)
                for values, shape in (
                    (track.time, n), (track.error, (n, 3)), (track.uncertainty, (n, 3)), (chips.places, (-1, 2)),
                )
            )  # fmt: skip
            if len(places) != len(before):
                raise ValueError(f"chips.places has {len(places)} values for {len(before)} chips")
        except (ValueError, binascii.Error) as error_:
            raise InputError(f"{what} is damaged ({error_}); {remedy}") from None
        return cls(
            figures={name: item for name, item in value.items() if name not in _NOT_FIGURES},
            identity=entry.identity, settings=entry.settings, time=time, error=error,
            uncertainty=uncertainty, before=before, after=after, places=places,
        )  # fmt: skip

    def sentences(self) -> list[str]:
        """Describe the correction, with figures."""
        f, n = self.figures, self.figures["points"]
        few = f", {f['distinct']} of which stand out of noise and clutter," if f.get("distinct", n) < n else ""
        size = np.sqrt((self.error * self.error).sum(axis=1))
        loops, of = count(len(f.get("history") or []), "loop"), f" of channel {f['channel']}" if "channel" in f else ""
        on = "" if "surface" in self.settings else ", if the ground is the plane on which points were taken"
        return [
            f"track corrected by up to {1e3 * size.max():.3g} mm ({1e3 * np.sqrt((size * size).mean()):.3g} mm r.m.s.) "
            f"from {count(f['points'], 'point')}{of}{few} in {loops}; entropy of their chips "
            f"{f['entropy_before']:.3f} before and {f['entropy_after']:.3f} after",
            f"phase error left over a dwell: {f['predicted_error']:.3f} rad r.m.s. predicted{on}; two estimates from "
            f"disjoint halves of the points differ by {f['halves_apart']:.3f} rad",
            *([_anchored(f["control"])] if f.get("control") else [_tied(f["tied"])] if "tied" in f else [UNTOLD]),
        ]


def _tied(tied: Mapping[str, Any]) -> str:
    """State whether the track fits that of another collection, with figures."""
    if not tied["points"]:
        return (
            "not tied to the collections before: too few points that both see, or they do not agree; so its image may "
            "be shifted against theirs, by metres where errors of centimetres change within a second"
        )
    return (
        f"tied to {tied['to']} by {count(tied['points'], 'point')} that both see, and moved by up to "
        f"{tied['moved']:.3g} m; "
        f"their ranges agree within {tied['range_left']:.2g} m r.m.s.: images meet in place, but phase may jump there"
    )


def _anchored(control: Mapping[str, Any]) -> str:
    """Describe the effect of control points, with figures."""
    out = ", ".join(control.get("left_out") or [])
    n = control["points"]
    points, move = ("control points anchor", "move") if n != 1 else ("control point anchors", "moves")
    by = f", and {move} it by up to {control['moved']:.3g} m" if "moved" in control else ""
    return f"{n} {points} it{by}; {control['phase_left']:.2g} rad r.m.s. of their phases are left" + (
        f"; left out, as they do not agree with the others: {out}" if out else ""
    )


def levels(before: FloatArray, after: FloatArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Convert power of chips (n_chip, n_row, n_column) before and after to levels, relative to each pair's maximum.

    Of each, the columns about the brightest one after.
    """
    width = min(COLUMNS, after.shape[2])
    middle = after.max(axis=1).argmax(axis=1)
    columns = (np.arange(width) - width // 2 + middle[:, None]) % after.shape[2]  # Doppler is cyclic
    before, after = (np.take_along_axis(chips, columns[:, None, :], axis=2) for chips in (before, after))
    top = np.maximum(before.max(axis=(1, 2), keepdims=True), after.max(axis=(1, 2), keepdims=True))
    floor = 10 ** (-DEPTH / 10)

    def scaled(power: FloatArray) -> NDArray[np.uint8]:
        decibels = 10 * np.log10(np.maximum(power / np.where(top > 0, top, 1.0), floor))
        return np.rint(255 * (1 + decibels / DEPTH)).astype(np.uint8)

    return scaled(before), scaled(after)


def _rounded(values: FloatArray) -> Any:
    """Lists of numbers with seven digits after the point: a tenth of a micrometre."""
    return np.round(values, 7).tolist()
