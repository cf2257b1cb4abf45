"""The machine and the installed versions."""

from __future__ import annotations

import os
import platform
import re
from importlib import metadata
from pathlib import Path
from typing import Any

from blocksar.graph.machine import machine

PACKAGES = ("blocksar", "numpy", "scipy", "numba", "dask", "distributed", "zarr", "xarray")


def describe_machine() -> dict[str, Any]:
    """CPU, cores and bytes that this process may use, and the load of the machine."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        match = re.search(r"^model name\s*:\s*(.+)$", info.read_text(), re.MULTILINE)
        cpu = match[1] if match else cpu
    cores, memory = machine()
    return {
        "cpu": cpu,
        "cores": cores,
        "memory_bytes": memory,
        "load_average_1_minute": os.getloadavg()[0],
        "system": platform.platform(),
    }


def versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: version_of(name) for name in PACKAGES}


def version_of(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"
