"""Opening the image of a run for a product."""

from __future__ import annotations

from blocksar.places.place import Place
from blocksar.products.options import Box
from blocksar.runs.finished import FinishedRun, folder_of, member_line


def opened(run: Place, channel: str | None, crop: Box | None = None) -> tuple[FinishedRun, list[str]]:
    """Open a channel of a run, or a part of it; and a line that says which of several it is.

    Raises
    ------
    InputError
        If the run is not finished, or has no such channel, or nothing of it lies in `crop`.
    """
    source = FinishedRun.open(folder_of(run, channel))
    return source if crop is None else source.cropped(*crop), member_line(run, channel)
