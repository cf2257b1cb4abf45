"""Interference: what echoes never do stands out, and cutting it leaves targets their amplitude."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from blocksar.errors import InputError
from blocksar.imaging.interference import FALSE_ALARMS, STANDS_OUT, Interference, cut_interference, over_medians

P, F = 256, 400
FREQUENCY = np.arange(F) - F / 2
METHODS = ("notch", "eigen")


def gaussian(rng: Any, *shape: int) -> Any:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def targets(rng: Any, count: int, *, doppler: float = 0.4) -> Any:
    """Targets of mean power 1 together, each with its delay (of the window) and Doppler (of the PRF)."""
    delay, rate = rng.uniform(-0.5, 0.5, count), rng.uniform(-doppler, doppler, count)
    value = gaussian(rng, count) / np.sqrt(count)
    over = np.exp(2j * np.pi * rate[:, None] * np.arange(P))
    return (value[:, None] * over).T @ np.exp(-2j * np.pi * delay[:, None] * FREQUENCY)


def tone(rng: Any, at: float, db: float, *, share: float = 1.0) -> Any:
    """A tone of random phase in each pulse, of `db` over power 1, cut off by the ends of the window."""
    course = np.exp(2j * np.pi * rng.uniform(size=P)) * (rng.uniform(size=P) < share) / np.sqrt(share)
    return course[:, None] * np.sinc(np.arange(F) - at) * np.sqrt(F) * 10 ** (db / 20)


def band(rng: Any, first: int, width: int, db: float) -> Any:
    """Noise of a few frequencies, `db` over power 1."""
    out = np.zeros((P, F), complex)
    out[:, first : first + width] = gaussian(rng, P, width) * np.sqrt(F / width) * 10 ** (db / 20)
    return out


def clean(kind: str, rng: Any) -> Any:
    noise = 0.1 * gaussian(rng, P, F)
    if kind == "noise":
        return noise
    if kind == "one target":
        return targets(rng, 1) + noise
    if kind == "two targets":
        return targets(rng, 2) + noise
    if kind == "alike in all pulses":
        return targets(rng, 300, doppler=0.0) + noise / 100
    if kind == "near one another":  # fringes as wide as the band
        return noise / 100 + 1 + gaussian(rng, 1) * np.exp(-0.06j * FREQUENCY)
    if kind == "half of the band":
        return (targets(rng, 300) + noise) * np.where(np.abs(FREQUENCY) < F / 4, 1, 1e-3)
    return targets(rng, 300) + noise


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "kind",
    ["noise", "one target", "two targets", "alike in all pulses", "near one another", "half of the band", "clutter"],
)
def test_nothing_is_cut_from_echoes(kind: str, method: Any) -> None:
    rng = np.random.default_rng(1)
    for _ in range(4):
        signal = clean(kind, rng).astype(np.complex64)
        left = signal.copy()
        found = cut_interference(left, method=method)
        assert found.affected == 0 and found.groups == 2 and not found.lines
        np.testing.assert_array_equal(left.view(np.int32), signal.view(np.int32))


def test_false_alarms_are_as_rare_as_stated() -> None:
    """The worst echoes: power at a frequency is exponential. The law is measured where it can be counted."""
    rng, trials = np.random.default_rng(2), 400
    cells = rng.exponential(size=(trials, 1, F))
    ratio = np.stack([over_medians(np.sqrt(one).astype(complex), np.ones((1, F), bool)) for one in cells])
    # A median of 100 cells varies by 1 / sqrt(100) / ln 2, which makes rare ratios more frequent.
    for rate, more in ((1e-2, 1.2), (1e-3, 1.3), (1e-4, 2.0)):
        assert np.mean(ratio * np.log(2) > np.log(1 / rate)) < rate * more
    assert pytest.approx(np.log(1 / FALSE_ALARMS) / np.log(2)) == STANDS_OUT
    assert ratio.max() < STANDS_OUT


CASES: dict[str, Any] = {
    "tone at a frequency": lambda rng: tone(rng, 123.0, 20),
    "1 MHz of 100": lambda rng: band(rng, 200, 4, 40),
    "pulsed 1 MHz of 100": lambda rng: band(rng, 200, 4, 30) * (rng.uniform(size=(P, 1)) < 0.1),
    "tone": lambda rng: tone(rng, 123.4, 20),
    "strong tone": lambda rng: tone(rng, 123.5, 40),
    "pulsed tone": lambda rng: tone(rng, 77.3, 40, share=0.2),
    "several": lambda rng: tone(rng, 123.4, 30) + band(rng, 200, 4, 40) + tone(rng, 300.3, 20),
}


@pytest.mark.parametrize(
    ("method", "case"),
    [*(("notch", case) for case in list(CASES)[:3]), *(("eigen", case) for case in CASES)],
)
def test_interference_is_cut_and_targets_keep_their_amplitude(method: Any, case: str) -> None:
    rng = np.random.default_rng(3)
    echoes, noise = targets(rng, 200), gaussian(rng, P, F)
    signal = (echoes + noise + CASES[case](rng)).astype(np.complex64)
    found = cut_interference(signal, method=method)
    valid = np.isfinite(signal)
    lost = 1 - valid.mean()
    assert found.affected == 2 and found.cut == (~valid).sum() and 0 < lost < 0.06
    # All targets together, by their own echoes: the image of each is the mean over valid samples. The noise's part is
    # 1 / sqrt(P F); what r courses of P take varies from target to target, and between 200 by 1 / sqrt(200).
    kept = (signal[valid] * echoes[valid].conj()).sum() / (np.abs(echoes[valid]) ** 2).sum()
    assert abs(kept - 1) < 0.01
    # In the mean over valid samples, the noise rises by what is lost; what is left of the interference adds little.
    left = np.mean(np.abs(signal[valid] - echoes[valid]) ** 2) / np.mean(np.abs(noise) ** 2) / valid.mean()
    assert abs(10 * np.log10(left)) < 0.5


def test_a_notch_leaves_what_leaks() -> None:
    """As its page says: what the window's ends spread over the band does not stand out, and is left."""
    rng = np.random.default_rng(4)
    echoes = targets(rng, 200) + gaussian(rng, P, F)
    signal = (echoes + tone(rng, 123.5, 40)).astype(np.complex64)
    cut_interference(signal, method="notch")
    assert np.nanmean(np.abs(signal - echoes) ** 2) > 10


