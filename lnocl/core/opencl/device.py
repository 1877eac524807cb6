"""Finding OpenCL devices and selection one, without a prompt and without a silent fallback."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import pyopencl as cl

from lnocl import process
from lnocl.core.opencl import kernel_cache, sharing
from lnocl.core.opencl.faults import after_fault, claim_process
from lnocl.errors import DeviceError, InputError, note

Named = TypeVar("Named", cl.Platform, cl.Device)

# A number of threads that PoCL cannot have ends the process.
THREADS, MAX_THREADS = "POCL_MAX_PTHREAD_COUNT", 4096


class Choice(NamedTuple):
    """A device, why it was chosen, and the CPU passed over where a GPU is the default."""

    device: cl.Device
    reason: str
    instead: cl.Device | None = None


def find_devices() -> list[cl.Device]:
    """Return every OpenCL device, in the order of the platforms.

    Raises
    ------
    DeviceError
        Where there is no platform, or no device on any; in a process that was forked from one
        that uses OpenCL.
    InputError
        POCL_MAX_PTHREAD_COUNT is no number of threads.
    """
    devices = [device for platform in _usable_platforms() for device in _devices_of(platform)]
    if not devices:
        raise DeviceError(
            "no OpenCL device was found; install the driver of your GPU, or PoCL (see README), or "
            "use the engine numpy"
        )
    return devices


def choose(spec: str | None = None) -> Choice:
    """Choose a device: that of `spec`, else of PYOPENCL_CTX, else the first GPU, else CPU.

    Worker processes of one machine take its GPUs in turn.

    Parameters
    ----------
    spec : str, optional
        ``PLATFORM[:DEVICE]``, as for PYOPENCL_CTX: each the index or a part of the name, in any
        case. Without ``DEVICE`` the platform's first.

    Raises
    ------
    InputError
        Where the specification fits no device, or as `find_devices`.
    DeviceError
        Where there is none at all.
    """
    devices = find_devices()
    if spec is not None:
        return Choice(_by_spec(spec, "`device`"), f"asked for as {spec!r}")
    if environment := os.environ.get("PYOPENCL_CTX"):
        return Choice(_by_spec(environment, "PYOPENCL_CTX"), f"PYOPENCL_CTX is {environment!r}")
    gpus = [device for device in devices if device.type & cl.device_type.GPU]
    cpus = [device for device in devices if device.type & cl.device_type.CPU]
    # Another platform may have the same ones under other names.
    like = [device for device in gpus if device.platform == gpus[0].platform]
    if process.is_worker and len(like) > 1:
        number = sharing.claim(len(like))
        return Choice(like[number], f"GPU {number + 1} of {len(like)}, shared among processes")
    if gpus:
        return Choice(gpus[0], "the first GPU", cpus[0] if cpus else None)
    if cpus:
        return Choice(cpus[0], "the first CPU")
    return Choice(devices[0], "the first device, neither GPU nor CPU")


def tell(choice: Choice) -> None:
    """Log, once, that a GPU was taken unasked, and how the CPU is taken."""
    if choice.instead is not None:
        _tell(describe(choice.device), choice.reason, spec_of(choice.instead))


@functools.cache
def _tell(name: str, reason: str, spec: str) -> None:
    note(
        "%s is taken, %s; `device` %s takes the CPU, which may be faster than a small GPU: lnocl "
        "bench times either",
        name,
        reason,
        spec,
    )


def describe(device: cl.Device) -> str:
    """Return the device's name, platform and driver in one line."""
    name, platform = " ".join(device.name.split()), device.platform.name.strip()
    return f"{name} ({platform}, {device.driver_version})"


@functools.cache
def context_of(device: cl.Device) -> cl.Context:
    """Return the context of a device, one for the whole process."""
    return cl.Context([device])


after_fault(context_of.cache_clear)  # a context may be lost with its device


def spec_of(device: cl.Device) -> str:
    """Return the ``PLATFORM:DEVICE`` indices of a device, by which `choose` finds it again."""
    for p, platform in enumerate(_usable_platforms()):
        for d, candidate in enumerate(_devices_of(platform)):
            if candidate == device:
                return f"{p}:{d}"
    raise DeviceError(f"{describe(device)} is no longer there")


def has_double(device: cl.Device) -> bool:
    """Return whether the device computes in double precision."""
    return bool(device.double_fp_config)


def _usable_platforms() -> list[cl.Platform]:
    """Return the platforms that have a device; indices in a specification count these."""
    claim_process()
    threads = os.environ.get(THREADS, "").strip()
    if threads and threads not in map(str, range(1, MAX_THREADS + 1)):
        raise InputError(
            f"{THREADS} is {threads!r}; set it to a whole number from 1 to {MAX_THREADS}, or unset "
            "it for a thread a core"
        )
    with kernel_cache.private():
        try:
            platforms = cl.get_platforms()
        except cl.Error:  # the loader's word for "none"
            return []
        return [platform for platform in platforms if _devices_of(platform)]


def _devices_of(platform: cl.Platform) -> list[cl.Device]:
    try:
        return list(platform.get_devices())
    except cl.Error:  # a platform whose devices are all missing
        return []


def _by_spec(spec: str, source: str) -> cl.Device:
    platform_part, _, device_part = spec.partition(":")
    platform = _pick(_usable_platforms(), platform_part)
    device = None
    if platform is not None:
        device = _pick(_devices_of(platform), device_part or "0")
    if device is None:
        known = "; ".join(f"{spec_of(found)} for {describe(found)}" for found in find_devices())
        raise InputError(f"{source} {spec!r} fits no OpenCL device; give one of these: {known}")
    return device


def _pick(candidates: Sequence[Named], part: str) -> Named | None:
    if part.isdecimal():
        return candidates[int(part)] if int(part) < len(candidates) else None
    named = [found for found in candidates if part and part.lower() in found.name.lower()]
    return named[0] if named else None
