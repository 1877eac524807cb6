"""The rooms of the package, from the ground up: an import goes down or stays in its room."""

import ast
import re
from pathlib import Path

import lnocl

# Each room may import those above it in this list, never one of its own line or below.
FLOORS = [
    {"errors", "process", "notebook", "loading"},
    {"progress"},
    {"parallel"},
    {"scene"},
    {"metrics", "residuals", "io", "reference", "solvers", "opencl"},
    {"detection"},
    {"psf"},
    {"simulation", "plotting"},
    {"engines"},
    {"runs"},
    {"significance", "checkpoint", "tiling"},
    {"result"},
    {"reconstruction"},
    {"deconvolution"},
    {"tiles"},
    {"__init__"},
    {"studies"},
    {"commands"},
    {"__main__"},
]
KNOWS_OPENCL = "core.opencl.", "core.engines.opencl."
PACKAGE = Path(lnocl.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.glob("**/*.py")
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


def tree_of(module):
    return ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text())


def imports(module):
    """Return the dotted names that a module imports, import_module calls included."""
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            yield node.args[0].value


def room_of(name):
    """Return the room of a dotted name: what the package itself holds is in ``__init__``."""
    room = name.removeprefix("lnocl.").removeprefix("core.").split(".")[0]
    return room if room in FLOOR else "__init__"


def test_nothing_is_checked_by_assert():
    """Which python -O leaves out."""
    nodes = ((module, node) for module in MODULES for node in ast.walk(tree_of(module)))
    assert not [f"{m}:{node.lineno}" for m, node in nodes if isinstance(node, ast.Assert)]


def test_every_room_has_its_floor():
    rooms = {room_of(module) for module in MODULES if module != "core.__init__"}
    assert rooms == set(FLOOR) - {"kernels"}


def test_imports_go_down_or_stay_in_their_room():
    wrong = [
        f"{module} imports {name}"
        for module in MODULES
        for name in imports(module)
        if name.split(".")[0] == "lnocl" and room_of(name) != (own := room_of(module))
        if FLOOR[room_of(name)] >= FLOOR[own]
    ]
    assert not wrong


def test_only_the_opencl_rooms_know_pyopencl():
    knows = {m for m in MODULES if any(name.split(".")[0] == "pyopencl" for name in imports(m))}
    assert not [m for m in knows if not f"{m}.".startswith(KNOWS_OPENCL)]


def test_only_cameras_and_kernels_see_the_sky_through_a_response():
    """So a term of what images see of the sky is added in one place on the host."""
    response = re.compile(r"\.(psf|psf_cutout)\((self\._)?j|rotations\[|\.undone\(|_phases\(\)")
    sees = {
        m for m in MODULES if response.search((PACKAGE / f"{m.replace('.', '/')}.py").read_text())
    }
    of_kernels = {m for m in sees if room_of(m) in ("engines", "opencl")}
    assert sees - of_kernels == {f"core.scene.{each}" for each in ("camera", "rotation", "scene")}
