r"""Images that are turned against the sky: rotation by three shears.

A rotation by up to 45 degrees is a shear along x, one along y, and one along x (Unser, Thevenaz &
Yaroslavsky, IEEE Trans. Image Process. 4, 1371, 1995, Eq. 3). The first is a phase in the spectrum
of each row, and exact. Each of the others shifts whole lines by one fraction of a pixel, by six
weights. What these weights do to a frequency is undone before, in the OTF, as a transform on
unequal points does it (Barnett, Magland & af Klinteberg, SIAM J. Sci. Comput. 41, C479, 2019). So
they are right to 5e-5 up to 0.3 cycles per pixel, and to 1.3e-4 at 0.35.

Quarter turns and flips are done by index.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.arrays import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Weights of a shift, and the parameter of their Kaiser-Bessel window: of the least error up to 0.35
# cycles per pixel.
TAPS = 6
BETA = 11.75
# Rows whose phases are products of two that are tabled: that of the first row of so many, and that
# of a row among them.
PHASE_ROWS = 16
# Pixels round a PSF that is turned, in which its ringing dies out, and the step of its side.
MARGIN, STEP = 16, 32
# Fractions of a pixel, and frequencies, on which the window's own effect is averaged.
FRACTIONS, FREQUENCIES = 64, 513


def shift_weights(fractions: Array) -> Array:
    """Return the weights, shape (..., TAPS), that shift a line by fractions of a pixel, 0 to 1.

    Point i becomes ``sum_k w_k f(i - TAPS / 2 + 1 + k)``. Their sum is 1, so that flux is kept.
    """
    distance = np.asarray(fractions)[..., None] + (TAPS / 2 - 1 - np.arange(TAPS))
    window = np.i0(BETA * np.sqrt(np.clip(1.0 - (2.0 * distance / TAPS) ** 2, 0.0, None)))
    return np.asarray(window / window.sum(axis=-1, keepdims=True))


def _own_effect() -> tuple[Array, Array]:
    """Return frequencies, cycles per pixel, and by what the weights' effect on them is undone.

    It is the factor of least mean squared error over all fractions of a pixel.
    """
    frequencies = np.linspace(0.0, 0.5, FREQUENCIES)
    fractions = (np.arange(FRACTIONS) + 0.5) / FRACTIONS
    places = np.arange(TAPS) - TAPS / 2 + 1 - fractions[:, None]
    phases = np.exp(2j * np.pi * frequencies * places[..., None])
    gains = np.einsum("ik,ikf->if", shift_weights(fractions), phases)
    return frequencies, gains.real.mean(axis=0) / (abs(gains) ** 2).mean(axis=0)


_EFFECT = _own_effect()


def _undone(frequencies: Array) -> Array:
    return np.interp(abs(frequencies), *_EFFECT)


class Rotation:
    """The map from a convolved sky to an image that is turned against it, and its adjoint.

    A source at x in the sky is at ``X = M x + t`` in the image, M a rotation. So the image is
    ``g(X) = f(M^-1 (X - t))``. With ``p = tan(a / 2)`` and ``q = -sin a``,

    - rows y of the sky are shifted by ``p y``;
    - columns w of that by ``q w - t_y``, which gives the rows Y of the image;
    - rows Y of that by ``p (Y - t_y) - t_x``.

    Parameters
    ----------
    angle : float
        a, radians, from the x axis towards the y axis, at most 45 degrees either way.
    shift : ndarray of float64, shape (2,)
        t, pixels.
    grid : tuple of int
        Shape (Ny, Nx) of both, periodic.
    shape : tuple of int
        Shape of the image at the grid's origin; pixels beyond it are of no use.

    Attributes
    ----------
    row_shifts : ndarray of float64, shape (Ny,)
        Of the first shear.
    column_shifts : ndarray of float64, shape (Nx,)
        Of the second.
    image_shifts : ndarray of float64, shape (Ny,)
        Of the third.
    """

    def __init__(
        self, angle: float, shift: Array, grid: tuple[int, int], shape: tuple[int, int]
    ) -> None:
        self.angle, self.grid = angle, grid
        ny, nx = grid
        p, q = math.tan(angle / 2.0), -math.sin(angle)
        (x, y), rows = shift, np.arange(ny)
        self.image_shifts = p * (rows - y) - x
        # The columns, and the rows, that the image is made of lie in the middle of a period.
        height, width = shape
        first, last = p * -y - x, p * (height - 1 - y) - x
        w = min(first, last), width - 1 + max(first, last)
        columns = _signed(nx, sum(w) / 2.0, 1)
        self.column_shifts = q * columns - y
        used = q * np.array(w) - y
        middle = float(used.mean() + (height - 1) / 2.0)
        self.phase_rows = math.gcd(ny, PHASE_ROWS)
        self.row_shifts = p * _signed(ny, middle, self.phase_rows)

    def forward(self, sky: Array) -> Array:
        """Return the image of a sky convolved with `spectrum`, both of shape (Ny, Nx)."""
        sheared = self._phased(sky, self.row_phases())
        sheared = shifted(sheared.T, self.column_shifts, 1).T
        return shifted(sheared, self.image_shifts, 1)

    def adjoint(self, image: Array) -> Array:
        """Return the adjoint of `forward`."""
        sheared = shifted(image, self.image_shifts, -1)
        sheared = shifted(sheared.T, self.column_shifts, -1).T
        return self._phased(sheared, self.row_phases().conj())

    def _phased(self, rows: Array, phases: NDArray[np.complex128]) -> Array:
        return np.fft.irfft(np.fft.rfft(rows, axis=1) * phases, self.grid[1], axis=1)

    def phase_tables(
        self, frequencies: NDArray[Any]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return phases of the first shear at frequencies, cycles per pixel.

        Those of the first of `phase_rows` rows each, and what a row among them has more: each row's
        is the product of the two.
        """
        step, shifts = self.phase_rows, self.row_shifts
        first, then = shifts[::step], shifts[:step] - shifts[0]
        tables = [np.exp(2j * np.pi * np.outer(each, frequencies)) for each in (first, then)]
        return tables[0], tables[1]

    def row_phases(self) -> NDArray[np.complex128]:
        """Return the phases of the first shear, shape (Ny, Nx // 2 + 1).

        At the highest frequency, which has no sign, it is the mean of both: a cosine.
        """
        first, then = self.phase_tables(np.fft.rfftfreq(self.grid[1]))
        phases = (first[:, None] * then).reshape(self.grid[0], -1)
        phases[:, -1] = phases[:, -1].real
        return np.asarray(phases)

    def matrix(self, shape: tuple[int, int]) -> csr_array:
        """Return the second and the third shear as a matrix, for the first pixels of the image.

        Its columns are the pixels of the grid, its rows those of a window of this shape.
        """
        from scipy.sparse import csr_array  # which takes its time to load

        (ny, nx), (height, width) = self.grid, shape
        along_x, x_weights = whole_and_weights(self.image_shifts[:height])
        along_y, y_weights = whole_and_weights(self.column_shifts)
        taps = np.arange(TAPS) - TAPS // 2 + 1
        x = (np.arange(width)[:, None] + along_x[:, None, None] + taps) % nx
        y = (np.arange(height)[:, None, None, None] + along_y[x][..., None] + taps) % ny
        weights = x_weights[:, None, :, None] * y_weights[x]
        starts = TAPS**2 * np.arange(height * width + 1)
        places = (y * nx + x[..., None]).ravel()
        return csr_array((weights.ravel(), places, starts), shape=(height * width, ny * nx))

    def undone(self) -> Array:
        """Return by what the effect of the weights on the sky is undone, for its rfft2."""
        ny, nx = self.grid
        u, v = np.fft.rfftfreq(nx)[None, :], np.fft.fftfreq(ny)[:, None]
        along_y = v + math.tan(self.angle / 2.0) * u
        along_x = u - math.sin(self.angle) * along_y
        return _undone(along_y) * _undone(along_x)


