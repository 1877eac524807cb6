"""The parameters of an observation, a row for each: unit, range, and what becomes of its arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene import arrays, containers
from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.components import in_filters, read_component_errors, read_components
from lnocl.core.scene.geometry import read_geometry
from lnocl.core.scene.halos import read_halos
from lnocl.core.scene.psfs import MOST_PSF_ERROR, read_ideal_psfs, read_pixels, read_psfs
from lnocl.core.scene.quantities import in_unit
from lnocl.core.scene.star_psfs import read_star_places, read_star_psfs
from lnocl.core.scene.transforms import of_one_shape, refuse_other_shapes, shapes_of
from lnocl.core.scene.uncertainties import is_uncertainty, without_source
from lnocl.errors import InputError, warn

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation

# Pixels of the sky to one of an image, along each axis. The frequencies that an image cannot tell
# apart are neighbours in the transform's order where this is a power of two (kernels/convolve.cl).
OVERSAMPLES = 1, 2, 4


class Given:
    """What is given of an observation, without units.

    Parameters
    ----------
    parameters : dict of str to Any
        As a caller gives them, by their names; `mask` is one of them.

    Attributes
    ----------
    values : dict of str to Any
        In electrons and seconds; maps are masked where they were. Beside that of `mask` is a list
        of the pixels that other parameters show to be bad.
    rates : set of str
        Those of them that are electrons per second.
    variances : ndarray of float64 or None
        Of all noise of the images, where they have an uncertainty; per second squared of rates.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        self.values, self.rates, self._bad = dict[str, Any](), set[str](), list[Mask]()
        self.variances: Array | None = None
        has_exposure = parameters.get("exposure") is not None
        for name, value in parameters.items():
            self.values[name] = self._plain(name, value, has_exposure)
            if name == "images":
                self.variances = containers.variances(name, value, name in self.rates)
        if self.variances is not None:
            self._bad.append(self.variances == 0)
        self.values["mask"] = parameters["mask"], self._bad

    def _plain(self, name: str, value: Any, has_exposure: bool) -> Any:
        unit = FIELDS[name].unit if name in FIELDS else ""
        if unit == "s":
            value = in_unit(name, 1.0 if value is None else value, unit)
            values, masked = arrays.values_and_mask(name, value)
            if values.ndim > 1:
                self._bad.append((values == 0) & ~masked)
            return value
        if name == "read_noise" and is_uncertainty(value):
            value = containers.deviations(name, value)
            self._bad.append(np.equal(value, 0))
        if not unit:
            return value
        value, is_rate = containers.counts(name, value, has_exposure if unit == "counts" else None)
        self.rates |= {name} if is_rate else set()
        if name == "images":
            value, masked = arrays.values_and_mask(name, value)
            self._bad.append(masked)
        return value


class Field(NamedTuple):
    """A parameter of an observation.

    Attributes
    ----------
    name : str
        Its name, and that of the attribute that holds it.
    read : callable
        Returns what is held, of the field, its value without unit, and what is held above it.
    unit : {"counts", "electrons", "s", ""}
        What its unit is converted to; counts may be per time.
    axes : {"pixels", "psf", "sky", ""}
        Whether its last axes are those of an image, where it has so many, of a PSF, or of the sky.
    in_bad : float
        What a map of levels holds in bad pixels.
    beyond : float or bool
        What is held in pixels by which an image is enlarged.
    is_positive : bool
        Whether a number is more than zero, not only zero or more.
    of_images : int
        The axis of the images.
    """

    name: str
    read: Callable[[Field, Any, Observation], Any]
    unit: Literal["counts", "electrons", "s", ""] = ""
    axes: Literal["pixels", "psf", "sky", ""] = ""
    in_bad: float = 0.0
    beyond: float | bool = 0.0
    is_positive: bool = False
    of_images: int = 0


def _oversample(_: Field, value: Any, held: Observation) -> int:
    if not (isinstance(value, (int, np.integer)) and value in OVERSAMPLES):
        raise InputError(f"`oversample` must be 1, 2 or 4; {value} was given")
    return int(value)


def _psf_error(field: Field, value: Any, held: Observation) -> float:
    error = arrays.numbers(field.name, value)
    if error.ndim or not 0 <= error <= MOST_PSF_ERROR:
        raise InputError(
            f"`{field.name}` must be a number from 0 to {MOST_PSF_ERROR:g}, the standard error of "
            f"the width of the PSFs over that; {value} was given"
        )
    return float(error)


def _images(field: Field, value: Any, held: Observation) -> Array:
    return arrays.stack(field.name, value, len(held.images) if "images" in vars(held) else 0)


