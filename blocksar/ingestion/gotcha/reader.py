"""Files of the AFRL Gotcha set as a reader: what `blocksar ingest gotcha` and `info` ask."""

from __future__ import annotations

from collections.abc import Sequence

from blocksar.ingestion.gotcha.files import KIND
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.readers import Described, ReaderOptions, Reading
from blocksar.places import Location
from blocksar.places.ranges import Readable


class GotchaReader:
    """MATLAB files of the AFRL Gotcha volumetric SAR data set."""

    summary = (
        "Join MATLAB files of the AFRL Gotcha data set, in azimuth, into a phase history.\n\n"
        "The phase history keeps the scene-centred frame of the files."
    )
    example = "data_3dsar_pass1_az00*_HH.mat --out gotcha.zarr"
    source = "SOURCE.mat...", "MATLAB files of one pass, of one or more polarisations."
    several = True
    kind: Kind = KIND
    options = ReaderOptions

    def read(self, sources: Sequence[Location], options: ReaderOptions) -> Reading:
        from blocksar.ingestion.gotcha.ingestion import begin

        return begin(sources, options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        from blocksar.ingestion.gotcha.ingestion import describe

        return describe(files, given)


GOTCHA = GotchaReader()
