"""The command line as a process: streams, signals, imports, devices."""

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commandline import GIVEN, NUMPY, PAPER, SHAPE, outside, run, without_progress

import lnocl
from lnocl.commands import cli
from lnocl.commands.parser import Command
from lnocl.core.opencl import device
from lnocl.core.opencl.tuning import candidates, chosen, describe_tuning
from lnocl.progress import Progress
from lnocl.studies import tuning

pytestmark = pytest.mark.usefixtures("command_folder")


# Of a run that ends early.


@pytest.mark.system
class TestProcess:
    ARGUMENTS = (
        *("deconvolve", "a.fits", "--psf", "k1.fits", "--n-iter", "1"),
        *(*PAPER, *GIVEN, *NUMPY),
    )

    def test_version_and_help_load_nothing_heavy(self):
        for option in ("--version", "--help"):
            script = (
                "import sys; from lnocl.commands.cli import main\n"
                f"try: main(['{option}'])\n"
                "finally: print(sorted({'astropy', 'pyopencl', 'scipy'} & set(sys.modules)))"
            )
            done = subprocess.run(
                [sys.executable, "-c", script], capture_output=True, text=True, check=True
            )
            *_, loaded = done.stdout.splitlines()
            assert loaded == "[]"
        assert outside("--version").stdout == f"lnocl {lnocl.__version__}\n"

    def test_a_reader_that_left_is_no_error(self):
        reading, writing = os.pipe()
        os.close(reading)
        done = outside(*self.ARGUMENTS, "-o", "out.fits", stdout=writing)
        os.close(writing)
        assert (done.returncode, without_progress(done.stderr)) == (0, "")
        assert fits.getdata("out.fits").shape == SHAPE

    def test_signal_during_error_output_ends_the_process_at_once(self):
        script = (
            "import os, signal, sys\n"
            "from lnocl.commands import cli\n"
            "from lnocl.commands import messages\n"
            "messages.fail = lambda *_: os.kill(os.getpid(), signal.SIGTERM)\n"
            "sys.exit(cli.main(['deconvolve', 'no.fits', '--psf', 'k1.fits', '-o', 'out.fits']))\n"
        )
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")

    @pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
    def test_a_full_stdout_is_one_line(self):
        with open("/dev/full", "w") as full:
            done = outside(*self.ARGUMENTS, "-o", "out.fits", stdout=full)
        assert done.returncode == 1
        assert without_progress(done.stderr) == "lnocl: error: [Errno 28] No space left on device\n"

    @pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&- >&- 2>&-"])
    @pytest.mark.parametrize(("mu", "status"), [("0", 0), ("-1", 2)])
    def test_closed_stream_causes_no_traceback(self, closed, mu, status):
        words = ["lnocl", *self.ARGUMENTS, "--mu", mu, "-o", "out.fits"]
        done = self.with_closed(closed, "-m", *words)
        assert done.returncode == status
        assert ("Traceback" in done.stderr, os.path.exists("out.fits")) == (False, status == 0)

    def with_closed(self, closed, *words):
        command = shlex.join([sys.executable, *words])
        return subprocess.run(["bash", "-c", f"{command} {closed}"], capture_output=True, text=True)

    @pytest.mark.parametrize("command", [["--help"], ["--version"], ["devices"]])
    def test_closed_stdout_is_no_error_for_help_version_and_devices(self, command):
        assert self.with_closed(">&-", "-m", "lnocl", *command).returncode == 0

    def test_no_file_gets_the_number_of_a_closed_stream(self):
        script = (
            "import os; from lnocl.commands.cli import main\n"
            "main(['devices']); print(os.open(os.devnull, os.O_RDONLY) > 2)"
        )
        done = self.with_closed("<&- 2>&-", "-c", script)
        assert done.stdout.splitlines()[-1] == "True"

    def test_a_library_s_bar_where_stderr_is_closed(self, monkeypatch):
        monkeypatch.setattr(sys, "stderr", None)
        with Progress(1, "it", True) as bar:
            bar.show(1, lambda: "done")

    @pytest.mark.parametrize(
        "command",
        [["selftest"], ["deconvolve", "a.fits", "--psf", "k1.fits", "--stop", "held-out",
                        "--n-iter", "100000", "--precision", "double", "-o", "out.fits"]],
    )  # fmt: skip
    def test_sigterm_ends_any_command_in_one_line_and_cleans_up(self, tmp_path, command):
        kernels = tmp_path / "kernels"
        kernels.mkdir()
        process = subprocess.Popen(
            [sys.executable, "-m", "lnocl", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"TMPDIR": str(kernels)},
        )
        # What each says first, before the first iteration.
        (process.stdout if command == ["selftest"] else process.stderr).readline()
        assert len(list(kernels.glob("lnocl-kernels-*"))) == 1
        process.send_signal(signal.SIGTERM)
        try:
            _, complaint = process.communicate(timeout=10)
        except subprocess.TimeoutExpired:  # it was lost, once in ten runs on a busy machine
            process.send_signal(signal.SIGTERM)
            _, complaint = process.communicate()
        assert (process.returncode, without_progress(complaint)) == (
            143,
            "lnocl: error: terminated\n",
        )
        assert list(kernels.iterdir()) == []
        assert not Path("out.fits").exists()

    def test_it_runs_in_a_thread_which_hears_no_signals(self):
        statuses = []
        thread = threading.Thread(target=lambda: statuses.append(run("--quiet")))
        thread.start()
        thread.join()
        assert statuses == [0]

    def test_ascii_stdout_escapes_other_characters(self):
        done = outside(*self.ARGUMENTS, "-o", "naïve.fits", PYTHONIOENCODING="ascii")
        assert without_progress(done.stderr) == ""
        assert done.stdout.endswith("; na\\xefve.fits\n")


