"""report: the page of a finished run, or of each of its channels or looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

from blocksar import stores
from blocksar.api.measuring import measure_targets
from blocksar.application.reports import Report, only_stage
from blocksar.application.target_files import targets_of
from blocksar.errors import InputError, ProcessingError, in_the_way, is_full, library_for, no_room
from blocksar.measurement.figures import as_json
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.products.look_spectra import measure_looks
from blocksar.products.registry import check_ending
from blocksar.products.writing import refuse_parts
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.runs.finished import FinishedRun, finished_record, folder_of
from blocksar.runs.record import RunRecord


def report(
    run: Location,
    *,
    out: Location | None = None,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Write the report page of a finished run: one self-contained HTML file.

    The page shows what RUN/quality.json holds. Without that file, the targets that the run knows are measured first.

    Parameters
    ----------
    run : path
        Folder of a finished run.
    out : path, optional
        HTML file to write. Default: RUN/report.html, which is always replaced.
    channel : str, optional
        Of a run of several channels or looks, each of which has a page of its own with links to the others. Default:
        all of them; with `out`, the first.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` has the verdict; `result` is the path of the page, of several that of the first.

    Raises
    ------
    InputError
        If the run is not finished or cannot be read, a library is not installed, or `out` exists and `overwrite` is
        False.
    ProcessingError
        If the page cannot be written; an earlier page stays.
    """
    folder = place(run)
    whole = finished_record(folder)
    linked = whole.channels if out is None else ()
    names = [channel] if channel is not None or not linked else list(linked)
    page = _page_module()
    writer = _Writer(
        run=folder, out=out, linked=linked, common=_common(folder, whole, progress), overwrite=overwrite,
        progress=progress, page=page,
    )  # fmt: skip
    lines, first = [], None
    for name in names:
        target, own_lines = writer.write(name)
        lines += [line if len(names) == 1 else f"{name}: {line}" for line in own_lines]
        first = first or target
    return Report(summary=lines, result=first)


class _Common(NamedTuple):
    """Parts that the pages of all channels or looks of a run share."""

    composite: Any  # the Pauli composite of channels; None without the polarisations
    looks: Any  # the spectra of looks; None of other runs
    n_looks: int | None


def _common(folder: Place, whole: RunRecord, progress: Progress | None) -> _Common:
    """Draw the composite of a run of all polarisations, and measure the spectra of looks."""
    if not whole.channels:
        return _Common(None, None, None)
    if whole.dimension == "look":
        looks = [FinishedRun.open(folder_of(folder, name)) for name in whole.channels]
        return _Common(None, measure_looks(looks), len(looks))
    from blocksar.products.page.page import draw_composite
    from blocksar.products.pictures.composite import find_pauli

    chosen = find_pauli(whole.channels)
    if not chosen:
        return _Common(None, None, None)
    sources = {name: FinishedRun.open(folder_of(folder, channel)) for name, channel in chosen.items()}
    return _Common(draw_composite(sources, progress=only_stage(progress, "composite")), None, None)


def _page_module() -> ModuleType:
    """Import the module of pages: optional, and slow to load."""
    with library_for("reports need", "plots"):
        from blocksar.products.page import page
    return page


@dataclass(frozen=True, kw_only=True)
class _Writer:
    """Settings with which the pages of all channels or looks of a run are written."""

    run: Place
    out: Location | None
    linked: Sequence[str]
    common: _Common
    overwrite: bool
    progress: Progress | None
    page: Any  # the module

    def write(self, channel: str | None) -> tuple[Place, list[str]]:
        """Write one page; return its path and lines for the user."""
        folder = folder_of(self.run, channel)
        target = folder / "report.html" if self.out is None else place(self.out)
        if self.out is not None and target.exists() and not self.overwrite:
            raise in_the_way(target)
        if isinstance(target, LocalPlace) and target.path.is_dir():
            raise InputError(f"{target} is a folder; give --out the name of a file")
        if isinstance(target, LocalPlace):
            refuse_parts(target)
        if self.out is not None:
            check_ending("report", str(target))
        source = FinishedRun.open(folder)
        figures, reason = _read_or_measure(folder, source)
        history = str(stores.open_dataset(source.image).attrs.get("history", ""))
        listener = as_listener(self.progress)
        siblings = [self.page.Sibling(name, f"../{name}/report.html", name == folder.name) for name in self.linked]
        content, verdict = self.page.make(
            source, figures, folder=str(self.run), siblings=siblings, looks=self.common.n_looks,
            spectra=self.common.looks, composite=self.common.composite, history=history, why=reason,
            progress=only_stage(listener, "report"), drawn=partial(listener.update, "responses"),
        )  # fmt: skip
        try:
            target.write_bytes(content)
        except (PermissionError, NotADirectoryError, FileExistsError) as error:
            raise InputError(f"{target} cannot be written ({error.strerror}); choose another --out") from error
        except OSError as error:
            if is_full(error):
                raise no_room(target, error) from error
            raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
        return target, ["; ".join(verdict), f"wrote {target}"]


def _read_or_measure(folder: Place, source: FinishedRun) -> tuple[dict[str, Any] | None, str]:
    """Read quality.json, or measure what it would hold; return None and the reason if that fails."""
    if (folder / "quality.json").exists():
        return stores.read_json(folder / "quality.json"), ""
    targets = targets_of(None, source.attrs)
    try:
        responses = measure_targets(source, targets).responses
    except InputError as error:  # the page can still show an image that is too coarse for measurements
        return None, f"Nothing was measured: {error}."
    return as_json(responses, source.weighting), ""
