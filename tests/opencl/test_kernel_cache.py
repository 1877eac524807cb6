"""Compiled programs in files: used again, damaged, cut short, in folders that cannot hold them."""

import errno
import io
import os
import random
import shutil
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from processes import run_python
from runtimes import on_pocl

import lnocl
from lnocl.core.opencl import device, kernel_cache

SAID = "print(deconvolve())"


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """The file of the first program: its name and content, and the result of the run with it."""
    folder = tmp_path_factory.mktemp("store")
    done = run_python(SAID, POCL_CACHE_DIR=str(folder))
    (file,) = (each for each in folder.glob("*.kernels") if b"rfft_rows/" in each.read_bytes())
    return file.name, file.read_bytes(), done.stdout


@on_pocl
@pytest.mark.system
def test_programs_are_stored_and_used_again(warm, tmp_path):
    name, content, said = warm
    (tmp_path / name).write_bytes(content)
    code = (
        "from lnocl.core.opencl import program\n"
        "print(deconvolve())\nprint(os.environ['POCL_CACHE_DIR'])"
    )
    done = run_python(code, POCL_CACHE_DIR=str(tmp_path))
    assert done.stdout == f"{said}{tmp_path}\n"
    assert not done.stderr
    assert (tmp_path / name).read_bytes() == content


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
    assert f"{tmp_path / name} is damaged, and is not used" in done.stderr
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


@pytest.mark.filterwarnings("ignore:.* is damaged, and is not used")
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
def test_unusable_cache_folder_is_reported_once(tmp_path):
    (tmp_path / "file").touch()
    code = "print(deconvolve(), deconvolve())"
    done = run_python(code, POCL_CACHE_DIR=str(tmp_path / "file" / "folder"))
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("LnoclWarning") == 1
    assert "(Not a directory), and every process compiles them anew; set POCL" in done.stderr


def test_no_folder_for_kernels_at_all(monkeypatch):
    monkeypatch.setattr(kernel_cache, "_own", [])
    monkeypatch.setattr("tempfile.tempdir", "/dev/null/a")
    monkeypatch.setenv("POCL_CACHE_DIR", "/dev/null/b")
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


class TestStrangers:
    """Kernels are code: those that others may have written are not loaded."""

    @pytest.fixture
    def file(self, tmp_path):
        kernel_cache.write(tmp_path / "a.kernels", b"content")
        return tmp_path / "a.kernels"

    @pytest.mark.parametrize("mode", [0o620, 0o602, 0o666])
    def test_a_file_that_others_may_write_to_is_not(self, file, mode):
        file.chmod(mode)
        with pytest.warns(lnocl.LnoclWarning, match="can be written by others, and is not used"):
            assert kernel_cache.read(file) is None

    def test_a_file_of_another_user_is_not(self, file, monkeypatch):
        monkeypatch.setattr(os, "getuid", lambda: 12345)
        with pytest.warns(lnocl.LnoclWarning, match="can be written by others"):
            assert kernel_cache.read(file) is None

    def test_a_pipe_is_not_waited_for(self, tmp_path):
        os.mkfifo(tmp_path / "a.kernels")
        assert kernel_cache.read(tmp_path / "a.kernels") is None
        before = set(os.listdir("/dev/fd"))
        assert kernel_cache.read(tmp_path) is None
        assert set(os.listdir("/dev/fd")) == before

    def test_folders_and_files_are_their_owners_alone(self, tmp_path):
        before = os.umask(0)
        try:
            assert kernel_cache.can_write(tmp_path / "store")
            kernel_cache.write(tmp_path / "store" / "a.kernels", b"content")
        finally:
            os.umask(before)
        assert (tmp_path / "store").stat().st_mode & 0o777 == 0o700
        assert (tmp_path / "store" / "a.kernels").stat().st_mode & 0o777 == 0o600

    def test_invalid_archive_is_ignored(self):
        assert kernel_cache.unpack(b"PK\x03\x04 and nothing else") == set()


def test_the_store_does_not_grow_without_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "MAX_STORED", 3000)
    for age, name in enumerate("abcde"):
        kernel_cache.write(tmp_path / f"{name}.kernels", bytes(900))
        os.utime(tmp_path / f"{name}.kernels", (age, age))
        if name == "c":
            kernel_cache.read(tmp_path / "a.kernels")  # is used again
    assert {file.stem for file in tmp_path.iterdir()} == {"a", "d", "e"}


def test_a_file_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    file = tmp_path / "a.kernels"
    kernel_cache.write(file, bytes(200))
    assert kernel_cache.read(file) == bytes(200)
    monkeypatch.setattr(kernel_cache, "MAX_STORED", 100)
    with pytest.warns(lnocl.LnoclWarning, match="is damaged, and is not used"):
        assert kernel_cache.read(file) is None
    assert not file.exists()


@on_pocl
@pytest.mark.system
def test_a_library_that_was_cut_short_is_not_stored(warm):
    content = warm[1][kernel_cache.DIGEST_SIZE :]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        libraries = [archive.read(name) for name in archive.namelist() if name.endswith(".so")]
    assert libraries
    for library in libraries:
        assert kernel_cache._is_whole(library)
        assert not kernel_cache._is_whole(library[:-1])
        assert not kernel_cache._is_whole(library[: len(library) // 2])
    assert kernel_cache._is_whole(b"no library")


def test_without_a_home_nothing_is_stored(tmp_path, monkeypatch):
    """Nor is a folder called ~ made where the process is."""
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.warns(lnocl.LnoclWarning, match="cannot be stored in /dev/null/lnocl"):
        assert not kernel_cache.can_write(kernel_cache.store())
    assert not list(tmp_path.iterdir())


@on_pocl
def test_archives_that_are_not_sound_leave_nothing():
    """Though their checksum is right; the first is sound."""
    device.find_devices()  # which makes the private folder
    made, chance = io.BytesIO(), random.Random(1)
    with zipfile.ZipFile(made, "w") as archive:
        for name in "abc":
            archive.writestr(f"ZZ/crafted/{name}.so", bytes(50))
    own, n_unpacked = kernel_cache._own[0].path, 0
    for turn in range(300):
        content = bytearray(made.getvalue())
        for _ in range(min(turn, 3)):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        unpacked = kernel_cache.unpack(bytes(content))
        n_unpacked += bool(unpacked)
        assert unpacked or not list(own.glob("ZZ/*"))
        shutil.rmtree(own / "ZZ", ignore_errors=True)
    assert 1 < n_unpacked < 30
