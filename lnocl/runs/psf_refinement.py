"""PSFs that are refined from the images before the reconstruction, and whether that helped."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from lnocl.errors import warn
from lnocl.runs.outcome import PsfRefinement
from lnocl.runs.psf_errors import PsfErrors
from lnocl.runs.short_runs import Estimate, ShortRuns, estimate_scatter, find_window, with_psfs
from lnocl.runs.start import Setup
from lnocl.scene.observation import Array, Observation
from lnocl.scene.psf_families import PsfFamilies, PsfParameters
from lnocl.solvers.psf_fit import Misfit, step

log = logging.getLogger("lnocl")

# Each round begins with the estimate after so many iterations with the present PSFs, and takes so
# many steps from it. After fewer than 15 the extended source is too smooth, and the PSFs follow it.
ITERATIONS, STEPS = (15, 15, 30), 2
# Free pixels follow the noise in more steps than these.
PIXEL_ITERATIONS, PIXEL_STEPS = (15, 15, 15, 15), 1
# Refined PSFs are used where chi squared of those given exceeds its expectation by so many standard
# deviations, and this share of that is mended.
WRONG, MENDED = 2.0, 0.65
# Free pixels may err by so many times what residuals show.
LOOSE = 3.0
# Where the PSFs' error exceeds the noise at the stars so many times, it is made a part of it: else
# held-out counts, which do not see it, run until it ruins the sky near the star.
RUINOUS = 4.0
# PSFs that are wrong by more than this are not told from the sky, whatever their noise.
HOPELESS = 0.15
# Of PSFs that are wrong by more than this it is warned.
WORTH_SAYING = 0.03
# A step is halved so often, at most, until no OTF exceeds its value at frequency 0.
MAX_HALVED = 10


def refine_psfs(
    setup: Setup, observation: Observation, names: Sequence[str], is_round: bool
) -> tuple[Observation, PsfRefinement]:
    """Return the observation with the PSFs that fit better, and what was found.

    Rounds of short runs, from the estimate of which parameters, star fluxes and perhaps positions
    are fitted (`lnocl.solvers.psf_fit`), in a window round the stars. What the extended source has
    all round a star is taken for the star's, unless it is round itself, and so is what the error of
    its PSFs may have left there. The given PSFs stand where the refined ones mend too little.

    Parameters
    ----------
    setup : Setup
        The parameters of the runs; one star or more among them.
    observation : Observation
        The images and the given PSFs.
    names : sequence of str
        Families of `PsfFamilies`.
    is_round : bool
        Whether the extended source lies all round a star.
    """
    window, stars, first = find_window(setup, observation)
    runs = ShortRuns(setup, window, stars, is_round)
    before, of_given = runs.judge(observation.psfs)
    families = PsfFamilies([name for name in names if name != "pixels"], observation)
    values = np.zeros((observation.n_images, 0))
    refined, after, of_refined = observation.psfs, before, of_given
    if families.parameters:
        refined, values = _find(runs, families, setup.refine_positions)
        after, of_refined = runs.judge(refined)
    if "pixels" in names:  # which are to mend what the others leave
        pixels = _pixels(observation, refined, of_refined)
        schedule = PIXEL_ITERATIONS, PIXEL_STEPS
        found = _search(runs, pixels, pixels.first(), schedule, setup.refine_positions)
        refined = pixels.psfs(found)
        after, of_refined = runs.judge(refined)
    is_accepted = _mends(before, after, "pixels" in names)
    final, estimate, known = before, of_given, observation.psf_scatter
    if is_accepted:
        observation, final, estimate = with_psfs(observation, refined), after, of_refined
        known = known[:0] if "pixels" in names else known  # what was scattered is found
    errors = PsfErrors(observation, estimate, first, final, known)
    is_noise = len(known) > 0 or (errors.over_noise > RUINOUS and errors.overall <= HOPELESS)
    refinement = PsfRefinement(
        tuple(families.parameters),
        values / families.units,
        (before.reduced, after.reduced),
        is_accepted,
        errors.overall,
        errors.edges,
        errors.at_radius,
        is_noise,
        errors.in_sky(),
    )
    log.info(_told(refinement))
    _warn(refinement)
    return errors.as_noise() if is_noise else observation, refinement


def _pixels(observation: Observation, psfs: Array, estimate: Estimate) -> PsfFamilies:
    """Return PSFs whose pixels are free, as far as their scatter is given, or residuals show it."""
    scatter = observation.psf_scatter
    if not len(scatter):
        scatter = LOOSE * estimate_scatter(psfs, estimate.kappa, observation.oversample)
    return PsfFamilies(("pixels",), with_psfs(observation, psfs), scatter)


def _mends(before: Misfit, after: Misfit, are_pixels_free: bool) -> bool:
    """Return whether refined PSFs mend so much that they are used."""
    if are_pixels_free and before.is_noise:  # which they may follow
        return False
    is_wrong = before.significance > WRONG
    return is_wrong and before.square - after.square > MENDED * before.excess


def _told(refinement: PsfRefinement) -> str:
    before, after = refinement.misfit
    if before == after:  # nothing was asked to be refined
        return f"the misfit of the PSFs is {before:.3g}, where noise gives 1"
    words = "refined" if refinement.is_accepted else "left as given"
    return f"PSFs {words}: their misfit is {before:.3g}, refined {after:.3g}, where noise gives 1"


def _warn(refinement: PsfRefinement) -> None:
    if refinement.psf_error <= WORTH_SAYING:
        return
    words = f"the PSFs do not fit the stars, by {100 * refinement.psf_error:.2g} %"
    if refinement.psf_error > HOPELESS:
        warn(f"{words}: give better ones; trust neither the sky near the stars nor their fluxes")
    elif refinement.is_noise:
        warn(f"{words}, which is added to the noise: trust nothing faint near the stars")
    else:
        warn(f"{words}: trust nothing fainter than this near the stars")


def _find(runs: ShortRuns, families: PsfFamilies, moves: bool) -> tuple[Array, Array]:
    """Return the PSFs that fit best, and their values; the stars' places may be fitted too."""
    firsts = [families.first(search) for search in range(families.n_searches)]
    schedule = ITERATIONS[:-1], STEPS
    found = [_search(runs, families, first, schedule, moves) for first in firsts]
    parameters = found[0]
    if len(found) > 1:
        parameters = _best_of_each_image(runs, families, found)
    parameters = _search(runs, families, parameters, (ITERATIONS[-1:], STEPS), moves)
    return families.psfs(parameters), parameters.values


