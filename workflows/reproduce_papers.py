"""Figures and tables of the papers from scratch, each of our numbers beside the printed one.

    python workflows/reproduce_papers.py --out reproduced
    python workflows/reproduce_papers.py --out reproduced --only fig2,fig11,table3

Scenes are simulated, planned, focused and measured in the run; what is typed in is what the papers print, below, with
the place where they print it. DIR/index.html holds everything, pictures embedded; DIR/README.md and the PNG files say
the same. Paper A is the angular-division paper, paper B the keystone-resampling paper.

All of it takes some minutes on two cores, and 6 GB in DIR while it goes on. Pictures need the extra `plots`.

    exit status   meaning
    0             all that was asked for is there
    1             something could not be made: the page says what and why, and holds the rest
    2             an option is wrong: nothing was written
"""

from __future__ import annotations

import base64
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jinja2
import numpy as np
import typer
from distributed import Client
from scipy.signal import ShortTimeFFT, resample
from scipy.signal.windows import gaussian

import blocksar
from blocksar import fitting, plotting, rows
from blocksar.azimuth_steps import Deramp, FrequencyPerturbation
from blocksar.cluster import machine, open_client
from blocksar.fourier import Axis, dual, unit_phasor
from blocksar.geometry import Geometry
from blocksar.lines import Line, focus
from blocksar.measurement import (
    CUT_WIDTHS,
    TABLE3,
    Complex128Array,
    PaperResponse,
    PointResponse,
    ProfileQuality,
    Response,
    Target,
    measure,
    profile_quality,
    read_response,
)
from blocksar.method import Derotation, Method
from blocksar.parameters import (
    SINC_WIDTH,
    SPEED_OF_LIGHT,
    Collection,
    ComplexArray,
    FloatArray,
    InputError,
    ProcessingError,
)
from blocksar.planning import BlockPlan, Plan, plan_collection
from blocksar.plotting import CURVE_COLOURS, LIMIT, Level, Map, Mark, Panel, Style, Trace, as_map, overview, plot_panels
from blocksar.range_steps import Compression, RangeCompression, ResidualRangeWalk
from blocksar.recovery import Recovery, recover_columns
from blocksar.recovery_plan import recovered_line
from blocksar.region import Grid
from blocksar.scene import Scene
from blocksar.simulation import simulate_pulses
from blocksar.steps import stages
from blocksar.stores import read_collection, read_region

Place = tuple[float, float]  # of a target: epoch range (m) and yaw (rad)

NAMES = ("A1", "A2", "A3", "B1", "B2", "B3", "C1", "C2", "C3")
SWATH = {"near": 27_600.0, "middle": 30_000.0, "far": 32_400.0}  # m: paper A's swath, less the width of a response
YAWS = 61  # of a curve
FINE = 8  # samples of a measured profile for one of the block's
PULSES = 40  # of a dwell, at which a range-compressed peak is looked for
QUARTER = 0.25  # of pi: the phase error that is usually allowed
THREADS = machine()[0]

# ---------------------------------------------------------------- what the papers print

# Paper A, Table 2: the reference method. Its range columns are those of Table 3, which `measurement` holds.
TABLE2_AZIMUTH = {
    "A1": (-5.74, -7.02, 2.18), "A2": (-13.10, -10.52, 1.85), "A3": (-8.48, -6.59, 2.01),
    "B1": (-7.65, -5.89, 2.01), "B2": (-13.24, -10.70, 1.89), "B3": (-8.43, -6.34, 1.97),
    "C1": (-7.37, -5.73, 2.06), "C2": (-13.21, -10.65, 1.85), "C3": (-7.04, -5.28, 2.10),
}  # fmt: skip
TABLE2 = {name: PaperResponse(*TABLE3[name][:3], *azimuth) for name, azimuth in TABLE2_AZIMUTH.items()}

# Paper A, Table 1: the steering interval of 42.13 to 57.87 degrees, divided evenly in three (section 3.1).
SEAMS = (42.13 + 15.74 / 3, 42.13 + 15.74 * 2 / 3)

# Paper A, section 4.2: positions in Figure 13 d, ground range first. It prints C1 twice: the fourth position is A3's.
PIXEL = 2.0  # m
MIDDLE = 1276  # the pixel of B2, the scene's centre
MOSAIC_PIXELS = {"A1": (26, 26), "C1": (2526, 26), "B2": (1276, 1276), "A3": (26, 2526), "C3": (2526, 2526)}
# And in Figure 13 a-c, which begin at columns 0, 850 and 1700 of 13 d: so much follows from A2, A3 and B2.
BLOCK_PIXELS = {
    "A1": (26, 26), "C1": (2526, 26), "A2": (26, 426), "C2": (2526, 426), "A3": (26, 826), "C3": (2526, 826),
}  # fmt: skip
BLOCK_COLUMNS = {"1": 0, "2": 850, "3": 1700}  # by the targets' digit

# Paper B, Table 2: points 1 to 3, by our name for the method. The unit of "MW" is not stated.
PAPER_B = {
    "frequency": {"PSLR": (-3.98, -13.26, -4.78), "ISLR": (-7.11, -9.83, -6.78), "MW": (20.67, 15.60, 28.35)},
    "all": {"PSLR": (-12.68, -13.27, -13.39), "ISLR": (-9.37, -9.81, -10.28), "MW": (15.62, 15.61, 15.62)},
}

POINTS_B = ("M1", "M3", "M5")  # paper B's points 1 to 3, in our scene
GRID_B = Grid(10_960.0, 11_670.0, 0.25, -1050.0, 1050.0, 0.25)

# ---------------------------------------------------------------- comparisons


class Claim(NamedTuple):
    """What a paper says of a number that it does not print."""

    text: str
    holds: Callable[[float], bool]


def below(limit: float, text: str) -> Claim:
    return Claim(text, lambda value: value < limit)


def above(limit: float, text: str) -> Claim:
    return Claim(text, lambda value: value > limit)


BELOW_QUARTER, ABOVE_QUARTER = below(QUARTER, "below π/4"), above(QUARTER, "above π/4")


class Cell(NamedTuple):
    text: str
    off: bool = False  # beyond what was expected


class Row(NamedTuple):
    """One of our numbers, and what is printed of it: a number, a claim, something that cannot be compared, or nothing.

    It agrees if it is within `tolerance` of the number, or the claim holds; `why` is said where it does not.
    """

    what: str
    ours: float
    unit: str = ""
    printed: float | Claim | str | None = None
    tolerance: float = 0.0
    why: str = ""
    digits: int = 2

    @property
    def compared(self) -> bool:
        return isinstance(self.printed, Claim | float | int)

    @property
    def agrees(self) -> bool:
        if isinstance(self.printed, Claim):
            return self.printed.holds(self.ours)
        return not isinstance(self.printed, float | int) or abs(self.ours - self.printed) <= self.tolerance

    @property
    def cells(self) -> list[Cell]:
        """Ours, printed, difference."""
        off = not self.agrees
        ours = Cell(self._text(self.ours), off)
        if self.printed is None or isinstance(self.printed, str):
            return [ours, Cell(self.printed or "not printed"), Cell("")]
        if isinstance(self.printed, Claim):
            return [ours, Cell(self.printed.text), Cell("does not hold" if off else "holds", off)]
        return [ours, Cell(self._text(self.printed)), Cell(self._text(self.ours - self.printed, "+"), off)]

    def _text(self, value: float, sign: str = "") -> str:
        return minus(f"{value:{sign}z.{self.digits}f}") if np.isfinite(value) else "not measured"


def minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")


class Table(NamedTuple):
    header: list[str]
    lines: list[list[Cell]]


def listed(found: Sequence[Row]) -> Table:
    """A line each."""
    lines = [[Cell(row.what), Cell(row.unit.replace(" ", "\N{NO-BREAK SPACE}")), *row.cells] for row in found]
    return Table(["", "unit", "ours", "printed", "difference"], lines)


def crossed(found: Sequence[Row], corner: str = "target") -> Table:
    """Rows called "target: quantity": a line a target, three columns a quantity."""
    header, lines = [corner], dict[str, list[Cell]]()
    for row in found:
        target, quantity = row.what.split(": ")
        name = f"{quantity} ({row.unit})" if row.unit else quantity
        header += [] if name in header else [name, f"{quantity}, printed", "difference"]
        lines.setdefault(target, [Cell(target)]).extend(row.cells)
    return Table(header, list(lines.values()))


@dataclass(kw_only=True)
class Exhibit:
    """One figure or table as it stands on the page."""

    title: str
    text: str
    pictures: list[Path] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)  # by default one, of all rows
    notes: list[str] = field(default_factory=list)
    key: str = ""
    seconds: float = 0.0
    failed: bool = False

    def __post_init__(self) -> None:
        if self.rows and not self.tables:
            self.tables = [listed(self.rows)]
        differing = [row.why or f"{row.what}: the difference is not explained." for row in self.rows if not row.agrees]
        self.notes = list(dict.fromkeys([*self.notes, *differing]))

    @property
    def verdict(self) -> str:
        """In a few words, for the list at the top."""
        compared = [row for row in self.rows if row.compared]
        if self.failed:
            return "could not be made"
        return f"{sum(row.agrees for row in compared)} of {len(compared)}" if compared else "not compared"


# ---------------------------------------------------------------- plans, runs, samples


@cache
def scene(name: str) -> Scene:
    """A shipped scene."""
    return Scene.read(name)


@cache
def geometry(name: str) -> Geometry:
    return Geometry(collection=scene(name).collection().centred())


@cache
def plan(name: str, blocks: int, **options: Any) -> Plan:
    """Of a shipped scene; options are those of `Method`."""
    return plan_collection(geometry(name).collection, blocks=blocks, method=Method(**options))


def targets(name: str, names: Sequence[str] | None = None) -> list[Target]:
    """Point targets of a shipped scene: all, or some, in that order."""
    known = {target.name: Target(*target) for target in scene(name).point_targets()}
    return [known[n] for n in (known if names is None else names)]


def tell(text: str) -> None:
    typer.echo(text, err=True)


