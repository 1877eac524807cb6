"""Outputs: each is there complete or not at all, and what none may be."""

import errno
import io
import os
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from matplotlib.figure import Figure

from lnocl.commands import cli
from lnocl.errors import FileError, InputError, LnoclWarning
from lnocl.io import atomic, fitswrite, saved_results
from lnocl.plotting.figure import save_figure

IMAGE = np.arange(1.0, 121.0).reshape(10, 12)
LARGE = np.random.default_rng(3).normal(size=(400, 500))
FULL = OSError(errno.ENOSPC, "No space left on device")


def write_result(path, overwrite=False):
    cubes = {"MODELS": LARGE[None]}
    fitswrite.write_result(path, LARGE, [(3.0, 4.5)], [17.25], cubes, overwrite=overwrite)


def write_image(path, overwrite=False):
    fitswrite.write_image(path, LARGE, overwrite=overwrite)


def write_text(path, overwrite=False):
    atomic.write_text(path, "lnocl\n" * 300_000, overwrite)


def write_figure(path, overwrite=False):
    figure = Figure(figsize=(7, 7))
    figure.add_subplot().imshow(LARGE)
    save_figure(figure, path, overwrite)


# All that the package writes with; each writes 1.5 MB and more, the figure 0.3 MB and more.
WRITERS = [write_result, write_image, write_text, write_figure]


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def fill_up(monkeypatch, room):
    """Let a disk have room for so many bytes."""

    class File(io.FileIO):
        def write(self, data):
            if self.tell() + memoryview(data).nbytes > room:
                raise FULL
            return super().write(data)

    # What atomic opens is of this kind anyway.
    monkeypatch.setattr(atomic, "open", lambda path, mode, **_: File(path, mode), raising=False)


@pytest.mark.parametrize("write", WRITERS)
class TestEveryWriter:
    @pytest.mark.parametrize("there", [False, True])
    @pytest.mark.parametrize("call", ["fsync", "replace"])
    @pytest.mark.parametrize("error", [FULL, KeyboardInterrupt()])
    def test_failed_write_preserves_the_existing_file(
        self, tmp_path, monkeypatch, write, there, call, error
    ):
        path = tmp_path / "out.fits"
        if there:
            path.write_bytes(b"old")

        def fail(*arguments):
            raise error

        monkeypatch.setattr(os, call, fail)
        with pytest.raises(FileError if error is FULL else KeyboardInterrupt) as caught:
            write(str(path), overwrite=True)
        if error is FULL:
            assert str(caught.value) == f"{path} cannot be written: No space left on device"
        assert names(tmp_path) == (["out.fits"] if there else [])
        assert not there or path.read_bytes() == b"old"

    @pytest.mark.parametrize("room", [0, 3000, 150_000])
    def test_a_disk_that_fills_up(self, tmp_path, monkeypatch, write, room):
        path = tmp_path / "out.fits"
        path.write_bytes(b"old")
        fill_up(monkeypatch, room)
        with pytest.raises(FileError) as caught:
            write(str(path), overwrite=True)
        assert str(caught.value) == f"{path} cannot be written: No space left on device"
        assert names(tmp_path) == ["out.fits"]
        assert path.read_bytes() == b"old"

    def test_existing_file_is_not_overwritten_by_default(self, tmp_path, write):
        path = tmp_path / "out.fits"
        path.write_bytes(b"old")
        with pytest.raises(FileError, match="exists"):
            write(str(path))
        assert path.read_bytes() == b"old"
        assert names(tmp_path) == ["out.fits"]

    def test_a_new_file_has_the_permissions_of_any_new_file(self, tmp_path, write):
        path = tmp_path / "out.fits"
        before = os.umask(0o027)
        try:
            write(str(path))
        finally:
            os.umask(before)
        assert stat.S_IMODE(path.stat().st_mode) == 0o640

    def test_a_link_stays_a_link(self, tmp_path, write):
        (tmp_path / "other").mkdir()
        target, link = tmp_path / "other" / "target.fits", tmp_path / "link.fits"
        target.touch()
        link.symlink_to(target)
        write(str(link), overwrite=True)
        assert link.is_symlink()
        assert target.stat().st_size > 100_000


