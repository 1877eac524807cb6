"""The one public verb: validate, choose, run, wrap up."""

from __future__ import annotations

import importlib
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from lnocl.errors import InputError, LnoclWarning
from lnocl.observation import Array, Observation
from lnocl.scaling import Scaling, prepare
from lnocl.scene import Scene
from lnocl.solvers import SOLVERS, Engine

PRECISIONS = ("single", "double")
ENGINES = ("opencl", "numpy")

# Seconds between two looks at the objective for the progress bar: each look waits for the device.
PROGRESS_INTERVAL = 0.1

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
    """

    def __init__(self, engine: Engine, scene: Scene) -> None:
        self._engine: Engine | None = engine
        self._scene = scene

    @cached_property
    def extended(self) -> Array:
        """Extended source, electrons per pixel."""
        ny, nx = self._scene.observation.shape
        return self._live().extended()[:ny, :nx] * self._scene.scale

    @cached_property
    def star_fluxes(self) -> Array:
        """Star fluxes, electrons."""
        return self._live().star_fluxes() * self._scene.scale

    def _live(self) -> Engine:
        if self._engine is None:
            raise RuntimeError("read what you need of the estimate before the callback returns")
        return self._engine

    def _close(self) -> None:
        self._engine = None


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
    n_iter : int
        Iterations done.
    stop_reason : str
        ``"n_iter"``, ``"callback"``, or ``"converged"``: no step of ``"sgp"`` lets the objective
        fall any more, in the precision used.
    device : str
        Name of the device, its platform and driver; ``"numpy"`` for the reference.
    history : ndarray, fields ``iteration`` (int64) and ``objective`` (float64)
        The objective J after each iteration, from iteration 0, the start.
    """

    extended: Array
    star_fluxes: Array
    n_iter: int
    stop_reason: str
    device: str
    history: NDArray[np.void]


