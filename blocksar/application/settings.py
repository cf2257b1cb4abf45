"""Settings of `focus`, and of the commands that share some of them: each option is stated here, once.

An option of the command line, `--config`, the keywords of the Python functions and the tables of the pages follow from
its field. The values go on as one `Settings`. Options of processors are theirs, such as `imaging.method.ChainOptions`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from blocksar.application.parsing import blocks_of, fidelity_of, grid_of, memory_of, with_axes
from blocksar.budget import FIDELITY, WAIT_WORKERS
from blocksar.chunks import PYRAMID_FROM
from blocksar.collection.surface import Surface
from blocksar.imaging.method import ChainOptions, Cutting
from blocksar.options import Option, Stated, options_of, read_values
from blocksar.processors import AUTO, CHAIN, PROCESSORS, OwnDevice

if TYPE_CHECKING:
    from blocksar.application.parsing import GridLike
    from blocksar.collection.grid import Grid
    from blocksar.collection.weighting import Weighting
    from blocksar.measurement.targets import Target
    from blocksar.places import Location
    from blocksar.readers.heights import Ground

    Control = Location | Sequence[Target]
else:  # as the command line has them: a help is shown before NumPy could be loaded
    GridLike = Location = Control = str

_TAPERS = "uniform, taylor:NBAR:SLL (such as taylor:4:-35), hamming, hann, or kaiser:BETA"
OVERWRITE = Option("Replace an existing output.", flags=("--overwrite",))  # as other commands have it, too
_PROCESSOR = Option(
    f"{', '.join(PROCESSORS.own)}: a fast one of the main ones, which keeps the fidelity.",
    metavar="NAME",
    choices=lambda: tuple(PROCESSORS.own),
)


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """Settings that the image depends on."""

    processor: Annotated[str, _PROCESSOR] = "auto"
    device: Annotated[
        OwnDevice,
        Option("What back-projection runs on: cpu, gpu, or auto, a GPU if one is found.", metavar="NAME"),
    ] = "cpu"
    blocks: Annotated[
        int | Literal["auto"],
        Option("Number of angular blocks; auto: the fewest that keep the fidelity.", metavar="auto|N", read=blocks_of),
    ] = "auto"
    fidelity: Annotated[
        float,
        Option("Least coherence with exact back-projection that is kept.", metavar="C", read=fidelity_of),
    ] = FIDELITY
    weighting: Annotated[str, Option(f"Weighting of band and dwell: {_TAPERS}.", metavar="NAME")] = "uniform"
    weighting_range: Annotated[str | None, Option("Weighting of the band instead.", metavar="NAME")] = None
    weighting_azimuth: Annotated[str | None, Option("Weighting of the dwell instead.", metavar="NAME")] = None
    grid: Annotated[
        GridLike | None,
        Option(
            "Image points x0:x1:dx,y0:y1:dy, m; default: the lit sector, spaced by half the resolution.",
            metavar="GRID",
            read=with_axes,
        ),
    ] = None
    looks: Annotated[int | None, Option("Form N images, each of a part of every target's dwell.", metavar="N")] = None
    terrain: Annotated[
        Location | None,
        Option("Heights of the ground: zarr or netCDF in the scene frame, or GeoTIFF.", metavar="FILE"),
    ] = None
    surface: Annotated[
        Surface | None,
        Option("The ground without --terrain: plane, or ellipsoid, WGS 84.", metavar="NAME",
               default="the store's, or plane"),
    ] = None  # fmt: skip
    vertical: Annotated[
        str | None,
        Option("Of a GeoTIFF's heights: ellipsoid, egm96, egm2008, or egm2008:FILE.", metavar="DATUM"),
    ] = None
    whole_pulses: Annotated[bool, Option("Of a raw echo: leave ground NaN of which parts of pulses were recorded.")] = (
        False
    )
    ground_height: Annotated[
        float | None, Option("Height z of the imaged plane in the scene frame; default: the store's.", metavar="M")
    ] = None
    interference: Annotated[
        Cutting | None,
        Option("Cut narrow-band lines that stand out of the echoes: notch, or eigen, their leak too.", metavar="NAME"),
    ] = None
    autofocus: Annotated[bool, Option("Correct the track from the samples first; see blocksar autofocus.")] = False
    control: Annotated[
        Control | None,
        Option("With autofocus: JSON file of points at known places, which anchor the track.", metavar="FILE"),
    ] = None


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Settings of where and how the work is done; for a given plan, the image does not depend on them."""

    workers: Annotated[
        int | None, Option("Worker processes; 0: this process; default: by the cores.", metavar="N", least=0)
    ] = None
    threads: Annotated[
        int | None, Option("Threads per worker; default: by the machine's cores.", metavar="N", least=1)
    ] = None
    memory_limit: Annotated[
        int | None, Option("Memory per worker, such as 2GiB; default: its share.", metavar="SIZE", read=memory_of)
    ] = None
    scheduler: Annotated[
        str | None, Option("Use this dask scheduler instead of a local cluster.", metavar="ADDRESS")
    ] = None
    wait_workers: Annotated[
        float,
        Option("Time to wait for workers while the scheduler has none; 0: none.", metavar="SECONDS"),
    ] = WAIT_WORKERS


