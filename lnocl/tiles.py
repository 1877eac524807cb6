"""Large images, and PSFs that vary over the field: overlapping tiles, each a run of its own."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.options import StopName, check_observation
from lnocl.core.runs.outcome import Outcome, StarErrors
from lnocl.core.runs.plan import Plan
from lnocl.core.runs.plan import plan as make_plan
from lnocl.core.runs.preparation import Prepared, prepare
from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array, together, whole
from lnocl.core.scene.components import refuse_unseen
from lnocl.core.scene.counts import mean_exposure, means
from lnocl.core.scene.grid import psf_shape
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.padding import recommend_pad
from lnocl.core.scene.scaled_penalty import EDGE
from lnocl.core.scene.scene import Scene
from lnocl.errors import InputError, LnoclWarning, counted, warn
from lnocl.parallel import Parallel, check_parallel, work
from lnocl.process import ignored_warnings, recorded_warnings
from lnocl.progress import Progress
from lnocl.reconstruction import reconstruct
from lnocl.residuals import StarResiduals
from lnocl.result import Result, make_result
from lnocl.result.verdict import warn_of_faults
from lnocl.tiling import Span, Tile, cut, lay

# Of those of `lnocl.deconvolve`, beside parameters.
OPTIONS = {"solver", "precision", "engine", "device", "pad", "refine_positions", "refine_psfs"}
OPTIONS |= {"mend_images", "spectral_smoothing"}
# The tiles with the brightest extended source, of whose choices that in the middle is taken, and
# the share of the light of the brightest that each has.
N_CHOOSING, FAIR = 3, 0.3
# Warnings of tiles that are given in full.
MAX_WARNINGS = 3

WHOLE = "x", "y", "width", "height", "n_iter"
TILE_DTYPE = np.dtype([*((name, np.int64) for name in WHOLE), ("objective", np.float64)])


@dataclass(frozen=True, eq=False, repr=False)
class TiledResult(Result):
    """The result of `lnocl.deconvolve_tiles`, put together from those of its tiles.

    Attributes and methods are those of `lnocl.Result`, with these differences. ``psfs`` are those
    of the middle of the images. ``history`` is the sum of those of all tiles. ``bootstrap`` raises
    `lnocl.InputError`, as replicas are made of one run.

    Attributes
    ----------
    tiles : ndarray, fields ``x``, ``y``, ``width``, ``height``, ``n_iter``, ``objective``
        A row for each tile: the pixels of an image without offset that it stands for, without its
        margins; its iterations; and its last objective, margins included. Where images reach
        beyond the sky's frame tiles do.

    See Also
    --------
    lnocl.Result : The attributes and methods.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> obs = lnocl.Observation(np.full((64, 64), 9.0), np.ones((3, 3)))
    >>> result = lnocl.deconvolve_tiles(obs, tile=40, stop=None, n_iter=2, engine="numpy")
    >>> for tile in result.tiles:
    ...     print(tile["x"], tile["y"], tile["width"], tile["height"])
    0 0 32 32
    32 0 32 32
    0 32 32 32
    32 32 32 32
    """

    tiles: NDArray[np.void]


class _Found(NamedTuple):
    """What a tile has found: the result of its window, and what it stands for alone.

    Attributes
    ----------
    result : Result
        Without what it would be computed from.
    row : tuple
        Of the table of tiles.
    models : ndarray of float64
        Of the images in its window.
    noise : ndarray of float64 or None
        Of components there, as `lnocl.core.solvers.light.pixel_noise`.
    fluxes : ndarray of float64, shape (G, 2)
        Of the extended source there that each filter shows, and its standard error, electrons.
    numbers : ndarray of int, shape (k,)
        Which of all stars in each epoch are its own.
    stars : ndarray of float64, shape (k, 6)
        Positions, fluxes, and their errors, of these.
    covariances : ndarray of float64, shape (k / n_epochs, n_epochs, n_epochs)
        Of the fluxes of each of them.
    at_stars : list of StarResiduals
        How well the model fits at these.
    messages : list of str
        Warnings.
    """

    result: Result
    row: tuple[Any, ...]
    models: Array
    noise: Array | None
    fluxes: Array
    numbers: NDArray[np.intp]
    stars: Array
    covariances: Array
    at_stars: list[StarResiduals]
    messages: list[str]


def deconvolve_tiles(
    observation: Observation,
    stars: Iterable[tuple[float, float]] = (),
    *,
    tile: int | None = None,
    parallel: Parallel = False,
    mu: float = 0.0,
    smoothing: float | Literal["auto"] = "auto",
    n_iter: int = 1000,
    stop: StopName | float | None = "held-out",
    progress: bool = False,
    **options: Any,
) -> TiledResult:
    """Reconstruct the sky tile by tile: large images, or PSFs that vary over the field.

    Each tile is a run of its own on a window of the sky, which is its part and margins of half a
    PSF. So no source that lights the part is left out. Each image is cut to the box that shows this
    window, wherever it is shifted, turned or scaled to. Its PSFs are those of the middle of its
    part, ``K = sum_i w_i K_i`` of a `lnocl.PsfField`; each star has that of its own place. The
    extended sources are blended across half of the margins.

    PSFs that are the same all over the images are judged once, as by `lnocl.deconvolve`: all tiles
    have those that were found, and star fluxes are marginal where they fit.

    All tiles have the same weights and the same δ of the edge-preserving term of each sky, and the
    same number of iterations unless `stop` is a number. Where held-out counts or the discrepancy
    choose, the three tiles with the brightest extended source do so, of those with 0.3 of the light
    of the brightest or more; held-out counts do by their parts without margins. The middle one of
    their choices serves all.

    Parameters
    ----------
    observation : Observation
        The p images, as for `lnocl.deconvolve`.
    stars : iterable of (x, y) or astropy.table.Table, optional
        Positions in pixels of an image without offset, as for `lnocl.deconvolve`.
    tile : int, optional
        Side of the grid that a tile is computed on, with its margins and pad, pixels of the images.
        By default about five times that of the PSFs where these vary, else 2048. Where images are
        turned by an angle the grid is larger, by ``1 + sin 2 angle`` or more.
    parallel : bool, int or "current-scheduler", optional
        Where the tiles are computed (`lnocl.parallel.check_parallel`). False: one after the other
        in this process. True or a number: in as many processes as cores, or in that many.
        "current-scheduler": by the workers of a cluster of Dask.
    mu : float, optional
        Weight of the Tikhonov term, per electron, as for `lnocl.deconvolve`.
    smoothing : float or "auto", optional
        Weight of the edge-preserving term, as for `lnocl.deconvolve`.
    n_iter : int, optional
        Largest number of iterations, 1 or more.
    stop : "held-out", "discrepancy", float or None, optional
        Rule by which to stop before `n_iter`, as for `lnocl.deconvolve`.
    progress : bool, optional
        Show progress, as `lnocl.deconvolve` does.
    **options
        Others of `lnocl.deconvolve`: solver, precision, engine, device, pad, refine_positions,
        refine_psfs, mend_images, spectral_smoothing.

    Returns
    -------
    TiledResult
        A `lnocl.Result` that is put together from those of the tiles, and the table of the tiles.

    Raises
    ------
    InputError
        As `lnocl.deconvolve`; a tile has no room for its margins; an option is not for tiles; the
        observation has halos; no good pixel of a tile shows one of the filters; a star is in a tile
        that all images mask, or that is behind a transmission of 0.
    LnoclError
        Dask is missing; the workers are lost.
    DeviceError
        As `lnocl.deconvolve`.

    Warns
    -----
    LnoclWarning
        As `lnocl.deconvolve`, for each tile: the first three in full, and the number of the others.

    Notes
    -----
    Tiles and one run of the whole agree where the steps of a pixel depend on its neighbours alone.
    That is so with "sgm", and with "sgp" when it has converged. Before that the steps of "sgp"
    differ from tile to tile, by less than the noise (:doc:`/validation/tiles`).

    Halos are refused. What a part of a halo has in common with a smooth sky no tile can tell, so
    that its amount takes the least squares of all pixels together.

    References
    ----------
    L. Denis, E. Thiebaut, F. Soulez, J.-M. Becker, R. Mourya, Int. J. Comput. Vis. 115, 253 (2015),
    section 2, compares models of PSFs that vary.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> narrow, wide = np.zeros((3, 3)), np.full((3, 3), 0.02)
    >>> narrow[1, 1], wide[1, 1] = 1.0, 0.84
    >>> field = lnocl.PsfField([narrow, wide], [(0, 0), (63, 0)])
    >>> obs = lnocl.Observation(np.full((64, 64), 9.0), field)
    >>> result = lnocl.deconvolve_tiles(obs, tile=40, stop=None, n_iter=9, engine="numpy")
    >>> len(result.tiles), result.extended[8:-8, 8:-8].mean().round(2)
    (4, np.float64(9.0))
    """
    check_parallel(parallel)
    check_observation(observation)
    if reason := for_the_whole(observation):
        raise InputError(reason)
    if unknown := sorted(options.keys() - OPTIONS):
        raise InputError(
            f"{unknown[0]} is no option of tiles; leave it out, or take deconvolve for the whole"
        )
    pad = options.pop("pad", "auto")
    given = {"mu": mu, "smoothing": smoothing, "n_iter": n_iter, "stop": stop, **options}
    plan = make_plan(observation, stars, **given)
    positions = plan.setup.stars
    tile_pad = (
        whole("pad", pad, 0, ", or auto") if str(pad) != "auto" else recommend_pad(observation)
    )
    tiles = lay(plan.setup.observation, tile, tile_pad)
    plan = replace(plan, setup=replace(plan.setup, pad=pad), in_tiles=True)
    prepared = prepare(plan, progress)
    observation, near_stars = prepared.setup.observation, prepared.penalties[0].near_stars
    observed = [*filter(None, (cut(observation, positions, near_stars, at) for at in tiles))]
    for each in observed:
        try:
            refuse_unseen(each.observation)
        except InputError as error:
            raise InputError(f"{_begins(each)}: {error.message}, or give a larger `tile`") from None
    or_dark = " or that is behind a `transmission` of 0" if len(observation.transmission) else ""
    for x, y in np.delete(positions, np.concatenate([each.numbers for each in observed]), axis=0):
        raise InputError(
            f"the star at ({x:g}, {y:g}) lies in a tile that all images mask{or_dark}; leave it "
            "out or mend the mask"
        )
    if len(tiles) > 1:
        common: dict[str, Any] = {"exposure": mean_exposure(observation)}
        if near_stars is not None or any(each.smoothing for each in prepared.penalties):
            with ignored_warnings():  # of which the tiles know more
                common["edges"] = tuple(EDGE * Scene(observation, positions).levels)
        prepared = prepared.penalised(**common)
    pad = tile_pad if len(tiles) > 1 else pad
    # It goes to other processes, without the whole images.
    prepared = prepared.of(observed[0].observation, observed[0].stars, pad=pad)
    chosen = None
    if isinstance(prepared.stop, str):
        chosen = _choose(observed, parallel, replace(prepared, is_within=False))
        prepared = _ending(prepared, chosen)
    plan = replace(plan, setup=replace(plan.setup, pad=pad), found=prepared.found)
    mosaic = _Mosaic(observation, positions, plan, tiles[0])
    with (
        Progress(len(observed), "tile", progress, "deconvolving") as bar,
        closing(work(partial(partial, _solve, prepared), observed, parallel)) as answers,
    ):
        for each, found in zip(observed, answers, strict=True):
            mosaic.add(each, found)
            bar.update()
    _warn_of_tiles([message for each in mosaic.found for message in each.messages])
    result = mosaic.result(chosen)
    warn_of_faults(result, progress)
    return result


def _ending(prepared: Prepared, choice: Result) -> Prepared:
    """Return the runs of all tiles after some have chosen."""
    penalty = replace(prepared.penalties[0], smoothing=choice.smoothing)
    prepared = replace(prepared, penalties=[penalty], n_iter=max(choice.n_iter, 1))
    if choice.stop_reason != prepared.stop:  # there was no end, and this is the steady run
        prepared = replace(prepared, steady=None, is_within=False)
    return replace(prepared, stop=None)


def for_the_whole(observation: Observation) -> str | None:
    """Return why an observation is not for tiles, and what to do; None where it is."""
    if len(observation.halos):
        return (
            "a tile cannot tell the `halos` in it from a smooth sky, as whole images can; take "
            "deconvolve for the whole, or leave `halos` out"
        )
    return None


def _choose(tiles: Sequence[Tile], parallel: Parallel, prepared: Prepared) -> Result:
    """Return the result in the middle of those of the tiles with the brightest extended source.

    One tile alone may be misled (docs/validation/tiles.md).
    """
    lights = np.array(list(map(_light, tiles)))
    brightest = [
        tiles[k]
        for k in np.argsort(lights)[-N_CHOOSING:].tolist()
        if lights[k] >= FAIR * lights.max()
    ]
    with closing(work(partial(partial, _choice, prepared), brightest, parallel)) as answers:
        choices = sorted(answers, key=lambda each: each.n_iter)
    return choices[len(choices) // 2]


def _choice(prepared: Prepared, tile: Tile) -> Result:
    with ignored_warnings(LnoclWarning):  # the tile is done again
        outcome = _outcome(prepared, tile.without_unseen_neighbours())
        return _alone(make_result(outcome), extended=np.zeros(0))


def _alone(result: Result, **changes: Any) -> Result:
    """Return a result without what it is computed from, to go from process to process."""
    return replace(result, _findings=cast(Any, None), **changes)


def _outcome(prepared: Prepared, tile: Tile) -> Outcome:
    prepared = prepared.of(tile.observation, tile.stars).penalised(near_stars=tile.near_stars)
    try:
        outcome = reconstruct(prepared, own=tile.own, within=tile.core)
    except InputError as error:
        raise InputError(f"{_begins(tile)}: {error.message}") from error
    if prepared.is_within and len(tile.stars):
        outcome = outcome.marginal(stars=True, halos=False, levels=False)
    return replace(outcome, psf_refinement=prepared.refinement)


def _begins(tile: Tile) -> str:
    return "tile that begins at pixel ({1}, {0}), where positions there begin".format(
        *(span.window.start for span in tile.spans)
    )


def _solve(prepared: Prepared, tile: Tile) -> _Found:
    from lnocl.core.solvers.light import Light, fluxes_of_filters  # which load scipy

    tile = tile.without_unseen_neighbours()
    begins = _begins(tile)
    with recorded_warnings() as recorded:
        outcome = _outcome(prepared, tile)
        errors = outcome.star_errors()
    result, (y, x), at_stars = make_result(outcome), tile.spans, outcome.star_residuals()
    within = np.zeros(tile.observation.sky_shape)
    within[tile.core] = 1.0
    lights = [Light(part.estimate) for part in outcome.estimate.parts]
    own, numbers = (_in_epochs(each, tile.observation) for each in (tile.own, tile.numbers))
    positions = result.star_positions + np.array([x.window.start, y.window.start])
    return _Found(
        _alone(result),
        (x.core.start, y.core.start, len(x.core), len(y.core), *result.history[-1]),
        np.array(list(outcome.models())),
        outcome.pixel_noise() if result.component_names else None,
        fluxes_of_filters(outcome.estimate, lights, within, errors.fluxes),
        numbers,
        np.column_stack([positions, result.star_fluxes, errors.fluxes, errors.positions])[own],
        errors.covariances[tile.own],
        [at_stars[s] for s in own],
        [
            f"{begins}: {getattr(each.message, 'message', each.message)}"
            for each in recorded
            if issubclass(each.category, LnoclWarning)
        ],
    )


def _light(tile: Tile) -> float:
    """Return the counts above the background in the core, but those within half a PSF of a star.

    Bright stars mislead the choice, most of all where PSFs are not quite right: both halves of the
    counts share their residuals.
    """
    observation = tile.observation
    images, level = together(observation.images, observation.background)
    light = np.where(observation.mask, 0.0, images - level)
    reach = max(psf_shape(observation)) / (2.0 * observation.oversample)
    rows, columns = (np.arange(n) for n in observation.shape)
    for j, image in enumerate(light):
        at = observation.geometry.on_sky(j, columns, rows[:, None])
        for place, own in zip(at, tile.core[::-1], strict=True):
            on_sky = observation.oversample * (place + 0.5)
            image[~((on_sky >= own.start) & (on_sky < own.stop))] = 0.0
        for x, y in observation.places(j, tile.stars):
            near = np.ix_(abs(rows - y) <= reach, abs(columns - x) <= reach)
            image[near] = 0.0
    return float(light.sum())


def _in_epochs(numbers: NDArray[np.intp], observation: Observation) -> NDArray[np.intp]:
    """Return the numbers of stars in each epoch, star by star."""
    n = observation.n_epochs
    return (n * numbers[:, None] + np.arange(n)).ravel()


class _Mosaic:
    """What all tiles have found, put together as they are done."""

    may_free_pixels = False

    def __init__(
        self, observation: Observation, positions: Array, plan: Plan, spans: tuple[Span, Span]
    ) -> None:
        self._plan = plan
        self.plan, n_epochs = tuple(str(plan).splitlines()), observation.n_epochs
        self.observation = observation
        self.given_positions = np.repeat(positions, n_epochs, axis=0)
        # The skies times weights, and these.
        shape = [observation.oversample * len(each.sky) for each in spans]
        self._first, self._weights = [each.sky.start for each in spans], np.zeros(shape)
        self._sky = np.zeros((*observation.skies_shape[:-2], *shape))
        self._noise = np.full(self._sky.shape if observation.component_names else 0, np.nan)
        # Where no tile sees the sky images have their background.
        _, background = together(observation.images, observation.background)
        self._models = np.zeros(observation.images.shape) + background
        self._stars = np.zeros((len(self.given_positions), 6))
        self._covariances = np.zeros((len(positions), n_epochs, n_epochs))
        self.found: list[_Found] = []

    def add(self, tile: Tile, found: _Found) -> None:
        """Add what a tile has found."""
        (y, x), q, sky = tile.spans, self.observation.oversample, found.result.extended
        weights = np.multiply.outer(y.weights(q), x.weights(q))
        first_y, first_x = (q * (at.window.start - at.sky.start) for at in tile.spans)
        there = slice(first_y, first_y + len(weights)), slice(first_x, first_x + weights.shape[1])
        self._sky[..., *there] += weights * sky
        self._weights[there] += weights
        if found.noise is not None:
            self._noise[..., *there][..., *tile.core] = found.noise[..., *tile.core]
        self._stars[found.numbers] = found.stars
        n = self.observation.n_epochs
        self._covariances[found.numbers[::n] // n] = found.covariances
        self.add_models(tile, found.models)
        nothing = np.zeros(0)
        result = replace(found.result, extended=nothing)
        self.found.append(found._replace(result=result, models=nothing, noise=None))

    def add_models(self, tile: Tile, models: Array) -> None:
        """Take the pixels of images that show the core of a tile from the models of its window."""
        y, x = tile.spans
        for j, (box, model) in enumerate(zip(tile.boxes, models, strict=True)):
            pairs = zip(box, self._models[j].shape, strict=True)
            seen_y, seen_x = (np.arange(max(at.start, 0), min(at.stop, n)) for at, n in pairs)
            at_x, at_y = self.observation.geometry.on_sky(j, seen_x, seen_y[:, None])
            is_own = np.nonzero(y.holds(at_y) & x.holds(at_x))
            at_y, at_x = seen_y[is_own[0]], seen_x[is_own[1]]
            self._models[j, at_y, at_x] = model[at_y - box[0].start, at_x - box[1].start]

    def result(self, chosen: Result | None) -> TiledResult:
        """Return it all, with the choice that was made for all tiles."""
        results = [each.result for each in self.found]
        longest = max(results, key=lambda each: each.n_iter)
        history = longest.history.copy()
        objectives = (each.history["objective"] for each in results)
        history["objective"] = sum(
            np.pad(each, (0, len(history) - len(each)), "edge") for each in objectives
        )
        sky, weight = map(self._in_frame, (self._sky, self._weights))
        choice = chosen or longest
        same = {name: getattr(choice, name) for name in ("n_iter", "stop_reason", "held_out")}
        found = {
            "extended": np.divide(sky, weight, out=np.zeros(sky.shape), where=weight > 0),
            "star_fluxes": self._stars[:, 2],
            "star_positions": self._stars[:, :2],
            "history": history,
            "_findings": self,
            "tiles": np.array([each.row for each in self.found], TILE_DTYPE),
        }
        return TiledResult(**vars(longest) | same | found)

    def _in_frame(self, array: Array) -> Array:
        """Return what is in the sky's frame of all that tiles stand for."""
        (ny, nx), q = self.observation.sky_shape, self.observation.oversample
        y, x = (-q * each for each in self._first)
        return array[..., y : y + ny, x : x + nx]

    def pixel_noise(self) -> Array:
        """Return the noise of each component's pixels, electrons, shape (K, ny, nx)."""
        return self._in_frame(self._noise)

    @property
    def setup(self) -> Setup:
        """The parameters of all tiles."""
        return self._plan.setup

    def models(self) -> Iterator[Array]:
        """Yield the models of the images."""
        return iter(self._models)

    def star_errors(self) -> StarErrors:
        """Return the errors of stars."""
        return StarErrors(self._stars[:, 3], self._stars[:, 4:], self._covariances)

    def halo_amounts(self, fluxes: Array) -> Array:
        """Return the amounts of halos, which tiles do not have."""
        return np.zeros((0, self.observation.n_images))

    def extended_flux(self, star_flux_errors: Array) -> tuple[Any, Any]:
        """Return the light of the extended source and its standard error, electrons.

        With several skies they are arrays of shape (K,).
        """
        from lnocl.core.solvers.light import of_components  # which loads scipy

        observation = self.observation
        found = np.array([each.fluxes for each in self.found])
        # The level of an image is wrong in all its tiles alike.
        exposure = means(observation.exposure, observation.mask) * observation.scales**2
        mixing = observation.mixing
        images = [list(range(observation.n_images))] if mixing is None else mixing.images
        levels = [
            np.linalg.norm(observation.background_error[own]) / exposure[own].sum()
            for own in images
        ]
        n_pixels = math.prod(observation.geometry.frame)
        errors = np.hypot(np.linalg.norm(found[:, :, 1], axis=0), n_pixels * np.array(levels))
        fluxes, covariance = of_components(observation, found[:, :, 0].sum(axis=0), errors)
        of_each = np.sqrt(np.diag(covariance))
        return (float(fluxes[0]), float(of_each[0])) if mixing is None else (fluxes, of_each)

    def star_residuals(self) -> list[StarResiduals]:
        """Return how well the model fits at each star."""
        pairs = ((each.numbers.tolist(), each.at_stars) for each in self.found)
        at_stars = {s: at for each in pairs for s, at in zip(*each, strict=True)}
        return [at_stars[s] for s in range(len(at_stars))]


def _warn_of_tiles(messages: Sequence[str]) -> None:
    for message in messages[:MAX_WARNINGS]:
        warn(message)
    if len(messages) > MAX_WARNINGS:
        warn(f"{counted(len(messages) - MAX_WARNINGS, 'other warning')} of tiles")
