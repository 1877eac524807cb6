"""An observation on the grid of the transform, at unit mean, as engines take it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers
from lnocl.core.scene.counts import mean_exposure
from lnocl.core.scene.detector import Movable, movable_psfs, on_sky, psfs_with_pixels
from lnocl.core.scene.first_estimate import RoughFit, first_estimate, level_beside, rough_fit
from lnocl.core.scene.grid import grid_of, pad_of
from lnocl.core.scene.halos import halo_cutouts
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.psf_field import Psfs
from lnocl.core.scene.rotation import Rotation, turned_psf
from lnocl.core.scene.scaled_penalty import scaled
from lnocl.core.scene.scene_check import warn_of_scene
from lnocl.core.scene.shifting import Cutout, MovablePsf, movable_psf
from lnocl.core.scene.star_psfs import StarPsfs, owned
from lnocl.core.scene.star_weights import OBSERVED_SHARE, weigh_stars
from lnocl.core.scene.stars import Covered, StarField, check_positions, covered_box
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError

# The one division guard: where the model is not above this (images have unit mean) the ratio is
# taken as 0. It keeps g / m inside the range of float32 and is far below any modelled light.
MIN_MODEL = 2.0**-64

# The weight of halos that are held: it leaves nothing of their corrections.
HELD = 1e30

NO_PENALTY = Penalty()


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
        `lnocl.core.scene.padding.choose_pad`.
    max_shift : float
        Pixels that a star may be moved later on, by `move_stars`.

    Attributes
    ----------
    pad : int
        Unobserved pixels round the images, at least.
    image_grid : tuple of int
        Shape (ny, nx), `lnocl.core.scene.grid.LENGTHS`; the images lie at its origin.
    grid : tuple of int
        Shape (Ny, Nx) of the sky's grid: that of the images, finer by `oversample`.
    mixing : Mixing or None
        How images show several skies, where there are some.
    sky_grid : tuple of int
        Shape of the extended source: `grid`, or with several skies (K, Ny, Nx).
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
        Its weights, scaled; with several skies a smoothing of each, shape (K, 1, 1).
    smoothing_map : ndarray of float64, shape `sky_grid`, or None
        The weight of the edge-preserving term in each pixel, scaled, where the penalty has a map;
        with `smoothing` in it.
    edge : float
        delta of the edge-preserving term, scaled; 0 where there is no such term; with several
        skies that of each, shape (K, 1, 1).
    spectral_smoothing : float
        The weight of that term between one sky and the next, scaled.
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
        A PSF that is larger than the grid, whose wings wrap round; offsets larger than what is
        unobserved beside the images; a PSF that rings where it is moved between pixels.
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
        self.pad = pad_of(observation, pad)
        self.image_grid = grid_of(observation, self.pad)
        ny, nx = self.image_grid
        self.grid = self.oversample * ny, self.oversample * nx
        self.mixing = observation.mixing
        self.sky_grid = (*observation.skies_shape[:-2], *self.grid)
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
        warn_of_scene(self, self._psfs, max_shift > 0 and self.n_stars > 0)
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
        rows, columns = map(_nearest, self.grid, given.shape[1:])
        each = given if given.strides[0] else given[:1]
        return np.broadcast_to(each[:, rows[:, None], columns], (self.n_images, *self.grid))

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
        """The PSFs of `psfs_of_sky`, each times its image's relative exposure."""
        return [movable_psf(psf, self.grid) for psf in self.scaled_psfs(self.psfs_of_sky())]

    @cached_property
    def _responses_of_sky(self) -> list[MovablePsf]:
        """The same with the pixels of the images."""
        return [movable_psf(psf, self.grid) for psf in self.scaled_psfs(self.psfs_of_sky(True))]

    def _penalise(self, penalty: Penalty) -> None:
        self.penalty = penalty
        found = scaled(penalty, self)
        self.mu, self.smoothing, self.smoothing_map, self.edge, self.star_prior = found[:-1]
        self.spectral_smoothing = found[-1]

    @property
    def is_smoothed(self) -> bool:
        """Whether the extended source has an edge-preserving term."""
        has_weight = bool(np.any(self.smoothing)) or self.spectral_smoothing > 0
        return has_weight or self.smoothing_map is not None

    @property
    def mixes(self) -> Array:
        """The weight of each sky in each image, shape (p, K); 1 where there is one sky."""
        return np.ones((self.n_images, 1)) if self.mixing is None else self.mixing.weights

    @property
    def flux_mixes(self) -> Array:
        """The weights of the skies in the images that show a flux, shape (n_fluxes, K)."""
        return self.mixes[self.shown.argmax(axis=1)]

    def prior_of_fluxes(self) -> tuple[Array, Array]:
        """Return flux and precision of the prior of each flux; a precision of 0 where none is."""
        prior, nothing = self.star_prior, np.zeros(self.n_fluxes)
        return (nothing, nothing) if prior is None else (prior.fluxes, prior.precision)

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
    ) -> list[list[Movable]]:
        """Return the PSF of each image at each star's position, or a part of it, to be placed.

        PSFs of their own are whole.
        """
        return self._own.into(self._common_psfs(positions, part), self.owned)

    def _common_psfs(
        self, positions: Array, part: tuple[slice, slice] | None = None
    ) -> list[list[Movable]]:
        observation, fields = self.observation, self.observation.psf_fields
        if not fields and self.transmission is None:
            parts = self._psfs
            if part is not None:
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
        """Return a copy whose halo amounts stay at scaled `fluxes`, and the start that is left."""
        other = copy(self)
        other.rough_fit = RoughFit(fluxes, level_beside(self, fluxes))
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

    def fluxes_of(self, which: Sequence[int]) -> NDArray[np.intp]:
        """Return the fluxes of stars in the epochs of some images, and of the halos of these."""
        epochs = np.unique(self.observation.epochs[list(which)])
        stars = np.arange(self.n_stars).reshape(-1, self.n_epochs)[:, epochs].ravel()
        halos = self.n_stars + np.arange(self.n_halos).reshape(-1, self.n_images)[:, which].ravel()
        return np.append(stars, halos)

    def of_images(self, which: Sequence[int]) -> Scene:
        """Return this scene for some images of one filter, in the same units: it has one sky."""
        other, which = copy(self), list(which)
        vars(other).pop("rough_fit", None)
        fluxes, n = self.fluxes_of(which), self.n_stars
        stars = fluxes[fluxes < n]
        other.observation = observation = self.observation.of_images(which)
        other.mixing, other.sky_grid = None, self.grid
        other.shown = self.shown[fluxes][:, which]
        other.star_weights = self.star_weights[fluxes]
        other.owned = self.owned[stars]
        for name in ("gains", "areas", "seen_areas", "transmission", "weights"):
            if (values := getattr(self, name)) is not None:
                setattr(other, name, values[which])
        for name in ("rotations", "_psfs", "_psfs_of_sky", "_responses_of_sky"):
            if held := vars(self).get(name):
                setattr(other, name, [held[j] for j in which])
        halos = fluxes[fluxes >= n] - n
        other._halos = [[self._halos[j][k] for k in halos] for j in which] if self._halos else []
        other._own = StarPsfs(observation, other.gains, other._movable, self.grid)
        other._field = other._place_stars(self.stars[stars])
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

    def _movable(self, psfs: Iterable[Array]) -> list[Movable]:
        return movable_psfs(psfs, self.observation, self.image_grid)

    def scaled_psfs(self, psfs: Iterable[Array] | None = None) -> list[Array]:
        """Return PSFs times the relative exposure of their image, where that is a number."""
        pairs = zip(self.gains, self.observation.psfs if psfs is None else psfs, strict=True)
        return [psf if gain == 1.0 else gain * psf for gain, psf in pairs]

    def star_box(self, j: int, s: int) -> Covered:
        """Return the rows and columns of the images' grid that star s may light in image j."""
        max_shift = self._max_shift if s < self.n_stars else 0.0
        return covered_box(self.star_cutout(j, s), self.image_grid, max_shift)

    def observed(self, total_weight: Array) -> NDArray[np.bool_]:
        """Return where the extended source was observed, from ``sum_j A_j^T w_j``."""
        most = total_weight.max(axis=(-2, -1), keepdims=True)
        return np.asarray(total_weight >= OBSERVED_SHARE * most)

    def start(
        self, extended: ArrayLike | None, star_fluxes: ArrayLike | None
    ) -> tuple[Array, Array]:
        """Return the estimate to begin with, on the grid and scaled.

        Parameters
        ----------
        extended : array_like, of shape `lnocl.Observation.skies_shape`, optional
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
        return first_estimate(self, extended, star_fluxes)

    @property
    def levels(self) -> Array:
        """The mean of each sky, electrons per pixel of it, by linear least squares; shape (K,)."""
        return np.ravel(self.rough_fit.level) * self.unit

    @cached_property
    def rough_fit(self) -> RoughFit:
        """Fluxes and the level of a flat extended source by linear least squares, scaled."""
        return rough_fit(self)

    def _leave_out_stars(self, is_lost: NDArray[np.bool_]) -> None:
        """Hold stars at no flux, and show them in no image, where no good pixel has their light."""
        if not is_lost.any():
            return
        self.shown[: len(is_lost)][is_lost] = False
        self.star_weights[: len(is_lost)][is_lost] = HELD
        self._field = self._place_stars(self.stars)

    def _weigh_stars(
        self, field: StarField, owners: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.bool_]]:
        return weigh_stars(self, field, owners, self._own.shares)

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
        return enlarged(array, self.image_grid, fill)


def _nearest(n: int, k: int) -> NDArray[np.int_]:
    """Return which of the first k of n pixels is nearest to each, round the end."""
    at = np.arange(n)
    return np.where(at < (n + k + 1) // 2, np.minimum(at, k - 1), 0)
