"""What a result is computed from when it is asked for, and its errors, detections and limits."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lnocl.core.runs.outcome import Outcome, StarErrors
from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.observation import Observation
from lnocl.errors import InputError
from lnocl.parallel import Parallel, check_parallel
from lnocl.residuals import StarResiduals

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.core.runs.bootstrap import Bootstrap
    from lnocl.significance import Significance


class Findings(Protocol):
    """What a result is computed from when it is asked for: the outcome of a run, or of tiles."""

    @property
    def setup(self) -> Setup:
        """The parameters of the run, or those of all tiles."""

    @property
    def observation(self) -> Observation:
        """The observation, with the PSFs that were used."""

    @property
    def given_positions(self) -> Array:
        """The places of the stars that were given, in the order of the fluxes, shape (n, 2)."""

    @property
    def may_free_pixels(self) -> bool:
        """Whether the pixels of PSFs were not to be refined, and could be."""

    @property
    def plan(self) -> tuple[str, ...]:
        """What the run was to do, a line for each step."""

    def models(self) -> Iterator[Array]:
        """Yield the m_j, electrons per pixel, shape (ny, nx)."""

    def star_errors(self) -> StarErrors:
        """Return the errors of stars and halos."""

    def halo_amounts(self, fluxes: Array) -> Array:
        """Return those of fluxes that are of halos, electrons of each image, shape (n_halos, p)."""

    def extended_flux(self, star_flux_errors: Array) -> tuple[Any, Any]:
        """Return the light of the extended source and its standard error, electrons."""

    def pixel_noise(self) -> Array:
        """Return the noise of each component's pixels, electrons, shape (K, ny, nx)."""

    def star_residuals(self) -> list[StarResiduals]:
        """Return how well the model fits at each star."""


