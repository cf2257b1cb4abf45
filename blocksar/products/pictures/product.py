"""The PNG as a product of `export`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal

from blocksar.errors import InputError, library_for
from blocksar.options import Option
from blocksar.products.options import COLOUR_MAP, COLOUR_RANGE, Crop, Decibels, Looks

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback
    from blocksar.runs.finished import FinishedRun


@dataclass(frozen=True, kw_only=True)
class PNGOptions:
    """Options of what is drawn, and in which colours."""

    range: Annotated[Decibels | None, COLOUR_RANGE] = None
    colour_map: Annotated[str | None, COLOUR_MAP] = None
    size: Annotated[
        int | None, Option("Longer side of the picture.", metavar="PIXELS", default="by the image, up to 1700")
    ] = None
    crop: Crop = None
    looks: Looks = None
    composite: Annotated[
        Literal["pauli", "mean"] | None,
        Option(
            "Colours from HH, VV and HV or VH of one run; or the mean power of its looks or channels.",
            default="one channel or look",
        ),
    ] = None


class PNG:
    """A picture in decibels, see `quicklook` and `composite`."""

    summary = (
        "Draw the image in decibels as a PNG, with axes in metres.\n\n"
        "Includes a scale bar, the look direction and north."
    )
    endings = (".png",)
    options = PNGOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: PNGOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.writing import opened

        drawn = {"limits": options.range, "size": options.size, "overwrite": overwrite, "progress": progress}
        if options.composite is None:
            source, said = opened(run, channel, options.crop)
            cell = _cell(options, source)
            quicklook = _pictures("quicklook")
            return [*said, *quicklook.write(source, out, cell=cell, colour_map=options.colour_map, **drawn)]
        sources = _composed(run, options, channel)
        first, *others = sources.values()
        cell = _cell(options, first)
        if options.composite == "pauli":
            return list(_pictures("composite").write(sources, out, cell=cell, **drawn))
        quicklook = _pictures("quicklook")
        return list(quicklook.write(first, out, others=others, cell=cell, colour_map=options.colour_map, **drawn))


def _cell(options: PNGOptions, source: FinishedRun) -> tuple[int, int]:
    """Pixels along y and along x of the cells of a picture, or of their parts."""
    from blocksar.measurement.looks import checked_looks

    return (1, 1) if options.looks is None else checked_looks(options.looks, (source.y.size, source.x.size))


def _composed(run: Place, options: PNGOptions, channel: str | None) -> dict[str, FinishedRun]:
    """Open the channels or looks of a composite by name."""
    from blocksar.products.writing import opened
    from blocksar.runs.finished import finished_record

    composite = options.composite
    if composite not in ("pauli", "mean"):
        raise InputError(f"composite is {composite!r}; it must be 'pauli' or 'mean'")
    taken = {"channel": channel, **({"colour_map": options.colour_map} if composite != "mean" else {})}
    for name, value in taken.items():
        if value is not None:
            raise InputError(f"{name} is {value!r}, but a composite has channels and colours of its own; leave it out")
    names = finished_record(run).channels
    if composite == "mean" and not names:
        raise InputError(f"composite mean takes the looks or channels of a run, and {run} has none; leave it out")
    members = dict(zip(names, names, strict=True))
    if composite == "pauli":
        members = _pictures("composite").pauli_channels(names, str(run))
    return {name: opened(run, member, options.crop)[0] for name, member in members.items()}


def _pictures(name: str) -> Any:
    """Import a module of pictures: optional, and slow to load."""
    with library_for("PNG needs", "plots"):
        return import_module(f"blocksar.products.pictures.{name}")
