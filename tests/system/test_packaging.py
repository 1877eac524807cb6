"""Install, editable install, sdist and wheel all carry the kernels."""

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
KERNELS = {path.name for path in (ROOT / "kernels").glob("*.cl")}


def run(*command, **keywords):
    done = subprocess.run(command, capture_output=True, text=True, check=False, **keywords)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The sdist and the wheel, built from what git tracks, the wheel from the sdist."""
    folder = tmp_path_factory.mktemp("build")
    files = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT)
    for name in filter(None, files.split("\0")):
        if (ROOT / name).is_file():
            target = folder / "source" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    run(sys.executable, "-m", "build", "--outdir", folder, folder / "source")
    return folder


def test_sdist(built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    assert {f"kernels/{name}" for name in KERNELS} <= names
    assert {"lnocl/py.typed", "LICENSE", "README.md"} <= names


def test_wheel(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"lnocl/kernels/{name}" for name in KERNELS} <= names
    assert "lnocl/py.typed" in names


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_installed(built, kind, tmp_path):
    """A fresh environment, which borrows the dependencies of this one, finds every kernel."""
    venv.create(tmp_path, with_pip=False, symlinks=True)
    python = tmp_path / "bin" / "python"
    site = tmp_path / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    target = [*built.glob("*.whl")] if kind == "wheel" else ["--editable", built / "source"]
    run(
        sys.executable,
        "-m",
        "pip",
        f"--python={python}",
        "install",
        "--quiet",
        "--no-deps",
        *target,
    )
    borrowed = os.pathsep.join(path for path in sys.path if "site-packages" in path)
    code = (
        f"import sys; sys.path += {borrowed.split(os.pathsep)!r}\n"
        "import lnocl, lnocl.commands.cli\n"
        "from importlib import resources\n"
        "print(lnocl.__file__, *(file.name for file in resources.files('lnocl.kernels').iterdir()))"
    )
    found, *files = run(python, "-I", "-c", code, cwd=tmp_path).split()
    assert found.startswith(str(site if kind == "wheel" else built / "source"))
    assert set(files) >= KERNELS
