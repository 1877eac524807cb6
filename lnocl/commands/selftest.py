"""The command ``selftest``: try the kernels on a device, and say whether they are right."""

from __future__ import annotations

import argparse

from lnocl import __version__
from lnocl.commands import messages
from lnocl.commands.declared import DEVICE
from lnocl.commands.parser import Command


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.opencl import device, trial
    from lnocl.verify import selftest

    chosen = device.choose(arguments.device).device
    trial.check(chosen)
    messages.say(
        [
            f"lnocl {__version__} on {device.describe(chosen)}, {chosen.version}; this takes up to "
            "a minute"
        ]
    )
    rows = selftest.run(chosen)
    messages.say(selftest.table(rows))
    messages.say([selftest.verdict(rows, chosen)])


COMMAND = Command(
    "try every kernel and short deconvolutions on a device, and say whether they are right",
    {"": [DEVICE]},
    _run,
    "Exit status: 0 all is right, 1 something is wrong, 2 wrong use.",
)
