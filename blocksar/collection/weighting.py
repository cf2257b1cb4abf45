"""Weighting: the tapers over band and dwell of an image's sum, and their ideal responses.

    image(p) = sum w(p, t) W(f) signal exp(+4j pi (fc + f) / c (R(p, t) - reference_range)) / sum w(p, t) W(f) g(p, t)

W is a function of v = (2k + 1 - m) / m of range frequency k of m. w is one of v = 2 offset / beam_width, the offset of
a point from the beam's centre, and of v = (2i + 1 - n) / n of pulse i of n where the beam is not steered. g is the
antenna's pattern, 1 where none is known. Unevenly spaced frequencies and pulses have v by their place in the band and
in the collection, and count by their shares of these as well (`sampling`).

Every taper is an even function of v on [-1, 1], and a short sum of cosines: those of Taylor, Hamming and Hann by their
definition, Kaiser's by a fit to 1e-10 with half the frequencies. Sums of cosines stay smooth beyond the ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.sampling import Sampling
from blocksar.constants import SINC_ISLR, SINC_PSLR, SINC_WIDTH
from blocksar.errors import InputError
from blocksar.texts import count

Name = Literal["uniform", "taylor", "hamming", "hann", "kaiser"]
FORMS = "uniform, taylor:NBAR:SLL (such as taylor:4:-35), hamming, hann, or kaiser:BETA (such as kaiser:2.5)"
MOST_NBAR = 12
LEAST_LEVEL, MOST_LEVEL = -80.0, -15.0  # dB, of Taylor's side lobes
MOST_BETA = 12.0
KAISER_BEYOND = 0.1  # of v, over which it falls on beyond its ends, with the slope that it has there
KAISER_TERMS = 16  # of its series of cosines, which has the period 4
CUT_WIDTHS = 10.0  # widths on either side of the peak within which side lobes count
NODES = 160  # of the quadrature over v: exact far beyond that many widths
STEPS_PER_WIDTH = 512  # of the ideal response


class IdealResponse(NamedTuple):
    """Figures of the ideal response to a band or a dwell under a taper, |integral of w(v) exp(1j pi v u) dv|^2 in u.

    `width` is the -3 dB width times the band (or the dwell's extent in wavenumber); `pslr` and `islr` are in dB.
    """

    width: float
    pslr: float
    islr: float


@dataclass(frozen=True)
class Taper:
    """A weighting along one axis.

    Attributes
    ----------
    name : {"uniform", "taylor", "hamming", "hann", "kaiser"}
    parameters : tuple of float
        NBAR and the level of the side lobes in dB of "taylor", BETA of "kaiser", none of the others.

    Raises
    ------
    InputError
        If the name is unknown, or a parameter is missing, superfluous or out of range.
    """

    name: Name = "uniform"
    parameters: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.name not in get_args(Name):
            raise InputError(f"weighting {self.name!r} is unknown; give {FORMS}")
        needed = {"taylor": 2, "kaiser": 1}.get(self.name, 0)
        if len(self.parameters) != needed:
            raise InputError(
                f"weighting {self.text!r} has {count(len(self.parameters), 'parameter')}, but {self.name} takes "
                f"{needed}; give {FORMS}"
            )
        if self.name == "taylor":
            nbar, level = self.parameters
            if not (nbar == round(nbar) and 2 <= nbar <= MOST_NBAR):
                raise InputError(
                    f"weighting {self.text!r}: NBAR = {nbar:g}; give a whole number from 2 to {MOST_NBAR}, such as 4"
                )
            if not LEAST_LEVEL <= level <= MOST_LEVEL:
                raise InputError(
                    f"weighting {self.text!r}: SLL = {level:g} dB; give a level from {LEAST_LEVEL:g} to {MOST_LEVEL:g} "
                    "dB, such as -35"
                )
        if self.name == "kaiser" and not 0 < self.parameters[0] <= MOST_BETA:
            raise InputError(
                f"weighting {self.text!r}: BETA = {self.parameters[0]:g}; give one above 0, up to {MOST_BETA:g}"
            )

    @classmethod
    def parse(cls, text: str) -> Taper:
        """Read NAME[:PARAMETER...], such as `taylor:4:-35`.

        Raises
        ------
        InputError
            If the text has another form, or as the taper itself.
        """
        name, *rest = str(text).strip().split(":")
        try:
            parameters = tuple(float(number) for number in rest)
        except ValueError:
            parameters = (math.nan,)
        if not all(map(math.isfinite, parameters)):
            raise InputError(f"weighting {str(text)[:80]!r} has a parameter that is no number; give {FORMS}")
        return cls(name[:80], parameters)  # type: ignore[arg-type]  # checked there

    @property
    def text(self) -> str:
        """The taper as `parse` reads it."""
        return ":".join([self.name, *(f"{value:.12g}" for value in self.parameters)])

    @property
    def uniform(self) -> bool:
        return self.name == "uniform"

    @property
    def series(self) -> tuple[FloatArray, float]:
        """a (n,) and q of w(v) = sum_k a_k cos(pi q k v): read-only."""
        return _series(self)

    def __call__(self, v: FloatArray) -> FloatArray:
        """w(v) (...), by its definition for |v| <= 1, and smooth and positive beyond."""
        if self.name == "kaiser":
            beta, away = self.parameters[0], 1 - np.square(v)
            within = np.i0(beta * np.sqrt(np.maximum(away, 0.0))) / np.i0(beta)
            # Its cosine series grows without limit there, into weights that would cancel for targets that are not lit.
            beyond = np.exp(-(beta**2) / 2 * np.clip(np.abs(v) - 1, 0.0, KAISER_BEYOND)) / np.i0(beta)
            return np.asarray(np.where(away >= 0, within, beyond))
        return _sum(*self.series, np.asarray(v, np.float64))

    def slope(self, v: FloatArray) -> FloatArray:
        """dw/dv (...) at v; that of "kaiser" beyond its ends as at them."""
        if self.name == "kaiser":
            v = np.clip(v, -1.0, 1.0)
        terms, frequency = self.series
        turns = np.pi * frequency * np.arange(terms.size)
        return np.asarray(-(terms * turns * np.sin(np.multiply.outer(v, turns))).sum(axis=-1))

    def samples(self, n: int) -> FloatArray:
        """w at v = (2k + 1 - n) / n, k = 0 .. n - 1."""
        return self((2 * np.arange(n) + 1 - n) / n)

    def on(self, axis: FloatArray, sampling: Sampling) -> FloatArray:
        """w at the samples of an axis (n,), by their place between its ends."""
        if sampling.even:
            return self.samples(axis.size)
        return self((2 * axis - axis[0] - axis[-1]) / (axis[-1] - axis[0] + sampling.step))

    def weights(self, axis: FloatArray, sampling: Sampling) -> FloatArray:
        """w times the share of each sample of an axis (n,)."""
        tapers = self.on(axis, sampling)
        return tapers if sampling.shares is None else tapers * sampling.shares

    def response(self, u: FloatArray) -> FloatArray:
        """The ideal response (n,), 1 at its peak: the mean of w(v) exp(1j pi v u), which is real, over that of w."""
        if self.uniform:
            return np.sinc(u)
        nodes, weights = solvers.gauss_legendre(NODES)
        shape = weights * self(nodes)
        return np.asarray((np.cos(np.pi * u[:, None] * nodes) * shape).sum(axis=1) / shape.sum())

    @property
    def ideal(self) -> IdealResponse:
        """Figures of the ideal response, from the definition."""
        return _ideal(self)

    @property
    def spread(self) -> float:
        """Integral of response^2 over u, the mean of w^2 over that of w, squared; 1 if uniform."""
        nodes, weights = solvers.gauss_legendre(NODES)
        values = self(nodes)
        return float(2 * (weights * values**2).sum() / (weights * values).sum() ** 2)


FLAT = Taper()


@dataclass(frozen=True, eq=False)
class DwellShape:
    """Weights of a point's dwell in the sum to an image, over v from -1 to 1 between its ends.

    v is the place of the line of sight between those at the dwell's ends, along the azimuth cut. It turns unevenly in
    time on a curved or accelerated track.

    Attributes
    ----------
    v : (n,) float
    weight : (n,) float
        w g times a quadrature's weight.
    square : (n,) float
        (w g)^2 times the same.
    """

    v: FloatArray
    weight: FloatArray
    square: FloatArray

    def response(self, u: FloatArray) -> FloatArray:
        """Magnitude of the ideal response (n,), 1 at its peak."""
        phasor = np.exp(1j * np.pi * u[:, None] * self.v)
        return np.asarray(np.abs((phasor * self.weight).sum(axis=1) / self.weight.sum()))

    @cached_property
    def ideal(self) -> IdealResponse:
        """Figures of the ideal response."""
        return ideal_figures(lambda u: self.response(u) ** 2)

    @property
    def spread(self) -> float:
        """Integral of |response|^2 over u; 1 for equal weights."""
        return float(2 * self.square.sum() / self.weight.sum() ** 2)


@dataclass(frozen=True)
class AxisTaper:
    """A taper over an interval of an axis, in the axis's unit: w(v) level(v), v = (value - centre) / half.

    `level` has the coefficients of a Legendre series; none for 1.
    """

    taper: Taper
    centre: float
    half: float
    level: tuple[float, ...] = ()

    @classmethod
    def over(cls, taper: Taper, start: float, step: float, n: int) -> AxisTaper | None:
        """The taper over n samples, each of which stands for a step; None if it is uniform."""
        return None if taper.uniform else cls(taper, start + (n - 1) / 2 * step, n / 2 * step)

    def __call__(self, values: FloatArray) -> FloatArray:
        v = (values - self.centre) / self.half
        if not self.level:
            return self.taper(v)
        return self.taper(v) * np.polynomial.legendre.legval(np.clip(v, -1.05, 1.05), np.array(self.level))


@dataclass(frozen=True)
class Weighting:
    """The tapers along range frequency and along the dwell."""

    range: Taper = FLAT
    azimuth: Taper = FLAT

    @classmethod
    def parse(cls, both: str = "uniform", range: str | None = None, azimuth: str | None = None) -> Weighting:
        """Read the tapers: `both`, unless one is given for an axis.

        Raises
        ------
        InputError
            As `Taper.parse`.
        """
        return cls(Taper.parse(both if range is None else range), Taper.parse(both if azimuth is None else azimuth))

    @property
    def uniform(self) -> bool:
        return self.range.uniform and self.azimuth.uniform

    @property
    def text(self) -> str:
        """The tapers in words."""
        if self.range == self.azimuth:
            return self.range.text
        return f"{self.range.text} in range, {self.azimuth.text} in azimuth"


UNIFORM = Weighting()


def _sum(a: FloatArray, q: float, v: FloatArray) -> FloatArray:
    """sum_k a_k cos(pi q k v), by Clenshaw's recurrence."""
    cosine = np.cos(np.pi * q * v)
    last, total = np.zeros_like(cosine), np.zeros_like(cosine)
    for term in a[:0:-1]:
        last, total = total, term + 2 * cosine * total - last
    return np.asarray(a[0] + cosine * total - last)


@lru_cache(maxsize=32)
def _series(taper: Taper) -> tuple[FloatArray, float]:
    frequency = 1.0
    match taper.name:
        case "uniform":
            a = np.ones(1)
        case "hamming":
            a = np.array([0.54, 0.46])
        case "hann":
            a = np.array([0.5, 0.5])
        case "taylor":
            a = np.concatenate([[1.0], 2 * taylor_coefficients(int(taper.parameters[0]), taper.parameters[1])])
        case "kaiser":
            frequency = 0.5
            # Beyond the ends, where I0(beta sqrt(1 - v^2)) would turn into a Bessel function, the series may take any
            # value.
            v = solvers.gauss_legendre(4 * KAISER_TERMS)[0]
            beta = taper.parameters[0]
            values = np.i0(beta * np.sqrt(1 - v**2)) / np.i0(beta)
            terms = np.cos(np.pi * frequency * np.arange(KAISER_TERMS)[:, None] * v)
            a = solvers.least_squares(terms, values, damping=1e-22)
    a.flags.writeable = False
    return a, frequency


def taylor_coefficients(nbar: int, level: float) -> FloatArray:
    """F_1 .. F_(nbar - 1) of Taylor's distribution, as in `scipy.signal.windows.taylor`; level in dB, negative."""
    a = math.acosh(10 ** (-level / 20)) / math.pi
    dilation = nbar**2 / (a**2 + (nbar - 0.5) ** 2)
    found = []
    for m in range(1, nbar):
        up = math.prod(1 - m**2 / (dilation * (a**2 + (i - 0.5) ** 2)) for i in range(1, nbar))
        down = 2 * math.prod(1 - m**2 / i**2 for i in range(1, nbar) if i != m)
        found.append((-1) ** (m + 1) * up / down)
    return np.array(found)


@lru_cache(maxsize=32)
def _ideal(taper: Taper) -> IdealResponse:
    if taper.uniform:
        return IdealResponse(SINC_WIDTH, SINC_PSLR, SINC_ISLR)
    return ideal_figures(lambda u: taper.response(u) ** 2)


def ideal_figures(power: Callable[[FloatArray], FloatArray]) -> IdealResponse:
    """Figures of a response, from its power at u (n,), 1 at u = 0 and even in u, where u = 1 is 1 / band."""
    low, high = 0.0, 4.0  # the main lobe falls below half within: hann's, the widest but Kaiser's, at 0.72
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if power(np.array([middle]))[0] > 0.5 else (low, middle)
    width = 2 * low
    u = np.arange(int(CUT_WIDTHS * STEPS_PER_WIDTH) + 1) * width / STEPS_PER_WIDTH
    response = power(u)
    first = int(np.flatnonzero(response[1:] > response[:-1])[0])
    energy = np.concatenate([[0.0], np.cumsum((response[1:] + response[:-1]) / 2)])
    side = energy[-1] - energy[first]
    return IdealResponse(
        width, float(10 * np.log10(response[first:].max())), float(10 * np.log10(side / energy[first]))
    )
