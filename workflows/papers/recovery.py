"""Paper A's Figures 6 and 7: recovery and division of the Doppler spectrum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import gaussian

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import PrfTooLow
from blocksar.imaging.method import Derotation, Method
from blocksar.kernels import rows
from blocksar.kernels.fourier import Axis, dual, unit_phasor
from blocksar.processors.chain.dwells.target_lines import Dwells
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.recovery import Recovery
from blocksar.products.pictures.panels import CURVE_COLOURS, Map, Mark, Panel, Style, Trace, plot_panels
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene
from papers.bench import SWATH, THREADS, Bench, geometry, plan_scene, scene, targets
from papers.comparison import Exhibit, Row, above, below
from papers.printed import SEAMS
from papers.sectors import YAWS
from papers.single_targets import line_panel, recovered_lines


def at_prf(prf: float) -> Collection:
    """Paper A's collection at another PRF, Hz."""
    tables = scene("table1").model_dump(by_alias=True, exclude_none=True)
    tables["radar"]["prf"] = prf
    return Scene.model_validate(tables).collection().centred()


def least_recovery(derotation: Derotation) -> Recovery:
    """Recovery of paper A's collection at the least PRF that a plan accepts, which a refusal names."""
    prf = geometry("table1").collection.prf / 8
    while True:
        try:
            return plan_collection(at_prf(prf), blocks=3, method=Method(derotation=derotation)).recovery
        except PrfTooLow as error:
            if error.needed <= prf:
                raise
            prf = error.needed


def few_targets(recovery: Recovery) -> tuple[ComplexArray, Line]:
    """Echo (n_pulse,) at the carrier and lines of seven targets: five across the sector, a near and a far one."""
    collection = at_prf(1 / recovery.pulses.step)
    carrier = int(np.abs(collection.range_frequency).argmin())
    some = collection.range_frequency[carrier - 4 : carrier + 4]
    geo = Geometry(collection=Collection(**{**collection.as_dict(), "range_frequency": some}))
    yaw = np.radians([44.5, 47.25, 50.0, 52.75, 55.5, 50.0, 50.0])
    rng = np.array([SWATH["middle"]] * 5 + [SWATH["near"], SWATH["far"]])
    point = geo.ground_point(rng, yaw)
    echo = simulate_pulses(geo.collection, point[:, 0], point[:, 1], np.ones(yaw.size), threads=THREADS)[:, 4]
    return echo, Dwells(geometry=geo, yaw=yaw, origin=recovery.origin, walk=recovery.walk).lines(rng)


def derotate(recovery: Recovery, line: Line) -> Line:
    """Lines after derotation."""
    step = recovery.pulses.step
    ahead, behind = (recovery.derotation_cycles(line.time + sign * step / 2) for sign in (1, -1))
    return replace(line, doppler=line.doppler - (ahead - behind) / step)


def derotate_echo(recovery: Recovery, echo: ComplexArray) -> ComplexArray:
    """Echo (n_pulse,) after derotation."""
    cycles = recovery.bulk + recovery.derotation_cycles(recovery.pulses.values)
    return np.asarray(echo * unit_phasor(-cycles))


def spectrogram(values: ComplexArray, axis: Axis, *, centre: float = 0.0, repeats: int = 0) -> Map:
    """Spectrogram of samples over slow time (s) about a Doppler (Hz), in s and kHz.

    It is repeated `repeats` times on either side, at multiples of the sampling rate.
    """
    rate = 1 / axis.step
    size = 2 * round(0.012 * rate) + 1
    transform = ShortTimeFFT(
        gaussian(size, std=size / 6), round(0.0015 * rate), rate, fft_mode="centered", mfft=4 * size
    )
    power = np.abs(transform.stft(values * np.exp(-2j * np.pi * centre * axis.values))) ** 2
    decibel = 10 * np.log10(np.tile(power, (2 * repeats + 1, 1)) / power.max() + 1e-9)
    time_edges = axis.start + transform.delta_t * (np.arange(power.shape[1] + 1) + transform.p_min - 0.5)
    doppler_edges = centre + rate * (np.linspace(0, 2 * repeats + 1, decibel.shape[0] + 1) - repeats - 0.5)
    return Map(decibel, time_edges, doppler_edges / 1e3, -30.0, 0.0)


