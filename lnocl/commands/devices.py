"""The command ``devices``: list the OpenCL devices, and measure what is fastest on one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from lnocl.commands import options
from lnocl.commands.declared import DEVICE
from lnocl.commands.parser import Command


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    import numpy as np

    from lnocl.core.opencl import device, trial
    from lnocl.core.opencl.tuning import describe_tuning

    if arguments.tune:
        yield from _tune(arguments.device)
        return
    found, single = device.find_devices(), np.dtype(np.float32)
    choice = device.choose(None)
    for each in found:
        yield f"{device.spec_of(each)} {device.describe(each)}; {describe_tuning(each, single)}"
    trial.check(choice.device)
    yield f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}"


def _tune(spec: str | None) -> Iterator[str]:
    from lnocl.core.opencl.device import choose, describe
    from lnocl.core.opencl.tuning import in_words, store
    from lnocl.studies import tuning

    device = choose(spec).device
    yield f"iterations on {describe(device)}; this takes up to a minute"
    chosen = {}
    for dtype, timed in tuning.measure(spec):
        chosen[dtype] = tuning.fastest(timed)
        for each in timed:
            taken = "  <- taken from now on" if each.tuning == chosen[dtype] else ""
            yield (
                f"{dtype.name}, {in_words(each.tuning, dtype)}: {each.ms:.2f} ms, "
                f"{each.ratio:.2f} of the first{taken}"
            )
    yield f"stored in {store(device, chosen)}"


COMMAND = Command(
    "list the OpenCL devices, and say which is used and why; or tune one of them",
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
