"""A device on trial: a driver that fails as it compiles may end the process without a word.

So a process of its own compiles kernels first, once for a driver and the kernels. PoCL aborts where
the linker fails, once for each environment: where the system has none, that of the package ziglang
is taken if it is installed.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from glob import glob
from pathlib import Path
from typing import IO, cast

import pyopencl as cl

from lnocl.core.opencl import kernel_cache
from lnocl.core.opencl.device import describe
from lnocl.core.opencl.sources import source
from lnocl.core.opencl.unknown_cpu import POCL
from lnocl.errors import DeviceError

# Processes that compile kernels anyway, and print a line behind the first.
at_work: list[subprocess.Popen[bytes]] = []
# What the outcome may depend on, besides the device.
VARIABLES = ("PATH", "COMPILER_PATH", "LIBRARY_PATH", "TMPDIR", "TEMP", "TMP")
LIMITS = ("RLIMIT_NOFILE", "RLIMIT_NPROC", "RLIMIT_AS", "RLIMIT_FSIZE")
LIBRARIES = ("/usr/lib*/gcc/*/*", "/usr/lib*/crti.o", "/usr/lib*/*/crti.o")
# Where a driver ends the process, the last line is not printed.
TRIAL = """
try:
    import sys
    import numpy
    import pyopencl as cl
    platform, device = map(int, sys.argv[2:])
    context = cl.Context([cl.get_platforms()[platform].get_devices()[device]])
    exec(sys.argv[1])
finally:
    print("lives")
"""
KERNELS = """
from lnocl.core.opencl import launch, program, sources, trial
trial.check = lambda device: None
made = program.Program(context, (8, 8), numpy.dtype("f4"))
made.kernel(sources.LAST[0])  # and all that are compiled with it
launcher = launch.Launcher(made)
flags, ones = launch.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, numpy.ones(2**14, "f4")
names = "pixels", "spectra", "steps"
buffers = {name: cl.Buffer(context, flags, hostbuf=ones) for name in names}
for name in ("rfft_rows", "fft_columns"):
    launcher.bind(name, buffers, n_images=1, n_skies=1)()
launcher.queue.finish()
"""
# Enough for a linker.
KERNEL = """
from lnocl.core.opencl.unknown_cpu import name_level
name_level(context.devices[0])
queue, found = cl.CommandQueue(context), numpy.zeros(1, numpy.float32)
buffer = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, 4)
cl.Program(context, "__kernel void f(__global float *x) { *x = 1; }").build().f(
    queue, (1,), None, buffer)
cl.enqueue_copy(queue, found, buffer)
"""
# PoCL's command names start files and libraries that its kernels do not need.
ZIGLANG = """#!/bin/sh
output= objects=
while [ $# -gt 0 ]; do
    case $1 in
        -o) output=$2; shift ;;
        *crt*.o) ;;
        *.o) objects="$objects $1" ;;
    esac
    shift
