"""blocksar: focus squint-TOPS synthetic aperture radar data by angular blocks, in parallel.

The functions correspond to the commands: `simulate`, `ingest`, `info`, `preview`, `check`, `autofocus`, `plan`,
`focus`, `quality`, `report`, `export`, `compare`, `calibrate`, `view` and `compile`; `open` returns a finished image;
`collection` builds a phase history from arrays, `scene_centre` finds its place on the Earth, and `write` stores it.
They are loaded on first use, so that `import blocksar` is fast. They raise `InputError` if the input is wrong, and
`ProcessingError` if processing failed and the same call can resume it.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import cache, wraps
from types import ModuleType
from typing import TYPE_CHECKING, Any

from blocksar.loop_cache import choose_cache
from blocksar.version import __version__

if TYPE_CHECKING:
    from blocksar.api import (
        autofocus,
        calibrate,
        check,
        collection,
        compare,
        compile,
        export,
        focus,
        info,
        ingest,
        open,
        plan,
        preview,
        quality,
        report,
        scene_centre,
        simulate,
        view,
        write,
    )
    from blocksar.errors import InputError, ProcessingError

__all__ = [
    "InputError",
    "ProcessingError",
    "__version__",
    "autofocus",
    "calibrate",
    "check",
    "collection",
    "compare",
    "compile",
    "export",
    "focus",
    "info",
    "ingest",
    "open",
    "plan",
    "preview",
    "quality",
    "report",
    "scene_centre",
    "simulate",
    "view",
    "write",
]


choose_cache()


def __getattr__(name: str) -> Any:
    if name in __all__:
        if name.endswith("Error"):
            return getattr(importlib.import_module("blocksar.errors"), name)
        return _in_python(getattr(importlib.import_module("blocksar.api"), name))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def _in_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a copy of the function whose errors name parameters of Python instead of options of the command line."""
    from blocksar.errors import InputError, ProcessingError, UnknownOption, in_python, shortened_trace
    from blocksar.options import check_arguments, nearest_argument

    @wraps(function)
    def call(*arguments: Any, **settings: Any) -> Any:
        try:
            check_arguments(function, settings)
            return function(*arguments, **settings)
        except (InputError, ProcessingError) as error:
            nearer = nearest_argument(function, error.name) if isinstance(error, UnknownOption) else None
            error.args = (nearer or in_python(str(error)), *error.args[1:])
            shortened_trace(error)
            raise
        except OSError as error:
            if "://" not in str(error.filename):
                raise
            from blocksar.places import place
            from blocksar.stores.records import unreachable  # only where an object store fails

            raise unreachable(place(error.filename), error) from None

    call.__module__ = __name__  # where pickle finds it
    return call


class _Package(ModuleType):
    """Module type of the package that keeps its function `collection` when the subpackage of that name is imported."""

    @property
    def collection(self) -> Any:
        return __getattr__("collection")

    @collection.setter
    def collection(self, folder: ModuleType) -> None:
        """Ignore the subpackage, which `from blocksar.collection...` finds in sys.modules."""

    def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        """Pickle the package by name: functions sent to workers refer to it."""
        return importlib.import_module, (self.__name__,)


sys.modules[__name__].__class__ = _Package


def __dir__() -> list[str]:
    return sorted(__all__)
