"""The result of `deconvolve`, and the estimate that a callback is given."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError, with_names
from lnocl.notebook import html_card
from lnocl.plotting.light_curves import light_curves
from lnocl.plotting.result import ResultView, draw_result
from lnocl.residuals import Fit, StarResiduals, judge, residuals
from lnocl.runs.outcome import Outcome, PsfRefinement, mean_over_epochs
from lnocl.scene.arrays import Array
from lnocl.scene.observation import Observation

if TYPE_CHECKING:
    from astropy.io import fits
    from astropy.table import QTable
    from matplotlib.figure import Figure

    from lnocl.parallel import Parallel
    from lnocl.runs.bootstrap import Bootstrap
    from lnocl.significance import Significance

# Stars that a notebook lists.
MAX_LISTED = 10

HISTORY_DTYPE = np.dtype([("iteration", np.int64), ("objective", np.float64)])


class Iterating(Protocol):
    """A run, or the two runs of held-out counts: both have an estimate."""

    def extended(self) -> Array:
        """Return the extended source, electrons per pixel, shape (ny, nx)."""

    def star_fluxes(self) -> Array:
        """Return the fluxes of stars, and then of halos, electrons."""

    def is_shown(self) -> NDArray[np.bool_]:
        """Return which of these any image shows."""

    def star_positions(self) -> Array:
        """Return the star positions, pixels, shape (n, 2)."""


class Findings(Protocol):
    """What a result is computed from when it is asked for: the outcome of a run, or of tiles."""

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

    def star_errors(self) -> tuple[Array, Array]:
        """Return the standard errors of the fluxes of stars and halos, and of positions."""

    def of_halos(self, fluxes: Array) -> Array:
        """Return those of fluxes that are of halos, electrons of each image, shape (n_halos, p)."""

    def extended_flux(self, star_flux_errors: Array) -> tuple[float, float]:
        """Return the light of the extended source and its standard error, electrons."""

    def star_residuals(self) -> list[StarResiduals]:
        """Return how well the model fits at each star."""


class Estimate:
    """The estimate of an iteration, as the callback of `lnocl.deconvolve` gets it.

    An array is fetched from the device when it is first read, and has to be read before the
    callback returns.

    Attributes
    ----------
    extended : ndarray of float64
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> obs = lnocl.Observation(np.full((8, 8), 4.0), np.ones((1, 1)))
    >>> def show(iteration, estimate):
    ...     print(iteration, estimate.extended.sum().round(6), estimate.star_fluxes.shape)
    >>> options = {"n_iter": 2, "stop": None, "engine": "numpy"}
    >>> result = lnocl.deconvolve(obs, solver="sgm", smoothing=0, callback=show, **options)
    1 256.0 (0,)
    2 256.0 (0,)
    """

    def __init__(self, run: Iterating) -> None:
        self._run: Iterating | None = run

    @cached_property
    def extended(self) -> Array:
        """Extended source, electrons per pixel of it.

        Its shape is the observation's ``sky_shape``: that of the images, times ``oversample``.
        """
        return self._live().extended()

    @cached_property
    def star_fluxes(self) -> Array:
        """Star fluxes, electrons, shape (n,); NaN where no good pixel shows a star."""
        run = self._live()
        return np.where(run.is_shown(), run.star_fluxes(), np.nan)[: len(run.star_positions())]

    @cached_property
    def star_positions(self) -> Array:
        """Star positions, (x, y) in pixels as last refined, shape (n, 2)."""
        return self._live().star_positions().copy()

    def _live(self) -> Iterating:
        if self._run is None:
            raise RuntimeError("read what you need of the estimate before the callback returns")
        return self._run

    def _close(self) -> None:
        self._run = None


Callback = Callable[[int, Estimate], Any]


@dataclass(frozen=True, eq=False)
class Result:
    """The result of `lnocl.deconvolve`.

    Its arrays are read-only, and results are compared by identity.

    Attributes
    ----------
    extended : ndarray of float64
        Extended source, electrons per pixel of it. Its shape is the observation's ``sky_shape``:
        that of the images, times ``oversample``.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons, in the order of the stars given. NaN where no good pixel shows a star, at all or
        in an epoch.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels, as given or refined.
    n_iter : int
        The iteration of the estimate.
    stop_reason : str
        Why the run ended:

        - ``"n_iter"``: all iterations were done.
        - ``"callback"``: the callback returned True.
        - ``"change"``, ``"discrepancy"``, ``"held-out"``: the stopping rule was met.
        - ``"converged"``: no step of ``"sgp"`` lowers the objective any more, in the precision
          used.
        - ``"diverged"``: the objective rose, as with PSFs that have many negative pixels.
        - ``"not finite"``: the objective became infinite or NaN.

        In the last two cases the estimate is that of the least objective, and the history ends
        there.
    device : str
        Name of the device, its platform and driver; ``"numpy"`` for the reference.
    history : ndarray, fields ``iteration`` (int64) and ``objective`` (float64)
        The objective J after each iteration, from iteration 0, the start. With held-out counts the
        sum of the objectives of both halves.
    mu : float
        Weight of the Tikhonov term, per electron, as given or as chosen.
    smoothing : float
        Weight of the edge-preserving term, as given or as chosen.
    held_out : ndarray, fields ``smoothing``, ``iteration`` (int64) and ``error``
        The relative error of the extended source that held-out counts estimate, for each smoothing
        and iteration that they compared last. Empty where they did not choose.
    psf_refinement : PsfRefinement or None
        The outcome for PSFs that were to be refined, or whose scatter was given
        (`lnocl.runs.outcome.PsfRefinement`); None without either.
    halo_fluxes : ndarray of float64, shape (n_halos, p)
        The amounts of the observation's `halos` in each image: electrons on its good pixels, not
        per exposure.

    See Also
    --------
    lnocl.tiles.TiledResult : The result of `lnocl.deconvolve_tiles`.

    Examples
    --------
    A star of 1000 electrons on a sky of 5 electrons per pixel:

    >>> import numpy as np
    >>> import lnocl
    >>> y, x = np.indices((33, 33)) - 16
    >>> psf = np.exp(-(x**2 + y**2) / 4)
    >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
    >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
    >>> result.star_fluxes.round(), result.extended.mean().round()
    (array([1000.]), np.float64(5.0))
    >>> result.n_iter, result.stop_reason, len(result.history)
    (20, 'n_iter', 21)
    """

    extended: Array
    star_fluxes: Array
    star_positions: Array
    n_iter: int
    stop_reason: str
    device: str
    history: NDArray[np.void]
    mu: float
    smoothing: float
    held_out: NDArray[np.void]
    psf_refinement: PsfRefinement | None
    halo_fluxes: Array
    _findings: Findings = field(repr=False, compare=False)

    def __post_init__(self) -> None:
        for values in vars(self).values():
            if isinstance(values, np.ndarray):
                values.flags.writeable = False

    @property
    def star_flux_errors(self) -> Array:
        """Standard errors of the star fluxes, electrons, shape (n,).

        They follow from the joint Fisher information of all stars, of halos and of the extended
        source, which are not taken as known (`lnocl.solvers.star_errors`,
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
        return self._star_errors[0][: len(self.star_fluxes)]

    @property
    def halo_flux_errors(self) -> Array:
        """Standard errors of the amounts of halos, electrons, shape (n_halos, p).

        They follow from the joint Fisher information of halos, stars and the extended source
        (`lnocl.solvers.halos`), and are computed as `star_flux_errors` are. They are NaN
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
        return self._findings.of_halos(self._star_errors[0])

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
        return self._star_errors[1]

    @cached_property
    def _star_errors(self) -> tuple[Array, Array]:
        errors = self._findings.star_errors()
        for each in errors:
            each.flags.writeable = False
        return errors

    @cached_property
    def extended_flux(self) -> tuple[float, float]:
        r"""The light of the extended source in the frame and its standard error, electrons.

        It is the sum of the extended source and of what the residuals have beside it
        (`lnocl.solvers.light`), so that it has no bias, and may be negative where there is little
        but noise. ``extended.sum()`` is too large there, as no pixel is negative. The error is that
        of counts, of `star_flux_errors`, and of levels of the background that are not known. It is
        computed when it is first read.

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
        return self._findings.extended_flux(self._star_errors[0])

    @property
    def _outcome(self) -> Outcome:
        """The outcome that replicas, detections and limits are of."""
        if not isinstance(self._findings, Outcome):
            raise InputError(
                "replicas are of one run, as detections and limits are, and this result is of "
                "tiles: deconvolve a cut-out without tiles"
            )
        return self._findings

    @property
    def _observation(self) -> Observation:
        return self._findings.observation

    @property
    def psfs(self) -> Array:
        """The PSFs of the model, shape (p, ky, kx), of unit sum: as given or refined.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> observation = lnocl.Observation(np.full((2, 8, 8), 4.0), np.ones((3, 3)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> result.psfs.shape, result.psfs[0].sum()
        ((2, 3, 3), np.float64(1.0))
        """
        return self._observation.as_given(self._observation.psfs, cut=False)

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """Pixels of the extended source that errors of the PSFs may have faked, bool.

        Those are the pixels below ``psf_refinement.may_be_faked``. The shape is that of `extended`.
        All are False where PSFs were not refined and no scatter of them was given.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> observation = lnocl.Observation(np.full((8, 8), 4.0), np.ones((3, 3)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> result.doubtful.shape, result.doubtful.any()
        ((8, 8), np.False_)
        """
        if self.psf_refinement is None:
            return np.zeros(self.extended.shape, np.bool_)
        return self.extended < self.psf_refinement.may_be_faked

    def models(self) -> Array:
        """Return the models of the images.

        ``m_j = e_j (A_j f + sum_s c_s P_js) + b_j``, in double precision, as in `lnocl.deconvolve`.
        As in the observation, the square of the read noise is included.

        Returns
        -------
        ndarray of float64, shape (p, ny, nx)
            Electrons per pixel.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> observation = lnocl.Observation(np.full((2, 8, 8), 4.0), np.ones((3, 3)), background=1)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> result.models().shape, result.models().mean().round(3)
        ((2, 8, 8), np.float64(4.0))
        """
        return self._observation.as_given(np.array(list(self._findings.models())))

    def residuals(self) -> Array:
        """Return the normalised residuals, ``(g_j - m_j) / sqrt(m_j)``.

        Their rms is about 1 where only noise is left.

        Returns
        -------
        ndarray of float64, shape (p, ny, nx)
            NaN where a pixel is bad, or the model is 0.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> image = np.random.default_rng(0).poisson(100.0, (32, 32))
        >>> observation = lnocl.Observation(image, np.ones((5, 5)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=1, engine="numpy")
        >>> result.residuals().shape, bool(0.9 < result.residuals().std() < 1.1)
        ((1, 32, 32), True)
        """
        return self._residuals(self.models())

    def _residuals(self, models: Iterable[Array]) -> Array:
        observation = self._observation
        images, mask = map(observation.as_given, (observation.images, observation.mask))
        return np.array([residuals(*each) for each in zip(images, mask, models, strict=True)])

    def to_table(self) -> QTable:
        """Return the stars as a table of astropy, which `lnocl.deconvolve` takes as stars again.

        Returns
        -------
        astropy.table.QTable
            Columns ``x`` and ``y`` in pixels, 0-based, and ``flux`` and ``flux_error`` in
            electrons, per second where exposures were given. Where positions were refined, also
            ``x_error`` and ``y_error``. With several epochs each star has a row in each, and
            ``epoch`` is its number: rows of one star are its light curve.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> table = result.to_table()
        >>> table.colnames
        ['x', 'y', 'flux', 'flux_error']
        >>> print(table["flux"].round())
        [1000.] electron
        """
        from astropy import units as u
        from astropy.table import QTable  # which takes its time to load

        unit = u.Unit(self._unit)
        x, y = self.star_positions.T
        columns = {"x": x * u.pix, "y": y * u.pix, "flux": self.star_fluxes * unit}
        if np.isfinite(self.star_position_errors).any():
            x_error, y_error = self.star_position_errors.T
            columns |= {"x_error": x_error * u.pix, "y_error": y_error * u.pix}
        columns["flux_error"] = self.star_flux_errors * unit
        if (n_epochs := self._observation.n_epochs) > 1:
            columns["epoch"] = np.arange(len(self.star_fluxes)) % n_epochs
        return QTable(columns)

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
        were, by as many iterations (`lnocl.runs.replicas`, :doc:`/validation/errors`). It costs as
        much as a run of all counts of that length. All n of them use the buffers and programs of
        one run.

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
            Called with the errors so far, a `lnocl.runs.bootstrap.Bootstrap`, after each replica
            from the second on.
        parallel : bool, int or "current-scheduler", optional
            Where the replicas are computed (`lnocl.parallel.check_parallel`). False: one after the
            other in this process. True or a number: in as many processes as cores, or in that many.
            "current-scheduler": by the workers of a cluster of Dask. All give the same errors on
            the same kind of device.

        Returns
        -------
        Bootstrap
            The errors, `lnocl.runs.bootstrap.Bootstrap`.

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
        from lnocl.io.regions import read_parts
        from lnocl.parallel import check_parallel
        from lnocl.runs.bootstrap import bootstrap, check_number

        check_number(n, seed)
        check_parallel(parallel)
        outcome = self._outcome
        parts = read_parts(regions, profiles, header, self._observation)
        return bootstrap(outcome, n, parts, seed, progress, earlier, callback, parallel)

    def significance(self, width: float = 0.0, false_alarms: float = 0.01) -> Significance:
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

        Returns
        -------
        Significance
            Maps and detections, `lnocl.significance.Significance`.

        Raises
        ------
        InputError
            - A width or number of false alarms is out of range.
            - The result is of tiles.
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
        from lnocl.scene.quantities import in_unit
        from lnocl.significance import significance  # which loads scipy

        width = in_unit("width", width, "pix")
        false_alarms = in_unit("false_alarms", false_alarms, "")

        return significance(self._outcome, width, false_alarms)

    def plot(self) -> Figure:
        """Return a picture of the result, whole and at each of the brightest stars.

        Each row shows image, model, residuals and extended source. Below them are the errors that
        held-out counts estimate, or else the objective (`lnocl.plotting.result.draw_result`).

        Returns
        -------
        matplotlib.figure.Figure
            Its ``savefig`` writes a file.

        Raises
        ------
        LnoclError
            matplotlib is missing.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import lnocl
        >>> observation = lnocl.Observation(np.full((8, 8), 4.0), np.ones((3, 3)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "result.png")
        ...     result.plot().savefig(path, dpi=40)
        ...     path.exists()
        True
        """
        return draw_result(view_of(self))

    def write(
        self, path: str, *, header: fits.Header | None = None, overwrite: bool = False
    ) -> None:
        """Write a FITS file, which ``lnocl plot`` and ``lnocl report`` read.

        It is the file of ``lnocl deconvolve --residuals``, without the options, the command and
        the messages of the run, and without ESTIMATE, which needs a command that leads to the
        images. The primary HDU holds the extended source. The tables STARS, HALOS, HISTORY,
        HELDOUT and PLAN hold the stars, the amounts of halos, the objectives, the errors that
        held-out counts estimate, and the plan. The cubes MODELS and RESIDUALS hold those of each
        image. PSFS and others are added where PSFs were refined. Units are electrons, per second
        where exposures were given.

        Parameters
        ----------
        path : str
            File to write, named .fits, .fit or .fts.
        header : astropy.io.fits.Header, optional
            Header of the first image, or of another whose pixels are those of the sky. The
            keywords of the target and the observation are copied. So are its coordinates, by
            which stars get ``ra`` and ``dec``, unless all images are turned against the sky.
        overwrite : bool, optional
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            The file cannot be written, or exists and must not be overwritten.
        InputError
            The name does not end in .fits, .fit or .fts.

        Examples
        --------
        >>> import os, tempfile
        >>> import numpy as np
        >>> from astropy.io import fits
        >>> import lnocl
        >>> observation = lnocl.Observation(np.full((8, 8), 4.0), np.ones((3, 3)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "sky.fits")
        ...     result.write(path)
        ...     fits.getdata(path).shape, fits.getheader(path)["NITER"]
        ((8, 8), 2)
        """
        from lnocl.io import atomic
        from lnocl.io.headers import observed_cards
        from lnocl.result.file import write_file

        path = os.fspath(path)
        atomic.check_fits_output(path, overwrite)
        cards = [] if header is None else observed_cards(header, header)
        is_upright = (self._observation.transforms[:, :, :2] == np.eye(2)).all(axis=(1, 2))
        write_file(self, path, header if is_upright.any() else None, overwrite, cards=cards)

    def _repr_html_(self) -> str:
        """Return a table for a notebook, with a thumbnail where matplotlib is there."""
        stars = [
            f"({x:.2f}, {y:.2f}): {flux:.5g}"
            for (x, y), flux in zip(self.star_positions, self.star_fluxes, strict=True)
        ]
        shown = [*stars[:MAX_LISTED], *(["..."] if len(stars) > MAX_LISTED else [])]
        rows = {
            "iterations": f"{self.n_iter} ({self.stop_reason})",
            "stars": "\n".join(shown) or "none",
            "extended source": "{:.5g} +- {:.2g}".format(*self.extended_flux),
            **({"halos": "\n".join(self._halo_lines())} if self.halo_fluxes.size else {}),
            "device": self.device,
        }
        return html_card("lnocl.Result", rows, self.extended)

    @property
    def _unit(self) -> str:
        return "electron" if (self._observation.exposure == 1.0).all() else "electron/s"

    def _halo_lines(self) -> list[str]:
        """Return the amounts of each halo in words, electrons."""
        lines = []
        pairs = zip(self.halo_fluxes, self.halo_flux_errors, strict=True)
        for k, (fluxes, errors) in enumerate(pairs, 1):
            if len(fluxes) == 1:
                amount = f"{fluxes[0]:.6g} +- {errors[0]:.2g} electrons"
            else:
                amount = (
                    f"{fluxes.min():.6g} to {fluxes.max():.6g} electrons in "
                    f"{len(fluxes)} images, with errors of {np.median(errors):.2g} (median)"
                )
            lines.append(f"halo {k}: {amount}")
        return lines

    def fit(self) -> Fit:
        """Return how well the model fits all good pixels.

        It takes a convolution of each image in double precision on the host.

        Returns
        -------
        Fit
            The sum of the squared residuals, their rms and its error, `lnocl.residuals.Fit`.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> image = np.random.default_rng(0).poisson(100.0, (32, 32))
        >>> observation = lnocl.Observation(image, np.ones((5, 5)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=1, engine="numpy")
        >>> fit = result.fit()
        >>> fit.n_pixels, bool(0.9 < fit.rms < 1.1), fit.is_misfit
        (1024, True, False)
        """
        return self._fit

    @cached_property
    def _fit(self) -> Fit:
        return judge(self._observation, self._findings.models())

    def star_residuals(self) -> list[StarResiduals]:
        """Return how well the model fits at each star: in its core, its wings and round it.

        Returns
        -------
        list of StarResiduals
            One for each star, `lnocl.residuals.StarResiduals`.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> observation = lnocl.Observation(5 + 1000 * psf / psf.sum(), psf)
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> (star,) = result.star_residuals()
        >>> star.core.n_pixels, star.is_misfit, star.has_halo
        (9, False, False)
        """
        return list(self._star_residuals)

    @cached_property
    def _star_residuals(self) -> list[StarResiduals]:
        return self._findings.star_residuals()

    @property
    def plan(self) -> str:
        """The plan that the run had, a line for each step: whether it was to be done, or why not.

        It is that of `lnocl.plan`, and the table PLAN of the result's file.
        """
        return "\n".join(self._findings.plan)

    def verdict(self) -> list[str]:
        """Return that the model fits, or else where it does not and what to do, a line each.

        It rests on `star_residuals` and `fit`. `lnocl.deconvolve` has warned of each fault.

        Returns
        -------
        list of str
            ``["the model fits"]``, or a line for each fault.

        Examples
        --------
        A star that is wider than its PSF:

        >>> import warnings
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> star, psf = (np.exp(-(x**2 + y**2) / width) for width in (8, 6))
        >>> observation = lnocl.Observation(5 + 1e4 * star / star.sum(), psf)
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("ignore", lnocl.LnoclWarning)
        ...     options = {"smoothing": 10.0, "stop": None, "n_iter": 20, "engine": "numpy"}
        ...     result = lnocl.deconvolve(observation, [(16, 16)], **options)
        >>> result.verdict()[0].partition(" or try")[0]
        'the model does not fit at 1 of 1 star, (16, 16): give a better PSF,'
        """
        from lnocl.result.verdict import FITS, faults

        return [with_names(line) for line in faults(self)] or [FITS]


def make_result(outcome: Outcome) -> Result:
    """Return the result of a reconstruction that has ended."""
    scene = outcome.scene
    history = np.zeros(len(outcome.objectives), HISTORY_DTYPE)
    history["iteration"] = np.arange(len(history))
    history["objective"] = outcome.objectives
    return Result(
        extended=outcome.estimate.observed_sky,
        star_fluxes=outcome.fluxes_of_stars,
        star_positions=scene.stars,
        n_iter=len(history) - 1,
        stop_reason=outcome.stop_reason,
        device=outcome.setup.engine_name(),
        history=history,
        mu=scene.penalty.mu,
        smoothing=scene.penalty.smoothing,
        held_out=outcome.curve,
        psf_refinement=outcome.psf_refinement,
        halo_fluxes=outcome.of_halos(outcome.star_fluxes),
        _findings=outcome,
    )


def view_of(result: Result) -> ResultView:
    """Return the arrays and texts of the picture of a result."""
    observation = result._observation
    models = result.models()
    return ResultView(
        extended=result.extended,
        # Once each, whatever epochs there are.
        stars=[(x, y) for x, y in result.star_positions[:: observation.n_epochs].tolist()],
        star_fluxes=mean_over_epochs(result.star_fluxes, observation.n_epochs),
        n_iter=result.n_iter,
        history={name: result.history[name] for name in HISTORY_DTYPE.names or ()},
        held_out={name: result.held_out[name] for name in result.held_out.dtype.names or ()},
        images=observation.as_given(np.where(observation.mask, np.nan, observation.images)),
        models=models,
        residuals=result._residuals(models),
        offsets=observation.transforms[:, :, 2],
        turns=observation.transforms[:, :, :2] if observation.is_mapped else None,
        doubtful=None if result.psf_refinement is None else result.doubtful,
        unit=result._unit,
        oversample=observation.oversample,
        light_curves=light_curves(
            result.star_fluxes,
            result.star_flux_errors,
            np.tile(np.arange(observation.n_epochs), len(result.star_fluxes)),
            result._unit,
        ),
    )
