"""The dwell gate: it limits each Doppler of the image to the dwell of its targets.

Under a weighting over dwells, the windows in time also apply it.

After the steps in Doppler, dwells differ in length from target to target, and the beam's centre need not pass amid
their ends. So a dwell is divided there, at its middle, into two halves. A window rises over one half, from its end to
the middle, and stays at the middle's weight beyond. There are windows for a few lengths of each half: the image of a
target is blended from those by its own length.

Along a half, the *share* is 0 at the end of the dwell and 1 in its middle, and v is the place in the beam, 0 in its
centre to 1 at its edge. A weighting is a function of v. Windows are made for times *since* the end of a dwell, s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.weighting import Taper
from blocksar.kernels.fourier import Axis, fast_length, fft_rows
from blocksar.kernels.fresnel import smeared_step
from blocksar.kernels.operations import BLEND_BEYOND
from blocksar.processors.chain.steps.lines import RowPolynomial

Step = Callable[[FloatArray, float], NDArray[np.complex128]]  # (times since an end, s; slope, s/Hz) -> its smeared step
RISE_SAMPLES = 256  # at least, of the grid on which a window is smeared, over its half
SMEARS = 12.0  # sqrt(e) beyond which the smear is small


@dataclass(frozen=True, kw_only=True, eq=False)
class HalfDwell:
    """Half of the dwells, from one end to the middle.

    Attributes
    ----------
    length : RowPolynomial
        Along Doppler, s.
    lengths : tuple of float
        Those for which windows are made, equally spaced, s.
    """

    length: RowPolynomial
    lengths: tuple[float, ...]

    def blended(self, taper: Taper, since: FloatArray, length: FloatArray) -> FloatArray:
        """Amplitude (..., n), over the middle's, that blended windows give echoes at times since the dwell's end, s.

        Over the middle's weight.
        """
        count, total = len(self.lengths), np.zeros(np.broadcast_shapes(since.shape, length.shape))
        apart = max(self.lengths[-1] - self.lengths[0], 1e-12)
        at = np.clip((length - self.lengths[0]) / apart, *BLEND_BEYOND) * (count - 1)
        for k, window in enumerate(self.lengths):
            share = math.prod((at - other) / (k - other) for other in range(count) if other != k)
            total += share * taper(np.clip(1 - since / window, 0.0, 1.0))
        return total / float(taper(np.array(0.0)))

    def blending(self, rng: FloatArray) -> FloatArray:
        """Polynomial along Doppler, (n, order + 1), of the place 0 .. 1 of a half's length among `lengths`."""
        coefficients = self.length.coefficients(rng)
        coefficients[:, 0] -= self.lengths[0]
        return coefficients / max(self.lengths[-1] - self.lengths[0], 1e-12)


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellTaper:
    """Weighting over dwells, and the two halves of a dwell."""

    taper: Taper
    begin: HalfDwell
    end: HalfDwell

    def rises(self, half: HalfDwell, since: FloatArray, *, slope: float, step: Step) -> list[NDArray[np.complex128]]:
        """Windows (n,) over one half of the dwell, one for each of its lengths, relative to the middle's weight.

        They are convolved with the Fresnel kernel of the area `slope` > 0, s/Hz (`dwell_gate`), as `step` is.
        """
        stepped = step(since, slope)
        return [stepped_rise(self.taper, since, length, stepped, slope=slope) for length in half.lengths]


def stepped_rise(
    taper: Taper, since: FloatArray, length: float, step: NDArray[np.complex128], *, slope: float
) -> NDArray[np.complex128]:
    """Rise of a taper over `length`, s, then 1, at uniform times since the end: (n,).

    `step` is the smeared step there, which the taper begins by. The rest is continuous, and is smeared by a transform.
    Its curvature jumps at both ends of the half: where a half is not much longer than its smear, that counts.
    """
    edge = float(taper(np.array(1.0)) / taper(np.array(0.0)))

    def rest(time: FloatArray) -> FloatArray:
        return np.where(time > 0, taper(np.clip(1 - time / length, 0, 1)) / taper(np.array(0.0)) - edge, 0.0)

    finer = math.ceil(abs(float(since[1] - since[0])) * RISE_SAMPLES / length)
    return edge * step + _smeared(rest, since, length, slope=slope, finer=finer)