done
exec {python} -P -m ziglang ld.lld -shared -o "$output" $objects
"""
CURE = "run apt-get install gcc libc6-dev, or pip install ziglang, or take engine numpy"
# Files that PoCL and the linker may have open.
N_FILES = 24
# Words of the trial, and their meaning.
TOO_FEW_FILES = "too few files may be open: raise the limit (ulimit -n)"
CAUSES = {
    "Too many open files": TOO_FEW_FILES,
    "doesn't exist": f"no linker was found on PATH: {CURE}",
    "cannot find": f"the linker lacks files of libgcc or libc: {CURE}",
    "Resource temporarily unavailable": "too few processes may run: raise the limit (ulimit -u)",
    "File too large": "files may not be as large as kernels: raise the limit (ulimit -f)",
    "No space left": "the folder for temporary files is full: set TMPDIR to another",
}


@functools.cache
def check(device: cl.Device) -> None:
    """Refuse a device whose driver ends the process as it compiles kernels.

    The store of compiled kernels holds the outcome for later processes.

    Raises
    ------
    DeviceError
        It does; the message says what to install, to set or to take.
    """
    is_pocl, note, found = device.platform.name == POCL, _note(device), outcome(device)
    if is_pocl:
        need_files()
    if found is None:
        found = _find_linker(device) if is_pocl else _compile(device)
        if found and kernel_cache.can_write(note.parent):
            kernel_cache.write(note, found)
    elif found == b"ziglang":
        _take_ziglang()


def outcome(device: cl.Device) -> bytes | None:
    """Return what was found in a trial of a device before; None where there was none."""
    return kernel_cache.read(_note(device))


def _note(device: cl.Device) -> Path:
    return kernel_cache.file_of(_environment(device)).with_suffix(".trial")


def _compile(device: cl.Device) -> bytes:
    if failure := _try(device, KERNELS):
        raise DeviceError(
            f"the driver of {describe(device)} ends the process as it compiles kernels "
            f"({failure}): update the driver, take another `device`, or `engine` numpy"
        )
    return b"lives"


def need_files() -> None:
    """Refuse to go where PoCL and its linker cannot open their files."""
    opened: list[int] = []
    try:
        for _ in range(N_FILES):
            opened.append(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        raise DeviceError(f"PoCL cannot link kernels: {TOO_FEW_FILES}") from error
    finally:
        for each in opened:
            os.close(each)


def _environment(device: cl.Device) -> str:
    words = [sys.executable, cl.VERSION_TEXT, describe(device)]
    if device.platform.name != POCL:
        return "\n".join([*words, source()])
    words += [_foreign(os.environ.get(name, "")) for name in VARIABLES]
    words += [str(shutil.which("ld")), *(file for each in LIBRARIES for file in sorted(glob(each)))]
    with contextlib.suppress(ImportError):  # there is none on Windows
        import resource

        words += [str(resource.getrlimit(getattr(resource, limit))) for limit in LIMITS]
    return "\n".join(words)


def _foreign(folders: str) -> str:
    """Return a list of folders without those that this package has put there."""
    parts = folders.split(os.pathsep)
    return os.pathsep.join(part for part in parts if kernel_cache.PREFIX not in part)


def _find_linker(device: cl.Device) -> bytes:
    """Return the linker that works: b"system" or b"ziglang"; b"" where that cannot be tried."""
    failure = "" if at_work and _lives(at_work.pop()) else _try(device, KERNEL)
    if not failure:
        return b"" if failure is None else b"system"
    if importlib.util.find_spec("ziglang"):
        _take_ziglang()
        if _try(device, KERNEL) == "":
            return b"ziglang"
    cause = next((CAUSES[words] for words in CAUSES if words in failure), failure)
    raise DeviceError(f"PoCL cannot link kernels: {cause}")


def _lives(process: subprocess.Popen[bytes]) -> bool:
    """Return whether a process that is at work has compiled its first kernel."""
    with cast(IO[bytes], process.stdout) as out:
        return out.readline() == b"lives\n"


def _try(device: cl.Device, kernels: str) -> str | None:
    """Compile in another process; return its last words where its driver ended it, else "".

    None where it ended by an error of Python, which says nothing of the driver.
    """
    platform = cl.get_platforms().index(device.platform)
    trial = [TRIAL, kernels, str(platform), str(device.platform.get_devices().index(device))]
    folder = kernel_cache.new_folder()
    try:
        # In a thread, where no signal interrupts it: the process is never left to itself.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(int).result()  # a thread that is there is waited for in any case
            done = thread.submit(
                subprocess.run,
                [sys.executable, "-P", "-c", *trial],  # not from the current folder
                env={**os.environ, kernel_cache.VARIABLE: folder, "XDG_CACHE_HOME": folder},
                capture_output=True,
                text=True,
                errors="replace",
            ).result()
    except OSError as error:
        return str(error.strerror)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    if "lives" in done.stdout:
        return None if done.returncode else ""
    return " ".join(done.stderr.split())[-400:] or f"exit status {done.returncode}"


def _take_ziglang() -> None:
    """Give clang, with which PoCL links, a linker that runs that of ziglang."""
    folder = kernel_cache.new_folder()
    script = os.path.join(folder, "ld")
    with open(script, "w", encoding="utf-8") as out:
        out.write(ZIGLANG.replace("{python}", shlex.quote(sys.executable)))
    os.chmod(script, 0o700)
    before = os.environ.get("COMPILER_PATH")
    os.environ["COMPILER_PATH"] = os.pathsep.join(filter(None, (folder, before)))
