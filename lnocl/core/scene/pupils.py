"""Pupils: the PSFs they have, and how phases across them change these."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

# Phases are polynomials up to this degree across each aperture: coma is the last of them.
DEGREE = 3
# Apertures with fewer pixels than this share of the largest are stray ones.
LEAST_APERTURE = 0.05
# A polynomial that others make up to this share of it is none of its own.
SAME = 1e-6


class Pupil:
    r"""A pupil, and phases across it.

    .. math:: K \propto |F(P \exp(i \sum_k z_k \phi_k))|^2

    The phases phi are polynomials of x and y up to degree 3 across each connected part of P,
    orthogonal, each of 1 rad rms over P. Piston and tilt of the whole are left out, which change
    nothing, and shift.

    Parameters
    ----------
    transmission : ndarray of float64, shape (ky, kx)
        P at the frequencies of the PSF, 0 in the middle, ``(ky // 2, kx // 2)``.

    Attributes
    ----------
    n_phases : int
        Number of phases.
    """

    def __init__(self, transmission: Array) -> None:
        self.shape = transmission.shape
        apertures = _apertures(transmission > 0)
        self._inside = np.any(apertures, axis=0)
        self._transmission = transmission[self._inside]
        self._phases = _phases(transmission, apertures, self._inside)
        self.n_phases = len(self._phases)

    def ideal_psf(self) -> Array:
        """Return the PSF without phases."""
        return self.psf(np.zeros(self.n_phases))

    def psf(self, z: Array) -> Array:
        """Return the PSF of coefficients z, shape (ky, kx), of unit sum, centred."""
        psf = np.abs(self._field(self._wave(z))) ** 2
        return np.asarray(psf / psf.sum())

    def slopes(self, z: Array) -> Array:
        """Return the derivatives of the PSF with respect to z, shape (n_phases, ky, kx)."""
        wave = self._wave(z)
        field = self._field(wave)
        changes = [2.0 * (field.conj() * self._field(1j * phi * wave)).real for phi in self._phases]
        return np.array(changes).reshape(-1, *self.shape) / (np.abs(field) ** 2).sum()

    def _wave(self, z: Array) -> NDArray[np.complex128]:
        return np.asarray(self._transmission * np.exp(1j * (z @ self._phases)))

    def _field(self, wave: NDArray[np.complex128]) -> NDArray[np.complex128]:
        pupil = np.zeros(self.shape, complex)
        pupil[self._inside] = wave
        return np.asarray(np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(pupil))))


def _apertures(inside: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    from scipy.ndimage import label  # which takes its time to load

    labels, n = label(inside, structure=np.ones((3, 3)))
    parts = [labels == i for i in range(1, n + 1)]
    least = LEAST_APERTURE * max((part.sum() for part in parts), default=0)
    return [part for part in parts if part.sum() >= least]


def _phases(
    transmission: Array, apertures: list[NDArray[np.bool_]], inside: NDArray[np.bool_]
) -> Array:
    """Return the phases at the pixels of the apertures, shape (n, n_inside)."""
    y, x = (each / max(inside.shape) for each in np.indices(inside.shape))
    columns = [np.ones(inside.shape), x, y]
    powers = [(a, d - a) for d in range(DEGREE + 1) for a in range(d, -1, -1)]
    for part in apertures:
        reach = np.sqrt(part.sum()) / max(inside.shape)
        xs, ys = ((each - each[part].mean()) / reach * part for each in (x, y))
        columns += [part * xs**a * ys**b for a, b in powers]
    weights = np.sqrt(transmission[inside] ** 2 / (transmission[inside] ** 2).sum())
    basis: list[Array] = []
    for column in columns:
        own = weights * column[inside]
        length = np.linalg.norm(own)
        for _ in range(2):  # rounding leaves something of the others the first time
            own = own - sum((each * (each @ own) for each in basis), 0.0)
        if np.linalg.norm(own) > SAME * length:
            basis.append(own / np.linalg.norm(own))
    return np.array(basis[3:]).reshape(-1, inside.sum()) / weights
