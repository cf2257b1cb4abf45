"""What back-projection runs on, where there is no GPU."""

from __future__ import annotations

from typing import Any, cast

import pytest

import blocksar
from blocksar.application.arguments import gpu_workers
from blocksar.errors import InputError, ProcessingError
from blocksar.graph import cluster
from blocksar.kernels import device as devices
from blocksar.processors import PROCESSORS, device_for

GRID = "-50:50:1,11260:11360:1"


def test_chains_run_on_the_cpu() -> None:
    with pytest.raises(InputError, match="angular-division does not run on a GPU; give --processor hier"):
        device_for("angular-division", "gpu")
    assert device_for("angular-division", "auto") == "cpu"
    assert {name for name, part in PROCESSORS.sound() if part.on_gpu} == {
        "hierarchical-backprojection", "backprojection", "auto",
    }  # fmt: skip


def test_auto_takes_a_gpu_that_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for found in (True, False):
        monkeypatch.setattr(devices, "has_gpu", lambda found=found: found)
        assert device_for("backprojection", "auto") == ("gpu" if found else "cpu")
        assert device_for("backprojection", "gpu") == "gpu"  # of another machine, perhaps


def test_a_local_run_has_one_worker_unless_more_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    if not devices.has_gpu():
        with pytest.raises(InputError, match=r"which --device gpu needs; install blocksar\[gpu\]|no GPU is found"):
            gpu_workers(None)
    monkeypatch.setattr(devices, "device", lambda name: None)
    assert (gpu_workers(None), gpu_workers(0), gpu_workers(2)) == (1, 0, 2)


def test_a_cluster_says_which_workers_have_one(monkeypatch: pytest.MonkeyPatch) -> None:
    workers: dict[str, dict[str, Any]] = {"a": {"resources": {}}, "b": {}}
    monkeypatch.setattr(cluster, "workers_of", lambda client: workers)
    with pytest.raises(InputError, match="no worker of the cluster has a GPU; start one"):
        cluster.workers_with_gpu(cast(Any, None))
    workers["c"] = {"resources": {"GPU": 1.0}}
    assert cluster.workers_with_gpu(cast(Any, None)) == 1


@pytest.mark.parametrize("processor", ["backprojection", "hierarchical-backprojection", "auto"])
def test_a_plan_says_what_a_gpu_needs(processor: Any) -> None:
    report = blocksar.plan("paper_b", processor=processor, device="gpu", grid=GRID)
    assert any("iB of its GPU" in line for line in report.summary)


def test_too_little_memory_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = []
    gpu = type("Small", (devices.Cpu,), {"limit": lambda self, memory: limits.append(memory)})
    monkeypatch.setattr(devices, "device", lambda name: gpu())
    with pytest.raises(ProcessingError, match="the GPU has too little memory"), devices.on_device("gpu", 4):
        raise MemoryError("out of memory\nallocating 5 bytes")
    with pytest.raises(MemoryError), devices.on_device("cpu", 0):
        raise MemoryError
    assert limits == [4, 0]