@dataclass(kw_only=True)
class Bench:
    """Where things are put, and focused runs: each is made when it is asked for first."""

    out: Path
    folder: Path
    workers: int
    stack: ExitStack
    runs: dict[str, Run] = field(default_factory=dict)

    @cached_property
    def client(self) -> Client:
        cores, memory = machine()
        threads, limit = max(cores // self.workers, 1), memory // self.workers
        return self.stack.enter_context(open_client(workers=self.workers, threads=threads, memory_limit=limit))

    def history(self, name: str) -> Path:
        store = self.folder / f"{name}.zarr"
        if not store.exists():
            tell(f"  simulating {name}")
            blocksar.simulate(scene(name), store, threads=THREADS)
        return store

    def run(self, name: str, *, blocks: int, grid: Grid | None = None, **options: Any) -> Run:
        """A shipped scene, focused through the public interface."""
        label = "-".join([name, str(blocks), *map(str, options.values())])
        if label not in self.runs:
            store = self.history(name)
            tell(f"  focusing {label}")
            blocksar.focus(store, self.folder / label, blocks=blocks, grid=grid, client=self.client, **options)
            self.runs[label] = Run(self.folder / label)
        return self.runs[label]

    def picture(self, name: str) -> Path:
        return self.out / f"{name}.png"


class Run:
    """A finished run, ready to be measured."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.image = blocksar.open(path)
        self.geometry = Geometry(collection=read_collection(path / "collection.zarr")[0].centred())
        self.x, self.y = (np.asarray(self.image[axis].values, np.float64) for axis in ("x", "y"))

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        return np.asarray(self.image["image"][rows, columns].values)

    def read_block(self, rows: slice, columns: slice) -> Any:
        return self.image["block"][rows, columns].values

    def responses(self, wanted: Sequence[Target]) -> list[Response]:
        found = [read_response(self.read, self.x, self.y, self.geometry, target) for target in wanted]
        return [response for response in found if response is not None]

    @cache  # noqa: B019 - runs live as long as the script
    def measured(self, name: str, names: tuple[str, ...] | None = None) -> dict[str, PointResponse]:
        return {r.target.name: measure(r) for r in self.responses(targets(name, names))}


# ---------------------------------------------------------------- single targets: traced lines, and samples


def lines(made: Plan, places: Sequence[Place]) -> Line:
    """Of some targets, in the recovered signal."""
    return recovered_line(
        made.geometry,
        epoch_range=np.array([r for r, _ in places]),
        yaw=np.array([yaw for _, yaw in places]),
        origin=made.recovery.origin,
        walk=made.recovery.walk,
    )


def traced(line: Line, block: BlockPlan, *, through: type | None = None) -> Line:
    """After the steps of a block, all or up to the last of a kind."""
    kinds = [isinstance(step, through) for step in block.chain] if through else [True] * len(block.chain)
    last = max((i for i, wanted in enumerate(kinds) if wanted), default=-1)
    for step in block.chain[: last + 1]:
        line = step.trace(line)
    return line


@cache
def slab(name: str, place: Place, first_bin: int, n_bin: int) -> ComplexArray:
    """A block's part of the recovered spectrum of one unit target: (range frequency, Doppler bin)."""
    made = plan(name, 1)
    collection = made.geometry.collection
    point = made.geometry.ground_point(np.array(place[0]), np.array(place[1]))
    signal = simulate_pulses(collection, point[:1], point[1:2], np.ones(1), threads=THREADS)
    frequency = collection.range_frequency
    spectrum = recover_columns(signal, range_frequency=frequency, recovery=made.recovery, threads=THREADS)
    return np.ascontiguousarray(spectrum[first_bin : first_bin + n_bin].T)


class Migration(NamedTuple):
    """A target after a step: its line, and where its range-compressed samples peak (time in s, range in m)."""

    line: Line
    time: FloatArray
    peak: FloatArray

    @property
    def extent(self) -> float:
        """Of the line in range, m."""
        return float(np.ptp(self.line.range))

    @property
    def disagreement(self) -> float:
        """Largest distance of a peak from the line, m."""
        return float(np.abs(self.peak - np.interp(self.time, self.line.time, self.line.range)).max())


def migrations(name: str, made: Plan, block: BlockPlan, place: Place) -> list[Migration]:
    """One target alone: after the unified walk correction, and after every step up to range compression."""
    at = next(i for i, step in enumerate(block.chain) if isinstance(step, Compression))
    walk, compression = block.chain[0], block.chain[at]
    assert isinstance(walk, ResidualRangeWalk) and isinstance(compression, RangeCompression)
    bare = replace(compression, reference=np.zeros_like(compression.reference))
    samples, line = slab(name, place, block.first_bin, block.n_bin), lines(made, [place])
    found = [_migration(line, replace(walk, walk=0.0).apply(samples, threads=THREADS), bare)]
    for step in block.chain[:at]:
        samples, line = step.apply(samples, threads=THREADS), step.trace(line)
        found.append(_migration(line, samples, bare))
    return [*found, _migration(compression.trace(line), samples, compression)]


def _migration(line: Line, samples: ComplexArray, compression: RangeCompression) -> Migration:
    """Compress some pulses of samples (range frequency, time) about the line, finely, and look for their peaks."""
    line = Line(**{name: np.ravel(getattr(line, name)) for name in Line.__dataclass_fields__})
    time, coarse = compression.time, compression.rows.step
    first, last = np.searchsorted(time.values, [line.time.min(), line.time.max()])
    every = max(int(last - first) // PULSES, 1)
    pulses = Axis(float(time.values[first]), time.step * every, len(range(first, last, every)))
    reach = np.ptp(line.range) / 2 + 4 * coarse
    around = Axis(float(line.range.mean() - reach), coarse / FINE, int(2 * reach / coarse * FINE) + 1)
    some = np.ascontiguousarray(samples[:, first:last:every])
    profiles = replace(compression, time=pulses, rows=around).apply(some, threads=THREADS)
    return Migration(line, pulses.values, _peaks(around, np.abs(profiles) ** 2))


def _peaks(axis: Axis, power: FloatArray) -> FloatArray:
    """Where each column is strongest, by a parabola through three samples."""
    top = np.clip(power.argmax(axis=0), 1, axis.size - 2)
    a, b, c = (power[top + k, np.arange(power.shape[1])] for k in (-1, 0, 1))
    return np.asarray(axis.values[top] + axis.step * (a - c) / (2 * (a - 2 * b + c)))


class Cut(NamedTuple):
    """An azimuth response: offsets (Hz) from where its line focuses, complex samples, theoretical width (Hz)."""

    offset: FloatArray
    values: Complex128Array
    width: float


def azimuth_cut(name: str, made: Plan, block: BlockPlan, place: Place) -> Cut:
    """One target alone, through the whole chain: its cut along Doppler at its strongest range."""
    samples = slab(name, place, block.first_bin, block.n_bin)
    for stage in stages(block.chain):
        samples = stage.apply(samples, threads=THREADS)
    row = int(np.abs(samples).max(axis=1).argmax())
    doppler = block.ground.doppler
    values = np.asarray(resample(samples[row].astype(np.complex128), 2 * FINE * doppler.size))
    axis = doppler.start + doppler.step / (2 * FINE) * np.arange(values.size)
    line = traced(lines(made, [place]), block)
    return Cut(axis - focus(line).doppler[0], values, SINC_WIDTH / float((line.weight * line.stretch).sum()))


# ---------------------------------------------------------------- paper A: the range series (2)

ORDERS = ("first", "second", "third", "fourth")


class Sector(NamedTuple):
    """Yaws, rad: the whole steering interval, or a block of it."""

    low: float
    high: float

    @property
    def centre(self) -> float:
        return (self.low + self.high) / 2


def sectors(count: int) -> list[Sector]:
    """The steering interval of paper A's Table 1, divided evenly."""
    beam = scene("table1").beam
    assert beam is not None
    edges = np.radians(np.linspace(beam.start_deg, beam.stop_deg, count + 1)).tolist()
    return [Sector(*edge) for edge in pairwise(edges)]


def series_phase(sector: Sector, order: int, *, kept: int) -> tuple[FloatArray, FloatArray]:
    """Yaws (n,) in rad, and the phase (range, n) of k_n less its first terms in yaw, (3) of paper A, in pi.

    All at half the aperture; `kept` terms are taken off.
    """
    geo, ranges = geometry("table1"), np.array(list(SWATH.values()))
    yaw = np.linspace(sector.low, sector.high, YAWS)
    exact = fitting.range_series(geo, ranges[:, None], yaw, order=4)[..., order]
    half_width = (sector.high - sector.low) / 2
    series = fitting.yaw_series(geo, ranges, sector.centre, order=4, half_width=half_width)[:, order, :kept]
    error = exact - series @ (yaw - sector.centre) ** np.arange(kept)[:, None]
    half_aperture = geo.collection.pulse_interval * geo.collection.n_pulse / 2
    return yaw, 4 / geo.collection.wavelength * error * half_aperture**order


def phase_panel(title: str, order: int, *, blocks: int, kept: int) -> tuple[Panel, float]:
    """Curves of `series_phase` over yaw, one a range; and the largest of them, in pi."""
    found = [series_phase(sector, order, kept=kept) for sector in sectors(blocks)]
    yaw = np.concatenate([np.append(yaw, np.nan) for yaw, _ in found])
    phase = np.concatenate([np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan) for _, values in found], axis=1)
    curves = [
        Trace(f"{name} range, {rng / 1e3:.1f} km", np.degrees(yaw), values, colour)
        for (name, rng), values, colour in zip(SWATH.items(), phase, CURVE_COLOURS, strict=False)
    ]
    levels = (Level("±π/4", QUARTER), Level("", -QUARTER))
    return Panel(title, "yaw (°)", "phase (π rad)", curves, levels), float(np.nanmax(np.abs(phase)))


def figure2(bench: Bench) -> Exhibit:
    """Before division: what (2) leaves of k_1 .. k_4."""
    made = [phase_panel(f"({'abcd'[n]}) {ORDERS[n]} order", n + 1, blocks=1, kept=4 - n) for n in range(4)]
    path = bench.picture("fig2")
    plot_panels([panel for panel, _ in made], path, title="What the range series leaves, whole sector")
    claims = (ABOVE_QUARTER, ABOVE_QUARTER, BELOW_QUARTER, BELOW_QUARTER)
    return Exhibit(
        title="Figure 2: phase errors of the range series before angular division",
        text="Phase at half the aperture that the series (2) leaves of each order of the range, over the whole "
        "steering interval about its centre. The paper prints curves, and says which of them exceed π/4.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", claim, digits=4)
            for name, (_, worst), claim in zip(ORDERS, made, claims, strict=True)
        ],
    )


def figure3(bench: Bench) -> Exhibit:
    """After division in three: what (2) leaves of k_1 and k_2."""
    made = [phase_panel(f"({'ab'[n]}) {ORDERS[n]} order", n + 1, blocks=3, kept=4 - n) for n in range(2)]
    path = bench.picture("fig3")
    plot_panels([panel for panel, _ in made], path, title="What the range series leaves, three blocks")
    return Exhibit(
        title="Figure 3: phase errors of the range series after angular division",
        text="The same with the steering interval divided in three, each block about its own centre. “Much less than "
        "π/4” is taken as less than a fifth of it.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", below(QUARTER / 5, "much less than π/4"), digits=4)
            for name, (_, worst) in zip(ORDERS, made, strict=False)
        ],
    )


def figure4(bench: Bench) -> Exhibit:
    """The space-variant part of the third order, before and after division."""
    titles = {1: "(a) whole sector", 3: "(b) three blocks"}
    made = {count: phase_panel(title, 3, blocks=count, kept=1) for count, title in titles.items()}
    path = bench.picture("fig4")
    plot_panels([panel for panel, _ in made.values()], path, title="The space-variant third order")
    return Exhibit(
        title="Figure 4: phase of the space-variant third order",
        text="Phase at half the aperture of k₃ less its value at the centre: of the sector in (a), of each block in "
        "(b).",
        pictures=[path],
        rows=[
            Row("whole sector, largest phase", made[1][1], "π rad", ABOVE_QUARTER, digits=3),
            Row("three blocks, largest phase", made[3][1], "π rad", BELOW_QUARTER, digits=3),
        ],
    )


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