def _signed(n: int, middle: float, step: int) -> Array:
    """Return the place that each point of a period stands for, those nearest to a middle.

    The period is cut at a multiple of a step.
    """
    first = step * round((middle - n / 2.0) / step)
    return np.asarray((np.arange(n) - first) % n + first, float)


def whole_and_weights(shifts: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the whole pixels of shifts, shape (n,), and the weights of what is left."""
    whole = np.floor(shifts)
    return whole.astype(int), shift_weights(shifts - whole)


def shifted(rows: Array, shifts: Array, sign: int) -> Array:
    """Return rows, each shifted round its end; the adjoint for a sign of -1."""
    whole, weights = whole_and_weights(shifts)
    n = rows.shape[1]
    total = np.zeros_like(rows)
    for k in range(TAPS):
        places = np.arange(n) + sign * (whole[:, None] - TAPS // 2 + 1 + k)
        total += weights[:, k, None] * np.take_along_axis(rows, places % n, axis=1)
    return total


def turned_psf(psf: Array, angle: float) -> Array:
    """Return a PSF as the sky sees it, ``K'(u) = K(M u)``, with its centre at ``n // 2``.

    It is turned by the phases of its rows and columns, exactly where it is limited to the
    frequencies that its pixels can hold.
    """
    n = STEP * math.ceil((math.hypot(*psf.shape) + 2 * MARGIN) / STEP)
    y, x = (n // 2 - k // 2 for k in psf.shape)
    laid = np.zeros((n, n))
    laid[y : y + psf.shape[0], x : x + psf.shape[1]] = psf
    places = np.arange(n) - n // 2
    along_x, along_y = -math.tan(angle / 2.0), math.sin(angle)
    for slope, axis in ((along_x, 1), (along_y, 0), (along_x, 1)):
        phases = np.exp(2j * np.pi * np.outer(slope * places, np.fft.rfftfreq(n)))
        spectra = np.fft.rfft(laid, axis=axis) * (phases if axis else phases.T)
        laid = np.fft.irfft(spectra, n, axis=axis)
    return laid
