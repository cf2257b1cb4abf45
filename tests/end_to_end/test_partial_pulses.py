"""Raw echoes with pulses that are only partly recorded: no copies, targets at their places, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import raw_strips
import xarray as xr
from raw_strips import FAST_TIME, LENGTH, PULSE, RATE, SPEED_OF_LIGHT, STEP, TARGETS, Target, strip

import blocksar
from blocksar import stores
from blocksar.application.pulses import pulse_reader
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError
from blocksar.imaging.compression import RawCompression
from blocksar.imaging.noise import NoiseMap
from blocksar.inspection.samples import count_zero_gaps
from blocksar.processors.exact.sums import form_image

GRID = ((-1760.0, 1800.0, STEP), (-40.0, 40.0, STEP))


@pytest.fixture(scope="module")
def dataset() -> xr.Dataset:
    return blocksar.collection(**strip())


@pytest.fixture(scope="module")
def store(dataset: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(blocksar.write(dataset, tmp_path_factory.mktemp("strip") / "raw.zarr"))


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of the whole swath by a chain, with `notes.txt` of what the run said."""
    folder = tmp_path_factory.mktemp("run") / "run"
    report = blocksar.focus(store, folder, grid=GRID, workers=0, progress=False)
    folder.with_name("notes.txt").write_text("\n".join(report.summary))
    return folder


def exact(history: stores.PhaseHistory, x: np.ndarray, y: np.ndarray, weighting: str = "uniform") -> np.ndarray:
    geometry = Geometry(collection=history.collection.centred())
    return form_image(pulse_reader(history), geometry, x, y, threads=2, weighting=Weighting.parse(weighting))


def at(image: xr.Dataset, target: Target) -> complex:
    return complex(image["image"].sel(x=target.x, y=target.y))


