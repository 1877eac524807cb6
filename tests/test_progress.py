"""Progress: bars of phases within others, lines without a terminal, notebooks."""

import io
import sys
import time

import pytest
from screen import Screen

from lnocl import progress
from lnocl.progress import HIDDEN, Progress


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    """A clock of its own, which ticks each hundredth of a second."""
    monkeypatch.setattr(progress, "_CLOCK", progress._Clock())
    monkeypatch.setattr(progress, "CLOCK_INTERVAL", 0.01)
    monkeypatch.setattr(progress, "FIRST_LINE", 0.0)


def wait_until(is_so):
    end = time.monotonic() + 10.0
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_without_a_terminal_lines_tell_of_the_phase_that_began_last(monkeypatch, caplog):
    monkeypatch.setattr(progress, "LINE_INTERVAL", 0.02)
    caplog.set_level("INFO", "lnocl.progress")
    with Progress(3, "tile", True, "deconvolving") as tiles:
        tiles.update()
        wait_until(lambda: len(caplog.messages) == 2)
        assert set(caplog.messages) == {"deconvolving: tile 1 of 3, 0 s"}
        with Progress(None, "", True, "measuring"):
            wait_until(lambda: "measuring: 0 s" in caplog.messages)
        n = len(caplog.messages)
        wait_until(lambda: len(caplog.messages) > n)
        assert caplog.messages[-1] == "deconvolving: tile 1 of 3, 0 s"


def test_the_first_line_comes_at_once_and_the_next_after_a_minute(caplog):
    caplog.set_level("INFO", "lnocl.progress")
    for _ in range(3):
        with Progress(None, "", True, "measuring"):
            wait_until(lambda: caplog.messages)
            time.sleep(0.1)
    assert caplog.messages == ["measuring: 0 s"]


def test_bars_are_gone_at_the_end_and_the_clock_ticks_meanwhile(monkeypatch):
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    with Progress(None, "", True, "deconvolve"):
        with Progress(3, "tile", True, "tiles") as tiles:
            tiles.update(2)
            wait_until(lambda: "deconvolve: 00:01" in screen.getvalue())
        assert "tiles" in screen.getvalue()
    assert screen.getvalue().split("\r")[-2].strip() == ""


def test_a_notebook_without_widgets_has_a_plain_bar(monkeypatch, recwarn):
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    with Progress(3, "tile", True, "tiles") as tiles:
        tiles.update()
    assert "tiles:   0%" in stream.getvalue()
    assert not recwarn.list


def test_parts_of_another_one_are_hidden(monkeypatch):
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    token = HIDDEN.set(True)
    with Progress(3, "tile", True, "tiles") as tiles:
        tiles.update()
    HIDDEN.reset(token)
    assert screen.getvalue() == ""
