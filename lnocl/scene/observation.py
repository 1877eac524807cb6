"""Several images of one sky, with PSFs, noise and masks; all input is checked here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, counted, note, warn
from lnocl.notebook import html_card
from lnocl.scene import containers
from lnocl.scene.arrays import Array, booleans, flag, numbers, refuse_masked, values_and_mask
from lnocl.scene.cores import centre, off_centre, peak
from lnocl.scene.halos import check_halos, refuse_dark
from lnocl.scene.psf_errors import check_modes, check_pixels
from lnocl.scene.psf_field import PsfField, read_fields
from lnocl.scene.quantities import bare
from lnocl.scene.shifting import place
from lnocl.scene.transforms import (
    Orientation,
    about_centre,
    check_transforms,
    enlarged,
    of_one_shape,
    refuse_other_shapes,
    rotation,
    scale_of,
    shapes_of,
)
from lnocl.scene.uncertainties import is_uncertainty, without_source

PsfCentre = Literal["check", "fit", "given"]

# An array whose last axis is so short, and the others so long, has its channels last.
MAX_CHANNELS = 4
MIN_SIDE = 8

# Most electrons in a pixel: sums of squares of a sky of so many remain far from the largest number,
# and float32, in which results are written, holds their sum.
MAX_COUNTS = 1e30

# Pixels of the sky to one of an image, along each axis. The frequencies that an image cannot tell
# apart are neighbours in the transform's order where this is a power of two (kernels/convolve.cl).
OVERSAMPLES = 1, 2, 4

# Pixels that the core of a PSF may lie off its centre: from the first on a warning is due, from the
# second on it is refused.
LITTLE_OFF_CENTRE, FAR_OFF_CENTRE = 0.25, 0.8

# Of PSFs with more negative light than this share it is warned. Public PSFs that are in order have
# 0.3 % at most. Those of five stars with noisy wings have up to 8 % (benchmarks/own_frame.py), and
# give the same light as PSFs without that noise.
MUCH_NEGATIVE = 0.1

# Attributes that hold a number for each image or for each pixel, and those that go with PSFs.
MAPS = "background", "read_noise", "exposure"
BESIDE_PSFS = "pupils", "ideal_psfs", "psf_modes", "psf_scatter"
# What `replace` takes, in the order in which one is checked beside those before it.
PARAMETERS = (
    *("oversample", "effective_psfs", "images", "mask", "exposure", "psfs", *BESIDE_PSFS),
    *("epochs", "background", "background_error", "read_noise", "halos"),
)
MOVES = "offsets", "transforms"


class Observation:
    """Images of one sky, each with its point spread function, background and bad pixels.

    The counts are taken to follow

    ``images[j] ~ Poisson(exposure[j] (psfs[j] * sky) + background[j]) + Normal(0, read_noise[j])``,

    with * a convolution and the sky moved by ``offsets[j]``. With `halos` each adds its own amount
    of them, which is fitted. All input is checked and copied once,
    and held in read-only arrays. With `oversample` the sky is finer than the pixels of the images.

    Parameters
    ----------
    images : array_like, shape (p, ny, nx) or (ny, nx)
        Counts in electrons per pixel. A pixel counts as bad where it is not finite, or masked in a
        `numpy.ma` array. The square of the read noise is added; counts that are negative then are
        set to zero, with a warning. An `astropy.units.Quantity`, an `astropy.nddata.NDData` such as
        a CCDData, or a sequence of these is taken with its unit, mask and uncertainty. The latter
        is that of all noise, the source's counts included: what is left without these is the read
        noise. Pixels are bad where it is 0 or not finite. Counts per time are multiplied by the
        exposure. Maps may be masked where the images are; nothing else may hold masked values.
    psfs : array_like, shape (p, ky, kx) or (ky, kx), or PsfField
        Point spread functions, with their centres at ``(ky // 2, kx // 2)``. One serves all images.
        Their sums are positive and are normalised to 1. Negative pixels stay, with a warning. A
        `lnocl.PsfField` or a `photutils.psf.GriddedPSFModel`, or one for each image, holds PSFs
        that vary over the image. Each star then has the PSF of its own place. The extended source
        has that of the middle; `lnocl.deconvolve_tiles` has one for each tile.
    background : float or array_like, shape (p,) or (p, ny, nx), optional
        Background, electrons per pixel, zero or more. A Quantity may be per time.
    background_error : float or array_like, shape (p,), optional
        Standard error of the level of `background`, electrons per pixel; 0 where it is known. Where
        it is more, `lnocl.deconvolve` fits the level with the rest, and a gradient of it
        (`lnocl.solvers.levels`).
    read_noise : float or array_like, shape (p,) or (p, ny, nx), optional
        Standard deviation of the read noise, electrons per pixel, zero or more. Its square is added
        to images and background (Snyder's approximation of Gaussian noise by Poisson noise). A
        `StdDevUncertainty`, `VarianceUncertainty` or `InverseVariance` of `astropy.nddata` may be
        of sky and read noise together. Pixels are bad where such a map is 0 or not finite.
    mask : array_like of bool, shape (p, ny, nx) or (ny, nx), optional
        True where a pixel is bad, as in `numpy.ma`. One serves all images.
    exposure : float or array_like, shape (p,), (p, ny, nx) or (ny, nx), optional
        Exposure of each image, or of each of its pixels, in seconds or relative to any unit; by
        default 1. The sky is in electrons per pixel and this unit. Exposures are more than zero; a
        map may be zero where a pixel saw nothing, and that pixel counts as bad.
    offsets : array_like, shape (p, 2), optional
        ``(dx, dy)`` of each image, pixels, each less than the image's side. A source at (x, y) in
        the sky is at ``(x + dx, y + dy)`` in the image. Offsets are taken into the PSFs; no counts
        are resampled.
    transforms : array_like, shape (p, 2, 3), optional
        The map from the sky to each image, in place of `offsets`: a source at (x, y) in the sky is
        at ``transforms[j] @ (x, y, 1)`` in the image. It is a rotation by any angle, with or
        without a flip, a scale and a shift; `lnocl.rotations` makes those of field rotation. Pixels
        of an image are as large as the sky's, or larger by the inverse of the scale. The sky is
        turned and sampled in the model; no counts are resampled. PSFs are as the images show them,
        on their pixels, and hold what a pixel collects. Images, and PSFs, of several shapes may be
        given as lists of arrays, and maps with them; bad pixels are added to smaller ones.
    halos : array_like, shape (n, p, ny, nx), (n, 1, ny, nx), (p, ny, nx) or (ny, nx), optional
        Light of known shape and unknown amount, such as the speckles of a star behind a
        coronagraph: n shapes in each image, or one in each, or one for all images. Finite and zero
        or more where a pixel is good, and not zero everywhere. Only the shape counts. The amount in
        each image is fitted with the stars and the extended source, and is zero or more. A flat
        halo, ``np.ones((ny, nx))``, is a level of the background that is fitted in each image.
    epochs : array_like, shape (p,), optional
        The epoch of each image, such as its night: numbers or text. Stars have a flux in each
        epoch, the rest of the sky is common. By default all images are of one epoch.
    oversample : {1, 2, 4}, optional
        Pixels of the sky, and of the PSFs, to one of the images along each axis, for detectors with
        fewer than two pixels to the PSF's width. Offsets of fractions of a pixel then add
        resolution.

        The model of a pixel is the sum over its pixels of the sky. Positions and offsets stay in
        pixels of the images.
    effective_psfs : bool, optional
        Whether each sample of the PSFs holds the light that a pixel of the images collects, as in
        effective PSFs of photutils and STDPSF files. Otherwise it holds what a pixel of the PSF
        collects, as in STPSF's OVERSAMP and OVERDIST. Without `oversample` both are the same.
    psf_centre : {"check", "fit", "given"}, optional
        Treatment of a PSF whose core lies off its centre, (ky // 2, kx // 2), and which would move
        the sky: "check" refuses it where it is off by 0.8 pixels or more, and warns from 0.25 on;
        "fit" moves it to its centre (`lnocl.scene.shifting.place`); "given" leaves it as it is.
    ideal_psfs : array_like, shape (p, ky, kx) or (ky, kx), optional
        The PSFs without aberrations, limited by diffraction alone, for ``refine_psfs`` "strehl".
        Shape, centre and normalisation are those of `psfs`. By default those of `pupils`.
    pupils : array_like, shape (p, ky, kx) or (ky, kx), optional
        Transmissions of the pupils, zero or more, of the shape of the PSFs, for ``refine_psfs``
        "pupil" and "strehl". They are sampled at the frequencies of a PSF's transform, with 0 in
        the middle, ``(ky // 2, kx // 2)``. Along x a pixel is ``wavelength / (kx * pixel scale)``
        long.
    psf_modes : array_like, shape (p, n, ky, kx) or (n, ky, kx), optional
        Ways in which the PSFs may differ from those given, for ``refine_psfs`` "modes". Each is one
        standard deviation, in units of PSFs of unit sum.
    psf_scatter : array_like, shape (p, ky, kx) or (ky, kx), optional
        Standard deviation of the pixels of the PSFs, as far as it is known, zero or more, in units
        of PSFs of unit sum. It serves the noise near stars, and ``refine_psfs`` "pixels".

    Attributes
    ----------
    images : ndarray of float64, shape (p, ny, nx)
        Electrons per pixel, the square of `read_noise` included; 0 where a pixel is bad.
    background : ndarray of float64, shape (p,) or (p, ny, nx)
        Electrons per pixel, the square of `read_noise` included.
    background_error : ndarray of float64, shape (p,)
        As given.
    read_noise : ndarray of float64, shape (p,) or (p, ny, nx)
        As given.
    exposure : ndarray of float64, shape (p,) or (p, ny, nx)
        As given.
    mask : ndarray of bool, shape (p, ny, nx)
        True where a pixel is bad.
    psfs : ndarray of float64, shape (p, ky, kx)
        Of unit sum. Where they vary over the field, those of the middle of the images.
    psf_fields : tuple of PsfField
        One for each image where PSFs vary over the field, else empty.
    offsets : ndarray of float64, shape (p, 2)
        As given, or 0; with `transforms` their shifts.
    turns : ndarray of float64, shape (p, 2, 2)
        The rotations, flips and scales of `transforms`; without it those of no turn.
    halos : ndarray of float64, shape (n, p, ny, nx)
        Of unit sum in each image, 0 where a pixel is bad; n is 0 where none were given.
    epochs : ndarray of int, shape (p,)
        The number of each image's epoch, from 0 on, in the order of the labels.
    oversample : int
        As given.
    effective_psfs : bool
        As given.
    ideal_psfs, pupils, psf_scatter : ndarray of float64, shape (p, ky, kx) or (0, ky, kx)
        As given; of length 0 where they were not.
    psf_modes : ndarray of float64, shape (p, n, ky, kx)
        As given; n is 0 where they were not.

    Raises
    ------
    InputError
        - `oversample` is not 1, 2 or 4, or `effective_psfs` is not True or False.
        - An array has the wrong shape, type or unit, is empty, or holds values out of range.
        - An array other than `images` holds masked values.
        - Images have an uncertainty that is below the noise of their counts in most pixels, of a
          class without a variance, or beside read noise.
        - A PSF or its sum is not finite, its sum is not positive, or its core is off its centre.
        - Images or background exceed 1e30 electrons in a pixel, with exposure and read noise.
        - No good pixel is left, or an offset leaves nothing of an image.
        - A halo is 0 on all good pixels of an image.
        - A label of `epochs` is missing or not a number, or the labels have no order.
        - `transforms` are given beside `offsets`, `oversample` or PSFs that vary over the field,
          shear the images by more than 0.05 pixels, or are for pixels smaller than the sky's.

    Warns
    -----
    LnoclWarning
        - Pixels are not finite and were masked.
        - Counts are negative and were set to zero.
        - Pixels of PSFs are negative, or their cores are a little off their centres.

    See Also
    --------
    lnocl.deconvolve : Reconstructs the sky from an observation.

    References
    ----------
    D. L. Snyder, A. M. Hammoud, R. L. White, J. Opt. Soc. Am. A 10, 1014 (1993), for the read
    noise; La Camera et al. (2012), Eq. 1 and 7, for the model.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> obs = lnocl.Observation(np.full((2, 8, 8), 5.0), np.ones((3, 3)), background=1.0)
    >>> obs.n_images, obs.shape, obs.psfs[0].sum()
    (2, (8, 8), np.float64(1.0))

    Read noise of 3 electrons adds 9 to images and background:

    >>> obs = lnocl.Observation(np.full((8, 8), 5.0), np.ones((3, 3)), read_noise=3.0)
    >>> obs.images.max(), obs.background
    (np.float64(14.0), array([9.]))
    """

    images: Array
    mask: NDArray[np.bool_]

    def __init__(
        self,
        images: ArrayLike,
        psfs: ArrayLike | PsfField | Sequence[PsfField],
        *,
        background: ArrayLike = 0.0,
        background_error: ArrayLike = 0.0,
        read_noise: ArrayLike = 0.0,
        mask: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        offsets: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        halos: ArrayLike | None = None,
        epochs: ArrayLike | None = None,
        oversample: int = 1,
        effective_psfs: bool = False,
        psf_centre: PsfCentre = "check",
        ideal_psfs: ArrayLike | None = None,
        pupils: ArrayLike | None = None,
        psf_modes: ArrayLike | None = None,
        psf_scatter: ArrayLike | None = None,
    ) -> None:
        shapes = shapes_of(images) if transforms is not None else []
        if len(set(shapes)) > 1:
            maps = {"background": background, "read_noise": read_noise, "exposure": exposure}
            for name, values in {**maps, "mask": mask}.items():
                refuse_other_shapes(name, values, shapes)
            images, mask = of_one_shape(images, np.nan), of_one_shape(mask, True)
            background, read_noise, exposure = map(of_one_shape, maps.values())
        own_psfs, psfs = shapes_of(psfs), of_one_shape(psfs, 0.0, about_centre=True)
        self._hold_oversample(oversample)
        self._hold_effective_psfs(effective_psfs)
        has_exposure = exposure is not None
        are_rates = self._hold_images(images, has_exposure, copy=True)
        variances = containers.variances("images", images, are_rates)
        if variances is not None:
            variances = variances.reshape(self.images.shape)
            self._add_to_mask(variances == 0)
        read_noise = self._deviations(read_noise)
        self._hold_mask(mask)
        self._mask_not_finite()
        self._hold_exposure(exposure)
        self._leave_out_bad_pixels()
        read_psfs = partial(_normalised_psfs, psf_centre=psf_centre)
        self._hold_psfs(psfs, partial(read_psfs, shapes=own_psfs))
        self._hold_pupils(pupils)
        self._hold_ideal_psfs(ideal_psfs, read_psfs)
        self._hold_psf_modes(psf_modes)
        self._hold_psf_scatter(psf_scatter)
        # With all bad pixels known: a map is fitted to the good ones of its image.
        self._hold_maps(offsets, transforms)
        self._hold_epochs(epochs)
        self._orientations: tuple[Orientation, ...] = ()
        self._given_shape = self.shape
        self._frame = self._shape_of_sky(shapes)
        with np.errstate(over="ignore"):
            if are_rates:
                self.images *= _each_pixel(self.exposure)
            self._hold_background(background, has_exposure)
            self._hold_background_error(background_error)
            self._hold_read_noise(read_noise)
            if variances is not None:
                self.read_noise = self._read_noise_of(
                    variances * _each_pixel(self.exposure) ** 2 if are_rates else variances
                )
            self._add_read_noise()
        self._hold_halos(halos)
        self._close()

    def __setattr__(self, name: str, value: object) -> None:
        if "_is_checked" in vars(self):
            raise AttributeError(
                f"an observation does not change; replace({name}=...) returns another"
            )
        super().__setattr__(name, value)

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes; one PSF for all images stays one where pickle would copy it."""
        is_shared = self.psfs.strides[0] == 0
        return {**vars(self), "psfs": self.psfs[:1] if is_shared else self.psfs}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        vars(self)["psfs"] = np.broadcast_to(self.psfs, (self.n_images, *self.psfs.shape[1:]))

    @property
    def n_images(self) -> int:
        """Number of images, p.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> lnocl.Observation(np.ones((2, 8, 8)), np.ones((3, 3))).n_images
        2
        """
        return self.images.shape[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (ny, nx) of each image.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> lnocl.Observation(np.ones((2, 8, 9)), np.ones((3, 3))).shape
        (8, 9)
        """
        return self.images.shape[1], self.images.shape[2]

    @property
    def sky_shape(self) -> tuple[int, int]:
        """Shape of the extended source: that of an image, times `oversample` along each axis.

        Of images of several shapes it is that whose `transforms` changes nothing.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> lnocl.Observation(np.ones((8, 9)), np.ones((3, 3)), oversample=2).sky_shape
        (16, 18)
        """
        return self.oversample * self._frame[0], self.oversample * self._frame[1]

    @property
    def n_epochs(self) -> int:
        """Number of epochs, in each of which stars have a flux."""
        return int(self.epochs.max()) + 1

    @property
    def is_turned(self) -> bool:
        """Whether any image is turned against the sky, or has other pixels."""
        return bool((self.turns != np.eye(2)).any())

    @property
    def scales(self) -> Array:
        """Pixels of the sky to one of each image, along each axis, by `turns`; shape (p,)."""
        return np.array([scale_of(turn) for turn in self.turns])

    def good_box(self, j: int) -> tuple[range, range]:
        """Return the rows and columns of image j that hold its good pixels; all if it has none."""
        good = ~self.mask[j]
        if not good.any():
            return range(self.shape[0]), range(self.shape[1])
        held = (np.flatnonzero(good.any(axis=axis)) for axis in (1, 0))
        rows, columns = (range(int(at[0]), int(at[-1]) + 1) for at in held)
        return rows, columns

    @property
    def transforms(self) -> Array:
        """The map from the sky to each image as given, shape (p, 2, 3), pixels."""
        if not self._orientations:
            return np.concatenate([self.turns, self.offsets[:, :, None]], axis=2)
        maps = np.empty((self.n_images, 2, 3))
        for j, orientation in enumerate(self._orientations):
            basis = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
            at = [orientation.place_back(each, self.shape) for each in self.places(j, basis)]
            maps[j] = np.array([at[1] - at[0], at[2] - at[0], at[0]]).T
        return maps

    @property
    def is_mapped(self) -> bool:
        """Whether any image is turned or flipped against the sky, as given."""
        return self.is_turned or bool(self._orientations)

    def places(self, j: int, positions: Array) -> Array:
        """Return where positions (..., 2) of the sky are in image j."""
        if (self.turns[j] == np.eye(2)).all():
            return positions + self.offsets[j]
        return np.asarray(positions @ self.turns[j].T + self.offsets[j])

    def upright(self) -> Observation:
        """Return the observation with quarter turns and flips of its images undone, by index.

        What is left of `turns` is by 45 degrees at most. Images that are not square are enlarged
        by bad pixels where a quarter turn asks for it.
        """
        nearest = [Orientation.nearest(turn) for turn in self.turns]
        orientations = tuple(orientation for orientation, _ in nearest)
        if all(orientation.is_identity for orientation in orientations):
            return self
        swaps = any(orientation.swaps for orientation in orientations)
        shape = (max(self.shape),) * 2 if swaps else self.shape
        other = copy(self)
        held = vars(other)
        for name, values in self._arrays().items():
            if name == "turns" or values.ndim < 3 or not values.size:
                continue
            if name == "halos":  # whose first axis is not that of the images
                values = np.moveaxis(values, 1, 0)
            if name in ("psfs", *BESIDE_PSFS):
                values = _about_centre(values, swaps)
            else:
                values = enlarged(values, shape, float(name == "mask"))
            pairs = zip(orientations, values, strict=True)
            upright = np.array([orientation.of(array) for orientation, array in pairs])
            held[name] = np.moveaxis(upright, 0, 1) if name == "halos" else upright
            held[name].flags.writeable = False
        places = zip(orientations, self.offsets, strict=True)
        held["offsets"] = np.array([each.place(at, shape) for each, at in places])
        left = np.array([rotation(angle) for _, angle in nearest])
        held["turns"] = left / self.scales[:, None, None]
        held["_orientations"] = orientations
        return other

    def as_given(self, images: NDArray[Any], cut: bool = True) -> NDArray[Any]:
        """Return images (p, ny, nx) of `upright` in the orientation of those given.

        They are cut to the shape of the images unless told otherwise.
        """
        if not self._orientations:
            return images
        ny, nx = self._given_shape if cut else images.shape[1:]
        pairs = zip(self._orientations, images, strict=True)
        return np.array([orientation.back(image)[:ny, :nx] for orientation, image in pairs])

    def replace(self, **changes: Any) -> Observation:
        """Return an observation with some parameters replaced, checked as before; the rest is kept.

        Values are as the attributes hold them: the square of the read noise is in images and
        background, and PSFs are neither normalised nor moved. Images become 0 where a pixel is bad.

        Parameters
        ----------
        **changes : array_like, int, bool or None
            Values by the name of a parameter of `Observation`; any but `psf_centre`. Images and
            PSFs in arrays of float64 are not copied, so leave them as they are. None stands for the
            default. New `pupils` bring their own `ideal_psfs`.

        Returns
        -------
        Observation
            Another observation.

        Raises
        ------
        InputError
            - A name is not that of a parameter.
            - A value is refused as by `Observation`, alone or beside what is kept. What has another
              shape than before is to be replaced with all that belongs to it.
            - `images` have an uncertainty, or are per time.
            - `mask` has less bad pixels than before, and what these hold is not replaced.

        Warns
        -----
        LnoclWarning
            As `Observation`.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> obs = lnocl.Observation(np.full((2, 8, 8), 5.0), np.ones((3, 3)))
        >>> other = obs.replace(psfs=np.ones((2, 1, 1)))
        >>> other.psfs.shape, obs.psfs.shape, np.shares_memory(other.images, obs.images)
        ((2, 1, 1), (2, 3, 3), True)
        """
        if unknown := sorted(changes.keys() - {*PARAMETERS, *MOVES}):
            raise InputError(
                f"`{unknown[0]}` cannot be replaced in an observation; what can is "
                f"{', '.join((*PARAMETERS, *MOVES))}"
            )
        if containers.variances("images", changes.get("images"), False) is not None:
            raise InputError("`images` with an uncertainty replace none; give `read_noise` too")
        other = copy(self)
        del vars(other)["_is_checked"]
        if "mask" in changes:
            other.mask = np.zeros(self.mask.shape, bool)
        if changes.get("pupils") is not None:
            changes = {"ideal_psfs": None, **changes}
        for name in PARAMETERS:
            if name in changes:
                getattr(other, f"_hold_{name}")(changes[name])
            elif other._is_of_other_shape(name, self):
                values: Any = getattr(self, name)
                if name == "psfs" and self.psf_fields:
                    values = self.psf_fields
                getattr(other, f"_hold_{name}")(values if np.size(values) else None)
        other._mask_not_finite()
        other._replace_maps(self, changes)
        other._refuse_freed_pixels(self, changes)
        other._leave_out_bad_pixels()
        if len(other.halos) and other.mask is not self.mask:
            other._hold_halos(other.halos)
        if other.shape != self.shape and not other._orientations:
            other._given_shape = other._frame = other.shape
        other._close()
        return other

    def _is_of_other_shape(self, name: str, before: Observation) -> bool:
        """Return whether what a parameter belongs to has another shape than before."""
        if name in ("oversample", "effective_psfs", "images"):
            return False
        is_other = self.images.shape != before.images.shape
        return is_other or (name in BESIDE_PSFS and self.psfs.shape != before.psfs.shape)

    def _replace_maps(self, before: Observation, changes: dict[str, Any]) -> None:
        """Hold the offsets or transforms of changes, or those before beside what is changed."""
        if before._orientations and "transforms" in changes:
            raise InputError("the images were turned upright; give `transforms` to an Observation")
        maps = np.concatenate([before.turns, before.offsets[:, :, None]], axis=2)
        transforms = changes.get("transforms", maps if before.is_mapped else None)
        is_kept = transforms is None and "transforms" not in changes
        if changes.keys() & set(MOVES) or self._is_of_other_shape("transforms", before):
            offsets = changes.get("offsets", before.offsets if is_kept else None)
            self._hold_maps(offsets, transforms)
        elif transforms is not None:
            self._refuse_beside_transforms()
            self._refuse_one_psf_for_scales()

    def _refuse_freed_pixels(self, before: Observation, changes: dict[str, Any]) -> None:
        """Refuse to take pixels for good again of which nothing is held."""
        if self.mask.shape != before.mask.shape:
            return
        n_freed = int(np.count_nonzero(before.mask & ~self.mask))
        maps = [name for name in ("images", *MAPS) if getattr(before, name).ndim == 3]
        if n_freed and (missing := [f"`{name}`" for name in maps if name not in changes]):
            raise InputError(
                f"`mask` frees {counted(n_freed, 'pixel')} of which nothing is held; give "
                f"{', '.join(missing)} with it"
            )

    def shows(self, positions: Array) -> NDArray[np.bool_]:
        """Return which positions, shape (n, 2), lie within any image, its offset added."""
        places = np.stack([self.places(j, positions) for j in range(self.n_images)], axis=1)
        size = np.array(self.shape[::-1])
        return np.asarray(np.any(np.all((places >= -0.5) & (places < size - 0.5), axis=2), axis=1))

    def window(
        self, rows: range, columns: range, middle: tuple[float, float] | None = None
    ) -> Observation:
        """Return the observation cut to some rows and columns; positions begin at their corner.

        PSFs that vary are those of a place (x, y) there, by default of its middle.
        """
        other, inside = copy(self), np.s_[..., rows.start : rows.stop, columns.start : columns.stop]
        held = vars(other)
        del held["_is_checked"]
        for name in ("images", "mask", "halos", *MAPS):
            if getattr(self, name).ndim > 2:
                held[name] = getattr(self, name)[inside]
        if self.psf_fields:
            fields = tuple(field.moved(-columns.start, -rows.start) for field in self.psf_fields)
            x, y = middle or ((len(columns) - 1) / 2.0, (len(rows) - 1) / 2.0)
            other.psf_fields, other.psfs = fields, np.array([field.at(x, y) for field in fields])
        if not other._orientations:
            other._given_shape = other._frame = other.shape
        other._leave_out_bad_pixels()
        refuse_dark(other.halos, other.mask)
        other._close()
        return other

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: each for name, each in vars(self).items() if isinstance(each, np.ndarray)}

    @property
    def nbytes(self) -> int:
        """Bytes that its arrays take."""
        arrays = self._arrays()
        if self.psfs.strides[0] == 0:  # one for all images
            arrays["psfs"] = self.psfs[:1]
        return sum(array.nbytes for array in arrays.values())

    def _repr_html_(self) -> str:
        """Return a table for a notebook, with a thumbnail of the first image."""
        ny, nx = self.shape
        rows = {
            "images": f"{self.n_images} of {nx} x {ny} pixels",
            "PSFs": f"{' x '.join(map(str, self.psfs.shape[:0:-1]))} pixels",
            "background": _range(self.background),
            "read noise": f"{_range(self.read_noise)}, its square in images and background",
            "bad pixels": f"{100 * self.mask.mean():.2g} %",
        }
        if (self.exposure != 1.0).any():
            rows["exposure"] = _range(self.exposure)
        if len(self.halos):
            rows["halos"] = f"{len(self.halos)}, fitted in each image"
        image = np.where(self.mask[0], np.nan, self.images[0])
        return html_card("lnocl.Observation", rows, image)

    def _hold_oversample(self, oversample: object) -> None:
        if not (isinstance(oversample, (int, np.integer)) and oversample in OVERSAMPLES):
            raise InputError(f"`oversample` must be 1, 2 or 4; {oversample} was given")
        self.oversample = int(oversample)

    def _hold_effective_psfs(self, effective_psfs: object) -> None:
        self.effective_psfs = flag("effective_psfs", effective_psfs)

    def _hold_images(
        self, images: ArrayLike, has_exposure: bool | None = None, copy: bool = False
    ) -> bool:
        """Hold images and where they are masked; return whether they are counts per time."""
        counts, are_rates = containers.counts("images", images, has_exposure)
        given, masked = values_and_mask("images", counts)
        n_before = len(self.images) if "images" in vars(self) else 0
        self.images = _stack("images", given, n_before, copy)
        if "mask" not in vars(self) or self.mask.shape != self.images.shape:
            self.mask = np.zeros(self.images.shape, bool)
        self._add_to_mask(masked.reshape(self.images.shape))
        return are_rates

    def _add_to_mask(self, bad: NDArray[np.bool_]) -> None:
        if (bad & ~self.mask).any():
            self.mask = self.mask | bad

    def _hold_mask(self, mask: ArrayLike | None) -> None:
        if mask is None:
            return
        given = booleans("mask", mask)
        if given.shape not in (self.images.shape, self.shape):
            raise InputError(f"`mask` has shape {given.shape}; the images have {self.images.shape}")
        self._add_to_mask(given)

    def _mask_not_finite(self) -> None:
        not_finite = ~np.isfinite(self.images) & ~self.mask
        if n_not_finite := int(not_finite.sum()):
            self._add_to_mask(not_finite)
            warn(_pixels(n_not_finite, "image", "not finite", "masked"))

    def _leave_out_bad_pixels(self) -> None:
        """Refuse images without a good pixel, and hold 0 in bad ones."""
        if self.mask.all():
            raise InputError(
                "all pixels are masked; a mask is True, or not 0, where a pixel is bad: turn it "
                "round if it marks the good ones"
            )
        if self.images[self.mask].any():
            self.images = np.where(self.mask, 0.0, self.images)

    def _hold_psfs(self, psfs: Any, read: Callable[[ArrayLike, int], Array] | None = None) -> None:
        """Hold PSFs, or fields of them, as `read` returns them."""
        read = read or _read_psfs
        fields = read_fields(psfs, self.n_images, self.oversample, self.effective_psfs)
        self.psf_fields = tuple(
            field.mapped(lambda stack: np.array(read(stack, len(stack)))) for field in fields
        )
        if fields:
            y, x = (np.array(self.shape) - 1) / 2.0
            self.psfs = np.array([field.at(x, y) for field in self.psf_fields])
        else:
            self.psfs = read(bare("psfs", psfs), self.n_images)

    def _hold_pupils(self, pupils: ArrayLike | None) -> None:
        self.pupils = check_pixels("pupils", pupils, self.psfs)

    def _hold_ideal_psfs(
        self, ideals: ArrayLike | None, read: Callable[[ArrayLike, int], Array] | None = None
    ) -> None:
        if ideals is None and len(self.pupils):
            from lnocl.scene.pupils import Pupil  # which loads scipy

            self.ideal_psfs = np.array([Pupil(pupil).ideal_psf() for pupil in self.pupils])
            return
        if ideals is None:
            self.ideal_psfs = np.zeros((0, *self.psfs.shape[1:]))
            return
        checked = (read or _read_psfs)(bare("ideal_psfs", ideals), self.n_images)
        if checked.shape != self.psfs.shape:
            raise InputError(
                f"`ideal_psfs` has PSFs of shape {checked.shape[1:]}, psfs of "
                f"{self.psfs.shape[1:]}; give them in one shape"
            )
        self.ideal_psfs = checked

    def _hold_psf_modes(self, modes: ArrayLike | None) -> None:
        self.psf_modes = check_modes(modes, self.psfs)

    def _hold_psf_scatter(self, scatter: ArrayLike | None) -> None:
        self.psf_scatter = check_pixels("psf_scatter", scatter, self.psfs)

    def _hold_halos(self, halos: ArrayLike | None) -> None:
        self.halos = check_halos(halos, self.mask)

    def _hold_exposure(self, exposure: ArrayLike | None) -> None:
        """Hold the exposures, and mask pixels of no exposure."""
        given = containers.seconds(1.0 if exposure is None else exposure)
        values = self._one_or_map("exposure", given, 1.0)
        _refuse_out_of_range("exposure", values)
        if values.ndim == 3:
            self._add_to_mask(values == 0)
        self.exposure = values

    def _hold_background(self, background: ArrayLike, has_exposure: bool | None = None) -> None:
        given, are_rates = containers.counts("background", background, has_exposure)
        values = self._one_or_map("background", given, 0.0)
        _refuse_out_of_range("background", values)
        if are_rates:
            if values.ndim < self.exposure.ndim:
                values = _each_pixel(values)
            values = values * (_each_pixel(self.exposure) if values.ndim == 3 else self.exposure)
        self.background = values

    def _hold_background_error(self, background_error: ArrayLike) -> None:
        given = containers.counts("background_error", background_error)[0]
        values = self._one_or_map("background_error", given, 0.0)
        _refuse_out_of_range("background_error", values)
        if values.ndim == 3:
            raise InputError("`background_error` is that of a level; give a number for each image")
        self.background_error = values

    def _deviations(self, read_noise: Any) -> Any:
        """Return the standard deviations of an uncertainty, and mask pixels where it has none."""
        if not is_uncertainty(read_noise):
            return read_noise
        sigma = containers.deviations("read_noise", read_noise)
        if np.shape(sigma) in (self.images.shape, self.shape):
            self._add_to_mask(np.equal(sigma, 0))
        return sigma

    def _hold_read_noise(self, read_noise: ArrayLike) -> None:
        given = containers.counts("read_noise", self._deviations(read_noise))[0]
        sigma = self._one_or_map("read_noise", given, 0.0)
        _refuse_out_of_range("read_noise", sigma)
        with np.errstate(over="ignore"):
            _refuse_unless("the square of `read_noise`", sigma**2, "finite", sigma >= 0)
        self.read_noise = sigma

    def _read_noise_of(self, variances: Array) -> Array:
        """Return the noise of images beyond that of their counts, by their uncertainty."""
        if self.read_noise.any():
            raise InputError(
                "give `read_noise`, or images with their uncertainty, which includes it, not both"
            )
        return without_source(variances, self.images, self.mask)

    def _add_read_noise(self) -> None:
        variance = self.read_noise**2
        if variance.any():
            np.add(self.images, _each_pixel(variance), out=self.images, where=~self.mask)
        if variance.ndim != self.background.ndim:
            variance, self.background = _each_pixel(variance), _each_pixel(self.background)
        self.background = self.background + variance

    def _refuse_overflow(self) -> None:
        for name, values in (("images", self.images), ("background", self.background)):
            if not (values <= MAX_COUNTS).all():
                raise InputError(
                    f"the {name}, with `exposure` and the square of `read_noise`, must be at most "
                    f"{MAX_COUNTS:g} electrons per pixel: divide the counts and `read_noise` by a "
                    "constant"
                )

    def _one_or_map(self, name: str, given: ArrayLike, masked: float) -> Array:
        """Return one number for each image, or for each pixel: one map serves all images."""
        array, masked_there = values_and_mask(name, given)
        if array.shape in (self.images.shape, self.shape):
            bad = self.mask if array.ndim == 3 else self.mask.all(axis=0)
            masked_there = masked_there & ~bad  # a new array: it may be the caller's
        refuse_masked(name, masked_there)
        values = numbers(name, array, copy=False)
        if values.ndim < 2:
            return _one_each(name, values, self.n_images)
        if values.shape not in (self.images.shape, self.shape):
            raise InputError(
                f"`{name}` has shape {values.shape}; the images have {self.images.shape}"
            )
        return np.where(self.mask, masked, values)

    def _hold_epochs(self, epochs: ArrayLike | None) -> None:
        if epochs is None:
            epochs = np.zeros(self.n_images)
        labels, masked = values_and_mask("epochs", epochs)
        refuse_masked("epochs", masked)
        if labels.shape != (self.n_images,):
            raise InputError(
                f"`epochs` has shape {labels.shape}; give a label for each of the "
                f"{self.n_images} images"
            )
        if (labels != labels).any():
            raise InputError("`epochs` holds a label that is not a number; give one, or a name")
        try:
            numbered = np.unique(labels, return_inverse=True)[1]
        except TypeError:
            kinds = sorted({type(label).__name__ for label in labels.tolist()})
            raise InputError(
                f"`epochs` holds labels without an order, of {' and '.join(kinds)}; give numbers "
                "alone, or text alone"
            ) from None
        self.epochs = numbered.astype(np.intp)

    def _hold_maps(self, offsets: ArrayLike | None, transforms: ArrayLike | None) -> None:
        """Hold the rotations and the shifts of the images."""
        if transforms is None:
            self.turns = np.broadcast_to(np.eye(2), (self.n_images, 2, 2))
            self.offsets = self._check_offsets(offsets)
            return
        self._refuse_beside_transforms(offsets is not None)
        exact = check_transforms(transforms, [self.good_box(j) for j in range(self.n_images)])
        self.turns, self.offsets = exact[:, :, :2].copy(), exact[:, :, 2].copy()
        self._refuse_one_psf_for_scales()

    def _refuse_beside_transforms(self, has_offsets: bool = False) -> None:
        for name, is_given in (
            ("offsets", has_offsets),
            ("oversample", self.oversample > 1),
            ("PSFs that vary over the field", bool(self.psf_fields)),
        ):
            if is_given:
                raise InputError(f"`transforms` are not taken beside {name}; give one of them")

    def _refuse_one_psf_for_scales(self) -> None:
        low, high = min(self.scales), max(self.scales)
        if self.n_images > 1 and self.psfs.strides[0] == 0 and low < high:
            raise InputError(
                f"one PSF is given for images whose pixels are {low:.4g} and {high:.4g} times the "
                "sky's; give one for each image, on its own pixels"
            )

    def _shape_of_sky(self, shapes: Sequence[tuple[int, int]]) -> tuple[int, int]:
        """Return the shape of the image whose pixels the sky has, of images of several shapes."""
        whole = np.eye(2, 3)
        maps = np.concatenate([self.turns, self.offsets[:, :, None]], axis=2)
        own = (shape for shape, each in zip(shapes, maps, strict=False) if (each == whole).all())
        return next(own, self.shape)

    def _check_offsets(self, offsets: ArrayLike | None) -> Array:
        if offsets is None:
            return np.zeros((self.n_images, 2))
        values = numbers("offsets", offsets, unit="pix")
        if values.shape != (self.n_images, 2):
            raise InputError(
                f"offsets has shape {values.shape}; give (dx, dy) for each of the "
                f"{self.n_images} images"
            )
        size = np.array(self.shape[::-1])
        _refuse_unless(
            "`offsets`",
            values,
            f"finite, and less than the images' {size[0]} by {size[1]} pixels",
            abs(values) < size,
        )
        return values

    def _close(self) -> None:
        """Refuse counts out of range, and hold all arrays as they are from now on."""
        self._refuse_overflow()
        self._clip_negative()
        for name, values in self._arrays().items():
            if values.flags.writeable:  # the array itself may be the caller's
                vars(self)[name] = values.view()
                vars(self)[name].flags.writeable = False
        self._is_checked = True

    def _clip_negative(self) -> None:
        if n_negative := int((self.images < 0).sum()):
            self.images = np.maximum(self.images, 0.0)
            words = _pixels(n_negative, "image", "negative", "set to 0")
            if self.read_noise.any():
                warn(f"{words}, with the square of `read_noise` added")
                return
            warn(
                f"{words}; if the sky was subtracted, give the noise that it left as `read_noise`, "
                "or add the sky to the images and give it as `background`"
            )


def mean_exposure(observation: Observation) -> float:
    """Return the mean of the exposures, of good pixels where they are maps.

    Raises
    ------
    InputError
        They are too large to be summed.
    """
    exposures = observation.exposure
    with np.errstate(over="ignore"):
        seen = exposures[~observation.mask] if exposures.ndim == 3 else exposures
        mean = float(seen.mean())
    if not np.isfinite(mean):
        raise InputError("the exposures are too large to be summed: divide them by a constant")
    return mean


def _range(values: Array) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.5g}" if low == high else f"{low:.5g} to {high:.5g}"


def _stack(name: str, values: ArrayLike, n_images: int = 0, copy: bool = True) -> Array:
    """Return one or several two-dimensional arrays as a stack; several may be one for each image.

    They are in float64, and copied unless that is not asked for.
    """
    array = numbers(name, values, copy)
    if array.ndim not in (2, 3):
        raise InputError(
            f"`{name}` has {counted(array.ndim, 'dimension')}; give two, or three for several "
            f"`{name}`"
        )
    if array.size == 0:
        raise InputError(f"`{name}` is empty: its shape is {array.shape}")
    may_be_colours = array.ndim == 3 and len(array) != n_images
    if may_be_colours and array.shape[2] <= MAX_CHANNELS and min(array.shape[:2]) >= MIN_SIDE:
        raise InputError(
            f"`{name}` has shape {array.shape}, but its axes are (p, ny, nx): of colours give one, "
            f"{name}[:, :, 0]; if they are of one sky, np.moveaxis({name}, -1, 0)"
        )
    return array.reshape((-1, *array.shape[-2:]))


def _pixels(n: int, kind: str, state: str, remedy: str) -> str:
    """Return a sentence on pixels that agrees in number."""
    noun, are, were = ("pixel", "is", "was") if n == 1 else ("pixels", "are", "were")
    return f"{n} {kind} {noun} {are} {state} and {were} {remedy}"


def _each_pixel(values: Array) -> Array:
    """Return values that broadcast over images."""
    return values if values.ndim == 3 else values[:, None, None]


def _one_each(name: str, values: Array, n_images: int) -> Array:
    if values.ndim > 1 or values.size not in (1, n_images):
        raise InputError(
            f"`{name}` has shape {values.shape}; give one number, or one for each of the "
            f"{n_images} images"
        )
    return np.array(np.broadcast_to(values, (n_images,)))


def _refuse_unless(name: str, values: Array, requirement: str, holds: NDArray[np.bool_]) -> None:
    good = holds & np.isfinite(values)
    if not good.all():
        raise InputError(f"{name} must be {requirement}; {values[~good].flat[0]:g} was given")


def _refuse_out_of_range(name: str, values: Array) -> None:
    if name == "exposure" and values.ndim == 1:
        _refuse_unless(f"`{name}`", values, "finite and more than zero", values > 0)
    else:
        _refuse_unless(f"`{name}`", values, "finite and not negative", values >= 0)


def _about_centre(psfs: Array, is_square: bool) -> Array:
    """Return PSFs enlarged about their centre to odd sides, whose middle it is."""
    ky, kx = psfs.shape[-2:]
    ny, nx = (k + 1 - k % 2 for k in ((max(ky, kx),) * 2 if is_square else (ky, kx)))
    y, x = ny // 2 - ky // 2, nx // 2 - kx // 2
    laid = np.zeros((*psfs.shape[:-2], ny, nx))
    laid[..., y : y + ky, x : x + kx] = psfs
    return laid


def _read_psfs(psfs: ArrayLike, n_images: int, copy: bool = False) -> Array:
    """Return PSFs with light, finite, one for each image; copied where that is asked for."""
    stack = _stack("psfs", psfs, n_images, copy)
    if stack.shape[0] not in (1, n_images):
        raise InputError(
            f"{counted(len(stack), 'psf')} for {counted(n_images, 'image')}; give one, or one for "
            "each image"
        )
    if (bad := ~np.isfinite(stack)).any():
        j, y, x = np.argwhere(bad)[0]
        raise InputError(
            f"`psfs[{j}]` is not finite in {counted(int(bad[j].sum()), 'pixel')}, the first at "
            f"({x}, {y}): interpolate, or make it of the star's frame with lnocl psf"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        sums = stack.sum(axis=(1, 2), keepdims=True)
        sizes = np.array([abs(psf).sum(keepdims=True) for psf in stack])
        # Rounding leaves a sum where values cancel; what overflows is not above itself.
        unusable = ~(sums > np.finfo(np.float64).eps * sizes)
    if unusable.any():
        j = int(np.argmax(unusable))
        raise InputError(
            f"`psfs[{j}]` has the sum {sums.flat[j]:g}; it must be positive, finite and more than "
            "the rounding of its values: give another, or subtract less of a background from it"
        )
    return stack if copy else np.broadcast_to(stack, (n_images, *stack.shape[1:]))


def _normalised_psfs(
    psfs: ArrayLike,
    n_images: int,
    psf_centre: str,
    shapes: Sequence[tuple[int, int]] = (),
) -> Array:
    """Return PSFs of unit sum, their cores at their centres where asked for.

    Those that were enlarged from their own shapes are moved within these.
    """
    stack = _read_psfs(psfs, n_images, copy=True)
    stack /= stack.sum(axis=(1, 2), keepdims=True)
    if n_negative := int((stack < 0).sum()):
        share = float(-stack.clip(max=0.0).sum(axis=(1, 2)).min())
        tell = warn if share > MUCH_NEGATIVE else note
        words = _pixels(n_negative, "psf", "negative", "kept")
        tell(f"{words}: {100 * share:.2g} % of the light of a PSF at most")
    if psf_centre == "fit":
        for psf, shape in zip(stack, shapes or [stack.shape[1:]] * len(stack), strict=True):
            own = about_centre(psf, shape)
            own[:] = _centred(own)
    elif psf_centre == "check":
        _refuse_off_centre(stack)
    elif psf_centre != "given":
        raise InputError(f"`psf_centre` {psf_centre!r} is not known; choose from check, fit, given")
    return np.broadcast_to(stack, (n_images, *stack.shape[1:]))


def _refuse_off_centre(psfs: Array) -> None:
    """Refuse PSFs whose core lies far off their centre, and warn of those a little off."""
    offsets = np.array([off_centre(psf) for psf in psfs])
    distances = np.hypot(*offsets.T)
    j = int(np.argmax(distances))
    if distances[j] < LITTLE_OFF_CENTRE:
        return
    (dx, dy), (y, x) = offsets[j], centre(psfs.shape[1:])
    words = (
        f"the core of `psfs[{j}]` lies ({dx:z.2f}, {dy:z.2f}) pixels off its centre ({x}, {y}), "
        "and would move the sky by as much: take `psf_centre` fit to centre it"
    )
    if distances[j] >= FAR_OFF_CENTRE:
        raise InputError(f"{words}, or `psf_centre` given if it is to be there")
    warn(words)


def _centred(psf: Array) -> Array:
    """Return a PSF moved so that its core lies at its centre, what leaves one edge at the other."""
    y, x = centre(psf.shape)
    whole = [n - at for n, at in zip((y, x), peak(psf), strict=True)]
    psf = np.roll(psf, whole, axis=(0, 1))
    dx, dy = off_centre(psf)
    return place(psf, psf.shape, x - dx, y - dy).on_grid(psf.shape)
