"""The listener that a caller wants, from what was given as `progress`."""

from __future__ import annotations

from typing import Literal

from blocksar.errors import InputError
from blocksar.progress.listening import Listener, Updated, UpdateListener
from blocksar.progress.notebook import CellProgress, in_notebook

Wanted = Updated | Literal[False]  # of a parameter that may also be None


def as_listener(wanted: Wanted | None) -> Listener:
    """Return a full listener: for an object that may have `update` only, for None and for False.

    None stands for bars below the cell in a Jupyter notebook and for silence elsewhere, False for silence.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if wanted is None and in_notebook():
        return CellProgress()
    if wanted is None or wanted is False:
        return Listener()
    if isinstance(wanted, Listener):
        return wanted
    if not callable(getattr(wanted, "update", None)):
        raise InputError(
            f"progress is {wanted!r}; give an object with a method update(stage, done, total), or False for silence"
        )
    return UpdateListener(wanted)
