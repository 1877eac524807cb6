"""The layers of the package: which module may import which."""

import ast
from pathlib import Path

import pytest

import lnocl

SHARED = {"commands.arguments", "commands.messages"}
# Each module with those of lnocl that it may import; errors and process are open to all.
LAYERS = {
    "__init__": {"deconvolution", "observation"},
    "__main__": {"cli"},
    "cli": SHARED
    | {
        "commands.signals",
        "commands.bench",
        "commands.deconvolve",
        "commands.demo",
        "commands.devices",
        "commands.plot",
        "commands.psf",
        "commands.selftest",
        "commands.simulate",
    },
    "commands.__init__": set(),
    "commands.arguments": set(),
    "commands.messages": set(),
    "commands.signals": set(),
    "commands.checkpoints": {"commands.arguments", "commands.signals", "deconvolution"},
    "commands.bench": SHARED | {"bench", "device"},
    "commands.deconvolve": SHARED
    | {"atomic", "deconvolution", "device", "edges", "fitsread", "fitswrite", "frames", "metrics"}
    | {"commands.checkpoints", "observation", "sky"},
    "commands.demo": SHARED | {"demo", "device"},
    "commands.devices": SHARED | {"device"},
    "commands.plot": SHARED | {"demo"},
    "commands.psf": SHARED | {"atomic", "fitsread", "fitswrite", "plots", "psf"},
    "commands.selftest": SHARED | {"device", "selftest"},
    "commands.simulate": SHARED | {"atomic", "demo", "simulate"},
    "bench": {
        "atomic",
        "demo",
        "experiment",
        "frames",
        "observation",
        "plots",
        "simulate",
        "trade",
    },
    "selftest": {"deconvolution", "device", "observation", "rig", "simulate", "twins"},
    "twins": {"fft", "reference", "rig"},
    "rig": {"fft", "program", "scene"},
    "trade": {"deconvolution", "experiment", "metrics", "observation", "progress", "simulate"},
    "demo": {"atomic", "experiment", "fitsread", "fitswrite", "metrics", "plots", "simulate"},
    "experiment": {"deconvolution", "metrics", "observation", "simulate"},
    "deconvolution": {
        "checkpoint",
        "heldout",
        "observation",
        "penalty",
        "progress",
        "run",
        "solvers",
        "stopping",
    },
    "checkpoint": {"atomic", "fitsfile", "heldout", "observation", "penalty", "run", "stopping"},
    "progress": set(),
    "heldout": {"observation", "penalty", "run"},
    "stopping": {"model", "observation", "run"},
    "run": {
        "device",
        "model",
        "observation",
        "opencl",
        "penalty",
        "reference",
        "refine",
        "scaling",
        "scene",
        "solvers",
    },
    "refine": {"model", "observation", "placement", "scene"},
    "solvers": {"observation"},
    "scaling": {"model", "observation", "scene"},
    "model": {"observation", "scene"},
    "scene": {"edges", "observation", "penalty", "placement"},
    "penalty": set(),
    "edges": {"observation"},
    "placement": {"observation"},
    "observation": {"units"},
    "units": set(),
    "reference": {"observation", "scaling", "scene"},
    "opencl": {"device", "faults", "fft", "observation", "program", "scaling", "scene"},
    "fft": {"program"},
    "program": {"device", "faults", "kernelcache"},
    "device": {"faults", "kernelcache"},
    "faults": set(),
    "kernelcache": set(),
    "errors": set(),
    "process": set(),
    "frames": {"fitsread", "maps", "observation", "sky", "units"},
    "maps": {"fitsread", "observation"},
    "sky": {"fitsfile", "headers", "units"},
    "fitsread": {"fitsfile", "headers"},
    "fitsfile": set(),
    "headers": set(),
    "fitswrite": {"atomic"},
    "atomic": set(),
    "kernels.__init__": set(),
    "metrics": {"observation"},
    "plots": {"atomic", "metrics"},
    "centring": set(),
    "repair": set(),
    "resampling": set(),
    "psf": {"centring", "observation", "repair", "resampling"},
    "simulate": {"fitsread", "observation"},
}
KNOWS_OPENCL = {"opencl", "fft", "program", "device", "faults", "rig", "twins", "selftest"}
PACKAGE = Path(lnocl.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.glob("**/*.py")
)


def imports(module):
    """Return the dotted names that a module imports, import_module calls included."""
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            yield node.args[0].value


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_only_what_its_layer_may(module):
    own = {name.removeprefix("lnocl.") for name in imports(module) if name.startswith("lnocl.")}
    # Of lnocl.commands.demo.run the module is commands.demo.
    own |= {name.rpartition(".")[0] for name in own}
    assert own & set(MODULES) <= LAYERS[module] | {"errors", "process"}


@pytest.mark.parametrize("module", MODULES)
def test_only_the_opencl_layers_know_pyopencl(module):
    knows = any(name.split(".")[0] == "pyopencl" for name in imports(module))
    assert knows == (module in KNOWS_OPENCL)
