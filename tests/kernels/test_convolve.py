"""Products with OTFs against their twins, and the adjoint."""

import numpy as np
import pytest
from kernel_cases import agree_with_twins, harness_of, in_each_precision

test_kernels_agree_with_their_twins = agree_with_twins("convolve.cl")


@in_each_precision
def test_adjoint_dot_product(dtype):
    """<A f, r> = <f, A^T r> for an asymmetric PSF whose peak is far from the origin."""
    harness = harness_of("radices 8, 8 and 4, 8, 4", dtype)
    rng = np.random.default_rng(3)
    f, r, psf = rng.random(harness.grid), rng.random(harness.grid), np.zeros(harness.grid)
    psf[5:9, 20:31] = rng.random((4, 11))
    spectra, pixels = harness.empty_spectra(), harness.put_pixels(psf[None])
    otf = {
        "otfs": harness.put(np.zeros((1, *harness.grid))),
        "otf_edges": harness.put(np.zeros((1, harness.grid[0], 2))),
        "n_images": 1,
    }
    harness.launch("rfft_rows", spectra=spectra, pixels=pixels)
    harness.launch("otf_columns", spectra=spectra, image=0, **otf)

    def apply(kernel, image):
        harness.launch("rfft_rows", spectra=spectra, pixels=harness.put_pixels(image[None]))
        harness.launch(kernel, spectra=spectra, **otf)
        # irfft_rows wants half of what rfft_rows gives; the OTF has taken care of that.
        harness.launch("irfft_rows", spectra=spectra, pixels=pixels)
        return harness.take_pixels(pixels)[0]

    forward = (apply("convolve_columns", f) * r).sum()
    backward = (f * apply("correlate_columns", r)).sum()
    assert forward == pytest.approx(backward, rel={np.float32: 1e-7, np.float64: 3e-16}[dtype] * 4)