def _mask(field: Field, given: tuple[Any, list[Mask]], held: Observation) -> Mask:
    """Return all bad pixels: those of `mask`, and those that other parameters show."""
    (value, others), shape = given, held.images.shape
    mask = arrays.booleans(field.name, np.zeros(shape, bool) if value is None else value)
    if mask.shape not in (shape, shape[1:]):
        raise InputError(f"`mask` has shape {mask.shape}; the images have {shape}")
    is_kept = value is not None and value is vars(held).get(field.name)
    mask = value if is_kept else np.broadcast_to(mask, shape).copy()
    for bad in others:
        if bad.shape in (shape, shape[1:]) and (bad & ~mask).any():
            mask = mask | bad
    not_finite = ~np.isfinite(held.images) & ~mask
    if n_not_finite := int(not_finite.sum()):
        mask = mask | not_finite
        warn(arrays.pixels(n_not_finite, "image", "not finite", "masked"))
    refuse_all_bad(mask)
    return mask


def refuse_all_bad(mask: Mask) -> None:
    """Refuse images without a good pixel."""
    if mask.all():
        raise InputError(
            "all pixels are masked; a mask is True, or not 0, where a pixel is bad: turn it "
            "round if it marks the good ones"
        )


def _levels(field: Field, value: Any, held: Observation) -> Array:
    """Return one number for each image, or for each pixel: one map serves all images."""
    name, shape = field.name, held.images.shape
    array, masked = arrays.values_and_mask(name, value)
    if array.shape in (shape, shape[1:]):
        bad = held.mask if array.ndim == 3 else held.mask.all(axis=0)
        masked = masked & ~bad  # a new array: it may be the caller's
    arrays.refuse_masked(name, masked)
    values = arrays.numbers(name, array, copy=False)
    if values.ndim > 1:
        if values.shape not in (shape, shape[1:]):
            raise InputError(f"`{name}` has shape {values.shape}; the images have {shape}")
        if not field.axes:
            raise InputError(f"`{name}` is that of a level; give a number for each image")
        # An exposure of 0 tells why a pixel is bad.
        values = np.where(held.mask & (values != 0), field.in_bad, values)
    elif values.size not in (1, shape[0]):
        raise InputError(
            f"`{name}` has shape {values.shape}; give one number, or one for each of the "
            f"{shape[0]} images"
        )
    else:
        values = np.array(np.broadcast_to(values, shape[:1]))
    if field.is_positive and values.ndim == 1:
        arrays.refuse_unless(f"`{name}`", values, "finite and more than zero", values > 0)
    else:
        arrays.refuse_unless(f"`{name}`", values, "finite and not negative", values >= 0)
    return values


def _deviations(field: Field, value: Any, held: Observation) -> Array:
    values = _levels(field, value, held)
    with np.errstate(over="ignore"):
        arrays.refuse_unless(f"the square of `{field.name}`", values**2, "finite", values >= 0)
    return values


def _epochs(_: Field, epochs: Any, held: Observation) -> NDArray[np.intp]:
    """Return the number of each image's epoch, in the order of the labels, which are held too."""
    n_images = held.n_images
    labels = arrays.unmasked("epochs", np.zeros(n_images) if epochs is None else epochs)
    if labels.shape != (n_images,):
        raise InputError(
            f"`epochs` has shape {labels.shape}; give a label for each of the {n_images} images"
        )
    if (labels != labels).any():
        raise InputError("`epochs` holds a label that is not a number; give one, or a name")
    try:
        distinct, numbered = np.unique(labels, return_inverse=True)
    except TypeError:
        kinds = sorted({type(label).__name__ for label in labels.tolist()})
        raise InputError(
            f"`epochs` holds labels without an order, of {' and '.join(kinds)}; give numbers "
            "alone, or text alone"
        ) from None
    texts = (f"{each:.15g}" if isinstance(each, float) else str(each) for each in distinct.tolist())
    held.epoch_labels = tuple(texts)
    if held.component_names:
        numbered, held.epoch_labels = in_filters(held, numbered, held.epoch_labels)
    return numbered.astype(np.intp)


def _transmission(field: Field, value: Any, held: Observation) -> Array:
    """Return the share of the sky's light that each image gets, shape (p, Ny, Nx) or (0, 0, 0)."""
    if value is None:
        return np.zeros((0, 0, 0))
    values = arrays.numbers(field.name, value, copy=False)
    if values.ndim == 2:
        values = np.broadcast_to(values, (held.n_images, *values.shape))
    if values.ndim != 3 or len(values) != held.n_images:
        raise InputError(
            f"`{field.name}` has shape {values.shape}; give one of the sky's pixels, or one for "
            f"each of the {held.n_images} images"
        )
    in_range = (values >= 0) & (values <= 1)
    arrays.refuse_unless(f"`{field.name}`", values, "finite, zero or more, and at most 1", in_range)
    if not values.any():
        raise InputError(f"`{field.name}` is 0 everywhere, so nothing of the sky is seen")
    return values


def is_dark(held: Observation) -> bool:
    """Return whether nothing of the sky is transmitted to images with good pixels."""
    has_good = ~held.mask.all(axis=(1, 2))
    return bool(len(held.transmission)) and not held.transmission[has_good].any()


