"""The command ``devices``: list the OpenCL devices, and measure what is fastest on one."""

from __future__ import annotations

import argparse

from lnocl.commands import messages, options
from lnocl.commands.declared import DEVICE
from lnocl.commands.parser import Command


def _run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from lnocl.opencl import device, trial
    from lnocl.opencl.tuning import describe_tuning

    if arguments.tune:
        _tune(arguments.device)
        return
    found, single = device.find_devices(), np.dtype(np.float32)
    choice = device.choose(None)
    messages.say(
        f"{device.spec_of(each)} {device.describe(each)}; {describe_tuning(each, single)}"
        for each in found
    )
    trial.check(choice.device)
    messages.say(
        [f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}"]
    )


def _tune(spec: str | None) -> None:
    from lnocl.opencl.device import choose, describe
    from lnocl.opencl.tuning import in_words, store
    from lnocl.studies import tuning

    device = choose(spec).device
    messages.say([f"iterations on {describe(device)}; this takes up to a minute"])
    chosen = {}
    for dtype, timed in tuning.measure(spec):
        chosen[dtype] = tuning.fastest(timed)
        rows = (
            f"{dtype.name}, {in_words(each.tuning, dtype)}: {each.ms:.2f} ms, {each.ratio:.2f} of "
            f"the first{'  <- taken from now on' if each.tuning == chosen[dtype] else ''}"
            for each in timed
        )
        messages.say(rows)
    messages.say([f"stored in {store(device, chosen)}"])


COMMAND = Command(
    "list the OpenCL devices, say which one is used and why, and measure what is fastest on it",
    {
        "": [
            options.option(
                "--tune",
                action="store_true",
                help="time iterations with vectors of several widths (CPU) or groups of several "
                "sizes (GPU), and use the fastest on this device from now on",
            ),
            DEVICE.but(needs=("tune",), help="with --tune: the device, as PLATFORM[:DEVICE]"),
        ]
    },
    _run,
)
