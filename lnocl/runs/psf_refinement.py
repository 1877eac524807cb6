"""PSFs that are refined from the images before the reconstruction, and whether that helped."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from lnocl.errors import warn
from lnocl.process import ignored_warnings
from lnocl.runs.outcome import PsfRefinement
from lnocl.runs.run import Run
from lnocl.runs.start import Setup, make_model, make_start
from lnocl.scene.observation import Array, Observation
from lnocl.scene.penalty import Penalty
from lnocl.scene.psf_families import PsfFamilies
from lnocl.scene.rings import Rings, medians
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.solvers.fluxes import fit_fluxes
from lnocl.solvers.psf_fit import Misfit, PsfStep, misfit, step

log = logging.getLogger("lnocl")

# Each round begins with the estimate after so many iterations with the present PSFs, and takes so
# many steps from it.
ITERATIONS, STEPS = (8, 15, 30), 2
# Of the extended source, what lies all round a star is the star's: this quantile in each ring.
ROUND = 0.4
# So many times what the PSFs' error may fake is not the extended source's.
FAKED = 2.0
# Refinement looks at a window of this side, pixels.
WINDOW = 256
# The median of the square of a normal deviate of unit variance.
MEDIAN = 0.455
# PSFs are judged after so many iterations. Refined ones are used where chi squared of those given
# exceeds its expectation by so much for each parameter, and this share of it is mended.
JUDGED, EXCESS, MENDED = 15, 10.0, 0.7
# Where the PSFs that are used have a larger reduced chi squared, their error is made a part of the
# noise: else held-out counts, which do not see it, run until it ruins the sky near the star.
RUINOUS = 2.0
# PSFs that are wrong by more than this are not told from the sky, whatever their noise.
HOPELESS = 0.25
# A step is halved so often, at most, until no OTF exceeds its value at frequency 0.
MAX_HALVED = 10


def refine_psfs(
    setup: Setup, observation: Observation, names: Sequence[str]
) -> tuple[Observation, PsfRefinement]:
    """Return the observation with the PSFs that fit better, and what was found.

    Rounds of short runs, from the estimate of which parameters, star fluxes and perhaps positions
    are fitted (`lnocl.solvers.psf_fit`), in a window round the stars. What the extended source has
    all round a star is taken for the star's, and so is what the error of its PSFs may have left
    there. The given PSFs stand where the refined ones mend too little.

    Parameters
    ----------
    setup : Setup
        The parameters of the runs; one star or more among them.
    observation : Observation
        The images and the given PSFs.
    names : sequence of str
        Families of `PsfFamilies`.
    """
    window, stars, first = _window(setup, observation)
    families = PsfFamilies(names, observation.psfs, observation.ideal_psfs, observation.psf_modes)
    look = _Look(setup, window, stars)
    values = _find(look, families, setup.refine_positions)
    refined = families.psfs(values)
    (before, of_given), (after, of_refined) = map(look.judge, (observation.psfs, refined))
    gain, excess = before.square - after.square, before.square - before.n_pixels
    is_accepted = excess > EXCESS * values.size and gain > MENDED * excess
    final, estimate = before, of_given
    if is_accepted:
        observation, final, estimate = _with_psfs(observation, refined), after, of_refined
    error = 0.0
    if final.reduced > RUINOUS:
        observation, error = _allow_for_errors(observation, estimate, first)
    misfits = before.reduced, after.reduced
    refinement = PsfRefinement(tuple(families.parameters), values, misfits, is_accepted, error)
    log.info(_told(refinement))
    return observation, refinement


def _find(look: _Look, families: PsfFamilies, moves: bool) -> Array:
    """Return the parameters of the PSFs that fit best; the stars' places may be fitted too."""
    values = np.zeros((look.n_images, len(families.prior)))
    for n_iter in ITERATIONS:
        found = look.at(families.psfs(values), n_iter)
        for _ in range(STEPS):
            change = step(found.scene, families, values, found.extended, found.fluxes, moves)
            values = _follow(families, values, change.parameters)
            if moves:  # which a common shift is not told from
                values, common = families.without_common_shift(values)
                change = change._replace(positions=change.positions + common)
            found = look.moved(found, families.psfs(values), change)
    return values


