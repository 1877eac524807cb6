"""The unit of images in files, and how many electrons it is: by header, gain, exposure or noise."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from astropy.units import dimensionless_unscaled

from lnocl.core.scene import units
from lnocl.core.scene.arrays import Array
from lnocl.errors import InputError, detail, note, warn
from lnocl.io.fitsread import read_contents, read_keyword
from lnocl.io.headers import CONVERTERS
from lnocl.io.image_files import ImageFiles
from lnocl.io.levels import is_rate
from lnocl.io.names import ERR
from lnocl.io.noise import electrons_by_variance

# The keywords that headers have for a gain and an exposure.
KEYWORDS = {"gain": ("GAIN", "EGAIN", *CONVERTERS), "exposure": ("EXPTIME", "EXPOSURE")}


class Electrons:
    """The electrons in the unit of images.

    Parameters
    ----------
    files : ImageFiles
        The images.
    """

    def __init__(self, files: ImageFiles) -> None:
        self._files, self._paths = files, files.paths

    def factor(self, exposure: Array | None) -> tuple[float, bool]:
        """Return the electrons in a unit of the images, and whether they are per second."""
        if self.in_units is not None:
            return 1.0, True
        gain, counts = self.gain, self._counts(("adu",))
        if gain is not None and not (np.isfinite(gain) and gain > 0):
            raise InputError(f"`gain` must be more than 0; {gain:g} was given")
        if gain is None and self._counts() is None:
            raise InputError(
                f"{self._paths[0]} is in {self._files.bunit(0)}, not in counts; give `gain`, the "
                "electrons in one of these units: a number, "
                + (
                    "or a keyword of its header such as GAIN"
                    + self.typed(("gain", "exposure")[: 1 + bool(counts and counts[1])])
                    if counts or not units.is_known(self.unit)
                    else "the exposure in seconds over the value of one electron per second"
                )
            )
        factor, are_rates = counts or (1.0, exposure is not None and units.is_known(self.unit))
        factor *= 1.0 if gain is None else gain
        if not units.is_known(self.unit):
            if exposure is not None:
                are_rates = all(
                    is_rate(factor * image, exposure[min(j, len(exposure) - 1)])
                    for j, image in enumerate(self._files.stack.data)
                )
            name = "electrons" if gain is None else "counts"
            note(
                "%s has %s: %s",
                self._paths[0],
                f"BUNIT {self._files.bunit(0)}" if self._files.bunit(0) else "no BUNIT",
                f"by its noise it is in {name} per second"
                if are_rates
                else f"its unit is taken to be {name}" + self.typed(("gain",)),
            )
        elif units.count_of(self.unit, ("electron",)) and gain not in (None, 1.0):
            warn(
                f"{self._paths[0]} is in {self._files.bunit(0)} by BUNIT, and is taken times gain "
                f"{gain:g}: leave `gain` out, unless BUNIT is wrong"
            )
        return factor, are_rates

    def typed(self, names: Sequence[str]) -> str:
        """Return which keywords of the header have what was not given, and what to type."""
        given, found = self._files.calibration, {}
        for name in names:
            for keyword in () if getattr(given, name) else KEYWORDS[name]:
                value = read_keyword(*self._files.stack.file_of(0), keyword)
                if isinstance(value, (int, float)) and 0 < value < np.inf:
                    found[name] = f"{keyword} {value:g}", f"`{name}`={keyword}"
                    break
        if not found:
            return ""
        held, words = zip(*found.values(), strict=True)
        return f"; its header has {' and '.join(held)}: give {' '.join(words)}"

    def _counts(self, others: Sequence[str] = ()) -> tuple[float, bool] | None:
        """Return the counts in the unit of the images, of these kinds too, as `units.count_of`."""
        unit = self.unit
        if unit.is_equivalent(dimensionless_unscaled) and unit != dimensionless_unscaled:
            return None  # numbers and per cents do not count anything
        return units.count_of(unit, (*units.COUNTS, *others))

    @cached_property
    def in_units(self) -> Array | None:
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
        gain = self._files.calibration.gain
        held = frozenset.intersection(*(read_contents(path).extensions for path in self._paths))
        words = [gain.upper()] if isinstance(gain, str) else ["VAR_POISSON", "`noise`", "ERR"]
        if isinstance(gain, float) or (gain is None and self._counts() is not None):
            return None
        noise = self._files.noise
        has_errors = noise is not None and noise.kind == ERR
        found_in = [word for word in words if word in held or (word == "`noise`" and has_errors)]
        if not found_in:
            return None
        word = found_in[0]
        if word == "`noise`" and noise is not None:
            variances = noise.variance
        else:
            variances = self._files.extensions(word, "gain") ** (2 if word == "ERR" else 1)
        flags = self._files.extensions("DQ", "mask") if "DQ" in held else [None] * len(variances)
        planes = zip(self._files.stack.data, variances, flags, strict=True)
        found = [
            electrons_by_variance(image, variance, self._files.stack.file_of(j)[0], sums)
            for j, (image, variance, sums) in enumerate(planes)
        ]
        for j, electrons in enumerate(found):
            detail("`images[%d]`: %.4g electrons in its unit, by %s", j, electrons, word)
        return np.array(found)

    @cached_property
    def gain(self) -> float | None:
        """The gain, as given or as all headers have it."""
        word = self._files.calibration.gain
        if self._by_noise is not None:
            return float(self._by_noise.mean()) if self.in_units is None else None
        if not isinstance(word, str):
            return word
        found = [self._files.stack.number("gain", j, word) for j in range(len(self._paths))]
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

    @cached_property
    def unit(self) -> Any:
        """The unit of the images, without dimension where their headers have no unit."""
        first, *others = (units.parse(self._files.bunit(j)) for j in range(len(self._paths)))
        for path, unit in zip(self._paths[1:], others, strict=True):
            if unit != first:
                raise InputError(
                    f"the images have several units: {self._paths[0]} has {first or 'no unit'}, "
                    f"{path} has {unit or 'no unit'}; convert them to one"
                )
        return dimensionless_unscaled if first is None else first
