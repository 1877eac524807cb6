"""Where several OpenCL runtimes are installed: that they agree."""

import pytest
from scenes import Recipe, worst

from lnocl.core.opencl.device import find_devices, spec_of

pytestmark = pytest.mark.system

RECIPE = Recipe((20, 50), 3, 1, mu=1e-3, masked=0.03, background="map", read_noise=(0.5, 1.0, 1.5))
# Of extended source and star fluxes after 1000 iterations. PoCL 3.0, PoCL 3.1 and Intel's CPU
# runtime agreed bit for bit; compilers may fuse multiply and add otherwise and still be right.
BOUNDS = {"single": 1e-6, "double": 1e-14}


@pytest.mark.parametrize("precision", BOUNDS)
def test_runtimes_agree_after_a_thousand_iterations(precision):
    specs = [spec_of(device) for device in find_devices()]
    if len(specs) < 2:
        pytest.skip("only one OpenCL device here")
    made = RECIPE.make()
    first, *others = (made.deconvolve(precision=precision, device=spec) for spec in specs)
    for other in others:
        assert other.device != first.device
        assert worst(other.extended, first.extended) <= BOUNDS[precision]
        assert worst(other.star_fluxes, first.star_fluxes) <= BOUNDS[precision]
