"""An observation from FITS files: counts, exposures, backgrounds, masks and offsets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.units import dimensionless_unscaled
from numpy.typing import NDArray

from lnocl.errors import InputError, counted, note, warn
from lnocl.io.calibration import Calibration, Word
from lnocl.io.fitsread import (
    keyword_number,
    read_contents,
    read_extension,
    read_keyword,
    read_stack,
)
from lnocl.io.flags import NO_BITS, bad_pixels, good_bits_of, most_common_flag
from lnocl.io.headers import CONVERTERS
from lnocl.io.levels import is_rate, sky_level, sky_noise
from lnocl.io.maps import Maps
from lnocl.io.names import ERR, PSF_ERRORS, parse_kind
from lnocl.io.noise import NoiseMap, electrons_by_variance, read_noise_map
from lnocl.io.pixel_scales import warn_of_pixel_scales
from lnocl.io.places import read_epochs, read_places
from lnocl.io.psf_grids import is_grid, read_grid
from lnocl.scene import units
from lnocl.scene.arrays import Array
from lnocl.scene.observation import Observation
from lnocl.scene.psfs import check_psfs
from lnocl.scene.transforms import enlarged

Mask = NDArray[np.bool_]

# The keywords that headers have for a gain and an exposure.
KEYWORDS = {"gain": ("GAIN", "EGAIN", *CONVERTERS), "exposure": ("EXPTIME", "EXPOSURE")}
# Of more masked pixels than this share of an image it is warned.
MUCH_MASKED = 0.1
# The word for a halo that is the same in all pixels.
FLAT = "flat"
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
        self._paths, self._calibration = images, calibration
        may_differ = calibration.align is not None
        self._images = read_stack(images, may_differ)
        self._psfs = read_stack(psfs, may_differ)
        self._grids = [read_grid(path) for path in psfs if is_grid(path)]
        if len(self._grids) not in (0, len(psfs)):
            raise InputError("give grids of PSFs for all images, or for none")
        self._maps = Maps(self._images.data.shape, self._images.shapes)
        self._maps.sha256 |= {"images": self._images.sha256, "psfs": self._psfs.sha256}
        self._background_errors = np.zeros(len(self._images.data))

    def frames(self) -> Frames:
        """Return the observation in the files."""
        if why := units.refusal(self._bunit(0)):
            raise InputError(f"{self._paths[0]} is in {self._bunit(0)}, {why}")
        exposure = self._exposure()
        factor, are_rates = self._electrons(exposure)
        if are_rates and exposure is None:
            raise InputError(
                f"{self._paths[0]} holds counts per time; give `exposure`, in seconds: a number, a "
                "map, or a keyword of the header such as EXPTIME" + self._typed(("exposure",))
            )
        # Electrons in each unit of the images.
        warn_of_pixel_scales(self._images, self._psfs, self._grids, self._calibration.oversample)
        each = factor * (_maps(exposure) if are_rates and exposure is not None else 1.0)
        noise = self._noise_map
        mask = self._mask(exposure, noise)
        counts = self._images.data
        counts *= each
        background = self._background(counts, mask)
        levels = self._without_sky(counts, background)
        read_noise = self._read_noise_words(counts, mask)
        places = read_places(self._images, self._paths, self._calibration)
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
            epochs=read_epochs(self._images, self._paths, self._calibration.epoch),
            oversample=self._calibration.oversample,
            effective_psfs=self._calibration.effective_psfs,
            psf_centre=self._calibration.psf_centre,
            **self._psf_errors(),
            **self._star_psfs(),
            halos=self._halos(),
        )
        unit = self._unit()
        name, of_unit = (units.spelled(unit), factor) if units.is_known(unit) else ("electron", 1.0)
        if exposure is not None and (name == "electron" or not are_rates):
            name += "/s"
        sha256, gain = self._maps.sha256, self._gain
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

    def _psf_errors(self) -> dict[str, Any]:
        """Return the ideal PSFs, pupils, modes and scatter that were given."""
        files: dict[str, list[str]] = {}
        for kind, path in map(parse_kind, self._calibration.psf_errors):
            files.setdefault(kind, []).append(path)
        if len(files.get("modes", ())) > 1:
            raise InputError("the modes are those of all images; give one file of `psf_modes`")
        found = {}
        for kind, paths in files.items():
            stack = read_stack(paths)
            self._maps.sha256.setdefault("psf_errors", []).extend(stack.sha256)
            parts = [read_extension(path, kind.upper()) for path in paths]
            held = [np.atleast_3d(part.T).T for part in parts if part is not None]
            found[PSF_ERRORS[kind]] = np.concatenate(held) if held else stack.data
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

    def _electrons(self, exposure: Array | None) -> tuple[float, bool]:
        """Return the electrons in a unit of the images, and whether they are per second."""
        if self._electrons_in_units is not None:
            return 1.0, True
        gain, counts = self._gain, self._counts(("adu",))
        if gain is not None and not (np.isfinite(gain) and gain > 0):
            raise InputError(f"`gain` must be more than 0; {gain:g} was given")
        if gain is None and self._counts() is None:
            raise InputError(
                f"{self._paths[0]} is in {self._bunit(0)}, not in counts; give `gain`, the "
                "electrons in one of these units: a number, "
                + (
                    "or a keyword of its header such as GAIN"
                    + self._typed(("gain", "exposure")[: 1 + bool(counts and counts[1])])
                    if counts or not units.is_known(self._unit())
                    else "the exposure in seconds over the value of one electron per second"
                )
            )
        factor, are_rates = counts or (1.0, exposure is not None and units.is_known(self._unit()))
        factor *= 1.0 if gain is None else gain
        if not units.is_known(self._unit()):
            if exposure is not None:
                are_rates = all(
                    is_rate(factor * image, exposure[min(j, len(exposure) - 1)])
                    for j, image in enumerate(self._images.data)
                )
            name = "electrons" if gain is None else "counts"
            note(
                "%s has %s: %s",
                self._paths[0],
                f"BUNIT {self._bunit(0)}" if self._bunit(0) else "no BUNIT",
                f"by its noise it is in {name} per second"
                if are_rates
                else f"its unit is taken to be {name}" + self._typed(("gain",)),
            )
        elif units.count_of(self._unit(), ("electron",)) and gain not in (None, 1.0):
            warn(
                f"{self._paths[0]} is in {self._bunit(0)} by BUNIT, and is taken times gain "
                f"{gain:g}: leave `gain` out, unless BUNIT is wrong"
            )
        return factor, are_rates

    def _typed(self, names: Sequence[str]) -> str:
        """Return which keywords of the header have what was not given, and what to type."""
        given, found = self._calibration, {}
        for name in names:
            for keyword in () if getattr(given, name) else KEYWORDS[name]:
                value = read_keyword(self._paths[0], self._images.headers[0], keyword)
                if isinstance(value, (int, float)) and 0 < value < np.inf:
                    found[name] = f"{keyword} {value:g}", f"`{name}`={keyword}"
                    break
        if not found:
            return ""
        held, words = zip(*found.values(), strict=True)
        return f"; its header has {' and '.join(held)}: give {' '.join(words)}"

    def _counts(self, others: Sequence[str] = ()) -> tuple[float, bool] | None:
        """Return the counts in the unit of the images, of these kinds too, as `units.count_of`."""
        unit = self._unit()
        if unit.is_equivalent(dimensionless_unscaled) and unit != dimensionless_unscaled:
            return None  # numbers and per cents do not count anything
        return units.count_of(unit, (*units.COUNTS, *others))

    @cached_property
    def _electrons_in_units(self) -> Array | None:
        """The electrons in a unit of each image, where they follow from its noise.

        They are to the image what an exposure is to a rate.
        """
        counts = self._counts(("adu",))
        return self._by_noise if counts is None or counts[1] else None

    @cached_property
    def _by_noise(self) -> Array | None:
        """The electrons in a unit of each image, by the variance of its counts.

        That is the extension that gain names; where no gain is given and the images are not in
        counts it is VAR_POISSON, or a map of all noise, or the extension ERR.
        """
        gain = self._calibration.gain
        held = frozenset.intersection(*(read_contents(path).extensions for path in self._paths))
        words = [gain.upper()] if isinstance(gain, str) else ["VAR_POISSON", "`noise`", "ERR"]
        if isinstance(gain, float) or (gain is None and self._counts() is not None):
            return None
        noise = self._noise_map
        has_errors = noise is not None and noise.kind == ERR
        found_in = [word for word in words if word in held or (word == "`noise`" and has_errors)]
        if not found_in:
            return None
        word = found_in[0]
        if word == "`noise`" and noise is not None:
            variances = noise.variance
        else:
            variances = self._extensions(word, "gain") ** (2 if word == "ERR" else 1)
        flags = self._extensions("DQ", "mask") if "DQ" in held else [None] * len(variances)
        planes = zip(self._images.data, variances, flags, strict=True)
        found = [
            electrons_by_variance(image, variance, self._paths[min(j, len(self._paths) - 1)], sums)
            for j, (image, variance, sums) in enumerate(planes)
        ]
        for j, electrons in enumerate(found):
            note("`images[%d]`: %.4g electrons in its unit, by %s", j, electrons, word)
        return np.array(found)

    @cached_property
    def _gain(self) -> float | None:
        word = self._calibration.gain
        if self._by_noise is not None:
            return float(self._by_noise.mean()) if self._electrons_in_units is None else None
        if not isinstance(word, str):
            return word
        found = [self._from_header("gain", j, word) for j in range(len(self._paths))]
        for path, gain in zip(self._paths, found, strict=True):
            if gain is None:
                raise InputError(
                    f"{path} has no {word} in its header; give `gain` as a number or another "
                    "keyword"
                )
            if gain != found[0]:
                raise InputError(
                    f"the images have several gains: {word} of {self._paths[0]} is {found[0]:g}, "
                    f"of {path} {gain:g}; convert them to electrons"
                )
        return found[0]

    def _unit(self) -> Any:
        """Return the unit of the images, without dimension where their headers have no unit."""
        first, *others = (units.parse(self._bunit(j)) for j in range(len(self._paths)))
        for path, unit in zip(self._paths[1:], others, strict=True):
            if unit != first:
                raise InputError(
                    f"the images have several units: {self._paths[0]} has {first or 'no unit'}, "
                    f"{path} has {unit or 'no unit'}; convert them to one"
                )
        return dimensionless_unscaled if first is None else first

    def _bunit(self, j: int) -> str:
        return str(read_keyword(self._paths[j], self._images.headers[j], "BUNIT") or "")

    def _exposure(self) -> Array | None:
        words = self._calibration.exposure
        if self._electrons_in_units is not None:
            if words:
                note("`exposure` is left out: the electrons in the unit have it")
            return self._electrons_in_units
        if not words:
            return None

        def seconds(j: int, keyword: str) -> float | None:
            return self._from_header("exposure", j, keyword, " seconds")

        return self._maps.combine("exposure", self._maps.fill("exposure", words, seconds))

    def _from_header(self, name: str, j: int, keyword: str, unit: str = "") -> float | None:
        return keyword_number(self._images, self._paths, name, j, keyword, unit)

    @cached_property
    def _noise_map(self) -> NoiseMap | None:
        given = self._calibration
        if given.noise and any(given.read_noise):
            raise InputError("give `read_noise`, or give `noise`, which includes it, not both")
        return read_noise_map(given.noise, self._maps, lambda: self._extensions("ERR", "noise"))

    def _mask(self, exposure: Array | None, noise: NoiseMap | None) -> Mask:
        """Return which pixels are bad, and log their number, each pixel for its first reason."""
        beyond = self._beyond()
        masked = beyond.copy()
        for why, bad in self._bad_pixels(exposure, noise):
            for j, count in enumerate((bad & ~masked).sum(axis=(1, 2))):
                note("`images[%d]`: %s masked %s", j, counted(count, "pixel"), why)
            masked |= bad
        n_masked, n_pixels = ((~beyond & each).sum(axis=(1, 2)) for each in (masked, ~beyond))
        for j, share in enumerate(n_masked / n_pixels):
            if share > MUCH_MASKED:
                warn(
                    f"{100 * share:.0f} % of `images[{j}]` are masked: look at why, above; leave "
                    "`mask` out, or name flags that are no fault, as in `mask` dq:16, if they are "
                    "good"
                )
        return masked

    def _beyond(self) -> Mask:
        """Return which pixels are beyond images that are smaller than others."""
        beyond = np.ones(self._images.data.shape, bool)
        for each, (ny, nx) in zip(beyond, self._images.shapes, strict=True):
            each[:ny, :nx] = False
        return beyond

    def _bad_pixels(
        self, exposure: Array | None, noise: NoiseMap | None
    ) -> Iterator[tuple[str, Mask]]:
        words = self._calibration.mask
        flags = [word for word in words if word.partition(":")[0] == "dq"]
        if paths := [word for word in words if word not in (*flags, "wht")]:
            yield "by the mask", self._maps.read("mask", paths) != 0  # NaN is not 0 either
        if flags:
            yield "by the extension DQ", self._data_quality(flags[-1])
        if "wht" in words:
            yield "without weight", self._extensions("WHT", "mask") == 0
        level = self._calibration.saturation
        if level is not None:
            yield f"as saturated, at {level:g} or above", self._images.data >= level
        if exposure is not None and exposure.ndim == 3:
            yield "without exposure", exposure == 0
        if noise is not None:
            yield "by the map of noise", noise.variance == 0

    def _data_quality(self, word: str) -> Mask:
        sums = self._extensions("DQ", "mask")
        flagged = np.empty(sums.shape, bool)
        for j, header in enumerate(self._images.headers):
            path, good_bits = self._paths[j], word[len("dq:") :]
            if word == "dq":
                words = (
                    str(read_keyword(path, header, keyword) or "").strip()
                    for keyword in ("TELESCOP", "INSTRUME", "DETECTOR")
                )
                good_bits = good_bits_of(*words)
            if good_bits != NO_BITS:
                note("%s: of the flags in DQ %s are no fault", path, good_bits)
            of_file = slice(None) if len(self._paths) == 1 else slice(j, j + 1)
            flagged[of_file] = bad_pixels(sums[of_file], good_bits, path)
            flag, n = most_common_flag(sums[of_file][flagged[of_file]])
            if n:
                note("%s: %s the flag %d of DQ", path, _have(n), flag)
        return flagged

    def _extensions(self, name: str, instead: str) -> Array:
        """Return the extensions of this name beside the images, shape (p, ny, nx)."""
        images, shapes = self._images.data, self._images.shapes
        found = []
        for path, shape in zip(self._paths, shapes, strict=False):
            values = read_extension(path, name)
            if values is None:
                raise InputError(
                    f"{path} has no extension {name}; give `{instead}` as a file, or leave it out"
                )
            # A file holds one image, or a cube of all images.
            of_cube = images.shape if len(self._paths) == 1 else shape
            if values.shape not in (shape, of_cube):
                raise InputError(
                    f"the extension {name} of {path} has the shape {values.shape}, its image "
                    f"{of_cube}; give `{instead}` as a file"
                )
            found.append(enlarged(values, images.shape[1:]))
        return np.broadcast_to(np.array(found).reshape(-1, *images.shape[1:]), images.shape)

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
        if is_subtracted and not any(words) and self._noise_map is None:
            note("the sky of the images was subtracted: its noise is measured as read noise")
            words = ["auto"]
        if not any(isinstance(word, str) for word in words):
            return words

        def electrons(j: int, word: str) -> float | None:
            if word == "auto":
                return sky_noise(j, counts[j], mask[j])
            return self._from_header("read_noise", j, word, " electrons")

        return self._maps.fill("read_noise", words, electrons)


def _in_own_shapes(stack: Array, shapes: Sequence[tuple[int, int]]) -> Array | list[Array]:
    """Return a stack, or of several shapes a list."""
    if len(set(shapes)) == 1:
        return stack
    return [each[:ny, :nx] for each, (ny, nx) in zip(stack, shapes, strict=True)]


def _have(n: int) -> str:
    return f"{counted(n, 'pixel')} {'has' if n == 1 else 'have'}"


def _maps(values: Array) -> Array:
    return values if values.ndim == 3 else values[:, None, None]