@dataclass(frozen=True, kw_only=True)
class Output:
    """Settings of output files: which ones are written, replaced, and kept."""

    performance_report: Annotated[
        Path | None,
        Option("Write dask's performance report, also if the run fails.", metavar="FILE.html", read=Path),
    ] = None
    overwrite: Annotated[bool, OVERWRITE] = False
    discard: Annotated[bool, Option("Remove spectrum and patches once the run needs them no more.")] = False
    pyramid: Annotated[
        bool | None,
        Option(
            "Add coarser levels of the image's power, for viewers.",
            default=f"where a side has more than {PYRAMID_FROM} pixels",
            flags=("--pyramid/--no-pyramid",),
        ),
    ] = None
    dry_run: Annotated[bool, Option("Say what would be done, with memory and disk, and write nothing.")] = False


@dataclass(frozen=True, kw_only=True)
class Settings(Output, Machine, Imaging):  # whose fields stand in the opposite order
    """All settings of a call.

    Attributes
    ----------
    options : mapping
        Those of the processor, by name, as they were given.
    """

    options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """Collect settings from the arguments of a function by name; its `**options` are those of a processor.

        Raises
        ------
        InputError
            If one cannot be read.

        Notes
        -----
        Blocks and options that only chains have leave `auto` nothing to choose: they ask for the main chain.
        """
        known = {each.name: each for each in options_of(cls)}
        own = {name: value for name, value in given.items() if name in known}
        chains = {each.name: given[each.name] for each in options_of(ChainOptions) if each.name in given}
        read = cls(**read_values(known.values(), own), options=chains | given.get("options", {}))
        divided = read.blocks != "auto" or any(
            read.options.get(each.name, each.default) not in (None, each.default) for each in options_of(ChainOptions)
        )
        return replace(read, processor=CHAIN) if read.processor == AUTO and divided else read

    @property
    def points(self) -> Grid | None:
        """The points of the image; None: those of the lit sector."""
        return grid_of(self.grid)

    @property
    def tapers(self) -> Weighting:
        """The weighting of band and dwell."""
        from blocksar.collection.weighting import Weighting

        return Weighting.parse(self.weighting, self.weighting_range, self.weighting_azimuth)

    @property
    def ground(self) -> Ground:
        """Return the ground that the options name: a terrain's file, or a surface."""
        from blocksar.readers.heights import Ground

        return Ground(terrain=self.terrain, surface=self.surface, vertical=self.vertical)


_GROUND = ("grid", "terrain", "surface", "vertical", "ground_height")
_LOCAL = ("workers", "threads", "memory_limit")
_NOT_PLANNED = ("autofocus", "control")  # settings of the image that plans do not take
_TAKEN = {
    "plan": (*(each.name for each in fields(Imaging) if each.name not in _NOT_PLANNED), "workers", "memory_limit"),
    "autofocus": (*_GROUND, "control", *_LOCAL, "scheduler", "wait_workers", "overwrite"),
    "check": _GROUND,
    "preview": ("grid", "overwrite"),
    "demo": (*_LOCAL, "performance_report", "overwrite"),
}
COMMANDS = ("focus", *_TAKEN)


def options_taken(command: str) -> tuple[Stated, ...]:
    """Return the options that a command takes, for the decorator of its function; `focus` takes all."""
    return options_of(Settings, *_TAKEN.get(command, ()))
