"""Drivers that end the process as they compile: PoCL where it cannot link, and any other."""

import os
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from processes import run_python
from runtimes import on_pocl

import lnocl
from lnocl.core.opencl import device, kernel_cache, program, sources, trial

pytestmark = [on_pocl, pytest.mark.system]

TOLD = """
try:
    deconvolve()
except lnocl.DeviceError as error:
    print(error)
"""


@pytest.fixture
def without_linker(tmp_path, monkeypatch):
    """Return a function that gives PoCL a linker which says something and fails."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "store"))
    monkeypatch.setenv("COMPILER_PATH", str(tmp_path))

    def give(words):
        (tmp_path / "ld").write_text(f'#!/bin/sh\necho "{words}" >&2\nexit 1\n')
        (tmp_path / "ld").chmod(0o700)

    return give


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (
            "ld: cannot find -lgcc: No such file",
            "the linker lacks files of libgcc or libc",
        ),
        ("ld: crti.o: Too many open files", "too few files may be open: raise the limit (ulimit"),
        ("ld: x.so: No space left on device", "temporary files is full: set TMPDIR"),
        ("ld: weather", "ld: weather"),
    ],
)
def test_linker_failure_is_reported_in_one_line(without_linker, words, cause):
    without_linker(words)
    done = run_python(TOLD)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("PoCL cannot link kernels: ")
    assert cause in done.stdout
    assert done.stdout.count("\n") == 1


def test_the_linker_of_ziglang_is_taken(without_linker, tmp_path):
    """Here a package of that name, which runs the system's."""
    without_linker("there is none")
    (tmp_path / "site" / "ziglang").mkdir(parents=True)
    (tmp_path / "site" / "ziglang" / "__init__.py").touch()
    (tmp_path / "site" / "ziglang" / "__main__.py").write_text(
        "import subprocess, sys\n"
        "assert sys.argv[1:3] == ['ld.lld', '-shared']\n"
        "open('linked', 'a').write('*')\n"
        "sys.exit(subprocess.call(['/usr/bin/ld', *sys.argv[2:]]))\n"
    )
    path = os.pathsep.join([str(Path(lnocl.__file__).parents[1]), str(tmp_path / "site")])
    for _ in range(2):
        done = run_python("print(deconvolve())", cwd=tmp_path, PYTHONPATH=path)
        assert (done.returncode, done.stderr) == (0, "")
    assert float(done.stdout) > 0
    assert len((tmp_path / "linked").read_text()) > 5


def test_it_is_tried_once(tmp_path, monkeypatch):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    chosen = device.choose().device
    trial.check.__wrapped__(chosen)
    monkeypatch.setattr(trial, "_try", lambda *_: pytest.fail("tried again"))
    trial.check.__wrapped__(chosen)
    monkeypatch.setenv("PATH", "/elsewhere")
    with pytest.raises(pytest.fail.Exception, match="tried again"):
        trial.check.__wrapped__(chosen)


def test_an_interrupted_trial_leaves_nothing(monkeypatch):
    started, folders, genuine = [], [], kernel_cache.new_folder

    class Interrupted(subprocess.Popen):
        def __init__(self, *arguments, **options):
            started.append(self)
            super().__init__(*arguments, **options)
            signal.raise_signal(signal.SIGINT)

    def new_folder():
        folders.append(genuine())
        return folders[-1]

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    monkeypatch.setattr(kernel_cache, "new_folder", new_folder)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which may be ignored here
    try:
        with pytest.raises(KeyboardInterrupt):
            trial._try(device.choose().device, trial.KERNEL)
    finally:
        signal.signal(signal.SIGINT, before)
    assert [process.returncode for process in started] == [0]
    assert [os.path.exists(folder) for folder in folders] == [False]


def test_the_trial_runs_no_code_of_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("open('planted', 'w'); raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    assert trial._try(device.choose().device, trial.KERNEL) == ""
    assert not (tmp_path / "planted").exists()


def test_a_trial_that_ends_otherwise_says_nothing_of_the_linker(tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "KERNEL", "import no_such_module")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    trial.check.__wrapped__(device.choose().device)
    assert not list(tmp_path.iterdir())


def test_too_few_files_are_refused(tmp_path):
    done = run_python(
        "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))\n" + TOLD,
        POCL_CACHE_DIR=str(tmp_path),
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "too few files may be open: raise the limit (ulimit -n)" in done.stdout


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        ("import os; os._exit(8)", "exit status 8"),
        ("import os; os.abort()", "exit status -6"),
        ("import os; os.write(2, b'LLVM: 9'); os._exit(0)", "LLVM: 9"),
    ],
)
def test_a_driver_that_ends_the_process_is_named(ending, words, tmp_path, monkeypatch):
    """Each time, as there may be a newer driver; any other error is that of a run."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(trial, "POCL", "another")
    monkeypatch.setattr(trial, "KERNELS", ending)
    chosen = device.choose().device
    for _ in range(2):
        with pytest.raises(lnocl.DeviceError) as told:
            trial.check.__wrapped__(chosen)
        assert f"the driver of {device.describe(chosen)} ends the process" in str(told.value)
        assert words in str(told.value)
    monkeypatch.setattr(trial, "KERNELS", "raise ValueError")
    trial.check.__wrapped__(chosen)
    monkeypatch.setattr(trial, "_try", lambda *_: pytest.fail("tried again"))
    trial.check.__wrapped__(chosen)


def test_a_driver_is_tried_with_all_kernels(monkeypatch):
    tried, build = [], program._build

    def recorded(context, text, options):
        tried.extend(name for name, _ in sources.KERNEL.findall(text))
        return build(context, text, options)

    monkeypatch.setattr(trial, "check", trial.check)  # which the trial puts out of the way
    monkeypatch.setattr(program, "_build", recorded)
    context = device.context_of(device.choose().device)
    exec(trial.KERNELS, {"context": context, "cl": cl, "numpy": np})
    assert {*tried} == {name for name, _ in sources.KERNEL.findall(program.source())}


@pytest.mark.parametrize("lack", ["noexec", "space", "files"])
def test_kernels_go_where_they_can_be_run(lack, tmp_path, monkeypatch):
    """Else beside the store; else one line says what to set."""
    genuine, bad = os.statvfs, {tmp_path / "temporary"}
    (tmp_path / "temporary").mkdir()

    def statvfs(folder):
        found = genuine(folder)
        exec_flag = os.ST_NOEXEC if Path(folder) in bad and lack == "noexec" else 0
        free = 100 if Path(folder) in bad and lack == "space" else found.f_bavail
        files = 100 if Path(folder) in bad and lack == "files" else 10**6
        return SimpleNamespace(
            f_flag=exec_flag,
            f_bavail=free,
            f_frsize=found.f_frsize,
            f_files=10**7,
            f_favail=files,
        )

    monkeypatch.setattr(os, "statvfs", statvfs)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "store"))
    assert kernel_cache._Folder().path.parent == tmp_path / "store"
    bad.add(tmp_path / "store")
    with pytest.raises(lnocl.DeviceError, match="set TMPDIR to one with 16 MiB from which progr"):
        kernel_cache._Folder()
    bad.clear()
    assert kernel_cache._Folder().path.parent == tmp_path / "temporary"


def test_store_is_used_where_no_temporary_folder_is_usable(tmp_path, monkeypatch):
    """A path that is too long for SQLite, and no folder at all; the store is taken instead."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / ("x" * 400)))
    assert kernel_cache._Folder().path.parent == tmp_path

    def nowhere():
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", nowhere)
    assert kernel_cache._Folder().path.parent == tmp_path
