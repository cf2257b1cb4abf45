"""Runs in xarray: the accessor `ds.sar` for images (levels, looks, parts, cuts, netCDF), CF metadata, and the tree.

`blocksar.open` and xarray's engine `blocksar` register the accessor; import `blocksar.accessor` for datasets opened in
another way.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from blocksar import stores
from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, library_for
from blocksar.measurement.figures import DEFINITIONS, PointResponse
from blocksar.measurement.multilooking import checked_looks, power_of
from blocksar.measurement.response import MIN_HALF_TAPS, interpolate
from blocksar.places import Location
from blocksar.places.place import Place
from blocksar.products.page.facts import responses_of
from blocksar.products.shared_options import parse_looks
from blocksar.runs.finished import finished_record
from blocksar.runs.folder import member
from blocksar.runs.record import RECORD, PredictedBlock
from blocksar.texts import frequency_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# ---------------------------------------------------------------- images

GRID_MAPPING = "spatial_ref"  # the name that rioxarray looks up first
LAYOUT = ("zarr_conventions", "multiscales", "spatial:", "proj:")  # what attributes of a store's layout start with
UNEVEN = 1e-3  # of the mean spacing, that the distance of neighbouring pixels may differ from it
MOST_SAMPLES = 1 << 20  # of a cut
PIECE = 32  # length in pixels of a piece of a cut; each is interpolated with a carrier of its own
Span = tuple[float | None, float | None]
_ENDS = (-np.inf, np.inf)  # in place of ends that are None


class Dataset(xr.Dataset):  # type: ignore[no-untyped-call]
    """A dataset whose `to_netcdf` first converts it with `SarAccessor.netcdf`, since netCDF has no complex numbers.

    What xarray derives from it is one as well.
    """

    __slots__ = ()

    def to_netcdf(self, *arguments: Any, **settings: Any) -> Any:
        """Write as xarray does, but the dataset that `sar.netcdf` returns."""
        return xr.Dataset.to_netcdf(self.sar.netcdf(), *arguments, **settings)


def open(folder: Place) -> xr.Dataset:
    """Open the image of a finished run, or another store, as a dataset with CF metadata; see `prepare`.

    Raises
    ------
    InputError
        If there is no such store, or the run is not finished.
    """
    if (folder / RECORD).exists():
        finished_record(folder)
    elif not (folder / "image.zarr").exists():
        return prepare(stores.open_dataset(folder))
    dataset = prepare(stores.open_dataset(folder / "image.zarr"))
    dataset.encoding["source"] = str(folder)
    return dataset


def prepare(dataset: xr.Dataset) -> xr.Dataset:
    """Add CF metadata to a dataset of an image: axes and, if known, the map projection; returns a `Dataset`.

    Attributes of an image are numbers and texts, others as JSON text, which netCDF holds. Those of the store's layout
    and place are left out: a part of the dataset would keep them, but they hold for the whole image only. The
    coordinates and the grid mapping hold for any part.

    Raises
    ------
    InputError
        If its georeference is wrong.
    """
    dataset.__class__ = Dataset
    dataset.attrs = {name: value for name, value in dataset.attrs.items() if not name.startswith(LAYOUT)}
    if "image" not in dataset or not {"x", "y"} <= set(dataset.coords):
        return dataset
    frame = _frame(dataset.attrs)
    dataset.attrs = flat(dataset.attrs)
    for axis in "xy":
        dataset[axis].attrs["axis"] = axis.upper()
        dataset[axis].encoding["_FillValue"] = None  # else xarray writes one, which CF forbids for coordinates
    if frame is None:
        return dataset
    mapping = frame.grid_mapping(float(dataset.attrs.get("ground_height") or 0.0))
    if mapping is None:
        return dataset
    mapping["long_name"] = "map projection whose easting and northing are x and y"
    dataset = dataset.assign_coords({GRID_MAPPING: xr.Variable((), np.int32(0), mapping)})
    for axis in "xy":
        dataset[axis].attrs["standard_name"] = f"projection_{axis}_coordinate"
    for variable in dataset.data_vars.values():
        if variable.dims[-2:] == ("y", "x"):
            variable.attrs["grid_mapping"] = GRID_MAPPING
    return dataset


def flat(attrs: Mapping[Any, Any]) -> dict[Any, Any]:
    """Convert attributes for netCDF: numbers and texts stay; mappings, lists and bool become JSON text."""

    def held(value: Any) -> Any:
        value = value.item() if isinstance(value, np.generic) else value
        plain = isinstance(value, str | int | float) and not isinstance(value, bool)
        return value if plain else json.dumps(value, default=_plain)

    return {name: held(value) for name, value in attrs.items()}


def nested(attribute: Any) -> Any:
    """Invert `flat` for an attribute: JSON text of a mapping or a list becomes that again."""
    if isinstance(attribute, str) and attribute.startswith(("{", "[")):
        with suppress(ValueError):
            return json.loads(attribute)
    return attribute


def _plain(value: Any) -> Any:
    """Convert an array or a number of numpy for JSON; anything else becomes text."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


