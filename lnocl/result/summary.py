"""What a result says in words: fluxes and their errors, whether to trust them, how it ended."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.counts import means
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.errors import counted, in_words
from lnocl.residuals import SIGNIFICANCE, Fit, sharp_sources
from lnocl.result.verdict import faults, is_doubt

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation
    from lnocl.result import Result

# Stars, and epochs, that have a line each; those of whose stars a table has columns.
MAX_LISTED, MAX_COLUMNS = 12, 4
# The darkest share of the extended source, and how bright it may be, in standard deviations of a
# pixel's noise.
DARK_SHARE, FLOOR = 0.05, 0.5
# Residuals are called noise so near to it, relatively.
NOISE = 0.05
# Of a star that is masked in all images, or in all of its epoch.
NOT_SHOWN = "unknown, as no good pixel shows it"
# Numbers from the first on, and those whose error is below the second, have an exponent.
LARGE, SMALL = 1e7, 1e-4
# A number that its error follows.
NUMBER = re.compile(r"[-+.\de ]+(?= \+-)")

ENDS = {
    "n_iter": ", all that were allowed",
    "held-out": "{and_smoothing} by held-out counts",
    "discrepancy": ": the data are fitted as well as noise allows",
    "change": ": the objective hardly changes any more",
    "converged": ": no step lowers the objective any more",
    "diverged": ": the objective rose after the last",
    "not finite": ": the objective was not finite after the last",
    "interrupt": ": it was interrupted",
    "callback": ": the callback ended it",
}


class Unit(NamedTuple):
    """A unit of flux: its name in the plural, and the electrons that it is."""

    name: str
    electrons: float = 1.0

    def flux(self, value: float, error: float) -> str:
        """Return a flux and its error, given in electrons, in this unit."""
        return f"{with_error(value / self.electrons, error / self.electrons)} {self.name}"


def with_error(value: float, error: float) -> str:
    """Return a number and its error, both to two digits of the error.

    Examples
    --------
    >>> from lnocl.result.summary import with_error
    >>> with_error(142837.2, 314.0), with_error(0.0123456, 0.00098), with_error(3.53185e7, 1.1e6)
    ('142 840 +- 310', '0.01235 +- 0.00098', '3.53e+07 +- 1.1e+06')
    """
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(error) or error <= 0.0:
        return f"{value:.6g}"
    last = int(f"{error:.1e}".partition("e")[2]) - 1  # the place of the error's second digit
    largest = max(abs(value), error)
    if largest >= LARGE or error < SMALL:
        digits = max(int(f"{value:.0e}".partition("e")[2]) - last, 0) if value else 0
        return f"{value:.{digits}e} +- {error:.1e}"
    numbers = (f"{round(each, -last) + 0.0:,.{max(-last, 0)}f}" for each in (value, error))
    return " +- ".join(numbers).replace(",", " ")


def rounded(value: float, error: float) -> str:
    """Return a number to two digits of its error, without it."""
    return with_error(value, error).partition(" +- ")[0]


def summary_lines(result: Result, unit: Unit | None = None, is_warned: bool = False) -> list[str]:
    """Return the fluxes of a result, whether to trust them, and how it ended, in a few lines.

    Parameters
    ----------
    result : Result
        The result.
    unit : Unit, optional
        That of the images (default: electrons, per second where exposures were given).
    is_warned : bool, optional
        Whether there were warnings beside those of a model that does not fit.
    """
    unit = unit or Unit(result._unit.replace("electron", "electrons"))
    curves = _light_curves(result, unit)
    rows = [] if curves else _star_rows(result, unit)
    rows += result._halo_rows()
    names = result.component_names or ("extended",)
    for name, flux, error in zip(names, *map(np.atleast_1d, result.extended_flux), strict=True):
        rows.append((name, f"{unit.flux(flux, error)} in the frame"))
    verdict, *more = _trust(result, unit, is_warned)
    rows += [("trust", verdict), *(("", each) for each in more)]
    return [*curves, *_aligned(rows), _end(result)]


def _aligned(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return labels and words in two columns, and numbers with their errors one below another."""
    found = [NUMBER.match(words) for _, words in rows]
    width = max(len(label) for label, _ in rows)
    most = max((each.end() for each in found if each), default=0)
    return [
        f"{label:{width}}  {' ' * (most - number.end() if number else 0)}{words}".rstrip()
        for (label, words), number in zip(rows, found, strict=True)
    ]


