"""Real samples where complex ones belong: named, in arrays, datasets and stores, with remedies that work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arrays import arrays
from near_range import CARRIER, RANGE, SPEED_OF_LIGHT, TARGETS, near_range
from scipy.signal import hilbert

import blocksar
from blocksar.errors import InputError

HALF = "half its amplitude, and a mirror image; give the analytic signal of what was recorded, np.conj"


def referenced(given: dict[str, Any]) -> Any:
    """exp(4j pi (carrier + range frequency) reference / c), (n_range_frequency,)."""
    frequency = given["carrier_frequency"] + given["range_frequency"]
    return np.exp(4j * np.pi / SPEED_OF_LIGHT * frequency * given["reference_range"])


def beats(given: dict[str, Any]) -> Any:
    """The real samples that a receiver without quadrature records: nobody has removed the reference phase."""
    return (given["signal"] * np.conj(referenced(given))).real


WRONG = {
    "floats": (beats, "signal is float64, but must be complex64: of real samples"),
    "counts": (lambda given: (1000 * beats(given)).astype(np.int16), "signal is int16, but must be complex64: of real"),
    "counts about a middle level": (lambda given: (1000 * beats(given) + 4000).astype(np.uint16), "nowhere negative"),
    "no imaginary part": (lambda given: beats(given).astype(np.complex64), "signal has no imaginary part: of real"),
    "taken after the reference": (lambda given: given["signal"].real.astype(complex), "signal has no imaginary part"),
    "with the phase of the reference": (
        lambda given: (beats(given) * referenced(given)).astype(np.complex64),
        "signal is real but for the phase of reference_range: of real samples",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("scene", [arrays, near_range])
def test_real_samples_are_refused_where_a_collection_is_made(scene: Any, kind: str) -> None:
    given = scene()
    make, said = WRONG[kind]
    with pytest.raises(InputError) as caught:
        blocksar.collection(**{**given, "signal": make(given)})
    assert said in str(caught.value)
    assert (HALF in str(caught.value)) != (kind == "counts about a middle level")


@pytest.mark.parametrize(
    "values",
    [
        np.ones((300, 256), complex),  # a target at the reference range
        -0.5 * np.ones((300, 256), complex),
        1j * np.ones((300, 256)),
        np.where(np.arange(300) < 150, 1.0, np.nan)[:, None] * np.ones((300, 256), complex),
    ],
)
def test_one_target_at_the_reference_range_is_none_of_them(values: Any) -> None:
    blocksar.collection(**{**near_range(), "signal": values})


def test_two_equal_targets_are_none_of_them() -> None:
    """They are real about the range midway between them, which differs from the reference."""
    blocksar.collection(**near_range(targets=[(0.5, 0.2, 0.0), (-0.5, -0.2, 0.0)]))


@pytest.mark.slow
@pytest.mark.checked
@pytest.mark.parametrize("processor", ["angular-division", "backprojection"])
def test_a_store_with_real_samples_is_neither_checked_nor_focused(processor: Any, tmp_path: Path) -> None:
    given = near_range()
    dataset = blocksar.collection(**given)
    dataset["signal"] = dataset["signal"].copy(data=beats(given).astype(np.complex64))
    dataset.to_zarr(tmp_path / "ph.zarr", zarr_format=3, consolidated=False)
    grid = "-0.2:0.2:0.05,-0.2:0.2:0.05"
    with pytest.raises(InputError, match="signal has no imaginary part"):
        blocksar.check(tmp_path / "ph.zarr", grid=grid)
    with pytest.raises(InputError, match="signal has no imaginary part"):
        blocksar.focus(tmp_path / "ph.zarr", tmp_path / "run", grid=grid, workers=0, processor=processor)


def peaks(folder: Path) -> list[complex]:
    image = blocksar.open(folder)["image"]
    return [complex(image.sel(x=x, y=y, method="nearest")) for x, y, _ in TARGETS]


def test_the_analytic_signal_of_dechirped_beats_gives_the_image(tmp_path: Path) -> None:
    """As the message says. The ends of a pulse, where the beat is cut, leave some per cent."""
    given = near_range()
    signal = np.conj(hilbert(beats(given), axis=-1)) * referenced(given)
    grid = "-1.2:1.2:0.02,-1:1:0.02"
    dataset = blocksar.collection(**{**given, "signal": signal})
    blocksar.focus(dataset, tmp_path / "run", grid=grid, workers=0, processor="backprojection")
    assert [abs(value) for value in peaks(tmp_path / "run")] == pytest.approx([1.0] * len(TARGETS), abs=0.03)


def test_samples_whose_phase_nobody_has_removed_are_taken_close_by(tmp_path: Path) -> None:
    """Half a range window reaches the ground: a reference range of 0 is right, and was refused."""
    given = near_range()
    signal = given["signal"] * np.conj(referenced(given))
    dataset = blocksar.collection(**{**given, "signal": signal, "reference_range": 0.0})
    grid = "-1.2:0.7:0.02,-1:1:0.02"
    blocksar.focus(dataset, tmp_path / "run", grid=grid, workers=0, processor="backprojection")
    assert np.abs(np.array(peaks(tmp_path / "run")[:2]) - 1).max() < 0.02
    with pytest.raises(InputError, match="reference_range is 0 m; give R0"):
        blocksar.collection(**{**arrays(), "reference_range": 0.0})
    with pytest.raises(InputError, match="reference_range is -1 m; give R0"):
        blocksar.collection(**{**given, "reference_range": -1.0})


def test_the_analytic_signal_of_an_echo_at_an_intermediate_frequency_is_the_echo() -> None:
    """As the message says: within the pulse, away from its ends, to a per cent."""
    rate, width, middle = 2e12, 20e-6, 60e6  # Hz/s, s, Hz: 40 MHz about 60 MHz
    fast = np.arange(16384) / 400e6
    delay = 10e-6 + 10e-9 * np.arange(8)[:, None]
    inside = np.abs(fast - delay - width / 2) <= width / 2
    baseband = inside * np.exp(1j * np.pi * rate * (fast - delay - width / 2) ** 2 - 2j * np.pi * CARRIER * delay)
    recorded = 2 * (baseband * np.exp(2j * np.pi * middle * fast)).real
    found = hilbert(recorded, axis=-1) / 2 * np.exp(-2j * np.pi * middle * fast)
    within = np.abs(fast - delay - width / 2) <= 0.45 * width
    assert np.abs(found - baseband)[within].max() < 0.01
    given = {name: value for name, value in near_range(n_pulse=8).items() if name not in ("signal", "range_frequency")}
    echo = {"fast_time": fast, "chirp_rate": rate, "pulse_width": width, **given, "reference_range": RANGE}
    for wrong in (recorded, recorded.astype(complex)):
        with pytest.raises(InputError, match=r"half its amplitude.*hilbert\(recorded, axis=-1\), times exp\(-2j pi f"):
            blocksar.collection(**{**echo, "echo": wrong})
