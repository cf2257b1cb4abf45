"""The parameters that a docstring describes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

Entry = tuple[str, str]  # type, description


def entries(function: Callable[..., Any]) -> dict[str, Entry]:
    """Type and description of every parameter, by name, from the section of the docstring."""
    text = inspect.getdoc(function) or ""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w+\n---|\Z)", text, re.M | re.S)
    found: dict[str, Entry] = {}
    for names, kind, body in re.findall(
        r"^(\S[^\n]*?)(?: : ([^\n]+))?\n((?:    [^\n]*\n|\n)+)", (section or [""] * 2)[1] + "\n", re.M
    ):
        for name in names.split(", "):
            found[name.strip("*")] = (kind, " ".join(body.split()))
    return found