def _frame(attrs: Mapping[Any, Any]) -> Georeference | None:
    """The scene frame of the attribute `georeference`."""
    attribute = nested(attrs.get("georeference"))
    return None if attribute is None else Georeference.from_attribute(attribute)


@xr.register_dataset_accessor("sar")  # type: ignore[no-untyped-call]
class SarAccessor:
    """Methods of a dataset with a complex `image` (y, x) over x and y in m."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def __repr__(self) -> str:
        return f"<sar: {', '.join(f'{name} {text}'.lstrip() for name, text in self._facts())}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f'<tr><td style="text-align:left">{escape(name)}</td><td style="text-align:left">{escape(text)}</td></tr>'
            for name, text in self._facts()
        )
        return f"<table>{rows}</table>"

    def _facts(self) -> list[tuple[str, str]]:
        """Describe the dataset by names and texts. Reads no pixels and no samples."""
        dataset, attrs = self._dataset, self._dataset.attrs
        rows = [("title", str(attrs["title"]))] if attrs.get("title") else []
        if "image" in dataset.variables:
            return rows + _image_facts(dataset)
        try:
            collection = stores.history_in_memory(dataset).collection
        except InputError as error:
            reason = str(error).removeprefix("the dataset: ")
            return [*rows, ("", f"neither image nor phase history: {reason}")]
        return rows + _history_facts(collection)

    @property
    def _images(self) -> xr.DataArray:
        """The image, or those of all channels."""
        if "image" not in self._dataset or self._dataset["image"].dims[-2:] != ("y", "x"):
            raise InputError("the dataset has no image (y, x); open a run, or its image.zarr, with blocksar.open")
        return self._dataset["image"]

    @property
    def _image(self) -> xr.DataArray:
        image = self._images
        if image.ndim > 2:
            kind = str(image.dims[0])
            first = str(self._dataset[kind].values[0])
            raise InputError(
                f"the dataset has {image.shape[0]} {kind}s; choose one, such as ds.sel({kind}={first!r}).sar"
            )
        return image

    def db(self) -> xr.DataArray:
        """Power in dB over that of a target of reflectivity 1; NaN where not covered, -inf where the pixel is zero.

        Reads the whole image. To read less, `crop` first; to stay lazy, give the dataset chunks (`ds.chunk()`).
        """

        def decibel(values: ComplexArray) -> Any:
            with np.errstate(divide="ignore"):
                return 10 * np.log10(values.real**2 + values.imag**2)

        image = self._images
        power = xr.apply_ufunc(
            decibel, image, dask="parallelized", dask_gufunc_kwargs={"meta": np.empty((0, 0), np.float32)}
        )
        power.attrs = {"units": "dB", "long_name": "power over that of unit reflectivity"}
        if "grid_mapping" in image.attrs:
            power.attrs["grid_mapping"] = image.attrs["grid_mapping"]
        return power.rename("power")

    def backscatter(
        self,
        quantity: str = "sigma0",
        *,
        calibration: float | Location | None = None,
        db: bool = False,
        subtract_noise: bool = False,
    ) -> xr.DataArray:
        """Backscatter of the ground: power over the area of the point response, and over a function of the incidence.

        Reads the whole image unless the dataset has chunks (`ds.chunk()`); to read less, `crop` first. The run's folder
        must still be there.

        Parameters
        ----------
        quantity : {"sigma0", "beta0", "gamma0"}
            Per area of the ground, of a terrain's slope if there is one; that over the sine of the local incidence
            angle at the middle of the dwell, as of an area of the slant plane; and over the cosine. Default: "sigma0".
        calibration : float or path, optional
            Radar cross-section of a target that peaks at 1, m2, or a file that `calibrate` wrote. Default: the
            attribute `calibration_factor`; without it values are relative, as if it were 1 m2, and the attribute
            `calibration` says so.
        db : bool
            In dB; NaN where no power is left. Default: False.
        subtract_noise : bool
            Without the mean power of the image's noise; may be below 0 in single pixels. Default: False.

        Returns
        -------
        DataArray
            (y, x), or of each channel or look, float32; NaN where not covered, and on a terrain in layover and shadow.

        Raises
        ------
        InputError
            If the quantity or the calibration is none, the run is not found, or noise is to be subtracted that was not
            known.
        """
        from blocksar.products import dataset_backscatter  # loads numba, which other methods do without

        names = ["image", *(("noise_equivalent",) if subtract_noise else ())]
        if subtract_noise:
            self._check_noise()

        def power(part: xr.Dataset) -> FloatArray:
            values = power_of(part["image"].values).astype(np.float64)
            return values - part["noise_equivalent"].values if subtract_noise else values

        return dataset_backscatter.compute(self._dataset, power, names, quantity, calibration, db=db)

    def noise_db(self, quantity: str | None = None, *, calibration: float | Location | None = None) -> xr.DataArray:
        """Noise-equivalent reflectivity in dB: the mean power of the image's noise over that of unit reflectivity.

        A target of that reflectivity has a signal-to-noise ratio of 1 in its pixel. NaN where not covered.

        Parameters
        ----------
        quantity : {"sigma0", "beta0", "gamma0"}, optional
            The noise as backscatter instead, such as the noise-equivalent sigma nought. Default: reflectivity.
        calibration : float or path, optional
            Radar cross-section of a target that peaks at 1, m2, or a file of `calibrate`, for a quantity. Default: as
            for `backscatter`.

        Raises
        ------
        InputError
            If the noise of the samples was not known (`noise_power`), or as `backscatter`.
        """
        self._check_noise()
        if quantity is not None:
            from blocksar.products import dataset_backscatter  # loads numba, which other methods do without

            found = dataset_backscatter.compute(
                self._dataset,
                lambda part: part["noise_equivalent"].values,
                ["noise_equivalent"],
                quantity,
                calibration,
                db=True,
            )
            found.attrs["long_name"] = f"noise-equivalent {quantity}"
            return found.rename(f"noise_equivalent_{quantity}")
        if calibration is not None:
            raise InputError(f"calibration is {calibration!r}, but no quantity is given; give one, such as 'sigma0'")
        noise = self._dataset["noise_equivalent"]
        level: xr.DataArray = xr.ufuncs.log10(noise) * 10
        level.attrs = {"units": "dB", "long_name": "noise-equivalent reflectivity"}
        if "grid_mapping" in noise.attrs:
            level.attrs["grid_mapping"] = noise.attrs["grid_mapping"]
        return level.rename("noise_equivalent")

    def _check_noise(self) -> None:
        if "noise_equivalent" not in self._dataset:
            raise InputError(
                "the dataset has no noise_equivalent: the noise of the samples was not known; give the phase history "
                "the attribute noise_power, and focus again"
            )

    def multilook(self, looks: tuple[int, int] | str) -> xr.DataArray:
        """Average power over whole cells of pixels, with less speckle; reads the whole image unless it has chunks.

        Parameters
        ----------
        looks : (int, int) or str
            Pixels along y and along x of a cell, such as (4, 2) or "4x2".

        Returns
        -------
        DataArray
            Power (y, x) over that of unit reflectivity, float32, at the middles of the cells; NaN where any pixel of a
            cell is not covered. Pixels beyond the last whole cell are left out.

        Raises
        ------
        InputError
            If the looks are wrong, or leave fewer than two cells along an axis.
        """
        image = self._images
        rows, columns = checked_looks(parse_looks(looks), (image.sizes["y"], image.sizes["x"]))
        pixels = image.isel(y=slice(image.sizes["y"] // rows * rows), x=slice(image.sizes["x"] // columns * columns))
        power = xr.apply_ufunc(
            power_of, pixels, dask="parallelized", dask_gufunc_kwargs={"meta": np.empty((0, 0), np.float32)}
        )
        cells = power.astype(np.float64).coarsen(y=rows, x=columns).reduce(np.mean).astype(np.float32)
        cells.attrs = {"units": "1", "long_name": "power over that of unit reflectivity", "looks": f"{rows}x{columns}"}
        if "grid_mapping" in image.attrs:
            cells.attrs["grid_mapping"] = image.attrs["grid_mapping"]
        return cells.rename("power")

    def crop(self, x: Span = (None, None), y: Span = (None, None)) -> xr.Dataset:
        """Select the pixels between ground coordinates, ends included; reads no pixel.

        Parameters
        ----------
        x, y : pair of float or None
            Lower and upper end, m; None for the image's own end. Default: (None, None).

        Raises
        ------
        InputError
            If no pixel lies within, or a span is no pair of numbers.
        """
        chosen = {}
        for name, span in (("x", x), ("y", y)):
            if name not in self._dataset.coords:
                raise InputError(f"the dataset has no coordinate {name}; open a run, or its image.zarr")
            axis = self._dataset[name].values
            try:
                low, high = (end if value is None else float(value) for value, end in zip(span, _ENDS, strict=True))
            except (TypeError, ValueError):
                raise InputError(f"{name} is {span!r}; give two ends in m, the lower first, or None for one") from None
            if low > high:
                raise InputError(f"{name} runs from {low:g} to {high:g} m; give the lower end first")
            inside = np.flatnonzero((axis >= low) & (axis <= high))
            if inside.size == 0:
                raise InputError(
                    f"{name} from {low:g} to {high:g} m holds no pixel; "
                    f"the image has {axis.min():g} .. {axis.max():g} m"
                )
            chosen[name] = slice(int(inside[0]), int(inside[-1]) + 1)
        return self._dataset.isel(chosen)

    def netcdf(self) -> xr.Dataset:
        """Convert the dataset to what netCDF can store, for `to_netcdf`.

        netCDF has no complex numbers, so `image` becomes `image_real` and `image_imag`, and likewise the samples of a
        phase history. Attributes other than numbers and text (of a phase history: source, targets, georeference) become
        JSON text, as those of an image are. What `blocksar.open` and `collection` return does this in `to_netcdf`.
        Reads the whole image unless the dataset has chunks; to read less, `crop` first.
        """
        converted = self._dataset
        for name, variable in self._dataset.data_vars.items():
            if variable.dtype.kind != "c":
                continue
            converted = converted.drop_vars([name])
            for word, part in (("real", variable.real), ("imag", variable.imag)):
                attrs = variable.attrs | {"long_name": f"{variable.attrs.get('long_name', name)}, {word} part"}
                converted[f"{name}_{word}"] = part.assign_attrs(attrs)
        return converted.assign_attrs(flat(self._dataset.attrs))

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the image in decibels, as cells of mean power, with a scale bar and, if georeferenced, north.

        Reads the image strip by strip.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw. Default: a new pyplot figure.

        Raises
        ------
        InputError
            If matplotlib is not installed, or `ax` is none of its axes.
        """
        with library_for("pictures need", "plots"):
            from matplotlib.axes import Axes  # optional, and slow to load, as the next line

            from blocksar.products.pictures import quicklook
        if not isinstance(ax, Axes | None):
            raise InputError(f"ax is {ax!r}, but must be matplotlib Axes; leave it out for a new figure")
        image = self._upright()
        frame = _frame(self._dataset.attrs)
        arrows = [] if frame is None else [quicklook.north_arrow(frame.rotation)]

        def read(rows: slice, columns: slice) -> ComplexArray:
            return np.asarray(image[rows, columns].values)

        axes = quicklook.show(read, *_axes(image), axes=ax, arrows=arrows)
        axes.set_title(str(self._dataset.attrs.get("title", "")))
        return axes

    def cut(
        self, x: float, y: float, *, azimuth: float | None = None, length: float = 20.0, samples: int = 401
    ) -> xr.DataArray:
        """Interpolate power, dB, along a straight line through a point.

        Only pixels near the line are read. The pixels hold the carrier, folded into their band; it is removed piece by
        piece before band-limited interpolation.

        Parameters
        ----------
        x, y : float
            Middle of the cut, m.
        azimuth : float, optional
            Direction in degrees, from the x axis towards the y axis. Default: along x.
        length : float
            From end to end, m. Default: 20.
        samples : int
            Number of points. Default: 401.

        Returns
        -------
        DataArray
            Over `distance` from the point, m, with coordinates x and y; NaN outside the image and near pixels that
            are not covered.

        Raises
        ------
        InputError
            If a value is no number, the point lies outside the image, `azimuth` is not finite, or `length` or `samples`
            give no line.
        """
        x, y, length = _number("x", x), _number("y", y), _number("length", length)
        azimuth = None if azimuth is None else _number("azimuth", azimuth)
        count: Any = samples  # whatever it was given as
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count > MOST_SAMPLES:
            raise InputError(f"samples is {samples!r:.80}; give a whole number of points, at most {MOST_SAMPLES}")
        if not 0 < length < np.inf or samples < 2:
            raise InputError(f"a cut of {length:g} m in {samples} samples is no line; give more than 0 m and 1 sample")
        if azimuth is not None and not np.isfinite(azimuth):
            raise InputError(f"azimuth is {azimuth:g}; give degrees from the x axis towards the y axis, or None")
        image = self._upright()
        axis_x, axis_y = _axes(image)
        if not (axis_x[0] <= x <= axis_x[-1] and axis_y[0] <= y <= axis_y[-1]):
            raise InputError(
                f"x = {x:g} m, y = {y:g} m lies outside the image, which has x {axis_x[0]:g} .. {axis_x[-1]:g} m and "
                f"y {axis_y[0]:g} .. {axis_y[-1]:g} m"
            )
        distance = np.linspace(-length / 2, length / 2, samples)
        angle = np.radians(azimuth or 0.0)
        at_x, at_y = x + distance * np.cos(angle), y + distance * np.sin(angle)
        values = np.empty(samples, np.complex128)
        spacing = min((axis[-1] - axis[0]) / (axis.size - 1) for axis in (axis_x, axis_y))
        for part in np.array_split(np.arange(samples), min(samples, int(np.ceil(length / (PIECE * spacing))))):
            values[part] = _interpolate(image, at_x[part], at_y[part])
        with np.errstate(divide="ignore"):
            power = 20 * np.log10(np.abs(values))
        return xr.DataArray(
            power,
            dims="distance",
            coords={
                "distance": ("distance", distance, {"units": "m", "long_name": "distance along the cut"}),
                "x": ("distance", at_x, {"units": "m", "long_name": "x in the scene frame"}),
                "y": ("distance", at_y, {"units": "m", "long_name": "y in the scene frame"}),
            },
            name="power",
            attrs={"units": "dB", "long_name": "power over that of unit reflectivity"},
        )

    def _upright(self) -> xr.DataArray:
        """The image with x and y ascending, whatever their order in the dataset. Reads no pixel."""
        image = self._image
        descending = [name for name in "xy" if image[name].size > 1 and image[name].values[0] > image[name].values[-1]]
        return image.isel({name: slice(None, None, -1) for name in descending})


