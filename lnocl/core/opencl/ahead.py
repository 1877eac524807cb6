"""Kernels that a process of its own compiles meanwhile: PoCL compiles one at a time in a process.

Whoever needs them waits for its end, and has them from the store, as of any process before; where
it failed they are not there, and are compiled as they would be without it.
"""

from __future__ import annotations

import atexit
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from subprocess import PIPE
from typing import TYPE_CHECKING

from lnocl import process
from lnocl.core.opencl import kernel_cache, trial
from lnocl.core.opencl.device import spec_of
from lnocl.core.opencl.unknown_cpu import POCL

if TYPE_CHECKING:
    from lnocl.core.opencl.program import Program

# Seconds after which nobody waits any longer.
LONGEST = 60.0
# `steps` is 0 to the kernels, so that they do nothing.
SCRIPT = """
import sys
sys.path.append(sys.argv[1])
import numpy
import pyopencl as cl
from lnocl.core.opencl import ahead, device, launch, program, sources, trial, tuning
ahead.begin = trial.check = lambda *_: None
context = device.context_of(device.choose(sys.argv[2]).device)
if sys.argv[4]:
    exec(trial.KERNEL)
    print("lives", flush=True)
made = program.Program(context, *eval(sys.argv[3]))
made.options, launcher = sys.argv[5:], launch.Launcher(made)
nothing = cl.Buffer(context, cl.mem_flags.COPY_HOST_PTR, hostbuf=bytes(2**20))
for name in sources.LAST:
    types = made.arguments[name].items()
    given = {each: nothing if "*" in kind else 0 for each, kind in types}
    launcher.bind(name, given | launcher.own)()
launcher.queue.finish()
"""
_begun: dict[Path, subprocess.Popen[bytes]] = {}


def begin(file: Path, program: Program) -> None:
    """Have the kernels that a run needs last compiled, if no process did that before."""
    device, nowhere = program.context.devices[0], subprocess.DEVNULL
    is_new = not (process.is_worker or file in _begun or program.is_stored)
    if not is_new or device.platform.name != POCL or process.n_cores() < 2:
        return
    if not kernel_cache.can_write(file.parent):
        return
    if is_known := trial.outcome(device) is not None:
        trial.check(device)  # which names the linker
    given = f"{program.grid}, numpy.dtype({program.dtype.str!r}), tuning.{program.tuning}"
    given += f", {program.oversample}, {program.has_turns}"
    root = str(Path(__file__).parents[3])
    words = [root, spec_of(device), given, "" if is_known else "tries", *program.options]
    script, out = [sys.executable, "-P", "-c", SCRIPT, *words], nowhere if is_known else PIPE
    with suppress(OSError):
        _begun[file] = subprocess.Popen(script, stdin=nowhere, stdout=out, stderr=nowhere)
        atexit.register(_begun[file].send_signal, signal.SIGINT)
        if not is_known:
            trial.at_work.append(_begun[file])


def wait(file: Path) -> None:
    """Wait for whoever compiles what a file will hold."""
    if file in _begun:
        with suppress(subprocess.TimeoutExpired):
            _begun[file].wait(LONGEST)
