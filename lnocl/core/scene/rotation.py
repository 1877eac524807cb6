r"""Images that are turned against the sky, or have larger pixels: rotation by three shears.

A rotation by up to 45 degrees is a shear along x, one along y, and one along x (Unser, Thevenaz &
Yaroslavsky, IEEE Trans. Image Process. 4, 1371, 1995, Eq. 3). The first is a phase in the spectrum
of each row, and exact. Each of the others shifts whole lines by one fraction of a pixel
(`lnocl.core.scene.line_weights`). A change of scale goes with any shear, so after the first of them
the rows and columns are taken in the steps of an image's larger pixels.

Quarter turns and flips are done by index.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.line_weights import TAPS, LineSampling, shifted, undone, whole_and_weights
from lnocl.core.scene.shifting import MARGIN
from lnocl.core.scene.transforms import enlarged, rotation

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Rows whose phases are products of two that are tabled: that of the first row of so many, and that
# of a row among them.
PHASE_ROWS = 16
# The step of the side of a PSF that is turned, pixels.
STEP = 32


class Rotation:
    """The map from a convolved sky to an image that is turned against it, and its adjoint.

    A source at x in the sky is at ``X = M x / s + t`` in the image, M a rotation. So the image is
    ``g(X) = f(s M^-1 (X - t))``. With ``w = x / s``, ``p = tan(a / 2)`` and ``q = -sin a``,

    - rows y of the sky are shifted by ``p y``;
    - of rows and columns those in steps of s are taken: rows and columns w;
    - columns w of that are shifted by ``q w - t_y``, which gives the rows Y of the image;
    - rows Y of that by ``p (Y - t_y) - t_x``.

    With s > 1 fractions of t are in the steps, not in the shears.

    Parameters
    ----------
    angle : float
        a, radians, from the x axis towards the y axis, at most 45 degrees either way.
    shift : ndarray of float64, shape (2,)
        t, pixels.
    grid : tuple of int
        Shape (Ny, Nx) of both, periodic.
    box : tuple of range
        Rows and columns of the image whose pixels are used.
    scale : float
        s, pixels of the sky to one of the image along each axis, 1 or more.

    Attributes
    ----------
    row_shifts : ndarray of float64, shape (Ny,)
        Of the first shear.
    column_shifts : ndarray of float64, shape (Nx,)
        Of the second.
    image_shifts : ndarray of float64, shape (Ny,)
        Of the third.
    samplings : tuple of LineSampling
        Of rows, and of columns; empty where s is 1.
    """

    def __init__(
        self,
        angle: float,
        shift: Array,
        grid: tuple[int, int],
        box: tuple[range, range],
        scale: float = 1.0,
    ) -> None:
        self.angle, self.scale, self.grid = angle, scale, grid
        ny, nx = grid
        p, q = math.tan(angle / 2.0), -math.sin(angle)
        whole = shift if scale == 1.0 else np.round(shift)
        lag_x, lag_y = scale * (rotation(-angle) @ (shift - whole))
        (x, y), rows = whole, np.arange(ny)
        self.image_shifts = p * (rows - y) - x
        # The columns, and the rows, that the image is made of lie in the middle of a period.
        (top, bottom), (left, right) = ((each[0], each[-1]) for each in box)
        w = left + right + p * (top + bottom - 2 * y) - 2 * x  # of its corners, twice
        columns = _signed(nx, w / 2.0, 1)
        self.column_shifts = q * columns - y
        middle = q * w / 2.0 - y + (top + bottom) / 2.0
        self.phase_rows = math.gcd(ny, PHASE_ROWS)
        of_sky = _signed(ny, scale * middle - lag_y, self.phase_rows)
        self.row_shifts = p * (of_sky + lag_y)
        self.samplings: tuple[LineSampling, ...] = ()
        if scale != 1.0:
            along_x = _signed(nx, scale * w / 2.0 - lag_x, 1)
            self.samplings = (
                LineSampling(scale * _signed(ny, middle, 1) - lag_y, int(of_sky.min())),
                LineSampling(scale * columns - lag_x, int(along_x.min())),
            )

    def forward(self, sky: Array) -> Array:
        """Return the image of a sky convolved with `spectrum`, both of shape (Ny, Nx)."""
        sheared = self.sampled(self._phased(sky, self.row_phases()))
        sheared = shifted(sheared.T, self.column_shifts, 1).T
        return shifted(sheared, self.image_shifts, 1)

    def adjoint(self, image: Array) -> Array:
        """Return the adjoint of `forward`."""
        sheared = shifted(image, self.image_shifts, -1)
        sheared = shifted(sheared.T, self.column_shifts, -1).T
        return self._phased(self.spread(sheared), self.row_phases().conj())

    def sampled(self, sheared: Array) -> Array:
        """Interpolate the once-sheared sky at the image's pixels."""
        for axis, sampling in enumerate(self.samplings):
            sheared = sampling.forward(sheared, axis)
        return sheared

    def spread(self, sheared: Array) -> Array:
        """Return the adjoint of `sampled`."""
        for axis, sampling in enumerate(self.samplings):
            sheared = sampling.adjoint(sheared, axis)
        return sheared

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

    def matrix(self, shape: tuple[int, int], step: int = 1) -> csr_array:
        """Return the second and the third shear as a matrix, for the first pixels of the image.

        Its columns are the pixels of the grid, its rows each `step`-th along both axes, in a window
        of this shape.
        """
        from scipy.sparse import csr_array  # which takes its time to load

        (ny, nx), (height, width) = self.grid, shape
        along_x, x_weights = whole_and_weights(self.image_shifts[: step * height : step])
        along_y, y_weights = whole_and_weights(self.column_shifts)
        taps = np.arange(TAPS) - TAPS // 2 + 1
        x = (step * np.arange(width)[:, None] + along_x[:, None, None] + taps) % nx
        y = (step * np.arange(height)[:, None, None, None] + along_y[x][..., None] + taps) % ny
        weights = x_weights[:, None, :, None] * y_weights[x]
        starts = TAPS**2 * np.arange(height * width + 1)
        places = (y * nx + x[..., None]).ravel()
        return csr_array((weights.ravel(), places, starts), shape=(height * width, ny * nx))

    def undone(self) -> Array:
        """Return by what the effect of the weights on the sky is undone, for its rfft2."""
        ny, nx = self.grid
        u, v = np.fft.rfftfreq(nx)[None, :], np.fft.fftfreq(ny)[:, None]
        along_y = v + math.tan(self.angle / 2.0) * u
        effect = np.ones(along_y.shape)
        for sampling, frequencies in zip(self.samplings, (along_y, u), strict=bool(self.samplings)):
            effect *= undone(sampling.places, frequencies)
        along_y, u = self.scale * along_y, self.scale * u
        along_x = u - math.sin(self.angle) * along_y
        effect *= undone(self.column_shifts, along_y) * undone(self.image_shifts, along_x)
        return effect


