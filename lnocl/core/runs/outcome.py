"""The outcome of a reconstruction: its estimate, and how that was reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.counts import means
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.errors import InputError, in_words, warn
from lnocl.residuals import MUCH_EXCHANGED, StarResiduals, judge_stars

if TYPE_CHECKING:
    from lnocl.core.solvers.levels import Levels
    from lnocl.core.solvers.light import Light, LightOfComponents

CURVE_DTYPE = np.dtype([("smoothing", np.float64), ("iteration", np.int64), ("error", np.float64)])


@dataclass(frozen=True)
class PsfRefinement:
    """The outcome for PSFs that do not fit, were to be refined, or are exact but for a scatter.

    Attributes
    ----------
    parameters : tuple of str
        Names of the n parameters of each PSF (`lnocl.core.scene.psf_families.PsfFamilies`).
    values : ndarray of float64, shape (p, n)
        Their values in the PSFs used; lengths in pixels of the images. Where the refined PSFs were
        not accepted, those that were found for them.
    misfit : tuple of float
        The reduced chi squared at the stars (`lnocl.core.scene.psf_misfit`), of the given PSFs and
        of those used: 1 for noise alone.
    is_accepted : bool
        Whether the refined PSFs are used (`lnocl.core.runs.psf_refinement.mend`).
    psf_error : float
        Relative error that the PSFs used still have at the stars, or, where `psf_error` of the
        observation is 0, as given by ``psf_scatter``; 0 where it is not told from noise. Where
        pixels were fitted it is the error before that.
    edges : ndarray of float64, shape (k + 1,)
        Radii of rings round a star, pixels.
    errors_in_rings : ndarray of float64, shape (k,)
        The same error in each ring.
    may_be_faked : ndarray of float64, of the shape of the extended source
        Light that this error may fake in the sky, electrons per pixel. In each ring it is the error
        times the light of the stars, as the PSFs spread it, over the square root of p.
    has_free_pixels : bool
        Whether the PSFs used were fitted pixel by pixel, and so follow the noise too.
    hidden_error : float
        Relative error that refined PSFs or places may have though noise hides it; it is in the
        errors of star fluxes.

    See Also
    --------
    lnocl.deconvolve : Refines PSFs with ``refine_psfs``.

    Examples
    --------
    One image of a star, whose PSF is exact but for 1 % in each pixel:

    >>> import numpy as np
    >>> import lnocl
    >>> y, x = np.indices((33, 33)) - 16
    >>> psf = np.exp(-(x**2 + y**2) / 4)
    >>> psf /= psf.sum()
    >>> known = {"psf_scatter": 0.01 * psf, "psf_error": 0.0}
    >>> observation = lnocl.Observation(5 + 1000 * psf, psf, **known)
    >>> result = lnocl.deconvolve(observation, [(16, 16)], stop=None, n_iter=5, engine="numpy")
    >>> result.psf_refinement.is_accepted
    False
    >>> round(result.psf_refinement.psf_error, 4)
    0.01
    """

    parameters: tuple[str, ...]
    values: Array
    misfit: tuple[float, float]
    is_accepted: bool
    psf_error: float
    edges: Array
    errors_in_rings: Array
    may_be_faked: Array
    has_free_pixels: bool = False
    hidden_error: float = 0.0


def joined_refinement(
    images: Sequence[Sequence[int]], found: Sequence[PsfRefinement | None], n_skies: int
) -> PsfRefinement | None:
    """Return the refinement of all images from those of filters, as far as there are any.

    Misfit, errors and what these may fake are those of the filter with the largest error.
    """
    pairs = [(which, each) for which, each in zip(images, found, strict=True) if each is not None]
    if not pairs:
        return None
    _, most = max(pairs, key=lambda pair: pair[1].psf_error)
    names = tuple(dict.fromkeys(name for _, each in pairs for name in each.parameters))
    values = np.zeros((sum(map(len, images)), len(names)))
    for which, each in pairs:
        columns = [names.index(name) for name in each.parameters]
        values[np.array(which)[:, None], columns] = each.values
    return replace(
        most,
        parameters=names,
        values=values,
        is_accepted=any(each.is_accepted for _, each in pairs),
        may_be_faked=np.broadcast_to(most.may_be_faked, (n_skies, *most.may_be_faked.shape)),
        hidden_error=max(each.hidden_error for _, each in pairs),
    )


class Mended(NamedTuple):
    """A setup whose PSFs and positions fit as well as could be found.

    Attributes
    ----------
    setup : Setup
        With the refined PSFs, where they are used, the scatter that they have left, and whether
        stars are to be moved.
    refinement : PsfRefinement or None
        The outcome for the PSFs; None where they fit, and nothing was asked of them.
    near_stars : ndarray of float64, of the shape of the extended source, or None
        The weight of the edge-preserving term that the error of the PSFs asks for; None for 0.
    fits : bool
        Whether the PSFs were judged, and no error is left that noise does not explain.
    is_within : bool
        Whether they were judged, and are off by no more than their `psf_error` holds.
    judged : Estimate or None
        That of the window in which stars were moved; None where they were not.
    given : ndarray of float64, shape (n, 2)
        Where its stars were given.
    """

    setup: Setup
    refinement: PsfRefinement | None = None
    near_stars: Array | None = None
    fits: bool = False
    is_within: bool = False
    judged: Estimate | None = None
    given: Array = np.zeros((0, 2))


def mean_over_epochs(fluxes: Array, n_epochs: int) -> Array:
    """Return the mean flux of each star, star by star in each epoch, over those that are known."""
    of_epochs = fluxes.reshape(-1, n_epochs)
    is_known = np.isfinite(of_epochs)
    n_known = is_known.sum(axis=1)
    totals = np.where(is_known, of_epochs, 0.0).sum(axis=1)
    return np.divide(totals, n_known, out=np.full(len(totals), np.nan), where=n_known > 0)


def marginalise(estimate: Estimate, stars: bool, halos: bool, levels: bool) -> Estimate:
    """Return the estimate with levels, halos and stars marginal where wanted.

    `lnocl.core.solvers.levels`, `lnocl.core.solvers.halos` and `lnocl.core.solvers.marginal` have
    the equations. Of several skies this is done for what each filter shows.
    """
    wanted = list[Callable[[Estimate], Estimate]]()
    if levels:
        from lnocl.core.solvers.levels import fit_levels

        wanted.append(fit_levels)
    if halos:
        from lnocl.core.solvers.halos import marginal_halos

        wanted.append(marginal_halos)
    if stars:
        from lnocl.core.solvers.marginal import marginal

        wanted.append(marginal)
    for change in wanted:
        estimate = estimate.changed(change)
    return estimate


@dataclass(frozen=True)
class Outcome:
    """The estimate that a reconstruction ended with, and how it came there.

    Attributes
    ----------
    setup : Setup
        Observation and parameters, from which it starts anew.
    estimate : Estimate
        What it has found, with the stars where they are now.
    objectives : ndarray of float64, shape (n_iter + 1,)
        Objectives of the start and after each iteration; not scaled.
    stop_reason : str
        As `lnocl.Result.stop_reason`.
    curve : ndarray of `CURVE_DTYPE`
        As `lnocl.Result.held_out`.
    psf_refinement : PsfRefinement or None
        None where the PSFs were not to be refined.
    is_marginal : bool
        Whether the star fluxes are those of `marginal`, and so those of replicas.
    has_marginal_halos : bool
        Whether the amounts of halos are, likewise.
    may_free_pixels : bool
        Whether the pixels of PSFs were not to be refined, and could be.
    plan : tuple of str
        That of the run (`lnocl.core.runs.plan.Plan`), a line for each step.
    has_levels : bool
        Whether levels of the background were fitted.
    """

    setup: Setup
    estimate: Estimate
    objectives: Array
    stop_reason: str
    curve: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, CURVE_DTYPE))
    psf_refinement: PsfRefinement | None = None
    is_marginal: bool = False
    has_marginal_halos: bool = False
    has_levels: bool = False
    may_free_pixels: bool = False
    plan: tuple[str, ...] = ()

    @property
    def scene(self) -> Scene:
        """The model of the observation."""
        return self.estimate.scene

    @property
    def sky(self) -> Array:
        """Extended source on the grid, electrons per pixel, shape (Ny, Nx)."""
        return self.estimate.sky

    @property
    def star_fluxes(self) -> Array:
        """Fluxes of the stars and then of the halos, electrons, shape (n_fluxes,)."""
        return self.estimate.star_fluxes

    @property
    def given_positions(self) -> Array:
        """The places of the stars that were given, in the order of the fluxes, shape (n, 2)."""
        return np.repeat(self.setup.stars, self.observation.n_epochs, axis=0)

    @property
    def fluxes_of_stars(self) -> Array:
        """Electrons, shape (n,); NaN where no image shows a star in its epoch."""
        n = self.scene.n_stars
        return np.where(self.scene.is_shown[:n], self.star_fluxes[:n], np.nan)

    @property
    def moves(self) -> bool:
        """Whether stars were moved."""
        return self.setup.refine_positions and self.scene.n_stars > 0

    def marginal(self, stars: bool, halos: bool, levels: bool) -> Outcome:
        """Return the outcome with marginal star fluxes, amounts of halos, or levels fitted."""
        estimate = marginalise(self.estimate, stars, halos, levels)
        return replace(
            self,
            setup=replace(self.setup, observation=estimate.scene.observation),
            estimate=estimate,
            is_marginal=stars,
            has_marginal_halos=halos,
            has_levels=levels,
        )

    def of_filter(self, label: str | None) -> Outcome:
        """Return what the images of a filter show of several skies, as the outcome of one sky.

        Parameters
        ----------
        label : str or None
            The name of the filter, such as "line + continuum"; None where there is one sky.

        Raises
        ------
        InputError
            There is no such filter, or there are several.
        """
        mixing = self.scene.mixing
        if mixing is None and label is None:
            return self
        if mixing is None:
            raise InputError("this result is of one sky: leave `images_of` out")
        names = mixing.filter_names
        if label not in names:
            what = "sources are of one" if label is None else f"{label!r} is no"
            known = " or ".join(map(repr, names))
            raise InputError(f"{what} filter of this result: give `images_of` as {known}")
        g = names.index(label)
        part, row, penalty = self.estimate.parts[g], mixing.rows[g], self.scene.penalty
        near, refinement = penalty.near_stars, self.psf_refinement
        # Weights are inverse amplitudes, which add in quadrature; those near stars are what filters
        # have asked for (`lnocl.core.runs.preparation`).
        amplitudes = row / (penalty.shares or 1.0)
        if near is not None:
            asked = np.linalg.pinv(mixing.rows.T**2)[g]
            near = np.sqrt(np.einsum("k,kyx->yx", asked, near**2).clip(0.0))
        own = replace(
            penalty,
            smoothing=penalty.smoothing / float(np.hypot.reduce(amplitudes)),
            near_stars=near,
            shares=(),
            spectral=0.0,
            stars=None,
            exposure=self.scene.mean_exposure,
        )
        if refinement is not None:
            refinement = replace(refinement, may_be_faked=refinement.may_be_faked[0])
        images = self.observation.of_images(part.images)
        setup = replace(self.setup, observation=images, pad=self.scene.pad, initial_extended=None)
        return replace(
            self,
            setup=replace(setup, initial_star_fluxes=None),
            estimate=replace(part.estimate, scene=part.estimate.scene.penalised(own)),
            psf_refinement=refinement,
        )

    def halo_amounts(self, fluxes: Array) -> Array:
        """Return those of fluxes that are of halos, electrons of each image, shape (n_halos, p)."""
        halo_amounts = fluxes[self.scene.n_stars :] * self.scene.mean_exposure
        return halo_amounts.reshape(-1, self.scene.n_images)

    @property
    def observation(self) -> Observation:
        """The observation, with the PSFs that were used."""
        return self.scene.observation

    def models(self) -> Iterator[Array]:
        """Yield the m_j, electrons per pixel."""
        ny, nx = self.observation.shape
        for j, image in enumerate(self.estimate.models()):
            yield self.scene.in_electrons(image, j)[:ny, :nx]

    def star_residuals(self) -> list[StarResiduals]:
        """Return how well the model fits at each star, and what it may exchange with a host."""
        from lnocl.core.solvers.exchange import exchanged  # which loads scipy

        found = dict[int, StarResiduals]()
        for part in self.estimate.parts:
            shares = exchanged(part.estimate, MUCH_EXCHANGED).tolist()
            judged = zip(part.fluxes.tolist(), judge_stars(part.estimate), shares, strict=False)
            found |= {s: each._replace(exchanged=share) for s, each, share in judged}
        return [found[s] for s in sorted(found)]

    def extended_flux(self, star_flux_errors: Array) -> tuple[Any, Any]:
        """Return the light of the extended source and its standard error, electrons.

        With several skies they are arrays of shape (K,).
        """
        whole = np.broadcast_to(1.0, self.observation.sky_shape)
        return self.light().flux(whole, star_flux_errors)

    def light(self) -> Light | LightOfComponents:
        """Return the light of the extended source without bias."""
        from lnocl.core.solvers.light import Light, LightOfComponents  # which loads scipy

        pairs = zip(self.estimate.parts, self.levels, strict=True)
        lights = [Light(part.estimate, levels) for part, levels in pairs]
        return lights[0] if self.scene.mixing is None else LightOfComponents(self.estimate, lights)

    def pixel_noise(self) -> Array:
        """Return the noise of each sky's pixels by the counts that they are seen in, (K, ny, nx).

        `lnocl.core.solvers.light.pixel_noise` has the equation.
        """
        from lnocl.core.solvers.light import pixel_noise  # which loads scipy

        return pixel_noise(self.estimate)

    @cached_property
    def levels(self) -> list[Levels | None]:
        """The levels of the background of each filter's images; None where they are known."""
        if not self.scene.observation.background_error.any():
            return [None] * len(self.estimate.parts)
        from lnocl.core.solvers.levels import Levels  # which loads scipy

        return [Levels(part.estimate, self.has_levels) for part in self.estimate.parts]

    def levels_in_words(self) -> list[str]:
        """Return the level of each image whose background was fitted, electrons per pixel."""
        if not self.has_levels:
            return []
        observation, errors = self.scene.observation, np.zeros(self.scene.n_images)
        for part, of_part in zip(self.estimate.parts, self.levels, strict=True):
            errors[list(part.images)] = 0.0 if of_part is None else of_part.errors[:, 0]
        levels, noise = (
            means(each, observation.mask)
            for each in (observation.background, observation.read_noise**2)
        )
        levels = levels - noise
        return [
            f"`images[{j}]`: background {levels[j]:.6g} +- {error:.2g} electrons per pixel, fitted "
            "with the rest"
            for j, error in enumerate(errors)
            if error > 0
        ]

    def star_errors(self) -> StarErrors:
        """Return the errors of fluxes and positions, the extended source not known.

        Those of stars with PSFs of their own have how far they would be without it.
        Fluxes are those of stars and halos. `lnocl.core.solvers.star_errors` has the equation. Of
        PSFs that are said to be exact, and are not, the relative error that is left is that of each
        star's flux too, added in quadrature. NaN for positions that were not fitted, and where the
        images do not determine them.

        Warns
        -----
        LnoclWarning
            The images do not determine flux and position of a star, or the amount of a halo.
        """
        n, n_epochs = self.scene.n_stars, self.scene.n_epochs
        fluxes, positions = np.full(self.scene.n_fluxes, np.nan), np.full((n, 2), np.nan)
        covariances = np.zeros((n // n_epochs, n_epochs, n_epochs))
        for part, levels in zip(self.estimate.parts, self.levels, strict=True):
            found, own = self._errors_of(part.estimate, levels), part.fluxes
            stars = own[own < n]
            fluxes[own], positions[stars] = found.fluxes, found.positions
            epochs = np.unique(stars % n_epochs)
            covariances[:, epochs[:, None], epochs] = found.covariances
        return StarErrors(fluxes, positions, covariances)

    def _errors_of(self, estimate: Estimate, levels: Levels | None) -> StarErrors:
        """Return the errors of a part of the estimate."""
        from lnocl.core.solvers.halos import halo_errors
        from lnocl.core.solvers.star_errors import add_apart, standard_errors, without_source

        scene, moves, halos = estimate.scene, self.moves, halo_errors(estimate)
        star_fluxes = estimate.star_fluxes[: scene.n_stars]
        errors, covariances = standard_errors(estimate, moves, halos.raised, levels)
        more = without_source(estimate, halos.raised)
        is_lost = np.isnan(errors[:, : 3 if moves else 1]).any(axis=1) & (star_fluxes > 0)
        _warn_of_undetermined(scene.stars[is_lost], bool(np.isnan(halos.errors).any()))
        if self.psf_refinement is not None:
            # Else what PSFs may have wrong is among the unknowns.
            left = self.psf_refinement.psf_error * (scene.observation.psf_error == 0)
            of_psfs = np.hypot(left, self.psf_refinement.hidden_error)
            more = np.hypot(more, of_psfs * star_fluxes)
        errors, covariances = add_apart(errors, covariances, more)
        positions = errors[:, 1:]
        positions[positions > MAX_SHIFT] = np.nan  # no star is moved farther
        return StarErrors(np.append(errors[:, 0], halos.errors), positions, covariances)


class StarErrors(NamedTuple):
    """Standard errors of stars.

    Attributes
    ----------
    fluxes : ndarray of float64, shape (n_fluxes,)
        Of stars, and then of halos, electrons.
    positions : ndarray of float64, shape (n, 2)
        Pixels; NaN where they were not fitted.
    covariances : ndarray of float64, shape (n / n_epochs, n_epochs, n_epochs)
        Of the fluxes of each star in its epochs, electrons squared.
    """

    fluxes: Array
    positions: Array
    covariances: Array


def _warn_of_undetermined(stars: Array, are_halos: bool) -> None:
    """Warn of stars, and perhaps halos, that the images do not tell from others."""
    named = ", ".join(map(in_words, stars))
    lost = [f"flux and position of each star at {named}"] * bool(named)
    lost += ["the amounts of all halos"] * are_halos
    advice = "leave out stars that lie on others"
    if are_halos:
        advice = "leave out halos that others, or a star, can stand in for"
    if lost:
        words = " and ".join(lost)
        warn(f"the images do not determine {words}, so that these errors are NaN; {advice}")
