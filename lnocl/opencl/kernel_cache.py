"""Compiled kernels kept from one process to the next, each program whole or not at all.

PoCL keeps them in a folder that processes share without a lock, and a file there that was cut
short kills the process that loads it. So it is given a folder of the process's own, and what it
leaves there of a program is kept as one archive, which is put in place at once and has checksums.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
import weakref
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from lnocl.errors import DeviceError, warn
from lnocl.process import LOCK

T = TypeVar("T")

VARIABLE = "POCL_CACHE_DIR"


class _Folder:
    """A folder of this process's own, as long as it lives."""

    def __init__(self) -> None:
        try:
            self.path = Path(tempfile.mkdtemp(prefix="lnocl-kernels-"))
        except OSError as error:
            raise DeviceError(
                f"no folder for kernels can be made: {error}; set TMPDIR to one that can be "
                "written to"
            ) from error
        weakref.finalize(self, _remove, self.path, os.getpid())


def _remove(path: Path, process: int) -> None:
    if os.getpid() == process:  # and none that was forked from it
        shutil.rmtree(path, ignore_errors=True)


_own: list[_Folder] = []
_fresh: list[_Folder] = []


@contextlib.contextmanager
def private() -> Iterator[None]:
    """Have PoCL use a folder of this process's own, if it is first asked for devices in here."""
    with LOCK:
        if _own:
            yield
            return
        _own.append(_Folder())
        with _environment(VARIABLE, _own[0].path):
            yield


@contextlib.contextmanager
def fresh() -> Iterator[None]:
    """Have PyOpenCL, which follows the XDG standard, use empty caches from now on."""
    with LOCK:
        _fresh.append(_Folder())
        sys.modules.pop("pyopencl.invoker", None)  # it holds a cache open
        with _environment("XDG_CACHE_HOME", _fresh[-1].path):
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


def store() -> Path:
    """Return the folder that archives are kept in."""
    if given := os.environ.get(VARIABLE):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "lnocl"


def build(owner: object, name: str, make: Callable[[], T]) -> T:
    """Build a program with what was kept of it, and keep what is there when its owner goes.

    Parameters
    ----------
    owner : object
        What the program lives with.
    name : str
        Everything that the kernels depend on.
    make : callable
        Builds the program.

    Warns
    -----
    LnoclWarning
        An archive that is damaged; a folder in which nothing can be kept.
    """
    with LOCK:
        if not _own:
            return make()
        own = _own[0].path
        archive = store() / f"{hashlib.sha256(name.encode()).hexdigest()}.zip"
        kept = _unpack(archive, own)
        before = set(_programs(own))
        built = make()
        programs = sorted({*kept, *(set(_programs(own)) - before)})
        if programs and _can_keep(archive.parent):
            weakref.finalize(owner, _keep, archive, own, programs, os.getpid())
        return built


def _programs(own: Path) -> list[str]:
    """Return the folders that PoCL has made for programs, one for each."""
    return [str(path.relative_to(own)) for path in own.glob("*/*") if path.is_dir()]


def _unpack(archive: Path, own: Path) -> list[str]:
    """Put what was kept where PoCL looks for it; return the programs' folders."""
    try:
        with zipfile.ZipFile(archive) as kept:
            names = kept.namelist()
            if kept.testzip() is not None:
                raise zipfile.BadZipFile
            for name in names:
                if not (own / name).exists():  # else it may be loaded already
                    _extract(kept, name, own)
    except OSError:  # none were kept, or they cannot be read
        return []
    except Exception:  # what is damaged may raise anything
        warn(f"the kernels kept in {archive} are damaged, and are compiled anew")
        with contextlib.suppress(OSError):
            archive.unlink()  # or what is made anew would seem to be kept
        return []
    return sorted({str(Path(*Path(name).parts[:2])) for name in names})


def _extract(kept: zipfile.ZipFile, name: str, own: Path) -> None:
    """Put a file where it belongs, whole or not at all."""
    try:
        kept.extract(name, own)
    except OSError:  # the disk may be full
        (own / name).unlink(missing_ok=True)
        raise


_refused: set[Path] = set()


def _can_keep(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return True
        reason = "it cannot be written to"
    except OSError as error:
        reason = str(error.strerror)
    if folder not in _refused:
        _refused.add(folder)
        warn(
            f"kernels cannot be kept in {folder} ({reason}), and are compiled anew by every "
            f"process; set {VARIABLE} to a folder that can be written to"
        )
    return False


def _keep(archive: Path, own: Path, programs: list[str], process: int) -> None:
    """Keep all files of some programs' folders, if there are any not kept yet."""
    if os.getpid() != process:
        return
    with LOCK, contextlib.suppress(OSError):  # what is not kept is compiled again
        files = [file for name in programs for file in (own / name).rglob("*") if file.is_file()]
        names = {str(file.relative_to(own)): file for file in files}
        with contextlib.suppress(Exception), zipfile.ZipFile(archive) as kept:
            if set(kept.namelist()) >= set(names):
                return
        handle, part = tempfile.mkstemp(dir=archive.parent, prefix=archive.stem, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as out, zipfile.ZipFile(out, "w") as kept:
                for name, file in names.items():
                    kept.write(file, name)
            os.replace(part, archive)
        except BaseException:
            os.unlink(part)
            raise
