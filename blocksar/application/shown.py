"""Reports with a picture: of a plan, and of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from blocksar.application.reports import Report
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, library_for
from blocksar.places.place import Place
from blocksar.processors.base import ImagePlan
from blocksar.runs.record import RunRecord

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class PlanReport(Report):
    """Report of `plan`.

    Attributes
    ----------
    plan : ImagePlan or None
        The plan, if it is one.
    """

    plan: ImagePlan | None = None

    @property
    def geometry(self) -> Geometry | None:
        """Track and ground of the collection, or of the first of several; None without a plan."""
        return None if self.plan is None else self.plan.pieces[0].geometry

    def headline(self) -> str:
        if self.plan is None or self.refusal is not None:
            return super().headline()
        return self.plan.headline()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the blocks with their predicted coherence, the footprint and the image's outline on the ground.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw. Default: a new pyplot figure, which also shows the track from above.

        Returns
        -------
        Axes
            Those of the ground.

        Raises
        ------
        InputError
            If matplotlib is not installed, or there is no plan: no processor was proposed.
        """
        plan = self.plan
        if plan is None or len(plan.pieces) > 1:
            raise InputError(f"there is no plan to draw ({self.headline()}); plan with other settings")
        with library_for("pictures need", "plots"):
            return plan.draw(ax)


def is_measurable(record: RunRecord) -> bool:
    """Tell whether the image of a run has more than one row and one column of pixels."""
    return record.plan.grid is None or min(Grid(*record.plan.grid).shape) > 1


@dataclass(frozen=True, repr=False)
class RunReport(Report):
    """Report of `focus`.

    Attributes
    ----------
    folder : Place or None
        The run folder.
    measurable : bool
        Whether `quality`, `report` and `export` take the image: not a single row or column.
    """

    folder: Place | None = None
    measurable: bool = True

    def __fspath__(self) -> str:
        """The run folder: a report stands for it wherever a run is asked for."""
        return str(self._focused())

    def _focused(self) -> Place:
        if self.folder is None:
            raise InputError("nothing was focused in this call; give the folder of a run")
        return self.folder

    def open(self) -> xr.Dataset:
        """Open the image, as `blocksar.open` does.

        Raises
        ------
        InputError
            If the run is gone, or nothing was focused.
        """
        from blocksar.products import dataset  # registers the accessor, and loads xarray

        return dataset.open(self._focused())

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the image in decibels, as `open().sar.plot` does.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw. Default: a new pyplot figure.

        Raises
        ------
        InputError
            If matplotlib is not installed, or the run is gone.
        """
        axes: Axes = self.open().sar.plot(ax)
        return axes