@pytest.mark.parametrize("way", ["script", "module", "library"])
def test_an_interrupt_while_modules_are_loaded_is_one_line(way, tmp_path):
    """Here a NumPy that is interrupted as it is imported."""
    (tmp_path / "numpy.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n")
    script = "from lnocl.commands.cli import main\nraise SystemExit(main())\n"
    (tmp_path / "lnocl").write_text(script)
    path = os.pathsep.join([str(tmp_path), str(Path(lnocl.__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, *{"script": [tmp_path / "lnocl"], "module": ["-m", "lnocl"],
                           "library": ["-c", script]}[way]],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        # Whoever runs the tests in the background may ignore it.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    if way == "library":
        assert done.stderr.endswith("KeyboardInterrupt\n")
    else:
        assert (done.returncode, without_progress(done.stderr)) == (
            130,
            "lnocl: error: interrupted\n",
        )


@pytest.mark.skipif(sys.platform != "linux", reason="others do not limit the address space")
@pytest.mark.parametrize("threads", ["1", ""])
def test_a_limit_of_memory_that_is_too_low_is_one_line_at_once(threads):
    """OpenBLAS would ask for its memory for ever, and hear no signal."""
    words = f"ulimit -v 200000; exec {shlex.quote(sys.executable)} -m lnocl detect a.fits"
    done = subprocess.run(
        ["bash", "-c", words],
        capture_output=True,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": threads},
        timeout=100,
    )
    assert (done.returncode, done.stdout) == (1, "")
    said = r"lnocl: error: not enough memory: \d+ MiB are needed; raise ulimit -v"
    if threads != "1" and os.cpu_count() > 1:
        said += ", or give OPENBLAS_NUM_THREADS=1"
    assert re.fullmatch(said, done.stderr.strip())


class TestDevices:
    def test_devices_command_lists_devices_and_the_reason_for_the_choice(self, capsys):
        assert cli.main(["devices"]) == 0
        *listed, used = capsys.readouterr().out.splitlines()
        found = device.find_devices()
        dtype = np.dtype(np.float32)
        assert listed == [
            f"{device.spec_of(each)} {device.describe(each)}; {describe_tuning(each, dtype)}"
            for each in found
        ]
        choice = device.choose(None)
        assert used == (
            f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}"
        )

    def test_fastest_tuning_is_measured_once_and_then_used(self, capsys, monkeypatch, tmp_path):
        """The times are made up: the second tuning is the faster one in single precision alone."""
        monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
        tried = {np.dtype(t): candidates(device.choose().device, np.dtype(t)) for t in "fd"}

        def measure(spec):
            for dtype, ratio in zip(tried, (0.8, 0.98), strict=True):
                first, second, *_ = tried[dtype]
                yield dtype, [tuning.Timed(first, 5.0, 1.0), tuning.Timed(second, 4.0, ratio)]

        monkeypatch.setattr(tuning, "measure", measure)
        assert cli.main(["devices", "--tune"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.endswith("<- taken from now on") for line in lines[1:5]] == [0, 1, 1, 0]
        (file,) = tmp_path.glob("*.tunings")
        assert lines[-1] == f"stored in {file}"
        assert cli.main(["devices"]) == 0
        assert ", as measured" in capsys.readouterr().out
        for dtype, index in zip(tried, (1, 0), strict=True):
            assert chosen(device.choose().device, dtype) == tried[dtype][index]


def test_the_clock_of_a_command_begins_before_its_work_and_ends_before_its_lines(monkeypatch):
    """Also that of one that returns its lines at once."""
    shown = []

    class Clock:
        def __init__(self, total, unit, is_shown, name=""):
            self.name = name

        def __enter__(self):
            shown.append(f"begin {self.name}")

        def __exit__(self, *exception):
            shown.append(f"end {self.name}")

    monkeypatch.setattr("lnocl.commands.parser.Progress", Clock)
    work = Command("", {}, lambda arguments: [shown.append("work") or "done"])
    lines = work.carry_out(argparse.Namespace(quiet=False, command_name="detect"))
    assert next(lines) == "done"
    assert shown == ["begin detect", "work", "end detect"]