def test_a_pulse_beyond_the_window_has_no_copy_at_its_other_end() -> None:
    """A satellite's echo of a target a quarter of a pulse beyond the window: 16 km nearer nothing is to be seen."""
    rate, pulse, sampling, carrier, prf, n, m = -7.2135e11, 41.75e-6, 32.317e6, 5.3e9, 1256.98, 2048, 128
    middle, height, speed, c = 995142.0, 800e3, 7062.0, SPEED_OF_LIGHT
    fast, time = 2 * middle / c + (np.arange(n) - n // 2) / sampling, (np.arange(m) - m // 2) / prf
    nadir, half = -np.sqrt(middle**2 - height**2), n / sampling * c / 4
    track = np.stack([0 * time + nadir, speed * time, 0 * time + height], axis=1)
    beyond = middle + half + pulse * c / 8
    x = nadir + np.sqrt(beyond**2 - height**2)
    away = np.linalg.norm(track - [x, 0, 0], axis=1)[:, None]
    delay = fast - 2 * away / c
    phase = np.pi * rate * delay**2 - 4 * np.pi * carrier / c * (away - middle)
    dataset = blocksar.collection(
        echo=np.where(np.abs(delay) <= pulse / 2, np.exp(1j * phase), 0), fast_time=fast, chirp_rate=rate,
        pulse_width=pulse, time=time, antenna_position=track, reference_range=middle, carrier_frequency=carrier,
    )  # fmt: skip
    history = stores.history_of(dataset).with_partial_pulses()
    offsets, along = np.arange(-300, 300, 3.0), np.arange(-150, 150, 30.0)
    true = np.abs(exact(history, x + offsets, along))
    assert true.max() == pytest.approx(1, abs=0.02)
    assert np.unravel_index(true.argmax(), true.shape) == (5, 100)
    false = exact(history, nadir + np.sqrt((beyond - 2 * half) ** 2 - height**2) + offsets, along)
    assert np.abs(false).max() < 1e-3  # -60 dB; -14 dB where pulses fold


@pytest.mark.parametrize("rate", [RATE, -RATE])
@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35", "hann"])
def test_targets_with_parts_of_pulses_have_place_amplitude_and_phase(rate: float, weighting: str) -> None:
    history = stores.history_of(blocksar.collection(**strip(rate=rate))).with_partial_pulses()
    offsets = np.arange(-40, 41) * 0.25
    for target in TARGETS:
        image = exact(history, target.x + offsets, target.y + np.array([-1.0, 0.0, 1.0]), weighting)
        value = image[1, 40]
        assert abs(value) == pytest.approx(1, abs=0.01)  # the rounded edge of the part of the band: 0.006
        assert abs(np.angle(value)) < 0.03
        row = np.abs(image[1])
        if weighting == "uniform":  # a part of the band, equally weighted, is as much broader
            width = 0.886 * SPEED_OF_LIGHT / 2 / (RATE * PULSE * target.part) * 1e4 / np.sqrt(1e8 - 25e6)
            assert (row > np.sqrt(0.5) * row.max()).sum() * 0.25 == pytest.approx(width, rel=0.15)
        # A parabola through the peak: the place to a twentieth of the response, which is 3.1 m / part wide.
        k = int(row.argmax())
        a, b, c = row[k - 1 : k + 2]
        assert abs(offsets[k] + 0.125 * (a - c) / (a - 2 * b + c)) < 0.05 / target.part * 3.1


@pytest.mark.slow
def test_a_chain_images_the_whole_swath(run: Path, dataset: xr.Dataset) -> None:
    image = blocksar.open(run)
    history = stores.history_of(dataset).with_partial_pulses()
    for target in TARGETS:
        assert abs(at(image, target) - 1) < 0.02
        near = image["image"].sel(x=slice(target.x - 60, target.x + 60))
        wanted = exact(history, near["x"].values, near["y"].values)
        found = near.values
        overlap = abs(np.vdot(wanted, found)) / np.linalg.norm(wanted) / np.linalg.norm(found)
        assert overlap > 0.999
    covered = np.isfinite(image["image"].values).any(axis=0)
    parts = np.array([raw_strips.part_of(x) for x in image["x"].values])
    assert covered[parts > 0.105].all() and not covered[parts < 0.095].any()


@pytest.mark.slow
def test_a_run_says_what_is_divided_and_measures_it(run: Path, store: Path) -> None:
    notes = run.with_name("notes.txt").read_text()
    assert "of the grid's lit pixels have parts of pulses, " in notes and "--whole-pulses leaves them NaN" in notes
    compared = blocksar.quality(run, reference=True).result["reference"]
    assert min(chip["coherence"] for chip in compared) > 0.98  # dark chips hold side lobes only
    plan = "\n".join(blocksar.plan(store, grid=GRID).summary)
    length = raw_strips.N_TIME / raw_strips.SAMPLING * SPEED_OF_LIGHT / 2 - LENGTH
    assert f"whole pulses from {length:.5g} m of slant range" in plan and "m on the ground" in plan
    assert "parts of pulses" in plan
    facts = blocksar.info(store).result["facts"]
    assert facts["whole pulses"].startswith(f"from {length:.5g} m of slant range")


@pytest.mark.slow
def test_whole_pulses_only_on_demand(store: Path, tmp_path: Path) -> None:
    report = blocksar.focus(store, tmp_path / "run", grid=GRID, whole_pulses=True, workers=0, progress=False)
    assert "parts of pulses" not in "\n".join(report.summary)
    image = blocksar.open(tmp_path / "run")
    y = image["y"].values[::10]
    back_projected = exact(stores.open_phase_history(store), image["x"].values, y)
    whole = np.array([raw_strips.part_of(x) for x in image["x"].values]) > 1 - 1e-9
    for pixels in (image["image"].values, back_projected):
        covered = np.isfinite(pixels).any(axis=0)
        assert not covered[~whole].any()
        assert covered[whole].sum() >= whole.sum() - 4  # ranges change by a few metres over the dwell
    assert abs(at(image, TARGETS[0]) - 1) < 0.002


@pytest.mark.slow
def test_ground_with_whole_pulses_needs_no_longer_transform(store: Path) -> None:
    inside = blocksar.plan(store, grid=((-100.0, 100.0, STEP), (-40.0, 40.0, STEP)))
    beyond = blocksar.plan(store, grid=GRID)
    steps = [report.plan.pieces[0].geometry.collection.range_frequency_step for report in (inside, beyond)]
    assert steps[0] == pytest.approx(raw_strips.SAMPLING / raw_strips.N_TIME)
    n = raw_strips.SAMPLING / steps[1]
    padded = raw_strips.N_TIME + 2 * PULSE * raw_strips.SAMPLING
    assert padded <= n < 1.1 * padded  # a length that is fast to transform


@pytest.mark.slow
def test_noise_of_ground_with_parts_of_pulses_is_as_said() -> None:
    rng = np.random.default_rng(7)
    shape = raw_strips.N_PULSE, raw_strips.N_TIME
    noise = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
    history = stores.history_of(
        blocksar.collection(**{**strip((), noise_power=1.0), "echo": noise})
    ).with_partial_pulses()
    geometry = Geometry(collection=history.collection.centred())
    assert history.raw is not None
    spectrum = RawCompression.of_echo(history.raw, history.collection).noise_spectrum
    for weighting in ("uniform", "hann"):
        settings = Weighting.parse(weighting)
        said = NoiseMap.of(geometry, settings, np.ones(shape[0]), spectrum)
        assert said is not None
        for part, side in ((1.5, -1), (0.5, -1), (0.3, 1)):
            x = raw_strips.target_with(part, side, 0.0).x + np.arange(-150, 151, 3.0)
            y = np.arange(-120, 121, 6.0)
            ratio = np.abs(exact(history, x, y, weighting)) ** 2 / said.over(x, y)
            assert np.nanmean(ratio) == pytest.approx(1, abs=0.15)  # over 500 to 2000 independent cells


def test_a_preview_shows_them_as_bright(store: Path) -> None:
    power = blocksar.preview(store, grid=GRID, size=1600).result
    peaks = [float(power.sel(x=slice(t.x - 8, t.x + 8), y=slice(t.y - 8, t.y + 8)).max()) for t in TARGETS[:3]]
    assert 10 * np.log10(max(peaks) / min(peaks)) < 2  # looks of a few pulses each


@pytest.mark.parametrize("weighting", ["uniform", "hann"])
def test_targets_keep_their_amplitude_under_gaps_of_pulses(weighting: str) -> None:
    """As of transmit events between a pulse and its echo, up to whole pulses long, which move from pulse to pulse."""
    given = strip(TARGETS[:4])
    lengths = ((80, 0.01), (300, 0.04)) if weighting == "uniform" else ((80, 0.01),)
    for length, tolerance in lengths:  # of a pulse of 300 samples
        echo = np.array(given["echo"])
        for pulse, start in enumerate(np.random.default_rng(1).integers(-length, echo.shape[1], len(echo))):
            echo[pulse, max(start, 0) : start + length] = np.nan
        history = stores.history_of(blocksar.collection(**{**given, "echo": echo})).with_partial_pulses()
        for target in TARGETS[: 4 if length < 300 else 1]:  # a gap as long hides all that the window has of others
            value = exact(history, np.array([target.x]), np.array([target.y]), weighting)[0, 0]
            assert abs(value - 1) < tolerance + 0.02 * (target.part < 1) + 0.02 * (weighting == "hann")


def test_gaps_of_pulses_are_told_and_so_are_zeros_in_their_place(tmp_path: Path) -> None:
    given = strip(TARGETS[:1])
    noise = np.random.default_rng(0).normal(size=(2, *given["echo"].shape))
    echo = given["echo"] + 1e-3 * (noise[0] + 1j * noise[1])
    for pulse, start in enumerate(np.random.default_rng(2).integers(0, 900, len(echo))):
        echo[pulse, start : start + 100] = np.nan
    for name, values in (("nan", echo), ("zeros", np.nan_to_num(echo))):
        run = blocksar.focus(
            blocksar.collection(**{**given, "echo": values}), tmp_path / name, grid="-8:8:2,-8:8:2", workers=0,
            processor="backprojection", progress=False,
        )  # fmt: skip
        notes, peak = "\n".join(run.summary), abs(at(run.open(), TARGETS[0]))
        if name == "nan":
            assert "9.8 % of the echo's samples are missing, gaps in 192 pulses" in notes and abs(peak - 1) < 0.01
        else:
            assert "of the echo's samples are zeros in gaps" in notes and "give NaN there" in notes and peak < 0.95
    plain = strip(TARGETS)["echo"]  # without noise, zeros are where nothing echoes
    assert count_zero_gaps(plain) == 0


def test_a_grid_about_the_reference_point_is_proposed_and_can_be_planned(dataset: xr.Dataset) -> None:
    with pytest.raises(InputError, match=r"grid is missing: .*, such as grid=") as error:
        blocksar.plan(dataset)
    proposed = str(error.value).partition("such as grid='")[2].partition("'")[0]
    assert blocksar.plan(dataset, grid=proposed, processor="backprojection").plan.grid.shape[0] > 10


@pytest.mark.slow
def test_delays_may_count_from_the_start_of_the_pulse(tmp_path: Path) -> None:
    centre = blocksar.collection(**strip())
    start = blocksar.collection(**strip(fast_time=FAST_TIME + PULSE / 2, pulse_reference="start"))
    histories = [stores.history_of(each).raw for each in (centre, start)]
    assert histories[0] is not None and histories[1] is not None
    np.testing.assert_allclose(histories[1].fast_time, histories[0].fast_time, rtol=0, atol=1e-18)
    written = stores.open_phase_history(blocksar.write(start, tmp_path / "raw.zarr"))
    assert written.raw is not None and "pulse_reference" not in written.attrs
    np.testing.assert_array_equal(written.raw.fast_time, histories[1].fast_time)
    other = xr.open_zarr(tmp_path / "raw.zarr")  # a store of another program
    other = other.assign_coords(fast_time=other["fast_time"] + PULSE / 2).assign_attrs(pulse_reference="start")
    other["fast_time"].attrs["units"] = "s"
    other.to_zarr(tmp_path / "start.zarr", consolidated=False)
    opened = stores.open_phase_history(tmp_path / "start.zarr").raw
    assert opened is not None
    np.testing.assert_allclose(opened.fast_time, histories[0].fast_time, rtol=0, atol=1e-18)
    with pytest.raises(InputError, match=r"pulse_reference is 'middle'; it must be 'centre' or 'start'"):
        blocksar.collection(**strip(pulse_reference="middle"))
