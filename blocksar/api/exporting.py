"""open, export: use a finished run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from blocksar.application.reports import Report, only_stage
from blocksar.errors import InputError
from blocksar.options import read_options, showing_options
from blocksar.places import Location, place
from blocksar.products.registry import PRODUCTS, check_ending
from blocksar.progress import Wanted as Progress

if TYPE_CHECKING:
    import xarray as xr


def open(run: Location) -> xr.Dataset:
    """Open the image of a run as a lazily loaded dataset: `image` and `block` over y and x.

    The dataset follows CF, with a grid mapping if it is georeferenced, and has the accessor `ds.sar`. The same is
    `xarray.open_dataset(run, engine="blocksar")`; `xarray.open_datatree` has channels, blocks and measurements, too.

    Parameters
    ----------
    run : path
        Folder of a finished run, or any store of blocksar, such as RUN/spectrum.zarr.

    Returns
    -------
    xarray.Dataset
        `image` (y, x) complex64, NaN where not covered; `block` (y, x) int16, -1 where not covered; x, y in m. Of
        several channels, `image` is (channel, y, x).

    Raises
    ------
    InputError
        If there is no such store, or the run is not finished. The image of an unfinished run opens by its own path,
        RUN/image.zarr.
    """
    from blocksar.products import dataset  # registers the accessor, and loads xarray

    return dataset.open(place(run))


@showing_options(*(PRODUCTS.get(name).options for name in PRODUCTS.own))
def export(
    kind: str,
    run: Location,
    out: Location,
    *,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Report:
    """Write the image of a finished run as one file that other programs read.

    Parameters
    ----------
    kind : {"sicd", "sidd", "geotiff", "png", "stac"}
        Complex image on its ground plane; detected image; cloud-optimised GeoTIFF; picture in decibels; STAC item. Or a
        product that another package adds, by its name.
    run : path
        Folder of a finished run.
    out : path
        Local file to write.
    channel : str, optional
        Of a run of several channels. Default: the first.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.
    **options
        Those of the product, as below; those of another package's, as `blocksar export NAME --help` lists them.

    Other Parameters
    ----------------
    content : {"amplitude", "power", "db", "complex", "height", "incidence", "visibility", "gamma"}, optional
        Pixels of a GeoTIFF: float32, or complex64, or uint8 flags. Those from "height" on are of images on a terrain;
        "gamma" is the power without what slopes do to it. Default: "amplitude", or "db" with `scale`. Only for
        `kind="geotiff"`.
    looks : (int, int) or str, optional
        Pixels along y and along x of the cells over which a SIDD, a GeoTIFF or a PNG averages power, such as (4, 2) or
        "4x2". Cells that are not covered as a whole are no data, but not in a PNG. Default: no averaging; in a PNG
        cells that suit its size.
    scale : {"uint8", "uint16"}, optional
        Whole numbers in which a GeoTIFF stores dB: 1 at the lower end of `range`, 0 where not covered. Default:
        float32.
    range : (float, float) or str, optional
        dB at the ends of a picture's colours, of a SIDD's 8 bits, or of `scale`, such as (-40, 0) or "-40:0". Default:
        by the image.
    crop : ((float, float), (float, float)) or str, optional
        Ends of x and of y, m, of the part to write, such as "0:500,18000:18500"; not for SICD and STAC. Default: the
        whole image.
    crs : str, optional
        Coordinate reference system to which a GeoTIFF is orthorectified, such as "EPSG:32616": each pixel shows the
        ground, at its height, whose place it is. Default: the pixels of the image, in the frame's own projection.
    quantity : {"sigma0", "beta0", "gamma0"}, optional
        Backscatter, in a GeoTIFF or a PNG: per area of the ground, of the slant plane, or across the line of sight.
        Default: power over that of a target of reflectivity 1, or `content`.
    db : bool, optional
        The quantity in dB, in a GeoTIFF; a PNG is in dB anyway. Default: False.
    calibration : float or path, optional
        Radar cross-section of a target that peaks at 1, m2, or a file that `calibrate` wrote, for `quantity` or a
        SICD. Default: the run's attribute `calibration_factor`; without it values are relative, and a SICD has none.
    colour_map : str, optional
        Of a PNG, by matplotlib's name. Default: "gray".
    size : int, optional
        Pixels of a PNG along its longer side. Default: by the image, up to about 1700.
    composite : {"pauli", "mean"}, optional
        A PNG of several channels or looks of one run. "pauli": colours from HH, VV and HV or VH, `|HH - VV|`,
        `|HV + VH|` and `|HH + VV|`, each over sqrt(2), as red, green and blue. "mean": their mean power, which has
        less speckle. Default: one channel or look.
    assets : sequence of str or str, optional
        Files exported before, which a STAC item names beside the image; in a text with commas between them. Only for
        `kind="stac"`. Default: none.

    Returns
    -------
    Report
        `summary` describes the file and gives its path.

    Raises
    ------
    InputError
        If the run is not finished, has no georeference though the product needs one, a library is not installed, an
        option is wrong or not one of the product's, or `out` has the ending of another product, or exists and
        `overwrite` is False.
    ProcessingError
        If writing fails; what stood at `out` stays.
    """
    if kind not in PRODUCTS:
        *names, last = map(repr, PRODUCTS.names())
        raise InputError(f"kind is {kind!r}; it must be {', '.join(names)} or {last}")
    product = PRODUCTS.get(kind)
    read: Any = read_options(
        product.options, options, kind, ((name, other.options) for name, other in PRODUCTS.sound())
    )
    check_ending(kind, str(place(out)))
    callback = only_stage(progress, "export")
    lines = product.write(place(run), out, read, channel=channel, overwrite=overwrite, progress=callback)
    return Report(summary=[*lines, f"wrote {place(out)}"])
