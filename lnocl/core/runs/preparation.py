"""What a run takes of its plan, once levels are fitted and PSFs judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lnocl.core.runs.options import StopName
from lnocl.core.runs.outcome import Mended, PsfRefinement, joined_refinement
from lnocl.core.runs.plan import AUTO, CORES, EXPOSURES, LEVELS, PLACES, PSFS, RAYS, Plan
from lnocl.core.runs.start import Setup
from lnocl.core.runs.steady import STEADY, steady_penalty
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.components import Mixing
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty, recommend_smoothings
from lnocl.core.scene.scene import Scene
from lnocl.errors import NotFiniteError, detail, note, of_images
from lnocl.process import ignored_notes, ignored_warnings
from lnocl.progress import Progress

# Of the smoothing that is recommended, from which held-out counts choose besides none.
MULTIPLES = (1.0, 3.0, 10.0)
# Pixels by which the stars of filters may lie apart, and standard errors.
MISPLACED, SURELY = 0.1, 5.0
# Filters of which each has lines of its own.
MOST_TOLD = 4
# Runs with wrong PSFs end where the objective falls by less than this share of itself.
CONVERGED = 1e-6


@dataclass(frozen=True)
class Prepared:
    """A run that is ready to begin.

    Attributes
    ----------
    setup : Setup
        The parameters, with the observation as it was mended.
    penalties : sequence of Penalty
        One, or more from which held-out counts choose.
    n_iter : int
        Iterations at most.
    stop : {"held-out", "discrepancy"}, float or None
        Rule by which to stop.
    steady : Penalty or None
        That of `lnocl.core.runs.steady`, where such a run goes first.
    refinement : PsfRefinement or None
        The outcome for PSFs that were judged.
    is_within : bool
        Whether PSFs were judged, and are off by no more than their `psf_error` holds.
    found : mapping of str
        What steps of the plan have found, in words.
    """

    setup: Setup
    penalties: Sequence[Penalty]
    n_iter: int
    stop: StopName | float | None
    steady: Penalty | None = None
    refinement: PsfRefinement | None = None
    is_within: bool = False
    found: Mapping[str, str] = field(default_factory=dict)

    def of(self, observation: Observation, stars: Array, **changes: Any) -> Prepared:
        """Return this run of another observation, with other stars; `changes` are of the setup."""
        setup = replace(self.setup, observation=observation, stars=stars, **changes)
        return replace(self, setup=setup)

    def penalised(self, **changes: Any) -> Prepared:
        """Return this run with the same changes of all its penalties."""
        penalties = [replace(each, **changes) for each in self.penalties]
        steady = self.steady and replace(self.steady, **changes)
        return replace(self, penalties=penalties, steady=steady)


def quietly() -> np.errstate:
    """Have NumPy not warn of what is too large: the run looks for objectives that are infinite."""
    return np.errstate(over="ignore", invalid="ignore")


def prepare(plan: Plan, progress: bool = False) -> Prepared:
    """Return the run of a plan, after levels are fitted and PSFs and positions judged."""
    setup, found = _mend_images(plan)
    mended = _mended(plan, setup, progress)
    is_auto, stop = AUTO.holds(plan) and plan.does(PSFS), plan.stop
    are_wrong = is_auto and mended.near_stars is not None and not mended.fits
    penalties = _penalties(plan, mended, are_wrong)
    if are_wrong and stop == "held-out":  # which shares their error, and chooses too little
        stop = CONVERGED
    of_psfs = steady_penalty(penalties), mended.refinement, is_auto and mended.is_within
    return Prepared(mended.setup, penalties, plan.n_iter, stop, *of_psfs, found)


def _mended(plan: Plan, setup: Setup, progress: bool) -> Mended:
    """Return a setup with levels fitted and PSFs judged: of several skies, filter by filter.

    What the images of a filter show is one sky.
    """
    observation = setup.observation
    mixing = observation.mixing if plan.does(LEVELS) or plan.does(PSFS) else None
    if mixing is None:
        if plan.does(LEVELS):
            from lnocl.core.runs.halos import settle_levels  # which loads scipy

            with quietly(), Progress(None, "", bool(progress), "fitting levels"):
                setup = settle_levels(setup)
        return _judge_psfs(plan, setup, progress) if plan.does(PSFS) else Mended(setup)
    found, names = list[Mended](), mixing.filter_names
    for g in range(len(names)):
        found.append(_mended_filter(plan, setup, mixing, g, progress))
    is_moved = [each.judged is not None for each in found]
    if plan.mends and plan.moves and any(is_moved):
        for g in np.flatnonzero(~np.array(is_moved)).tolist():  # whose places are to be compared
            with ignored_notes(), ignored_warnings():
                moved = _mended_filter(replace(plan, moves=True), setup, mixing, g, progress)
            found[g] = found[g]._replace(judged=moved.judged, given=moved.given)
        setup = _in_one_place(setup, mixing, found)
    if len(names) > MOST_TOLD:
        note(f"what was found for {len(names) - MOST_TOLD} other filters is in the result alone")
    return _joined(setup, mixing, found)


def _mended_filter(plan: Plan, setup: Setup, mixing: Mixing, g: int, progress: bool) -> Mended:
    """Return the setup of the images of a filter, as `_mended` does."""
    which, families = mixing.images[g], plan.families
    observation = setup.observation.of_images(which)
    own = replace(setup, observation=observation, stars=_seen_stars(observation, setup.stars))
    own = replace(own, initial_extended=None, initial_star_fluxes=None)
    if len(which) == 1 and not plan.is_asked:  # whose place is that of its stars
        families = tuple(name for name in families if name != "shift")
    if not len(own.stars):  # to fit any to
        families = ()
    quiet = ignored_notes() if g >= MOST_TOLD else nullcontext()
    with of_images(which, mixing.filter_names[g]), quiet:
        return _mended(replace(plan, setup=own, families=families), own, progress)


def _seen_stars(observation: Observation, stars: Array) -> Array:
    """Return the stars that the images of a filter show: others tell nothing of it."""
    stars = stars[observation.shows(stars)]
    if not (len(stars) and observation.mask.any()):
        return stars
    with ignored_warnings(), ignored_notes():  # of the PSFs, of which the run tells too
        return np.asarray(stars[Scene(observation).observes(stars)])


def _in_one_place(setup: Setup, mixing: Mixing, found: Sequence[Mended]) -> Setup:
    """Return a setup with the images of filters moved to where those of the first see the stars."""
    observation, moved = setup.observation, np.zeros((setup.observation.n_images, 2))
    places = list(map(_away, found))
    for name, images, (away, error) in zip(mixing.filter_names, mixing.images, places, strict=True):
        x, y = by = away - places[0][0]
        if np.hypot(x, y) > max(MISPLACED, SURELY * float(np.hypot(error, places[0][1]))):
            moved[images] = observation.turns[images] @ by
            note(
                f"{name}: images moved by ({x:+.2f}, {y:+.2f}) pixels, by their stars "
                "(`mend_images` False leaves them)"
            )
    return replace(setup, observation=observation.moved(moved)) if moved.any() else setup


def _away(mended: Mended) -> tuple[Array, float]:
    """Return how far stars lie from where they were given, pixels, and its standard error.

    It is the mean by the inverse squares of errors; the error is infinite where none is known.
    """
    if mended.judged is None:
        return np.zeros(2), np.inf
    from lnocl.core.solvers.star_errors import standard_errors  # which loads scipy

    scene = mended.judged.scene
    errors = standard_errors(mended.judged, True)[0][:, 1:].max(axis=1)
    weights = np.nan_to_num(errors**-2.0, posinf=0.0).reshape(len(scene.places), -1).sum(axis=1)
    if not weights.sum():
        return np.zeros(2), np.inf
    mean = np.average(scene.places - mended.given, axis=0, weights=weights)
    return np.asarray(mean), float(weights.sum() ** -0.5)


def _joined(setup: Setup, mixing: Mixing, found: Sequence[Mended]) -> Mended:
    """Return the setup of all images, with what was mended of those of each filter.

    The error of PSFs asks each sky to be smoothed by the root of the sum of squares of what it asks
    of what filters show, times their weights.
    """
    mended = [each.setup.observation for each in found]
    observation = setup.observation.joined(list(zip(mixing.images, mended, strict=True)))
    moves = any(each.setup.refine_positions for each in found)
    near = [each.near_stars for each in found]
    near_stars, shape = None, observation.sky_shape
    if any(each is not None for each in near):
        squares = [np.zeros(shape) if each is None else each**2 for each in near]
        near_stars = np.sqrt(np.einsum("gk,gyx->kyx", mixing.rows**2, np.array(squares)))
    return Mended(
        replace(setup, observation=observation, refine_positions=moves),
        joined_refinement(mixing.images, [each.refinement for each in found], observation.n_skies),
        near_stars,
        all(each.fits for each in found),
        all(each.is_within for each in found),
    )


def _mend_images(plan: Plan) -> tuple[Setup, dict[str, str]]:
    """Return the setup of a plan with images mended, and in words what was."""
    from lnocl.core.runs import mends  # which loads scipy

    steps = {
        PLACES: mends.align_images,
        CORES: mends.mask_cores,
        RAYS: mends.mask_rays,
        EXPOSURES: mends.fit_exposures,
    }
    setup, found = plan.setup, dict[str, str]()
    for step in filter(plan.does, steps):
        setup, found[step] = steps[step](setup)
    return setup, found


def _judge_psfs(plan: Plan, setup: Setup, progress: bool) -> Mended:
    """Return that of `lnocl.core.runs.psf_refinement.mend`, or `setup` where it is not finite.

    The scatter of such PSFs is one of the unknowns at the stars: they fit unless residuals show
    otherwise. Exact ones are wrong by the scatter that is given.
    """
    from lnocl.core.runs.guarded_runs import GuardedRuns  # which loads scipy
    from lnocl.core.runs.psf_refinement import mend

    known, judged = setup.observation.psf_scatter, setup
    if setup.observation.psf_error and len(known):
        judged = replace(setup, observation=setup.observation.replace(psf_scatter=None))
    mended = Mended(judged)
    judging = Progress(None, "it", bool(progress), "judging the PSFs")
    with judging, suppress(NotFiniteError):  # of which the run itself tells
        runs = GuardedRuns(judged, judging.update)
        mended = mend(runs, plan.families, plan.moves, plan.is_asked)
    if judged is setup:
        return mended
    observation = mended.setup.observation
    found = observation.psf_scatter
    observation = observation.replace(psf_scatter=np.maximum(known, found) if len(found) else known)
    return mended._replace(setup=replace(mended.setup, observation=observation))


def _penalties(plan: Plan, mended: Mended, are_psfs_wrong: bool) -> list[Penalty]:
    """Return the penalty, or those from which held-out counts choose."""
    if not isinstance(plan.smoothing, str):
        return [Penalty(plan.mu, plan.smoothing, spectral=plan.spectral_smoothing)]
    recommended, *others = recommend_smoothings(mended.setup.observation).tolist()
    shares = (1.0, *(each / recommended for each in others)) if others else ()
    multiples: Sequence[float] = (1.0,)
    reason = "the noise of the counts"
    if are_psfs_wrong:
        multiples, reason = (STEADY,), "the error of the PSFs"
    elif plan.stop == "held-out":
        multiples, reason = (0.0, *MULTIPLES), ""
    weights = (each * recommended for each in multiples)
    first = Penalty(plan.mu, 0.0, (), mended.near_stars, shares, plan.spectral_smoothing)
    penalties = [replace(first, smoothing=each) for each in weights]
    if reason:
        detail(f"`smoothing` chosen: {penalties[0].in_words()}, by {reason}")
    return penalties
