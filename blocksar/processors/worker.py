"""Imports of the process that workers are forked from, which all workers share."""

from __future__ import annotations

import gc
from contextlib import suppress

gc.disable()  # imports create many objects and no garbage

import distributed  # noqa: E402, F401
import numpy as np  # noqa: E402

from blocksar.graph.compiling import TASKS, load_cached  # noqa: E402
from blocksar.kernels.fourier import fft_rows  # noqa: E402
from blocksar.kernels.fresnel import fresnel_integral  # noqa: E402
from blocksar.stores.chunk_files import zstd  # noqa: E402
from blocksar.tasks import forming, inspecting, preparing  # noqa: E402, F401

with suppress(ModuleNotFoundError):  # a processor's folder may be taken away
    from blocksar.processors.chain.tasks import patching, recovering  # noqa: F401

load_cached(TASKS)
fft_rows(np.zeros((1, 2), np.complex64), inverse=False)  # imports, on the first call
fresnel_integral(np.zeros(1))
zstd()
gc.freeze()  # a collection in a worker would write to the pages that it shares with the others
gc.enable()