def figure6(bench: Bench) -> Exhibit:
    """Spectrograms: echo, after linear derotation, after nonlinear derotation and padding, recovered."""
    linear, nonlinear = least_recovery("linear"), least_recovery("nonlinear")
    (wide_echo, wide), (echo, line) = few_targets(linear), few_targets(nonlinear)
    squint = -2 / geometry("table1").collection.wavelength * nonlinear.walk
    pulses, time = nonlinear.pulses, nonlinear.time
    folded = dual(pulses, size=nonlinear.padded, centre=0.0)
    padded = rows.to_time(rows.to_doppler(derotate_echo(nonlinear, echo)[None], pulses, folded), folded, time)[0]
    recovered = padded * unit_phasor(nonlinear.derotation_cycles(time.values))
    prf = {recovery: f"PRF {1e-3 / recovery.pulses.step:.2f} kHz" for recovery in (linear, nonlinear)}
    pictures = {
        f"(a) echo, {prf[nonlinear]}": (
            spectrogram(echo, pulses, centre=squint, repeats=1), replace(line, doppler=line.doppler + squint)
        ),
        f"(b) linear derotation, {prf[linear]}": (
            spectrogram(derotate_echo(linear, wide_echo), linear.pulses), derotate(linear, wide)
        ),
        f"(c) nonlinear derotation, {prf[nonlinear]}, padded": (spectrogram(padded, time), derotate(nonlinear, line)),
        "(d) recovered": (spectrogram(recovered, time, centre=nonlinear.doppler.centre), line),
    }  # fmt: skip
    panels = [line_panel(title, line, ["traced line"], under=picture) for title, (picture, line) in pictures.items()]
    path = bench.picture("fig6")
    plot_panels(panels, path, title="Spectrum recovery", bar="power (dB, strongest = 0)")
    return Exhibit(
        title="Figure 6: spectrum recovery",
        text="Spectrograms of simulated samples at the carrier, of seven targets: five across the sector at middle "
        "range, a near and a far one at its centre; their traced lines are dashed. Each derotation is shown at the "
        "least PRF that holds the derotated band of everything that the beam lights. The ambiguous echo is repeated "
        "three times, one PRF apart; the lines mark the true Doppler.",
        pictures=[path],
        rows=_recovery_rows(linear, nonlinear),
        notes=[
            "Table 1 prints neither PRF nor beam width. The PRF of our scene, 8 kHz, holds the derotated band with "
            "margin; its dwell of 0.162 s gives the printed azimuth width at the centre.",
            "(11) as printed includes the beam-centre lines only. The yaw extent of the beam makes up most of the "
            "derotated band, so a PRF according to (11) would be far too low.",
        ],
    )


def _recovery_rows(linear: Recovery, nonlinear: Recovery) -> list[Row]:
    plan = plan_scene("table1", 3)
    collection, region = plan.geometry.collection, plan.region
    band_edge = 1 + float(np.abs(collection.range_frequency).max()) / collection.carrier
    places = [(rng, yaw) for yaw in region.yaw.tolist() for rng in map(float, region.at(np.array(yaw)))]
    total = float(np.ptp(recovered_lines(plan, places).doppler)) * band_edge / 1e3
    own = float(np.ptp(recovered_lines(plan, [(SWATH["middle"], np.radians(50.0))]).doppler)) / 1e3
    needed = [float(np.ptp(recovery.band)) * band_edge / 1e3 for recovery in (linear, nonlinear)]
    return [
        Row("Doppler band of the echo", total, "kHz", above(2 * collection.prf / 1e3, "much larger than the PRF"),
            why=f"The echo's band is {total / collection.prf * 1e3:.1f} times the PRF of our scene."),
        Row("bandwidth of one target at the centre", own, "kHz", below(total / 2, "much smaller than that")),
        Row("band after nonlinear derotation by (11)", _beam_centre_band(plan, nonlinear) / 1e3, "kHz"),
        Row("PRF needed after linear derotation", needed[0], "kHz"),
        Row("PRF needed after nonlinear derotation", needed[1], "kHz", below(needed[0], "further reduced")),
    ]  # fmt: skip


