"""preview: draw a coarse picture of a collection in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.api.describing import grid_text
from blocksar.application.arguments import Source, check_one_frame, history_of, sources_of
from blocksar.application.parsing import GridLike, grid_of
from blocksar.application.pulses import imaging_parts, pulse_reader
from blocksar.application.reports import Report, only_stage
from blocksar.arrays import ComplexArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.region import default_grid, facing_grid, grid_extent, joint_grid, plan_region
from blocksar.errors import InputError, library_for, quoted
from blocksar.graph.machine import resources
from blocksar.imaging import preview as coarse
from blocksar.kernels.phase import Float32Array
from blocksar.places import Location, place
from blocksar.products.pictures.overview import Overview, cell_edges, range_notes
from blocksar.products.registry import check_ending
from blocksar.products.shared_options import parse_range
from blocksar.products.writing import replacing
from blocksar.progress import Wanted as Progress
from blocksar.progress.listening import Callback

if TYPE_CHECKING:
    import xarray as xr

SIZE = 1000  # pixels along the longer side
LARGEST = 8000


def preview(
    source: Source,
    *,
    out: Location | None = None,
    grid: GridLike | None = None,
    size: int = SIZE,
    range: tuple[float, float] | str | None = None,
    colour_map: str | None = None,
    channel: str | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Form a coarse picture of a collection in seconds, from short apertures and a part of the band.

    Its geometry is exact, and bright targets lie at their places within a pixel. Nothing is calibrated for antenna
    patterns.

    Parameters
    ----------
    source : path or xarray.Dataset, or a list of them
        Phase-history store, or a dataset of its contract; of several in one frame, each pixel is that of the one which
        saw more of its dwell.
    out : path, optional
        PNG file to write. Default: none is written.
    grid : Grid or ((x0, x1, dx), (y0, y1, dy)), optional
        Ground to show, m in the scene frame; pixels are at least dx and dy. Default: what the beam lights; where it is
        not steered, the surroundings of the point that the reference range follows, if it does.
    size : int
        Pixels along the longer side, at most. Default: 1000.
    range : (float, float) or str, optional
        dB at the ends of the colours. Default: by the picture.
    colour_map : str, optional
        By matplotlib's name. Default: "gray".
    channel : str, optional
        Of a phase history of several channels. Default: the first.
    threads : int, optional
        Default: the number of cores.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `result` is an xarray DataArray: power (y, x) over that of unit reflectivity, NaN where nothing was lit, with x
        and y in m. `summary` has what was read, the resolution, and the grid that a run would take.

    Raises
    ------
    InputError
        If the source is no phase history, a grid is missing or lies outside the swath, matplotlib is not installed, or
        `out` exists and `overwrite` is False, or has the ending of another product.
    ProcessingError
        If the file cannot be written.
    """
    pixels: Any = size  # whatever it was given as
    if isinstance(pixels, bool) or not isinstance(pixels, int | np.integer) or not 50 <= pixels <= LARGEST:
        raise InputError(f"size = {quoted(size)}: give 50 to {LARGEST} pixels along the longer side of the picture")
    count = resources(1, threads, None).threads
    limits = None if range is None else parse_range(range)
    if out is not None:
        check_ending("png", str(place(out)))
    histories = [history_of(each) for each in sources_of(source)]
    check_one_frame(histories)
    if channel is not None:
        histories = [history.of_channel(channel) for history in histories]
    imaged = imaging_parts(histories, grid_of(grid))
    geometries = [Geometry(collection=history.collection.centred()) for history in imaged]
    chosen, proposed = _ground(geometries, grid_of(grid))
    planned = [coarse.plan_preview(geometry, chosen, size=size) for geometry in geometries]
    callback = only_stage(progress, "preview")

    def form() -> Float32Array:
        grid = planned[0].grid
        power, most = np.full(grid.shape, np.nan, np.float32), np.full(grid.shape, -np.inf)
        for number, (history, each) in enumerate(zip(imaged, planned, strict=True)):
            report = partial(_told, callback, number, len(planned))
            own = coarse.form_preview(_reader(history), each, threads=count, progress=report)
            if len(planned) == 1:
                power = own
            else:
                margin = np.where(np.isnan(own), -np.inf, each.geometry.beam.margin(*np.meshgrid(grid.x, grid.y)))
                power, most = np.where(margin > most, own, power), np.maximum(margin, most)
        _refuse_dark(geometries, chosen, power)
        return power

    if out is None:
        power = form()
    else:
        with replacing(out, overwrite=overwrite) as part:
            power = form()
            _draw(part, imaged[0], geometries[0], planned[0], power, limits, colour_map)
    with np.errstate(divide="ignore"):
        notes = [] if limits is None else range_notes(10 * np.log10(power), limits)
    return Report(
        summary=[
            *_sentences(imaged, planned[0], proposed),
            *notes,
            *([f"wrote {place(out)}"] if out is not None else []),
        ],
        result=_as_dataarray(planned[0], power),
    )


