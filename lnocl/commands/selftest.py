"""The command ``selftest``: try the kernels on a device, and say whether they are right."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from lnocl import __version__
from lnocl.commands.declared import DEVICE
from lnocl.commands.parser import Command


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.core.opencl import device, trial
    from lnocl.studies import selftest

    chosen = device.choose(arguments.device).device
    trial.check(chosen)
    name, rows = device.describe(chosen), []
    yield f"lnocl {__version__} on {name}, {chosen.version}; this takes up to a minute"
    for row in selftest.run(device.spec_of(chosen)):
        yield selftest.line(row)
        rows.append(row)
    yield selftest.verdict(rows, name)


COMMAND = Command(
    "try short reconstructions on a device, and say whether the kernels are right",
    {"": [DEVICE]},
    _run,
    "A row is a deviation from the NumPy reference, in units of the precision's rounding. Exit "
    "status: 0 all is right, 1 something is wrong, 2 wrong use.",
)
