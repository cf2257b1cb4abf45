"""What people do next with an image that `blocksar.open` gave: `ds.sar.db()`, `.crop()`, `.plot()`, `.cut()`.

`blocksar.open` registers the accessor; for datasets that were opened in another way, `import blocksar.accessor` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from blocksar.georeference import Georeference
from blocksar.measurement import MIN_HALF_TAPS, Complex128Array, interpolate
from blocksar.parameters import ComplexArray, FloatArray, InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GRID_MAPPING = "spatial_ref"  # the name that rioxarray looks for first
PIECE = 32  # pixels of a cut that are interpolated with one carrier
Span = tuple[float | None, float | None]


def prepare(dataset: xr.Dataset) -> xr.Dataset:
    """Name x and y of an image as CF does, and tell its map projection if it is georeferenced.

    Raises
    ------
    InputError
        If its georeference is wrong.
    """
    if "image" not in dataset or "georeference" not in dataset.attrs:
        return dataset
    frame = Georeference.from_attribute(dataset.attrs["georeference"])
    mapping = frame.grid_mapping(float(dataset.attrs.get("ground_height") or 0.0))
    if mapping is None:
        return dataset
    dataset = dataset.assign_coords({GRID_MAPPING: xr.Variable((), np.int32(0), mapping)})
    for axis in "xy":
        names = {"standard_name": f"projection_{axis}_coordinate", "axis": axis.upper()}
        dataset[axis].attrs.update(names)
    for name in ("image", "block"):
        if name in dataset:
            dataset[name].attrs["grid_mapping"] = GRID_MAPPING
    return dataset


@xr.register_dataset_accessor("sar")  # type: ignore[no-untyped-call]
class SarAccessor:
    """Of a dataset that holds `image` (y, x), complex, over x and y in m."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @property
    def _image(self) -> xr.DataArray:
        if "image" not in self._dataset or self._dataset["image"].dims != ("y", "x"):
            raise InputError("the dataset holds no image (y, x); open a run, or its image.zarr, with blocksar.open")
        return self._dataset["image"]

    def db(self) -> xr.DataArray:
        """Power in dB, 0 being that of a target of reflectivity 1; NaN where not covered, -inf where there is nothing.

        Reads what the dataset holds: `crop` first, or give the dataset chunks (`ds.chunk()`), and it is lazy.
        """

        def decibel(values: ComplexArray) -> Any:
            with np.errstate(divide="ignore"):
                return 10 * np.log10(values.real**2 + values.imag**2)

        image = self._image
        power = xr.apply_ufunc(decibel, image, dask="parallelized", output_dtypes=[np.float32])
        power.attrs = {"units": "dB", "long_name": "power over that of unit reflectivity"}
        if "grid_mapping" in image.attrs:
            power.attrs["grid_mapping"] = image.attrs["grid_mapping"]
        return power.rename("power")

    def crop(self, x: Span = (None, None), y: Span = (None, None)) -> xr.Dataset:
        """The pixels between ground coordinates, m, ends included; None is the image's own end. Reads no pixel.

        Raises
        ------
        InputError
            If nothing is left.
        """
        chosen = {}
        for name, span in (("x", x), ("y", y)):
            low, high = span
            axis = self._dataset[name].values
            if low is not None and high is not None and low > high:
                raise InputError(f"{name} runs from {low:g} to {high:g} m; give the lower end first")
            chosen[name] = self._dataset.indexes[name].slice_indexer(low, high)
            if axis[chosen[name]].size == 0:
                raise InputError(
                    f"{name} from {low} to {high} m holds no pixel; the image has {axis[0]:g} .. {axis[-1]:g} m"
                )
        return self._dataset.isel(chosen)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the image in decibels, by cells of mean power, with scale bar and, if georeferenced, north.

        Strips of the image are read one after another. Without `ax`, in a new figure of pyplot.

        Raises
        ------
        InputError
            If matplotlib is not installed.
        """
        try:
            from blocksar import quicklook  # optional, and slow to load
        except ModuleNotFoundError as error:
            raise InputError(f"{error.name} is not installed, which pictures need; install blocksar[plots]") from None
        image = self._image
        told = self._dataset.attrs.get("georeference")
        arrows = [] if told is None else [quicklook.north(Georeference.from_attribute(told).rotation)]

        def read(rows: slice, columns: slice) -> ComplexArray:
            return np.asarray(image[rows, columns].values)

        axes = quicklook.show(read, *self._axes(), axes=ax, arrows=arrows)
        axes.set_title(str(self._dataset.attrs.get("title", "")))
        return axes

    def cut(
        self, x: float, y: float, *, azimuth: float | None = None, length: float = 20.0, samples: int = 401
    ) -> xr.DataArray:
        """Power along a straight line through a point, dB.

        Parameters
        ----------
        x, y : float
            m, the middle of the cut.
        azimuth : float, optional
            Direction in degrees, from the x axis towards the y axis; along x if None.
        length : float
            m, from end to end.
        samples : int
            Interpolated, band-limited, from the pixels about the line, which alone are read. The image has kept its
            carrier, folded into the band of its pixels: it is taken off piece by piece.

        Returns
        -------
        DataArray
            Over `distance` from the point, m, with coordinates x and y; NaN outside and near what is not covered.

        Raises
        ------
        InputError
            If the point lies outside the image, or length or samples are below what makes a line.
        """
        if not length > 0 or samples < 2:
            raise InputError(f"a cut of {length:g} m in {samples} samples is no line; give more than 0 m and 1 sample")
        axis_x, axis_y = self._axes()
        if not (axis_x[0] <= x <= axis_x[-1] and axis_y[0] <= y <= axis_y[-1]):
            raise InputError(
                f"x = {x:g} m, y = {y:g} m lies outside the image, which has x {axis_x[0]:g} .. {axis_x[-1]:g} m and "
                f"y {axis_y[0]:g} .. {axis_y[-1]:g} m"
            )
        distance = np.linspace(-length / 2, length / 2, samples)
        turn = np.radians(azimuth or 0.0)
        at_x, at_y = x + distance * np.cos(turn), y + distance * np.sin(turn)
        values = np.empty(samples, np.complex128)
        spacing = min((axis[-1] - axis[0]) / (axis.size - 1) for axis in (axis_x, axis_y))
        for part in np.array_split(np.arange(samples), min(samples, int(np.ceil(length / (PIECE * spacing))))):
            values[part] = self._at(at_x[part], at_y[part])
        with np.errstate(divide="ignore"):
            power = 20 * np.log10(np.abs(values))
        return xr.DataArray(
            power,
            dims="distance",
            coords={
                "distance": ("distance", distance, {"units": "m", "long_name": "distance along the cut"}),
                "x": ("distance", at_x, {"units": "m"}),
                "y": ("distance", at_y, {"units": "m"}),
            },
            name="power",
            attrs={"units": "dB", "long_name": "power over that of unit reflectivity"},
        )

    def _axes(self) -> tuple[FloatArray, FloatArray]:
        x, y = (np.asarray(self._dataset[name].values, np.float64) for name in "xy")
        if x.size < 2 or y.size < 2:
            raise InputError(f"the image has {y.size} x {x.size} pixels, which are no picture; crop less")
        return x, y

    def _at(self, x: FloatArray, y: FloatArray) -> Complex128Array:
        """Pixels interpolated at points near one another, but for the phase."""
        places, spans = [], []
        for axis, wanted in zip(self._axes(), (x, y), strict=True):
            index = (wanted - axis[0]) / (axis[-1] - axis[0]) * (axis.size - 1)
            low = int(np.clip(np.floor(index.min()) - MIN_HALF_TAPS, 0, axis.size))
            high = int(np.clip(np.ceil(index.max()) + MIN_HALF_TAPS + 1, 0, axis.size))
            places.append(index - low)
            spans.append(slice(low, high))
        chip = np.asarray(self._image[spans[1], spans[0]].values, np.complex128)
        if chip.size == 0:
            return np.full(x.shape, np.nan + 0j)
        return interpolate(_without_carrier(_without_carrier(chip, 0), 1), row=places[1], column=places[0])


def _without_carrier(chip: Complex128Array, axis: int) -> Complex128Array:
    """Turn a chip's phase back by the mean step from pixel to pixel along an axis, so that its band is about zero."""
    chip = np.moveaxis(chip, axis, 0)
    known = np.where(np.isfinite(chip), chip, 0)
    step = np.angle((known[1:] * known[:-1].conj()).sum())
    return np.moveaxis(chip * np.exp(-1j * step * np.arange(len(chip)))[:, None], 0, axis)
