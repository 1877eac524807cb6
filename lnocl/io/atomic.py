"""Output files: checks of their names, and writing that leaves a whole file or no file."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import io
import os
import re
import secrets
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from typing import IO, Any

from lnocl.errors import FileError, InputError, warn

COMPRESSED = (".gz", ".bz2", ".xz", ".zip", ".z", ".fz")
FITS_ENDINGS = (".fits", ".fit", ".fts")
_TEMPORARY = re.compile(r"\.lnocl-[0-9a-f]{16}\.tmp")
# Seconds after the last write to a temporary file from which on nobody writes to it.
ABANDONED = 24 * 3600.0
# The marks (`_marks`) of the files that a command reads, which no output may replace.
_INPUTS: ContextVar[frozenset[Any]] = ContextVar("inputs", default=frozenset())


@contextlib.contextmanager
def kept(inputs: Iterable[str]) -> Iterator[None]:
    """Have outputs refused that would replace one of these files, or others kept already."""
    token = _INPUTS.set(_INPUTS.get().union(*map(_marks, inputs)))
    try:
        yield
    finally:
        _INPUTS.reset(token)


def refuse_input(path: str) -> None:
    """Refuse an output that is one of the files that are `kept`, links included.

    Raises
    ------
    InputError
        It is one of them.
    """
    if not _marks(path).isdisjoint(_INPUTS.get()):
        raise InputError(f"the output {path} is one of the inputs; give it another name")


def _marks(path: str) -> set[Any]:
    """Return the place and the inode of a file, which its links share."""
    marks: set[Any] = set()
    with contextlib.suppress(OSError, ValueError):  # of a name that no file has
        marks.add(os.path.realpath(path))
        found = os.stat(path)
        marks.add((found.st_dev, found.st_ino))
    return marks


# Seconds between two looks at a lock of others, and seconds after which the wait is told.
LOOK, LONG = 0.02, 10.0


def check_folder(
    path: str, overwrite: bool, names: Iterable[str] | None = None, make: bool = True
) -> None:
    """Make the folder for output files, and check that no file is lost, before any work is done.

    Parameters
    ----------
    path : str
        Folder; made where it does not exist.
    overwrite : bool
        Whether files in it may be replaced.
    names : iterable of str, optional
        Files that will be written. By default the folder must be empty.
    make : bool, optional
        Whether to make the folder; otherwise only check that it can be made.

    Raises
    ------
    FileError
        The path is not a folder, cannot be made or written to, or holds files that must not be
        overwritten.
    """
    if not (make or os.path.lexists(path)):
        # The folder does not exist yet; its nearest parent that does must allow it.
        parent = os.path.dirname(os.path.abspath(path))
        while not os.path.lexists(parent):
            parent = os.path.dirname(parent)
        if not os.path.isdir(parent):
            raise FileError(f"the output folder {path} cannot be used: {parent} is not a folder")
        check_output(os.path.join(parent, ".lnocl"), overwrite=True)
        return
    try:
        os.makedirs(path, exist_ok=True)
        there = os.listdir(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, FileExistsError):
            reason = "it is not a folder"
        raise FileError(f"the output folder {path} cannot be used: {reason}") from error
    if names is None and there and not overwrite:
        raise FileError(
            f"the output folder {path} is not empty; give another, or --overwrite to replace "
            "files in it"
        )
    for name in [".lnocl"] if names is None else names:
        check_output(os.path.join(path, name), overwrite)


def check_output(path: str, overwrite: bool, is_updated: bool = False) -> None:
    """Check that a result can be written, before any work is done for it.

    Parameters
    ----------
    path : str
        File to write.
    overwrite : bool
        Whether it may exist already.
    is_updated : bool, optional
        Whether it may be an input, to which something is added.

    Raises
    ------
    FileError
        The file exists and must not be overwritten, is a folder or a device, or its folder
        does not exist or cannot be written to.
    InputError
        The file is one of the inputs, or its name asks for compression.
    """
    if path.lower().endswith(COMPRESSED):
        raise InputError(f"the output {path} is not compressed; give it a name ending in .fits")
    if not is_updated:
        refuse_input(path)
    _check_replaceable(path, overwrite)
    target = os.path.realpath(path)
    if not os.path.isdir(os.path.dirname(target)):
        raise FileError(f"the folder of the output {path} does not exist; create it first")
    temporary = _temporary_beside(target)
    try:
        try:
            _create(temporary).close()
        finally:
            _remove(temporary)
    except OSError as error:
        raise FileError(
            f"the output {path} cannot be written to its folder: {error.strerror}"
        ) from error


def check_fits_output(path: str, overwrite: bool, is_updated: bool = False) -> None:
    """Check that a FITS file can be written, before any work is done for it.

    Raises
    ------
    FileError, InputError
        As `check_output`; a name that does not end in .fits, .fit or .fts.
    """
    if os.path.basename(path) and not path.lower().endswith((*FITS_ENDINGS, *COMPRESSED)):
        raise InputError(f"the output is a FITS file; give it a name ending in .fits, not {path}")
    check_output(path, overwrite, is_updated)


@contextlib.contextmanager
def whole_file(
    path: str, overwrite: bool = False, before: os.stat_result | None = None
) -> Iterator[IO[bytes]]:
    """Yield a stream whose content becomes the file once it is complete and on the disk.

    Until then it is a temporary file in the same folder. After a failure that one is gone, and a
    file that was there is as it was.

    Parameters
    ----------
    path : str
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.
    before : os.stat_result, optional
        The file that the content was made of.

    Yields
    ------
    binary stream
        To write to.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    ChangedError
        The file is not the one it was before.
    """
    _refuse_planted_link(path)
    target = os.path.realpath(path)
    temporary = _temporary_beside(target)
    try:
        with _explained(path):
            output = _Output(_create(temporary))
        with _explained(path, output):
            with io.BufferedWriter(output) as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            _check_replaceable(path, overwrite)
            if before is not None:
                os.chmod(temporary, stat.S_IMODE(before.st_mode))
                if not _is_same(before, os.stat(target)):
                    raise ChangedError(f"{path} has changed while it was written")
            os.replace(temporary, target)
    except BaseException:
        _remove(temporary)
        raise


class ChangedError(FileError):
    """A file that others have changed since its content was read."""


def update_file(path: str, write: Callable[[IO[bytes]], None]) -> None:
    """Replace a file by one that is made of it; what others add to it meanwhile is not lost.

    They wait for a lock, as far as the file system has locks. Where it has none, or others do not
    heed them, the file is made once more.

    Parameters
    ----------
    path : str
        The file.
    write : callable
        Reads the file, and writes the new content to the binary stream that it is given.

    Raises
    ------
    FileError
        The file is not there, or cannot be written.
    """
    target = os.path.realpath(path)
    with _explained(path), _locked(target):
        while True:
            before = os.stat(target)
            try:
                with whole_file(path, overwrite=True, before=before) as stream:
                    write(stream)
            except ChangedError:
                continue
            return


def write_text(path: str, text: str, overwrite: bool = False) -> None:
    """Write a text in UTF-8: the file is there complete, or not at all.

    Parameters
    ----------
    path : str
        File to write.
    text : str
        Its content.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    with whole_file(path, overwrite) as stream:
        stream.write(text.encode("utf-8", "backslashreplace"))