def deconvolve(
    observation: Observation,
    stars: Sequence[tuple[float, float]] = (),
    mu: float = 0.0,
    solver: str = "sgm",
    n_iter: int = 1000,
    stop: None = None,
    precision: str = "single",
    engine: str = "opencl",
    device: str | None = None,
    pad: int = 0,
    initial_extended: ArrayLike | None = None,
    initial_star_fluxes: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: bool = False,
) -> Result:
    """Reconstruct the sky from several images as stars plus an extended source.

    Minimises ``J = sum_j sum_n [g_j ln(g_j / m_j) + m_j - g_j] + mu / 2 sum f^2`` over the star
    fluxes c and the extended source f, with ``m_j = K_j * f + sum_s c_s P_js + b_j``, stopped
    after `n_iter` iterations. The split-gradient method without stars and with ``mu = 0`` is
    Richardson-Lucy for several images; the scaled gradient projection method needs a tenth of its
    iterations and less.

    Parameters
    ----------
    observation : Observation
        The images, p of shape (ny, nx), and what is known of them.
    stars : sequence of (x, y), optional
        Positions of the point sources in pixels, 0-based, x along columns; whole numbers.
    mu : float, optional
        Weight of the Tikhonov term on the extended source, per electron; zero or more.
    solver : {"sgm", "sgp"}, optional
        Iteration to use: the split-gradient method, or the scaled gradient projection method, which
        solves for the star fluxes at the start, so that those given matter little.
    n_iter : int, optional
        Iterations to do, 1 or more.
    stop : None, optional
        Stopping rule besides `n_iter`; there is none yet.
    precision : {"single", "double"}, optional
        Arithmetic of the OpenCL engine. The reference always computes in double.
    engine : {"opencl", "numpy"}, optional
        OpenCL, or the plain NumPy reference.
    device : str, optional
        OpenCL device as ``PLATFORM[:DEVICE]``, each an index or a part of the name (see
        `lnocl.device.choose`). By default that of the environment variable PYOPENCL_CTX, else
        the first GPU, else the first CPU.
    pad : int, optional
        Unobserved pixels kept round the images, at least; the grid is then the next power of
        two on each axis. With ``pad=0`` and a power-of-two image the model is periodic.
    initial_extended : array_like, shape (ny, nx), optional
        Extended source to start from; by default flat.
    initial_star_fluxes : array_like, shape (n,), optional
        Star fluxes to start from; by default read off the data.
    callback : callable, optional
        ``callback(iteration, estimate)``, called after every iteration; it stops the run by
        returning True. The estimate has ``extended`` and ``star_fluxes``, which are fetched
        from the device when they are read.
    progress : bool, optional
        Show a progress bar with the objective on stderr, where that is a terminal.

    Returns
    -------
    Result
        Extended source, star fluxes, and how they came about.

    Raises
    ------
    InputError
        A parameter out of its range or too large for the precision, a star outside the images,
        no such device, or a device for the reference.
    DeviceError
        No OpenCL device at all, too little memory on it, no double precision, or a compiler that
        fails.

    Warns
    -----
    LnoclWarning
        A PSF that is larger than the grid, whose wings wrap round; so many iterations that single
        precision is expected to stray from double by a thousandth of the extended source.

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
    _check_choices(solver, precision, engine, stop, device)
    if not (isinstance(n_iter, (int, np.integer)) and n_iter >= 1):
        raise InputError(f"n_iter must be a whole number, 1 or more; {n_iter} was given")
    if engine == "opencl" and precision == "single":
        _warn_of_straying(int(n_iter))
    scene = Scene(observation, stars, mu, pad)
    extended, star_fluxes = scene.start(initial_extended, initial_star_fluxes)
    scaling = None
    if solver == "sgp":
        star_fluxes, scaling = prepare(scene, extended, star_fluxes)
    running = _make_engine(engine, scene, precision, device, n_iter, scaling)
    running.start(extended, star_fluxes)
    done, stop_reason = _run(solver, running, scene, int(n_iter), callback, progress)
    return _wrap_up(running, scene, done, stop_reason)


def _check_choices(
    solver: str, precision: str, engine: str, stop: None, device: str | None
) -> None:
    choices = {
        "solver": (solver, tuple(SOLVERS)),
        "precision": (precision, PRECISIONS),
        "engine": (engine, ENGINES),
    }
    for name, (value, known) in choices.items():
        if value not in known:
            raise InputError(f"{name} {value!r} is not known; choose from {', '.join(known)}")
    if stop is not None:
        raise InputError(f"stop {stop!r} is not known; give None")
    if engine == "numpy" and device is not None:
        raise InputError(f"engine numpy uses no device; leave device {device!r} out")


def _warn_of_straying(n_iter: int) -> None:
    stray = STRAY_PER_ITERATION * n_iter
    if stray > STRAY_WORTH_A_WARNING:
        warnings.warn(
            f"single precision is expected to stray from double by {stray:.1g} of the extended "
            f"source after {n_iter} iterations; take precision double, or fewer iterations",
            LnoclWarning,
            stacklevel=3,
        )


def _make_engine(
    engine: str,
    scene: Scene,
    precision: str,
    device: str | None,
    n_iter: int,
    scaling: Scaling | None,
) -> Any:
    # Imported where it is chosen: the reference runs where no OpenCL is installed.
    if engine == "numpy":
        return importlib.import_module("lnocl.reference").ReferenceEngine(scene, scaling)
    opencl = importlib.import_module("lnocl.opencl")
    return opencl.OpenCLEngine(scene, precision, device, n_iter, scaling=scaling)


def _run(
    solver: str,
    engine: Engine,
    scene: Scene,
    n_iter: int,
    callback: Callback | None,
    progress: bool,
) -> tuple[int, str]:
    # disable=None is tqdm's word for "quiet where stderr is no terminal".
    bar = tqdm(total=n_iter, unit="it", disable=None if progress else True)
    shown = time.monotonic()
    iteration = 0
    with bar:
        for iteration in SOLVERS[solver](engine, n_iter):
            if not bar.disable and time.monotonic() - shown > PROGRESS_INTERVAL:
                objective = engine.objectives()[-1] * scene.scale
                bar.set_postfix_str(f"objective {objective:.6g}", refresh=False)
                bar.update(iteration - bar.n)
                shown = time.monotonic()
            if callback is not None:
                estimate = Estimate(engine, scene)
                stopped = callback(iteration, estimate)
                estimate._close()
                if stopped:
                    stop_reason = "callback"
                    break
        else:
            stop_reason = "n_iter" if iteration == n_iter else "converged"
        bar.update(iteration - bar.n)
    return iteration, stop_reason


def _wrap_up(engine: Any, scene: Scene, done: int, stop_reason: str) -> Result:
    if len(engine.objectives()) == done:
        engine.ratio()  # records the objective of the last estimate
    history = np.zeros(done + 1, HISTORY_DTYPE)
    history["iteration"] = np.arange(done + 1)
    history["objective"] = engine.objectives() * scene.scale
    estimate = Estimate(engine, scene)
    return Result(
        extended=estimate.extended,
        star_fluxes=estimate.star_fluxes,
        n_iter=done,
        stop_reason=stop_reason,
        device=engine.name,
        history=history,
    )
