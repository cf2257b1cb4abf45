"""Sentence at the end of every refusal of a chain: hierarchical back-projection does it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from blocksar.errors import InputError, PrfTooLow, Unfocusable
from blocksar.processors import HIERARCHY

FOLDED = f"; hierarchical back-projection takes any PRF, and tells what folds: --processor {HIERARCHY}"
ANY = f"; hierarchical back-projection has no such limit: --processor {HIERARCHY}"


@contextmanager
def naming_hierarchy() -> Iterator[None]:
    """Add the end to errors about what no chain can form."""
    try:
        yield
    except Unfocusable as error:
        raise InputError(f"{error}{FOLDED if isinstance(error, PrfTooLow) else ANY}") from error
