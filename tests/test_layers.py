"""The rooms of the package, from the ground up: an import goes down or stays in its room."""

import ast
from pathlib import Path

import pytest

import lnocl

# Each room may import those above it in this list, never one of its own line or below.
FLOORS = [
    {"errors", "process", "notebook", "loading"},
    {"parallel"},
    {"scene"},
    {"matched_filter"},
    {"metrics", "residuals", "detection", "psf", "io", "reference", "solvers", "opencl"},
    {"simulation", "plotting"},
    {"engines"},
    {"runs"},
    {"result"},
    {"deconvolution"},
    {"tiles"},
    {"__init__"},
    {"verify", "studies"},
    {"commands"},
    {"__main__"},
]
KNOWS_OPENCL = {"opencl", "verify", "engines.opencl"}
PACKAGE = Path(lnocl.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.glob("**/*.py")
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


def imports(module):
    """Return the dotted names that a module imports, import_module calls included."""
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            yield node.args[0].value


@pytest.mark.parametrize("module", MODULES)
def test_nothing_is_checked_by_assert(module):
    """Which python -O leaves out."""
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text())
    assert not [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Assert)]


def room_of(name):
    """Return the room of a dotted name: what the package itself holds is in ``__init__``."""
    room = name.removeprefix("lnocl.").split(".")[0]
    return room if room in FLOOR else "__init__"


def test_every_room_has_its_floor():
    assert {module.split(".")[0] for module in MODULES} == set(FLOOR) - {"kernels"}


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_down_or_stay_in_their_room(module):
    own = module.split(".")[0]
    used = {room_of(name) for name in imports(module) if name.split(".")[0] == "lnocl"} - {own}
    assert not {room for room in used if FLOOR[room] >= FLOOR[own]}


@pytest.mark.parametrize("module", MODULES)
def test_only_the_opencl_rooms_know_pyopencl(module):
    knows = any(name.split(".")[0] == "pyopencl" for name in imports(module))
    assert not knows or module in KNOWS_OPENCL or module.split(".")[0] in KNOWS_OPENCL
