"""A folder for a processor: each can be taken away, and none drags another in."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from scenes import write_store

import blocksar

PACKAGE = Path(blocksar.__file__).parent
FOLDERS = {
    "chain": ("angular-division", "keystone-resampling", "high-order-phase"),
    "hierarchy": ("hierarchical-backprojection",),
    "exact": ("backprojection",),
}
# Hides a folder of processors, takes its lines out of the registry, and plans with all others.
APART = """
import importlib.abc, json, sys
folder, gone = sys.argv[1], json.loads(sys.argv[2])

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if f"{name}.".startswith(f"blocksar.processors.{folder}."):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Hidden())
import blocksar
from blocksar.processors import PROCESSORS
for name in gone:
    del PROCESSORS.own[name]
found = {}
for name in PROCESSORS.own:
    found[name] = blocksar.plan(sys.argv[3], processor=name, workers=0).plan.processor
from blocksar.graph import compiling
compiling.missing(compiling.LOOPS)
print(json.dumps(found))
"""
LARGEST = 100  # modules that the hierarchy, which is the smallest of the fast ones, may need


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_processors_folder_can_be_taken_away(folder: str, tmp_path: Path) -> None:
    store = write_store(tmp_path, pulses=64, steering=(50.0, 50.3), dwell=0.01, swath=[29900.0, 30100.0])
    command = [sys.executable, "-c", APART, folder, json.dumps(FOLDERS[folder]), str(store)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    assert set(found) == {"auto", *(name for names in FOLDERS.values() for name in names)} - {*FOLDERS[folder]}
    assert all(chosen == name for name, chosen in found.items() if name != "auto")


@cache
def imports_of(module: str) -> dict[str, bool]:
    """Modules of the package that a module imports, and whether it does so when it is loaded."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    later = {id(each) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) for each in ast.walk(node)}
    later |= {id(each) for node in tree.body if isinstance(node, ast.If) for each in ast.walk(node)}
    found: dict[str, bool] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE.name:
            for name in (f"{node.module}.{alias.name}" for alias in node.names):
                own = name if is_module(name) else name.rpartition(".")[0]
                found[own] = found.get(own, False) or id(node) not in later
    return found


def is_module(name: str) -> bool:
    path = PACKAGE.joinpath(*name.split(".")[1:])
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def closure(*roots: str, loaded: bool = False) -> set[str]:
    """All that modules import, and what that imports; `loaded`: only what they import when they are loaded."""
    seen: set[str] = set()
    left = [*roots]
    while left:
        if (module := left.pop()) not in seen:
            seen.add(module)
            left += [name for name, at_once in imports_of(module).items() if at_once or not loaded]
    return seen


def modules_in(folder: str) -> Iterator[str]:
    for path in sorted((PACKAGE / "processors" / folder).rglob("*.py")):
        if path.name != "__init__.py":
            yield ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_processor_imports_another(folder: str) -> None:
    """Not even where a function or a type checker imports, nor by what the processors share."""
    others = tuple(f"blocksar.processors.{name}." for name in FOLDERS if name != folder)
    assert [module for module in sorted(closure(*modules_in(folder))) if f"{module}.".startswith(others)] == []


def test_the_hierarchy_is_small() -> None:
    """Its modules, the tasks that form an image with it, and all that is loaded with these."""
    found = closure(*modules_in("hierarchy"), "blocksar.tasks.stages", loaded=True)
    assert len(found) <= LARGEST, f"{len(found)}: {', '.join(sorted(found))}"


def test_readers_of_other_packages_import_by_the_former_name() -> None:
    names = "from blocksar.ingestion.readers import READERS as former; from blocksar.readers.registry import READERS"
    code = f"{names}; import blocksar.ingestion.kinds; assert former is READERS and blocksar.ingestion.kinds.Kind"
    subprocess.run([sys.executable, "-c", code], check=True)
