"""What an OpenCL device fails at, in words; and processes in which it cannot work."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import pyopencl as cl

from lnocl.errors import DeviceError

# How runtimes say that memory is short; some say it at the first launch only. Later, the same
# words are those of a device that is lost.
SHORT_OF_MEMORY = (
    cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
    cl.status_code.OUT_OF_RESOURCES,
    cl.status_code.OUT_OF_HOST_MEMORY,
)

_uses_opencl = _was_forked = False


def _note_fork() -> None:
    global _was_forked
    _was_forked = _uses_opencl


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_note_fork)


def claim_process() -> None:
    """Note that this process uses OpenCL.

    Raises
    ------
    DeviceError
        It was forked from one that did: the threads of the runtime are not in it, and what waits
        for them would wait forever.
    """
    global _uses_opencl
    _uses_opencl = True
    if _was_forked:
        raise DeviceError(
            "this process was forked from one that uses OpenCL, which does not survive a fork: "
            "start workers by spawn, as multiprocessing.get_context('spawn') does"
        )


class OnDevice(Protocol):
    """What `guarded` is told of an engine."""

    name: str
    bytes_needed: int
    is_proven: bool


T = TypeVar("T", bound=type)


def guarded(engine: T) -> T:
    """Make every verb of a class raise DeviceError for what pyopencl raises, and after a fork."""
    for name, verb in list(vars(engine).items()):
        if callable(verb) and (name == "__init__" or not name.startswith("_")):
            setattr(engine, name, _guard(verb))
    return engine


def _guard(verb: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(verb)
    def guard(self: OnDevice, *arguments: Any, **keywords: Any) -> Any:
        claim_process()
        try:
            return verb(self, *arguments, **keywords)
        except (cl.Error, MemoryError) as error:
            for action in _actions:
                action()
            raise DeviceError(_explain(error, self)) from error

    return guard


_actions: list[Callable[[], None]] = []


def after_fault(action: Callable[[], None]) -> Callable[[], None]:
    """Have an action done after every fault, so that later engines start with a new context."""
    _actions.append(action)
    return action


def _explain(error: Exception, engine: OnDevice) -> str:
    cause = str(error) or "out of memory"
    size = f"{engine.bytes_needed / 2**20:.0f} MiB" if engine.bytes_needed else "some room"
    needs = f"the scene takes {size} there"
    no_memory = not isinstance(error, cl.Error) or error.code in SHORT_OF_MEMORY
    if no_memory and not engine.is_proven:
        return (
            f"{engine.name} has too little memory free: {needs}; take fewer or smaller images, "
            f"fewer stars, `precision` single, or another `device` ({cause})"
        )
    return (
        f"{engine.name} failed ({cause}), and the state of the run is lost; {needs}: run again, "
        "from the checkpoint if there is one, see what lnocl selftest says, or take another "
        "`device`"
    )


def build_failure(name: str, error: Exception) -> DeviceError:
    """Return the error that a compiler's failure makes, and save all messages of the compiler."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = next((line for line in lines if "error:" in line), lines[0] if lines else "no word")
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="lnocl-build-", suffix=".log", encoding="utf-8", delete=False
        ) as log:
            log.write(f"{name}\n{error}\n")
    except OSError as reason:
        saved = f"its messages could not be saved: {reason}"
    else:
        saved = f"its messages are in {log.name}"
    return DeviceError(
        f"the kernels do not build on {name}: {first[:200]}; {saved}; "
        "update the driver, or take another `device`"
    )
