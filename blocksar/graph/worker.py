"""What the process that workers are forked from imports and loads, once for all of them."""

from __future__ import annotations

import gc

gc.disable()  # imports create many objects and no garbage

import distributed  # noqa: E402, F401

from blocksar.focusing.correction import compile_kernels  # noqa: E402
from blocksar.graph import tasks  # noqa: E402, F401

compile_kernels()
gc.freeze()  # a collection in a worker would write to the pages that it shares with the others
gc.enable()