def _create(path: str) -> io.FileIO:
    """Open a temporary file, locked as long as it is open."""
    _remove_abandoned(os.path.dirname(path))
    file = open(path, "xb", buffering=0)  # noqa: SIM115  its caller closes it
    _lock(file.fileno())
    return file


@functools.cache
def _remove_abandoned(folder: str) -> None:
    """Remove temporary files that killed processes left in a folder, once in a process.

    Nobody has them locked, and as not all file systems tell other machines of locks, nobody has
    written to them for a day.
    """
    before = time.time() - ABANDONED
    with contextlib.suppress(OSError):  # of a folder that cannot be listed
        for entry in list(os.scandir(folder)):
            with contextlib.suppress(OSError):  # of a file of another user, or that is gone
                if not _TEMPORARY.fullmatch(entry.name) or not entry.is_file(follow_symlinks=False):
                    continue
                if entry.stat(follow_symlinks=False).st_mtime > before:
                    continue
                with open(entry.path, "rb") as file:
                    if _lock(file.fileno(), shared=True):
                        os.unlink(entry.path)


@contextlib.contextmanager
def _locked(target: str) -> Iterator[None]:
    """Let nobody else update a file, by the lock of a neighbour that is there as long.

    The file itself cannot be locked: it is replaced, and on some file systems a locked file cannot
    be read.
    """
    if os.name == "nt":  # no flock, and no file can be removed that is open
        yield
        return
    folder, name = os.path.split(target)
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    neighbour = os.path.join(folder, f".lnocl-{digest}.tmp")
    file = _wait_for(neighbour, target)
    try:
        yield
    finally:
        _remove(neighbour)
        os.close(file)


