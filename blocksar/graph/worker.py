"""What the process that workers are forked from imports and loads, once for all of them."""

from __future__ import annotations

import distributed  # noqa: F401

from blocksar.focusing.correction import compile_kernels
from blocksar.graph import tasks  # noqa: F401

compile_kernels()
