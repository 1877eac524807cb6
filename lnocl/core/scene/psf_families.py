"""Families of PSFs: a given PSF, changed by parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.psf_field import Kind, Psfs, mapped
from lnocl.core.scene.psf_pixels import PsfPixels
from lnocl.core.scene.pupils import Pupil
from lnocl.core.scene.shifting import fold

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation

Spectrum = NDArray[np.complex128]

# Standard deviations of the priors: pixels, square pixels, a power, radians, those of the modes.
SHIFT, JITTER, STREHL, PUPIL, MODE = 0.5, 0.7, 0.7, 0.3, 1.0
# The parameters of each family; those of pupils and modes are numbered, those of pixels have no
# names.
Family = Literal["shift", "jitter", "strehl", "pupil", "modes", "pixels"]
FAMILIES: dict[Family, tuple[str, ...]] = {
    "shift": ("x", "y"),
    "jitter": ("xx", "xy", "yy"),
    "strehl": ("power",),
    "pupil": (),
    "modes": (),
    "pixels": (),
}
NO_SCATTER = np.zeros((0, 0, 0))
# An OTF is not told from 0 below this.
LEAST_OTF = 1e-4
# Of a transform.
ROUNDING = 1e-9
# An even phase and its negative have nearly one PSF, so that at 0 nothing says which way to go, and
# every fifth search ends with the wrong one: so many begin, at random phases of this share of the
# prior.
SEARCHES, FIRST = 3, 0.3


class PsfParameters(NamedTuple):
    """Parameters of p PSFs.

    Attributes
    ----------
    values : ndarray of float64, shape (p, n)
        Those that have names.
    pixels : ndarray of float64, shape (p, ky, kx)
        The fields of `PsfPixels`; of shape (p, 0, 0) where they are not asked for.
    """

    values: Array
    pixels: Array

    def plus(self, change: PsfParameters, share: float = 1.0) -> PsfParameters:
        """Return the parameters after a share of a change."""
        return PsfParameters(
            self.values + share * change.values, self.pixels + share * change.pixels
        )


class PsfFamilies:
    r"""PSFs that differ from given ones G by a few parameters theta, and perhaps pixel by pixel.

    .. math:: \hat K = \hat G \exp(\sum_k \theta_k B_k) \frac{\hat A(z)}{\hat A(0)}
              + \sum_l \theta_l \hat L_l + \hat D

    - shift: ``B = -2 pi i (u, v)``, theta in pixels along x and y;
    - jitter: ``B = -2 pi^2 (u^2, 2 u v, v^2)``, theta a covariance in square pixels, of a Gaussian
      that the PSF is convolved with, or sharpened by where it is negative;
    - strehl: ``B = ln |G^ / T^|``, T the PSF without aberrations: 1 takes the ratio of their OTFs
      once more, -1 leaves T. A structure function of the phase is so multiplied by 1 + theta;
    - pupil: A(z) the PSF of the pupil with the phases z, in radians rms (`Pupil`);
    - modes: images L, each one standard deviation; what they have of light is taken from G;
    - pixels: D, the corrections of `PsfPixels`.

    The parameters have Gaussian priors of mean 0.

    Parameters
    ----------
    names : sequence of str
        Families, of `FAMILIES`.
    observation : Observation
        For the given PSFs, and ``ideal_psfs``, ``pupils`` and ``psf_modes`` as the families need
        them.
    scatter : ndarray of float64, shape (p, ky, kx), optional
        Standard deviations of the pixels of the PSFs, for "pixels".

    Attributes
    ----------
    parameters : list of str
        Names of the n parameters of each PSF, such as "jitter xy".
    prior : ndarray of float64, shape (n,)
        Standard deviations of their priors.
    units : ndarray of float64, shape (n,)
        The parameters, in pixels of the PSFs, over what they are in pixels of the images.
    pixels : PsfPixels or None
        None where they are not asked for.
    n_searches : int
        How many searches find the best parameters.
    """

    def __init__(
        self, names: Sequence[str], observation: Observation, scatter: Array = NO_SCATTER
    ) -> None:
        self._names, self._psfs = names, observation.psfs
        self._over_images, self._turns = observation.psfs_over_images, observation.turns
        is_sky = (observation.transforms == np.eye(2, 3)).all(axis=(1, 2))
        self._is_sky = is_sky if is_sky.any() else ~is_sky
        self._ideals, modes = observation.ideal_psfs, observation.psf_modes
        self._pupils = [Pupil(each) for each in observation.pupils] if "pupil" in names else []
        if "modes" not in names:
            modes = np.zeros((len(self._psfs), 0, *self._psfs.shape[1:]))
        self._modes = modes - modes.sum(axis=(2, 3), keepdims=True) * self._psfs[:, None]
        self.pixels = None
        if "pixels" in names:
            self.pixels = PsfPixels(self._psfs, scatter, observation.oversample)
        numbered = {"pupil": self._n_phases, "modes": modes.shape[1]}
        scales = {"shift": SHIFT, "jitter": JITTER, "strehl": STREHL, "pupil": PUPIL}
        pixels = {"shift": observation.oversample, "jitter": observation.oversample**2}
        self.parameters, prior, units = [], [], []
        for name, own in FAMILIES.items():
            if name in names:
                own = own or tuple(str(i + 1) for i in range(numbered.get(name, 0)))
                self.parameters += [f"{name} {each}" for each in own]
                prior += [scales.get(name, MODE)] * len(own)
                units += [pixels.get(name, 1)] * len(own)
        self.units = np.array(units, np.float64)
        self.prior = np.array(prior) * self.units
        self.n_searches = SEARCHES if self._pupils else 1

    def first(self, search: int = 0) -> PsfParameters:
        """Return parameters to begin a search with: those of the given PSFs, but for phases."""
        values = np.zeros((len(self._psfs), len(self.prior)))
        start = np.random.default_rng(search).standard_normal((len(self._psfs), self._n_phases))
        values[:, self._phases] = FIRST * PUPIL * start
        pixels = (0, 0) if self.pixels is None else self._grid
        return PsfParameters(values, np.zeros((len(self._psfs), *pixels)))

    def slopes(
        self, j: int, grid: tuple[int, int], values: Array
    ) -> tuple[list[Spectrum | Array], list[Spectrum]]:
        """Return the slopes of ln K^ and of K^ of PSF j, at the frequencies of a real transform.

        The first are those of shift, jitter, Strehl ratio and phases, the others those of modes.
        """
        factors: list[Any] = self._exponents(j, grid)
        if self._pupils:
            z = values[self._phases]
            otf = spectrum(self._pupils[j].psf(z), grid)
            slopes = (spectrum(each, grid) for each in self._pupils[j].slopes(z))
            factors += [_ratio(each, otf, 0.0) for each in slopes]
        return factors, [spectrum(mode, grid) for mode in self._modes[j]]

    def psfs(self, parameters: PsfParameters) -> Array:
        """Return the PSFs, shape (p, ky, kx), wrapped round."""
        return self._changed(self._psfs, parameters)

    def psfs_over_images(self, parameters: PsfParameters) -> Psfs:
        """Return those that vary over images, each changed as that of the middle, or the PSFs."""
        return self._changed(self._over_images, parameters)

    def correction(self, j: int, parameters: PsfParameters) -> Array:
        """Return what free pixels add to PSF j, shape (ky, kx)."""
        if self.pixels is None:
            return np.zeros(self._grid)
        return self.pixels.correction(j, parameters.pixels[j])

    def _changed(self, psfs: Kind, parameters: PsfParameters) -> Kind:
        def change(j: int, stack: Array) -> Array:
            factor, added = self._of_otf(j, parameters.values[j])
            otfs = (spectrum(psf, self._grid) * factor + added for psf in stack)
            seen = [np.fft.fftshift(np.fft.irfft2(otf, self._grid)) for otf in otfs]
            return np.array(seen) + self.correction(j, parameters)

        return mapped(psfs, change)

    def without_common_shift(self, parameters: PsfParameters) -> tuple[PsfParameters, Array]:
        """Return parameters without what a shift of the sky does alike, and that shift, (x, y).

        It is that of the images whose pixels are the sky's, in which positions are, where there are
        any: others may have wrong offsets.
        """
        common, values = np.zeros(2), parameters.values
        if "shift" in self._names:
            shifts, turns = values[:, :2], self._turns
            of_sky = turns[self._is_sky].reshape(-1, 2), shifts[self._is_sky].ravel()
            common[:] = np.linalg.lstsq(*of_sky)[0]
            values = np.hstack([shifts - turns @ common, values[:, 2:]])
        return parameters._replace(values=values), common

    def are_possible(self, parameters: PsfParameters) -> bool:
        """Return whether no OTF exceeds its value at frequency 0, by more than those given do."""
        for given, psf in zip(self._psfs, self.psfs(parameters), strict=True):
            most = max(abs(spectrum(given, self._grid)).max(), 1.0)
            if not abs(spectrum(psf, self._grid)).max() <= (1.0 + ROUNDING) * most:
                return False
        return True

    @property
    def _grid(self) -> tuple[int, int]:
        return self._psfs.shape[1], self._psfs.shape[2]

    @property
    def _n_phases(self) -> int:
        return self._pupils[0].n_phases if self._pupils else 0

    @property
    def _phases(self) -> slice:
        """Which of the parameters are phases."""
        before = sum(len(FAMILIES[name]) for name in FAMILIES if name in self._names)
        return slice(before, before + self._n_phases)

    def _exponents(self, j: int, grid: tuple[int, int]) -> list[Any]:
        """Return the B_k of PSF j."""
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
        return factors

    def _of_otf(self, j: int, values: Array) -> tuple[Spectrum | float, Spectrum | float]:
        """Return by what OTFs of image j are multiplied, and what is added to them then."""
        grid = self._grid
        exponents = self._exponents(j, grid)
        log = sum((t * b for t, b in zip(values, exponents, strict=False)), 0.0)
        factor = np.exp(log)
        if self._pupils:
            now, ideal = self._pupils[j].psf(values[self._phases]), self._pupils[j].ideal_psf()
            factor = factor * _ratio(spectrum(now, grid), spectrum(ideal, grid), 1.0)
        modes = (spectrum(mode, grid) for mode in self._modes[j])
        linear = zip(values[self._phases.stop :], modes, strict=True)
        return factor, sum((t * mode for t, mode in linear), 0.0)


def _ratio(otf: Spectrum, other: Spectrum, otherwise: float) -> Spectrum:
    """Return the ratio of two OTFs, or another value where the second is not told from 0."""
    known = abs(other) > LEAST_OTF
    return np.divide(otf, other, out=np.full_like(otf, otherwise), where=known)


def spectrum(psf: Array, grid: tuple[int, int]) -> Spectrum:
    """Return the spectrum of a PSF on a grid, its middle at the origin, wrapped round if larger."""
    for axis, n in enumerate(grid):
        psf = fold(psf, n, axis)
    values: Spectrum = np.fft.rfft2(np.fft.ifftshift(psf))
    return values
