"""What the process that workers are forked from imports and loads, once for all of them."""

from __future__ import annotations

import gc

gc.disable()  # imports create many objects and no garbage

import distributed  # noqa: E402, F401

from blocksar.graph import tasks  # noqa: E402, F401
from blocksar.graph.compiling import compile_kernels  # noqa: E402

compile_kernels(apart=False)
gc.freeze()  # a collection in a worker would write to the pages that it shares with the others
gc.enable()
