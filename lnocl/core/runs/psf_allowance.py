"""What the error that PSFs still have asks for: smoothing near stars, and doubt of faint light."""

from __future__ import annotations

import numpy as np

from lnocl.core.runs.guarded_runs import GuardedRuns, Judged, estimate_scatter, inside, rings_of
from lnocl.core.runs.start import make_model
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_misfit import smoothing_near_stars
from lnocl.core.scene.rings import Rings
from lnocl.core.scene.scene import Scene
from lnocl.process import ignored_warnings

# The weight of the edge-preserving term near stars, in standard deviations of the gradient of the
# data term by the error of the PSFs. More flattens the hosts of stars, less leaves halos.
STRENGTH = 2.0
# Where PSFs give so little of their peak, nothing is known of them.
DARK = 1e-9


class Allowance:
    """The error that PSFs still have, and what follows from it for the extended source.

    Parameters
    ----------
    observation : Observation
        The images, with the PSFs that are used.
    runs : GuardedRuns
        The runs that have judged them.
    estimate : Judged
        Their last estimate, with these PSFs.
    scatter : ndarray of float64, shape (p, ky, kx)
        Standard deviations of the PSFs' pixels; of shape (0, ky, kx) where they are not known.

    Attributes
    ----------
    error : float
        Relative to the PSFs: what is left at the stars, or the scatter that is given.
    edges, in_rings : ndarray of float64, shapes (k + 1,) and (k,)
        Radii of rings round a star, pixels, and the error in each; 0 where `error` is.
    """

    def __init__(
        self, observation: Observation, runs: GuardedRuns, estimate: Judged, scatter: Array
    ) -> None:
        misfit = estimate.misfit
        self._observation, self._estimate, self._held = observation, estimate, runs.held
        self._moved = estimate.scene.places - runs.stars
        self._stars = runs.whole.stars
        self.error = misfit.kappa if misfit.is_significant else 0.0
        # Those that are told, and those that the smoothing follows.
        shares = np.array([misfit.in_rings * bool(self.error), misfit.in_rings])
        rings = rings_of(observation.psfs, observation.oversample)
        if len(scatter):
            errors, lights = (
                np.bincount(rings.number.ravel(), (each**2).sum(axis=0).ravel())
                for each in (scatter, observation.psfs)
            )
            self.error = max(self.error, float(np.sqrt(errors.sum() / lights.sum())))
            # Where PSFs give next to nothing, a share of them means nothing.
            least = np.bincount(rings.number.ravel()) * (DARK * observation.psfs.max()) ** 2
            known = np.divide(errors, lights, out=np.zeros_like(errors), where=lights > least)
            k = max(shares.shape[1], len(known))
            told, shown, known = (
                np.pad(each, (0, k - len(each)), "edge") for each in (*shares, known)
            )
            shares = np.maximum([told, shown], np.sqrt(known))
        self.in_rings, self._shown = shares[:, : len(rings)]
        self.edges = rings.edges[: len(self.in_rings) + 1]

    def near_stars(self, pad: int | str) -> Array | None:
        """Return the weight of the edge-preserving term for these errors, None for 0.

        What single rings show counts, though all of them together may show no error: an extended
        source that is free there takes the light of the star for it.
        """
        if not self._shown.any():
            return None
        whole = self._whole(pad)
        return smoothing_near_stars(whole, make_model(whole.scene), self._shown, STRENGTH)

    def scatter(self) -> Array:
        """Return the standard deviations of the PSFs' pixels; of shape (0, ky, kx) for no error."""
        psfs = self._observation.psfs
        if not self.in_rings.any():
            return psfs[:0]
        return estimate_scatter(psfs, self.in_rings, self._observation.oversample)

    def may_be_faked(self) -> Array:
        """Return the light that errors may fake, ``kappa(r) sum_s c_s K_s / sqrt(p)``.

        Electrons per pixel of the sky: K is the mean over the PSFs, at the stars.
        """
        whole = self._whole(0)
        scene = whole.scene
        ny, nx = scene.observation.sky_shape
        light = np.zeros(scene.grid)
        for j in range(scene.n_images):
            for s in np.flatnonzero(scene.shown[:, j] & scene.through_psfs).tolist():
                cutout = scene.psf_on_sky(j, s)
                light[cutout.window(scene.grid)] += whole.star_fluxes[s] * cutout.values
        number = Rings((ny, nx), on_sky(scene.stars, scene.oversample), scene.oversample).number
        kappa = self.in_rings[np.minimum(number, len(self.in_rings) - 1)]
        return np.asarray(kappa * light[:ny, :nx] / scene.n_images**1.5)

    def _whole(self, pad: int | str) -> Estimate:
        """Return the start of the whole scene, with the stars as they were found."""
        stars = self._stars.copy()
        stars[self._held] += self._moved
        with ignored_warnings():  # those of the reconstruction are the same
            scene = Scene(self._observation, inside(stars, self._observation), pad=pad)
        start = Estimate.of_scaled(scene, *scene.start(None, None))
        held = np.repeat(self._held, scene.n_epochs)
        n = np.count_nonzero(held)
        start.star_fluxes[: scene.n_stars][held] = self._estimate.star_fluxes[:n]
        start.star_fluxes[scene.n_stars :] = self._estimate.star_fluxes[n:]
        return start
