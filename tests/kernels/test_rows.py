"""The transforms along rows against their twins."""

import numpy as np
import pytest
from kernel_cases import DTYPES, agree_with_twins, harness_of

from lnocl.verify.harness import inputs

test_kernels_agree_with_their_twins = agree_with_twins("rows.cl")


@pytest.mark.parametrize("dtype", DTYPES.values())
@pytest.mark.parametrize("kernel", ["rfft_rows", "irfft_rows"])
def test_out_of_place_transforms_leave_their_inputs_alone(dtype, kernel):
    harness = harness_of("radices 8, 8 and 4, 8, 4", dtype)
    given = inputs(harness)
    packed = {
        "pixels": harness.layout.pack_pixels(given.pixels),
        "spectra": harness.layout.pack_spectra(given.spectrum[0]),
    }
    buffers = {name: harness.put(values) for name, values in packed.items()}
    harness.launch(kernel, **buffers)
    left = "pixels" if kernel == "rfft_rows" else "spectra"
    assert np.array_equal(harness.take(buffers[left], packed[left].shape), packed[left])
