"""The engine `blocksar` of xarray, by entry point: `xarray.open_dataset(run, engine="blocksar")`, and `open_datatree`.

xarray loads this module whenever it opens something without an engine, so it imports everything else on use.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from xarray.backends import BackendEntrypoint

if TYPE_CHECKING:
    import xarray as xr


class Engine(BackendEntrypoint):
    """Engine that opens what `blocksar.open` does, and a run with all its stores as a tree."""

    description = "Runs and stores of blocksar"
    supports_groups: ClassVar[bool] = True

    def open_dataset(self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None) -> xr.Dataset:
        """The image of a run, or another store."""
        from blocksar.places import place
        from blocksar.products import dataset

        return _without(dataset.open(place(filename_or_obj)), drop_variables)

    def open_datatree(self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None) -> xr.DataTree:
        """Open a run as a tree; see `products.dataset.groups_of`."""
        import xarray as xr

        return xr.DataTree.from_dict(self.open_groups_as_dict(filename_or_obj, drop_variables=drop_variables))

    def open_groups_as_dict(
        self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None
    ) -> dict[str, xr.Dataset]:
        """Open a run as groups; see `products.dataset.groups_of`."""
        from blocksar.places import place
        from blocksar.products import dataset

        groups = dataset.groups_of(place(filename_or_obj))
        return {path: _without(group, drop_variables) for path, group in groups.items()}

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Tell whether it is the folder of a run on this machine."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        folder = os.fspath(filename_or_obj)
        return os.path.isfile(os.path.join(folder, "run.json")) and os.path.isdir(os.path.join(folder, "image.zarr"))


def _without(dataset: xr.Dataset, names: str | Iterable[str] | None) -> xr.Dataset:
    named = [names] if isinstance(names, str) else list(names or ())
    return dataset.drop_vars(named, errors="ignore")
