"""Registries of plug-ins: own parts, and those that other packages install as entry points."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from blocksar.errors import InputError, quoted

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Part = TypeVar("Part")


class Registry(Generic[Part]):
    """Parts by name, own ones and entry points of other packages; each is loaded on demand.

    Parameters
    ----------
    group : str
        Entry-point group under which other packages add parts.
    noun : str
        What a part is, for messages.
    own : mapping of str to str
        "module:attribute" by name.
    check : callable, optional
        Raises an error if a part of another package is not what it should be.
    """

    def __init__(
        self, group: str, noun: str, own: Mapping[str, str], check: Callable[[Part], object] = lambda part: None
    ) -> None:
        self.group, self.noun, self.own, self.check = group, noun, dict(own), check

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        """Entry points of other packages by name; a name of an own part is skipped."""
        from importlib.metadata import entry_points  # takes longer to load than all other imports here

        return {each.name: each for each in entry_points(group=self.group) if each.name not in self.own}

    def names(self) -> tuple[str, ...]:
        """Return the names of own parts, then those of other packages."""
        return (*self.own, *sorted(self._installed))

    def __contains__(self, name: Any) -> bool:
        return isinstance(name, str) and (name in self.own or name in self._installed)

    def sound(self) -> Iterator[tuple[str, Part]]:
        """Iterate over the parts by name; those that cannot be loaded are skipped."""
        for name in self.names():
            try:
                part = self.get(name)
            except InputError:
                continue
            yield name, part

    def __iter__(self) -> Iterator[Part]:
        return (part for _, part in self.sound())

    def get(self, name: Any) -> Part:
        """Return the part of a name.

        Raises
        ------
        InputError
            If there is none, or its package cannot be loaded.
        """
        if isinstance(name, str) and name in self.own:
            module, _, attribute = self.own[name].partition(":")
            return cast(Part, getattr(import_module(module), attribute))
        found = self._installed.get(name) if isinstance(name, str) else None
        if found is None:
            close = difflib.get_close_matches(str(name), self.names(), n=1)
            hint = f"did you mean {close[0]}? Known are" if close else "use"
            raise InputError(f"{self.noun} {quoted(name)} is unknown; {hint} {', '.join(self.names())}")
        try:
            part = cast(Part, found.load())
            self.check(part)
            return part
        except Exception as error:
            package = found.dist.name if found.dist is not None else found.value
            raise InputError(
                f"{self.noun} {name} of package {package} cannot be loaded ({type(error).__name__}: {error}); repair "
                "or remove that package"
            ) from error