def line_panel(title: str, line: Line, names: Sequence[str], *, under: Map | None = None) -> Panel:
    """Time-frequency lines (n_target, n), s and kHz; over a spectrogram all have one colour, and the first a name."""
    names = [*names, *[""] * (line.doppler.shape[0] - len(names))]
    colours = CURVE_COLOURS if under is None else [LIMIT] * len(names)
    traces = [
        Trace(name, time, doppler / 1e3, colour, "-" if under is None else "--")
        for name, time, doppler, colour in zip(names, line.time, line.doppler, colours, strict=False)
    ]
    return Panel(title, "slow time (s)", "Doppler (kHz)", traces, map=under)


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


# ---------------------------------------------------------------- paper A: range migration


def same_range(block: BlockPlan) -> dict[str, Place]:
    """T_A, T_B, T_C: targets of one range at a block's first yaw of full dwell, its last, and halfway."""
    full = full_dwell()
    first, last = max(block.low, full.low), min(block.high, full.high)
    yaws = (first, (first + last) / 2, last)
    return {f"T_{letter}": (SWATH["middle"], yaw) for letter, yaw in zip("ABC", yaws, strict=True)}


def cells(metres: float) -> float:
    """Range resolution cells of paper A's scene."""
    return metres * 2 * geometry("table1").collection.bandwidth / SPEED_OF_LIGHT


def migration_panel(title: str, shown: Mapping[str, Migration], *, about: float) -> Panel:
    """Traced lines and measured peaks, m from a range."""
    traces = []
    for (name, found), colour in zip(shown.items(), CURVE_COLOURS, strict=False):
        traces.append(Trace(f"{name}traced", found.line.time, found.line.range - about, colour))
        traces.append(Trace(f"{name}measured", found.time, found.peak - about, colour, "."))
    return Panel(title, "slow time (s)", "range (m)", traces)


def figure8(bench: Bench) -> Exhibit:
    """Range migration of three targets of one range, through the range steps of the first block."""
    made = plan("table1", 3)
    block = made.blocks[0]
    found = {name: migrations("table1", made, block, place) for name, place in same_range(block).items()}
    stages_ = ("unified range-walk correction", "residual range-walk correction", "keystone", "RCMC")
    origin = SWATH["middle"] - made.recovery.origin
    panels = [
        migration_panel(
            f"({letter}) after {stage}", {f"${name}$, ": steps[i] for name, steps in found.items()}, about=origin
        )
        for i, (letter, stage) in enumerate(zip("abcd", stages_, strict=True))
    ]
    path = bench.picture("fig8")
    plot_panels(panels, path, title="Range migration of targets of one range")
    worst = [cells(max(steps[i].extent for steps in found.values())) for i in range(4)]
    apart = cells(float(np.ptp([steps[3].line.range.mean() for steps in found.values()])))
    claims = (above(1, "walk remains"), above(0.5, "differs between targets"), None, below(0.5, "corrected"))
    off = max(steps[i].disagreement for steps in found.values() for i in range(4))
    return Exhibit(
        title="Figure 8: range migration of targets that share a reference range",
        text=f"T_A, T_B and T_C lie at {SWATH['middle'] / 1e3:.0f} km in the first block: at the first and the last of "
        "its yaws that are lit for a full dwell, and halfway; ranges are shown from there. Lines are traced; dots are "
        "peaks of range-compressed samples, of each target simulated alone and put through the steps. A range cell is "
        f"{1 / cells(1):.2f} m.",
        pictures=[path],
        rows=[
            *(Row(f"after {stage}, largest migration", cells_, "cells", claim, digits=3)
              for stage, cells_, claim in zip(stages_, worst, claims, strict=True)),
            Row("after RCMC, apart from each other", apart, "cells", below(1, "one range cell"), digits=3),
            Row("peaks and traced lines, largest difference", cells(off), "cells", digits=3),
        ],
    )  # fmt: skip


def figure11(bench: Bench) -> Exhibit:
    """Residual migration of a near, a middle and a far target, without keystone and with."""
    path, panels, found = bench.picture("fig11"), [], []
    letters = iter("abcdef")
    for keystone in (False, True):
        made = plan("table1", 3, keystone=keystone)
        block = made.blocks[1]
        for (name, rng), target in zip(SWATH.items(), "ABC", strict=True):
            after = migrations("table1", made, block, (rng, block.low))[-1]
            title = f"({next(letters)}) {target}, {name} range, {'with' if keystone else 'without'} keystone"
            panels.append(migration_panel(title, {"": after}, about=float(after.line.range.mean())))
            found.append((f"{target}, {'with' if keystone else 'without'} keystone", after))
    reach = 1.1 * max(float(np.abs(trace.y).max()) for panel in panels for trace in panel.traces)
    plot_panels([panel._replace(y_limits=(-reach, reach)) for panel in panels], path, columns=3, size=(3.6, 2.7),
                title="Residual range migration")  # fmt: skip
    off = cells(max(after.disagreement for _, after in found))
    larger, corrected = above(1, "much larger than a cell"), below(0.5, "accurately compensated")
    claims = (larger, None, larger, corrected, corrected, corrected)
    return Exhibit(
        title="Figure 11: residual range migration without and with keystone",
        text="Targets A, B and C stand at near, middle and far range (27.6, 30.0, 32.4 km), all at the first yaw of "
        "the middle block, where what keystone corrects is largest; the paper does not print their yaws. Ranges are "
        "from the mean over the dwell, in one scale. Without keystone, migration is corrected in the time domain by "
        "the block's reference.",
        pictures=[path],
        rows=[
            Row(name, cells(after.extent), "cells", claim, digits=3)
            for (name, after), claim in zip(found, claims, strict=True)
        ],
        notes=[f"Peaks of samples and traced lines differ by {off:.3f} cells at most."],
    )


# ---------------------------------------------------------------- paper A: azimuth focusing


def rates(line: Line) -> FloatArray:
    """Mean Doppler rate of each line, Hz/s."""
    return np.asarray(np.diff(line.doppler[:, [0, -1]], axis=1) / np.diff(line.time[:, [0, -1]], axis=1))[:, 0]


