"""The layers of the package, stated once; every import is held to them."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from scenes import write_store

import blocksar

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "blocksar"

# ---------------------------------------------------------------- the layers

# From the ground up. A room is a folder or a module right under blocksar/; it imports from lower layers only, and from
# no other room of its own layer.
LAYERS = (
    {"errors", "constants", "budget", "garbage", "loop_cache", "version"},
    {"texts"},
    {"places", "progress", "arrays", "solvers", "chunks", "options", "plugins", "spans", "table"},
    {"kernels"},
    {"collection"},
    {"stores", "measurement", "imaging"},
    {"readers", "runs", "planning", "inspection", "autofocusing"},
    {"simulation", "graph", "products", "ingestion"},
    {"tasks"},
    {"processors"},
    {"application"},
    {"api"},
    {"cli", "accessor", "__init__"},
    {"__main__"},
)

# Where a library may be imported; None: everywhere. A library that is not listed is not used.
HOMES: dict[str, set[str] | None] = {
    "numpy": None,
    "scipy": None,
    "numba": {"autofocusing", "kernels", "imaging", "inspection", "processors", "simulation"},
    "llvmlite": {"kernels"},
    "finufft": {"kernels", "simulation"},
    "pydantic": {"runs", "simulation"},
    "zarr": {"places", "stores"},
    "numcodecs": {"stores"},
    "obstore": {"places"},
    "psutil": {"places"},
    "xxhash": {"stores"},
    "xarray": {"stores", "products", "api", "application", "readers"},
    "dask": {"graph"},
    "distributed": {"graph", "processors", "api", "application"},  # processors: of workers; api, application: types
    "typer": {"cli"},
    "rich": {"cli", "progress"},
    "matplotlib": {"products", "processors", "application"},  # processors, application: types
    "jinja2": {"products"},
    "rasterio": {"products", "readers"},
    "shapely": {"products"},
    "sarkit": {"readers", "products"},
    "lxml": {"simulation", "products"},
    "h5py": {"readers"},
    "pyproj": {"collection", "products", "readers"},  # products: types
}

# Folders and modules of arrays, numbers and frozen objects only: no files, no logging, no graphs.
PURE = (
    "autofocusing/", "collection/", "imaging/", "inspection/", "kernels/", "measurement/", "planning/",
    "processors/chain/dwells/", "processors/chain/ground/", "processors/chain/planning/", "processors/chain/steps/",
    "processors/exact/", "processors/hierarchy/", "solvers.py",
)  # fmt: skip
IMPURE_LIBRARIES = {"io", "json", "logging", "os", "pathlib", "shutil", "tempfile"}

# scipy.fft outside kernels/fourier.py, where a comment beside the import gives the reason. numpy.fft: nowhere.
OWN_TRANSFORMS = {"simulation/scatterers.py"}

# Libraries that `import blocksar` and `blocksar --help` must not load.
HEAVY = ("dask", "distributed", "finufft", "importlib.metadata", "matplotlib", "numba", "scipy", "xarray", "zarr")

# ---------------------------------------------------------------- reading the modules

MODULES = sorted(PACKAGE.rglob("*.py"))
LAYER = {room: number for number, rooms in enumerate(LAYERS) for room in rooms}
EVERY = pytest.mark.parametrize("room", sorted(LAYER))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules_of(room: str) -> list[Path]:
    return [path for path in MODULES if room_of(path) == room]


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file's syntax tree, which several tests look at."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))))


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Every dotted name that a file imports, also inside functions and under TYPE_CHECKING, with its line."""
    package = list(path.relative_to(ROOT).parts[:-1])
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *filter(None, [node.module])])
            yield from ((f"{origin}.{alias.name}", node.lineno) for alias in node.names)


def imports_of(room: str) -> Iterator[tuple[Path, str, int]]:
    yield from ((path, name, line) for path in modules_of(room) for name, line in imports(path))


