"""An observation on the grid of the transform, at unit mean, as engines take it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, counted, warn
from lnocl.scene.arrays import Array, numbers
from lnocl.scene.band_matrix import BandMatrix
from lnocl.scene.counts import mean_exposure
from lnocl.scene.detector import DetectorPsf, movable_psfs, on_sky, psfs_with_pixels
from lnocl.scene.grid import grid_of, psf_shape
from lnocl.scene.halos import halo_cutouts
from lnocl.scene.observation import Observation
from lnocl.scene.penalty import MAX_WEIGHT, Penalty
from lnocl.scene.psf_field import Psfs
from lnocl.scene.rotation import Rotation, turned_psf
from lnocl.scene.shifting import Cutout, MovablePsf
from lnocl.scene.star_psfs import StarPsfs, owned
from lnocl.scene.stars import Covered, StarField, check_positions, covered_box

# Below this share of its maximum the total weight of a pixel of the extended source is taken as
# "not observed" (the threshold of Bertero & Boccacci 2005, A&A 437, 369, for boundary effects).
OBSERVED_SHARE = 0.01

# A PSF that rings by more than this share of its peak, moved by half a pixel, is warned of.
# Gaussians do not ring where they are centred on a pixel; sharp ones do where they are not.
MAX_RINGING = 0.01
# Five times the PSF's side wide, a tile of a field that grows by half varied by 0.1
# (docs/validation/tiles.md).
MAX_VARIATION = 0.2

# The one division guard: where the model is not above this (images have unit mean) the ratio is
# taken as 0. It keeps g / m inside the range of float32 and is far below any modelled light.
MIN_MODEL = 2.0**-64

# The weight of halos that are held: it leaves nothing of their corrections.
HELD = 1e30

NO_PENALTY = Penalty()

# A start may be so many times as bright as the images, beside so many times the noise of their sum,
# as the floor of an estimate is.
BRIGHTER, FLOOR = 3.0, 30.0
# delta of the edge-preserving term, in means of a flat extended source: docs/validation/sgp.md.
EDGE = 3.0


class Scene:
    """What is modelled, on a grid that the transform takes, scaled to images of about unit mean.

    The scale of images and background is a power of two, so that it changes no digit. Exposures
    are taken relative to their mean: as ``m_j = e_j (A_j f + sum_s c_s P_js) + b_j`` is linear,
    one of a whole image goes into its PSF, and a map e_j(n) into the weights, with images and
    background divided by it, which leaves the objective as it is but for the weights.

    A halo in an image is to solvers and engines what a star is: light of known shape, in that image
    alone, whose flux is fitted. So halos come after the stars wherever there are fluxes.

    Parameters
    ----------
    observation : Observation
        The images and what is known of them.
    stars : sequence of (x, y)
        Positions of the point sources in pixels of the first image less its offset, 0-based, x
        along columns.
    penalty : Penalty
        On the extended source.
    pad : int or "auto"
        Unobserved pixels round the images, at least; "auto": those of
        `lnocl.scene.padding.choose_pad`.
    max_shift : float
        Pixels that a star may be moved later on, by `move_stars`.

    Attributes
    ----------
    image_grid : tuple of int
        Shape (ny, nx), `lnocl.scene.grid.LENGTHS`; the images lie at its origin.
    grid : tuple of int
        Shape (Ny, Nx) of the sky's grid: that of the images, finer by `oversample`.
    oversample : int
        Pixels of the sky to one of the images, along each axis.
    stars : ndarray of float64, shape (n, 2)
        Positions. With several epochs n counts each star in each epoch, star by star.
    shown : ndarray of bool, shape (n_fluxes, p)
        Which images show a star, those of its epoch; none where no good pixel of these has its
        light, and its flux is 0. Then which show a halo, that which it is of.
    rotations : list of Rotation
        How each image is turned against the sky; empty where none is.
    areas : ndarray of float64, shape (p,)
        Pixels of the sky to one of each image.
    transmission : ndarray of float64, shape (p, Ny, Nx), or None
        The share of each pixel of the sky's light that an image gets, before its PSF; beyond the
        sky's frame that of the nearest pixel.
    seen_areas : ndarray of float64, shape (p,)
        `areas` times its mean.
    scale : float
        Electrons per unit of the images.
    unit : float
        Electrons per exposure and unit of the estimate.
    mean_exposure : float
        Electrons of a halo to one of a star of the same flux.
    penalty : Penalty
        On the extended source.
    mu, smoothing : float
        Its weights, scaled.
    smoothing_map : ndarray of float64, shape (Ny, Nx), or None
        The weight of the edge-preserving term in each pixel, scaled, where the penalty has a map;
        with `smoothing` in it.
    edge : float
        delta of the edge-preserving term, scaled; 0 where there is no such term.
    star_prior : StarPrior or None
        That of the penalty, scaled.
    weights : ndarray of bool or float64, shape (p, ny, nx) of the images' grid, or None
        True where a pixel was observed, or its relative exposure where exposures are maps; None
        where all were observed alike.
    gains : ndarray of float64, shape (p,)
        Relative exposures where they are numbers, else 1; the PSFs are multiplied by them.
    owned : ndarray of int, shape (n,)
        The PSF of its own that each star has, -1 where it has none.
    star_weights : ndarray of float64, shape (n_fluxes,)
        ``sum_j <P_js, w_j>``, of each image not less than 0: the shares of the star's light that
        were observed, summed; likewise of halos. `HELD` where a flux is to stay.
    holds_halos : bool
        Whether halos keep their fluxes.

    Raises
    ------
    InputError
        A star outside the images; penalty or pad out of range; images too large for the transform;
        exposures too large to be summed; a sky, images over exposures, that is no finite number, or
        0.

    Warns
    -----
    LnoclWarning
        A star that no good pixel shows, in an epoch or at all; a PSF that is larger than the grid,
        whose wings wrap round; offsets larger than what is unobserved beside the images; a PSF that
        rings where it is moved between pixels.
    """

    def __init__(
        self,
        observation: Observation,
        stars: ArrayLike = (),
        penalty: Penalty = NO_PENALTY,
        pad: int | str = 0,
        max_shift: float = 0.0,
    ) -> None:
        self.observation = observation = observation.upright()
        positions = check_positions(stars, observation)
        self._max_shift = max_shift
        self.shown = self._shown(len(positions))
        self.owned = np.repeat(owned(observation, positions), observation.n_epochs)
        positions = np.repeat(positions, observation.n_epochs, axis=0)
        self.oversample = observation.oversample
        self.image_grid = grid_of(observation, pad)
        ny, nx = self.image_grid
        self.grid = self.oversample * ny, self.oversample * nx
        self._warn_of_large_psf()
        self._warn_of_varying_psfs()
        self._warn_of_wrapped_offsets()
        # A power of two just above the mean; 1 where that is 0.
        n_good = int(np.count_nonzero(~observation.mask))
        # Bad pixels hold 0.
        self.scale = 2.0 ** math.frexp(float(observation.images.sum() / n_good))[1]
        exposure = observation.exposure
        has_map = exposure.ndim == 3
        self.mean_exposure = mean_exposure(observation)
        self.unit = self._sky_unit(self.mean_exposure)
        relative = exposure / self.mean_exposure
        self.gains = np.ones(self.n_images) if has_map else relative
        self._psfs = self._movable(self.scaled_psfs())
        self.areas = (self.oversample * observation.scales) ** 2
        self.transmission = self._transmission()
        self.seen_areas = self.areas.copy()
        if self.transmission is not None:
            self.seen_areas *= observation.transmission.mean(axis=(1, 2))
        self.rotations = self._rotations()
        self._own = StarPsfs(observation, self.gains, self._movable, self.grid)
        self.weights = self._weigh(relative if has_map else None)
        self._halos = (
            halo_cutouts(observation.halos, self.weights, has_map, self.image_grid)
            if len(observation.halos)
            else []
        )
        self._field = self._place_stars(positions)
        self.star_weights, is_observed = self._weigh_stars(self._field, self.owned)
        self._leave_out_stars(~is_observed[: len(positions)])
        self.holds_halos = False
        self._warn_of_ringing()
        self._penalise(penalty)

    def _shown(self, n: int) -> NDArray[np.bool_]:
        """Return which images show each of n stars in each epoch, and then each halo."""
        observation, p = self.observation, self.n_images
        stars = np.tile(np.arange(observation.n_epochs), n)[:, None] == observation.epochs
        halos = np.tile(np.eye(p, dtype=bool), (len(observation.halos), 1))
        return np.concatenate([stars, halos])

    def _rotations(self) -> list[Rotation]:
        observation = self.observation
        if not observation.is_turned:
            return []
        rotations = []
        for j, scale in enumerate(observation.scales.tolist()):
            turn, shift, box = observation.on_fine_pixels(j)
            angle = float(np.arctan2(turn[1, 0], turn[0, 0]))
            rotations.append(Rotation(angle, shift, self.grid, box, scale))
        return rotations

    def _transmission(self) -> Array | None:
        given = self.observation.transmission
        if not len(given):
            return None
        beyond = [(0, n - k) for n, k in zip(self.grid, given.shape[1:], strict=True)]
        if given.strides[0] or not any(map(any, beyond)):
            return np.pad(given, [(0, 0), *beyond], mode="edge")
        one = np.pad(given[0], beyond, mode="edge")
        return np.broadcast_to(one, (self.n_images, *self.grid))

    def transmitted(self, positions: Array) -> Array:
        """Return the share of the light of points, (n, 2), that each image gets; shape (p, n)."""
        if self.transmission is None:
            return np.ones((self.n_images, len(positions)))
        from scipy.ndimage import map_coordinates

        at = on_sky(positions, self.oversample).T[::-1]
        shares = (map_coordinates(t, at, order=1, mode="nearest") for t in self.transmission)
        return np.array(list(shares))

    def psfs_of_sky(self, with_pixels: bool = False) -> list[Array]:
        """Return the PSFs as the sky sees them, of unit sum: turned back, on the sky's pixels.

        They may have the pixels of the images besides.
        """
        psfs = psfs_with_pixels(self.observation) if with_pixels else list(self.observation.psfs)
        if not self.rotations:
            return psfs
        pairs = zip(psfs, self.rotations, strict=True)
        return [turned_psf(psf, rotation.angle, rotation.scale) for psf, rotation in pairs]

    @cached_property
    def _psfs_of_sky(self) -> list[MovablePsf]:
        """Those, times the relative exposure of their image where that is a number."""
        return [MovablePsf(psf, self.grid) for psf in self.scaled_psfs(self.psfs_of_sky())]

    @cached_property
    def _responses_of_sky(self) -> list[MovablePsf]:
        """The same with the pixels of the images."""
        return [MovablePsf(psf, self.grid) for psf in self.scaled_psfs(self.psfs_of_sky(True))]

    def _penalise(self, penalty: Penalty) -> None:
        self.penalty = penalty
        longer = 1.0 if penalty.exposure is None else penalty.exposure / self.mean_exposure
        self.mu = self._scaled("mu", penalty.mu, self.scale * longer**2)
        self.smoothing = self._scaled("smoothing", penalty.smoothing, longer)
        self.smoothing_map = self._smoothing_map(penalty)
        self.edge = self._edge(penalty) if self.is_smoothed else 0.0
        self.star_prior = penalty.stars and penalty.stars.scaled(self.unit, self.scale)

    @property
    def is_smoothed(self) -> bool:
        """Whether the extended source has an edge-preserving term."""
        return self.smoothing > 0 or self.smoothing_map is not None

    def _smoothing_map(self, penalty: Penalty) -> Array | None:
        """Return the weight of the edge-preserving term on the grid, scaled, where it is a map."""
        if penalty.near_stars is None:
            return None
        ny, nx = self.observation.sky_shape
        total = np.full(self.grid, self.smoothing)
        total[:ny, :nx] += penalty.near_stars
        return total

    def _edge(self, penalty: Penalty) -> float:
        """Return delta of the edge-preserving term, scaled."""
        return EDGE * self._rough_fit[1] if penalty.edge is None else penalty.edge / self.unit

    def penalised(self, penalty: Penalty) -> Scene:
        """Return this scene with another penalty."""
        other = copy(self)
        other._penalise(penalty)
        return other

    def of_half(self, observation: Observation) -> Scene:
        """Return this scene for half of its counts: scaled, all but the images is the same."""
        half = copy(self)
        half.observation = observation
        half.scale, half.unit = self.scale / 2.0, self.unit / 2.0
        return half

    def seen_through(self, psfs: Psfs) -> Scene:
        """Return this scene with other PSFs, as they are."""
        other = copy(self)
        other.observation = self.observation.replace(psfs=psfs)
        other._psfs = other._movable(other.scaled_psfs())
        for name in ("_psfs_of_sky", "_responses_of_sky"):
            vars(other).pop(name, None)
        other._field = other._place_stars(self.stars)
        return other

    def _scaled(self, name: str, weight: float, factor: float) -> float:
        """Return a weight of the penalty, scaled; refuse one that is too large for float32."""
        if weight * factor > MAX_WEIGHT:
            raise InputError(
                f"`{name}` {weight:g} is too large for images of about {self.scale:g} electrons "
                f"per pixel; the most that means anything there is {MAX_WEIGHT / factor:g}"
            )
        return float(weight) * factor if weight else 0.0  # the factor may be infinite

    def _sky_unit(self, mean_exposure: float) -> float:
        """Return the unit of the sky; refuse one in which its flux is no number, or lost."""
        unit = self.scale / mean_exposure
        if unit == 0 or not math.isfinite(unit * math.prod(self.grid)):
            raise InputError(
                f"images of about {self.scale:g} electrons per pixel at exposures of about "
                f"{mean_exposure:g} leave a sky that no number holds: divide or multiply one of "
                "them by a constant"
            )
        return unit

    def move_stars(self, stars: ArrayLike) -> None:
        """Give the stars other positions, none farther away than the max_shift.

        They may leave the images, but a star stays where it was rather than go where no image has
        observed its light.
        """
        before, weights = self.stars, self.star_weights
        self._field = self._place_stars(numbers("stars", stars))
        self.star_weights, is_observed = self._weigh_stars(self._field, self.owned)
        if self.holds_halos:
            self.star_weights[self.n_stars :] = HELD
        if not is_observed.all():
            is_seen = is_observed[: self.n_stars, None]
            self._field = self._place_stars(np.where(is_seen, self.stars, before))
            self.star_weights = np.where(is_observed, self.star_weights, weights)

    def observes(self, positions: Array) -> NDArray[np.bool_]:
        """Return which stars at these positions any image would observe."""
        shown = np.ones((len(positions), self.n_images), bool)
        owners = owned(self.observation, positions)
        psfs = self._own.into(self._common_psfs(positions), owners)
        field = StarField(psfs, self.observation, self.image_grid, positions, shown)
        return self._weigh_stars(field, owners)[1]

    def _place_stars(self, positions: Array) -> StarField:
        psfs = self.star_psfs(positions)
        return StarField(
            psfs, self.observation, self.image_grid, positions, self.shown, self._halos
        )

    def star_psfs(
        self, positions: Array, part: tuple[slice, slice] | None = None
    ) -> list[list[MovablePsf | DetectorPsf]]:
        """Return the PSF of each image at each star's position, or a part of it, to be placed.

        PSFs of their own are whole.
        """
        return self._own.into(self._common_psfs(positions, part), self.owned)

    def _common_psfs(
        self, positions: Array, part: tuple[slice, slice] | None = None
    ) -> list[list[MovablePsf | DetectorPsf]]:
        observation, fields = self.observation, self.observation.psf_fields
        if not fields and part is None and self.transmission is None:
            return [[psf] * len(positions) for psf in self._psfs]
        if not fields and self.transmission is None:
            parts = self._movable([psf[part] for psf in self.scaled_psfs()])
            return [[psf] * len(positions) for psf in parts]
        shares = self.gains[:, None] * self.transmitted(positions)
        psfs = [
            [field.at(*place) for place in observation.places(j, positions)]
            for j, field in enumerate(fields)
        ] or [[psf] * len(positions) for psf in observation.psfs]
        return [
            self._movable([share * psf[part or ...] for share, psf in zip(*each, strict=True)])
            for each in zip(shares, psfs, strict=True)
        ]

    @property
    def stars(self) -> Array:
        """Positions of the stars, shape (n, 2)."""
        return self._field.positions

    @property
    def has_exposure_map(self) -> bool:
        """Whether the weights are exposures, not only whether a pixel was observed."""
        return self.weights is not None and self.weights.dtype != np.bool_

    @property
    def n_images(self) -> int:
        """Number of images, p."""
        return self.observation.n_images

    @property
    def n_stars(self) -> int:
        """Number of point sources; with several epochs of each in each."""
        return len(self.stars)

    @property
    def n_epochs(self) -> int:
        """Number of epochs, in each of which stars have a flux."""
        return self.observation.n_epochs

    @property
    def places(self) -> Array:
        """Positions of the stars, once each."""
        return np.asarray(self.stars[:: self.n_epochs])

    @property
    def through_psfs(self) -> NDArray[np.bool_]:
        """Which fluxes the PSFs of the images show: not halos, nor stars with PSFs of their own."""
        return np.append(self.owned < 0, np.zeros(self.n_halos, bool))

    @property
    def n_halos(self) -> int:
        """Number of halos of all images together."""
        return self.n_fluxes - self.n_stars

    @property
    def is_shown(self) -> NDArray[np.bool_]:
        """Whether any image shows each star, in its epoch, and each halo; shape (n_fluxes,)."""
        return np.asarray(self.shown.any(axis=1))

    @property
    def shown_places(self) -> Array:
        """Positions of stars that any image shows, once each, shape (n_shown, 2)."""
        is_shown = self.is_shown[: self.n_stars].reshape(-1, self.n_epochs).any(axis=1)
        return np.asarray(self.places[is_shown])

    @property
    def shown_stars(self) -> Array:
        """Those on the sky's grid."""
        return on_sky(self.shown_places, self.oversample)

    @property
    def n_fluxes(self) -> int:
        """Number of fluxes: of the stars, and then of the halos, shape by shape."""
        return len(self.shown)

    def holding(self, fluxes: Array, penalty: Penalty) -> Scene:
        """Return this scene with its halos held, and the start that fluxes, scaled, leave."""
        other = copy(self)
        other._rough_fit = fluxes, self._level_beside(fluxes)
        other.star_weights = np.append(self.star_weights[: self.n_stars], [HELD] * self.n_halos)
        other.holds_halos = True
        other._penalise(penalty)
        return other

    def of_stars(self) -> Scene:
        """Return this scene without its halos."""
        other, n = copy(self), self.n_stars
        other.shown, other.star_weights = self.shown[:n], self.star_weights[:n]
        other._halos, other.holds_halos = [], False
        other._field = other._place_stars(self.stars)
        return other

    def with_star(self, place: Array) -> Scene:
        """Return this scene with one more star, the last, at (x, y)."""
        other, n, n_epochs = copy(self), self.n_stars, self.n_epochs
        shown = np.arange(n_epochs)[:, None] == self.observation.epochs
        other.shown = np.insert(self.shown, [n] * n_epochs, shown, axis=0)
        positions = np.concatenate([self.stars, np.tile(place, (n_epochs, 1))])
        other.owned = np.append(self.owned, [-1] * n_epochs)
        other._field = other._place_stars(positions)
        other.star_weights, _ = other._weigh_stars(other._field, other.owned)
        return other

    def images(self) -> Iterator[Array]:
        """Yield each image on its grid, scaled, shape (ny, nx); 0 where not observed."""
        ny, nx = self.observation.shape
        for j, image in enumerate(self.observation.images):
            laid = np.zeros(self.image_grid)
            np.divide(image, self.scale, out=laid[:ny, :nx])
            yield self.per_exposure(laid, 0.0, j)

    def background(self) -> Array:
        """Return the background, scaled, shape (p,) or (p, ny, nx); 1 where not observed."""
        background = self.observation.background / self.scale
        if self.has_exposure_map and background.ndim == 1:
            background = np.broadcast_to(background[:, None, None], self.observation.images.shape)
        if background.ndim == 1:
            return background
        return self.per_exposure(self._on_grid(background, fill=1.0), 1.0, slice(None))

    def per_exposure(
        self, values: Array, fill: float, j: int | slice, there: Any = np.s_[:]
    ) -> Array:
        """Return counts of images over relative exposures, where these are maps and weights."""
        if self.weights is None or not self.has_exposure_map:
            return values
        weights = self.weights[j][there]
        return np.divide(values, weights, out=np.full_like(values, fill), where=weights > 0)

    def in_electrons(self, model: Array, j: int, there: Any = np.s_[:]) -> Array:
        """Return the model of pixels of image j, changed in place, as its counts are."""
        if self.weights is not None and self.has_exposure_map:
            model *= self.weights[j][there]
        model *= self.scale
        return model

    def psf(self, j: int) -> Array:
        """Return what the sky is convolved with for image j, on the grid, shape (Ny, Nx).

        That is `psf_cutout`; for an image that is turned, with the effect of the shears' weights
        undone (`Rotation.undone`).
        """
        psf = self.psf_cutout(j).on_grid(self.grid)
        if not self.rotations:
            return psf
        import scipy.fft

        spectrum = scipy.fft.rfft2(psf) * self.rotations[j].undone()
        return np.asarray(scipy.fft.irfft2(spectrum, self.grid))

    def point_response(self, j: int) -> Array:
        """Return what image j shows of a point at the origin, on the sky's grid, shape (Ny, Nx).

        Where images are turned `psf` has what their weights need besides; its squares mean nothing.
        """
        return self.psf_cutout(j).on_grid(self.grid)

    def psf_cutout(self, j: int) -> Cutout:
        """Return the response of image j where it is not 0, the sky moved by the offset.

        Its value at a pixel of the sky is what a pixel of the image that begins there sees of a
        source at the origin. Without oversampling it is the PSF with its peak at the offset. For an
        image that is turned it is the PSF turned back, as bright as the image's pixels are large.
        """
        if self.rotations:
            cutout = self._responses_of_sky[j].at(0.0, 0.0)
            return cutout._replace(values=self.areas[j] * cutout.values)
        return self._psfs[j].response(*self.observation.offsets[j])

    def star_image(self, j: int, s: int) -> Array:
        """Return P_js, the PSF of image j centred on star s, or a halo, shape (ny, nx)."""
        return self.star_cutout(j, s).on_grid(self.image_grid)

    def star_cutout(self, j: int, s: int) -> Cutout:
        """Return P_js, where it is not 0."""
        return self._field.cutouts[j][s]

    def star_on_sky(self, j: int, s: int) -> Cutout:
        """Return P_js before the pixels of image j sample it, on the sky's grid."""
        return self._field.psfs[j][s].on_sky(*self._field.places[j][s])

    def psf_on_sky(self, j: int, s: int) -> Cutout:
        """Return PSF j on the sky's grid, at star s."""
        if self.owned[s] >= 0:
            rotation = self.rotations[j] if self.rotations else None
            fine = self._own.of_sky(self.owned[s], j, rotation)
        else:
            fine = self._psfs_of_sky[j] if self.rotations else self._psfs[j].fine
        return fine.at(*on_sky(self.stars[s], self.oversample))

    def share_shown(self, s: int) -> float:
        """Return the share of its light that images show of star s, without mask and edges."""
        shown = self.shown[s]
        is_own = self.owned[s] >= 0 and shown.any()
        return float(self._own.shares[self.owned[s]][shown].mean()) if is_own else 1.0

    @property
    def star_field(self) -> StarField:
        """The stars where they are now."""
        return self._field

    def _movable(self, psfs: Iterable[Array]) -> list[MovablePsf | DetectorPsf]:
        return movable_psfs(psfs, self.observation, self.image_grid)

    def scaled_psfs(self, psfs: Iterable[Array] | None = None) -> list[Array]:
        """Return PSFs times the relative exposure of their image, where that is a number."""
        pairs = zip(self.gains, self.observation.psfs if psfs is None else psfs, strict=True)
        return [psf if gain == 1.0 else gain * psf for gain, psf in pairs]

    def star_box(self, j: int, s: int) -> Covered:
        """Return the rows and columns of the images' grid that star s may light in image j."""
        max_shift = self._max_shift if s < self.n_stars else 0.0
        return covered_box([self.star_cutout(j, s)], self.image_grid, max_shift)

    def observed(self, total_weight: Array) -> NDArray[np.bool_]:
        """Return where the extended source was observed, from ``sum_j A_j^T w_j``."""
        return total_weight >= OBSERVED_SHARE * total_weight.max()

    def start(
        self, extended: ArrayLike | None, star_fluxes: ArrayLike | None
    ) -> tuple[Array, Array]:
        """Return the estimate to begin with, on the grid and scaled.

        Parameters
        ----------
        extended : array_like, of shape `lnocl.Observation.sky_shape`, optional
            Extended source, electrons per pixel, finite and not negative. Beyond the images the
            grid is filled with its mean. By default flat, with the flux that the stars leave. One
            that is far brighter than the images is made as bright as that.
        star_fluxes : array_like, shape (n,), optional
            Electrons, finite and not negative, but for stars that no image shows, which have none.
            By default a least-squares fit of the star images and one constant to the images; of
            halos, where there are any, instead of that.

        Raises
        ------
        InputError
            Either has the wrong shape, a negative, masked or non-finite value; counts of the start
            that are no number.
        """
        if star_fluxes is None:
            fluxes = self._rough_fit[0].copy()
        else:
            shape = (self.n_stars,)
            given = numbers("initial_star_fluxes", star_fluxes)
            if given.shape == shape:
                given[~self.is_shown[: self.n_stars]] = 0.0
            fluxes = _check_start("initial_star_fluxes", given, shape) / self.unit
            fluxes = np.append(fluxes, self._rough_fit[0][self.n_stars :])
        if extended is None:
            level = self._rough_fit[1]
            self._refuse_if_too_bright(level * math.prod(self.grid) + float(fluxes.sum()))
            return np.full(self.grid, level), fluxes
        given = _check_start("initial_extended", extended, self.observation.sky_shape) / self.unit
        given = self._in_their_unit(given)
        self._refuse_if_too_bright(float(given.sum() + fluxes.sum()))
        return _lay(given, self.grid, fill=given.mean()), fluxes

    def _in_their_unit(self, extended: Array) -> Array:
        """Return an extended source to begin with, as bright as images if far brighter.

        Iterations do not find back from one that is: pixels fall to 0, and stay there.
        """
        counts = excess = exposures = 0.0
        for j, (image, background) in enumerate(zip(self.images(), self.background(), strict=True)):
            weights = np.ones(self.image_grid) if self.weights is None else self.weights[j]
            counts += float((weights * image).sum())
            excess += float((weights * (image - background)).sum())
            exposures += float(self.seen_areas[j] * self.gains[j] * weights.sum())
        noise = math.sqrt(counts / self.scale)
        most = (BRIGHTER * max(excess, 0.0) + FLOOR * noise) / exposures
        with np.errstate(over="ignore"):
            mean = float(extended.mean())
        if mean <= most:
            return extended
        level = self._rough_fit[1]
        warn(
            f"`initial_extended` has {mean / level:.2g} times the light of the images, as in "
            "another unit, and was divided by that; it is in electrons per pixel, per second with "
            "exposures"
        )
        shape = extended / extended.max()
        return np.asarray(shape * (level / shape.mean()))

    def _refuse_if_too_bright(self, light: float) -> None:
        """Refuse a start whose counts, in electrons, no number holds."""
        most = self.weights.max() if self.weights is not None else 1.0
        if not math.isfinite(light * float(most) * float(self.gains.max()) * self.scale):
            raise InputError(
                "what the images show in their shortest exposure is more, in the longest, than a "
                "number holds: divide images and background by a constant"
            )

    @property
    def level(self) -> float:
        """The mean of the extended source, electrons per pixel of it, by linear least squares."""
        return self._rough_fit[1] * self.unit

    @cached_property
    def _rough_fit(self) -> tuple[Array, float]:
        """Star fluxes and the level of a flat extended source, by linear least squares.

        Halos stand in for the level: what a flat one has in common with the sky goes to the halo.
        """
        total, n_observed, n_seen = 0.0, 0, 0.0  # pixels of images, and of the sky
        normal: BandMatrix | None = None
        moment, levels = np.zeros(self.n_fluxes), []
        background = self.background()
        for j, excess in enumerate(self.images()):
            excess -= background[j]
            observed = np.ones(excess.shape, bool) if self.weights is None else self.weights[j] > 0
            excess[~observed] = 0.0
            light, n_there = float(excess.sum()), int(np.count_nonzero(observed))
            total, n_observed = total + light, n_observed + n_there
            n_seen += self.seen_areas[j] * n_there
            if not (self.n_fluxes and n_there):
                continue
            covered = self._field.covered(j)
            stars, weights = self._field.images(j, covered), observed[covered].astype(np.float64)
            sums = stars.products(weights)[0]
            information = stars.information(weights)
            normal = information if normal is None else normal + information
            levels.append(sums / np.sqrt(n_there))
            level = 0.0 if self.n_halos else light / n_there
            moment += stars.products(weights * (excess[covered] - level))[0]
        mean = total / n_observed
        # A star or a sky that starts at zero stays there, so each keeps a small share.
        least = max(1e-3 * mean, float(np.finfo(np.float32).eps))
        if normal is None:
            best = moment
        elif self.n_halos:
            best = normal.solve(moment)
        else:
            best = _solve_beside(normal, np.array(levels).T, moment)
        fluxes = np.maximum(best, least * math.prod(self.image_grid) / 100)
        fluxes[~self.is_shown] = 0.0
        level = (total - float(fluxes @ self.star_weights)) / n_seen
        return fluxes, max(level, least * n_observed / n_seen)

    def _level_beside(self, fluxes: Array) -> float:
        """Return the level of a flat extended source beside stars and halos of these fluxes."""
        total, n_observed, n_seen = 0.0, 0, 0.0
        for j, (image, background) in enumerate(zip(self.images(), self.background(), strict=True)):
            observed = np.ones(image.shape, bool) if self.weights is None else self.weights[j] > 0
            n_there = int(np.count_nonzero(observed))
            total += float((image - background)[observed].sum())
            n_observed, n_seen = n_observed + n_there, n_seen + self.seen_areas[j] * n_there
        least = max(1e-3 * total, n_observed * float(np.finfo(np.float32).eps))
        return max(total - float(fluxes @ self.star_weights), least) / n_seen

    def _weigh_stars(
        self, field: StarField, owners: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return ``sum_j <P_js, w_j>`` for each star, and whether any image observed it.

        An image did where `OBSERVED_SHARE` of the star's light falls on its good pixels, however
        short the exposure: it may be the only one that is not saturated. A sum that negative pixels
        of a PSF make negative counts as 0. PSFs of their own show a share of the light.
        """
        has_own = np.append(owners >= 0, np.zeros(len(field) - len(owners), bool))
        if self.weights is None:
            light = field.shown.T.astype(np.float64)
            if self.n_epochs > 1:  # else a star is in all images, of mean exposure 1
                light[:, : len(field.positions)] *= self.gains[:, None]
            # Samples of an effective PSF a pixel apart may sum to another number.
            is_summed = has_own | (self.oversample > 1 and self.observation.effective_psfs)
            for s in np.flatnonzero(is_summed):
                light[:, s] = [cutouts[s].values.sum() for cutouts in field.cutouts]
            return light.sum(axis=0), np.ones(len(field), bool)
        total, is_observed = np.zeros(len(field)), np.zeros(len(field), bool)
        for j, weights in enumerate(self.weights):
            windows = [
                (cutout, weights[cutout.window(self.image_grid)]) for cutout in field.cutouts[j]
            ]
            light = np.array([float((cutout.values * w).sum()) for cutout, w in windows])
            on_good = np.array([float((cutout.values * (w > 0)).sum()) for cutout, w in windows])
            total += np.maximum(light, 0.0)
            whole = np.full(len(field), self.gains[j])
            whole[has_own] *= self._own.shares[owners[owners >= 0], j]
            is_observed |= (on_good >= OBSERVED_SHARE * whole) & (light > 0)
        return total, is_observed

    def _leave_out_stars(self, is_lost: NDArray[np.bool_]) -> None:
        """Hold stars at no flux, and show them in no image, where no good pixel has their light."""
        if not is_lost.any():
            return
        self.shown[: len(is_lost)][is_lost] = False
        self.star_weights[: len(is_lost)][is_lost] = HELD
        self._field = self._place_stars(self.stars)
        of_epochs = is_lost.reshape(-1, self.n_epochs)
        is_dark = np.asarray(of_epochs.all(axis=1))
        stars = self.places
        if n_dark := int(is_dark.sum()):
            x, y = stars[is_dark][0]
            others = f", and so do {counted(n_dark - 1, 'other')}" if n_dark > 1 else ""
            or_dark = "" if self.transmission is None else " or nothing is transmitted"
            warn(
                f"the star at ({x:g}, {y:g}) lies where all images are masked{or_dark}{others}: it "
                "is left out, and its flux is NaN"
            )
        of_epochs = of_epochs & ~is_dark[:, None]
        if n_lost := int(of_epochs.sum()):
            s, epoch = np.argwhere(of_epochs)[0].tolist()
            x, y = stars[s]
            others = f", as {counted(n_lost - 1, 'other')} in their epochs" if n_lost > 1 else ""
            warn(
                f"the star at ({x:g}, {y:g}) is on no good pixel of epoch {epoch}: its flux there "
                f"is NaN{others}"
            )

    def _weigh(self, relative: Array | None) -> NDArray[Any] | None:
        """Return the weights for relative exposures, where they are a map."""
        observed = ~self.observation.mask
        if relative is not None:
            return self._on_grid(np.where(observed, relative, 0.0))
        is_whole = observed.all() and self.image_grid == self.observation.shape
        if is_whole and self.transmission is None:
            return None
        if (observed == observed[0]).all():
            return np.broadcast_to(self._on_grid(observed[0]), (self.n_images, *self.image_grid))
        return self._on_grid(observed)

    def _on_grid(self, array: NDArray, fill: float = 0.0) -> NDArray:
        return _lay(array, self.image_grid, fill)

    def _warn_of_wrapped_offsets(self) -> None:
        if self.observation.is_turned:  # the grid holds all that is turned
            return
        offsets = np.ceil(abs(self.observation.offsets).max(axis=0)).astype(int)[::-1]
        room = np.subtract(self.image_grid, self.observation.shape)
        if (offsets > room).any():
            warn(
                f"the images are shifted by up to {offsets.max()} pixels, and what leaves one edge "
                f"comes in at the opposite one: give `pad` {offsets.max()} or more"
            )

    def _warn_of_ringing(self) -> None:
        """Warn of PSFs that are moved between pixels and are sharper than pixels can hold."""
        for j, offset in enumerate(self.observation.offsets):
            q = self.oversample
            places = self.observation.places(j, self.stars)
            moved = np.concatenate([[q * offset], on_sky(places, q)])
            if self.observation.effective_psfs:
                moved -= (q - 1) / 2.0
            may_move = self._max_shift > 0 and self.n_stars > 0
            if not (may_move or self.rotations) and (moved == np.round(moved)).all():
                continue
            psf, moved_psf = self.observation.psfs[j], self._psfs[j].fine.at(0.5, 0.5).values
            dark = min(psf.min(), 0.0) - moved_psf.min() / self.gains[j]
            if dark > MAX_RINGING * psf.max():
                warn(
                    f"`psfs[{j}]` is sharper than its pixels can hold: moved between pixels it "
                    f"rings by up to {dark / psf.max():.1%} of its peak, at whole pixels not"
                )

    def _warn_of_varying_psfs(self) -> None:
        observation = self.observation
        for j, field in enumerate(observation.psf_fields):
            variation = field.variation(observation.psfs[j], observation.shape)
            if variation > MAX_VARIATION:
                remedy = ": take tiles, by lnocl.deconvolve_tiles, or a smaller tile"
                warn(
                    f"`psfs[{j}]` varies over the image by {variation:.0%}, and what is not a star "
                    "is reconstructed with that of the middle"
                    + ("" if observation.is_mapped else remedy)
                )

    def _warn_of_large_psf(self) -> None:
        shape = psf_shape(self.observation)
        if any(k > n for k, n in zip(shape, self.grid, strict=True)):
            warn(
                f"the psf {shape} is larger than the grid {self.grid}: its wings wrap "
                "round; crop it, or give `pad` to enlarge the grid"
            )


def _solve_beside(normal: BandMatrix, levels: Array, moment: Array) -> Array:
    """Return ``(F - U U^T)^-1 m``: the stars beside the level of each image (Woodbury)."""
    with_levels = normal.solve(levels)
    left = np.eye(levels.shape[1]) - levels.T @ with_levels
    alone = normal.solve(moment)
    return alone + with_levels @ (np.linalg.pinv(left, hermitian=True) @ (levels.T @ alone))


def _lay(array: NDArray, grid: tuple[int, int], fill: float = 0.0) -> NDArray:
    """Return an array at the origin of a grid."""
    ny, nx = array.shape[-2:]
    if grid == (ny, nx):
        return array
    laid = np.zeros((*array.shape[:-2], *grid), array.dtype)
    if fill:
        laid.fill(fill)
    laid[..., :ny, :nx] = array
    return laid


def _check_start(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = numbers(name, values)
    if array.shape != shape:
        raise InputError(f"`{name}` has shape {array.shape}; it must have {shape}")
    if not (np.isfinite(array).all() and (array >= 0).all()):
        raise InputError(f"`{name}` must be finite and not negative")
    return array
