"""The effective PSF of several stars in one frame: what they share, and how much they differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from astropy.stats import sigma_clipped_stats
from scipy.ndimage import binary_dilation, maximum_filter, shift
from scipy.spatial import KDTree

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.psfs import PSF_ERROR
from lnocl.core.scene.shifting import MovablePsf
from lnocl.detection.fitting import step
from lnocl.detection.maxima import SIGNIFICANT
from lnocl.errors import InputError, counted
from lnocl.psf.centring import Point, brightest
from lnocl.psf.repair import repair
from lnocl.psf.scatter import of_one, of_several, width_error
from lnocl.psf.steps import cut_square, measure_background, nearest_pixel

# Rounds of fitting the stars and adding what is left of them to the PSF, at least and at most; they
# end where they change no flux by more than this share. A saturated star settles slowly.
ROUNDS, MOST_ROUNDS, SETTLED = 20, 60, 3e-5
# The first rounds take each pixel for the star nearest to it, so that no star is another's wings.
FIRST_ROUNDS = 3
# Outside its core, a star's pixel is a neighbour's where it exceeds another star's by this share,
# significantly; and so are so many pixels beside it.
EXCESS, BESIDE = 0.5, 2
# After so many rounds a pixel that exceeds its star by this share of its peak, significantly, is a
# cosmic ray.
ROUGH_ROUNDS, RAY = 8, 0.2
# Pixels at the edge of the squares that no star shows; fewer of small squares.
EDGE = 2
# Half the side of the square whose light is a star's first flux.
APERTURE = 3
# A star's core is where it is above this share of its peak; there it is fitted. Where none of that
# is good, it is fitted down to the other share.
CORE, FAINTEST = 0.1, 1e-3


class FittedStar(NamedTuple):
    """A star as the effective PSF fits it.

    Attributes
    ----------
    x, y : float
        Where it is in the frame, 0-based pixels.
    flux : float
        Relative to the PSF, which has unit sum.
    misfit : float
        The rms of what is left of it where the PSF is above `CORE` of its peak, as a share of its
        peak.
    """

    x: float
    y: float
    flux: float
    misfit: float


class EffectivePsf(NamedTuple):
    """A PSF that several stars share.

    Attributes
    ----------
    psf : ndarray of float64, shape (k, k)
        Of unit sum and odd side.
    scatter : ndarray of float64, shape (k, k)
        Standard deviation of what a star shows from it (`lnocl.psf.scatter`).
    error : float
        That of the width of a star, relative to the PSF's.
    stars : list of FittedStar
        The stars.
    n_neighbours : int
        Pixels left out, all stars together, as they show something else than the star.
    """

    psf: Array
    scatter: Array
    error: float
    stars: list[FittedStar]
    n_neighbours: int


def combine(light: Array, bad: Mask, centres: list[Point], half: int, n_given: int) -> EffectivePsf:
    r"""Return the PSF that explains all stars of a frame together.

    .. math:: K \leftarrow K + \frac{\sum_s c_s T_s^{-1} w (d - \sum_t c_t T_t K) / \sum_t c_t}
              {\sum_s c_s T_s^{-1} w}

    with the frame d above its background, the fluxes c, the translations T to the stars, and w,
    0 at bad pixels and at sources that are not in the list. The sums over s are of the stars that
    were given, or of all where one was given; t counts their neighbours too. Each round fits flux
    and place of each star.

    Parameters
    ----------
    light : ndarray of float64, shape (ny, nx)
        The frame above its background.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel counts for nothing.
    centres : list of tuple of float
        Row and column of each star.
    half : int
        The PSF reaches so many pixels from its middle.
    n_given : int
        The first so many stars are given; the mean place of those with good cores stays.

    Raises
    ------
    InputError
        Stars with too few good pixels in their cores, or not above the background; no star shows
        the middle of the PSF.

    References
    ----------
    J. Anderson, I. R. King, PASP 112, 1360 (2000), for the effective PSF; A. C. Kak, M. Slaney,
    Principles of Computerized Tomographic Imaging (1988), chapter 7, for the weights of its
    iteration (SIRT).
    """
    return _Stars(light, bad, centres, half, n_given).combine()


def join(frames: Sequence[Array], bad: Sequence[Mask]) -> tuple[Array, list[Point]]:
    """Return squares round the brightest star of each frame side by side, and where the stars are.

    Each is above its own background, the median of the frame's border.

    Parameters
    ----------
    frames : sequence of ndarray of float64, shape (ny, nx)
        Frames of a star each, of any shapes.
    bad : sequence of ndarray of bool, shape (ny, nx)
        True where a pixel counts for nothing; it is NaN in what is returned.

    Returns
    -------
    ndarray of float64, shape (2 h + 1, n (2 h + 1))
        The squares, as large as all frames have them.
    list of tuple of float
        Column and row of each star.
    """
    squares, lights = [], []
    for frame, without in zip(frames, bad, strict=True):
        pixels = np.where(without, 0.0, frame)
        row, column = place = brightest(pixels, without)
        level, _ = measure_background("auto", pixels, without, [place], None)
        lights.append((np.where(without, np.nan, frame - level), place))
        squares.append(min(row, column, frame.shape[0] - 1 - row, frame.shape[1] - 1 - column))
    half = min(squares)
    cut = [cut_square(light, place, half) for light, place in lights]
    places = [(float(half + j * (2 * half + 1)), float(half)) for j in range(len(cut))]
    return np.concatenate(cut, axis=1), places


def lines(found: EffectivePsf) -> tuple[str, ...]:
    """Return how well the PSF fits each star, and what errors it has, as lines of a record."""
    psf, side = found.psf, len(found.psf)
    n = len(found.stars)
    core = psf > CORE * psf.max()
    error = float(np.sqrt(np.mean(found.scatter[core] ** 2)) / psf.max())
    return (
        *(
            f"star {s} of {n}: x = {star.x:.3f}, y = {star.y:.3f}, flux {star.flux:.6g}; "
            f"{100 * star.misfit:.2f} % of its peak is left in its core (rms)"
            for s, star in enumerate(found.stars, 1)
        ),
        f"effective PSF: {counted(n, 'star')}, {found.n_neighbours} pixels of neighbours left out "
        f"within {side} x {side} pixels; its pixels have errors of {100 * error:.2f} % of the peak "
        f"in the core (rms, by noise and how stars differ), its width {100 * found.error:.2g} %",
    )


class _Stars:
    """The stars of a frame with margins, in which the PSF fits round each of them."""

    def __init__(
        self, light: Array, bad: Mask, centres: list[Point], half: int, n_given: int
    ) -> None:
        self._half, self._n_given, self._frame, self._bad = half, n_given, light, bad
        self._n_own = n_given if n_given > 1 else len(centres)  # one star needs its neighbours
        self._repaired = np.pad(light, half)
        self._good = np.pad(~bad, half)
        self._light = np.where(self._good, self._repaired, 0.0)
        self._places = np.array(centres, np.float64) + half
        self._pixels = [nearest_pixel((y, x)) for y, x in self._places]
        self._noise = float(sigma_clipped_stats(light[~bad])[2])
        near = min(APERTURE, half)
        self._fluxes = np.array(
            [cut_square(self._repaired, pixel, near).sum() for pixel in self._pixels]
        )
        # Stars that were given, and are not saturated, say where the middle of the PSF is.
        whole = [cut_square(~bad, nearest_pixel(each), near).all() for each in centres[:n_given]]
        self._whole = np.array(whole)
        if not (self._fluxes > 0).all():
            s = int(np.argmin(self._fluxes))
            raise InputError(
                f"the star at {self._name(s)} is not above the background; leave it out"
            )

    def combine(self) -> EffectivePsf:
        """Return the PSF, its scatter and the stars."""
        side = 2 * self._half + 1
        shown = self._shown()
        shown[self._n_own :] = 0.0
        weight = np.einsum("s,syx->yx", self._fluxes, shown)
        if not weight[self._half, self._half]:
            raise InputError(
                "no star shows the middle of the PSF: all are bad there; give other stars"
            )
        psf = np.zeros((side, side))
        for done in range(MOST_ROUNDS):
            own = self._nearest() if done < FIRST_ROUNDS else self._outside_others(psf)
            left, overlap = self._residual(psf, own)
            left /= np.maximum(overlap, self._fluxes.min())
            used = own * shown
            weight = np.einsum("s,syx->yx", self._fluxes, used)
            steps = [
                c * self._centred(left, s, own[s]) * used[s] for s, c in enumerate(self._fluxes)
            ]
            psf += np.divide(sum(steps), weight, out=np.zeros_like(psf), where=weight > 0)
            before = self._fluxes.copy()
            self._fit(psf)
            change = float(np.max(abs(self._fluxes / before - 1.0)))
            if done + 1 >= ROUNDS and change < SETTLED:
                break
            if done + 1 == ROUGH_ROUNDS and self._n_own > 2:
                self._leave_rays(psf)
                shown[: self._n_own] = self._shown()[: self._n_own]
        weight = np.einsum("s,syx->yx", self._fluxes, used)
        hidden = np.einsum("s,syx->yx", self._fluxes, shown) == 0
        repair(psf, hidden, hidden)
        covered = (weight == 0) & ~hidden  # by others: what lies opposite is the best guess
        psf[covered] = np.where(covered, 0.0, psf)[::-1, ::-1][covered]
        return self._finished(psf, used)

    def _leave_rays(self, psf: Array) -> None:
        """Take pixels for bad that far exceed a star, in its core too, as others have it."""
        left, _ = self._residual(psf)
        for s, c in enumerate(self._fluxes[: self._n_own]):
            is_ray = left[self._window(s)] > max(RAY * c * psf.max(), SIGNIFICANT * self._noise)
            self._good[self._window(s)] &= ~is_ray
        self._light *= self._good

    def _finished(self, psf: Array, shown: Array) -> EffectivePsf:
        (left, _), n = self._residual(psf), self._n_own
        fluxes, shown = self._fluxes[:n], shown[:n]
        apart = np.array([self._centred(left, s) / c for s, c in enumerate(fluxes)])
        core, error = psf > CORE * psf.max(), PSF_ERROR
        if n > 1:
            scatter = of_several(apart, shown, fluxes, psf, self._frame, self._bad)
            error = width_error(apart, shown, fluxes, psf, core)
        else:
            scatter = of_one(self._repaired, ~self._good, self._pixels[0], self._half) / fluxes[0]
        total, stars = psf.sum(), []
        for s, (y, x) in enumerate(self._places[:n] - self._half):
            parts = apart[s][core & (shown[s] > 0)]
            misfit = float(np.sqrt(np.mean(parts**2)) / psf.max()) if parts.size else np.nan
            stars.append(FittedStar(float(x), float(y), float(fluxes[s] * total), misfit))
        return EffectivePsf(psf / total, scatter / total, error, stars, self._n_neighbours)

    def _shown(self) -> Array:
        """Return where each star's own pixels show it, neither bad nor a neighbour's: (n, k, k)."""
        good = np.array([self._good[self._window(s)] for s in range(len(self._places))])
        own = [self._centred(self._repaired, s) / c for s, c in enumerate(self._fluxes)]
        most = [maximum_filter(each, 3).clip(min=0) for each in own]
        foreign = np.zeros_like(good)
        for s, c in enumerate(self._fluxes):
            for t, other in enumerate(self._fluxes):
                noise = self._noise * np.hypot(1 / c, 1 / other)
                limit = (1 + EXCESS) * most[t] + SIGNIFICANT * noise
                outside = most[t] < CORE * most[t].max()
                foreign[s] |= good[s] & good[t] & outside & (own[s] > limit)
            foreign[s] = binary_dilation(foreign[s], iterations=BESIDE)
        self._n_neighbours = int((foreign & good).sum())
        # Half of what lies on the edge falls beyond it, and corrections of that would run away.
        edge = min(EDGE, self._half // 4)
        inner = np.pad(np.ones(np.subtract(good.shape[1:], 2 * edge)), edge)
        return (good & ~foreign) * inner

    def _nearest(self) -> Array:
        """Return where each star's own pixels are nearer to it than to any other: (n, k, k)."""
        y, x = np.indices(self._light.shape)
        nearest = KDTree(self._places).query(np.stack([y, x], axis=-1))[1]
        return np.array([nearest[self._window(s)] == s for s in range(len(self._places))])

    def _outside_others(self, psf: Array) -> Array:
        """Return where each star's own pixels are outside the cores of the others: (n, k, k)."""
        core = binary_dilation(psf > CORE * psf.max(), iterations=BESIDE)
        covered = np.zeros(self._light.shape, int)
        for s in range(len(self._places)):
            covered[self._window(s)] += core
        return np.array([covered[self._window(s)] == core for s in range(len(self._places))])

    def _residual(self, psf: Array, own: Array | None = None) -> tuple[Array, Array]:
        """Return the residuals of good pixels, and the sum of the fluxes that each is used for."""
        left, overlap = self._light.copy(), np.zeros_like(self._light)
        movable = MovablePsf(psf, psf.shape)
        for s, c in enumerate(self._fluxes):
            left[self._window(s)] -= c * movable.at(*self._middle(s)).on_grid(psf.shape)
            overlap[self._window(s)] += c * (1.0 if own is None else own[s])
        left *= self._good
        return left, overlap

    def _fit(self, psf: Array) -> None:
        """Fit the fluxes and places of the stars, each by least squares where it is bright."""
        movable = MovablePsf(psf, psf.shape)
        left, _ = self._residual(psf)
        steps = np.zeros((len(self._places), 2))
        core = psf > CORE * psf.max()
        for s, c in enumerate(self._fluxes):
            there = self._window(s)
            star = movable.with_slopes(*self._middle(s)).on_grid(psf.shape)
            used = core & self._good[there]
            if used.sum() < len(star):  # of a saturated star the wings are left
                used = (psf > FAINTEST * psf.max()) & self._good[there]
            if used.sum() < len(star):
                raise InputError(
                    f"the star at {self._name(s)} has too few good pixels; leave it out"
                )
            found, moves = step([star], np.array([c]), left[there] + c * star[0], used)
            self._fluxes[s] = max(found[0], c / 2)
            steps[s] = moves[0, ::-1]
        weights = self._fluxes[: self._n_given] * (self._whole if self._whole.any() else 1.0)
        self._places += steps - np.average(steps[: len(weights)], axis=0, weights=weights)

    def _name(self, s: int) -> str:
        y, x = self._places[s] - self._half
        return f"({x:.1f}, {y:.1f})"

    def _middle(self, s: int) -> Point:
        """Return x and y of a star's centre in its window."""
        y, x = self._places[s] - self._pixels[s] + self._half
        return float(x), float(y)

    def _window(self, s: int) -> tuple[slice, slice]:
        y, x = (slice(i - self._half, i + self._half + 1) for i in self._pixels[s])
        return y, x

    def _centred(self, image: Array, s: int, own: Array | float = 1.0) -> Array:
        """Return the square round a star, moved so that the star is in its middle."""
        fraction = self._places[s] - self._pixels[s]
        # Splines do not ring where neighbours are cut.
        return np.asarray(shift(own * image[self._window(s)], -fraction, mode="nearest"))
