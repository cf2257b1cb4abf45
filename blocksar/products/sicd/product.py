"""SICD as a product of `export`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback


@dataclass(frozen=True, kw_only=True)
class SICDOptions:
    """SICD has none."""


class SICD:
    """The complex image, pixel by pixel, see `nitf`."""

    summary = "Write the complex image, on its ground plane, as a SICD file.\n\nThe run must be georeferenced."
    endings = (".nitf", ".ntf", ".nsf")
    options = SICDOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: SICDOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.sicd import nitf
        from blocksar.products.writing import opened

        source, said = opened(run, channel)
        return [*said, *nitf.write(source, out, overwrite=overwrite, progress=progress)]