def _signed(n: int, middle: float, step: int) -> Array:
    """Return the place that each point of a period stands for, those nearest to a middle.

    The period is cut at a multiple of a step.
    """
    first = step * round((middle - n / 2.0) / step)
    return np.asarray((np.arange(n) - first) % n + first, float)


def cropped(psf: Array) -> Array:
    """Return a PSF without the rows and columns of 0 round it, its centre at ``n // 2``."""
    y, x = (k // 2 for k in psf.shape)
    rows, columns = np.nonzero(psf)
    down, along = int(abs(rows - y).max()), int(abs(columns - x).max())
    return psf[max(y - down, 0) : y + down + 1, max(x - along, 0) : x + along + 1]


def turned_psf(psf: Array, angle: float, scale: float = 1.0) -> Array:
    """Return a PSF as the sky sees it, ``K'(u) = K(M u / s) / s^2``, with its centre at ``n // 2``.

    It is made finer, and turned, by the phases of its rows and columns: exactly where it is limited
    to the frequencies that its pixels can hold.
    """
    psf = psf if scale == 1.0 else cropped(psf)
    n = STEP * math.ceil((math.hypot(*psf.shape) + 2 * MARGIN) / STEP)
    laid = enlarged(psf, (n, n), is_centred=True)
    if scale != 1.0:
        laid, n = _finer(laid, scale), STEP * math.ceil(n * scale / STEP)
    places = np.arange(n) - n // 2
    along_x, along_y = -math.tan(angle / 2.0), math.sin(angle)
    for slope, axis in ((along_x, 1), (along_y, 0), (along_x, 1)):
        phases = np.exp(2j * np.pi * np.outer(slope * places, np.fft.rfftfreq(n)))
        spectra = np.fft.rfft(laid, axis=axis) * (phases if axis else phases.T)
        laid = np.fft.irfft(spectra, n, axis=axis)
    return laid


def _finer(psf: Array, scale: float) -> Array:
    """Return a PSF about the middle of a square on pixels that are smaller by a factor."""
    n = len(psf)
    n_finer = STEP * math.ceil(n * scale / STEP)
    places = (np.arange(n_finer) - n_finer // 2) / scale
    frequencies = np.fft.fftfreq(n)
    # Its place in the middle, and that the highest frequency has no sign.
    waves = np.exp(2j * np.pi * np.outer(places + n // 2, frequencies)) / n / scale
    if n % 2 == 0:
        waves[:, n // 2] = np.cos(np.pi * (places + n // 2)) / n / scale
    waves[abs(places) > n / 2] = 0.0  # beyond, it begins anew
    return np.asarray((waves @ np.fft.fft2(psf) @ waves.T).real)
