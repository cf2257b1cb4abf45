"""Paper A's Figures 6 and 7: recovery of the Doppler spectrum."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import gaussian

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.focusing.lines import Line
from blocksar.focusing.method import Derotation, Method
from blocksar.focusing.recovery import Recovery
from blocksar.kernels import rows
from blocksar.kernels.fourier import Axis, dual, unit_phasor
from blocksar.planning.plan import Plan, plan_collection
from blocksar.planning.target_lines import recovered_line
from blocksar.products.pictures.figures import CURVE_COLOURS
from blocksar.products.pictures.panels import Map, Mark, Panel, Style, Trace, plot_panels
from blocksar.simulation.scatterers import simulate_pulses
from blocksar.simulation.scene import Scene
from papers.bench import THREADS, Bench, geometry, plan, scene, targets
from papers.comparison import Exhibit, Row, above, below
from papers.printed import SEAMS, SWATH
from papers.single_targets import YAWS, line_panel, lines

# ---------------------------------------------------------------- paper A: recovery and division


def at_prf(prf: float) -> Collection:
    """Paper A's collection, at another PRF."""
    tables = scene("table1").model_dump(by_alias=True, exclude_none=True)
    tables["radar"]["prf"] = prf
    return Scene.model_validate(tables).collection().centred()


def least_recovery(derotation: Derotation) -> Recovery:
    """Of paper A's collection at the least PRF that a plan accepts: where it refuses one, it names that."""
    prf = geometry("table1").collection.prf / 8
    while True:
        try:
            return plan_collection(at_prf(prf), blocks=3, method=Method(derotation=derotation)).recovery
        except InputError as error:
            asked = re.search(r"a PRF of at least ([\d.e+]+) Hz", str(error))
            if asked is None or float(asked[1]) <= prf:
                raise
            prf = float(asked[1])


def few_targets(recovery: Recovery) -> tuple[ComplexArray, Line]:
    """Echo (n_pulse,) at the carrier, and lines, of five targets across the sector, a near and a far one."""
    collection = at_prf(1 / recovery.pulses.step)
    carrier = int(np.abs(collection.range_frequency).argmin())
    some = collection.range_frequency[carrier - 4 : carrier + 4]
    geo = Geometry(collection=Collection(**{**collection.as_dict(), "range_frequency": some}))
    yaw = np.radians([44.5, 47.25, 50.0, 52.75, 55.5, 50.0, 50.0])
    rng = np.array([SWATH["middle"]] * 5 + [SWATH["near"], SWATH["far"]])
    point = geo.ground_point(rng, yaw)
    echo = simulate_pulses(geo.collection, point[:, 0], point[:, 1], np.ones(yaw.size), threads=THREADS)[:, 4]
    return echo, recovered_line(geo, epoch_range=rng, yaw=yaw, origin=recovery.origin, walk=recovery.walk)


def derotated(recovery: Recovery, line: Line) -> Line:
    """Lines after derotation."""
    step = recovery.pulses.step
    ahead, behind = (recovery.derotation_cycles(line.time + sign * step / 2) for sign in (1, -1))
    return replace(line, doppler=line.doppler - (ahead - behind) / step)


def derotated_echo(recovery: Recovery, echo: ComplexArray) -> ComplexArray:
    cycles = recovery.bulk + recovery.derotation_cycles(recovery.pulses.values)
    return np.asarray(echo * unit_phasor(-cycles))


