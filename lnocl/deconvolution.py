"""The public function: plan, prepare, run, finish, and return the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from inspect import signature
from os import PathLike
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lnocl.checkpoint import Checkpointer
from lnocl.core.runs.inputs import describe
from lnocl.core.runs.options import EngineName, Precision, StopName, check_types
from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.plan import HALOS, LEVELS, PSFS, STARS, Plan
from lnocl.core.runs.plan import plan as make_plan
from lnocl.core.runs.preparation import Prepared, prepare, quietly
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_families import Family
from lnocl.core.solvers import SolverName
from lnocl.errors import detail
from lnocl.progress import Progress
from lnocl.reconstruction import reconstruct
from lnocl.residuals import judge_stars
from lnocl.result import Callback, Result, make_result
from lnocl.result.verdict import warn_of_faults


def deconvolve(
    observation: Observation,
    stars: Iterable[tuple[float, float]] = (),
    *,
    mu: float = 0.0,
    smoothing: float | Literal["auto"] = "auto",
    spectral_smoothing: float = 0.0,
    solver: SolverName = "sgp",
    n_iter: int = 1000,
    stop: StopName | float | None = "held-out",
    precision: Precision = "single",
    engine: EngineName = "opencl",
    device: str | None = None,
    pad: int | Literal["auto"] = "auto",
    initial_extended: ArrayLike | None = None,
    initial_star_fluxes: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: bool = False,
    refine_positions: bool | Literal["auto"] = "auto",
    refine_psfs: Literal["auto"] | Iterable[Family] = "auto",
    mend_images: bool = True,
    checkpoint: str | PathLike[str] | None = None,
    resume: str | PathLike[str] | None = None,
) -> Result:
    r"""Reconstruct the sky from several images as stars plus an extended source.

    The images show one sky, each through a PSF of its own. Stars are given by their positions, and
    have fluxes; the rest of the sky is an image without them. The defaults are for real frames:
    they choose iterations and smoothing, judge the PSFs, and move stars where the data show it.

    A star of 1e5 electrons on a sky of 20 per pixel:

    >>> import numpy as np
    >>> import lnocl
    >>> y, x = np.mgrid[-8:9, -8:9]
    >>> psf = np.exp(-(x**2 + y**2) / 4.5)
    >>> image = np.full((32, 32), 20.0)
    >>> image[4:21, 3:20] += 1e5 * psf / psf.sum()
    >>> image = np.random.default_rng(0).poisson(image)
    >>> obs = lnocl.Observation(image, psf, background=20.0, psf_error=0)
    >>> result = lnocl.deconvolve(obs, stars=[(11, 12)], engine="numpy")
    >>> print(result)  # doctest: +ELLIPSIS
    star 1 (11, 12)  99 700 +- 320 electrons
    ...

    ``result.extended`` is the image of the rest. Leave `engine` out to use an OpenCL device, and
    `psf_error` for PSFs that are not exact.

    Parameters
    ----------
    observation : Observation
        The p images of shape (ny, nx), with their PSFs, backgrounds, noise and masks.
    stars : iterable of (x, y) or astropy.table.Table, optional
        Positions of the n point sources in pixels of an image without offset, 0-based, x along
        columns. Two stars must lie a thousandth of a pixel apart or more. They may be a Quantity in
        pixels, or a table with columns x and y, or as photutils or SExtractor name them
        (`lnocl.core.scene.star_tables.IN_PIXELS`). SExtractor counts from 1, and is converted.
        Between pixels a star's image is the PSF moved in its spectrum
        (`lnocl.core.scene.shifting.place`).
    mu : float, optional
        Weight of the Tikhonov term on the extended source, per electron, zero or more.
    smoothing : float or "auto", optional
        Weight of an edge-preserving term against noise (`lnocl.core.scene.penalty.Penalty`), zero
        or more, or "auto", that which suits the noise of the counts.

        The weight is λ in the objective, without unit. The length δ is three times the mean of the
        extended source. The term keeps the noise down that grows with the iterations, most of all
        beside bright stars. "auto" is a tenth of the noise of the data term's gradient, ``0.1
        sqrt(sum_j <e_j^2 / g_j> sum K_j^2)``, with e_j over their mean and < > the mean over
        pixels. With held-out counts it is 0, or 1, 3 or 10 times that, whichever they choose
        (:doc:`/validation/sgp`). Where PSFs do not fit the stars it is 3 times that. It is more
        near the stars, as far as rings round these show an error of the PSFs. See Notes.
    spectral_smoothing : float, optional
        Weight of that term between each component and the next, such as the slices of a cube, in
        units of `smoothing`, zero or more. By default components share no prior.
    solver : {"sgp", "sgm"}, optional
        Iteration to use: "sgp", the scaled gradient projection method; or "sgm", the split-gradient
        method, the paper's, which needs ten times the iterations and more.

        "sgp" solves for the star fluxes at the start, so that those given matter little.
    n_iter : int, optional
        Largest number of iterations, 1 or more.

        So many are done unless `stop` or a callback ends the run sooner.
    stop : "held-out", "discrepancy", float or None, optional
        When to stop before `n_iter`: "held-out", at the iteration that held-out counts choose
        (cross-validation); "discrepancy", when the data are fitted as well as noise allows; a
        number below 1, when the objective changes relatively by less in an iteration; or None.

        With "held-out" see Notes; where PSFs do not fit, which held-out counts do not notice, the
        run ends when the objective falls by less than 1e-6 of itself. With "discrepancy" it ends
        when the data term has fallen to its expectation for Poisson counts of the model's means.
        The change that a number is compared with is averaged over ten iterations.
    precision : {"single", "double"}, optional
        Arithmetic of the OpenCL engine. The NumPy reference always computes in double.
    engine : {"opencl", "numpy"}, optional
        Where the iterations are computed: OpenCL, or the plain NumPy reference.
    device : str, optional
        OpenCL device as ``PLATFORM[:DEVICE]``, each an index or a part of the name, as ``lnocl
        devices`` lists them (see `lnocl.core.opencl.device.choose`). By default that of the
        environment variable PYOPENCL_CTX, else the first GPU, else the first CPU.
    pad : int or "auto", optional
        Smallest number of unobserved pixels round the images. "auto": where light runs over the
        edge as many as the PSFs need, else 0.

        They need the radius that holds nine tenths of their light, at most half the shorter side
        (:doc:`/validation/frames`). Each axis of the grid is then the next of
        `lnocl.core.scene.grid.LENGTHS`: powers of two, and 3, 5, 7 or 9 times one from 16 up. It is
        at least as long as the PSFs or twice the images. The model is periodic where images have
        such lengths, PSFs are no larger, and ``pad=0``.
    initial_extended : array_like, of the shape of the result's, optional
        Extended source to start from, not 0 everywhere; by default flat. Pixels that start at 0
        stay 0 with "sgm". One that is far brighter than the images, as in another unit, is made as
        bright as they are.
    initial_star_fluxes : array_like, shape (n,), optional
        Star fluxes to start from, more than 0 with "sgm" unless positions are refined; by default
        read off the data.
    callback : callable, optional
        Called after every iteration as ``callback(iteration, estimate)``, with a
        `lnocl.result.Estimate`. It stops the run by returning True. With held-out counts the
        estimate is the sum of both halves'. They go beyond the iteration of the result, and begin
        again for each smoothing.
    progress : bool, optional
        Show a progress bar on stderr, where that is a terminal, for each long phase, with the
        objective or the quantity of the stopping rule. Elsewhere the logger "lnocl.progress" has a
        line each minute.
    refine_positions : bool or "auto", optional
        Fit the positions of the stars too, each within 3 pixels of the one given, or take them as
        given. By default they are fitted where that mends a misfit at the stars, and `smoothing` is
        "auto".

        Fisher scoring of all fluxes and positions moves the stars, with the extended source held
        fixed (`lnocl.core.solvers.positions`). It runs at the start and after 3, 6, 12, 24 ...
        iterations. See Notes.
    refine_psfs : iterable of {"shift", "jitter", "strehl", "pupil", "modes", "pixels"}, or "auto"
        What is fitted of PSFs to the stars before the reconstruction, where they do not fit: shift;
        jitter (a blur, or a sharpening); strehl (needs `ideal_psfs` or `pupils`); pupil (phases;
        needs `pupils`); modes (needs `psf_modes`); pixels. Refined PSFs are used where they fit
        better. By default, where `smoothing` is "auto": jitter, the shift of several images,
        pixels, and those whose needs are given. Unless the `psf_error` of the observation is 0,
        PSFs first become what the stars show of them. Then jitter and pixels are fitted only where
        PSFs are off by more than twice that error.

        The extended source is marginalised. An empty sequence is for none, and leaves PSFs as they
        are given. See Notes. At least one star.
    mend_images : bool, optional
        Mask saturated cores of stars and cosmic rays, and fit relative exposures to stars, where
        `smoothing` is "auto". By default this is done.

        Cores are flat at their top, 0, or wrapped round (`lnocl.core.scene.saturation`). Cosmic
        rays are sharper than the PSF (`lnocl.core.scene.blemishes`). Exposures of several images of
        a filter are multiplied by the factor that all stars show, where it is significant
        (`lnocl.core.scene.zero_points`); those in the middle keep their own. A line of the log
        and the plan of the result say what was mended.
    checkpoint : str or path, optional
        File for the state of the run (FITS), saved after the first iterations, every minute and at
        the end.

        Each checkpoint replaces the one before once it is complete. With held-out counts it holds
        both halves and about twenty estimates of each.
    resume : str or path, optional
        Checkpoint to continue from. Everything else must be as it was when it was written. The
        result is then bit for bit that of a run that was never interrupted.

    Returns
    -------
    Result
        The extended source, the stars, and the history of the run.

    Raises
    ------
    InputError
        - `observation` is not an Observation, or no good pixel shows one of its filters.
        - A parameter is out of its range, masked or too large for the precision.
        - A star lies outside the images, two are at one position, or they are not in pixels.
        - The start is not in counts, or is 0 and stays so.
        - The device does not exist, or was given for the reference.
        - Exposures are too large to be summed, or the sky overflows.
        - Held-out counts were asked of images that hold no counts.
        - PSFs are to be refined without a star, in a way that is not known, or that needs more than
          the observation has.
        - A shift of one image is to be refined beside free positions.
    FileError
        A checkpoint cannot be written or read, is damaged, or would replace that of another run.
    DivergedError
        The objective of the halves of held-out counts rises from the start.
    DeviceError
        - There is no OpenCL device, or it has too little memory or no double precision.
        - The device or its compiler fails.
        - The process was forked from one that uses OpenCL.

    Warns
    -----
    LnoclWarning
        - A PSF is larger than the grid, so that its wings wrap round.
        - A PSF rings by more than 1 % of its peak where it is moved between pixels.
        - PSFs vary by more than a fifth over an image that has one for its extended source.
        - A PSF is a tenth wider or narrower than a star.
        - A star is not at the position given, or lies on bad pixels of all images.
        - No good pixel shows a star, at all or in an epoch: it is left out, and its flux is NaN.
        - PSFs have an error of more than 3 % at the stars that refining has not mended.
        - Images are offset by more than `pad` and the grid leave room for.
        - Single precision is expected to stray from double by a thousandth of the extended source.
        - The noise of an image is not that of Poisson counts.
        - The background is above the darker half of an image.
        - The extended source to start from was far brighter than the images.
        - Held-out counts choose an iteration too near `n_iter`; a run with a weight is the result.
        - The objective rises or is not finite.
        - The model does not fit, at a star or in all, or a star has no light (`Result.verdict`).
        - A later checkpoint cannot be written.
        - Compiled kernels cannot be stored, or they or the tunings are damaged.

    See Also
    --------
    lnocl.deconvolve_tiles : Reconstructs large images, and PSFs that vary, tile by tile.
    lnocl.Result.bootstrap : Errors of stars, regions and pixels.

    Notes
    -----
    **The objective** that the star fluxes c and the extended source f minimise is

    .. math::

       J = \sum_j \sum_n \left[ g_j \, \ln \frac{g_j}{m_j} + m_j - g_j \right]
           + \frac{\mu}{2} \sum F^2
           + \lambda \sum \left[ \sqrt{(F - F')^2 + \delta^2} - \delta \right]

    for images :math:`g_j` of pixels n, with the models

    .. math:: m_j = e_j \left( A_j f + \sum_s c_s P_{js} \right) + \sum_k a_{kj} H_{kj} + b_j .

    Here :math:`A_j` convolves with PSF j, and :math:`P_{js}` is the image of star s for flux 1. The
    background is :math:`b_j`, and the exposure :math:`e_j`, by default 1. Halos :math:`H_{kj}`, if
    any, have amounts :math:`a_{kj}` that are fitted in each image. The weights μ and λ of the
    penalties are `mu` and `smoothing`. These are on :math:`F = \bar e f`, the extended source in
    electrons at the mean exposure, and no unit of time enters them. The last sum is over pairs of
    neighbouring pixels. The sky may be finer than the images (``oversample`` of the observation).
    :math:`A_j` then sums over the pixels of the sky that a pixel of the image holds.

    The paper's iteration is ``solver="sgm", stop=None, smoothing=0, pad=0`` with `mu` and `n_iter`
    given. Without stars and penalties that is Richardson-Lucy for several images. The theory
    explains the model (:doc:`/theory/model`) and the methods (:doc:`/theory/iterations`).

    **Held-out counts** are cross-validation by data thinning. The counts are split at random into
    two halves, independent observations of the same sky. Both are reconstructed side by side. The
    error of their sum is estimated from the products of one's estimates with the other's
    (`lnocl.core.runs.assessment` has the equation). The last iteration with an error within a tenth
    of the least is chosen, and the halves run to twice that iteration. The result is the sum of
    their extended sources and star fluxes at the chosen iteration, and the mean of their positions.

    That takes about four times as long as a run whose iteration is known. It takes the memory of
    two runs and of about twenty estimates of each. Where smoothing is "auto" the halves then
    continue with larger and larger weights, each from a third of the chosen iteration, until the
    error rises. That takes six times as long in the median, and up to eleven
    (:doc:`/validation/sgp`).

    **Stars have a prior** in the halves where smoothing is "auto". What lies under a star the
    extended source may take over at almost no price, and the more light it has, the smaller is its
    relative error. So a run with a fixed weight comes first, until the objective settles. The star
    fluxes that it tells, and their errors by `lnocl.core.solvers.star_errors`, are a Gaussian prior
    (`lnocl.core.runs.steady`). Where held-out counts choose an iteration of more than four fifths
    of `n_iter`, that run is the result, and a warning says so.

    **Refined PSFs** have parameters of these kinds (`lnocl.core.scene.psf_families`,
    `lnocl.core.solvers.psf_fit`):

    - "shift", the place of the PSF;
    - "jitter", the covariance of a blur;
    - "strehl", the Strehl ratio between the PSF and ``ideal_psfs``;
    - "pupil", phases across ``pupils``;
    - "modes", the coefficients of ``psf_modes``;
    - "pixels", each pixel, as far as the residuals allow, or the ``psf_scatter`` of exact PSFs.

    **PSFs are never exact**, unless the `psf_error` of the observation is 0. Stretch, blur and
    wings of each, the errors of its pixels (``psf_scatter`` where that is more), the light beyond
    its file, zero points of images and a cusp of the extended source under each star are unknowns
    beside the stars, with priors (`lnocl.core.solvers.psf_errors`). The mean of stretch and blur by
    the brightest stars, after a run with a fixed weight, makes the PSFs of the reconstruction,
    three times in turn (`lnocl.core.runs.psf_posterior`). A PSF stays whose images fit no better,
    where PSFs are not in doubt and its width changes by less than its `psf_error`. Stars that lie
    off by more than such PSFs may be shifted are moved, where they may be. Points beside stars that
    were not named are held meanwhile (`lnocl.core.solvers.companions`). All of it is marginalised
    in the errors of fluxes and places (:doc:`/validation/psf_error`).

    **PSFs that do not fit** leave light beside a star, and an extended source that is free there
    takes it up. So PSFs are judged by short runs in a window round the stars. In these the
    extended source is smoothed near the stars as strongly as the PSFs' own error asks for, which
    the residuals at the stars show (`lnocl.core.scene.psf_misfit`, `lnocl.core.runs.guarded_runs`).
    Where their chi squared exceeds its expectation by five standard deviations, or by three and the
    error is above 0.025, positions and PSFs are refined as far as they may be: exact PSFs only
    where that is asked, and jitter and pixels unasked only where the error is above twice
    `psf_error`, which is raised to it. They are used where they take two standard deviations or
    more, and leave less than half of the error, or nothing that noise does not explain. Free
    pixels, which may fit anything, are used where they leave less than 0.3 of it, and change no
    star's flux by more than κ. Read noise that is larger than the images show is lowered for all
    this.

    What is left, a relative error κ of the PSFs, adds to λ twice the standard deviation of the data
    term's gradient by it, ``2 sqrt(sum_j (A_j^2)^T (κ S_j / m_j)^2)``, with S_j the starlight. So
    does the ``psf_scatter`` of PSFs whose `psf_error` is 0, and the error that free pixels have
    mended. It is the error in each ring round the stars, where it is two standard deviations or
    more. The run then ends where the objective hardly changes any more (:doc:`/validation/psf`).
    Where single rings show an error and all of them together show none, held-out counts choose λ.
    Where `smoothing` is a number, it stays as it is, scatter or not, and PSFs are judged only where
    `refine_psfs` names families, or exact ones have a scatter. Those of more than 64 stars in the
    window are judged only where families are named. Stars whose positions are not refined are taken
    to be where they are given.

    Images that are turned, of several epochs or with halos are judged alike, each PSF in the frame
    of its image. Of PSFs that vary over an image all are changed alike.

    **Star fluxes are marginal** where PSFs were judged, and fit or are off by no more than twice
    their `psf_error`. What lies under a star belongs to it or to the extended source, and early
    iterations leave it to the star. So after the last iteration each star takes a step of Newton to
    the flux that the counts give it with the extended source marginalised
    (`lnocl.core.solvers.marginal`). The extended source takes up what stars lose. A callback and
    the history have the iterations as they were.

    **Levels** of backgrounds with a `background_error` are fitted after a short run, and again at
    the end, with a gradient (`lnocl.core.solvers.levels`). Their errors are in those of star fluxes
    and of the extended source. Where `smoothing` is a number levels stay, with the errors as given.

    **The split-gradient method** lowers the objective at every iteration where PSFs are not
    negative. With many negative pixels, as in a raw frame of a star, the objective may rise again.
    All the light may then end in one pixel. Where the objective stays a tenth above its least for
    ten iterations, the run ends with the estimate of the least objective. A warning names the fault
    of the PSFs. The scaled gradient projection method accepts no rise above
    rounding.

    References
    ----------
    A. La Camera, S. Antoniucci, M. Bertero et al., "Image reconstruction for observations with a
    high dynamic range: LINC-NIRVANA simulations of a stellar jet", Proc. SPIE 8445 (2012), Eq. 7
    to 9.

    S. Bonettini, R. Zanella, L. Zanni, "A scaled gradient projection method for constrained image
    deblurring", Inverse Problems 25, 015002 (2009).

    Examples
    --------
    A callback ends the run above after three iterations:

    >>> def third(iteration, estimate):
    ...     return iteration == 3
    >>> result = lnocl.deconvolve(obs, stop=None, callback=third, engine="numpy")
    >>> result.n_iter, result.stop_reason
    (3, 'callback')
    """
    check_types(callback, progress=progress)
    planned = signature(make_plan).parameters
    plan = make_plan(**{name: value for name, value in locals().items() if name in planned})
    prepared = prepare(plan, progress)
    inputs = partial(
        describe,
        prepared.setup,
        mu=mu,
        smoothing=smoothing,
        spectral_smoothing=spectral_smoothing,
        n_iter=plan.n_iter,
        stop=prepared.stop,
    )
    checkpointer = Checkpointer(inputs, checkpoint, resume)
    if callback is not None:
        callback = np.errstate(**np.geterr())(callback)  # which NumPy may well warn
    outcome = reconstruct(prepared, callback, progress, checkpointer)
    outcome = _finish(outcome, replace(plan, found=prepared.found), prepared, progress)
    result = make_result(outcome)
    warn_of_faults(result, progress)
    return result


def _finish(outcome: Outcome, plan: Plan, prepared: Prepared, progress: bool) -> Outcome:
    """Return an outcome with what the plan has marginal, and how well PSFs fit."""
    is_within = prepared.is_within
    if plan.does(STARS) and not plan.does(PSFS):  # as all stars have PSFs of their own
        judged = (judge_stars(part.estimate) for part in outcome.estimate.parts)
        is_within = not any(star.is_misfit for stars in judged for star in stars)
    if prepared.stop == "held-out" and outcome.stop_reason not in ("held-out", "callback"):
        is_within = False  # what leaves them without an end leaves marginal fluxes without sense
    has_halos, has_levels = plan.does(HALOS), plan.does(LEVELS)
    if is_within or has_halos or has_levels:
        what = "fitting stars, halos and levels"
        with quietly(), Progress(None, "", bool(progress), what):
            outcome = outcome.marginal(is_within, has_halos, has_levels)
    for words in outcome.levels_in_words():
        detail("%s", words)
    return replace(
        outcome,
        psf_refinement=prepared.refinement,
        may_free_pixels="pixels" not in plan.families,
        plan=tuple(str(plan).splitlines()),
    )