def _beam_centre_band(plan: Plan, recovery: Recovery) -> float:
    """(11) as printed, Hz: the derotated band of the beam-centre lines at both ends of the swath."""
    geo, collection = plan.geometry, plan.geometry.collection
    ends = np.array([SWATH["near"], SWATH["far"]])
    beam, time = collection.beam_azimuth[[0, -1]], collection.time[[0, -1]]
    _, rate = geo.range_history(geo.ground_point(ends, beam), time)
    slow = time - geo.epoch
    doppler = -2 / collection.wavelength * (rate - recovery.walk)
    line = replace(recovered_lines(plan, [(SWATH["middle"], beam[0])]), time=slow, doppler=doppler)
    return float(np.ptp(derotate(recovery, line).doppler))


def figure7(bench: Bench) -> Exhibit:
    """Block division in the angular domain, and yaw against Doppler."""
    plan, path = plan_scene("table1", 3), bench.picture("fig7")
    plot_panels([_sector_panel(plan), _yaw_panel(plan)], path, size=(4.6, 4.6), title="Angular division")
    return Exhibit(
        title="Figure 7: angular division",
        text="(a) The three blocks on the ground, with the area that the beam lights beyond the steering interval, and "
        "the 9 × 9 targets. (b) Recovered Doppler of targets against their yaw, when the centre of the beam passes "
        "them; boxes are the yaws of the blocks and the Doppler bins that they use, with margins for the dwell of "
        "targets at their edges.",
        pictures=[path],
        rows=[
            *(Row(f"seam of blocks {i} and {i + 1}", float(np.degrees(plan.seams[i])), "°", seam, 0.005, digits=3)
              for i, seam in enumerate(SEAMS, start=1)),
            *(Row(f"Doppler used by block {i}", block.n_bin * plan.recovery.doppler.step / 1e3, "kHz")
              for i, block in enumerate(plan.blocks, start=1)),
            Row("recovered Doppler, all", plan.recovery.doppler.extent / 1e3, "kHz"),
        ],
        notes=["The printed seams are those of the printed steering interval, 42.13° to 57.87°, divided evenly."],
    )  # fmt: skip


def _sector_panel(plan: Plan) -> Panel:
    geo, outlines, marks = plan.geometry, [], []
    for number, (block, colour) in enumerate(zip(plan.blocks, CURVE_COLOURS, strict=False), start=1):
        yaw = np.linspace(block.low, block.high, YAWS)
        near, far = plan.region.at(yaw)
        loop = np.concatenate([geo.ground_point(near, yaw), geo.ground_point(far, yaw)[::-1]])
        x, y, _ = np.append(loop, loop[:1], axis=0).T / 1e3
        outlines.append(Trace(f"block {number}", x, y, colour))
        middle = geo.ground_point(far[YAWS // 2] + 400.0, yaw[YAWS // 2]) / 1e3
        marks.append(Mark(str(number), float(middle[0]), float(middle[1])))
    places = np.array([(target.x, target.y) for target in targets("table1")]) / 1e3
    dots = Trace("targets", places[:, 0], places[:, 1], CURVE_COLOURS[1], ".")
    return Panel("(a) blocks on the ground", "x (km)", "y (km)", [*outlines, dots], marks=marks, equal=True)


def _yaw_panel(plan: Plan) -> Panel:
    doppler, traces = plan.recovery.doppler, []
    styles: tuple[Style, ...] = ("-", "--", ":")
    for (name, rng), style in zip(SWATH.items(), styles, strict=True):
        yaw = np.linspace(plan.region.yaw[0], plan.region.yaw[-1], YAWS)
        middle = recovered_lines(plan, [(rng, float(angle)) for angle in yaw]).doppler.mean(axis=-1)
        traces.append(Trace(f"{name} range, {rng / 1e3:.1f} km", np.degrees(yaw), middle / 1e3, "#5a6676", style))
    for block, colour in zip(plan.blocks, CURVE_COLOURS, strict=False):
        low, high = (doppler.start + doppler.step * (block.first_bin + n) for n in (0, block.n_bin))
        x = np.degrees([block.low, block.high, block.high, block.low, block.low])
        traces.append(Trace("", x, np.array([low, low, high, high, low]) / 1e3, colour))
    return Panel("(b) yaw and Doppler", "yaw (°)", "Doppler (kHz)", traces)