def _follow(families: PsfFamilies, values: Array, change: Array) -> Array:
    """Return the parameters after a step, shortened until the PSFs are those of some light."""
    for _ in range(MAX_HALVED):
        if families.are_possible(values + change):
            return values + change
        change = change / 2.0
    return values


def _told(refinement: PsfRefinement) -> str:
    before, after = refinement.misfit
    change = f"their misfit is {before:.3g}, refined {after:.3g}, where noise gives 1"
    if refinement.psf_error:
        change += f"; an error of {100 * refinement.psf_error:.2g} % is added to the noise"
    return f"PSFs {'refined' if refinement.is_accepted else 'left as given'}: {change}"


def _with_psfs(observation: Observation, psfs: Array) -> Observation:
    """Return an observation with other PSFs, as they are."""
    other = copy(observation)
    other.psfs = psfs
    return other


def _allow_for_errors(
    observation: Observation, estimate: _Estimate, first: Array
) -> tuple[Observation, float]:
    """Return an observation with the PSFs' error in its noise, and that error; 0 where hopeless.

    Its variance is ``(2 kappa(r) sum_s c_s P_js)^2``; as that of read noise it is added to images
    and background.
    """
    fluxes = estimate.fluxes * estimate.scene.unit
    ny, nx = observation.shape
    with ignored_warnings():
        scene = Scene(observation, (estimate.scene.stars + first).clip(0, (nx - 1, ny - 1)))
    images, read_noise = observation.images.copy(), np.empty_like(observation.images)
    background = np.empty_like(images)
    errors, lights = 0.0, 0.0
    for j, offset in enumerate(observation.offsets):
        light = scene.star_field.light(j, fluxes / scene.unit)[:ny, :nx] * scene.scale
        if scene.weights is not None and scene.has_exposure_map:
            light *= scene.weights[j][:ny, :nx]
        number = Rings((ny, nx), scene.stars + offset).number
        error = estimate.kappa[np.minimum(number, len(estimate.kappa) - 1)] * light
        errors, lights = errors + float((error**2).sum()), lights + float((light**2).sum())
        variance = (FAKED * error) ** 2
        images[j] += np.where(observation.mask[j], 0.0, variance)
        background[j] = observation.background[j] + variance
        read_noise[j] = np.sqrt(observation.read_noise[j] ** 2 + variance)
    found = float(np.sqrt(errors / lights))
    if found > HOPELESS:
        warn(
            f"the PSFs do not fit the stars, by {100 * found:.2g} %: the sky near the stars, and "
            "their fluxes, are not to be trusted; give other PSFs"
        )
        return observation, 0.0
    noisy = copy(observation)
    noisy.images, noisy.background, noisy.read_noise = images, background, read_noise
    return noisy, found


