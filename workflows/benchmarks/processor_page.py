"""The page of cost against error: its text, tables and picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from benchmarks.processors import Row

PICTURE = "cost_against_error.png"
PAGE = """\
# Cost against error

```bash
.venv/bin/python workflows/benchmark.py --cost-against-error workflows/benchmarks/README.md --peers fastsar/bin/python
```

made this page: every processor on three small scenes of clutter, from store to store in one process, asked for several
fidelities. *Error* is the power of the difference from exact back-projection over the power of that, without any
adjustment of place, gain or phase. Times are processor time of all threads, {repeats}, with planning, which takes some
seconds of the chains' and does not grow with the pixels: on images of millions of them chains are the cheaper ones.
[fastsar](https://pypi.org/project/fastsar/), in an environment of its own that `--peers` names, goes from arrays to
arrays, without reading, checks and writing, but with the set-up of its former, which other samples of the same geometry
would share.

{machine}.

![Error over processor time]({picture})

{scenes}
"""


def write_page(result: dict[str, Any], path: Path) -> None:
    """Write the page, and the picture beside it."""
    computer, versions = result["machine"], result["versions"]
    n = result["repeats"]
    text = PAGE.format(
        repeats="of one run" if n == 1 else f"median of {n} runs", picture=PICTURE,
        machine=f"{computer['cpu']}, {computer['cores']} cores, numpy {versions['numpy']}, numba {versions['numba']}",
        scenes="\n".join(_section(name, scene) for name, scene in result["scenes"].items()).strip(),
    )  # fmt: skip
    path.write_text(text, encoding="utf-8")
    draw(result["scenes"], path.with_name(PICTURE))


def _section(name: str, scene: dict[str, Any]) -> str:
    height, width = scene["pixels"]
    lines = [
        f"## {name[0].upper()}{name[1:]}",
        "",
        f"{scene['what']}: {scene['pulses']} x {scene['samples']} samples, {height} x {width} pixels.",
        "",
        "| processor | fidelity asked for | coherence | error, dB | processor time, s |",
        "|---|---|---|---|---|",
        *map(_line, scene["rows"]),
        "",
    ]
    for processor, reason in scene["refused"].items():
        lines += [f"`{processor}`: {reason}", ""]
    return "\n".join(lines)


def _line(row: Row) -> str:
    found = ["", "exact", ""]
    if row.coherence is not None and row.error is not None:
        asked = "" if row.asked is None else f"{row.asked:g}"
        found = [asked, f"{row.coherence:.6f}", f"{10 * math.log10(row.error):.1f}"]
    return f"| `{row.processor}` | {' | '.join(found)} | {row.seconds:.1f} |"


def draw(scenes: dict[str, Any], path: Path) -> None:
    """Draw errors over processor time, a panel a scene; exact back-projection is a line at its time."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(scenes), figsize=(4 * len(scenes), 4), layout="constrained", squeeze=False)
    names = list(dict.fromkeys(row.processor for scene in scenes.values() for row in scene["rows"]))
    for axes, (name, scene) in zip(panels[0], scenes.items(), strict=True):
        for number, processor in enumerate(names):
            rows = [row for row in scene["rows"] if row.processor == processor]
            points = [(row.seconds, 10 * math.log10(row.error)) for row in rows if row.error is not None]
            if points:
                axes.plot(*zip(*points, strict=True), "o-", color=f"C{number}", label=processor)
            elif rows:
                axes.axvline(rows[0].seconds, linestyle="--", color=f"C{number}", label=f"{processor} (exact)")
        axes.set(title=name, xlabel="processor time (s)", xlim=(0, None))
    panels[0][0].set_ylabel("error (dB)")
    handles = {label: h for axes in panels[0] for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)