@pytest.mark.parametrize("method", METHODS)
def test_missing_and_empty_pulses_stay_as_they_are(method: Any) -> None:
    rng = np.random.default_rng(5)
    signal = (targets(rng, 50) + gaussian(rng, P, F) + tone(rng, 123.4, 30)).astype(np.complex64)
    signal[7], signal[20:30], signal[40, 5] = np.nan, 0, np.inf
    cut_interference(signal, method=method)
    assert np.isnan(signal[7]).all() and (signal[20:30] == 0).all() and np.isinf(signal[40, 5])
    assert np.isfinite(np.delete(signal, [7, 40], axis=0)).mean() > 0.85


def test_a_receive_window_that_does_not_follow_the_range() -> None:
    """Of a raw echo the samples were turned by the reference range: the leak is the same in all pulses before that."""
    rng = np.random.default_rng(6)
    delay = 0.4 * np.arange(P)  # cells of delay
    turn = np.exp(2j * np.pi * np.outer(delay, FREQUENCY / F))
    echoes = targets(rng, 200) + gaussian(rng, P, F)
    for cycles, most in (((delay, FREQUENCY / F), 0.3), (None, 1e9)):
        signal = ((echoes + tone(rng, 123.5, 30)) * turn).astype(np.complex64)
        cut_interference(signal, method="eigen", cycles=cycles)
        left = np.nanmean(np.abs(signal - echoes * turn) ** 2)
        assert left < most


def test_merging_and_words() -> None:
    parts = [
        Interference(groups=1, affected=1, lines=[[3, 5]], cut=20, samples=100, peak=1e4, removed=1e3, kept=10.0),
        Interference(groups=1, affected=0, lines=[], cut=0, samples=100, peak=0.0, removed=0.0, kept=90.0),
        Interference(
            groups=1, affected=1, lines=[[4, 6], [9, 10]], cut=30, samples=100, peak=1e3, removed=0.0, kept=0.0
        ),
    ]
    whole = Interference.merge(parts)
    assert whole.lines == [[3, 6], [9, 10]] and (whole.groups, whole.affected, whole.cut) == (3, 2, 50)
    assert Interference(**whole.as_dict()) == whole
    words = whole.sentence("notch", 9e9 + 1e6 * np.arange(12))
    assert "2 lines at 9002.50-9005.50, 9008.50-9009.50 MHz, in 2 of 3 groups of pulses, up to 40 dB" in words
    assert "+10 dB of the rest's energy" in words and "16.7% of the samples are missing" in words
    assert "nothing is cut" in parts[1].sentence("eigen", np.arange(12.0))


def test_too_few_frequencies_are_refused() -> None:
    with pytest.raises(InputError, match="--interference needs at least 64 range frequencies"):
        cut_interference(np.ones((100, 63), np.complex64), method="notch")
