"""Kernel, twin and test stand under one name each; what the comparison itself relies on."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from kernel_cases import FOLDER, harness_of, kernels_in
from kernel_comparison import KERNELS

from lnocl.core import reference
from lnocl.errors import DeviceError

FILES = sorted(path.stem for path in FOLDER.glob("*.cl") if kernels_in(path.name))


@pytest.mark.parametrize("name", FILES)
def test_kernel_twin_and_test_have_one_name(name):
    twins = Path(reference.__file__).parent / f"{name}.py"
    assert (Path(__file__).parent / f"test_{name}.py").is_file()
    for kernel in kernels_in(f"{name}.cl"):
        assert f"def {kernel}(" in twins.read_text(encoding="utf-8")
        assert callable(getattr(reference, kernel))
    assert f"| `{name}.cl` |" in (FOLDER / "README.md").read_text(encoding="utf-8")


def test_no_file_defines_a_macro_of_another():
    """Each program has all files, and there the later definition would hold without a word.

    But for the two ways of a transform, of which a program has one.
    """
    definition = re.compile(r"^ *# *define +(\w+)", re.MULTILINE)
    files = defaultdict(set)
    for path in FOLDER.glob("*.cl"):
        for name in definition.findall(path.read_text(encoding="ascii")):
            files[name].add("lines" if path.stem in ("scratch", "registers") else path.stem)
    assert "EVEN" in files
    assert not {name: where for name, where in files.items() if len(where) > 1}


def test_every_kernel_is_compared():
    kernels = {kernel for name in FILES for kernel in kernels_in(f"{name}.cl")}
    assert kernels == set(KERNELS)
    built = (harness_of(case, np.float32) for case in ("odd factors 3 and 5", "turned"))
    assert {name for each in built for name in each.program.arguments} == kernels


def test_writes_past_the_end_of_an_array_are_found():
    harness = harness_of("odd factors 3 and 5", np.float32)
    harness.forget()
    written, other = harness.put(np.zeros(4)), harness.put(np.zeros(4))
    assert not harness.take(other, 4).any()
    cl.enqueue_copy(harness.launcher.queue, written, np.ones(1, np.uint8), dst_offset=16)
    with pytest.raises(DeviceError, match="written past the end of an array"):
        harness.take(other, 4)
    harness.forget()
    assert not harness.take(other, 4).any()
