"""Compiled programs in files, one checked file a program, so that a later process need not compile.

PoCL has a folder of its own for that, which processes share without a lock, and a file there that
was cut short kills the process that loads it. So PoCL is given a private folder. Its files of a
program, or the binary of another runtime, are written to one file, in place at once, behind their
checksum.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import stat
import struct
import tempfile
import weakref
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from lnocl.errors import DeviceError, warn
from lnocl.process import LOCK

VARIABLE = "POCL_CACHE_DIR"
DIGEST = hashlib.sha256
DIGEST_SIZE = DIGEST().digest_size
PREFIX = "lnocl-kernels-"
# Bytes that kernels may take while they are compiled, and those that the store may hold.
MIN_FREE, MAX_STORED = 16 * 2**20, 512 * 2**20
# Files likewise, and bytes of the path of their folder: SQLite, for PyOpenCL's cache, opens no
# longer path than 512, its own names included.
MIN_FILES, MAX_PATH = 1000, 350
# Faults of archives that zipfile finds, and of the disk.
UNUSABLE = (OSError, EOFError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error)


class _Folder:
    """A folder of this process alone, removed when the process ends.

    PoCL runs code from it: it lies in the folder for temporary files, or, where no code may be run
    from there or little space is left, beside the store of compiled kernels.
    """

    def __init__(self) -> None:
        reasons = []
        for find in (_temporary, store):
            parent = Path("TMPDIR")
            try:
                parent = find()
                if find is store:
                    parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                if reason := _unfit(parent):
                    raise OSError(0, reason)
                self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
                break
            except OSError as error:
                reasons.append(f"{parent} ({error.strerror})")
        else:
            raise DeviceError(
                f"no folder for kernels can be made in {' or in '.join(reasons)}; set TMPDIR to "
                f"one with {MIN_FREE >> 20} MiB from which programs may be run"
            )
        weakref.finalize(self, _remove, self.path, os.getpid())


def _temporary() -> Path:
    try:
        return Path(tempfile.gettempdir())
    except FileNotFoundError:
        raise OSError(0, "no folder can be written to") from None


def _unfit(folder: Path) -> str:
    """Return why code cannot be stored and run in a folder, or ""."""
    if len(os.fsencode(folder)) > MAX_PATH:
        return "its path is too long"
    if not hasattr(os, "statvfs"):
        return ""
    state = os.statvfs(folder)
    if state.f_flag & os.ST_NOEXEC:
        return "no programs may be run from there"
    is_short_of_files = state.f_files and state.f_favail < MIN_FILES
    if is_short_of_files or state.f_bavail * state.f_frsize < MIN_FREE:
        return "it is nearly full"
    return ""


def _remove(path: Path, process: int) -> None:
    if os.getpid() == process:  # a process forked from it must leave the folder alone
        shutil.rmtree(path, ignore_errors=True)


_own: list[_Folder] = []


@contextlib.contextmanager
def private() -> Iterator[None]:
    """Give PoCL and PyOpenCL a private folder for their caches, the first time they are used."""
    with LOCK:
        if _own:
            yield
            return
        _own.append(_Folder())
        folder = _own[0].path
        with _environment(VARIABLE, folder), _environment("XDG_CACHE_HOME", folder):
            import pyopencl.invoker  # noqa: F401  PyOpenCL opens a cache as this is imported

            yield


@contextlib.contextmanager
def _environment(name: str, path: Path) -> Iterator[None]:
    given = os.environ.get(name)
    os.environ[name] = str(path)
    try:
        yield
    finally:
        if given is None:
            del os.environ[name]
        else:
            os.environ[name] = given


def new_folder() -> str:
    """Return a new folder in the private one."""
    return tempfile.mkdtemp(prefix="folder-", dir=_own[0].path)


def folders() -> set[str]:
    """Return the folders that PoCL has made for programs in its private folder, one for each."""
    own = _own[0].path
    return {str(path.relative_to(own)) for path in own.glob("*/*") if path.is_dir()}


def pack(names: set[str]) -> bytes:
    """Return the files in some of these folders as the content of an archive."""
    own, content = _own[0].path, io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for file in sorted(file for name in names for file in (own / name).rglob("*")):
            if file.is_file() and _is_whole(data := file.read_bytes()):
                archive.writestr(zipfile.ZipInfo(str(file.relative_to(own))), data)
    return content.getvalue()


def _is_whole(data: bytes) -> bool:
    """Return whether a file is not a library that was cut short, as by a full disk.

    The table of an ELF file's sections is its end; a process that loads less than that is killed.
    """
    if not data.startswith(b"\x7fELF\x02\x01"):  # 64 bits, little end first
        return not data.startswith(b"\x7fELF")
    (offset,) = struct.unpack_from("<Q", data, 40)
    size, count = struct.unpack_from("<HH", data, 58)
    return offset + size * count <= len(data)


def unpack(content: bytes | None) -> set[str]:
    """Put the files of an archive where PoCL looks for them; return their folders.

    A folder that is there already is left alone, as its files may be loaded. Where the archive is
    not sound, or the disk full, no part of any folder stays.
    """
    own, new = _own[0].path, set[str]()
    try:
        with zipfile.ZipFile(io.BytesIO(content or b"")) as archive:
            names = {str(Path(*Path(name).parts[:2])) for name in archive.namelist()}
            new = {name for name in names if not (own / name).exists()}
            for name in archive.namelist():
                if str(Path(*Path(name).parts[:2])) in new:
                    archive.extract(name, own)
        return names
    except UNUSABLE:
        for name in new:
            shutil.rmtree(own / name, ignore_errors=True)
        return set()


def store() -> Path:
    """Return the folder that compiled kernels are stored in."""
    folder = os.environ.get(VARIABLE)
    if not folder:
        folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        if folder.startswith("~"):  # the user has no home
            folder = os.devnull
        folder = os.path.join(folder, "lnocl")
    return Path(folder)


def file_of(name: str) -> Path:
    """Return the file of the program with this name, all that its kernels depend on."""
    return store() / f"{DIGEST(os.fsencode(name)).hexdigest()}.kernels"


def read(file: Path) -> bytes | None:
    """Return the content of a file, or None where there is no file that can be read.

    Kernels are code: a file that is another user's, or that others may write to, is not read.

    Warns
    -----
    LnoclWarning
        The file is damaged, and is removed; or it is not this user's alone.
    """
    try:
        with open(file, "rb", opener=_without_waiting) as stream:
            state = os.fstat(stream.fileno())
            if not stat.S_ISREG(state.st_mode):
                return None
            if hasattr(os, "getuid") and (state.st_uid != os.getuid() or state.st_mode & 0o022):
                warn(f"{file} can be written by others, and is not used")
                return None
            content = stream.read() if state.st_size <= MAX_STORED else b""
    except OSError:
        return None
    digest, content = content[:DIGEST_SIZE], content[DIGEST_SIZE:]
    if DIGEST(content).digest() == digest:
        with contextlib.suppress(OSError):
            os.utime(file)  # the least used are the first to go
        return content
    discard(file)
    return None


def _without_waiting(name: str, flags: int) -> int:
    """Open a file, and a pipe without waiting for its other end."""
    return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))


def discard(file: Path) -> None:
    """Remove a file whose content cannot be used, and say so."""
    warn(f"{file} is damaged, and is not used")
    with contextlib.suppress(OSError):
        file.unlink()


def write(file: Path, content: bytes) -> None:
    """Write kernels to their file, behind their checksum; remove the least used if all is much."""
    replace(file, DIGEST(content).digest() + content)
    with contextlib.suppress(OSError):
        _trim(file.parent)


def replace(file: Path, content: bytes) -> None:
    """Write content to a file, whole or not at all; a full disk leaves the file as it was."""
    with contextlib.suppress(OSError):
        handle, part = tempfile.mkstemp(dir=file.parent, prefix=file.stem, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as out:
                out.write(content)
            os.replace(part, file)
        except BaseException:
            os.unlink(part)
            raise


def _trim(folder: Path) -> None:
    """Remove the least used files of a store that has grown too large."""
    files = [(file.stat(), file) for file in folder.glob("*.kernels")]
    total = sum(state.st_size for state, _ in files)
    for state, file in sorted(files, key=lambda each: each[0].st_mtime):
        if total <= MAX_STORED:
            break
        file.unlink()
        total -= state.st_size


_refused: set[Path] = set()


def can_write(folder: Path) -> bool:
    """Return whether files can be written to a folder, which is made; warn once where not."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if os.access(folder, os.W_OK | os.X_OK) and shutil.disk_usage(folder).free >= MIN_FREE:
            return True
        reason = "it cannot be written to, or is nearly full"
    except OSError as error:
        reason = str(error.strerror)
    if folder not in _refused:
        _refused.add(folder)
        warn(
            f"compiled kernels cannot be stored in {folder} ({reason}), and every process compiles "
            f"them anew; set {VARIABLE} to a folder that can be written to"
        )
    return False
