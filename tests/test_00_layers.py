"""Imports run one way. The tables below are the architecture; the tests parse every module and hold it to them."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import blocksar

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "blocksar"

# ---------------------------------------------------------------- the tables

GROUND = {"parameters", "fourier", "geometry"}
KERNELS = GROUND | {"lanes", "phase", "rows", "lines"}
STEPS = {"range_steps", "azimuth_steps"}
MEASURES = {"recovery", "ground", "backprojection", "measurement"}
PLANS = {"fitting", "closed_form", "region", "recovery_plan", "chains", "binding", "planning", "choice"}
FILES = {"places", "stores", "runs"}
BELOW_GRAPH = KERNELS | STEPS | MEASURES | {"method", "steps", "inspection"} | PLANS | FILES | {"cluster", "progress"}
INGEST = {"resampling", "cphd", "matfile", "gotcha"}
BELOW_API = BELOW_GRAPH | INGEST | {"graph", "effort", "scene", "simulation", "cphd_simulation", "plotting"}
PRODUCTS = {"products", "sicd", "geotiff", "quicklook", "accessor", "facts", "picture", "page"}

ARROWS: dict[str, set[str]] = {
    "parameters": set(),
    "method": {"parameters"},
    "fourier": {"parameters"},
    "geometry": {"parameters"},
    "scene": {"parameters", "geometry"},
    "lanes": set(),
    "phase": {"parameters", "fourier", "lanes"},
    "rows": {"parameters", "fourier", "phase"},
    "lines": {"parameters", "geometry"},
    "fitting": {"parameters", "geometry", "lines"},
    "closed_form": {"parameters", "geometry", "lines", "method", "fitting"},
    "steps": KERNELS,
    **dict.fromkeys(STEPS, KERNELS | {"steps"}),
    **dict.fromkeys(MEASURES, KERNELS),
    "inspection": KERNELS | {"recovery"},
    "places": {"parameters"},
    "stores": {"parameters", "places"},
    "runs": {"parameters", "places", "stores"},
    "simulation": GROUND | {"phase", "recovery", "scene", "places", "stores"},
    "georeference": {"parameters"},
    "resampling": {"parameters"},
    "matfile": {"parameters"},
    "foreign": {"parameters", "places"},
    "gotcha": {"parameters", "foreign", "geometry", "matfile", "resampling", "places", "stores"},
    "products": {"parameters", "geometry", "georeference", "places", "stores"},
    "sicd": {"parameters", "geometry", "georeference", "places", "products"},
    "geotiff": {"parameters", "georeference", "places", "products"},
    "quicklook": {"parameters", "places", "plotting", "products"},
    "accessor": {"parameters", "georeference", "measurement", "quicklook"},
    "facts": {"parameters", "measurement", "planning", "products"},
    "picture": {"parameters", "measurement", "plotting", "products", "facts"},
    "page": {"parameters", "measurement", "method", "planning", "plotting", "products", "facts", "picture"},
    "cphd": {"parameters", "foreign", "georeference", "resampling", "places", "stores"},
    "cphd_simulation": GROUND | {"georeference", "places", "stores", "scene", "simulation", "cphd"},
    "region": {"parameters", "geometry"},
    "recovery_plan": KERNELS | {"recovery", "region"},
    "chains": STEPS | {"method", "steps"},
    "binding": KERNELS | STEPS | {"method", "steps", "chains", "fitting"},
    "planning": KERNELS
    | STEPS
    | {"method", "steps", "binding", "fitting", "closed_form", "ground", "recovery", "region", "recovery_plan"},
    "choice": {"parameters", "method", "planning"},
    "progress": {"parameters"},
    "cluster": {"parameters", "ground", "progress"},
    "effort": {"geometry", "graph", "ground", "planning", "progress", "region", "stores"},
    "graph": BELOW_GRAPH,
    "plotting": {"parameters", "geometry", "measurement"},
    "api": BELOW_API | PRODUCTS | {"georeference"},
    "cli": BELOW_API | PRODUCTS | {"api"},
    "__main__": {"cli"},
    "__init__": {"api", "parameters"},  # loaded on first use
}

# Who may import a library; None: every module. What is not here is not used.
HOMES: dict[str, set[str] | None] = {
    "numpy": None,
    "scipy": None,
    "numba": None,
    "llvmlite": {"backprojection", "lanes"},
    "finufft": {"simulation"},
    "xxhash": {"stores"},
    "zarr": {"places", "stores"},
    "obstore": {"places"},
    "psutil": {"places"},
    "xarray": {"stores", "api", "accessor"},
    "dask": {"cluster"},
    "distributed": {"cluster", "graph", "api"},
    "typer": {"cli"},
    "rich": {"cli", "progress"},
    "matplotlib": {"plotting", "quicklook", "accessor", "picture"},
    "jinja2": {"page"},
    "bokeh": {"cluster"},  # only asked whether it is there
    "pydantic": {"scene"},
    "sarkit": {"cphd", "sicd"},
    "lxml": {"cphd_simulation", "sicd"},
    "shapely": {"sicd"},
    "pyproj": {"georeference", "geotiff"},  # the latter for its types
    "rasterio": {"geotiff"},
}

# Arrays in, arrays out: nothing here knows of files or logs.
PURE = KERNELS | STEPS | MEASURES | {"resampling", "steps", "inspection", "method", "fitting", "closed_form", "chains"}
IMPURE_LIBRARIES = {"io", "json", "logging", "os", "pathlib", "shutil", "tempfile"}

# scipy.fft outside fourier.py, where a comment beside the import says why. numpy.fft: nowhere else.
OWN_TRANSFORMS = {"simulation", "backprojection"}

# What `import blocksar` and `blocksar --help` must not wait for.
HEAVY = ("dask", "distributed", "finufft", "matplotlib", "numba", "scipy", "xarray", "zarr")

# ---------------------------------------------------------------- reading the modules


def modules() -> dict[str, list[Path]]:
    """Files by layer: a module, or a folder of modules, right under blocksar/."""
    found: dict[str, list[Path]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        found.setdefault(path.relative_to(PACKAGE).parts[0].removesuffix(".py"), []).append(path)
    return found


def imported(path: Path) -> Iterator[tuple[str, int]]:
    """Every absolute dotted name that a file imports, wherever in it, with the line."""
    package = [PACKAGE.name, *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *filter(None, [node.module])])
            yield from ((f"{origin}.{alias.name}", node.lineno) for alias in node.names)


MODULES = modules()
EVERY = pytest.mark.parametrize("module", sorted(MODULES))


def where(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


# ---------------------------------------------------------------- tests


def test_every_module_is_in_the_table() -> None:
    unknown = set(MODULES) - set(ARROWS)
    assert not unknown, f"say in ARROWS what {sorted(unknown)} may import"


def test_the_table_has_no_circle() -> None:
    below = {module: arrows for module, arrows in ARROWS.items() if module != "__init__"}
    assert set(TopologicalSorter(below).static_order()) == set(below)


@EVERY
def test_arrows(module: str) -> None:
    wrong = []
    for path in MODULES[module]:
        for name, line in imported(path):
            parts = name.split(".")
            if parts[0] != PACKAGE.name:
                continue
            target = parts[1] if len(parts) > 1 else "__init__"
            if target not in ARROWS[module] | {module, "__version__"}:
                wrong.append(f"{where(path, line)}: {module} -> {target}")
    assert not wrong, "\n".join(wrong)


@EVERY
def test_libraries_stay_at_home(module: str) -> None:
    wrong = []
    for path in MODULES[module]:
        for name, line in imported(path):
            top = name.split(".")[0]
            if top == PACKAGE.name or top in sys.stdlib_module_names:
                allowed = module not in PURE or top not in IMPURE_LIBRARIES
            else:
                home = HOMES.get(top, set())
                allowed = home is None or module in home
            if not allowed:
                wrong.append(f"{where(path, line)}: {module} may not import {top}")
    assert not wrong, "\n".join(wrong)


def test_every_library_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    extras = [name for extra in optional if extra != "test" for name in optional[extra]]
    declared = " ".join([*project["dependencies"], *extras])
    assert not [name for name in HOMES if name not in declared]


@EVERY
def test_one_home_for_the_fourier_transform(module: str) -> None:
    if module == "fourier":
        return
    wrong = []
    for path in MODULES[module]:
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        for name, line in imported(path):
            if name.split(".")[:2] in (["numpy", "fft"], ["scipy", "fft"], ["scipy", "fftpack"]):
                reason = "#" in lines[line - 1] or lines[line - 2].lstrip().startswith("#")
                if not (module in OWN_TRANSFORMS and name.startswith("scipy.fft") and reason):
                    wrong.append(f"{where(path, line)}: import {name}")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in ("np.fft", "numpy.fft"):
                wrong.append(f"{where(path, node.lineno)}: {ast.unparse(node)}")
    assert not wrong, "call blocksar.fourier instead:\n" + "\n".join(wrong)


@pytest.mark.parametrize("module", ["blocksar", "blocksar.cli"])
def test_the_import_is_light(module: str) -> None:
    code = f"import {module}, sys; print(*(name for name in {HEAVY!r} if name in sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.split() == []


def test_no_module_is_named_like_a_public_function() -> None:
    # Importing it would hide the function.
    assert not set(blocksar.__all__) & set(MODULES)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'defocus'"):
        _ = blocksar.defocus


def test_the_package_carries_its_data() -> None:
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "scenes" / "table1.toml").is_file()
    assert all((PACKAGE / "templates" / f"report.{kind}").is_file() for kind in ("html", "css", "js"))


def test_the_project_stands_on_its_own() -> None:
    # Put together here, so that this file does not hold the words it looks for.
    outside = {"/" + "work/": [], "../" + "shared": [".ci/run"], "/tmp/" + "venv": []}
    files = [path for path in ROOT.iterdir() if path.is_file()]
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
