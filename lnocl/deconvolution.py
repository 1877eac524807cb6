"""The one public verb: validate, choose, run, wrap up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from numbers import Real
from os import PathLike
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, NotFiniteError, warn
from lnocl.runs.checkpoint import Checkpointer, describe
from lnocl.runs.held_out import (
    NO_CURVE,
    Choice,
    Grid,
    HeldOutSelection,
    several_mu,
    several_smoothings,
)
from lnocl.runs.progress import Bar
from lnocl.runs.run import Run, Setup
from lnocl.runs.stopping import Rule, make_rule
from lnocl.scene.observation import Array, Observation, numbers
from lnocl.scene.penalty import Penalty
from lnocl.solvers import SOLVERS

PRECISIONS = ("single", "double")
ENGINES = ("opencl", "numpy")
STOPS = ("discrepancy", "held-out")

# Kernels count iterations in 32 bits.
MOST_ITERATIONS = 2**31 - 2

# What single precision strays from double, as a share of the extended source, for each iteration of
# a long run, and the share that is worth a warning (benchmarks/precision.py, docs/precision.md).
STRAY_PER_ITERATION = 8e-9
STRAY_WORTH_A_WARNING = 1e-3

HISTORY_DTYPE = np.dtype([("iteration", np.int64), ("objective", np.float64)])


class Estimate:
    """What a callback is shown: the estimate of this iteration, fetched when it is asked for.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels, as refined last.
    """

    def __init__(self, run: Run) -> None:
        self._run: Run | None = run

    @cached_property
    def extended(self) -> Array:
        """Extended source, electrons per pixel."""
        return self._live().extended()

    @cached_property
    def star_fluxes(self) -> Array:
        """Star fluxes, electrons."""
        return self._live().star_fluxes()

    @cached_property
    def star_positions(self) -> Array:
        """Star positions, pixels."""
        return self._live().star_positions().copy()

    def _live(self) -> Run:
        if self._run is None:
            raise RuntimeError("read what you need of the estimate before the callback returns")
        return self._run

    def _close(self) -> None:
        self._run = None


Callback = Callable[[int, Estimate], Any]


@dataclass(frozen=True)
class Result:
    """What `deconvolve` returns.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons, in the order of the stars given.
    star_positions : ndarray of float64, shape (n, 2)
        (x, y) in pixels, as given or refined.
    star_flux_errors : ndarray of float64, shape (n,)
        Standard errors, electrons, by the Fisher information of fluxes and positions where the
        extended source is known; 0 where positions were not refined.
    star_position_errors : ndarray of float64, shape (n, 2)
        Likewise, pixels.
    n_iter : int
        Iterations done.
    stop_reason : str
        ``"n_iter"``, ``"callback"``, the rule that was met (``"change"``, ``"discrepancy"``,
        ``"held-out"``), ``"converged"``: no step of ``"sgp"`` lets the objective fall any more,
        in the precision used; or ``"not finite"``: the objective became infinite or NaN, and the
        estimate is the last with a finite one.
    device : str
        Name of the device, its platform and driver; ``"numpy"`` for the reference.
    history : ndarray, fields ``iteration`` (int64) and ``objective`` (float64)
        The objective J after each iteration, from iteration 0, the start.
    mu : float
        Weight of the Tikhonov term, as given or as chosen.
    smoothing : float
        Weight of the edge-preserving term, as given or as chosen.
    held_out : ndarray, fields ``mu``, ``smoothing``, ``iteration`` (int64) and ``error``
        Where held-out counts were asked: the relative error of the extended source that they
        estimate, for each penalty and iteration looked at; else empty.
    """

    extended: Array
    star_fluxes: Array
    star_positions: Array
    star_flux_errors: Array
    star_position_errors: Array
    n_iter: int
    stop_reason: str
    device: str
    history: NDArray[np.void]
    mu: float
    smoothing: float
    held_out: NDArray[np.void]
    _models: Callable[[], Array] = field(repr=False, compare=False)
    _observation: Observation = field(repr=False, compare=False)

    def models(self) -> Array:
        """Return the m_j, shape (p, ny, nx), electrons per pixel.

        ``m_j = e_j (A_j f + sum_s c_s P_js) + b_j``, in double precision. As in the observation,
        the square of the read noise is included.
        """
        return self._models()

    def residuals(self) -> Array:
        """Return ``(g_j - m_j) / sqrt(m_j)``, shape (p, ny, nx): about 1 where only noise is left.

        NaN where a pixel is bad, or the model is 0.
        """
        observation, models = self._observation, self.models()
        usable = ~observation.mask & (models > 0)
        excess = observation.images - models
        return np.divide(
            excess, np.sqrt(np.maximum(models, 0.0)), out=np.full_like(excess, np.nan), where=usable
        )


def deconvolve(
    observation: Observation,
    stars: Sequence[tuple[float, float]] = (),
    *,
    mu: float | str = 0.0,
    solver: str = "sgm",
    n_iter: int = 1000,
    stop: str | float | None = None,
    precision: str = "single",
    engine: str = "opencl",
    device: str | None = None,
    pad: int | str = 0,
    initial_extended: ArrayLike | None = None,
    initial_star_fluxes: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: bool = False,
    refine_positions: bool = False,
    smoothing: float | str = 0.0,
    checkpoint: str | PathLike[str] | None = None,
    checkpoint_every: float = 60.0,
    resume: str | PathLike[str] | None = None,
) -> Result:
    """Reconstruct the sky from several images as stars plus an extended source.

    Minimises ``J = sum_j sum_n [g_j ln(g_j / m_j) + m_j - g_j] + mu / 2 sum f^2`` and, for
    `smoothing`, ``+ smoothing sum [sqrt((f - f')^2 + delta^2) - delta]`` over pairs of neighbours,
    over the star fluxes c and the extended source f, with ``m_j = K_j * f + sum_s c_s P_js + b_j``,
    stopped after `n_iter` iterations. The split-gradient method without stars and penalties is
    Richardson-Lucy for several images; the scaled gradient projection method needs a tenth of its
    iterations and less.

    Parameters
    ----------
    observation : Observation
        The images, p of shape (ny, nx), and what is known of them.
    stars : sequence of (x, y), optional
        Positions of the point sources in pixels of an image without offset, 0-based, x along
        columns. Between pixels a star's image is the PSF moved in its spectrum
        (`lnocl.scene.shifting.place`).
    mu : float or "auto", optional
        Weight of the Tikhonov term on the extended source, per electron; zero or more. "auto":
        0 or one of seven values, three decades up to p over the brightest pixel, whichever held-out
        counts choose (see Notes).
    solver : {"sgm", "sgp"}, optional
        Iteration to use: the split-gradient method, or the scaled gradient projection method, which
        solves for the star fluxes at the start, so that those given matter little.
    n_iter : int, optional
        Iterations to do, at most where they may end sooner; 1 or more.
    stop : float, "discrepancy" or "held-out", optional
        When to stop before `n_iter`. A number in (0, 1): when the objective changes relatively by
        less an iteration, in the mean over ten. "discrepancy": when the data term has fallen to its
        expectation for Poisson counts of the model's means. "held-out": at the iteration that
        held-out counts choose (see Notes).
    precision : {"single", "double"}, optional
        Arithmetic of the OpenCL engine. The reference always computes in double.
    engine : {"opencl", "numpy"}, optional
        OpenCL, or the plain NumPy reference.
    device : str, optional
        OpenCL device as ``PLATFORM[:DEVICE]``, each an index or a part of the name (see
        `lnocl.opencl.device.choose`). By default that of the environment variable PYOPENCL_CTX,
        else the first GPU, else the first CPU.
    pad : int or "auto", optional
        Unobserved pixels kept round the images, at least; the grid is then the next power of
        two on each axis. With ``pad=0`` and a power-of-two image the model is periodic. "auto",
        for sources that run over the edge: the radius with nine tenths of the PSFs' light, at most
        half the shorter side (docs/frames.md).
    initial_extended : array_like, shape (ny, nx), optional
        Extended source to start from; by default flat.
    initial_star_fluxes : array_like, shape (n,), optional
        Star fluxes to start from; by default read off the data.
    callback : callable, optional
        ``callback(iteration, estimate)``, called after every iteration; it stops the run by
        returning True. The estimate has ``extended`` and ``star_fluxes``, which are fetched
        from the device when they are read. The halves of held-out counts do not call it.
    progress : bool, optional
        Show a progress bar on stderr, where that is a terminal, with the objective or what the
        stopping rule watches.
    refine_positions : bool, optional
        Move the stars to where they are most likely, at most 3 pixels away, by Fisher scoring of
        all fluxes and positions with the extended source held fixed: at the start and after 3, 6,
        12, 24 ... iterations (`lnocl.solvers.positions`).
    smoothing : float or "auto", optional
        Weight of an edge-preserving term (`lnocl.scene.penalty.Penalty`), zero or more, without
        unit; delta is three times the mean of the extended source. It keeps the noise down that
        grows with the iterations, most of all beside bright stars; 1e-4 to 1e-3 for stars a
        hundred times as bright as what is beside them (docs/sgp.md). "auto": 0 or one of five
        values, whichever held-out counts choose (see Notes).
    checkpoint : str or path, optional
        File for checkpoints (FITS): written after the first iteration, then every
        `checkpoint_every` seconds, and at the end. Each replaces the one before once it is
        complete. While held-out counts choose it holds six runs and about twenty estimates of each.
    checkpoint_every : float, optional
        Seconds between checkpoints, zero or more.
    resume : str or path, optional
        Checkpoint to go on from. Everything else must be as it was when it was written; the result
        is then bit for bit that of a run that was never interrupted.

    Returns
    -------
    Result
        Extended source, star fluxes, and how they came about.

    Raises
    ------
    InputError
        An observation that is none; a parameter out of its range, masked or too large for the
        precision, mu and smoothing both "auto", a star outside the images, no such device, or a
        device for the reference; images or exposures too large to be summed, or a sky that no
        number holds; held-out counts of images that hold none.
    FileError
        A checkpoint that cannot be written or read, is damaged, or would replace that of another
        run.
    DeviceError
        No OpenCL device at all, too little memory on it, no double precision, a compiler or a
        device that fails; a process that was forked from one that uses OpenCL.

    Warns
    -----
    LnoclWarning
        A PSF that is larger than the grid, whose wings wrap round; offsets without `pad`; a PSF
        that rings where it is moved between pixels; so many iterations that single
        precision is expected to stray from double by a thousandth of the extended source; held-out
        counts of images that are not whole counts, or that chose an iteration too near `n_iter`; an
        objective that is not finite; compiled kernels that cannot be kept, or are damaged.

    Notes
    -----
    Held-out counts: the counts are dealt out at random to two halves, independent observations of
    the same sky. Both are reconstructed side by side, and the error of their sum is estimated from
    the products of one's estimates with the other's (`lnocl.runs.held_out` has the equation), the
    mean of three ways to deal. Chosen is the last iteration with an error within a tenth of the
    least; the halves go on for as long again. The reconstruction itself is then made from all
    counts. So it takes thirteen times as long as if the iteration had been known, and the memory
    of six runs and of about twenty estimates of each.

    References
    ----------
    A. La Camera, S. Antoniucci, M. Bertero et al., "Image reconstruction for observations with
    a high dynamic range: LINC-NIRVANA simulations of a stellar jet", Proc. SPIE 8445 (2012),
    Eq. 7 to 9. S. Bonettini, R. Zanella, L. Zanni, "A scaled gradient projection method for
    constrained image deblurring", Inverse Problems 25, 015002 (2009).

    Examples
    --------
    Four equal images of a star on a flat sky, through a PSF of one pixel:

    >>> import numpy as np
    >>> import lnocl
    >>> image = np.full((16, 16), 2.0)
    >>> image[5, 8] += 100.0
    >>> obs = lnocl.Observation(np.stack([image] * 4), np.ones((1, 1)))
    >>> result = lnocl.deconvolve(obs, stars=[(8, 5)], n_iter=50, engine="numpy")
    >>> (result.extended.sum() + result.star_fluxes.sum()).round(6)
    np.float64(612.0)
    """
    _check_observation(observation)
    _check_choices(solver, n_iter, stop, precision, engine, device)
    _check_kinds(callback, progress=progress, refine_positions=refine_positions)
    penalty, grid = _penalties(mu, smoothing)
    if engine == "opencl" and precision == "single":
        _warn_of_straying(int(n_iter))
    setup = Setup(stars, pad, solver, precision, engine, device, refine_positions)
    checkpointer = Checkpointer(
        checkpoint,
        checkpoint_every,
        resume,
        lambda: describe(
            observation,
            setup,
            mu=mu,
            smoothing=smoothing,
            n_iter=int(n_iter),
            stop=stop,
            initial_extended=initial_extended,
            initial_star_fluxes=initial_star_fluxes,
        ),
    )
    bar = Bar(int(n_iter), bool(progress))
    if callback is not None:
        callback = np.errstate(**np.geterr())(callback)  # which NumPy may well warn
    # What is too large makes the objective infinite, which the run looks for: NumPy need not warn.
    with bar, np.errstate(over="ignore", invalid="ignore"):
        choice = checkpointer.saved.choice() if checkpointer.saved is not None else None
        if choice is None:
            choice = Choice(penalty, int(n_iter), NO_CURVE)
            if grid is not None or stop == "held-out":
                choice = _choose(
                    setup,
                    observation,
                    penalty,
                    grid,
                    stop,
                    int(n_iter),
                    initial_extended,
                    bar,
                    checkpointer,
                )
        run = Run(
            setup, observation, choice.penalty, choice.n_iter, initial_extended, initial_star_fluxes
        )
        rule = make_rule(stop)
        stop_reason = checkpointer.restore(run, rule)
        bar.expect(choice.n_iter)
        keep = partial(checkpointer.keep, run, rule, choice)
        if stop_reason:
            keep(stop_reason)  # perhaps in another file
        else:
            try:
                stop_reason = _iterate(run, choice.n_iter, rule, callback, bar, keep)
            except NotFiniteError:
                stop_reason = "not finite"
        if stop_reason == "not finite":
            checkpointer.redo(run)
        if stop == "held-out" and stop_reason == "n_iter":
            stop_reason = "held-out"
        return _wrap_up(run, stop_reason, choice)


def _penalties(mu: Any, smoothing: Any) -> tuple[Penalty, Grid | None]:
    """Return the penalty, the least one where there are several, and what makes the others."""
    for name, weight in (("mu", mu), ("smoothing", smoothing)):
        if isinstance(weight, str) and weight != "auto":
            raise InputError(f"{name} {weight!r} is not known; give a number or auto")
    if isinstance(mu, str) and isinstance(smoothing, str):
        raise InputError("mu and smoothing cannot both be auto; give one of them as a number")
    if isinstance(mu, str):
        return Penalty(0.0, smoothing), several_mu(smoothing)
    if isinstance(smoothing, str):
        return Penalty(mu, 0.0), several_smoothings(mu)
    return Penalty(mu, smoothing), None


def _check_observation(observation: object) -> None:
    if not isinstance(observation, Observation):
        raise InputError(
            f"observation is of type {type(observation).__name__}; give an lnocl.Observation, as "
            "lnocl.Observation(images, psfs) makes"
        )


def _check_choices(
    solver: str,
    n_iter: object,
    stop: object,
    precision: str,
    engine: str,
    device: object,
) -> None:
    choices = {
        "solver": (solver, tuple(SOLVERS)),
        "precision": (precision, PRECISIONS),
        "engine": (engine, ENGINES),
    }
    for name, (value, known) in choices.items():
        if not (isinstance(value, str) and value in known):
            raise InputError(f"{name} {value!r} is not known; choose from {', '.join(known)}")
    if not (isinstance(n_iter, (int, np.integer)) and n_iter >= 1):
        raise InputError(f"n_iter must be a whole number, 1 or more; {n_iter} was given")
    if n_iter > MOST_ITERATIONS:
        raise InputError(f"n_iter must be {MOST_ITERATIONS} at most; {n_iter} was given")
    is_change = isinstance(stop, Real) and 0 < cast(float, stop) < 1
    if not (stop is None or is_change or (isinstance(stop, str) and stop in STOPS)):
        raise InputError(
            f"stop {stop!r} is not known; give {', '.join(STOPS)}, or a number between 0 and 1"
        )
    if not (device is None or isinstance(device, str)):
        raise InputError(f"device must be text, PLATFORM[:DEVICE]; {device!r} was given")
    if engine == "numpy" and device is not None:
        raise InputError(f"engine numpy uses no device; leave device {device!r} out")


def _check_kinds(callback: object, **flags: object) -> None:
    if not (callback is None or callable(callback)):
        raise InputError(f"callback must be a function or None; {callback!r} was given")
    for name, flag in flags.items():
        if not isinstance(flag, (bool, np.bool_)):
            raise InputError(f"{name} must be True or False; {flag!r} was given")


def _warn_of_straying(n_iter: int) -> None:
    stray = STRAY_PER_ITERATION * n_iter
    if stray > STRAY_WORTH_A_WARNING:
        warn(
            f"single precision is expected to stray from double by {stray:.1g} of the extended "
            f"source after {n_iter} iterations; take precision double, or fewer iterations"
        )


def _choose(
    setup: Setup,
    observation: Observation,
    penalty: Penalty,
    grid: Grid | None,
    stop: object,
    n_iter: int,
    initial_extended: ArrayLike | None,
    bar: Bar,
    checkpointer: Checkpointer,
) -> Choice:
    """Have held-out counts choose the penalty and the number of iterations, or one of them."""
    half = None
    if initial_extended is not None:
        half = numbers("initial_extended", initial_extended) / 2.0
    selection = HeldOutSelection(
        partial(Run, setup, n_iter=n_iter, initial_extended=half),
        observation,
        penalty,
        grid,
        n_iter,
        stop != "held-out",
    )
    if checkpointer.saved is not None:
        selection.restore(checkpointer.saved.arrays)
    return selection.choose(
        lambda words: bar.show(0, lambda: words), lambda: checkpointer.keep_choosing(selection)
    )


def _iterate(
    run: Run,
    n_iter: int,
    rule: Rule,
    callback: Callback | None,
    bar: Bar,
    keep: Callable[[str], None],
) -> str:
    """Iterate to the end, keeping checkpoints; return why it ended."""
    quantity = partial(rule.quantity, run)
    stop_reason = None
    for iteration in run:
        if callback is not None:
            estimate = Estimate(run)
            if callback(iteration, estimate):
                stop_reason = "callback"
            estimate._close()
        if rule.met(run):
            stop_reason = rule.reason  # it would end here without a callback too
        bar.show(iteration, quantity, last=stop_reason is not None or iteration == n_iter)
        if stop_reason is not None:
            break
        keep("")
    stop_reason = stop_reason or ("n_iter" if run.done == n_iter else "converged")
    run.finish()
    keep(stop_reason)
    return stop_reason


def _wrap_up(run: Run, stop_reason: str, choice: Choice) -> Result:
    run.finish()
    history = np.zeros(run.done + 1, HISTORY_DTYPE)
    history["iteration"] = np.arange(run.done + 1)
    history["objective"] = run.objectives()
    flux_errors, position_errors = run.star_errors()
    return Result(
        extended=run.extended(),
        star_fluxes=run.star_fluxes(),
        star_positions=run.star_positions(),
        star_flux_errors=flux_errors,
        star_position_errors=position_errors,
        n_iter=run.done,
        stop_reason=stop_reason,
        device=run.engine.name,
        history=history,
        mu=choice.penalty.mu,
        smoothing=choice.penalty.smoothing,
        held_out=choice.curve,
        _models=run.models(),
        _observation=run.scene.observation,
    )