def spectrogram(values: ComplexArray, axis: Axis, *, centre: float = 0.0, repeats: int = 0) -> Map:
    """Of samples over slow time, s, about a Doppler, Hz; shown in s and kHz, repeated at the sampling rate."""
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
    straight, bent = least_recovery("linear"), least_recovery("nonlinear")
    (wide_echo, wide), (echo, line) = few_targets(straight), few_targets(bent)
    squint = -2 / geometry("table1").collection.wavelength * bent.walk
    folded = dual(bent.pulses, size=bent.padded, centre=0.0)
    padded = rows.to_time(rows.to_doppler(derotated_echo(bent, echo)[None], bent.pulses, folded), folded, bent.time)[0]
    recovered = padded * unit_phasor(bent.derotation_cycles(bent.time.values))
    prf = {recovery: f"PRF {1e-3 / recovery.pulses.step:.2f} kHz" for recovery in (straight, bent)}
    shown = {
        f"(a) echo, {prf[bent]}": (
            spectrogram(echo, bent.pulses, centre=squint, repeats=1), replace(line, doppler=line.doppler + squint)
        ),
        f"(b) linear derotation, {prf[straight]}": (
            spectrogram(derotated_echo(straight, wide_echo), straight.pulses), derotated(straight, wide)
        ),
        f"(c) nonlinear derotation, {prf[bent]}, padded": (spectrogram(padded, bent.time), derotated(bent, line)),
        "(d) recovered": (spectrogram(recovered, bent.time, centre=bent.doppler.centre), line),
    }  # fmt: skip
    panels = [line_panel(title, line, ["traced line"], under=picture) for title, (picture, line) in shown.items()]
    path = bench.picture("fig6")
    plot_panels(panels, path, title="Spectrum recovery", bar="power (dB, strongest = 0)")
    return Exhibit(
        title="Figure 6: spectrum recovery",
        text="Spectrograms of simulated samples at the carrier, of seven targets: five across the sector at middle "
        "range, a near and a far one at its centre; dashed are their traced lines. Each derotation is shown at the "
        "least PRF that holds all that the beam lights after it. The echo stands three times, one PRF apart, as it is "
        "ambiguous; its lines say which is meant.",
        pictures=[path],
        rows=_recovery_rows(straight, bent),
        notes=[
            "Table 1 prints neither PRF nor beam width. The scene's 8 kHz hold the derotated band with margin; its "
            "dwell of 0.162 s gives the printed azimuth width at the centre.",
            "(11) as printed counts the beam-centre lines only. The beam's own spread of yaw is the larger part of the "
            "derotated band, so a PRF by (11) would be far too low.",
        ],
    )


def _recovery_rows(straight: Recovery, bent: Recovery) -> list[Row]:
    made = plan("table1", 3)
    collection, region = made.geometry.collection, made.region
    band_edge = 1 + float(np.abs(collection.range_frequency).max()) / collection.carrier
    places = [(rng, yaw) for yaw in region.yaw.tolist() for rng in map(float, region.at(np.array(yaw)))]
    total = float(np.ptp(lines(made, places).doppler)) * band_edge / 1e3
    own = float(np.ptp(lines(made, [(SWATH["middle"], np.radians(50.0))]).doppler)) / 1e3
    linear, nonlinear = (float(np.ptp(found.band)) * band_edge / 1e3 for found in (straight, bent))
    return [
        Row("Doppler band of the echo", total, "kHz", above(2 * collection.prf / 1e3, "much larger than the PRF"),
            why=f"The echo's band is {total / collection.prf * 1e3:.1f} times the PRF of the scene, which is ours."),
        Row("own bandwidth of a target at the centre", own, "kHz", below(total / 2, "much smaller than that")),
        Row("band after nonlinear derotation by (11)", _beam_centre_band(made, bent) / 1e3, "kHz"),
        Row("PRF needed after linear derotation", linear, "kHz"),
        Row("PRF needed after nonlinear derotation", nonlinear, "kHz", below(linear, "further reduced")),
    ]  # fmt: skip