def details(result: Result) -> list[str]:
    """Return what else a result can say: its residuals and its objective, a line each."""
    at_stars = zip(result.star_positions, result.star_residuals(), strict=True)
    return [
        f"residuals, 1 for noise alone: {_rms(result.fit())} in all",
        *(
            f"residuals at the star at {in_words(place)}: {_rms(found.core)} in its core, "
            f"{_rms(found.wings)} in its wings"
            for place, found in at_stars
            if found.core.n_pixels
        ),
        f"objective {result.history['objective'][-1]:.6g} on {result.device}",
    ]


def _star_rows(result: Result, unit: Unit) -> list[tuple[str, str]]:
    """Return label and flux of each star, of one epoch or of several."""
    observation, shown = result._observation, []
    n, labels, word = observation.n_epochs, observation.epoch_labels, observation.epoch_word
    stars = result.star_positions[::n], result.star_fluxes, result.star_flux_errors
    fluxes, errors = (np.reshape(each, (-1, n)) for each in stars[1:])
    for k, (place, flux, error) in enumerate(zip(stars[0], fluxes, errors, strict=True), 1):
        seen, words = np.isfinite(flux), NOT_SHOWN
        if seen.sum() == 1:
            words = unit.flux(flux[seen][0], error[seen][0])
        elif seen.any() and result.component_names and n <= MAX_COLUMNS:
            pairs = zip(labels, flux / unit.electrons, error / unit.electrons, strict=True)
            each = (f"{with_error(*numbers)} in {label}" for label, *numbers in pairs)
            words = f"{'; '.join(each)}, {unit.name}"
        elif seen.any():
            middle = float(np.median(error[seen]))
            low, high = (
                with_error(end(flux[seen]) / unit.electrons, middle / unit.electrons).split(" +- ")
                for end in (np.min, np.max)
            )
            words = f"{low[0]} to {' +- '.join(high)} {unit.name} in {seen.sum()} {word}s"
        shown.append((f"star {k} {_rounded(place)}", words))
    n_more = len(shown) - MAX_LISTED
    return shown if n_more <= 1 else [*shown[:MAX_LISTED], (f"{n_more} more stars", "in its table")]


def _light_curves(result: Result, unit: Unit) -> list[str]:
    """Return a table with a row for each epoch and a column for each star, if they are few.

    Errors of epochs are those of the changes; that of the mean holds what all epochs share. With
    several components rows are of filters, whose fluxes have no mean.
    """
    n = result._observation.n_epochs
    n_stars = len(result.star_fluxes) // n
    if not (1 < n <= MAX_LISTED and 0 < n_stars <= MAX_COLUMNS):
        return []
    is_one, labels = not result.component_names, result._observation.epoch_labels
    columns = [["epoch" if is_one else "images of", *labels, *["mean"] * is_one]]
    own_errors = result.star_variation_errors if is_one else result.star_flux_errors
    fluxes, errors = (
        np.reshape(each, (n_stars, n)) / unit.electrons for each in (result.star_fluxes, own_errors)
    )
    for k, place in enumerate(result.star_positions[::n]):
        pairs, seen = zip(fluxes[k], errors[k], strict=True), np.isfinite(fluxes[k])
        mean = with_error(np.nan, np.nan)
        if seen.any():
            shared = result.star_flux_covariances[k][np.ix_(seen, seen)].mean()
            mean = with_error(fluxes[k][seen].mean(), np.sqrt(shared) / unit.electrons)
        rows = [*(with_error(*pair) for pair in pairs), *[mean] * is_one]
        columns.append([f"star {k + 1} {_rounded(place)}", *rows])
    widths = [max(map(len, column)) for column in columns]
    lines = [
        "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))
        for row in zip(*columns, strict=True)
    ]
    lines[0] += f"  {unit.name}" + ", errors of epochs against the mean" * is_one
    return lines