def line_in(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


# ---------------------------------------------------------------- tests


def test_every_room_has_a_layer() -> None:
    assert {room_of(path) for path in MODULES} == set(LAYER)


@EVERY
def test_imports_point_to_lower_layers(room: str) -> None:
    wrong = []
    for path, name, line in imports_of(room):
        parts = name.split(".")
        if parts[0] == PACKAGE.name:
            target = parts[1] if parts[1:] and parts[1] in LAYER else "__init__"
            if target != room and LAYER[target] >= LAYER[room]:
                wrong.append(f"{line_in(path, line)}: {room} (layer {LAYER[room] + 1}) imports {target}")
    assert not wrong, "\n".join(wrong)


def test_modules_form_no_circle() -> None:
    names = {name_of(path) for path in MODULES}
    arrows = {}
    for path in MODULES:
        found = {name if name in names else name.rpartition(".")[0] for name, _ in imports(path)}
        arrows[name_of(path)] = found & names - {name_of(path)}
    assert set(TopologicalSorter(arrows).static_order()) == names


@EVERY
def test_libraries_stay_at_home(room: str) -> None:
    wrong = []
    for path, name, line in imports_of(room):
        library = name.split(".")[0]
        if library == PACKAGE.name or library in sys.stdlib_module_names:
            pure = path.relative_to(PACKAGE).as_posix().startswith(PURE)
            allowed = not pure or library not in IMPURE_LIBRARIES
        else:
            home = HOMES.get(library, set())
            allowed = home is None or room in home
        if not allowed:
            wrong.append(f"{line_in(path, line)}: {room} may not import {library}")
    assert not wrong, "\n".join(wrong)


def test_every_library_is_used_and_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    extras = [name for extra in optional if extra != "test" for name in optional[extra]]
    declared = " ".join([*project["dependencies"], *extras])
    assert not [name for name in HOMES if name not in declared]
    used = {(name.split(".")[0], room_of(path)) for path in MODULES for name, _ in imports(path)}
    unused = [
        (library, room) for library, rooms in HOMES.items() for room in rooms or () if (library, room) not in used
    ]
    assert not unused


@EVERY
def test_one_home_for_the_fourier_transform(room: str) -> None:
    wrong = []
    for path in modules_of(room):
        place, lines = path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8").splitlines()
        for name, line in imports(path):
            if name.split(".")[:2] in (["numpy", "fft"], ["scipy", "fft"], ["scipy", "fftpack"]):
                reason = "#" in lines[line - 1] or lines[line - 2].lstrip().startswith("#")
                home = place == "kernels/fourier.py" or (place in OWN_TRANSFORMS and reason)
                if not (home and name.startswith("scipy.fft")):
                    wrong.append(f"{line_in(path, line)}: import {name}")
        for node in nodes_of(path):
            if isinstance(node, ast.Attribute) and node.attr == "fft" and ast.unparse(node) in ("np.fft", "numpy.fft"):
                wrong.append(f"{line_in(path, node.lineno)}: {ast.unparse(node)}")
    assert not wrong, "call blocksar.kernels.fourier instead:\n" + "\n".join(wrong)


def loaded(*steps: tuple[str, tuple[str, ...]]) -> list[list[str]]:
    """Which libraries a process has loaded after each of its statements."""
    code = "import sys\n" + "".join(
        f"{statement}\nprint(*(name for name in {names!r} if name in sys.modules))\n" for statement, names in steps
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return [line.split() for line in run.stdout.splitlines()]


def test_imports_and_a_plan_are_light() -> None:
    numbers = ("dask", "distributed", "scipy.fft", "scipy.special")
    plan = "import blocksar; blocksar.plan('table1', blocks=3)"
    assert loaded(("import blocksar", HEAVY), ("import blocksar.cli", HEAVY), (plan, numbers)) == [[], [], []]


@pytest.mark.slow
def test_focus_loads_only_what_it_uses(tmp_path: Path) -> None:
    """A run waits for its libraries before it plans, and does without zarr on a store of ours.

    Nor has the process zarr that workers are forked from; here the main process does their work.
    """
    slow = ("pydantic", "scipy.ndimage", "scipy.special", "matplotlib", "xarray", "rasterio", "zarr")
    target = '[[targets]]\nname = "T"\nrange = 30000.0\nyaw_deg = 50.15\n'
    store = write_store(tmp_path, pulses=64, steering=(50.0, 50.3), dwell=0.01, swath=[29900.0, 30100.0], more=target)
    focus = f"blocksar.api.focusing.focus({str(store)!r}, {str(tmp_path / 'run')!r}, blocks=1, workers=0)"
    assert loaded(
        ("import blocksar.api.focusing", (*slow, "blocksar.autofocusing")),
        (f"import blocksar.processors.worker; {focus}", ("xarray", "zarr")),
    ) == [[], []]


def test_no_room_is_named_as_a_public_function() -> None:
    # Importing it would hide the function; of `collection` the package sees to it that it does not.
    assert set(blocksar.__all__) & set(LAYER) == {"collection"}
    assert importlib.import_module("blocksar.collection.grid") and inspect.isfunction(blocksar.collection)


def functions_of(path: Path) -> Iterator[tuple[ast.FunctionDef, int, bool]]:
    """Functions with the lines of their bodies, docstrings excluded, and whether a comment says why they are long."""
    lines = path.read_text(encoding="utf-8").splitlines()
    for node in nodes_of(path):
        if isinstance(node, ast.FunctionDef):
            documented = ast.get_docstring(node) is not None
            first = node.body[0].end_lineno or 0 if documented else node.body[0].lineno - 1
            excused = any("# longer than most: " in line for line in lines[node.lineno - 1 : node.body[0].lineno])
            yield node, (node.end_lineno or 0) - first, excused


def test_modules_and_functions_stay_small() -> None:
    sizes, wrong = [], []
    for path in [*MODULES, *sorted((ROOT / "workflows").rglob("*.py")), *sorted((ROOT / "deploy").rglob("*.py"))]:
        if (length := len(path.read_text(encoding="utf-8").splitlines())) > 800:
            wrong.append(f"{path.relative_to(ROOT)} has {length} lines; split it where it has two subjects")
        for function, size, excused in functions_of(path):
            sizes.append(size)
            if size > 60 and not excused:
                wrong.append(f"{line_in(path, function.lineno)}: {function.name} has {size} lines")
    assert not wrong, "\n".join(wrong)
    assert sorted(sizes)[len(sizes) // 2] < 12


@pytest.mark.slow
def test_tests_use_public_names_and_no_other_tests() -> None:
    wrong = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        nodes = nodes_of(path)
        modules = {
            alias.asname or alias.name.split(".")[-1]
            for node in nodes
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name)
            for alias in node.names
        }
        for node in nodes:
            private = isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__")
            if private and isinstance(node.value, ast.Name) and node.value.id in modules:
                wrong.append(f"{line_in(path, node.lineno)}: {ast.unparse(node)}")
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0].startswith("test_"):
                wrong.append(f"{line_in(path, node.lineno)}: imports the test {node.module}")
            if isinstance(node, ast.ImportFrom) and any(alias.name.startswith("_") for alias in node.names):
                names = [alias.name for alias in node.names if alias.name != "__version__"]
                wrong += [f"{line_in(path, node.lineno)}: imports {name}" for name in names if name.startswith("_")]
    assert not wrong, "\n".join(wrong)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'defocus'"):
        _ = blocksar.defocus


def test_the_package_carries_its_data() -> None:
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "simulation" / "scenes" / "table1.toml").is_file()
    assert all(
        (PACKAGE / "products" / "page" / "templates" / f"report.{kind}").is_file() for kind in ("html", "css", "js")
    )


def test_the_project_stands_on_its_own() -> None:
    # Put together here, so that this file does not hold the words it looks for.
    outside = {"/" + "work/": [], "../" + "shared": [".ci/run"], "/tmp/" + "venv": []}
    files = [path for path in ROOT.iterdir() if path.is_file() and path.name != ".git"]  # a file in a worktree
    for folder in (".ci", "blocksar", "deploy", "tests", "workflows"):
        files += [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    wrong = []
    for path in files:
        text = path.read_bytes().decode("utf-8", errors="replace")
        place = path.relative_to(ROOT).as_posix()
        wrong += [
            f"{place} mentions {word}" for word, allowed in outside.items() if word in text and place not in allowed
        ]
    assert not wrong, "\n".join(wrong)