def _told(callback: Callback, number: int, count: int, done: int, total: int) -> None:
    """Report the progress of one of `count` collections as a share of all."""
    callback(number * total + done, count * total)


def _refuse_dark(geometries: Sequence[Geometry], grid: Grid, power: Float32Array) -> None:
    """Check that a picture shows some ground.

    Raises
    ------
    InputError
        If nothing of it is lit, with what is.
    """
    if np.isfinite(power).any():
        return
    if len(geometries) == 1:  # raises an error with the lit ground, if the grid lies beside it
        grid_extent(geometries[0], plan_region(geometries[0], grid), grid)
    raise InputError(
        f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g} has no lit pixel; move the grid, or give a larger one"
    )


def _ground(geometries: Sequence[Geometry], given: Grid | None) -> tuple[Grid, Grid]:
    """Return the ground to show, and the grid that a run would use by default."""
    if given is None and len(geometries) > 1:
        joint = joint_grid(geometries)
        return joint, joint
    geometry, grid = geometries[0], given
    if grid is None and not geometry.collection.steered:
        grid = facing_grid(geometry)
    if grid is not None and len(geometries) > 1:
        return grid, grid
    region = plan_region(geometry, grid)
    proposed = grid or default_grid(geometry, region)
    return given or proposed, proposed


def _reader(history: stores.PhaseHistory) -> coarse.ReadPart:
    if history.raw is None:
        return history.read
    whole = pulse_reader(history)

    def read(pulses: slice, columns: slice) -> ComplexArray:
        return np.ascontiguousarray(whole(pulses)[:, columns])

    return read


def _draw(
    path: str,
    history: stores.PhaseHistory,
    geometry: Geometry,
    planned: coarse.Preview,
    power: Float32Array,
    limits: tuple[float, float] | None,
    colour_map: str | None,
) -> None:
    with library_for("pictures need", "plots"):
        from blocksar.products.pictures import quicklook  # optional, and slow to load
    grid = planned.grid
    reduced = Overview(power, None, cell_edges(grid.x, grid.x.size, 1), cell_edges(grid.y, grid.y.size, 1))
    frame = Georeference.among(history.attrs)
    across, along = planned.resolution
    quicklook.save(
        path, reduced, title=f"{history.attrs.get('title') or 'phase history'} (preview)",
        caption=f"resolution {across:.3g} m in range, {along:.3g} m in azimuth   pixels {grid.dx:.3g} m",
        arrows=quicklook.scene_arrows(reduced, geometry, frame), limits=limits,
        colour_map=quicklook.checked_colour_map(colour_map),
    )  # fmt: skip


def _sentences(histories: Sequence[stores.PhaseHistory], planned: coarse.Preview, proposed: Grid) -> list[str]:
    history = histories[0]
    n_pulse, n_column = history.collection.n_pulse, history.collection.n_range_frequency
    columns = planned.columns.stop - planned.columns.start
    pulses = len({p for part in planned.apertures for p in np.arange(part.start, part.stop).tolist()})
    across, along = planned.resolution
    names = history.channels
    return [
        *([f"channel {names[history.channel]} of {', '.join(names)}"] if names else []),
        f"resolution {across:.3g} m in range and {along:.3g} m in azimuth, in pixels of {planned.grid.dx:.3g} m, from "
        f"{pulses} of {n_pulse} pulses and {columns} of {n_column} range frequencies"
        + (f" of each of {len(histories)} phase histories, about" if len(histories) > 1 else ""),
        f"a run takes --grid {grid_text(proposed)}",
    ]


def _as_dataarray(planned: coarse.Preview, power: Float32Array) -> xr.DataArray:
    import xarray as xr  # slow to load

    coords = {
        name: (name, getattr(planned.grid, name), {"units": "m", "long_name": f"{name} in the scene frame"})
        for name in "yx"
    }
    return xr.DataArray(
        power, dims=("y", "x"), coords=coords, name="power",
        attrs={"units": "1", "long_name": "power over that of unit reflectivity", "resolution": planned.resolution},
    )  # fmt: skip
