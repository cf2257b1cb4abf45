"""Figures and tables of the papers from scratch, each of our numbers beside the printed one.

    python workflows/reproduce_papers.py --out reproduced
    python workflows/reproduce_papers.py --out reproduced --only fig2,fig11,table3

Scenes are simulated, planned, focused and measured in the run; what is typed in is what the papers print, below, with
the place where they print it. DIR/index.html holds everything, pictures embedded; DIR/README.md and the PNG files say
the same. Paper A is the angular-division paper, paper B the keystone-resampling paper.

All of it takes some minutes on two cores, and 6 GB in DIR while it goes on. Pictures need the extra `plots`.

    exit status   meaning
    0             all that was asked for is there
    1             something could not be made: the page says what and why, and holds the rest
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
from papers.azimuth import closed_form, figure9
from papers.bench import THREADS, Bench, tell
from papers.comparison import Exhibit
from papers.images import figure12, figure13
from papers.migration import figure8, figure11
from papers.page import write_page
from papers.range_series import figure2, figure3, figure4
from papers.recovery import figure6, figure7
from papers.responses import figure14, figure15, paper_b_table, table2, table3

# ---------------------------------------------------------------- the page

EXHIBITS: dict[str, Callable[[Bench], Exhibit]] = {
    "fig2": figure2, "fig3": figure3, "fig4": figure4, "fig6": figure6, "fig7": figure7, "fig8": figure8,
    "fig9": figure9, "fig11": figure11, "fig12": figure12, "fig13": figure13, "fig14": figure14, "table2": table2,
    "fig15": figure15, "table3": table3, "b-table2": paper_b_table, "closed-form": closed_form,
}  # fmt: skip


# ---------------------------------------------------------------- the command


def wanted(only: str | None) -> list[str]:
    """Names of exhibits, in the page's order."""
    names = list(EXHIBITS) if only is None else [name.strip().lower() for name in only.split(",")]
    unknown = [name for name in names if name not in EXHIBITS]
    if unknown:
        raise InputError(f"--only has {', '.join(map(repr, unknown))}; choose from {', '.join(EXHIBITS)}")
    return [name for name in EXHIBITS if name in names]


def exhibit(bench: Bench, name: str) -> Exhibit:
    """One figure or table; where it fails, what stands in its place."""
    started = time.perf_counter()
    try:
        found = EXHIBITS[name](bench)
    except (InputError, ProcessingError) as error:
        found = Exhibit(title=f"{name} could not be made", text=str(error), failed=True)
    found.key, found.seconds = name, time.perf_counter() - started
    return found


def reproduce(out: Path, names: Sequence[str], *, workers: int) -> list[Exhibit]:
    """Make some exhibits and the page of them.

    Raises
    ------
    InputError
        If `out` is no folder and cannot become one.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out} cannot be a folder ({error.strerror}); choose another") from None
    started, found = time.perf_counter(), []
    with ExitStack() as stack:
        folder = stack.enter_context(
            tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True)
        )
        bench = Bench(out=out, folder=Path(folder), workers=workers, stack=stack)
        for name in names:
            tell(name)
            found.append(exhibit(bench, name))
    write_page(out, found, time.perf_counter() - started)
    return found


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page and its pictures.")],
    only: Annotated[str | None, typer.Option(metavar="FIG,...", help=f"Some of: {', '.join(EXHIBITS)}.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes that focus.")] = min(THREADS, 4),
) -> None:
    """Reproduce figures and tables of the papers, each number beside the printed one.

    Example: python workflows/reproduce_papers.py --out reproduced --only fig2,table3
    """
    try:
        found = reproduce(out, wanted(only), workers=workers)
    except InputError as error:
        tell(f"reproduce_papers: {error}")
        raise typer.Exit(2) from None
    tell(f"{out / 'index.html'} is there")
    if failed := [e.key for e in found if e.failed]:
        tell(f"reproduce_papers: {', '.join(failed)} could not be made; the page says why")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
