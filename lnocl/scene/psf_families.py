"""Families of PSFs: a given PSF, changed by a few parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.shifting import fold

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

# Standard deviations of the priors: pixels, square pixels, a power, and those of the modes.
SHIFT, JITTER, STREHL, MODE = 0.5, 0.7, 0.7, 1.0
# The parameters of each family; those of modes are numbered.
FAMILIES = {"shift": ("x", "y"), "jitter": ("xx", "xy", "yy"), "strehl": ("power",), "modes": ()}
# An OTF is not told from 0 below this.
LEAST_OTF = 1e-4
# Of a transform.
ROUNDING = 1e-9


class PsfFamilies:
    r"""PSFs that differ from given ones G by a few parameters theta.

    .. math:: \hat K = \hat G \exp(\sum_k \theta_k B_k) + \sum_l \theta_l \hat L_l

    - shift: ``B = -2 pi i (u, v)``, theta in pixels along x and y;
    - jitter: ``B = -2 pi^2 (u^2, 2 u v, v^2)``, theta a covariance in square pixels, of a Gaussian
      that the PSF is convolved with, or sharpened by where it is negative;
    - strehl: ``B = ln |G^ / T^|``, T the PSF without aberrations: 1 takes the ratio of their OTFs
      once more, -1 leaves T. A structure function of the phase is so multiplied by 1 + theta;
    - modes: images L, each one standard deviation; what they have of light is taken from G.

    The parameters have Gaussian priors of mean 0.

    Parameters
    ----------
    names : sequence of str
        Families, of `FAMILIES`.
    psfs : ndarray of float64, shape (p, ky, kx)
        The given PSFs.
    ideals : ndarray of float64, shape (p, ky, kx)
        The PSFs without aberrations, for "strehl".
    modes : ndarray of float64, shape (p, n, ky, kx)
        For "modes".

    Attributes
    ----------
    parameters : list of str
        Names of the n parameters of each PSF, such as "jitter xy".
    prior : ndarray of float64, shape (n,)
        Standard deviations of their priors.
    """

    def __init__(self, names: Sequence[str], psfs: Array, ideals: Array, modes: Array) -> None:
        self._names, self._psfs, self._ideals = names, psfs, ideals
        if "modes" not in names:
            modes = np.zeros((len(psfs), 0, *psfs.shape[1:]))
        self._modes = modes - modes.sum(axis=(2, 3), keepdims=True) * psfs[:, None]
        self.parameters, prior = [], []
        scales = {"shift": SHIFT, "jitter": JITTER, "strehl": STREHL}
        for name in FAMILIES:
            if name in names:
                own = FAMILIES[name] or tuple(map(str, range(1, modes.shape[1] + 1)))
                self.parameters += [f"{name} {each}" for each in own]
                prior += [scales.get(name, MODE)] * len(own)
        self.prior = np.array(prior)

    def slopes(
        self, j: int, grid: tuple[int, int]
    ) -> tuple[list[Spectrum | Array], list[Spectrum]]:
        """Return the B_k and the L^_l of PSF j, at the frequencies of a real transform."""
        v, u = np.fft.fftfreq(grid[0])[:, None], np.fft.rfftfreq(grid[1])[None, :]
        factors: list[Any] = []
        if "shift" in self._names:
            factors += [-2j * np.pi * (u + 0 * v), -2j * np.pi * (v + 0 * u)]
        if "jitter" in self._names:
            factors += [-2 * np.pi**2 * each for each in (u * u + 0 * v, 2 * u * v, v * v + 0 * u)]
        if "strehl" in self._names:
            given, ideal = (
                np.maximum(abs(spectrum(each, grid)), LEAST_OTF)
                for each in (self._psfs[j], self._ideals[j])
            )
            factors.append(np.where(ideal > LEAST_OTF, np.log(given / ideal), 0.0))
        return factors, [spectrum(mode, grid) for mode in self._modes[j]]

    def psfs(self, values: Array) -> Array:
        """Return the PSFs of parameters of shape (p, n), shape (p, ky, kx), wrapped round."""
        grid = self._grid
        otfs = (self._otf(j, each) for j, each in enumerate(values))
        return np.array([np.fft.fftshift(np.fft.irfft2(otf, grid)) for otf in otfs])

    def without_common_shift(self, values: Array) -> tuple[Array, Array]:
        """Return the parameters with shifts of mean 0 over the PSFs, and that mean, (x, y)."""
        common = np.zeros(2)
        if "shift" in self._names:
            common = values[:, :2].mean(axis=0)
            values = np.hstack([values[:, :2] - common, values[:, 2:]])
        return values, common

    def are_possible(self, values: Array) -> bool:
        """Return whether no OTF exceeds its value at frequency 0, by more than those given do."""
        for j, each in enumerate(values):
            most = max(abs(spectrum(self._psfs[j], self._grid)).max(), 1.0)
            if not abs(self._otf(j, each)).max() <= (1.0 + ROUNDING) * most:
                return False
        return True

    @property
    def _grid(self) -> tuple[int, int]:
        return self._psfs.shape[1], self._psfs.shape[2]

    def _otf(self, j: int, values: Array) -> Spectrum:
        factors, modes = self.slopes(j, self._grid)
        log = sum((t * b for t, b in zip(values, factors, strict=False)), 0.0)
        linear = zip(values[len(factors) :], modes, strict=True)
        otf = spectrum(self._psfs[j], self._grid) * np.exp(log)
        return np.asarray(otf + sum((t * mode for t, mode in linear), 0.0))


def spectrum(psf: Array, grid: tuple[int, int]) -> Spectrum:
    """Return the spectrum of a PSF on a grid, its middle at the origin, wrapped round if larger."""
    for axis, n in enumerate(grid):
        psf = fold(psf, n, axis)
    values: Spectrum = np.fft.rfft2(np.fft.ifftshift(psf))
    return values