def _wait_for(neighbour: str, target: str) -> int:
    """Return a file of this name that is open and locked, once nobody else has it locked."""
    patience = time.monotonic() + LONG
    while True:
        os.stat(target)  # it is still there
        with contextlib.suppress(FileNotFoundError):  # who had it locked has removed it
            file = _open_or_make(neighbour)
            try:
                if _lock(file) and os.path.samestat(os.fstat(file), os.stat(neighbour)):
                    return file
            except BaseException:
                os.close(file)
                raise
            os.close(file)
        if time.monotonic() > patience:
            warn(f"waiting for another process, which is writing {target}")
            patience = float("inf")
        time.sleep(LOOK)


def _open_or_make(path: str) -> int:
    """Open a file, which may be another user's, or make it."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except PermissionError:
        if not os.access(os.path.dirname(path), os.W_OK):
            raise
        return os.open(path, os.O_RDONLY | os.O_NOFOLLOW)


def _is_same(one: os.stat_result, other: os.stat_result) -> bool:
    names = "st_dev", "st_ino", "st_size", "st_mtime_ns"
    return all(getattr(one, name) == getattr(other, name) for name in names)


def _lock(file: int, shared: bool = False) -> bool:
    """Lock an open file, and return whether nobody else has, as far as its file system knows."""
    try:
        import fcntl
    except ImportError:  # Windows, which removes no file that is open
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EAGAIN, errno.EACCES)
    return True


class _Output(io.RawIOBase):
    """A file that remembers the error with which a write failed.

    Its writer may raise another one: astropy raises AttributeError on a full disk.
    """

    def __init__(self, file: io.FileIO) -> None:
        super().__init__()
        self.failure: OSError | None = None
        self._file = file

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._file.fileno()

    def tell(self) -> int:
        return self._file.tell()

    def write(self, data: Any) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.failure = error
            raise

    def close(self) -> None:
        self._file.close()
        super().close()


@contextlib.contextmanager
def _explained(path: str, output: _Output | None = None) -> Iterator[None]:
    """Raise errors of the operating system as FileError; let all others pass."""
    try:
        yield
    except FileError:
        raise
    except Exception as error:
        failure = (output.failure if output else None) or error
        if not isinstance(failure, OSError):
            raise
        raise FileError(f"{path} cannot be written: {failure.strerror or failure}") from error


def _refuse_planted_link(path: str) -> None:
    """Refuse a link of another user in a folder that all may write, as Linux itself may."""
    if not os.path.islink(path):
        return
    owner, folder = os.lstat(path).st_uid, os.stat(os.path.dirname(path) or ".")
    if folder.st_mode & stat.S_ISVTX and owner not in (os.geteuid(), folder.st_uid):
        raise FileError(
            f"the output {path} is a link of another user in a folder that all may write; give "
            "another name"
        )


def _check_replaceable(path: str, overwrite: bool) -> None:
    _refuse_planted_link(path)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        if not os.path.basename(path):
            raise FileError(f"the output {path!r} is not the name of a file") from None
        return
    except (OSError, ValueError) as error:
        raise FileError(
            f"the output {path} cannot be written: {getattr(error, 'strerror', None) or error}"
        ) from error
    if not stat.S_ISREG(mode):
        raise FileError(f"the output {path} exists and is not a regular file; give another name")
    if not overwrite:
        raise FileError(
            f"the output {path} exists; give another name, or `overwrite`=True to replace it"
        )


def _remove(temporary: str) -> None:
    with contextlib.suppress(OSError):  # the error to report is the one before
        os.unlink(temporary)


def _temporary_beside(target: str) -> str:
    return os.path.join(os.path.dirname(target), f".lnocl-{secrets.token_hex(8)}.tmp")