def _number(name: str, value: Any) -> float:
    """Check that a parameter is a number, and return it."""
    with suppress(TypeError, ValueError, OverflowError):
        return float(value)
    raise InputError(f"{name} is {value!r:.80}; give a number")


def _history_facts(collection: Collection) -> list[tuple[str, str]]:
    """Pulses, band, track and beam of a phase history."""
    position, time = collection.antenna_position, collection.time
    speed = float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum() / (time[-1] - time[0]))
    height = float(np.median(position[:, 2])) - collection.ground_height
    cell = SPEED_OF_LIGHT / (2 * collection.bandwidth)
    beam = "not steered: plan and focus need a grid"
    if collection.beam_width is not None:
        angle = collection.beam_azimuth if collection.beam_steering is None else collection.beam_steering
        kind = "yaw" if collection.beam_steering is None else "steered about the antenna's axis"
        first, last = np.degrees(angle[[0, -1]])
        beam = f"{np.degrees(collection.beam_width):.4g} degrees wide, {kind} {first:.2f} .. {last:.2f} degrees"
    return [
        ("phase history", f"{collection.n_pulse} pulses x {collection.n_range_frequency} range frequencies"),
        ("pulses", f"{time[0]:.4g} .. {time[-1]:.4g} s, {collection.rate_text}"),
        (
            "band",
            f"{frequency_text(collection.carrier)}, {frequency_text(collection.bandwidth)}: cells of {cell:.3g} m",
        ),
        ("track", f"{speed:.4g} m/s, {height:.5g} m above the ground"),
        ("reference range", f"{float(np.median(collection.reference_range)):.6g} m"),
        ("beam", beam),
    ]


