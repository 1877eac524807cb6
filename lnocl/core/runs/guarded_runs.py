"""Short runs that judge PSFs, with the extended source smoothed more strongly near the stars.

A wrong PSF leaves light around each star. A free extended source absorbs it: the residuals are
small, the star is too faint, and the error of the PSF goes unnoticed. So the weight of the
edge-preserving term near stars follows the relative error of the PSFs
(`lnocl.core.scene.psf_misfit`). This error is first assumed to be large. It is then measured after
each run, until it stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from lnocl.core.runs.halos import hold_halos, settle_halos
from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.psf_posterior import settle_psfs
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_model, make_start
from lnocl.core.runs.steady import STEADY, run_steadily
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.noise_check import with_noise_shown
from lnocl.core.scene.observation import BESIDE_PSFS, Observation
from lnocl.core.scene.padding import choose_pad
from lnocl.core.scene.penalty import Penalty, recommend_smoothing
from lnocl.core.scene.psf_field import Psfs, mapped
from lnocl.core.scene.psf_misfit import PsfMisfit, measure_misfit, smoothing_near_stars
from lnocl.core.scene.rings import Rings
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.transforms import enlarged
from lnocl.core.solvers.psf_errors import with_errors
from lnocl.core.solvers.psf_fit import settle
from lnocl.errors import DivergedError, InputError
from lnocl.process import ignored_notes, ignored_warnings

# PSFs are judged in a window of this side, pixels of the images. It is a half or a quarter where
# that holds the same stars, each as far from its edges as its PSF is wide, or where the PSFs of its
# stars have more pixels than this together, since each step computes all of them.
WINDOW, LEAST_WINDOW, MOST_PIXELS = 256, 64, 2**22
# The error that PSFs are first taken to have; later ones are measured until they change by less
# than this share, or so often.
FIRST_ERROR, SETTLED, MAX_ROUNDS = 0.3, 0.1, 4
# The weight of the edge-preserving term near stars, in standard deviations of the gradient of the
# data term by the error of the PSFs: the halo that a wrong Strehl ratio leaves bends less.
GUARD = 20.0
# Iterations of the first round, and of each further one, which begins where that ended; and of
# runs with one weight, at most.
FIRST_ITERATIONS, ITERATIONS, N_ITER = 40, 30, 300
# The extended source of these runs may lack structure of this share of its light.
UNRESOLVED = 0.25
# The error of a PSF's pixel is a share of the PSF, smoothed over so many pixels of the images.
SPREAD = 2.0


@dataclass(frozen=True, eq=False)
class Judged(Estimate):
    """An estimate with extra smoothing near the stars, and its misfit at the stars.

    Attributes
    ----------
    misfit : PsfMisfit
        How far the images are from their models at the stars.
    """

    misfit: PsfMisfit

    @cached_property
    def model(self) -> Model:
        """The forward model of the scene, computed on the host."""
        return make_model(self.scene)


class GuardedRuns:
    """Short runs in the window that holds most stars, smoothed more strongly near them.

    The window has `WINDOW` pixels a side or less, or the side of smaller images. Positions are
    (x, y).

    Parameters
    ----------
    setup : Setup
        The images and the parameters of the runs; one star or more among them.
    tick : callable, optional
        Is told how many iterations are done more.

    Attributes
    ----------
    whole : Setup
        The parameter `setup`.
    observation : Observation
        The images in the window, without their PSFs; their noise is that of the whole images.
    stars : ndarray of float64, shape (n, 2)
        The positions of the stars in the window, from its first pixel.
    first : ndarray of int, shape (2,)
        That pixel in the whole images.
    held : ndarray of bool, shape (m,)
        Which of all m stars these are.
    penalty : Penalty
        Of runs that are not smoothed more strongly near stars.
    """

    def __init__(self, setup: Setup, tick: Callable[[int], object] = int) -> None:
        self.whole, self._tick, observation = setup, tick, setup.observation
        # PSFs that are cut to the window go without what has the shape of whole ones.
        shown = with_noise_shown(observation).replace(**dict.fromkeys(BESIDE_PSFS))
        self._side = choose_window(setup.stars, shown, observation.psfs.shape[1:])
        window = find_window(setup.stars, shown, self._side)
        self.observation, self.first, self.held = window
        self.stars = setup.stars[self.held] - self.first
        if len(own := self.observation.star_psfs):
            cut = np.array([self.cut(psfs) for psfs in own])
            self.observation = self.observation.replace(star_psfs=cut)
        # One grid for all PSFs that are tried.
        pad = choose_pad(observation) if setup.pad == "auto" else setup.pad
        self._setup = replace(
            setup, solver="sgp", pad=pad, initial_extended=None, initial_star_fluxes=None
        )
        self.penalty = Penalty(smoothing=STEADY * recommend_smoothing(self.observation))
        self._steady = dict[tuple[int, bytes], tuple[Outcome, Psfs]]()

    def beside(self, points: Array) -> GuardedRuns:
        """Return the runs with more stars, at places (n, 2) in the whole images."""
        stars = np.concatenate([self.whole.stars, points])
        return GuardedRuns(replace(self.whole, stars=stars), self._tick)

    def setup_of(self, psfs: Psfs, stars: Array) -> Setup:
        """Return the setup of a run with PSFs of the whole images and stars of the window."""
        observation = self.seen_through(psfs)
        return replace(self._setup, observation=observation, stars=inside(stars, observation))

    def fit(
        self,
        psfs: Psfs,
        stars: Array,
        moves: bool,
        error: float = FIRST_ERROR,
        guard: float = GUARD,
    ) -> Judged:
        """Return the estimate with these PSFs.

        At most `MAX_ROUNDS` runs follow each other, each from the estimate of the one before. Each
        is smoothed near the stars by the misfit that the one before has left. They end where the
        misfit is insignificant or stays.

        Parameters
        ----------
        psfs : Psfs
            Of the whole images.
        stars : ndarray of float64, shape (n, 2)
            The positions of the stars in the window; first guesses where they are moved.
        moves : bool
            Whether stars are moved, at the start of each run.
        error : float
            The relative error of the PSFs that the first run assumes.
        guard : float
            The weight of the smoothing near stars for that error, in the units of `GUARD`.
        """
        setup = replace(self.setup_of(psfs, stars), refine_positions=moves)
        with ignored_warnings(), ignored_notes():  # those of the reconstruction are the same
            start = settle_halos(make_start(setup, Penalty()))
            none = np.zeros(1)
            nothing_measured = PsfMisfit(none + error**2, none, none, 1.0, none + error)
            found = _judged(start.estimate(), nothing_measured)
            moved = replace(setup, refine_positions=False)
            rounds = (moved, FIRST_ITERATIONS), *[(setup, ITERATIONS)] * (MAX_ROUNDS - 1)
            for each, n_iter in rounds:
                before, found = found, self._run(each, found, n_iter, guard)
                change = abs(found.misfit.kappa - before.misfit.kappa)
                if not found.misfit.is_significant or change < SETTLED * found.misfit.kappa:
                    break
        return found

    def steady(self, psfs: Psfs, stars: Array) -> Outcome:
        """Return the outcome of a run with one weight, which is kept for the same PSFs and stars.

        Raises
        ------
        DivergedError, NotFiniteError
            As `run_steadily`.
        """
        key = id(psfs), stars.tobytes()
        if key not in self._steady:  # which holds the PSFs, lest others take their place in memory
            found = steady_outcome(self.setup_of(psfs, stars), self.penalty, self._tick)
            self._steady = {key: (found, psfs)}
        return self._steady[key][0]

    def settled(self, psfs: Psfs, stars: Array, moves: bool) -> tuple[Psfs, Array]:
        """Return PSFs, of the whole images, and stars, in the window, as the images show them.

        Those given are returned where they stay. Stars stay unless they may move.
        """
        setup = self.setup_of(psfs, stars)

        def run(given: Setup) -> Outcome:
            if given is setup:
                return self.steady(psfs, stars)
            return steady_outcome(given, self.penalty, self._tick)

        theta, found = settle_psfs(setup, moves, run)
        stars = np.where(found == setup.stars, stars, found)
        if theta.any():
            whole = with_errors(self.whole.observation.replace(psfs=psfs), theta)
            psfs = whole.psfs_over_images
        return psfs, stars

    def _run(self, setup: Setup, found: Judged, n_iter: int, guard: float) -> Judged:
        """Return the estimate after a run that begins at `found`, with its misfit measured anew.

        The misfit of `found` sets the smoothing near the stars. A run that diverges keeps its last
        state.
        """
        rings = found.misfit.in_rings
        near = smoothing_near_stars(found, found.model, rings, guard)
        penalty = replace(self.penalty, near_stars=near)
        setup = replace(
            setup,
            stars=inside(found.scene.places, self.observation),
            initial_extended=np.maximum(found.observed_sky, 0.0),
            initial_star_fluxes=found.star_fluxes[: found.scene.n_stars],
            looks_round=False,
        )
        start = hold_halos(make_start(setup, penalty), found)
        # Stars are moved at the start of a round alone.
        run = Run(replace(start, setup=replace(start.setup, refine_positions=False)), n_iter)
        with suppress(DivergedError):  # by negative PSFs: the misfit tells how good the end is
            run.complete(self._tick)
        estimate, model = run.estimate(), make_model(run.scene)
        misfit = measure_misfit(estimate, model, estimate)
        if misfit.is_significant:  # which may be of structure that was smoothed
            misfit = measure_misfit(estimate, model, settle(estimate, model, UNRESOLVED))
        return _judged(estimate, misfit)

    def moved(self, estimate: Judged, psfs: Psfs, star_fluxes: Array, stars: Array) -> Judged:
        """Return an estimate with other PSFs, star fluxes and positions.

        Its extended source and misfit are unchanged; stars that leave the images are clipped.
        """
        observation = self.seen_through(psfs)
        with ignored_warnings():
            scene = Scene(observation, inside(stars, self.observation), pad=self._setup.pad)
        return replace(estimate, scene=scene, star_fluxes=star_fluxes)

    def seen_through(self, psfs: Psfs) -> Observation:
        """Return the window with PSFs of the whole images, cut to it."""
        cut = mapped(psfs, lambda _, stack: self.cut(stack))
        if isinstance(cut, tuple):
            x, y = self.first
            cut = tuple(field.moved(-x, -y) for field in cut)
        return self.observation.replace(psfs=cut)

    def cut(self, psfs: Array) -> Array:
        """Return the middle of PSFs, at most as large as the window."""
        most = self._side * self.observation.oversample
        ky, kx = (min(n, most) for n in psfs.shape[1:])
        return enlarged(psfs, (ky, kx), is_centred=True)

    def completed(self, psfs: Psfs, changes: Sequence[Array]) -> Psfs:
        """Return PSFs of unit sum, with what is added to the middle of those of each image."""

        def complete(j: int, stack: Array) -> Array:
            whole = stack + enlarged(changes[j], stack.shape[1:], is_centred=True)
            return np.asarray(whole / whole.sum(axis=(1, 2), keepdims=True))

        return mapped(psfs, complete)


def steady_outcome(setup: Setup, penalty: Penalty, tick: Callable[[int], object] = int) -> Outcome:
    """Return the outcome of a run with stars where they are given, and halos held.

    Raises
    ------
    DivergedError, NotFiniteError
        As `Run`.
    """
    setup = replace(setup, solver="sgp", refine_positions=False)
    with ignored_warnings(), ignored_notes():
        start = settle_halos(make_start(setup, penalty))
        return run_steadily(start, penalty, N_ITER, tick)


def inside(stars: Array, observation: Observation) -> Array:
    """Return star positions; those that no image shows are clipped to the first."""
    last = np.array(observation.shape[::-1]) - 1
    return np.where(observation.shows(stars)[:, None], stars, stars.clip(0, last))


def choose_window(stars: Array, observation: Observation, psf_shape: Sequence[int]) -> int:
    """Return the side of the window in which PSFs of a shape are judged, pixels of the images."""
    side, q = WINDOW, observation.oversample
    while side > LEAST_WINDOW:
        of_psf = math.prod(min(n, side * q) for n in psf_shape)
        held = find_window(stars, observation, side)[2]
        is_slow = np.count_nonzero(held) * of_psf > MOST_PIXELS
        if not (is_slow or _is_wide(side // 2, max(psf_shape) / q, stars[held], observation)):
            break
        side //= 2
    return side


def _is_wide(side: int, width: float, stars: Array, observation: Observation) -> bool:
    """Return whether a window holds stars, and round each as much of its image as a PSF is wide."""
    cut, first, held = find_window(stars, observation, side)
    if 2 * width > side or not held.all():
        return False
    last, end = first + cut.shape[::-1] - 1, np.array(observation.shape[::-1]) - 1
    places = np.array([observation.places(j, stars) for j in range(observation.n_images)])
    seen = places[((places > -width) & (places < end + width)).all(axis=-1)]
    reach = (seen - width).clip(0.0), np.minimum(seen + width, end)
    return bool((reach[0] >= first).all() and (reach[1] <= last).all())


def find_window(
    stars: Array, observation: Observation, side: int
) -> tuple[Observation, NDArray[np.int_], NDArray[np.bool_]]:
    """Return the observation cut to the window that holds most stars.

    Candidates lie round the middle of all stars and round each star, inside the images. All images
    are cut to the same rows and columns. They stay whole where no window holds a star in each of
    those that are turned, or where it would hold nothing of a halo, or no good pixel.

    Returns
    -------
    observation : Observation
        The images in the window.
    first : ndarray of int, shape (2,)
        (x, y) of its first pixel.
    held : ndarray of bool, shape (m,)
        Which of all m stars it holds.
    """
    size = np.minimum(observation.shape[::-1], side)
    last = np.array(observation.shape[::-1]) - size
    middle = (stars.min(axis=0) + stars.max(axis=0)) / 2.0
    firsts = np.clip(np.round(np.vstack([middle, stars])) - size // 2, 0, last).astype(int)
    places = [stars]
    if observation.is_turned:
        places = [observation.places(j, stars) for j in range(observation.n_images)]
    counts = [_count_in_windows(each, firsts, observation.shape, side) for each in places]
    in_all = np.min(counts, axis=0)
    first, cut = np.zeros(2, int), observation
    if in_all.any():
        best = firsts[int(np.argmax(in_all))]
        x, y = (range(int(at), int(at + n)) for at, n in zip(best, size, strict=True))
        with suppress(InputError):  # of a window without good pixels, or one that a halo is not in
            first, cut = best, observation.window(y, x)
    return cut, first, cut.shows(stars - first)


def _count_in_windows(
    stars: Array, firsts: NDArray[np.int_], shape: tuple[int, int], side: int
) -> NDArray[np.int_]:
    """Return the number of stars in each window; stars outside the images do not count."""
    pixels = np.floor(stars + 0.5)
    inside = pixels[np.all((pixels >= 0) & (pixels < shape[::-1]), axis=1)]
    if not len(inside):
        return np.zeros(len(firsts), int)
    half = (side - 1) / 2.0
    return np.asarray(
        KDTree(inside).query_ball_point(firsts + half, half, p=np.inf, return_length=True)
    )


def estimate_scatter(psfs: Array, in_rings: Array, oversample: int) -> Array:
    """Return the standard deviation of each pixel of PSFs, of their shape.

    It is the relative error in the pixel's ring times the PSF, smoothed over `SPREAD` pixels of the
    images. The error of the last ring holds beyond it.

    Parameters
    ----------
    psfs : ndarray of float64, shape (p, ky, kx)
        The PSFs.
    in_rings : ndarray of float64
        Their relative error in each ring, as `PsfMisfit.in_rings`.
    oversample : int
        Pixels of the PSFs to one of the images, along each axis.
    """
    number = rings_of(psfs, oversample).number
    share = in_rings[np.minimum(number, len(in_rings) - 1)]
    width = SPREAD * oversample
    return np.array([share * gaussian_filter(psf, width).clip(0.0) for psf in psfs])


def rings_of(psfs: Array, oversample: int) -> Rings:
    """Return the rings round the central pixel of PSFs, ``(kx // 2, ky // 2)``."""
    ky, kx = psfs.shape[1:]
    return Rings((ky, kx), np.array([(kx // 2, ky // 2)]), oversample)


def _judged(estimate: Estimate, misfit: PsfMisfit) -> Judged:
    return Judged(estimate.scene, estimate.sky, estimate.star_fluxes, misfit)
