"""A plan: what `lnocl.deconvolve` does with an observation, by one table of rules."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from lnocl.core.runs import options
from lnocl.core.runs.options import EngineName, Precision, StopName
from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import flag
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.psf_families import Family
from lnocl.core.scene.star_psfs import owned, refuse_unowned
from lnocl.core.scene.stars import check_positions
from lnocl.core.scene.zero_points import FEWEST
from lnocl.core.solvers import SolverName
from lnocl.errors import InputError

PLACES, CORES, RAYS, EXPOSURES, LEVELS, PSFS, HALOS, PRIOR, CHOICE, STARS = STEPS = (
    "align images by their stars",
    "mask saturated cores",
    "mask cosmic rays",
    "fit exposures to stars",
    "fit levels of backgrounds",
    "judge PSFs before the run",
    "settle halos",
    "give stars a prior by a run with a fixed weight",
    "choose the iteration by held-out counts",
    "take marginal star fluxes",
)


class Condition(NamedTuple):
    """What must hold of a plan for a step.

    Attributes
    ----------
    holds : callable
        Tells of the plan whether it does.
    otherwise : str
        What is said where it does not.
    """

    holds: Callable[[Plan], bool]
    otherwise: str


AUTO = Condition(lambda plan: plan.smoothing == "auto", "`smoothing` is a number")
MENDS = Condition(lambda plan: plan.mends, "`mend_images` is False")
HAS_STARS = Condition(lambda plan: len(plan.setup.stars) > 0, "there are no stars")
SEVERAL = Condition(lambda plan: plan.setup.observation.n_images > 1, "there is one image")
# From filter to filter a star has another flux, and neither varies nor moves in one.
STEADY = Condition(
    lambda plan: plan.setup.observation.is_of_one_time or len(plan.setup.stars) >= FEWEST,
    "fewer than three stars may vary from epoch to epoch",
)
ALIKE = Condition(
    lambda plan: max(Counter(map(tuple, plan.setup.observation.components)).values()) > 1,
    "there is one image of each filter",
)
SHOWS_PSFS = Condition(
    lambda plan: bool((owned(plan.setup.observation, plan.setup.stars) < 0).any()),
    "all stars have PSFs of their own",
)
HAS_HALOS = Condition(lambda plan: len(plan.setup.observation.halos) > 0, "there are no halos")
NO_HALOS = Condition(
    lambda plan: not len(plan.setup.observation.halos), "halos may be as bright beside stars"
)
HAS_ERROR = Condition(
    lambda plan: bool(plan.setup.observation.background_error.any()), "backgrounds have no error"
)
HELD_OUT = Condition(lambda plan: plan.stop == "held-out", "`stop` is another rule")
WHOLE = Condition(lambda plan: not plan.in_tiles, "the images are divided into tiles")

# What each step needs, in the order in which reasons are given.
NEEDS: dict[str, tuple[Condition, ...]] = {
    PLACES: (AUTO, MENDS, HAS_STARS, SEVERAL, SHOWS_PSFS, STEADY, NO_HALOS, WHOLE),
    CORES: (AUTO, MENDS, HAS_STARS),
    RAYS: (AUTO, MENDS),
    EXPOSURES: (AUTO, MENDS, HAS_STARS, SEVERAL, ALIKE, STEADY, NO_HALOS),
    LEVELS: (AUTO, HAS_ERROR, WHOLE),
    PSFS: (AUTO, HAS_STARS, SHOWS_PSFS),
    HALOS: (AUTO, HAS_HALOS),
    PRIOR: (AUTO, HELD_OUT, HAS_STARS),
    CHOICE: (HELD_OUT,),
    STARS: (AUTO, HAS_STARS),
}
# Of steps that hang on what those before find: where they are done.
UNLESS_WRONG = "unless PSFs are wrong"
WHERE = {PRIOR: UNLESS_WRONG, CHOICE: UNLESS_WRONG, STARS: "where PSFs nearly fit"}


@dataclass(frozen=True, eq=False)
class Plan:
    """What `lnocl.deconvolve` does with an observation: which steps, and why not the others.

    ``print(plan)`` tells a line of each step. A step that hangs on what others find says so.

    Attributes
    ----------
    setup : Setup
        The observation, the stars and how iterations are computed.
    mu : float
        Weight of the Tikhonov term.
    smoothing : float or "auto"
        Weight of the edge-preserving term.
    spectral_smoothing : float
        Its share between one component and the next.
    n_iter : int
        Iterations at most.
    stop : {"held-out", "discrepancy"}, float or None
        Rule by which to stop.
    families : tuple of str
        Families of PSFs that may be refined.
    is_asked : bool
        Whether they were named.
    moves : bool or "auto"
        Whether stars are moved; "auto": where that mends a misfit.
    in_tiles : bool
        Whether it is that of `lnocl.deconvolve_tiles`.
    mends : bool
        Whether images may be mended before anything is fitted to them.
    found : mapping of str
        What steps that are done have found, in words; it is told with them.

    See Also
    --------
    lnocl.plan : Makes it.
    lnocl.deconvolve : Carries it out.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> image = np.full((16, 16), 2.0)
    >>> image[5, 8] += 100.0
    >>> obs = lnocl.Observation(np.stack([image] * 2), np.ones((3, 3)), epochs=[0, 1])
    >>> print(lnocl.plan(obs, [(8, 5)]))
    align images by their stars: no, fewer than three stars may vary from epoch to epoch
    mask saturated cores: yes
    mask cosmic rays: yes
    fit exposures to stars: no, fewer than three stars may vary from epoch to epoch
    fit levels of backgrounds: no, backgrounds have no error
    judge PSFs before the run: yes, and fit shift, jitter, pixels
    settle halos: no, there are no halos
    give stars a prior by a run with a fixed weight: yes, unless PSFs are wrong
    choose the iteration by held-out counts: yes, unless PSFs are wrong
    take marginal star fluxes: yes, where PSFs nearly fit
    """

    setup: Setup
    mu: float
    smoothing: float | Literal["auto"]
    n_iter: int
    stop: StopName | float | None
    families: tuple[str, ...] = ()
    is_asked: bool = False
    moves: bool | Literal["auto"] = False
    in_tiles: bool = False
    mends: bool = True
    spectral_smoothing: float = 0.0
    found: Mapping[str, str] = field(default_factory=dict)

    def why_not(self, step: str) -> str:
        """Return why a step is not done; an empty text where it is.

        Parameters
        ----------
        step : str
            A step as `steps` names it, such as "mask cosmic rays".

        Returns
        -------
        str
            The first reason, such as "there are no stars".

        Raises
        ------
        InputError
            No step has this name.

        Examples
        --------
        >>> import numpy as np
        >>> import lnocl
        >>> plan = lnocl.plan(lnocl.Observation(np.full((16, 16), 9.0), np.ones((3, 3))))
        >>> plan.why_not("mask saturated cores"), plan.why_not("mask cosmic rays")
        ('there are no stars', '')
        """
        if step not in NEEDS:
            raise InputError(f"no step is called {step!r}; choose from {', '.join(STEPS)}")
        observation = self.setup.observation
        # Else it is one of the unknowns at the stars.
        is_given = len(observation.psf_scatter) > 0 and not observation.psf_error
        if step == PSFS and (self.families or (is_given and SHOWS_PSFS.holds(self))):
            return ""
        return next((each.otherwise for each in NEEDS[step] if not each.holds(self)), "")

    def does(self, step: str) -> bool:
        """Return whether a step is done, as `steps` names it; see `why_not`."""
        return not self.why_not(step)

    def steps(self) -> list[tuple[str, str]]:
        """Return each step, and in words whether it is done."""
        return [(step, self._in_words(step)) for step in STEPS]

    def _in_words(self, step: str) -> str:
        if why := self.why_not(step):
            return f"no, {why}"
        if step == PSFS and self.families:
            return f"yes, and fit {', '.join(self.families)}"
        where = WHERE.get(step, "")
        if where == UNLESS_WRONG and not (AUTO.holds(self) and self.does(PSFS)):
            where = ""
        return ", ".join(filter(None, ("yes", where, self.found.get(step, ""))))

    def __str__(self) -> str:
        """Return a line for each step."""
        return "\n".join(f"{step}: {words}" for step, words in self.steps())


def plan(
    observation: Observation,
    stars: Any = (),
    *,
    mu: float = 0.0,
    smoothing: float | Literal["auto"] = "auto",
    spectral_smoothing: float = 0.0,
    solver: SolverName = "sgp",
    n_iter: int = 1000,
    stop: StopName | float | None = "held-out",
    precision: Precision = "single",
    engine: EngineName = "opencl",
    device: str | None = None,
    pad: int | Literal["auto"] = "auto",
    initial_extended: Any = None,
    initial_star_fluxes: Any = None,
    refine_positions: bool | Literal["auto"] = "auto",
    refine_psfs: Literal["auto"] | Iterable[Family] = "auto",
    mend_images: bool = True,
) -> Plan:
    """Return what `lnocl.deconvolve` does with an observation; nothing is computed yet.

    Parameters
    ----------
    observation, stars
        As for `lnocl.deconvolve`.
    mu, smoothing, spectral_smoothing, solver, n_iter, stop, precision, engine, device, pad, \
    initial_extended, initial_star_fluxes, refine_positions, refine_psfs, mend_images
        As for `lnocl.deconvolve`.

    Returns
    -------
    Plan
        Printed, a line for each step.

    Raises
    ------
    InputError
        Images, stars or a parameter cannot be used, as of `lnocl.deconvolve`.

    See Also
    --------
    lnocl.deconvolve : Carries it out.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> obs = lnocl.Observation(np.full((16, 16), 9.0), np.ones((3, 3)))
    >>> lnocl.plan(obs).why_not("judge PSFs before the run")
    'there are no stars'
    """
    options.check_observation(observation)
    options.check_choices(solver, precision, engine, device)
    options.check_length(n_iter, stop)
    refine_positions = options.read_refine_positions(refine_positions)
    fits_stars = solver == "sgp" or refine_positions is True
    positions = check_positions(stars, observation)
    refuse_unowned(observation, positions)
    observation = observation.upright()
    initial = options.read_start(observation, fits_stars, initial_extended, initial_star_fluxes)
    smoothing = options.read_smoothing(smoothing)
    # Which refuses what is out of range.
    Penalty(mu, 0.0 if isinstance(smoothing, str) else smoothing, spectral=spectral_smoothing)
    if spectral_smoothing and not observation.component_names:
        raise InputError("`spectral_smoothing` is between components, and the images have none")
    setup = Setup(observation, positions, pad, solver, precision, engine, device, False, *initial)
    mends = flag("mend_images", mend_images)
    how: dict[str, Any] = {"mends": mends, "spectral_smoothing": spectral_smoothing}
    made = Plan(setup, mu, smoothing, int(n_iter), stop, **how)
    is_auto = AUTO.holds(made) and made.does(PSFS)
    showing = positions[owned(observation, positions) < 0]
    families = options.check_families(refine_psfs, observation, showing, refine_positions, is_auto)
    moves = refine_positions if is_auto else refine_positions is True
    return replace(
        made,
        setup=replace(setup, refine_positions=moves is True, settles_halos=made.does(HALOS)),
        families=families,
        is_asked=bool(families) and not isinstance(refine_psfs, str),
        moves=moves,
    )
