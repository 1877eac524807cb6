"""Amounts of halos, and levels of the background, that runs are to hold, from a short run.

Fitted with a sky that is positive and free, halos lose more of their light with every iteration
(`lnocl.core.solvers.halos`). So they are first estimated in a run that is too short for that, with
the extended source marginalised. Then the reconstruction holds them, and they are estimated again
when it has ended. So are levels that are not known, which are held as background.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, Start, make_model, make_start, measure_steps
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.penalty import Penalty
from lnocl.core.solvers.halos import marginal_halos
from lnocl.core.solvers.levels import fit_levels
from lnocl.process import ignored_notes, ignored_warnings

# Iterations of the short run: the most likely amounts are right to 0.5 % then, and fall.
N_ITER = 10


def settle_halos(start: Start) -> Start:
    """Return a start of a scene that holds its halos; as it is where it has none to hold."""
    if not (start.setup.settles_halos and start.scene.n_halos):
        return start
    with ignored_warnings(), ignored_notes():  # those of the reconstruction are the same
        found = _short_run(start.setup).changed(marginal_halos)
    return hold_halos(start, found)


def hold_halos(start: Start, found: Estimate) -> Start:
    """Return a start of a scene whose halos are held at those of an estimate, if it has any."""
    setup, n = start.setup, start.scene.n_stars
    if not (setup.settles_halos and start.scene.n_halos):
        return start
    fluxes = np.append(start.star_fluxes[:n], found.fluxes[n:])
    held = start.scene.holding(fluxes, start.scene.penalty)
    extended = start.extended if setup.initial_extended is not None else held.start(None, None)[0]
    fluxes, scaling = measure_steps(setup, held, make_model(held), extended, fluxes)
    return replace(start, scene=held, extended=extended, star_fluxes=fluxes, scaling=scaling)


def settle_levels(setup: Setup) -> Setup:
    """Return a setup with the levels of the background that are fitted after a short run."""
    with ignored_warnings(), ignored_notes():
        found = _short_run(setup).changed(fit_levels)
    return replace(setup, observation=found.scene.observation)


def _short_run(setup: Setup) -> Estimate:
    """Return the estimate after a short run."""
    free = replace(setup, solver="sgp", refine_positions=False, initial_extended=None)
    run = Run(make_start(free, Penalty()), N_ITER)
    run.complete()
    return run.estimate()
