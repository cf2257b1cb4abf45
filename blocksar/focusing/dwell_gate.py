"""The dwell gate: limits each Doppler of the image to its own dwell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.weighting import AxisTaper, Taper
from blocksar.focusing.lines import RowPolynomial
from blocksar.kernels.fourier import Axis, fast_length, fft_rows

FAR = 8.0  # from which on the asymptotic series of the Fresnel integrals is used
# (2 k - 1)!! in pairs of odd and even k: the last term is 1e-14 of the first there.
FAR_SERIES = tuple(
    (float(math.prod(range(1, 4 * m + 2, 2))), float(math.prod(range(1, 4 * m + 4, 2)))) for m in range(6)
)
FADE_SAMPLES = 16  # at least, of the grid on which a faded window is made, over its fade
SMEARS = 12.0  # sqrt(e) beyond which the smear of a faded window is small
FADE_START = 0.5  # of the fall's length, from the dwell's other end to where a window begins to fade out


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellGate:
    """Limit each Doppler of the image to its own dwell, as back-projection does, so that fewer samples suffice.

    The final transform sums over all of slow time, so the sharp ends of other targets' dwells leave side lobes.
    Back-projection sums over the pixel's own lit pulses and has none; on clutter the difference costs 0.005 of
    coherence. A step H(t - e(f)) in time, at an end e of the dwell that moves along Doppler, is a convolution in
    Doppler. With psi' = e, and exactly where e is linear, it is

        S(f) -> exp(-2j pi psi) F{ G(t) F^-1{ exp(2j pi psi) S } },
        G(t) = integral of H(t - u) exp(j pi u^2 / e') / sqrt(j e') du,

    a Fresnel-smoothed step. The two ends are gated one after the other, since after the steps in Doppler the dwells
    differ in length. Between these transforms all targets lie about t = 0, so the later ones are short.

    A step in Doppler that delays by D(f) turns a sharp end after it into a smeared one before it. The smear is again
    that of a Fresnel integral, with D' in place of e', and adds to it: with e' + D' instead of e' the dwell has sharp
    ends at the time when the target was lit, as in back-projection, for the targets with a D' amid those of the block.
    In the time after a step that stretches lines by s, its smear is s D'; ends that fade out are made with that.

    The keystone scales time by 1 + f / fc, so a dwell does not end at the same time for all range frequencies. The
    window that differs least from steps at times spread evenly over +-`blur` is their mean: it loses a third less than
    a sharp one.

    Under a weighting, each window rises (or falls) as the taper does, from its end to the dwell's middle, and stays at
    the middle's weight beyond: `DwellTaper`. It begins from zero where the edges of dwells are back-projected
    (`dwell_edges`), and then `blur` has no effect.

    That scaling also moves the slopes of a taper, and ends that fade out. Where this costs too much, the band is
    divided by Lagrange's polynomials L_k(f) through a few frequencies f_k: images of the samples times L_k, each with
    windows for dwells as they are at f_k, add up to one whose windows follow f to the order of the polynomials.

    Attributes
    ----------
    begin, end : RowPolynomial
        psi(r, f) of the two ends, cycles, with the ends moved by half of `length` to t = 0.
    common : RowPolynomial
        psi of the dwell's middle at the middle range, for all rows. It stays applied, so that the image can be sampled
        coarsely in Doppler.
    begin_slope, end_slope : RowPolynomial
        One coefficient each, e'(r) + D', s/Hz.
    blur : float
        Half of the time over which an end is spread, s.
    length : float
        The mean dwell after all steps, s.
    time : Axis
        Slow time after the gate, about 0, s.
    taper : DwellTaper or None
        None where all of a dwell has equal weights.
    share : AxisTaper or None
        L_k over range frequency, Hz; None for all of the band.
    """

    begin: RowPolynomial
    end: RowPolynomial
    common: RowPolynomial
    begin_slope: RowPolynomial
    end_slope: RowPolynomial
    blur: float
    length: float
    time: Axis
    taper: DwellTaper | None = None
    share: AxisTaper | None = None

    def begin_window(self, slope: float) -> ComplexArray:
        """G over `time` for the dwell's begin, (time.size,) complex64; it fades out well after the end."""
        return self._window(slope, self.time.values)

    def end_window(self, slope: float) -> ComplexArray:
        """G over `time` for the dwell's end, (time.size,) complex64; it fades out well before the begin."""
        return self._window(slope, -self.time.values)

    def _window(self, slope: float, time: FloatArray) -> ComplexArray:
        """A smeared step up at -length / 2, times a smooth fall from 1 to 0 between length / 2 and the last time."""
        return self._faded(smeared_step(time + self.length / 2, slope=abs(slope), blur=self.blur), slope, time)

    def tapered_windows(self, slope: float, end: Literal["begin", "end"]) -> ComplexArray:
        """The windows of one end under the taper, one for each of its lengths: (n, time.size) complex64."""
        assert self.taper is not None
        half = self.taper.begin if end == "begin" else self.taper.end
        time = self.time.values if end == "begin" else -self.time.values
        since = time + self.length / 2
        if self.taper.fade:
            rises = [
                half.faded_rise(
                    since, length, taper=self.taper.taper, slope=abs(slope), fade=self.taper.fade, knots=knots
                )
                for length, knots in zip(half.lengths, half.knots or [None] * len(half.lengths), strict=True)
            ]
        else:
            step = smeared_step(since, slope=abs(slope), blur=self.blur)
            rises = [
                half.rise(since, length, step, taper=self.taper.taper, slope=abs(slope)) for length in half.lengths
            ]
        if end == "end":  # the weight of the middle counts once
            rises = [rise * float(self.taper.taper(np.array(0.0))) for rise in rises]
        return np.stack([self._faded(rise, slope, time) for rise in rises])

    def halves(
        self, rng: FloatArray, doppler: FloatArray, time: FloatArray
    ) -> tuple[tuple[HalfDwell, FloatArray, FloatArray], ...]:
        """Of a gate with a taper: both halves, the shares of them at which `time` (..., n) lies, and their lengths.

        Targets (...) focus at ranges `rng`, m, and `doppler`, Hz. Shares are 0 at the end and 1 in the middle of the
        dwell; lengths (..., 1) are in s.
        """
        assert self.taper is not None
        found = []
        for half, phase, side in ((self.taper.begin, self.begin, 1.0), (self.taper.end, self.end, -1.0)):
            end = phase.evaluate(rng, doppler[..., None])[1] - side * self.length / 2
            length = half.length.evaluate(rng, doppler[..., None])[0]
            found.append((half, np.asarray(side * (time - end) / length), length))
        return tuple(found)

    def levels(self, rng: FloatArray, doppler: FloatArray, time: FloatArray) -> FloatArray | float:
        """Factors (..., n) by which the windows raise weights at times of targets, as in `halves`; 1 where none do."""
        if self.taper is None or not (self.taper.begin.level or self.taper.end.level):
            return 1.0
        (begin, since, _), (end, until, _) = self.halves(rng, doppler, time)
        return np.where(since < 1, begin.levels(since), 1.0) * np.where(until < 1, end.levels(until), 1.0)

    def _faded(self, step: NDArray[np.complex128], slope: float, time: FloatArray) -> ComplexArray:
        room = (self.time.extent - self.length) / 2
        fall = np.clip((time - self.length / 2) / room * (1 + FADE_START) - FADE_START, 0, 1)
        window = step * np.cos(np.pi / 2 * fall) ** 2
        return (window if slope > 0 else window.conj()).astype(np.complex64)


