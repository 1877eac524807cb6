"""An observation from FITS files: counts, exposures, backgrounds, masks and offsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits

from lnocl.core.scene import units
from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psfs import PSF_ERROR, check_psfs
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError, counted, note, warn
from lnocl.io.calibration import EACH, Calibration, Word
from lnocl.io.electrons import Electrons
from lnocl.io.fitsread import read_extension, read_stack
from lnocl.io.image_files import ImageFiles
from lnocl.io.levels import sky_level, sky_noise
from lnocl.io.masks import read_mask
from lnocl.io.mixtures import read_components
from lnocl.io.names import PSF_ERRORS, parse_kind
from lnocl.io.pixel_scales import warn_of_pixel_scales
from lnocl.io.places import read_epochs, read_places
from lnocl.io.psf_grids import is_grid, read_grid

# The word for a halo that is the same in all pixels.
FLAT = "flat"
# The extension beside a PSF with the standard deviation of its pixels.
SCATTER = "SCATTER"
# The keyword of a PSF with the standard error of its width, relative to that.
WIDTH_ERROR = "PSFERROR"
# Of images with more negative pixels than this share the sky was subtracted.
SUBTRACTED = 0.01


class Frames(NamedTuple):
    """An observation that was read.

    Attributes
    ----------
    observation : Observation
        In electrons; its sky per second where exposures were given.
    header : astropy.io.fits.Header
        Header of the sky: that of the first image, or of the one with the smallest pixels.
    background, read_noise : list of Word
        As given, with the numbers of keywords, and those that ``"auto"`` found.
    sha256 : dict of str to list of str
        Checksums of all files, by the option they belong to: images, psfs, background, ...
    unit : str
        Unit of the sky, as FITS spells it: that of the images, per second where they are counts
        and exposures were given; electrons where they have none that is known.
    electrons : float
        Electrons, or electrons per second, in this unit.
    gain : float, optional
        As given, or as the headers have it.
    """

    observation: Observation
    header: fits.Header
    background: list[Word]
    read_noise: list[Word]
    sha256: dict[str, list[str]]
    unit: str
    electrons: float
    gain: float | None


def read_frames(images: Sequence[str], psfs: Sequence[str], calibration: Calibration) -> Frames:
    """Read images, their PSFs and their calibration.

    Notes such as the number of masked pixels and the reason are logged.

    Parameters
    ----------
    images, psfs : sequence of str
        Files, as for `fitsread.read_stack`; PSFs may be grids (`lnocl.io.psf_grids`). The unit of
        the images is that of their BUNIT; without one they are in electrons.
    calibration : Calibration
        Their calibration.

    Raises
    ------
    FileError, InputError
        As `fitsread.read_stack` and `Observation`; a unit that is not one of counts; counts per
        time without exposure; maps that do not fit.
    """
    return _Reader(images, psfs, calibration).frames()


class _Reader:
    """Reader of the files of one observation."""

    def __init__(
        self, images: Sequence[str], psfs: Sequence[str], calibration: Calibration
    ) -> None:
        self._files = ImageFiles(images, calibration)
        self._paths, self._calibration = images, calibration
        self._images, self._maps = self._files.stack, self._files.maps
        self._electrons = Electrons(self._files)
        of_one_sky = EACH not in calibration.components
        self._psfs = read_stack(psfs, calibration.align is not None, of_one_sky)
        self._grids = [read_grid(path) for path in psfs if is_grid(path)]
        if len(self._grids) not in (0, len(psfs)):
            raise InputError("give grids of PSFs for all images, or for none")
        self._maps.sha256["psfs"] = self._psfs.sha256
        self._background_errors = np.zeros(len(self._images.data))

    def frames(self) -> Frames:
        """Return the observation in the files."""
        bunit, electrons = self._files.bunit(0), self._electrons
        if why := units.refusal(bunit):
            raise InputError(f"{self._paths[0]} is in {bunit}, {why}")
        exposure = self._exposure()
        factor, are_rates = electrons.factor(exposure)
        if are_rates and exposure is None:
            raise InputError(
                f"{self._paths[0]} holds counts per time; give `exposure`, in seconds: a number, a "
                "map, or a keyword of the header such as EXPTIME" + electrons.typed(("exposure",))
            )
        # Electrons in each unit of the images.
        warn_of_pixel_scales(self._images, self._psfs, self._grids, self._calibration.oversample)
        each = factor * (_maps(exposure) if are_rates and exposure is not None else 1.0)
        noise = self._files.noise
        mask = read_mask(self._files, exposure)
        counts = self._images.data
        counts *= each
        background = self._background(counts, mask)
        levels = self._without_sky(counts, background)
        read_noise = self._read_noise_words(counts, mask)
        places = read_places(self._images, self._calibration)
        if places.sha256:
            self._maps.sha256["angle"] = places.sha256
        observation = Observation(
            _in_own_shapes(counts, self._images.shapes),
            self._grids or _in_own_shapes(self._psfs.data, self._psfs.shapes),
            background=self._maps.combine("background", levels),
            # A flat halo is fitted in the place of the level.
            background_error=self._background_errors * (FLAT not in self._calibration.halos),
            read_noise=self._maps.combine("read_noise", read_noise)
            if noise is None
            else noise.read_noise(counts, each, mask),
            mask=mask if mask.any() else None,
            exposure=1.0 if exposure is None else exposure,
            **places.maps,
            **read_components(self._files, self._calibration.components),
            epochs=read_epochs(self._images, self._calibration.epoch),
            oversample=self._calibration.oversample,
            effective_psfs=self._calibration.effective_psfs,
            psf_centre=self._calibration.psf_centre,
            psf_error=self._psf_error(),
            **self._psf_errors(),
            **self._star_psfs(),
            halos=self._halos(),
        )
        unit = electrons.unit
        name, of_unit = (units.spelled(unit), factor) if units.is_known(unit) else ("electron", 1.0)
        if exposure is not None and (name == "electron" or not are_rates):
            name += "/s"
        sha256, gain = self._maps.sha256, electrons.gain
        return Frames(
            observation, places.header, background, read_noise, sha256, name, of_unit, gain
        )

    def _halos(self) -> Array | None:
        """Return the shapes of halos that were given."""
        shape, words = self._images.data.shape, self._calibration.halos
        if not words:
            return None
        return np.array(
            [np.ones(shape) if word == FLAT else self._maps.read("halos", [word]) for word in words]
        )

    def _psf_error(self) -> float:
        """Return the error that was given, or the largest that files of PSFs have."""
        if self._calibration.psf_error is not None:
            return self._calibration.psf_error
        files = range(len(self._psfs.paths))
        found = (self._psfs.number("psf_error", j, WIDTH_ERROR) for j in files)
        return max(PSF_ERROR if error is None else error for error in found)

    def _psf_errors(self) -> dict[str, Any]:
        """Return the ideal PSFs, pupils, modes and scatter that were given."""
        files: dict[str, list[str]] = {}
        for kind, path in map(parse_kind, self._calibration.psf_errors):
            files.setdefault(kind, []).append(path)
        if len(files.get("modes", ())) > 1:
            raise InputError("the modes are those of all images; give one file of `psf_modes`")
        found = dict[str, Any]()
        for kind, paths in files.items():
            stack = read_stack(paths)
            self._maps.sha256.setdefault("psf_errors", []).extend(stack.sha256)
            parts = [read_extension(path, kind.upper()) for path in paths]
            held = [np.atleast_3d(part.T).T for part in parts if part is not None]
            found[PSF_ERRORS[kind]] = np.concatenate(held) if held else stack.data
        if "scatter" not in files and self._calibration.psf_error != 0 and not self._grids:
            found["psf_scatter"] = self._scatter_beside()
        return found

    def _scatter_beside(self) -> list[Array] | None:
        """Return the scatter that files of PSFs have beside them, 0 where others have none.

        Warns
        -----
        LnoclWarning
            It is not of the shape of the PSFs, and left out.
        """
        paths, found, n = self._psfs.paths, list[Array](), 0
        psfs = list(_in_own_shapes(self._psfs.data, self._psfs.shapes))
        of_each = len(psfs) // len(paths)
        for path in paths:
            own, part = psfs[len(found) : len(found) + of_each], read_extension(path, SCATTER)
            planes = [np.zeros(psf.shape) for psf in own]
            if part is not None and np.atleast_3d(part.T).T.shape == np.shape(own):
                planes = [
                    each / psf.sum() for each, psf in zip(np.atleast_3d(part.T).T, own, strict=True)
                ]
                n += 1
            elif part is not None:
                warn(f"{path} has a {SCATTER} that is not of the shape of its PSF, and is left out")
            found += planes
        if not n:
            return None
        of_files = counted(n, "file") if n == len(paths) else f"{n} of {len(paths)} files"
        note(f"{SCATTER}, the error of the pixels of PSFs, is taken from {of_files} of PSFs")
        return found

    def _star_psfs(self) -> dict[str, Any]:
        """Return the PSFs of their own of stars, and the places of these."""
        places, psfs = list[list[float]](), list[Array]()
        for place, path in map(parse_kind, self._calibration.star_psfs):
            stack = read_stack([path])
            self._maps.sha256.setdefault("star_psfs", []).extend(stack.sha256)
            places.append([float(each) for each in place.split(",")])
            psfs.append(check_psfs("star_psfs", stack.data, len(self._images.data)))
        if not psfs:
            return {}
        ny, nx = np.max([psf.shape[1:] for psf in psfs], axis=0).tolist()
        each = [enlarged(psf, (ny, nx), is_centred=True) for psf in psfs]
        return {"star_places": places, "star_psfs": np.array(each)}

    def _exposure(self) -> Array | None:
        words = self._calibration.exposure
        if self._electrons.in_units is not None:
            if words:
                note("`exposure` is not used: the unit was already converted to electrons")
            return self._electrons.in_units
        if not words:
            return None

        def seconds(j: int, keyword: str) -> float | None:
            return self._images.number("exposure", j, keyword, " seconds")

        return self._maps.combine("exposure", self._maps.fill("exposure", words, seconds))

    def _background(self, counts: Array, mask: Mask) -> list[Word]:
        """Return the background with numbers in the place of "auto"."""

        def electrons(j: int, word: str) -> float | None:
            if word != "auto":
                return None
            level, self._background_errors[j] = sky_level(j, counts[j], mask[j])
            return level

        return self._maps.fill("background", self._calibration.background, electrons)

    def _without_sky(self, counts: Array, background: list[Word]) -> list[Word]:
        """Return the background, but for what is below 0, which is taken from the counts.

        That is of a sky of which too much was subtracted; its noise is known apart from its level.
        """
        levels = list(background)
        for j, level in enumerate(background):
            if isinstance(level, float) and -np.inf < level < 0:
                counts[j] -= level
                levels[j] = 0.0
        return levels

    def _read_noise_words(self, counts: Array, mask: Mask) -> list[Word]:
        """Return the read noise with numbers in the place of keywords and "auto"."""
        words = list(self._calibration.read_noise)
        is_subtracted = (counts < 0)[~mask].mean() > SUBTRACTED if not mask.all() else False
        if is_subtracted and not any(words) and self._files.noise is None:
            note("the sky of the images was subtracted: its noise is measured as read noise")
            words = ["auto"]
        if not any(isinstance(word, str) for word in words):
            return words

        def electrons(j: int, word: str) -> float | None:
            if word == "auto":
                return sky_noise(j, counts[j], mask[j])
            return self._images.number("read_noise", j, word, " electrons")

        return self._maps.fill("read_noise", words, electrons)


def _in_own_shapes(stack: Array, shapes: Sequence[tuple[int, int]]) -> Array | list[Array]:
    """Return a stack, or of several shapes a list."""
    if len(set(shapes)) == 1:
        return stack
    return [each[:ny, :nx] for each, (ny, nx) in zip(stack, shapes, strict=True)]


def _maps(values: Array) -> Array:
    return values if values.ndim == 3 else values[:, None, None]
