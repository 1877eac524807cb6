"""The NumPy twin of every kernel, in float64, under the kernel's name.

A twin takes and returns arrays in their natural order, where the kernel has its own layout
(`lnocl.core.opencl.layout`). Row spectra are half spectra along x alone, shape (..., Ny, Nx // 2 +
1).
"""

from lnocl.core.reference.columns import fft_columns, ifft_columns
from lnocl.core.reference.convolve import convolve_columns, correlate_columns, otf_columns
from lnocl.core.reference.decide import collect_sums, follow_stars
from lnocl.core.reference.ratio import ratio_rows
from lnocl.core.reference.rows import irfft_rows, rfft_rows
from lnocl.core.reference.scale import scale_rows
from lnocl.core.reference.smooth import smooth
from lnocl.core.reference.step import gradient_rows, shortened, step_rows
from lnocl.core.reference.transmit import gather_rows, transmit_rows
from lnocl.core.reference.turn import (
    irfft_sheared,
    ratio_sheared,
    rfft_sheared,
    sample_lines,
    unshear_columns,
)