@dataclass(frozen=True, kw_only=True, eq=False)
class HalfDwell:
    """The half of the dwells from one end to the middle.

    After the steps in Doppler its length differs from target to target. The image is blended from those that windows of
    a few lengths would make.

    Attributes
    ----------
    length : RowPolynomial
        Along Doppler, s.
    lengths : tuple of float
        Those for which windows are made, equally spaced, s.
    edge : float
        The share of the half in which its edge fades out, where it does: over it the place in the beam changes by
        1 / fade. It differs from 1 / fade itself where targets pass the beam's edge faster or slower than its centre.
    knots : tuple of (float, float)
        With edges that fade out, for each of `lengths` the shares of it at which the edge is over, and at which v is
        1 / 2; none where v is linear.
    level : float
        By how much weights at the end of the half are raised over those in the middle, linearly in between: steps in
        Doppler that stretch a line in time by s have changed its amplitude by 1 / sqrt(s), its sum by sqrt(s).
    """

    length: RowPolynomial
    lengths: tuple[float, ...]
    edge: float = 0.0
    knots: tuple[tuple[float, float], ...] = ()
    level: float = 0.0

    def levels(self, share: FloatArray) -> FloatArray:
        """Factors by which weights are raised at shares of the half."""
        return np.asarray(1 + self.level * np.clip(1 - share, 0.0, 1.0))

    def place(self, share: FloatArray, fade: int, knots: Sequence[FloatArray | float] | None) -> FloatArray:
        """|v| at shares of the half, 0 at its end to 1 in the middle of the dwell."""
        if not fade:
            return np.clip(1 - share, 0.0, 1.0)
        outer = 1 - 1 / fade
        if knots is None:
            return np.interp(share, [0.0, self.edge, 1.0], [1.0, outer, 0.0])
        # The cubic through the end, where the edge is over, v = 1 / 2 and the middle.
        (edge, halfway), u = knots, np.clip(share, 0.0, 1.0)
        cubic = (u - edge) * (u - halfway) * (u - 1) / (-edge * halfway)
        cubic += outer * u * (u - halfway) * (u - 1) / (edge * (edge - halfway) * (edge - 1))
        cubic += 0.5 * u * (u - edge) * (u - 1) / (halfway * (halfway - edge) * (halfway - 1))
        return np.asarray(cubic)

    def share(self, rng: FloatArray) -> FloatArray:
        """Power coefficients along Doppler, (n, order + 1), of the place of a length among `lengths`, 0 .. 1."""
        coefficients = self.length.coefficients(rng)
        coefficients[:, 0] -= self.lengths[0]
        return coefficients / max(self.lengths[-1] - self.lengths[0], 1e-12)

    def rise(
        self, time: FloatArray, length: float, step: NDArray[np.complex128], *, taper: Taper, slope: float
    ) -> NDArray[np.complex128]:
        """The taper's first half over `length`, then 1, as a window in time since the end: (time.size,).

        `step` is the smeared step there, F. The taper begins by a step, of its weight at the end, and a ramp, which
        under the Fresnel integral of the slope e becomes t F(t) + (1j e / 2 pi) F'(t). The rest is smooth, so that each
        of its cosines, of rate k, is only multiplied by exp(-1j k^2 e / 4 pi).
        """
        terms, frequency = taper.series
        turns = np.pi * frequency * np.arange(terms.size)
        edge, pace = (terms * np.cos(turns)).sum(), (terms * turns * np.sin(turns)).sum() / length
        turned = terms * np.exp(-0.25j / np.pi * slope * (turns / length) ** 2)
        inside = (time > 0) & (time < length)
        rest = np.where(time > 0, terms.sum() - edge - pace * time, 0.0).astype(np.complex128)
        rest[inside] = (turned[:, None] * np.cos(np.outer(turns, time[inside] / length - 1))).sum(axis=0)
        rest[inside] -= edge + pace * time[inside]
        total = edge * step + rest
        if abs(pace) * length > 1e-9 * terms.sum():  # without blur, or the two terms would not cancel far from the end
            ramp = time * smeared_step(time, slope=slope, blur=0.0)
            total += pace * (ramp + np.sqrt(1j * slope) / (2 * np.pi) * np.exp(1j * np.pi / slope * time**2))
        return np.asarray(total / terms.sum())

    def faded_rise(
        self,
        time: FloatArray,
        length: float,
        *,
        taper: Taper,
        slope: float,
        fade: int,
        knots: tuple[float, float] | None = None,
    ) -> NDArray[np.complex128]:
        """The same for a taper that fades to zero over the first 1 / fade of the half, at uniform times.

        Convolved with the Fresnel kernel by a transform on a finer grid: a fade as narrow as this one is no short sum
        of cosines.
        """
        step, extra = abs(float(time[1] - time[0])), max(length / 2, SMEARS * math.sqrt(slope))
        finer = math.ceil(step * fade / length * FADE_SAMPLES)
        before = math.ceil(extra / step)
        size = fast_length((time.size + 2 * before) * finer)
        fine = min(float(time[0]), float(time[-1])) + (np.arange(size) - before * finer) * step / finer
        if knots is None:
            v = np.interp(fine, [0.0, self.edge * length, length], [1.0, 1 - 1 / fade, 0.0])
        else:
            v = self.place(fine / length, fade, knots)
        profile = faded(taper, v, fade) / taper(np.array(0.0)) * np.clip(2 * (fine[-1] - fine) / extra, 0, 1)
        if self.level:
            profile *= self.levels(fine / length)
        frequency = (np.arange(size) + size // 2) % size - size // 2
        turn = np.exp(-1j * np.pi * slope * (frequency * finer / (size * step)) ** 2)
        spectrum = fft_rows(profile[None].astype(np.complex128), inverse=False)
        window = fft_rows(spectrum * turn, inverse=True)[0, before * finer :: finer][: time.size]
        return window if time[1] > time[0] else window[::-1]


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellTaper:
    """The weighting over dwells, and the halves into which their middles divide them.

    With a positive `fade`, weights fade to zero over the last 1 / fade of each half (`dwell_edges`).
    """

    taper: Taper
    begin: HalfDwell
    end: HalfDwell
    fade: int = 0


def faded(taper: Taper, v: FloatArray, fade: int) -> FloatArray:
    """The taper at places v in the beam, -1 .. 1, times sin^2(pi fade (1 - |v|) / 2) for 1 - |v| < 1 / fade."""
    return taper(v) * np.sin(np.pi / 2 * np.clip(fade * (1 - np.abs(v)), 0, 1)) ** 2


def smeared_step(time: FloatArray, *, slope: float, blur: float) -> NDArray[np.complex128]:
    """The integral of H(t - u) exp(1j pi u^2 / e) / sqrt(1j e) du for e = `slope` > 0, a mean over +-`blur`."""
    scale = np.sqrt(2 / slope)
    z, reach = scale * time, max(scale * blur, 1e-4)
    mean = (fresnel_integral(z + reach) - fresnel_integral(z - reach)) / (2 * reach)
    return np.asarray(0.5 + mean * np.exp(-0.25j * np.pi) / np.sqrt(2))


def fresnel_integral(z: FloatArray) -> NDArray[np.complex128]:
    """Integral of the Fresnel integrals C + 1j S, up to a constant: z (C + 1j S) + (1j / pi) exp(1j pi z^2 / 2).

    Beyond FAR the asymptotic series of C and S is exact to 1e-14, and takes a third of the time. With x = pi z^2,

        |z| (1 + 1j) / 2 - (1 / pi) exp(1j x / 2) sum_k (2 k - 1)!! (-1j)^(k - 1) / x^k,    k = 1 .. 2 len(FAR_SERIES),

    summed over pairs of terms, odd and even k.
    """
    from scipy.special import fresnel  # slow to import, and a plan needs far values only

    far = np.abs(z) > FAR
    near = z[~far]
    sine, cosine = fresnel(near)
    integral = np.empty(z.shape, np.complex128)
    integral[~far] = near * (cosine + 1j * sine) + 1j * np.exp(0.5j * np.pi * near**2) / np.pi
    integral[far] = far_fresnel_integral(z[far])
    return integral


def far_fresnel_integral(z: FloatArray) -> NDArray[np.complex128]:
    """The same where all |z| are beyond FAR."""
    integral = np.empty(z.shape, np.complex128)
    x = np.pi * z**2
    inverse = 1 / x
    square, odd, even = inverse * inverse, np.zeros_like(x), np.zeros_like(x)
    for first, second in FAR_SERIES[::-1]:
        odd = first - square * odd
        even = second - square * even
    odd, even = odd * inverse / np.pi, even * square / np.pi
    cosine, sine, ahead = np.cos(x / 2), np.sin(x / 2), np.abs(z) / 2
    integral.real = ahead - (cosine * odd + sine * even)
    integral.imag = ahead - (sine * odd - cosine * even)
    return integral
