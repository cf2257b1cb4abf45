"""Reproduce the figures and tables of the papers from scratch, each of our numbers beside the printed one.

    python workflows/reproduce_papers.py --out reproduced
    python workflows/reproduce_papers.py --out reproduced --only fig2,fig11,table3

Scenes are simulated, planned, focused and measured in the run. The only numbers typed in are those that the papers
print, in papers/printed.py, each with its place. DIR/index.html has everything, with pictures embedded; DIR/README.md
and the PNG files have the same content. Paper A is the angular-division paper, paper B the keystone-resampling paper.

A full run takes some minutes on two cores and needs 6 GB in DIR for temporary files. Pictures need the extra `plots`.

    exit status   meaning
    0             all requested figures and tables are there
    1             some of them failed: the page gives the reasons, and has the others
    2             an option is wrong: nothing was written
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from blocksar.errors import InputError, ProcessingError
from papers.azimuth import figure9
from papers.bench import THREADS, Bench, log
from papers.coefficients import closed_form
from papers.comparison import Exhibit
from papers.images import figure12, figure13
from papers.migration import figure8, figure11
from papers.page import write_page
from papers.paper_b import paper_b_table
from papers.range_series import figure2, figure3, figure4
from papers.recovery import figure6, figure7
from papers.responses import figure14, figure15, table2, table3

EXHIBITS: dict[str, Callable[[Bench], Exhibit]] = {
    "fig2": figure2, "fig3": figure3, "fig4": figure4, "fig6": figure6, "fig7": figure7, "fig8": figure8,
    "fig9": figure9, "fig11": figure11, "fig12": figure12, "fig13": figure13, "fig14": figure14, "table2": table2,
    "fig15": figure15, "table3": table3, "b-table2": paper_b_table, "closed-form": closed_form,
}  # fmt: skip


def select(only: str | None) -> list[str]:
    """Parse --only: names of exhibits in the order of the page.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    names = list(EXHIBITS) if only is None else [name.strip().lower() for name in only.split(",")]
    unknown = [name for name in names if name not in EXHIBITS]
    if unknown:
        raise InputError(f"--only has {', '.join(map(repr, unknown))}; choose from {', '.join(EXHIBITS)}")
    return [name for name in EXHIBITS if name in names]


def run_exhibit(bench: Bench, name: str) -> Exhibit:
    """Run one figure or table; if it fails, the exhibit holds the error."""
    started = time.perf_counter()
    try:
        exhibit = EXHIBITS[name](bench)
    except (InputError, ProcessingError) as error:
        exhibit = Exhibit(title=f"{name} failed", text=str(error), failed=True)
    exhibit.key, exhibit.seconds = name, time.perf_counter() - started
    return exhibit


def reproduce(out: Path, names: Sequence[str], *, workers: int) -> list[Exhibit]:
    """Run some exhibits and write their page.

    Raises
    ------
    InputError
        If the folder `out` cannot be created.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out} cannot be created ({error.strerror}); choose another") from None
    started, exhibits = time.perf_counter(), []
    with ExitStack() as stack:
        folder = stack.enter_context(
            tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True)
        )
        bench = Bench(out=out, folder=Path(folder), workers=workers, stack=stack)
        for name in names:
            log(name)
            exhibits.append(run_exhibit(bench, name))
    write_page(out, exhibits, time.perf_counter() - started)
    return exhibits


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page and its pictures.")],
    only: Annotated[str | None, typer.Option(metavar="FIG,...", help=f"Some of: {', '.join(EXHIBITS)}.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes for focusing.")] = min(THREADS, 4),
) -> None:
    """Reproduce figures and tables of the papers, each number beside the printed one.

    Example: python workflows/reproduce_papers.py --out reproduced --only fig2,table3
    """
    try:
        exhibits = reproduce(out, select(only), workers=workers)
    except InputError as error:
        log(f"reproduce_papers: {error}")
        raise typer.Exit(2) from None
    log(f"wrote {out / 'index.html'}")
    if failed := [e.key for e in exhibits if e.failed]:
        log(f"reproduce_papers: {', '.join(failed)} failed; the page gives the reasons")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
