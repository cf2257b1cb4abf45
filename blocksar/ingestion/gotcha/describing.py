"""Description of files of the Gotcha set, without their samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.collection.beam import NOT_STEERED
from blocksar.errors import InputError
from blocksar.ingestion.gotcha.files import read_headers
from blocksar.ingestion.readers import Described
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place, size_text
from blocksar.places.ranges import Readable

MOST_READ = 16  # files that are read; of more, the first and the last


def describe(files: Sequence[Readable], given: str) -> Described:
    """Read the headers of files of one pass.

    Raises
    ------
    InputError
        As `GotchaReader.read`.
    """
    places = [file for file in files if isinstance(file, Place)]
    if len(places) < len(files):
        raise InputError(f"{given} is a file of a web server; copy files of the Gotcha set to a local folder first")
    read = [read_headers(path) for path in (places if len(places) <= MOST_READ else [places[0], places[-1]])]
    azimuths = [np.degrees(np.arctan2(file.position[:, 1], file.position[:, 0])) for file in read]
    frequency = read[0].frequency
    position = np.concatenate([file.position for file in read])
    polarisations = sorted({file.polarisation for file in read if file.polarisation})
    passes = sorted({file.pass_ for file in read if file.pass_})
    size = sum(path.taken() for path in places if isinstance(path, LocalPlace))
    some = "" if len(read) == len(files) else "; the first and the last were read"
    rows = [("files", f"{len(files)}, {size_text(size)}{some}")]
    rows += [("pass", ", ".join(passes))] if passes else []
    rows += [("polarization", ", ".join(polarisations))] if polarisations else []
    rows += [
        ("azimuth", f"{azimuths[0].min():.2f} .. {azimuths[-1].max():.2f} degrees"),
        ("pulses", f"{sum(len(file.checksums) for file in read)} in the files that were read"),
        ("band", f"{(frequency[0] + frequency[-1]) / 2e9:.5g} GHz; {(frequency[-1] - frequency[0]) / 1e6:.4g} MHz in "
                 f"{frequency.size} frequencies"),
        ("track", f"{np.linalg.norm(position, axis=1).mean():.5g} m from the scene's centre, "
                  f"{position[:, 2].mean():.5g} m above it"),
        ("beam", NOT_STEERED),
    ]  # fmt: skip
    what = "file" if len(files) == 1 else "folder"
    return Described(
        kind=f"{what} of the AFRL Gotcha set", rows=rows, command=["ingest", "gotcha", given, "--out", "gotcha.zarr"]
    )
