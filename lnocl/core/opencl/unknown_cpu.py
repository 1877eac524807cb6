"""CPUs that are newer than PoCL: it compiles for the x86-64 level that they have.

The LLVM in PoCL 3.0 calls a CPU that it does not know "generic", a name that its own compiler then
refuses, so that no kernel builds. PoCL keeps the name in the record of the device, as the string
after the target's.
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct

import pyopencl as cl

POCL = "Portable Computing Language"
TARGET, UNKNOWN = b"x86_64-unknown-linux-gnu\0", b"generic\0"
# It calls a Zen 4 a Zen 3, which has no AVX-512, and its features those of a Zen 4: kernels with
# vectors of 512 bits do not compile then, or are wrong.
MISTAKEN, UNEXPECTED = b"znver3\0", "avx512f"
# Levels of x86-64 by a feature that each of them has first.
LEVELS = {"avx512f": b"x86-64-v4\0", "avx2": b"x86-64-v3\0", "sse4_2": b"x86-64-v2\0"}
# Bytes of the record that are looked through.
RECORD = 1024
MEMORY, FEATURES = "/proc/self/mem", "/proc/cpuinfo"


@functools.cache
def name_level(device: cl.Device) -> None:
    """Have PoCL compile for the level of x86-64 where it does not know the CPU, or mistakes it.

    Nothing is done for other devices, nor where PoCL knows the CPU, nor beyond Linux.
    """
    if device.platform.name != POCL:
        return
    try:
        level = _level()
        memory = os.open(MEMORY, os.O_RDWR)
    except OSError:
        return
    try:
        place = find_name(memory, device.int_ptr)
        if level and place and _is_wrong(_text(memory, place), level):
            os.pwrite(memory, struct.pack("P", ctypes.addressof(_lasting(level))), place)
    finally:
        os.close(memory)


def find_name(memory: int, record: int) -> int | None:
    """Return where the record of a device points to the name of its CPU.

    Parameters
    ----------
    memory : int
        File descriptor of this process's memory: reading what is not there fails, and no more.
    record : int
        Address of the record.
    """
    size = struct.calcsize("P")
    places = range(record, record + RECORD, size)
    return next((at + size for at in places if _text(memory, at, len(TARGET)) == TARGET), None)


def _text(memory: int, place: int, length: int = len(UNKNOWN)) -> bytes:
    """Return the bytes that a pointer points to; none where it points nowhere."""
    try:
        (address,) = struct.unpack("P", os.pread(memory, struct.calcsize("P"), place))
        return os.pread(memory, length, address)
    except (OSError, OverflowError, struct.error):
        return b""


def _is_wrong(name: bytes, level: bytes) -> bool:
    """Return whether PoCL has no name for a CPU of this level, or that of an older one."""
    is_older = name.startswith(MISTAKEN) and level == LEVELS[UNEXPECTED]
    return name.startswith(UNKNOWN) or is_older


def _level() -> bytes | None:
    with open(FEATURES, encoding="utf-8") as lines:
        features = next((line for line in lines if line.startswith("flags")), "").split()
    return next((level for feature, level in LEVELS.items() if feature in features), None)


@functools.cache
def _lasting(text: bytes) -> ctypes.Array[ctypes.c_char]:
    """Return a copy that stays where it is as long as the process does."""
    return ctypes.create_string_buffer(text)
