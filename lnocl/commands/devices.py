"""The command ``devices``: list the OpenCL devices."""

from __future__ import annotations

import argparse

from lnocl.commands import messages
from lnocl.commands.parser import Command


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.opencl import device

    found = device.find_devices()
    choice = device.choose(None)
    messages.say(
        [
            *(f"{device.spec_of(each)} {device.describe(each)}" for each in found),
            f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}",
        ]
    )


COMMAND = Command("list the OpenCL devices, and say which one is used and why", {}, _run)