def refuse_other_sky(held: Observation) -> None:
    """Refuse a transmission that is not of the sky's pixels, or of which no image shows any."""
    shape, sky = held.transmission.shape, held.sky_shape
    if shape[0] and shape[1:] != sky:
        raise InputError(f"`transmission` has shape {shape}; the sky has {sky}")
    if is_dark(held):
        raise InputError(
            "`transmission` is 0 everywhere for the images that have good pixels, so nothing of "
            "the sky is seen"
        )


# In the order in which they are read: what a field is checked beside is above it.
FIELDS = {
    field.name: field
    for field in (
        Field("oversample", _oversample),
        Field("effective_psfs", lambda field, value, _: arrays.flag(field.name, value)),
        Field("images", _images, "counts", "pixels", beyond=np.nan),
        Field("mask", _mask, "", "pixels", beyond=True),
        Field("exposure", _levels, "s", "pixels", in_bad=1.0, is_positive=True),
        Field("psfs", read_psfs, "", "psf"),
        Field("pupils", read_pixels, "", "psf"),
        Field("ideal_psfs", read_ideal_psfs, "", "psf"),
        Field("psf_modes", read_pixels, "", "psf"),
        Field("psf_scatter", read_pixels, "", "psf"),
        Field("psf_error", _psf_error),
        Field("star_places", read_star_places),
        Field("star_psfs", read_star_psfs, "", "psf", of_images=1),
        Field("components", read_components),
        Field("component_errors", read_component_errors),
        Field("epochs", _epochs),
        Field("background", _levels, "counts", "pixels"),
        Field("background_error", _levels, "electrons"),
        Field("read_noise", _deviations, "electrons", "pixels"),
        Field("halos", read_halos, "", "pixels", of_images=1),
        Field("transmission", _transmission, "", "sky"),
    )
}


def in_one_shape(given: dict[str, Any], shapes: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Return images of several shapes, and their maps, with bad pixels added to smaller ones."""

    def laid(name: str, field: Field, maps: Any) -> Any:
        if field.of_images and isinstance(maps, (list, tuple)) and not shapes_of(maps):
            return [laid(name, field, each) for each in maps]
        if not field.of_images or len(set(shapes_of(maps))) > 1:  # else a halo of all images
            refuse_other_shapes(name, maps, shapes)
        return of_one_shape(maps, field.beyond)

    fields = FIELDS.items()
    return {k: laid(k, field, given[k]) for k, field in fields if field.axes == "pixels"}


def hold(
    held: Observation,
    parameters: dict[str, Any],
    before: Observation | None = None,
    shapes: Sequence[tuple[int, int]] = (),
) -> Given:
    """Hold what is given in an observation, checked, beside what is kept of another.

    Parameters
    ----------
    held : Observation
        A new one, or a copy of `before`.
    parameters : dict of str to Any
        By their names; `mask` is one of them.
    before : Observation, optional
        The rest is that of it, read again where what it is checked beside differs.
    shapes : sequence of tuple of int, optional
        Those of the images as they were given, where these differ.

    Returns
    -------
    Given
        The parameters in plain numbers.
    """
    if "components" in parameters:  # stars have a flux in each of their filters
        parameters = {"component_errors": None, "epochs": None, **parameters}
    given = Given(parameters)
    for name, field in FIELDS.items():
        if before is not None and name not in parameters and _differs(field, held, before):
            values: Any = (name == "psfs" and before.psf_fields) or getattr(before, name)
            given.values[name] = values if np.size(values) else None
        if name in given.values:
            setattr(held, name, field.read(field, given.values[name], held))
    held.geometry = read_geometry(given.values, held, before, shapes)
    refuse_other_sky(held)
    with np.errstate(over="ignore", invalid="ignore"):  # bad pixels hold anything
        for name in given.rates:
            rates, exposure = arrays.together(getattr(held, name), held.exposure)
            setattr(held, name, rates * exposure)
    return given


def _differs(field: Field, held: Observation, before: Observation) -> bool:
    """Return whether what a parameter is checked beside differs from before."""
    if held.images.shape != before.images.shape:
        return True
    if field.axes == "psf":
        is_same = len(held.star_places) == len(before.star_places)
        return not is_same or held.psfs.shape != before.psfs.shape
    is_map = field.axes == "pixels" and getattr(before, field.name).ndim > 2
    return is_map and held.mask is not before.mask


def noise_beyond_counts(held: Observation, given: Given) -> Array:
    """Return the read noise that the uncertainty of images leaves beside that of their counts."""
    if held.read_noise.any():
        raise InputError(
            "give `read_noise`, or images with their uncertainty, which includes it, not both"
        )
    variances = np.asarray(given.variances).reshape(held.images.shape)
    if "images" in given.rates:
        variances, exposure = arrays.together(variances, held.exposure)
        variances = variances * exposure**2
    return without_source(variances, held.images, held.mask)