def figure9(bench: Bench) -> Exhibit:
    """Time-frequency lines through the azimuth steps, and focused azimuth responses."""
    made, path = plan("table1", 3), bench.picture("fig9")
    bare = plan("table1", 3, perturbation="none")
    block = made.blocks[0]
    places = same_range(block)
    line = lines(made, list(places.values()))
    kinds = (Compression, FrequencyPerturbation, Deramp)
    after = [traced(line, block, through=kind) for kind in kinds]
    titles = ("(a) before perturbation", "(b) after frequency perturbation", "(c) after deramp")
    panels = [
        line_panel(title, line, [f"${name}$" for name in places]) for title, line in zip(titles, after, strict=True)
    ]
    cuts = {name: azimuth_cut("table1", made, block, place) for name, place in places.items()}
    blurred = {name: azimuth_cut("table1", bare, bare.blocks[0], place) for name, place in places.items()}
    panels.append(_cut_panel("(d) focused in Doppler", cuts, blurred))
    plot_panels(panels, path, title="Azimuth focusing of targets of one range")
    dwell = float(line.weight.sum(axis=-1).max())
    lined = [traced(lines(p, list(places.values())), p.blocks[0], through=Deramp) for p in (made, bare)]
    left = [float(focus(found).quadratic.max()) / np.pi for found in lined]
    # As phase at the dwell's edge, of pi.
    differing, *apart = (float(np.ptp(rates(found))) * (dwell / 2) ** 2 for found in (after[0], *lined))
    quality = [_quality(cut) for cut in (*cuts.values(), *blurred.values())]
    return Exhibit(
        title="Figure 9: azimuth focusing of targets that share a reference range",
        text="The targets of Figure 8. (a) to (c) are traced lines; (d) are cuts of focused samples about the Doppler "
        "at which each target's traced line focuses, dotted without any perturbation, where one deramp has to serve "
        "all. Targets are lit at different times, so one rate for all means one curve of Doppler over time, moved up "
        "and down: that is what a common deramp takes out. By how much rates differ beyond it is given as phase at "
        "the dwell's edge.",
        pictures=[path],
        rows=[
            *(
                Row(f"(a) Doppler rate of {name}", float(rate) / 1e3, "kHz/s")
                for name, rate in zip(places, rates(after[0]), strict=True)
            ),
            Row("(a) rates differ by", differing, "π rad", ABOVE_QUARTER),
            Row("(a) rates differ, beyond one curve", apart[1], "π rad", digits=4),
            Row("(b) rates differ, beyond one curve", apart[0], "π rad", below(QUARTER / 5, "the same rate"), digits=4),
            Row("(c) quadratic phase left", left[0], "π rad", below(QUARTER / 5, "level"), digits=4),
            Row("(c) the same without perturbation", left[1], "π rad", digits=4),
            *(Row(f"(d) PSLR of {name}", found.pslr, "dB") for name, found in zip(places, quality[:3], strict=True)),
            *(Row(f"(d) PSLR of {name}, no perturbation", found.pslr, "dB")
              for name, found in zip(places, quality[3:], strict=True)),
        ],
    )  # fmt: skip


def _quality(cut: Cut) -> ProfileQuality:
    """About its peak."""
    top = int(np.abs(cut.values).argmax())
    return profile_quality(cut.offset - cut.offset[top], cut.values, width=cut.width)


def _cut_panel(title: str, cuts: dict[str, Cut], blurred: dict[str, Cut]) -> Panel:
    traces, reach = [], 8 * next(iter(cuts.values())).width
    peak = max(float(np.abs(cut.values).max()) for cut in cuts.values())
    parts: tuple[tuple[dict[str, Cut], Style], ...] = ((blurred, ":"), (cuts, "-"))
    for shown, style in parts:
        for cut, colour in zip(shown.values(), CURVE_COLOURS, strict=False):
            near = np.abs(cut.offset) < reach
            decibel = 20 * np.log10(np.abs(cut.values[near]) / peak + 1e-6)
            named = ("no perturbation", "#8c9bb0") if style == ":" else ("", colour)
            traces.append(Trace(named[0], cut.offset[near], decibel, named[1], style))
    return Panel(title, "Doppler from the traced focus (Hz)", "power (dB)", traces, y_limits=(-45, 2))


# ---------------------------------------------------------------- paper A: images


def block_of(made: Plan, target: Target) -> int:
    """The block that owns a target."""
    yaw = float(made.geometry.yaw(np.array(target.x), np.array(target.y)))
    return int(np.clip(np.searchsorted(made.seams, yaw) - 1, 0, made.n_blocks - 1))


def figure12(bench: Bench) -> Exhibit:
    """Images of the blocks in their own range-Doppler grid, from the run's recovered spectrum."""
    run, made, path = bench.run("table1", blocks=3), plan("table1", 3), bench.picture("fig12")
    owners = {target: block_of(made, target) for target in targets("table1")}
    panels, off, doppler = [], 0.0, dict[str, float]()
    for block in made.blocks:
        image, grid = _block_image(run, block), block.ground.doppler
        mine = [target for target, owner in owners.items() if owner == block.index]
        row, column, *_ = block.ground.locate(np.array([t.x for t in mine]), np.array([t.y for t in mine]))
        off = max(off, _distance(image, row, column))
        doppler |= {target.name: grid.start + grid.step * c for target, c in zip(mine, column, strict=True)}
        panels.append(_block_panel(image, block, {t.name: (r, c) for t, r, c in zip(mine, row, column, strict=True)}))
    leaning = abs(doppler["C1"] - doppler["A1"]) / 1e3
    plot_panels(panels, path, columns=3, size=(3.7, 4.2), title="Focused blocks in range and Doppler",
                bar="power (dB, not calibrated)")  # fmt: skip
    return Exhibit(
        title="Figure 12: images of the angular blocks",
        text="The blocks of the run of Figure 13 as they are focused, before geometric correction: range against "
        "Doppler, the strongest sample of each cell of the picture. Columns of targets lean and bend: the geometric "
        "distortion. Names stand beside their targets' predicted places.",
        pictures=[path],
        rows=[
            Row("Doppler of A1 and C1, of one azimuth, differs by", leaning, "kHz", above(0.1, "obvious distortion")),
            Row("strongest samples from the predicted places", off, "samples"),
        ],
    )


def _block_image(run: Run, block: BlockPlan) -> ComplexArray:
    bins = slice(block.first_bin, block.first_bin + block.n_bin)
    samples = np.ascontiguousarray(read_region(run.path / "spectrum.zarr", "spectrum", (bins, slice(None))).T)
    for stage in stages(block.chain):
        samples = stage.apply(samples, threads=THREADS)
    return samples[: block.ground.rows.size, : block.ground.doppler.size]


def _distance(image: ComplexArray, row: FloatArray, column: FloatArray, reach: int = 4) -> float:
    """Largest offset, in samples, of the strongest sample about each predicted place."""
    worst = 0.0
    for r, c in zip(row, column, strict=True):
        r0, c0 = round(r) - reach, round(c) - reach
        about = np.abs(image[r0 : r0 + 2 * reach + 1, c0 : c0 + 2 * reach + 1])
        peak = np.unravel_index(int(about.argmax()), about.shape)
        worst = max(worst, abs(r0 + int(peak[0]) - r), abs(c0 + int(peak[1]) - c))
    return float(worst)


def _block_panel(image: ComplexArray, block: BlockPlan, places: dict[str, tuple[float, float]]) -> Panel:
    doppler, rng = block.ground.doppler, block.ground.rows
    seen = overview(lambda r, c: image[r, c], doppler.values, rng.values, max_pixels=500)
    marks = [
        Mark(name, (doppler.start + doppler.step * (c + 60)) / 1e3, (rng.start + rng.step * (r + 60)) / 1e3)
        for name, (r, c) in places.items() if name in NAMES
    ]  # fmt: skip
    title, shown = f"({'abc'[block.index]}) block {block.index + 1}", as_map(seen, scale=(1e-3, 1e-3))
    return Panel(title, "Doppler (kHz)", "range from the centre's (km)", map=shown, marks=marks)


def pixel(target: Target, found: PointResponse) -> tuple[float, float]:
    """Measured position in pixels of the paper's picture: ground range, azimuth."""
    area = scene("table1")
    cos, sin = np.cos(area.centre_yaw), np.sin(area.centre_yaw)
    dx, dy = target.x + found.error_x - area.centre[0], target.y + found.error_y - area.centre[1]
    return MIDDLE + float(dx * cos + dy * sin) / PIXEL, MIDDLE + float(dy * cos - dx * sin) / PIXEL


