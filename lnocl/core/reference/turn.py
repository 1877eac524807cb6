"""The second and third shear of images that are turned: the twins of kernels/turn.cl.

The first is in the phases of `convolve_columns` and `correlate_columns`;
`lnocl.core.scene.rotation` has all three, and the steps of larger pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.reference.ratio import compare
from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.line_weights import shifted, sums_of_lines


def irfft_sheared(row_spectra: ComplexArray) -> Array:
    """Return the pixels of a sky after its first shear."""
    return irfft_rows(row_spectra)


def ratio_sheared(
    sheared: Array,
    column_shifts: Array,
    image_shifts: Array,
    images: Array,
    weights: NDArray[Any] | None,
    background: Array,
    star_images: Array,
    star_fluxes: Array,
) -> tuple[Array, float, Array]:
    """Return ``r_j - w_j`` after the adjoint of the third shear, the data term and the star sums.

    As `ratio_rows`, with ``A_j f`` from the sky after its first shear, shape (p, Ny, Nx): its
    columns are shifted by `column_shifts`, shape (p, Nx), then its rows by `image_shifts`, (p, Ny).
    Of images with fewer pixels each `oversample`-th is one, and 0 is in the others.
    """
    oversample = sheared.shape[-1] // images.shape[-1]
    seen = np.array(
        [
            shifted(shifted(pixels.T, along_y, 1).T, along_x, 1)
            for pixels, along_y, along_x in zip(sheared, column_shifts, image_shifts, strict=True)
        ]
    )
    excess, objective, star_sums = compare(
        seen[:, ::oversample, ::oversample], images, weights, background, star_images, star_fluxes
    )
    laid = np.zeros_like(sheared)
    laid[:, ::oversample, ::oversample] = excess
    back = [shifted(each, shifts, -1) for each, shifts in zip(laid, image_shifts, strict=True)]
    return np.array(back), objective, star_sums


def rfft_sheared(sheared: Array, column_shifts: Array) -> ComplexArray:
    """Return the row spectra of pixels after the adjoint of the second shear."""
    return rfft_rows(unshear_columns(sheared, column_shifts))


def unshear_columns(sheared: Array, column_shifts: Array) -> Array:
    """Return pixels after the adjoint of the second shear."""
    back = [
        shifted(each.T, shifts, -1).T for each, shifts in zip(sheared, column_shifts, strict=True)
    ]
    return np.array(back)


def sample_lines(
    lines: NDArray[Any], firsts: NDArray[np.int_], weights: Array, axis: int
) -> NDArray[Any]:
    """Return sums of lines along an axis, round its end: ``sum_k w_ik x(firsts_i + k)``."""
    return sums_of_lines(lines, firsts, weights, axis)