def _smeared(
    profile: Callable[[FloatArray], FloatArray], since: FloatArray, length: float, *, slope: float, finer: int
) -> NDArray[np.complex128]:
    """A profile of the times since an end, convolved with the Fresnel kernel of the area `slope`: (n,).

    By a transform on a finer grid that goes on at both ends, where what the transform wraps around can fade out.
    """
    step, beyond = abs(float(since[1] - since[0])), max(length / 2, SMEARS * math.sqrt(slope))
    before = math.ceil(beyond / step)
    size = fast_length((since.size + 2 * before) * finer)
    fine = min(float(since[0]), float(since[-1])) + (np.arange(size) - before * finer) * step / finer
    values = profile(fine) * np.clip(2 * (fine[-1] - fine) / beyond, 0, 1)
    frequency = (np.arange(size) + size // 2) % size - size // 2
    kernel = np.exp(-1j * np.pi * slope * (frequency * finer / (size * step)) ** 2)
    spectrum = fft_rows(values[None].astype(np.complex128), inverse=False)
    window = fft_rows(spectrum * kernel, inverse=True)[0, before * finer :: finer][: since.size]
    return window if since[1] > since[0] else window[::-1]


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

    The keystone scales time by 1 + f / fc, so a dwell does not end at the same time for all range frequencies. The
    window that differs least from steps at times spread evenly over +-`blur` is their mean: it loses a third less than
    a sharp one. A target whose end lies inside that mean at some range frequencies, and outside it at others, then
    lacks some of its sum over band and dwell: blur / 3 at each end under equal weights. So just inside the end windows
    are raised, by a triangle of the height `lift` from 0 to 4 blurs, which has what is lacking.

    Under a weighting, each window rises (or falls) as the taper does, from its end to the dwell's middle, and stays at
    the middle's weight beyond (`DwellTaper`). That scaling also moves the slopes of a taper, which windows do not
    follow: `processors.chain.planning.prediction` counts it.

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
    lift : float
        By how much windows are raised just inside an end, relative to the weight there.
    length : float
        The mean dwell after all steps, s.
    time : Axis
        Slow time after the gate, about 0, s.
    taper : DwellTaper or None
        None where all of a dwell has equal weights.
    """

    begin: RowPolynomial
    end: RowPolynomial
    common: RowPolynomial
    begin_slope: RowPolynomial
    end_slope: RowPolynomial
    blur: float
    lift: float
    length: float
    time: Axis
    taper: DwellTaper | None = None

    def window(self, slope: float, end: Literal["begin", "end"]) -> ComplexArray:
        """Window of the gate over `time` for one end of the dwell, complex64; it fades out far beyond the other end."""
        time = self._time_towards_middle(end)
        return self._fade_out(self._step(time + self.length / 2, abs(slope)), slope, time)

    def tapered_windows(self, slope: float, end: Literal["begin", "end"]) -> ComplexArray:
        """Windows of one end under the taper, one for each length: (n, time.size) complex64."""
        assert self.taper is not None
        time = self._time_towards_middle(end)
        half = self.taper.begin if end == "begin" else self.taper.end
        rises = self.taper.rises(half, time + self.length / 2, slope=abs(slope), step=self._step)
        if end == "end":  # the weight of the middle counts once
            rises = [rise * float(self.taper.taper(np.array(0.0))) for rise in rises]
        return np.stack([self._fade_out(rise, slope, time) for rise in rises])

    def _step(self, since: FloatArray, slope: float) -> NDArray[np.complex128]:
        """Smeared step (n,) at times since an end, s, raised just inside of it by `lift`."""
        step = smeared_step(since, slope=slope, blur=self.blur)
        if self.lift:
            rise, fall = (smeared_step(since - n * self.blur, slope=slope, blur=self.blur) for n in (1, 3))
            step += self.lift * (rise - fall)
        return step

    def _time_towards_middle(self, end: Literal["begin", "end"]) -> FloatArray:
        """Time after the gate, s, that grows from one end of the dwell, at -length / 2, to the other at length / 2."""
        return self.time.values if end == "begin" else -self.time.values

    def _fade_out(self, rise: NDArray[np.complex128], slope: float, time: FloatArray) -> ComplexArray:
        """Make the window of a slope from the rise for |slope|, faded out between length / 2 and the last time."""
        room = (self.time.extent - self.length) / 2
        fall = np.clip((time - self.length / 2) / room * (1 + FADE_START) - FADE_START, 0, 1)
        window = rise * np.cos(np.pi / 2 * fall) ** 2
        return (window if slope > 0 else window.conj()).astype(np.complex64)

    def halves(
        self, rng: FloatArray, doppler: FloatArray, time: FloatArray
    ) -> tuple[tuple[HalfDwell, FloatArray, FloatArray], ...]:
        """Both halves of a tapered dwell, with the share (..., n) of each at `time`, and the lengths (..., 1), s.

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
