"""An observation from FITS files: counts, exposures, backgrounds, masks, offsets."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray

from lnocl import sky
from lnocl.errors import InputError
from lnocl.fitsread import Stack, read_extension, read_stack
from lnocl.observation import Observation
from lnocl.units import count_of

log = logging.getLogger("lnocl")

# Units that headers have in other words than astropy's.
UNIT_WORDS = {
    r"\b(electron|count|photon|ct)s\b": r"\1",
    r"\bcts\b": "ct",
    r"\be-": "electron",
    r"\bdn\b": "adu",
    r"\bsec(onds?)?\b": "s",
}

Word = str | float
Array = NDArray[np.float64]


class Known(NamedTuple):
    """What is known of images in files; words are numbers, names of files, or as said.

    Attributes
    ----------
    background : sequence of Word
        Electrons per pixel, one or one for each image: a number, a map, or ``"auto"``, the
        sigma-clipped median of the image.
    read_noise : sequence of Word
        Standard deviation, electrons: numbers or maps.
    inverse_variance : sequence of str
        Maps of one over the variance of all noise but that of the source, in units of the images.
    exposure : sequence of Word
        Seconds: numbers, maps, or a keyword of the images' headers.
    mask : sequence of str
        Maps, not 0 where a pixel is bad; or ``"dq"``, the extension DQ of each image's file.
    saturation : float, optional
        Pixels of this value and above, in units of the images, are bad.
    gain : float, optional
        Electrons for each unit of the images; then their unit does not matter.
    align : {"wcs"}, optional
        Offsets from the headers' coordinates.
    """

    background: Sequence[Word] = (0.0,)
    read_noise: Sequence[Word] = (0.0,)
    inverse_variance: Sequence[str] = ()
    exposure: Sequence[Word] = ()
    mask: Sequence[str] = ()
    saturation: float | None = None
    gain: float | None = None
    align: str | None = None


class Frames(NamedTuple):
    """An observation that was read.

    Attributes
    ----------
    observation : Observation
        In electrons; its sky per second where exposures were given.
    images : Stack
        The images as they lie in their files.
    background : list of Word
        As given, with the numbers that ``"auto"`` found.
    sha256 : dict of str to list of str
        Checksums of all files, by what they are: images, psfs, background, ...
    """

    observation: Observation
    images: Stack
    background: list[Word]
    sha256: dict[str, list[str]]


def read_frames(images: Sequence[str], psfs: Sequence[str], known: Known) -> Frames:
    """Read images and PSFs, and what is known of them.

    What was done to the images is logged, such as how many pixels are masked and why.

    Parameters
    ----------
    images, psfs : sequence of str
        Files, as for `fitsread.read_stack`. The unit of the images is that of their BUNIT; without
        one they are in electrons.
    known : Known
        What is known of them.

    Raises
    ------
    FileError, InputError
        As `fitsread.read_stack` and `Observation`; a unit that is no count; counts per time
        without exposure; maps that do not fit.
    """
    return _Reader(images, psfs, known).frames()


class _Reader:
    """The files of an observation on their way to be one."""

    def __init__(self, images: Sequence[str], psfs: Sequence[str], known: Known) -> None:
        self._paths, self._known = images, known
        self._images = read_stack(images)
        self._psfs = read_stack(psfs)
        self._sha256 = {"images": self._images.sha256, "psfs": self._psfs.sha256}

    def frames(self) -> Frames:
        """Return the observation that the files are."""
        known, data = self._known, self._images.data
        factor, are_rates = self._electrons()
        exposure = self._values("exposure", known.exposure) if known.exposure else None
        if are_rates and exposure is None:
            raise InputError(
                f"{self._paths[0]} holds counts per time: give --exposure, in seconds: a number, "
                "a map, or a keyword of the header such as EXPTIME"
            )
        mask = self._mask()
        # What a unit of the images is in electrons.
        each = factor * (_maps(exposure) if are_rates and exposure is not None else 1.0)
        counts = data * each
        read_noise = self._read_noise(each, mask)
        background = self._background(counts, mask)
        observation = Observation(
            counts,
            self._psfs.data,
            self._combine(background),
            read_noise,
            mask if mask.any() else None,
            1.0 if exposure is None else exposure,
            self._offsets(),
        )
        return Frames(observation, self._images, background, self._sha256)

    def _electrons(self) -> tuple[float, bool]:
        """Return how many electrons a unit of the images is, and whether per second."""
        units = [_unit_of(header) for header in self._images.headers]
        if len(set(map(str, units))) > 1:
            raise InputError(f"the images come in several units: {', '.join(map(str, units))}")
        counts = None if units[0] is None else count_of(units[0])
        gain = self._known.gain
        if gain is not None:
            if not (np.isfinite(gain) and gain > 0):
                raise InputError(f"the gain must be a number more than 0; {gain:g} was given")
            is_per_time = units[0] is not None and (
                units[0].is_equivalent(u.adu / u.s) or (counts is not None and counts[1])
            )
            return gain, is_per_time
        if units[0] is None:
            return 1.0, False
        if counts is None:
            raise InputError(
                f"{self._paths[0]} is in {self._images.header['BUNIT']}, which is no count: give "
                "--gain, the electrons for each unit of it"
            )
        return counts

    def _mask(self) -> NDArray[np.bool_]:
        data = self._images.data
        masked = np.zeros(data.shape, bool)
        if words := [word for word in self._known.mask if word != "dq"]:
            given = self._read("mask", words)
            masked |= given.data != 0  # NaN is not 0 either
            self._announce("by the mask", masked)
        if "dq" in self._known.mask:
            flagged = self._data_quality()
            self._announce("by the extension DQ", flagged & ~masked)
            masked |= flagged
        if self._known.saturation is not None:
            saturated = data >= self._known.saturation
            self._announce(
                f"saturated, at {self._known.saturation:g} or above", saturated & ~masked
            )
            masked |= saturated
        return masked

    def _data_quality(self) -> NDArray[np.bool_]:
        stack = []
        for path in self._paths:
            flags = read_extension(path, "DQ")
            if flags is None:
                raise InputError(f"{path} has no extension DQ; give a mask file, or leave dq out")
            if flags.shape != self._images.data.shape[1:] or len(self._paths) != self._count:
                raise InputError(
                    f"the extension DQ of {path} has the shape {flags.shape}, its image "
                    f"{self._images.data.shape[1:]}; give a mask file"
                )
            stack.append(flags != 0)
        return np.array(stack)

    def _announce(self, why: str, masked: NDArray[np.bool_]) -> None:
        for j, count in enumerate(masked.sum(axis=(1, 2)), 1):
            log.info("image %d: %d pixels masked %s", j, count, why)

    def _read_noise(self, each: Array | float, mask: NDArray[np.bool_]) -> Array | list[float]:
        if not self._known.inverse_variance:
            return self._values("read_noise", self._known.read_noise)
        if any(self._known.read_noise):
            raise InputError("give read noise or inverse variance, which holds it, not both")
        inverse = self._read("inverse_variance", self._known.inverse_variance).data
        if (inverse < 0).any():
            raise InputError("the inverse variance must not be negative")
        unknown = ~np.isfinite(inverse) | (inverse == 0)
        unknown = np.broadcast_to(unknown, mask.shape)
        if unknown.any():
            self._announce("without variance", unknown & ~mask)
        mask |= unknown
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(mask, 0.0, each / np.sqrt(inverse))

    def _background(self, counts: Array, mask: NDArray[np.bool_]) -> list[Word]:
        """Return the background with numbers in the place of "auto"."""
        from astropy.stats import sigma_clipped_stats

        words = self._one_each("background", self._known.background)
        for j, word in enumerate(words):
            if word == "auto":
                bad = mask[j] | ~np.isfinite(counts[j])
                _, median, scatter = sigma_clipped_stats(counts[j], bad)
                log.info(
                    "image %d: background %.6g electrons per pixel, scatter %.3g (sigma-clipped "
                    "median)",
                    j + 1,
                    median,
                    scatter,
                )
                if median < 0:
                    raise InputError(
                        f"image {j + 1} has a sigma-clipped median of {median:.6g} electrons: its "
                        "background was subtracted already; give --background 0, and its noise as "
                        "--read-noise or --inverse-variance"
                    )
                words[j] = float(median)
        return words

    def _one_each(self, name: str, words: Sequence[Word]) -> list[Word]:
        """Return a word for each image, where any must be found out for itself."""
        if "auto" not in words:
            return list(words)
        if len(words) not in (1, self._count):
            raise InputError(
                f"{len(words)} values of {name} for {self._count} images; give one, or one for each"
            )
        return list(words) * (self._count if len(words) == 1 else 1)

    def _values(self, name: str, words: Sequence[Word]) -> Array:
        keyword = words[0]
        if name == "exposure" and isinstance(keyword, str) and keyword in self._images.header:
            return self._from_headers(keyword, len(words))
        return self._combine(words, name)

    def _from_headers(self, keyword: str, n_words: int) -> Array:
        headers = self._images.headers
        if n_words > 1 or any(not isinstance(h.get(keyword), (int, float)) for h in headers):
            raise InputError(
                f"the keyword {keyword} must stand alone, and be a number in each file"
            )
        values = np.array([float(header[keyword]) for header in headers])
        log.info("exposure from %s: %s seconds", keyword, ", ".join(f"{v:g}" for v in values))
        return values

    def _combine(self, words: Sequence[Word], name: str = "background") -> Array:
        """Return numbers as they are, or maps with numbers spread over theirs."""
        if all(isinstance(word, float) for word in words):
            return np.array(words, float)
        if all(isinstance(word, str) for word in words):
            return self._read(name, [str(word) for word in words]).data
        shape = self._images.data.shape[1:]
        return np.array(
            [
                np.full(shape, word)
                if isinstance(word, float)
                else self._read(name, [str(word)]).data[0]
                for word in words
            ]
        )

    def _read(self, name: str, paths: Sequence[str]) -> Stack:
        """Read maps of the images' shape, one or one for each."""
        stack = read_stack(paths)
        shape, n = self._images.data.shape[1:], len(stack.data)
        if stack.data.shape[1:] != shape or n not in (1, self._count):
            raise InputError(
                f"{paths[0]}: {n} maps of {stack.data.shape[1:]} for {self._count} images of "
                f"{shape}; give one map of that shape, or one for each image"
            )
        self._sha256[name] = self._sha256.get(name, []) + stack.sha256
        return stack._replace(data=np.broadcast_to(stack.data, self._images.data.shape))

    def _offsets(self) -> Array | None:
        if self._known.align is None:
            return None
        headers = self._images.headers
        if len(headers) != self._count:
            raise InputError("a cube has one WCS for all images; give one file for each image")
        found = sky.offsets(headers, self._paths, self._images.data.shape[1:])
        for j, (dx, dy) in enumerate(found[1:], 2):
            log.info("image %d: offset %.3f, %.3f pixels in x, y, from the WCS", j, dx, dy)
        return found

    @property
    def _count(self) -> int:
        return len(self._images.data)


def _maps(values: Array) -> Array:
    return values if values.ndim != 1 else values[:, None, None]


def _unit_of(header: fits.Header) -> u.UnitBase | None:
    """Return the unit of an image; None where its header gives none."""
    text = str(header.get("BUNIT", "")).strip()
    if not text:
        return None
    words = text.lower()
    for pattern, replacement in UNIT_WORDS.items():
        words = re.sub(pattern, replacement, words)
    unit = u.Unit(words, parse_strict="silent")
    return u.Unit(text, parse_strict="silent") if isinstance(unit, u.UnrecognizedUnit) else unit