class Measured:
    """The errors of a result, and what is tested in it: the first part of `lnocl.Result`."""

    star_fluxes: Array
    _findings: Findings

    @property
    def star_flux_errors(self) -> Array:
        """Standard errors of the star fluxes, electrons, shape (n,).

        They follow from the joint Fisher information of all stars, of halos and of the extended
        source, which are not taken as known (`lnocl.core.solvers.star_errors`,
        :doc:`/validation/errors`). Where a halo is like a star they are large. The relative
        error that the PSFs still have (`psf_refinement`) is added in quadrature. They are
        computed when they are first read. They are NaN where the images do not determine the flux,
        as for stars that have moved to one place, that a halo can stand in for, or that no good
        pixel shows.

        Warns
        -----
        LnoclWarning
            The images do not determine flux and position of a star.

        Examples
        --------
        The noise of 1000 counts is 32 electrons. The sky and the extended source add to it:

        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> bool(32 < result.star_flux_errors[0] < 100)
        True
        """
        return self._star_errors.fluxes[: len(self.star_fluxes)]

    @property
    def star_flux_covariances(self) -> Array:
        """Covariances of each star's fluxes in the epochs, electrons squared, shape (n, m, m).

        n counts the stars that were given, m the epochs. The variances are the squares of
        `star_flux_errors`. The light of a star that the extended source, or a level, may hold is
        wrong in all epochs alike, so that changes between epochs have smaller errors. NaN where no
        good pixel shows a star.

        See Also
        --------
        lnocl.Result.star_variation_errors : Errors of the changes.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> images = np.array([5 + flux * psf / psf.sum() for flux in (1000, 1200)])
        >>> observation = lnocl.Observation(images, psf, epochs=["May", "June"])
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> result.star_flux_covariances.shape
        (1, 2, 2)
        >>> bool(result.star_flux_covariances[0, 0, 1] > 0)
        True
        """
        return self._star_errors.covariances

    @property
    def star_variation_errors(self) -> Array:
        r"""Standard errors of fluxes less their star's mean over the epochs, electrons, (n,).

        With the covariances C of the m epochs that show a star, and P their deviations from the
        mean, the variances are the diagonal of

        .. math:: P C P, \quad P = 1 - 1 1^T / m.

        With one epoch they are 0. With these errors the fluxes of a star that does not vary scatter
        about their mean; `star_flux_errors` are those of each flux.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> images = np.array([5 + flux * psf / psf.sum() for flux in (1000, 1200)])
        >>> observation = lnocl.Observation(images, psf, epochs=["May", "June"])
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> bool((result.star_variation_errors < result.star_flux_errors).all())
        True
        """
        found = []
        for covariance in self.star_flux_covariances:
            known = np.isfinite(np.diag(covariance))
            deviations = np.where(known & known[:, None], np.eye(len(known)), 0.0)
            deviations[np.ix_(known, known)] -= 1.0 / max(known.sum(), 1)
            variances = np.diag(deviations @ np.nan_to_num(covariance) @ deviations.T)
            found.append(np.where(known, np.sqrt(variances.clip(0.0)), np.nan))
        return np.array(found).ravel()

    @property
    def halo_flux_errors(self) -> Array:
        """Standard errors of the amounts of halos, electrons, shape (n_halos, p).

        They follow from the joint Fisher information of halos, stars and the extended source
        (`lnocl.core.solvers.halos`), and are computed as `star_flux_errors` are. They are NaN
        where the images do not determine an amount.

        Warns
        -----
        LnoclWarning
            The images do not determine the amount of a halo.

        Examples
        --------
        A halo of 40000 electrons of which the shape is known:

        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((32, 32)) - 16
        >>> halo = 1 / (1 + np.hypot(x, y))
        >>> counts = np.random.default_rng(0).poisson(40000 * halo / halo.sum() + 2)
        >>> observation = lnocl.Observation(counts, np.ones((5, 5)), background=2, halos=halo)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> bool(abs(result.halo_fluxes[0, 0] - 40000) < 3 * result.halo_flux_errors[0, 0])
        True
        >>> bool(190 < result.halo_flux_errors[0, 0] < 400)
        True
        """
        return self._findings.halo_amounts(self._star_errors.fluxes)

    @property
    def star_position_errors(self) -> Array:
        """Standard errors of the star positions, pixels, shape (n, 2).

        They are computed as `star_flux_errors` are. NaN where the positions were not refined.

        Warns
        -----
        LnoclWarning
            The images do not determine flux and position of a star.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
        >>> options = {"refine_positions": True, "stop": None, "n_iter": 20, "engine": "numpy"}
        >>> result = lnocl.deconvolve(observation, [(16.2, 16.0)], **options)
        >>> abs(result.star_positions - 16).max() < 0.01, (result.star_position_errors < 0.1).all()
        (np.True_, np.True_)
        """
        return self._star_errors.positions

    @cached_property
    def _star_errors(self) -> StarErrors:
        errors = self._findings.star_errors()
        for each in errors:
            each.flags.writeable = False
        return errors

    @cached_property
    def extended_flux(self) -> tuple[Any, Any]:
        r"""The light of the extended source in the frame and its standard error, electrons.

        With components they are arrays of shape (K,), of the part of the frame in which filters
        tell them apart, and hold what weights of components may have wrong
        (`lnocl.core.solvers.light`).

        It is the sum of the extended source and of what the residuals have beside it
        (`lnocl.core.solvers.light`), so that it has no bias, and may be negative where there is
        little but noise. ``extended.sum()`` is too large there, as no pixel is negative. The error
        is that of counts, of `star_flux_errors`, and of levels of the background that are not
        known. It is computed when it is first read.

        Examples
        --------
        A sky of 5 electrons per pixel that is all background:

        >>> import numpy as np
        >>> import lnocl
        >>> images = np.random.default_rng(0).poisson(5.0, (64, 64))
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), background=5)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> flux, error = result.extended_flux
        >>> bool(abs(flux - (images - 5).sum()) < 10), bool(130 < error < 160)
        (True, True)
        >>> bool(result.extended.sum() > 3 * error)
        True
        """
        return self._findings.extended_flux(self._star_errors.fluxes)

    @property
    def _outcome(self) -> Outcome:
        """The outcome that replicas, detections and limits are of."""
        if not isinstance(self._findings, Outcome):
            raise InputError(
                "replicas are of one run, as detections and limits are, and this result is of "
                "tiles: deconvolve a cut-out without tiles"
            )
        return self._findings

    def bootstrap(
        self,
        n: int = 50,
        *,
        regions: str | os.PathLike[str] | Iterable[Any] = (),
        profiles: str | os.PathLike[str] | Iterable[Any] = (),
        header: fits.Header | None = None,
        seed: int = 0,
        progress: bool = False,
        earlier: Bootstrap | None = None,
        callback: Callable[[Bootstrap], None] | None = None,
        parallel: Parallel = False,
    ) -> Bootstrap:
        """Return the errors of stars, regions, profiles and pixels, by replicas of this result.

        A replica is a sky that the result may stand for, observed and reconstructed as the images
        were, by as many iterations (`lnocl.core.runs.replicas`, :doc:`/validation/errors`). It
        costs as much as a run of all counts of that length. All n of them use the buffers and
        programs of one run.

        Parameters
        ----------
        n : int, optional
            Replicas, ten or more. Each is a run of as many iterations as the result's.
        regions : str, path or iterable of regions.Region, optional
            Regions whose light of the extended source is measured. A name is that of a file of
            them, as DS9 writes. Others are objects of the package regions. They are in pixels of
            the extended source, or on the sky.
        profiles : str, path or iterable of regions.RectanglePixelRegion, optional
            Boxes along whose longer sides light and width are measured, pixel by pixel, likewise.
        header : astropy.io.fits.Header, optional
            Header of the first image, for regions on the sky.
        seed : int, optional
            Seed of the replicas, zero or more. The same seed gives the same errors on the same
            device.
        progress : bool, optional
            Show progress, as `lnocl.deconvolve` does.
        earlier : Bootstrap, optional
            Replicas of this result that exist already, of the same regions and seed. The rest is
            added. All is bit for bit as if it had been computed at once.
        callback : callable, optional
            Called with the errors so far, a `lnocl.core.runs.bootstrap.Bootstrap`, after each
            replica from the second on.
        parallel : bool, int or "current-scheduler", optional
            Where the replicas are computed (`lnocl.parallel.check_parallel`). False: one after the
            other in this process. True or a number: in as many processes as cores, or in that many.
            "current-scheduler": by the workers of a cluster of Dask. All give the same errors on
            the same kind of device.

        Returns
        -------
        Bootstrap
            The errors, `lnocl.core.runs.bootstrap.Bootstrap`.

        Raises
        ------
        InputError
            - n is less than 10, or the seed is negative.
            - A region lies outside the images or encloses nothing, or is on the sky without a
              header.
            - A profile is not a box.
            - Earlier replicas are of another result, or of other regions or another seed.
        FileError
            The file of regions is missing, or holds none.
        LnoclError
            The package regions is missing, or Dask; the workers are lost.
        DeviceError
            As `lnocl.deconvolve`.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=5, engine="numpy")
        >>> errors = result.bootstrap(10)
        >>> errors.n, errors.quantities[0].name, errors.error_map.shape
        (10, 'star 1 flux', (33, 33))
        >>> errors = result.bootstrap(12, earlier=errors)
        >>> errors.n
        12
        """
        from lnocl.core.runs.bootstrap import bootstrap, check_number
        from lnocl.io.regions import read_parts

        check_number(n, seed)
        check_parallel(parallel)
        outcome = self._outcome
        parts = read_parts(regions, profiles, header, self._findings.observation)
        return bootstrap(outcome, n, parts, seed, progress, earlier, callback, parallel)

    def significance(
        self, width: float = 0.0, false_alarms: float = 0.01, images_of: str | None = None
    ) -> Significance:
        """Return which sources there are beside the stars, at a rate of false alarms.

        Each place of the sky is tested for a source, under the model without it: stars, background
        and a smooth level. What noise, PSF errors and the extended source could be is allowed for
        (`lnocl.significance`). It takes about as long as a few iterations on the host; where PSFs
        vary over the field, as long for each of its nodes. Fluxes and limits are those before a
        `transmission`.

        Parameters
        ----------
        width : float, optional
            Full width at half maximum of the sources, pixels of the images; 0 for points.
        false_alarms : float, optional
            Number of false alarms expected in the whole field, from 1e-200 to 10. The threshold
            follows from it.
        images_of : str, optional
            With components the filter whose images are tested, such as "line + continuum": what
            they show is one sky.

        Returns
        -------
        Significance
            Maps and detections, `lnocl.significance.Significance`.

        Raises
        ------
        InputError
            - A width or number of false alarms is out of range.
            - The result is of tiles.
            - With components no filter is named, or one that there is not.
            - Nowhere do the images tell such a source from stars, level and edges.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> images = np.random.default_rng(1).poisson(10.0, (64, 64))
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), background=10)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=20, engine="numpy")
        >>> len(result.significance().detections)
        0
        """
        from lnocl.core.scene.quantities import in_unit
        from lnocl.significance import significance  # which loads scipy

        width = in_unit("width", width, "pix")
        false_alarms = in_unit("false_alarms", false_alarms, "")

        return significance(self._outcome.of_filter(images_of), width, false_alarms)
