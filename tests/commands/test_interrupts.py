"""Signals that come while a command runs, sent where it calls something."""

import os
import pkgutil
import signal
from pathlib import Path

import pytest
from astropy.io import fits

from lnocl.commands import cli
from lnocl.commands.checkpoints import Interrupts
from lnocl.commands.signals import ENDING


@pytest.fixture
def interrupted(small_command, monkeypatch):
    """Return what runs the command in this process, and sends signals where it calls something."""
    # Which may be ignored here.
    before = {signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler)}
    before |= {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    words = [*small_command, "--engine", "numpy", "--n-iter", "3", "--residuals"]

    def interrupt(called, numbers, *more):
        genuine, due = pkgutil.resolve_name(called), list(numbers)

        def stand_in(*given, **options):
            while due:
                signal.raise_signal(due.pop(0))
            return genuine(*given, **options)

        with monkeypatch.context() as patch:
            patch.setattr(called, stand_in)
            return cli.main([*words, *more])

    yield interrupt
    for number, handler in before.items():
        signal.signal(number, handler)


def assert_whole(path):
    with fits.open(path, checksum=True) as hdus:
        names = ["STARS", "HISTORY", "MODELS", "RESIDUALS", "ELECTRONS", "PLAN", "MESSAGES"]
        names += ["ESTIMATE"]
        assert [hdu.name for hdu in hdus[1:]] == names
        assert (hdus[0].header["STOPPED"], hdus[0].header["NITER"]) == ("n_iter", 3)


def last_line(capsys):
    """Return the last line on stderr, after the faults of the result."""
    *warned, last = capsys.readouterr().err.splitlines()
    assert all(line.startswith("lnocl: warning: light lies all round") for line in warned)
    return last


IN_THE_END = [
    "lnocl.deconvolution.make_result",
    "lnocl.result.Result.models",
    "lnocl.commands.deconvolve.summary_lines",
    "lnocl.result.file.write_result",
    "lnocl.io.atomic.os.fsync",
]


@pytest.mark.parametrize("called", IN_THE_END)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_after_the_last_iteration_costs_nothing(called, number, interrupted, capsys):
    assert interrupted(called, [number], "-o", "found.fits") == 128 + number
    assert last_line(capsys) == (
        "lnocl: error: interrupted after the last iteration; the result is in found.fits"
    )
    assert_whole("found.fits")


def test_nor_does_it_where_no_iteration_was_left(interrupted, capsys):
    checkpoints = ("--checkpoint", "run.fits", "-o", "whole.fits")
    assert interrupted("lnocl.result.file.write_result", [], *checkpoints) == 0
    resume = ("--resume", "run.fits", "-o", "found.fits")
    assert interrupted("lnocl.result.file.write_result", [signal.SIGINT], *resume) == 130
    assert_whole("found.fits")


@pytest.mark.parametrize("called", ["lnocl.result.file.write_result", "lnocl.io.atomic.os.fsync"])
@pytest.mark.parametrize(
    ("second", "word"),
    [
        (signal.SIGINT, "interrupted"),
        (signal.SIGTERM, "terminated"),
        (signal.SIGHUP, "terminated"),
    ],
)
def test_a_second_one_ends_it_with_no_file(called, second, word, interrupted, capsys):
    before = os.listdir()
    assert interrupted(called, [signal.SIGINT, second], "-o", "found.fits") == 128 + second
    assert last_line(capsys) == f"lnocl: error: {word}"
    assert os.listdir() == before


def test_a_signal_that_was_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            interrupts.callback(1, None)
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_signal_handlers_are_restored_after_the_run():
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts() as interrupts:
        assert not interrupts.callback(1, None)
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("name", ["found.fits", "images.fits", "a.png"])
def test_a_checkpoint_in_the_place_of_other_files_is_refused(name, small_command, capsys):
    words = ["-o", "found.fits", "--plot", "a.png", "--checkpoint", name]
    assert cli.main([*small_command, *words]) == 2
    said = capsys.readouterr().err
    assert f" {name} is an output too" in said or f" {name} is one of the inputs" in said


def test_the_output_does_not_replace_the_checkpoint_gone_on_from(small_command, capsys):
    Path("run.fits").touch()
    assert cli.main([*small_command, "-o", "run.fits", "--resume", "run.fits"]) == 2
    assert "is one of the inputs" in capsys.readouterr().err
