"""Compiled programs in files: used again, damaged, cut short, in folders that cannot hold them."""

import errno
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from processes import run_python
from runtimes import on_pocl

import lnocl
from lnocl.opencl import device, kernel_cache

SAID = "print(deconvolve())"


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """The file of one program: its name, its content, and the result of the run that made it."""
    folder = tmp_path_factory.mktemp("store")
    done = run_python(SAID, POCL_CACHE_DIR=str(folder))
    (file,) = folder.iterdir()
    return file.name, file.read_bytes(), done.stdout


@on_pocl
@pytest.mark.system
def test_programs_are_stored_and_used_again(warm, tmp_path):
    name, content, said = warm
    (tmp_path / name).write_bytes(content)
    code = (
        "from lnocl.opencl import program\nprint(deconvolve())\nprint(os.environ['POCL_CACHE_DIR'])"
    )
    done = run_python(code, POCL_CACHE_DIR=str(tmp_path))
    assert done.stdout == f"{said}{tmp_path}\n"
    assert not done.stderr
    (file,) = tmp_path.iterdir()
    assert file.read_bytes() == content


def middle(content):
    """Return the content with some bytes changed in a compiled kernel."""
    at = content.index(b"\x7fELF") + 2000
    return content[:at] + bytes(64) + b"\xff" * 64 + content[at + 128 :]


DAMAGES = {
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "garbage": lambda content: np.random.default_rng(1).bytes(9999),
    "changed": middle,
}


@on_pocl
@pytest.mark.system
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_programs_are_compiled_anew(warm, tmp_path, damage):
    name, content, said = warm
    (tmp_path / name).write_bytes(DAMAGES[damage](content))
    done = run_python(SAID, POCL_CACHE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout == said
    assert (
        f"the compiled kernels in {tmp_path / name} are damaged, and are compiled anew"
        in done.stderr
    )
    assert kernel_cache.read(tmp_path / name) is not None


def test_a_disk_that_is_full_cuts_no_kernel_short(tmp_path, monkeypatch):
    """PoCL would load what there is of it, and kill the process."""
    own = tmp_path / "own"
    (own / "aa/first/k").mkdir(parents=True)
    (own / "aa/first/k/k.so").write_bytes(b"compiled")
    (own / "aa/first/program.bc").write_bytes(b"code")
    monkeypatch.setattr(kernel_cache, "_own", [SimpleNamespace(path=own)])
    content = kernel_cache.pack(kernel_cache.folders())
    shutil.rmtree(own / "aa")

    def copy(source, target):
        target.write(source.read(3))
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("shutil.copyfileobj", copy)
        kernel_cache.unpack(content)
    assert not [path for path in own.rglob("*") if path.is_file()]
    assert kernel_cache.unpack(content) == {"aa/first"}
    assert (own / "aa/first/k/k.so").read_bytes() == b"compiled"
    assert kernel_cache.pack(kernel_cache.folders()) == content


@pytest.mark.filterwarnings("ignore:the compiled kernels in")
def test_of_a_damaged_file_nothing_is_used(tmp_path):
    rng = np.random.default_rng(1)
    binary, file = rng.bytes(5000), tmp_path / "program.bin"
    kernel_cache.write(file, binary)
    content = file.read_bytes()
    assert kernel_cache.read(file) == binary
    for at in (*range(40), *rng.integers(0, len(content), 100)):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        assert kernel_cache.read(file) is None
        assert not file.exists()


def test_a_disk_that_is_full_leaves_no_part_of_a_file(tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", no_room)
    kernel_cache.write(tmp_path / "program.bin", b"binary")
    assert not list(tmp_path.iterdir())


@on_pocl
@pytest.mark.system
def test_a_folder_that_cannot_hold_programs_is_said_once(tmp_path):
    (tmp_path / "file").touch()
    code = "print(deconvolve(), deconvolve())"
    done = run_python(code, POCL_CACHE_DIR=str(tmp_path / "file" / "folder"))
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("LnoclWarning") == 1
    assert "(Not a directory), and every process compiles them anew; set POCL" in done.stderr


def test_no_folder_for_kernels_at_all(monkeypatch):
    monkeypatch.setattr(kernel_cache, "_own", [])
    monkeypatch.setattr("tempfile.tempdir", "/nonexistent")
    with pytest.raises(lnocl.DeviceError, match=r"no folder for kernels .* set TMPDIR"):
        device.find_devices()


@on_pocl
@pytest.mark.system
def test_caches_of_pyopencl_are_left_alone(tmp_path, warm):
    """They may be broken: here there is a file in the place of their folder."""
    name, content, said = warm
    (tmp_path / name).write_bytes(content)
    cache = tmp_path / "cache"
    cache.touch()
    done = run_python(SAID, POCL_CACHE_DIR=str(tmp_path), XDG_CACHE_HOME=str(cache))
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")