def figure13(bench: Bench) -> Exhibit:
    """Each block after geometric correction, and the mosaic; positions of targets."""
    run, path, whole = bench.run("table1", blocks=3), bench.picture("fig13"), bench.picture("fig13d")
    panels = []
    for index in range(3):
        seen = overview(partial(_owned, run, index), run.x, run.y, max_pixels=500)
        title, shown = f"({'abc'[index]}) block {index + 1}", as_map(seen, scale=(1e-3, 1e-3))
        panels.append(Panel(title, "x (km)", "y (km)", map=shown, equal=True))
    plot_panels(panels, path, columns=3, size=(3.7, 3.3), title="Blocks after geometric correction",
                bar="power (dB, unit reflectivity = 0)")  # fmt: skip
    plotting.plot_mosaic(
        run.read, run.x, run.y, whole, read_block=run.read_block, targets=targets("table1"), labels=NAMES,
        title="(d) blocks combined",
    )  # fmt: skip
    found = run.measured("table1")
    places = {target.name: pixel(target, found[target.name]) for target in targets("table1")}
    off = max(float(np.hypot(r.error_x, r.error_y)) for r in found.values())
    pixels = [
        *(row for name in MOSAIC_PIXELS for row in _pixel_rows(f"{name}, mosaic", places[name], MOSAIC_PIXELS[name])),
        *(row for name in BLOCK_PIXELS for row in _pixel_rows(f"{name}, block {name[1]}", (
            places[name][0], places[name][1] - BLOCK_COLUMNS[name[1]]), BLOCK_PIXELS[name])),
    ]  # fmt: skip
    accuracy = Row(
        f"largest position error of {len(found)} targets", off, "m", below(PIXEL, "within a 2 m cell"), digits=4
    )
    return Exhibit(
        title="Figure 13: images after geometric correction",
        text="(a) to (c) are what each block owns of the mosaic (d); the strongest pixel of each cell of the picture "
        "is shown, and yellow lines are the blocks' borders. Positions are measured peaks, written as pixels of the "
        "paper's picture: 2 m, ground range first, B2 at (1276, 1276). The pictures of the blocks begin at columns 0, "
        "850 and 1700 of the mosaic, which follows from the printed A2, A3 and B2.",
        pictures=[path, whole],
        rows=[accuracy, *pixels],
        tables=[listed([accuracy]), crossed(pixels)],
        notes=["The paper lists C1 twice among the mosaic's targets; the fourth position is that of A3."],
    )


def _owned(run: Run, index: int, rows: slice, columns: slice) -> ComplexArray:
    """What one block owns of the mosaic."""
    return np.where(run.read_block(rows, columns) == index, run.read(rows, columns), np.complex64(np.nan))


def _pixel_rows(name: str, ours: tuple[float, float], printed: tuple[int, int]) -> list[Row]:
    axes = ("ground range", "azimuth")
    return [Row(f"{name}: {axis}", o, "pixels", p, 1.0) for axis, o, p in zip(axes, ours, printed, strict=True)]


# ---------------------------------------------------------------- point responses

TOLERANCES = {"PSLR": 0.5, "ISLR": 0.5, "IRW": 0.05}
WHY_ISLR = (
    "ISLR: the paper does not define its ISLR. Ours counts side lobes within {ours:g} widths of the peak, for which an "
    "ideal response has {ideal:.2f} dB; it would have the {printed:.2f} dB that {whose} where they are counted within "
    "about {widths:.1f} widths."
)
WHY_WIDTH = (
    "Azimuth IRW: the printed widths are all but constant over the scene, as if one factor had turned the width in "
    "Doppler, which is the same for every full dwell, into metres. Ours are metres on the ground along constant range: "
    "Doppler changes less with yaw towards the velocity, so they grow with yaw and follow the limit of each target's "
    "own dwell (last column). A1 and A3 are lit for part of a dwell only."
)
WHY_B = (
    "The frequency perturbation is not FDPF, of which the paper gives no more than the name: it blurs points by other "
    "amounts. That points at the edges blur by it, and hardly by resampling, is what the tables show."
)
WHY_PSLR = "PSLR: the printed response of this target is not ours."


def why_islr(printed: float, whose: str) -> str:
    """With the definition that would give an ideal response the printed ISLR, dB."""
    u = np.arange(0, 60, 1e-3)
    energy = np.cumsum(np.sinc(u) ** 2)
    main, side = energy[u <= 1][-1], u > 1
    widths, islr = u[side] / SINC_WIDTH, 10 * np.log10((energy[side] - main) / main)
    within = float(widths[np.abs(islr - printed).argmin()])
    ideal = float(np.interp(CUT_WIDTHS, widths, islr))
    return minus(WHY_ISLR.format(ours=CUT_WIDTHS, ideal=ideal, printed=printed, whose=whose, widths=within))


def response_tables(
    found: dict[str, PointResponse], printed: dict[str, PaperResponse], why: str
) -> tuple[list[Row], list[Table]]:
    """Range and azimuth of the nine targets, beside the paper's."""
    rows_, tables = [], []
    islr = why_islr(float(np.mean([row.range_islr for row in printed.values()])), "the table prints for range (mean)")
    for axis in ("range", "azimuth"):
        part = []
        for name in NAMES:
            for quantity, unit in (("PSLR", "dB"), ("ISLR", "dB"), ("IRW", "m")):
                key = f"{axis}_{quantity.lower()}"
                ours, theirs = getattr(found[name], key), getattr(printed[name], key)
                reason = {"ISLR": islr, "IRW": WHY_WIDTH, "PSLR": why}[quantity]
                part.append(Row(f"{name}: {axis} {quantity}", ours, unit, theirs, TOLERANCES[quantity], reason))
        table = crossed(part)
        table.header.append("IRW, limit (m)")
        for name, line in zip(NAMES, table.lines, strict=True):
            line.append(Cell(f"{getattr(found[name], f'{axis}_irw_theory'):.2f}"))
        tables.append(table)
        rows_ += part
    return rows_, tables


def contours(bench: Bench, key: str, run: Run, title: str) -> Path:
    path = bench.picture(key)
    plotting.plot_contours(run.responses(targets("table1", NAMES)), path, title=title)
    return path


def reference_run(bench: Bench) -> Run:
    """The reference method of paper A: see `Method`."""
    return bench.run("table1", blocks=1, coefficients="closed-form", range_model="conventional")


REFERENCE = (
    "The paper's reference method is its [10], of which it says only that the range model is less accurate after "
    "variable substitution and that the space-variant third order remains, all other steps being its own. Built in its "
    "place: a range model whose substitution is right to first order in azimuth. With it only the first condition of "
    "(29) can be met, so there is the α of (30) and no β, and third and fourth order count as constant; the sector is "
    "one block."
)


def figure14(bench: Bench) -> Exhibit:
    """Contours of the nine targets by the reference method."""
    path = contours(bench, "fig14", reference_run(bench), "Reference method")
    return Exhibit(
        title="Figure 14: contours by the reference method",
        text=f"Contours at −3, −15 and −30 dB on each response's own axes, all panels in one scale. {REFERENCE}",
        pictures=[path],
    )


def table2(bench: Bench) -> Exhibit:
    """The nine targets by the reference method."""
    measured = reference_run(bench).measured("table1", NAMES)
    why = (
        "PSLR: what was built in place of the reference method is not it, so edge targets blur by another amount; that "
        "they blur while A2, B2 and C2 do not is what the table shows."
    )
    found, tables = response_tables(measured, TABLE2, why)
    bad = [name for name in NAMES if measured[name].azimuth_pslr > -9]
    return Exhibit(
        title="Table 2: nine targets by the reference method",
        text=REFERENCE,
        rows=found,
        tables=tables,
        notes=[
            f"Azimuth PSLR is worse than −9 dB at {', '.join(bad) or 'none of the nine'}; in the paper at all of A1, "
            "A3, B1, B3, C1 and C3."
        ],
    )  # fmt: skip