class TestUpdateFile:
    def test_threads_wait_for_each_other(self, tmp_path):
        path = tmp_path / "a"
        path.write_bytes(b"")

        def add(k):
            def write(stream):
                content = path.read_bytes()
                time.sleep(0.002)
                stream.write(content + bytes([k]))

            atomic.update_file(str(path), write)

        with ThreadPoolExecutor(12) as pool:
            list(pool.map(add, range(12)))
        assert sorted(path.read_bytes()) == list(range(12))
        assert names(tmp_path) == ["a"]

    def test_update_includes_content_that_others_write_without_the_lock(self, tmp_path):
        path, other = tmp_path / "a", tmp_path / "b"
        path.write_bytes(b"1")
        calls = []

        def write(stream):
            content = path.read_bytes()
            calls.append(content)
            if len(calls) == 1:
                other.write_bytes(b"12")
                other.replace(path)
            stream.write(content + b"3")

        atomic.update_file(str(path), write)
        assert calls == [b"1", b"12"]
        assert path.read_bytes() == b"123"
        assert names(tmp_path) == ["a"]

    @pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
    def test_a_file_system_without_locks_is_no_hindrance(self, tmp_path, monkeypatch, number):
        fcntl = pytest.importorskip("fcntl")

        def flock(file, how):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(fcntl, "flock", flock)
        path = tmp_path / "a"
        path.write_bytes(b"1")
        atomic.update_file(str(path), lambda stream: stream.write(b"2"))
        assert path.read_bytes() == b"2"
        assert names(tmp_path) == ["a"]

    def test_it_keeps_the_permissions(self, tmp_path):
        path = tmp_path / "a"
        path.write_bytes(b"1")
        path.chmod(0o600)
        atomic.update_file(str(path), lambda stream: stream.write(b"2"))
        assert stat.S_IMODE(path.stat().st_mode) == 0o600

    def test_a_lock_that_a_killed_process_left_holds_nobody(self, tmp_path):
        path = tmp_path / "a"
        path.write_bytes(b"1")
        with atomic._locked(str(path)):
            [left] = set(names(tmp_path)) - {"a"}
        (tmp_path / left).touch()
        atomic.update_file(str(path), lambda stream: stream.write(b"2"))
        assert names(tmp_path) == ["a"]

    def test_long_wait_for_a_lock_is_reported(self, tmp_path, monkeypatch):
        monkeypatch.setattr(atomic, "LONG", 0.0)
        path = tmp_path / "a"
        path.write_bytes(b"1")

        def hold():
            with ThreadPoolExecutor(1) as pool:
                with atomic._locked(str(path)):
                    update = pool.submit(
                        atomic.update_file, str(path), lambda stream: stream.write(b"2")
                    )
                    time.sleep(0.1)
                    assert path.read_bytes() == b"1"
                update.result()

        with pytest.warns(LnoclWarning, match="waiting for another process, which is writing"):
            hold()
        assert path.read_bytes() == b"2"

    def test_a_file_that_is_gone_is_one_line(self, tmp_path):
        with pytest.raises(FileError, match="cannot be written: No such file"):
            atomic.update_file(str(tmp_path / "a"), lambda stream: None)
        assert names(tmp_path) == []