@xr.register_dataarray_accessor("sar")  # type: ignore[no-untyped-call]
class ArrayAccessor:
    """Methods of an array over x and y in m, as of a dataset: `crop` and `netcdf` of any array, others of an image."""

    def __init__(self, array: xr.DataArray) -> None:
        self._array = array
        self._whole = SarAccessor(array.to_dataset(name="image"))

    @property
    def _image(self) -> SarAccessor:
        if self._array.dtype.kind != "c":
            raise InputError(
                f"the array {self._array.name} holds {self._array.dtype}, not the complex image; give ds.image"
            )
        return self._whole

    def __repr__(self) -> str:
        return f"<sar: array {self._array.name}, methods db, multilook, crop, plot, cut, netcdf>"

    def db(self) -> xr.DataArray:
        """As `SarAccessor.db`."""
        return self._image.db()

    def multilook(self, looks: tuple[int, int] | str) -> xr.DataArray:
        """As `SarAccessor.multilook`."""
        return self._image.multilook(looks)

    def plot(self, ax: Axes | None = None) -> Axes:
        """As `SarAccessor.plot`; an array knows no north."""
        return self._image.plot(ax)

    def cut(
        self, x: float, y: float, *, azimuth: float | None = None, length: float = 20.0, samples: int = 401
    ) -> xr.DataArray:
        """As `SarAccessor.cut`."""
        return self._image.cut(x, y, azimuth=azimuth, length=length, samples=samples)

    def crop(self, x: Span = (None, None), y: Span = (None, None)) -> xr.DataArray:
        """As `SarAccessor.crop`, of the array."""
        return self._whole.crop(x, y)["image"].rename(self._array.name)

    def netcdf(self) -> xr.Dataset:
        """As `SarAccessor.netcdf`: a dataset of the array, or of its real and imaginary part."""
        return SarAccessor(
            self._array.to_dataset(name="image" if self._array.name is None else self._array.name)
        ).netcdf()


