"""Time `focus` with the blocksar of whichever Python runs this script; `other_version.py` starts it.

    PYTHON -P workflows/benchmarks/timed_focus.py WORKERS THREADS MEMORY_LIMIT

Starts a cluster and prints the version of blocksar, as a line of JSON. Then reads requests from standard input, one
line of JSON each (store, run, blocks), and prints the seconds of each. Ends with its standard input.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

import blocksar


def cluster_module() -> Any:
    """The module of `open_client`: blocksar 0.1 has it in another place."""
    try:
        return importlib.import_module("blocksar.graph.cluster")
    except ModuleNotFoundError:
        return importlib.import_module("blocksar.cluster")


def main(workers: int, threads: int, memory_limit: int) -> None:
    opened = cluster_module().open_client(workers=workers, threads=threads, memory_limit=memory_limit)
    with opened as client:
        print(json.dumps(blocksar.__version__), flush=True)
        for line in sys.stdin:
            request = json.loads(line)
            started = time.perf_counter()
            blocksar.focus(
                request["store"], request["run"], blocks=request["blocks"], threads=threads, client=client
            )  # fmt: skip
            print(json.dumps(time.perf_counter() - started), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
