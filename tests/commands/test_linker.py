"""Commands that compile, on a machine without a linker."""

import os

import pytest

from lnocl.commands import cli
from lnocl.core.opencl import trial
from lnocl.errors import DeviceError


@pytest.mark.parametrize("command", ["demo", "selftest", "devices"])
def test_missing_linker_is_reported_before_any_other_output(command, tmp_path, monkeypatch, capsys):
    """So that the same command works once there is one."""

    def check(_):
        raise DeviceError("PoCL cannot link kernels: no linker was found")

    monkeypatch.setattr(trial, "check", check)
    monkeypatch.chdir(tmp_path)
    assert cli.main([command]) == 1
    said = capsys.readouterr()
    assert said.err == "lnocl: error: PoCL cannot link kernels: no linker was found\n"
    assert "lnocl uses" not in said.out
    assert "WRONG" not in said.out
    assert os.listdir() == []
