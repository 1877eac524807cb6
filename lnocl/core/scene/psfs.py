"""PSFs, and what is known of their errors, as they are given: checked, normalised, centred."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.scene.arrays import Array, numbers, pixels, stack
from lnocl.core.scene.cores import centre, off_centre, peak
from lnocl.core.scene.geometry import Geometry
from lnocl.core.scene.psf_field import read_fields
from lnocl.core.scene.quantities import bare
from lnocl.core.scene.shifting import place
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError, counted, note, warn

# What real PSFs have, and the most that may be said of them.
PSF_ERROR, MOST_PSF_ERROR = 0.03, 0.3

if TYPE_CHECKING:
    from lnocl.core.scene.fields import Field
    from lnocl.core.scene.observation import Observation

PsfCentre = Literal["check", "fit", "given"]


class MadePsf(Protocol):
    """A PSF of unit sum and the standard deviation of its pixels, as a `lnocl.psf.StarPsf` is."""

    @property
    def psf(self) -> Array:
        """The PSF, shape (ky, kx)."""

    @property
    def scatter(self) -> Array:
        """The standard deviations, shape (ky, kx)."""


# Pixels that the core of a PSF may lie off its centre: from the first on a warning is due, from the
# second on it is refused.
LITTLE_OFF_CENTRE, FAR_OFF_CENTRE = 0.25, 0.8

# Of PSFs with more negative light than this share it is warned. Public PSFs that are in order have
# 0.3 % at most. Those of five stars with noisy wings have up to 8 % (benchmarks/own_frame.py), and
# give the same light as PSFs without that noise.
MUCH_NEGATIVE = 0.1


def check_psfs(name: str, psfs: ArrayLike, n_images: int) -> Array:
    """Return PSFs with light, finite, one for each image: of one for all, views of the same."""
    each = stack(name, bare(name, psfs), n_images)
    if each.shape[0] not in (1, n_images):
        raise InputError(
            f"{counted(len(each), name.removesuffix('s'))} for {counted(n_images, 'image')}; give "
            "one, or one for each image"
        )
    if (bad := ~np.isfinite(each)).any():
        j, y, x = np.argwhere(bad)[0]
        raise InputError(
            f"`{name}[{j}]` is not finite in {counted(int(bad[j].sum()), 'pixel')}, the first at "
            f"({x}, {y}): interpolate, or make it of the star's frame with lnocl psf"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        sums = each.sum(axis=(1, 2), keepdims=True)
        sizes = np.array([abs(psf).sum(keepdims=True) for psf in each])
        # Rounding leaves a sum where values cancel; what overflows is not above itself.
        unusable = ~(sums > np.finfo(np.float64).eps * sizes)
    if unusable.any():
        j = int(np.argmax(unusable))
        raise InputError(
            f"`{name}[{j}]` has the sum {sums.flat[j]:g}; it must be positive, finite and more "
            "than the rounding of its values: give another, or subtract less of a background from "
            "it"
        )
    return np.broadcast_to(each, (n_images, *each.shape[1:]))


def read_psfs(field: Field, psfs: Any, held: Observation) -> Array:
    """Return PSFs, those of the middle where they vary; hold the fields that these are of."""
    fields = read_fields(psfs, held.n_images, held.oversample, held.effective_psfs)
    held.psf_fields = tuple(
        each.mapped(lambda stack: check_psfs(field.name, stack, len(stack))) for each in fields
    )
    if fields:
        return at_middle(held)
    return check_psfs(field.name, psfs, held.n_images)


def without_errors(psfs: Any) -> tuple[Any, Any, float]:
    """Return PSFs as arrays, and the scatter that those of `lnocl.psf.make_psf` carry, or None.

    That of others among them is 0. The last is the largest error of a width, that of others
    `PSF_ERROR`.
    """
    each = psfs if isinstance(psfs, (list, tuple)) else [psfs]
    are_made = [hasattr(one, "psf") and hasattr(one, "scatter") for one in each]
    if not any(are_made):
        return psfs, None, PSF_ERROR
    error = max(getattr(one, "error", PSF_ERROR) for one in each)
    pairs = [
        (one.psf, one.scatter) if is_made else (one, np.zeros(np.shape(one)))
        for one, is_made in zip(each, are_made, strict=True)
    ]
    if each is not psfs:
        return *pairs[0], error
    return [psf for psf, _ in pairs], [scatter for _, scatter in pairs], error


def read_ideal_psfs(field: Field, ideals: Any, held: Observation) -> Array:
    """Return PSFs without aberrations, by default those of pupils; (0, ky, kx) for none."""
    if ideals is None and len(held.pupils):
        from lnocl.core.scene.pupils import Pupil  # which loads scipy

        return np.array([Pupil(pupil).ideal_psf() for pupil in held.pupils])
    if ideals is None:
        return np.zeros((0, *held.psfs.shape[1:]))
    checked = check_psfs(field.name, ideals, held.n_images)
    if checked.shape != held.psfs.shape:
        raise InputError(
            f"`ideal_psfs` has PSFs of shape {checked.shape[1:]}, psfs of {held.psfs.shape[1:]}; "
            "give them in one shape"
        )
    return checked


def read_pixels(field: Field, values: Any, held: Observation) -> Array:
    """Return a number for each pixel of each PSF, shape (p, ky, kx), or (0, ky, kx) for none.

    Of `psf_modes` there are several for each PSF, shape (p, n, ky, kx), which may be negative. A
    `psf_scatter` of 0 is none.
    """
    name, (p, *shape) = field.name, held.psfs.shape
    are_modes, may_be_dark = name == "psf_modes", name in ("psf_modes", "psf_scatter")
    if values is None or (name == "psf_scatter" and not np.any(values)):
        return np.zeros((p, 0, *shape) if are_modes else (0, *shape))
    given = numbers(name, bare(name, values))
    if given.ndim == 2 + are_modes:
        given = given[None]
    if given.ndim != 3 + are_modes or len(given) not in (1, p) or list(given.shape[-2:]) != shape:
        one = "(n, ky, kx), with (ky, kx) " if are_modes else ""
        raise InputError(
            f"`{name}` has shape {np.shape(values)}; give {one}{tuple(shape)}, the shape of the "
            f"PSFs, or one such {'cube' if are_modes else 'map'} for each of the {p} images"
        )
    if not np.isfinite(given).all() or (not are_modes and (given < 0).any()):
        kind = "" if are_modes else "negative or "
        raise InputError(f"`{name}` hold values that are {kind}not finite; repair them first")
    if not (may_be_dark or given.any(axis=(1, 2)).all()):
        raise InputError(f"`{name}` hold a map that is all 0; leave `{name}` out, or give another")
    return np.broadcast_to(given, (p, *given.shape[1:])).copy()


def at_middle(held: Observation) -> Array:
    """Return the PSFs that fields have in the middle of their images."""
    known: Geometry | None = vars(held).get("geometry")
    if known is None or (len(known.turns), *known.shape) != held.images.shape:  # another comes
        known = Geometry.shifted(None, held.n_images, held.shape)
    return np.array([field.at(*known.middle(j)) for j, field in enumerate(held.psf_fields)])


def own(psfs: Array) -> Array:
    """Return PSFs of images, or the one that serves all."""
    return psfs[:1] if psfs.strides[0] == 0 else psfs


def normalised(psfs: Array, psf_centre: str, shapes: Sequence[tuple[int, int]] = ()) -> Array:
    """Return PSFs of unit sum, their cores at their centres where asked for.

    Those that were enlarged from their own shapes are moved within these.
    """
    each = own(psfs).copy(order="K")
    each /= each.sum(axis=(1, 2), keepdims=True)
    if n_negative := int((each < 0).sum()):
        share = float(-each.clip(max=0.0).sum(axis=(1, 2)).min())
        tell = warn if share > MUCH_NEGATIVE else note
        words = pixels(n_negative, "psf", "negative", "kept")
        tell(f"{words}: {100 * share:.2g} % of the light of a PSF at most")
    if psf_centre == "fit":
        for psf, shape in zip(each, shapes or [each.shape[1:]] * len(each), strict=True):
            inner = enlarged(psf, shape, is_centred=True)
            inner[:] = _centred(inner)
    elif psf_centre == "check":
        _refuse_off_centre(each)
    elif psf_centre != "given":
        raise InputError(f"`psf_centre` {psf_centre!r} is not known; choose from check, fit, given")
    return np.broadcast_to(each, psfs.shape)


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
