r"""What a sky may hold that an estimate of it does not: detail below the resolution.

An estimate is smoother than the sky, and a star takes the light that lies under its core. The sky
is taken for

.. math:: \max(f + a\, C^{1/2} x, 0), \qquad x \sim N(0, 1),

with an amplitude a that is a share of the extended source f, smoothed, near stars of the brightest
there, and a correlation C over a part of the resolution. How large these are was measured on
simulated skies: docs/errors.md.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from lnocl.scene.cores import fwhm
from lnocl.scene.observation import Array
from lnocl.scene.scene import Scene
from lnocl.scene.smooth_field import SmoothField

# Of the extended source.
SHARE = 0.4
# Of the resolution: widths of the correlation, of the smoothing of the amplitude and of that near
# stars; and the distances from a star within which light is looked for, and may lie.
CORRELATED, SMOOTHED, SMOOTHED_NEAR = 0.25, 0.35, 0.175
LOOKED_FOR, NEAR = 1.05, 0.7


class Texture:
    """Detail that an estimate may lack, as a Gaussian field on the grid.

    Parameters
    ----------
    scene : Scene
        Its PSFs and stars.
    extended : ndarray of float64, shape (Ny, Nx)
        The estimate of the extended source, on the grid, zero or more.

    Attributes
    ----------
    amplitude : ndarray of float64, shape (Ny, Nx)
        Standard deviation of the field, in the unit of `extended`.
    resolution : float
        Full width at half maximum of the narrowest PSF, pixels.
    """

    def __init__(self, scene: Scene, extended: Array) -> None:
        self.resolution = resolution(scene)
        self._extended = extended
        smooth = gaussian_filter(extended, SMOOTHED * self.resolution, mode="wrap")
        self._brighten_near_stars(scene, smooth)
        self.amplitude = SHARE * smooth
        self._correlate = SmoothField(extended.shape, CORRELATED * self.resolution).apply

    def _brighten_near_stars(self, scene: Scene, smooth: Array) -> None:
        light = gaussian_filter(self._extended, SMOOTHED_NEAR * self.resolution, mode="wrap")
        half = int(np.ceil(LOOKED_FOR * self.resolution))
        offsets = np.arange(-half, half + 1)
        for x, y in scene.stars:
            rows, columns = (round(at) + offsets for at in (y, x))
            distance = np.hypot((rows - y)[:, None], columns - x) / self.resolution
            window = np.ix_(rows % smooth.shape[0], columns % smooth.shape[1])
            brightest = light[window][distance <= LOOKED_FOR].max()
            smooth[window] = np.where(
                distance <= NEAR, np.maximum(smooth[window], brightest), smooth[window]
            )

    def apply(self, x: Array) -> Array:
        """Return the field ``a C^(1/2) x`` of white noise x."""
        return self.amplitude * self._correlate(x)

    def adjoint(self, sky: Array) -> Array:
        """Return ``C^(1/2) (a sky)``, of which `apply` is the transpose."""
        return self._correlate(self.amplitude * sky)

    def draw(self, rng: np.random.Generator) -> Array:
        """Return a sky like the estimate, with detail of its own."""
        noise = rng.standard_normal(self._extended.shape)
        return np.maximum(self._extended + self.apply(noise), 0.0)


def resolution(scene: Scene) -> float:
    """Return the full width at half maximum of the narrowest PSF, pixels."""
    return min(fwhm(psf) for psf in scene.observation.psfs)