def _best_of_each_image(
    runs: ShortRuns, families: PsfFamilies, found: Sequence[PsfParameters]
) -> PsfParameters:
    """Return for each image the parameters that fit it best, of those that were found."""
    squares = [runs.judge(families.psfs(each))[0].squares for each in found]
    best = np.argmin(squares, axis=0)
    values = [found[search].values[j] for j, search in enumerate(best)]
    return found[0]._replace(values=np.array(values))


def _search(
    runs: ShortRuns,
    families: PsfFamilies,
    parameters: PsfParameters,
    schedule: tuple[Sequence[int], int],
    moves: bool,
) -> PsfParameters:
    """Return the parameters after rounds of so many iterations each, and so many steps."""
    iterations, steps = schedule
    for n_iter in iterations:
        found = runs.at(families.psfs(parameters), n_iter)
        for _ in range(steps):
            change = step(found.scene, families, parameters, found.extended, found.fluxes, moves)
            parameters = _follow(families, parameters, change.parameters)
            if moves:  # which a common shift is not told from
                parameters, common = families.without_common_shift(parameters)
                moved = change.positions + common / found.scene.oversample
                change = change._replace(positions=moved)
            found = runs.moved(found, families.psfs(parameters), change)
    return parameters


def _follow(
    families: PsfFamilies, parameters: PsfParameters, change: PsfParameters
) -> PsfParameters:
    """Return the parameters after a step, shortened until the PSFs are those of some light."""
    for halved in range(MAX_HALVED):
        after = parameters.plus(change, 0.5**halved)
        if families.are_possible(after):
            return after
    return parameters
