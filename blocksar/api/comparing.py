"""compare: two runs of one ground, such as two passes: interferogram, coherence, amplitude ratio and change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from blocksar.application.reports import Report, finite, only_stage
from blocksar.errors import InputError, in_the_way, library_for, quoted
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place, check_room
from blocksar.products.pair import PIXEL_BYTES, Made, Pair, displacement, write_pair
from blocksar.products.shared_options import parse_looks
from blocksar.products.writing import refuse_parts
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.runs.finished import FinishedRun, folder_of, member_line
from blocksar.spans import parse_crop

WINDOW = "7x7"
FALSE_ALARMS = 1e-3
LEVEL = 1e-9  # rad/m, below which height does not turn the phase
LARGEST = 255  # pixels of a window along an axis
STORE = "pair.zarr"
PICTURES = ("phase.png", "coherence.png", "ratio.png", "change.png")


def compare(
    a: Location,
    b: Location,
    out: Location,
    *,
    window: tuple[int, int] | str = WINDOW,
    false_alarms: float = FALSE_ALARMS,
    channel: str | None = None,
    crop: tuple[tuple[float, float], tuple[float, float]] | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Compare two finished runs on one grid, such as those of two passes, pixel by pixel.

    Parameters
    ----------
    a, b : path
        Folders of the runs, the earlier one first. Both are images on one grid and one ground.
    out : path
        Folder to write: pair.zarr, which opens with xarray, and phase.png, coherence.png, ratio.png and change.png.
    window : (int, int) or str
        Pixels along y and along x, odd, over which coherence is estimated, such as (7, 7) or "7x7". Default: "7x7".
    false_alarms : float
        Probability, of 1, that a pixel is called changed that is not. Default: 0.001.
    channel : str, optional
        Of runs of several channels or looks. Default: the first.
    crop : ((float, float), (float, float)) or str, optional
        Ends of x and of y, m, of the part to compare, such as "0:500,18000:18500". Default: the whole image.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `result` has the store's path, baseline, vertical wavenumber (rad/m), coherence and change. The store has
        `interferogram`, `coherence`, `amplitude_ratio`, `vertical_wavenumber` and `change` (y, x).

    Raises
    ------
    InputError
        If a run is not finished, grids, grounds or frames differ, an option is wrong, matplotlib is not installed, or
        `out` has such files and `overwrite` is False.
    ProcessingError
        If writing fails.
    """
    sides, rate = _checked_window(window), _checked_rate(false_alarms)
    with library_for("pictures need", "plots"):
        from blocksar.products.pictures import pair_layers  # optional, and slow to load
    runs = [FinishedRun.open(folder_of(place(run), channel)) for run in (a, b)]
    box = None if crop is None else parse_crop(crop)
    parts = [run if box is None else run.cropped(*box) for run in runs]
    pair = Pair(a=parts[0], b=parts[1], window=sides, false_alarms=rate)
    folder = place(out)
    _check_out(folder, overwrite=overwrite)
    check_room(folder, PIXEL_BYTES * pair.a.x.size * pair.a.y.size)
    listener = as_listener(progress)
    store = folder / STORE
    made = write_pair(pair, store, overwrite=overwrite, progress=only_stage(listener, "compare"))
    drawn = pair_layers.draw_pair(pair, store, folder, overwrite=overwrite, progress=only_stage(listener, "draw"))
    lines = [*member_line(place(a), channel), *_lines(pair, made)]
    names = ", ".join(each.name for each in drawn if isinstance(each, LocalPlace))
    return Report(summary=[*lines, f"wrote {store}, and beside it {names}"], result=_result(pair, made, store))


def _checked_window(window: Any) -> tuple[int, int]:
    sides: Any = ()
    with suppress(InputError):
        sides = parse_looks(window)
    odd = all(isinstance(n, int) and not isinstance(n, bool) and n % 2 == 1 and 1 <= n <= LARGEST for n in sides)
    if not (len(sides) == 2 and odd and max(sides) > 1):
        raise InputError(
            f"window = {quoted(window)}: give pixels along y and along x, odd and at most {LARGEST}, such as 7x7"
        )
    return sides[0], sides[1]


def _checked_rate(rate: Any) -> float:
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1e-6 <= rate <= 0.1:
        raise InputError(f"false_alarms = {quoted(rate)}: give a probability from 1e-6 to 0.1, such as 0.001")
    return float(rate)


def _check_out(folder: Place, *, overwrite: bool) -> None:
    if not isinstance(folder, LocalPlace):
        raise InputError(f"{folder} is no local path, and pictures are written only to local paths; choose another out")
    if folder.exists() and not folder.path.is_dir():
        raise InputError(f"{folder} is no folder; choose another out")
    refuse_parts(LocalPlace(folder.path / STORE))
    if not overwrite and (there := [name for name in (STORE, *PICTURES) if (folder / name).exists()]):
        raise in_the_way(folder / there[0])


def _lines(pair: Pair, made: Made) -> Sequence[str]:
    """Describe the baseline, coherence and change of a pair in sentences."""
    baseline, (n_y, n_x) = pair.baseline, pair.window
    lines = ["one of the runs does not see the middle of the image, so that no baseline is given"]
    if math.isfinite(baseline.wavenumber):
        turn = f"{2 * math.pi / abs(baseline.wavenumber):.3g} m" if abs(baseline.wavenumber) > LEVEL else "infinite"
        lines = [
            f"baseline in the middle: {baseline.perpendicular:.3g} m across the line of sight, "
            f"{baseline.parallel:.3g} m along it; height of ambiguity {turn}; coherence that it leaves of flat ground "
            f"{baseline.surface:.3f}"
        ]
    lines += [
        f"coherence over {n_y} x {n_x} pixels, {pair.looks:.1f} of them independent: median {made.median:.3f}, which "
        f"stands for {made.scene:.3f}; chance alone gives {pair.chance:.3f}",
        f"1 rad of phase is {1e3 * displacement(pair):.3g} mm along the line of sight",
    ]
    if math.isnan(made.limit):
        lines.append(
            "change is not judged: the scene is hardly more coherent than chance; take a larger window, or align the "
            "tracks (blocksar autofocus)"
        )
    else:
        lines.append(
            f"changed: {100 * made.changed / max(made.judged, 1):.3g} % of {made.judged} pixels, whose coherence is "
            f"below {made.limit:.3f}; false alarms {100 * pair.false_alarms:g} %"
        )
        if dark := made.covered - made.judged:
            lines.append(
                f"not judged: {100 * dark / made.covered:.3g} % of {made.covered} covered pixels, where noise or side "
                "lobes of brighter places leave too little of the ground"
            )
    if pair.a.weighting != pair.b.weighting:
        lines.append(
            f"note: weights differ, {pair.a.weighting.text} and {pair.b.weighting.text}, which takes coherence below 1"
        )
    return lines


def _result(pair: Pair, made: Made, store: Place) -> dict[str, Any]:
    baseline = pair.baseline
    return {
        "store": str(store),
        "perpendicular_baseline": finite(baseline.perpendicular),
        "parallel_baseline": finite(baseline.parallel),
        "vertical_wavenumber": finite(baseline.wavenumber),
        "surface_coherence": finite(baseline.surface),
        "displacement_of_a_radian": displacement(pair),
        "window": list(pair.window),
        "independent_pixels": pair.looks,
        "median_coherence": made.median,
        "coherence": made.scene,
        "coherence_of_chance": pair.chance,
        "change_below": finite(made.limit),
        "covered": made.covered,
        "judged": made.judged,
        "changed": made.changed,
    }