def _window(setup: Setup, observation: Observation) -> tuple[Observation, Array, Array]:
    """Return the observation cut to a window round most of the stars, these, and its corner."""
    size = np.minimum(observation.shape[::-1], WINDOW)
    last = np.array(observation.shape[::-1]) - size
    middle = (setup.stars.min(axis=0) + setup.stars.max(axis=0)) / 2.0
    firsts = [np.clip(np.round(at) - size // 2, 0, last) for at in (middle, *setup.stars)]
    low = np.array(firsts)[:, None] - 0.5
    held = np.all((setup.stars >= low) & (setup.stars < low + size), axis=2)
    best = int(np.argmax(held.sum(axis=1)))
    x, y = (slice(int(at), int(at + n)) for at, n in zip(firsts[best], size, strict=True))
    cut = copy(observation)
    for name in ("images", "mask", "background", "exposure"):
        values = getattr(observation, name)
        setattr(cut, name, values[:, y, x] if values.ndim == 3 else values)
    return cut, setup.stars[held[best]] - firsts[best], firsts[best]


class _Look:
    """Short runs with PSFs to be judged, whose stars are refined where they are in the run."""

    def __init__(self, setup: Setup, observation: Observation, stars: Array) -> None:
        self._setup = replace(setup, solver="sgp", stars=stars)
        self._observation = observation

    @property
    def n_images(self) -> int:
        """Number of images."""
        return self._observation.n_images

    def at(self, psfs: Array, n_iter: int) -> _Estimate:
        """Return the estimate after so many iterations with these PSFs."""
        with ignored_warnings():  # those of the reconstruction are the same
            run = Run(make_start(self._setup, self._seen_through(psfs), Penalty()), n_iter)
            for _ in run:
                pass
        return _clean(run.scene, run.engine.extended().astype(np.float64), run.engine.star_fluxes())

    def judge(self, psfs: Array) -> tuple[Misfit, _Estimate]:
        """Return how well these PSFs fit, and the estimate by which that is judged."""
        found = self.at(psfs, JUDGED)
        return misfit(found.scene, found.extended, found.fluxes), found

    def moved(self, estimate: _Estimate, psfs: Array, change: PsfStep) -> _Estimate:
        """Return an estimate with other PSFs and stars."""
        ny, nx = self._observation.shape
        positions = change.positions.clip(0, (nx - 1, ny - 1))
        with ignored_warnings():
            scene = Scene(self._seen_through(psfs), positions, pad=self._setup.pad)
        return replace(estimate, scene=scene, fluxes=change.fluxes)

    def _seen_through(self, psfs: Array) -> Observation:
        """Return the observation with these PSFs, as far as the window may show them."""
        cut = [
            slice(n // 2 - min(n, WINDOW) // 2, n // 2 - min(n, WINDOW) // 2 + min(n, WINDOW))
            for n in psfs.shape[1:]
        ]
        return _with_psfs(self._observation, psfs[:, *cut])


@dataclass(frozen=True)
class _Estimate:
    """An estimate without what PSFs in error may have left in its extended source.

    `kappa` is the relative error of the PSFs in each of the `Rings` round the stars, as far as
    residuals show it beyond the noise of the counts: the root of the median of
    ``((g - m)^2 / 0.455 - m) / (sum_s c_s P_js)^2``.
    """

    scene: Scene
    extended: Array
    fluxes: Array
    kappa: Array


def _clean(scene: Scene, extended: Array, fluxes: Array) -> _Estimate:
    """Return an estimate whose extended source has nothing that the stars' PSFs may have left."""
    model = make_model(scene)
    shape = scene.observation.shape
    inside = tuple(map(slice, shape))
    rings = Rings(shape, scene.stars)
    kept = extended.copy()
    kept[inside] = np.maximum(kept[inside] - rings.round_stars(kept[inside], ROUND), 0.0)
    diffuse = model.forward(kept)
    diffuse += model.background
    fluxes = fit_fluxes(scene, model, diffuse, fluxes)
    excess, number = [], []
    mean_light = np.zeros(shape)
    for j, (counts, light) in enumerate(zip(scene.images(), model.starlight(fluxes), strict=True)):
        total = np.maximum(diffuse[j] + light, MIN_MODEL)[inside]
        counts, light, weights = (
            each[inside] for each in (counts, light, np.broadcast_to(model.weights[j], scene.grid))
        )
        good = weights > 0
        variance = np.divide(total, weights * scene.scale, out=np.ones(shape), where=good)
        squares = (counts - total) ** 2 / MEDIAN
        lit = good & (light > 0)
        excess.append((squares - variance)[lit] / light[lit] ** 2)
        number.append(Rings(shape, scene.stars + scene.observation.offsets[j]).number[lit])
        mean_light += light / scene.n_images
    kappa = np.zeros(rings.number.max() + 1)
    found = np.sqrt(np.maximum(medians(np.concatenate(number), np.concatenate(excess)), 0.0))
    kappa[: len(found)] = found[: len(kappa)]
    faked = FAKED / np.sqrt(scene.n_images) * kappa[rings.number] * mean_light
    kept[inside] = np.maximum(kept[inside] - faked, 0.0)
    return _Estimate(scene, kept, fluxes, kappa)
