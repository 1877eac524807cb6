"""Install, editable install, sdist and wheel carry the kernels, and the sdist its tests."""

import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
KERNELS = {path.name for path in (ROOT / "kernels").glob("*.cl")}


def run(*command, **keywords):
    done = subprocess.run(command, capture_output=True, text=True, check=False, **keywords)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def tracked(*folders):
    """Return the names of the files that git tracks or would track, of all or of some folders."""
    command = [
        "git",
        "ls-files",
        "-z",
        "--cached",
        "--others",
        "--exclude-standard",
        "--",
        *folders,
    ]
    return [name for name in run(*command, cwd=ROOT).split("\0") if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The sdist and the wheel, built from what git tracks, the wheel from the sdist."""
    folder = tmp_path_factory.mktemp("build")
    for name in tracked():
        target = folder / "source" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((ROOT / name).read_bytes())
    (folder / "source" / "docs" / "gallery").mkdir()
    (folder / "source" / "docs" / "gallery" / "built.md").touch()
    run(sys.executable, "-m", "build", "--outdir", folder, folder / "source")
    return folder


@pytest.fixture(scope="module")
def unpacked(built, tmp_path_factory):
    """The files of the sdist."""
    folder = tmp_path_factory.mktemp("sdist")
    (sdist,) = built.glob("*.tar.gz")
    filtered = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # not before 3.11.4
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, **filtered)
    (root,) = folder.iterdir()
    return root


def metadata(built):
    """Return the metadata of the wheel."""
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Metadata.from_email(archive.read(name), validate=False)


def environment(folder, *target, within=()):
    """Make an environment with lnocl that borrows the dependencies of this one."""
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", f"--python={python}"]
    run(*within, *pip, "install", "--quiet", "--no-deps", *target)
    site = folder / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    borrowed = [path for path in sys.path if "site-packages" in path]
    (site / "borrowed.pth").write_text("\n".join(borrowed))
    return python, site


def is_for_show(name):
    """Return whether only the pages need a file, which is left out of the sdist."""
    return re.match(r"benchmarks/results/|docs/.*\.(png|html)$", name)


def test_the_sdist_has_every_file_but_pictures(unpacked):
    files = {str(path.relative_to(unpacked)) for path in unpacked.rglob("*") if path.is_file()}
    wanted = {name for name in tracked() if not is_for_show(name)} - {".gitignore"}
    made = {name for name in files if name == "PKG-INFO" or name.startswith("lnocl.egg-info/")}
    assert files - made == wanted


def test_links_of_the_sdist_resolve(unpacked):
    links = [
        (page, link)
        for page in unpacked.rglob("*.md")
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text())
        if "://" not in link
        if not is_for_show(os.path.relpath(page.parent / link, unpacked))
    ]
    assert len(links) > 10
    assert [link for page, link in links if not (page.parent / link).exists()] == []


def test_the_tests_of_the_sdist_run(unpacked, tmp_path):
    python, _ = environment(tmp_path, "--editable", unpacked)
    told = run(
        python, "-m", "pytest", "-q", "tests/test_metrics.py", "tests/test_figures.py", cwd=unpacked
    )
    assert re.search(r"\d+ passed", told)


def test_wheel(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in names if "kernels/" in name} == {f"lnocl/kernels/{k}" for k in KERNELS}
    assert "lnocl/py.typed" in names


def test_the_page_of_an_index_has_no_link_to_a_file_of_the_repository(built):
    description = metadata(built).description
    assert "lnocl reconstructs faint structure" in description
    assert re.findall(r"\]\((?!https?:)", description) == []


# A folder is seen as one that cannot be written to, by root too.
READ_ONLY = "unshare", "--map-root-user", "--mount", "sh", "-c"
BIND = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && ! touch "$0/new" && exec "$@"'


@pytest.mark.parametrize("kind", ["wheel", "editable", "clone", "clone, editable"])
def test_installed(built, kind, tmp_path):
    """A fresh environment, which borrows the dependencies of this one, has kernels and types.

    The clone cannot be written to.
    """
    source, within = built / "source", ()
    target = [*built.glob("*.whl")] if kind == "wheel" else [source]
    if "editable" in kind:
        target = ["--editable", source]
    if "clone" in kind:
        within = *READ_ONLY, BIND, source
        if subprocess.run([*within, "true"], capture_output=True).returncode:
            pytest.skip("no folder can be made one that cannot be written to")
    python, site = environment(tmp_path, *target, within=within)
    code = (
        "import lnocl, lnocl.commands.cli\n"
        "from lnocl.core.opencl import sources\n"
        "print(lnocl.__file__, *(file.name for file in sources.folder().iterdir()))"
    )
    found, *files = run(python, "-I", "-c", code, cwd=tmp_path).split()
    assert found.startswith(str(source if "editable" in kind else site))
    assert set(files) >= KERNELS
    if kind in ("wheel", "editable"):
        pytest.importorskip("mypy")
        (tmp_path / "user.py").write_text(
            "import lnocl\n"
            "reveal_type(lnocl.deconvolve)\n"
            "given = lnocl.Observation([], [])\n"
            "lnocl.deconvolve(given, solver='other')  # type: ignore[arg-type]\n"
        )
        mypy = [sys.executable, "-m", "mypy", "--python-executable", python]
        mypy += ["--warn-unused-ignores", "user.py"]
        assert "observation: lnocl.core.scene.observation.Observation" in run(*mypy, cwd=tmp_path)


@pytest.mark.parametrize(
    ("system", "machine", "pocl"),
    [
        ("linux", "x86_64", True),
        ("linux", "aarch64", False),
        ("darwin", "arm64", False),
        ("win32", "AMD64", False),
    ],
)
def test_pocl_is_required_where_its_wheel_exists(built, system, machine, pocl):
    required = metadata(built).requires_dist
    place = {"sys_platform": system, "platform_machine": machine, "extra": ""}
    extras = [
        one.extras
        for one in required
        if one.name == "pyopencl" and (one.marker is None or one.marker.evaluate(place))
    ]
    assert extras == ([set(), {"pocl"}] if pocl else [set()])


def test_the_citation_has_the_version():
    version = re.search(r"^version = (\S+)$", (ROOT / "setup.cfg").read_text(), re.M)[1]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    headings = re.findall(r"^## \[?([^]\n]+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert headings[0] == "Unreleased" or headings[0].startswith(version)


def test_addresses_are_of_one_repository(built):
    url = re.search(r"^url = (\S+)$", (ROOT / "setup.cfg").read_text(), re.M)[1]
    assert f"\nrepository-code: {url}\n" in (ROOT / "CITATION.cff").read_text()
    recipe = (ROOT / "docs/developing/recipe.yaml").read_text()
    assert f"  repository: {url}\n" in recipe
    urls = metadata(built).project_urls
    assert set(urls) == {"Documentation", "Changelog", "Issues"}
    assert all(address.startswith(f"{url}/") for address in urls.values())


def test_conda_forge_recipe_has_the_requirements_of_the_wheel(built):
    recipe = (ROOT / "docs/developing/recipe.yaml").read_text()
    block = re.search(r"^  run:\n((?:    .*\n)+)", recipe, re.M)[1]
    required = {str(one) for one in metadata(built).requires_dist if one.marker is None}
    assert f"python {metadata(built).requires_python}" in block.replace("${{ python_min }}", "3.11")
    listed = set(re.findall(r"- (\S+) (>=\S+)", block)) - {("python", ">=${{")}
    assert {name + least for name, least in listed} == required


def test_no_advice_names_a_package_that_no_index_has():
    names = tracked("*.py", "*.md", "*.sh", "*.ipynb", ".ci")
    texts = {name: (ROOT / name).read_text() for name in names}
    advice = re.compile(r"pip install [^\n&]*\blnocl\b")
    assert [name for name, text in texts.items() if advice.search(text)] == []