class TestWholeFile:
    def test_nothing_is_there_before_it_is_on_the_disk(self, tmp_path, monkeypatch):
        path = tmp_path / "out.txt"
        seen = []
        for call, plain in (("fsync", os.fsync), ("replace", os.replace)):

            def note(*given, call=call, plain=plain):
                sizes = [entry.stat().st_size for entry in tmp_path.iterdir()]
                seen.append((call, path.exists(), sizes))
                plain(*given)

            monkeypatch.setattr(os, call, note)
        atomic.write_text(str(path), "lnocl")
        assert seen == [("fsync", False, [5]), ("replace", False, [5])]
        assert path.read_bytes() == b"lnocl"

    def test_exception_of_the_writer_is_raised_unchanged(self, tmp_path):
        with pytest.raises(ZeroDivisionError), atomic.whole_file(str(tmp_path / "a")) as stream:
            stream.write(bytes(1 // 0))
        assert names(tmp_path) == []

    def test_the_disk_is_blamed_whatever_the_writer_makes_of_it(self, tmp_path, monkeypatch):
        def write():
            with atomic.whole_file(str(tmp_path / "a")) as stream:
                try:
                    stream.write(bytes(100_000))
                except OSError:
                    raise AttributeError("no _file") from None

        fill_up(monkeypatch, 0)
        with pytest.raises(FileError, match="No space left"):
            write()
        assert names(tmp_path) == []


class TestCheckOutput:
    def test_a_new_name_and_an_overwritten_one_pass(self, tmp_path):
        path = tmp_path / "out.fits"
        atomic.check_output(str(path), overwrite=False)
        assert list(tmp_path.iterdir()) == []
        path.write_bytes(b"old")
        atomic.check_output(str(path), overwrite=True)
        assert path.read_bytes() == b"old"

    @pytest.mark.parametrize(
        ("name", "error", "message"),
        [
            ("there.fits", FileError, "exists; give another name, or overwrite=True to"),
            ("missing/out.fits", FileError, "does not exist; create it first"),
            ("there.fits/out.fits", FileError, "cannot be written: Not a directory"),
            ("folder", FileError, "is not a regular file"),
            ("n" * 300 + ".fits", FileError, "cannot be written: File name too long"),
            ("new/", FileError, "is not the name of a file"),
            ("out.fits.gz", InputError, "is not compressed"),
        ],
    )
    def test_unusable_output(self, tmp_path, name, error, message):
        (tmp_path / "there.fits").touch()
        (tmp_path / "folder").mkdir()
        with pytest.raises(error, match=message):
            atomic.check_output(f"{tmp_path}/{name}", overwrite=False)

    def test_a_folder_that_takes_no_file(self):
        with pytest.raises(FileError, match=r"cannot be written to its folder"):
            atomic.check_output("/proc/out.fits", overwrite=False)

    def test_a_device_is_never_replaced(self):
        with pytest.raises(FileError, match="not a regular file"):
            atomic.check_output(os.devnull, overwrite=True)

    def test_an_input_is_never_replaced(self, tmp_path):
        path = str(tmp_path / "a.fits")
        fits.PrimaryHDU(IMAGE).writeto(path)
        (tmp_path / "link.fits").symlink_to(path)
        os.link(path, tmp_path / "hard.fits")
        for name in ("a.fits", "link.fits", "hard.fits"):
            output = str(tmp_path / name)
            with atomic.kept(["missing.fits", path]):
                with pytest.raises(InputError, match="is one of the inputs"):
                    atomic.check_output(output, overwrite=True)
                atomic.check_output(output, overwrite=True, is_updated=True)
            atomic.check_output(output, overwrite=True)


class TestCommandLine:
    """Every failure is one line on stderr, leaves earlier files whole, and no other behind."""

    COMMAND = (
        *("deconvolve", "a.fits", "--psf", "k.fits", "--n-iter", "1", "--engine", "numpy"),
        *("--stop", "none", "--exposure", "EXPTIME", "--quiet"),
    )

    @pytest.fixture(autouse=True)
    def folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        image = np.random.default_rng(1).poisson(20.0, (16, 12)) + 0.0
        primary = fits.PrimaryHDU(header=fits.Header({"EXPTIME": 30.0}))
        fits.HDUList([primary, fits.ImageHDU(image)]).writeto("a.fits")
        fits.writeto("k.fits", np.pad(np.ones((3, 3)), 2))

    def fails(self, capsys, message, *arguments, command=COMMAND):
        before = {path: path.read_bytes() for path in Path().glob("**/*") if path.is_file()}
        assert cli.main([*command, *arguments]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err == f"lnocl: error: {message}\n"
        after = {path: path.read_bytes() for path in Path().glob("**/*") if path.is_file()}
        assert {path: before[path] for path in after} == after
        return before.keys() - after.keys()

    def test_the_name_of_a_table_is_not_the_table(self, capsys):
        name = "x y\n1 2\n"
        message = "x y 1 2 cannot be read as a table: No such file or directory"
        self.fails(capsys, message, "--stars", name, "-o", "out.fits")
        Path(name).write_text("x y\n3 4\n")
        assert cli.main([*self.COMMAND, "--stars", name, "-o", "out.fits"]) == 0
        assert saved_results.read_result("out.fits").stars == [(3.0, 4.0)]

    def test_paths_in_a_header_lead_nowhere(self, tmp_path):
        names_of_files = ("EXTNAME", "FILENAME", "OBJECT", "ORIGIN", "CTYPE1", "DP1", "CPDIS1")
        with fits.open("a.fits", mode="update") as hdus:
            for hdu in hdus:
                hdu.header.update(dict.fromkeys(names_of_files, "../stray.fits"))
        assert cli.main([*self.COMMAND, "-o", "out.fits"]) == 0
        assert names(tmp_path) == ["a.fits", "k.fits", "out.fits"]
        assert not (tmp_path.parent / "stray.fits").exists()


checked_or_written = pytest.mark.parametrize(
    "work",
    [
        lambda path: atomic.check_output(path, overwrite=True),
        lambda path: atomic.write_text(path, "words", overwrite=True),
    ],
    ids=["check", "write"],
)


@checked_or_written
def test_signal_during_file_creation_leaves_no_file(work, tmp_path, monkeypatch):
    genuine = atomic._create

    def interrupted(path):
        genuine(path).close()
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic, "_create", interrupted)
    with pytest.raises(KeyboardInterrupt):
        work(str(tmp_path / "out.txt"))
    assert not list(tmp_path.iterdir())


def age(path, days=2):
    then = time.time() - 86400 * days
    os.utime(path, (then, then), follow_symlinks=False)
    return path


@checked_or_written
def test_temporary_file_of_a_killed_process_is_removed_after_a_day(work, tmp_path):
    code = (
        "import os, signal, sys; from lnocl.io import atomic\n"
        "with atomic.whole_file(sys.argv[1]) as stream:\n"
        "    stream.write(b'part'); stream.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    path = tmp_path / "out.txt"
    subprocess.run([sys.executable, "-c", code, path], check=False)
    (left,) = tmp_path.iterdir()
    work(str(path))
    assert left.exists()  # for a day, whoever has it
    age(left)
    atomic._remove_abandoned.cache_clear()
    work(str(path))
    assert not left.exists()


def test_temporary_file_of_a_running_process_is_not_removed(tmp_path):
    with atomic.whole_file(str(tmp_path / "one.txt")) as stream:
        stream.write(b"words")
        stream.flush()
        (temporary,) = tmp_path.iterdir()
        age(temporary)
        code = "import sys; from lnocl.io import atomic; atomic.write_text(sys.argv[1], 'words')"
        subprocess.run([sys.executable, "-c", code, tmp_path / "two.txt"], check=True)
    assert names(tmp_path) == ["one.txt", "two.txt"]


def test_folders_links_and_other_names_are_not_removed_as_temporary(tmp_path):
    name = ".lnocl-0123456789abcdef.tmp"
    (tmp_path / "folder" / name).mkdir(parents=True)
    (tmp_path / f"{name}.fits").write_text("mine")
    (tmp_path / name).symlink_to(tmp_path / f"{name}.fits")
    for path in tmp_path.iterdir():
        age(path)
    before = names(tmp_path)
    atomic.write_text(str(tmp_path / "folder" / "out.txt"), "words")
    atomic.check_output(str(tmp_path / "out.txt"), overwrite=True)
    assert names(tmp_path) == before
    assert names(tmp_path / "folder") == [name, "out.txt"]


def test_a_file_in_the_place_of_an_output_folder(tmp_path):
    path = tmp_path / "out"
    path.write_text("old")
    with pytest.raises(FileError) as caught:
        atomic.check_folder(str(path), overwrite=True)
    assert str(caught.value) == f"the output folder {path} cannot be used: it is not a folder"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes links of other users")
def test_a_link_of_another_user_where_all_may_write_is_not_followed(tmp_path):
    shared, victim = tmp_path / "shared", tmp_path / "victim.fits"
    shared.mkdir()
    shared.chmod(0o1777)
    victim.write_bytes(b"precious")
    link = shared / "out.fits"
    link.symlink_to(victim)
    os.lchown(link, 12345, 12345)
    with pytest.raises(FileError, match=r"is a link of another user in a folder that all may"):
        atomic.check_output(str(link), overwrite=True)
    with pytest.raises(FileError, match="is a link of another user"):
        atomic.write_text(str(link), "new", overwrite=True)
    assert victim.read_bytes() == b"precious"
    os.lchown(link, 0, 0)
    atomic.write_text(str(link), "new", overwrite=True)
    assert victim.read_bytes() == b"new"
