"""PSFs and positions that the images show to be wrong: mended where that helps, else allowed for.

All is judged by one number, the error kappa of the PSFs that is left at the stars in
`lnocl.core.runs.guarded_runs`: whether anything is wrong, whether a mend is taken, and how strongly
the extended source is smoothed near the stars because of what could not be mended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lnocl.core.runs.guarded_runs import FIRST_ERROR, GUARD, GuardedRuns, Judged, estimate_scatter
from lnocl.core.runs.outcome import Mended, PsfRefinement
from lnocl.core.runs.psf_allowance import STRENGTH, Allowance
from lnocl.core.runs.psf_posterior import HELD
from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_families import PsfFamilies, PsfParameters
from lnocl.core.scene.psf_faults import name_faults
from lnocl.core.scene.psf_field import Psfs, either, mapped
from lnocl.core.scene.psf_misfit import PsfMisfit
from lnocl.core.scene.psf_wings import are_noisy, without_noise
from lnocl.core.scene.psfs import MOST_PSF_ERROR
from lnocl.core.scene.star_psfs import owned
from lnocl.core.solvers.companions import Companion, companions
from lnocl.core.solvers.psf_errors import alike
from lnocl.core.solvers.psf_fit import step
from lnocl.errors import DivergedError, NotFiniteError, counted, detail, note, warn
from lnocl.process import ignored_notes, ignored_warnings

# A mend is taken where it leaves less than this share of kappa, or nothing to doubt, and a misfit
# that is less by so many of its standard deviations.
MENDED, GONE = 0.5, 2.0
# None is taken that leaves a star less than this share of its flux, or so little to judge by.
FADED = 0.5
# Free pixels, which may fit anything, are to leave less than this share of kappa. Where it is not
# significant they are tried above this kappa.
FITTED, FREED = 0.3, 0.1
# Images that lie farther from where their offsets have them, pixels, are named.
MISPLACED = 0.1
# Families that take a host, or a companion, for the PSF: unasked they are fitted beyond it alone.
TAKING = "jitter", "pixels"
# Rounds of a search: each takes so many steps, and judges the PSFs. It ends where a round lowers
# the misfit by less than so many of its standard deviations.
ROUNDS, STEPS, IMPROVED = 4, 2, 0.3
# PSFs are next taken to be wrong by so many times what they were, at most by `FIRST_ERROR`.
LOOSE = 2.0
# Of PSFs that are left wrong by more than this it is warned; of those whose pixels were fitted, by
# more than `FIRST_ERROR`.
NOTABLE = 0.03
# What to do about them.
FOREIGN = "see whether they are of these images, and sampled alike"
# Of more stars in the window the least squares would take more memory than the run.
MOST_STARS = 64
# A step is halved so often, at most, until no OTF exceeds its value at frequency 0.
MAX_HALVED = 10


@dataclass(frozen=True)
class _State:
    """PSFs, the places of stars for them, whether these move, and how to make their estimate."""

    psfs: Psfs
    stars: Array
    moves: bool
    judge: Callable[[], Judged]

    @classmethod
    def of(cls, runs: GuardedRuns, psfs: Psfs, stars: Array, moves: bool, **how: float) -> _State:
        """Return the state of PSFs that runs judge when they are first asked."""
        return cls(psfs, stars, moves, lambda: runs.fit(psfs, stars, moves, **how))

    @cached_property
    def estimate(self) -> Judged:
        return self.judge()

    @property
    def misfit(self) -> PsfMisfit:
        return self.estimate.misfit

    @property
    def places(self) -> Array:
        """The places of the stars, moved where they may be."""
        return self.estimate.scene.places if self.moves else self.stars

    @property
    def star_fluxes(self) -> Array:
        """The fluxes of the stars, electrons."""
        return self.estimate.star_fluxes[: self.estimate.scene.n_stars]

    def is_mended_by(self, other: _State) -> bool:
        """Return whether other PSFs or positions mend enough to be taken."""
        before, after = self.misfit, other.misfit
        if (other.star_fluxes < FADED * self.star_fluxes).any():
            return False  # a sharper PSF, and the star's light in the extended source
        if after.expected.sum() < FADED * before.expected.sum():
            return False  # stars that dominate nowhere show no misfit
        is_less = before.significance - after.significance > GONE
        return is_less and (not after.is_doubtful or after.kappa < MENDED * before.kappa)


def mend(runs: GuardedRuns, names: Sequence[str], moves: bool | str, is_asked: bool) -> Mended:
    """Return a setup whose positions and PSFs are mended where the images ask for it.

    Points beside the stars, which PSFs that may have an error would follow, are held meanwhile. The
    noise of PSFs that have negative pixels, but for exact ones that fit, is taken from their wings
    first, unless they fit worse so. PSFs that may have an error then become the mean of what the
    stars show of it (`lnocl.core.runs.psf_posterior`), each where its images fit better so.
    Where they are off by no more than that error holds, neither jitter nor pixels are fitted
    unasked, and stars take their marginal fluxes. Where they are off by more, the error is raised
    at the end to what holds it.

    What does not fit then is mended: stars are moved, the families are fitted, and pixels freed.
    Each is tried only where the misfit before is in doubt. It is taken where it leaves less than
    half of kappa, or nothing to doubt, and every star more than half its flux.

    Free pixels fit any star, and may take some of its surroundings for the PSF. So they are to
    leave less than 0.3 of kappa, and the error that is allowed for is the one before them.

    Parameters
    ----------
    runs : GuardedRuns
        Those of the images and the given PSFs.
    names : sequence of str
        Families of `PsfFamilies` that may be refined.
    moves : bool or "auto"
        Whether stars are moved; "auto": where that mends a misfit.
    is_asked : bool
        Whether the outcome is wanted though PSFs may fit.
    """
    setup, observation = runs.whole, runs.whole.observation
    may_hide = names and observation.psf_error and len(setup.stars) <= MOST_STARS
    if may_hide and len(points := _beside_stars(runs)):
        runs = runs.beside(points)
    if len(runs.stars) > MOST_STARS and not (is_asked or len(observation.psf_scatter)):
        number = counted(len(runs.stars), "star")
        note(f"PSFs are not judged: {number} in the window; name `refine_psfs` to judge them")
        return Mended(setup)
    psfs = observation.psfs_over_images
    given = state = _State.of(runs, psfs, runs.stars, moves is True)
    may_err = bool(observation.psf_error) or state.misfit.is_doubtful
    if names and may_err and are_noisy(observation.psfs):
        state = _clean(runs, state)
    done = ["noise of their wings removed"] if state.psfs is not psfs else []
    if names and observation.psf_error:
        settled = _settle(runs, state, moves is not False)
        if settled is not state:
            _tell_widths(observation.replace(psfs=state.psfs), settled.psfs)
        given, state = (settled if state is given else given), settled
    if state.misfit.is_doubtful and moves == "auto":
        moved = _State.of(runs, state.psfs, runs.stars, True)
        state = moved if state.is_mended_by(moved) else state
    if not is_asked and _is_held(state.misfit, observation):
        names = [name for name in names if name not in TAKING]
    of_parameters = [name for name in names if name != "pixels"]
    families = PsfFamilies(of_parameters, observation.replace(psfs=state.psfs))
    values, tried, left = np.zeros((observation.n_images, len(families.prior))), state, None
    is_fitted = False  # whether the PSFs used have these values
    if state.misfit.is_doubtful and families.parameters:
        tried, values = _fit(runs, families, state, moves is not False)
        if is_fitted := state.is_mended_by(tried):
            state = tried
            done.append(f"{' and '.join(of_parameters)} fitted")
    # Below either, pixels follow the noise.
    may_free = state.misfit.is_significant or state.misfit.kappa > FREED
    if state.misfit.is_doubtful and may_free and "pixels" in names:
        fitted, first = tried, min(state, tried, key=lambda each: each.misfit.kappa)
        # A source that is kept from the stars more strongly leaves its own errors to the pixels.
        loose = _State.of(runs, first.psfs, first.places, first.moves, guard=STRENGTH)
        tried = _free_pixels(runs, observation.psf_scatter, loose, moves is not False)
        if _is_trusted(tried, loose, state.misfit.kappa):
            left, state, is_fitted = state.misfit, tried, first is fitted
            done.append("pixels fitted")
    is_accepted = state.psfs is not observation.psfs_over_images
    if is_accepted:
        observation = observation.replace(psfs=state.psfs)
    known = observation.psf_scatter
    is_told = state is not given or given.misfit.is_significant
    estimate = replace(state.estimate, misfit=left or state.misfit)
    allowance = Allowance(observation, runs, estimate, known)
    near_stars = allowance.near_stars(setup.pad)
    changed = replace(setup, observation=observation, refine_positions=state.moves)
    places = state.estimate if state.moves else None, runs.stars
    if not (is_asked or len(known) or is_told):
        return Mended(changed, None, near_stars, True, True, *places)
    _tell(given, state, tried, done)
    if is_fitted and families.parameters[:2] == ["shift x", "shift y"]:
        _tell_places(values[:, :2] / families.units[:2])
    refinement = PsfRefinement(
        tuple(families.parameters),
        values / families.units if is_fitted or not is_accepted else 0.0 * values,
        (given.misfit.reduced, state.misfit.reduced),
        is_accepted,
        allowance.error,
        allowance.edges,
        allowance.in_rings,
        allowance.may_be_faked(),
        left is not None,
        state.misfit.hidden if state is not given else 0.0,
    )
    _warn(refinement, setup)
    # Replicas draw PSFs from it, so that the errors of regions contain that of the PSFs.
    if not len(known) and len(scatter := allowance.scatter()):
        observation = observation.replace(psf_scatter=scatter)
    fits = not allowance.error
    is_within = fits or _is_held(estimate.misfit, observation)
    if observation.psf_error and not is_within:  # the errors of stars hold what residuals show
        observation = observation.replace(psf_error=min(estimate.misfit.kappa, MOST_PSF_ERROR))
    changed = replace(changed, observation=observation)
    return Mended(changed, refinement, near_stars, fits, is_within, *places)


def _is_held(misfit: PsfMisfit, observation: Observation) -> bool:
    """Return whether PSFs that are not exact are off by no more than their `psf_error` holds."""
    error = observation.psf_error
    return bool(error) and misfit.kappa <= HELD * error


def _beside_stars(runs: GuardedRuns) -> Array:
    """Return the places of points that a run of the window shows beside stars, shape (n, 2).

    They are those of `lnocl.core.solvers.companions`, (x, y), pixels of the images: PSFs that may
    have an error would follow them. The noise of wings, which may look like one, is taken from
    the PSFs.
    """
    found, observation = list[Companion](), runs.whole.observation
    psfs = observation.psfs_over_images
    if are_noisy(observation.psfs):
        psfs = mapped(psfs, lambda _, stack: without_noise(stack, observation.oversample))
    with suppress(DivergedError, NotFiniteError), ignored_warnings(), ignored_notes():
        _, found = companions(runs.steady(psfs, runs.stars).estimate)
    places = runs.first + np.reshape([each.place for each in found], (-1, 2))
    if len(places):
        named = " ".join(f"({x:.4g}, {y:.4g})" for x, y in places)
        points = counted(len(places), "point")
        note(f"{points} beside stars held while PSFs are fitted, {named}: name what is a star")
    return np.asarray(places, np.float64)


def _settle(runs: GuardedRuns, state: _State, moves: bool) -> _State:
    """Return the state with PSFs that are the mean of what they may be, where they fit better.

    That mean takes the extended source to be as smooth as its prior. Where it is not, PSFs that are
    right would follow it, and their images fit worse.

    Where no PSF is in doubt, each stays that fits no better so. A PSF whose width changed by more
    than its error is used all the same, as a bright sky takes up what a wrong one leaves. Where
    PSFs are in doubt, how well one fits depends on the others: all change, or all stay. None is
    used with which a star loses its light. Stars that were moved are moved again for these, but
    where they follow a host from a flat sky.
    """
    psfs, stars = runs.settled(state.psfs, state.places, moves)
    is_moved = bool((stars != state.places).any())
    if psfs is state.psfs and not is_moved:
        return state
    settled = _State.of(runs, psfs, stars, state.moves or is_moved)
    numbers, rise = alike(runs.whole.observation), settled.misfit.excess - state.misfit.excess
    is_slight = abs(_widened(runs.whole.observation, psfs)) <= runs.whole.observation.psf_error
    stays = (np.bincount(numbers, rise) >= 0)[numbers] & is_slight & (not state.misfit.is_doubtful)
    if stays.all() and not is_moved:
        return state
    if stays.any():
        psfs = either(stays, state.psfs, psfs)
        settled = _State.of(runs, psfs, stars, settled.moves)
    if is_moved and settled.misfit.is_doubtful:
        stay = replace(_State.of(runs, psfs, stars, state.moves), moves=True)
        settled = min(settled, stay, key=lambda each: each.misfit.significance)
    is_worse = settled.misfit.significance > state.misfit.significance + GONE
    is_faded = (settled.star_fluxes < FADED * state.star_fluxes).any()
    return state if is_worse or is_faded else settled


def _clean(runs: GuardedRuns, state: _State) -> _State:
    """Return the state with the noise taken from the wings of PSFs, unless they fit worse so.

    Noise of wings hands the light of stars to the extended source, which it spreads, and nothing of
    that shows at the stars.
    """
    psfs = mapped(state.psfs, lambda _, each: without_noise(each, runs.observation.oversample))
    cleaned = _State.of(runs, psfs, state.places, state.moves)
    is_worse = cleaned.misfit.significance > state.misfit.significance + GONE
    return state if is_worse else cleaned


def _fit(
    runs: GuardedRuns, families: PsfFamilies, state: _State, moves: bool
) -> tuple[_State, Array]:
    """Return the state with the PSFs of families that fit best, and their values."""
    firsts = [families.first(search) for search in range(families.n_searches)]
    found = [_search(runs, families, first, state, moves) for first in firsts]
    parameters, fitted = min(found, key=lambda each: each[1].misfit.reduced)
    if len(found) > 1:  # phases of one image may be right in one search, of another in another
        squares = [each.misfit.squares for _, each in found]
        best = np.argmin(squares, axis=0)
        values = [found[search][0].values[j] for j, search in enumerate(best)]
        first = parameters._replace(values=np.array(values))
        again = _search(runs, families, first, fitted, moves)
        if again[1].misfit.reduced < fitted.misfit.reduced:
            parameters, fitted = again
    return fitted, parameters.values


def _free_pixels(runs: GuardedRuns, scatter: Array, state: _State, moves: bool) -> _State:
    """Return the state with PSFs whose pixels are free, as far as scatter or residuals show."""
    observation = runs.seen_through(state.psfs)
    scatter = runs.cut(scatter)
    if not len(scatter):
        rings = state.misfit.in_rings
        scatter = estimate_scatter(observation.psfs, rings, observation.oversample)
    families = PsfFamilies(("pixels",), observation, scatter)
    parameters, found = _search(runs, families, families.first(), state, moves, STRENGTH)
    changes = [families.correction(j, parameters) for j in range(observation.n_images)]
    psfs = runs.completed(state.psfs, changes)
    return _State(psfs, found.stars, found.moves, lambda: found.estimate)


def _is_trusted(tried: _State, state: _State, given: float) -> bool:
    """Return whether free pixels leave little of kappa, and change no star's flux by more than it.

    The wings of free PSFs may take the light of a host, and their cores that of a star. The state
    is the one that they begin from; given is kappa before, which families may have lowered.
    """
    before, after = state.star_fluxes, tried.star_fluxes
    is_near = abs(after - before) <= state.misfit.kappa * before
    is_fitted = tried.misfit.kappa < FITTED * given
    return is_fitted and bool(is_near.all())


def _search(
    runs: GuardedRuns,
    families: PsfFamilies,
    parameters: PsfParameters,
    state: _State,
    moves: bool,
    guard: float = GUARD,
) -> tuple[PsfParameters, _State]:
    """Return the parameters of the least misfit that a search finds, and the state with them."""
    found: list[tuple[PsfParameters, _State]] = []
    error, estimate = state.misfit.kappa, state.estimate
    for _ in range(ROUNDS):
        parameters, stars = _step(runs, families, parameters, estimate, moves)
        psfs = families.psfs_over_images(parameters)
        how = {"error": min(FIRST_ERROR, LOOSE * error), "guard": guard}
        tried = _State.of(runs, psfs, stars, moves, **how)
        estimate = tried.estimate
        gain = found[-1][1].misfit.significance - estimate.misfit.significance if found else np.inf
        found.append((parameters, tried))
        if gain < IMPROVED:
            break
        error = estimate.misfit.kappa
    return min(found, key=lambda each: each[1].misfit.reduced)


def _step(
    runs: GuardedRuns,
    families: PsfFamilies,
    parameters: PsfParameters,
    estimate: Judged,
    moves: bool,
) -> tuple[PsfParameters, Array]:
    """Return the parameters and the stars after a few steps from an estimate."""
    stars = estimate.scene.places
    found = runs.moved(estimate, families.psfs_over_images(parameters), estimate.star_fluxes, stars)
    for _ in range(STEPS):
        change = step(found, families, parameters, moves)
        parameters, stars = _follow(families, parameters, change.parameters), change.positions
        if moves:  # which a common shift is not told from
            parameters, common = families.without_common_shift(parameters)
            is_through = found.scene.owned[:: found.scene.n_epochs, None] < 0
            stars = stars + is_through * common / found.scene.oversample
        psfs = families.psfs_over_images(parameters)
        found = runs.moved(found, psfs, change.star_fluxes, stars)
    return parameters, found.scene.places


def _follow(
    families: PsfFamilies, parameters: PsfParameters, change: PsfParameters
) -> PsfParameters:
    """Return the parameters after a step, shortened until the PSFs are those of some light."""
    for halved in range(MAX_HALVED):
        after = parameters.plus(change, 0.5**halved)
        if families.are_possible(after):
            return after
    return parameters


def _widened(observation: Observation, psfs: Psfs) -> Array:
    """Return by how much wider PSFs are than those of an observation, relative to these, (p,)."""
    pairs = zip(observation.replace(psfs=psfs).psfs, observation.psfs, strict=True)
    return np.array([fwhm(after) / fwhm(before) - 1.0 for after, before in pairs])


def _tell_widths(observation: Observation, psfs: Psfs) -> None:
    """Say in a line how wide PSFs are that were fitted to the stars, over those given."""
    widths = 100.0 * _widened(observation, psfs)
    words = " to ".join(dict.fromkeys(f"{width:+.1f}" for width in (min(widths), max(widths))))
    if max(abs(widths)) > 100.0 * FIRST_ERROR:
        warn(
            f"the PSFs given do not fit the stars, by {words} % in width, and were fitted there: "
            f"{FOREIGN}"
        )
    else:
        note(f"PSFs fitted to the stars: {words} % in width (`psf_error` 0 leaves them)")


def _tell_places(shifts: Array) -> None:
    """Say in a line for each image that lies elsewhere, by the shift of its PSF, in pixels."""
    for j, (dx, dy) in enumerate(shifts):
        if len(shifts) > 1 and np.hypot(dx, dy) > MISPLACED:
            note(
                f"`images[{j}]` was ({dx:+.2f}, {dy:+.2f}) pixels from its offset, or its PSF from "
                "its centre: its PSF is moved"
            )


def _tell(given: _State, state: _State, tried: _State, done: Sequence[str]) -> None:
    """Say in a line what was done."""
    before, after, found = (each.misfit.reduced for each in (given, state, tried))
    if done:
        note(
            f"PSFs refined, {', '.join(done)}: misfit {after:.3g}, before {before:.3g}; noise has 1"
        )
    elif state.moves and not given.moves:
        note(
            f"positions refined: misfit of the stars {after:.3g}, before {before:.3g}; noise has 1"
        )
    elif tried is not given:
        note(
            f"PSFs not changed: misfit {before:.3g}, refined {found:.3g}; noise has 1; too much of "
            "the error is left, or a star loses its light"
        )
    else:
        detail(f"misfit of the PSFs {before:.3g}; noise has 1")


def _warn(refinement: PsfRefinement, setup: Setup) -> None:
    seen = setup.stars[owned(setup.observation, setup.stars) < 0]
    if refinement.has_free_pixels and refinement.psf_error > FIRST_ERROR:
        warn(
            f"the PSFs given do not fit the stars, by {100 * refinement.psf_error:.0f} %, and "
            "their pixels were fitted there: " + (name_faults(setup.observation, seen) or FOREIGN)
        )
    if not refinement.has_free_pixels and refinement.psf_error > NOTABLE:
        are_exact = "" if setup.observation.psf_error else ", or leave `psf_error` 0 out"
        warn(
            f"the PSFs do not fit the stars, by {100 * refinement.psf_error:.2g} %: "
            + (
                name_faults(setup.observation, seen)
                or f"trust nothing fainter than this near the stars{are_exact}"
            )
        )
