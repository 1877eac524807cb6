"""The result of `deconvolve`, and the estimate that a callback is given."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import compress, cycle
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.outcome import Outcome, PsfRefinement
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.observation import Observation
from lnocl.errors import InputError, counted, with_names
from lnocl.notebook import html_card
from lnocl.plotting.result import draw_result
from lnocl.residuals import Fit, StarResiduals, judge, residuals
from lnocl.result.estimate import Callback, Estimate, Iterating
from lnocl.result.measured import Findings, Measured
from lnocl.result.summary import summary_lines, with_error
from lnocl.result.views import view_of

if TYPE_CHECKING:
    from astropy.io import fits
    from astropy.nddata import CCDData
    from astropy.table import QTable
    from matplotlib.figure import Figure

__all__ = ["Callback", "Estimate", "Iterating", "Result", "make_result", "view_of"]

# Stars that a notebook lists, and skies that it shows.
MAX_LISTED, MOST_SKIES = 10, 4

HISTORY_DTYPE = np.dtype([("iteration", np.int64), ("objective", np.float64)])


@dataclass(frozen=True, eq=False, repr=False)
class Result(Measured):
    """The result of `lnocl.deconvolve`.

    Its arrays are read-only, and results are compared by identity.

    Attributes
    ----------
    extended : ndarray of float64
        Extended source, electrons per pixel of it. Its shape is the observation's ``sky_shape``:
        that of the images, times ``oversample``; with ``components`` (K, ny, nx), one sky each.
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
        The outcome for PSFs that were to be refined, or are exact but for a scatter
        (`lnocl.core.runs.outcome.PsfRefinement`); None without either.
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
    def _observation(self) -> Observation:
        return self._findings.observation

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components, in the order of `extended`; empty where there is one sky."""
        return self._observation.component_names

    def component(self, name: str) -> Array:
        """Return the sky of a component, electrons per pixel in an image of weight 1.

        Parameters
        ----------
        name : str
            Its name, as given to `lnocl.Observation`.

        Returns
        -------
        ndarray of float64, shape (ny, nx)
            Its plane of `extended`.

        Raises
        ------
        InputError
            No component has this name.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> images, psf = [np.full((8, 8), 9.0), np.full((8, 8), 4.0)], np.ones((1, 1))
        >>> components = {"line": [1, 0], "continuum": [1, 1]}
        >>> observation = lnocl.Observation(images, psf, components=components)
        >>> options = {"smoothing": 0, "stop": None, "engine": "numpy"}
        >>> result = lnocl.deconvolve(observation, **options)
        >>> result.component("line").mean().round(2)
        np.float64(5.0)
        """
        if name not in self.component_names:
            known = ", ".join(self.component_names) or "none was given"
            raise InputError(f"no component is called {name!r}: {known}")
        return self.extended[self.component_names.index(name)]

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
            electrons, per second where exposures were given. A flux is NaN where no good pixel
            shows the star. Where positions were refined, also ``x_error`` and ``y_error``, in
            pixels. With several epochs each star has a row in each: rows of one star are its light
            curve. Then ``epoch`` is the number of the epoch, from 0 on, and ``epoch_label`` its
            label; ``variation_error`` is the error of the flux less the star's mean. With
            components these rows are of filters, which ``images_of`` names instead of both.

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
            labels = np.array(self._observation.epoch_labels)[columns["epoch"]]
            columns["images_of" if self.component_names else "epoch_label"] = labels
            if not self.component_names:
                columns["variation_error"] = self.star_variation_errors * unit
        return QTable(columns)

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

        It is the file of ``lnocl deconvolve --residuals``, without the options, the command, and
        what was measured and chosen. It has no ESTIMATE, which needs a command that leads to the
        images. The primary HDU holds the extended source. The tables STARS, HISTORY, PLAN and
        MESSAGES hold the stars, the objectives, the plan, and the lines of ``print(result)``.
        HALOS holds the amounts of halos, and HELDOUT the errors that held-out counts estimate,
        where there are any. With components the primary HDU is a cube of their skies, COMPONENTS
        has their names and light, and NOISE the noise of their pixels by counts. PSFS and others
        are added where PSFs were refined. Extended source and
        stars are in electrons, per second where exposures were given.

        The cubes MODELS and RESIDUALS hold `models`, in electrons, and `residuals` of each image.
        ELECTRONS holds how many electrons of each image one unit of the extended source is.

        Parameters
        ----------
        path : str or path
            File to write, named .fits, .fit or .fts.
        header : astropy.io.fits.Header, optional
            Header of the first image, or of another whose pixels are those of the sky. The
            keywords of the target and the observation are copied. So are its coordinates, by
            which stars get ``ra`` and ``dec``, unless all images are turned against the sky.
            By default the coordinates are those of the images, where these are NDData or CCDData.
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
        header = self._wcs_header() if header is None else header
        write_file(
            self,
            path,
            header if is_upright.any() else None,
            overwrite,
            cards=cards,
            messages=str(self).splitlines(),
        )

    def to_ccddata(self) -> CCDData:
        """Return the extended source as a CCDData of astropy.

        Returns
        -------
        astropy.nddata.CCDData
            With its unit, electrons, per second where exposures were given, and the coordinates of
            the images, where these were NDData or CCDData; those of a finer sky are as fine.

        Examples
        --------
        >>> import numpy as np
        >>> from astropy.nddata import CCDData
        >>> from astropy.wcs import WCS
        >>> import lnocl
        >>> wcs = WCS({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 65.0, "CRVAL2": 19.5})
        >>> image = CCDData(np.full((8, 8), 4.0), unit="electron", wcs=wcs)
        >>> observation = lnocl.Observation(image, np.ones((3, 3)))
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=2, engine="numpy")
        >>> sky = result.to_ccddata()
        >>> sky.unit, sky.wcs.wcs.crval.tolist()
        (Unit("electron"), [65.0, 19.5])
        """
        from astropy.nddata import CCDData

        from lnocl.io.fitsread import wcs_cards
        from lnocl.io.headers import finer_cards, make_wcs

        header, wcs = self._wcs_header(), None
        if header is not None:
            wcs = make_wcs(finer_cards(wcs_cards(header), self._observation.oversample))
            if self.component_names:
                wcs = wcs.sub([1, 2, 0])  # the last for the planes
                wcs.array_shape = self.extended.shape
        return CCDData(self.extended, unit=self._unit, wcs=wcs)

    def _wcs_header(self) -> fits.Header | None:
        """Return the coordinates of the images, where they came with them."""
        from astropy.wcs import WCS

        wcs = self._observation.wcs  # which may be of another library, such as gwcs
        is_known = isinstance(wcs, WCS) and wcs.has_celestial
        return wcs.celestial.to_header(relax=True) if is_known else None

    def _repr_html_(self) -> str:
        """Return a table for a notebook, with a thumbnail where matplotlib is there."""
        labels = [f" in images of {each}" for each in self._observation.epoch_labels]
        seen = cycle(labels if self.component_names else [""])
        stars = [
            f"({x:.2f}, {y:.2f}): {flux:.5g}{where}"
            for (x, y), flux, where in zip(
                self.star_positions, self.star_fluxes, seen, strict=False
            )
        ]
        shown = [*stars[:MAX_LISTED], *(["..."] if len(stars) > MAX_LISTED else [])]
        rows = {
            "iterations": f"{self.n_iter} ({self.stop_reason})",
            "stars": "\n".join(shown) or "none",
            **self._light_rows(),
            **dict(self._halo_rows()),
            "device": self.device,
        }
        skies = self.extended[:MOST_SKIES] if self.component_names else self.extended
        return html_card("lnocl.Result", rows, skies)

    @property
    def _unit(self) -> str:
        return "electron/s" if self._findings.setup.is_rate else "electron"

    def __str__(self) -> str:
        """Return the fluxes, whether to trust them, and how the run ended, in a few lines.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> y, x = np.indices((33, 33)) - 16
        >>> psf = np.exp(-(x**2 + y**2) / 4)
        >>> image = np.random.default_rng(0).poisson(50 + 1e5 * psf / psf.sum())
        >>> observation = lnocl.Observation(image, psf, background=50, psf_error=0)
        >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=20, engine="numpy")
        >>> print(result)
        star 1 (16, 16)  99 990 +- 330 electrons
        extended            180 +- 250 electrons in the frame
        trust            yes: residuals are noise, the PSF fits
        20 iterations, all that were allowed
        """
        return with_names("\n".join(summary_lines(self)))

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.extended.shape[:-3:-1]))
        n_stars = len(self.star_positions) // self._observation.n_epochs
        return (
            f"<lnocl.{type(self).__name__} of {counted(n_stars, 'star')} and {shape} pixels after "
            f"{counted(self.n_iter, 'iteration')}>"
        )

    def _light_rows(self) -> dict[str, str]:
        """Return the light of the extended source, or of each component, in words."""
        names = self.component_names or ("extended source",)
        fluxes = zip(names, *map(np.atleast_1d, self.extended_flux), strict=True)
        return {name: f"{flux:.5g} +- {error:.2g}" for name, flux, error in fluxes}

    def _halo_rows(self) -> list[tuple[str, str]]:
        """Return the name of each halo, and its amounts in words, electrons."""
        rows = []
        pairs = zip(self.halo_fluxes, self.halo_flux_errors, strict=True)
        for k, (fluxes, errors) in enumerate(pairs, 1):
            if len(fluxes) == 1:
                amount = f"{with_error(fluxes[0], errors[0])} electrons"
            else:
                amount = (
                    f"{fluxes.min():.6g} to {fluxes.max():.6g} electrons in "
                    f"{len(fluxes)} images, with errors of {np.median(errors):.2g} (median)"
                )
            rows.append((f"halo {k}", amount))
        return rows

    def fit(self, epoch: str | float | None = None) -> Fit:
        """Return how well the model fits all good pixels, or those of an epoch.

        It takes a convolution of each image in double precision on the host.

        Parameters
        ----------
        epoch : str or float, optional
            Its label, as given to `lnocl.Observation`.

        Returns
        -------
        Fit
            The sum of the squared residuals, their rms and its error, `lnocl.residuals.Fit`.

        Raises
        ------
        InputError
            No epoch has this label.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> image = np.random.default_rng(0).poisson(100.0, (32, 32))
        >>> images, nights = [image, image], ["May", "June"]
        >>> observation = lnocl.Observation(images, np.ones((5, 5)), epochs=nights)
        >>> result = lnocl.deconvolve(observation, stop=None, n_iter=1, engine="numpy")
        >>> fit = result.fit()
        >>> fit.n_pixels, bool(0.9 < fit.rms < 1.1), fit.is_misfit
        (2048, True, False)
        >>> result.fit("June").n_pixels
        1024
        """
        labels = self._observation.epoch_labels
        is_wanted = [epoch is None or labels[k] == str(epoch) for k in self._observation.epochs]
        if not any(is_wanted):
            raise InputError(f"`epoch` is {epoch!r}; give one of {', '.join(labels)}")
        return reduce(Fit.plus, compress(self._fits, is_wanted))

    @cached_property
    def _fits(self) -> list[Fit]:
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
    history = np.array(list(enumerate(outcome.objectives)), HISTORY_DTYPE)
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
        halo_fluxes=outcome.halo_amounts(outcome.star_fluxes),
        _findings=outcome,
    )
