"""Settings of the estimator of the track's error; the defaults serve all collections."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the estimator is told.

    Attributes
    ----------
    points : int
        Prominent points that are kept.
    least_points : int
        With fewer, nothing is estimated.
    lines : int
        Range lines of a chip, odd.
    line_spacing : float
        Range cells between them.
    speed : float
        Line-of-sight speeds within +- this keep a point inside the Doppler band of its chip, m/s.
    narrow_speed : float
        Likewise after the phase gradient.
    acceleration : float
        Line-of-sight acceleration that a short aperture bears, m/s^2.
    intervals : int
        Of the finest spline, at most.
    roughness : float
        Acceleration of the error, m/s^2 rms, at which the smoothness prior costs `prior`.
    displacement : float
        Error, m rms, that likewise costs `prior`.
    prior : float
        Entropy, in nats a chip.
    loops : int
        At most; chips are taken anew for each.
    step : float
        Loops end when one changes the phases by less, rad rms.
    halves : float
        Two estimates from disjoint halves of the points may differ by this, rad rms.
    """

    points: int = 75
    least_points: int = 20
    lines: int = 7
    line_spacing: float = 0.8
    speed: float = 2.0
    narrow_speed: float = 0.6
    acceleration: float = 4.0
    intervals: int = 128
    roughness: float = 4.0
    displacement: float = 0.2
    prior: float = 0.02
    loops: int = 6
    step: float = 0.03
    halves: float = 0.2
