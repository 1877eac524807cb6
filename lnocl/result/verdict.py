"""The verdict on a result: that the model fits, or where it does not and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.psfs import PSF_ERROR
from lnocl.core.scene.star_psfs import owned
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.errors import MisfitWarning, counted, in_words, warn
from lnocl.progress import Progress

if TYPE_CHECKING:
    from lnocl.result import Result

# What it is where nothing is wrong.
FITS = "the model fits"
# Where a star without light may be instead: so many pixels from its place.
ELSEWHERE = 10
# Electrons, or per second, that iterations which multiply leave of a star without light.
NO_LIGHT = 1e-6
# Where less than this share of the stars does not fit, that is not by the PSF.
FEW = 0.4
# Of a star that was moved by this share of `MAX_SHIFT` more may be needed.
AT_LIMIT = 0.99


def warn_of_faults(result: Result, progress: bool) -> None:
    """Warn of each of the faults of a result.

    Warns
    -----
    MisfitWarning
        The model does not fit.
    """
    with (
        np.errstate(over="ignore", invalid="ignore"),
        Progress(None, "", bool(progress), "measuring residuals"),
    ):
        found = faults(result)
    for line in found:
        warn(line, MisfitWarning)


def faults(result: Result) -> list[str]:
    """Return where the model does not fit and what to do, a line each; parameters by their names.

    They are those of stars without light, of stars that moved too far, and of residuals far from
    what noise leaves, or the error of the PSF that the errors of fluxes hold; light all round a
    star, as a PSF that is too narrow leaves it; and light that star and host may exchange.
    """
    findings, at_stars, overall = result._findings, result.star_residuals(), result.fit()
    labels = findings.observation.epoch_labels
    n_epochs, word = len(labels), findings.observation.epoch_word
    unfitted, held, lit, dark, lost, paired = (_Told(labels, word) for _ in range(6))
    most, of_cores = min(findings.observation.psf_error, PSF_ERROR), 0.0
    for s, (place, given, flux, found) in enumerate(
        zip(
            result.star_positions, findings.given_positions, result.star_fluxes, at_stars,
            strict=True,
        )
    ):  # fmt: skip
        if np.isnan(flux):  # no image shows it, as the run has told
            continue
        if not flux > NO_LIGHT:
            where = _elsewhere(result.extended, place, findings.observation.oversample)
            dark.add(s, in_words(given), where)
            continue
        if np.hypot(*(place - given)) > AT_LIMIT * MAX_SHIFT:
            lost.add(s, in_words(given), f" to {in_words(place)}")
        if found.is_misfit:
            if found.core_error < most and not found.wings.is_misfit:
                of_cores += found.core.square_sum
                held.add(s, in_words(place), share=found.core_error)
            else:
                unfitted.add(s, in_words(place))
        if found.has_halo:
            lit.add(s, in_words(place), share=found.halo)
        if found.is_like_host:
            paired.add(s, in_words(place), share=found.exchanged)
    lines = []
    if dark:
        lines.append(f"no light is left for {dark.count()}: {dark.words('; ')}")
    if lost:
        lines.append(
            f"{lost.count()} moved as far as stars may, {MAX_SHIFT:g} pixels, from "
            f"{lost.words('; ')}: give the place where it is brightest"
        )
    if unfitted:
        from lnocl.core.scene.psf_faults import name_faults  # which loads scipy

        places = findings.given_positions[::n_epochs]
        seen = places[owned(findings.observation, places) < 0]
        remedy = name_faults(findings.observation, seen) or "give a better PSF" + (
            ", or try `refine_psfs` jitter pixels" if findings.may_free_pixels else ""
        )
        if len(unfitted) < FEW * len(places):
            remedy = (
                "the PSF fits the others: see whether a cosmic ray or another star lies there, or "
                "beside a star that the PSF was made of"
            )
        lines.append(
            f"the model does not fit at {len(unfitted)} of "
            f"{counted(len(at_stars) // n_epochs, 'star')}, {unfitted.words(' ')}: {remedy}"
        )
    elif overall.is_misfit and not (dark or lost) and of_cores < 0.5 * overall.square_sum:
        lines.append("the model does not fit: see to background, noise and gain")
    if held:
        lines.append(
            f"the PSF is off at {held.count()}, {held.words('; ')}: within its error, which the "
            "errors of fluxes hold"
        )
    refinement = result.psf_refinement
    is_fitted = refinement is not None and refinement.has_free_pixels  # which follow the noise
    if overall.is_overfit and not is_fitted:
        lines.append(
            "the residuals are far less than noise: the noise that is taken is too large (see to "
            "unit, gain, exposure, background and read noise), or the model follows the noise"
            + ("" if result.smoothing > 0.0 else " (take fewer iterations, or `smoothing`)")
        )
    if lit:
        lines.append(
            f"light lies all round {lit.count()}, as a share of its flux: {lit.words('; ')}: a "
            "host, or the PSF is too narrow or lacks its wings, or the background is too low"
        )
    if paired:
        lines.append(
            f"{paired.count()} may exchange light with the extended source there, up to this share "
            f"of the star's: {paired.words('; ')}: a sharper image tells them apart, or a PSF that "
            "is known to be exact (`psf_error` 0 with a `smoothing`)"
        )
    return lines


def is_doubt(fault: str) -> bool:
    """Return whether a fault may be none, or errors hold it, as light that a host may have."""
    parts = "light lies all round", " may exchange light with ", ": within its error, which"
    return any(part in fault for part in parts)


class _Told:
    """What is told of stars, once of each, whatever epochs it is of."""

    def __init__(self, epoch_labels: Sequence[str], word: str) -> None:
        self._labels, self._word = epoch_labels, word
        self._found: dict[int, list[tuple[int, str, str, float]]] = {}

    def __len__(self) -> int:
        return len(self._found)

    def add(self, s: int, place: str, more: str = "", share: float = np.nan) -> None:
        """Add what is told of flux `s`: the star's place, more words, and a share of its light."""
        star, epoch = divmod(s, len(self._labels))
        self._found.setdefault(star, []).append((epoch, place, more, share))

    def count(self) -> str:
        """Return how many stars these are."""
        return counted(len(self), "star")

    def words(self, between: str) -> str:
        """Return what is told of the first three."""
        return between.join([self._of_star(each) for each in [*self._found.values()][:3]])

    def _of_star(self, found: list[tuple[int, str, str, float]]) -> str:
        epoch, place, more, _ = found[0]
        n = len(found)
        one = "images of" if self._word == "filter" else self._word
        when = f" in {counted(n, self._word) if n > 1 else f'{one} {self._labels[epoch]}'}"
        ends = [f"{100 * end([share for *_, share in found]):.0f}" for end in (min, max)]
        shares = "" if ends[0] == "nan" else f", {' to '.join(dict.fromkeys(ends))} %"
        return f"{place}{when * (len(self._labels) > 1)}{more}{shares}"


def _elsewhere(extended: Array, place: Array, finer: int) -> str:
    """Return where the brightest light near a star without light is, and what to do."""
    extended = extended.reshape(-1, *extended.shape[-2:]).sum(axis=0)
    x, y = np.round(on_sky(place, finer)).astype(int)
    reach = ELSEWHERE * finer
    rows, columns = (slice(max(at - reach, 0), max(at + reach + 1, 0)) for at in (y, x))
    around = extended[rows, columns]
    if not around.any():
        return ", nor near it: leave it out"
    row, column = np.unravel_index(int(around.argmax()), around.shape)
    at = np.array([columns.start + column, rows.start + row], float)
    brightest = (at - (finer - 1) / 2.0) / finer
    return (
        f", and the brightest light within {ELSEWHERE} pixels lies at {in_words(brightest)}: give "
        "the star's place, or leave it out"
    )
