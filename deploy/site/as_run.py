"""An extension of griffe: functions whose signature and docstring a decorator completes, as they are when run."""

from __future__ import annotations

import inspect
from importlib import import_module
from typing import Any

import griffe

PREFIX = "blocksar.api.sources.ingest_"


class AsRun(griffe.Extension):
    """Takes signatures and docstrings of readers' functions from the functions."""

    def on_function_instance(self, *, func: griffe.Function, **_: Any) -> None:
        if not func.path.startswith(PREFIX):
            return
        function = getattr(import_module(func.path.rpartition(".")[0]), func.name)
        func.docstring = griffe.Docstring(inspect.getdoc(function) or "", parent=func)
        func.parameters = griffe.Parameters(
            *(
                griffe.Parameter(
                    each.name,
                    kind=griffe.ParameterKind(each.kind.description),
                    default=None if each.default is inspect.Parameter.empty else repr(each.default),
                )
                for each in inspect.signature(function).parameters.values()
            )
        )