@xr.register_datatree_accessor("sar")  # type: ignore[no-untyped-call]
class TreeAccessor(SarAccessor):
    """Methods of a tree: those of the dataset at its root, and `netcdf` for all groups."""

    def __init__(self, tree: xr.DataTree) -> None:
        super().__init__(tree.to_dataset())
        self._tree = tree

    def netcdf(self) -> xr.DataTree:  # type: ignore[override]
        """Convert every group as `SarAccessor.netcdf` does."""
        groups = {node.path: node.to_dataset(inherit=False) for node in self._tree.subtree}
        return xr.DataTree.from_dict({path: SarAccessor(group).netcdf() for path, group in groups.items()})


def _image_facts(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Size, place, calibration and provenance of an image."""
    attrs, image = dataset.attrs, dataset["image"]
    rows = [("image", " x ".join(f"{image.sizes[dim]}" for dim in reversed(image.dims)) + " pixels")]
    for name in ("x", "y"):
        if name in dataset.coords and dataset[name].size > 1:
            axis = dataset[name].values
            step = (axis[-1] - axis[0]) / (axis.size - 1)
            rows.append((name, f"{axis[0]:.6g} .. {axis[-1]:.6g} m every {step:.4g} m"))
    settings, predicted, warnings = (nested(attrs.get(name)) for name in ("settings", "predicted", "warnings"))
    if isinstance(settings, dict) and "processor" in settings:
        rows.append(("processor", str(attrs.get("processor", settings["processor"]))))
    if "predicted_coherence" in attrs:
        rows.append(("predicted coherence", f"at least {attrs['predicted_coherence']:.6f}"))
    if isinstance(predicted, list) and predicted:
        least = min(block.get("coherence") or 0.0 for block in predicted)
        rows.append(
            (
                "predicted coherence",
                f"at least {least:.6f} in {len(predicted)} {'block' if len(predicted) == 1 else 'blocks'}",
            )
        )
    rows += [(name, str(attrs[name])) for name in ("calibration",) if attrs.get(name)]
    rows += [("note", str(line)) for line in warnings or []]
    return [*rows, ("methods", "db, backscatter, multilook, crop, plot, cut, netcdf")]


def _axes(image: xr.DataArray) -> tuple[FloatArray, FloatArray]:
    """Return x and y, m, of an image of at least 2 x 2 evenly spaced pixels.

    Raises
    ------
    InputError
        If it is not one.
    """
    x, y = (np.asarray(image[name].values, np.float64) for name in "xy")
    if x.size < 2 or y.size < 2:
        raise InputError(f"the image has {y.size} x {x.size} pixels, too few for a picture; crop less")
    for name, axis in (("x", x), ("y", y)):
        steps = np.diff(axis)
        if not (np.abs(steps - steps.mean()) < UNEVEN * steps.mean()).all():
            raise InputError(f"{name} of the image is not evenly spaced; select its pixels by slices with one step")
    return x, y


def _interpolate(image: xr.DataArray, x: FloatArray, y: FloatArray) -> Complex128Array:
    """Interpolate pixels at adjacent points (n,), without the phase of the carrier."""
    indices, spans = [], []
    for axis, coordinate in zip(_axes(image), (x, y), strict=True):
        index = (coordinate - axis[0]) / (axis[-1] - axis[0]) * (axis.size - 1)
        low = int(np.clip(np.floor(index.min()) - MIN_HALF_TAPS, 0, axis.size))
        high = int(np.clip(np.ceil(index.max()) + MIN_HALF_TAPS + 1, 0, axis.size))
        indices.append(index - low)
        spans.append(slice(low, high))
    chip = np.asarray(image[spans[1], spans[0]].values, np.complex128)
    if chip.size == 0:
        return np.full(x.shape, np.nan + 0j)
    return interpolate(_remove_carrier(_remove_carrier(chip, 0), 1), row=indices[1], column=indices[0])


def _remove_carrier(chip: Complex128Array, axis: int) -> Complex128Array:
    """Remove the mean phase step from pixel to pixel along an axis, so that the band is centred on zero."""
    chip = np.moveaxis(chip, axis, 0)
    finite = np.where(np.isfinite(chip), chip, 0)
    step = np.angle((finite[1:] * finite[:-1].conj()).sum())
    return np.moveaxis(chip * np.exp(-1j * step * np.arange(len(chip)))[:, None], 0, axis)


# ---------------------------------------------------------------- tree

QUALITY = "quality.json"
# Units by the last word of a figure's name, but `theory`; those of other figures are ratios.
UNITS = {
    "yaw": "rad", "range": "m", "memory": "byte", "bias": "m s-2", "phase": "rad", "pslr": "dB", "islr": "dB",
    "irw": "m", "resolution": "m", "x": "m", "y": "m",
}  # fmt: skip


def groups_of(run: Place) -> dict[str, xr.Dataset]:
    """Return the datasets of a finished run by their place in the tree.

    Returns
    -------
    dict
        "/": as `blocksar.open`. "/blocks" over `block`: the plan's prediction for each block, if it has any; `number`
        is that of the image's variable `block`. "/quality" over `target`: what `blocksar quality` has measured, if it
        has been. "/channels/NAME" or "/looks/NAME": all this of each channel or look.

    Raises
    ------
    InputError
        If there is no finished run, or it is damaged.
    """
    record = finished_record(run)
    groups = {"/": open(run)}
    if record.plan.predicted:
        groups["/blocks"] = _blocks(record.plan.predicted)
    if (run / QUALITY).exists():
        groups["/quality"] = _quality(run)
    for name in record.channels:
        for path, group in groups_of(member(run, name, record.dimension)).items():
            groups[f"/{record.dimension}s/{name}{path}".rstrip("/")] = group
    return groups


def _blocks(predicted: Sequence[PredictedBlock]) -> xr.Dataset:
    figures: dict[str, Any] = {
        field.name: [getattr(block, field.name) for block in predicted] for field in fields(PredictedBlock)
    }
    figures["number"] = figures.pop("block")
    figures["part"] = [-1 if part is None else part for part in figures["part"]]
    return _table("block", [block.name for block in predicted], figures, {"title": "blocks as planned"})


def _quality(run: Place) -> xr.Dataset:
    try:
        responses = responses_of(stores.read_json(run / QUALITY))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{run / QUALITY} is damaged ({error}); run `blocksar quality {run}` again") from error
    named = {"x": "target_x", "y": "target_y"}  # x and y are the axes of the image above
    figures = {
        named.get(name, name): [getattr(response, name) for response in responses]
        for name in PointResponse._fields
        if name != "name"
    }
    return _table(
        "target",
        [response.name for response in responses],
        figures,
        {"title": "targets as measured", "comment": DEFINITIONS},
    )


def _table(along: str, names: Sequence[str], figures: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Make a dataset of figures along a named dimension; pairs get the dimension `end` as well."""
    made = {}
    for name, values in figures.items():
        array = np.asarray(values)
        unit = UNITS.get(name.removesuffix("_theory").rpartition("_")[2], "1")
        made[name] = ((along, "end")[: array.ndim], array, {"units": unit, "long_name": name.replace("_", " ")})
    return xr.Dataset(made, coords={along: np.array(names, dtype=np.str_)}, attrs=attrs)
