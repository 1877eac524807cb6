"""What tests need of the OpenCL runtime that they run on."""

import pytest

from lnocl.core.opencl import device

on_pocl = pytest.mark.skipif(
    device.choose().device.platform.name != "Portable Computing Language",
    reason="only PoCL's compiled kernels are kept by lnocl",
)