def _beam_centre_band(made: Plan, recovery: Recovery) -> float:
    """(11) as printed, Hz: what derotation leaves between the beam-centre lines of the swath's ends."""
    geo, collection = made.geometry, made.geometry.collection
    ends = np.array([SWATH["near"], SWATH["far"]])
    beam, time = collection.beam_azimuth[[0, -1]], collection.time[[0, -1]]
    _, rate = geo.range_history(geo.ground_point(ends, beam), time)
    slow = time - geo.epoch
    doppler = -2 / collection.wavelength * (rate - recovery.walk)
    line = replace(lines(made, [(SWATH["middle"], beam[0])]), time=slow, doppler=doppler)
    return float(np.ptp(derotated(recovery, line).doppler))


def figure7(bench: Bench) -> Exhibit:
    """Block division in the angular domain, and yaw against Doppler."""
    made, path = plan("table1", 3), bench.picture("fig7")
    plot_panels([_sector_panel(made), _yaw_panel(made)], path, size=(4.6, 4.6), title="Angular division")
    return Exhibit(
        title="Figure 7: angular division",
        text="(a) The three blocks on the ground, with what the beam lights beyond the steering interval, and the "
        "9 × 9 targets. (b) Recovered Doppler of targets against their yaw, when the beam's centre passes them; the "
        "boxes are the blocks' yaws and the Doppler bins that they take, margins for the dwell of their edge targets "
        "included.",
        pictures=[path],
        rows=[
            *(Row(f"seam of blocks {i} and {i + 1}", float(np.degrees(made.seams[i])), "°", seam, 0.005, digits=3)
              for i, seam in enumerate(SEAMS, start=1)),
            *(Row(f"Doppler taken by block {i}", block.n_bin * made.recovery.doppler.step / 1e3, "kHz")
              for i, block in enumerate(made.blocks, start=1)),
            Row("recovered Doppler, all", made.recovery.doppler.extent / 1e3, "kHz"),
        ],
        notes=["The printed seams are those of the printed steering interval, 42.13° to 57.87°, divided evenly."],
    )  # fmt: skip


def _sector_panel(made: Plan) -> Panel:
    geo, outlines, marks = made.geometry, [], []
    for number, (block, colour) in enumerate(zip(made.blocks, CURVE_COLOURS, strict=False), start=1):
        yaw = np.linspace(block.low, block.high, YAWS)
        near, far = made.region.at(yaw)
        loop = np.concatenate([geo.ground_point(near, yaw), geo.ground_point(far, yaw)[::-1]])
        x, y, _ = np.append(loop, loop[:1], axis=0).T / 1e3
        outlines.append(Trace(f"block {number}", x, y, colour))
        middle = geo.ground_point(far[YAWS // 2] + 400.0, yaw[YAWS // 2]) / 1e3
        marks.append(Mark(str(number), float(middle[0]), float(middle[1])))
    places = np.array([(target.x, target.y) for target in targets("table1")]) / 1e3
    dots = Trace("targets", places[:, 0], places[:, 1], CURVE_COLOURS[1], ".")
    return Panel("(a) blocks on the ground", "x (km)", "y (km)", [*outlines, dots], marks=marks, equal=True)


def _yaw_panel(made: Plan) -> Panel:
    doppler, traces = made.recovery.doppler, []
    styles: tuple[Style, ...] = ("-", "--", ":")
    for (name, rng), style in zip(SWATH.items(), styles, strict=True):
        yaw = np.linspace(made.region.yaw[0], made.region.yaw[-1], YAWS)
        middle = lines(made, [(rng, float(angle)) for angle in yaw]).doppler.mean(axis=-1)
        traces.append(Trace(f"{name} range, {rng / 1e3:.1f} km", np.degrees(yaw), middle / 1e3, "#5a6676", style))
    for block, colour in zip(made.blocks, CURVE_COLOURS, strict=False):
        low, high = (doppler.start + doppler.step * (block.first_bin + n) for n in (0, block.n_bin))
        x = np.degrees([block.low, block.high, block.high, block.low, block.low])
        traces.append(Trace("", x, np.array([low, low, high, high, low]) / 1e3, colour))
    return Panel("(b) yaw and Doppler", "yaw (°)", "Doppler (kHz)", traces)