def figure15(bench: Bench) -> Exhibit:
    """Contours of the nine targets, three blocks."""
    path = contours(bench, "fig15", bench.run("table1", blocks=3), "Angular division, three blocks")
    return Exhibit(
        title="Figure 15: contours by the proposed method",
        text="Contours at −3, −15 and −30 dB on each response's own axes, all panels in one scale: three blocks, "
        "fitted coefficients.",
        pictures=[path],
    )


def table3(bench: Bench) -> Exhibit:
    """The nine targets, three blocks."""
    measured = bench.run("table1", blocks=3).measured("table1", NAMES)
    found, tables = response_tables(measured, TABLE3, WHY_PSLR)
    excess = max(abs(r.azimuth_irw / r.azimuth_irw_theory - 1) for r in measured.values())
    return Exhibit(
        title="Table 3: nine targets by the proposed method",
        text="Three blocks, fitted coefficients. PSLR, ISLR and IRW are measured in the calibrated ground image, along "
        "constant Doppler (range) and along constant range (azimuth).",
        rows=found,
        tables=tables,
        notes=[f"Every azimuth width is within {100 * excess:.2g} % of what the target's own dwell allows."],
    )


# ---------------------------------------------------------------- paper B


def paper_b_table(bench: Bench) -> Exhibit:
    """Three points of paper B's scene: resampled, and by a frequency perturbation only."""
    methods: dict[str, dict[str, Any]] = {
        "keystone-resampling": {"perturbation": "all"},
        "frequency perturbation, closed-form": {"perturbation": "frequency", "coefficients": "closed-form"},
        "frequency perturbation, fitted": {"perturbation": "frequency"},
    }
    parts = {}
    for title, options in methods.items():
        run = bench.run("paper_b", blocks=1, grid=GRID_B, processor="keystone-resampling", **options)
        measured = list(run.measured("paper_b", POINTS_B).values())
        parts[title] = _paper_b_rows(measured, PAPER_B[options["perturbation"]])
    found = [row for part in parts.values() for row in part]
    # The peak is looked for where the point is.
    above_peak = any(row.ours > 0 for row in found if row.what.endswith("PSLR"))
    smeared = ["PSLR above 0 dB: the point is smeared, and a lobe beside its place is the strongest."] * above_peak
    return Exhibit(
        title="Table 2 of paper B: azimuth figures of three points",
        text="Points 1 to 3 stand at −1000, 0 and +1000 m of azimuth, at middle range: the paper's figure of them is "
        "not at hand, and that is its scene's size. The first table is the paper's method, with fitted coefficients. "
        "The others stand in for its FDPF column, a method which it only names: a frequency perturbation in place of "
        "perturbation in time and resampling, with coefficients expanded about the scene's centre, and fitted to the "
        "whole scene.",
        rows=found,
        tables=[crossed(part, title) for title, part in parts.items()],
        notes=[
            *smeared,
            "MW: the unit of the printed widths is not stated, so they cannot be compared with metres. For the paper's "
            "method they are all but equal, as widths in Doppler are of points that are lit for one time; so what is "
            "compared is the width over the limit of each point's own dwell, with point 2 as the unit.",
        ],
    )


def _paper_b_rows(found: Sequence[PointResponse], printed: Mapping[str, Sequence[float]]) -> list[Row]:
    islr = why_islr(PAPER_B["all"]["ISLR"][1], "the paper prints for point 2")
    rows_, over_limit = [], [response.azimuth_irw / response.azimuth_irw_theory for response in found]
    well = printed is PAPER_B["all"]
    for i, (response, width) in enumerate(zip(found, printed["MW"], strict=True)):
        name, ratio, theirs = f"point {i + 1}", over_limit[i] / over_limit[1], width / printed["MW"][1]
        rows_ += [
            Row(f"{name}: PSLR", response.azimuth_pslr, "dB", printed["PSLR"][i], 0.5, WHY_B),
            Row(f"{name}: ISLR", response.azimuth_islr, "dB", printed["ISLR"][i], 0.5, islr if well else WHY_B),
            Row(f"{name}: IRW", response.azimuth_irw, "m", f"MW {width:.2f}", digits=3),
            Row(f"{name}: IRW over limit, point 2 = 1", ratio, "", theirs, 0.02, WHY_B, digits=3),
        ]
    return rows_


# ---------------------------------------------------------------- coefficients


def closed_form(bench: Bench) -> Exhibit:
    """Closed-form against fitted coefficients: residual phase by range, and the nine targets with one block."""
    ranges = np.linspace(SWATH["near"], SWATH["far"], 13)
    path, panels, found = bench.picture("closed-form"), [], []
    for blocks in (1, 2, 3):
        traces, title = [], f"{blocks} block{'s' * (blocks > 1)}"
        for coefficients, colour in zip(("closed-form", "fitted"), CURVE_COLOURS[::2], strict=False):
            left = quadratic_left(plan("table1", blocks, coefficients=coefficients), ranges)
            traces.append(Trace(coefficients, ranges / 1e3, left, colour))
            found.append(Row(f"{title}, {coefficients}, worst range", float(left.max()), "rad", digits=4))
        panels.append(
            Panel(
                title, "range (km)", "phase (rad)", traces, [Level("π/4", np.pi / 4)], y_limits=(1e-4, 10.0), log=True
            )
        )
    plot_panels(panels, path, columns=3, size=(3.5, 2.9), title="Quadratic phase left at the dwell's edge")
    runs = {kind: bench.run("table1", blocks=1, coefficients=kind) for kind in ("closed-form", "fitted")}
    measured = {kind: run.measured("table1", NAMES) for kind, run in runs.items()}
    return Exhibit(
        title="Closed-form and fitted coefficients",
        text="Not a figure of the papers. What is left of the quadratic phase at the dwell's edge on traced lines, the "
        "worst of all yaws that are lit for a full dwell, by (30) and (31) of paper A as corrected, and by "
        "coefficients fitted on the lines; and the nine targets of Table 3 with the whole sector as one block.",
        pictures=[path],
        rows=found,
        tables=[listed(found), _pslr_table(measured)],
    )


def full_dwell() -> Sector:
    """First and last yaw that are lit for a full dwell."""
    collection = geometry("table1").collection
    half = (collection.beam_width or 0.0) / 2
    return Sector(float(collection.beam_azimuth.min()) + half, float(collection.beam_azimuth.max()) - half)


def quadratic_left(made: Plan, ranges: FloatArray) -> FloatArray:
    """The worst of all blocks and yaws of full dwell at each range, rad."""
    worst, full = np.zeros(ranges.size), full_dwell()
    for block in made.blocks:
        yaws = np.linspace(max(block.low, full.low), min(block.high, full.high), 21)
        line = lines(made, [(rng, yaw) for rng in ranges.tolist() for yaw in yaws.tolist()])
        left = focus(traced(line, block)).quadratic.reshape(ranges.size, yaws.size)
        worst = np.maximum(worst, left.max(axis=1))
    return worst


def _pslr_table(measured: dict[str, dict[str, PointResponse]]) -> Table:
    lines_ = [[Cell(name)] + [Cell(minus(f"{m[name].azimuth_pslr:.2f}")) for m in measured.values()] for name in NAMES]
    return Table(["target, one block", *(f"azimuth PSLR, {kind} (dB)" for kind in measured)], lines_)