def _trust(result: Result, unit: Unit, is_warned: bool) -> Iterator[str]:
    """Yield whether to trust a result and why not; then what its extended source may hold."""
    first, *others = found = faults(result) or [""]
    if first:
        yield f"{'perhaps' if all(map(is_doubt, found)) else 'no'}: {first}"
        yield from others
    elif is_warned:
        yield f"yes, but see the warnings: {_residuals(result.fit())}"
    else:
        fits = ", the PSF fits" if np.isfinite(result.star_fluxes).any() else ""
        yield f"yes: {_residuals(result.fit())}{fits}"
    yield from _floor(result, unit)
    yield from _unnamed(result, unit)
    yield from _shortness(result)


def _rounded(place: NDArray[np.float64]) -> str:
    return in_words(np.round(place, 2))


def _residuals(fit: Fit) -> str:
    if not fit.n_pixels or abs(fit.rms - 1.0) < max(NOISE, SIGNIFICANCE * fit.error):
        return "residuals are noise"
    return f"residuals are {fit.rms:.2f} times noise"


def _end(result: Result) -> str:
    smoothing = f" and smoothing {result.smoothing:.3g}" if result.held_out.size else ""
    why = ENDS[result.stop_reason].format(and_smoothing=smoothing)
    return f"{counted(result.n_iter, 'iteration')}{why}"


def _shortness(result: Result) -> Iterator[str]:
    if result.n_iter <= 1 and result.stop_reason not in ("interrupt", "callback", "n_iter"):
        yield (
            f"it ended after {counted(result.n_iter, 'iteration')}: there is little but noise, or "
            "PSF, background or noise are wrong"
        )


def _unnamed(result: Result, unit: Unit) -> Iterator[str]:
    """Yield a line on sources in the extended source that are as sharp as stars."""
    observation = result._observation
    levels = means(observation.background, observation.mask)
    background = float((levels / _areas(observation)).sum())
    # Of all images, whose noise tells.
    exposure = float(means(observation.exposure, observation.mask).sum())
    skies = result.extended.reshape(-1, *result.extended.shape[-2:]) * exposure
    each = (sharp_sources(sky, background, observation.oversample) for sky in skies)
    found = np.concatenate(list(each)) / (1.0, 1.0, exposure)
    found = found[np.argsort(-found[:, 2])]
    offsets = found[:, None, :2] - result.star_positions
    found = found[(np.hypot(*np.moveaxis(offsets, -1, 0)) > MAX_SHIFT).all(axis=1)]
    if len(found):
        (*place, light), n = found[0], len(found)
        yield (
            f"{counted(n, 'source')} in the extended source {'is' if n == 1 else 'are'} as sharp "
            f"as stars, the brightest at {in_words(place)} with {light / unit.electrons:.3g} "
            f"{unit.name}: give what is a star as `stars` too, and mask what is a cosmic ray"
        )


def _floor(result: Result, unit: Unit) -> Iterator[str]:
    """Yield a line where the extended source is nowhere dark."""
    observation = result._observation
    darkest = float(np.quantile(result.extended, DARK_SHARE, axis=(-2, -1)).max())
    counts = darkest * _areas(observation) * means(observation.exposure, observation.mask)
    levels = means(observation.background, observation.mask)
    if (counts > FLOOR * np.sqrt(levels + counts)).any():
        yield (
            f"the extended source is hardly darker anywhere than {darkest / unit.electrons:.3g} "
            f"{unit.name} a pixel: the background is too low by that, or light fills the frame"
        )


def _areas(observation: Observation) -> NDArray[np.float64]:
    """Return how many pixels of the sky are one of each image."""
    return np.asarray((observation.oversample * observation.scales) ** 2)


def _rms(fit: Fit) -> str:
    return f"{fit.rms:.2f} +- {fit.error:.2f}" if fit.n_pixels else "unknown (no good pixel)"
