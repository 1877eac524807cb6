"""Several images of one sky, with PSFs, noise and masks; all input is checked here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, together
from lnocl.core.scene.components import Mixing
from lnocl.core.scene.containers import variances
from lnocl.core.scene.counts import refuse_overflow, without_negative
from lnocl.core.scene.fields import (
    FIELDS,
    hold,
    in_one_shape,
    noise_beyond_counts,
    refuse_all_bad,
)
from lnocl.core.scene.geometry import MOVES, Box, Geometry, good_box
from lnocl.core.scene.halos import refuse_dark
from lnocl.core.scene.psf_field import PsfField, Psfs
from lnocl.core.scene.psfs import (
    MadePsf,
    PsfCentre,
    at_middle,
    normalised,
    own,
    without_errors,
)
from lnocl.core.scene.quantities import coordinates
from lnocl.core.scene.transforms import of_one_shape, shapes_of
from lnocl.errors import InputError, counted
from lnocl.notebook import html_card

# What goes with PSFs, and is left out where they are cut.
BESIDE_PSFS = tuple(
    name
    for name, field in FIELDS.items()
    if field.axes == "psf" and name not in ("psfs", "star_psfs")
)

# What runs of a filter's images mend, and those of all take over.
JOINED = "psfs", "psf_scatter", "background"


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
    psfs : array_like, shape (p, ky, kx) or (ky, kx), StarPsf or PsfField
        Point spread functions, with their centres at ``(ky // 2, kx // 2)``. One serves all images.
        Their sums are positive and are normalised to 1. Negative pixels stay, with a warning. Those
        that `lnocl.psf.make_psf` returns, one or a list in which arrays may be too, bring their
        `psf_scatter`, unless `psf_error` is 0. A
        `lnocl.PsfField` or a `photutils.psf.GriddedPSFModel`, or one for each image, holds PSFs
        that vary over the image. Each star then has the PSF of its own place. The extended source
        has that of the middle; `lnocl.deconvolve_tiles` has one for each tile.
    background : float or array_like, shape (p,) or (p, ny, nx), optional
        Background, electrons per pixel, zero or more. A Quantity may be per time.
    background_error : float or array_like, shape (p,), optional
        Standard error of the level of `background`, electrons per pixel; 0 where it is known. Where
        it is more, `lnocl.deconvolve` fits the level with the rest, and a gradient of it
        (`lnocl.core.solvers.levels`).
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
        on their pixels, and hold what a pixel collects. With `oversample` sky and PSFs are finer,
        and the maps those between pixels of images still. Images, and PSFs, of several shapes may
        be given as lists of arrays, and maps with them; bad pixels are added to smaller ones.
    transmission : array_like, shape (p, Ny, Nx) or (Ny, Nx), optional
        Share of the light of each pixel of the sky that each image gets, 0 to 1, before the PSF
        spreads it: that of a coronagraph, or of vignetting on the sky. One serves all images. The
        sky and the fluxes of stars are those before it. What is behind less than 0.01 in all images
        is left out, stars and sky, but for stars with PSFs of their own. What dims the
        light after the PSF, as bad pixels do, is an `exposure`.
    halos : array_like, shape (n, p, ny, nx), (n, 1, ny, nx), (p, ny, nx) or (ny, nx), optional
        Light of known shape and unknown amount, such as the speckles of a star behind a
        coronagraph: n shapes in each image, or one in each, or one for all images. Finite and zero
        or more where a pixel is good, and not zero everywhere. Only the shape counts. The amount in
        each image is fitted with the stars and the extended source, and is zero or more. A flat
        halo, ``np.ones((ny, nx))``, is a level of the background that is fitted in each image.
    epochs : array_like, shape (p,), optional
        The epoch of each image, such as its night: numbers or text. Stars have a flux in each
        epoch, the rest of the sky is common. By default all images are of one epoch.
    components : mapping of str to array_like, shape (p,), optional
        Skies of which each image shows a known mixture, by their names, with the weight that each
        has in each image: ``{"line": [1, 0], "continuum": [1, 1]}`` for an image in a line and one
        beside it. Weights are 0, or from 1e-6 to 1e6, and tell the 2 to 64 components apart. The
        extended source is a sky for each component, in electrons per pixel of an image of weight 1.
        Stars have a flux in each filter, that is in images of equal weights.
    component_errors : mapping of str to array_like, shape (p,), optional
        Standard errors of these weights, by name; 0 where none is given. They are in the errors of
        the light of components.
    oversample : {1, 2, 4}, optional
        Pixels of the sky, and of the PSFs, to one of the images along each axis. More than 1 is for
        detectors with fewer than two pixels to the PSF's width, where offsets of fractions of a
        pixel add resolution.

        The model of a pixel is the sum over its pixels of the sky. Positions and offsets stay in
        pixels of the images.
    effective_psfs : bool, optional
        Whether each sample of the PSFs holds the light that a pixel of the images collects, as in
        effective PSFs of photutils and STDPSF files. Otherwise it holds what a pixel of the PSF
        collects, as in STPSF's OVERSAMP and OVERDIST. Without `oversample` both are the same.
    psf_centre : {"check", "fit", "given"}, optional
        Treatment of a PSF whose core lies off its centre, (ky // 2, kx // 2), and which would move
        the sky: "check" refuses it where it is off by 0.8 pixels or more, and warns from 0.25 on;
        "fit" moves it to its centre (`lnocl.core.scene.shifting.place`); "given" leaves it as it
        is.
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
        of PSFs of unit sum; 0 where nothing is. It is in the errors of stars and regions. Where
        `psf_error` is 0, the extended source is smoothed near stars by it, and ``refine_psfs``
        "pixels" keeps to it. By default that of PSFs of `lnocl.psf.make_psf`.
    psf_error : float, optional
        Relative error that the PSFs may have in their width, one standard deviation, 0 to 0.3;
        0 for exact PSFs, as in simulations. What else they may have wrong follows it
        (`lnocl.core.solvers.psf_errors`): blur along each axis, wings, shifts, single pixels, zero
        points of images. All of it is in the errors of stars, and what these show of it is taken
        into the PSFs of the reconstruction. By default 0.03, as real PSFs have
        (:doc:`/validation/psf_priors`), or what PSFs of ``lnocl psf`` bring, less where these are
        of several stars.
    star_psfs : array_like, shape (n, p, ky, kx), (p, ky, kx) or (ky, kx), optional
        PSFs of their own of the stars at `star_places`, such as one behind the mask of a
        coronagraph. All else has `psfs`: other stars, the extended source and what is tested. They
        are in the axes of the images, of any shape, each with its star at ``(ky // 2, kx // 2)``.
        They are neither normalised nor moved. Their sum is the share of the star's light that an
        image shows, 1 without a mask; so the flux of the star is what it has beside the mask, in
        the unit of `psfs`.
    star_places : array_like, shape (n, 2) or (2,), optional
        ``(x, y)`` of these stars, as they are given to `lnocl.deconvolve`: each PSF is that of the
        nearest star, which lies within half a pixel.

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
    transmission : ndarray of float64, shape (p, Ny, Nx)
        As given; of shape (0, 0, 0) where it was not.
    halos : ndarray of float64, shape (n, p, ny, nx)
        Of unit sum in each image, 0 where a pixel is bad; n is 0 where none were given.
    epochs : ndarray of int, shape (p,)
        The number of each image's epoch, from 0 on, in the order of the labels.
    epoch_labels : tuple of str
        The label of each epoch.
    components, component_errors : ndarray of float64, shape (p, K)
        Weights, and their standard errors; K is 0 where there is one sky.
    component_names : tuple of str
        Their K names.
    oversample : int
        As given.
    effective_psfs : bool
        As given.
    psf_error : float
        As given.
    ideal_psfs, pupils, psf_scatter : ndarray of float64, shape (p, ky, kx) or (0, ky, kx)
        As given; of length 0 where they were not.
    psf_modes : ndarray of float64, shape (p, n, ky, kx)
        As given; n is 0 where they were not.
    star_psfs : ndarray of float64, shape (n, p, ky, kx)
        As given; n is 0 where they were not.
    star_places : ndarray of float64, shape (n, 2)
        As given.
    wcs : astropy.wcs.WCS or None
        The coordinates of the sky: those of the first image, an NDData or CCDData, whose pixels
        the sky has.

    Raises
    ------
    InputError
        - `oversample` is not 1, 2 or 4, or `effective_psfs` is not True or False.
        - An array has the wrong shape, type or unit, is empty, or holds values out of range.
        - An array other than `images` holds masked values.
        - Images have an uncertainty that is below the noise of their counts in most pixels, of a
          class without a variance, or beside read noise.
        - A PSF or its sum is not finite, its sum is not positive, or its core is off its centre.
        - `star_psfs` and `star_places` are not of as many stars, two places are within a pixel, or
          the sum of a PSF is more than 1.
        - Images or background exceed 1e30 electrons in a pixel, with exposure and read noise.
        - No good pixel is left, or an offset leaves nothing of an image.
        - `psf_error` is not from 0 to 0.3, or `psf_centre` is not one of its three.
        - A halo is 0 on all good pixels of an image.
        - `transmission` is not of the sky's shape, out of range, or 0 everywhere in the images that
          have good pixels.
        - Weights of `components` are out of range, or do not tell these apart.
        - A label of `epochs` is missing or not a number, or the labels have no order.
        - `transforms` are given beside `offsets`, or shear the images by more than 0.05 pixels.
        - Pixels of an image are smaller than those of the sky, by its transform.

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
    exposure: Array
    psfs: Array
    psf_fields: tuple[PsfField, ...]
    pupils: Array
    ideal_psfs: Array
    psf_modes: Array
    psf_scatter: Array
    psf_error: float
    star_places: Array
    star_psfs: Array
    components: Array
    component_errors: Array
    component_names: tuple[str, ...]
    epochs: NDArray[np.intp]
    epoch_labels: tuple[str, ...]
    background: Array
    background_error: Array
    read_noise: Array
    halos: Array
    transmission: Array
    oversample: int
    effective_psfs: bool
    geometry: Geometry
    wcs: Any

    def __init__(
        self,
        images: ArrayLike,
        psfs: ArrayLike | PsfField | Sequence[PsfField] | MadePsf | Sequence[MadePsf | ArrayLike],
        *,
        background: ArrayLike = 0.0,
        background_error: ArrayLike = 0.0,
        read_noise: ArrayLike = 0.0,
        mask: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        offsets: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        halos: ArrayLike | None = None,
        transmission: ArrayLike | None = None,
        epochs: ArrayLike | None = None,
        components: Mapping[str, ArrayLike] | None = None,
        component_errors: Mapping[str, ArrayLike] | None = None,
        oversample: int = 1,
        effective_psfs: bool = False,
        psf_centre: PsfCentre = "check",
        ideal_psfs: ArrayLike | None = None,
        pupils: ArrayLike | None = None,
        psf_modes: ArrayLike | None = None,
        psf_scatter: ArrayLike | None = None,
        psf_error: float | None = None,
        star_psfs: ArrayLike | None = None,
        star_places: ArrayLike | None = None,
    ) -> None:
        given = {name: value for name, value in locals().items() if name in (*FIELDS, *MOVES)}
        shapes = shapes_of(images) if transforms is not None else []
        if len(set(shapes)) > 1:
            given |= in_one_shape(given, shapes)
        given["psfs"], scatter, of_made = without_errors(psfs)
        if psf_error is None:
            given["psf_error"] = of_made
        if psf_scatter is None and psf_error != 0:
            given["psf_scatter"] = scatter
        shapes_of_psfs = shapes_of(given["psfs"])
        for name in ("psfs", "psf_scatter", "star_psfs"):
            given[name] = of_one_shape(given[name], 0.0, about_centre=True)
        read = hold(self, given, shapes=shapes)
        into = partial(normalised, psf_centre=psf_centre)
        self.psf_fields = tuple(field.mapped(into) for field in self.psf_fields)
        if self.psf_fields:
            self.psfs = at_middle(self)
        else:
            self.psfs = into(self.psfs, shapes=shapes_of_psfs)
        if ideal_psfs is not None:
            self.ideal_psfs = into(self.ideal_psfs)
        with np.errstate(over="ignore"):
            if read.variances is not None:
                self.read_noise = noise_beyond_counts(self, read)
            self.background = np.add(*together(self.background, self.read_noise**2))
            counts, added = together(self.images, self.read_noise**2)
            is_own = not np.may_share_memory(counts, read.values["images"])
            self.images = np.add(counts, added, out=counts if is_own else None)
        self.wcs = self._wcs_of(images)
        self._closed()

    def __setattr__(self, name: str, value: object) -> None:
        if "_is_checked" in vars(self):
            raise AttributeError(
                f"an observation does not change; replace({name}=...) returns another"
            )
        super().__setattr__(name, value)

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes; one PSF for all images stays one where pickle would copy it."""
        return {**vars(self), "psfs": own(self.psfs)}

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
        return self.oversample * self.geometry.frame[0], self.oversample * self.geometry.frame[1]

    @property
    def n_epochs(self) -> int:
        """Number of epochs, in each of which stars have a flux."""
        return int(self.epochs.max()) + 1

    @property
    def is_of_one_time(self) -> bool:
        """Whether there is one epoch, but for filters."""
        mixing = self.mixing
        return self.n_epochs == (1 if mixing is None else len(mixing.rows))

    @property
    def epoch_word(self) -> str:
        """What an epoch is called in messages: with components it is a filter."""
        return "filter" if self.component_names else "epoch"

    @property
    def n_skies(self) -> int:
        """Number of components, or 1 where there are none."""
        return max(len(self.component_names), 1)

    @property
    def skies_shape(self) -> tuple[int, ...]:
        """Shape of the extended source: `sky_shape`, or with several components (K, ny, nx)."""
        return (self.n_skies, *self.sky_shape) if self.component_names else self.sky_shape

    @property
    def mixing(self) -> Mixing | None:
        """How images show the components; None where there are none."""
        names = self.component_names
        return Mixing.of(self.components, names) if names else None

    @property
    def psfs_over_images(self) -> Psfs:
        """The PSFs, or where they vary over images the field of each."""
        return self.psf_fields or self.psfs

    @property
    def offsets(self) -> Array:
        """Shifts of the images as given, or those of `transforms`, shape (p, 2), pixels."""
        return self.geometry.offsets

    @property
    def turns(self) -> Array:
        """Rotations, flips and scales of `transforms`, shape (p, 2, 2)."""
        return self.geometry.turns

    @property
    def transforms(self) -> Array:
        """The map from the sky to each image as given, shape (p, 2, 3), pixels."""
        return self.geometry.transforms

    @property
    def scales(self) -> Array:
        """Pixels of the sky to one of each image, along each axis, by `turns`; shape (p,)."""
        return self.geometry.scales

    @property
    def is_turned(self) -> bool:
        """Whether any image is turned against the sky, or has other pixels."""
        return self.geometry.is_turned

    @property
    def is_mapped(self) -> bool:
        """Whether any image is turned or flipped against the sky, as given."""
        return self.geometry.is_mapped

    def places(self, j: int, positions: Array) -> Array:
        """Return where positions (..., 2) of the sky are in image j."""
        return self.geometry.places(j, positions)

    def shows(self, positions: Array) -> NDArray[np.bool_]:
        """Return which positions, shape (n, 2), lie within any image, its offset added."""
        return self.geometry.shows(positions)

    def good_box(self, j: int) -> Box:
        """Return the rows and columns of image j that hold its good pixels; all if it has none."""
        return good_box(self.mask[j])

    def on_fine_pixels(self, j: int) -> tuple[Array, Array, Box]:
        """Return the map from pixels of the sky to fine pixels of image j, and its box of them.

        Fine pixels are `oversample` times as fine as the image's, as those of the sky are. They are
        counted from the centre of the image's first pixel, so that its pixel x is fine pixel
        ``oversample * x``.

        Parameters
        ----------
        j : int
            The image, from 0 on.

        Returns
        -------
        M, t : ndarray of float64, shapes (2, 2) and (2,)
            Pixel u = (x, y) of the sky, 0-based, is at ``M u + t``.
        box : (range, range)
            Rows and columns of fine pixels, those of `good_box`.
        """
        q, turn = self.oversample, self.turns[j]
        rows, columns = (range(q * at.start, q * at.stop) for at in self.good_box(j))
        shift = q * self.offsets[j] - (q - 1) / 2.0 * turn.sum(axis=1)
        return turn, shift, (rows, columns)

    def upright(self) -> Observation:
        """Return the observation with quarter turns and flips of its images undone, by index.

        What is left of `turns` is by 45 degrees at most. Images that are not square are enlarged
        by bad pixels where a quarter turn asks for it.
        """
        geometry = self.geometry.upright()
        if geometry is self.geometry:
            return self
        fields = geometry.turned_fields(self.psf_fields)
        changes: dict[str, Any] = {"geometry": geometry, "psf_fields": fields}
        for name, field in FIELDS.items():
            values = getattr(self, name)
            if field.axes in ("pixels", "psf") and values.ndim > 2 and values.size:
                fill = field.beyond if field.axes == "pixels" else None
                changes[name] = geometry.turned(values, fill, field.of_images)
        return self._with(changes)._closed()

    def moved(self, by: Array) -> Observation:
        """Return the observation with each image moved by so many of its pixels, shape (p, 2)."""
        return self._with({"geometry": self.geometry.moved(by)})._closed()

    def as_given(self, images: NDArray[Any], cut: bool = True) -> NDArray[Any]:
        """Return images (p, ny, nx) of `upright` in the orientation of those given.

        They are cut to the shape of the images unless told otherwise.
        """
        return self.geometry.as_given(images, cut)

    def replace(self, **changes: Any) -> Observation:
        """Return an observation with some parameters replaced, checked as before; the rest is kept.

        Values are as the attributes hold them: the square of the read noise is in images and
        background, and PSFs are neither normalised nor moved. Images become 0 where a pixel is bad.

        Parameters
        ----------
        **changes : array_like, int, bool or None
            Values by the name of a parameter of `Observation`; any but `psf_centre`. Images and
            PSFs in arrays of float64 are not copied, so leave them as they are. None stands for the
            default. New `pupils` bring their own `ideal_psfs`, and new `components` their own
            `component_errors` and `epochs`.

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
            - `images` have an uncertainty, or images or background are per time without `exposure`.
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
        names = *FIELDS, *MOVES
        if unknown := sorted(changes.keys() - set(names)):
            raise InputError(
                f"`{unknown[0]}` cannot be replaced in an observation; what can is "
                f"{', '.join(names)}"
            )
        if changes.get("pupils") is not None:
            changes = {"ideal_psfs": None, **changes}
        if variances("images", changes.get("images"), False) is not None:
            raise InputError("`images` with an uncertainty replace none; give `read_noise` too")
        other = self._with({})
        hold(other, {"mask": self.mask, **changes}, self)
        other._refuse_freed_pixels(self, changes)
        return other._closed()

    def _refuse_freed_pixels(self, before: Observation, changes: dict[str, Any]) -> None:
        """Refuse to take pixels for good again of which nothing is held."""
        freed = before.mask & ~self.mask if self.mask.shape == before.mask.shape else np.False_
        n_freed = int(np.count_nonzero(freed))
        maps = [name for name, field in FIELDS.items() if field.axes == "pixels"]
        held = {name: getattr(before, name) for name in maps if name not in ("mask", *changes)}
        missing = [f"`{name}`" for name, each in held.items() if each.ndim > 2 and each.size]
        if n_freed and missing:
            raise InputError(
                f"`mask` frees {counted(n_freed, 'pixel')} of which nothing is held; give "
                f"{', '.join(missing)} with it"
            )

    def window(
        self,
        rows: range,
        columns: range,
        middle: tuple[float, float] | None = None,
        boxes: Sequence[Box] | None = None,
    ) -> Observation:
        """Return the observation of some rows and columns of the sky, which positions begin in.

        Images, upright ones, are cut to the same rows and columns, or each to its own of `boxes`.
        PSFs that vary are those of a place (x, y) there, by default of its middle.
        """
        boxes = boxes or [(rows, columns)] * self.n_images
        geometry = self.geometry.window(rows, columns, boxes)
        changes: dict[str, Any] = {
            "geometry": geometry,
            "star_places": self.star_places - (columns.start, rows.start),
            "transmission": self.transmission_of(rows, columns),
            "wcs": None,
        }
        for name, field in FIELDS.items():
            if field.axes == "pixels" and (values := getattr(self, name)).ndim > 2:
                changes[name] = geometry.cut(values, boxes, field.beyond, field.of_images)
        if self.psf_fields:
            pairs = zip(self.psf_fields, boxes, strict=True)
            fields = tuple(field.moved(-x.start, -y.start) for field, (y, x) in pairs)
            place = np.array(middle or ((len(columns) - 1) / 2.0, (len(rows) - 1) / 2.0))
            psfs = [each.at(*geometry.places(j, place)) for j, each in enumerate(fields)]
            changes |= {"psf_fields": fields, "psfs": np.array(psfs)}
        other = self._with(changes)
        refuse_all_bad(other.mask)
        refuse_dark(other.halos, other.mask)
        return other._closed()

    def of_images(self, which: Sequence[int]) -> Observation:
        """Return the observation of some images, upright ones of one filter, as of one sky."""
        numbers_of, labels = np.unique(self.epochs[which], return_inverse=True)
        changes: dict[str, Any] = {
            "geometry": self.geometry.of_images(which),
            "psf_fields": tuple(self.psf_fields[j] for j in which) if self.psf_fields else (),
            "components": np.zeros((len(which), 0)),
            "component_errors": np.zeros((len(which), 0)),
            "component_names": (),
            "epochs": labels.ravel().astype(np.intp),
            "epoch_labels": tuple(self.epoch_labels[k] for k in numbers_of),
            "background_error": self.background_error[which],
        }
        for name, field in FIELDS.items():
            if field.axes and name not in changes:
                values = getattr(self, name)
                if values.ndim > field.of_images and values.shape[field.of_images] > 0:
                    changes[name] = _of_images(values, which, field.of_images)
        return self._with(changes)._closed()

    def joined(self, parts: Sequence[tuple[Sequence[int], Observation]]) -> Observation:
        """Return this observation with PSFs and levels of parts, `of_images`, that were mended."""
        changes: dict[str, Any] = {"psf_error": max(each.psf_error for _, each in parts)}
        order = np.argsort(np.concatenate([which for which, _ in parts]))
        for name in JOINED:
            stacks = together(*(getattr(each, name) for _, each in parts))
            shape = max(each.shape[1:] for each in stacks)
            laid = [
                np.broadcast_to(each if len(each) else 0.0, (len(which), *shape))
                for each, (which, _) in zip(stacks, parts, strict=True)
            ]
            whole = np.concatenate(laid)[order]
            # Else what was not mended stays as it is, one array for all images too.
            if any(map(len, stacks)) and not np.array_equal(whole, getattr(self, name)):
                changes[name] = whole
        if self.psf_fields:
            fields = [field for _, each in parts for field in each.psf_fields]
            changes["psf_fields"] = tuple(fields[j] for j in order)
        return self._with(changes)._closed()

    def transmission_of(self, rows: range, columns: range) -> Array:
        """Return the `transmission` of some rows and columns of the sky.

        Parameters
        ----------
        rows, columns : range
            In pixels of the images, 0-based. Beyond the frame of the sky the transmission is that
            of the nearest pixel.

        Returns
        -------
        ndarray of float64, shape (p, q len(rows), q len(columns))
            With q for `oversample`; of shape (0, 0, 0) where no transmission was given.
        """
        given, q = self.transmission, self.oversample
        if not len(given):
            return given
        axes = zip((rows, columns), given.shape[1:], strict=True)
        y, x = (np.arange(q * at.start, q * at.stop).clip(0, n - 1) for at, n in axes)
        return np.broadcast_to(own(given)[:, y[:, None], x], (len(given), len(y), len(x)))

    def _wcs_of(self, images: Any) -> Any:
        """Return the WCS of an image that is neither moved nor turned against the sky."""
        is_sky = (self.transforms == np.eye(2, 3)).all(axis=(1, 2))
        # Of one array for all images it is that of each.
        pairs = zip(coordinates(images), is_sky, strict=False)
        return next((wcs for wcs, is_same in pairs if wcs is not None and is_same), None)

    def _with(self, changes: dict[str, Any]) -> Observation:
        """Return a copy with other attributes, which may still change."""
        other = copy(self)
        vars(other).update(changes)
        del vars(other)["_is_checked"]
        return other

    def _closed(self) -> Observation:
        """Refuse counts out of range, and hold all arrays as they are from now on."""
        if self.images[self.mask].any():
            self.images = np.where(self.mask, 0.0, self.images)
        refuse_overflow({"images": self.images, "background": self.background})
        self.images = without_negative(self.images, bool(self.read_noise.any()))
        for name, values in self._arrays().items():
            if values.flags.writeable:  # the array itself may be the caller's
                vars(self)[name] = values.view()
                vars(self)[name].flags.writeable = False
        self._is_checked = True
        return self

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: each for name, each in vars(self).items() if isinstance(each, np.ndarray)}

    @property
    def nbytes(self) -> int:
        """Bytes that its arrays take."""
        return sum(array.nbytes for array in {**self._arrays(), "psfs": own(self.psfs)}.values())

    def __repr__(self) -> str:
        """Return shapes, levels and noise as given, a line each."""
        rows = {"lnocl.Observation": "", **self._rows()}
        return "\n".join(f"{name}: {value}" if value else name for name, value in rows.items())

    def _repr_html_(self) -> str:
        """Return a table for a notebook, with a thumbnail of the first image."""
        image = np.where(self.mask[0], np.nan, self.images[0])
        return html_card("lnocl.Observation", self._rows(), image)

    def _rows(self) -> dict[str, str]:
        ny, nx = self.shape
        rows = {
            "images": f"{self.n_images} of {nx} x {ny} pixels",
            "PSFs": f"{' x '.join(map(str, self.psfs.shape[:0:-1]))} pixels",
            "background": _range(np.subtract(*together(self.background, self.read_noise**2))),
            "read noise": _range(self.read_noise),
            "bad pixels": f"{100 * self.mask.mean():.2g} %",
        }
        if (self.exposure != 1.0).any():
            rows["exposure"] = _range(self.exposure)
        if len(self.halos):
            rows["halos"] = f"{len(self.halos)}, fitted in each image"
        if mixing := self.mixing:
            shown = ", ".join(mixing.filter_names)
            rows["components"] = f"{', '.join(mixing.names)}; images show {shown}"
        elif self.n_epochs > 1:
            rows["epochs"] = f"{self.n_epochs}"
        if self.oversample > 1:
            rows["sky"] = f"{self.oversample} pixels to one of the images along each axis"
        return rows


def _of_images(values: NDArray[Any], which: Sequence[int], axis: int) -> NDArray[Any]:
    """Return those of some images; one array for all of them stays one."""
    if values.strides[axis] == 0:
        shape = *values.shape[:axis], len(which), *values.shape[axis + 1 :]
        return np.broadcast_to(values.take([0], axis), shape)
    return values.take(which, axis)


def _range(values: Array) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.5g}" if low == high else f"{low:.5g} to {high:.5g}"