# ---------------------------------------------------------------- the page

EXHIBITS: dict[str, Callable[[Bench], Exhibit]] = {
    "fig2": figure2, "fig3": figure3, "fig4": figure4, "fig6": figure6, "fig7": figure7, "fig8": figure8,
    "fig9": figure9, "fig11": figure11, "fig12": figure12, "fig13": figure13, "fig14": figure14, "table2": table2,
    "fig15": figure15, "table3": table3, "b-table2": paper_b_table, "closed-form": closed_form,
}  # fmt: skip

PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
  body { font: 1rem/1.5 system-ui, sans-serif; color: #1d242d; background: #fff;
         max-width: 68rem; margin: 0 auto; padding: 0 1rem 3rem }
  h1, h2 { line-height: 1.25 }
  h2 { margin-top: 3rem; border-top: 1px solid #d5dae2; padding-top: 1.5rem }
  img { width: 100%; min-width: 40rem; height: auto; display: block }
  .wide { overflow-x: auto; margin: 1rem 0 }
  table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .875rem }
  th, td { padding: .25rem .7rem; border-bottom: 1px solid #e4e7ec; text-align: right; vertical-align: bottom }
  td { white-space: nowrap }
  th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff;
                                   white-space: normal; min-width: 9rem }
  @media (max-width: 40rem) {
    th, td { padding: .2rem .35rem; font-size: .8rem; white-space: normal }
    th:first-child, td:first-child { min-width: 7rem }
  }
  .off { color: #b3202c; font-weight: 600 }
  .quiet { color: #5a6676; font-size: .875rem }
</style>
</head>
<body>
<h1>{{ title }}</h1>
{% for line in preface %}
<p>{{ line }}</p>
{% endfor %}
<div class="wide"><table>
<tr><th>figure or table</th><th>as printed</th><th>seconds</th></tr>
{% for e in exhibits %}
<tr>
  <td><a href="#{{ e.key }}">{{ e.title }}</a></td>
  <td{% if e.failed %} class="off"{% endif %}>{{ e.verdict }}</td>
  <td>{{ "%.0f"|format(e.seconds) }}</td>
</tr>
{% endfor %}
</table></div>
{% for e in exhibits %}
<h2 id="{{ e.key }}">{{ e.title }}</h2>
<p{% if e.failed %} class="off"{% endif %}>{{ e.text }}</p>
{% for picture in e.pictures %}
<div class="wide"><img alt="{{ e.title }}" src="data:image/png;base64,{{ embed(picture) }}"></div>
{% endfor %}
{% for table in e.tables %}
<div class="wide"><table>
<tr>{% for cell in table.header %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for line in table.lines %}
<tr>
{% for cell in line %}
<td{% if cell.off %} class="off"{% endif %}>{{ cell.text }}</td>
{% endfor %}
</tr>
{% endfor %}
</table></div>
{% endfor %}
{% if e.notes %}
<ul>
{% for note in e.notes %}
<li>{{ note }}</li>
{% endfor %}
</ul>
{% endif %}
{% endfor %}
<p class="quiet">{{ made }}</p>
</body>
</html>
"""

README = """\
# {{ title }}

{% for line in preface %}
{{ line }}

{% endfor %}
| figure or table | as printed | seconds |
|---|---|---|
{% for e in exhibits %}
| [{{ e.title }}](#{{ e.key }}) | {{ e.verdict }} | {{ "%.0f"|format(e.seconds) }} |
{% endfor %}
{% for e in exhibits %}

<a id="{{ e.key }}"></a>

## {{ e.title }}

{{ e.text }}
{% for picture in e.pictures %}

![{{ e.title }}]({{ picture.name }})
{% endfor %}
{% for table in e.tables %}

| {{ table.header|join(" | ") }} |
|{{ "---|" * table.header|length }}
{% for line in table.lines %}
{% for cell in line %}| {{ "**%s**"|format(cell.text) if cell.off else cell.text }} {% endfor %}|
{% endfor %}
{% endfor %}
{% if e.notes %}

{% for note in e.notes %}
- {{ note }}
{% endfor %}
{% endif %}
{% endfor %}

{{ made }}
"""


def write_page(out: Path, exhibits: Sequence[Exhibit], seconds: float) -> None:
    """index.html, pictures embedded, and README.md beside the pictures; each there whole or not at all."""
    told = {
        "title": "The papers' figures and tables, reproduced by blocksar",
        "preface": [
            "Every number called ours was measured in the run that wrote this page: scenes simulated with exact "
            "ranges, planned, focused and measured. Printed numbers are quoted; where a paper prints a curve or a "
            "sentence only, what it claims is quoted and checked.",
            "“As printed” counts the numbers that are as printed, within what is usual, and the claims that hold. The "
            "others are in bold, and below their table stands why.",
        ],
        "exhibits": exhibits,
        "made": f"Made by blocksar {blocksar.__version__} in {seconds:.0f} s.",
        "embed": lambda picture: base64.b64encode(picture.read_bytes()).decode(),
    }  # fmt: skip
    for name, template, escaped in (("index.html", PAGE, True), ("README.md", README, False)):
        environment = jinja2.Environment(
            autoescape=escaped, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        part = out / f"{name}.part"
        part.write_text(environment.from_string(template).render(**told), encoding="utf-8")
        part.replace(out / name)


# ---------------------------------------------------------------- the command


def wanted(only: str | None) -> list[str]:
    """Names of exhibits, in the page's order."""
    names = list(EXHIBITS) if only is None else [name.strip().lower() for name in only.split(",")]
    unknown = [name for name in names if name not in EXHIBITS]
    if unknown:
        raise InputError(f"--only has {', '.join(map(repr, unknown))}; choose from {', '.join(EXHIBITS)}")
    return [name for name in EXHIBITS if name in names]


def exhibit(bench: Bench, name: str) -> Exhibit:
    """One figure or table; where it fails, what stands in its place."""
    started = time.perf_counter()
    try:
        found = EXHIBITS[name](bench)
    except (InputError, ProcessingError) as error:
        found = Exhibit(title=f"{name} could not be made", text=str(error), failed=True)
    found.key, found.seconds = name, time.perf_counter() - started
    return found


def reproduce(out: Path, names: Sequence[str], *, workers: int) -> list[Exhibit]:
    """Make some exhibits and the page of them.

    Raises
    ------
    InputError
        If `out` is no folder and cannot become one.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out} cannot be a folder ({error.strerror}); choose another") from None
    started, found = time.perf_counter(), []
    with ExitStack() as stack:
        folder = stack.enter_context(
            tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True)
        )
        bench = Bench(out=out, folder=Path(folder), workers=workers, stack=stack)
        for name in names:
            tell(name)
            found.append(exhibit(bench, name))
    write_page(out, found, time.perf_counter() - started)
    return found


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page and its pictures.")],
    only: Annotated[str | None, typer.Option(metavar="FIG,...", help=f"Some of: {', '.join(EXHIBITS)}.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes that focus.")] = min(THREADS, 4),
) -> None:
    """Reproduce figures and tables of the papers, each number beside the printed one.

    Example: python workflows/reproduce_papers.py --out reproduced --only fig2,table3
    """
    try:
        found = reproduce(out, wanted(only), workers=workers)
    except InputError as error:
        tell(f"reproduce_papers: {error}")
        raise typer.Exit(2) from None
    tell(f"{out / 'index.html'} is there")
    if failed := [e.key for e in found if e.failed]:
        tell(f"reproduce_papers: {', '.join(failed)} could not be made; the page says why")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
